"""Part of the independent checker: a sensor that is to be a part is one, by the written design and the part's file.

Its field of view and range are the part's, and every ray that it fires is one of the part's pattern. Rows are name,
bound, value and whether the bound is kept, as `check.ConstraintCheck`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.catalog.library import SUFFIX, load_library
from lidardesign.design.catalog.part import Part
from lidardesign.design.sensor import boresight_frame
from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK
from lidardesign.space import direction

Row = tuple[str, Any, Any, bool]


def snap_rows(name: str, index: int, document: Mapping[str, Any], snap: Any) -> list[Row]:
    """Whether a sensor is the part that it says to be.

    Arguments:
        name: The sensor's name.
        index: Its place in the design.
        document: The design.
        snap: The value of `snap` that holds for it; None asks nothing.
    """
    if snap is None:
        return []
    sensor = document["sensors"][index]
    keys = snap if isinstance(snap, Mapping) else {}
    allowed = keys.get("parts") or "the catalogue"
    if sensor.get("part") is None:
        return [(f"{name}.snap", allowed, "a sensor of its own", keys.get("otherwise") == "keep")]
    part = _found(str(sensor["part"]), keys.get("parts") or [])
    if part is None:
        return [(f"{name}.snap", allowed, sensor["part"], False)]
    return [(f"{name}.snap", part.name, *_compared(part, index, sensor, document))]


def _found(name: str, named: list[str]) -> Part | None:
    """The part that a sensor names, if the constraints admit it."""
    own = [path for path, _ in map(_path_and_mode, named) if path is not None]
    try:
        library = load_library(own)
        part = library.part(name)
    except ConfigError:
        return None
    stem = name.partition(":")[0]
    admitted = not named
    for text in named:
        path, mode = _path_and_mode(text)
        same = text.partition(":")[0] == stem if path is None else _lies_in(library.origins[stem], path)
        admitted |= same and mode in ("", part.mode)
    return part if admitted else None


def _path_and_mode(text: str) -> tuple[Path | None, str]:
    """The path that an entry of `parts` is, None where it is a name, and the mode behind it."""
    path, mode = text.rsplit(":", 1) if f"{SUFFIX}:" in text else (text, "")
    if path.endswith(SUFFIX) or Path(path).is_dir():
        return Path(path), mode
    return None, text.partition(":")[2]


def _lies_in(origin: str, path: Path) -> bool:
    return Path(origin) == path or Path(origin).parent == path


def _compared(part: Part, index: int, sensor: Mapping[str, Any], document: Mapping[str, Any]) -> tuple[str, bool]:
    """What the sensor is beside the part, and whether that is the same."""
    view = sensor["field_of_view_rad"]
    for key, found, expected in zip(view, (view["horizontal"], view["vertical"]), part.field_of_view_rad, strict=True):
        if abs(found - expected) > COARSE_SLACK:
            return f"a {key} field of view of {found:g} instead of {expected:g} rad", False
    (near, far), gate = part.range_m, sensor["gate_m"]
    if gate["start"] < near - COARSE_SLACK or gate["end"] > far + COARSE_SLACK:
        return f"a gate of {gate['start']:g} to {gate['end']:g} m, and the part measures {near:g} to {far:g} m", False
    table = document.get("ray_table")
    if not table:
        return "no explicit rays", False
    strays = _strays(part, index, sensor, table)
    return (f"{strays} rays that the part does not have", False) if strays else (part.name, True)


def _strays(part: Part, index: int, sensor: Mapping[str, Any], table: Mapping[str, Any]) -> int:
    """How many rays of a sensor are none of its part's, or are fired twice or from elsewhere."""
    # loaded here because few designs are of parts
    from scipy.spatial import cKDTree

    own = np.flatnonzero(np.asarray(table["sensor"]) == index)
    azimuth, elevation = (np.asarray(table[key], dtype=np.float64)[own] for key in ("azimuth_rad", "elevation_rad"))
    aimed = sensor["boresight"]
    frame = boresight_frame(aimed["azimuth_rad"], aimed["elevation_rad"], aimed.get("roll_rad") or 0.0)
    local = direction(azimuth, elevation) @ (boresight_frame(*part.centre_rad).T @ frame).T
    away, ray = cKDTree(part.directions).query(local)
    starts = np.stack([np.asarray(table[f"origin_{axis}_m"], dtype=np.float64)[own] for axis in "xyz"], axis=1)
    moved = np.abs(starts - np.asarray(sensor["origin_m"]["mean"])).max(axis=1, initial=0.0) > COARSE_SLACK
    same = len(part.directions) - len(np.unique(part.directions, axis=0))
    twice = max(len(ray) - len(np.unique(ray)) - same, 0)
    return int(((away > COARSE_SLACK) | moved).sum()) + twice
