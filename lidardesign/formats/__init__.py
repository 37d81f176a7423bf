"""Export formats: plugins of the entry-point group `lidardesign.formats`, and designs written in them.

Formats of this package are beside the functions that write them, and listed in pyproject.toml as those of others are.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.errors import ConfigError, PluginError
from lidardesign.plugins import AUTHOR_HINT, PluginKind, check_members, plugin_guard
from lidardesign.run.files import write_atomic, write_folder
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays

if TYPE_CHECKING:
    from lidardesign.formats.rig import Rig
    from lidardesign.scenes.mujoco_models import RobotFile
    from lidardesign.sensors.design import DesignSpec

API_VERSION = 1
RAYS, RATE, EVERY_STEP, ROBOT, ADAPTIVE = HELD = ("rays", "rate", "every-step", "robot", "adaptive")
# Frames of a quarter of an hour and of a microsecond.
SLOWEST_HZ, FASTEST_HZ = 0.001, 1e6


@dataclass(frozen=True)
class WriteOptions:
    """What is asked of a file beside the design, of formats that hold it.

    Arguments:
        rate_hz: Frames per second [Hz]; 0: at every step of a simulation.
        robot: Robot model that receives the sensors; None: sensors alone.
    """

    rate_hz: float = DEFAULT_RATE_HZ
    robot: RobotFile | None = None


@dataclass(frozen=True, eq=False)
class Format:
    """An export format; anything with these members is one.

    Arguments:
        name: Name in `export --format`, that of its entry point.
        suffix: Suffix of the file or folder, with the dot.
        summary: One line for `formats list`.
        write: Writes the file or folder, whole or not at all; returns notes of what the format cannot hold.
        reader: Program that reads it.
        checked: How tests check that this program reads the file.
        holds: Which of `HELD` it holds: the rays, a frame rate, one of 0 for every step of a simulation, a robot's
            model with the sensors in it, patterns that follow what they see.
        is_folder: Whether it writes a folder of files.
        read: Reads a file; of formats of other packages it is asked for files with the suffix .NAME.
        api_version: The version of this contract.
    """

    name: str
    suffix: str
    summary: str
    write: Callable[[DesignSpec, Rays, Path, WriteOptions], list[str]]
    reader: str
    checked: str
    holds: frozenset[str] = frozenset({RAYS})
    is_folder: bool = False
    read: Callable[[Path], Rig] | None = None
    api_version: int = API_VERSION


def check_format(name: str, found: Any) -> dict[str, Any]:
    """Check that an object fulfils the contract of formats; returns what lists say of it.

    Raises:
        PluginError: The first member that is missing or of the wrong type or value.
    """
    check_members(
        "format",
        name,
        found,
        API_VERSION,
        **dict.fromkeys(("name", "summary", "suffix", "reader", "checked"), str),
        holds=frozenset,
        is_folder=bool,
        write=object,
    )
    unknown = sorted(map(str, found.holds.difference(HELD)))
    if unknown or not found.suffix.startswith(".") or "/" in found.suffix:
        wrong = f"holds {', '.join(unknown)}" if unknown else f"its suffix is {found.suffix!r}"
        raise PluginError(
            wrong,
            where=f"format {name}",
            allowed=", ".join(HELD) if unknown else "a dot, then a name",
            hint=AUTHOR_HINT,
        )
    facts = {key: getattr(found, key) for key in ("summary", "suffix", "reader", "checked")}
    return {
        **facts,
        "folder": found.is_folder,
        "holds": sorted(found.holds),
        "reads": getattr(found, "read", None) is not None,
    }


FORMATS: PluginKind[Format] = PluginKind("lidardesign.formats", "format", check_format)


def shipped_formats() -> list[Format]:
    """The formats of this package by name."""
    return [FORMATS.load(name) for name in FORMATS.names() if FORMATS.is_shipped(name)]


def write_design(
    format: Format,
    design: DesignSpec,
    rays: Rays,
    path: Path,
    rate_hz: float | None = None,
    robot: RobotFile | None = None,
) -> list[str]:
    """Write a design in a format, whole or not at all; returns notes of what the format cannot hold.

    Arguments:
        format: The format.
        design: The design.
        rays: Its rays.
        path: The file or folder.
        rate_hz: Frames per second [Hz]; the usual ones by default.
        robot: Robot model that receives the sensors; None: sensors alone.

    Raises:
        ConfigError: A frame rate, a robot or patterns for a format without them, or a rate out of range.
        DataError: The file cannot be written, or the format cannot hold such a design at all.
        PluginError: The format is of another package, and broken.
    """
    check_rate(format, rate_hz)
    if len(rays) and design.following(len(rays)) is not None and ADAPTIVE not in format.holds:
        raise ConfigError(
            f"{format.name} cannot hold patterns that follow what they see",
            where="--format",
            allowed=_holding(ADAPTIVE),
            hint="lidardesign constrain DESIGN --adaptive 1 makes the best single pattern",
        )
    if robot is not None and ROBOT not in format.holds:
        raise ConfigError(f"{format.name} cannot hold a robot", where="--robot", allowed=_holding(ROBOT))
    options = WriteOptions(DEFAULT_RATE_HZ if rate_hz is None else rate_hz, robot)
    write = format.write if FORMATS.is_shipped(format.name) else partial(_write_contained, format)
    notes = write(design, rays, Path(path), options)
    if design.constraints:
        notes.append("the constraints of the design are lost")
    if design.mount is not None and robot is None:
        hint = "; --robot MODEL puts the sensors on it" if ROBOT in format.holds else ""
        notes.append(f"places and directions are in the frame of the robot's body {design.mount!r}{hint}")
    return notes


def _write_contained(format: Format, design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Let another package's format write elsewhere, and copy what it has written to its end."""
    with tempfile.TemporaryDirectory(prefix="lidardesign-") as folder:
        staged = Path(folder) / path.name
        with plugin_guard(format.name, "format"):
            notes = [str(note) for note in format.write(design, rays, staged, options)]
        if not (staged.is_dir() if format.is_folder else staged.is_file()):
            raise PluginError(
                f"wrote no {'folder' if format.is_folder else 'file'}", where=f"format {format.name}", hint=AUTHOR_HINT
            )
        if format.is_folder:
            return [*write_folder(path, folder_contents(staged)), *notes]
        write_atomic(path, staged.read_bytes())
    return notes


def folder_contents(folder: Path) -> dict[str, bytes]:
    """The content of all files of a folder by their names."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def check_rate(format: Format, rate_hz: float | None) -> None:
    """Refuse a frame rate [Hz] that is out of range, or that a format cannot hold.

    Raises:
        ConfigError: Such a rate.
    """
    steps = EVERY_STEP in format.holds
    if rate_hz is not None and not SLOWEST_HZ <= rate_hz <= FASTEST_HZ and not (steps and rate_hz == 0):
        every = ", or 0: at every step" if steps else ""
        raise ConfigError(f"{rate_hz}", where="--rate-hz", allowed=f"{SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz{every}")
    if rate_hz is not None and RATE not in format.holds:
        raise ConfigError(f"{format.name} cannot hold a frame rate", where="--rate-hz", allowed=_holding(RATE))


def _holding(what: str) -> str:
    """The shipped formats that hold something, in words."""
    return f"with {', '.join(format.name for format in shipped_formats() if what in format.holds)}"
