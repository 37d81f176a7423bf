"""Keeping a bandwidth budget: how many rays it pays for, and which common gate width."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from lidardesign.design.bandwidth import Bandwidth, split_budget
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.constraints.feasibility import least_width
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import COARSE_SLACK

# A cap of n bins is this share narrower, so that its width never rounds up to n + 1 bins.
BIN_MARGIN = COARSE_SLACK
MOST_REFITS = 12

Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class BandwidthBudget:
    """The bandwidth of sensors whose rays share the sensor's gate.

    Arguments:
        model: Bins, bits and rate.
        limit_mbps: The budget; None is none.
        rays: Rays per frame; None leaves them to the budget.
        names: What stands in the way of a smaller bandwidth: the number of rays, and least widths of gates.
    """

    model: Bandwidth
    limit_mbps: float | None
    rays: int | None
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, constraints: Constraints, rays: int | None) -> BandwidthBudget:
        """The read-out that a constraint file and an option ask for."""
        budget = constraints.budget
        names = ["budget.rays"] if budget.rays is not None else ["--rays"] if rays is not None else []
        for rules in constraints.rules:
            names += least_width(rules)[1]
        model = Bandwidth(budget.bin_ps, budget.bits_per_bin, budget.rate_hz)
        wanted = budget.rays if rays is None else rays
        return cls(model, budget.bandwidth_mbps, wanted, tuple(dict.fromkeys(names)))

    def mbps(self, widths_m: np.ndarray, weights: np.ndarray, rays: int) -> float:
        """Bandwidth of gates (K,) [m] whose rays are split by weights (K,)."""
        return self.model.mbps_of_widths(widths_m, split_budget(weights, rays))

    def fits(self, widths_m: np.ndarray, weights: np.ndarray, rays: int) -> bool:
        """Whether that many rays keep the budget."""
        return self.limit_mbps is None or self.mbps(widths_m, weights, rays) <= self.limit_mbps

    def affordable_rays(self, widths_m: np.ndarray, weights: np.ndarray) -> int:
        """The number of rays that the budget pays for, at least one per sensor (which may exceed it)."""
        bins_per_ray = float(np.dot(weights / np.sum(weights), self.model.bins(widths_m)))
        per_ray = bins_per_ray * self.model.mbps_of_widths(np.zeros(1), 1)
        rays = int((self.limit_mbps or 0.0) / per_ray)
        # largest remainders may hand spare rays to the wider gates
        while rays > len(widths_m) and not self.fits(widths_m, weights, rays):
            rays -= 1
        return max(rays, len(widths_m))


def fit_within_budget(
    fitted: Fitted,
    refit: Callable[[Fitted, float], Fitted],
    shape: Callable[[Fitted], tuple[np.ndarray, np.ndarray]],
    budget: BandwidthBudget,
) -> tuple[Fitted, int | None]:
    """A design that keeps the bandwidth budget, and its number of rays.

    Where the fit is too expensive its gates are narrowed to a common number of bins and it is refitted from
    where it was, until the count of whole bins keeps the budget.

    Arguments:
        fitted: The fit without a budget.
        refit: Continues a fit with gates no wider than a cap [m].
        shape: Gate widths [m] and weights of a fit, shape (K,) each.
        budget: Budget and bandwidth model.

    Raises:
        InfeasibleError: Even the narrowest admitted gates exceed the budget.
    """
    widths, weights = shape(fitted)
    if budget.limit_mbps is None:
        return fitted, budget.rays
    rays = budget.rays if budget.rays is not None else budget.affordable_rays(widths, weights)
    if budget.fits(widths, weights, rays):
        return fitted, rays
    bins = _affordable_bins(budget, widths, weights, rays)
    for _ in range(MOST_REFITS):
        fitted = refit(fitted, (1 - BIN_MARGIN) * max(bins, 1) * budget.model.bin_m)
        widths, weights = shape(fitted)
        if budget.fits(widths, weights, rays):
            return fitted, rays
        if bins <= 1:
            break
        bins = min(bins - 1, _affordable_bins(budget, widths, weights, rays))
    needed = budget.mbps(widths, weights, rays)
    raise InfeasibleError(
        f"{rays} rays still need {needed:g} Mbit/s with the narrowest gates that the other constraints admit",
        conflicts=["budget.bandwidth_mbps", *budget.names],
        allowed=f"at most {budget.limit_mbps:g} Mbit/s",
        hint="fewer rays, narrower gates, or more bandwidth",
    )


def _affordable_bins(budget: BandwidthBudget, widths: np.ndarray, weights: np.ndarray, rays: int) -> int:
    """The largest common cap in bins that keeps the budget with the present weights, at least 1."""
    counts = split_budget(weights, rays)
    bins = budget.model.bins(widths)
    unit = budget.model.mbps_of_widths(np.zeros(1), 1)
    low, high = 1, int(bins.max())
    while low < high:
        middle = (low + high + 1) // 2
        if unit * int(np.dot(counts, np.minimum(bins, middle))) <= (budget.limit_mbps or 0.0):
            low = middle
        else:
            high = middle - 1
    return low
