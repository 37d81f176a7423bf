"""Scenes call for the effects that matter in them, for the right reason; skipping one of those fails the audit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from support.heads import ARM, EVERYTHING, FACE, FLATLAND, face_rays, heads, rays_of

from lidardesign.scenes.rays import fire_times
from lidardesign.scenes.scene import Body, Box, rigid
from lidardesign.scoring.baselines.candidates import rays_at
from lidardesign.scoring.baselines.even import even_placement
from lidardesign.scoring.evaluation.results import Audit, AuditRow
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import Detector, Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import simulate
from lidardesign.space import direction

SINGLE_PHOTON = load_detector("single-photon")


def plans(scenes, rays, detector):
    return [{one.name: one for one in Planner(detector).plan(scene, [rays]).decisions} for scene in scenes]


def switched_on(decisions):
    return frozenset(name for name, decision in decisions.items() if decision.on) - {"multipath"}


def mean_score(task, scenes, rays, detector, effects):
    """Of all scenes, each with its own set of effects."""
    values = []
    for scene, on in zip(scenes, effects, strict=True):
        returns = simulate(scene, rays, physics=Physics(detector, on) if on else None)
        values.append(task.score(scene, returns).value)
    return float(np.mean(values))


def fail(task, scenes, rays, detector, *choices):
    """Whether audits of choices of effects, a set for each scene, fail against everything."""
    everything = mean_score(task, scenes, rays, detector, [EVERYTHING] * len(scenes))
    moved = [mean_score(task, scenes, rays, detector, effects) - everything for effects in choices]
    rows = [AuditRow(None, None, by, by, by) for by in moved]
    failed = Audit(task.metric.tolerance, task.metric.unit, rows, [], []).failed
    return [row in failed for row in rows]


def assert_called_for(effect, reason, task, scenes, rays, detector):
    """The plan of every scene has the effect for that reason and passes the audit; without it, the audit fails."""
    found = plans(scenes, rays, detector)
    for decisions in found:
        assert decisions[effect].on
        assert reason in decisions[effect].bound.reason
    planned = [switched_on(decisions) for decisions in found]
    assert fail(task, scenes, rays, detector, planned, [on - {effect} for on in planned]) == [False, True]


def test_a_face_indoors_calls_for_the_detectors_own_limits_and_nothing_else():
    scenes, rays = heads(), face_rays()
    found = plans(scenes, rays, SINGLE_PHOTON)
    for decisions in found:
        assert {"photon_noise", "jitter", "quantisation"} <= switched_on(decisions)
        for name in ("motion", "specular", "multipath", "shadowing", "atmosphere", "pile_up"):
            assert not decisions[name].on
    assert fail(FACE, scenes, rays, SINGLE_PHOTON, [switched_on(decisions) for decisions in found]) == [False]


def test_sunlight_calls_for_ambient_light_and_pile_up():
    scenes, rays = heads(illuminance_lux=100_000, light="sun"), face_rays()
    assert_called_for("ambient", "100,000 lux (sun)", FACE, scenes, rays, SINGLE_PHOTON)
    assert_called_for("pile_up", "ns blind after each", FACE, scenes, rays, SINGLE_PHOTON)


def test_fog_calls_for_the_atmosphere():
    assert_called_for("atmosphere", "air that dims light by", FACE, heads(visibility_m=2), face_rays(), SINGLE_PHOTON)


def test_a_mirror_calls_for_specular_surfaces():
    turned = rigid(Rotation.from_euler("z", -45, degrees=True).as_matrix(), (-0.10, 0.15, 0.0))
    mirror = Body(Box((0.002, 0.1, 0.25)), "mirror", "occluder", turned, reflectance=0.05, specular=0.9)
    assert_called_for("specular", "meet mirrors or glass: mirror", FACE, heads(mirror), face_rays(), SINGLE_PHOTON)


def test_an_arm_that_moves_fast_calls_for_motion():
    scenes = ARM.scenes(ARM.Config(size="small", test=1, frames=8, duration_s=2), "test", 0)
    generator = np.random.default_rng(0)
    count = 3000
    origins = np.stack(
        [generator.uniform(-0.2, 1.0, count), generator.uniform(-1.0, 1.0, count), np.ones(count)], axis=1
    )
    looking = direction(generator.uniform(0, 2 * math.pi, count), generator.uniform(-math.pi / 2, -1.05, count))
    timing = Detector("timing", bin_s=2e-11)
    rays = rays_of(origins, looking, (0.1, 2.0))
    assert_called_for("motion", "surfaces move by up to", ARM, scenes, rays, timing)
    at_once = replace(rays, time_s=np.zeros(count))
    (decisions,) = plans(scenes, at_once, timing)
    assert not decisions["motion"].on


def test_a_wide_beam_at_a_depth_edge_calls_for_its_footprint():
    scenes = FLATLAND.scenes(FLATLAND.Config(scene="occluded", test=4), "test", 0)
    place = np.linspace(0.05, 0.95, 64)
    origins = np.stack([place, 0 * place, 0 * place], axis=1)
    rays = rays_of(origins, np.tile([0.0, 1.0, 0.0], (64, 1)), (0.0, 1.2))
    wide = Detector("wide", bin_s=2e-11, divergence_rad=0.1, footprint_rays=16)
    assert_called_for("footprint", "beams of 100 mrad", FLATLAND, scenes, rays, wide)
    for decisions in plans(scenes, rays, replace(wide, divergence_rad=1e-8)):
        assert not decisions["footprint"].on


def test_baselines_fire_over_the_same_frame_as_designs():
    config = FACE.Config()
    points = even_placement(np.array(FACE.space(config).low[:5]), np.array(FACE.space(config).high[:5]), 40)
    assert np.array_equal(rays_at(points, np.array([0.1, 1.0])).time_s, fire_times(40, Bandwidth().rate_hz))
