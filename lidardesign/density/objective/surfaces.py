"""The target surfaces of all columns, and which columns can matter at a scene point: everything of p* but visibility.

Two forms of one interface. `SceneTable` evaluates every column at every point: meshes at rest share a table in which
that costs next to nothing. `MovingFrames` are thousands of columns of bodies in their own frames: bounding boxes tell
which columns can come within a tolerance of the best surface term at a point, and only these are evaluated.

Both also draw design points that observe random surfaces, with the density of these draws:

- `SceneTable`: a point is drawn uniform in area on a random scene's targets, moved along the normal by a normal offset
  of the target's own sigma, and observed from a random origin. Its density per volume is q(s) = sum_i N(SDF_i(s);
  sigma) / A_i over the scenes, and r^2 q(s) per solid angle and range: exact for flat surfaces and off in first order
  of sigma times the curvature for others (on a ball of 15 sigma the rim weighs 14 % too little, which a pool for
  balancing and a coverage can bear). Weights p* / q are bounded by A / r^2, and unlike range errors along rays these
  proposals also reach the rim of silhouettes, where a ray passes a surface within sigma without meeting it.
- `MovingFrames`: scene points exactly in proportion to the sum of the bodies' surface terms, each observed from uniform
  origins. Weights p* / q are then the visible share over r^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.density.fields.bodies import GROUP_COLUMNS, Bodies, Pairs, occluding_bodies
from lidardesign.density.fields.distance import Field, body_kernels, scene_columns
from lidardesign.density.fields.importance import BodyWeights, LogWeights
from lidardesign.density.objective.visibility import BodyRaycast, Raycast, Visibility
from lidardesign.numerics import TINY, logsumexp
from lidardesign.scenes.scene import Scene
from lidardesign.scenes.surface import sample_body, target_area_m2
from lidardesign.space import ELEVATION, RANGE, DesignSpace, aim, observed_point

# Points times columns at a time: some ten arrays of so many float64 are in use at once.
PAIRS_AT_ONCE = 2**22
# Frames at a time, fewer where there are more columns: should all of these matter, their pairs still fit in 300 MB.
LEAST_ROWS, MOST_ROWS = 64, 2048
# Room for pairs is not touched before it is used; too little of it costs a second pass.
PAIRS_PER_ROW = 1024
# Scene points are proposed this far around bounding boxes; the surface term is below e^-12 beyond.
REACH_SIGMAS = 5.0
DRAWS_AT_ONCE = 262_144
# Bodies so thin beside their boxes that fewer draws than this share hit their surface are drawn in vain.
MOST_ROUNDS = 400
# Where less than this share of the first draws hits, only boxes as far as the space reaches are drawn from.
RICH_SHARE = 1e-4
# Few origins of a wide ceiling may see a point under the space's angles: each point is tried from several.
ORIGINS_PER_POINT = 4
AIMING_ROUNDS = 8
TERM_TOLERANCE_NATS = 16.0
PROPOSALS_AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class _NearTable:
    """The surface terms log w - d^2 / (2 sigma^2) at scene points, for the columns that matter there."""

    table: SceneTable
    observed: np.ndarray
    sigma_m: float
    distances: np.ndarray
    surface: np.ndarray
    columns: np.ndarray

    def log_sums(self, log_transmittance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """log p* at the points from log T of the columns, shape (N,), and the share of each term in it."""
        terms = np.where(self.columns, self.surface + log_transmittance, -np.inf)
        peak = terms.max(axis=1, keepdims=True)
        shares = np.exp(terms - peak)
        total = shares.sum(axis=1, keepdims=True)
        shares /= total
        return (peak + np.log(total))[:, 0], shares

    def gradient(self, shares: np.ndarray) -> np.ndarray:
        """The gradient of log p* by the points at fixed T, shape (N, 3)."""
        by_point = self.table.field.gradient(self.observed, -shares * self.distances / self.sigma_m**2)
        if self.table.importance is not None:
            by_point += self.table.importance.gradient(self.observed, shares)
        return by_point


@dataclass(frozen=True, eq=False)
class SceneTable:
    """Surfaces of which every column is evaluated at every point.

    Arguments:
        field: Distances to the targets.
        log_column_weights: log of the columns' own weights, shape (columns,).
        importance: How much the surfaces count; None: 1 everywhere.
    """

    field: Field
    log_column_weights: np.ndarray
    importance: LogWeights | None = None
    can_propose = True

    @property
    def rows_at_once(self) -> int:
        """The chunk size in points."""
        return max(PAIRS_AT_ONCE // len(self.log_column_weights), 1)

    @property
    def grid_steps_m(self) -> np.ndarray:
        """The grid steps of all meshes [m]."""
        return self.field.grid_steps_m

    def terms(self, observed: np.ndarray, distances: np.ndarray, sigma_m: float) -> np.ndarray:
        """log w - distance^2 / (2 sigma^2) at scene points (N, 3), shape (N, columns)."""
        terms = self.log_column_weights - np.square(distances / sigma_m) / 2
        return terms if self.importance is None else terms + self.importance.values(observed)

    def near(self, observed: np.ndarray, sigma_m: float, tolerance_nats: float) -> _NearTable:
        """Surface terms at scene points (N, 3); columns within a tolerance of the best one are a mask (N, columns)."""
        distances = self.field.distances(observed).astype(np.float64)
        surface = self.terms(observed, distances, sigma_m)
        best = surface.max(axis=1, keepdims=True, initial=-np.inf)
        return _NearTable(self, observed, sigma_m, distances, surface, surface >= best - tolerance_nats)

    def log_proximity(self, observed: np.ndarray, sigma_m: float, tolerance_nats: float) -> np.ndarray:
        """log of the sum of surface terms at scene points, (N, 3) to (N,), of all columns."""
        distances = self.field.distances(observed).astype(np.float64)
        return logsumexp(self.terms(observed, distances, sigma_m), axis=1)

    def subsample(self, columns: np.ndarray) -> SceneTable:
        """Some columns alone, weighted to stand for all; the others stay in the table without weight."""
        count = len(self.log_column_weights)
        weights = np.full(count, -np.inf)
        weights[columns] = self.log_column_weights[columns] + np.log(count / len(columns))
        return replace(self, log_column_weights=weights)

    def propose(
        self, scenes: Sequence[Scene], space: DesignSpace, count: int, sigma_m: float, generator: np.random.Generator
    ) -> np.ndarray:
        """Points (N, 6) inside the space, at most `count`."""
        columns = scene_columns(scenes)
        column = np.sort(generator.integers(len(columns), size=count))
        surface, normal = np.empty((count, 3)), np.empty((count, 3))
        for number in np.unique(column):
            rows = np.flatnonzero(column == number)
            index, frame = columns[number]
            targets = [body for body in scenes[index].bodies if body.is_target]
            drawn = sample_body(targets, space, len(rows), generator, frame)
            surface[rows], normal[rows] = drawn.points, self._normals(drawn.points, drawn.triangles, number)
        surface += generator.normal(scale=sigma_m, size=(count, 1)) * normal
        points = space.wrap(aim(space.sample(count, generator)[:, :3], surface))
        return points[space.contains(points) & (points[:, RANGE] > 0)]

    def log_proposal(
        self, scenes: Sequence[Scene], space: DesignSpace, points: np.ndarray, sigma_m: float
    ) -> np.ndarray:
        """log of the density of `propose` at points (N, 6) of the space, per chart volume up to a constant, (N,)."""
        columns = scene_columns(scenes)
        area_m2 = np.array([target_area_m2(scene, space) for scene in scenes])[[index for index, _ in columns]]
        distances = self.field.distances(observed_point(points)).astype(np.float64)
        log_density = logsumexp(-np.square(distances / sigma_m) / 2, axis=1, weights=1.0 / area_m2)
        return log_density + 2 * np.log(points[:, RANGE]) + log_chart_factor(space, points)

    def _normals(self, points: np.ndarray, triangles: np.ndarray, column: int) -> np.ndarray:
        """Unit normals of triangles, and of primitives, whose triangles are points, from the field's gradient."""
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        flat = length[:, 0] == 0
        if flat.any():
            weights = np.zeros((int(flat.sum()), self.field.columns))
            weights[:, column] = 1.0
            normal[flat] = self.field.gradient(points[flat], weights)
            length = np.linalg.norm(normal, axis=1, keepdims=True)
        return normal / np.where(length == 0, 1.0, length)


@dataclass(frozen=True, eq=False)
class _NearFrames:
    frames: MovingFrames
    observed: np.ndarray
    sigma_m: float
    columns: Pairs
    surface: np.ndarray

    def log_sums(self, log_transmittance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return row_log_sums(self.surface + log_transmittance, self.columns)

    def gradient(self, shares: np.ndarray) -> np.ndarray:
        pairs, by_point = self.columns, np.empty_like(self.observed)
        weights = -shares * pairs.distances / self.sigma_m**2
        body_kernels().add_gradients(
            self.frames.bodies.arrays, self.observed, pairs.row_starts, pairs.bodies, weights, by_point
        )
        if self.frames.importance is not None:
            self.frames.importance.add_pair_gradients(self.observed, pairs, shares, by_point)
        return by_point


@dataclass(frozen=True, eq=False)
class MovingFrames:
    """Primitives and moving bodies, of which only those columns are evaluated that matter; methods as of `SceneTable`.

    Arguments:
        bodies: The targets, sorted by column.
        log_column_weights: log of the columns' own weights, shape (columns,).
        importance: How much their surfaces count; None: 1 everywhere.
    """

    bodies: Bodies
    log_column_weights: np.ndarray
    importance: BodyWeights | None = None

    @property
    def rows_at_once(self) -> int:
        """See `SceneTable`."""
        return int(np.clip(PAIRS_AT_ONCE // self.bodies.columns, LEAST_ROWS, MOST_ROWS))

    @property
    def grid_steps_m(self) -> np.ndarray:
        """See `SceneTable`."""
        return self.bodies.grid_steps_m

    @property
    def can_propose(self) -> bool:
        """Whether `propose` can draw: planes have no end."""
        return bool(np.isfinite(self.bodies.low).all())

    def near(self, observed: np.ndarray, sigma_m: float, tolerance_nats: float) -> _NearFrames:
        """See `SceneTable`; columns are pairs."""
        weights, bound_nats = self.log_column_weights, tolerance_nats
        if self.importance is not None:
            # bounds know the most that a column may count, and by how much it may count less
            weights, bound_nats = weights + self.importance.column_peaks, bound_nats + self.importance.spread
        pairs = near_pairs(self.bodies, observed, weights, sigma_m, bound_nats)
        surface = self.log_column_weights[pairs.columns] - np.square(pairs.distances / sigma_m) / 2
        if self.importance is not None:
            surface += self.importance.of_pairs(observed, pairs)
            near = surface >= np.maximum.reduceat(surface, pairs.row_starts[:-1])[pairs.rows] - tolerance_nats
            pairs, surface = pairs.where(near), surface[near]
        return _NearFrames(self, observed, sigma_m, pairs, surface)

    def log_proximity(self, observed: np.ndarray, sigma_m: float, tolerance_nats: float) -> np.ndarray:
        """See `SceneTable`; of the columns that matter."""
        near = self.near(observed, sigma_m, tolerance_nats)
        return row_log_sums(near.surface, near.columns)[0]

    def subsample(self, columns: np.ndarray) -> MovingFrames:
        """See `SceneTable`; the others are taken away."""
        weights = self.log_column_weights[columns] + np.log(self.bodies.columns / len(columns))
        bodies = self.bodies.take(columns)
        return MovingFrames(bodies, weights, None if self.importance is None else BodyWeights(bodies))

    def propose(
        self, scenes: Sequence[Scene], space: DesignSpace, count: int, sigma_m: float, generator: np.random.Generator
    ) -> np.ndarray:
        """See `SceneTable`."""
        parts, missing = [], count
        reach_m = np.array(space.low[:3]) - space.high[RANGE], np.array(space.high[:3]) + space.high[RANGE]
        for _ in range(AIMING_ROUNDS):
            near = self.draw_near(missing, sigma_m, generator, reach_m)
            surface = np.repeat(near, ORIGINS_PER_POINT, axis=0)
            aimed = space.wrap(aim(space.sample(len(surface), generator)[:, :3], surface))
            parts.append(aimed[space.contains(aimed) & (aimed[:, RANGE] > 0)])
            # further draws would be as much in vain
            exhausted = len(near) < missing
            missing -= len(parts[-1])
            if missing <= 0 or exhausted:
                break
        return np.concatenate(parts)[:count]

    def log_proposal(
        self, scenes: Sequence[Scene], space: DesignSpace, points: np.ndarray, sigma_m: float
    ) -> np.ndarray:
        """See `SceneTable`."""
        # each body has a term of its own, also where several are in one column
        count, weights = len(self.bodies), self.log_column_weights[self.bodies.column]
        bodies = replace(self.bodies, column=np.arange(count), starts=np.arange(count + 1))
        observed, log_density = observed_point(points), np.empty(len(points))
        for start in range(0, len(points), PROPOSALS_AT_ONCE):
            rows = slice(start, min(start + PROPOSALS_AT_ONCE, len(points)))
            pairs = near_pairs(bodies, observed[rows], weights, sigma_m, TERM_TOLERANCE_NATS)
            terms = weights[pairs.columns] - np.square(pairs.distances / sigma_m) / 2
            log_density[rows] = row_log_sums(terms, pairs)[0]
        return log_density + 2 * np.log(points[:, RANGE]) + log_chart_factor(space, points)

    def draw_near(
        self,
        count: int,
        sigma_m: float,
        generator: np.random.Generator,
        reach_m: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Scene points (at most count, 3) whose density is the sum over bodies of weight * exp(-d^2 / (2 sigma^2)).

        Uniform points of the bodies' padded boxes, each box as often as its weight times its volume, are kept with the
        probability of their own body's term: no body's integral is needed.

        Arguments:
            count: How many, fewer where bodies are too thin.
            sigma_m: Standard deviation of the surface proximity [m].
            generator: Of all draws.
            reach_m: Corners of a box; of bodies much larger than it only points in there are drawn.
        """
        bodies = self.bodies
        low, high = bodies.low - REACH_SIGMAS * sigma_m, bodies.high + REACH_SIGMAS * sigma_m
        weights = np.exp(self.log_column_weights[bodies.column])
        cumulated = _cumulated(weights * (high - low).prod(axis=1))
        accepted: list[np.ndarray] = []
        for number in range(MOST_ROUNDS):
            if number == 1 and reach_m is not None and len(accepted[0]) < RICH_SHARE * DRAWS_AT_ONCE:
                low, high = np.maximum(low, reach_m[0]), np.minimum(high, reach_m[1])
                volume = np.maximum(high - low, 0.0).prod(axis=1)
                if not volume.any():
                    break
                cumulated = _cumulated(weights * volume)
            body = np.searchsorted(cumulated, generator.random(DRAWS_AT_ONCE), side="right").clip(max=len(bodies) - 1)
            points = generator.uniform(low[body], high[body])
            distances = np.empty(len(points))
            body_kernels().distances_of(bodies.arrays, body, points, distances)
            accepted.append(points[generator.random(len(points)) < np.exp(-np.square(distances / sigma_m) / 2)])
            if sum(map(len, accepted)) >= count:
                break
        return np.concatenate(accepted)[:count]


Surfaces = SceneTable | MovingFrames


def log_peak(surfaces: Surfaces) -> float:
    """An upper bound of the surface term of a single column."""
    importance = surfaces.importance
    return float(surfaces.log_column_weights.max()) + (0.0 if importance is None else importance.peak)


def raycast(surfaces: Surfaces, scenes: Sequence[Scene]) -> Visibility:
    """Ray casting at scenes, for columns as surfaces list them."""
    return BodyRaycast(occluding_bodies(scenes)) if isinstance(surfaces, MovingFrames) else Raycast(scenes)


def _cumulated(masses: np.ndarray) -> np.ndarray:
    return np.cumsum(masses / masses.sum())


def near_pairs(
    bodies: Bodies, points: np.ndarray, log_weights: np.ndarray, sigma_m: float, tolerance_nats: float
) -> Pairs:
    """Points (N, 3) with the columns whose surface term is within a tolerance of the best one there."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    row_starts = np.empty(len(points) + 1, dtype=np.int64)
    group_weights = np.maximum.reduceat(log_weights, np.arange(0, bodies.columns, GROUP_COLUMNS))
    room = max(min(PAIRS_PER_ROW, bodies.columns) * len(points), 1)
    while True:
        out = np.empty(room, dtype=np.int64), np.empty(room), np.empty(room, dtype=np.int64)
        count = body_kernels().near_columns(
            bodies.arrays, bodies.group_edges, points, log_weights, group_weights, 1.0 / sigma_m**2, tolerance_nats,
            row_starts, out,
        )  # fmt: skip
        if count <= room:
            return Pairs(row_starts, *(values[:count] for values in out))
        room = count


def row_log_sums(terms: np.ndarray, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """log of the sum of exp(terms) of each row (N,), and the share of each pair in it (P,)."""
    starts, counts = pairs.row_starts[:-1], np.diff(pairs.row_starts)
    peak = np.maximum.reduceat(terms, starts)
    shares = np.exp(terms - np.repeat(peak, counts))
    total = np.add.reduceat(shares, starts)
    return peak + np.log(total), shares / np.repeat(total, counts)


def log_chart_factor(space: DesignSpace, points: np.ndarray) -> np.ndarray | float:
    """log of solid angle per chart area at design points: 0 where the chart measures solid angle."""
    if space.measure == "solid_angle":
        return 0.0
    return np.log(np.maximum(np.cos(points[:, ELEVATION]), TINY))
