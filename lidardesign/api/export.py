"""The explicit rays of a design, and writing them in other programs' formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import BackgroundNote, ConfigError
from lidardesign.formats import FORMATS, RAYS, ROBOT, Format, check_rate, shipped_formats, write_design
from lidardesign.formats.designs import folder_of
from lidardesign.run.clock import phase
from lidardesign.run_folder import Notes, RunFolder, log_note
from lidardesign.scenes.mujoco_models import RobotFile
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import condition_values


class DesignSource:
    """A design with its run, from which its number of rays may follow.

    Arguments:
        specification: The design.
        run: The run that it came from, where that is open; else the one that its file names is opened when needed.
        path: Its file; None while it has none.
    """

    def __init__(self, specification: DesignSpec, run: RunFolder | None = None, path: Path | None = None) -> None:
        self.specification, self.run, self.path = specification, run, path

    @property
    def folder(self) -> Path | None:
        """The folder of the run that it came from, if it is there."""
        if self.run is not None:
            return self.run.folder
        return None if self.path is None else folder_of(self.specification, self.path)

    def opened_run(self) -> RunFolder | None:
        """The run that it came from, if it is there."""
        return self.run or (None if self.folder is None else RunFolder.open(self.folder))

    def usual_count(self, notes: Notes = log_note) -> int:
        """The number of rays that it is meant to fire, else the largest that its task is evaluated at.

        Raises:
            ConfigError: It leaves its number of rays open, and its run is not there.
        """
        if self.specification.count is not None:
            return self.specification.count
        run = self.opened_run()
        if run is None:
            where = self.specification.name if self.path is None else str(self.path)
            raise ConfigError("the design leaves the number of rays open", where=where, hint="give --rays N")
        count = max(run.task.defaults.rays)
        notes(BackgroundNote(f"the design leaves the number of rays open; {count} is the task's largest budget"))
        return count

    @phase("rays")
    def at(
        self, count: int | None = None, at: Mapping[str, float] | None = None, notes: Notes = log_note
    ) -> tuple[DesignSpec, Rays]:
        """The design and its rays at a condition.

        Arguments:
            count: Rays per frame; 0 for sensors alone.
            at: Condition values.
            notes: Called with every note.

        Raises:
            ConfigError: The design is not defined at this condition, or cannot fire so many rays.
        """
        design = self.specification
        design = design.at_condition(at or {}) if at or design.condition else design
        if count == 0:
            return design, Rays(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty(0), np.empty(0))
        return design, design.rays(self.usual_count(notes) if count is None else count)


@dataclass(frozen=True, eq=False)
class Exported:
    """The result of an export.

    Arguments:
        path: The file or folder.
        format: The format's name.
        rays: Number of rays.
        sensors: Number of sensors.
        bytes: Size of what was written; None for a pipe or a device.
        notes: Properties of the design that the format cannot hold.
    """

    path: Path
    format: str
    rays: int
    sensors: int
    bytes: int | None
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON form; the path of the design is for the caller to add."""
        return {
            "format": self.format,
            "out": str(self.path),
            "rays": self.rays,
            "bytes": self.bytes,
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """A request to export a design's rays in a format.

    Arguments:
        source: The design.
        format: The format.
        target: The file or folder to write.
        rays: Rays per frame; None takes the design's own.
        at: Condition values.
        rate_hz: Frames per second, in formats that hold it [Hz].
        robot: A robot's model that the sensors are put into; None: that of the run of a design that is mounted on a
            body of it, else they are written alone.
    """

    source: DesignSource
    format: Format
    target: Path
    rays: int | None = None
    at: Mapping[str, float] | Sequence[str] = ()
    rate_hz: float | None = None
    robot: Path | None = None

    def __post_init__(self) -> None:
        if self.rays is not None and RAYS not in self.format.holds:
            raise ConfigError(f"{self.format.name} holds sensors, not rays", where="--rays", hint="leave it out")
        check_rate(self.format, self.rate_hz)

    def _robot(self) -> RobotFile | None:
        """The robot's model that the sensors are put into; None for sensors alone."""
        mounted = self.source.specification.mount is not None
        run = self.source.opened_run() if ROBOT in self.format.holds and (mounted or self.robot) else None
        task = None if run is None else run.config.task
        path = self.robot or (getattr(task, "model", None) if mounted else None)
        if path is not None and path.exists() and self.target.exists() and path.samefile(self.target):
            raise ConfigError(f"{self.target} is the robot's model", where="--out", allowed="another file")
        return path and RobotFile(path, getattr(task, "folder", None), getattr(task, "groups", None))

    def write(self, file: Path | None = None, notes: Notes = log_note) -> Exported:
        """Write the design.

        Arguments:
            file: What is written instead of the target, which it is copied to later.
            notes: Called with every note.
        """
        file = self.target if file is None else file
        count = self.rays if RAYS in self.format.holds else 0
        design, rays = self.source.at(count, condition_values(self.at), notes)
        with phase("writing"):
            lost = tuple(write_design(self.format, design, rays, file, self.rate_hz, self._robot()))
        for note in lost:
            notes(note)
        written = [path for path in (file, *file.rglob("*")) if path.is_file()]
        size = sum(path.stat().st_size for path in written) if written or file.is_dir() else None
        return Exported(self.target, self.format.name, len(rays), len(design.sensors), size, lost)


def format_of(name: str | None, path: Path | None = None) -> Format:
    """The format of a name; without one the shipped one whose suffix a path has.

    Raises:
        ConfigError: There is none.
        PluginError: It is of another package, and broken.
    """
    if name is None and path is not None:
        fitting = [one for one in shipped_formats() if path.name.endswith(one.suffix)]
        if fitting:
            return max(fitting, key=lambda one: len(one.suffix))
    if name is None or name not in FORMATS.names():
        problem = "no format was given" if name is None else f"unknown format {name!r}"
        raise ConfigError(problem, where="--format", allowed=FORMATS.allowed())
    return FORMATS.load(name)


def export_target(path: Path | None, out: Path | None, suffix: str) -> Path:
    """The path that an export is written to: the given one, else with a suffix beside the design's file.

    Raises:
        ConfigError: It is the design's own file, or neither path is given.
    """
    if out is None and path is None:
        raise ConfigError(
            "a design without a file has no folder to write to", hint="save it, or say where to write the export"
        )
    target = out if out is not None else path.with_suffix(suffix)
    if path is not None and target.exists() and path.exists() and target.samefile(path):
        raise ConfigError("would overwrite the design itself", where=str(target), hint="give another --out")
    return target
