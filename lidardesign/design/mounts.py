"""Mounting points in a constraint file: which sensors have them, and whether there are enough for all."""

from __future__ import annotations

from collections.abc import Sequence

from lidardesign.design.constraints import Constraints

Mount = tuple[float, float, float]


def mounts_of(constraints: Constraints, sensor: int) -> list[Mount]:
    """The mounts that one sensor may take; none where it is not mounted."""
    listed = constraints.of_sensor(sensor).origin.mounts_m or []
    return [(x, y, z) for x, y, z in listed]


def is_mounted(constraints: Constraints) -> bool:
    """Whether any sensor sits at a mount."""
    return any(mounts_of(constraints, sensor) for sensor in range(len(constraints.each) + 1))


def most_mounted(constraints: Constraints) -> int | None:
    """The largest number of sensors that all find a mount; None where the number is not limited.

    Sensors beyond the entries of `each` share the common list.
    """
    common = mounts_of(constraints, len(constraints.each))
    count = len(constraints.each) + len(common)
    options = [mounts_of(constraints, sensor) for sensor in range(count)]
    while not matched(options[:count]):
        count -= 1
    return None if not common and count == len(constraints.each) else count


def matched(options: Sequence[Sequence[Mount]]) -> bool:
    """Whether every mounted sensor can have a mount of its own (augmenting paths; H. Kuhn 1955)."""
    taken: dict[Mount, int] = {}

    def place(sensor: int, tried: set[Mount]) -> bool:
        for mount in options[sensor]:
            if mount not in tried:
                tried.add(mount)
                if mount not in taken or place(taken[mount], tried):
                    taken[mount] = sensor
                    return True
        return False

    return all(place(sensor, set()) for sensor, mounts in enumerate(options) if mounts)


def fixed_at(constraints: Constraints, places: Sequence[Mount | None]) -> Constraints:
    """The constraints with sensor i fixed at the i-th place, and no mounts left to choose."""
    each = []
    for sensor, place in enumerate(places):
        one = constraints.of_sensor(sensor)
        if place is not None:
            origin = one.origin.model_copy(update={"mounts_m": None, "fixed_m": list(place)})
            one = one.model_copy(update={"origin": origin})
        each.append(one)
    common = constraints.origin.model_copy(update={"mounts_m": None})
    return constraints.model_copy(update={"origin": common, "each": each})
