"""Training scenes as methods see them: their returns, and the gates that hold these."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, cached_property

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.numerics import wrap_turn
from lidardesign.problem.world import World
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.pattern import low_discrepancy
from lidardesign.space import AZIMUTH, ELEVATION, FULL_TURN, RANGE, DesignSpace, direction

RAY_AXES = 5  # x, y, z, azimuth, elevation: everything but the range

# Per scene and frame, over several axes or over one: the ends of the central 99 % then rest on a few rays in each.
DENSE_RAYS, DENSE_RAYS_ON_A_LINE = 4096, 256
MOST_VIEWS = 128  # scenes times frames that are looked at: evenly spread where there are more


FLATTEST_COSINE = 0.1  # a surface counts as seen no more flatly
# A gate without width receives nothing, since gates are open at their end. Ranges that never vary get the width
# of the default 100 ps bin around them.
SMALLEST_GATE_M = 0.015


def opened_gate(start_m: float | np.ndarray, end_m: float | np.ndarray) -> np.ndarray:
    """Gates that include both their ends, shape (..., 2) [m]; those without width get `SMALLEST_GATE_M`."""
    start, end = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    around = np.maximum(0.0, start - SMALLEST_GATE_M / 2)
    wide = end > start
    return np.stack(
        [np.where(wide, start, around), np.where(wide, np.nextafter(end, np.inf), around + SMALLEST_GATE_M)], axis=-1
    )


class ReturnTable:
    """Returns of each of M rays on targets in each of V views.

    Arguments:
        space: The design space, whose range all gates keep to.
        points: The rays (x, y, z, azimuth, elevation), shape (M, 5).
        range_m: Ranges of their returns, NaN where there is none, shape (V, M).
        cosine: Cosine of the angle between a ray and the surface's normal, shape (V, M).
    """

    def __init__(self, space: DesignSpace, points: np.ndarray, range_m: np.ndarray, cosine: np.ndarray) -> None:
        self.space, self.points, self.range_m, self.cosine = space, points, range_m, cosine
        self.returned = np.isfinite(range_m)

    @cached_property
    def share(self) -> np.ndarray:
        """The share of views in which each ray returns, shape (M,)."""
        return self.returned.mean(axis=0)

    @cached_property
    def area_m2_sr(self) -> np.ndarray:
        """The area of surface that a solid angle covers, averaged over a ray's returns; 0 without any, shape (M,)."""
        area = np.where(self.returned, self.range_m**2 / np.maximum(self.cosine, FLATTEST_COSINE), 0.0)
        return area.sum(axis=0) / np.maximum(self.returned.sum(axis=0), 1)

    @cached_property
    def sigma_m(self) -> float:
        """Spread of ranges along one ray from view to view: the median standard deviation [m]."""
        several = self.returned.sum(axis=0) > 1
        return float(np.median(np.nanstd(self.range_m[:, several], axis=0, ddof=1))) if several.any() else 0.0

    @cached_property
    def _ascending(self) -> tuple[np.ndarray, np.ndarray]:
        """All ranges in ascending order, and the rays that they are of."""
        ray, range_m = np.nonzero(self.returned)[1], self.range_m[self.returned]
        order = np.argsort(range_m, kind="stable")
        return range_m[order], ray[order]

    @cached_property
    def _scale(self) -> tuple[float, float]:
        """Units of directions and of origins in which each spans about 1."""
        looking = direction(self.points[:, AZIMUTH], self.points[:, ELEVATION])
        return tuple(float(np.ptp(part, axis=0).max()) or 1.0 for part in (looking, self.points[:, :3]))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(_features(self.points, self._scale))

    def nearest(self, points: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
        """The nearest of the table's rays, or of some (K,), to each of others (N, 5), shape (N,)."""
        asked = _features(points, self._scale)
        if among is None:
            return self._tree.query(asked)[1]
        return among[cKDTree(self._tree.data[among]).query(asked)[1]]

    def gates(self, points: np.ndarray, tail: float, margin_m: float) -> np.ndarray:
        """Gates of rays (N, 5) that hold the returns of the table's rays nearest to each of them, (N, 2) [m].

        Arguments:
            points: The rays.
            tail: The share of these returns that is left out at either end.
            margin_m: Margin at either end, within the space's range [m].
        """
        if not len(points):
            return np.zeros((0, 2))
        cell = cKDTree(_features(points, self._scale)).query(self._tree.data)[1]
        low, high = self._ends(cell, len(points), tail)
        empty = np.isnan(low)
        if empty.any():
            own = self.nearest(points[empty], np.flatnonzero(self.share > 0))
            low[empty], high[empty] = (end[own] for end in self._ends(np.arange(len(cell)), len(cell), tail))
        lowest, highest = self.space.low[RANGE], self.space.high[RANGE]
        return opened_gate(np.clip(low - margin_m, lowest, highest), np.clip(high + margin_m, lowest, highest))

    def _ends(self, cell: np.ndarray, count: int, tail: float) -> tuple[np.ndarray, np.ndarray]:
        """Low and high quantiles of the returns in each cell, rounded outwards; NaN without returns."""
        range_m, ray = self._ascending
        order = np.argsort(cell[ray], kind="stable")
        returns = np.bincount(cell[ray], minlength=count)
        first, last = np.cumsum(returns) - returns, returns - 1
        some = returns > 0
        low, high = np.full(count, np.nan), np.full(count, np.nan)
        low[some] = range_m[order[(first + np.floor(tail * last).astype(np.int64))[some]]]
        high[some] = range_m[order[(first + np.ceil((1.0 - tail) * last).astype(np.int64))[some]]]
        return low, high


def _features(points: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Scaled directions and origins, whose Euclidean distance compares rays, (N, 5) to (N, 6)."""
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    return np.column_stack([looking / scale[0], points[:, :3] / scale[1]])


class TrainingReturns:
    """The training scenes at up to `MOST_VIEWS` of their frames, evenly spread over scenes and time.

    Arguments:
        space: The design space.
        train: The training scenes.
    """

    def __init__(self, space: DesignSpace, train: Sequence[Scene]) -> None:
        self.space, self.train = space, train
        # traced once
        self.observed = cache(self._traced)

    @cached_property
    def casters(self) -> list[tuple[Scene, SceneCaster]]:
        """A caster per scene and frame, built once."""
        return [(self.train[i], SceneCaster(self.train[i], frame)) for i, frame in spread_frames(self.train)]

    def _traced(self, space: DesignSpace) -> np.ndarray:
        """Design points of dense rays over a part of the design space, even in its own measure, that return; (K, 6).

        Azimuths are unrolled to one arc.
        """
        axes = [i for i, dimension in enumerate(space.free) if dimension != RANGE]
        count = dense_rays(len(axes))
        unit = np.full((count, len(space.free)), -1.0)
        unit[:, axes] = 2 * low_discrepancy(count, len(axes)) - 1
        table = self.returns(space.from_unit(unit))
        view, ray = np.nonzero(table.returned)
        design = np.column_stack([table.points[ray], table.range_m[view, ray]])
        if self.space.full_azimuth:
            design[:, AZIMUTH] = unrolled(design[:, AZIMUTH])
        return design

    def returns(self, points: np.ndarray) -> ReturnTable:
        """Returns of rays (N, 5 or 6) on targets inside the space's range, ray by ray and view by view."""
        lowest, highest = whole_range(self.space)
        looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
        range_m = np.full((len(self.casters), len(points)), np.nan)
        cosine = np.zeros(range_m.shape)
        for view, (scene, caster) in enumerate(self.casters):
            found = caster.first_hit(points[:, :3], looking)
            target = np.array([*(body.is_target for body in scene.bodies), False])[found.body]
            seen = target & (found.range_m >= lowest) & (found.range_m < highest)
            range_m[view, seen] = found.range_m[seen]
            cosine[view] = np.abs(np.einsum("nk,nk->n", found.normal, looking))
        return ReturnTable(self.space, points[:, :RAY_AXES], range_m, cosine)


def spread_frames(scenes: Sequence[Scene], most: int = MOST_VIEWS) -> list[tuple[int, int]]:
    """All (scene, frame), or `most` of them evenly spread."""
    every = [(index, frame) for index, scene in enumerate(scenes) for frame in range(scene.frames)]
    if len(every) <= most:
        return every
    # the middles of equal shares: no scene's first frame is favoured
    return [every[int((i + 0.5) * len(every) / most)] for i in range(most)]


def dense_rays(axes: int) -> int:
    """The number of dense rays over this many axes."""
    return DENSE_RAYS if axes > 1 else DENSE_RAYS_ON_A_LINE


def unrolled(azimuth_rad: np.ndarray) -> np.ndarray:
    """Azimuths moved by whole turns onto one arc that starts behind the widest gap, shape (K,)."""
    if not len(azimuth_rad):
        return azimuth_rad
    turned = np.sort(wrap_turn(azimuth_rad))
    gaps = np.diff(np.append(turned, turned[0] + FULL_TURN))
    return wrap_turn(azimuth_rad, turned[(int(np.argmax(gaps)) + 1) % len(turned)])


def whole_range(space: DesignSpace) -> np.ndarray:
    """The gate over all of a space's range, shape (2,) [m]."""
    return opened_gate(space.low[RANGE], space.high[RANGE])


def returns_of(world: World) -> TrainingReturns:
    """The training scenes of a world, traced once for all methods."""
    return world.known("returns", lambda: TrainingReturns(world.space, world.learned))
