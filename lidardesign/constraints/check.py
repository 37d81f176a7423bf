"""The independent checker of a written design against a written constraint file.

It reads plain documents only and shares no code with the fit; `document` has the definitions. Chosen rays are held
against their own sensors' fields and gates. An excluded box is violated where an interval of origins reaches into its
interior along all three axes. A sensor that names a part has the part's field of view and range, and fires rays of
the part's pattern.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK, ROUNDING, SLACK
from lidardesign.sensors.sensor import boresight_frame
from lidardesign.space import direction

if TYPE_CHECKING:
    from lidardesign.parts.part import Part

# Rays may leave a field or a gate by this much, in radians or relative: decimal digits in a file.
AGREEMENT = COARSE_SLACK
# The bandwidth model counts a width this share above whole bins as whole bins.
BIN_ROUNDING = SLACK
LIGHT_M_PER_S = 299792458.0
# Places are given to the millimetre: an origin fixed this close to the space's own place means that place [m].
SAME_PLACE_M = 1e-3
PICOSECOND_S = 1e-12
AXES = ("x_m", "y_m", "z_m")
ANGLES = ("horizontal", "vertical")


@dataclass(frozen=True)
class ConstraintCheck:
    """One verified bound.

    Arguments:
        name: Sensor and key, as `s0.gate.width_m.max`.
        bound: The bound of the constraint file.
        value: The design's value.
        satisfied: Whether the value keeps the bound.
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
    sensors, each = list(document["sensors"]), list(rules.get("each") or [])
    own_rules = [_merged(rules, each[index]) if index < len(each) else rules for index in range(len(sensors))]
    checks = _between("sensors", len(sensors), rules.get("sensors"))
    wanted = _get(rules, "sensors", "count")
    if wanted is not None:
        checks.append(ConstraintCheck("sensors.count", wanted, len(sensors), wanted == len(sensors)))
    for index, (sensor, own) in enumerate(zip(sensors, own_rules, strict=True)):
        name = str(sensor.get("name", index))
        checks += _origin(name, sensor, own, bounds) + _boresight(name, sensor, own, bounds)
        checks += _excluded(name, sensor, own, z) + _intervals(name, sensor, own)
        if bounds is not None:
            checks += _inside_space(name, sensor, bounds)
    for pattern in _patterns(document):
        checks += _pattern(pattern, own_rules, bounds)
        # others fire what their part or file says, whose field may be round
        if document.get("layout") in ("chosen", "spinning"):
            checks += _rays_outside_sensors(pattern, sensors, level)
    checks += _mounts(sensors, own_rules) + _parts(document, rules.get("parts"))
    return checks + _budget(document, rules.get("budget") or {})


def _merged(common: Mapping[str, Any], special: Mapping[str, Any] | None) -> dict[str, Any]:
    """The common keys overridden by an entry of `each`, key by key at every depth."""
    result = dict(common)
    for key, value in (special or {}).items():
        both = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        if value is not None:
            result[key] = _merged(result[key], value) if both else value
    return result


def _get(values: Any, *keys: str) -> Any:
    for key in keys:
        values = values.get(key) if isinstance(values, Mapping) else None
    return values


def _patterns(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """All patterns of a design, also those that follow what they see."""
    return [*(document.get("patterns") or []), *(_get(document, "adaptive", "patterns") or [])]


def _slack(bound: float) -> float:
    """The tolerance of a bound for rounding of means, spreads and unit conversions."""
    return ROUNDING * max(abs(bound), 1.0)


def _between(name: str, value: float, rules: Any) -> list[ConstraintCheck]:
    """Checks of `min` and `max` on a value, where they are given."""
    checks, low, high = [], _get(rules, "min"), _get(rules, "max")
    if low is not None:
        checks.append(ConstraintCheck(f"{name}.min", low, value, bool(value >= low - _slack(low))))
    if high is not None:
        checks.append(ConstraintCheck(f"{name}.max", high, value, bool(value <= high + _slack(high))))
    return checks


def _within_space(name: str, key: str, space: Mapping[str, Any], *values: float) -> ConstraintCheck:
    """A check of a value, or of the first and last of several, against the space's bounds along a dimension."""
    low, high = (float(end) for end in space[key])
    kept = values[0] >= low - _slack(low) and values[-1] <= high + _slack(high)
    value = list(values) if len(values) > 1 else values[0]
    return ConstraintCheck(f"{name}.space.{key}", [low, high], value, bool(kept))


def _origin(
    name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any], space: Mapping[str, Any] | None
) -> list[ConstraintCheck]:
    """Checks of an origin; one fixed within `SAME_PLACE_M` of the space's own place must stand at that place."""
    mean, covariance = sensor["origin_m"]["mean"], sensor["origin_m"].get("covariance") or np.zeros((3, 3))
    checks = []
    tests = {
        "low_m": lambda value, bound: value >= bound - _slack(bound),
        "high_m": lambda value, bound: value <= bound + _slack(bound),
        "fixed_m": lambda value, bound: abs(value - bound) <= _slack(bound),
    }
    for key, test in tests.items():
        bound = _get(rules, "origin", key)
        if bound is not None:
            meant = list(bound)
            for axis, dimension in enumerate(AXES if key == "fixed_m" and space is not None else ()):
                low, high = (float(end) for end in space[dimension])
                if low == high and abs(meant[axis] - low) <= SAME_PLACE_M:
                    meant[axis] = low
            kept = all(test(value, limit) for value, limit in zip(mean, meant, strict=True))
            checks.append(ConstraintCheck(f"{name}.origin.{key}", list(bound), list(mean), bool(kept)))
    principal = np.sqrt(np.maximum(np.linalg.eigvalsh(np.array(covariance, dtype=np.float64)), 0.0))
    spread = float(principal[-1])
    checks += _between(f"{name}.origin.spread_m", spread, {"max": _get(rules, "origin", "spread_m", "max")})
    checks += _between(f"{name}.origin.thickness_m", float(principal[0]), _get(rules, "origin", "thickness_m"))
    if _get(rules, "origin", "fixed_m") is not None:
        checks.append(ConstraintCheck(f"{name}.origin.fixed_m.spread", 0.0, spread, spread == 0.0))
    return checks


def _boresight(name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any], space: Any) -> list[ConstraintCheck]:
    """Checks of a boresight's elevation, roll and azimuth (on the circle); a missing end is the space's.

    Without a space a single bound says little: it is then read as the half circle beyond it.
    """
    elevation = math.degrees(sensor["boresight"]["elevation_rad"])
    checks = _between(f"{name}.boresight.elevation_deg", elevation, _get(rules, "boresight", "elevation_deg"))
    roll = math.degrees(sensor["boresight"].get("roll_rad") or 0.0)
    checks += _between(f"{name}.boresight.roll_deg", roll, _get(rules, "boresight", "roll_deg"))
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


def _intervals(name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any]) -> list[ConstraintCheck]:
    """Checks of a sensor's gate and field of view."""
    view, (start, end) = sensor["field_of_view_rad"], (sensor["gate_m"][key] for key in ("start", "end"))
    values = {
        **{f"field_of_view.{axis}_deg": math.degrees(view[axis]) for axis in ANGLES},
        "gate.start_m": start,
        "gate.end_m": end,
        "gate.width_m": end - start,
    }
    each = (_between(f"{name}.{key}", found, _get(rules, *key.split("."))) for key, found in values.items())
    return [check for checks in each for check in checks]


def _inside_space(name: str, sensor: Mapping[str, Any], space: Mapping[str, Any]) -> list[ConstraintCheck]:
    """Checks of gates and mean origins inside the design space; origins are listed only where they are outside."""
    gate = _within_space(name, "range_m", space, float(sensor["gate_m"]["start"]), float(sensor["gate_m"]["end"]))
    places = zip(AXES, sensor["origin_m"]["mean"], strict=True)
    origins = [_within_space(name, axis, space, value) for axis, value in places]
    return [gate, *(check for check in origins if not check.satisfied)]


def _mounts(sensors: Sequence[Mapping[str, Any]], own_rules: Sequence[Mapping[str, Any]]) -> list[ConstraintCheck]:
    """Checks that every mounted sensor stands at one of its mounts, without spread, and alone."""
    checks, taken = [], []
    for index, (sensor, own) in enumerate(zip(sensors, own_rules, strict=True)):
        mounts, mean = _get(own, "origin", "mounts_m"), list(sensor["origin_m"]["mean"])
        if not mounts:
            continue
        still = not np.any(sensor["origin_m"].get("covariance"))
        there = [mount for mount in mounts if all(abs(a - b) <= _slack(b) for a, b in zip(mean, mount, strict=True))]
        kept = bool(there) and there[0] not in taken and still
        taken += there[:1]
        checks.append(ConstraintCheck(f"{sensor.get('name', index)}.origin.mounts_m", mounts, mean, kept))
    return checks


def _excluded(name: str, sensor: Mapping[str, Any], rules: Mapping[str, Any], z: float) -> list[ConstraintCheck]:
    """Checks of the interval mean -+ z spread of a sensor's origin against every excluded box."""
    mean, covariance = sensor["origin_m"]["mean"], sensor["origin_m"].get("covariance") or np.zeros((3, 3))
    reach = [z * math.sqrt(max(covariance[axis][axis], 0.0)) for axis in range(3)]
    low, high = ([m + sign * r for m, r in zip(mean, reach, strict=True)] for sign in (-1, 1))
    return _outside(name, low, high, rules)


def _outside(name: str, low: list[float], high: list[float], rules: Mapping[str, Any]) -> list[ConstraintCheck]:
    """Checks of an interval of origins against every excluded box."""
    value = {"low_m": low, "high_m": high}
    return [
        ConstraintCheck(f"{name}.origin.exclude[{index}]", box, value, not _reaches_into(low, high, box))
        for index, box in enumerate(_get(rules, "origin", "exclude") or [])
    ]


def _reaches_into(low: Sequence[float], high: Sequence[float], box: Mapping[str, Any]) -> bool:
    """True where an interval of origins meets the interior of a box by more than rounding; never for flat boxes."""
    return all(
        bottom < top and end > bottom + _slack(bottom) and start < top - _slack(top)
        for start, end, bottom, top in zip(low, high, box["low_m"], box["high_m"], strict=True)
    )


def _pattern(
    pattern: Mapping[str, Any], own_rules: Sequence[Mapping[str, Any]], space: Mapping[str, Any] | None
) -> list[ConstraintCheck]:
    """Checks of rays' gates and origins against the bounds of their sensors, at every knot.

    Between knots they are linear, and these bounds are convex. Only broken ones are listed, but for the ends of a
    pattern along a condition, which must lie in the design space.
    """
    owners = [own_rules[sensor] for sensor in pattern["sensor"]]
    knots, failed = list(pattern.get("knots_m") or []), []
    columns = ("origin_x_m", "origin_y_m", "origin_z_m", "gate_start_m", "gate_end_m")
    for knot in range(max(len(knots), 1)):
        for ray, (*place, start, end) in enumerate(zip(*(pattern[key][knot] for key in columns), strict=True)):
            name = f"ray{ray}.knot{knot}" if knots else f"ray{ray}"
            checks = _outside(name, place, place, owners[ray])
            for key, value in (("start_m", start), ("end_m", end), ("width_m", end - start)):
                checks += _between(f"{name}.gate.{key}", value, _get(owners[ray], "gate", key))
            if space is not None:
                checks.append(_within_space(name, "range_m", space, start, end))
            failed += [check for check in checks if not check.satisfied]
    if not knots:
        return failed
    # on its way from end to end no ray passes through an excluded box
    for ray, own in enumerate(owners):
        ways = [[pattern[key][knot][ray] for knot in range(len(knots))] for key in columns[:3]]
        low, high = [min(way) for way in ways], [max(way) for way in ways]
        failed += [check for check in _outside(f"ray{ray}", low, high, own) if not check.satisfied]
    if space is None:
        return failed
    return [*failed, _within_space("pattern", pattern["dimension"], space, knots[0], knots[-1])]


def _rays_outside_sensors(
    pattern: Mapping[str, Any], sensors: Sequence[Mapping[str, Any]], level: float
) -> list[ConstraintCheck]:
    """Failed checks of listed rays inside their sensor's place or region, field of view and gate, at any knot."""
    owner, failed = np.asarray(pattern["sensor"]), []
    for index, sensor in enumerate(sensors):
        own, view, gate = np.flatnonzero(owner == index), sensor["field_of_view_rad"], sensor["gate_m"]
        columns = ("azimuth_rad", "elevation_rad", "gate_start_m", "gate_end_m")
        azimuth, elevation, start, end = (np.asarray(pattern[key], dtype=np.float64)[:, own] for key in columns)
        forward, *across = np.moveaxis(direction(azimuth, elevation) @ _frame(sensor).T, -1, 0)
        sideways = np.hypot(*across)
        # true angles from the boresight, along the field's two axes
        angle = np.arctan2(sideways, forward) / np.where(sideways > 0, sideways, 1.0)
        parted = [angle * part for part in across]
        if view["horizontal"] >= 2 * math.pi - AGREEMENT:
            # of a sensor that turns all around, turns and heights say where rays are
            parted = [np.arctan2(across[0], forward), np.arcsin(np.clip(across[1], -1.0, 1.0))]
        most = [float(np.abs(part).max(initial=0.0)) * 2 for part in parted]
        name = str(sensor.get("name", index))
        checks = [
            ConstraintCheck(f"{name}.rays.{axis}_rad", view[axis], value, value <= view[axis] + AGREEMENT)
            for axis, value in zip(ANGLES, most, strict=True)
        ]
        ends = [float(start.min(initial=gate["start"])), float(end.max(initial=gate["end"]))]
        slack = AGREEMENT * gate["end"]
        kept = ends[0] >= gate["start"] - slack and ends[1] <= gate["end"] + slack
        checks += [
            ConstraintCheck(f"{name}.rays.gate_m", [gate["start"], gate["end"]], ends, kept),
            _starts(name, pattern, own, sensor["origin_m"], level),
        ]
        failed += [check for check in checks if not check.satisfied]
    return failed


def _frame(sensor: Mapping[str, Any]) -> np.ndarray:
    """The frame of a sensor's boresight, shape (3, 3)."""
    aimed = sensor["boresight"]
    return boresight_frame(aimed["azimuth_rad"], aimed["elevation_rad"], aimed.get("roll_rad") or 0.0)


def _starts(
    name: str, pattern: Mapping[str, Any], own: np.ndarray, origin: Mapping[str, Any], level: float
) -> ConstraintCheck:
    """A check that rays start at their sensor's place, or in the ellipsoid of its region that holds the level."""
    starts = np.stack([np.asarray(pattern[f"origin_{axis}"], dtype=float)[:, own].ravel() for axis in AXES], axis=1)
    # along a condition sensors are carried
    away = (starts - np.asarray(origin["mean"])) * [axis != pattern.get("dimension") for axis in AXES]
    variances, axes = np.linalg.eigh(np.asarray(origin.get("covariance") or np.zeros((3, 3)), dtype=np.float64))
    free, quantile = int((variances > ROUNDING * variances[-1]).sum()), 0.0
    if free:
        # slow to import
        from scipy.special import chdtri

        quantile = float(chdtri(free, 1 - level))
    far = np.square(away @ axes / (np.sqrt(np.maximum(variances, 0.0) * quantile) + AGREEMENT)).sum(axis=1)
    worst = starts[far.argmax()].tolist() if len(far) else origin["mean"]
    return ConstraintCheck(f"{name}.rays.origin_m", list(origin["mean"]), worst, bool((far <= 1).all()))


def _budget(document: Mapping[str, Any], budget: Mapping[str, Any]) -> list[ConstraintCheck]:
    """Checks of the number of rays and their bandwidth: rays times whole bins times bits times frames [Mbit/s]."""
    bin_m = LIGHT_M_PER_S * budget.get("bin_ps", 100.0) * PICOSECOND_S / 2
    widths = [_pattern_widths(pattern, bin_m) for pattern in _patterns(document)]
    asked, limit, checks = budget.get("rays"), budget.get("bandwidth_mbps"), []
    own = _get(document, "constraints", "budget", "rays")
    rays = asked if own is None else own
    if not widths and rays is not None:
        widths = [_even_widths(document["sensors"], rays)]
    if asked is not None:
        counts = [len(each) for each in widths]
        checks.append(ConstraintCheck("budget.rays", asked, counts[-1], set(counts) == {asked}))
    if limit is not None:
        mbps = None
        if widths:
            bins = max(np.maximum(np.ceil(each / bin_m * (1 - BIN_ROUNDING)), 1).sum() for each in widths)
            mbps = float(bins) * budget.get("bits_per_bin", 40.0) * budget.get("rate_hz", 10.0) / 1e6
        kept = mbps is not None and mbps <= limit + _slack(limit)
        checks.append(ConstraintCheck("budget.bandwidth_mbps", limit, mbps, kept))
    return checks


def _even_widths(sensors: Sequence[Mapping[str, Any]], rays: int) -> np.ndarray:
    """The gate width of each even ray, (rays,) [m]; rays are split by weight with largest remainders, each one."""
    quotas = np.array([sensor["weight"] for sensor in sensors]) * rays
    counts = np.floor(quotas + AGREEMENT)
    for index in np.argsort(-(np.round(quotas - counts, 9)), kind="stable")[: rays - int(counts.sum())]:
        counts[index] += 1
    while counts.min() == 0 and counts.max() > 1:
        counts[counts.argmax()] -= 1
        counts[counts.argmin()] += 1
    widths = [sensor["gate_m"]["end"] - sensor["gate_m"]["start"] for sensor in sensors]
    return np.repeat(widths, counts.astype(int))


def _pattern_widths(pattern: Mapping[str, Any], bin_m: float) -> np.ndarray:
    """Gate widths of a pattern at the condition value where they cost most bandwidth, shape (rays,) [m].

    They are linear between knots, so the number of bins changes only where a width crosses a whole number of bins; one
    value between each two crossings is tried.
    """
    width = np.array(pattern["gate_end_m"], dtype=np.float64) - np.array(pattern["gate_start_m"], dtype=np.float64)
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
    return every[bins.argmax()]


def _parts(document: Mapping[str, Any], parts: Mapping[str, Any] | None) -> list[ConstraintCheck]:
    """Checks that every sensor is an admitted part as its file describes it, within the numbers and power allowed.

    Without constraints on parts, failed checks of the sensors that name one.
    """
    is_free, parts = parts is None, parts or {}
    named = [] if parts.get("names", "catalog") == "catalog" else list(parts["names"])
    checks, found = [], []
    for index, sensor in enumerate(document["sensors"]):
        name, own = f"{sensor.get('name', index)}.part", sensor.get("part")
        part = None if own is None else _admitted_part(str(own), named)
        if part is None:
            value, kept = own or "a sensor of its own", is_free and own is None
            checks.append(ConstraintCheck(name, named or "the catalogue", value, kept))
            continue
        found.append(part)
        wrong = _differences(part, index, sensor, next(iter(document.get("patterns") or ()), None))
        checks.append(ConstraintCheck(name, part.name, wrong or part.name, wrong is None))
    for own, rule in (parts.get("each") or {}).items():
        # a bare name counts all its modes
        checks += _between(f"parts.each.{own}", sum(f"{part.name}:".startswith(f"{own}:") for part in found), rule)
    for name, rule in (("power_w", {"max": parts.get("power_w")}), ("price", parts.get("price") or {})):
        if rule.get("max") is not None:
            total = sum(math.inf if part.value(name) is None else part.value(name) for part in found)
            checks += _between(f"parts.{name}", total, rule)
    return [check for check in checks if not (is_free and check.satisfied)]


def _admitted_part(name: str, named: Sequence[str]) -> Part | None:
    """The part of a name; None where it is unknown or the constraints do not admit it."""
    from lidardesign.parts.catalogue import SUFFIX, load_library

    # an entry is a name or a path, with a mode behind it or not
    entries: list[tuple[Path | None, str, str]] = []
    for text in named:
        path, mode = text.rsplit(":", 1) if f"{SUFFIX}:" in text else (text, "")
        if path.endswith(SUFFIX) or Path(path).is_dir():
            entries.append((Path(path), "", mode))
        else:
            entries.append((None, *text.partition(":")[::2]))
    try:
        part = load_library([path for path, _, _ in entries if path is not None]).part(name)
    except ConfigError:
        return None
    stem = name.partition(":")[0]
    file = Path(part.origin)
    admitted = any(
        (entry == stem if path is None else path in (file, file.parent)) and mode in ("", part.mode)
        for path, entry, mode in entries
    )
    return part if admitted or not named else None


def _differences(part: Part, index: int, sensor: Mapping[str, Any], pattern: Mapping[str, Any] | None) -> str | None:
    """The first difference of a sensor from its part, in words; None where they agree."""
    view = sensor["field_of_view_rad"]
    for key, expected in zip(ANGLES, part.field_of_view_rad, strict=True):
        if abs(view[key] - expected) > COARSE_SLACK:
            return f"a {key} field of view of {view[key]:g} instead of {expected:g} rad"
    (near, far), gate = part.range_m, sensor["gate_m"]
    if gate["start"] < near - COARSE_SLACK or gate["end"] > far + COARSE_SLACK:
        return f"a gate of {gate['start']:g} to {gate['end']:g} m, and the part measures {near:g} to {far:g} m"
    if not pattern:
        return "no pattern"
    # loaded here because few designs are of parts
    from scipy.spatial import cKDTree

    own = np.flatnonzero(np.asarray(pattern["sensor"]) == index)
    angles = ("azimuth_rad", "elevation_rad")
    azimuth, elevation = (np.asarray(pattern[key][0], dtype=np.float64)[own] for key in angles)
    to_part = (boresight_frame(*part.centre_rad).T @ _frame(sensor)).T
    away, ray = cKDTree(part.directions).query(direction(azimuth, elevation) @ to_part)
    starts = np.stack([np.asarray(pattern[f"origin_{axis}"][0], dtype=np.float64)[own] for axis in AXES], axis=1)
    moved = np.abs(starts - np.asarray(sensor["origin_m"]["mean"])).max(axis=1, initial=0.0) > COARSE_SLACK
    same = len(part.directions) - len(np.unique(part.directions, axis=0))
    # rays that are not in the part's pattern, start elsewhere or repeat
    strays = int(((away > COARSE_SLACK) | moved).sum()) + max(len(ray) - len(np.unique(ray)) - same, 0)
    return f"{strays} rays that the part does not have" if strays else None
