"""Sensors of any figures, for hypothesis."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from lidardesign.sensors.sensor import DEFAULT_LEVEL, Coupling, Sensor, interval_factor

finite = st.floats(-1e6, 1e6)
length = st.floats(0, 1e5)
width = st.floats(1e-3, 1e5)


@st.composite
def covariances(draw):
    root = np.array(draw(st.lists(st.floats(-2, 2), min_size=9, max_size=9))).reshape(3, 3)
    covariance = root @ root.T
    return (covariance + covariance.T) / 2


@st.composite
def sensors(draw, name, weight, level=DEFAULT_LEVEL, rays=None, steepest=math.pi / 2, widest=4.0):
    """A sensor of any figures, up to an elevation and a spread, whose field of view is no wider than a turn."""
    widest = min(widest, math.pi / interval_factor(level))
    return Sensor(
        name=name, weight=weight, level=level, rays=rays,
        origin_m=np.array(draw(st.tuples(finite, finite, finite))),
        origin_covariance_m2=draw(covariances()),
        azimuth_rad=draw(st.floats(-10, 10)), elevation_rad=draw(st.floats(-steepest, steepest)),
        roll_rad=draw(st.floats(-4, 4)), spread_horizontal_rad=draw(st.floats(0, widest)),
        spread_vertical_rad=draw(st.floats(0, widest)), range_m=draw(length), spread_range_m=draw(width),
        coupling=draw(st.none() | couplings()),
    )  # fmt: skip


@st.composite
def couplings(draw):
    numbers = lambda values, count: np.array(draw(st.lists(values, min_size=count, max_size=count)))  # noqa: E731
    return Coupling(
        direction_per_m=numbers(finite, 6).reshape(2, 3), range_per_m=numbers(finite, 3),
        range_per_rad=numbers(finite, 2), spread_rad=numbers(length, 2), spread_m=draw(length),
    )  # fmt: skip
