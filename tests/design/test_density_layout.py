"""The layout `density`: rays on the sphere as far from each other as random ones never are, where the density is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lidardesign.layouts.rays import lay_out
from scipy.spatial import cKDTree

from lidardesign.samples import Samples
from lidardesign.sensors.sensor import DesignSpec, Sensor
from lidardesign.space import DesignSpace, angles

SPACE = DesignSpace((0, 0, 0, 0, -math.pi / 2, 0), (0, 0, 0, 2 * math.pi, math.pi / 2, 10))
SAMPLES = 30_000
HEXAGONAL = 2.149  # mean nearest distance of a hexagonal lattice over that of random points of the same density


def cap(half_angle, count, seed=0):
    """Unit vectors even in solid angle within an angle of the x axis."""
    generator = np.random.default_rng(seed)
    forward = generator.uniform(math.cos(half_angle), 1.0, count)
    turn, sideways = generator.uniform(0, 2 * math.pi, count), np.sqrt(1 - forward**2)
    return np.stack([forward, sideways * np.cos(turn), sideways * np.sin(turn)], axis=1)


def looking_along(directions, azimuth=0.0, elevation=0.0, half_angle=1.6, log_weights=None):
    """A sensor that sees all directions at 1 m, and their samples."""
    spread = half_angle / 1.95
    sensor = Sensor(
        "s", 1.0, np.zeros(3), np.zeros((3, 3)), azimuth, elevation, 0.0, spread, spread, range_m=1.0,
        spread_range_m=0.1,
    )  # fmt: skip
    along = np.column_stack([np.zeros((len(directions), 3)), *angles(directions), np.ones(len(directions))])
    level = np.zeros(len(along))
    samples = Samples(along, level, level if log_weights is None else log_weights, SPACE)
    return DesignSpec("d", (sensor,), layout="density"), samples


def nearest(directions):
    """Chords to the nearest other ray."""
    return cKDTree(directions).query(directions, k=2)[0][:, 1]


def evenness(directions, area):
    """Mean nearest distance over that of random points of the same density: 1 for those, 2.15 at most."""
    return nearest(directions).mean() / (0.5 * math.sqrt(area / len(directions)))


@pytest.mark.parametrize("half_angle", [0.2, 1.5])
def test_rays_keep_their_distance_as_blue_noise_does(half_angle):
    area = 2 * math.pi * (1 - math.cos(half_angle))
    design, samples = looking_along(cap(half_angle, SAMPLES), half_angle=half_angle)
    rays = lay_out(design, 200, samples).direction
    random = cap(half_angle, 200, seed=1)
    assert evenness(random, area) < 1.2
    assert 1.65 < evenness(rays, area) < HEXAGONAL
    # what is nearest is nearly equally near for all: 0.52 for random points
    spacing = nearest(rays)
    assert spacing.std() / spacing.mean() < 0.16
    assert spacing.min() > 0.55 * spacing.mean()


def test_a_wide_field_has_as_many_rays_per_solid_angle_at_its_rim_as_in_its_middle():
    design, samples = looking_along(cap(1.5, SAMPLES), half_angle=1.5)
    rays = lay_out(design, 400, samples).direction
    inner_half = (1 + math.cos(1.5)) / 2
    assert (rays[:, 0] > inner_half).mean() == pytest.approx(0.5, abs=0.025)


def test_rays_turn_with_their_sensor_to_the_pole_and_across_north():
    directions = cap(0.4, 8000)
    design, samples = looking_along(directions, half_angle=0.4)
    rays = lay_out(design, 60, samples).direction
    for azimuth, elevation in ((0.0, -math.pi / 2), (math.pi, 0.7)):
        turned, _ = looking_along(directions, azimuth, elevation, half_angle=0.4)
        frame = turned.sensors[0].frame
        moved, seen = looking_along(directions @ frame, azimuth, elevation, half_angle=0.4)
        np.testing.assert_allclose(lay_out(moved, 60, seen).direction, rays @ frame, atol=1e-9)


def test_the_same_samples_and_seed_give_the_same_bits_and_every_ray_is_inside_the_field():
    design, samples = looking_along(cap(0.6, 6000), half_angle=0.3)
    first, again = (lay_out(design, 150, samples, seed=4) for _ in range(2))
    assert first.direction.tobytes() == again.direction.tobytes()
    assert first.gate_m.tobytes() == again.gate_m.tobytes()
    azimuth, elevation = angles(first.direction)
    horizontal, vertical = design.sensors[0].field_of_view_rad
    assert (np.abs((azimuth + math.pi) % (2 * math.pi) - math.pi) <= horizontal / 2 + 0.02).all()
    assert (np.abs(elevation) <= vertical / 2 + 1e-9).all()
    assert len(np.unique(first.direction, axis=0)) == 150
    narrow = replace(design, sensors=(replace(design.sensors[0], spread_horizontal_rad=0.05),))
    assert np.abs(lay_out(narrow, 150, samples).direction[:, 1]).max() < np.abs(first.direction[:, 1]).max()
