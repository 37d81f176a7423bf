"""Patterns: rays at knots of a condition, each of them one ray all along."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import conditions, patterns

from lidardesign.errors import ConfigError
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.pattern import TRAVELLED, Pattern, low_discrepancy, with_coordinates
from lidardesign.space import DIMENSIONS, angles, direction

shares = st.floats(0, 1)
moving = conditions.flatmap(lambda name: patterns(dimension=name))
ROUNDING = 1e-9


def columns_of(pattern):
    """Every number of the rays at the knots, shape (P, N, 7)."""
    angular = np.stack([pattern.azimuth_rad, pattern.elevation_rad], axis=2)
    return np.concatenate([pattern.origin_m, angular, pattern.gate_m], axis=2)


def columns_at(pattern, value):
    rays = pattern.at(value)
    return np.concatenate([rays.origin_m, rays.angles_rad, rays.gate_m], axis=1)


def between(pattern, share, last=-1):
    """A value of the condition from the first knot to another."""
    return min(pattern.knots[0] + share * (pattern.knots[last] - pattern.knots[0]), pattern.knots[last])


# --- at a value of the condition


@given(moving)
def test_at_a_knot_rays_are_exactly_those_of_the_knot(pattern):
    for knot, there in zip(pattern.knots, columns_of(pattern), strict=True):
        np.testing.assert_array_equal(columns_at(pattern, knot), there)
        np.testing.assert_array_equal(pattern.at(knot).sensor, pattern.sensor)


@given(moving, shares)
def test_between_knots_every_number_of_a_ray_is_linear(pattern, share):
    value = between(pattern, share)
    table = columns_of(pattern).reshape(len(pattern.knots), -1)
    naive = np.array([np.interp(value, pattern.knots, column) for column in table.T])
    # so close that gates keep between knots the bounds that they keep at both
    rounding = ROUNDING * np.maximum(1.0, np.abs(table).max(axis=0))
    assert (np.abs(columns_at(pattern, value).ravel() - naive) <= rounding).all()


@given(moving, shares)
def test_rays_start_where_the_condition_is(pattern, share):
    value = between(pattern, share)
    assert (pattern.at(value).origin_m[:, DIMENSIONS.index(pattern.dimension)] == value).all()
    assert len(TRAVELLED) == pattern.origin_m.shape[2]


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -0.1, 1.1])
def test_beyond_the_ends_and_nowhere_there_are_no_rays(value):
    pattern = Pattern.along("x_m", [0.0, 1.0], [fan(0.0), fan(1.0)], (0.0, 1.0))
    with pytest.raises(ConfigError, match=r"(?s)--at.*0 to 1" + (r".*--at x_m=0\.5" if value is None else "")):
        pattern.at(value)


@given(patterns(), st.none() | st.floats(allow_nan=True))
def test_without_a_condition_rays_are_the_same_everywhere(pattern, value):
    np.testing.assert_array_equal(columns_at(pattern, value), columns_of(pattern)[0])


# --- of lists of rays

KNOTS = [-0.2, 0.5, 1.1, 2.0]
ENDS = (-0.5, 4.0)
OWNER = np.array([0, 0, 0, 1, 1])


def fan(x, turn=0.0):
    """Two sensors whose rays are well apart, and turn and listen further the farther the robot is."""
    azimuth = np.array([-1.0, 0.0, 1.0, -0.5, 0.5]) + 0.1 * x + turn
    elevation = np.array([0.1, 0.2, 0.3, 0.4, 0.5]) - 0.05 * x
    start = np.array([1.0, 1.1, 1.2, 1.3, 1.4]) + 0.1 * x
    return Rays.from_angles(np.zeros((5, 3)), azimuth, elevation, np.stack([start, start + 0.3], axis=1), OWNER)


def in_order(pattern):
    """The rays of a pattern in an order that does not depend on theirs."""
    table = np.concatenate([columns_of(pattern), np.tile(pattern.sensor[None, :, None], (len(pattern.knots), 1, 1))], 2)
    return table[:, np.lexsort((pattern.elevation_rad[0], pattern.sensor))]


@given(st.data(), st.permutations(KNOTS))
def test_a_ray_is_the_same_ray_at_all_knots_however_lists_and_knots_are_ordered(data, knots):
    mixed = [fan(x).subset(np.array(data.draw(st.permutations(range(5))))) for x in knots]
    found = Pattern.along("x_m", knots, mixed, ENDS)
    expected = Pattern.along("x_m", KNOTS, [fan(x) for x in KNOTS], ENDS)
    np.testing.assert_allclose(in_order(found), in_order(expected), rtol=0, atol=1e-12)
    assert found.knots == expected.knots
    # the first knot says in which order rays fire
    np.testing.assert_array_equal(found.sensor, mixed[int(np.argmin(knots))].sensor)


def test_a_pattern_passes_through_the_lists_that_it_is_of():
    pattern = Pattern.along("x_m", KNOTS, [fan(x) for x in KNOTS], ENDS)
    for x in KNOTS:
        rays, here = fan(x), pattern.at(x)
        np.testing.assert_allclose(here.azimuth_rad, rays.azimuth_rad, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(here.elevation_rad, rays.elevation_rad)
        np.testing.assert_array_equal(here.gate_m, rays.gate_m)
        np.testing.assert_array_equal(here.origin_m, np.tile([x, 0.0, 0.0], (5, 1)))


@given(st.integers(0, 1000))
def test_rays_of_a_sensor_become_those_that_move_least_together(seed):
    generator = np.random.default_rng(seed)
    lists = []
    for _ in range(3):
        gate = np.sort(generator.uniform(1, 3, (4, 2)), axis=1)
        lists.append(Rays.from_angles(np.zeros((4, 3)), *generator.uniform(-1, 1, (2, 4)), gate, np.zeros(4, int)))
    aims = [one.direction * one.gate_m.mean(axis=1, keepdims=True) for one in lists]
    orders = [list(order) for order in itertools.permutations(range(4))]
    pattern, best = Pattern.along("y_m", [0.0, 1.0, 2.0], lists, (0.0, 2.0)), range(4)
    for place in (1, 2):
        before = aims[place - 1][best]
        best = min(orders, key=lambda order: np.square(before - aims[place][order]).sum())
        np.testing.assert_array_equal(pattern.gate_m[place], lists[place].gate_m[best])


def test_a_ray_keeps_to_its_sensor_though_another_sensors_ray_is_nearer():
    def pair(first, second):
        gate = np.tile([1.0, 1.2], (2, 1))
        return Rays.from_angles(np.zeros((2, 3)), np.array([first, second]), np.zeros(2), gate, np.array([0, 1]))

    pattern = Pattern.along("x_m", [0.0, 1.0], [pair(-0.3, 0.3), pair(0.3, -0.3)], (0.0, 1.0))
    np.testing.assert_allclose(pattern.azimuth_rad, [[-0.3, 0.3], [0.3, -0.3]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("ends", "further"), [(ENDS, 2), ((KNOTS[0], KNOTS[-1]), 0), ((-1.0, KNOTS[-1]), 1)])
def test_beyond_the_first_and_last_list_rays_stay_as_they_are_there(ends, further):
    pattern = Pattern.along("x_m", KNOTS, [fan(x) for x in KNOTS], ends)
    assert (pattern.ends, len(pattern.knots)) == (ends, len(KNOTS) + further)
    for end, knot in zip(ends, (KNOTS[0], KNOTS[-1]), strict=True):
        there, here = pattern.at(end), pattern.at(knot)
        np.testing.assert_array_equal(there.angles_rad, here.angles_rad)
        np.testing.assert_array_equal(there.gate_m, here.gate_m)


@pytest.mark.parametrize("turn", [0.95, math.pi - 0.05])
def test_rays_pass_through_north_and_south_without_a_jump(turn):
    lists = [fan(x, turn) for x in KNOTS]
    wrapped = [Rays.from_angles(one.origin_m, *angles(one.direction), one.gate_m, one.sensor) for one in lists]
    pattern = Pattern.along("x_m", KNOTS, wrapped, ENDS)
    assert np.abs(np.diff(pattern.azimuth_rad, axis=0)).max() < 0.2
    np.testing.assert_allclose(pattern.at(0.8).direction, fan(0.8, turn).direction, atol=1e-3)


@pytest.mark.parametrize("turn", [0.0, 0.4, -2.0])
def test_a_sensor_turned_about_the_vertical_turns_its_rays_by_as_much_at_every_knot(turn):
    pattern, own = Pattern.along("x_m", KNOTS, [fan(x) for x in KNOTS], ENDS), OWNER == 1
    rotation = np.stack([direction(turn, 0.0), direction(turn + math.pi / 2, 0.0), [0.0, 0.0, 1.0]], axis=1)
    moved = pattern.remounted(1, np.array([9.0, 0.2, 0.0]), np.array([9.0, 0.5, 1.0]), rotation)
    away = columns_of(moved) - columns_of(pattern)
    expected = np.array([0.2 * math.sin(turn), 0.5 - 0.2 * math.cos(turn), 1.0, turn, 0.0, 0.0, 0.0])
    # whole turns are the same at all knots
    away[..., 3] -= 2 * math.pi * np.round((away[0, :, 3] - turn * own) / (2 * math.pi))
    np.testing.assert_allclose(away, np.broadcast_to(own[:, None] * expected, away.shape), rtol=0, atol=1e-12)


@given(patterns())
def test_the_pattern_of_a_list_is_the_list(pattern):
    rays = pattern.at()
    again = Pattern.of(rays).at()
    for name in ("origin_m", "direction", "gate_m", "sensor", "time_s", "angles_rad"):
        np.testing.assert_array_equal(getattr(again, name), getattr(rays, name))
    np.testing.assert_array_equal(rays.direction, direction(rays.azimuth_rad, rays.elevation_rad))


# --- what it says of itself


def test_a_pattern_stays_what_it_is_and_is_no_other():
    pattern = Pattern.of(fan(0.0))
    assert len({pattern, replace(pattern)}) == 2
    with pytest.raises(AttributeError, match="cannot assign"):
        pattern.dimension = "x_m"


@given(patterns() | moving, st.dictionaries(st.integers(0, 2), st.floats(-9, 9)))
def test_moving_changes_the_named_coordinates_of_origins_alone(pattern, values):
    moved = replace(pattern, origin_m=with_coordinates(pattern.origin_m, values))
    expected = columns_of(pattern)
    for axis, value in values.items():
        expected[..., axis] = value
    np.testing.assert_array_equal(columns_of(moved), expected)


@given(patterns() | moving)
def test_gates_are_of_rays_where_two_of_a_sensor_differ_anywhere(pattern):
    pairs = itertools.combinations(range(len(pattern)), 2)
    differ = any(
        pattern.sensor[one] == pattern.sensor[other] and (pattern.gate_m[:, one] != pattern.gate_m[:, other]).any()
        for one, other in pairs
    )
    assert pattern.gates == ("ray" if differ else "sensor")
    shared = np.broadcast_to(pattern.gate_m[:1, :1], pattern.gate_m.shape)
    assert Pattern(**{**vars(pattern), "gate_m": shared}).gates == "sensor"


# --- even points


def naive_even_points(count, axes):
    """Multiples of a root's powers (Roberts), or of more axes whole numbers with their digits turned round (Halton)."""
    if axes <= 2:
        root = np.roots([1.0, *[0.0] * (axes - 1), -1.0, -1.0]).real.max()
        return (0.5 + np.arange(1, count + 1)[:, None] / root ** np.arange(1, axes + 1)) % 1

    def turned_round(number, base):
        return number and (number % base + turned_round(number // base, base)) / base

    return [[turned_round(number, prime) for prime in (7, 5, 3, 2)[-axes:]] for number in range(1, count + 1)]


@pytest.mark.parametrize("axes", [1, 2, 3, 4])
def test_even_points_are_those_of_their_papers(axes):
    np.testing.assert_allclose(low_discrepancy(50, axes), naive_even_points(50, axes), rtol=0, atol=1e-12)
