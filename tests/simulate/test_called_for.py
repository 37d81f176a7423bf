"""Scenes of the tasks call for the effects that matter in them; without one of those, scores move too far."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.heads import ARM, EVERYTHING, FACE, FLATLAND, face_rays, heads, rays_of

from lidardesign.methods.fields import even_placement
from lidardesign.methods.laid_out import rays_at
from lidardesign.scenes.rays import fire_times
from lidardesign.scenes.scene import Body, Box, rigid
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import Detector, Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import simulate
from lidardesign.space import direction

SINGLE_PHOTON = load_detector("single-photon")


def plans(scenes, rays, detector):
    """The effects of each scene."""
    return [Planner(detector).plan(scene, [rays]).effects - {"multipath"} for scene in scenes]


def mean_score(task, scenes, rays, detector, effects):
    """Of all scenes, each with its own set of effects."""
    values = []
    for scene, on in zip(scenes, effects, strict=True):
        returns = simulate(scene, rays, physics=Physics(detector, on) if on else None)
        values.append(task.score(scene, returns).value)
    return float(np.mean(values))


def assert_called_for(effects, task, scenes, rays, detector):
    """Every plan has the effects and changes the score by no more than is tolerated, which no plan does without one."""
    planned = plans(scenes, rays, detector)
    everything = mean_score(task, scenes, rays, detector, [EVERYTHING] * len(scenes))
    assert all(effects <= on for on in planned)
    assert abs(mean_score(task, scenes, rays, detector, planned) - everything) <= task.metric.tolerance
    for effect in effects:
        without = mean_score(task, scenes, rays, detector, [on - {effect} for on in planned])
        assert abs(without - everything) > task.metric.tolerance


TURNED = rigid(Rotation.from_euler("z", -45, degrees=True).as_matrix(), (-0.10, 0.15, 0.0))
MIRROR = Body(Box((0.002, 0.1, 0.25)), "mirror", "occluder", TURNED, reflectance=0.05, specular=0.9)
FACES = {
    "indoors": (set(), (), {}),
    "in sunlight": ({"ambient", "pile_up"}, (), {"illuminance_lux": 100_000, "light": "sun"}),
    "in fog": ({"atmosphere"}, (), {"visibility_m": 2}),
    "beside a mirror": ({"specular"}, (MIRROR,), {}),
}


@pytest.mark.parametrize(("effects", "bodies", "surroundings"), FACES.values(), ids=FACES)
def test_a_face_calls_for_what_its_surroundings_do(effects, bodies, surroundings):
    scenes, rays = heads(*bodies, **surroundings), face_rays()
    assert_called_for(effects, FACE, scenes, rays, SINGLE_PHOTON)
    if not effects:
        beyond = {"motion", "specular", "shadowing", "atmosphere", "pile_up"}
        assert all(not on & beyond for on in plans(scenes, rays, SINGLE_PHOTON))


def test_an_arm_that_moves_fast_calls_for_motion():
    scenes = ARM.scenes(ARM.Config(size="small", test=1, frames=8, duration_s=2), "test", 0)
    generator, count = np.random.default_rng(0), 3000
    origins = generator.uniform((-0.2, -1.0, 1.0), (1.0, 1.0, 1.0), (count, 3))
    looking = direction(generator.uniform(0, 2 * math.pi, count), generator.uniform(-math.pi / 2, -1.05, count))
    timing, rays = Detector("timing", bin_s=2e-11), rays_of(origins, looking, (0.1, 2.0))
    assert_called_for({"motion"}, ARM, scenes, rays, timing)
    (at_once,) = plans(scenes, replace(rays, time_s=np.zeros(count)), timing)
    assert "motion" not in at_once


def test_a_wide_beam_at_a_depth_edge_calls_for_its_footprint():
    scenes = FLATLAND.scenes(FLATLAND.Config(scene="occluded", test=4), "test", 0)
    origins = np.linspace((0.05, 0.0, 0.0), (0.95, 0.0, 0.0), 64)
    rays = rays_of(origins, np.tile([0.0, 1.0, 0.0], (64, 1)), (0.0, 1.2))
    wide = Detector("wide", bin_s=2e-11, divergence_rad=0.1, footprint_rays=16)
    assert_called_for({"footprint"}, FLATLAND, scenes, rays, wide)
    assert all("footprint" not in on for on in plans(scenes, rays, replace(wide, divergence_rad=1e-8)))


def test_baselines_fire_over_the_same_frame_as_designs():
    config = FACE.Config()
    points = even_placement(np.array(FACE.space(config).low[:5]), np.array(FACE.space(config).high[:5]), 40)
    assert np.array_equal(rays_at(points, np.array([0.1, 1.0])).time_s, fire_times(40, Bandwidth().rate_hz))
