"""Seams between the parts: designs through their files, moving meshes and turned worlds, all the way to the rows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support import references
from support.command_line import caller
from support.fits import design_of, fitted

from lidardesign.config import resolve, save_run_config
from lidardesign.formats.designs import load_design
from lidardesign.registry import load_task
from lidardesign.run.manifest import start_manifest
from lidardesign.samples import Samples, save_samples
from lidardesign.scenes.scene import Body, Capsule, Mesh, Scene, Sphere, rigid
from lidardesign.scoring.evaluation.request import EvaluationRequest
from lidardesign.scoring.evaluation.score import evaluate
from lidardesign.space import DesignSpace, aim
from lidardesign.task import Defaults, Metric, Score, TaskConfig

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
CEILING = DesignSpace((-0.6, -0.5, 1.0, 0.0, -math.pi / 2, 0.2), (0.6, 0.7, 1.0, 2 * math.pi, -0.9, 1.3))
RADIUS_M = 0.12
FRAMES = 6


class HitTask:
    """Millimetres of range that come back from the target, a figure that every single return changes."""

    name = "hits"
    summary = "ranges of returns on the target"
    api_version = 1
    Config = TaskConfig
    metric = Metric("range", "mm", "higher", worst=0.0, tolerance=1.0)
    defaults = Defaults()

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
    values = {"task": HitTask(), "config": TaskConfig(), "seed": 0, "baselines": (), "test": scenes}
    return EvaluationRequest(**{**values, "designs": designs, "space": space, "rays": rays, **changes})


def figures(evaluation):
    """What a row says, without how long it took."""
    rows = [*evaluation.rows, *evaluation.equal_bandwidth]
    return [(row.design, row.rays, row.bandwidth_mbps, row.failures, row.per_scene.tolist()) for row in rows]


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


@pytest.fixture
def lidardesign(capsys, tmp_path, monkeypatch):
    """Run the program in this process; the target density is the planted one."""
    monkeypatch.setattr("lidardesign.fitting.request.RunTarget.__call__", lambda self, points: log_shelf(points))
    return caller(capsys, tmp_path, monkeypatch)


def log_shelf(points):
    """A shelf's front about 1 m away, between 0.1 and 1.9 m above the sensor."""
    front, height = points[:, 5] * np.cos(points[:, 4]), points[:, 5] * np.sin(points[:, 4])
    return -0.5 * (np.square((front - 1.0) / 0.05) + np.square((height - 1.0) / 0.5))


@pytest.fixture
def aisle(tmp_path):
    """A run of the warehouse, as `learn` leaves it."""
    config = resolve(load_task("warehouse"), preset="draft", seed=3, overrides=["task.size=small"])
    folder = tmp_path / "aisle"
    points = config.space.sample(40_000, np.random.default_rng(0))
    start_manifest(folder, command=["lidardesign", "learn"], seed=3)
    save_run_config(config, folder)
    log_prob = np.full(len(points), -config.space.log_volume)
    save_samples(Samples(points, log_prob, log_shelf(points), config.space), folder)
    return folder


def test_rays_along_a_condition_score_the_same_where_their_run_is_gone(lidardesign, aisle, tmp_path):
    assert lidardesign("fit", aisle, "--sensors", 2, "--rays", 6).code == 0
    inside, away = aisle / "designs" / "fit.yaml", tmp_path / "away.yaml"
    away.write_text(inside.read_text().replace("name: fit", "name: away"))
    result = lidardesign("evaluate", inside, away, "--rays", 6, "--json")
    assert result.code == 0, result.err
    rows = {row["design"]: row for row in result.json["rows"]}
    for key in ("value", "bandwidth_mbps", "failures"):
        assert rows["away"][key] == rows["fit"][key]
    assert rows["fit"]["value"] < rows["uniform"]["value"]


@pytest.mark.parametrize("layout", ["even", "chosen"])
def test_a_design_for_one_position_drives_along_the_aisle_as_it_is(lidardesign, aisle, layout):
    made = ("--at", "x_m=0.37", "--layout", layout, "--rays", 6, "--sensors", 2, "--name", "here")
    assert lidardesign("fit", aisle, *made).code == 0
    result = lidardesign("evaluate", aisle, "--rays", 6, "--json")
    assert result.code == 0, result.err
    rows = {row["design"]: row for row in result.json["rows"]}
    assert rows["here"]["bandwidth_mbps"] < rows["uniform"]["bandwidth_mbps"]
    design = load_design(aisle / "designs" / "here.yaml")
    here, there = (design.rays(at={"x_m": x}) for x in (0.37, 3.0))
    np.testing.assert_array_equal(here.direction, there.direction)
    np.testing.assert_array_equal(here.gate_m, there.gate_m)
