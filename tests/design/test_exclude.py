"""Excluded boxes: no sensor, interval or ray's start lies in one, and nothing else changes."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lidardesign.layouts.rays import lay_out
from support.aisles import AISLE
from support.command_line import caller, make_run
from support.tables import each_row

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.mixture.fit import fit
from lidardesign.samples import Samples
from lidardesign.sensors.design_file import design_document, load_design, save_design
from lidardesign.space import DesignSpace, aim, observed_point

ROOM = DesignSpace((-1, -1, 0, 0.0, -math.pi / 2, 0.05), (1, 1, 2, 2 * math.pi, math.pi / 2, 6.0))
CENTRE, WIDTH = np.array([0.0, 0.0, 1.0]), 0.2
SLAB = {"low_m": [-0.3, -5, -5], "high_m": [0.2, 5, 5]}
PILLAR = {"low_m": [-0.5, -0.5, -1.0], "high_m": [0.5, 0.5, 1.5]}


def log_target(points):
    """One blob of scene points, seen from everywhere."""
    return -0.5 * np.square((observed_point(points) - CENTRE) / WIDTH).sum(axis=-1)


def room(count=12_000, seed=0, space=ROOM):
    """Samples of the density of a blob in the middle of the room."""
    generator = np.random.default_rng(seed)
    scene = CENTRE + WIDTH * generator.standard_normal((count, 3))
    origin = generator.uniform(space.low[:3], space.high[:3], (count, 3))
    points = aim(origin, scene)
    points = points[space.contains(points)]
    target = log_target(points)
    return Samples(points, target + 2 * np.log(points[:, 5]), target, space)


SAMPLES = room()


def fitted(samples=SAMPLES, count=None, layout="grid", rays=None, **values):
    constraints = Constraints.from_mapping(values)
    return fit(
        samples, sensors=count, layout=layout, rays=rays, constraints=constraints, retarget=log_target,
        em_samples=2000, restarts=2,
    )  # fmt: skip


def interval(sensor):
    """Lowest and highest origin along each axis at the level 0.95, by a factor of its own."""
    reach = 1.959963984540054 * np.sqrt(np.diag(sensor.origin_covariance_m2))
    return sensor.origin_m - reach, sensor.origin_m + reach


def assert_outside(design, boxes):
    for sensor in design.sensors:
        low, high = interval(sensor)
        for box in boxes:
            into = (high > np.array(box["low_m"]) + 1e-9) & (low < np.array(box["high_m"]) - 1e-9)
            into &= np.array(box["low_m"]) < np.array(box["high_m"])
            assert not into.all(), (sensor.origin_m, low, high, box)
    if design.ray_table is not None:
        assert not any(starting_in(box, design.ray_table) for box in boxes)


def starting_in(box, rays):
    return ((rays.origin_m > box["low_m"]) & (rays.origin_m < box["high_m"])).all(axis=1).any()


def places(result):
    return [(*sensor.origin_m, *sensor.origin_covariance_m2.ravel()) for sensor in result.design.sensors]


@each_row("layout", ["grid", "density", "distributed", "scan"])
@each_row("box", [SLAB, PILLAR], ids=["slab", "pillar"])
def test_no_sensor_and_no_ray_is_in_an_excluded_box(layout, box):
    result = fitted(layout=layout, rays=40, origin={"exclude": [box]})
    assert_outside(result.design, [box])
    assert result.satisfied
    rows = [check for check in result.constraints if "exclude" in check.name]
    assert len(rows) == len(result.design.sensors)
    assert rows[0].name == "s0.origin.exclude[0]"


def test_the_admissible_mass_is_the_density_outside():
    result = fitted(origin={"exclude": [SLAB]})
    outside = (SAMPLES.points[:, 0] <= -0.3) | (SAMPLES.points[:, 0] >= 0.2)
    assert result.admissible_mass == pytest.approx(SAMPLES.weights[outside].sum())


def test_boxes_beyond_the_space_change_nothing():
    free = fitted(count=2)
    far = fitted(count=2, origin={"exclude": [{"low_m": [3, -9, -9], "high_m": [5, 9, 9]}]})
    assert places(far) == places(free)
    assert far.log_likelihood == free.log_likelihood


@pytest.mark.parametrize("axis", range(3))
def test_flat_boxes_exclude_nothing_and_it_is_said(axis):
    box = {"low_m": [-0.5, -0.5, 0.5], "high_m": [0.5, 0.5, 1.5]}
    box["high_m"][axis] = box["low_m"][axis]
    flat = fitted(count=2, origin={"exclude": [box]})
    assert places(flat) == places(fitted(count=2))
    assert flat.satisfied
    assert flat.notes[0] == "origin.exclude[0] has no volume and excludes nothing"


def test_each_sensor_may_have_boxes_of_its_own():
    left, right = {"low_m": [-2, -2, -1], "high_m": [0, 2, 3]}, {"low_m": [0, -2, -1], "high_m": [2, 2, 3]}
    result = fitted(each=[{"origin": {"exclude": [left]}}, {"origin": {"exclude": [right]}}])
    first, second = result.design.sensors
    assert interval(first)[0][0] >= -1e-9
    assert interval(second)[1][0] <= 1e-9
    assert result.satisfied


def test_an_entry_of_each_replaces_the_common_boxes():
    result = fitted(origin={"exclude": [SLAB]}, each=[{"origin": {"exclude": []}}, {}])
    names = [check.name for check in result.constraints if "exclude" in check.name]
    assert names == ["s1.origin.exclude[0]"]


def test_boxes_hold_together_with_spreads():
    origin = {"exclude": [PILLAR], "spread_m": {"max": 0.3}, "thickness_m": {"max": 0.02}}
    result = fitted(count=4, origin=origin)
    assert_outside(result.design, [PILLAR])
    assert result.satisfied


def test_mounts_in_an_excluded_box_are_dropped_and_it_is_said():
    mounts = [[0.0, 0.0, 0.1], [0.8, 0.0, 0.1], [-0.8, 0.0, 0.1]]
    result = fitted(origin={"exclude": [PILLAR], "mounts_m": mounts})
    assert sorted(sensor.origin_m[0] for sensor in result.design.sensors) == [-0.8, 0.8]
    assert result.satisfied
    assert "1 of 3 origin.mounts_m left out, inside origin.exclude: [0.0, 0.0, 0.1]" in result.notes


def test_a_sensor_may_sit_on_the_surface_of_a_box():
    result = fitted(count=1, origin={"exclude": [PILLAR], "fixed_m": [0.5, 0.0, 1.0]})
    assert list(result.design.sensors[0].origin_m) == [0.5, 0.0, 1.0]
    assert result.satisfied


@each_row(
    ("values", "conflicts"),
    [
        ({"origin": {"exclude": [PILLAR], "fixed_m": [0, 0, 1]}}, ["origin.exclude[0]", "origin.fixed_m"]),
        (
            {"origin": {"exclude": [SLAB, PILLAR], "low_m": [-0.2, -1, 0], "high_m": [0.1, 1, 2]}},
            ["origin.exclude[0]", "origin.low_m", "origin.high_m"],
        ),
        (
            {"origin": {"exclude": [SLAB, {"low_m": [0.1, -5, -5], "high_m": [3, 5, 5]}], "low_m": [-0.2, -1, 0]}},
            ["origin.exclude", "origin.low_m"],
        ),
        (
            {"origin": {"exclude": [{"low_m": [-2, -2, -2], "high_m": [2, 2, 2]}]}},
            ["origin.exclude[0]", "space.x_m", "space.y_m", "space.z_m"],
        ),
        (
            {"origin": {"exclude": [PILLAR], "mounts_m": [[0, 0, 1], [0.1, 0, 1]]}},
            ["origin.mounts_m", "origin.exclude"],
        ),
        (
            {"sensors": {"count": 2}, "origin": {"exclude": [PILLAR], "mounts_m": [[0, 0, 1], [0.7, 0, 1]]}},
            ["sensors.count", "origin.mounts_m", "origin.exclude"],
        ),
        (
            {"origin": {"exclude": [PILLAR]}, "each": [{}, {"origin": {"fixed_m": [0, 0, 1]}}]},
            ["origin.exclude[0]", "each[1].origin.fixed_m"],
        ),
        (
            {"sensors": {"count": 2}, "origin": {"exclude": [PILLAR], "fixed_m": [0, 0, 1]}, "each": [{}]},
            ["origin.exclude[0]", "origin.fixed_m"],
        ),
    ],
)  # fmt: skip
def test_boxes_that_leave_no_place_are_refused_by_name(values, conflicts):
    with pytest.raises(InfeasibleError) as caught:
        fitted(**values)
    assert list(caught.value.conflicts) == conflicts


@each_row(
    ("boxes", "message"),
    [
        ([{"low_m": [0, 0, 1], "high_m": [1, 1, 0]}], "low_m is above high_m along z"),
        ([{"low_m": [0, 0, math.nan], "high_m": [1, 1, 1]}], "finite"),
        ([{"low_m": [0, 0], "high_m": [1, 1, 1]}], "at least 3"),
        ([{"low_m": [0, 0, 0, 0], "high_m": [1, 1, 1]}], "at most 3"),
        ([{"low_m": [0, 0, 0]}], "high_m is missing"),
        ([{"low_m": [0, 0, 0], "high_m": [1, 1, 1], "heigh_m": 3}], "unknown key"),
        ([{"low_m": ["a", 0, 0], "high_m": [1, 1, 1]}], "number"),
        ([[0, 0, 0, 1, 1, 1]], "origin.exclude.0"),
        ([SLAB] * 33, "32"),
    ],
)
def test_boxes_that_are_none_and_too_many_are_refused(boxes, message):
    with pytest.raises(ConfigError, match=message):
        Constraints.from_mapping({"origin": {"exclude": boxes}})


@pytest.mark.parametrize("count", [40, 90])
def test_rays_of_another_number_keep_out_with_and_without_samples(count, tmp_path):
    result = fitted(layout="distributed", rays=40, count=3, origin={"exclude": [PILLAR]})
    path = tmp_path / "design.yaml"
    save_design(result.design, path)
    design = load_design(path)
    assert design.constraints == {"origin": {"exclude": [PILLAR]}}
    for samples in (SAMPLES, None):
        for one in (design, replace(design, ray_table=None)):
            assert not starting_in(PILLAR, lay_out(one, count, samples))


def test_a_pinned_coordinate_is_in_a_box_or_not():
    origin = {"low_m": [-1, -1, 0.4], "high_m": [1, 1, 0.4], "exclude": [PILLAR]}
    result = fitted(count=2, origin=origin)
    assert result.satisfied
    assert_outside(result.design, [PILLAR])
    origin = {"low_m": [-1, -1, 1.8], "high_m": [1, 1, 1.8]}
    above = fitted(count=2, origin=origin | {"exclude": [PILLAR]})
    assert places(above) == places(fitted(count=2, origin=origin))


def test_a_narrow_gap_between_boxes_is_a_place():
    walls = [{"low_m": [-2, -2, -1], "high_m": [0.6, 2, 3]}, {"low_m": [0.61, -2, -1], "high_m": [2, 2, 3]}]
    result = fitted(room(60_000), count=1, origin={"exclude": walls})
    assert result.satisfied
    (sensor,) = result.design.sensors
    assert 0.6 <= interval(sensor)[0][0] < interval(sensor)[1][0] <= 0.61


def test_far_from_the_origin_of_coordinates_nothing_changes():
    """Boxes ten kilometres away are kept as those around the origin are."""
    shift = np.array([10_000.0, -20_000.0, 500.0])
    space = DesignSpace((*(ROOM.low[:3] + shift), *ROOM.low[3:]), (*(ROOM.high[:3] + shift), *ROOM.high[3:]))
    points = SAMPLES.points.copy()
    points[:, :3] += shift
    box = {key: (np.array(value) + shift).tolist() for key, value in PILLAR.items()}
    moved = fitted(Samples(points, SAMPLES.log_prob, SAMPLES.log_target, space), count=3, origin={"exclude": [box]})
    here = fitted(count=3, origin={"exclude": [PILLAR]})
    assert moved.satisfied
    for one, other in zip(moved.design.sensors, here.design.sensors, strict=True):
        np.testing.assert_allclose(one.origin_m - shift, other.origin_m, atol=1e-3)


# --- the independent checker


@pytest.fixture(scope="module")
def document():
    return design_document(fitted(layout="distributed", rays=20, count=2, origin={"exclude": [PILLAR]}).design)


def broken(document):
    checks = check_design(document, document["constraints"], ROOM)
    return [check.name for check in checks if not check.satisfied and "exclude" in check.name]


@each_row(
    ("mean_x", "spread_x", "names"),
    [(0.0, 0.0, ["s1.origin.exclude[0]"]), (0.7, 0.1, []), (0.7, 0.11, ["s1.origin.exclude[0]"])],
)
def test_a_mean_in_a_box_and_an_interval_that_reaches_into_it_are_seen(document, mean_x, spread_x, names):
    moved = copy.deepcopy(document)
    moved["sensors"][1]["origin_m"] = {"mean": [mean_x, 0.0, 1.0], "covariance": np.diag([spread_x**2, 0, 0]).tolist()}
    assert broken(moved) == names


def test_a_ray_that_starts_in_a_box_is_seen(document):
    assert broken(document) == []
    moved = copy.deepcopy(document)
    for key in ("origin_x_m", "origin_y_m"):
        moved["ray_table"][key][7] = 0.0
    moved["ray_table"]["origin_z_m"][7] = 1.4999
    assert broken(moved) == ["ray7.origin.exclude[0]"]
    moved["ray_table"]["origin_z_m"][7] = 1.5
    assert broken(moved) == []


# --- tracks


def shelf(count=6000):
    """A wall along an aisle."""
    generator = np.random.default_rng(0)
    points = np.zeros((count, 6))
    points[:, 0] = generator.uniform(-0.5, 4.0, count)
    points[:, 3] = -math.pi / 2
    height = generator.uniform(0.2, 0.8, count)
    points[:, 4], points[:, 5] = np.arctan2(height, 1.2), np.hypot(height, 1.2)
    return Samples(points, np.zeros(count), np.zeros(count), AISLE)


def tracked(box, **origin):
    rules = Constraints.from_mapping({"origin": {"exclude": [box], **origin}})
    return fit(shelf(), layout="scan", rays=4, constraints=rules)


def test_a_track_ends_at_a_box():
    result = tracked({"low_m": [3.0, -1, -1], "high_m": [9, 1, 1]})
    assert (result.design.track.knots[0], result.design.track.knots[-1]) == (-0.5, 3.0)
    assert result.satisfied
    written = design_document(result.design)
    written["track"]["knots_m"][-1] = 3.1
    checks = check_design(written, written["constraints"])
    assert "track.origin.exclude[0]" in [check.name for check in checks if not check.satisfied]


def test_a_box_beside_a_track_is_in_nobodys_way():
    result = tracked({"low_m": [1.0, 0.0, -1], "high_m": [2.0, 1, 1]})
    assert (result.design.track.knots[0], result.design.track.knots[-1]) == (-0.5, 4.0)
    assert result.satisfied


def test_a_box_that_cuts_a_track_is_refused_with_the_pieces():
    cut = {"low_m": [1.0, -1, -1], "high_m": [2.0, 1, 1]}
    with pytest.raises(InfeasibleError, match="2 pieces") as caught:
        tracked(cut)
    assert list(caught.value.conflicts) == ["origin.exclude", "--layout scan"]
    assert "up to 1 or from 2" in caught.value.hint
    assert tracked(cut, low_m=[2, -1, -1]).design.track.knots[0] == 2


# --- the command line


@pytest.fixture
def call(capsys, tmp_path, monkeypatch):
    return caller(capsys, tmp_path, monkeypatch)


GRID = ("--layout", "grid", "--sensors", 2)


def test_boxes_are_given_by_option_and_by_file(call, tmp_path):
    make_run(tmp_path / "run")
    box = "[{low_m: [-9, -9, -9], high_m: [0.5, 9, 9]}]"
    result = call("constrain", "run", *GRID, "--set", f"origin.exclude={box}", "--json", "--name", "right")
    assert result.code == 0, result.err
    rows = [row for row in result.json["constraints"] if "exclude" in row["name"]]
    assert rows
    assert all(row["satisfied"] and row["value"]["low_m"][0] >= 0.5 for row in rows)
    (tmp_path / "rules.yaml").write_text(f"origin:\n  exclude: {box}\n")
    options = ["--constraints", "rules.yaml", "--set", "origin.exclude.0.high_m=[0.6, 9, 9]"]
    result = call("constrain", "run", *GRID, *options, "--json")
    assert result.code == 0, result.err
    rows = [row for row in json.loads(result.out)["constraints"] if "exclude" in row["name"]]
    assert rows[0]["bound"]["high_m"] == [0.6, 9, 9]
    shown = call(
        "constrain", "run", "--layout", "grid", "--constraints", "rules.yaml", "--set", "sensors.count=1", "-v"
    )
    assert "s0.origin.exclude[0]" in shown.out
    assert "low_m [-9, -9, -9], high_m [0.5, 9, 9]" in shown.out
    again = call("constrain", "run/designs/right.yaml", "--json")
    assert again.code == 0, again.err


side = st.floats(-1.2, 1.2).map(lambda value: round(value, 3))
corner = st.tuples(side, side, side.map(lambda value: value + 1))
box = st.tuples(corner, corner).map(
    lambda pair: {"low_m": np.minimum(*pair).tolist(), "high_m": np.maximum(*pair).tolist()}
)


@settings(max_examples=15, deadline=None)
@given(st.lists(box, min_size=1, max_size=4), st.integers(1, 3), st.sampled_from(["grid", "distributed", "scan"]))
def test_whatever_the_boxes_nothing_is_inside_one(boxes, sensors, layout):
    try:
        result = fitted(layout=layout, count=None if layout == "scan" else sensors, rays=12, origin={"exclude": boxes})
    except InfeasibleError:
        return
    assert result.satisfied
    assert_outside(result.design, boxes)
