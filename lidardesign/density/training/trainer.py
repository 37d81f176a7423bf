"""Training the flow on the target until it is good enough, with divergence handling and exact resume.

The first steps follow the reverse KL along paths while sigma falls geometrically from its start to its final value, so
that surfaces are found while they are wide; eta falls to zero with it. All further ones balance the mass by values of
p* (`losses`), with steps that fall as the root of their number. What is learned is the average of the weights on the
way, the later ones counting more: it is at every step about as good as if training had been planned to end there, so
training may stop at any. Every `STRETCH` steps the average is measured against the target, and training stops once the
share of its mass in the wrong place is small enough. The best average that was measured is what is kept: some targets
turn worse again as steps go on.

A step whose loss or gradient is not finite is skipped; several in a row take the last good weights back and halve the
step size; when that does not help either, training stops with the last good checkpoint. Balancing looks back from
places to densities: where float32 cannot (`losses.round_trip_nats`), the remaining steps are taken in float64.

Every `STRETCH` steps the whole state is copied. Checkpoints are these copies, also after an interruption: a resumed run
falls back on the same weights as an uninterrupted one would, so both stay the same bit for bit.

References:
    Averages of polynomial weight, Shamir and Zhang 2013, arXiv:1212.1824.
"""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.optim.adam import adam

from lidardesign.config import LearningSettings
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.target import Target
from lidardesign.density.training.checkpoint import (
    COUNTERS,
    FLOWS,
    MOMENTS,
    check_resumable,
    clear_snapshots,
    is_snapshot,
    load_arrays,
    save_arrays,
    save_flow,
    snapshot_name,
)
from lidardesign.density.training.losses import TOLERANCE_NATS, Pool, balancing_loss, pathwise_loss, round_trip_nats
from lidardesign.density.training.quality import measure
from lidardesign.density.training.sampling import LearnedFlow
from lidardesign.errors import DivergenceError, NumericalError
from lidardesign.estimates import Estimate
from lidardesign.numerics import HALF_DIGITS
from lidardesign.run.clock import phase
from lidardesign.run.files import append_line, write_atomic
from lidardesign.run.inputs import RECORD, read_file
from lidardesign.run.manifest import record
from lidardesign.samples import Samples

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
# The share of the path-wise steps over which sigma falls.
ANNEALED = 0.7
# The step size falls on a cosine to this share over the path-wise steps.
LAST_PATHWISE_RATE = 0.1
# Balancing begins with this share; after so many steps it is divided by the root of 2.
BALANCING_RATE = 0.3
SLOWING_STEPS = 200
# The average after k steps has the weights after step j in proportion to (j / k)^AVERAGING, about.
AVERAGING = 4
SKIPS_BEFORE_BACKING_OFF = 5
HALVINGS_BEFORE_GIVING_UP = 6
STRETCH, LEAST_STRETCHES = 50, 2
# What is measured on the way is known to about 0.01; it has to be below the goal by so many standard errors.
STOPPING_POINTS = 2048
# Fewer do not show what a density dropped.
FEWEST_PROBES = 100
STANDARD_ERRORS = 1.0
PROGRESS_STEPS = 10
ROUND_TRIPS = 256


@dataclass(frozen=True)
class LearnProgress:
    """The state of learning for progress bars and progress.jsonl.

    Arguments:
        step, steps: Done, and the most that are taken; None where time decides.
        loss: Mean of (1 + eta) log p - log p* over the batch [nats].
        ess: Effective share of the batch at the present sigma.
        seconds: Spent so far; seconds_left: with all steps, None where time decides.
    """

    step: int
    steps: int | None
    loss: float
    ess: float
    seconds: float
    seconds_left: float | None


# The arrays of a state, copied, and its counters.
_State = tuple[dict[str, np.ndarray], dict[str, Any]]


def least_balancing_steps(pathwise_steps: int) -> int:
    """The least number of balancing steps of a run with this many path-wise ones.

    After a single stretch a few points are still starved, too few for the misplaced share to see them.
    """
    return max(pathwise_steps, LEAST_STRETCHES * STRETCH)


def reaches(misplaced: Estimate, goal: float) -> bool:
    """True where a misplaced share is below a goal by `STANDARD_ERRORS` of its standard errors."""
    return misplaced.value + STANDARD_ERRORS * (misplaced.error or 0.0) <= goal


@dataclass(eq=False)
class Trainer(LearnedFlow):
    """The state of training: flow, optimiser, random stream and counters.

    `average` is what is learned, in place of `flow`, which steps move, and `best` what it was when the least of its
    mass was measured to be in the wrong place: `least_misplaced`, None before that. `is_over` is asked before each
    balancing step once these are as many as the path-wise ones: a time budget. `doubled_at` is the step from which on
    float64 replaced float32, None where it did not have to. `measured` has the misplaced shares by step.
    """

    settings: LearningSettings
    run: Path
    pool: Pool
    probes: Samples | None = None
    is_over: Callable[[Trainer], bool] | None = None
    step: int = 0
    stopped: bool = False
    skipped: int = 0
    skipped_in_a_row: int = 0
    halvings: int = 0
    doubled_at: int | None = None
    least_misplaced: float | None = None
    measured: list[tuple[int, Estimate]] = field(default_factory=list)
    seconds_before: float = 0.0
    _snapshot: _State | None = None

    def __post_init__(self) -> None:
        self.average, self.best = copy.deepcopy(self.flow), copy.deepcopy(self.flow)
        self.optimiser = Adam(self.flow.parameters(), self.settings.rate)
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time spent learning, over all resumed parts."""
        return self.seconds_before + time.perf_counter() - self._started

    @property
    def balanced_steps(self) -> int:
        """Balancing steps that are done; negative before they begin."""
        return self.step - self.settings.pathwise_steps

    def learned(self) -> LearnedFlow:
        """The learned flow in float64: the best average that was measured, else the last one.

        Steps are taken in float32 as well and cost less; samples and their densities are worth float64.
        """
        return self._in_double(self.average if self.least_misplaced is None else self.best)

    def _in_double(self, flow: DesignFlow, generator: torch.Generator | None = None) -> LearnedFlow:
        """A flow in float64, with samples from the trainer's own stream, or another."""
        return LearnedFlow(copy.deepcopy(flow).double(), self.target, self.coordinates, generator or self.generator)

    def sigma_m(self, step: int) -> float:
        """The annealed sigma of a step [m]."""
        final = self.target.optics.sigma_m
        start = max(self.settings.sigma_start_m or SIGMA_START_RATIO * final, final)
        fraction = min(step / max(ANNEALED * self.settings.pathwise_steps, 1.0), 1.0)
        return start * (final / start) ** fraction

    def _rate(self) -> float:
        share = BALANCING_RATE / math.sqrt(1 + max(self.balanced_steps, 0) / SLOWING_STEPS)
        if self.step < self.settings.pathwise_steps:
            cosine = math.cos(math.pi * self.step / self.settings.pathwise_steps)
            share = LAST_PATHWISE_RATE + (1 - LAST_PATHWISE_RATE) * (1 + cosine) / 2
        return self.settings.rate * share / 2**self.halvings

    def train(self, progress: Callable[[LearnProgress], None] | None = None) -> None:
        """Run until it is good enough or all steps are done, with checkpoints, one of them when it is interrupted.

        Raises:
            DivergenceError: Learning stayed non-finite.
        """
        try:
            checkpointed = time.perf_counter()
            while not self.stopped and self.step < self.settings.steps:
                if self.balanced_steps % STRETCH == 0 or self._snapshot is None:
                    self._begin_stretch()
                    self._snapshot = self._state()
                    if time.perf_counter() - checkpointed > self.settings.checkpoint_seconds:
                        self._save(*self._snapshot)
                        checkpointed = time.perf_counter()
                loss, ess = self._advance()
                if is_snapshot(self.step, self.settings):
                    save_flow(self.average, self.run, snapshot_name(self.step), step=self.step)
                is_over = self._may_stop and self.is_over is not None and self.is_over(self)
                is_last = is_over or self.step == self.settings.steps
                reached = self._reached(is_last)
                goal = self.settings.misplaced
                is_good = bool(reached and goal) and reaches(self.measured[-1][1], goal)
                self.stopped = is_good or (is_last and self.step < self.settings.steps)
                if reached or self.stopped or is_last or self.step % PROGRESS_STEPS == 0:
                    self._report(loss, ess, reached, progress)
        except KeyboardInterrupt:
            if self._snapshot is not None:
                self._save(*self._snapshot)
            raise
        self._save(*self._state())

    def _reached(self, is_last: bool) -> dict[str, float]:
        """Measure the misplaced share after each stretch of balancing and at the end; keep the best average."""
        if self.probes is None or len(self.probes) < FEWEST_PROBES or not self._may_stop:
            return {}
        if self.balanced_steps % STRETCH and not is_last:
            return {}
        # the same base points every time, so that only the averages differ
        own = torch.Generator().manual_seed(0)
        try:
            found = measure(self._in_double(self.average, own), self.probes, STOPPING_POINTS).estimates["misplaced"]
        except NumericalError:  # a flow without numbers is not good
            return {}
        if self.least_misplaced is None or found.value < self.least_misplaced:
            self.least_misplaced = found.value
            self.best.load_state_dict(self.average.state_dict())
        self.measured.append((self.step, found))
        return {"misplaced": found.value, "misplaced_error": found.error or 0.0}

    @property
    def _may_stop(self) -> bool:
        return self.balanced_steps >= least_balancing_steps(self.settings.pathwise_steps)

    def _report(
        self,
        loss: float,
        ess: float,
        reached: Mapping[str, float],
        progress: Callable[[LearnProgress], None] | None,
    ) -> None:
        seconds = self.seconds
        row = {
            "step": self.step,
            "loss": loss if math.isfinite(loss) else None,
            "ess": ess if math.isfinite(ess) else None,
            "sigma_m": self.sigma_m(self.step),
            "rate": self._rate(),
            "skipped": self.skipped,
            "seconds": round(seconds, 3),
            **reached,
        }
        append_line(self.run / PROGRESS, json.dumps(row))
        if progress:
            steps = self.settings.steps if self.is_over is None else None
            left = None if steps is None else seconds / self.step * (steps - self.step)
            progress(LearnProgress(self.step, steps, loss, ess, seconds, left))

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
        self._average()
        return value, ess

    @torch.no_grad()
    def _average(self) -> None:
        """Update the average: the flow itself until balancing begins, then a mean with polynomial weights."""
        share = (AVERAGING + 1) / (AVERAGING + max(self.balanced_steps, 1))
        torch._foreach_lerp_(list(self.average.parameters()), list(self.flow.parameters()), share)

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
            if self.step >= self.settings.pathwise_steps:
                return balancing_loss(self.flow, self.target, self.coordinates, count, self.pool, self.generator)
            eta = self.settings.entropy * (1 - self.step / self.settings.pathwise_steps)
            sigma_m, target = self.sigma_m(self.step), self._few_frames()
            return pathwise_loss(self.flow, target, self.coordinates, count, sigma_m, eta, self.generator)
        except NumericalError:  # the flow left the numbers: a step to skip like any other
            return torch.tensor(math.nan), math.nan, math.nan

    def _begin_stretch(self) -> None:
        """Prepare the balancing steps up to the next snapshot; the stream is left alone.

        They are taken in float64 where float32 densities are too inaccurate, and proposals that the flow starves are
        drawn more often.
        """
        if self.step < self.settings.pathwise_steps:
            return
        single, stream = next(self.flow.parameters()).dtype != torch.float64, torch.Generator().manual_seed(self.step)
        if single and round_trip_nats(self.flow, ROUND_TRIPS, stream) > TOLERANCE_NATS:
            self._double(self.step)
        self.pool = self.pool.emphasised(self.flow, self.coordinates)

    def _double(self, step: int) -> None:
        self.doubled_at = step
        for flow in (self.flow, self.average, self.best):
            flow.double()
        for parameter in self.flow.parameters():
            state = self.optimiser.state.get(parameter, {})
            state.update({name: _moved(name, value, parameter) for name, value in state.items()})

    def _few_frames(self) -> Target:
        """The target of a path-wise step, on a random subset of frames: at a wide sigma all would matter everywhere.

        Balancing needs the values of p* and uses all frames; at the final sigma few of them matter at a point.
        """
        if self.target.columns <= self.settings.frames:
            return self.target
        chosen = torch.randperm(self.target.columns, generator=self.generator)[: self.settings.frames]
        return self.target.subsample(np.sort(chosen.numpy()))

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
        arrays = {
            f"{of}.{name}": value.detach().cpu().numpy().copy()
            for of in FLOWS
            for name, value in getattr(self, of).state_dict().items()
        }
        for index, parameter in enumerate(self.flow.parameters()):
            for name, value in self.optimiser.state.get(parameter, {}).items():
                arrays[f"adam.{index}.{name}"] = torch.as_tensor(value).cpu().numpy().copy()
        arrays["generator"] = self.generator.get_state().numpy().copy()
        return arrays

    def _restore_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        for of in FLOWS:
            getattr(self, of).load_state_dict(_inside(arrays, of))
        for index, parameter in enumerate(self.flow.parameters()):
            moments = _inside(arrays, f"adam.{index}")
            self.optimiser.state[parameter] = {name: _moved(name, value, parameter) for name, value in moments.items()}

    def _state(self) -> _State:
        counters = {name: getattr(self, name) for name in (*COUNTERS, "stopped", "doubled_at", "least_misplaced")}
        return self._state_arrays(), {**counters, "seconds": self.seconds}

    def _save(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        save_arrays(self.run, CHECKPOINT, arrays, state)
        if (self.run / PROGRESS).exists():
            record(self.run, [PROGRESS])

    def resume(self) -> None:
        """Take the state of the run's checkpoint; progress.jsonl and snapshots are cut back to it."""
        arrays, state = load_arrays(self.run, CHECKPOINT)
        check_resumable(arrays, state, self.flow, self.run / CHECKPOINT)
        if state.get("doubled_at") is not None:
            self._double(state["doubled_at"])
        self._restore_arrays(arrays)
        self.generator.set_state(torch.as_tensor(arrays["generator"]))
        for name in (*COUNTERS, "stopped", "least_misplaced"):
            setattr(self, name, state.get(name))
        self.seconds_before, self._started = state["seconds"], time.perf_counter()
        clear_snapshots(self.run, beyond=self.step)
        path = self.run / PROGRESS
        if path.exists():
            lines = read_file(path, RECORD).decode(errors="replace").splitlines()
            lines = [line for line in lines if _step_of(line) <= self.step]
            write_atomic(path, "".join(line + "\n" for line in lines))
            rows = [row for row in map(json.loads, lines) if "misplaced" in row]
            self.measured = [(row["step"], Estimate(row["misplaced"], row["misplaced_error"])) for row in rows]


def _inside(arrays: Mapping[str, np.ndarray], folder: str) -> dict[str, torch.Tensor]:
    """The arrays named folder.NAME, by NAME."""
    names = {key: key.removeprefix(f"{folder}.") for key in arrays}
    return {name: torch.as_tensor(arrays[key]) for key, name in names.items() if name != key}


def _moved(name: str, value: torch.Tensor, parameter: torch.Tensor) -> torch.Tensor:
    """A copy of an entry of a parameter's optimiser state on its device, where fused steps are counted too."""
    return value.to(parameter.device, value.dtype if name == "step" else parameter.dtype, copy=True)


def _step_of(line: str) -> float:
    """The step of a progress line; a line that was cut by a kill counts as beyond every checkpoint."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return math.inf
