"""Mirrors and glass: images behind mirrors, squares of shares both ways, panes, and their limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.rays import random_fan, rays_along

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Body, Box, Mesh, Receiver, Scene, Sphere, rigid
from lidardesign.simulate.detector.light import Beams, direct_echoes
from lidardesign.simulate.detector.physics import Detector
from lidardesign.simulate.effects import specular
from lidardesign.simulate.effects.footprint import split_beams
from lidardesign.simulate.effects.motion import still_tracer
from lidardesign.simulate.effects.specular import MAXIMUM_TURNS, detours
from lidardesign.space import direction

EVERYWHERE = {
    "azimuth_rad": 0.0, "elevation_rad": 0.0, "horizontal_rad": 3.1, "vertical_rad": 3.1, "range_m": (0.0, 9.0),
}  # fmt: skip
WALL = Body(Box((0.1, 9, 9)), poses=rigid(translation_m=(3.1, 0, 0)))


def beams_along(directions, origins=(0.0, 0.0, 0.0)):
    return Beams.of(rays_along(directions, origin=origins))


def traced(scene, beams):
    tracer = still_tracer(SceneCaster(scene))
    hits = tracer(beams.origin_m, beams.direction, beams.time_s)
    return direct_echoes(scene, beams, hits), detours(scene, beams, hits, tracer)


def slab(x_m, thickness_m=0.01, yaw_rad=0.0, **material):
    """A wide plate whose near face is at x = x_m, turned about the middle of that face."""
    turn = Rotation.from_euler("z", yaw_rad).as_matrix()
    centre = np.array([x_m, 0.0, 0.0]) + turn @ [thickness_m / 2, 0.0, 0.0]
    return Body(Box((thickness_m / 2, 3.0, 3.0)), poses=rigid(turn, centre), **material)


def meshed(body):
    made = trimesh.creation.box(extents=2 * np.array(body.shape.half_extents_m))
    mesh = Mesh(np.array(made.vertices), np.array(made.faces))
    return Body(mesh, poses=body.poses, reflectance=body.reflectance, specular=body.specular)


def fan(count=100, spread=0.2, seed=0):
    return random_fan(count, spread, seed)


@pytest.mark.parametrize("made", [lambda body: body, meshed], ids=["box", "mesh"])
def test_a_flat_mirror_shows_the_image_of_the_scene_at_its_whole_distance(made):
    mirror = made(slab(2.0, yaw_rad=math.radians(45), reflectance=0.0, specular=0.7))
    # the mirror x + ... turned by 45 degrees sends x to -y: the ball is seen as if it lay behind the mirror
    ball = Body(Sphere(0.8), poses=rigid(translation_m=(2.0, -3.0, 0.1)), reflectance=0.4)
    normal = mirror.poses[:3, :3] @ [-1.0, 0.0, 0.0]
    image = np.array([2.0, -3.0, 0.1]) - 2 * ((np.array([2.0, -3.0, 0.1]) - [2.0, 0, 0]) @ normal) * normal
    looking = fan(spread=0.1)
    direct, led = traced(Scene((mirror, ball)), beams_along(looking))
    behind, _ = traced(Scene((replace(ball, poses=rigid(translation_m=image)),)), beams_along(looking))
    assert len(behind) == len(led) == 100
    assert np.array_equal(led.ray, behind.ray)
    assert (led.body == 1).all()
    assert led.path_m == pytest.approx(behind.path_m, abs=1e-6)
    assert led.gain == pytest.approx(0.7**2 * behind.gain, rel=1e-5)
    assert (direct.gain == 0).all()


def test_a_pane_weakens_what_lies_behind_it_by_both_faces_both_ways():
    pane, looking = slab(1.0, transmission=0.9, reflectance=0.02), fan()
    direct, led = traced(Scene((pane, WALL)), beams_along(looking))
    clear, _ = traced(Scene((WALL,)), beams_along(looking))
    assert (direct.body == 0).all()
    behind, far_face = led.subset(led.body == 1), led.subset(led.body == 0)
    assert behind.path_m == pytest.approx(clear.path_m, abs=1e-12)
    assert behind.gain == pytest.approx(0.9**4 * clear.gain, rel=1e-12)
    assert far_face.path_m == pytest.approx(direct.path_m * 1.01, abs=1e-12)
    assert far_face.gain == pytest.approx(0.9**2 * direct.gain / 1.01**2, rel=1e-12)


def test_panes_add_up_until_beams_are_given_up():
    wall = Body(Box((0.1, 9, 9)), poses=rigid(translation_m=(9.1, 0, 0)))
    for panes in range(1, MAXIMUM_TURNS // 2 + 2):
        bodies = tuple(slab(1.0 + index, transmission=0.8, reflectance=0.0) for index in range(panes))
        _, led = traced(Scene((*bodies, wall)), beams_along([[1.0, 0, 0]]))
        behind = led.subset(led.body == panes)
        if panes <= MAXIMUM_TURNS // 2:
            assert behind.path_m == pytest.approx([9.0], abs=1e-12)
            assert behind.gain == pytest.approx([0.8 ** (4 * panes) * 0.5 / (math.pi * 81)], rel=1e-9)
        else:
            assert not len(behind)


def test_two_mirrors_face_to_face_make_a_row_of_images():
    mirrors = slab(2.0, reflectance=0.0, specular=0.5), slab(-1.0, yaw_rad=math.pi, reflectance=0.1, specular=0.5)
    looking = direction(np.array([0.0]), np.array([0.05]))
    direct, led = traced(Scene(mirrors), beams_along(looking))
    # the near mirror at x = -1 is met after 2 + 3, 2 + 3 + 6, ... metres; each turn takes half both ways
    slant = math.cos(0.05)
    met = led.subset(led.body == 1)
    turns = np.arange(1, 2 * len(met), 2)
    lengths = (2 + 3 * turns) / slant
    assert len(met) == MAXIMUM_TURNS // 2
    assert np.sort(met.path_m) == pytest.approx(lengths, abs=1e-9)
    order = np.argsort(met.path_m)
    assert met.gain[order] == pytest.approx(0.25**turns * 0.1 * slant / (math.pi * lengths**2), rel=1e-9)
    assert not direct.gain.any()


def test_faint_beams_are_given_up():
    mirror = slab(2.0, yaw_rad=math.radians(45), specular=0.0009, reflectance=0.1)
    ball = Body(Sphere(0.8), poses=rigid(translation_m=(2.0, -3.0, 0.1)))
    assert not len(traced(Scene((mirror, ball)), beams_along([[1.0, 0, 0]]))[1])


def test_light_is_never_made():
    # inside a white, half mirroring room all that comes back by detours is less than what a matt one sends directly
    room = Body(Sphere(3.0), reflectance=0.5, specular=0.3, transmission=0.2)
    matt = Body(Sphere(3.0), reflectance=1.0)
    looking = fan(200, spread=1.5)
    direct, led = traced(Scene((room,)), beams_along(looking, (1.0, 0.5, 0.0)))
    white, _ = traced(Scene((matt,)), beams_along(looking, (1.0, 0.5, 0.0)))
    assert direct.gain.sum() + led.gain.sum() < white.gain.sum()


def test_a_fixed_receiver_hears_what_a_mirror_lights_straight_from_there():
    mirror = slab(2.0, yaw_rad=math.radians(45), reflectance=0.0, specular=0.7)
    floor = Body(Box((3.0, 0.1, 3.0)), poses=rigid(translation_m=(2.0, -3.1, 0.0)), reflectance=0.4)
    receiver = Receiver((0.0, -1.0, 0.0), **{**EVERYWHERE, "azimuth_rad": -0.8})
    _, led = traced(Scene((mirror, floor), receiver=receiver), beams_along([[1.0, 0.0, 0.0]]))
    # out: 2 m to the mirror and 3 m to the floor at (2, -3); back from there to (0, -1), at 45 degrees
    back_m = math.sqrt(8)
    assert led.path_m == pytest.approx([(5 + back_m) / 2], abs=1e-9)
    assert led.gain == pytest.approx([0.7 * 0.4 * math.cos(math.pi / 4) / (math.pi * 8)], rel=1e-9)
    behind = replace(receiver, azimuth_rad=2.5)
    assert not len(traced(Scene((mirror, floor), receiver=behind), beams_along([[1.0, 0.0, 0.0]]))[1])


def test_a_fixed_receiver_hears_through_panes_on_both_ways():
    pane, receiver = slab(1.0, transmission=0.9, reflectance=0.0), Receiver((0.0, 0.5, 0.0), **EVERYWHERE)
    _, led = traced(Scene((pane, WALL), receiver=receiver), beams_along([[1.0, 0.0, 0.0]]))
    behind = led.subset(led.body == 1)
    back_m = math.hypot(3.0, 0.5)
    assert behind.path_m == pytest.approx([(3 + back_m) / 2], abs=1e-9)
    assert behind.gain == pytest.approx([0.9**4 * 0.5 * (3 / back_m) / (math.pi * back_m**2)], rel=1e-9)


@pytest.mark.parametrize("radius_m", [1.0, 30.0, 1000.0])
@pytest.mark.parametrize("height_m", [0.05, 1.0])
def test_beams_leave_large_meshes_for_good_however_near_they_start(radius_m, height_m):
    room = trimesh.creation.box(extents=[2 * radius_m] * 3)
    mesh = Mesh(np.array(room.vertices), np.array(room.faces), "unsigned")
    scene = Scene((Body(mesh, reflectance=0.1, specular=0.4, transmission=0.3),))
    generator = np.random.default_rng(0)
    looking = direction(generator.uniform(0, 2 * math.pi, 1000), generator.uniform(-1.5, -0.5, 1000))
    direct, led = traced(scene, beams_along(looking, (0.31 * radius_m, -0.27 * radius_m, height_m - radius_m)))
    # out of a floor at a height the next wall is far: nothing is met where the floor was
    again = led.path_m < direct.path_m[led.ray] + 1e-3 * radius_m
    beside_a_wall = np.abs(looking[led.ray, :2] * direct.path_m[led.ray, None]).max(axis=1) > 0.6 * radius_m
    assert len(led) > 900
    assert not (again & ~beside_a_wall).any()


@pytest.mark.parametrize("at_once", [1, 7, 50])
def test_beams_that_are_followed_in_groups_have_the_echoes_that_they_have_together(monkeypatch, at_once):
    window = slab(1.0, specular=0.3, transmission=0.6, reflectance=0.1)
    scene = Scene((window, slab(2.0, specular=0.4, reflectance=0.5)))
    generator = np.random.default_rng(2)
    rays = beams_along(direction(*generator.uniform(-0.5, 0.5, (2, 40))))
    beams = split_beams(rays, Detector("wide", divergence_rad=0.2, footprint_rays=3))
    _, together = traced(scene, beams)
    monkeypatch.setattr(specular, "BEAMS_AT_ONCE", at_once)
    _, apart = traced(scene, beams)
    assert len(apart) == len(together) > 100
    order = np.argsort(together.ray, kind="stable"), np.argsort(apart.ray, kind="stable")
    for name in ("ray", "path_m", "gain", "body"):
        assert np.array_equal(getattr(together, name)[order[0]], getattr(apart, name)[order[1]])
