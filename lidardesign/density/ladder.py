"""What learning had reached after a part of its steps, measured anew from the snapshots that a run kept."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from lidardesign.density.flow import DesignFlow
from lidardesign.density.learn import FLOW, make_flow
from lidardesign.density.measure import Probes, measure
from lidardesign.density.objective import Coordinates
from lidardesign.density.snapshots import kept_snapshots, rung_steps, twin_step
from lidardesign.density.target import Target
from lidardesign.density.training import PROGRESS
from lidardesign.design.samples import Samples
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.run.checkpoint import load_arrays
from lidardesign.run.config import RunConfig
from lidardesign.run.manifest import verify


@dataclass(frozen=True, eq=False)
class LoadedFlow:
    """A flow of a run with what it is measured by; see `measure.Learned`."""

    flow: DesignFlow
    target: Target
    coordinates: Coordinates
    generator: torch.Generator


@dataclass(frozen=True, eq=False)
class Reached:
    """What a run's flow was worth after a step.

    Arguments:
        step: The number of steps done.
        seconds: What they took [s].
        estimates: ess, kl_nats, log_z, coverage and misplaced, with standard errors.
        samples: The samples that these were measured on.
        twin: The misplaced share of the snapshot shortly before, where one was kept.
    """

    step: int
    seconds: float
    estimates: Mapping[str, Estimate]
    samples: Samples
    twin: Estimate | None = None

    @property
    def misplaced(self) -> Estimate:
        """The share that flows around this step misplace: the mean of the twins, with half of what they are apart."""
        own = self.estimates["misplaced"]
        if self.twin is None:
            return own
        error = max(own.error or 0.0, self.twin.error or 0.0)
        return Estimate((own.value + self.twin.value) / 2, math.hypot(error, (own.value - self.twin.value) / 2))


def check_kept(run: Path) -> None:
    """Check all that a run is measured anew by: its flow, its snapshots and its progress.

    Raises:
        DataError: The run is unfinished or damaged.
    """
    for name in (FLOW, PROGRESS, *kept_snapshots(run).values()):
        verify(run, name)


def remeasured(run: Path, config: RunConfig, target: Target, probes: Probes, *, count: int, seed: int) -> list[Reached]:
    """The figures of every snapshot of a run and of its flow, in the order of steps.

    All are measured on the same base points and the same probes, so that they differ by what was learned.

    Arguments:
        run: The run's folder.
        config: Its configuration.
        target: Its target, or one that another run is to be measured against.
        probes: Probes of that target.
        count: Samples of each flow.
        seed: The root of the base points.

    Raises:
        DataError: The run is unfinished or damaged.
    """
    files = {**kept_snapshots(run), config.learning.steps: FLOW}
    rungs = [step for step in rung_steps(config.learning) if step in files]
    seconds, found = seconds_at(run, rungs), []
    for step in rungs:
        reached = measure(load_flow(run, files[step], config, target, seed), probes, count)
        twin = files.get(twin_step(config.learning, step))
        other = measure(load_flow(run, twin, config, target, seed), probes, count) if twin else None
        apart = None if other is None else other.estimates["misplaced"]
        found.append(Reached(step, seconds[step], reached.estimates, reached.samples, apart))
    return found


def load_flow(run: Path, name: str, config: RunConfig, target: Target, seed: int) -> LoadedFlow:
    """A flow of a run from its file, in double precision.

    Raises:
        DataError: The file is missing, damaged, or of another flow.
    """
    generator = torch.Generator().manual_seed(seed)
    flow = make_flow(config, generator).double()
    arrays, _ = load_arrays(run, name)
    try:
        flow.load_state_dict({key: torch.as_tensor(value) for key, value in arrays.items()})
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise DataError(f"is of another flow: {reason}", where=str(run / name), hint="learn the run again") from None
    return LoadedFlow(flow, target, Coordinates(config.space), generator.manual_seed(seed))


def seconds_at(run: Path, steps: list[int]) -> dict[int, float]:
    """How long learning had taken after each step, from the run's progress, interpolated between its rows [s].

    Raises:
        DataError: The progress is missing or damaged.
    """
    verify(run, PROGRESS)
    try:
        rows = [json.loads(line) for line in (run / PROGRESS).read_text(encoding="utf-8").splitlines()]
        done = np.array([0.0, *(float(row["step"]) for row in rows)])
        taken = np.array([0.0, *(float(row["seconds"]) for row in rows)])
        if not (np.isfinite(done).all() and np.isfinite(taken).all() and (np.diff(done) > 0).all()):
            raise ValueError("steps do not ascend, or a number is none")
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        raise DataError("is no progress of learning", where=str(run / PROGRESS), hint="learn the run again") from None
    return {step: float(np.interp(step, done, taken)) for step in steps}

