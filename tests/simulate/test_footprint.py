"""Beams of some width: even, centred, upright; mean ranges and shares of surfaces in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.rays import rays_along

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Body, Box, Plane, Scene, rigid
from lidardesign.simulate.detector.light import Beams, direct_echoes
from lidardesign.simulate.detector.physics import Detector
from lidardesign.simulate.effects.footprint import even_disc, split_beams
from lidardesign.space import direction

HALF_RAD = 0.02


def wide(rays=64, divergence_rad=2 * HALF_RAD):
    return Detector("wide", divergence_rad=divergence_rad, footprint_rays=rays)


def beams_along(directions):
    return Beams.of(rays_along(directions, (0.0, 10.0)))


def echoes_of(scene, beams):
    return direct_echoes(scene, beams, SceneCaster(scene).first_hit(beams.origin_m, beams.direction))


@pytest.mark.parametrize("count", [2, 3, 8, 16, 33, 100])
def test_points_of_the_disc_are_its_own_half_turn_with_the_mean_square_radius_of_a_disc(count):
    points = even_disc(count)
    assert points.shape == (count, 2)
    assert points.mean(axis=0) == pytest.approx(np.zeros(2), abs=1e-15)
    assert np.square(points).sum(axis=1).mean() == pytest.approx(0.5, abs=0.51 / count**2 if count % 2 else 1e-12)
    assert np.hypot(*points.T).max() < 1


def test_points_of_the_disc_keep_their_distance():
    for count in (16, 64, 256):
        points = even_disc(count)
        apart = np.linalg.norm(points[:, None] - points[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        # a hexagonal lattice of that density has 1.90 / sqrt(count)
        assert apart.min() > 1.6 / math.sqrt(count)


@pytest.mark.parametrize("count", [1, 7, 32])
@pytest.mark.parametrize("half_rad", [1e-6, 0.02, 1.0, math.pi])
def test_a_beams_parts_lie_in_its_cone_evenly_over_its_solid_angle(count, half_rad):
    looking = direction(np.array([0.3, 2.0]), np.array([-0.7, 1.1]))
    parts = split_beams(beams_along(looking), wide(count, 2 * half_rad))
    assert np.bincount(parts.ray).tolist() == [count, count]
    assert np.bincount(parts.ray, weights=parts.share) == pytest.approx([1, 1])
    assert np.linalg.norm(parts.direction, axis=1) == pytest.approx(np.ones(2 * count), abs=1e-14)
    aside = np.linalg.norm(np.cross(looking[parts.ray], parts.direction), axis=1)
    along = np.einsum("nk,nk->n", looking[parts.ray], parts.direction)
    angle = np.arctan2(aside, along)
    assert angle.max() < half_rad
    if count > 1:
        shares = np.sort(np.sin(angle[:count] / 2) ** 2 / math.sin(half_rad / 2) ** 2)
        pairs = np.sort(np.square(even_disc(count)).sum(axis=1))
        assert shares == pytest.approx(pairs, rel=1e-6, abs=1e-12)


def test_thin_beams_and_single_ones_stay_the_same_object():
    beams = beams_along([[1.0, 0.0, 0.0]])
    assert split_beams(beams, wide(16, 0.0)) is beams
    assert split_beams(beams, wide(1)) is beams


def test_the_pattern_turns_with_the_azimuth_and_depends_on_no_other_beam():
    looking = direction(np.array([0.1, 0.4, 2.0]), np.array([0.2, -1.0, math.pi / 2]))
    turn = Rotation.from_euler("z", 1.3)
    together = split_beams(beams_along(looking), wide()).direction.reshape(3, -1, 3)
    turned = split_beams(beams_along(turn.apply(looking[:2])), wide()).direction.reshape(2, -1, 3)
    for index in range(2):
        assert turn.apply(together[index]) == pytest.approx(turned[index], abs=1e-14)
    alone = split_beams(beams_along(looking[1:2]), wide()).direction
    assert np.array_equal(alone, together[1])
    assert np.isfinite(together).all()


def test_the_mean_range_on_a_tilted_plane_is_that_of_the_cone():
    # the plane x = 2 turned by `tilt` about the upright axis: range = 2 cos(tilt) / cos(angle to its normal)
    tilt = math.radians(50)
    turn = Rotation.from_euler("z", tilt).as_matrix() @ Rotation.from_euler("y", -math.pi / 2).as_matrix()
    scene = Scene((Body(Plane(), poses=rigid(turn, (2.0, 0.0, 0.0))),))
    echoes = echoes_of(scene, split_beams(beams_along([[1.0, 0.0, 0.0]]), wide(512)))
    # the second-order mean over the disc of 2 / (cos u - tan(tilt) sin u): <u^2> = half^2 / 4 per axis
    tangent = math.tan(tilt)
    expected = 2 * (1 + HALF_RAD**2 / 8 * (1 + 2 * tangent**2) + HALF_RAD**2 / 8)
    assert echoes.path_m.mean() == pytest.approx(expected, abs=3e-6)
    # and its spread: 2 tan(tilt) half / 2
    assert echoes.path_m.std() == pytest.approx(tangent * HALF_RAD, rel=5e-3)


@pytest.mark.parametrize("inside", [0.15, 0.5, 0.8])
def test_at_an_edge_both_depths_get_their_share_of_the_disc(inside):
    # a near plate covers all lateral angles above an edge that cuts the disc at offset h: a circle's segment
    h = math.cos(math.pi * inside)
    edge_m = math.tan(h * HALF_RAD) * 2.0
    plate = Body(Box((0.0005, 5.0, 5.0)), poses=rigid(translation_m=(2.0005, 5.0 + edge_m, 0.0)), reflectance=0.8)
    wall = Body(Box((0.0005, 20.0, 20.0)), poses=rigid(translation_m=(4.0005, 0.0, 0.0)), reflectance=0.2)
    scene = Scene((plate, wall))
    beams = split_beams(beams_along([[1.0, 0.0, 0.0]]), wide(1024))
    echoes = echoes_of(scene, beams)
    share = (math.acos(h) - h * math.sqrt(1 - h * h)) / math.pi
    near = echoes.body == 0
    assert beams.share[near].sum() == pytest.approx(share, abs=4e-3)
    # each depth's light follows its own 1 / R^2 and reflectance
    assert echoes.gain[near].sum() == pytest.approx(share * 0.8 / (math.pi * 4), rel=4e-3 / share)
    assert echoes.gain[~near].sum() == pytest.approx((1 - share) * 0.2 / (math.pi * 16), rel=4e-3 / (1 - share))
    assert echoes.path_m[near] == pytest.approx(np.full(near.sum(), 2.0), rel=HALF_RAD**2)
