"""The design space: its chart, its poles, its seam, its fixed dimensions and its bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import references
from support.spaces import log_volume

from lidardesign.space import AZIMUTH, ELEVATION, DesignSpace, aim, angles, direction, observed_point

LOW, HIGH = (-1.0, 0.0, 2.0, -0.5, -1.2, 0.1), (1.0, 3.0, 2.0, 2.5, 0.9, 4.0)
ALL_ROUND_LOW, ALL_ROUND_HIGH = (0.0, 0.0, 0.0, 0.0, -math.pi / 2, 0.0), (0.0, 0.0, 0.0, 2 * math.pi, math.pi / 2, 5.0)
MEASURES = ("solid_angle", "angles")
azimuths = st.floats(-20.0, 20.0)
elevations = st.floats(-math.pi / 2, math.pi / 2)


@given(azimuths, elevations)
def test_directions_have_unit_length_and_their_angles_point_the_same_way(azimuth, elevation):
    found = direction(azimuth, elevation)
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=references.ROUNDING)
    again = direction(*angles(7.0 * found))
    np.testing.assert_allclose(again, found, atol=references.ROUNDING)
    assert 0 <= angles(found)[0] < 2 * math.pi


@pytest.mark.hard_case("2")
def test_the_poles_are_finite_and_straight():
    for sign in (-1.0, 1.0):
        np.testing.assert_allclose(direction(1.3, sign * math.pi / 2), [0, 0, sign], atol=references.ROUNDING)
        assert angles(np.array([0.0, 0.0, sign])) == (0.0, sign * math.pi / 2)


def test_an_azimuth_just_below_zero_is_not_rounded_to_a_full_turn():
    azimuth, _ = angles(np.array([1.0, -1e-20, 0.0]))
    assert azimuth == 0.0


def test_aiming_observes_the_target():
    generator = np.random.default_rng(0)
    origins, targets = generator.normal(size=(2, 100, 3))
    points = aim(origins, targets)
    np.testing.assert_allclose(observed_point(points), targets, atol=10 * references.ROUNDING)


def test_turning_the_world_turns_directions_and_keeps_ranges():
    generator = np.random.default_rng(1)
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    origins, targets = generator.normal(size=(2, 50, 3))
    still, turned = aim(origins, targets), aim(origins @ turn.T, targets @ turn.T)
    np.testing.assert_allclose(turned[:, 5], still[:, 5], rtol=1e-13)
    expected = direction(still[:, AZIMUTH], still[:, ELEVATION]) @ turn.T
    found = direction(turned[:, AZIMUTH], turned[:, ELEVATION])
    np.testing.assert_allclose(found, expected, atol=10 * references.ROUNDING)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize(("low", "high"), [(LOW, HIGH), (ALL_ROUND_LOW, ALL_ROUND_HIGH)])
def test_unit_coordinates_make_the_round_trip_and_fixed_dimensions_are_exact(measure, low, high):
    space = DesignSpace(low, high, measure=measure)
    unit = np.random.default_rng(2).uniform(-1, 1, (500, len(space.free)))
    points = space.from_unit(unit)
    assert space.contains(points).all()
    # arcsine near the poles loses half of the digits: 1e-8 at worst
    np.testing.assert_allclose(space.to_unit(points), unit, atol=1e-7)
    for i in set(range(6)) - set(space.free):
        assert (points[:, i] == low[i]).all()


@pytest.mark.parametrize("measure", MEASURES)
def test_corners_of_the_unit_box_are_corners_of_the_space(measure):
    space = DesignSpace(LOW, HIGH, measure=measure)
    corners = space.from_unit(np.array([-np.ones(5), np.ones(5)]))
    np.testing.assert_allclose(corners, [LOW, HIGH], atol=references.ROUNDING)


def test_a_solid_angle_is_the_area_on_the_sphere_and_directions_fill_it_evenly():
    space = DesignSpace((0, 0, 0, 0, -math.pi / 2, 1), (0, 0, 0, 2 * math.pi, math.pi / 2, 1))
    assert log_volume(space) == pytest.approx(math.log(4 * math.pi))
    points = space.sample(20_000, np.random.default_rng(3))
    mean = direction(points[:, AZIMUTH], points[:, ELEVATION]).mean(axis=0)
    assert np.abs(mean).max() < references.STANDARD_ERRORS * math.sqrt(1 / 3 / 20_000)


def test_the_paper_chart_is_even_in_elevation():
    space = DesignSpace((0, 0, 0, 0, -1.0, 1), (0, 0, 0, 1.0, 1.0, 1), measure="angles")
    elevation = space.sample(20_000, np.random.default_rng(4))[:, ELEVATION]
    assert abs((np.abs(elevation) < 0.5).mean() - 0.5) < references.STANDARD_ERRORS * 0.5 / math.sqrt(20_000)


@pytest.mark.parametrize("turns", [-3, -1, 1, 2])
def test_azimuths_count_modulo_a_turn(turns):
    space = DesignSpace(LOW, HIGH)
    points = space.sample(200, np.random.default_rng(5))
    moved = points + np.eye(6)[AZIMUTH] * turns * 2 * math.pi
    assert space.contains(moved).all()
    np.testing.assert_allclose(space.wrap(moved), points, atol=1e-12)
    np.testing.assert_allclose(space.to_unit(moved), space.to_unit(points), atol=1e-12)


def test_rounding_at_either_end_of_the_azimuth_stays_inside():
    space = DesignSpace(LOW, HIGH)
    points = space.from_unit(np.zeros((4, 5)))
    points[:, AZIMUTH] = [LOW[3] - 1e-12, LOW[3], HIGH[3], HIGH[3] + 1e-12]
    assert space.contains(points).all()
    assert np.abs(space.to_unit(points)[:, 2]).max() <= 1 + 1e-11


def test_a_fixed_azimuth_accepts_itself_after_whole_turns():
    space = DesignSpace((0, 0, 0, 1.0, 0, 1), (1, 0, 0, 1.0, 0, 2))
    points = space.from_unit(np.zeros((3, 2)))
    points[:, AZIMUTH] += np.array([-2, 0, 2]) * math.pi
    assert space.contains(points).all()


def test_both_ends_of_a_full_turn_are_the_same_ray():
    space = DesignSpace(ALL_ROUND_LOW, ALL_ROUND_HIGH)
    assert space.full_azimuth
    ends = space.from_unit(np.array([[-1.0, 0.2, 0.1], [1.0, 0.2, 0.1]]))
    np.testing.assert_allclose(observed_point(ends[0]), observed_point(ends[1]), atol=1e-14)


def test_a_space_with_every_dimension_fixed_is_one_point():
    space = DesignSpace((1.0,) * 6, (1.0,) * 6)
    assert space.free == ()
    assert (space.sample(3, np.random.default_rng(6)) == 1.0).all()


def test_conditions_are_free_dimensions_of_that_name():
    space = DesignSpace(LOW, HIGH, condition=("x_m", "z_m"))
    assert space.conditioned == (0,)  # z is fixed


@pytest.mark.parametrize("measure", MEASURES)
def test_a_space_survives_its_own_dictionary(measure):
    space = DesignSpace(LOW, HIGH, condition=("y_m",), measure=measure)
    assert DesignSpace.from_dict(space.as_dict()) == space
    one_number = DesignSpace.from_dict({**space.as_dict(), "z_m": 2.0})
    assert one_number == space
