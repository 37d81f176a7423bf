"""A task of a few lines that is scored: the share of rays without a return."""

from __future__ import annotations

import numpy as np

from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.scene import Body, Scene, Sphere, rigid
from lidardesign.space import DesignSpace
from lidardesign.task import Defaults, Metric, Score, TaskConfig

SPACE = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))

RAYS = (9, 25)


class MissTask:
    """Percent of rays without a return; fewer than three returns are a failure."""

    name = "miss"
    summary = "rays without a return"
    api_version = 1
    Config = TaskConfig
    metric = Metric("misses", "%", "lower", worst=150.0, tolerance=1.0)
    defaults = Defaults()

    def space(self, config):
        return SPACE

    def scenes(self, config, split, seed):
        return scenes(seed)

    def score(self, scene, returns):
        hit = sum(int(frame.returned.sum()) for frame in returns)
        if hit < 3:
            return Score(self.metric.worst, failed=True)
        return Score(100.0 * (1 - hit / sum(len(frame.outcome) for frame in returns)))


def scenes(seed, count=6, side=0.0):
    generator = np.random.default_rng(seed)
    return [
        Scene(
            (
                Body(
                    Sphere(0.4),
                    "ball",
                    "both",
                    rigid(translation_m=np.array([3, side, 0]) + generator.normal(0, 0.05, 3)),
                ),
            ),
            f"ball {index}",
        )
        for index in range(count)
    ]


def design(name="aimed", azimuth=0.0, spread=0.03, range_m=2.65, weight=1.0):
    sensor = Sensor(
        "s0", weight, np.zeros(3), np.zeros((3, 3)), azimuth, 0.0, 0.0, spread, spread, range_m, 0.05
    )
    return DesignSpec(name, (sensor,))


def make_request(designs=None, **changes):
    task = changes.pop("task", MissTask())
    values = {
        "task": task,
        "config": TaskConfig(),
        "space": SPACE,
        "seed": 3,
        "designs": [design()] if designs is None else designs,
        "rays": RAYS,
        "train": scenes(1),
        "test": scenes(2),
    }
    return EvaluationRequest(**{**values, **changes})


def rows_by_key(evaluation):
    return {(row.design, row.rays): row for row in evaluation.rows}
