"""Sizes of design spaces."""

from __future__ import annotations

import numpy as np

from lidardesign.space import DesignSpace


def log_volume(space: DesignSpace) -> float:
    """Logarithm of the chart volume of the free dimensions."""
    free = list(space.free)
    return float(np.log(space.chart_high[free] - space.chart_low[free]).sum())
