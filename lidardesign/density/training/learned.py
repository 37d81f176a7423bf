"""The learned density of a run: loaded, sampled, evaluated, and measured at the snapshots that its learning kept.

Gradients of steps are compared relative to their own noise, sqrt(E |g - E g|^2) over batches: a step's gradient is an
estimate, so errors of arithmetic or of fewer scenes matter only in comparison with it.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from lidardesign.config import LearningSettings, RunConfig
from lidardesign.density.coordinates import Coordinates
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.prepare import prepare_target
from lidardesign.density.objective.target import Target
from lidardesign.density.objective.visibility import Optics
from lidardesign.density.training.checkpoint import load_arrays, stored_snapshots
from lidardesign.density.training.learn import FLOW, make_flow, training_scenes
from lidardesign.density.training.losses import Pool, balancing_loss, pathwise_loss
from lidardesign.density.training.quality import measure
from lidardesign.density.training.sampling import LearnedFlow, Thinning, condition_groups, draw_samples, log_density_of
from lidardesign.density.training.trainer import PROGRESS, SIGMA_START_RATIO
from lidardesign.errors import ConfigError, DataError
from lidardesign.estimates import Estimate
from lidardesign.numerics import TINY
from lidardesign.run.inputs import RECORD, read_file
from lidardesign.run.manifest import verify
from lidardesign.samples import Samples
from lidardesign.space import DesignSpace
from lidardesign.task import Task


@dataclass(frozen=True, eq=False)
class SnapshotQuality:
    """The quality of a run's flow after a step.

    Arguments:
        step: The number of steps done.
        seconds: Time that they took [s].
        estimates: ess, kl_nats, log_z, coverage and misplaced, with standard errors.
    """

    step: int
    seconds: float
    estimates: Mapping[str, Estimate]


def check_kept(run: Path) -> None:
    """Verify the files that a run is measured anew from: its flow, its snapshots and its progress.

    Raises:
        DataError: The run is unfinished or damaged.
    """
    for name in (FLOW, PROGRESS, *stored_snapshots(run).values()):
        verify(run, name)


def remeasured(
    run: Path, config: RunConfig, target: Target, probes: Samples, *, count: int, seed: int
) -> list[SnapshotQuality]:
    """The figures of every snapshot of a run and of its flow, in the order of steps.

    All are measured on the same base points and the same probes, so that only the flows differ.

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
    seconds, qualities = seconds_at(run), []
    for step, name in {**stored_snapshots(run), max(seconds): FLOW}.items():
        reached = measure(load_flow(run, name, config, target, seed), probes, count)
        taken = float(np.interp(step, list(seconds), list(seconds.values())))
        qualities.append(SnapshotQuality(step, taken, reached.estimates))
    return qualities


def load_flow(run: Path, name: str, config: RunConfig, target: Target, seed: int) -> LearnedFlow:
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
        raise DataError(
            f"belongs to another flow: {reason}", where=str(run / name), hint="learn the run again"
        ) from None
    return LearnedFlow(flow, target, Coordinates(config.space), generator.manual_seed(seed))


def seconds_at(run: Path) -> dict[int, float]:
    """Time of learning by the number of steps, ascending, from the run's progress [s]; 0 steps have 0 s.

    Raises:
        DataError: The progress is missing or damaged.
    """
    verify(run, PROGRESS)
    try:
        rows = [json.loads(line) for line in read_file(run / PROGRESS, RECORD).decode().splitlines()]
        done = [0, *(int(row["step"]) for row in rows)]
        taken = [0.0, *(float(row["seconds"]) for row in rows)]
        if not (np.isfinite(taken).all() and (np.diff(np.array(done, dtype=float)) > 0).all()):
            raise ValueError("steps do not ascend, or a value is not a number")
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        raise DataError(
            "does not hold the progress of learning", where=str(run / PROGRESS), hint="learn the run again"
        ) from None
    return dict(zip(done, taken, strict=True))


Loss = Callable[[DesignFlow, torch.Generator], torch.Tensor]
DTYPES = ("float32", "float64")


@dataclass(frozen=True, eq=False)
class FlatTarget:
    """p* = 1 at no cost: what remains of a step's time is the flow's own."""

    optics: Optics
    space: DesignSpace

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """See `Target`."""
        return np.zeros(len(points))

    def log_density_and_gradient(
        self, points: np.ndarray, sigma_m: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Target`."""
        return np.zeros(len(points)), np.zeros(points.shape)


@dataclass(frozen=True, eq=False)
class LearningSteps:
    """The two kinds of steps of learning, at a flow.

    Arguments:
        flow: Where the gradients are taken.
        target: The target density.
        settings: Of learning.
        pool: Proposals for balancing.
    """

    flow: DesignFlow
    target: Target | FlatTarget
    settings: LearningSettings
    pool: Pool

    def without_target(self) -> LearningSteps:
        """The same steps with a target that costs nothing, to be timed."""
        return replace(self, target=FlatTarget(self.target.optics, self.target.space))

    @property
    def sigma_m(self) -> float:
        """The middle of the annealing on its geometric scale [m]."""
        final = self.target.optics.sigma_m
        start = max(self.settings.sigma_start_m or SIGMA_START_RATIO * final, final)
        return float(np.sqrt(start * final))

    def pathwise(self, target: Target | None = None) -> Loss:
        """The loss of a path-wise step, with a thinned target where one is given."""
        target, coordinates = target or self.target, Coordinates(self.target.space)
        return lambda flow, generator: pathwise_loss(
            flow, target, coordinates, self.settings.batch, self.sigma_m, 0.0, generator
        )[0]

    def balancing(self) -> Loss:
        """The loss of a balancing step."""
        coordinates, count = Coordinates(self.target.space), self.settings.batch
        return lambda flow, generator: balancing_loss(flow, self.target, coordinates, count, self.pool, generator)[0]


def gradient(flow: DesignFlow, loss: Loss, seed: int, clip_norm: float) -> np.ndarray:
    """The gradient that a step takes, by all parameters, flat float64; zeros where it is not finite and skipped.

    Arguments:
        flow: Its arithmetic is the step's.
        loss: Draws its batch from the generator that it is given.
        seed: Of the batch: the same one gives the same batch in any arithmetic.
        clip_norm: The length that steps are clipped to.
    """
    parameters = list(flow.parameters())
    batch = torch.Generator().manual_seed(seed)
    parts = torch.autograd.grad(loss(flow, batch), parameters, allow_unused=True, materialize_grads=True)
    flat = torch.cat([part.detach().double().reshape(-1) for part in parts]).cpu().numpy()
    if not np.isfinite(flat).all():
        return np.zeros_like(flat)
    return flat * min(1.0, clip_norm / max(np.linalg.norm(flat), TINY))


def in_arithmetic(flow: DesignFlow, dtype: str) -> DesignFlow:
    """A copy of a flow in float32 or float64."""
    return copy.deepcopy(flow).to(dtype=getattr(torch, dtype))


def noise_share(gradients: Sequence[np.ndarray], exact: Sequence[np.ndarray]) -> tuple[float, float]:
    """The rms error of gradients as a share of the noise of the exact ones, and its standard error.

    Arguments:
        gradients: Of several batches, shape (P,) each, or (draws, P) of several draws for each batch; the standard
            error is the jackknife's over batches.
        exact: Of the same batches, 3 or more.
    """
    apart, products = _apart(gradients, exact)
    count = len(apart)
    left_out = [_share(apart, products, np.delete(np.arange(count), n)) for n in range(count)]
    return _share(apart, products, np.arange(count)), float(np.sqrt((count - 1) * np.var(left_out)))


def noise_shares(gradients: Sequence[np.ndarray], exact: Sequence[np.ndarray]) -> np.ndarray:
    """The error of every batch's gradient as a share of the noise of exact ones, shape (batches,)."""
    apart, products = _apart(gradients, exact)
    variance = _variance(products)
    return np.sqrt(apart / variance) if variance > 0 else np.zeros(len(apart))


def _apart(gradients: Sequence[np.ndarray], exact: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean squared differences by batch (K,), and the products of all exact gradients (K, K)."""
    apart = [
        np.square(np.atleast_2d(found) - wanted).sum(axis=1).mean()
        for found, wanted in zip(gradients, exact, strict=True)
    ]
    exact = np.asarray(exact)
    return np.array(apart), exact @ exact.T


def _share(apart: np.ndarray, products: np.ndarray, rows: np.ndarray) -> float:
    """sqrt(mean |difference|^2 / variance) over some batches."""
    variance = _variance(products[np.ix_(rows, rows)])
    return float(np.sqrt(apart[rows].mean() / variance)) if variance > 0 else 0.0


def _variance(products: np.ndarray) -> float:
    """E |g - E g|^2 from the products of gradients (K, K)."""
    count = len(products)
    return float((np.trace(products) - products.sum() / count) / (count - 1))


# Samples to be kept of those that are drawn at a time.
KEPT_AT_ONCE = 4096


class LearnedDensity:
    """A normalised density over rays: design points (x, y, z, azimuth, elevation, range) in metres and radians.

    It is the flow as the target thins it (`Thinning`), so the training scenes are made when it is first used.

    Arguments:
        run: The run folder.
        task: Its task.
        config: Its configuration.
    """

    def __init__(self, run: Path, task: Task, config: RunConfig) -> None:
        self._run, self._task, self._config = run, task, config

    @cached_property
    def _thinning(self) -> Thinning:
        _, state = load_arrays(self._run, FLOW)
        return Thinning(*(tuple(state[field.name]) for field in fields(Thinning)))

    @cached_property
    def _flow(self) -> LearnedFlow:
        target, _ = prepare_target(training_scenes(self._task, self._config), self._config)
        return load_flow(self._run, FLOW, self._config, target, self._config.seed)

    @property
    def space(self) -> DesignSpace:
        """The design space that it lives in."""
        return self._config.space

    def sample(self, count: int, seed: int | np.random.Generator = 0) -> np.ndarray:
        """Design points drawn from the density, shape (count, 6); the same seed gives the same points.

        Raises:
            DataError: The task's scenes have changed so much that nothing is left of the density.
        """
        self._flow.generator.manual_seed(int(np.random.default_rng(seed).integers(2**63)))
        kept = np.empty((0, 6))
        while len(kept) < count:
            drawn = draw_samples(self._flow, math.ceil(KEPT_AT_ONCE * math.exp(-self._thinning.log_kept)))
            points = self._thinning.thinned(drawn, self._flow.generator).points
            if not len(points):
                reason = "the task's training scenes differ from those that it was learned from"
                raise DataError(reason, where=str(self._run), hint="learn the run again")
            kept = np.concatenate([kept, points])
        return kept[:count]

    def log_prob(self, points: np.ndarray) -> np.ndarray:
        """The log density per chart volume of design points, (N, 6) to (N,); -inf outside the space.

        Raises:
            ConfigError: Points of another shape.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 6:
            raise ConfigError(f"points of shape {points.shape}", where="log_prob", allowed="(N, 6)")
        log_prob = log_density_of(self._flow, points)
        groups = condition_groups(self.space, points)
        return self._thinning.log_prob(log_prob, self._flow.target.log_density(points), groups)
