"""Rounding to bins: an error spread evenly over a bin.

Its rms is bin / sqrt(12), as ranges lie anywhere in a bin: an estimate where all of them lie at one place of their bin,
which may be half a bin off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why nothing is rounded, if so."""
    return None if detector.bin_m else "the detector has no bins"


def stake(sight: Sight, counts: Counts) -> Stake:
    """bin^2 / 12 for every ray."""
    bin_m = sight.detector.bin_m
    reason = f"bins are {1000 * bin_m:.3g} mm wide"
    return Stake(np.full(len(sight), (bin_m / math.sqrt(12)) ** 2), np.zeros(len(sight)), reason)
