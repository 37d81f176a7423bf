"""Angles are physical: designs turn with their world, across azimuth 0 and at the poles, and thin origins stay thin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lidardesign.layouts.rays import lay_out
from support import references
from support.designs import from_the_ceiling
from support.tables import each_row

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.mixture.bounds import Bounds
from lidardesign.mixture.components import Axes, Features
from lidardesign.mixture.em import mixture_of_labels, run_em
from lidardesign.mixture.fit import fit
from lidardesign.numerics import clipped_eigenvalues
from lidardesign.samples import Samples
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.sensor import boresight_frame, interval_factor, tangent_directions
from lidardesign.space import DesignSpace, aim, angles, direction

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SPHERE = DesignSpace((0, 0, 0, 0, -math.pi / 2, 0.1), (0, 0, 0, 2 * math.pi, math.pi / 2, 2.0))
CUBE = DesignSpace((-1, -1, -1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, math.pi / 2, 3.0))


@pytest.mark.parametrize("layout", ["grid", "density", "distributed", "scan"])
def test_a_design_turns_with_its_world(layout):
    samples = from_the_ceiling()
    sensors = None if layout == "scan" else 3
    straight, around = (
        fit(one, sensors=sensors, layout=layout, rays=40, em_samples=3000, restarts=2).design
        for one in (samples, references.quarter_turned(samples))
    )
    if layout != "scan":
        for one, other in zip(straight.sensors, around.sensors, strict=True):
            assert other.weight == pytest.approx(one.weight, abs=1e-9)
            np.testing.assert_allclose(other.field_of_view_rad, one.field_of_view_rad, atol=1e-9)
            np.testing.assert_allclose(other.gate_m, one.gate_m, atol=1e-9)
            np.testing.assert_allclose(other.boresight, QUARTER @ one.boresight, atol=1e-9)
            np.testing.assert_allclose(other.origin_m, QUARTER @ one.origin_m, atol=1e-9)
            np.testing.assert_allclose(
                other.origin_covariance_m2, QUARTER @ one.origin_covariance_m2 @ QUARTER.T, atol=1e-9
            )
            assert other.travel_m[0] == pytest.approx(one.travel_m[0], abs=1e-9)
    first, second = (in_order(lay_out(one), turn) for one, turn in ((straight, QUARTER), (around, np.eye(3))))
    np.testing.assert_allclose(first, second, atol=1e-9)


def in_order(rays, turn):
    """Origins, directions and gates after a turn, in an order that no frame decides."""
    rows = np.concatenate([rays.origin_m @ turn.T, rays.direction @ turn.T, rays.gate_m], axis=1)
    return rows[np.lexsort(np.round(rows, 7).T)]


@pytest.mark.hard_case("1")
@pytest.mark.hard_case("2")
@each_row(
    ("azimuth", "elevation"),
    [(0.0, 0.0), (2 * math.pi - 1e-3, 0.3), (1.0, -math.pi / 2), (4.0, math.pi / 2), (0.0, -1.5), (3.0, 1.55)],
)
def test_a_field_across_azimuth_zero_or_a_pole_is_the_physical_angle(azimuth, elevation):
    generator = np.random.default_rng(3)
    tangent = generator.normal(0, [0.12, 0.05], (20_000, 2))
    looking = tangent_directions(boresight_frame(azimuth, elevation, 0.3), tangent)
    points = np.column_stack([np.zeros((len(tangent), 3)), *angles(looking), generator.normal(1, 0.05, len(tangent))])
    level = np.zeros(len(points))
    sensor = fit(Samples(points, level, level, SPHERE), sensors=1).design.sensors[0]
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


def test_the_thickness_of_an_origin_is_bounded_along_its_thinnest_direction_alone():
    samples, axes = tilted_sheet()
    free = fit(samples, sensors=1, em_samples=6000).design.sensors[0]
    rules = {"origin": {"thickness_m": {"max": 0.02}}}
    result = fit(samples, sensors=1, em_samples=6000, constraints=Constraints.from_mapping(rules))
    sensor = result.design.sensors[0]
    before, after = (np.sqrt(np.linalg.eigvalsh(s.origin_covariance_m2)) for s in (free, sensor))
    assert after[0] == pytest.approx(0.02, rel=1e-8)
    np.testing.assert_allclose(after[1:], before[1:], rtol=1e-6)
    assert abs(np.linalg.eigh(sensor.origin_covariance_m2)[1][:, 0] @ axes[:, 2]) > 0.99
    assert result.satisfied
    document = design_document(result.design)
    assert all(check.satisfied for check in check_design(document, rules, CUBE))
    failed = [c.name for c in check_design(design_document(replace(result.design, sensors=(free,))), rules)]
    assert f"{free.name}.origin.thickness_m.max" in failed


def test_the_log_likelihood_never_falls_with_thin_origins():
    samples, _ = tilted_sheet()
    features = Features.of(samples.points, samples.weights, Axes.of(CUBE), CUBE)
    bounds = replace(Bounds.unbounded(4, interval_factor(0.95)), origin_thickness=np.full(4, 0.02))
    labels = np.random.default_rng(6).integers(0, 4, len(features))
    trace = run_em(mixture_of_labels(features, labels, bounds), features, bounds, iterations=40)
    assert len(trace.history) > 3
    assert (np.diff(trace.history) >= 0).all()
    thin = np.sqrt(np.linalg.eigvalsh(trace.mixture.origin_covariance_m2)[:, 0])
    assert (thin <= 0.02 * (1 + 1e-9)).all()


def test_lowering_the_least_eigenvalue_is_the_best_covariance_of_bounded_thickness():
    generator = np.random.default_rng(7)
    root = generator.normal(size=(3, 3))
    scatter = root @ root.T
    limit = 0.5 * np.linalg.eigvalsh(scatter)[0]

    def likelihood(covariance):
        return -np.linalg.slogdet(covariance)[1] - np.trace(np.linalg.solve(covariance, scatter))

    best = likelihood(clipped_eigenvalues(scatter, 0.0, np.inf, limit))
    for _ in range(300):
        other = generator.normal(size=(3, 3))
        other = clipped_eigenvalues(other @ other.T + scatter, 1e-3, np.inf, limit)
        assert likelihood(other) <= best + 1e-9


def test_the_travel_is_the_interval_along_the_longest_axis_of_the_origin():
    sensor = fit(from_the_ceiling(), sensors=1, em_samples=2000).design.sensors[0]
    length, along = sensor.travel_m
    spread = math.sqrt(along @ sensor.origin_covariance_m2 @ along)
    assert length == pytest.approx(2 * interval_factor(0.95) * spread, rel=1e-12)
    assert spread**2 == pytest.approx(np.linalg.eigvalsh(sensor.origin_covariance_m2)[-1], rel=1e-12)
    assert along[2] == pytest.approx(0, abs=1e-12)
    fixed = replace(sensor, origin_covariance_m2=np.zeros((3, 3)))
    assert fixed.travel_m[0] == 0
    assert fixed.as_dict()["travel_m"] == {"length": 0.0, "direction": [0.0, 0.0, 0.0]}
