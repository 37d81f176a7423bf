"""Sensors and patterns of any figures, for hypothesis."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from lidardesign.sensors.adaptive import AdaptivePatterns, PatternRule
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import TRAVELLED, Pattern
from lidardesign.sensors.sensor import Sensor
from lidardesign.space import DIMENSIONS

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
        gate_m=(start, start + width_m), origin_covariance_m2=draw(st.none() | covariances().filter(np.any)),
    )  # fmt: skip


@st.composite
def patterns(draw, sensors=2, rays=None, dimension=None):
    """A pattern of any figures: a few rays of so many sensors, at knots where it follows a condition."""
    count = draw(st.integers(1, 6)) if rays is None else rays
    knots = draw(st.lists(st.integers(-999, 999), min_size=2, max_size=4, unique=True)) if dimension else []
    shape = (max(len(knots), 1), count)

    def column(values):
        size = math.prod(shape)
        return np.array(draw(st.lists(values, min_size=size, max_size=size)), dtype=np.float64).reshape(shape)

    origin_m = np.stack([column(finite) for _ in range(3)], axis=2)
    if dimension:
        origin_m[..., DIMENSIONS.index(dimension)] = np.sort(knots)[:, None] / 8
    start_m = column(length)
    return Pattern(
        origin_m, column(st.floats(-10, 10)), column(st.floats(-math.pi / 2, math.pi / 2)),
        np.stack([start_m, start_m + column(width)], axis=2),
        np.array(draw(st.lists(st.integers(0, sensors - 1), min_size=count, max_size=count)), dtype=np.int64),
        dimension, tuple(knot / 8 for knot in sorted(knots)),
    )  # fmt: skip


conditions = st.sampled_from(TRAVELLED)


@st.composite
def adaptive_designs(draw):
    """A design of any figures with patterns that begin with the same look."""
    rays, number = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    looks = draw(st.integers(0, rays))
    generator = np.random.default_rng(draw(st.integers(0, 999)))
    own = [draw(patterns(2, rays)) for _ in range(number + 1)]
    for pattern in own[1:]:
        for name in ("origin_m", "azimuth_rad", "elevation_rad", "gate_m"):
            getattr(pattern, name)[:, :looks] = getattr(own[0], name)[:, :looks]
        pattern.sensor[:looks] = own[0].sensor[:looks]
    shares = generator.uniform(0, 1, number + 1)
    rule = PatternRule(generator.normal(size=(number, looks or 2)), looks, generator.uniform(0, 9, looks))
    return DesignSpec(
        "seen",
        tuple(draw(sensors(name, 0.5)) for name in ("a", "b")),
        "chosen",
        (draw(patterns(2, rays)),),
        adaptive=AdaptivePatterns(rule, tuple(own), shares / shares.sum()),
    )
