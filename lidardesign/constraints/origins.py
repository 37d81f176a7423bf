"""Places of sensors: origin boxes less excluded boxes, mounts, and the places that a design space fixes.

The remaining region is not convex, so it is described by its maximal boxes: a box avoids the interiors of all excluded
boxes exactly where it lies in one of the maximal boxes between them. So an interval of origins, itself a box, is kept
out of all excluded boxes by keeping it in one maximal box, without loss of generality.

Excluded boxes that take part of the origin box divide what is left of it, and an interval keeps to one of its parts:
it would otherwise balance on an edge of the origin box, half of it outside, to cover other parts. Where none does,
the mean alone keeps to the origin box, and its interval, which may be longer, has the excluded boxes beyond to avoid.
Along axes on which the origin box is thin there is no freedom: an excluded box that does not hold the coordinate there
is not in the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lidardesign.constraints.document import Constraints, SensorRules, rules_of
from lidardesign.numerics import HALF_DIGITS, SLACK
from lidardesign.space import DIMENSIONS, DesignSpace

# Origin boxes thinner than this along an axis pin it [m].
PINNED_BOX_M = SLACK
# Gaps between excluded boxes narrower than this, in metres and relative to coordinates, leave no place.
SMALLEST_GAP = HALF_DIGITS
# An origin fixed this close to the space's own place means that place [m]: tables, robot models and drawings give
# places to the millimetre, and no sensor is mounted more exactly.
SAME_PLACE_M = 1e-3

Mount = tuple[float, float, float]


class Boxes(NamedTuple):
    """Boxes with their sides along the axes.

    Arguments:
        low_m: Lower corners, shape (M, 3); may be -inf.
        high_m: Upper corners, shape (M, 3); may be inf.
    """

    low_m: np.ndarray
    high_m: np.ndarray


def origin_box(rules: SensorRules, space: DesignSpace) -> tuple[np.ndarray, np.ndarray]:
    """The box of a sensor's mean origin inside the design space, (3,) each [m]; a point where it is fixed."""
    low, high = (np.array(bound[:3], dtype=np.float64) for bound in (space.low, space.high))
    if rules.origin.low_m is not None:
        low = np.maximum(low, rules.origin.low_m)
    if rules.origin.high_m is not None:
        high = np.minimum(high, rules.origin.high_m)
    if rules.origin.fixed_m is not None:
        free = np.isin(np.arange(3), space.free)
        low = high = np.where(free, np.array(rules.origin.fixed_m), np.array(space.low[:3]))
    return low, np.maximum(low, high)


def excluded_boxes(rules: SensorRules) -> Boxes:
    """The boxes that a sensor's constraints exclude, flat ones included."""
    corners = [(box.low_m, box.high_m) for box in rules.origin.exclude or []]
    return Boxes(*np.array(corners, dtype=np.float64).reshape(-1, 2, 3).transpose(1, 0, 2))


def inside_excluded(origins_m: np.ndarray, rules: SensorRules) -> np.ndarray:
    """Mask of the origins (N, 3) in the interior of an excluded box, shape (N,) bool."""
    inside = np.zeros(len(origins_m), dtype=bool)
    for low, high in zip(*excluded_boxes(rules), strict=True):
        inside |= ((origins_m > low) & (origins_m < high)).all(axis=1)
    return inside


def free_boxes(rules: SensorRules, space: DesignSpace) -> Boxes:
    """The maximal boxes between the excluded ones for a sensor's intervals; none where all is excluded.

    They end at the origin box only where an excluded box meets it, and are unbounded along fixed axes.
    """
    low, high = origin_box(rules, space)
    fixed = high - low <= PINNED_BOX_M
    middle = (low + high) / 2
    bottoms, tops = excluded_boxes(rules)
    held = np.where(fixed, (bottoms < middle) & (middle < tops), bottoms < tops).all(axis=1)
    bottoms, tops = bottoms[held], tops[held]
    kept = ~fixed & (((bottoms < high) & (tops > low)) | fixed).all(axis=1).any()
    free = Boxes(np.where(kept, low, -np.inf)[None], np.where(kept, high, np.inf)[None])
    for bottom, top in zip(bottoms, tops, strict=True):
        free = _without(free, bottom, top, low, high, ~fixed)
    # in an order that is not that of the excluded boxes, for where two are equally good
    corners = np.unique(np.concatenate(free, axis=1), axis=0)
    return Boxes(corners[:, :3], corners[:, 3:])


def _without(
    boxes: Boxes, bottom: np.ndarray, top: np.ndarray, low: np.ndarray, high: np.ndarray, axes: np.ndarray
) -> Boxes:
    """The maximal boxes inside given ones that avoid a further box, cut along `axes`, with room in [low, high]."""
    met = ((boxes.low_m < top) & (boxes.high_m > bottom) | ~axes).all(axis=1)
    lows, highs = [], []
    for axis in np.flatnonzero(axes):
        below, above = boxes.high_m[met].copy(), boxes.low_m[met].copy()
        below[:, axis] = np.minimum(below[:, axis], bottom[axis])
        above[:, axis] = np.maximum(above[:, axis], top[axis])
        lows += [boxes.low_m[met], above]
        highs += [below, boxes.high_m[met]]
    old = np.concatenate([boxes.low_m, -boxes.high_m], axis=1)[~met]
    if not lows:
        return Boxes(old[:, :3], -old[:, 3:])
    fresh = np.concatenate([np.concatenate(lows), -np.concatenate(highs)], axis=1)
    # drop boxes with next to no room inside [low, high] along some axis
    needed = np.minimum(SMALLEST_GAP * np.maximum(np.maximum(np.abs(low), np.abs(high)), 1.0), (high - low) / 2)
    room = np.minimum(-fresh[:, 3:], high) - np.maximum(fresh[:, :3], low)
    fresh = fresh[(room > needed)[:, axes].all(axis=1)]
    # no old box lies in a fresh one: fresh boxes are parts of other old ones
    fresh = np.unique(fresh, axis=0)
    holds = (np.concatenate([old, fresh])[None] <= fresh[:, None]).all(axis=2)
    corners = np.concatenate([old, fresh[holds.sum(axis=1) == 1]])
    return Boxes(corners[:, :3], -corners[:, 3:])


def nearest_in_boxes(origins_m: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The nearest point of any of M boxes, given by corners (M, 3), to each of some origins (N, 3): shape (N, 3)."""
    clipped = np.clip(origins_m[:, None], low, high)
    away = np.square(clipped - origins_m[:, None]).sum(axis=2)
    return np.take_along_axis(clipped, away.argmin(axis=1)[:, None, None], axis=1)[:, 0]


def mounts_of(rules: SensorRules) -> list[Mount]:
    """The mounts that a sensor may take, those in an excluded box left out; none where it is not mounted."""
    listed = [(x, y, z) for x, y, z in rules.origin.mounts_m or []]
    inside = inside_excluded(np.array(listed, dtype=np.float64).reshape(-1, 3), rules)
    return [mount for mount, dropped in zip(listed, inside, strict=True) if not dropped]


def is_mounted(rules: Sequence[SensorRules]) -> bool:
    """True where any sensor stands at a mount."""
    return any(mounts_of(one) for one in rules)


def most_mounted(rules: Sequence[SensorRules]) -> int | None:
    """The largest number of sensors that can all be mounted; None where the number is not limited.

    Sensors beyond the entries of `each` share the common list.
    """
    entries, common = len(rules) - 1, mounts_of(rules[-1])
    count = entries + len(common)
    options = [mounts_of(rules_of(rules, sensor)) for sensor in range(count)]
    while not mounts_suffice([mounts for mounts in options[:count] if mounts]):
        count -= 1
    return None if not common and count == entries else count


def mounts_suffice(options: Sequence[Sequence[Mount]]) -> bool:
    """True where mounted sensors can all have distinct mounts, by maximum bipartite matching."""
    if not options or not all(options):
        return not options
    # loaded here because few constraint files have mounts
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    places = sorted({mount for mounts in options for mount in mounts})
    admitted = np.array([[mount in mounts for mount in places] for mounts in options], dtype=np.int8)
    return bool((maximum_bipartite_matching(csr_array(admitted), perm_type="column") >= 0).all())


def fix_origin(rules: SensorRules, place: Mount) -> SensorRules:
    """The rules of a sensor that is fixed at a place, with no mounts left to choose."""
    return replace(rules, origin=rules.origin.model_copy(update={"mounts_m": None, "fixed_m": list(place)}))


def fix_origins(rules: Sequence[SensorRules], places: Sequence[Mount | None]) -> tuple[SensorRules, ...]:
    """The rules with sensor i fixed at the i-th place, where there is one, and no mounts left to choose for others."""
    own = [replace(rules_of(rules, sensor), index=sensor) for sensor in range(len(places))]
    fixed = [one if place is None else fix_origin(one, place) for one, place in zip(own, places, strict=True)]
    unmounted = rules[-1].origin.model_copy(update={"mounts_m": None})
    return (*fixed, replace(rules[-1], origin=unmounted, index=len(places)))


def placement_notes(rules: Sequence[SensorRules]) -> tuple[str, ...]:
    """Notes on rules without effect: mounts in excluded boxes, and excluded boxes without volume."""
    notes = []
    for one in rules:
        listed, name = one.origin.mounts_m or [], one.path("origin.exclude")
        lost = [str(mount) for mount in listed if tuple(mount) not in mounts_of(one)]
        if lost:
            share = f"{len(lost)} of {len(listed)} {one.path('origin.mounts_m')}"
            notes.append(f"{share} left out, inside {name}: {', '.join(lost)}")
        notes += [
            f"{name}[{number}] has no volume and excludes nothing"
            for number, box in enumerate(one.origin.exclude or [])
            if not all(low < high for low, high in zip(box.low_m, box.high_m, strict=True))
        ]
    return tuple(dict.fromkeys(notes))


def snap_place_to_space(origin_m: Sequence[float], space: DesignSpace) -> list[float]:
    """An origin (3,) with coordinates within `SAME_PLACE_M` of the space's fixed ones replaced by these [m]."""
    place = [float(value) for value in origin_m]
    for axis in {0, 1, 2} - set(space.free):
        if abs(place[axis] - space.low[axis]) <= SAME_PLACE_M:
            place[axis] = float(space.low[axis])
    return place


def snap_to_space(constraints: Constraints, space: DesignSpace) -> tuple[Constraints, list[str]]:
    """Constraints with fixed origins and mounts snapped to the space's fixed coordinates, and notes on them.

    The same object where nothing moves.
    """
    document: dict[str, Any] = constraints.as_document()
    notes, changed = [], False
    for name, one in (("", document), *((f"each[{i}].", one) for i, one in enumerate(document.get("each", [])))):
        origin = dict(one.get("origin") or {})
        for key in ("fixed_m", "mounts_m"):
            given = origin.get(key)
            if given is None:
                continue
            moved = [snap_place_to_space(place, space) for place in np.reshape(given, (-1, 3))]
            off = float(np.abs(np.reshape(given, (-1, 3)) - moved).max(initial=0.0))
            if off > 0:
                origin[key], changed = moved if key == "mounts_m" else moved[0], True
            if off > SLACK:
                stand = "from where the run's sensors stand: treated as being there"
                notes.append(f"{name}origin.{key} is {1e3 * off:.2g} mm {stand}")
        if origin:
            one["origin"] = origin
    return (Constraints.from_mapping(document) if changed else constraints), notes


def axes_outside(low_m: Sequence[float], high_m: Sequence[float], space: DesignSpace) -> list[int]:
    """The axes, other than conditions, on which a box of origins lies outside the design space."""
    return [
        axis
        for axis in range(3)
        if DIMENSIONS[axis] not in space.condition
        and (low_m[axis] > space.high[axis] + SAME_PLACE_M or high_m[axis] < space.low[axis] - SAME_PLACE_M)
    ]


def place_text(low_m: Sequence[float], high_m: Sequence[float]) -> str:
    """A box of origins for people, as `x 0.451, y -1 to 1, z 0 m`."""
    ends = [tuple(f"{round(end, 6) + 0.0:.7g}" for end in pair) for pair in zip(low_m, high_m, strict=True)]
    sides = (low if low == high else f"{low} to {high}" for low, high in ends)
    return ", ".join(f"{axis} {side}" for axis, side in zip("xyz", sides, strict=True)) + " m"
