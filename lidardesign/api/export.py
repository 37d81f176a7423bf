"""The explicit rays of a design, and writing them in other programs' formats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidardesign.errors import BackgroundNote, ConfigError
from lidardesign.fitting.run_samples import RunTarget, Weighting, may_need_samples, weighted_samples
from lidardesign.formats.registry import EXPORTERS, Exporter
from lidardesign.layouts.rays import lay_out, layout_of, own_count
from lidardesign.layouts.track import placed
from lidardesign.run.clock import phase
from lidardesign.run_folder import Notes, RunFolder, folder_of, log_note
from lidardesign.scenes.mujoco_models import RobotFile
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.sensor import DesignSpec

# Formats that hold sensors only, so that the number of rays may stay open.
WITHOUT_RAYS = ("sensors-csv", "stl")


class DesignSource:
    """A design with what its rays may follow from.

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

    @property
    def leaves_rays_open(self) -> bool:
        """Whether nothing in the design says how many rays it fires."""
        return layout_of(self.specification).own_count(self.specification) is None

    def largest_budget(self) -> int:
        """The rays of a design that leaves them open: the largest number that its task is evaluated at.

        Raises:
            ConfigError: Its run is not there.
        """
        run = self.opened_run()
        if run is None:
            where = self.specification.name if self.path is None else str(self.path)
            raise ConfigError("the design leaves the number of rays open", where=where, hint="give --rays N")
        return max(run.task.defaults.rays)

    @phase("rays")
    def lay_out(
        self,
        count: int | None = None,
        at: Mapping[str, float] | None = None,
        seed: int = 0,
        *,
        may_stay_open: bool = False,
        notes: Notes = log_note,
    ) -> tuple[DesignSpec, Rays]:
        """The design and its explicit rays at a condition; another number of rays may need the samples of its run.

        A scan of another number of rays has other sensors, so the design that is given back is that one. A design that
        leaves its number of rays open takes the largest budget of its task.

        Arguments:
            count: Rays per frame.
            at: Condition values.
            seed: Root of the random streams.
            may_stay_open: Whether sensors alone are wanted where no number is given.
            notes: Called with every note.

        Raises:
            ConfigError: The design is nowhere at such a condition, or needs a run that is not there.
        """
        design, at = self.specification, at or {}
        if at or design.track is not None:
            # refuses a wrong place before anything is fitted
            placed(design, at)
        if count is None and self.leaves_rays_open and not may_stay_open:
            count = self.largest_budget()
            notes(BackgroundNote(f"the design leaves the number of rays open; {count} is the task's largest budget"))
        samples, retarget = None, None
        if count is not None and may_need_samples(design) and (self.leaves_rays_open or count != own_count(design)):
            run = self.opened_run()
            if run is not None:
                weighting = Weighting.of(design)
                retarget = RunTarget(run, weighting=weighting)
                samples = weighted_samples(run, weighting, retarget)
        if layout_of(design).one_sensor_per_ray:
            # most exports fit nothing, and start sooner without what fits
            from lidardesign.mixture.fit import refitted

            design = refitted(design, count, samples, seed=seed, at=at, retarget=retarget)
        count = 0 if may_stay_open else count
        rays = lay_out(design, count, samples, seed=seed, at=at, retarget=retarget)
        return placed(design, at) if at or design.track is not None else design, rays


@dataclass(frozen=True, eq=False)
class Exported:
    """What an export wrote.

    Arguments:
        path: The file or folder.
        format: The format's name.
        rays: How many rays it holds.
        sensors: How many sensors.
        bytes: The size of what was written; None for what is no file, as a pipe.
        notes: What the format cannot hold.
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
    """What is exported: how many rays, at which condition, at how many frames per second, to where.

    Arguments:
        source: The design.
        exporter: The format.
        target: The file or folder to write.
        rays: Rays per frame; None takes the design's own.
        at: Condition values.
        rate_hz: Frames per second, in formats that hold it [Hz].
        seed: Root of the random streams.
        robot: A robot's model that the sensors are put into; None: that of the run of a design that is mounted on a
            body of it, else they are written alone.
    """

    source: DesignSource
    exporter: Exporter
    target: Path
    rays: int | None = None
    at: Mapping[str, float] = field(default_factory=dict)
    rate_hz: float | None = None
    seed: int = 0
    robot: Path | None = None

    def __post_init__(self) -> None:
        name, layout = self.exporter.name, layout_of(self.source.specification)
        if self.rays is not None and name in WITHOUT_RAYS and not layout.one_sensor_per_ray:
            # of a scan another number of rays is another number of sensors
            raise ConfigError(f"{name} holds sensors, not rays", where="--rays", hint="leave it out")
        self.exporter.check_rate(self.rate_hz)

    def _robot(self) -> RobotFile | None:
        """The robot's model, and what the run of a mounted design says of it."""
        mounted = self.source.specification.mount is not None
        run = self.source.opened_run() if self.exporter.robotic and (mounted or self.robot) else None
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
        file, exporter = self.target if file is None else file, self.exporter
        open_rays = exporter.name in WITHOUT_RAYS
        design, rays = self.source.lay_out(self.rays, self.at, self.seed, may_stay_open=open_rays, notes=notes)
        with phase("writing"):
            lost = tuple(exporter.write(design, rays, file, self.rate_hz, self._robot()))
        for note in lost:
            notes(note)
        written = [path for path in (file, *file.rglob("*")) if path.is_file()]
        size = sum(path.stat().st_size for path in written) if written or file.is_dir() else None
        return Exported(self.target, exporter.name, len(rays), len(design.sensors), size, lost)


def exporter_of(name: str | None, path: Path | None = None) -> Exporter:
    """The format of a name; without one that whose suffix a path has.

    Raises:
        ConfigError: There is none.
    """
    if name is None and path is not None:
        fitting = [exporter for exporter in EXPORTERS.values() if path.name.endswith(exporter.suffix)]
        if fitting:
            return max(fitting, key=lambda exporter: len(exporter.suffix))
    if name not in EXPORTERS:
        problem = "no format was given" if name is None else f"unknown format {name!r}"
        raise ConfigError(problem, where="--format", allowed=", ".join(EXPORTERS))
    return EXPORTERS[name]


def export_target(path: Path | None, out: Path | None, exporter: Exporter) -> Path:
    """Where to write a design: where a user says, or beside its file.

    Raises:
        ConfigError: Over the design, or nowhere that is known.
    """
    if out is None and path is None:
        raise ConfigError(
            "a design without a file has no folder to write to", hint="save it, or say where to write the export"
        )
    target = out if out is not None else path.with_suffix(exporter.suffix)
    if path is not None and target.exists() and path.exists() and target.samefile(path):
        raise ConfigError("would overwrite the design itself", where=str(target), hint="give another --out")
    return target
