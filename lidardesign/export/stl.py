"""Mounting positions as STL: per sensor a small solid with its tip where the sensor stands, opening where it looks.

STL has no units and CAD programs take its numbers as millimetres, so that is what is written. The solid is a pyramid
of 20 mm along the boresight; its far face is 16 mm wide at the bottom and 8 mm at the top, so the roll can be seen.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import ROUNDING, Estimate
from lidardesign.export.common.names import identifier
from lidardesign.export.common.poses import angles_between, constraint_losses, require_sensors
from lidardesign.numerics import unit_vectors
from lidardesign.run.files import write_atomic

if TYPE_CHECKING:
    from lidardesign.design.sensor import Sensor
    from lidardesign.geometry.rays import Rays

MM_PER_M = 1000.0
# Forward, to the left and up from the tip [mm]: the tip, then the far face from its bottom right against the clock.
CORNERS_MM = np.array([(0, 0, 0), (20, -8, -6), (20, -4, 6), (20, 4, 6), (20, 8, -6)], dtype=np.float64)
# Seen from outside against the clock.
FACETS = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (1, 4, 3), (1, 3, 2)])
KEYWORDS = ("solid", "facet", "loop", "vertex")
_VERTEX = re.compile(r"^\s*vertex (\S+) (\S+) (\S+)$", re.MULTILINE)


def write_stl(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold."""
    write_atomic(path, "".join(_solid(index, sensor) for index, sensor in enumerate(design.sensors)))
    notes = [
        "numbers are millimetres: STL has no units, and CAD programs take that one",
        "sensors only: rays, fields of view, gates, weights and spreads are not held",
    ]
    moving = [length for length, _ in (sensor.travel_m for sensor in design.sensors) if length > 0]
    if moving:
        notes.append(f"{len(moving)} sensors are regions of up to {max(moving):.3g} m: solids stand in their middles")
    return notes + constraint_losses(design)


def _solid(index: int, sensor: Sensor) -> str:
    # A name that no reader takes for a word of the format
    word = identifier(sensor.name)
    name = f"sensor_{index}" if any(key in word.lower() for key in KEYWORDS) else f"sensor_{index}_{word}"
    corners = MM_PER_M * np.asarray(sensor.origin_m) + CORNERS_MM @ sensor.frame
    facets = []
    for triangle in corners[FACETS]:
        normal = unit_vectors(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0]))
        vertices = "".join(f"   vertex {_numbers(corner)}\n" for corner in triangle)
        facets.append(f" facet normal {_numbers(normal)}\n  outer loop\n{vertices}  endloop\n endfacet\n")
    return f"solid {name}\n{''.join(facets)}endsolid {name}\n"


def _numbers(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))


def read_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Places [m], shape (G, 3), and boresight frames, shape (G, 3, 3), of the solids of a file that `write_stl` made.

    Raises:
        DataError: The file cannot be read, or holds other solids.
    """
    try:
        found = _VERTEX.findall(Path(path).read_text(encoding="utf-8"))
        corners = np.array(found, dtype=np.float64).reshape(-1, *FACETS.shape, 3)
    except (OSError, ValueError) as error:
        raise DataError(f"cannot be read as STL: {error}", where=str(path), hint="export it again") from error
    # corner k of the solid, wherever it is first
    first = [int((corner == FACETS).argmax()) for corner in range(len(CORNERS_MM))]
    tip, right, right_up, left_up, left = corners.reshape(len(corners), FACETS.size, 3)[:, first].transpose(1, 0, 2)
    across = unit_vectors(left - right)
    up = unit_vectors((left_up + right_up) - (left + right))
    return tip / MM_PER_M, np.stack([np.cross(across, up), across, up], axis=1)


def stl_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose, of places, boresights and rolls."""
    places, frames = read_stl(path)
    require_sensors(len(design.sensors), len(places), path)
    written = np.stack([sensor.frame for sensor in design.sensors])
    origin = np.linalg.norm(places - np.array([sensor.origin_m for sensor in design.sensors]), axis=1)
    turned = np.concatenate([angles_between(frames[:, row], written[:, row]) for row in range(3)])
    return {
        "origin_m": Estimate(None, float(origin.max()), "m", ROUNDING),
        "direction_rad": Estimate(None, float(turned.max()), "rad", ROUNDING),
    }
