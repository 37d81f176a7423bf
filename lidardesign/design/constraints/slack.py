"""How much room a design leaves under each of its constraints: what one would have to loosen to gain anything.

Works on what the independent checker found; bounds that many sensors share are told once, by the closest sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from lidardesign.design.constraints.check import ConstraintCheck

# A bound with this share of itself left is one that the design leans on.
TIGHT_SHARE = 0.01
# Bounds of the design space hold for every sensor, whatever was asked for.
SPACE_MARK = "space."
# Where the bandwidth is the only bound whose name says nothing of its side.
UPPER_ENDS = (".max", ".high_m", "budget.bandwidth_mbps", "budget.power_w")
LOWER_ENDS = (".min", ".low_m")
FULL_TURN_DEG = 360.0


@dataclass(frozen=True)
class ConstraintSlack:
    """One bound, over all sensors that it holds for.

    Arguments:
        name: The key in the constraint file, as `gate.width_m.max`; of the design space as `space.range_m`.
        bound: What was asked for.
        value: What the closest of the sensors has; of a bound that is broken, what the worst has.
        sensor: The name of that sensor; empty where the bound is on the whole design.
        room: How far that is from the bound, in the bound's unit; negative where it is broken, None where a bound is
            kept or not, without a distance.
        share: The same as a share of the bound, of an interval of its width; None with no distance, or a bound of 0.
        sensors: How many sensors have this bound.
        tight: How many of them are within 1 % of it.
        broken: How many of them break it.
    """

    name: str
    bound: Any
    value: Any
    sensor: str
    room: float | None
    share: float | None
    sensors: int
    tight: int
    broken: int

    @property
    def word(self) -> str:
        """`broken`, `at the bound`, or `kept`."""
        return "broken" if self.broken else "at the bound" if self.tight else "kept"


def constraint_slack(checks: Iterable[ConstraintCheck], sensors: Sequence[str]) -> list[ConstraintSlack]:
    """How tight each bound is, in the order in which the checker comes to them.

    Arguments:
        checks: What the checker found on a design.
        sensors: The names of the design's sensors.
    """
    groups: dict[tuple[str, str], list[tuple[str, ConstraintCheck]]] = {}
    # the longest name first: one sensor's name may begin with another's
    names = sorted(sensors, key=len, reverse=True)
    for check in checks:
        owner = next((name for name in names if check.name.startswith(f"{name}.")), "")
        key = check.name.removeprefix(f"{owner}.") if owner else check.name
        groups.setdefault((key, repr(check.bound)), []).append((owner, check))
    return [_told(key, group) for (key, _), group in groups.items()]


def room_of(check: ConstraintCheck) -> tuple[float | None, float | None]:
    """How far a value is inside its bound, in the bound's unit and as a share of it; None without a distance."""
    bound, value = _numbers(check.bound), _numbers(check.value)
    if not bound or not value:
        return None, None
    if check.name.endswith(UPPER_ENDS) and len(bound) == len(value):
        return _nearest([(limit - found, abs(limit)) for limit, found in zip(bound, value, strict=True)])
    if check.name.endswith(LOWER_ENDS) and len(bound) == len(value):
        return _nearest([(found - limit, abs(limit)) for limit, found in zip(bound, value, strict=True)])
    if check.name.endswith(".boresight.azimuth_deg"):
        return _on_circle(bound[0], bound[1], value[0])
    if f".{SPACE_MARK}" in check.name and len(bound) == 2:
        low, high = bound
        return _nearest([(value[0] - low, high - low), (high - value[-1], high - low)])
    return None, None


def room_left(check: ConstraintCheck) -> float | None:
    """How far the value is inside its bound, in the bound's unit; negative beyond it, None without a distance."""
    return room_of(check)[0]


def share_left(check: ConstraintCheck) -> float | None:
    """The room left as a share of the bound; None without a bound of some size."""
    return room_of(check)[1]


def is_tight(check: ConstraintCheck) -> bool:
    """Whether next to nothing of a bound is left."""
    return _is_tight(*room_of(check))


def _on_circle(low: float, high: float, value: float) -> tuple[float, float | None]:
    """Room of an azimuth between two others [deg]."""
    width = high - low if high - low >= FULL_TURN_DEG else (high - low) % FULL_TURN_DEG
    past = (value - low) % FULL_TURN_DEG
    inside = min(past, width - past)
    # outside, the nearer end counts
    room = inside if inside >= 0 else -min(past - width, FULL_TURN_DEG - past)
    return room, room / width if width else None


def _nearest(rooms: list[tuple[float, float]]) -> tuple[float, float | None]:
    """The smallest room, and its share of the bound that it is to."""
    room, scale = min(rooms)
    return room, room / scale if scale else None


def _numbers(value: Any) -> list[float]:
    """A number, or a list of them, as a list; empty for anything else."""
    values = value if isinstance(value, list | tuple) else [value]
    plain = all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)
    return [float(one) for one in values] if plain and all(math.isfinite(one) for one in values) else []


def _told(key: str, group: Sequence[tuple[str, ConstraintCheck]]) -> ConstraintSlack:
    rooms = [room_of(check) for _, check in group]

    def closeness(index: int) -> tuple[bool, float]:
        room = rooms[index][0]
        return group[index][1].satisfied, math.inf if room is None else room

    first = min(range(len(group)), key=closeness)
    owner, check = group[first]
    room, share = rooms[first]
    tight = [one for one, (_, kept) in zip(rooms, group, strict=True) if kept.satisfied and _is_tight(*one)]
    broken = sum(not kept.satisfied for _, kept in group)
    return ConstraintSlack(key, check.bound, check.value, owner, room, share, len(group), len(tight), broken)


def _is_tight(room: float | None, share: float | None) -> bool:
    return room is not None and (room <= 0 if share is None else share <= TIGHT_SHARE)
