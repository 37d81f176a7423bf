"""Excluded boxes: no sensor, interval or ray's start lies in one, and nothing else changes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidardesign.design.constraints import Constraints
from lidardesign.design.files import design_document
from lidardesign.design.fit import fit
from lidardesign.design.samples import Samples
from lidardesign.errors import ConfigError, InfeasibleError
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


def interval(sensor, level=0.95):
    """Lowest and highest origin along each axis, by a factor of its own."""
    z = {0.95: 1.959963984540054}[level]
    reach = z * np.sqrt(np.diag(sensor.origin_covariance_m2))
    return sensor.origin_m - reach, sensor.origin_m + reach


def assert_outside(design, boxes):
    for sensor in design.sensors:
        low, high = interval(sensor)
        for box in boxes:
            into = (high > np.array(box["low_m"]) + 1e-9) & (low < np.array(box["high_m"]) - 1e-9)
            into &= np.array(box["low_m"]) < np.array(box["high_m"])
            assert not into.all(), (sensor.origin_m, low, high, box)
    if design.ray_table is not None:
        for box in boxes:
            inside = (design.ray_table.origin_m > box["low_m"]) & (design.ray_table.origin_m < box["high_m"])
            assert not inside.all(axis=1).any()


def places(result):
    return [(*sensor.origin_m, *sensor.origin_covariance_m2.ravel()) for sensor in result.design.sensors]


@pytest.mark.parametrize("layout", ["grid", "density", "distributed", "scan"])
@pytest.mark.parametrize("box", [SLAB, PILLAR], ids=["slab", "pillar"])
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


def test_the_order_of_the_boxes_does_not_matter():
    boxes = [SLAB, PILLAR, {"low_m": [0.4, 0.2, 0], "high_m": [0.9, 0.9, 1]}]
    first, *others = [places(fitted(origin={"exclude": list(some)})) for some in itertools.permutations(boxes)]
    assert all(other == first for other in others)


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


@pytest.mark.parametrize(
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


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ({"low_m": [0, 0, 1], "high_m": [1, 1, 0]}, "low_m is above high_m along z"),
        ({"low_m": [0, 0, math.nan], "high_m": [1, 1, 1]}, "finite"),
        ({"low_m": [0, 0], "high_m": [1, 1, 1]}, "at least 3"),
        ({"low_m": [0, 0, 0, 0], "high_m": [1, 1, 1]}, "at most 3"),
        ({"low_m": [0, 0, 0]}, "high_m is missing"),
        ({"low_m": [0, 0, 0], "high_m": [1, 1, 1], "heigh_m": 3}, "unknown key"),
        ({"low_m": ["a", 0, 0], "high_m": [1, 1, 1]}, "number"),
        ([0, 0, 0, 1, 1, 1], "origin.exclude.0"),
    ],
)
def test_boxes_that_are_none_are_refused(box, message):
    with pytest.raises(ConfigError, match=message):
        Constraints.from_mapping({"origin": {"exclude": [box]}})


def test_too_many_boxes_are_refused():
    with pytest.raises(ConfigError, match="32"):
        Constraints.from_mapping({"origin": {"exclude": [SLAB] * 33}})


def test_the_written_design_keeps_its_boxes():
    result = fitted(origin={"exclude": [SLAB]})
    assert design_document(result.design)["constraints"] == {"origin": {"exclude": [SLAB]}}


side = st.floats(-1.2, 1.2).map(lambda value: round(value, 3))
corner = st.tuples(side, side, side.map(lambda value: value + 1))
box = st.tuples(corner, corner).map(
    lambda pair: {"low_m": np.minimum(*pair).tolist(), "high_m": np.maximum(*pair).tolist()}
)


@settings(max_examples=25, deadline=None)
@given(st.lists(box, min_size=1, max_size=4), st.integers(1, 3), st.sampled_from(["grid", "distributed", "scan"]))
def test_whatever_the_boxes_nothing_is_inside_one(boxes, sensors, layout):
    try:
        result = fitted(layout=layout, count=None if layout == "scan" else sensors, rays=12, origin={"exclude": boxes})
    except InfeasibleError:
        return
    assert result.satisfied
    assert_outside(result.design, boxes)
