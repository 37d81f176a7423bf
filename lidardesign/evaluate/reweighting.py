r"""A smooth factor of the density over scene points, and how refinement moves it to where the error is.

A layout of n rays per area leaves an error of about c / n there (a surface through returns is off by the square of
their distance). The total, with the number of rays given, is least where every ray has the same share of the error:
$n \propto \sqrt c$, so that $c / n^2$ is the same everywhere. A step therefore multiplies the density by a power of
the error per fired ray. Rays that return nothing count too: where more rays do not help, as around outlines that are
somewhere else in every scene, dividing by returns would send them all there.

Where a thing is either met or missed, as a box by one of few rays, an error falls by the factor $e^{-a n}$ instead, and
the next ray saves $a$ times the error that is left, however many there are. Then a step multiplies by a power of the
error per density that was learned. On warehouse shelves this gains more with 6 and 12 rays, on faces less: refinement
tries both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.layouts.quantise import lloyd
from lidardesign.errors import ConfigError
from lidardesign.geometry.rays import Returns
from lidardesign.space import FARTHEST_M, observed_point
from lidardesign.task import Residuals

# So many anchors around a point decide its factor.
NEIGHBOURS = 4
# No weight is changed by more than the factor exp of this.
LARGEST_LOG_FACTOR = 20.0
FIT_AGAIN = "fit the design again: its file was changed by hand"


@dataclass(frozen=True, eq=False)
class Reweighting:
    """log factors at anchors in the scene; between them the mean of the nearest ones, by a Gaussian of the distance.

    Arguments:
        points_m: Anchors in the world frame [m], shape (K, 3).
        log_factors: log of the factor at each, shape (K,).

    Raises:
        ConfigError: No anchors, shapes that do not fit, or values that are not finite or too large.
    """

    points_m: np.ndarray
    log_factors: np.ndarray
    where: str = field(default="reweighting")

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m, dtype=np.float64)
        factors = np.asarray(self.log_factors, dtype=np.float64)
        if points.ndim != 2 or points.shape[1:] != (3,) or factors.shape != points.shape[:1] or not len(factors):
            found = f"log factors of shape {factors.shape} at points of shape {points.shape}"
            raise ConfigError(found, where=self.where, allowed="(K,) at (K, 3), K at least 1", hint=FIT_AGAIN)
        if not (np.abs(points).max() <= FARTHEST_M and np.abs(factors).max() <= LARGEST_LOG_FACTOR):
            raise ConfigError(
                "points or log factors are not finite or too large",
                where=self.where,
                allowed=f"log factors of -{LARGEST_LOG_FACTOR:g} to {LARGEST_LOG_FACTOR:g}, "
                f"points at most {FARTHEST_M:g} m away",
            )
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "log_factors", factors)

    @classmethod
    def from_document(cls, document: Any, where: str) -> Reweighting:
        """What `as_document` gave; anything else is refused with its place."""
        keys = {"points_m", "log_factors"}
        if not isinstance(document, Mapping) or set(document) != keys:
            allowed = f"the keys {', '.join(sorted(keys))}"
            raise ConfigError("is no reweighting", where=where, allowed=allowed, hint=FIT_AGAIN)
        return cls(*(_numbers(document[key], f"{where}: {key}") for key in ("points_m", "log_factors")), where)

    def as_document(self) -> dict[str, Any]:
        """Plain lists, as they stand in a design's file."""
        return {"points_m": self.points_m.tolist(), "log_factors": self.log_factors.tolist()}

    @cached_property
    def tree(self) -> cKDTree:
        """The search tree of the anchors."""
        return cKDTree(self.points_m)

    @cached_property
    def reach_m(self) -> float:
        """How far an anchor's factor reaches: the median distance to the nearest other one [m]."""
        if len(self.points_m) < 2:
            return 1.0
        apart = self.tree.query(self.points_m, k=2)[0][:, 1]
        # anchors may coincide where a scene is a few points; any reach then gives their mean
        return float(np.median(apart[apart > 0])) if (apart > 0).any() else 1.0

    def log_factor(self, points: np.ndarray) -> np.ndarray:
        """log of the factor of design points (N, 6), by the scene points that they observe, shape (N,)."""
        return self.at_places(observed_point(points))

    def at_places(self, places_m: np.ndarray) -> np.ndarray:
        """log of the factor at places in the scene (N, 3), shape (N,)."""
        count = min(NEIGHBOURS, len(self.points_m))
        distance, nearest = (v.reshape(len(places_m), count) for v in self.tree.query(places_m, k=count))
        log_shares = -np.square(distance / self.reach_m) / 2
        # far from all anchors every share underflows: relative to the nearest one they do not
        shares = np.exp(log_shares - log_shares.max(axis=1, keepdims=True))
        return (shares * self.log_factors[nearest]).sum(axis=1) / shares.sum(axis=1)


def _numbers(rows: Any, where: str) -> np.ndarray:
    """Nested lists of numbers as an array; text and truth values are none, though numpy would take them.

    Raises:
        ConfigError: Something is no number, or rows differ in length.
    """
    if not _all_numbers(rows):
        raise ConfigError("holds something that is no number", where=where, allowed="lists of numbers", hint=FIT_AGAIN)
    try:
        return np.asarray(rows, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError("is no table of numbers", where=where, allowed="rows of one length", hint=FIT_AGAIN) from None


def _all_numbers(rows: Any) -> bool:
    if isinstance(rows, list | tuple):
        return all(_all_numbers(one) for one in rows)
    return isinstance(rows, int | float) and not isinstance(rows, bool)


ANCHORS = 300
# Where rays differ along a condition, anchors have to be as near to each other in all of the scene that is passed.
MOST_ANCHORS = 1000
# Errors and rays at an anchor are means over so many nearest anchors, itself among them.
SMOOTHED_OVER = 5
# This share of the mean is added to errors and rays: an anchor without either asks for no infinite factor.
PRIOR_SHARE = 0.2
# Anchors are rounded to this share of the scene, and log factors to these decimals: files are read by people too.
POINT_SHARE = 1e-3
FACTOR_DECIMALS = 3
# No factor exceeds this, or falls below its inverse.
LARGEST_FACTOR = 5.0


def anchors_for(positions: int) -> int:
    """How many anchors stand for a scene that is seen from so many positions."""
    return min(ANCHORS * positions, MOST_ANCHORS)


@dataclass(frozen=True, eq=False)
class Attention:
    """Anchors in the scene, and which of them are neighbours.

    Arguments:
        points_m: Shape (K, 3).
        neighbours: Indices of the nearest anchors of each, shape (K, M).
        shares: Of the density that each stands for, shape (K,).
    """

    points_m: np.ndarray
    neighbours: np.ndarray
    shares: np.ndarray

    @classmethod
    def over(cls, places_m: np.ndarray, generator: np.random.Generator, count: int = ANCHORS) -> Attention:
        """Anchors that stand for places (N, 3) drawn from the density."""
        count = min(count, len(np.unique(places_m, axis=0)))
        anchors, _ = lloyd(places_m, np.ones(len(places_m)), count, generator, iterations=10)
        return cls.at(_rounded(anchors), places_m)

    @classmethod
    def at(cls, anchors_m: np.ndarray, places_m: np.ndarray) -> Attention:
        """Anchors (K, 3) that are known, for places (N, 3) drawn from the density."""
        tree, count = cKDTree(anchors_m), len(anchors_m)
        near = tree.query(anchors_m, k=min(SMOOTHED_OVER, count))[1]
        shares = np.bincount(tree.query(places_m)[1], minlength=count) / len(places_m)
        return cls(anchors_m, near.reshape(count, -1), shares)

    def gains(self, seen: Sequence[tuple[Residuals, Sequence[Returns]]]) -> dict[str, np.ndarray]:
        """log of the error at each anchor, per fired ray and per density, relative to its mean, shape (K,) each.

        Empty where there is no error, or no ray.

        Arguments:
            seen: Of each scene the residuals and the returns that they are of.
        """
        tree, count = cKDTree(self.points_m), len(self.points_m)
        error, rays = np.zeros(count), np.zeros(count)
        # in units of the largest one, whatever unit residuals have
        largest = max((residuals.values.max(initial=0.0) for residuals, _ in seen), default=0.0)
        for residuals, returns in seen:
            if largest > 0 and len(residuals.values):
                nearest = tree.query(residuals.points_m)[1]
                error += np.bincount(nearest, residuals.values / largest, minlength=count)
            for frame in returns:
                # where its rays looked: their returns, and without one the middle of their gates
                range_m = np.where(frame.returned, np.nan_to_num(frame.range_m), frame.rays.gate_m.mean(axis=1))
                places = frame.rays.origin_m + range_m[:, None] * frame.rays.direction
                rays += np.bincount(tree.query(places)[1], minlength=count)
        if error.sum() <= 0 or rays.sum() <= 0:
            return {}
        return {"the error per ray": self._ratio(error, rays), "the error": self._ratio(error, self.shares)}

    def _ratio(self, error: np.ndarray, spent: np.ndarray) -> np.ndarray:
        """log of the error over what is spent on it, each smoothed and relative to its mean, shape (K,)."""
        error, spent = (values[self.neighbours].mean(axis=1) for values in (error, spent))
        log_ratio = np.log(error / error.mean() + PRIOR_SHARE) - np.log(spent / spent.mean() + PRIOR_SHARE)
        return log_ratio - np.average(log_ratio, weights=spent)

    def moved(self, log_factors: np.ndarray, gains: np.ndarray, step: float) -> np.ndarray:
        """log factors a step further, none beyond its bound, shape (K,)."""
        largest = min(np.log(LARGEST_FACTOR), LARGEST_LOG_FACTOR)
        return np.clip(log_factors + step * gains, -largest, largest)

    def reweighting(self, log_factors: np.ndarray) -> Reweighting:
        """The factor over the whole scene."""
        return Reweighting(self.points_m, np.round(log_factors, FACTOR_DECIMALS))


def _rounded(points_m: np.ndarray) -> np.ndarray:
    """Points with no more decimals than their extent needs."""
    extent = float(np.ptp(points_m, axis=0).max())
    return np.round(points_m, max(-math.floor(math.log10(POINT_SHARE * extent)), 0)) if extent > 0 else points_m
