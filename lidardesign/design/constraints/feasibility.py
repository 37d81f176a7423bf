"""Contradictions among constraints, found before anything is sampled, by the smallest set that conflicts.

Start, end and width of a gate are difference constraints on two numbers, so every contradiction is a cycle
through at most three bounds: all five kinds of cycle are checked with the tightest bound of each kind.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.constraints.document import Constraints, SensorConstraints
from lidardesign.design.constraints.origins import free_boxes, most_mounted, mounts_of, snap_place_to_space
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import SLACK
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, RANGE, DesignSpace

# Bounds that differ by less come from the same number through degrees and radians [m or rad].
AGREEMENT = SLACK


@dataclass(frozen=True)
class _Bound:
    """One bound and the name it is found under; an empty name needs no mention."""

    value: float
    name: str


def check_feasible(
    constraints: Constraints, space: DesignSpace, *, sensors: int | None = None, rays: int | None = None
) -> None:
    """Refuse constraints that contradict each other or the design space.

    Arguments:
        constraints: A checked constraint file.
        space: The design space of the density.
        sensors: The number of sensors asked for elsewhere (an option), if any.
        rays: The number of rays asked for elsewhere, if any.

    Raises:
        InfeasibleError: With the conflicting names.
    """
    _check_count(constraints, sensors)
    _check_mount_count(constraints, sensors)
    for index in range(_entries(constraints, sensors)):
        one = constraints.of_sensor(index)
        _check_origin(constraints, one, index, space)
        _check_mounts(constraints, one, index, space)
        _check_excluded(constraints, one, index, space)
        _check_boresight(constraints, one, index, space)
        _check_field(constraints, one, index, space)
        _check_gate(constraints, one, index, space)
    _check_budget(constraints, sensors, rays)


def _entries(constraints: Constraints, sensors: int | None) -> int:
    """How many sensors differ in their constraints: those beyond the entries of `each` have the common ones."""
    return len(constraints.each) + (least_sensors(constraints, sensors).value > len(constraints.each))


def _refuse(message: str, conflicts: Sequence[str]) -> None:
    names = [name for name in dict.fromkeys(conflicts) if name]
    raise InfeasibleError(f"{message} ({', '.join(names)})", conflicts=names, hint="relax one of the constraints named")


def _check_count(constraints: Constraints, sensors: int | None) -> None:
    count = constraints.sensors
    if count.min is not None and count.max is not None and count.min > count.max:
        _refuse(f"at least {count.min} and at most {count.max} sensors", ["sensors.min", "sensors.max"])
    named = [("sensors.count", count.count, count.count), ("--sensors", sensors, sensors)]
    named += [("sensors.min", count.min, None), ("sensors.max", None, count.max)]
    named.append(("each", len(constraints.each) or None, None))
    for low_name, low, _ in named:
        for high_name, _, high in named:
            if low is not None and high is not None and low > high:
                _refuse(f"{low} sensors wanted, but at most {high} admitted", [low_name, high_name])


def _check_origin(constraints: Constraints, one: SensorConstraints, index: int, space: DesignSpace) -> None:
    low_name, high_name = (constraints.name_of(index, f"origin.{key}_m") for key in ("low", "high"))
    fixed_name = constraints.name_of(index, "origin.fixed_m")
    place = None if one.origin.fixed_m is None else snap_place_to_space(one.origin.fixed_m, space)
    for axis in range(3):
        bounds = f"space.{DIMENSIONS[axis]}"
        lows = [_Bound(space.low[axis], bounds)]
        highs = [_Bound(space.high[axis], bounds)]
        if one.origin.low_m is not None:
            lows.append(_Bound(one.origin.low_m[axis], low_name))
        if one.origin.high_m is not None:
            highs.append(_Bound(one.origin.high_m[axis], high_name))
        if place is not None:
            fixed = _Bound(place[axis], fixed_name)
            lows.append(fixed)
            highs.append(fixed)
        for low in lows:
            for high in highs:
                if low.value > high.value + AGREEMENT:
                    _refuse(
                        f"{DIMENSIONS[axis]} of the origin is at least {low.value:g} and at most {high.value:g}",
                        [low.name, high.name],
                    )


def _check_mounts(constraints: Constraints, one: SensorConstraints, index: int, space: DesignSpace) -> None:
    """Mounts are alternatives to a fixed origin, inside the design space and the box."""
    if one.origin.mounts_m is None:
        return
    name = constraints.name_of(index, "origin.mounts_m")
    if one.origin.fixed_m is not None:
        _refuse("an origin is fixed, or at one of several mounts", [constraints.name_of(index, "origin.fixed_m"), name])
    for number, mount in enumerate(one.origin.mounts_m):
        for axis, value in enumerate(mount):
            bounds = [_Bound(space.low[axis], f"space.{DIMENSIONS[axis]}")]
            bounds.append(_Bound(space.high[axis], f"space.{DIMENSIONS[axis]}"))
            for key in ("low_m", "high_m"):
                corner = getattr(one.origin, key)
                own = value if corner is None else corner[axis]
                bounds.append(_Bound(own, constraints.name_of(index, f"origin.{key}")))
            for low, high in (bounds[:2], bounds[2:]):
                beyond = low if value < low.value - AGREEMENT else high if value > high.value + AGREEMENT else None
                if beyond is not None:
                    text = f"{DIMENSIONS[axis]} of a mount is {value:g}, beyond {beyond.value:g}"
                    _refuse(text, [f"{name}[{number}]", beyond.name])


def _check_mount_count(constraints: Constraints, sensors: int | None) -> None:
    """Every mounted sensor needs a mount of its own."""
    least = least_sensors(constraints, sensors)
    most = most_mounted(constraints)
    if most is not None and most < least.value:
        names = [constraints.name_of(i, "origin.mounts_m") for i in range(len(constraints.each) or 1)]
        mounted = [name for i, name in enumerate(names) if constraints.of_sensor(i).origin.mounts_m]
        some = [constraints.name_of(i, "origin.exclude") for i in range(len(names)) if _lost_mounts(constraints, i)]
        _refuse(f"{least.value:g} sensors for {most} mounts", [least.name or "sensors", *mounted, *some])


def _lost_mounts(constraints: Constraints, index: int) -> bool:
    """Whether some of a sensor's mounts lie in an excluded box."""
    return len(mounts_of(constraints, index)) < len(constraints.of_sensor(index).origin.mounts_m or [])


def _check_excluded(constraints: Constraints, one: SensorConstraints, index: int, space: DesignSpace) -> None:
    """Excluded boxes leave room for a sensor's origin, or some of its mounts."""
    if not one.origin.exclude:
        return
    name = constraints.name_of(index, "origin.exclude")
    if one.origin.mounts_m is not None:
        if not mounts_of(constraints, index):
            _refuse("every mount lies in an excluded box", [constraints.name_of(index, "origin.mounts_m"), name])
        return
    if _has_room(one, space):
        return
    alone = [i for i, box in enumerate(one.origin.exclude) if not _has_room(_given(one, exclude=[box]), space)]
    given = [key for key in ("low_m", "high_m", "fixed_m") if getattr(one.origin, key) is not None]
    some = (kept for count in range(len(given) + 1) for kept in itertools.combinations(given, count))
    fewest = next(k for k in some if not _has_room(_given(one, **{key: None for key in given if key not in k}), space))
    bounds = [constraints.name_of(index, f"origin.{key}") for key in fewest]
    boxes = "an excluded box holds" if alone else "the excluded boxes hold"
    place = "its fixed origin" if fewest == ("fixed_m",) else "all origins"
    where = bounds or [f"space.{DIMENSIONS[axis]}" for axis in range(3)]
    _refuse(f"{boxes} {place}", [f"{name}[{alone[0]}]" if alone else name, *where])


def _has_room(one: SensorConstraints, space: DesignSpace) -> bool:
    return len(free_boxes(one, space).low_m) > 0


def _given(one: SensorConstraints, **values: object) -> SensorConstraints:
    """The constraints with other keys of the origin."""
    return one.model_copy(update={"origin": one.origin.model_copy(update=values)})


def _check_boresight(constraints: Constraints, one: SensorConstraints, index: int, space: DesignSpace) -> None:
    elevation = one.boresight.elevation_deg
    name = constraints.name_of(index, "boresight.elevation_deg.min")
    other = constraints.name_of(index, "boresight.elevation_deg.max")
    if elevation.min is not None and elevation.max is not None and elevation.min > elevation.max:
        _refuse(f"elevation at least {elevation.min:g} and at most {elevation.max:g} degrees", [name, other])
    if elevation.min is not None and math.radians(elevation.min) > space.high[ELEVATION] + AGREEMENT:
        _refuse("the boresight's elevation lies above the design space", [name, "space.elevation_rad"])
    if elevation.max is not None and math.radians(elevation.max) < space.low[ELEVATION] - AGREEMENT:
        _refuse("the boresight's elevation lies below the design space", [other, "space.elevation_rad"])
    given = one.boresight.azimuth_deg
    if (given.min is None and given.max is None) or space.full_azimuth:
        return
    low, high = azimuth_interval(one, space)
    if not _arcs_meet(low, high, space.low[AZIMUTH], space.high[AZIMUTH]):
        names = [
            constraints.name_of(index, f"boresight.azimuth_deg.{end}")
            for end in ("min", "max")
            if getattr(given, end) is not None
        ]
        _refuse("the boresight's azimuth lies outside the design space", [*names, "space.azimuth_rad"])


def azimuth_interval(one: SensorConstraints, space: DesignSpace) -> tuple[float, float]:
    """The admitted azimuths as low and high of one arc, high in [low, low + 2 pi]; a missing end is the space's."""
    given = one.boresight.azimuth_deg
    low = space.low[AZIMUTH] if given.min is None else math.radians(given.min)
    high = space.high[AZIMUTH] if given.max is None else math.radians(given.max)
    if high - low >= 2 * math.pi:
        return low, low + 2 * math.pi
    return low, low + math.fmod(math.fmod(high - low, 2 * math.pi) + 2 * math.pi, 2 * math.pi)


def _arcs_meet(low: float, high: float, other_low: float, other_high: float) -> bool:
    def inside(angle: float, start: float, end: float) -> bool:
        turned = math.fmod(math.fmod(angle - start, 2 * math.pi) + 2 * math.pi, 2 * math.pi)
        return turned <= end - start + AGREEMENT or turned >= 2 * math.pi - AGREEMENT

    return inside(low, other_low, other_high) or inside(other_low, low, high)


def _check_field(constraints: Constraints, one: SensorConstraints, index: int, space: DesignSpace) -> None:
    for axis, dimension in (("horizontal", AZIMUTH), ("vertical", ELEVATION)):
        bounds = getattr(one.field_of_view, f"{axis}_deg")
        name = constraints.name_of(index, f"field_of_view.{axis}_deg.min")
        other = constraints.name_of(index, f"field_of_view.{axis}_deg.max")
        if bounds.min is not None and bounds.max is not None and bounds.min > bounds.max:
            _refuse(
                f"{axis} field of view at least {bounds.min:g} and at most {bounds.max:g} degrees",
                [name, other],
            )
        fixed = dimension not in space.free
        if bounds.min and fixed:
            _refuse(
                f"a {axis} field of view, but the design space fixes that angle",
                [name, f"space.{DIMENSIONS[dimension]}"],
            )


def _check_gate(constraints: Constraints, one: SensorConstraints, index: int, space: DesignSpace) -> None:
    """Every cycle through bounds of any kind is looked at, and one that needs the fewest of them is told."""

    def bounds(part: str, end: str, *others: _Bound) -> list[_Bound]:
        value = getattr(getattr(one.gate, part), end)
        own = [] if value is None else [_Bound(value, constraints.name_of(index, f"gate.{part}.{end}"))]
        return [*own, *others]

    # a bound that the others do not need to conflict is not named: distances are at least 0, and so are widths
    zero, thick = _Bound(0.0, ""), RANGE in space.free
    near, far = _Bound(space.low[RANGE], "space.range_m"), _Bound(space.high[RANGE], "space.range_m")
    start_low, start_high = bounds("start_m", "min", near, zero), bounds("start_m", "max")
    end_low, end_high = bounds("end_m", "min"), bounds("end_m", "max", far)
    width_low = bounds("width_m", "min", zero)
    width_high = bounds("width_m", "max", *([] if thick else [_Bound(0.0, "space.range_m")]))
    text = "no gate can satisfy this"
    found: list[tuple[str, list[str]]] = []
    for lows, highs in ((start_low, start_high), (end_low, end_high), (width_low, width_high)):
        for low, high in itertools.product(lows, highs):
            if low.value > high.value + AGREEMENT:
                found.append((f"{text}: at least {low.value:g} and at most {high.value:g} m", [low.name, high.name]))
    for start, width, end in itertools.product(start_low, width_low, end_high):
        room = end.value - start.value
        if width.value > room + AGREEMENT or (thick and room <= 0):
            told = f"starts at {start.value:g} m or later, is at least {width.value:g} m wide"
            told = f"{text}: it {told}, and ends at {end.value:g} m or earlier"
            found.append((told, [start.name, width.name, end.name]))
    for end, width, start in itertools.product(end_low, width_high, start_high):
        if end.value - width.value > start.value + AGREEMENT:
            told = f"ends at {end.value:g} m or later, is at most {width.value:g} m wide"
            told = f"{text}: it {told}, and starts at {start.value:g} m or earlier"
            found.append((told, [end.name, width.name, start.name]))
    if found:
        _refuse(*min(found, key=lambda conflict: len(set(conflict[1]) - {""})))


def least_sensors(constraints: Constraints, sensors: int | None = None) -> _Bound:
    """The smallest number of sensors that the constraints admit, and where it stands."""
    count = constraints.sensors
    named = [
        (sensors, "--sensors"),
        (count.count, "sensors.count"),
        (count.min, "sensors.min"),
        (len(constraints.each) or None, "each"),
    ]
    bounds = [_Bound(value, name) for value, name in named if value is not None]
    return max(bounds, key=lambda b: b.value, default=_Bound(1, ""))


def _check_budget(constraints: Constraints, sensors: int | None, asked: int | None) -> None:
    budget, least = constraints.budget, least_sensors(constraints, sensors)
    if asked is not None and budget.rays is not None and asked != budget.rays:
        _refuse(f"{asked} and {budget.rays} rays asked for", ["--rays", "budget.rays"])
    given = _Bound(asked, "--rays") if budget.rays is None else _Bound(budget.rays, "budget.rays")
    if given.value is not None and given.value < least.value:
        _refuse(f"{given.value} rays for {least.value:g} sensors", [given.name, least.name or "sensors"])
    if budget.bandwidth_mbps is None:
        return
    model = Bandwidth(budget.bin_ps, budget.bits_per_bin, budget.rate_hz)
    widths = [least_width(constraints, index) for index in range(_entries(constraints, sensors))]
    numbers = [_Bound(1, ""), least] + ([given] if given.value is not None else [])
    common, least_of_all = least_width(constraints, len(constraints.each)), min(width for width, _ in widths)
    narrowest = [(0.0, []), (least_of_all, [name for _, names in widths for name in names])]
    # what all sensors must keep says more than what single ones must besides
    narrowest += [common] if common[0] <= least_of_all else []
    # the fewest names first: one ray of any gate, then as many as are asked for, then as wide as is asked for
    for (width, names), rays in sorted(itertools.product(narrowest, numbers), key=lambda one: len(one[0][1])):
        needed = model.mbps_of_widths([width], int(rays.value))
        if needed > budget.bandwidth_mbps:
            text = f"{rays.value:g} rays need at least {needed:g} Mbit/s, more than {budget.bandwidth_mbps:g} Mbit/s"
            _refuse(text, [rays.name, "budget.bandwidth_mbps", *names])


def most_rays(constraints: Constraints) -> int | None:
    """The number of rays that the bandwidth pays for with the narrowest gates, at least 1; None without a limit."""
    budget = constraints.budget
    if budget.bandwidth_mbps is None:
        return None
    narrowest = min(least_width(constraints, index)[0] for index in range(len(constraints.each) + 1))
    each_mbps = Bandwidth(budget.bin_ps, budget.bits_per_bin, budget.rate_hz).mbps_of_widths([narrowest], 1)
    return max(int(budget.bandwidth_mbps / each_mbps), 1)


def least_width(constraints: Constraints, index: int) -> tuple[float, list[str]]:
    """The narrowest gate that a sensor's constraints admit [m], and the names of those that keep it so wide."""
    gate = constraints.of_sensor(index).gate
    widths: list[tuple[float, list[str]]] = [(0.0, [])]
    if gate.width_m.min is not None:
        widths.append((gate.width_m.min, ["gate.width_m.min"]))
    if gate.end_m.min is not None and gate.start_m.max is not None:
        widths.append((gate.end_m.min - gate.start_m.max, ["gate.end_m.min", "gate.start_m.max"]))
    width, keys = max(widths, key=lambda one: one[0])
    return width, [constraints.name_of(index, key) for key in keys]
