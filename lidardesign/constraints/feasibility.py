"""Contradictions among constraints, as smallest conflicting sets, found before anything is sampled.

Start, end and width of a gate are difference constraints on two numbers, so every contradiction is a cycle
through at most three bounds: all five kinds of cycle are checked with the tightest bound of each kind.

The bandwidth budget: the number of rays and the common gate width that it affords.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.constraints.document import MOST_ROLL_DEG, Constraints, SensorRules
from lidardesign.constraints.origins import free_boxes, most_mounted, mounts_of, snap_place_to_space
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import SLACK
from lidardesign.run.yaml import leaves
from lidardesign.sensors.bandwidth import Bandwidth, split_budget
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, RANGE, DesignSpace

# Bounds that differ by less come from the same number through degrees and radians [m or rad].
AGREEMENT = SLACK
# Lengths beyond so many times the space, and smaller fields of view, are probably in another unit.
DOUBTFUL_TIMES, DOUBTFUL_DEG = 10.0, 1.0


@dataclass(frozen=True)
class _Bound:
    """A bound and its name; an empty name is left out of messages."""

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
    count = constraints.sensors
    if count.min is not None and count.max is not None and count.min > count.max:
        _refuse(f"at least {count.min} and at most {count.max} sensors", ["sensors.min", "sensors.max"])
    asked = "--sensors" if constraints.parts is None or constraints.parts.count != sensors else "parts.count"
    named = [
        ("sensors.count", count.count, count.count),
        (asked, sensors, sensors),
        ("sensors.min", count.min, None),
        ("sensors.max", None, count.max),
        ("each", len(constraints.each) or None, None),
    ]
    for (low_name, low, _), (high_name, _, high) in itertools.product(named, named):
        if low is not None and high is not None and low > high:
            _refuse(f"{low} sensors requested, but at most {high} allowed", [low_name, high_name])
    # of equal numbers the option is named
    lows = [_Bound(low, name) for name, low, _ in (named[1], *named) if low is not None]
    least = max(lows, key=lambda bound: bound.value, default=_Bound(1, ""))
    # Every mounted sensor needs a mount of its own
    most = most_mounted(constraints.rules)
    if most is not None and most < least.value:
        # the common rules name mounts only where no entry of `each` does
        own = constraints.rules[:-1] or constraints.rules
        mounted = [one.path("origin.mounts_m") for one in own if one.origin.mounts_m]
        lost = [one.path("origin.exclude") for one in own if len(mounts_of(one)) < len(one.origin.mounts_m or [])]
        _refuse(f"{least.value:g} sensors for {most} mounts", [least.name or "sensors", *mounted, *lost])
    # the last rules are those of sensors beyond the entries of `each`
    needed = constraints.rules if least.value > len(constraints.each) else constraints.rules[:-1]
    for rules in needed:
        _check_origin(rules, space)
        # Mounts are alternatives to a fixed origin, inside the design space and the box
        name = rules.path("origin.mounts_m")
        if rules.origin.mounts_m is not None and rules.origin.fixed_m is not None:
            _refuse("an origin is either fixed or at one of several mounts", [rules.path("origin.fixed_m"), name])
        for number, mount in enumerate(rules.origin.mounts_m or []):
            for axis, value in enumerate(mount):
                lows, highs = _origin_limits(rules, axis, space)
                beyond = [
                    *(low for low in lows if value < low.value - AGREEMENT),
                    *(high for high in highs if value > high.value + AGREEMENT),
                ]
                if beyond:
                    text = f"{DIMENSIONS[axis]} of a mount is {value:g}, beyond {beyond[0].value:g}"
                    _refuse(text, [f"{name}[{number}]", beyond[0].name])
        _check_excluded(rules, space)
        _check_boresight(rules, space, are_parts=constraints.parts is not None)
        _check_field(rules, space)
        _check_gate(rules, space)
    _check_budget(constraints, needed, least, rays)


def unit_notes(constraints: Constraints, space: DesignSpace) -> list[str]:
    """Questions about bounds that are probably in millimetres or radians: far beyond the space, or below a degree."""
    most_m = DOUBTFUL_TIMES * max(map(abs, (*space.low[:3], *space.high[:3], space.high[RANGE])))
    given = {
        ".".join(map(str, path)): value
        for path, value in leaves(constraints.as_document())
        if isinstance(value, int | float) and "exclude" not in path
    }
    far = {name: value for name, value in given.items() if "_m." in f"{name}." and abs(value) > most_m}
    narrow = {name: value for name, value in given.items() if "field_of_view" in name and 0 < value < DOUBTFUL_DEG}
    # whoever means degrees writes few digits
    unrounded = {
        name: value
        for name, value in given.items()
        if "boresight" in name and abs(value) <= math.tau and not (2 * value).is_integer()
    }
    return [
        *(f"{name}={value:g} is far beyond the design space: in millimetres?" for name, value in far.items()),
        *(f"{name}={value:g} is a very small angle: in radians?" for name, value in {**narrow, **unrounded}.items()),
    ]


def _refuse(message: str, conflicts: Sequence[str]) -> None:
    names = [name for name in dict.fromkeys(conflicts) if name]
    hint = "loosen one of the constraints named"
    if any(name.startswith("space.") for name in names):
        hint = "loosen the constraint; space is the run's, and another one has to be learned"
    raise InfeasibleError(f"{message} ({', '.join(names)})", conflicts=names, hint=hint)


def _origin_limits(rules: SensorRules, axis: int, space: DesignSpace) -> tuple[list[_Bound], list[_Bound]]:
    """Lower and upper bounds on a coordinate of the origin [m]."""
    name, origin = f"space.{DIMENSIONS[axis]}", rules.origin
    lows, highs = [_Bound(space.low[axis], name)], [_Bound(space.high[axis], name)]
    if origin.low_m is not None:
        lows.append(_Bound(origin.low_m[axis], rules.path("origin.low_m")))
    if origin.high_m is not None:
        highs.append(_Bound(origin.high_m[axis], rules.path("origin.high_m")))
    return lows, highs


def _check_origin(rules: SensorRules, space: DesignSpace) -> None:
    """Refuse an origin box or a fixed origin outside the design space."""
    fixed = None if rules.origin.fixed_m is None else snap_place_to_space(rules.origin.fixed_m, space)
    for axis in range(3):
        lows, highs = _origin_limits(rules, axis, space)
        if fixed is not None:
            place = _Bound(fixed[axis], rules.path("origin.fixed_m"))
            lows, highs = [*lows, place], [*highs, place]
        for low, high in itertools.product(lows, highs):
            if low.value > high.value + AGREEMENT:
                text = f"{DIMENSIONS[axis]} of the origin is at least {low.value:g} and at most {high.value:g}"
                _refuse(text, [low.name, high.name])


def _check_excluded(rules: SensorRules, space: DesignSpace) -> None:
    """Refuse excluded boxes that leave no room for a sensor's origin, or no mount."""
    origin, name = rules.origin, rules.path("origin.exclude")
    if not origin.exclude:
        return
    if origin.mounts_m is not None:
        if not mounts_of(rules):
            _refuse("every mount lies in an excluded box", [rules.path("origin.mounts_m"), name])
        return

    def has_room(**changes: object) -> bool:
        return len(free_boxes(replace(rules, origin=origin.model_copy(update=changes)), space).low_m) > 0

    if has_room():
        return
    alone = [number for number, box in enumerate(origin.exclude) if not has_room(exclude=[box])]
    given = [key for key in ("low_m", "high_m", "fixed_m") if getattr(origin, key) is not None]
    subsets = (subset for count in range(len(given) + 1) for subset in itertools.combinations(given, count))
    fewest = next(keys for keys in subsets if not has_room(**{key: None for key in given if key not in keys}))
    boxes = "an excluded box holds" if alone else "the excluded boxes hold"
    place = "its fixed origin" if fewest == ("fixed_m",) else "all origins"
    bounds = [rules.path(f"origin.{key}") for key in fewest] or [f"space.{DIMENSIONS[axis]}" for axis in range(3)]
    _refuse(f"{boxes} {place}", [f"{name}[{alone[0]}]" if alone else name, *bounds])


def _check_boresight(rules: SensorRules, space: DesignSpace, *, are_parts: bool) -> None:
    elevation, azimuth = rules.boresight.elevation_deg, rules.boresight.azimuth_deg
    low_name, high_name = (rules.path(f"boresight.elevation_deg.{end}") for end in ("min", "max"))
    if elevation.min is not None and elevation.max is not None and elevation.min > elevation.max:
        _refuse(f"elevation at least {elevation.min:g} and at most {elevation.max:g} degrees", [low_name, high_name])
    if elevation.min is not None and math.radians(elevation.min) > space.high[ELEVATION] + AGREEMENT:
        _refuse("the boresight's elevation lies above the design space", [low_name, "space.elevation_rad"])
    if elevation.max is not None and math.radians(elevation.max) < space.low[ELEVATION] - AGREEMENT:
        _refuse("the boresight's elevation lies below the design space", [high_name, "space.elevation_rad"])
    roll = rules.boresight.roll_deg
    low, high = -math.inf if roll.min is None else roll.min, math.inf if roll.max is None else roll.max
    names = [rules.path(f"boresight.roll_deg.{end}") for end in ("min", "max") if getattr(roll, end) is not None]
    if low > high:
        _refuse(f"a roll of at least {low:g} and at most {high:g} degrees", names)
    if not are_parts and (low > MOST_ROLL_DEG or high < -MOST_ROLL_DEG):
        _refuse("beyond 45 degrees a field is the same with its two angles exchanged", names)
    if not space.turns and not low <= 0 <= high:
        _refuse("the roll is 0 where the design space holds all rays in a plane", [*names, "space"])
    ends = [end for end in ("min", "max") if getattr(azimuth, end) is not None]
    if not ends or space.full_azimuth:
        return

    def inside(angle: float, start: float, end: float) -> bool:
        past = math.fmod(math.fmod(angle - start, 2 * math.pi) + 2 * math.pi, 2 * math.pi)
        return past <= end - start + AGREEMENT or past >= 2 * math.pi - AGREEMENT

    low, high = azimuth_interval(rules, space)
    if not (inside(low, space.low[AZIMUTH], space.high[AZIMUTH]) or inside(space.low[AZIMUTH], low, high)):
        names = [rules.path(f"boresight.azimuth_deg.{end}") for end in ends]
        _refuse("the boresight's azimuth lies outside the design space", [*names, "space.azimuth_rad"])


def azimuth_interval(rules: SensorRules, space: DesignSpace) -> tuple[float, float]:
    """The admitted azimuths as low and high of one arc, high in [low, low + 2 pi]; a missing end is the space's."""
    given = rules.boresight.azimuth_deg
    low = space.low[AZIMUTH] if given.min is None else math.radians(given.min)
    high = space.high[AZIMUTH] if given.max is None else math.radians(given.max)
    if high - low >= 2 * math.pi:
        return low, low + 2 * math.pi
    return low, low + math.fmod(math.fmod(high - low, 2 * math.pi) + 2 * math.pi, 2 * math.pi)


def _check_field(rules: SensorRules, space: DesignSpace) -> None:
    for axis, dimension in (("horizontal", AZIMUTH), ("vertical", ELEVATION)):
        bounds = getattr(rules.field_of_view, f"{axis}_deg")
        low_name, high_name = (rules.path(f"field_of_view.{axis}_deg.{end}") for end in ("min", "max"))
        if bounds.min is not None and bounds.max is not None and bounds.min > bounds.max:
            _refuse(
                f"{axis} field of view at least {bounds.min:g} and at most {bounds.max:g} degrees",
                [low_name, high_name],
            )
        if bounds.min and dimension not in space.free:
            _refuse(
                f"a {axis} field of view, but the design space fixes that angle",
                [low_name, f"space.{DIMENSIONS[dimension]}"],
            )


def _check_gate(rules: SensorRules, space: DesignSpace) -> None:
    """Refuse contradictory bounds on a gate, with the conflict of the fewest bounds."""

    def bounds(part: str, end: str, *others: _Bound) -> list[_Bound]:
        value = getattr(getattr(rules.gate, part), end)
        own = [] if value is None else [_Bound(value, rules.path(f"gate.{part}.{end}"))]
        return [*own, *others]

    # a bound that the others do not need to conflict is not named: distances are at least 0, and so are widths
    zero, thick = _Bound(0.0, ""), RANGE in space.free
    near, far = _Bound(space.low[RANGE], "space.range_m"), _Bound(space.high[RANGE], "space.range_m")
    start_low, start_high = bounds("start_m", "min", near, zero), bounds("start_m", "max")
    end_low, end_high = bounds("end_m", "min"), bounds("end_m", "max", far)
    width_low = bounds("width_m", "min", zero)
    width_high = bounds("width_m", "max", *([] if thick else [_Bound(0.0, "space.range_m")]))
    text = "no gate can satisfy this"
    conflicts: list[tuple[str, list[str]]] = []
    for lows, highs in ((start_low, start_high), (end_low, end_high), (width_low, width_high)):
        for low, high in itertools.product(lows, highs):
            if low.value > high.value + AGREEMENT:
                message = f"{text}: at least {low.value:g} and at most {high.value:g} m"
                conflicts.append((message, [low.name, high.name]))
    for start, width, end in itertools.product(start_low, width_low, end_high):
        room = end.value - start.value
        if width.value > room + AGREEMENT or (thick and room <= 0):
            message = f"{text}: it starts at {start.value:g} m or later, is at least {width.value:g} m wide"
            names = [start.name, width.name, end.name]
            conflicts.append((f"{message}, and ends at {end.value:g} m or earlier", names))
    for end, width, start in itertools.product(end_low, width_high, start_high):
        if end.value - width.value > start.value + AGREEMENT:
            message = f"{text}: it ends at {end.value:g} m or later, is at most {width.value:g} m wide"
            names = [end.name, width.name, start.name]
            conflicts.append((f"{message}, and starts at {start.value:g} m or earlier", names))
    if conflicts:
        _refuse(*min(conflicts, key=lambda conflict: len(set(conflict[1]) - {""})))


def _check_budget(constraints: Constraints, needed: Sequence[SensorRules], least: _Bound, asked: int | None) -> None:
    """Refuse fewer rays than sensors, or a bandwidth below that of their narrowest gates."""
    budget = constraints.budget
    if asked is not None and budget.rays is not None and asked != budget.rays:
        _refuse(f"{asked} and {budget.rays} rays requested", ["--rays", "budget.rays"])
    given = _Bound(asked, "--rays") if budget.rays is None else _Bound(budget.rays, "budget.rays")
    if given.value is not None and given.value < least.value:
        _refuse(f"{given.value} rays for {least.value:g} sensors", [given.name, least.name or "sensors"])
    if budget.bandwidth_mbps is None:
        return
    widths = [least_width(rules) for rules in needed]
    numbers = [_Bound(1, ""), least] + ([given] if given.value is not None else [])
    common, least_of_all = least_width(constraints.rules[-1]), min(width for width, _ in widths)
    narrowest = [(0.0, []), (least_of_all, [name for _, names in widths for name in names])]
    # bounds on all sensors make a shorter conflict than those of single ones
    narrowest += [common] if common[0] <= least_of_all else []
    # the fewest names first: one ray of any gate, then as many as are asked for, then as wide as is asked for
    for (width, names), rays in sorted(itertools.product(narrowest, numbers), key=lambda pair: len(pair[0][1])):
        mbps = budget.readout.mbps_of_widths([width], int(rays.value))
        if mbps > budget.bandwidth_mbps:
            text = f"{rays.value:g} rays need at least {mbps:g} Mbit/s, more than {budget.bandwidth_mbps:g} Mbit/s"
            _refuse(text, [rays.name, "budget.bandwidth_mbps", *names])


def most_rays(constraints: Constraints) -> int | None:
    """The number of rays that the bandwidth affords with the narrowest gates, at least 1; None without a limit."""
    budget = constraints.budget
    if budget.bandwidth_mbps is None:
        return None
    narrowest = min(least_width(rules)[0] for rules in constraints.rules)
    return max(int(budget.bandwidth_mbps / budget.readout.mbps_of_widths([narrowest], 1)), 1)


def least_width(rules: SensorRules) -> tuple[float, list[str]]:
    """The narrowest gate that a sensor's rules admit [m], and the names of the bounds that set it."""
    gate = rules.gate
    widths: list[tuple[float, list[str]]] = [(0.0, [])]
    if gate.width_m.min is not None:
        widths.append((gate.width_m.min, ["gate.width_m.min"]))
    if gate.end_m.min is not None and gate.start_m.max is not None:
        widths.append((gate.end_m.min - gate.start_m.max, ["gate.end_m.min", "gate.start_m.max"]))
    width, keys = max(widths, key=lambda pair: pair[0])
    return width, [rules.path(key) for key in keys]


@dataclass(frozen=True)
class BandwidthBudget:
    """The bandwidth of sensors whose rays share the sensor's gate.

    Arguments:
        model: Bins, bits and rate.
        limit_mbps: The budget; None is none.
        rays: Rays per frame; None leaves them to the budget.
        names: The bounds that keep the bandwidth from being smaller: number of rays, least gate widths.
    """

    model: Bandwidth
    limit_mbps: float | None
    rays: int | None
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, constraints: Constraints, rays: int | None) -> BandwidthBudget:
        """The budget of a constraint file and an option."""
        budget = constraints.budget
        names = ["budget.rays"] if budget.rays is not None else ["--rays"] if rays is not None else []
        names += [name for rules in constraints.rules for name in least_width(rules)[1]]
        wanted = budget.rays if rays is None else rays
        return cls(budget.readout, budget.bandwidth_mbps, wanted, tuple(dict.fromkeys(names)))

    def mbps(self, widths_m: np.ndarray, weights: np.ndarray, rays: int) -> float:
        """Bandwidth of gates (K,) [m] whose rays are split by weights (K,)."""
        return self.model.mbps_of_widths(widths_m, split_budget(weights, rays, each=True))

    def fits(self, widths_m: np.ndarray, weights: np.ndarray, rays: int) -> bool:
        """True where this number of rays keeps the budget."""
        return self.limit_mbps is None or self.mbps(widths_m, weights, rays) <= self.limit_mbps

    def affordable_rays(self, widths_m: np.ndarray, weights: np.ndarray) -> int:
        """The number of rays that the budget affords, at least one per sensor (which may exceed it)."""
        bins_per_ray = float(np.dot(weights / np.sum(weights), self.model.bins(widths_m)))
        rays = int((self.limit_mbps or 0.0) / (bins_per_ray * self.model.mbps_of_widths(np.zeros(1), 1)))
        # largest remainders may hand spare rays to the wider gates
        while rays > len(widths_m) and not self.fits(widths_m, weights, rays):
            rays -= 1
        return max(rays, len(widths_m))


def affordable_bins(budget: BandwidthBudget, widths: np.ndarray, weights: np.ndarray, rays: int) -> int:
    """The largest common cap in bins that keeps the budget with the present weights, at least 1."""
    counts = split_budget(weights, rays, each=True)
    bins = budget.model.bins(widths)
    unit = budget.model.mbps_of_widths(np.zeros(1), 1)
    wider = range(2, int(bins.max()) + 1)
    return 1 + bisect.bisect_right(
        wider, budget.limit_mbps or 0.0, key=lambda cap: unit * int(np.dot(counts, np.minimum(bins, cap)))
    )
