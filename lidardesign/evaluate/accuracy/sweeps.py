"""What accuracy costs in time: the ladders of every numerical choice, for a task and a run, on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from lidardesign.config import RunConfig
from lidardesign.evaluate.accuracy.settings import Ladder
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.results import Evaluation
from lidardesign.run.clock import phase

# In the order of the pipeline. Each module has `ladders(request) -> Sequence[Ladder]`, empty where the choice does not
# arise, and LABEL, its name for progress.
LADDERS = ("visibility", "fields", "precision", "scenes", "training", "mixture", "physics", "held_out")


@dataclass(frozen=True, eq=False)
class AccuracyRequest:
    """What ladders are measured on.

    Arguments:
        config: The run's configuration.
        run: The run's folder.
        request: The evaluation's request: task, scenes, designs, samples, layouts, planner, seed.
        evaluation: What the evaluation found.
    """

    config: RunConfig
    run: Path
    request: EvaluationRequest
    evaluation: Evaluation


@dataclass(frozen=True, eq=False)
class Accuracy:
    """All ladders, and the time that each module of them took [s]."""

    ladders: Sequence[Ladder]
    seconds: dict[str, float]

    def as_rows(self) -> list[dict[str, Any]]:
        """The contract's `accuracy` list."""
        return [row for ladder in self.ladders for row in ladder.as_rows()]


def measure_accuracy(
    request: AccuracyRequest, progress: Callable[[int, int, str], None] | None = None
) -> Accuracy:
    """Measure every ladder that applies.

    Arguments:
        request: What to measure on.
        progress: Called with the ladders done, all ladders, and the label of the next.
    """
    found: list[Ladder] = []
    seconds: dict[str, float] = {}
    for done, name in enumerate(LADDERS):
        module = import_module(f"lidardesign.evaluate.accuracy.{name}")
        if progress:
            progress(done, len(LADDERS), module.LABEL)
        started = time.perf_counter()
        with phase(name):
            found += module.ladders(request)
        seconds[name] = round(time.perf_counter() - started, 3)
    if progress:
        progress(len(LADDERS), len(LADDERS), "")
    return Accuracy(found, seconds)
