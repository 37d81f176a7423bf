"""Distributed designs: rays across their sensors' origins, how they follow from where they start, and couplings."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from lidardesign.layouts import distributed as lines
from lidardesign.layouts.distributed import in_region, normal_ball
from lidardesign.layouts.rays import lay_out
from scipy.special import chdtri
from support.rings import RING
from support.tables import each_row

from lidardesign.mixture.ensemble import coupling_of
from lidardesign.mixture.fit import fit
from lidardesign.sensors.pattern import low_discrepancy
from lidardesign.sensors.sensor import Sensor, tangent_directions
from lidardesign.space import angles, observed_point

SLOPES = np.array([[0.4, -0.2, 0.1], [0.3, 0.5, -0.3]])
RANGE_SLOPES, ANGLE_SLOPES = np.array([0.2, -0.1, 0.3]), np.array([0.25, -0.4])


def planted(count=20_000, seed=0):
    """A sensor and samples of its joint Gaussian."""
    generator = np.random.default_rng(seed)
    root = np.array([[0.10, 0.0, 0.0], [0.03, 0.06, 0.0], [0.01, -0.02, 0.04]])
    x = generator.standard_normal((count, 3)) @ root.T
    u = x @ SLOPES.T + generator.standard_normal((count, 2)) * [0.05, 0.08]
    r = 0.9 + x @ RANGE_SLOPES + u @ ANGLE_SLOPES + 0.02 * generator.standard_normal(count)
    spread = u.std(axis=0)
    sensor = Sensor(
        "s0", 1.0, np.array([0.2, -0.1, 1.0]), root @ root.T, 0.7, -1.2, 0.3, float(spread[0]), float(spread[1]),
        0.9, float(r.std()),
    )  # fmt: skip
    azimuth, elevation = angles(tangent_directions(sensor.frame, u))
    return sensor, np.column_stack([x + sensor.origin_m, azimuth, elevation, r])


FITTED = fit(RING, sensors=3, layout="distributed", rays=120, em_samples=4000, restarts=2)


def without_table(design):
    return replace(design, ray_table=None, rays=None, sensors=tuple(replace(s, rays=None) for s in design.sensors))


def test_the_coupling_of_a_planted_joint_gaussian_is_its_regression():
    sensor, points = planted()
    found = coupling_of(sensor, points, np.ones(len(points)))
    np.testing.assert_allclose(found.direction_per_m, SLOPES, atol=0.05)
    np.testing.assert_allclose(found.range_per_m, RANGE_SLOPES, atol=0.03)
    np.testing.assert_allclose(found.range_per_rad, ANGLE_SLOPES, atol=0.01)
    np.testing.assert_allclose(found.spread_rad, [0.05, 0.08], rtol=0.02)
    np.testing.assert_allclose(found.spread_m, 0.02, rtol=0.02)


def test_the_coupling_of_weighted_samples_is_that_of_repeated_ones():
    sensor, points = planted(300)
    times = np.random.default_rng(1).integers(1, 4, len(points))
    weighted = coupling_of(sensor, points, times.astype(np.float64))
    repeated = coupling_of(sensor, np.repeat(points, times, axis=0), np.ones(times.sum()))
    assert json.dumps(weighted.as_dict()) != ""
    for name in ("direction_per_m", "range_per_m", "range_per_rad", "spread_rad", "spread_m"):
        np.testing.assert_allclose(getattr(weighted, name), getattr(repeated, name), rtol=1e-9)


def test_residual_spreads_are_at_most_the_marginal_ones():
    for sensor in FITTED.design.sensors:
        assert sensor.coupling.spread_rad[0] <= sensor.spread_horizontal_rad
        assert sensor.coupling.spread_rad[1] <= sensor.spread_vertical_rad
        assert sensor.coupling.spread_m <= sensor.spread_range_m


def test_a_fixed_origin_and_too_few_samples_have_no_coupling():
    sensor, points = planted(1000)
    fixed = replace(sensor, origin_covariance_m2=np.zeros((3, 3)))
    assert coupling_of(fixed, points, np.ones(len(points))) is None
    assert coupling_of(sensor, points[:20], np.ones(20)) is None


def test_what_does_not_vary_has_no_slope():
    sensor, points = planted(1000)
    points[:, 1] = sensor.origin_m[1]
    flat = sensor.origin_covariance_m2.copy()
    flat[1], flat[:, 1] = 0.0, 0.0
    found = coupling_of(replace(sensor, origin_covariance_m2=flat), points, np.ones(len(points)))
    assert (found.direction_per_m[:, 1] == 0).all()
    assert found.range_per_m[1] == 0
    still = points.copy()
    still[:, 0], still[:, 2], still[:, 5] = sensor.origin_m[0], sensor.origin_m[2], 0.9
    found = coupling_of(sensor, still, np.ones(len(points)))
    values = np.concatenate([np.ravel(v) for v in found.as_dict().values()])
    assert np.isfinite(values).all()
    assert (found.direction_per_m == 0).all()


@each_row("samples", [RING, None], ids=["samples", "design file"])
@each_row("count", [1, 7, 400])
def test_rays_start_inside_the_ellipsoids_of_their_sensors(samples, count):
    design = without_table(FITTED.design)
    rays = lay_out(design, count, samples)
    assert len(rays.origin_m) == count
    for index, sensor in enumerate(design.sensors):
        own = rays.sensor == index
        azimuth, elevation = angles(rays.direction[own])
        points = np.column_stack([rays.origin_m[own], azimuth, elevation, np.full(own.sum(), sensor.range_m)])
        assert in_region(replace(sensor, level=sensor.level + 1e-6), points).all()
        start, end = sensor.gate_m
        assert (rays.gate_m[own, 0] >= start).all()
        assert (rays.gate_m[own, 1] <= end).all()
        assert (rays.gate_m[own, 1] > rays.gate_m[own, 0]).all()


def test_no_ray_of_a_blocked_cone_is_fired():
    rays = lay_out(without_table(FITTED.design), 400, RING)
    assert np.degrees(np.arccos(-rays.direction[:, 2])).min() > 14.9


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_low_discrepancy_points_fill_the_ball_as_a_normal_vector_does(axes):
    points = normal_ball(low_discrepancy(4000, axes), 0.95)
    radius = np.square(points).sum(axis=1)
    assert radius.max() <= chdtri(axes, 0.05) * (1 + 1e-12)
    for share in (0.25, 0.5, 0.9):
        assert (radius <= chdtri(axes, 1 - 0.95 * share)).mean() == pytest.approx(share, abs=0.01)
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.01)


def test_more_rays_leave_no_populated_region_empty():
    views = observed_point(RING.points)
    design = without_table(FITTED.design)
    reach = []
    for count in (50, 200, 800):
        rays = lay_out(design, count, RING)
        away = views[:500, None] - rays.origin_m
        along = (away * rays.direction).sum(axis=2)
        nearest = np.linalg.norm(away - along[:, :, None] * rays.direction, axis=2).min(axis=1)
        reach.append((np.mean(nearest), np.quantile(nearest, 0.98)))
    assert (np.diff(reach, axis=0) < 0).all()
    assert reach[2][1] < 0.05


def test_distances_from_lines_agree_with_the_cross_product_in_whatever_blocks(monkeypatch):
    generator = np.random.default_rng(8)
    points, origins, looking = (generator.normal(size=(n, 3)) for n in (50, 7, 7))
    looking /= np.linalg.norm(looking, axis=1)[:, None]
    weights = generator.random(50)
    apart = np.square(np.cross(points[:, None] - origins, looking)).sum(axis=2)
    for block in (1, 60, 1_000_000):
        monkeypatch.setattr(lines, "BLOCK", block)
        nearest, away = lines.nearest_lines(points, origins, looking)
        np.testing.assert_array_equal(nearest, apart.argmin(axis=1))
        np.testing.assert_allclose(away, apart.min(axis=1), atol=1e-12)
        np.testing.assert_allclose(lines.mean_squares(points, weights, origins, looking), weights @ apart, rtol=1e-10)
