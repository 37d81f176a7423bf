"""The baseline `no-visibility`: the same design fitted to the density without its occlusion term.

The number of sensors, the layout, the constraints, the level and the seed are those of a fitted design; only the
samples differ. What its rays are worth beside that design is what knowing about occlusion is worth, and where that
design was weighted or refined, what that is worth as well: the twin is neither.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.fit import fit_like
from lidardesign.design.sensor import DesignSpec
from lidardesign.evaluate.baselines.candidates import Positions, mean_mbps
from lidardesign.geometry.rays import Rays
from lidardesign.samples import Samples
from lidardesign.space import DesignSpace

# Bandwidth grows almost in proportion to the number of rays: a few steps find the largest number that fits.
MOST_STEPS = 8
CLOSE_ENOUGH = 0.98  # of the bandwidth: every further step may be another fit

LogTarget = Callable[[np.ndarray], np.ndarray]


class LayOut(Protocol):
    """How a design becomes a ray list of a given length at a condition value."""

    def __call__(
        self, design: DesignSpec, count: int, samples: Samples | None, *, at: Mapping[str, float] | None = None
    ) -> Rays:
        """As `lidardesign.design.fit.rays_at`."""
        ...


def fitted_twin(design: DesignSpec, samples: Samples, *, name: str, retarget: LogTarget | None = None) -> DesignSpec:
    """A design fitted to other samples as a given one was fitted to its own.

    Arguments:
        design: The design whose sensors, layout, constraints, level and seed are taken.
        samples: Samples of the other density.
        name: Of the twin.
        retarget: log p* of the other density, where the fit needs it.
    """
    seed = design.provenance.get("seed", 0)
    seed = seed if isinstance(seed, int) else 0
    return fit_like(design, samples, rays=design.rays, seed=seed, name=name, retarget=retarget)


class TwinCandidate:
    """A design as a baseline's layout.

    Arguments:
        design: The design.
        samples: What it is laid out by at other numbers of rays.
        conditions: The condition values.
        lay_out: How it becomes rays.
    """

    drawn_anew = False

    def __init__(
        self, design: DesignSpec, samples: Samples, conditions: Sequence[Mapping[str, float]], lay_out: LayOut
    ) -> None:
        self.name = design.name
        self._design, self._samples, self._conditions, self._lay_out = design, samples, conditions, lay_out
        self._known: dict[int, Positions] = {}

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> Positions:
        """See `lidardesign.evaluate.baselines.candidates.Candidate`."""
        if count not in self._known:
            self._known[count] = tuple(
                self._lay_out(self._design, count, self._samples, at=condition) for condition in self._conditions
            )
        return self._known[count]

    def positions_within(self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth) -> Positions:
        """The most rays that a few steps in proportion to the bandwidth find; never more than fit."""
        low, high = 0, math.inf
        count = self._design.rays or max(len(self._design.sensors), 1)
        for _ in range(MOST_STEPS):
            cost = mean_mbps(self.positions(spaces, count), bandwidth)
            if cost <= limit_mbps:
                low = count
            else:
                high = count
            if high - low <= 1 or CLOSE_ENOUGH * limit_mbps <= cost <= limit_mbps:
                break
            guess = math.floor(count * limit_mbps / cost) if cost > 0 else 2 * count
            count = int(min(max(guess, low + 1), high - 1))
        return self.positions(spaces, low)
