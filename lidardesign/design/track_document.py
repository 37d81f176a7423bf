"""Tracks and conditions as they stand in a design file: units in the keys, one row of rays per knot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lidardesign.design.document import Node
from lidardesign.design.sensor import Track
from lidardesign.design.track import TRAVELLED
from lidardesign.space import DIMENSIONS

TRACK_KEYS = (
    "dimension", "knots_m", "azimuth_rad", "elevation_rad", "gate_start_m", "gate_end_m", "sensor",
)  # fmt: skip
# Four numbers per ray and knot stay below the number of values that the YAML reader accepts in one file.
MOST_TRACK_RAYS = 100_000
# Beyond this double precision no longer tells places a millimetre apart.
FURTHEST_M = 1e12


def track_document(track: Track) -> dict[str, Any]:
    """The plain document of a track, in the order in which it is written."""
    gate = np.asarray(track.gate_m, dtype=np.float64)
    values = (track.knots, track.azimuth_rad, track.elevation_rad, gate[..., 0], gate[..., 1])
    columns = [np.asarray(value, dtype=np.float64).tolist() for value in values]
    sensor = np.asarray(track.sensor, dtype=np.int64).tolist()
    return dict(zip(TRACK_KEYS, (track.dimension, *columns, sensor), strict=True))


def read_track(node: Node, sensors: int) -> Track:
    """A track of its document, for a design of so many sensors.

    Raises:
        ConfigError: A key is missing, rows differ in length, or knots do not ascend.
    """
    keys = node.mapping(TRACK_KEYS)
    knots = keys["knots_m"].numbers()
    if len(knots) < 2 or (knots[1:] <= knots[:-1]).any():
        raise keys["knots_m"].error("are no knots", allowed="at least two numbers, each above the one before")
    if np.abs(knots).max() > FURTHEST_M:
        raise keys["knots_m"].error(f"reach {np.abs(knots).max():g} m", allowed=f"within {FURTHEST_M:g} m of 0")
    index = np.array([item.integer(0, sensors - 1) for item in keys["sensor"].items()], dtype=np.int64)
    if not len(index):
        raise keys["sensor"].error("is empty", allowed="at least one ray")

    def rows(key: str, low: float = -math.inf, high: float = math.inf) -> np.ndarray:
        items = keys[key].items()
        if len(items) != len(knots):
            raise keys[key].error(f"has {len(items)} rows", allowed=f"{len(knots)}, one per knot")
        return np.stack([item.numbers(len(index), low, high) for item in items])

    azimuth, elevation = rows("azimuth_rad"), rows("elevation_rad", -math.pi / 2, math.pi / 2)
    start, end = rows("gate_start_m", 0), rows("gate_end_m", 0)
    if (end < start).any():
        knot, ray = (int(i) for i in np.argwhere(end < start)[0])
        bad = keys["gate_end_m"].child(knot).child(ray)
        raise bad.error(f"is {end[knot, ray]}, before the gate's start {start[knot, ray]}")
    dimension = keys["dimension"].choice(TRAVELLED)
    return Track(dimension, knots, azimuth, elevation, np.stack([start, end], axis=2), index)


def read_at(node: Node) -> Mapping[str, float]:
    """The condition values of a design, as {"x_m": 0.37}.

    Raises:
        ConfigError: A name that is no dimension of the design space, or a value that is no number.
    """
    return {name: item.number() for name, item in node.mapping((), DIMENSIONS).items()}
