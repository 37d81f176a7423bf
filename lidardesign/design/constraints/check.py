"""The independent checker: does a written design keep a written constraint file?

It reads plain documents only and shares no code with the fit: intervals are recomputed from means and
spreads, compared with the reported ones, and bounds are applied to both. `constraints` has the definitions.

Part of the independent checker: no sensor is in an excluded box, by plain documents only.

A box is broken where an interval of origins reaches into its interior along all three axes; boxes without volume
have none. Rows are name, bound, value and whether the bound is kept, as `check.ConstraintCheck`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from lidardesign.design.snap.check import snap_rows
from lidardesign.numerics import COARSE_SLACK, ROUNDING, SLACK

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


# Rounding of the checker's own conversions between radians and degrees, as a share of the bound.
# A reported interval may differ from its mean and spread by this share (decimal digits in a file).
AGREEMENT = COARSE_SLACK
# The bandwidth model counts a width this share above whole bins as whole bins.
BIN_ROUNDING = SLACK
LIGHT_M_PER_S = 299792458.0
# Places are told to the millimetre: an origin pinned so near to the only one that the space has is that one [m].
SAME_PLACE_M = 1e-3
PICOSECOND_S = 1e-12


@dataclass(frozen=True)
class ConstraintCheck:
    """One verified bound.

    Arguments:
        name: Sensor and key, as `s0.gate.width_m.max`.
        bound: What was asked for.
        value: What the design has.
        satisfied: Whether it keeps the bound.
    """

    name: str
    bound: Any
    value: Any
    satisfied: bool

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON form."""
        return {"name": self.name, "bound": self.bound, "value": self.value, "satisfied": self.satisfied}


def check_design(document: Mapping[str, Any], constraints: Any, space: Any = None) -> list[ConstraintCheck]:
    """Verify every bound of a constraint document on a design document.

    Arguments:
        document: A design as plain values (the file, or its JSON form).
        constraints: A constraint file as plain values, or an object with `as_document()`.
        space: The design space as `DesignSpace` or its `as_dict()`; its range and origin bounds are then checked.

    Returns:
        One entry per sensor and bound, and one per budget line.
    """
    rules = constraints.as_document() if hasattr(constraints, "as_document") else dict(constraints or {})
    bounds = space.as_dict() if hasattr(space, "as_dict") else space
    level = float(document.get("level", 0.95))
    z = NormalDist().inv_cdf((1 + level) / 2)
    sensors = list(document["sensors"])
    each = list(rules.get("each") or [])
    checks = _count(rules, len(sensors))
    for index, sensor in enumerate(sensors):
        own = _over(rules, each[index]) if index < len(each) else rules
        name = str(sensor.get("name", index))
        checks += _consistency(name, sensor, z)
        checks += _origin(name, sensor, own, bounds) + _boresight(name, sensor, own, bounds)
        checks += [ConstraintCheck(*row) for row in excluded_rows(name, sensor, own, z)]
        checks += _intervals(name, sensor, own, z)
        checks += [ConstraintCheck(*row) for row in snap_rows(name, index, document, own.get("snap"))]
        if bounds is not None:
            checks += _inside_space(name, sensor, bounds)
    checks += _table(document, rules)
    if document.get("track"):
        checks += [ConstraintCheck(*row) for row in excluded_travel(document["track"], sensors, rules)]
        checks += _track(document["track"], rules, bounds)
    return checks + _mounts(sensors, rules, each) + _budget(document, rules)


def _over(common: Mapping[str, Any], special: Mapping[str, Any] | None) -> dict[str, Any]:
    result = dict(common)
    for key, value in (special or {}).items():
        if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = _over(result[key], value)
        elif value is not None:
            result[key] = value
    return result


def _get(values: Any, *keys: str) -> Any:
    for key in keys:
        values = values.get(key) if isinstance(values, Mapping) else None
    return values


def _slack(bound: float) -> float:
    return ROUNDING * max(abs(bound), 1.0)


def _between(name: str, value: float, rules: Any) -> list[ConstraintCheck]:
    """Checks of `min` and `max` where they are given."""
    checks = []
    low, high = _get(rules, "min"), _get(rules, "max")
    if low is not None:
        checks.append(ConstraintCheck(f"{name}.min", low, value, bool(value >= low - _slack(low))))
    if high is not None:
        checks.append(ConstraintCheck(f"{name}.max", high, value, bool(value <= high + _slack(high))))
    return checks


def _count(rules: Mapping[str, Any], found: int) -> list[ConstraintCheck]:
    checks = _between("sensors", found, rules.get("sensors"))
    wanted = _get(rules, "sensors", "count")
    if wanted is not None:
        checks.append(ConstraintCheck("sensors.count", wanted, found, wanted == found))
    return checks


def _consistency(name: str, sensor: Mapping[str, Any], z: float) -> list[ConstraintCheck]:
    """Reported intervals against means and spreads."""
    spread = sensor["spread"]
    pairs = []
    for axis in ("horizontal", "vertical"):
        pairs.append((f"field_of_view_rad.{axis}", sensor["field_of_view_rad"][axis], 2 * z * spread[f"{axis}_rad"]))
    start, end = sensor["gate_m"]["start"], sensor["gate_m"]["end"]
    mean = sensor.get("range_m")
    if mean is not None:
        pairs.append(("gate_m.start", start, max(mean - z * spread["range_m"], 0.0)))
        pairs.append(("gate_m.end", end, mean + z * spread["range_m"]))
    elif start > 0:
        pairs.append(("gate_m.width", end - start, 2 * z * spread["range_m"]))
    size = max(abs(value) for _, *values in pairs for value in values)
    checks = [
        ConstraintCheck(f"{name}.{key}", expected, found, bool(abs(found - expected) <= AGREEMENT * max(size, SLACK)))
        for key, found, expected in pairs
    ]
    # agreement is no news; a contradiction is
    return [check for check in checks if not check.satisfied]


def _origin(
    name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any], space: Mapping[str, Any] | None
) -> list[ConstraintCheck]:
    """Origins in their boxes; one that is pinned next to where the space fixes it is kept by standing there."""
    mean, covariance = sensor["origin_m"]["mean"], sensor["origin_m"]["covariance"]
    checks = []
    tests = {
        "low_m": lambda value, bound: value >= bound - _slack(bound),
        "high_m": lambda value, bound: value <= bound + _slack(bound),
        "fixed_m": lambda value, bound: abs(value - bound) <= _slack(bound),
    }
    for key, test in tests.items():
        bound = _get(rules, "origin", key)
        if bound is not None:
            meant = _meant(bound, space) if key == "fixed_m" else bound
            kept = all(test(value, limit) for value, limit in zip(mean, meant, strict=True))
            checks.append(ConstraintCheck(f"{name}.origin.{key}", list(bound), list(mean), bool(kept)))
    largest = _get(rules, "origin", "spread_m", "max")
    principal = np.sqrt(np.maximum(np.linalg.eigvalsh(np.array(covariance, dtype=np.float64)), 0.0))
    thickness, spread = float(principal[0]), float(principal[-1])
    if largest is not None:
        checks += _between(f"{name}.origin.spread_m", spread, {"max": largest})
    checks += _between(f"{name}.origin.thickness_m", thickness, _get(rules, "origin", "thickness_m"))
    if _get(rules, "origin", "fixed_m") is not None:
        checks.append(ConstraintCheck(f"{name}.origin.fixed_m.spread", 0.0, spread, spread == 0.0))
    return checks


def _meant(pinned: Sequence[float], space: Mapping[str, Any] | None) -> list[float]:
    """A pinned origin, with the space's coordinate where that is fixed no further away than places are told."""
    place = [float(value) for value in pinned]
    for axis, key in enumerate(("x_m", "y_m", "z_m")):
        low, high = (float(end) for end in (space or {}).get(key, (-math.inf, math.inf)))
        if low == high and abs(place[axis] - low) <= SAME_PLACE_M:
            place[axis] = low
    return place


def _mounts(
    sensors: list[Mapping[str, Any]], rules: Mapping[str, Any], each: list[Mapping[str, Any]]
) -> list[ConstraintCheck]:
    """Every mounted sensor is at one of its mounts without any spread, and no other one is there."""
    checks, taken = [], []
    for index, sensor in enumerate(sensors):
        mounts = _get(_over(rules, each[index]) if index < len(each) else rules, "origin", "mounts_m")
        if not mounts:
            continue
        mean, name = list(sensor["origin_m"]["mean"]), str(sensor.get("name", index))
        still = not np.any(sensor["origin_m"]["covariance"])
        there = [mount for mount in mounts if all(abs(a - b) <= _slack(b) for a, b in zip(mean, mount, strict=True))]
        kept = bool(there) and there[0] not in taken and still
        taken += there[:1]
        checks.append(ConstraintCheck(f"{name}.origin.mounts_m", mounts, mean, kept))
    return checks


def _boresight(name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any], space: Any) -> list[ConstraintCheck]:
    """Elevation, and azimuth on the circle; an end that is not given is the space's.

    Without a space a single bound says little: it is then read as the half circle beyond it.
    """
    elevation = math.degrees(sensor["boresight"]["elevation_rad"])
    checks = _between(f"{name}.boresight.elevation_deg", elevation, _get(rules, "boresight", "elevation_deg"))
    given = _get(rules, "boresight", "azimuth_deg") or {}
    low, high = given.get("min"), given.get("max")
    if low is None and high is None:
        return checks
    azimuth = math.degrees(sensor["boresight"]["azimuth_rad"])
    turn = _get(space, "azimuth_rad")
    if low is None:
        low = high - 180 if turn is None else math.degrees(turn[0])
    if high is None:
        high = low + 180 if turn is None else math.degrees(turn[1])
    width = high - low if high - low >= 360 else (high - low) % 360
    past = (azimuth - low) % 360
    kept = past <= width + _slack(360) or past >= 360 - _slack(360)
    return [*checks, ConstraintCheck(f"{name}.boresight.azimuth_deg", [low, high], azimuth, bool(kept))]


def _intervals(name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any], z: float) -> list[ConstraintCheck]:
    """Gate and field of view: the worse of the reported and the recomputed interval is checked."""
    checks = []
    spread = sensor["spread"]
    for axis in ("horizontal", "vertical"):
        bounds = _get(rules, "field_of_view", f"{axis}_deg")
        key = f"{name}.field_of_view.{axis}_deg"
        both = [math.degrees(v) for v in (sensor["field_of_view_rad"][axis], 2 * z * spread[f"{axis}_rad"])]
        checks += _worse(key, both, bounds)
    start, end = sensor["gate_m"]["start"], sensor["gate_m"]["end"]
    starts, ends, widths = [start], [end], [end - start]
    mean = sensor.get("range_m")
    if mean is not None:
        half = z * spread["range_m"]
        starts.append(max(mean - half, 0.0))
        ends.append(mean + half)
        widths.append(ends[1] - starts[1])
    for key, values in (("start_m", starts), ("end_m", ends), ("width_m", widths)):
        checks += _worse(f"{name}.gate.{key}", values, _get(rules, "gate", key))
    return checks


def _worse(name: str, values: list[float], rules: Any) -> list[ConstraintCheck]:
    low = _between(name, min(values), {"min": _get(rules, "min")})
    return low + _between(name, max(values), {"max": _get(rules, "max")})


def _inside_space(name: str, sensor: Mapping[str, Any], space: Mapping[str, Any]) -> list[ConstraintCheck]:
    """Gates and mean origins inside the design space; origins are listed where they are not."""
    near, far = (float(v) for v in space["range_m"])
    start, end = float(sensor["gate_m"]["start"]), float(sensor["gate_m"]["end"])
    inside = start >= near - _slack(near) and end <= far + _slack(far)
    checks = [ConstraintCheck(f"{name}.space.range_m", [near, far], [start, end], bool(inside))]
    for value, key in zip(sensor["origin_m"]["mean"], ("x_m", "y_m", "z_m"), strict=True):
        low, high = (float(v) for v in space[key])
        kept = low - _slack(low) <= value <= high + _slack(high)
        if not kept:
            checks.append(ConstraintCheck(f"{name}.space.{key}", [low, high], value, False))
    return checks


def _widths(document: Mapping[str, Any], budget: Mapping[str, Any]) -> list[tuple[float, int]] | None:
    """Gate widths and how many rays have them, of a track where they cost most; None without a number of rays."""
    table = document.get("ray_table")
    if table:
        pairs = zip(table["gate_start_m"], table["gate_end_m"], strict=True)
        return [(end - start, 1) for start, end in pairs]
    if document.get("track"):
        return _dearest(document["track"], budget)
    sensors = document["sensors"]
    if any(sensor.get("rays") is None for sensor in sensors):
        return None
    return [(s["gate_m"]["end"] - s["gate_m"]["start"], int(s["rays"])) for s in sensors]


def _dearest(track: Mapping[str, Any], budget: Mapping[str, Any]) -> list[tuple[float, int]]:
    """Gate widths where a track needs most bins: widths are linear between knots, so bins change only where one
    crosses a whole number, and one place between each two of these tells all."""
    bin_m = LIGHT_M_PER_S * budget.get("bin_ps", 100.0) * PICOSECOND_S / 2
    width = np.array(track["gate_end_m"], dtype=np.float64) - np.array(track["gate_start_m"], dtype=np.float64)
    places = [width]
    for left, right in zip(width[:-1] / bin_m, width[1:] / bin_m, strict=True):
        crossings = [0.0, 1.0]
        for one, other in zip(left, right, strict=True):
            whole = np.arange(math.ceil(min(one, other)), math.floor(max(one, other)) + 1)
            crossings += [] if one == other else list((whole - one) / (other - one))
        shares = np.sort(crossings)
        middle = (shares[1:] + shares[:-1])[:, None] / 2
        places.append(bin_m * ((1 - middle) * left + middle * right))
    every = np.concatenate(places)
    bins = np.maximum(np.ceil(every / bin_m * (1 - BIN_ROUNDING)), 1).sum(axis=1)
    return [(float(width), 1) for width in every[bins.argmax()]]


def _table(document: Mapping[str, Any], rules: Mapping[str, Any]) -> list[ConstraintCheck]:
    """Gates of explicit rays keep the gate bounds of their sensor."""
    table = document.get("ray_table")
    if not table:
        return []
    each = list(rules.get("each") or [])
    columns = zip(table["gate_start_m"], table["gate_end_m"], table["sensor"], strict=True)
    failed = []
    for ray, (start, end, sensor) in enumerate(columns):
        own = _over(rules, each[sensor]) if sensor < len(each) else rules
        for key, value in (("start_m", start), ("end_m", end), ("width_m", end - start)):
            failed += [c for c in _between(f"ray{ray}.gate.{key}", value, _get(own, "gate", key)) if not c.satisfied]
    owners = [_over(rules, each[sensor]) if sensor < len(each) else rules for sensor in table["sensor"]]
    return failed + [ConstraintCheck(*row) for row in excluded_starts(table, owners)]


def _track(track: Mapping[str, Any], rules: Mapping[str, Any], space: Any) -> list[ConstraintCheck]:
    """Gates and boresights at every knot; in between they are linear, and these bounds are convex.

    Only broken bounds are listed, but for the ends of the track, which must lie in the design space.
    """
    failed = []
    for knot in range(len(track["knots_m"])):
        rows = (track[key][knot] for key in ("gate_start_m", "gate_end_m", "azimuth_rad", "elevation_rad"))
        for ray, (start, end, azimuth, elevation) in enumerate(zip(*rows, strict=True)):
            name = f"ray{ray}.knot{knot}"
            gate = {"start": start, "end": end}
            aimed = {"azimuth_rad": azimuth, "elevation_rad": elevation}
            origin = {"mean": [0.0, 0.0, 0.0]}
            one = {"gate_m": gate, "boresight": aimed, "origin_m": origin}
            found = _boresight(name, one, rules, space)
            for key, value in (("start_m", start), ("end_m", end), ("width_m", end - start)):
                found += _between(f"{name}.gate.{key}", value, _get(rules, "gate", key))
            if space is not None:
                found += _looks_inside(name, one, space)
            failed += [check for check in found if not check.satisfied]
    if space is None:
        return failed
    low, high = (float(value) for value in space[track["dimension"]])
    first, last = track["knots_m"][0], track["knots_m"][-1]
    inside = first >= low - _slack(low) and last <= high + _slack(high)
    return [*failed, ConstraintCheck(f"track.space.{track['dimension']}", [low, high], [first, last], bool(inside))]


def _looks_inside(name: str, ray: Mapping[str, Any], space: Mapping[str, Any]) -> list[ConstraintCheck]:
    """The gate and the elevation of a ray inside the design space, and its azimuth on the circle."""
    checks = []
    near, far = (float(v) for v in space["range_m"])
    start, end = ray["gate_m"]["start"], ray["gate_m"]["end"]
    inside = start >= near - _slack(near) and end <= far + _slack(far)
    checks.append(ConstraintCheck(f"{name}.space.range_m", [near, far], [start, end], bool(inside)))
    low, high = (float(v) for v in space["elevation_rad"])
    elevation = ray["boresight"]["elevation_rad"]
    inside = low - _slack(low) <= elevation <= high + _slack(high)
    checks.append(ConstraintCheck(f"{name}.space.elevation_rad", [low, high], elevation, bool(inside)))
    low, high = (float(v) for v in space["azimuth_rad"])
    past = (ray["boresight"]["azimuth_rad"] - low) % (2 * math.pi)
    inside = past <= high - low + _slack(math.pi) or past >= 2 * math.pi - _slack(math.pi)
    azimuth = ray["boresight"]["azimuth_rad"]
    return [*checks, ConstraintCheck(f"{name}.space.azimuth_rad", [low, high], azimuth, bool(inside))]


def _budget(document: Mapping[str, Any], rules: Mapping[str, Any]) -> list[ConstraintCheck]:
    budget = rules.get("budget") or {}
    widths = _widths(document, budget)
    total = None if widths is None else sum(count for _, count in widths)
    checks = []
    declared = document.get("rays")
    if declared is not None and total is not None and declared != total:
        checks.append(ConstraintCheck("rays", declared, total, False))
    if budget.get("rays") is not None:
        found = total if total is not None else declared
        checks.append(ConstraintCheck("budget.rays", budget["rays"], found, found == budget["rays"]))
    limit = budget.get("bandwidth_mbps")
    if limit is not None:
        found = None if widths is None else _mbps(widths, budget)
        kept = found is not None and found <= limit + _slack(limit)
        checks.append(ConstraintCheck("budget.bandwidth_mbps", limit, found, kept))
    return checks


def _mbps(widths: list[tuple[float, int]], budget: Mapping[str, Any]) -> float:
    """Rays times whole bins times bits times frames [Mbit/s]."""
    bin_m = LIGHT_M_PER_S * budget.get("bin_ps", 100.0) * PICOSECOND_S / 2
    bins = sum(count * max(math.ceil(width / bin_m * (1 - BIN_ROUNDING)), 1) for width, count in widths)
    return bins * budget.get("bits_per_bin", 40.0) * budget.get("rate_hz", 10.0) / 1e6
