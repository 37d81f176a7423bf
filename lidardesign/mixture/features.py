r"""Design points as the arrays that expectation maximisation runs on.

Linear features hold the free origin axes y_1..y_m and the range y_r, centred and scaled:
$\Phi = [1,\; y_i,\; y_r,\; y_i y_j (i \le j),\; y_r^2]$, so that every Gaussian exponent in them is one
matrix product, and so are all their sufficient statistics. Directions are unit vectors.

Axes that the space fixes are left out of the density, not given a tiny variance. Where only the azimuth is
free, directions become unit vectors on the equator (a great circle, where tangent coordinates are exact) and
angles scale by the cosine of the fixed elevation; where only the elevation is free, on the meridian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.numerics import SLACK, safe_divide
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction, observed_point

# Below this cosine of a fixed elevation the azimuth turns the ray about itself: it is no freedom there.
POLE_COSINE = SLACK
# A free axis on which the data do not vary is scaled by this share of its bounds: nothing divides by 0.
IDLE_AXIS_SHARE = 1e-3
# The mean range of like rays is over so many of so many samples: one in three hundred of the density.
NEIGHBOURS = 16
NEIGHBOUR_POOL = 5000


@dataclass(frozen=True)
class Axes:
    """Which factors of a component are random.

    Arguments:
        origin: Free origin axes, of 0, 1, 2.
        horizontal, vertical: Whether the direction varies along azimuth and elevation.
        range: Whether the range varies.
        azimuth_rad, elevation_rad: The direction, where it is fixed.
        angle_scale: True angle per internal horizontal angle: the cosine of a fixed elevation, otherwise 1.
    """

    origin: tuple[int, ...]
    horizontal: bool
    vertical: bool
    range: bool
    azimuth_rad: float = 0.0
    elevation_rad: float = 0.0
    angle_scale: float = 1.0

    @property
    def angular(self) -> int:
        """The number of free angles: 0, 1 or 2."""
        return int(self.horizontal) + int(self.vertical)

    @property
    def linear(self) -> int:
        """The number of free linear dimensions: origin axes and range."""
        return len(self.origin) + int(self.range)

    @classmethod
    def of(cls, space: DesignSpace, pinned: tuple[float | None, ...] = (None, None, None)) -> Axes:
        """The axes of a space with some origin coordinates pinned."""
        free = space.free
        cosine = 1.0 if ELEVATION in free else math.cos(space.low[ELEVATION])
        return cls(
            origin=tuple(i for i in range(3) if i in free and pinned[i] is None),
            horizontal=AZIMUTH in free and cosine > POLE_COSINE,
            vertical=ELEVATION in free,
            range=RANGE in free,
            azimuth_rad=space.low[AZIMUTH],
            elevation_rad=space.low[ELEVATION],
            angle_scale=cosine if cosine > POLE_COSINE else 1.0,
        )

    def directions(self, points: np.ndarray) -> np.ndarray:
        """Internal unit vectors, (N, 6) to (N, 3): true ones where both angles are free."""
        azimuth = points[:, AZIMUTH] if self.horizontal else np.zeros(len(points))
        elevation = points[:, ELEVATION] if self.vertical else np.zeros(len(points))
        return direction(azimuth, elevation)


@dataclass(frozen=True, eq=False)
class Features:
    """Weighted design points, prepared once per fit.

    Arguments:
        points: Design points, shape (N, 6).
        weights: Non-negative, summing to 1, shape (N,).
        axes: Which dimensions are random.
        centre, scale: Origin of the linear coordinates and their unit [m], shape (m,).
    """

    points: np.ndarray
    weights: np.ndarray
    axes: Axes
    centre: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, weights: np.ndarray, axes: Axes, space: DesignSpace) -> Features:
        """Features of points with weights that need not sum to 1; scaled by the points' own spread."""
        weights = np.asarray(weights, dtype=np.float64) / np.sum(weights)
        columns = [*axes.origin, *([RANGE] if axes.range else [])]
        linear = points[:, columns]
        centre = weights @ linear
        spread = np.sqrt(weights @ np.square(linear - centre))
        extent = np.array(space.high)[columns] - np.array(space.low)[columns]
        return cls(points, weights, axes, centre, np.maximum(spread, IDLE_AXIS_SHARE * extent))

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def linear(self) -> np.ndarray:
        """Free origin coordinates and range, scaled, shape (m, N)."""
        columns = [*self.axes.origin, *([RANGE] if self.axes.range else [])]
        return np.ascontiguousarray(((self.points[:, columns] - self.centre) / self.scale).T)

    @cached_property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Index pairs of the quadratic features: all origin axes with each other, the range with itself."""
        count = len(self.axes.origin)
        origin = [(i, j) for i in range(count) for j in range(i, count)]
        return (*origin, *([(count, count)] if self.axes.range else []))

    @cached_property
    def phi(self) -> np.ndarray:
        """The features Phi, shape (F, N)."""
        quadratic = [self.linear[i] * self.linear[j] for i, j in self.pairs]
        return np.ascontiguousarray(
            np.concatenate([np.ones((1, len(self))), self.linear, *(q[None] for q in quadratic)])
        )

    @cached_property
    def directions(self) -> np.ndarray:
        """Internal unit vectors, shape (3, N)."""
        return np.ascontiguousarray(self.axes.directions(self.points).T)

    @cached_property
    def angular_scale(self) -> float:
        """Root mean square angle of the directions from their mean, at most 1 rad and never 0 [rad]."""
        resultant = float(np.linalg.norm(self.directions @ self.weights))
        return min(max(math.sqrt(max(2 * (1 - resultant), 0.0)), IDLE_AXIS_SHARE), 1.0)

    @cached_property
    def embedding(self) -> np.ndarray:
        """Scaled linear coordinates and directions, whose Euclidean distance seeds components, (N, m + 3)."""
        return np.concatenate([self.linear, self.directions / self.angular_scale]).T

    def subset(self, keep: np.ndarray) -> Features:
        """The points at an index or mask, with weights scaled to sum to 1 and the same units."""
        weights = self.weights[keep]
        return Features(self.points[keep], weights / weights.sum(), self.axes, self.centre, self.scale)


def ray_features(features: Features) -> np.ndarray:
    """What rays look at, however far their scene points are, shape (N, F): coordinates in which like rays are near.

    Directions where origins are given, else points of the mean surface.
    """
    from scipy.spatial import cKDTree

    aiming = features.embedding
    if features.axes.range:
        aiming = np.delete(aiming, len(features.axes.origin), axis=1)
    if not features.axes.origin:
        return np.ascontiguousarray(aiming)
    tree = cKDTree(aiming[:NEIGHBOUR_POOL])
    near = tree.query(aiming, k=min(NEIGHBOURS, len(aiming)))[1].reshape(len(aiming), -1)
    share = features.weights[near]
    points = features.points.copy()
    # far from all of the density neighbours weigh nothing together, and there is no mean
    total = share.sum(axis=1)
    mean = safe_divide((share * points[near, RANGE]).sum(axis=1), total)
    points[:, RANGE] = np.where(total > 0, mean, points[:, RANGE])
    return observed_point(points)
