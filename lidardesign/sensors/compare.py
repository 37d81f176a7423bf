"""Differences of two designs, sensor by sensor; the bandwidth of a design; and notes on designs outside a space.

Sensors of the same names are compared by name; otherwise sensors are assigned with the smallest sum of differences,
where a metre of place and of gate counts as much as a radian at the designs' range.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import Sensor
from lidardesign.space import RANGE, DesignSpace, angles

RIGHT_ANGLE_M = 1.0
# How far a rig of others may stand beside a space, in sizes of it: the diagonal of its box of origins and its reach.
FAR_SIZES = 10.0
MODEL_KEYS = ("bin_ps", "bits_per_bin", "rate_hz")


def difference(first: Sensor | None, second: Sensor | None) -> dict[str, Any]:
    """Names and the differences, second minus first: metres, degrees and shares; None for a sensor left over."""
    named = {"a": first.name if first else None, "b": second.name if second else None}
    if first is None or second is None:
        return {**named, "difference": None}
    fields = np.degrees(np.subtract(second.field_of_view_rad, first.field_of_view_rad))
    gates = np.subtract(second.gate_m, first.gate_m)
    return {
        **named,
        "difference": {
            "place_m": float(np.linalg.norm(second.origin_m - first.origin_m)),
            "boresight_deg": math.degrees(angles_between(first.boresight, second.boresight)),
            "roll_deg": math.degrees(math.remainder(second.roll_rad - first.roll_rad, math.tau)),
            "horizontal_deg": float(fields[0]),
            "vertical_deg": float(fields[1]),
            "gate_start_m": float(gates[0]),
            "gate_end_m": float(gates[1]),
            "weight": second.weight - first.weight,
        },
    }


def angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles between unit vectors (..., 3), exact for the smallest too, shape (...) [rad]."""
    return 2 * np.arctan2(np.linalg.norm(first - second, axis=-1), np.linalg.norm(first + second, axis=-1))


def paired_sensors(first: DesignSpec, second: DesignSpec) -> list[tuple[Sensor | None, Sensor | None]]:
    """The sensors of two designs in pairs, in the order of the first; those left over, with None, at the end."""
    by_name = {sensor.name: sensor for sensor in second.sensors}
    if {sensor.name for sensor in first.sensors} == set(by_name):
        return [(sensor, by_name[sensor.name]) for sensor in first.sensors]
    from scipy.optimize import linear_sum_assignment

    range_m = float(np.mean([sensor.gate_m for sensor in (*first.sensors, *second.sensors)])) or RIGHT_ANGLE_M
    one, other = (
        {
            "place": np.array([sensor.origin_m for sensor in design.sensors]),
            "look": range_m * np.array([sensor.boresight for sensor in design.sensors]),
            "gate": np.array([sensor.gate_m for sensor in design.sensors]),
            "field": range_m * np.array([sensor.field_of_view_rad for sensor in design.sensors]),
        }
        for design in (first, second)
    )
    # the difference of each sensor of one design from each of the other, shape (G, H) [m]
    distances_m = sum(np.linalg.norm(one[key][:, None] - other[key][None], axis=2) for key in one)
    rows, columns = linear_sum_assignment(distances_m)
    return [
        *((first.sensors[row], second.sensors[column]) for row, column in zip(rows, columns, strict=True)),
        *((sensor, None) for index, sensor in enumerate(first.sensors) if index not in rows),
        *((None, sensor) for index, sensor in enumerate(second.sensors) if index not in columns),
    ]


@dataclass(frozen=True)
class BandwidthUse:
    """The bandwidth of a design.

    Arguments:
        model: The read-out: that of the design's own budget.
        low_mbps, high_mbps: Least and most over the knots of a condition, else the same [Mbit/s]; of one ray where the
            design leaves its number of rays open.
        rays: Rays per frame; None where they are open.
    """

    model: Bandwidth
    low_mbps: float
    high_mbps: float
    rays: int | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for scripts."""
        rays = {"rays": self.rays, "of_one_ray": self.rays is None}
        return {"low_mbps": self.low_mbps, "high_mbps": self.high_mbps, **rays, **asdict(self.model)}


def readout_of(design: DesignSpec) -> BandwidthUse:
    """The bandwidth of a design, by the read-out model of its own constraints or the default one."""
    budget = design.constraints.get("budget") or {}
    model = Bandwidth(**{name: float(budget[name]) for name in MODEL_KEYS if budget.get(name) is not None})
    if design.patterns:
        gate_m = design.patterns[-1].gate_m
        found = [model.mbps_of_widths(row) for row in gate_m[..., 1] - gate_m[..., 0]]
        return BandwidthUse(model, min(found), max(found), design.count)
    widths = np.array([sensor.gate_m[1] - sensor.gate_m[0] for sensor in design.sensors])
    if design.count is None:
        once = float(design.weights @ np.array([model.mbps_of_widths(width) for width in widths]))
    else:
        once = model.mbps_of_widths(widths, design.rays_per_sensor())
    return BandwidthUse(model, once, once, design.count)


def outside_notes(design: DesignSpec, space: DesignSpace) -> list[str]:
    """A note on a design far outside a design space, likely in other units; else an empty list.

    Arguments:
        design: Its sensors' origins and gates, and those of its rays where it has patterns.
        space: The design space of the run that it is scored in.
    """
    low, high = np.array(space.low[:3]), np.array(space.high[:3])
    size_m = float(np.linalg.norm(high - low)) + space.high[RANGE]
    every = (*design.sensors, *design.patterns)
    origins_m = np.concatenate([np.reshape(one.origin_m, (-1, 3)) for one in every])
    starts_m = np.concatenate([np.asarray(one.gate_m)[..., 0].ravel() for one in every])
    unit = "are its lengths in millimetres?"
    apart_m = np.linalg.norm(np.maximum(np.maximum(origins_m - high, low - origins_m), 0.0), axis=1)
    if apart_m.max() > FAR_SIZES * size_m:
        return [f"{design.name} stands {apart_m.max():.4g} m outside the run's design space; {unit}"]
    if starts_m.max() > FAR_SIZES * size_m:
        return [
            f"{design.name} listens from {starts_m.max():.4g} m, but the run's design space ends at "
            f"{space.high[RANGE]:.4g} m; {unit}"
        ]
    return []


def outside_space(design: DesignSpec, space: DesignSpace) -> str:
    """The part of a design outside a design space, as "3 of 361 rays ... outside"; empty where all is inside.

    Arguments:
        design: Its rays where it has patterns, else its sensors' origins, boresights and gates.
        space: The design space that it is scored in; along its conditions designs are moved.
    """
    sensors = design.sensors
    if design.patterns:
        rays = Rays.joined([design.patterns[-1].at(knot) for knot in design.patterns[-1].knots or (None,)])
        what, origins_m, directions, gates_m = "rays", rays.origin_m, rays.direction, rays.gate_m
    else:
        what, origins_m = "sensors", np.array([sensor.origin_m for sensor in sensors]).reshape(-1, 3)
        directions = np.array([sensor.boresight for sensor in sensors]).reshape(-1, 3)
        gates_m = np.array([sensor.gate_m for sensor in sensors]).reshape(-1, 2)
    # the range of a gate nearest to the middle of the space's
    range_m = np.clip((space.low[RANGE] + space.high[RANGE]) / 2, gates_m[:, 0], gates_m[:, 1])
    points = np.column_stack([origins_m, *angles(directions), range_m])
    points[:, space.conditioned] = np.array(space.low)[list(space.conditioned)]
    outside = int((~space.contains(points)).sum())
    return f"{outside} of {len(points)} {what} start, point or listen outside" if outside else ""
