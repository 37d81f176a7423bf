"""Two designs beside each other, sensor by sensor.

Sensors of the same names are compared by name; otherwise each sensor of one design with one of the other so that all
differences together are smallest, where a metre of place and of gate counts as much as a radian at the designs' range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidardesign.design.sensor import Design, Sensor

RIGHT_ANGLE_M = 1.0


@dataclass(frozen=True, eq=False)
class SensorPair:
    """Two sensors that stand for one another; one is None where the other design has more.

    Arguments:
        first, second: Of the first and the second design.
    """

    first: Sensor | None
    second: Sensor | None

    def as_dict(self) -> dict[str, Any]:
        """Names and the differences, second minus first: metres, degrees and shares; None for a sensor left over."""
        named = {"a": self.first.name if self.first else None, "b": self.second.name if self.second else None}
        if self.first is None or self.second is None:
            return {**named, "difference": None}
        first, second = self.first, self.second
        fields = np.degrees(np.subtract(second.field_of_view_rad, first.field_of_view_rad))
        gates = np.subtract(second.gate_m, first.gate_m)
        rays = None if first.rays is None or second.rays is None else second.rays - first.rays
        return {
            **named,
            "difference": {
                "place_m": float(np.linalg.norm(second.origin_m - first.origin_m)),
                "boresight_deg": math.degrees(angle_between(first.boresight, second.boresight)),
                "horizontal_deg": float(fields[0]),
                "vertical_deg": float(fields[1]),
                "gate_start_m": float(gates[0]),
                "gate_end_m": float(gates[1]),
                "weight": second.weight - first.weight,
                "rays": rays,
            },
        }


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """The angle of two unit vectors (3,), exact for the smallest too [rad]."""
    return 2 * math.atan2(float(np.linalg.norm(first - second)), float(np.linalg.norm(first + second)))


def paired_sensors(first: Design, second: Design) -> list[SensorPair]:
    """The sensors of two designs in pairs, in the order of the first; those left over at the end."""
    by_name = {sensor.name: sensor for sensor in second.sensors}
    if {sensor.name for sensor in first.sensors} == set(by_name):
        return [SensorPair(sensor, by_name[sensor.name]) for sensor in first.sensors]
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(_distances(first, second))
    pairs = [SensorPair(first.sensors[row], second.sensors[column]) for row, column in zip(rows, columns, strict=True)]
    lonely = [SensorPair(one, None) for index, one in enumerate(first.sensors) if index not in rows]
    return pairs + lonely + [SensorPair(None, one) for index, one in enumerate(second.sensors) if index not in columns]


def _distances(first: Design, second: Design) -> np.ndarray:
    """How different each sensor of one design is from each of the other, shape (G, H) [m]."""
    every = (*first.sensors, *second.sensors)
    range_m = float(np.mean([sensor.range_m for sensor in every])) or RIGHT_ANGLE_M
    one, other = (
        {
            "place": np.array([sensor.origin_m for sensor in design.sensors]),
            "look": range_m * np.array([sensor.boresight for sensor in design.sensors]),
            "gate": np.array([sensor.gate_m for sensor in design.sensors]),
            "field": range_m * np.array([sensor.field_of_view_rad for sensor in design.sensors]),
        }
        for design in (first, second)
    )
    return sum(np.linalg.norm(one[key][:, None] - other[key][None], axis=2) for key in one)
