"""Run folders and the designs in and beside them: opened, read, and traced back to where they came from."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.config import RunConfig, load_run_config
from lidardesign.errors import ConfigError, DataError, LidardesignError
from lidardesign.registry import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.run.files import sha256_file
from lidardesign.run.inputs import MESH
from lidardesign.run.manifest import changed_since_recorded, read_manifest
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.design_file import load_design
from lidardesign.sensors.sensor import DesignSpec
from lidardesign.space import RANGE, DesignSpace
from lidardesign.task import FolderConfig, Metric, Split, Task, conditions_of, metric_of, scenes_of

if TYPE_CHECKING:
    from typing import Self

    from pydantic import BaseModel

DESIGN_FOLDER = "designs"
CONFIGURATION, MANIFEST, SAMPLES = "config.yaml", "manifest.json", "samples.npz"
# Where the manifest has what a task read, with its SHA-256.
INPUTS = "inputs"
MOST_NAMED = 6

Notes = Callable[[str], None]


def ignore(step: str) -> None:
    """Where steps of the work go when nobody asks for them."""


def log_note(text: str) -> None:
    """Where notes go when nobody asks for them: to the log of this package."""
    logging.getLogger("lidardesign").info(text)


@dataclass(frozen=True)
class RunFolder:
    """A run folder that was opened: its task and configuration."""

    folder: Path
    task: Task
    config: RunConfig

    @classmethod
    def open(cls, folder: Path | str) -> Self:
        """Open a run folder.

        Raises:
            DataError: There is none, or it is damaged.
        """
        folder = Path(folder)
        return cls(folder, *load_run_config(folder))

    def design_path(self, name: str) -> Path:
        """Where a design of this run is written."""
        return self.folder / DESIGN_FOLDER / f"{name}.yaml"

    @property
    def metric(self) -> Metric:
        """What scores mean."""
        with plugin_guard(self.task.name):
            return metric_of(self.task, self.config.task)

    def conditions(self, space: DesignSpace | None = None) -> list[dict[str, float]]:
        """The condition values that designs are for, in the run's design space or a part of it; see `conditions_of`.

        Raises:
            PluginError: The task's own code failed.
        """
        with plugin_guard(self.task.name):
            return conditions_of(self.task, self.config.task, space or self.config.space)

    @phase("scenes")
    def scenes(self, split: Split, seed: int) -> list[Scene]:
        """The scenes of a split, judged by the run's own design space.

        Raises:
            PluginError: The task's own code failed.
        """
        with plugin_guard(self.task.name):
            return list(scenes_of(self.task, self.config.task, split, seed, self.config.space))

    def input_notes(self) -> list[str]:
        """Lines on what the task reads, where it is no longer as it was when the run was learned."""
        task, before = self.config.task, read_manifest(self.folder).get(INPUTS) or {}
        now = input_hashes(task) if before else {}
        moved = {name: digest for name, digest in before.items() if now.get(name) != digest}

        def is_kept(name: str) -> bool:
            return isinstance(task, FolderConfig) and task.reads(Path(name))

        # files of folders are known by their content, whatever they are called now
        renamed = {digest for name, digest in moved.items() if is_kept(name)} & {*now.values()}
        changed = [name for name, digest in moved.items() if digest not in renamed]
        notes = []
        if changed:
            more = "" if len(changed) == 1 else f" and {len(changed) - 1} more"
            notes.append(f"{changed[0]}{more} changed since {self.folder} was learned: its scenes are different now")
        came = [
            Path(name).name
            for name, digest in now.items()
            if is_kept(name) and before.get(name) != digest and name not in changed and digest not in renamed
        ]
        if came:
            more = f" and {len(came) - MOST_NAMED} more" if len(came) > MOST_NAMED else ""
            named = ", ".join(came[:MOST_NAMED]) + more
            notes.append(f"{named} came since {self.folder} was learned: left out; learn again to take in what is new")
        return notes

    def design_paths(self) -> list[Path]:
        """The files of this run's designs by name."""
        return sorted((self.folder / DESIGN_FOLDER).glob("*.yaml"))

    @property
    def has_samples(self) -> bool:
        """Whether learning has left samples of the density."""
        return (self.folder / SAMPLES).exists()

    def command_times(self) -> dict[str, dict[str, float]]:
        """Seconds by phase of each command on this run, in the order in which they first ran."""
        entries = read_manifest(self.folder).get("timings", {})
        phases = {name: entry.get("phases") for name, entry in entries.items() if isinstance(entry, dict)}
        return {
            name: dict(seconds)
            for name, seconds in phases.items()
            # entries of older versions have no phases
            if isinstance(seconds, dict) and all(isinstance(value, int | float) for value in seconds.values())
        }


def input_paths(config: BaseModel) -> list[Path]:
    """The paths that a task's configuration names."""

    def within(value: Any) -> list[Path]:
        if isinstance(value, dict):
            value = list(value.values())
        if isinstance(value, list | tuple):
            return [path for item in value for path in within(item)]
        if hasattr(value, "model_fields_set"):
            return input_paths(value)
        return [value] if isinstance(value, Path) else []

    return within([value for _, value in config])


def input_hashes(config: BaseModel) -> dict[str, str]:
    """SHA-256 of the files that a task's configuration names, of those in its folders, and of its robots, by path."""
    files = [file for path in input_paths(config) for file in files_of(path)]
    return {str(file): sha256_file(file) for file in files if file.is_file() and file.stat().st_size <= MESH.most_bytes}


def files_of(path: Path) -> list[Path]:
    """The files of a folder, or those that a robot's model names, or the one file."""
    if path.suffix.lower() in (".xml", ".urdf"):
        from lidardesign.scenes.mujoco_models import model_files

        with contextlib.suppress(LidardesignError):  # whoever reads the model says what is wrong with it
            return [Path(name) for name, *_ in model_files(path, Path(path.anchor))]
    return sorted(path.iterdir()) if path.is_dir() else [path]


def read_design(path: Path, notes: Notes = log_note, reach_m: float | None = None) -> DesignSpec:
    """A design file or a rig of others.

    One of a run that is not as it was written says so: it may be cut, or mended by hand. A rig says what its file
    does not.

    Arguments:
        path: The file.
        notes: Called with every note.
        reach_m: How far the rays of a rig are heard where its file does not say so [m].

    Raises:
        ConfigError, DataError: It cannot be read.
    """
    difference = _difference(path)
    try:
        design = load_design(path, reach_m)
    except (ConfigError, DataError) as error:
        if difference is None:
            raise
        hint = f"the file {difference}; fit it again, or correct it"
        raise type(error)(error.message, where=error.where, allowed=error.allowed, hint=hint) from None
    if difference is not None:
        notes(f"{path} {difference}")
    # only what was read from others has notes
    further = design.provenance.get("notes") if "source" in design.provenance else None
    for note in further if isinstance(further, list) else ():
        notes(f"{path}: {note}")
    return design


def _difference(path: Path) -> str | None:
    """In what a design differs from the one that its run's manifest has, where it lies in a run."""
    folder, run = path.absolute().parent, path.absolute().parent.parent
    if folder.name == DESIGN_FOLDER and path.is_file() and (run / MANIFEST).is_file():
        with contextlib.suppress(DataError):  # whatever needs the manifest says that it is damaged
            return changed_since_recorded(run, f"{DESIGN_FOLDER}/{path.name}")
    return None


def open_target(path: Path, notes: Notes = log_note) -> tuple[RunFolder | None, DesignSpec | None]:
    """Open a run folder, or a design file and the run that it came from.

    Returns:
        (run, None) for a folder, (run or None, design) for a file.

    Raises:
        DataError: There is no such file or folder, or it cannot be read.
    """
    if path.is_dir():
        return RunFolder.open(path), None
    if not path.exists():
        raise DataError("no such run or design", where=str(path), hint="give a run folder or a design file")
    design = read_design(path, notes)
    return run_of(design, path), design


def run_of(design: DesignSpec, path: Path) -> RunFolder | None:
    """The run that a design came from, if it is there."""
    folder = folder_of(design, path)
    return None if folder is None else RunFolder.open(folder)


def folder_of(design: DesignSpec, path: Path) -> Path | None:
    """The folder of the run that a design came from, if it is there: its provenance names it relative to its file."""
    named = design.provenance.get("run")
    folder = Path(os.path.normpath(path.parent / named)) if isinstance(named, str) else None
    # a design that was copied elsewhere names a folder that is none of its run's
    return folder if folder is not None and (folder / MANIFEST).is_file() else None


def need_run(run: RunFolder | None, path: Path | str) -> RunFolder:
    """The run of a design.

    Raises:
        DataError: The design was not made by a run, or the run has gone.
    """
    if run is None:
        raise DataError(
            "the run of this design cannot be found",
            where=str(path),
            hint="give the run folder (RUN --like FILE for a rig), or put the design back into its designs folder",
        )
    return run


def relative_folder(folder: Path, path: Path) -> str:
    """How the file of a design names the folder of its run."""
    return os.path.relpath(folder.absolute(), path.parent.absolute())


def reach_of(runs: Sequence[RunFolder]) -> float | None:
    """How far any ray of the first run's design space may be heard [m]; None without a run."""
    return runs[0].config.space.high[RANGE] if runs else None


def reach_beside(files: Iterable[Path], runs: Sequence[RunFolder]) -> float | None:
    """How far rays may be heard in the first of the runs, or in that of the first design that came from one [m]."""
    if runs:
        return reach_of(runs)
    for path in files:
        # whoever reads it for good says what is wrong with it
        with contextlib.suppress(LidardesignError):
            run = run_of(load_design(path), path)
            if run is not None:
                return reach_of([run])
    return None


def settings_texts(settings: Sequence[str] | Mapping[str, Any]) -> tuple[str, ...]:
    """Settings as KEY=VALUE: as they are, or of a mapping of dotted keys."""
    if not isinstance(settings, Mapping):
        return tuple(settings)
    texts = {key: value if isinstance(value, str | Path) else json.dumps(value) for key, value in settings.items()}
    return tuple(f"{key}={value}" for key, value in texts.items())
