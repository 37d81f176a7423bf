"""Rays meet moving bodies where they are at their own time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from support.meshes import icosphere

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Plane, Scene, Sphere, rigid
from lidardesign.simulate.effects.motion import Screw, moving_tracer, path_of
from lidardesign.space import direction

RATE_HZ = 10.0


def random_pose(generator, reach_m=1.0):
    return rigid(Rotation.random(random_state=generator).as_matrix(), generator.uniform(-reach_m, reach_m, 3))


def fan(count=300, seed=0, spread=0.5):
    generator = np.random.default_rng(seed)
    looking = direction(generator.uniform(-spread, spread, count), generator.uniform(-spread, spread, count))
    return np.zeros((count, 3)), looking, generator.uniform(0, 1 / RATE_HZ, count)


SHAPES = {
    "sphere": Sphere(0.5),
    "box": Box((0.3, 0.5, 0.2)),
    "capsule": Capsule(0.2, 0.4),
    "cylinder": Cylinder(0.2, 0.4),
    "ellipsoid": Ellipsoid((0.3, 0.5, 0.2)),
    "plane": Plane(),
    "mesh": icosphere(subdivisions=3),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_every_ray_sees_what_a_scene_at_rest_at_its_time_shows(shape):
    generator = np.random.default_rng(3)
    ahead = rigid(translation_m=(2.5, 0.0, 0.0))
    poses = np.stack([ahead @ random_pose(generator, 0.3) for _ in range(3)])
    scene = Scene((Body(shape, poses=poses), Body(Box((0.1, 3, 3)), poses=rigid(translation_m=(5, 0, 0)))))
    origins, looking, time_s = fan(40)
    for frame in range(3):
        tracer = moving_tracer(scene, frame)
        hits = tracer(origins, looking, time_s)
        path = path_of(scene.bodies[0], frame, scene.frame_rate_hz)
        for ray in range(len(looking)):
            rotation, translation = path.at(time_s[ray : ray + 1])
            now = Scene((Body(shape, poses=rigid(rotation[0], translation[0])), scene.bodies[1]))
            alone = SceneCaster(now).first_hit(origins[ray : ray + 1], looking[ray : ray + 1])
            assert hits.body[ray] == alone.body[0]
            assert hits.range_m[ray] == pytest.approx(alone.range_m[0], abs=2e-6)
            assert hits.normal[ray] == pytest.approx(alone.normal[0], abs=1e-5)


def test_the_screw_is_the_exponential_of_its_twist_and_joins_its_poses():
    generator = np.random.default_rng(5)
    for _ in range(20):
        first, second = random_pose(generator, 2.0), random_pose(generator, 2.0)
        screw = Screw.between(first, second, RATE_HZ)
        x, y, z = screw.turn_rad_s
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], screw.drift_m_s
        times = np.array([0.0, 0.03, 1 / RATE_HZ, 0.17])
        rotation, translation = screw.at(times)
        for index, time_s in enumerate(times):
            assert rigid(rotation[index], translation[index]) == pytest.approx(expm(time_s * twist) @ first, abs=1e-12)
        assert rigid(rotation[2], translation[2]) == pytest.approx(second, abs=1e-12)
        point, step_s = generator.normal(size=3), 1e-6
        near = [
            rotation @ point + place for rotation, place in zip(*screw.at(np.array([0.05, 0.05 + step_s])), strict=True)
        ]
        assert screw.speed_m_s(point) == pytest.approx(np.linalg.norm(near[1] - near[0]) / step_s, rel=1e-4)


def test_tiny_turns_lose_no_digits():
    pose = rigid(translation_m=(1.0, 2.0, 3.0))
    for angle in (1e-12, 1e-9, 1e-6):
        later = rigid(Rotation.from_rotvec([0, 0, angle]).as_matrix(), (1.0 + 1e-9, 2.0, 3.0))
        rotation, translation = Screw.between(pose, later, RATE_HZ).at(np.array([0.05]))
        assert rotation[0] == pytest.approx(Rotation.from_rotvec([0, 0, angle / 2]).as_matrix(), abs=3e-16)
        assert translation[0] == pytest.approx([1.0 + 5e-10, 2.0, 3.0], abs=2e-15)


def test_after_its_last_pose_a_body_goes_on_as_it_came():
    poses = np.stack([rigid(translation_m=(x, 0.0, 0.0)) for x in (2.0, 3.0, 3.5)])
    paths = [path_of(Body(Sphere(0.1), poses=poses), frame, RATE_HZ) for frame in range(3)]
    for path, halfway in zip(paths, (2.5, 3.25, 3.75), strict=True):
        assert path.at(np.array([0.05]))[1][0] == pytest.approx([halfway, 0, 0], abs=1e-13)


def test_rays_sent_after_a_frame_meet_a_body_on_its_further_way():
    generator = np.random.default_rng(21)
    poses = np.stack([rigid(translation_m=(2.5, 0, 0)) @ random_pose(generator, 0.3) for _ in range(4)])
    scene = Scene((Body(SHAPES["box"], poses=poses), Body(Box((0.1, 3, 3)), poses=rigid(translation_m=(5, 0, 0)))))
    origins, looking, time_s = fan(200)
    now, earlier = moving_tracer(scene, 2), moving_tracer(scene, 0)
    # what is sent 0.2 s into frame 0 meets what frame 2 shows, and beyond the last pose too
    for shift in (0.0, 0.1, 0.25):
        here = now(origins, looking, time_s + shift)
        there = earlier(origins, looking, time_s + shift + 2 / RATE_HZ)
        assert np.array_equal(here.body, there.body)
        assert there.range_m == pytest.approx(here.range_m, abs=1e-9)
    assert len(earlier(origins[:0], looking[:0], time_s[:0]).range_m) == 0


def test_nothing_is_missed_however_fast_it_flies():
    # by the end of the frame the ball is 30 m further: the ball that holds its way still lets every ray through
    scene = Scene((Body(Sphere(0.2), poses=rigid(translation_m=(3, -15, 0)), velocity_m_s=(0.0, 300.0, 0.0)),))
    time_s = np.linspace(0, 0.1, 101)
    towards = np.stack([np.full(101, 3.0), -15 + 300 * time_s, np.zeros(101)], axis=1)
    length = np.linalg.norm(towards, axis=1)
    hits = moving_tracer(scene, 0)(np.zeros((101, 3)), towards / length[:, None], time_s)
    assert hits.range_m == pytest.approx(length - 0.2, abs=1e-6)
    assert math.isinf(moving_tracer(scene, 0)(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.zeros(1)).range_m[0])
