"""Constraints that a rig sets by what it is: as many sensors at its places, none wider, as many rays.

What a user asks for goes before what the rig has: of two bounds on one number theirs is taken, and where they say
anything of where sensors are, the rig says nothing of it. Where sensors look is left to the fit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidardesign.constraints.document import MOST_FITTED, Constraints, SensorConstraints, merged
from lidardesign.constraints.origins import axes_outside, place_text, snap_place_to_space
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.numerics import SLACK
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor, interval_factor
from lidardesign.space import DIMENSIONS, DesignSpace

# Rays of one direction, or of directions that differ by rounding, have no field of view that could be a bound; those of
# a fan have one in their plane, and this one across it.
SMALLEST_FIELD_DEG = 1e-3
PLACES = ("fixed_m", "low_m", "high_m", "mounts_m")
MOST_NAMED = 4
SHARED = tuple(SensorConstraints.model_fields)


def rig_constraints(
    rig: DesignSpec, space: DesignSpace, asked: Constraints, *, rays: int | None, hint: str | None = None
) -> Constraints:
    """The constraints of a rig below those that were asked for.

    Arguments:
        rig: The design to be like.
        space: The design space; a coordinate that is a condition stays open, as sensors move along it.
        asked: What the user wants.
        rays: The number of rays that the user wants, where that is said elsewhere; else the rig's own is a bound.
        hint: What to do where the rig's sensors stand outside the space.

    Raises:
        ConfigError: More sensors than a fit takes.
        InfeasibleError: A sensor of the rig stands where those of the space may not, and the user asks for no place.
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
    document: dict[str, Any] = {
        # count, and min with max, exclude one another
        "sensors": own.get("sensors", {"count": len(rig.sensors)}),
        "budget": {"rays": rig.count} if rig.count and rays is None else {},
    }
    result = merged(document, {key: own[key] for key in own if key not in ("sensors", "each")})
    like = [_of_sensor(sensor, space) for sensor in rig.sensors]
    # entries beyond the rig's sensors stay: there are then too many, which is found where all contradictions are
    like += [{} for _ in each[len(like) :]]
    wanted = [merged(shared, entry) for entry in each]
    placed = [any(key in entry.get("origin", {}) for key in PLACES) for entry in wanted]
    _check_places(rig, space, placed, hint)
    for bounds in itertools.compress(like, placed):
        bounds.pop("origin", None)
    result["each"] = [merged(bounds, entry) for bounds, entry in zip(like, wanted, strict=True)]
    return Constraints.from_mapping(result, where=f"--like {rig.name}")


def _check_places(rig: DesignSpec, space: DesignSpace, placed: Sequence[bool], hint: str | None) -> None:
    """Refuse a rig whose sensors stand where the design space has no place, of those that the user puts nowhere."""
    boxes = {sensor.name: _box(sensor) for sensor, own in zip(rig.sensors, placed, strict=False) if not own}
    beyond = {name: axes for name, box in boxes.items() if (axes := axes_outside(*box, space))}
    if not beyond:
        return
    name = next(iter(beyond))
    more = f" (and {len(beyond) - 1} more of its sensors elsewhere, too)" if len(beyond) > 1 else ""
    raise InfeasibleError(
        f"the run's sensors stand at {place_text(space.low[:3], space.high[:3])}; the rig's {name} at "
        f"{place_text(*boxes[name])}{more}",
        conflicts=[*(f"space.{DIMENSIONS[axis]}" for axis in beyond[name]), f"--like {rig.name}"],
        where=f"--like {rig.name}",
        hint=hint or "learn with a design space that contains the rig's places",
    )


def _of_sensor(sensor: Sensor, space: DesignSpace) -> dict[str, Any]:
    """A sensor's place, a point or the box of its origins, open along conditions; its field of view and its gate."""
    low, high = _box(sensor)
    place = snap_place_to_space(sensor.origin_m, space)
    moving = [axis for axis in range(3) if DIMENSIONS[axis] in space.condition]
    bounds: dict[str, Any] = {"origin": {"fixed_m": place}}
    if moving or (low != high).any():
        low, high = np.minimum(low, place), np.maximum(high, place)
        for axis in moving:
            low[axis], high[axis] = space.low[axis], space.high[axis]
        bounds["origin"] = {key: [float(v) for v in corner] for key, corner in (("low_m", low), ("high_m", high))}
        if sensor.region_m > 0:
            bounds["origin"]["spread_m"] = {"max": sensor.region_m}
    widths = dict(zip(("horizontal_deg", "vertical_deg"), map(math.degrees, sensor.field_of_view_rad), strict=True))
    if max(widths.values()) > SMALLEST_FIELD_DEG:
        narrow = {axis: {"max": max(width, SMALLEST_FIELD_DEG)} for axis, width in widths.items() if width < 360}
        bounds.update({"field_of_view": narrow} if narrow else {})
    start, end = sensor.gate_m
    if end - start > SLACK:
        bounds["gate"] = {"width_m": {"max": end - start}}
    return bounds


def _box(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box of a sensor's origins, (3,) each [m]."""
    half = interval_factor(DEFAULT_LEVEL) * np.sqrt(np.maximum(np.diag(sensor.covariance_m2), 0.0))
    return sensor.origin_m - half, sensor.origin_m + half


def moved_notes(rig: DesignSpec, space: DesignSpace, constraints: Constraints) -> list[str]:
    """Which sensors of a rig are taken to stand where the space fixes their place, as they stand next to it."""
    moved = []
    for sensor, one in zip(rig.sensors, constraints.each, strict=False):
        place = snap_place_to_space(sensor.origin_m, space)
        off = float(np.abs(np.subtract(place, sensor.origin_m)).max())
        # what is said of other places, or of conditions, is no move
        if off > SLACK and one.origin.fixed_m == place:
            moved.append((sensor.name, 1e3 * off))
    if not moved:
        return []
    names = ", ".join(name for name, _ in moved[:MOST_NAMED]) + ", ..." * (len(moved) > MOST_NAMED)
    return [
        f"{names}: {max(off for _, off in moved):.2g} mm from where the run's sensors stand: treated as standing there"
    ]


def rig_notes(rig: DesignSpec, constraints: Constraints, asked: Constraints) -> list[str]:
    """What a rig's likeness says, one line each, for people."""
    sensors, own = len(rig.sensors), asked.as_document()
    has_rays = constraints.budget.rays is not None and asked.budget.rays is None
    rays = f", {constraints.budget.rays} rays" if has_rays else ""
    counts = f"{sensors} sensor{'s' * (sensors > 1)}{rays}"
    lines = [f"like {rig.name}: {counts}, at its places, fields of view and gates no wider"]
    single = sum(max(sensor.field_of_view_rad) <= math.radians(SMALLEST_FIELD_DEG) for sensor in rig.sensors)
    if single:
        lines.append(f"{single} of {sensors} sensors have no field of view: that of the fit is not bounded")
    if own:
        lines.append(f"your own constraints take precedence: {', '.join(sorted(own))}")
    return lines
