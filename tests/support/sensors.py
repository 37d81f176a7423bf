"""Sensors by the spreads of a mixture's component."""

from __future__ import annotations

import numpy as np

from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor, interval_factor


def normal_sensor(
    name="s0", weight=1.0, origin_m=(0.0, 0.0, 0.0), azimuth_rad=0.0, elevation_rad=0.0, roll_rad=0.0,
    spread_rad=(0.1, 0.05), range_m=1.0, spread_range_m=0.1, level=DEFAULT_LEVEL, **further,
):  # fmt: skip
    """A sensor whose field of view and gate hold a level of normal angles and ranges; no gate starts below 0."""
    z = interval_factor(level)
    field = tuple(2 * z * spread for spread in spread_rad)
    gate = (max(range_m - z * spread_range_m, 0.0), range_m + z * spread_range_m)
    origin = np.array(origin_m, dtype=np.float64)
    return Sensor(name, weight, origin, azimuth_rad, elevation_rad, roll_rad, field, gate, **further)
