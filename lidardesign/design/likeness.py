"""Constraints that a rig sets by what it is: as many sensors at its places, none wider, as many rays.

What a user asks for goes before what the rig has: of two bounds on one number theirs is taken, and where they say
anything of where sensors are, the rig says nothing of it. Where sensors look is left to the fit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lidardesign.design.constraints import MOST_FITTED, Constraints, SensorConstraints, merged
from lidardesign.design.sensor import Design, Sensor, interval_factor
from lidardesign.errors import ConfigError
from lidardesign.numerics import SLACK
from lidardesign.space import DIMENSIONS, DesignSpace

# Rays of one direction, or of directions that differ by rounding, have no field of view that could be a bound; those of
# a fan have one in their plane, and this one across it.
SMALLEST_FIELD_DEG = 1e-3
PLACES = ("fixed_m", "low_m", "high_m", "mounts_m")
SHARED = tuple(SensorConstraints.model_fields)


def constraints_like(rig: Design, space: DesignSpace, asked: Constraints, *, rays: int | None) -> Constraints:
    """The constraints of a rig below those that were asked for.

    Arguments:
        rig: The design to be like.
        space: The design space; a coordinate that is a condition stays open, as sensors move along it.
        asked: What the user wants.
        rays: The number of rays that the user wants, where that is said elsewhere; else the rig's own is a bound.

    Raises:
        ConfigError: More sensors than a fit takes.
    """
    if len(rig.sensors) > MOST_FITTED:
        raise ConfigError(
            f"{len(rig.sensors)} sensors", where=f"--like {rig.name}", allowed=f"at most {MOST_FITTED}",
            hint="rays that belong together need one name in the column `sensor`",
        )  # fmt: skip
    own = asked.as_document()
    shared = {key: own[key] for key in SHARED if key in own}
    given = own.get("each", [])
    each = [*given, *({} for _ in rig.sensors[len(given) :])]
    document: dict[str, Any] = {"sensors": {"count": len(rig.sensors)}, "budget": {}}
    if rig.rays and rays is None:
        document["budget"] = {"rays": rig.rays}
    if "sensors" in own:
        # count, and min with max, exclude one another
        document["sensors"] = own["sensors"]
    result = merged(document, {key: own[key] for key in own if key not in ("sensors", "each")})
    like = [_of_sensor(sensor, space) for sensor in rig.sensors]
    # entries beyond the rig's sensors stay: there are then too many, which is found where all contradictions are
    like += [{} for _ in each[len(like) :]]
    result["each"] = [_under(one, merged(shared, entry)) for one, entry in zip(like, each, strict=True)]
    return Constraints.from_mapping(result, where=f"--like {rig.name}")


def _under(like: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    """A rig's bounds on a sensor below those that were asked for it."""
    placed = any(key in asked.get("origin", {}) for key in PLACES)
    base = {key: value for key, value in like.items() if not (placed and key == "origin")}
    return merged(base, asked)


def _of_sensor(sensor: Sensor, space: DesignSpace) -> dict[str, Any]:
    bounds: dict[str, Any] = {"origin": _place(sensor, space)}
    widths = dict(zip(("horizontal_deg", "vertical_deg"), map(math.degrees, sensor.field_of_view_rad), strict=True))
    if max(widths.values()) > SMALLEST_FIELD_DEG:
        narrow = {axis: {"max": max(width, SMALLEST_FIELD_DEG)} for axis, width in widths.items() if width < 360}
        bounds.update({"field_of_view": narrow} if narrow else {})
    start, end = sensor.gate_m
    if end - start > SLACK:
        bounds["gate"] = {"width_m": {"max": end - start}}
    return bounds


def _place(sensor: Sensor, space: DesignSpace) -> dict[str, Any]:
    """Where a sensor is: a point, or the box of its origins, open along conditions."""
    half = interval_factor(sensor.level) * np.sqrt(np.maximum(np.diag(sensor.origin_covariance_m2), 0.0))
    low, high = sensor.origin_m - half, sensor.origin_m + half
    moving = [axis for axis in range(3) if DIMENSIONS[axis] in space.condition]
    if not moving and not half.any():
        return {"fixed_m": [float(value) for value in sensor.origin_m]}
    for axis in moving:
        low[axis], high[axis] = space.low[axis], space.high[axis]
    return {"low_m": [float(value) for value in low], "high_m": [float(value) for value in high]}


def taken_over(rig: Design, constraints: Constraints, asked: Constraints) -> list[str]:
    """What a rig's likeness says, one line each, for people."""
    sensors, own = len(rig.sensors), asked.as_document()
    said = [f"{sensors} sensor" + "s" * (sensors > 1)]
    if constraints.budget.rays is not None and asked.budget.rays is None:
        said.append(f"{constraints.budget.rays} rays")
    lines = [f"like {rig.name}: {', '.join(said)}, at its places, fields of view and gates no wider"]
    narrow = math.radians(SMALLEST_FIELD_DEG)
    single = sum(max(sensor.field_of_view_rad) <= narrow for sensor in rig.sensors)
    if single:
        lines.append(f"{single} of {sensors} sensors have no field of view: that of the fit is not bounded")
    if own:
        lines.append(f"what you ask for goes before: {', '.join(sorted(own))}")
    return lines
