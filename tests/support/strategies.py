"""Sensors of any figures, for hypothesis."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from lidardesign.sensors.sensor import Sensor

finite = st.floats(-1e6, 1e6)
length = st.floats(0, 1e5)
width = st.floats(1e-3, 1e5)


@st.composite
def covariances(draw):
    root = np.array(draw(st.lists(st.floats(-2, 2), min_size=9, max_size=9))).reshape(3, 3)
    covariance = root @ root.T
    return (covariance + covariance.T) / 2


@st.composite
def sensors(draw, name, weight, steepest=math.pi / 2, widest=2 * math.pi):
    """A sensor of any figures, up to an elevation, whose field of view is no wider than a turn."""
    start, width_m = draw(length), draw(width)
    return Sensor(
        name=name, weight=weight, origin_m=np.array(draw(st.tuples(finite, finite, finite))),
        azimuth_rad=draw(st.floats(-10, 10)), elevation_rad=draw(st.floats(-steepest, steepest)),
        roll_rad=draw(st.floats(-4, 4)),
        field_of_view_rad=(draw(st.floats(0, widest)), draw(st.floats(0, widest))),
        gate_m=(start, start + width_m), origin_covariance_m2=draw(st.none() | covariances()),
    )  # fmt: skip
