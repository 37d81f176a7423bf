"""A task of a few lines that is scored: the share of rays without a return."""

from __future__ import annotations

import numpy as np

from lidardesign.evaluation.entries import design_entries
from lidardesign.evaluation.request import EvaluationRequest, fired_numbers
from lidardesign.evaluation.rivals import rivals_of
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import DesignSpace
from lidardesign.task import Defaults, Metric, Score, TaskConfig
from support.baselines import balls
from support.sensors import normal_sensor

SPACE = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))

RAYS = (9, 25)


class MissTask:
    """Percent of rays without a return; too few returns are a failure."""

    name = "miss"
    summary = "rays without a return"
    api_version = 1
    Config = TaskConfig
    metric = Metric("misses", "%", "lower", worst=150.0, tolerance=1.0)
    defaults = Defaults()
    fewest_returns = 3

    def space(self, config):
        return SPACE

    def scenes(self, config, split, seed):
        return scenes(seed)

    def score(self, scene, returns):
        hit = sum(int(frame.returned.sum()) for frame in returns)
        fired = sum(len(frame.outcome) for frame in returns)
        if hit < self.fewest_returns or not fired:
            return Score(self.metric.worst, failed=True)
        return Score(100.0 * (1 - hit / fired))


class HitTask(MissTask):
    """Percent of rays with a return: higher is better."""

    metric = Metric("hits", "%", "higher", worst=0.0, tolerance=1.0)

    def score(self, scene, returns):
        return Score(100.0 * float(np.mean(returns[0].returned)) if len(returns[0].outcome) else 0.0)


def scenes(seed, count=6, side=0.0):
    return balls(np.array([3, side, 0]), count=count, seed=seed)


def design(name="aimed", azimuth=0.0, spread=0.03, range_m=2.65, weight=1.0):
    sensor = normal_sensor("s0", weight, (0, 0, 0), azimuth, 0.0, 0.0, (spread, spread), range_m, 0.05)
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


def entries_of(request):
    """All entries of an evaluation: its designs, and their rivals."""
    counts = fired_numbers(request.designs, request.rays)
    designs = design_entries(request, counts)
    shared = [count for count in counts if count not in request.alone]
    return [*designs, *rivals_of(request, designs, shared).entries]


def rows_by_key(evaluation):
    return {(row.design, row.rays): row for row in evaluation.rows}
