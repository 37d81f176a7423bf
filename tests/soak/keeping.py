"""A second reader of design files: which bounds of a constraint file does a written design break?

Plain arithmetic on plain values, written from docs/design-file.md alone; neither the fit nor the program's own
checker is used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from statistics import NormalDist
from typing import Any

import numpy as np

LIGHT_M_PER_S = 299792458.0
# Degrees are converted to radians and back, and a file's intervals follow from its spreads in float64.
ROUNDING = 1e-9


def broken_bounds(design: Mapping[str, Any], rules: Mapping[str, Any], space: Mapping[str, Any]) -> list[str]:
    """The bounds that do not hold, each as one line with what was found."""
    return [f"{name}: {found}" for name, kept, found in checked_bounds(design, rules, space) if not kept]


def checked_bounds(
    design: Mapping[str, Any], rules: Mapping[str, Any], space: Mapping[str, Any]
) -> list[tuple[str, bool, Any]]:
    """Every bound by name, whether it is kept, and what was found."""
    checks = list(_counts(design, rules))
    each = rules.get("each") or []
    z = NormalDist().inv_cdf((1 + design.get("level", 0.95)) / 2)
    taken: list[tuple[float, ...]] = []
    for index, sensor in enumerate(design["sensors"]):
        own = _laid_over(rules, each[index]) if index < len(each) else rules
        parts = (
            _gate(sensor, own),
            _angles(sensor, own, space),
            _origin(sensor, own, z, taken),
            _rays(design, index, own),
        )
        checks += [(f"sensor {index} {name}", kept, found) for part in parts for name, kept, found in part]
        checks += _inside(sensor, space)
    return checks


def _laid_over(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    both = dict(common)
    for key, value in own.items():
        known = both.get(key)
        both[key] = _laid_over(known, value) if isinstance(value, Mapping) and isinstance(known, Mapping) else value
    return both


Check = tuple[str, bool, Any]


def _within(name: str, value: float, rules: Mapping[str, Any] | None) -> Iterator[Check]:
    rules = rules or {}
    slack = ROUNDING * max(abs(value), *(abs(bound) for bound in rules.values()), 0.0) if rules else 0.0
    if "min" in rules:
        yield f"{name}.min {rules['min']}", value >= rules["min"] - slack, value
    if "max" in rules:
        yield f"{name}.max {rules['max']}", value <= rules["max"] + slack, value


def _counts(design: Mapping[str, Any], rules: Mapping[str, Any]) -> Iterator[Check]:
    asked, found = rules.get("sensors") or {}, len(design["sensors"])
    yield from _within("sensors", found, {key: asked[key] for key in ("min", "max") if key in asked})
    if "count" in asked:
        yield f"sensors.count {asked['count']}", asked["count"] == found, found
    budget = rules.get("budget") or {}
    fired = [_widths(design, pattern) for pattern in design.get("patterns") or [None]]
    if "rays" in budget:
        counts = [sum(count for _, count in widths) for knots in fired for widths in knots]
        yield f"budget.rays {budget['rays']}", {*counts} == {budget["rays"]}, counts
    if "bandwidth_mbps" in budget:
        limit = budget["bandwidth_mbps"]
        spent = max(_bandwidth_mbps(widths, budget) for knots in fired for widths in knots)
        yield f"budget.bandwidth_mbps {limit}", spent <= limit * (1 + ROUNDING), spent


def _widths(design: Mapping[str, Any], pattern: Mapping[str, Any] | None) -> list[list[tuple[float, int]]]:
    """Widths of gates and how many rays have them, at each knot of a pattern, or of even rays."""
    if pattern:
        knots = zip(pattern["gate_start_m"], pattern["gate_end_m"], strict=True)
        return [[(end - start, 1) for start, end in zip(*ends, strict=True)] for ends in knots]
    sensors, rays = design["sensors"], (design["constraints"].get("budget") or {}).get("rays", 0)
    counts = [math.floor(sensor["weight"] * rays + ROUNDING) for sensor in sensors]
    most_left = sorted(range(len(sensors)), key=lambda index: round(counts[index] - sensors[index]["weight"] * rays, 9))
    for index in most_left[: rays - sum(counts)]:
        counts[index] += 1
    gates = [sensor["gate_m"] for sensor in sensors]
    return [[(gate["end"] - gate["start"], count) for gate, count in zip(gates, counts, strict=True)]]


def _bandwidth_mbps(widths: list[tuple[float, int]], budget: Mapping[str, Any]) -> float:
    bin_m = LIGHT_M_PER_S * budget.get("bin_ps", 100.0) * 1e-12 / 2
    bins = sum(count * max(math.ceil(width / bin_m * (1 - ROUNDING)), 1) for width, count in widths)
    return bins * budget.get("bits_per_bin", 40.0) * budget.get("rate_hz", 10.0) / 1e6


def _gate(sensor: Mapping[str, Any], rules: Mapping[str, Any]) -> Iterator[Check]:
    asked, start, end = rules.get("gate") or {}, sensor["gate_m"]["start"], sensor["gate_m"]["end"]
    for key, value in (("start_m", start), ("end_m", end), ("width_m", end - start)):
        yield from _within(f"gate.{key}", value, asked.get(key))


def _rays(design: Mapping[str, Any], index: int, rules: Mapping[str, Any]) -> Iterator[Check]:
    """The gates of a sensor's own rays, at every knot."""
    for pattern in design.get("patterns") or []:
        for starts, ends in zip(pattern["gate_start_m"], pattern["gate_end_m"], strict=True):
            for owner, start, end in zip(pattern["sensor"], starts, ends, strict=True):
                if owner == index:
                    yield from _gate({"gate_m": {"start": start, "end": end}}, rules)


def _angles(sensor: Mapping[str, Any], rules: Mapping[str, Any], space: Mapping[str, Any]) -> Iterator[Check]:
    field = rules.get("field_of_view") or {}
    for axis in ("horizontal", "vertical"):
        found = math.degrees(sensor["field_of_view_rad"][axis])
        yield from _within(f"field_of_view.{axis}", found, field.get(f"{axis}_deg"))
    asked = rules.get("boresight") or {}
    elevation = math.degrees(sensor["boresight"]["elevation_rad"])
    yield from _within("boresight.elevation", elevation, asked.get("elevation_deg"))
    arc = asked.get("azimuth_deg")
    if arc:
        ends = space["azimuth_rad"] if isinstance(space["azimuth_rad"], list) else [space["azimuth_rad"]] * 2
        low = arc.get("min", math.degrees(ends[0]))
        high = arc.get("max", math.degrees(ends[1]))
        azimuth = math.degrees(sensor["boresight"]["azimuth_rad"])
        middle = low + ((high - low) % 360 if high - low < 360 else 360) / 2
        half = 180.0 if high - low >= 360 else ((high - low) % 360) / 2
        away = abs((azimuth - middle + 180) % 360 - 180)
        yield f"boresight.azimuth {low} to {high}", away <= half + 360 * ROUNDING, azimuth


def _origin(
    sensor: Mapping[str, Any], rules: Mapping[str, Any], z: float, taken: list[tuple[float, ...]]
) -> Iterator[Check]:
    asked = rules.get("origin") or {}
    mean = np.array(sensor["origin_m"]["mean"])
    covariance = np.array(sensor["origin_m"].get("covariance", np.zeros((3, 3))))
    slack = ROUNDING * max(np.abs(mean).max(), 1e-30)
    for name, sign in (("low_m", 1), ("high_m", -1)):
        if name in asked:
            yield f"origin.{name} {asked[name]}", bool((sign * (mean - np.array(asked[name])) >= -slack).all()), mean
    if "fixed_m" in asked:
        there = bool((np.abs(mean - np.array(asked["fixed_m"])) <= slack).all()) and not covariance.any()
        yield f"origin.fixed_m {asked['fixed_m']}", there, mean
    if "mounts_m" in asked:
        mounts = [tuple(mount) for mount in asked["mounts_m"]]
        at = next((mount for mount in mounts if np.abs(mean - np.array(mount)).max() <= slack), None)
        yield "origin.mounts_m", at is not None and at not in taken and not covariance.any(), mean
        taken.append(at or ())
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    yield from _within("origin.spread_m", float(spreads[-1]), asked.get("spread_m"))
    yield from _within("origin.thickness_m", float(spreads[0]), asked.get("thickness_m"))
    half = z * np.sqrt(np.diag(covariance))
    for box in asked.get("exclude") or []:
        low, high = np.array(box["low_m"]), np.array(box["high_m"])
        inside = (mean + half > low + slack) & (mean - half < high - slack)
        yield f"origin.exclude {box}", not (inside.all() and (low < high).all()), (mean, half)


def _inside(sensor: Mapping[str, Any], space: Mapping[str, Any]) -> Iterator[Check]:
    """The mean origin and the gate lie in the design space."""
    found = dict(zip(("x_m", "y_m", "z_m"), sensor["origin_m"]["mean"], strict=True))
    for name, values in [*((name, [value]) for name, value in found.items()), ("range_m", sensor["gate_m"].values())]:
        low, high = space[name] if isinstance(space[name], list) else (space[name], space[name])
        slack = ROUNDING * max(abs(low), abs(high))
        yield f"space.{name}", all(low - slack <= value <= high + slack for value in values), list(values)
