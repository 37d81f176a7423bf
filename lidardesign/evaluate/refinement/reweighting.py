"""A smooth factor of the target density over scene points: what refinement finds, and what a design keeps of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.errors import ConfigError
from lidardesign.space import FARTHEST_M, observed_point

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
