"""Run folders: their task, configuration, scenes, designs and inputs."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.config import RunConfig, load_run_config, with_task_settings
from lidardesign.errors import LidardesignError
from lidardesign.plugins import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.run.files import named, sha256_file
from lidardesign.run.inputs import MESH
from lidardesign.run.manifest import read_manifest
from lidardesign.scenes.scene import Scene
from lidardesign.space import DesignSpace
from lidardesign.task import FolderConfig, Metric, Split, Task, conditions_of, metric_of, scenes_of

if TYPE_CHECKING:
    from typing import Self

    from pydantic import BaseModel

DESIGN_FOLDER = "designs"
CONFIGURATION, MANIFEST, SAMPLES = "config.yaml", "manifest.json", "samples.npz"
# Key of the manifest for the task's input files, with their SHA-256.
INPUTS = "inputs"

Notes = Callable[[str], None]


def ignore(step: str) -> None:
    """Default callback for progress messages, which ignores them."""


def log_note(text: str) -> None:
    """Default callback for notes, which writes them to the log of this package."""
    logging.getLogger("lidardesign").info(text)


@dataclass(frozen=True)
class RunFolder:
    """An open run folder with its task and configuration, and when it was made; None: not to be compared."""

    folder: Path
    task: Task
    config: RunConfig
    created: str | None = None

    @classmethod
    def open(cls, folder: Path | str) -> Self:
        """Open a run folder.

        Raises:
            DataError: There is none, or it is damaged.
        """
        folder = Path(folder)
        return cls(folder, *load_run_config(folder), read_manifest(folder).get("created"))

    def design_path(self, name: str) -> Path:
        """Path of a design file of this run."""
        return self.folder / DESIGN_FOLDER / f"{name}.yaml"

    @cached_property
    def metric(self) -> Metric:
        """Metric of the task's scores with the run's configuration."""
        with plugin_guard(self.task.name):
            return metric_of(self.task, self.config.task)

    def with_settings(self, settings: Sequence[str]) -> Self:
        """This run with other settings of the task, as KEY=VALUE; its space stays.

        Raises:
            ConfigError: A key that is none, or that cannot be changed.
        """
        return replace(self, config=with_task_settings(self.task, self.config, settings)) if settings else self

    def conditions(self, space: DesignSpace | None = None) -> list[dict[str, float]]:
        """Condition values that designs are evaluated at, in the run's design space or a part; see `conditions_of`.

        Raises:
            PluginError: The task's own code failed.
        """
        with plugin_guard(self.task.name):
            return conditions_of(self.task, self.config.task, space or self.config.space)

    @phase("scenes")
    def scenes(self, split: Split, seed: int) -> list[Scene]:
        """The scenes of a split for the run's own design space.

        Raises:
            PluginError: The task's own code failed.
        """
        with plugin_guard(self.task.name):
            return list(scenes_of(self.task, self.config.task, split, seed, self.config.space))

    def input_notes(self) -> list[str]:
        """Notes on input files that changed, went or were added since the run was learned."""
        task, before = self.config.task, read_manifest(self.folder).get(INPUTS) or {}
        now = input_hashes(task) if before else {}
        moved = {name: digest for name, digest in before.items() if now.get(name) != digest}

        def is_kept(name: str) -> bool:
            return isinstance(task, FolderConfig) and task.reads(Path(name))

        # files of folders are identified by content, under any name
        renamed = {digest for name, digest in moved.items() if is_kept(name)} & {*now.values()}
        changed = [name for name, digest in moved.items() if digest not in renamed]
        notes = task.twin_notes() if isinstance(task, FolderConfig) else []
        if changed:
            moves = named([f"{name} {'changed' if Path(name).exists() else 'is gone'}" for name in changed])
            notes.append(f"{moves} since {self.folder} was learned: its scenes are different now")
        came = [
            Path(name).name
            for name, digest in now.items()
            if is_kept(name) and before.get(name) != digest and name not in changed and digest not in renamed
        ]
        if came:
            left_out = f"added after {self.folder} was learned, so left out; learn again to include what is new"
            notes.append(f"{named(came)}: {left_out}")
        return notes

    def design_paths(self) -> list[Path]:
        """Paths of this run's design files, sorted by name."""
        return sorted((self.folder / DESIGN_FOLDER).glob("*.yaml"))

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
    """Paths in a task's configuration."""

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
    """SHA-256 of a task's input files by path: named files, and files of named folders and robots."""
    files = [file for path in input_paths(config) for file in files_of(path)]
    return {str(file): sha256_file(file) for file in files if file.is_file() and file.stat().st_size <= MESH.most_bytes}


def files_of(path: Path) -> list[Path]:
    """Files of a folder, files of a robot's model, or the single file."""
    if path.suffix.lower() in (".xml", ".urdf"):
        from lidardesign.scenes.mujoco_models import model_files

        with contextlib.suppress(LidardesignError):  # errors are reported when the model is read
            return [Path(name) for name, *_ in model_files(path, Path(path.anchor))]
    return sorted(path.iterdir()) if path.is_dir() else [path]


def settings_texts(settings: Sequence[str] | Mapping[str, Any]) -> tuple[str, ...]:
    """Settings as KEY=VALUE texts, from such texts or from a mapping of dotted keys."""
    if not isinstance(settings, Mapping):
        return tuple(settings)
    texts = {key: value if isinstance(value, str | Path) else json.dumps(value) for key, value in settings.items()}
    return tuple(f"{key}={value}" for key, value in texts.items())
