"""The catalogue of real parts, and parts at poses: their rays, their sensors, and designs of them.

A part fires its own pattern, or an evenly spread subset where fewer rays are asked for. More rays than it has take more
parts, which share them equally.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import ConfigError, page
from lidardesign.limits import MOST_RAYS
from lidardesign.parts.part import Part
from lidardesign.parts.statements import PartFile
from lidardesign.run.clock import phase
from lidardesign.run.validation import check_model, suggest
from lidardesign.run.yaml import load_yaml
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern, even_subset, grid_rows, grid_tangent
from lidardesign.sensors.sensor import Sensor, boresight_frame, boresight_of
from lidardesign.space import FARTHEST_M

FOLDER = Path(__file__).parent / "files"
SHIPPED = "lidardesign"
SUFFIX = ".yaml"
STEM = re.compile(r"[a-z0-9][a-z0-9._-]{0,60}")
MODULE_PREFIX = "module-"
MODULE = re.compile(MODULE_PREFIX + r"(\d+\.?\d*)x(\d+\.?\d*)-(\d{1,7})x(\d{1,7})", re.ASCII)


@dataclass(frozen=True, eq=False)
class Library:
    """Parts by name.

    Arguments:
        files: The parts' files by the names of the parts.
        origins: The path of each file, `lidardesign` for shipped ones.
    """

    files: dict[str, PartFile]
    origins: dict[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the parts, without modes."""
        return sorted(self.files)

    def part(self, name: str) -> Part:
        """A part by `NAME` or `NAME:MODE`, or a module by its field of view and its zones, as `module-45x45-8x8`.

        Raises:
            ConfigError: There is no such part or mode.
        """
        if name.startswith(MODULE_PREFIX):
            return _module(name)
        stem, colon, mode = name.partition(":")
        if stem not in self.files:
            raise ConfigError(
                f"there is no part {stem!r}",
                where="catalog",
                allowed=", ".join(self.names),
                hint=suggest(stem, self.files)
                or "lidardesign catalog list shows all, and a path names a file of your own",
            )
        file = self.files[stem]
        if colon and mode not in file.modes:
            raise ConfigError(
                f"{stem} has no mode {mode!r}",
                where="catalog",
                allowed=", ".join(file.modes) or f"{stem} alone: it has one mode",
                hint=suggest(mode, file.modes),
            )
        return Part.of_file(stem, file, mode or None, self.origins[stem])

    def every_mode(self) -> list[Part]:
        """All parts in all their modes, by name."""
        modes = {name: self.files[name].modes for name in self.names}
        return [self.part(f"{name}:{mode}" if mode else name) for name in modes for mode in modes[name] or [""]]


def load_library(own: Sequence[Path] = ()) -> Library:
    """The shipped parts and those of a user's files or folders, which replace shipped ones of the same name.

    Raises:
        ConfigError: A file or folder that cannot be read, holds no part, or has an invalid value; the message names
            file, line and column. Two own parts of one name.
    """
    files = dict(_shipped())
    origins = dict.fromkeys(files, SHIPPED)
    taken: dict[str, str] = {}
    for path in itertools.chain.from_iterable(map(_part_files, map(Path, own))):
        name = part_name(path)
        if name in taken:
            raise ConfigError(f"is a second part called {name!r}", where=str(path), hint=f"the first is {taken[name]}")
        files[name] = read_part(path)
        taken[name] = origins[name] = str(path)
    return Library(files, origins)


def find_part(name_or_path: str | Path, own: Sequence[Path] = ()) -> Part:
    """A part by `NAME`, `NAME:MODE`, or the path of a part file, `FILE.yaml` or `FILE.yaml:MODE`.

    Raises:
        ConfigError: There is no such part, mode or file, or the file is no part file.
    """
    text = str(name_or_path)
    path, mode = (text, "") if text.endswith(SUFFIX) else text.rsplit(":", 1) if f"{SUFFIX}:" in text else ("", "")
    if not path:
        return load_library(own).part(text)
    file = Path(path)
    name = part_name(file)
    return load_library([*own, file]).part(f"{name}:{mode}" if mode else name)


def named_parts(names: Sequence[str] | str, bounded: Iterable[str] = ()) -> list[Part]:
    """Parts by `NAME`, `NAME:MODE`, or paths of part files and folders; `catalog` is all that are shipped.

    Arguments:
        names: See above.
        bounded: Names of parts whose number is bounded, without a mode in all their modes.

    Raises:
        ConfigError: A name or path that is no part, or a bound on what is not one of the parts.
    """
    parts = _named(names)
    known = [*dict.fromkeys(name for part in parts for name in (part.name, part.name.split(":")[0]))]
    for name in bounded:
        if name not in known:
            raise ConfigError(
                f"{name!r} is not one of the parts",
                where="parts.each",
                allowed=", ".join(known),
                hint=suggest(name, known) or "files of parts of your own go into parts.names",
            )
    return parts


def parts_of(design: DesignSpec) -> list[Part | None]:
    """The parts that the sensors of a design are; None for those that are none, or whose part is not at hand."""
    named = (design.constraints.get("parts") or {}).get("names") or ()
    texts = [] if isinstance(named, str) else named
    own = [text.rsplit(":", 1)[0] if f"{SUFFIX}:" in text else text for text in texts]
    return [None if sensor.part is None else _part_at_hand(sensor.part, own) for sensor in design.sensors]


def _part_at_hand(name: str, own: Sequence[str]) -> Part | None:
    try:
        return load_library([Path(text) for text in own if text.endswith(SUFFIX) or Path(text).is_dir()]).part(name)
    except ConfigError:
        return None


def _named(names: Sequence[str] | str) -> list[Part]:
    if names == "catalog":
        library = load_library()
        return [library.part(name) for name in library.names]
    return [find_part(name) for name in dict.fromkeys(itertools.chain.from_iterable(map(_part_files, names)))]


def _part_files(path: Any) -> list[Any]:
    """The part files in a folder; what is none stands for itself.

    Raises:
        ConfigError: There are none.
    """
    inside = sorted(Path(path).glob(f"*{SUFFIX}")) if Path(path).is_dir() else [path]
    if not inside:
        hint = f"{page('catalog.md')} shows a part file"
        raise ConfigError(f"holds no file *{SUFFIX}", where=str(path), hint=hint)
    return inside


def _module(name: str) -> Part:
    """A module of even zones that no part file describes: it measures at any range.

    Raises:
        ConfigError: A name that says no field of view or zones, or impossible ones.
    """
    found = MODULE.fullmatch(name)
    if found is None or not all(map(float, found.groups())):
        raise ConfigError(
            f"{name!r} does not describe a module",
            where="--fov and --zones",
            allowed="a field of view in degrees and a number of zones, each width x height: --fov 45x45 --zones 8x8",
        )
    across, up = (float(text) / 2 for text in found.groups()[:2])
    columns, rows = map(int, found.groups()[2:])
    figures = {
        "pattern": [{"kind": "zones", "columns": columns, "rows": rows, "source": "you"}],
        "field_of_view_deg": [{"azimuth": [-across, across], "elevation": [-up, up], "source": "you"}],
        "near_m": [{"value": 0.0, "source": "you"}],
        "far_m": [{"value": FARTHEST_M, "source": "you"}],
        "rate_hz": [{"value": DEFAULT_RATE_HZ, "source": "you"}],
        "sources": {"you": {"title": "the name of the module", "kind": "list"}},
    }
    about = {"maker": "any", "product": name, "kind": "multi-zone", "summary": "a module of even zones"}
    file = check_model(PartFile, {"schema_version": 1, **about, **figures}, lambda *_, **__: name)
    return Part.of_file(name, file, None, SHIPPED)


@lru_cache(maxsize=1)
def _shipped() -> dict[str, PartFile]:
    return {path.stem: read_part(path) for path in sorted(FOLDER.glob(f"*{SUFFIX}"))}


def part_name(path: Path) -> str:
    """The name of the part in a file: the file's stem.

    Raises:
        ConfigError: A stem that could not be typed as a name.
    """
    if not STEM.fullmatch(path.stem):
        raise ConfigError(
            f"{path.stem!r} is not a name of a part", where=str(path), allowed="a file name of a-z, 0-9, dot, dash, _"
        )
    return path.stem


@phase("catalog")
def read_part(path: Path) -> PartFile:
    """Read one part file.

    Raises:
        ConfigError: The file cannot be read or is no part file.
    """
    document = load_yaml(path)
    if not document.mapping:
        raise ConfigError("does not describe a part", where=str(path), hint=f"{page('catalog.md')} shows a part file")
    return check_model(PartFile, document.mapping, document.locate)


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of a part, whose forward axis is the boresight.

    Arguments:
        origin_m: Shape (3,).
        azimuth_rad, elevation_rad, roll_rad: Of its forward axis, as a sensor's boresight.
    """

    origin_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    azimuth_rad: float = 0.0
    elevation_rad: float = 0.0
    roll_rad: float = 0.0

    @property
    def frame(self) -> np.ndarray:
        """Rows forward, horizontal, vertical, shape (3, 3): directions in the part's frame @ frame are the world's."""
        return boresight_frame(self.azimuth_rad, self.elevation_rad, self.roll_rad)


def looking_at(part: Part, origin_m: np.ndarray, azimuth_rad: float, elevation_rad: float) -> Pose:
    """The pose in which the centre of a part's field looks along a direction, with its field upright.

    A part whose field is not centred on its forward axis is tilted by the offset of the centre.
    """
    frame = boresight_frame(*part.centre_rad).T @ boresight_frame(azimuth_rad, elevation_rad)
    return Pose(np.asarray(origin_m, dtype=np.float64), *boresight_of(frame))


def parts_for(part: Part, count: int) -> int:
    """The number of parts of a kind that fire `count` rays, at least 1."""
    return max(-(-count // part.rays), 1)


def part_rays(part: Part, poses: Pose | Sequence[Pose], count: int | None = None) -> Rays:
    """The rays of parts at poses, in the order in which each fires.

    Arguments:
        part: The kind of part; its range is the gate of every ray, its rate sets the length of a frame.
        poses: One part stands at each.
        count: Rays in all; None is every ray of every part. The parts share them equally, the first ones take the
            remainder, and each fires an evenly spread subset of its pattern.

    Raises:
        ConfigError: No pose; more rays than the parts have, or than any design may.
    """
    poses = [poses] if isinstance(poses, Pose) else list(poses)
    if not poses:
        raise ConfigError(f"no pose for {part.name}", where="catalog", allowed="at least one")
    capacity = part.rays * len(poses)
    total = capacity if count is None else count
    if not 0 <= total <= min(capacity, MOST_RAYS):
        raise ConfigError(
            f"{total} rays of {len(poses)} x {part.name}",
            where="catalog",
            allowed=f"at most {min(capacity, MOST_RAYS)} ({part.rays} each)",
            hint=f"{parts_for(part, total)} parts have enough",
        )
    shares = [total // len(poses) + (index < total % len(poses)) for index in range(len(poses))]
    looking = []
    for pose, share in zip(poses, shares, strict=True):
        directions = part.directions @ pose.frame
        looking.append(directions[even_subset(directions, share)])
    sensor = np.repeat(np.arange(len(poses)), shares)
    # all parts run at once, each over its own frame
    return Rays(
        np.array([pose.origin_m for pose in poses], dtype=np.float64)[sensor],
        np.concatenate(looking),
        np.tile(part.range_m, (total, 1)),
        sensor,
        np.concatenate([np.arange(share) / (max(share, 1) * part.rate_hz) for share in shares]),
    )


def part_sensor(
    part: Part,
    pose: Pose,
    *,
    name: str = "s0",
    weight: float = 1.0,
) -> Sensor:
    """The part as a component of design space: its field of view and its range are the component's intervals.

    The boresight is the centre of the field. A field of a full turn is a ring about the part's axis, of which the
    component is the Gaussian of the same extents; the part's rays have its true field.
    """
    azimuth, elevation, roll = boresight_of(boresight_frame(*part.centre_rad) @ pose.frame)
    return Sensor(
        name=name,
        weight=weight,
        origin_m=np.asarray(pose.origin_m, dtype=np.float64),
        azimuth_rad=azimuth,
        elevation_rad=elevation,
        roll_rad=roll,
        field_of_view_rad=part.field_of_view_rad,
        gate_m=part.range_m,
        part=part.name,
    )


def part_design(
    part: Part,
    poses: Pose | Sequence[Pose],
    count: int | None = None,
    *,
    name: str | None = None,
) -> DesignSpec:
    """A design of real parts at poses, with the explicit rays of their patterns; see `part_rays`.

    Its layout is `fixed`: at fewer rays it fires an evenly spread subset, more it does not have.

    Raises:
        ConfigError: See `part_rays`.
    """
    poses = [poses] if isinstance(poses, Pose) else list(poses)
    rays = part_rays(part, poses, count)
    sensors = tuple(
        part_sensor(part, pose, name=f"s{index}", weight=1 / len(poses)) for index, pose in enumerate(poses)
    )
    return DesignSpec(
        name=name or part.name.replace(":", "-"),
        sensors=sensors,
        layout="fixed",
        patterns=(Pattern.of(rays.as_angles()),),
        provenance={"catalog": part.name, "product": part.product, "rate_hz": part.rate_hz},
    )


def side_by_side(part: Part, pose: Pose, number: int) -> list[Pose]:
    """Poses at one place whose fields of view stand beside each other, around that of one pose.

    Fields of more than half a turn stand above each other; line scanners are rolled evenly over half a turn.
    """
    horizontal, vertical = part.field_of_view_rad
    if vertical == 0:
        return [replace(pose, roll_rad=pose.roll_rad + math.pi * index / number) for index in range(number)]
    rows = np.ones(number, dtype=np.int64) if horizontal > math.pi else grid_rows(horizontal, vertical, number)
    across = np.concatenate([np.arange(n) - (n - 1) / 2 for n in rows])
    up = np.repeat(np.arange(len(rows)) - (len(rows) - 1) / 2, rows)
    return [_rotate(pose, *shift) for shift in zip(across * horizontal, up * vertical, strict=True)]


def interleaved(part: Part, pose: Pose, number: int) -> list[Pose]:
    """Poses at one place with nearly the same field, each with its rays between those of the others.

    The shifts are an even grid in one cell of the pattern: four parts of 8 x 8 zones have 16 x 16.
    """
    horizontal, vertical = part.field_of_view_rad
    columns, rows = part.grid
    return [_rotate(pose, *shift) for shift in grid_tangent(horizontal / columns, vertical / rows, number)]


def _rotate(pose: Pose, azimuth_rad: float, elevation_rad: float) -> Pose:
    """A pose turned about its own place by an azimuth and an elevation in its own frame."""
    return Pose(pose.origin_m, *boresight_of(boresight_frame(azimuth_rad, elevation_rad) @ pose.frame))
