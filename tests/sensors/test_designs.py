"""Designs: how many rays they fire, which, and where."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.designs import sensor, three_sensors
from support.strategies import patterns

from lidardesign.errors import ConfigError
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern, even_rays, field_on_sphere
from lidardesign.sensors.sensor import boresight_frame
from lidardesign.space import direction

EVEN = DesignSpec("d", three_sensors())
TURN = 0.7


def chosen(*numbers):
    """A design of rays that were chosen for these numbers."""
    tables = (Pattern.of(even_rays(EVEN.sensors, split_budget(EVEN.weights, number))) for number in numbers)
    return replace(EVEN, layout="chosen", patterns=tuple(tables))


def fixed(count=60, layout="fixed"):
    return replace(chosen(count), layout=layout)


def assert_same_rays(found, expected):
    for name in ("origin_m", "direction", "gate_m", "sensor"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


# --- how many


def test_a_design_is_meant_for_its_largest_pattern_or_for_its_budget():
    assert (chosen(5, 20).count, fixed(7).count, EVEN.count) == (20, 7, None)
    assert replace(EVEN, constraints={"budget": {"rays": 30}}).count == 30
    assert replace(chosen(5), constraints={"budget": {"rays": 30}}).count == 5
    with pytest.raises(ConfigError, match="--rays N"):
        EVEN.rays()


def test_only_chosen_rays_have_numbers_of_their_own_and_only_fixed_patterns_a_size():
    designs = (EVEN, chosen(5, 20), fixed(7), fixed(7, "spinning"))
    assert [design.counts for design in designs] == [None, [5, 20], None, None]
    assert [design.size for design in designs] == [None, None, 7, 7]


@given(patterns(sensors=3), st.data())
def test_how_many_rays_a_sensor_fires_is_read_off_its_pattern_whatever_its_weight(pattern, data):
    design = replace(EVEN, layout="fixed", patterns=(pattern,))
    np.testing.assert_array_equal(design.rays_per_sensor(), np.bincount(pattern.sensor, minlength=3))
    for one in (design, EVEN):
        some = data.draw(st.integers(0, len(pattern)))
        fired = np.bincount(one.rays(some).sensor, minlength=3)
        np.testing.assert_array_equal(one.rays_per_sensor(some), fired)
    assert EVEN.rays_per_sensor() is None


# --- which


def test_chosen_rays_are_fired_at_the_numbers_that_they_were_chosen_for_alone():
    design = chosen(5, 20)
    for number in (5, 20):
        assert_same_rays(design.rays(number), design.pattern(number).at())
    assert_same_rays(design.rays(), design.rays(20))
    for number in (0, 4, 12, 21):
        with pytest.raises(ConfigError, match=f"(?s){number} rays.*5, 20.*--rays {number}"):
            design.rays(number)


@pytest.mark.hard_case("35")
@pytest.mark.parametrize("count", [0, 1, 2, 3, 50, 101])
def test_even_rays_are_of_any_number_and_shared_out_by_weight(count):
    rays = EVEN.rays(count)
    assert len(rays) == count
    assert (np.diff(rays.sensor) >= 0).all()
    np.testing.assert_array_equal(np.bincount(rays.sensor, minlength=3), split_budget(EVEN.weights, count, each=True))
    np.testing.assert_allclose(rays.time_s, np.arange(count) / (max(count, 1) * DEFAULT_RATE_HZ))
    for index, one in enumerate(EVEN.sensors):
        own = rays.sensor == index
        assert (rays.gate_m[own] == one.gate_m).all()
        assert (rays.origin_m[own] == one.origin_m).all()


@pytest.mark.parametrize("elevation", [-math.pi / 2, -1.2, 0.0, 1.0, math.pi / 2])
@pytest.mark.parametrize("spread", [0.05, 0.4, 1.7])
def test_all_even_rays_are_inside_the_field_of_view_also_straight_down(elevation, spread):
    looking = sensor(elevation_rad=elevation, spread_rad=(spread, 0.06))
    rays = DesignSpec("d", (looking,)).rays(137)
    assert (np.abs(looking.tangent_of(rays.direction)) <= np.array(looking.field_of_view_rad) / 2 + 1e-9).all()
    assert len(np.unique(np.round(rays.direction, 9), axis=0)) == 137


# half of the diagonals of these fields are 2.5, 3 and 3.5 rad
@pytest.mark.parametrize(("field", "share"), [((3.0, 4.0), 1.0), ((3.6, 4.8), 1.0), ((4.2, 5.6), math.pi / 3.5)])
def test_a_field_beyond_the_sphere_is_shrunk_so_that_no_ray_goes_round(field, share):
    wide = replace(sensor(), field_of_view_rad=field)
    np.testing.assert_allclose(field_on_sphere(wide), share * np.array(field))
    assert len(np.unique(np.round(even_rays([wide], [50]).direction, 9), axis=0)) == 50


def test_every_sensor_has_its_own_number_of_even_rays():
    with pytest.raises(ValueError, match="zip"):
        even_rays(EVEN.sensors, [5])


def test_a_sensor_whose_field_has_no_width_fires_along_its_boresight():
    still = replace(sensor(), field_of_view_rad=(0.0, 0.0))
    rays = DesignSpec("d", (still,)).rays(5)
    np.testing.assert_allclose(rays.direction, np.tile(still.boresight, (5, 1)), atol=1e-12)


def test_permuting_the_sensors_permutes_their_even_rays():
    order = [2, 0, 1]
    rays, other = EVEN.rays(101), replace(EVEN, sensors=tuple(EVEN.sensors[i] for i in order)).rays(101)
    for new, old in enumerate(order):
        np.testing.assert_array_equal(rays.direction[rays.sensor == old], other.direction[other.sensor == new])


@pytest.mark.parametrize("layout", ["fixed", "spinning"])
@pytest.mark.parametrize("count", [0, 1, 7, 30, 59, 60])
def test_fewer_rays_of_a_fixed_pattern_are_some_of_its_own_in_each_sensors_proportion(layout, count):
    design = fixed(60, layout)
    rays, whole = design.rays(count), design.patterns[0].at()
    own = np.bincount(whole.sensor, minlength=3)
    np.testing.assert_array_equal(np.bincount(rays.sensor, minlength=3), split_budget(own, count))
    fired = {(int(s), *d) for s, d in zip(whole.sensor, whole.direction, strict=True)}
    kept = {(int(s), *d) for s, d in zip(rays.sensor, rays.direction, strict=True)}
    assert len(kept) == count
    assert kept <= fired
    np.testing.assert_allclose(rays.time_s, np.arange(count) / max(count, 1) / 10)


def test_half_of_a_fixed_pattern_is_spread_over_all_of_it():
    design = fixed()
    rays, table = design.rays(30), design.rays()
    for index in range(3):
        whole, half = table.direction[table.sensor == index], rays.direction[rays.sensor == index]
        steps = np.linalg.norm(whole[:, None] - whole, axis=2)
        neighbour = np.where(steps > 0, steps, np.inf).min(axis=1).max()
        assert np.linalg.norm(whole[:, None] - half, axis=2).min(axis=1).max() < 2 * neighbour


@pytest.mark.parametrize("layout", ["fixed", "spinning"])
def test_a_fixed_pattern_has_no_further_rays(layout):
    with pytest.raises(ConfigError, match=r"(?s)61 rays.*has 60.*at most 60"):
        fixed(60, layout).rays(61)


# --- where


@given(st.floats(-10, 10), st.sampled_from([EVEN, chosen(9), fixed(9), replace(EVEN, at={"x_m": 0.37})]))
def test_a_design_without_a_condition_moves_and_keeps_its_rays(at, design):
    still, away = design.rays(9), design.rays(9, at={"x_m": at})
    assert (away.origin_m[:, 0] == at).all()
    np.testing.assert_array_equal(away.origin_m[:, 1:], still.origin_m[:, 1:])
    np.testing.assert_array_equal(away.direction, still.direction)
    np.testing.assert_array_equal(away.gate_m, still.gate_m)


@pytest.mark.parametrize(
    ("at", "words"),
    [
        ({"azimuth_rad": 1.0}, "cannot be moved"), ({"range_m": 1.0}, "cannot be moved"),
        ({"speed": 1.0}, "not a dimension"), ({"x_m": math.inf}, "finite"), ({"x_m": math.nan}, "finite"),
    ],
)  # fmt: skip
def test_only_origins_move(at, words):
    with pytest.raises(ConfigError, match=words):
        EVEN.rays(9, at=at)


def test_a_design_for_one_direction_is_for_no_other():
    turned = replace(EVEN, at={"azimuth_rad": 0.3})
    assert_same_rays(turned.rays(9, at={"azimuth_rad": 0.3}), EVEN.rays(9))
    with pytest.raises(ConfigError, match=r"azimuth_rad=0\.3"):
        turned.rays(9, at={"azimuth_rad": 1.0})


def along(layout="chosen", ends=(0.0, 1.0)):
    """Three rays of a sensor along x, turning upwards or downwards on their way."""
    lists = [
        Rays.from_angles(np.zeros((3, 3)), np.full(3, 1.0), np.array(up), np.tile([0.5, 1.5], (3, 1)), np.zeros(3))
        for up in ([0.0, 0.4, 0.8], [0.1, 0.4, 0.7])
    ]
    pattern = Pattern.along("x_m", ends, lists, ends)
    return DesignSpec("along", (sensor(origin_m=(0.5, 0.0, 0.0)),), layout, (pattern,), provenance={"run": "."})


@given(st.floats(0, 1))
def test_a_design_with_a_condition_is_at_a_place_what_its_patterns_are_there(at):
    design = along()
    here = design.at_condition({"x_m": at})
    assert_same_rays(design.rays(at={"x_m": at}), design.patterns[0].at(at))
    assert_same_rays(here.rays(), design.patterns[0].at(at))
    assert (here.condition, here.at, here.counts) == (None, {"x_m": at}, design.counts)
    assert here.sensors[0].origin_m.tolist() == [at, 0.0, 0.0]
    some = along("fixed").rays(2, at={"x_m": at})
    assert {*map(tuple, some.direction)} <= {*map(tuple, design.patterns[0].at(at).direction)}


@pytest.mark.parametrize("at", [None, {}, {"x_m": -0.1}, {"x_m": 1.1}, {"x_m": math.nan}, {"y_m": 0.0}])
def test_a_design_with_a_condition_needs_a_place_between_its_ends(at):
    with pytest.raises(ConfigError, match=r"(?s)--at.*(0 to 1|x_m)"):
        along().rays(at=at)


# --- a sensor at another pose


@given(patterns(sensors=3), st.integers(0, 2), st.tuples(*[st.floats(-3, 3)] * 6))
def test_the_rays_of_a_sensor_go_with_it_and_come_back_with_it(pattern, index, numbers):
    design = replace(EVEN, layout="chosen", patterns=(pattern,))
    old, place, frame = design.sensors[index], np.array(numbers[:3]), boresight_frame(*numbers[3:])
    moved = design.remounted(index, place, frame)
    new = moved.sensors[index]
    np.testing.assert_allclose(new.frame, frame, atol=1e-9)
    own = pattern.sensor == index
    for value in pattern.ends if pattern.dimension else (None,):
        before, after = pattern.at(value), moved.patterns[0].at(value)
        # in the sensor's own axes every ray starts and looks as before
        if pattern.dimension is None:
            start = (before.origin_m[own] - old.origin_m) @ old.frame.T
            np.testing.assert_allclose((after.origin_m[own] - place) @ frame.T, start, atol=1e-6)
        np.testing.assert_allclose(after.direction[own] @ frame.T, before.direction[own] @ old.frame.T, atol=1e-9)
        np.testing.assert_array_equal(after.gate_m, before.gate_m)
        for name in ("origin_m", "direction"):
            np.testing.assert_array_equal(getattr(after, name)[~own], getattr(before, name)[~own])
    back = moved.remounted(index, old.origin_m, old.frame).patterns[0]
    np.testing.assert_allclose(back.origin_m, pattern.origin_m, atol=1e-6)
    looking = [direction(one.azimuth_rad, one.elevation_rad) for one in (back, pattern)]
    np.testing.assert_allclose(*looking, atol=1e-9)
