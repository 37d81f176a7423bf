"""Mounting points in a constraint file: which sensors have them, and whether there are enough for all.

Where sensors are asked to stand and where a design space lets them: two numbers for one place are one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.mixture.origins import inside_excluded
from lidardesign.numerics import SLACK
from lidardesign.space import DIMENSIONS, DesignSpace

Mount = tuple[float, float, float]


def mounts_of(constraints: Constraints, sensor: int) -> list[Mount]:
    """The mounts that one sensor may take, those in an excluded box left out; none where it is not mounted."""
    one = constraints.of_sensor(sensor)
    listed = [(x, y, z) for x, y, z in one.origin.mounts_m or []]
    dropped = inside_excluded(np.array(listed, dtype=np.float64).reshape(-1, 3), one)
    return [mount for mount, inside in zip(listed, dropped, strict=True) if not inside]


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
    while not matched([mounts for mounts in options[:count] if mounts]):
        count -= 1
    return None if not common and count == len(constraints.each) else count


def matched(options: Sequence[Sequence[Mount]]) -> bool:
    """Whether each of some mounted sensors can have a mount of its own; one without any left cannot."""
    if not options or not all(options):
        return not options
    # loaded here because few constraint files have mounts
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    places = sorted({mount for mounts in options for mount in mounts})
    admitted = np.array([[mount in mounts for mount in places] for mounts in options], dtype=np.int8)
    return bool((maximum_bipartite_matching(csr_array(admitted), perm_type="column") >= 0).all())


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


def placement_notes(constraints: Constraints) -> tuple[str, ...]:
    """What the constraints say without effect: mounts in excluded boxes, and excluded boxes without volume."""
    notes = []
    for index in range(len(constraints.each) + 1):
        one = constraints.of_sensor(index)
        left, listed = mounts_of(constraints, index), one.origin.mounts_m or []
        name = constraints.name_of(index, "origin.exclude")
        if len(left) < len(listed):
            mounts = constraints.name_of(index, "origin.mounts_m")
            places = ", ".join(str(mount) for mount in listed if tuple(mount) not in left)
            notes.append(f"{len(listed) - len(left)} of {len(listed)} {mounts} left out, inside {name}: {places}")
        for number, box in enumerate(one.origin.exclude or []):
            if not all(low < high for low, high in zip(box.low_m, box.high_m, strict=True)):
                notes.append(f"{name}[{number}] has no volume and excludes nothing")
    return tuple(dict.fromkeys(notes))


# An origin that is pinned no further than this from where the space fixes it is meant to be there [m]: tables, robot
# models and drawings say places to the millimetre, and no sensor is mounted more exactly.
SAME_PLACE_M = 1e-3


def fixed_axes(space: DesignSpace) -> list[int]:
    """The axes of origins on which the design space leaves one place."""
    return [axis for axis in range(3) if axis not in space.free]


def settled_place(origin_m: Sequence[float], space: DesignSpace) -> list[float]:
    """An origin (3,) [m], with those coordinates of the space that it differs from by less than anyone mounts."""
    place = [float(value) for value in origin_m]
    for axis in fixed_axes(space):
        if abs(place[axis] - space.low[axis]) <= SAME_PLACE_M:
            place[axis] = float(space.low[axis])
    return place


def settled(constraints: Constraints, space: DesignSpace) -> tuple[Constraints, list[str]]:
    """Constraints whose pinned origins are where the space fixes them, and a note for each that was moved there.

    The same object where nothing moves.
    """
    document: dict[str, Any] = constraints.as_document()
    notes, changed = [], False
    for name, one in (("", document), *((f"each[{i}].", one) for i, one in enumerate(document.get("each", [])))):
        given = (one.get("origin") or {}).get("fixed_m")
        place = given if given is None else settled_place(given, space)
        if given is not None and place != list(given):
            one["origin"], changed = {**one["origin"], "fixed_m": place}, True
            off = float(np.abs(np.subtract(place, given)).max())
            if off > SLACK:
                stand = "from where the run's sensors stand: taken to be there"
                notes.append(f"{name}origin.fixed_m is {1e3 * off:.2g} mm {stand}")
    return (Constraints.from_mapping(document) if changed else constraints), notes


def misses(low_m: Sequence[float], high_m: Sequence[float], space: DesignSpace) -> list[int]:
    """The axes on which a box of origins lies outside the design space, but for conditions, along which it moves."""
    return [
        axis
        for axis in range(3)
        if DIMENSIONS[axis] not in space.condition
        and (low_m[axis] > space.high[axis] + SAME_PLACE_M or high_m[axis] < space.low[axis] - SAME_PLACE_M)
    ]


def place_text(low_m: Sequence[float], high_m: Sequence[float]) -> str:
    """A box of origins for people, as `x 0.451, y -1 to 1, z 0 m`."""
    ends = [tuple(f"{round(end, 6) + 0.0:.7g}" for end in pair) for pair in zip(low_m, high_m, strict=True)]
    told = [
        f"{name} {low}" if low == high else f"{name} {low} to {high}"
        for name, (low, high) in zip("xyz", ends, strict=True)
    ]
    return f"{', '.join(told)} m"
