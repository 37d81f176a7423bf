"""The target density over thousands of moving frames: only the columns that matter at a point are evaluated.

log p*(d) is the sum over columns of `target.Target`, one per scene and frame, frames averaged within a scene. Here the
columns' targets are bodies in their own frames (`bodies`), and bounding boxes tell which columns can come within
`surface_tolerance_nats` (t) of the best surface term at a point. The others are left out of distance, visibility and
gradient alike, which lowers p* by less than columns * exp(-t) times the largest surface term there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.bodies import GROUP_COLUMNS, Bodies, collect_bodies
from lidardesign.density.fields.importance import BodyWeights, is_weighted, weigh
from lidardesign.density.target.target import PAIRS_AT_ONCE, Target
from lidardesign.density.visibility.occlusion import BodyRaycast, NoOcclusion, Pairs
from lidardesign.density.visibility.quadrature import Optics, RayBatch, RayGradient
from lidardesign.scene import Scene
from lidardesign.space import DesignSpace, observed_point

# Points at a time, fewer where there are more columns: should all of these matter, their pairs still fit in 300 MB.
ROWS_AT_ONCE = 2048
# Room for pairs is not touched before it is used; too little of it costs a second pass.
PAIRS_PER_ROW = 1024


@dataclass(frozen=True, eq=False)
class FramesTarget(Target):
    """The target of scenes whose targets are primitives or moving bodies.

    Arguments:
        field: The targets, sorted by column.
        visibility: How occlusion is computed.
        importance: How much their surfaces count; None: 1 everywhere.
    """

    field: Bodies
    visibility: BodyRaycast | NoOcclusion
    importance: BodyWeights | None = None

    @property
    def rows_at_once(self) -> int:
        """See `Target`."""
        return int(np.clip(PAIRS_AT_ONCE // self.field.columns, 64, ROWS_AT_ONCE))

    def drawn(self, columns: np.ndarray) -> FramesTarget:
        """See `Target`: an estimate of p* from some columns alone, weighted to stand for all of them."""
        share = np.log(self.field.columns / len(columns))
        field = self.field.take(columns)
        return replace(
            self,
            field=field,
            importance=None if self.importance is None else BodyWeights(field),
            visibility=self.visibility.take(columns),
            log_column_weights=self.log_column_weights[columns] + share,
        )

    def log_proximity(self, points: np.ndarray, sigma_m: float | None = None) -> np.ndarray:
        """log of the sum of surface terms at the scene points that design points (N, 6) observe, shape (N,)."""
        sigma_m = self.optics.sigma_m if sigma_m is None else sigma_m
        observed, values = observed_point(points), np.empty(len(points))
        for start in range(0, len(points), self.rows_at_once):
            rows = slice(start, min(start + self.rows_at_once, len(points)))
            pairs, surface = self._pairs(observed[rows], sigma_m)
            values[rows] = row_log_sums(surface, pairs)[0]
        return values

    def _pairs(self, observed: np.ndarray, sigma_m: float) -> tuple[Pairs, np.ndarray]:
        """The pairs that matter and their surface terms, shape (P,)."""
        if self.importance is None:
            pairs = near_pairs(self.field, observed, self.log_column_weights, sigma_m, self.surface_tolerance_nats)
            return pairs, self.log_column_weights[pairs.columns] - np.square(pairs.distances / sigma_m) / 2
        # bounds know the most that a column may count, and by how much it may count less
        weights, tolerance = self.log_column_weights + self.importance.column_peaks, self.surface_tolerance_nats
        pairs = near_pairs(self.field, observed, weights, sigma_m, tolerance + self.importance.spread)
        surface = self.log_column_weights[pairs.columns] - np.square(pairs.distances / sigma_m) / 2
        surface += self.importance.of_pairs(observed, pairs)
        best = np.maximum.reduceat(surface, pairs.row_starts[:-1])
        kept = surface >= best[pairs.rows] - tolerance
        return pairs.where(kept), surface[kept]

    def _evaluate(self, points: np.ndarray, optics: Optics, gradient: bool) -> tuple[np.ndarray, np.ndarray | None]:
        rays = RayBatch.of(points)
        observed = rays.observed
        pairs, surface = self._pairs(observed, optics.sigma_m)
        passed = self.visibility.blocked(rays, pairs, optics)
        values, shares = row_log_sums(surface + passed.log_values, pairs)
        if not gradient:
            return values, None
        by_point = self._surface_gradient(observed, pairs, -shares * pairs.distances / optics.sigma_m**2)
        if self.importance is not None:
            self.importance.add_pair_gradients(observed, pairs, shares, by_point)
        by_ray = RayGradient.zeros(len(points))
        passed.add_gradient(shares, by_ray)
        by_ray.add_by_point(by_point, rays)
        return values, self._by_chart(points, by_ray)

    def _surface_gradient(self, observed: np.ndarray, pairs: Pairs, weights: np.ndarray) -> np.ndarray:
        from lidardesign.density.fields import body_kernels

        out = np.empty_like(observed)
        body_kernels.add_gradients(*self.field.shapes, observed, pairs.row_starts, pairs.bodies, weights, out)
        return out


def build_frames_target(
    scenes: Sequence[Scene],
    space: DesignSpace,
    settings: DensitySettings,
    visibility: str,
    log_column_weights: np.ndarray,
    *,
    resolution: int,
    padding_m: float,
) -> FramesTarget:
    """The target of scenes whose targets are primitives or moving bodies; see `target.build_target`."""
    targets = collect_bodies(scenes, lambda body: body.is_target, resolution=resolution, padding_m=padding_m)
    importance = None
    if is_weighted(scenes):
        entries = [body for scene in scenes for _ in range(scene.frames) for body in scene.bodies if body.is_target]
        targets = weigh(targets, entries)
        importance = BodyWeights(targets)
    return FramesTarget(
        field=targets,
        visibility=NoOcclusion() if visibility == "off" else BodyRaycast.of(scenes),
        log_column_weights=log_column_weights,
        optics=Optics.of(settings),
        space=space,
        surface_tolerance_nats=settings.surface_tolerance_nats,
        importance=importance,
    )


def near_pairs(
    bodies: Bodies, points: np.ndarray, log_weights: np.ndarray, sigma_m: float, tolerance_nats: float
) -> Pairs:
    """Points (N, 3) with the columns whose surface term is within a tolerance of the best one there."""
    from lidardesign.density.fields import body_kernels

    points = np.ascontiguousarray(points, dtype=np.float64)
    row_starts = np.empty(len(points) + 1, dtype=np.int64)
    group_weights = np.maximum.reduceat(log_weights, np.arange(0, bodies.columns, GROUP_COLUMNS))
    room = max(min(PAIRS_PER_ROW, bodies.columns) * len(points), 1)
    while True:
        columns, nearest = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64)
        distances = np.empty(room)
        count = body_kernels.near_columns(
            *bodies.shapes, bodies.edges, bodies.starts, bodies.group_edges, GROUP_COLUMNS,
            points, log_weights, group_weights, 1.0 / sigma_m**2, tolerance_nats,
            row_starts, columns, distances, nearest,
        )  # fmt: skip
        if count <= room:
            return Pairs(row_starts, columns[:count], distances[:count], nearest[:count])
        room = count


def row_log_sums(terms: np.ndarray, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """log of the sum of exp(terms) of each row (N,), and the share of each pair in it (P,)."""
    starts = pairs.row_starts[:-1]
    counts = np.diff(pairs.row_starts)
    peak = np.maximum.reduceat(terms, starts)
    shares = np.exp(terms - np.repeat(peak, counts))
    total = np.add.reduceat(shares, starts)
    return peak + np.log(total), shares / np.repeat(total, counts)
