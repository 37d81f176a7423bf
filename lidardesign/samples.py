"""Weighted samples of the learned density, which `fit` and `constrain` use in its place, and a verdict on its quality.

Learning mixes flow samples with independent points in the share that is most effective (`learn.mix_samples`). A rough
density costs designs little, as rays are chosen among candidates (benchmarks/verdicts.py measures it).
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from lidardesign.errors import DataError
from lidardesign.numerics import COARSE_SLACK, normalised_weights, systematic_draw
from lidardesign.run.arrays import guarded, read_npz
from lidardesign.run.clock import phase
from lidardesign.run.inputs import SAMPLES, parse_json
from lidardesign.run.manifest import verify, write_recorded
from lidardesign.space import DesignSpace

FILE_NAME = "samples.npz"
NUMBERS = ("points", "log_prob", "log_target")
DAMAGED_HINT = "learn the run again"
# Largest misplaced mass, largest KL [nats] and smallest ESS of a density with each verdict.
BOUNDS: dict[str, tuple[float, float, float]] = {"good": (0.25, 0.5, 0.2), "usable": (0.5, 2.0, 0.05)}
# Advice for a better density, by the preset that it was learned with.
NEXT = {"draft": "--preset standard learns longer", "standard": "--preset fine learns longer"}
LAST = "raise learning.steps and lower learning.misplaced; a smaller space or a larger density.sigma_m learns faster"


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a flow, or of its mixture with independent points, with both densities for importance weights.

    Arguments:
        points: Design points, shape (N, 6).
        log_prob: Logarithm of the density that they were drawn from, per chart volume, shape (N,).
        log_target: log p* at the points, unnormalised, shape (N,).
        space: The design space of both densities.

    Raises:
        DataError: Values that are not finite; log p* alone may be -inf.
    """

    points: np.ndarray
    log_prob: np.ndarray
    log_target: np.ndarray
    space: DesignSpace

    def __post_init__(self) -> None:
        numbers = np.isfinite(self.points).all() and np.isfinite(self.log_prob).all()
        if not (numbers and (self.log_target < np.inf).all()):
            raise DataError("holds values that are not finite", where="samples", hint=DAMAGED_HINT)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def log_weights(self) -> np.ndarray:
        """log p* - log p, the unclipped importance weights, shape (N,)."""
        return self.log_target - self.log_prob

    @cached_property
    def weights(self) -> np.ndarray:
        """Importance weights that sum to 1, shape (N,)."""
        try:
            return normalised_weights(self.log_weights)
        except ValueError:
            raise DataError("no sample of the run has a finite weight", hint="learn the run again") from None

    @property
    def effective_sample_size(self) -> float:
        """ESS = (sum w)^2 / (N sum w^2), a share of N between 0 and 1."""
        return float(1.0 / (len(self) * np.square(self.weights).sum()))

    @cached_property
    def independent(self) -> float:
        """Effective number of samples, with repeated points merged into one."""
        places = np.round(self.space.to_unit(self.points) / COARSE_SLACK)
        _, same = np.unique(places, axis=0, return_inverse=True)
        return float(1.0 / np.square(np.bincount(same.reshape(-1), self.weights)).sum())

    def subset(self, keep: np.ndarray | slice) -> Samples:
        """The samples at an index, a slice or a mask."""
        return Samples(self.points[keep], self.log_prob[keep], self.log_target[keep], self.space)

    def resample(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Design points drawn from p* by systematic importance resampling, shape (count, 6)."""
        return self.points[generator.permutation(systematic_draw(self.weights, count, generator))]


def save_samples(samples: Samples, run: Path) -> None:
    """Write the samples into a run folder, atomically, with their hash always in the manifest."""
    buffer = io.BytesIO()
    np.savez(
        buffer,
        points=samples.points,
        log_prob=samples.log_prob,
        log_target=samples.log_target,
        space=np.frombuffer(json.dumps(samples.space.as_dict()).encode(), dtype=np.uint8),
    )
    write_recorded(run, FILE_NAME, buffer.getvalue())


@phase("samples")
def load_samples(run: Path, expected: DesignSpace | None = None) -> Samples:
    """Read the samples of a run folder.

    Arguments:
        run: The folder.
        expected: The run's design space, to compare with; None: no comparison.

    Raises:
        DataError: The file is missing, damaged, of another design space, or holds values that are not finite.
    """
    verify(run, FILE_NAME)
    path = run / FILE_NAME
    arrays = read_npz(path, SAMPLES, hint=DAMAGED_HINT)
    missing = [name for name in (*NUMBERS, "space") if name not in arrays]
    if missing:
        raise DataError(f"has no {', '.join(missing)}", where=str(path), hint=DAMAGED_HINT)
    points, log_prob, log_target = (arrays[name] for name in NUMBERS)
    count = len(points) if points.ndim else 0
    for array, shape in ((points, (count, 6)), (log_prob, (count,)), (log_target, (count,))):
        if array.shape != shape or array.dtype != np.float64 or not count:
            raise DataError(
                f"holds an array of {array.dtype} of shape {array.shape}",
                where=str(path),
                allowed=f"float64 of shape {shape}",
                hint=DAMAGED_HINT,
            )
    space = guarded(lambda: DesignSpace.from_dict(parse_json(arrays["space"].tobytes())), path, DAMAGED_HINT)
    if expected is not None and space != expected:
        own, theirs = space.as_dict(), expected.as_dict()
        name = next(name for name in own if own[name] != theirs[name])
        found = f"belong to another design space: {name} {own[name]}"
        raise DataError(found, where=str(path), allowed=f"{name} {theirs[name]}, as the run", hint=DAMAGED_HINT)
    try:
        samples = Samples(points, log_prob, log_target, space)
    except DataError as error:
        raise DataError(error.message, where=str(path), hint=error.hint) from None
    outside = int((~space.contains(points)).sum())
    if outside:
        raise DataError(f"has {outside} of {count} points outside its design space", where=str(path), hint=DAMAGED_HINT)
    return samples


@dataclass(frozen=True)
class Verdict:
    """Quality of a learned density.

    Arguments:
        word: good, usable or poor.
        why: The first figure beyond the bound of a better verdict, and that bound; empty where it is good.
    """

    word: Literal["good", "usable", "poor"]
    why: str = ""

    @classmethod
    def of(cls, misplaced: float, kl_nats: float, ess: float) -> Verdict:
        """The verdict on a density with these figures."""
        reasons = {}
        for word, (most_misplaced, most_nats, least_ess) in BOUNDS.items():
            beyond = (
                (misplaced > most_misplaced, f"{misplaced:.2g} of its mass is in the wrong place", most_misplaced),
                (kl_nats > most_nats, f"KL is {kl_nats:.2g} nats", most_nats),
                (ess < least_ess, f"ESS is {ess:.2g}", least_ess),
            )
            reasons[word] = [f"{found} ({word}: {bound:g})" for wrong, found, bound in beyond if wrong]
        if not reasons["good"]:
            return cls("good")
        return cls("poor", reasons["usable"][0]) if reasons["usable"] else cls("usable", reasons["good"][0])

    def text(self, preset: str) -> str:
        """The verdict in a line, with advice for a density that was learned with a preset."""
        return f"{self.word}: {self.advice(preset)}" if self.why else self.word

    def advice(self, preset: str) -> str:
        """Reason for the verdict, and advice for a better density."""
        return f"{self.why}; {NEXT.get(preset, LAST)}"
