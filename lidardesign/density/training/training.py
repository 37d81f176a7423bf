"""Training the flow on the target: annealing, then balancing, with divergence handling and exact resume.

First the reverse KL along paths, while sigma falls geometrically from its start to its final value, so that surfaces
are found while they are wide; eta falls to zero with it. The last steps balance the mass by values of p* (`losses`).
A step whose loss or gradient is not finite is skipped; several in a row take the last good weights back and halve the
step size; when that does not help either, training stops with the last good checkpoint. Balancing looks back from
places to densities: where float32 cannot (`losses.round_trip_nats`), the remaining steps are taken in float64.

Every `SNAPSHOT_STEPS` steps the whole state is copied. Checkpoints are these copies, also after an interruption: a
resumed run falls back on the same weights as an uninterrupted one would, so both stay the same bit for bit.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.optim.adam import adam

from lidardesign.config import LearningSettings
from lidardesign.density.target.target import Target
from lidardesign.density.training.checkpoint import (
    COUNTERS,
    MOMENTS,
    check_resumable,
    clear_snapshots,
    load_arrays,
    save_arrays,
    save_flow,
    snapshot_name,
    snapshot_steps,
)
from lidardesign.density.training.losses import TOLERANCE_NATS, Pool, balancing_loss, pathwise_loss, round_trip_nats
from lidardesign.density.training.sampling import LearnedFlow
from lidardesign.errors import DataError, DivergenceError, NumericalError
from lidardesign.numerics import HALF_DIGITS
from lidardesign.run.clock import phase
from lidardesign.run.files import append_line, write_atomic
from lidardesign.run.inputs import RECORD, read_file
from lidardesign.run.manifest import record

# How much of the means of gradients and of their squares a step keeps.
BETAS = (0.9, 0.99)


class Adam:
    """Steps of one size for all weights, each along its own mean gradient over the root of its mean square.

    The steps are those of `torch.optim.Adam` (Kingma and Ba 2015, arXiv:1412.6980), bit for bit. Its class imports the
    compiler of PyTorch, which nothing here uses: that takes as long again as importing PyTorch, in every process.

    Arguments:
        parameters: The weights, which are changed in place.
        rate: The step size; may be set between steps.

    `state` holds the means and the count of steps by weight; a weight without a gradient is left alone and has none.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], rate: float) -> None:
        self.parameters = list(parameters)
        self.rate = rate
        self.state: dict[torch.Tensor, dict[str, torch.Tensor]] = {}

    def clear(self) -> None:
        """Forget all gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Change every weight that has a gradient."""
        moved = [parameter for parameter in self.parameters if parameter.grad is not None]
        states = [self._state_of(parameter) for parameter in moved]
        adam(
            moved,
            [parameter.grad for parameter in moved],
            *([state[name] for state in states] for name in MOMENTS),
            [],
            [state["step"] for state in states],
            fused=True,  # one pass over the weights, a fifth of the time
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=self.rate,
            weight_decay=0.0,
            eps=HALF_DIGITS,
            maximize=False,
        )

    def _state_of(self, parameter: torch.Tensor) -> dict[str, torch.Tensor]:
        if not self.state.get(parameter):
            moments = {name: torch.zeros_like(parameter, memory_format=torch.preserve_format) for name in MOMENTS}
            # fused steps are counted on the device of the weight
            self.state[parameter] = {"step": torch.zeros((), dtype=torch.float32, device=parameter.device), **moments}
        return self.state[parameter]


CHECKPOINT = "checkpoint.safetensors"
PROGRESS = "progress.jsonl"
SIGMA_START_RATIO = 6.0
# The step size falls over each phase on a cosine between these shares of its initial value.
PATHWISE_RATES = (1.0, 0.1)
BALANCING_RATES = (0.6, 0.006)
SKIPS_BEFORE_BACKING_OFF = 5
HALVINGS_BEFORE_GIVING_UP = 6
SNAPSHOT_STEPS = 50
PROGRESS_STEPS = 10
ROUND_TRIPS = 256


@dataclass(frozen=True)
class LearnProgress:
    """Where learning stands, for progress bars and progress.jsonl.

    Arguments:
        step, steps: Done and planned.
        loss: Mean of (1 + eta) log p - log p* over the batch [nats].
        ess: Effective share of the batch at the present sigma.
        seconds: Spent so far; seconds_left: estimated.
        phase: "fields", "learning" or "measuring".
    """

    step: int
    steps: int
    loss: float
    ess: float
    seconds: float
    seconds_left: float
    phase: str = "learning"


# The arrays of a state, copied, and its counters.
_State = tuple[dict[str, np.ndarray], dict[str, Any]]


@dataclass(eq=False)
class Trainer(LearnedFlow):
    """The state of training: flow, optimiser, random stream and counters.

    `replan` is asked for other settings once, when balancing begins; they may differ in the number of balancing steps.
    `doubled_at` is the step from which on float64 replaced float32, None where it did not have to.
    """

    settings: LearningSettings
    run: Path
    pool: Pool
    step: int = 0
    skipped: int = 0
    skipped_in_a_row: int = 0
    halvings: int = 0
    doubled_at: int | None = None
    seconds_before: float = 0.0
    replan: Callable[[Trainer], LearningSettings] | None = None
    _snapshot: _State | None = None

    def __post_init__(self) -> None:
        self.optimiser = Adam(self.flow.parameters(), self.settings.rate)
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time spent learning, over all resumed parts."""
        return self.seconds_before + time.perf_counter() - self._started

    @property
    def pathwise_steps(self) -> int:
        """Steps before balancing begins."""
        return round((1 - self.settings.balance) * self.settings.steps)

    def sigma_m(self, step: int) -> float:
        """The annealed sigma of a step [m]."""
        final = self.target.optics.sigma_m
        start = max(self.settings.sigma_start_m or SIGMA_START_RATIO * final, final)
        fraction = min(step / max(self.settings.anneal * self.pathwise_steps, 1.0), 1.0)
        return start * (final / start) ** fraction

    def _rate(self) -> float:
        pathwise = self.step < self.pathwise_steps
        first, last = PATHWISE_RATES if pathwise else BALANCING_RATES
        begin, end = (0, self.pathwise_steps) if pathwise else (self.pathwise_steps, self.settings.steps)
        angle = math.pi * ((self.step - begin) / max(end - begin, 1))
        return self.settings.rate * (last + (first - last) * (1 + math.cos(angle)) / 2) / 2**self.halvings

    def train(self, progress: Callable[[LearnProgress], None] | None = None) -> None:
        """Run the remaining steps, with checkpoints, one of them when it is interrupted; raises DivergenceError."""
        try:
            checkpointed = time.perf_counter()
            while self.step < self.settings.steps:
                if self.step % SNAPSHOT_STEPS == 0 or self.step == self.pathwise_steps:
                    self._begin_stretch()
                if self.step % SNAPSHOT_STEPS == 0 or self._snapshot is None:
                    self._snapshot = self._state()
                    if time.perf_counter() - checkpointed > self.settings.checkpoint_seconds:
                        self._save(*self._snapshot)
                        checkpointed = time.perf_counter()
                if self.replan is not None and self.step == self.pathwise_steps:
                    self.settings, self.replan = self.replan(self), None
                loss, ess = self._advance()
                if self.step in snapshot_steps(self.settings):
                    save_flow(self.flow, self.run, snapshot_name(self.step), step=self.step)
                if self.step % PROGRESS_STEPS == 0 or self.step == self.settings.steps:
                    seconds = self.seconds
                    left = seconds / self.step * (self.settings.steps - self.step)
                    row = {
                        "step": self.step,
                        "loss": loss if math.isfinite(loss) else None,
                        "ess": ess if math.isfinite(ess) else None,
                        "sigma_m": self.sigma_m(self.step),
                        "rate": self._rate(),
                        "skipped": self.skipped,
                        "seconds": round(seconds, 3),
                    }
                    append_line(self.run / PROGRESS, json.dumps(row))
                    if progress:
                        progress(LearnProgress(self.step, self.settings.steps, loss, ess, seconds, left))
        except KeyboardInterrupt:
            if self._snapshot is not None:
                self._save(*self._snapshot)
            raise
        self._save(*self._state())

    def _advance(self) -> tuple[float, float]:
        self.optimiser.rate = self._rate()
        loss, norm, value, ess = self.find_gradient()
        if torch.isfinite(loss) and torch.isfinite(norm):
            with phase("update"):
                self.optimiser.step()
            self.skipped_in_a_row = 0
        else:
            self._skip()
        self.step += 1
        return value, ess

    def find_gradient(self) -> tuple[torch.Tensor, torch.Tensor, float, float]:
        """Fill the gradients of a step without taking it: the loss, their norm, the loss and the ESS for reports."""
        self.optimiser.clear()
        loss, value, ess = self._loss()
        if torch.isfinite(loss):
            with phase("gradient"):
                loss.backward()
        return loss, torch.nn.utils.clip_grad_norm_(self.flow.parameters(), self.settings.clip_norm), value, ess

    def _loss(self) -> tuple[torch.Tensor, float, float]:
        count = self.settings.batch
        try:
            if self.step >= self.pathwise_steps:
                return balancing_loss(self.flow, self.target, self.coordinates, count, self.pool, self.generator)
            eta = self.settings.entropy * (1 - self.step / self.pathwise_steps)
            sigma_m, target = self.sigma_m(self.step), self._few_frames()
            return pathwise_loss(self.flow, target, self.coordinates, count, sigma_m, eta, self.generator)
        except NumericalError:  # the flow left the numbers: a step to skip like any other
            return torch.tensor(math.nan), math.nan, math.nan

    def _begin_stretch(self) -> None:
        """Prepare the balancing steps up to the next snapshot; the stream is left alone.

        They are taken in float64 where float32 gets the densities wrong that they ask for, and their proposals are
        drawn by what the flow starves now.
        """
        if self.step < self.pathwise_steps:
            return
        self._check_round_trip()
        self.pool = self.pool.emphasised(self.flow, self.coordinates)

    def _check_round_trip(self) -> None:
        if next(self.flow.parameters()).dtype == torch.float64:
            return
        if round_trip_nats(self.flow, ROUND_TRIPS, torch.Generator().manual_seed(self.step)) > TOLERANCE_NATS:
            self._double(self.step)

    def _double(self, step: int) -> None:
        self.doubled_at = step
        self.flow.double()
        for parameter in self.flow.parameters():
            state = self.optimiser.state.get(parameter, {})
            state.update({name: _moved(name, value, parameter) for name, value in state.items()})

    def _few_frames(self) -> Target:
        """The target of a path-wise step. While sigma is wide thousands of frames would matter at every point.

        Balancing needs the values of p* and sees all frames; at the final sigma few of them matter.
        """
        if self.target.columns <= self.settings.frames:
            return self.target
        chosen = torch.randperm(self.target.columns, generator=self.generator)[: self.settings.frames]
        return self.target.drawn(np.sort(chosen.numpy()))

    def _skip(self) -> None:
        self.skipped, self.skipped_in_a_row = self.skipped + 1, self.skipped_in_a_row + 1
        if self.skipped_in_a_row < SKIPS_BEFORE_BACKING_OFF:
            return
        self.halvings, self.skipped_in_a_row = self.halvings + 1, 0
        if self.halvings > HALVINGS_BEFORE_GIVING_UP:
            self._save(*self._snapshot)
            raise DivergenceError(
                f"learning diverged at step {self.step}: loss or gradient stayed non-finite after "
                f"{self.halvings - 1} halvings of the step size; the last good state is {self.run / CHECKPOINT}",
                hint="a smaller learning.rate, a larger density.sigma_m, or learning.dtype=float64",
            )
        self._restore_arrays(self._snapshot[0])

    def _state_arrays(self) -> dict[str, np.ndarray]:
        arrays = {f"flow.{name}": value.detach().cpu().numpy().copy() for name, value in self.flow.state_dict().items()}
        for index, parameter in enumerate(self.flow.parameters()):
            for name, value in self.optimiser.state.get(parameter, {}).items():
                arrays[f"adam.{index}.{name}"] = torch.as_tensor(value).cpu().numpy().copy()
        arrays["generator"] = self.generator.get_state().numpy().copy()
        return arrays

    def _restore_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        prefix = "flow."
        flow = {key[len(prefix) :]: torch.as_tensor(value) for key, value in arrays.items() if key.startswith(prefix)}
        try:
            self.flow.load_state_dict(flow)
        except RuntimeError as error:
            raise DataError(
                f"the checkpoint belongs to another flow: {str(error).splitlines()[-1].strip()}",
                where=str(self.run / CHECKPOINT),
                hint="resume with the run's own configuration",
            ) from None
        for index, parameter in enumerate(self.flow.parameters()):
            start = f"adam.{index}."
            moments = {key[len(start) :]: torch.as_tensor(v) for key, v in arrays.items() if key.startswith(start)}
            self.optimiser.state[parameter] = {name: _moved(name, value, parameter) for name, value in moments.items()}

    def _state(self) -> _State:
        counters = {name: getattr(self, name) for name in (*COUNTERS, "doubled_at")}
        return self._state_arrays(), {**counters, "seconds": self.seconds}

    def _save(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        save_arrays(self.run, CHECKPOINT, arrays, state)
        if (self.run / PROGRESS).exists():
            record(self.run, [PROGRESS])

    def resume(self) -> None:
        """Take the state of the run's checkpoint; progress.jsonl and snapshots are cut back to it."""
        arrays, state = load_arrays(self.run, CHECKPOINT)
        check_resumable(arrays, state, self.flow, self.generator, self.run / CHECKPOINT)
        if state.get("doubled_at") is not None:  # older checkpoints have no such entry
            self._double(state["doubled_at"])
        self._restore_arrays(arrays)
        self.generator.set_state(torch.as_tensor(arrays["generator"]))
        for name in COUNTERS:
            setattr(self, name, state[name])
        self.seconds_before, self._started = state["seconds"], time.perf_counter()
        clear_snapshots(self.run, beyond=self.step)
        path = self.run / PROGRESS
        if path.exists():
            lines = read_file(path, RECORD).decode(errors="replace").splitlines()
            write_atomic(path, "".join(line + "\n" for line in lines if _step_of(line) <= self.step))


def _moved(name: str, value: torch.Tensor, parameter: torch.Tensor) -> torch.Tensor:
    """A copy of a part of a parameter's optimiser state beside it: fused steps are counted on its device as well."""
    return value.to(parameter.device, value.dtype if name == "step" else parameter.dtype, copy=True)


def _step_of(line: str) -> float:
    """The step of a progress line; a line that was cut by a kill counts as beyond every checkpoint."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return math.inf
