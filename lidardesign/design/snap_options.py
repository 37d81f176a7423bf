"""Which parts may stand in for a sensor: those whose own field of view and range keep its constraints.

A part's field of view and range cannot be narrowed; only outside the design space's range, where no task has anything,
does its read-out stop. So a constraint that no part keeps is said by name.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from lidardesign.design.catalog.library import SUFFIX, Library, load_library
from lidardesign.design.catalog.part import Part
from lidardesign.design.constraints import Constraints, SensorConstraints, Snap
from lidardesign.design.shapes import Shape, shapes_of
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import SLACK
from lidardesign.space import DesignSpace

SPACE_RANGE = "space.range_m"
BOUNDED = ("field_of_view.horizontal_deg", "field_of_view.vertical_deg", "gate.start_m", "gate.end_m", "gate.width_m")


@dataclass(frozen=True, eq=False)
class Options:
    """The parts that a sensor may become.

    Arguments:
        shapes: The parts, each upright and turned where that differs; empty where the sensor stays as it is.
        snapped: Whether the sensor is to become a part.
        lacking: Names of a smallest set of constraints that no part keeps together; empty where some do.
    """

    shapes: list[Shape]
    snapped: bool
    lacking: tuple[str, ...] = ()


def wants_parts(constraints: Constraints) -> bool:
    """Whether any sensor is to become a part."""
    return any(constraints.of_sensor(index).snap is not None for index in range(len(constraints.each) + 1))


def options_of(constraints: Constraints, space: DesignSpace, middles_m: Sequence[float]) -> list[Options]:
    """What each of some sensors may become.

    Arguments:
        constraints: The constraint file.
        space: The design space.
        middles_m: The mean range of each sensor: a part that does not measure there is none for it.

    Raises:
        InfeasibleError: No part keeps a sensor's constraints, and it is not said that it may stay as it is.
        ConfigError: A part that is not there, or no part file.
    """
    last = len(constraints.each)
    snaps = [constraints.of_sensor(min(index, last)).snap for index in range(min(len(middles_m), last + 1))]
    parts = [[] if snap is None else parts_of(snap) for snap in snaps]
    options = [_options(constraints, i, space, middle, parts[min(i, last)]) for i, middle in enumerate(middles_m)]
    refused = [
        index
        for index, one in enumerate(options)
        if one.lacking and (snap := constraints.of_sensor(index).snap) is not None and snap.otherwise == "refuse"
    ]
    if refused:
        names = tuple(dict.fromkeys(name for index in refused for name in options[index].lacking))
        which = ", ".join(f"s{index}" for index in refused)
        raise InfeasibleError(
            f"no part can stand in for {which} and keep {', '.join(names)}",
            conflicts=[*names, constraints.name_of(refused[0], "snap")],
            hint="loosen one of the constraints named, or leave such sensors as they are: --set snap.otherwise=keep",
        )
    return options


def parts_of(snap: Snap) -> list[Part]:
    """The parts, in all modes where none is named, that a constraint file chooses from.

    Of the whole catalogue, those of which a source says from where they measure.

    Raises:
        ConfigError: A name or path that is no part.
    """
    if snap.parts is None:
        return list(_catalogue())
    found: dict[str, Part] = {}
    for text in snap.parts:
        found |= {part.name: part for part in _named(text)}
    return list(found.values())


@lru_cache(maxsize=1)
def _catalogue() -> tuple[Part, ...]:
    # kept, because patterns of hundred thousands of rays take a while
    return tuple(part for part in load_library().every_mode() if part.value("near_m") is not None)


def _split(text: str) -> tuple[Path | None, str]:
    """The path that a text names, None where it is a name, and the mode behind it."""
    path, mode = text.rsplit(":", 1) if f"{SUFFIX}:" in text else (text, "")
    return (Path(path) if path.endswith(SUFFIX) or Path(path).is_dir() else None), mode


def _named(text: str) -> list[Part]:
    """The parts of a name, of `NAME:MODE`, or of the path of a file or folder; all modes where none is named."""
    path, mode = _split(text)
    if path is None:
        library, stems, mode = load_library(), [text.partition(":")[0]], text.partition(":")[2]
    else:
        library = load_library([path])
        files = {str(file) for file in _inside(path)}
        stems = [name for name, origin in library.origins.items() if origin in files]
    if mode:
        return [library.part(f"{stem}:{mode}") for stem in stems]
    return [part for stem in stems for part in _modes(library, library.part(stem))]


def _inside(path: Path) -> list[Path]:
    return sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]


def _modes(library: Library, part: Part) -> list[Part]:
    stem = part.name.partition(":")[0]
    return [library.part(f"{stem}:{mode}") for mode in part.modes] or [part]


def _options(
    constraints: Constraints, index: int, space: DesignSpace, middle_m: float, parts: Sequence[Part]
) -> Options:
    one = constraints.of_sensor(index)
    if one.snap is None:
        return Options([], snapped=False)
    every = [shapes_of(part, space) for part in parts]
    heard = [shapes for shapes in every if shapes and shapes[0].gate_m[0] <= middle_m <= shapes[0].gate_m[1]]
    broken = [_broken(shapes[0], one) for shapes in heard]
    kept = [shape for shapes, found in zip(heard, broken, strict=True) if not found for shape in shapes]
    if kept:
        return Options(kept, snapped=True)
    lacking = _smallest_lacking(broken) if broken else ()
    return Options(
        [], snapped=False, lacking=tuple(constraints.name_of(index, key) for key in lacking) or (SPACE_RANGE,)
    )


def _broken(shape: Shape, one: SensorConstraints) -> set[str]:
    """Keys of the constraints that a part does not keep."""
    horizontal, vertical = (math.degrees(angle) for angle in shape.part.field_of_view_rad)
    start, end = shape.gate_m
    values = (horizontal, vertical, start, end, end - start)
    found = set()
    for key, value in zip(BOUNDED, values, strict=True):
        bounds: Any = one
        for part in key.split("."):
            bounds = getattr(bounds, part)
        if bounds.min is not None and value < bounds.min * (1 - SLACK):
            found.add(f"{key}.min")
        if bounds.max is not None and value > bounds.max * (1 + SLACK):
            found.add(f"{key}.max")
    return found


def _smallest_lacking(broken: Sequence[set[str]]) -> tuple[str, ...]:
    """The fewest constraints of which every part breaks at least one."""
    every = sorted(set().union(*broken))
    sizes = (itertools.combinations(every, size) for size in range(1, len(every) + 1))
    return next(names for one in sizes for names in one if all(set(names) & found for found in broken))
