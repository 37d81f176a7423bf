"""Candidate rays inside sensors: the second step from a density to rays.

They are drawn from the density's samples by weight, each at most once. Spacing is left to the choice:
candidates that were spaced evenly beforehand (by Lloyd's cells) gave designs that were 5 to 9 % worse on faces, at
equal rays and bandwidth, over three seeds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.constraints.document import SensorRules, rules_of
from lidardesign.constraints.origins import inside_excluded, origin_box
from lidardesign.numerics import ROUNDING, SLACK, TINY, angle_over_sine
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.pattern import even_rays, with_coordinates
from lidardesign.sensors.sensor import Sensor, interval_factor
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, RANGE, DesignSpace, aim, direction, observed_point

CANDIDATES_PER_RAY = 5
# Of rays that start all over regions: 100 rays of 2,000 track with 14 % less error than of 500, in one run of the arm.
LEAST_CANDIDATES_OF_REGIONS = 2000
NEAREST_SHARE = 0.1  # of the samples along a condition that propose rays at one of its values
# A direction or range without spread has no density. These smallest spreads, far below any that matters,
# order samples by their distance instead; the one of the range is relative to the sensors' mean range.
SMALLEST_ANGLE_RAD, SMALLEST_LENGTH = 1e-4, 1e-4
# Rays on the field's very edge belong to it: rounding of the tangent map [rad].
FIELD_ROUNDING_RAD = ROUNDING
# Samples may lie outside a box or an ellipsoid by the rounding of their coordinates [m].
ROUNDING_M = SLACK


@dataclass(frozen=True, eq=False)
class Proposals:
    """A source of candidate rays: the density's samples inside sensors.

    Arguments:
        sensors: The sensors that fire them.
        rules: Their constraints, which bound regions of origins.
        level: The share of each marginal that fields of view and gates hold.
        samples: Samples of the density, at all values of its conditions.
        by_turns: Whether sensors that see the same take turns in firing there.
    """

    sensors: Sequence[Sensor]
    rules: Sequence[SensorRules]
    level: float
    samples: Samples
    by_turns: bool = False

    def draw(
        self, count: int, at: Mapping[str, float], generator: np.random.Generator, least: np.ndarray | None = None
    ) -> Rays:
        """Draw candidates at a value of the condition; even rays fill up where too few samples are inside the sensors.

        Arguments:
            count: Their number.
            at: The value, by the condition's name.
            generator: Source of the draw.
            least: Least number of each sensor, (S,), which may raise their number; None sets none.
        """
        samples, least = nearest_samples(self.samples, at), np.zeros(len(self.sensors)) if least is None else least
        sensors = self.sensors_at(at)
        owner, fired = owners(sensors, self.rules, self.level, samples.points, samples.space, by_turns=self.by_turns)
        inside = np.flatnonzero((owner >= 0) & (samples.weights > 0))
        # the same ray at another range is the same candidate
        _, first, same = np.unique(fired[inside, :RANGE], axis=0, return_index=True, return_inverse=True)
        order = draw_order(np.bincount(same.reshape(-1), samples.weights[inside]), generator)
        order = order[first_candidates(owner[inside[first[order]]], count, least)]
        chosen = inside[first[np.sort(order)]]
        rays = rays_of_points(fired[chosen], owner[chosen], sensors)
        even = split_budget(np.array([sensor.weight for sensor in sensors]), max(count - len(chosen), 0))
        even = np.maximum(even, least - np.bincount(owner[chosen], minlength=len(sensors))).astype(np.int64)
        if even.any():
            rays = Rays.joined([rays, even_rays(sensors, even)])
        return replace(rays, time_s=np.zeros(len(rays)))

    def share_of_several(self, at: Mapping[str, float]) -> float:
        """The share of what the sensors see of the density, at a value of the condition, that several of them see."""
        samples, sensors = nearest_samples(self.samples, at), self.sensors_at(at)
        seen = np.zeros(len(samples), dtype=np.intp)
        for index, sensor in enumerate(sensors):
            own = [rules_of(self.rules, index)]
            seen += owners([sensor], own, self.level, samples.points, samples.space)[0] >= 0
        return float(samples.weights[seen > 1].sum()) / max(float(samples.weights[seen > 0].sum()), TINY)

    def sensors_at(self, at: Mapping[str, float]) -> list[Sensor]:
        """The sensors as they stand at a value of the condition."""
        moves = {DIMENSIONS.index(name): value for name, value in at.items()}
        return [replace(sensor, origin_m=with_coordinates(sensor.origin_m, moves)) for sensor in self.sensors]


def draw_order(weights: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """A random order by weight (N,): its first n are a weighted draw of n without replacement.

    References:
        Weighted random sampling with a reservoir, Efraimidis and Spirakis 2006.
    """
    keys = np.log(np.maximum(weights, TINY)) + generator.gumbel(size=len(weights))
    return np.argsort(-keys, kind="stable")


def first_candidates(owner: np.ndarray, count: int, least: np.ndarray) -> np.ndarray:
    """The first `count` candidates, and further ones of sensors that have too few among them.

    Arguments:
        owner: The sensor of each, (N,).
        count: Number of candidates.
        least: Least number of each sensor, where it has as many, (S,).

    Returns:
        Their indices, ascending.
    """
    taken = np.arange(len(owner)) < count
    for sensor in np.flatnonzero(np.bincount(owner[taken], minlength=len(least)) < least):
        taken[np.flatnonzero(owner == sensor)[: int(least[sensor])]] = True
    return np.flatnonzero(taken)


def rays_of_points(points: np.ndarray, sensor: np.ndarray, sensors: Sequence[Sensor]) -> Rays:
    """The rays of design points (N, 6) with the gates of their sensors (N,)."""
    gate_m = np.array([one.gate_m for one in sensors], dtype=np.float64).reshape(-1, 2)[sensor]
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    return Rays(points[:, :3], looking, gate_m, sensor, np.zeros(len(points)))


def nearest_samples(samples: Samples, at: Mapping[str, float], share: float = NEAREST_SHARE) -> Samples:
    """The share of samples whose condition is nearest to a value, moved to it; all samples without a condition."""
    if not at:
        return samples
    ((name, value),) = at.items()
    axis = DIMENSIONS.index(name)
    away = np.abs(samples.points[:, axis] - value)
    nearest = samples.subset(np.sort(np.argsort(away, kind="stable")[: math.ceil(share * len(samples))]))
    points = nearest.points.copy()
    points[:, axis] = value
    return replace(nearest, points=points, space=samples.space.at(at))


def owners(
    sensors: Sequence[Sensor],
    rules: Sequence[SensorRules],
    level: float,
    points: np.ndarray,
    space: DesignSpace,
    *,
    by_turns: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """The sensor that fires each design point, -1 where none does, (N,), and the points as they are fired, (N, 6).

    A point belongs to the sensor whose component is densest there, the first where they tie, if that sees it. Rays of
    a sensor at one place are re-aimed from it at the observed scene point; in a region they keep their origins.

    Arguments:
        sensors: S of them, with the shares of the rays as weights.
        rules: Of all sensors.
        level: The share of each marginal that fields of view and gates hold.
        points: Design points, shape (N, 6).
        space: Their design space.
        by_turns: Whether a point belongs to the next of the sensors that see it instead, point by point.
    """
    observed, z = observed_point(points), interval_factor(level)
    smallest_m = SMALLEST_LENGTH * (float(np.mean([sensor.gate_m for sensor in sensors])) or 1.0)
    best, owner, fired = np.full(len(points), -np.inf), np.full(len(points), -1), points.copy()
    sees = np.zeros(len(points), dtype=bool)
    for index, sensor in enumerate(sensors):
        if sensor.weight == 0:
            continue
        own, score, inside = points, np.zeros(len(points)), np.ones(len(points), dtype=bool)
        spreads_m, axes = principal_axes(sensor)
        fixed = [axis for axis in range(3) if not np.any(axes[axis])]
        if fixed:
            origins = points[:, :3].copy()
            origins[:, fixed] = np.asarray(sensor.origin_m)[fixed]
            if (origins != points[:, :3]).any():  # else their angles keep every digit
                own = space.wrap(aim(origins, observed))
        if len(spreads_m):
            away = (own[:, :3] - sensor.origin_m) @ axes / spreads_m
            score -= np.square(away).sum(axis=1) / 2 + np.log(spreads_m).sum()
            inside &= _in_region(own[:, :3], away, rules_of(rules, index), level, space)
        tangent = sensor.tangent_of(direction(own[:, AZIMUTH], own[:, ELEVATION]))
        start, end = sensor.gate_m
        angular = np.maximum(np.array(sensor.field_of_view_rad) / (2 * z), SMALLEST_ANGLE_RAD)
        depth, middle = max((end - start) / (2 * z), smallest_m), (start + end) / 2
        squares = np.square(tangent / angular).sum(axis=1) + np.square((own[:, RANGE] - middle) / depth)
        jacobian = np.log(angle_over_sine(np.hypot(tangent[:, 0], tangent[:, 1])))
        score += math.log(sensor.weight) - squares / 2 - np.log(angular).sum() - math.log(depth) + jacobian
        inside &= (np.abs(tangent) <= np.array(sensor.field_of_view_rad) / 2 + FIELD_ROUNDING_RAD).all(axis=1)
        inside &= (own[:, RANGE] >= start) & (own[:, RANGE] < end)
        if by_turns:
            score = np.where(inside, -((index - np.arange(len(points))) % len(sensors)), -np.inf)
        better = score > best
        best[better], owner[better], sees[better], fired[better] = score[better], index, inside[better], own[better]
    return np.where(sees, owner, -1), fired


def principal_axes(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (k,) [m] of a sensor's region along its principal axes, and these as columns (3, k)."""
    if sensor.origin_covariance_m2 is None:
        return np.zeros(0), np.zeros((3, 0))
    values, axes = np.linalg.eigh(np.asarray(sensor.origin_covariance_m2, dtype=np.float64))
    # axes with less of the variance than this share are fixed: only rounding is left there
    free = values > ROUNDING * max(values[-1], 0.0)
    return np.sqrt(values[free]), axes[:, free]


def _in_region(
    origins_m: np.ndarray, away: np.ndarray, rules: SensorRules, level: float, space: DesignSpace
) -> np.ndarray:
    """Mask of the origins (N, 3) in a region: in its ellipsoid of the level and within constraints, (N,)."""
    # slow to import
    from scipy.special import chdtri

    low, high = origin_box(rules, space)
    inside = ((origins_m >= low - ROUNDING_M) & (origins_m <= high + ROUNDING_M)).all(axis=1)
    inside &= ~inside_excluded(origins_m, rules)
    # the quantile of chi squared: the ellipsoid holds the level of a normal vector
    return inside & (np.square(away).sum(axis=1) <= float(chdtri(away.shape[1], 1 - level)))
