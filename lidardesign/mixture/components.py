r"""Mixtures of sensors on the sphere: density, responsibilities and sufficient statistics in one pass.

A component is $q(d) = N(x)\, N_2(u)\, \frac{t}{\sin t}\, N(r)$: origin with its full covariance, tangent
coordinates u of the direction at the angle t = |u| from the boresight, range. With unit axes f, h, v of the
boresight and $g(t) = t / \sin t$ the coordinates are $u = g\,(h \cdot d, v \cdot d)$, so one matrix product
per block of samples gives all cosines, and g multiplies after the exponential: no logarithm of it is needed.

Linear features of the design points hold the free origin axes y_1..y_m and the range y_r, centred and scaled:
$\Phi = [1,\; y_i,\; y_r,\; y_i y_j (i \le j),\; y_r^2]$, so that every Gaussian exponent in them is one
matrix product, and so are all their sufficient statistics. Directions are unit vectors.

Axes that the space fixes are left out of the density, not given a tiny variance. Where only the azimuth is
free, directions become unit vectors on the equator (a great circle, where tangent coordinates are exact) and
angles scale by the cosine of the fixed elevation; where only the elevation is free, on the meridian.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.numerics import ROUNDING, SLACK, wrap_angle
from lidardesign.sensors.sensor import boresight_frame
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction

# Samples per block: arrays of 10 components then stay inside a core's second-level cache (measured).
BLOCK = 2048
# Cosines are kept this far from +-1: at +1 t / sin t differs from its limit 1 by 3e-13, and at the antipode,
# where it diverges, it stays finite.
COSINE_MARGIN = ROUNDING
# A component without samples keeps this weight, so that its logarithm stays finite.
SMALLEST_WEIGHT = ROUNDING
LOG_TWO_PI = math.log(2 * math.pi)
# Below this cosine of a fixed elevation the azimuth turns the ray about itself: it is no freedom there.
POLE_COSINE = SLACK
# A free axis on which the data do not vary is scaled by this share of its bounds: nothing divides by 0.
IDLE_AXIS_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Mixture:
    """Parameters of K components, one row each.

    Arguments:
        weights: Shares, summing to 1, shape (K,).
        origin_m: Mean origins, shape (K, 3).
        origin_covariance_m2: Shape (K, 3, 3); only its free axes are read.
        azimuth_rad, elevation_rad, roll_rad: Internal boresights (see `features`), shape (K,).
        spread_rad: Horizontal and vertical standard deviations, internal angles, shape (K, 2).
        range_m, spread_range_m: Mean and standard deviation of the range, shape (K,).
    """

    weights: np.ndarray
    origin_m: np.ndarray
    origin_covariance_m2: np.ndarray
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray
    roll_rad: np.ndarray
    spread_rad: np.ndarray
    range_m: np.ndarray
    spread_range_m: np.ndarray

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def frames(self) -> np.ndarray:
        """Rows forward, horizontal, vertical of each boresight, roll included, shape (K, 3, 3)."""
        return boresight_frame(self.azimuth_rad, self.elevation_rad, self.roll_rad)


@dataclass(frozen=True, eq=False)
class Statistics:
    """Expected sufficient statistics of the components, for the M-step.

    Arguments:
        log_likelihood: Weighted mean log density of the samples.
        mass: Expected share of the samples, shape (K,).
        phi: Expected sums of the linear features, shape (K, F).
        tangent: Expected sums of 1, u_h, u_v times u_h, u_v: shape (K, 2, 3) [rad, rad^2], in rolled axes.
    """

    log_likelihood: float
    mass: np.ndarray
    phi: np.ndarray
    tangent: np.ndarray


def angle_ratio(cosine: np.ndarray, out: np.ndarray, work: np.ndarray) -> np.ndarray:
    """t / sin t of cos t, into `out`; overwrites `cosine` and `work`, all of one shape."""
    np.clip(cosine, COSINE_MARGIN - 1.0, 1.0 - COSINE_MARGIN, out=cosine)
    np.arccos(cosine, out=out)
    # (1 - c)(1 + c) keeps the digits that 1 - c^2 loses near the boresight
    np.subtract(1.0, cosine, out=work)
    cosine += 1.0
    work *= cosine
    np.sqrt(work, out=work)
    out /= work
    return out


def linear_coefficients(mixture: Mixture, features: Features) -> np.ndarray:
    """Rows that turn the features Phi into log weight + log N(x) + log N(r) + angular constants, (K, F)."""
    axes, count = features.axes, len(features.axes.origin)
    constant = np.log(np.maximum(mixture.weights, SMALLEST_WEIGHT)) - 0.5 * LOG_TWO_PI * (axes.linear + axes.angular)
    linear = np.zeros((len(mixture), axes.linear))
    quadratic = np.zeros((len(mixture), len(features.pairs)))
    if count:
        constant = constant + _origin_coefficients(mixture, features, linear, quadratic)
    if axes.range:
        mean = (mixture.range_m - features.centre[-1]) / features.scale[-1]
        precision = np.square(features.scale[-1] / mixture.spread_range_m)
        linear[:, -1], quadratic[:, -1] = precision * mean, -0.5 * precision
        constant = constant - 0.5 * precision * np.square(mean) - np.log(mixture.spread_range_m)
    for axis, used in enumerate((axes.horizontal, axes.vertical)):
        if used:
            constant = constant - np.log(mixture.spread_rad[:, axis])
    return np.concatenate([constant[:, None], linear, quadratic], axis=1)


def _origin_coefficients(mixture: Mixture, features: Features, linear: np.ndarray, quadratic: np.ndarray) -> np.ndarray:
    axes = list(features.axes.origin)
    count = len(axes)
    scale = features.scale[:count]
    mean = (mixture.origin_m[:, axes] - features.centre[:count]) / scale
    covariance = mixture.origin_covariance_m2[:, axes][:, :, axes]
    precision = np.linalg.inv(covariance / (scale[:, None] * scale))
    weighted = np.einsum("kij,kj->ki", precision, mean)
    linear[:, :count] = weighted
    for column, (i, j) in enumerate(features.pairs[: count * (count + 1) // 2]):
        quadratic[:, column] = -0.5 * precision[:, i, j] * (1 if i == j else 2)
    return -0.5 * np.einsum("ki,ki->k", weighted, mean) - 0.5 * np.linalg.slogdet(covariance)[1]


def angular_rows(mixture: Mixture, axes: Axes) -> np.ndarray:
    """Rows forward, horizontal / (sqrt 2 sigma_h), vertical / (sqrt 2 sigma_v), (3, K, 3); 0 where fixed."""
    rows = np.ascontiguousarray(np.moveaxis(mixture.frames, 1, 0))
    for axis, used in enumerate((axes.horizontal, axes.vertical)):
        rows[axis + 1] *= (1.0 / (math.sqrt(2.0) * mixture.spread_rad[:, axis]))[:, None] if used else 0.0
    return rows


_Evaluated = tuple[slice, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _evaluated(mixture: Mixture, features: Features) -> Iterator[_Evaluated]:
    """Log joint densities of blocks of samples, in arrays that the next block overwrites.

    Each block with its exponents without t / sin t, that ratio, and scaled tangent coordinates h, v, (K, n) each.
    """
    count, total = len(mixture), len(features)
    coefficients = linear_coefficients(mixture, features)
    rows = angular_rows(mixture, features.axes).reshape(3 * count, 3)
    buffer = np.empty(6 * count * min(BLOCK, total))
    for start in range(0, total, BLOCK):
        part = slice(start, min(start + BLOCK, total))
        width = part.stop - start
        arrays = buffer[: 6 * count * width].reshape(6, count, width)
        forward, horizontal, vertical, exponent, ratio, work = arrays
        np.matmul(coefficients, features.phi[:, part], out=exponent)
        if features.axes.angular:
            np.matmul(rows, features.directions[:, part], out=arrays[:3].reshape(3 * count, width))
            angle_ratio(forward, ratio, work)
            for tangent in (horizontal, vertical):
                tangent *= ratio
                np.multiply(tangent, tangent, out=work)
                exponent -= work
        yield part, exponent, ratio, horizontal, vertical


def expect(mixture: Mixture, features: Features) -> Statistics:
    """The E-step: log-likelihood and expected sufficient statistics of weighted samples, in log space."""
    count, axes = len(mixture), features.axes
    phi = np.zeros((count, len(features.phi)))
    tangent = np.zeros((count, 2, 3))
    total = 0.0
    for part, exponent, ratio, horizontal, vertical in _evaluated(mixture, features):
        peak = exponent.max(axis=0)
        exponent -= peak
        np.exp(exponent, out=exponent)
        if axes.angular == 2:
            exponent *= ratio
        norm = exponent.sum(axis=0)
        weights = features.weights[part]
        total += float(weights @ (np.log(norm) + peak))
        exponent *= weights / norm
        phi += exponent @ features.phi[:, part].T
        if axes.angular:
            # first and second moments of the scaled tangent coordinates
            np.multiply(exponent, horizontal, out=ratio)
            tangent[:, 0, 0] += ratio.sum(axis=1)
            tangent[:, 0, 1] += np.einsum("kn,kn->k", ratio, horizontal)
            tangent[:, 0, 2] += np.einsum("kn,kn->k", ratio, vertical)
            np.multiply(exponent, vertical, out=ratio)
            tangent[:, 1, 0] += ratio.sum(axis=1)
            tangent[:, 1, 2] += np.einsum("kn,kn->k", ratio, vertical)
    tangent[:, 1, 1] = tangent[:, 0, 2]
    unit = math.sqrt(2.0) * mixture.spread_rad
    tangent = tangent * unit[:, :, None] * np.concatenate([np.ones((count, 1)), unit], axis=1)[:, None, :]
    return Statistics(total, phi[:, 0], phi, tangent)


def _joint(mixture: Mixture, features: Features) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Joint densities of blocks of samples, (K, n), less a factor of each sample, of which the log is given, (n,)."""
    for part, exponent, ratio, _, _ in _evaluated(mixture, features):
        peak = exponent.max(axis=0)
        terms = np.exp(exponent - peak)
        yield part, terms * ratio if features.axes.angular == 2 else terms, peak


def log_density(mixture: Mixture, features: Features) -> np.ndarray:
    """log q of each sample, shape (N,)."""
    result = np.empty(len(features))
    for part, terms, peak in _joint(mixture, features):
        result[part] = np.log(terms.sum(axis=0)) + peak
    return result


def responsibilities(mixture: Mixture, features: Features) -> np.ndarray:
    """Posterior shares of the components for each sample, shape (N, K), rows summing to 1."""
    result = np.empty((len(features), len(mixture)))
    for part, terms, _ in _joint(mixture, features):
        result[part] = (terms / terms.sum(axis=0)).T
    return result


def label_statistics(mixture: Mixture, features: Features, labels: np.ndarray) -> Statistics:
    """Statistics of a hard assignment, each sample to one component: O(N) for any number of components."""
    count = len(mixture)
    scattered = [np.bincount(labels, features.weights * row, minlength=count) for row in features.phi]
    local = np.einsum("nij,jn->in", mixture.frames[labels], features.directions)
    u = local[1:] * angle_ratio(local[0], np.empty(len(labels)), np.empty(len(labels)))
    used = (features.axes.horizontal, features.axes.vertical)
    rows = [u[i] if used[i] else np.zeros(len(labels)) for i in range(2)]
    tangent = [
        [np.bincount(labels, features.weights * a * b, minlength=count) for b in (np.ones(len(labels)), *rows)]
        for a in rows
    ]
    return Statistics(float("nan"), scattered[0], np.stack(scattered, 1), np.moveaxis(np.array(tangent), 2, 0))


def mean_directions(features: Features, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation of the mean unit vector of each cell, shape (K,) each [rad]."""
    sums = np.stack([np.bincount(labels, features.weights * row, minlength=count) for row in features.directions])
    azimuth = np.arctan2(sums[1], sums[0]) if features.axes.horizontal else np.zeros(count)
    elevation = np.arctan2(sums[2], np.hypot(sums[0], sums[1])) if features.axes.vertical else np.zeros(count)
    return np.asarray(wrap_angle(azimuth)), elevation


@dataclass(frozen=True)
class Axes:
    """The random factors of a component.

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
    azimuth_rad: float
    elevation_rad: float
    angle_scale: float

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
        off_pole = cosine > POLE_COSINE
        return cls(
            origin=tuple(i for i in range(3) if i in free and pinned[i] is None),
            horizontal=AZIMUTH in free and off_pole,
            vertical=ELEVATION in free,
            range=RANGE in free,
            azimuth_rad=space.low[AZIMUTH],
            elevation_rad=space.low[ELEVATION],
            angle_scale=cosine if off_pole else 1.0,
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
        # not by BLAS, whose threads share out long sums and change their last bit
        centre = np.einsum("n,nk->k", weights, linear)
        spread = np.sqrt(np.einsum("n,nk->k", weights, np.square(linear - centre)))
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
        resultant = float(np.linalg.norm(np.einsum("kn,n->k", self.directions, self.weights)))
        return math.sqrt(np.clip(2 * (1 - resultant), IDLE_AXIS_SHARE**2, 1.0))

    @cached_property
    def embedding(self) -> np.ndarray:
        """Scaled linear coordinates and directions, whose Euclidean distance seeds components, (N, m + 3)."""
        return np.concatenate([self.linear, self.directions / self.angular_scale]).T

    def subset(self, keep: np.ndarray) -> Features:
        """The points at an index or mask, with weights scaled to sum to 1 and the same units."""
        weights = self.weights[keep]
        return Features(self.points[keep], weights / weights.sum(), self.axes, self.centre, self.scale)
