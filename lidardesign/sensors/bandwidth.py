"""Shares of rays, and the read-out bandwidth of a design: bins, bits and frames per second (paper, section 6).

A gate of width w listens for the round-trip time 2 w / c, cut into bins of one fixed duration. Every bin
of every ray is read out once per frame, so the bandwidth is sum(bins) * bits * rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.limits import MOST_RAYS
from lidardesign.numerics import SLACK
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S

SECONDS_PER_PICOSECOND = 1e-12
BITS_PER_MEGABIT = 1e6
# A width of exactly k bins that passed through a mean and a spread comes back a few ulp off; this share of
# the width may be rounding, far below what any receiver resolves.
BIN_ROUNDING = SLACK
# More are counted as so many, which no read-out takes: whole numbers stay exact.
MOST_BINS = 1e15
# Shares of a ray closer than this are the same share: weights that were normalised differ by a few ulp.
REMAINDER_DECIMALS = 9


@dataclass(frozen=True)
class Bandwidth:
    """The read-out model of a time-resolved receiver.

    Arguments:
        bin_ps: Duration of one time bin [ps].
        bits_per_bin: Bits read out per bin.
        rate_hz: Frames per second [Hz].

    Raises:
        ConfigError: A value that is not finite and positive.
    """

    bin_ps: float = 100.0
    bits_per_bin: float = 40.0
    rate_hz: float = 10.0

    def __post_init__(self) -> None:
        for name in ("bin_ps", "bits_per_bin", "rate_hz"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{value} found", where=f"bandwidth.{name}", allowed="a finite number above 0")

    @property
    def bin_m(self) -> float:
        """The one-way distance that one bin covers, c * bin / 2 [m]."""
        return SPEED_OF_LIGHT_M_S * self.bin_ps * SECONDS_PER_PICOSECOND / 2

    def bins(self, width_m: float | np.ndarray) -> np.ndarray:
        """Bins per gate, ceil(2 * width / (c * bin)), at least 1: widths [m], shape (...), to int64 (...).

        Raises:
            ConfigError: A width that is negative or not finite.
        """
        width = np.asarray(width_m, dtype=np.float64)
        if not (np.isfinite(width).all() and (width >= 0).all()):
            raise ConfigError("a gate width is negative or not finite", where="bandwidth", allowed="0 m or more")
        return np.maximum(np.ceil(np.minimum(width / self.bin_m, MOST_BINS) * (1 - BIN_ROUNDING)), 1.0).astype(np.int64)

    def mbps(self, rays: Rays) -> float:
        """Bandwidth of a ray list [Mbit/s]."""
        return self.mbps_of_widths(rays.gate_m[:, 1] - rays.gate_m[:, 0])

    def mbps_of_widths(self, widths_m: np.ndarray, counts: np.ndarray | int = 1) -> float:
        """Bandwidth of `counts` rays for each gate width: (G,) [m], (G,) to Mbit/s."""
        total = int(np.sum(self.bins(widths_m) * np.asarray(counts)))
        return total * self.bits_per_bin * self.rate_hz / BITS_PER_MEGABIT


def split_budget(weights: np.ndarray, count: int, *, each: bool = False) -> np.ndarray:
    """Whole numbers of rays in proportion to weights: (G,) to int64 (G,) with the sum `count` exactly.

    Largest remainder (Hamilton): every sensor gets the whole part of its quota, the rays left over go to the
    largest fractional parts, the lower index first where they tie. Too few rays leave some sensors without; with
    `each` these get one ray from the sensors with most, as far as there are rays for all.

    Raises:
        ConfigError: Weights that are negative, not finite or all zero; a negative count.
    """
    weights = np.asarray(weights, dtype=np.float64)
    if weights.ndim != 1 or not len(weights):
        raise ConfigError(f"weights of shape {weights.shape}", where="budget", allowed="one per sensor")
    if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.max() > 0):
        raise ConfigError(
            "weights are negative, not finite or all zero", where="budget", allowed="0 or more, one above 0"
        )
    if not 0 <= count <= MOST_RAYS or count != int(count):
        raise ConfigError(f"{count} rays", where="budget", allowed=f"a whole number from 0 to {MOST_RAYS}")
    scaled = weights / weights.max()
    quotas = scaled / scaled.sum() * count
    shares = np.floor(quotas).astype(np.int64)
    order = np.argsort(-np.round(quotas - shares, REMAINDER_DECIMALS), kind="stable")
    shares[order[: int(count) - int(shares.sum())]] += 1
    while each and shares.min() == 0 and shares.max() > 1:
        shares[[shares.argmax(), shares.argmin()]] += [-1, 1]
    return shares
