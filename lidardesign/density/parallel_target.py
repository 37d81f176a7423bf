"""The target density with its columns shared out over ranks.

Each rank holds the distance fields and occluders of its own columns (of every size-th scene, or frame of moving
scenes), so memory and building time fall with the number of ranks. Points of all ranks are gathered; each rank adds up
its own columns; the parts are combined by logsumexp. Which columns matter at a point depends on the best one, so the
best surface terms are compared over ranks first: all ranks together leave out what one process would leave out.

log p* of a shared target is collective: all ranks ask for it, each at points of its own (any number of them). A rank
that no column is left for carries the first one with the weight zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.density.fields import Field
from lidardesign.density.frames import FramesTarget
from lidardesign.density.occlusion import Pairs
from lidardesign.density.parallel import ALONE, Ranks
from lidardesign.density.receiver import common_receiver
from lidardesign.density.refinement import refine_quadrature
from lidardesign.density.settings import DensitySettings
from lidardesign.density.target import Target, build_target, is_of_frames
from lidardesign.density.visibility import Optics
from lidardesign.scene import Scene
from lidardesign.space import DesignSpace


@dataclass(frozen=True, eq=False)
class GatheredField:
    """The distances of all ranks' columns, in the order of one process: collective, for points that all ranks share.

    Arguments:
        own: The field of this rank's columns.
        columns: The number of columns of all ranks.
        owned: Which of them are this rank's.
        order: Which of them all ranks hold, rank by rank.
        shell_m: See `Field`, of all columns.
        ranks: Who holds the others.
    """

    own: Field
    columns: int
    owned: np.ndarray
    order: np.ndarray
    shell_m: np.ndarray
    ranks: Ranks

    def distances(self, points: np.ndarray) -> np.ndarray:
        """See `Field`."""
        found = np.empty((self.columns, len(points)))
        own = self.own.distances(points).T[: len(self.owned)]
        found[self.order] = self.ranks.gather(own.astype(np.float64))
        return np.ascontiguousarray(found.T)

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """See `Field`."""
        own = np.zeros((len(points), self.own.columns))
        own[:, : len(self.owned)] = weights[:, self.owned]
        return self.ranks.sum(self.own.gradient(points, own))


@dataclass(frozen=True, eq=False)
class OwnColumns(Target):
    """The columns of one rank: part of the sum that is p*, at points that all ranks share."""

    ranks: Ranks = ALONE

    def _best(self, surface: np.ndarray) -> np.ndarray:
        return self.ranks.max(super()._best(surface))

    def _log_sums(self, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        peak = terms.max(axis=1, keepdims=True, initial=-np.inf)
        peak = self.ranks.max(peak)
        shares = np.exp(terms - peak)
        total = self.ranks.sum(shares.sum(axis=1, keepdims=True))
        return (peak + np.log(total))[:, 0], shares / total


@dataclass(frozen=True, eq=False)
class OwnFrames(FramesTarget):
    """The frames of one rank: part of the sum that is p*, at points that all ranks share."""

    ranks: Ranks = ALONE

    def _pairs(self, observed: np.ndarray, sigma_m: float) -> Pairs:
        """Of the columns that matter among this rank's, those that matter among all."""
        pairs = super()._pairs(observed, sigma_m)
        surface = self.log_column_weights[pairs.columns] - np.square(pairs.distances / sigma_m) / 2
        best = self.ranks.max(_row_largest(surface, pairs))
        kept = surface >= best[pairs.rows] - self.surface_tolerance_nats
        ends = np.concatenate([[0], np.cumsum(kept)])[pairs.row_starts]
        return Pairs(ends, pairs.columns[kept], pairs.distances[kept], pairs.bodies[kept])

    def _row_sums(self, terms: np.ndarray, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
        peak = self.ranks.max(_row_largest(terms, pairs))
        shares, rows = np.exp(terms - peak[pairs.rows]), pairs.rows
        total = self.ranks.sum(np.bincount(rows, shares, minlength=len(peak)))
        return peak + np.log(total), shares / total[rows]


def _row_largest(values: np.ndarray, pairs: Pairs) -> np.ndarray:
    """The largest value of each row's pairs, shape (N,); -inf for a row without any."""
    largest = np.full(len(pairs.row_starts) - 1, -np.inf)
    held = np.flatnonzero(np.diff(pairs.row_starts))
    if len(held):
        largest[held] = np.maximum.reduceat(values, pairs.row_starts[held])
    return largest


class _OverRanks:
    """Points of all ranks, evaluated by each in its own columns."""

    own: Target
    ranks: Ranks

    def _in_chunks(
        self, points: np.ndarray, sigma_m: float | None, gradient: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        every, mine = self.ranks.gathered(np.asarray(points, dtype=np.float64))
        values, gradients = super()._in_chunks(every, sigma_m, gradient)
        return values[mine], gradients[mine]

    def _evaluate(self, points: np.ndarray, optics: Optics, gradient: bool) -> tuple[np.ndarray, np.ndarray | None]:
        values, by_chart = self.own._evaluate(points, optics, gradient)
        return values, None if by_chart is None else self.ranks.sum(by_chart)


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedTarget(_OverRanks, Target):
    """A target whose scenes are shared out over ranks.

    Arguments:
        own: The columns of this rank.
        owned: Which of all columns these are; empty for a rank that only carries the first one.
        scenes: The scenes of this rank.
        rows: How many points keep the memory of every rank bounded.
        ranks: Who has the others.
    """

    own: OwnColumns
    owned: np.ndarray
    scenes: tuple[Scene, ...]
    rows: int
    ranks: Ranks

    @property
    def rows_at_once(self) -> int:
        """See `Target`; the same on all ranks."""
        return self.rows

    def drawn(self, columns: np.ndarray) -> SharedTarget:
        """See `Target`."""
        whole = super().drawn(columns)
        if whole is self:
            return self
        weights = _weights(whole.log_column_weights, self.owned, self.own.columns)
        return replace(whole, own=replace(self.own, log_column_weights=weights))

    def refined(self, probes: np.ndarray) -> tuple[SharedTarget, list[str]]:
        """With enough midpoints of its quadrature; see `refine_quadrature`."""
        own, notes = refine_quadrature(self.own, self.scenes, probes, self.ranks.mean)
        return replace(self, own=own, visibility=own.visibility, rows=_fewest(own.rows_at_once, self.ranks)), notes


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedFrames(_OverRanks, FramesTarget):
    """A target of moving frames that are shared out over ranks; proposals know all bodies, which are poses only.

    Arguments:
        own: The columns of this rank.
        ranks: Who has the others.
    """

    own: OwnFrames
    ranks: Ranks

    @classmethod
    def of(cls, target: FramesTarget, ranks: Ranks) -> SharedFrames:
        """A target shared out: every size-th column."""
        owned = np.arange(ranks.rank, target.columns, ranks.size)
        held = owned if len(owned) else np.zeros(1, dtype=np.int64)
        common = {"optics": target.optics, "space": target.space}
        common["surface_tolerance_nats"] = target.surface_tolerance_nats
        weights = _weights(target.log_column_weights, owned, len(held))
        own = OwnFrames(target.field.take(held), target.visibility.take(held), weights, ranks=ranks, **common)
        return cls(target.field, target.visibility, target.log_column_weights, own=own, ranks=ranks, **common)

    def drawn(self, columns: np.ndarray) -> SharedFrames:
        """See `Target`."""
        return SharedFrames.of(super().drawn(columns), self.ranks)


def _weights(log_weights: np.ndarray, owned: np.ndarray, held: int) -> np.ndarray:
    """The weights of a rank's columns: -inf for those that it carries without owning them, shape (held,)."""
    own = np.full(held, -np.inf)
    own[: len(owned)] = log_weights[owned]
    return own


def _fewest(rows: int, ranks: Ranks) -> int:
    return int(-ranks.max(np.array([-rows]))[0])


def build_shared_target(
    scenes: Sequence[Scene],
    space: DesignSpace,
    settings: DensitySettings,
    visibility: str,
    ranks: Ranks,
    *,
    compiled: bool = True,
) -> Target:
    """The target of scenes, each rank's own part of it; see `target.build_target`.

    Raises:
        ConfigError: See `target.build_target`.
    """
    if ranks.size == 1:
        return build_target(scenes, space, settings, visibility, compiled=compiled)
    if is_of_frames(scenes, visibility):
        return SharedFrames.of(build_target(scenes, space, settings, visibility), ranks)
    common_receiver(scenes)
    chosen = range(ranks.rank, len(scenes), ranks.size)
    mine = tuple(scenes[index] for index in chosen) or (scenes[0],)
    part = build_target(mine, space, settings, visibility, compiled=compiled, around=scenes)
    frames = [scene.frames for scene in scenes]
    columns, starts = sum(frames), np.cumsum([0, *frames])
    owned = np.concatenate([np.arange(0), *(np.arange(starts[i], starts[i + 1]) for i in chosen)])
    log_weights = -np.log(np.repeat(np.array(frames, dtype=np.float64), frames))
    return _shared(part, mine, owned, log_weights, columns, ranks)


def _shared(
    part: Target, scenes: tuple[Scene, ...], owned: np.ndarray, log_weights: np.ndarray, columns: int, ranks: Ranks
) -> SharedTarget:
    common = {"optics": part.optics, "space": part.space, "surface_tolerance_nats": part.surface_tolerance_nats}
    weights = _weights(log_weights, owned, part.columns)
    own = OwnColumns(part.field, part.visibility, weights, ranks=ranks, **common)
    order, shell_m = ranks.gather(owned), np.zeros(columns)
    shell_m[order] = ranks.gather(part.field.shell_m[: len(owned)])
    return SharedTarget(
        GatheredField(part.field, columns, owned, order, shell_m, ranks), part.visibility, log_weights,
        own=own, owned=owned, scenes=scenes, rows=_fewest(part.rows_at_once, ranks), ranks=ranks, **common,
    )  # fmt: skip
