"""The target density over several ranks.

Scenes at rest are shared out: each rank holds the distance fields and occluders of every size-th scene, so memory and
building time fall with the number of ranks. Points of all ranks are gathered; each rank adds up its own columns; the
parts are combined by logsumexp. Which columns matter at a point depends on the best one, so the best surface terms are
compared over ranks first: all ranks together leave out what one process would leave out. A rank that no scene is left
for carries the first one with the weight zero.

Frames of moving scenes are poses of a few shapes: every rank holds all of them, and evaluates its own points alone.

log p* of a shared target is collective: all ranks ask for it, each at points of its own (any number of them).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import Field
from lidardesign.density.fields.importance import LogWeights
from lidardesign.density.ranks import ALONE, Ranks
from lidardesign.density.target.frames import FramesTarget
from lidardesign.density.target.refinement import refine_quadrature
from lidardesign.density.target.target import Target, build_target, is_of_frames, unusable
from lidardesign.density.visibility.quadrature import Optics, Quadrature, Visibility
from lidardesign.density.visibility.receiver import HeardVisibility, common_receiver
from lidardesign.errors import NumericalError
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
        return self.gathered(self.own.distances(points))

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """See `Field`."""
        return self.ranks.sum(self.own.gradient(points, self.mine(weights)))

    def gathered(self, own: np.ndarray) -> np.ndarray:
        """The values of all columns from those that this rank holds, (N, held columns) to (N, columns)."""
        found = np.empty((self.columns, len(own)))
        found[self.order] = self.ranks.gather(own.T[: len(self.owned)].astype(np.float64))
        return np.ascontiguousarray(found.T)

    def mine(self, weights: np.ndarray) -> np.ndarray:
        """The weights of the columns that this rank holds, 0 for one that it does not own: (N, held columns)."""
        own = np.zeros((len(weights), self.own.columns))
        own[:, : len(self.owned)] = weights[:, self.owned]
        return own


@dataclass(frozen=True, eq=False)
class GatheredWeights:
    """The log weights of all ranks' columns, in the order of one process: collective, for points that all share.

    Arguments:
        own: Those of this rank's columns.
        field: Who holds what.
    """

    own: LogWeights
    field: GatheredField

    @property
    def peak(self) -> float:
        """See `LogWeights`, of all ranks."""
        return float(self.field.ranks.max(np.array([self.own.peak]))[0])

    def values(self, points: np.ndarray) -> np.ndarray:
        """See `LogWeights`."""
        return self.field.gathered(self.own.values(points))

    def gradient(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """See `LogWeights`."""
        return self.field.ranks.sum(self.own.gradient(points, self.field.mine(weights)))


@dataclass(frozen=True, eq=False)
class OwnColumns(Target):
    """The columns of one rank: part of the sum that is p*, at points that all ranks share."""

    ranks: Ranks = ALONE

    def _best(self, surface: np.ndarray) -> np.ndarray:
        return self.ranks.max(super()._best(surface))

    def _log_sums(self, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = terms.max(axis=1, initial=-np.inf)
        # a rank without any term at a point has nothing to add there
        level = np.where(np.isfinite(own), own, 0.0)
        every = self.ranks.stacked(np.stack([own, np.exp(terms - level[:, None]).sum(axis=1)]))
        peak = every[:, 0].max(axis=0)
        values = peak + np.log((np.exp(every[:, 0] - peak) * every[:, 1]).sum(axis=0))
        return values, np.exp(terms - values[:, None])


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedTarget(Target):
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
        weights = _weights(whole.log_column_weights, self.owned, self.own.columns)
        return replace(whole, own=replace(self.own, log_column_weights=weights))

    def refined(self, probes: np.ndarray) -> tuple[SharedTarget, list[str]]:
        """With enough midpoints of its quadrature; see `refine_quadrature`."""

        def mean(values: np.ndarray) -> float:
            # a scene that is only carried is counted by its owner
            return self.ranks.mean(values if len(self.owned) else values[:0])

        own, notes = refine_quadrature(self.own, self.scenes, probes, mean)
        return replace(self, own=own, visibility=own.visibility, rows=_fewest(own.rows_at_once, self.ranks)), notes

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
class SharedFrames(FramesTarget):
    """A target of moving frames, of which every rank holds all and evaluates them at its own points.

    Arguments:
        ranks: Who evaluates the other points.
    """

    ranks: Ranks

    def _in_chunks(
        self, points: np.ndarray, sigma_m: float | None, gradient: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        # what one rank finds out about its points ends the step of all
        wrong = unusable(np.asarray(points, dtype=np.float64))
        if self.ranks.max(np.array([wrong is not None]))[0]:
            elsewhere = "design points are not finite, or their ranges negative, on another rank"
            raise NumericalError(wrong or elsewhere, where="target density")
        return super()._in_chunks(points, sigma_m, gradient)


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
        whole = build_target(scenes, space, settings, visibility)
        return SharedFrames(**{one.name: getattr(whole, one.name) for one in fields(FramesTarget)}, ranks=ranks)
    common_receiver(scenes)
    chosen = range(ranks.rank, len(scenes), ranks.size)
    mine = tuple(scenes[index] for index in chosen) or (scenes[0],)
    part = build_target(mine, space, settings, visibility, compiled=compiled, around=scenes)
    frames = [scene.frames for scene in scenes]
    columns, starts = sum(frames), np.cumsum([0, *frames])
    owned = np.concatenate([np.arange(0), *(np.arange(starts[i], starts[i + 1]) for i in chosen)])
    log_weights = -np.log(np.repeat(np.array(frames, dtype=np.float64), frames))
    return _shared(part, mine, owned, log_weights, columns, ranks)


def _with_thickest_shell(visibility: Visibility, ranks: Ranks) -> Visibility:
    """A quadrature whose margin clears the open surfaces of all ranks; other ways have no margin of the kind."""
    if isinstance(visibility, HeardVisibility):
        return HeardVisibility(_with_thickest_shell(visibility.one_way, ranks), visibility.receiver)
    if not isinstance(visibility, Quadrature):
        return visibility
    thickest_m = float(ranks.max(np.array([visibility.thickest_m]))[0])
    return Quadrature(visibility.field, visibility.points, thickest_m)


def _shared(
    part: Target, scenes: tuple[Scene, ...], owned: np.ndarray, log_weights: np.ndarray, columns: int, ranks: Ranks
) -> SharedTarget:
    common = {"optics": part.optics, "space": part.space, "surface_tolerance_nats": part.surface_tolerance_nats}
    weights = _weights(log_weights, owned, part.columns)
    visibility = _with_thickest_shell(part.visibility, ranks)
    own = OwnColumns(part.field, visibility, weights, ranks=ranks, importance=part.importance, **common)
    order, shell_m = ranks.gather(owned), np.zeros(columns)
    shell_m[order] = ranks.gather(part.field.shell_m[: len(owned)])
    field = GatheredField(part.field, columns, owned, order, shell_m, ranks)
    importance = None if part.importance is None else GatheredWeights(part.importance, field)
    return SharedTarget(
        field, visibility, log_weights, importance=importance,
        own=own, owned=owned, scenes=scenes, rows=_fewest(part.rows_at_once, ranks), ranks=ranks, **common,
    )  # fmt: skip
