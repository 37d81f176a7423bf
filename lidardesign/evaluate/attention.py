r"""Where rays should go: from residuals and rays at anchors in the scene to log factors of the density.

A layout of n rays per area leaves an error of about c / n there (a surface through returns is off by the square of
their distance). The total, with the number of rays given, is least where every ray has the same share of the error:
$n \propto \sqrt c$, so that $c / n^2$ is the same everywhere. Each step therefore multiplies the density by a power of
the error per fired ray. Rays that return nothing count too: where more rays do not help, as around outlines that are
somewhere else in every scene, dividing by returns would send them all there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.quantise import lloyd
from lidardesign.design.reweighting import LARGEST_LOG_FACTOR, Reweighting
from lidardesign.simulate.returns import Returns
from lidardesign.task import Residuals

ANCHORS = 300
ANCHOR_ITERATIONS = 10
# Errors and rays at an anchor are means over so many nearest anchors, itself among them.
SMOOTHED_OVER = 5
# This share of the mean is added to errors and rays: an anchor without either asks for no infinite factor.
PRIOR_SHARE = 0.2
# No factor exceeds this, or falls below its inverse.
LARGEST_FACTOR = 5.0


@dataclass(frozen=True, eq=False)
class Attention:
    """Anchors in the scene, and which of them are neighbours.

    Arguments:
        points_m: Shape (K, 3).
        neighbours: Indices of the nearest anchors of each, shape (K, M).
    """

    points_m: np.ndarray
    neighbours: np.ndarray

    @classmethod
    def over(cls, places_m: np.ndarray, generator: np.random.Generator, count: int = ANCHORS) -> Attention:
        """Anchors that stand for places (N, 3) drawn from the density."""
        count = min(count, len(np.unique(places_m, axis=0)))
        anchors, _ = lloyd(places_m, np.ones(len(places_m)), count, generator, iterations=ANCHOR_ITERATIONS)
        near = cKDTree(anchors).query(anchors, k=min(SMOOTHED_OVER, count))[1]
        return cls(anchors, near.reshape(count, -1))

    def gains(self, seen: Sequence[tuple[Residuals, Sequence[Returns]]]) -> np.ndarray:
        """log of the error per fired ray at each anchor, relative to its mean over rays, shape (K,).

        Arguments:
            seen: Of each scene the residuals and the returns that they are of.
        """
        tree, count = cKDTree(self.points_m), len(self.points_m)
        error, rays = np.zeros(count), np.zeros(count)
        for residuals, returns in seen:
            if len(residuals.values):
                nearest = tree.query(residuals.points_m)[1]
                error += np.bincount(nearest, residuals.values, minlength=count)
            for places in _fired_places(returns):
                rays += np.bincount(tree.query(places)[1], minlength=count)
        error, rays = (values[self.neighbours].mean(axis=1) for values in (error, rays))
        if error.mean() <= 0 or rays.mean() <= 0:
            return np.zeros(count)
        log_ratio = np.log(error / error.mean() + PRIOR_SHARE) - np.log(rays / rays.mean() + PRIOR_SHARE)
        return log_ratio - np.average(log_ratio, weights=rays)

    def moved(self, log_factors: np.ndarray, gains: np.ndarray, step: float) -> np.ndarray:
        """log factors a step further, none beyond its bound, shape (K,)."""
        largest = min(np.log(LARGEST_FACTOR), LARGEST_LOG_FACTOR)
        return np.clip(log_factors + step * gains, -largest, largest)

    def reweighting(self, log_factors: np.ndarray) -> Reweighting:
        """The factor over the whole scene."""
        return Reweighting(self.points_m, log_factors)


def _fired_places(returns: Sequence[Returns]) -> list[np.ndarray]:
    """Where rays looked, frame by frame: their returns, and without one the middle of their gates, (N, 3) [m]."""
    places = []
    for frame in returns:
        rays = frame.rays
        range_m = np.where(frame.returned, np.nan_to_num(frame.range_m), rays.gate_m.mean(axis=1))
        places.append(rays.origin_m + range_m[:, None] * rays.direction)
    return places
