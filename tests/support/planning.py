"""Scenes, rays and detectors that plans are made for."""

from __future__ import annotations

import numpy as np

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Body, Box, Capsule, Scene, Sphere, rigid
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import EFFECTS, Detector
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import FirstHits
from lidardesign.simulate.returns import simulate
from lidardesign.space import direction

SINGLE, CONSUMER = load_detector("single-photon"), load_detector("consumer-8x8")

TIMED = Detector("timed", jitter_sigma_s=1e-11)


def random_shapes(generator):
    """One of each kind, and a pose somewhere before the sensors."""
    shapes = (
        Sphere(generator.uniform(0.05, 0.4)),
        Box(tuple(generator.uniform(0.05, 0.4, 3))),
        Capsule(generator.uniform(0.03, 0.1), generator.uniform(0.1, 0.3)),
    )
    turned = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    turned *= np.sign(np.linalg.det(turned))
    return shapes, rigid(turned, (generator.uniform(0.6, 2.5), *generator.uniform(-0.5, 0.5, 2)))


def grid(side=12, half_rad=0.3, gate_m=(0.1, 4.0), rate_hz=10.0):
    turn = np.linspace(-half_rad, half_rad, side)
    azimuth, elevation = (angle.ravel() for angle in np.meshgrid(turn, turn))
    count = len(azimuth)
    time_s = np.arange(count) / (count * rate_hz)
    looking = direction(azimuth, elevation)
    return Rays(np.zeros((count, 3)), looking, np.tile(gate_m, (count, 1)), np.zeros(count), time_s)


def room(ball=None, wall=None, **scene):
    bodies = (
        Body(Sphere(0.1), "ball", poses=rigid(translation_m=(0.5, 0, 0)), **(ball or {})),
        Body(Box((0.05, 2, 2)), "wall", poses=rigid(translation_m=(2, 0, 0)), **(wall or {})),
    )
    return Scene(bodies, "room", **scene)


def decisions(plan):
    return {decision.name: decision for decision in plan.decisions}


# one receiver for all rays and light by way of other surfaces have their own tests
SIMULATED = frozenset(EFFECTS) - {"multipath", "shadowing"}


def errors(scene, rays, physics, far_m):
    """Mean square error of ranges of returns, their number, and the share of wrong returns."""
    truth, found = simulate(scene, rays)[0], simulate(scene, rays, physics=physics)[0]
    both = truth.returned & found.returned
    off_m = (found.range_m - truth.range_m)[both]
    near = np.abs(off_m) <= far_m
    wrong = int((truth.returned != found.returned).sum() + (~near).sum())
    square = float(np.mean(off_m[near] ** 2)) if near.any() else 0.0
    return square, int(near.sum()), wrong / max(int(truth.returned.sum()), 1)


def sight(scene, detector, rays=None, frame=0):
    return FirstHits.of(scene, frame, detector, [grid() if rays is None else rays], SceneCaster(scene, frame))


def counts(scene, detector, rays=None):
    return Counts(sight(scene, detector, rays))


def facing_wall(**body):
    """A wall far wider than the view, 2 m ahead, met head-on by a narrow beam."""
    return Scene((Body(Box((0.05, 50, 50)), "wall", poses=rigid(translation_m=(2.05, 0, 0)), **body),))
