"""Proposals around surfaces, in and from their shell: weighted to p* they agree with brute force, rim included."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from lidardesign.density.independent import independent_points, resampled_proposals
from lidardesign.density.settings import DensitySettings
from lidardesign.density.shell import shell_proposals
from lidardesign.density.target import build_target
from lidardesign.scene import Body, Mesh, Scene, Sphere, rigid
from lidardesign.space import AZIMUTH, DesignSpace, direction

CENTRE, RADIUS, SIGMA = np.array([1.0, 0.0, 0.1]), 0.3, 0.02


def ball():
    return Body(Sphere(RADIUS), poses=rigid(translation_m=CENTRE))


def mesh_ball():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return Body(Mesh(mesh.vertices, mesh.faces), poses=rigid(translation_m=CENTRE))


def open_space(measure="solid_angle"):
    return DesignSpace((0, -0.05, 0, -0.6, -0.5, 0.3), (0, 0.05, 0, 0.6, 0.7, 1.6), measure=measure)


def flat_space():
    return DesignSpace((0, 0, 0, -0.6, 0.05, 0.3), (0, 0, 0, 0.6, 0.05, 1.6))


def on_the_rim(points):
    """Whether a ray passes the ball without meeting it."""
    offset = CENTRE - points[:, :3]
    forward = direction(points[:, 3], points[:, 4])
    along = np.einsum("nk,nk->n", offset, forward)
    return np.linalg.norm(offset - along[:, None] * forward, axis=1) > RADIUS


def weighted_means(points, log_weights, functions):
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    means = np.array([np.sum(weights * f(points)) for f in functions])
    errors = [math.sqrt(np.sum(weights**2 * (f(points) - m) ** 2)) for f, m in zip(functions, means, strict=True)]
    return means, np.array(errors)


FUNCTIONS = (on_the_rim, lambda p: p[:, 5], lambda p: p[:, 4], lambda p: np.abs(p[:, 3]))


@pytest.mark.parametrize("body", [ball, mesh_ball], ids=["primitive", "mesh"])
@pytest.mark.parametrize("measure", ["solid_angle", "angles"])
@pytest.mark.parametrize("visibility", ["off", "raycast"])
def test_weighted_proposals_have_the_moments_of_the_target(body, measure, visibility, tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARDESIGN_CACHE", str(tmp_path))
    space, scenes = open_space(measure), [Scene((body(),))]
    target = build_target(scenes, space, DensitySettings(sigma_m=SIGMA), visibility)
    generator = np.random.default_rng(1)
    points, log_density = independent_points(target, scenes, 20_000, generator)
    assert space.contains(points).all()
    found, error = weighted_means(points, target.log_density(points) - log_density, FUNCTIONS)
    brute = space.sample(200_000, generator)
    expected, brute_error = weighted_means(brute, target.log_density(brute), FUNCTIONS)
    # the density of the shell is exact to first order in sigma / radius = 1 / 15, squared over two curvatures
    curvature = 2 * SIGMA / RADIUS * np.array([expected[0], 0.05, 0.05, 0.05])
    assert (np.abs(found - expected) < 4 * np.hypot(error, brute_error) + curvature).all()
    assert found[0] > 0.01


def test_weights_of_shell_proposals_are_bounded():
    space, scenes = open_space(), [Scene((mesh_ball(),))]
    target = build_target(scenes, space, DensitySettings(sigma_m=SIGMA), "off")
    points, log_density = shell_proposals(target.field, scenes, space, 5_000, SIGMA, np.random.default_rng(2))
    log_weights = target.log_density(points) - log_density
    area = 4 * math.pi * RADIUS**2
    assert log_weights.max() <= math.log(area / points[:, 5].min() ** 2) + 1e-9


def test_with_a_fixed_angle_points_are_resampled_by_proximity():
    space, scenes = flat_space(), [Scene((ball(),))]
    target = build_target(scenes, space, DensitySettings(sigma_m=SIGMA), "raycast")
    generator = np.random.default_rng(3)
    points, log_density = independent_points(target, scenes, 20_000, generator)
    alike = resampled_proposals(target, 20_000, np.random.default_rng(3))
    np.testing.assert_array_equal(points, alike[0])
    found, error = weighted_means(points, target.log_density(points) - log_density, FUNCTIONS)
    brute = space.sample(200_000, generator)
    expected, brute_error = weighted_means(brute, target.log_density(brute), FUNCTIONS)
    assert (np.abs(found - expected) < 4 * np.hypot(error, brute_error) + 1e-3).all()
    assert found[0] > 0.01


@pytest.mark.parametrize("body", [ball, mesh_ball], ids=["primitive", "mesh"])
def test_with_a_fixed_range_points_at_that_range_have_the_moments_of_the_target(body, tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARDESIGN_CACHE", str(tmp_path))
    wide, scenes = open_space(), [Scene((body(),))]
    range_m = (wide.low[5] + wide.high[5]) / 2
    space = DesignSpace((*wide.low[:5], range_m), (*wide.high[:5], range_m))
    target = build_target(scenes, space, DensitySettings(sigma_m=SIGMA), "raycast")
    generator = np.random.default_rng(3)
    points, log_density = independent_points(target, scenes, 20_000, generator)
    assert (points[:, 5] == range_m).all()
    found, error = weighted_means(points, target.log_density(points) - log_density, FUNCTIONS)
    brute = space.sample(200_000, generator)
    expected, brute_error = weighted_means(brute, target.log_density(brute), FUNCTIONS)
    # 20,000 points are drawn, with repetition, from the candidates near the surface: as in plain integration
    assert (np.abs(found - expected) < 4 * np.hypot(error, 2 * brute_error) + 1e-3).all()


def test_a_space_that_reaches_no_surface_gives_no_proposals():
    away = DesignSpace((0, 0, 0, math.pi - 0.1, -0.1, 0.1), (0, 0, 0, math.pi + 0.1, 0.1, 0.5))
    for body in (ball(), mesh_ball()):
        target = build_target([Scene((body,))], away, DensitySettings(sigma_m=SIGMA), "off")
        assert len(independent_points(target, [Scene((body,))], 500, np.random.default_rng(4))[0]) == 0
    flat = DesignSpace((0, 0, 0, math.pi - 0.1, 0.0, 0.1), (0, 0, 0, math.pi + 0.1, 0.0, 0.5))
    target = build_target([Scene((ball(),))], flat, DensitySettings(sigma_m=SIGMA), "off")
    assert len(independent_points(target, [Scene((ball(),))], 500, np.random.default_rng(5))[0]) == 0


@pytest.mark.parametrize("body", [ball, mesh_ball], ids=["primitive", "mesh"])
def test_the_same_seed_gives_the_same_proposals(body):
    space, scenes = open_space(), [Scene((body(),))]
    target = build_target(scenes, space, DensitySettings(sigma_m=SIGMA), "off")
    first, second = (independent_points(target, scenes, 100, np.random.default_rng(6))[0] for _ in range(2))
    assert first.tobytes() == second.tobytes()
    assert np.ptp(first[:, AZIMUTH]) > 0
