"""A receiver elsewhere hears what it can see, no more and no less."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support.rays import random_fan, rays_along

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Body, Box, Mesh, Plane, Receiver, Scene, Sphere, rigid
from lidardesign.simulate.detector.light import Beams, direct_echoes
from lidardesign.simulate.effects.motion import still_tracer
from lidardesign.simulate.effects.shadowing import visible_echoes
from lidardesign.space import direction

BESIDE = Receiver((0.0, 1.0, 0.0), 0.0, 0.0, 3.0, 3.0, (0.0, 1e6))


def fan(count=400):
    return random_fan(count, 0.5)


def both(scene, directions, origin=(0.0, 0.0, 0.0)):
    """Direct echoes, and those of them that are heard."""
    beams, tracer = Beams.of(rays_along(directions, origin=origin)), still_tracer(SceneCaster(scene))
    hits = tracer(beams.origin_m, beams.direction, beams.time_s)
    direct = direct_echoes(scene, beams, hits)
    return direct, visible_echoes(scene, beams, hits, direct, tracer)


def wall(x_m=4.0, **material):
    return Body(Box((0.1, 20, 20)), poses=rigid(translation_m=(x_m + 0.1, 0, 0)), **material)


def test_the_shadow_of_a_ball_on_a_wall_is_its_cone():
    ball = Body(Sphere(0.3), poses=rigid(translation_m=(2.0, 0.5, 0.0)))
    direct, kept = both(Scene((wall(), ball), receiver=BESIDE), fan(4000))
    lit = direct.subset(direct.body == 0)
    points = fan(4000)[lit.ray]
    points = points * (4.0 / points[:, :1])
    towards, centre = points - BESIDE.origin_m, np.array([2.0, 0.5, 0.0]) - BESIDE.origin_m
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    aside = np.linalg.norm(np.cross(towards, centre), axis=1)
    assert 0.02 < (aside < 0.3).mean() < 0.5
    assert np.array_equal(lit.ray[aside > 0.3], kept.ray[kept.body == 0])


@pytest.mark.parametrize(
    "change",
    [{"horizontal_rad": 0.4}, {"vertical_rad": 0.4}, {"range_m": (0.0, 4.1)}, {"range_m": (4.2, 9.0)}],
)
def test_what_lies_outside_the_view_or_the_ranges_is_not_heard(change):
    receiver = replace(BESIDE, **change)
    direct, kept = both(Scene((wall(),), receiver=receiver), fan())
    points = fan() * (4.0 / fan()[:, :1]) - receiver.origin_m
    distance = np.linalg.norm(points, axis=1)
    seen = np.abs(np.arctan2(points[:, 1], points[:, 0])) <= receiver.horizontal_rad / 2
    seen &= np.abs(np.arctan2(points[:, 2], points[:, 0])) <= receiver.vertical_rad / 2
    seen &= (distance >= receiver.range_m[0]) & (distance <= receiver.range_m[1])
    assert 0.02 < seen.mean() < 0.98
    assert np.array_equal(kept.ray, direct.ray[seen])


def test_the_far_side_of_a_thin_plate_is_not_heard():
    plate = Body(Box((0.001, 2.0, 2.0)), poses=rigid(translation_m=(2.0, 0.0, 0.0)))
    direct, kept = both(Scene((plate,), receiver=replace(BESIDE, origin_m=(4.0, 0, 0), azimuth_rad=math.pi)), fan())
    assert len(direct) == 400
    assert not len(kept)


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("shift", [0.0, 1000.0])
def test_bodies_that_touch_do_not_hide_each_other_where_they_touch(scale, shift):
    # a floor, and on it a box and a meshed cube, all touching: each sees the receiver from all of its open faces
    made = trimesh.creation.box(extents=[1.0, 1.0, 1.0])
    mesh = Mesh(np.array(made.vertices) * scale, np.array(made.faces))
    floor_m = -1.0 * scale
    moved = np.array([0.0, shift, 0.0])

    def at(x, y, z):
        return rigid(translation_m=np.array([x, y, z]) * scale + moved)

    bodies = (
        Body(Plane(), poses=rigid(translation_m=(0, 0, floor_m))),
        Body(Box((0.5 * scale, 0.5 * scale, 0.5 * scale)), poses=at(3.0, 0.5, -0.5)),
        Body(mesh, poses=at(3.0, -0.5, -0.5)),
    )
    receiver = replace(BESIDE, origin_m=tuple(np.array([0.0, 0.1, 0.05]) * scale + moved))
    towards = np.stack(np.meshgrid([2.5], np.linspace(-1.2, 1.2, 80), np.linspace(-0.9999, 0.2, 41)), axis=-1)
    towards = towards.reshape(-1, 3) / np.linalg.norm(towards.reshape(-1, 3), axis=1, keepdims=True)
    direct, kept = both(Scene(bodies, receiver=receiver), towards, tuple(moved))
    assert set(direct.body) == {0, 1, 2}
    front = np.isin(direct.body, [1, 2])
    assert np.array_equal(kept.ray[np.isin(kept.body, [1, 2])], direct.ray[front])


def test_glass_between_weakens_by_its_transmission():
    pane = Body(Box((0.005, 0.4, 0.4)), poses=rigid(translation_m=(2.0, 1.0, 0.0)), transmission=0.9, reflectance=0.0)
    direct, kept = both(Scene((wall(), pane), receiver=BESIDE), np.array([[1.0, 0.0, 0.0], [0.98, -0.199, 0.0]]) / 1.0)
    assert direct.body.tolist() == [0, 0]
    assert kept.gain / direct.gain == pytest.approx([1.0, 1.0])
    _, kept = both(Scene((wall(), pane), receiver=BESIDE), direction(np.array([0.15]), np.array([0.0])))
    bare, _ = both(Scene((wall(),), receiver=BESIDE), direction(np.array([0.15]), np.array([0.0])))
    assert kept.gain == pytest.approx(0.9**2 * bare.gain, rel=1e-9)


@pytest.mark.parametrize("radius_m", [1.0, 30.0, 1000.0])
def test_a_receiver_just_above_a_large_mesh_sees_all_that_is_lit_there(radius_m):
    room = trimesh.creation.box(extents=[2 * radius_m] * 3)
    mesh = Mesh(np.array(room.vertices), np.array(room.faces), "unsigned")
    generator = np.random.default_rng(0)
    looking = direction(generator.uniform(0, 2 * math.pi, 1000), generator.uniform(-1.5, -0.3, 1000))
    place = np.array([0.31, -0.27, 0.05 / radius_m - 1]) * radius_m
    for aside_m in (0.0, 0.01):
        receiver = replace(BESIDE, origin_m=tuple(place + np.array([aside_m, 0, 0])), elevation_rad=-math.pi / 2)
        direct, kept = both(Scene((Body(mesh),), receiver=receiver), looking, tuple(place))
        # a view of 3 rad leaves out what is flatter than 4 degrees, and no ray is
        assert len(direct) == len(kept) == 1000
