"""A small report to look at: two designs, three positions, a body that moves over four frames, and any name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidardesign.constraints.check import ConstraintCheck
from lidardesign.constraints.slack import constraint_slack
from lidardesign.evaluation.results import Evaluation, Paired
from lidardesign.report.density_views import density_view
from lidardesign.report.page import Report
from lidardesign.report.scene_figure import scene_figure
from lidardesign.report.sections import CommandTimes, Reproduction
from lidardesign.samples import Samples
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, gate_outcomes
from lidardesign.scenes.scene import Body, Box, Capsule, Plane, Scene, Sphere, rigid
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import DesignSpace
from lidardesign.task import Metric
from support.evaluations import make_row
from support.sensors import normal_sensor

METRIC = Metric("Chamfer <distance>", "mm", "lower", worst=200.0, tolerance=0.1)
NASTY = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&"
PLACES = tuple({"y_m": value} for value in (-0.3, 0.0, 0.3))
FRAMES = 4
SPACE = DesignSpace((0, -0.5, 0, -0.6, -0.3, 0.5), (0, 0.5, 0, 0.6, 0.3, 4.0))


def make_evaluation(*names):
    rows = [make_row(name, rays, value) for name in names for rays, value in ((9, 10.0), (25, 5.0))]
    rows += [make_row("uniform", n, 20.0, baseline=True) for n in (9, 25)]
    paired = [Paired(names[0], "uniform", 9, -10.0, -12.0, -8.0), Paired(names[0], "uniform", 25, -15.0, -16.0, 1.0)]
    matched = [make_row("uniform", n, 30.0, True, names[0]) for n in (9, 25)]
    bandwidth = [Paired(names[0], "uniform", n, -20.0, -25.0, -15.0, n) for n in (9, 25)]
    return Evaluation(METRIC, 1, rows, paired, matched, bandwidth, [f"note {names[0]}"])


def make_sensor(name="s0", azimuth=0.0, elevation=0.0):
    return normal_sensor(name, 1.0, (0, 0, 0), azimuth, elevation, 0.0, (0.1, 0.05), 2.7, 0.2)


def make_rays(count=9, sensors=1, lift=0.0):
    spread = np.linspace(-0.5, 0.5, count)
    up = lift * np.cos(7 * spread)
    flat = np.sqrt(1 - up**2)
    directions = np.stack([flat * np.cos(spread), flat * np.sin(spread), up], axis=1)
    gates = np.tile([2.0, 4.0], (count, 1))
    return Rays(np.zeros((count, 3)), directions, gates, np.arange(count) % sensors, np.zeros(count))


def make_scene(name="ball"):
    post = Body(Box((0.02, 0.02, 0.5)), "post", "occluder", rigid(translation_m=(1.0, 0.1, 0.0)))
    floor = Body(Plane(), "floor", "both", rigid(translation_m=(0, 0, -1.0)))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses = np.stack([rigid(turn, (3.0, 0.9 - 0.6 * frame, 0.1)) for frame in range(FRAMES)])
    rod = Body(Capsule(0.1, 0.3), "rod", "target", poses)
    return Scene((Body(Sphere(0.4), name, "both", rigid(translation_m=(3, 0, 0))), post, floor, rod), name)


def ray_segments(scene, rays, frame=0):
    """Line segments by outcome, from the origin to the first hit or the gate's end, (3 K, 3) float32 [m]."""
    range_m = SceneCaster(scene, frame).first_hit(rays.origin_m, rays.direction).range_m
    outcome = gate_outcomes(range_m, rays.gate_m)
    length = np.minimum(range_m, rays.gate_m[:, 1])
    ends = rays.origin_m + length[:, None] * rays.direction
    lines = np.stack([rays.origin_m, ends, np.full_like(ends, np.nan)], axis=1)
    return {kind: lines[outcome == kind].reshape(-1, 3).astype(np.float32) for kind in Outcome}


def moved_to(rays, at):
    origin = rays.origin_m.copy()
    origin[:, 1] = at.get("y_m", 0.0)
    return replace(rays, origin_m=origin)


def make_shown(name="plain", designs=2, places=PLACES, rays=25, scene=None, **further):
    made = []
    for number in range(designs):
        sensors = (make_sensor(f"a {name}", 0.2), make_sensor(f"b {name}", -0.2, 0.1))
        made.append(DesignSpec(name if number == 0 else f"{name} {number}", sensors))
    fired = tuple(moved_to(make_rays(rays, 2, lift=0.05), at) for at in places)
    return scene_figure(scene or make_scene(name), made, places, designs * [fired], **further)


def make_samples(count=4000):
    generator = np.random.default_rng(3)
    points = SPACE.sample(count, generator)
    return Samples(points, np.zeros(count), -np.square(points[:, 3]) * 20, SPACE)


def make_report(name="plain", designs=2, **further):
    """A whole report; every name in it is built from `name`."""
    shown = make_shown(name, designs, **further)
    made = [one.design for one in shown.designs]
    samples = make_samples()
    checks = [ConstraintCheck(f"{sensor.name}.gate.width_m.max", 0.8, 0.79, True) for sensor in made[0].sensors]
    names = [sensor.name for sensor in made[0].sensors]
    return Report(
        make_evaluation(*(design.name for design in made)),
        shown,
        title=name,
        density=density_view(samples, shown.scene, made),
        density_m=samples.points[:300, :3] + np.array([2.0, 0, 0]),
        constraints={design.name: constraint_slack(checks, names) for design in made[:1]},
        times=[CommandTimes(f"learn {name}", "now", {"learning": 8.0, "learning/target": 5.0, "other": 2.0}, 2**20)],
        reproduce=Reproduction([("what", name)], [("seed", name)], f"config: {name}"),
    )
