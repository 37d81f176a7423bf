"""Angles are physical: designs turn with their world, across azimuth 0 and at the poles, and thin origins stay thin."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from support import references
from support.designs import from_the_ceiling
from support.fits import broken, fitted

from lidardesign.samples import Samples
from lidardesign.sensors.pattern import even_rays
from lidardesign.sensors.sensor import boresight_frame, interval_factor, tangent_directions
from lidardesign.space import DesignSpace, aim, angles, direction, observed_point

EYE = np.eye(3)
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SPHERE = DesignSpace((0, 0, 0, 0, -math.pi / 2, 0.1), (0, 0, 0, 2 * math.pi, math.pi / 2, 2.0))
CUBE = DesignSpace((-1, -1, -1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, math.pi / 2, 3.0))


def log_target(points, turn=EYE):
    """A blob of scene points under the ceiling."""
    seen = observed_point(points) @ turn
    return -0.5 * np.square((seen - [0.1, 0.0, 0.3]) / [0.2, 0.3, 0.1]).sum(axis=1)


@pytest.mark.parametrize("rules", [{}, {"origin": {"spread_m": {"max": 0.2}}}], ids=["places", "regions"])
def test_sensors_and_their_even_rays_turn_with_their_world(rules):
    samples, found = from_the_ceiling(), []
    for turn, world in ((EYE, samples), (QUARTER, references.quarter_turned(samples))):
        retarget = functools.partial(log_target, turn=turn)
        found.append(fitted(world, rules, sensors=3, retarget=retarget, em_samples=3000))
    for one, other in zip(*(each.sensors for each in found), strict=True):
        assert other.weight == pytest.approx(one.weight, abs=1e-9)
        np.testing.assert_allclose(other.field_of_view_rad, one.field_of_view_rad, atol=1e-9)
        np.testing.assert_allclose(other.gate_m, one.gate_m, atol=1e-9)
        np.testing.assert_allclose(other.boresight, QUARTER @ one.boresight, atol=1e-9)
        np.testing.assert_allclose(other.origin_m, QUARTER @ one.origin_m, atol=1e-9)
        np.testing.assert_allclose(other.covariance_m2, QUARTER @ one.covariance_m2 @ QUARTER.T, atol=1e-9)
        assert (one.region_m > 0) == bool(rules)
    rays = [even_rays(one.sensors, [7, 8, 9]) for one in found]
    first, second = (in_order(one, turn) for one, turn in zip(rays, (QUARTER, EYE), strict=True))
    np.testing.assert_allclose(first, second, atol=1e-9)


def in_order(rays, turn):
    """Origins, directions and gates after a turn, in an order that no frame decides."""
    rows = np.concatenate([rays.origin_m @ turn.T, rays.direction @ turn.T, rays.gate_m], axis=1)
    return rows[np.lexsort(np.round(rows, 7).T)]


@pytest.mark.hard_case("1")
@pytest.mark.hard_case("2")
@pytest.mark.parametrize(
    ("azimuth", "elevation"),
    [(0.0, 0.0), (2 * math.pi - 1e-3, 0.3), (1.0, -math.pi / 2), (4.0, math.pi / 2), (0.0, -1.5), (3.0, 1.55)],
)
def test_a_field_across_azimuth_zero_or_a_pole_is_the_physical_angle(azimuth, elevation):
    generator = np.random.default_rng(3)
    tangent = generator.normal(0, [0.12, 0.05], (20_000, 2))
    looking = tangent_directions(boresight_frame(azimuth, elevation, 0.3), tangent)
    points = np.column_stack([np.zeros((len(tangent), 3)), *angles(looking), generator.normal(1, 0.05, len(tangent))])
    level = np.zeros(len(points))
    (sensor,) = fitted(Samples(points, level, level, SPHERE), sensors=1, em_samples=20_000).sensors
    planted = 2 * interval_factor(0.95) * np.array([0.12, 0.05])
    # near a pole what is horizontal depends on the azimuth of the boresight
    np.testing.assert_allclose(sorted(sensor.field_of_view_rad, reverse=True), planted, rtol=0.02)
    np.testing.assert_allclose(sensor.boresight, direction(azimuth, elevation), atol=0.005)


def tilted_sheet(count=6000, seed=5):
    """Origins on a thick tilted sheet that all look at one blob."""
    generator = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    origin = generator.normal(0, [0.3, 0.2, 0.08], (count, 3)) @ axes.T
    points = aim(np.clip(origin, -1, 1), np.array([0.0, 0.0, 1.8]) + generator.normal(0, 0.1, (count, 3)))
    points = points[CUBE.contains(points)]
    level = np.zeros(len(points))
    return Samples(points, level, level, CUBE), axes


def test_the_thickness_of_a_region_is_bounded_along_its_thinnest_direction_alone():
    samples, axes = tilted_sheet()
    wide = {"spread_m": {"max": 9.0}}
    rules = {"origin": {**wide, "thickness_m": {"max": 0.02}}}
    free, thin = (fitted(samples, one, sensors=1, em_samples=6000) for one in ({"origin": wide}, rules))
    before, after = (np.sqrt(np.linalg.eigvalsh(one.sensors[0].covariance_m2)) for one in (free, thin))
    assert after[0] == pytest.approx(0.02, rel=1e-8)
    np.testing.assert_allclose(after[1:], before[1:], rtol=1e-6)
    assert abs(np.linalg.eigh(thin.sensors[0].covariance_m2)[1][:, 0] @ axes[:, 2]) > 0.99
    assert broken(thin, rules, CUBE) == []
    assert broken(free, rules, CUBE) == ["s0.origin.thickness_m.max"]
