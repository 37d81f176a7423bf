"""The slack of each constraint of a design: the tight ones are those to loosen.

Computed from the independent checks; a bound that several sensors share has one row, that of the tightest sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from lidardesign.constraints.check import ConstraintCheck

# A bound with this share of itself left is one that the design leans on.
TIGHT_SHARE = 0.01
# Bounds of the design space hold for every sensor, whatever was asked for.
SPACE_MARK = "space."
# Names of bounds by their side; the budgets are upper bounds without `.max`.
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


class Room(NamedTuple):
    """The slack of a bound; both values are None where the bound has no distance.

    Arguments:
        room: In the bound's unit; negative beyond the bound.
        share: As a share of the bound, of an interval of its width; None of a bound of 0.
    """

    room: float | None
    share: float | None

    @property
    def is_tight(self) -> bool:
        """True where the slack is at most `TIGHT_SHARE` of the bound, or no more than 0."""
        return self.room is not None and (self.room <= 0 if self.share is None else self.share <= TIGHT_SHARE)


def constraint_slack(checks: Iterable[ConstraintCheck], sensors: Sequence[str]) -> list[ConstraintSlack]:
    """The slack of each bound, in the order of the checks.

    Arguments:
        checks: The checks of a design.
        sensors: The names of the design's sensors.
    """
    groups: dict[tuple[str, str], list[tuple[str, ConstraintCheck, Room]]] = {}
    for check in checks:
        owner, key = split_name(check.name, sensors)
        groups.setdefault((key, repr(check.bound)), []).append((owner, check, room_of(check)))
    rows = []
    for (key, _), group in groups.items():
        # the check furthest beyond its bound, else the closest to it
        order = [(check.satisfied, math.inf if room.room is None else room.room) for _, check, room in group]
        owner, check, (room, share) = group[order.index(min(order))]
        tight = sum(check.satisfied and room.is_tight for _, check, room in group)
        broken = sum(not check.satisfied for _, check, _ in group)
        rows.append(ConstraintSlack(key, check.bound, check.value, owner, room, share, len(group), tight, broken))
    return rows


def broken_notes(name: str, checks: Iterable[ConstraintCheck]) -> list[str]:
    """A line on the first bound that a design breaks, its constraints' or its own sensors'; else an empty list.

    Those of the design space are left out: other spaces may be larger.
    """
    broken = [check for check in checks if not check.satisfied and f".{SPACE_MARK}" not in check.name]
    more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
    return [
        f"{name} breaks {one.name}{more}: it has {_said(one.value)}, allowed is {_said(one.bound)}; "
        "lidardesign show DESIGN lists all"
        for one in broken[:1]
    ]


def _said(value: Any) -> Any:
    return ", ".join(f"{one:.4g}" for one in _numbers(value)) or value


def split_name(name: str, sensors: Sequence[str]) -> tuple[str, str]:
    """The sensor that a check is of, empty where it is of the whole design, and the key of its bound."""
    # one sensor's name may begin with another's
    owner = max((sensor for sensor in sensors if name.startswith(f"{sensor}.")), key=len, default="")
    return owner, name.removeprefix(f"{owner}.") if owner else name


def room_of(check: ConstraintCheck) -> Room:
    """The slack of a check."""
    bound, value = _numbers(check.bound), _numbers(check.value)
    # room and the scale of its share, at each end
    ends: list[tuple[float, float]] = []
    if check.name.endswith(UPPER_ENDS) and len(bound) == len(value):
        ends = [(limit - found, abs(limit)) for limit, found in zip(bound, value, strict=True)]
    elif check.name.endswith(LOWER_ENDS) and len(bound) == len(value):
        ends = [(found - limit, abs(limit)) for limit, found in zip(bound, value, strict=True)]
    elif check.name.endswith(".boresight.azimuth_deg") and bound and value:
        low, high = bound
        width = high - low if high - low >= FULL_TURN_DEG else (high - low) % FULL_TURN_DEG
        past = (value[0] - low) % FULL_TURN_DEG
        inside = min(past, width - past)
        # outside, the nearer end counts
        ends = [(inside if inside >= 0 else -min(past - width, FULL_TURN_DEG - past), width)]
    elif f".{SPACE_MARK}" in check.name and len(bound) == 2 and value:
        low, high = bound
        ends = [(value[0] - low, high - low), (high - value[-1], high - low)]
    if not ends:
        return Room(None, None)
    room, scale = min(ends)
    return Room(room, room / scale if scale else None)


def _numbers(value: Any) -> list[float]:
    """A number, or a list of them, as a list; empty for anything else."""
    values = value if isinstance(value, list | tuple) else [value]
    plain = all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)
    return [float(one) for one in values] if plain and all(math.isfinite(one) for one in values) else []
