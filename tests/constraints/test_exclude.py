"""Excluded boxes: no sensor, interval or ray's start lies in one, and nothing else changes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import fits
from support.sensors import normal_sensor

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.origins import placement_notes
from lidardesign.errors import InfeasibleError
from lidardesign.rays.proposals import Proposals
from lidardesign.samples import Samples
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.space import DesignSpace, aim, observed_point

ROOM = DesignSpace((-1, -1, 0, 0.0, -math.pi / 2, 0.05), (1, 1, 2, 2 * math.pi, math.pi / 2, 6.0))
CENTRE, WIDTH = np.array([0.0, 0.0, 1.0]), 0.2
SLAB = {"low_m": [-0.3, -5, -5], "high_m": [0.2, 5, 5]}
PILLAR = {"low_m": [-0.5, -0.5, -1.0], "high_m": [0.5, 0.5, 1.5]}


def log_target(points):
    """One blob of scene points, seen from everywhere."""
    return -0.5 * np.square((observed_point(points) - CENTRE) / WIDTH).sum(axis=-1)


def room(count=6000):
    """Samples of the density of a blob in the middle of the room."""
    generator = np.random.default_rng(0)
    scene = CENTRE + WIDTH * generator.standard_normal((count, 3))
    points = aim(generator.uniform(ROOM.low[:3], ROOM.high[:3], (count, 3)), scene)
    points = points[ROOM.contains(points)]
    target = log_target(points)
    return Samples(points, target + 2 * np.log(points[:, 5]), target, ROOM)


SAMPLES = room()
REGION = {"spread_m": {"max": 9.0}}


def fitted(samples=SAMPLES, count=None, rays=None, **values):
    return fits.fitted(samples, values, sensors=count, rays=rays, retarget=log_target)


def broken(found, **values):
    return fits.broken(found, values, ROOM)


def box_checks(found, values):
    return [check.name for check in fits.checks(found, values, ROOM) if "exclude" in check.name]


def interval(sensor):
    """Lowest and highest origin along each axis at the level 0.95, by a factor of its own."""
    reach = 1.959963984540054 * np.sqrt(np.diag(sensor.covariance_m2))
    return sensor.origin_m - reach, sensor.origin_m + reach


def assert_outside(found, boxes):
    for sensor in found.sensors:
        low, high = interval(sensor)
        for box in boxes:
            into = (high > np.array(box["low_m"]) + 1e-9) & (low < np.array(box["high_m"]) - 1e-9)
            into &= np.array(box["low_m"]) < np.array(box["high_m"])
            assert not into.all(), (sensor.origin_m, low, high, box)


def places(found):
    return [(*sensor.origin_m, *sensor.covariance_m2.ravel()) for sensor in found.sensors]


@pytest.mark.parametrize("region", [{}, REGION], ids=["places", "regions"])
@pytest.mark.parametrize("box", [SLAB, PILLAR], ids=["slab", "pillar"])
def test_no_sensor_and_no_ray_is_in_an_excluded_box(region, box):
    origin = {"exclude": [box], **region}
    found = fitted(origin=origin)
    assert_outside(found, [box])
    rules = Constraints.from_mapping({"origin": origin}).rules
    start_m = Proposals(found.sensors, rules, 0.95, SAMPLES).draw(200, {}, np.random.default_rng(0)).origin_m
    assert not ((start_m > box["low_m"]) & (start_m < box["high_m"])).all(axis=1).any()
    assert broken(found, origin=origin) == []
    assert box_checks(found, {"origin": origin}) == [f"s{i}.origin.exclude[0]" for i in range(4)]


def test_the_admissible_mass_is_the_density_outside():
    found = fitted(origin={"exclude": [SLAB], **REGION})
    outside = (SAMPLES.points[:, 0] <= -0.3) | (SAMPLES.points[:, 0] >= 0.2)
    assert found.admissible_mass == pytest.approx(SAMPLES.weights[outside].sum())


@pytest.mark.parametrize("axis", range(3))
def test_flat_boxes_exclude_nothing_and_it_is_said(axis):
    box = {"low_m": [-0.5, -0.5, 0.5], "high_m": [0.5, 0.5, 1.5]}
    box["high_m"][axis] = box["low_m"][axis]
    values = {"origin": {"exclude": [box], **REGION}}
    flat = fitted(count=2, **values)
    assert places(flat) == places(fitted(count=2, origin=REGION))
    assert broken(flat, **values) == []
    notes = placement_notes(Constraints.from_mapping(values).rules)
    assert notes == ("origin.exclude[0] has no volume and excludes nothing",)


def test_an_entry_of_each_replaces_the_common_boxes():
    values = {"origin": {"exclude": [SLAB]}, "each": [{"origin": {"exclude": []}}, {}]}
    assert box_checks(fitted(**values), values) == ["s1.origin.exclude[0]"]


def test_mounts_in_an_excluded_box_are_dropped_and_it_is_said():
    mounts = [[0.0, 0.0, 0.1], [0.8, 0.0, 0.1], [-0.8, 0.0, 0.1]]
    values = {"origin": {"exclude": [PILLAR], "mounts_m": mounts}}
    found = fitted(**values)
    assert sorted(sensor.origin_m[0] for sensor in found.sensors) == [-0.8, 0.8]
    assert broken(found, **values) == []
    notes = placement_notes(Constraints.from_mapping(values).rules)
    assert notes == ("1 of 3 origin.mounts_m left out, inside origin.exclude: [0.0, 0.0, 0.1]",)


def test_a_sensor_may_sit_on_the_surface_of_a_box():
    origin = {"exclude": [PILLAR], "fixed_m": [0.5, 0.0, 1.0]}
    found = fitted(count=1, origin=origin)
    assert list(found.sensors[0].origin_m) == [0.5, 0.0, 1.0]
    assert broken(found, origin=origin) == []


def without(*boxes, **origin):
    return {"exclude": list(boxes), **origin}


NARROW = {"low_m": [-0.2, -1, 0], "high_m": [0.1, 1, 2]}
RIGHT = {"low_m": [0.1, -5, -5], "high_m": [3, 5, 5]}
EVERYTHING = {"low_m": [-2, -2, -2], "high_m": [2, 2, 2]}
INSIDE = {"fixed_m": [0, 0, 1]}
TWO = {"count": 2}
BOX, BOXES, SPACE = "origin.exclude[0]", "origin.exclude", ("space.x_m", "space.y_m", "space.z_m")
CONFLICTS = [
    ({"origin": without(PILLAR, **INSIDE)}, [BOX, "origin.fixed_m"]),
    ({"origin": without(SLAB, PILLAR, **NARROW)}, [BOX, "origin.low_m", "origin.high_m"]),
    ({"origin": without(SLAB, RIGHT, low_m=[-0.2, -1, 0])}, [BOXES, "origin.low_m"]),
    ({"origin": without(EVERYTHING)}, [BOX, *SPACE]),
    ({"origin": without(PILLAR, mounts_m=[[0, 0, 1], [0.1, 0, 1]])}, ["origin.mounts_m", BOXES]),
    (
        {"sensors": TWO, "origin": without(PILLAR, mounts_m=[[0, 0, 1], [0.7, 0, 1]])},
        ["sensors.count", "origin.mounts_m", BOXES],
    ),
    ({"origin": without(PILLAR), "each": [{}, {"origin": INSIDE}]}, [BOX, "each[1].origin.fixed_m"]),
    ({"sensors": TWO, "origin": without(PILLAR, **INSIDE), "each": [{}]}, [BOX, "origin.fixed_m"]),
]


@pytest.mark.parametrize(("values", "conflicts"), CONFLICTS)
def test_boxes_that_leave_no_place_are_refused_by_name(values, conflicts):
    with pytest.raises(InfeasibleError) as caught:
        fitted(**values)
    assert list(caught.value.conflicts) == conflicts


@pytest.mark.parametrize("region", [{}, REGION], ids=["places", "regions"])
def test_a_narrow_gap_between_boxes_is_a_place(region):
    walls = [{"low_m": [-2, -2, -1], "high_m": [0.6, 2, 3]}, {"low_m": [0.61, -2, -1], "high_m": [2, 2, 3]}]
    found = fitted(room(60_000), count=1, origin={"exclude": walls, **region})
    assert broken(found, origin={"exclude": walls, **region}) == []
    (sensor,) = found.sensors
    low, high = interval(sensor)
    assert 0.6 <= low[0] <= high[0] <= 0.61
    assert (low[0] < high[0]) == bool(region)


@pytest.mark.parametrize("region", [{}, REGION], ids=["places", "regions"])
def test_far_from_the_origin_of_coordinates_nothing_changes(region):
    """Boxes ten kilometres away are kept as those around the origin are."""
    shift = np.array([10_000.0, -20_000.0, 500.0])
    space = DesignSpace((*(ROOM.low[:3] + shift), *ROOM.low[3:]), (*(ROOM.high[:3] + shift), *ROOM.high[3:]))
    points = SAMPLES.points.copy()
    points[:, :3] += shift
    box = {key: (np.array(value) + shift).tolist() for key, value in PILLAR.items()}
    away = Samples(points, SAMPLES.log_prob, SAMPLES.log_target, space)
    moved, here = (
        fits.fitted(samples, {"origin": {"exclude": [one], **region}}, sensors=3, retarget=retarget)
        for samples, one, retarget in (
            (away, box, lambda points: log_target(points - np.append(shift, [0, 0, 0]))),
            (SAMPLES, PILLAR, log_target),
        )
    )
    for one, other in zip(moved.sensors, here.sensors, strict=True):
        np.testing.assert_allclose(one.origin_m - shift, other.origin_m, atol=1e-3)


@pytest.mark.parametrize(
    ("mean_x", "spread_x", "names"),
    [(0.0, 0.0, ["s1.origin.exclude[0]"]), (0.7, 0.1, []), (0.7, 0.11, ["s1.origin.exclude[0]"])],
)
def test_a_mean_in_a_box_and_an_interval_that_reaches_into_it_are_seen(mean_x, spread_x, names):
    moved = normal_sensor("s1", 0.5, (mean_x, 0, 1), origin_covariance_m2=np.diag([spread_x**2, 0, 0]))
    sensors = (normal_sensor("s0", 0.5, (0.7, 0, 1)), moved)
    checks = check_design(design_document(DesignSpec("d", sensors)), {"origin": {"exclude": [PILLAR]}}, ROOM)
    assert [check.name for check in checks if not check.satisfied and "exclude" in check.name] == names


def test_boxes_are_given_by_option_and_by_file(call, flat, tmp_path):
    (tmp_path / "rules.yaml").write_text("origin:\n  exclude: [{low_m: [-9, -9, -9], high_m: [0.5, 9, 9]}]\n")
    options = ["--constraints", "rules.yaml", "--set", "origin.exclude.0.high_m=[0.6, 9, 9]"]
    result = call("constrain", flat, "--layout", "even", "--sensors", 2, *options, "--json")
    assert result.code == 0, result.err
    rows = [row for row in result.json["constraints"] if "exclude" in row["name"]]
    assert len(rows) == 2
    assert all(row["satisfied"] and row["value"]["low_m"][0] >= 0.6 for row in rows)
    assert rows[0]["bound"]["high_m"] == [0.6, 9, 9]
    shown = call("show", "run/designs/constrained.yaml")
    assert "low_m [-9, -9, -9], high_m [0.6, 9, 9]" in shown.out
