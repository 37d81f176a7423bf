"""Evaluations by workers, and what of them must not depend on who scored."""

from __future__ import annotations

import math

import numpy as np
from lidardesign_tasks.flatland import FlatlandConfig, FlatlandTask

from lidardesign.evaluation.request import EvaluationRequest
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from support.sensors import normal_sensor

SEED = 3


def make_request(**changes):
    """Flatland with six held-out scenes and one design."""
    task, config = FlatlandTask(), FlatlandConfig(train=3, test=6)
    space = task.space(config)
    sensor = normal_sensor("s0", 1.0, (0.5, 0.0, 0.0), math.pi / 2, 0.0, 0.0, (0.3, 0.01), 0.7, 0.1)
    values = {
        "task": task,
        "config": config,
        "space": space,
        "seed": SEED,
        "designs": [DesignSpec("aimed", (sensor,))],
        "rays": (8, 16),
        "train": task.scenes(config, "train", SEED),
        "test": task.scenes(config, "test", SEED),
    }
    return EvaluationRequest(**{**values, **changes})


def without_times(document):
    """A document without what no second run repeats."""
    if isinstance(document, dict):
        return {key: without_times(value) for key, value in document.items() if "seconds" not in key}
    return [without_times(value) for value in document] if isinstance(document, list) else document


def results(evaluation):
    rows = [*evaluation.rows, *evaluation.equal_bandwidth]
    return without_times(evaluation.as_dict()), [row.per_scene.tolist() for row in rows]


def random_rays(count, seed):
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, 3))
    return Rays(
        generator.normal(size=(count, 3)),
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        np.sort(generator.random((count, 2)), axis=1),
        generator.integers(0, 9, count),
        generator.random(count),
    )
