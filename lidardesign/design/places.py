"""Where sensors are asked to stand and where a design space lets them: two numbers for one place are one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lidardesign.design.constraints import Constraints
from lidardesign.numerics import SLACK
from lidardesign.space import DIMENSIONS, DesignSpace

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
