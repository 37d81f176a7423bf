"""Part of the independent checker: no sensor is in an excluded box, by plain documents only.

A box is broken where an interval of origins reaches into its interior along all three axes; boxes without volume
have none. Rows are name, bound, value and whether the bound is kept, as `check.ConstraintCheck`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from lidardesign.numerics import ROUNDING

# Rounding of means, spreads and their product, as a share of the bound, or of a metre.

Row = tuple[str, Any, Any, bool]


def excluded_rows(name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any], z: float) -> list[Row]:
    """The interval mean -+ z spread of a sensor's origin along each axis, against every excluded box."""
    mean, covariance = sensor["origin_m"]["mean"], sensor["origin_m"]["covariance"]
    reach = [z * math.sqrt(max(covariance[axis][axis], 0.0)) for axis in range(3)]
    low, high = ([m + sign * r for m, r in zip(mean, reach, strict=True)] for sign in (-1, 1))
    value = {"low_m": low, "high_m": high}
    return [
        (f"{name}.origin.exclude[{index}]", box, value, not _reaches_into(low, high, box))
        for index, box in enumerate(_boxes(rules))
    ]


def excluded_starts(table: Mapping[str, Any], rules: Sequence[Mapping[str, Any]]) -> list[Row]:
    """The rays of a table that start in a box that their own sensor's rules exclude."""
    if not any(_boxes(own) for own in rules):
        return []
    starts = zip(table["origin_x_m"], table["origin_y_m"], table["origin_z_m"], rules, strict=True)
    return [
        (f"ray{ray}.origin.exclude[{index}]", box, start, False)
        for ray, (*start, own) in enumerate(starts)
        for index, box in enumerate(_boxes(own))
        if _reaches_into(start, start, box)
    ]


def excluded_travel(
    track: Mapping[str, Any], sensors: Sequence[Mapping[str, Any]], rules: Mapping[str, Any]
) -> list[Row]:
    """The excluded boxes that sensors pass through on their way along a track."""
    axis = ("x_m", "y_m", "z_m").index(track["dimension"])
    rows: list[Row] = []
    for sensor in sensors:
        low, high = list(sensor["origin_m"]["mean"]), list(sensor["origin_m"]["mean"])
        low[axis], high[axis] = track["knots_m"][0], track["knots_m"][-1]
        value = {"low_m": low, "high_m": high}
        for index, box in enumerate(_boxes(rules)):
            row = (f"track.origin.exclude[{index}]", box, value, False)
            if _reaches_into(low, high, box) and row not in rows:
                rows.append(row)
    return rows


def _boxes(rules: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return list((rules.get("origin") or {}).get("exclude") or [])


def _reaches_into(low: Sequence[float], high: Sequence[float], box: Mapping[str, Any]) -> bool:
    """Whether an interval of origins meets the interior of a box by more than rounding."""
    return all(
        bottom < top and end > bottom + _slack(bottom) and start < top - _slack(top)
        for start, end, bottom, top in zip(low, high, box["low_m"], box["high_m"], strict=True)
    )


def _slack(bound: float) -> float:
    return ROUNDING * max(abs(bound), 1.0)
