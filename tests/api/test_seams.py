"""Seams between the parts: moving meshes and turned worlds, all the way to the rows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support import references
from support.fits import design_of, fitted
from support.scoring import MissTask

from lidardesign.evaluation.request import EvaluationRequest
from lidardesign.evaluation.score import evaluate
from lidardesign.samples import Samples
from lidardesign.scenes.scene import Body, Capsule, Mesh, Scene, Sphere, rigid
from lidardesign.space import DesignSpace, aim
from lidardesign.task import Metric, Score, TaskConfig

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
CEILING = DesignSpace((-0.6, -0.5, 1.0, 0.0, -math.pi / 2, 0.2), (0.6, 0.7, 1.0, 2 * math.pi, -0.9, 1.3))
RADIUS_M = 0.12
FRAMES = 6


class RangeTask(MissTask):
    """Millimetres of range that come back from the target, a figure that every single return changes."""

    metric = Metric("range", "mm", "higher", worst=0.0, tolerance=1.0)

    def score(self, scene, returns):
        ranges = np.concatenate([one.range_m[one.returned & (one.body == 0)] for one in returns])
        return Score(1000 * float(ranges.sum()), failed=not len(ranges), details={"hits": float(len(ranges))})


def carried(shape, count=3, seed=6):
    """A target that moves below the ceiling, with a capsule that moves with it above."""
    generator = np.random.default_rng(seed)
    scenes = []
    for index in range(count):
        start, end = np.array([0.1, 0.0, 0.3]) + generator.uniform(-0.2, 0.2, (2, 3))
        path = start + np.linspace(0, 1, FRAMES)[:, None] * (end - start)
        target = Body(shape, "target", "target", np.stack([rigid(translation_m=place) for place in path]))
        above = np.stack([rigid(translation_m=place + np.array([0.1, 0.0, 0.3])) for place in path])
        scenes.append(Scene((target, Body(Capsule(0.04, 0.1), "link", "occluder", above)), f"path {index}"))
    return scenes


def from_the_ceiling(count=6000, seed=0):
    """Samples of rays from the ceiling at where the target may be."""
    generator = np.random.default_rng(seed)
    scene = np.array([0.1, 0.0, 0.3]) + generator.uniform(-0.3, 0.3, (count, 3))
    origin = np.column_stack([generator.uniform(-0.6, 0.6, count), generator.uniform(-0.5, 0.7, count), np.ones(count)])
    points = aim(origin, scene)
    points = points[CEILING.contains(points)]
    return Samples(points, np.zeros(len(points)), generator.normal(0, 0.3, len(points)), CEILING)


def request(designs, scenes, space=CEILING, rays=(40,), **changes):
    values = {"task": RangeTask(), "config": TaskConfig(), "seed": 0, "baselines": (), "test": scenes}
    return EvaluationRequest(**{**values, "designs": designs, "space": space, "rays": rays, **changes})


def icosphere(subdivisions=3):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS_M)
    return Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def fitted_design(samples):
    """Three sensors below the ceiling, with even rays."""
    return design_of(fitted(samples, sensors=3, retarget=lambda points: np.zeros(len(points))))


def test_a_moving_mesh_scores_as_the_ball_that_it_is_almost():
    design, rows = fitted_design(from_the_ceiling()), []
    for shape in (Sphere(RADIUS_M), icosphere()):
        asked = request(
            [design], carried(shape), rays=(60,), baselines=("uniform", "bounding", "occupancy"),
            train=carried(shape, 4, 1),
        )  # fmt: skip
        rows.append({row.design: row for row in evaluate(asked).rows})
    for name, ball in rows[0].items():
        mesh = rows[1][name]
        assert mesh.details["hits"] == pytest.approx(ball.details["hits"], rel=0.05, abs=3)
        assert mesh.bandwidth_mbps == pytest.approx(ball.bandwidth_mbps, rel=0.05)
    assert rows[1][design.name].value > 1.5 * rows[1]["uniform"].value


def turned_scene(scene):
    return replace(scene, bodies=tuple(replace(body, poses=rigid(QUARTER) @ body.poses) for body in scene.bodies))


def test_rows_of_a_fitted_design_stay_when_the_world_turns_by_a_quarter():
    straight, scenes, rows = from_the_ceiling(), carried(Sphere(RADIUS_M)), []
    turned = references.quarter_turned(straight), [turned_scene(scene) for scene in scenes]
    for samples, test in ((straight, scenes), turned):
        rows.append(evaluate(request([fitted_design(samples)], test, samples.space, rays=(40, 64))).rows)
    for before, after in zip(*rows, strict=True):
        assert before.details["hits"] > 2
        assert after.details == before.details
        assert after.bandwidth_mbps == pytest.approx(before.bandwidth_mbps, rel=1e-12)
        np.testing.assert_allclose(after.per_scene, before.per_scene, rtol=1e-9)
