"""Runs and designs as commands are given them.

Rigs of others beside a run: how far their rays are heard where no file says it, and how many they can fire.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.errors import ConfigError, DataError, LidardesignError
from lidardesign.run.clock import phase
from lidardesign.run.files import is_input, is_there, readable

if TYPE_CHECKING:
    from lidardesign.cli.output import Output
    from lidardesign.config import RunConfig
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.scene import Scene
    from lidardesign.task import Split, Task


DESIGN_FOLDER = "designs"
MANIFEST = "manifest.json"
NAME_PATTERN = re.compile(r"[^\W.][\w.+-]{0,99}")


@dataclass(frozen=True)
class Run:
    """A run folder that was opened: its task and configuration."""

    folder: Path
    task: Task
    config: RunConfig

    def design_path(self, name: str) -> Path:
        """Where a design of this run is written."""
        return self.folder / DESIGN_FOLDER / f"{name}.yaml"

    @phase("scenes")
    def scenes(self, split: Split, seed: int) -> list[Scene]:
        """The scenes of a split, judged by the run's own design space.

        Raises:
            PluginError: The task's own code failed.
        """
        from lidardesign.registry import plugin_guard
        from lidardesign.task import scenes_of

        with plugin_guard(self.task.name):
            return list(scenes_of(self.task, self.config.task, split, seed, self.config.space))

    def designs(self) -> list[Path]:
        """The designs of this run by name."""
        return sorted((self.folder / DESIGN_FOLDER).glob("*.yaml"))


def open_run(folder: Path) -> Run:
    """Open a run folder.

    Raises:
        DataError: There is none, or it is damaged.
    """
    with phase("libraries"):
        from lidardesign.config import load_run_config

    task, config = load_run_config(folder)
    return Run(folder, task, config)


def read_design(path: Path, console: Output, reach_m: float | None = None) -> DesignSpec:
    """A design file or a rig of others, or standard input for `-`.

    One of a run that is not as it was written says so: it may be cut, or mended by hand. A rig says what its file
    does not.

    Arguments:
        path: The file.
        console: Where notes go.
        reach_m: How far the rays of a rig are heard where its file does not say so [m].

    Raises:
        ConfigError, DataError: It cannot be read.
    """
    from lidardesign.design.files import load_design

    difference = _difference(path)
    try:
        with readable(path) as file:
            design = load_design(file, reach_m)
    except (ConfigError, DataError) as error:
        if difference is None:
            raise
        hint = f"the file {difference}; fit it again, or mend it"
        raise type(error)(error.message, where=error.where, allowed=error.allowed, hint=hint) from None
    if difference is not None:
        console.note(f"note: {path} {difference}")
    tell_notes(design, str(path), console)
    return design


def _difference(path: Path) -> str | None:
    """In what a design differs from the one that its run's manifest has, where it lies in a run."""
    from lidardesign.run.manifest import changed_since_recorded

    folder, run = path.absolute().parent, path.absolute().parent.parent
    if folder.name != DESIGN_FOLDER or not path.is_file() or not (run / MANIFEST).is_file():
        return None
    try:
        return changed_since_recorded(run, f"{DESIGN_FOLDER}/{path.name}")
    except DataError:  # a manifest that is damaged is told by whatever needs it
        return None


def open_target(path: Path, console: Output) -> tuple[Run | None, DesignSpec | None]:
    """Open what a command was given: a run folder, or a design file and the run that it came from.

    Returns:
        (run, None) for a folder, (run or None, design) for a file.

    Raises:
        DataError: There is no such file or folder, or it cannot be read.
    """
    if path.is_dir():
        return open_run(path), None
    if not is_there(path):
        raise DataError("no such run or design", where=str(path), hint="give a run folder or a design file")
    design = read_design(path, console)
    return run_of(design, path), design


def run_of(design: DesignSpec, path: Path) -> Run | None:
    """The run that a design came from, if it is there."""
    folder = folder_of(design, path)
    return None if folder is None else open_run(folder)


def folder_of(design: DesignSpec, path: Path) -> Path | None:
    """The folder of the run that a design came from, if it is there: its provenance names it relative to its file."""
    named = design.provenance.get("run")
    if not isinstance(named, str):
        return None
    folder = Path(os.path.normpath(path.parent / named))
    # a design that was copied elsewhere names a folder that is none of its run's
    return folder if (folder / MANIFEST).is_file() else None


def need_run(run: Run | None, path: Path) -> Run:
    """The run of a target.

    Raises:
        DataError: The design was not made by a run, or the run has gone.
    """
    if run is None:
        raise DataError(
            "the run of this design is not there",
            where=str(path),
            hint="give the run folder (RUN --like FILE for a rig), or put the design back into its designs folder",
        )
    return run


def provenance(run: Run, path: Path, command: str, seed: int, **further: Any) -> dict[str, Any]:
    """What a design file says about where it came from; the run's place is relative to the design's."""
    from lidardesign.run.manifest import versions

    return {
        "command": command,
        "task": run.task.name,
        "run": os.path.relpath(run.folder.absolute(), path.parent.absolute()),
        "seed": seed,
        "versions": versions(),
        **further,
    }


def check_name(name: str) -> str:
    """A design's name, which is also its file's.

    Raises:
        ConfigError: It could not be a file's name everywhere.
    """
    if not NAME_PATTERN.fullmatch(name):
        allowed = "letters, digits, _, -, + and . (not in front), at most 100"
        raise ConfigError(f"{name!r} is no name for a design", where="--name", allowed=allowed)
    return name


def check_choice(value: str, option: str, allowed: tuple[str, ...]) -> str:
    """A value that must be one of a few words.

    Raises:
        ConfigError: It is none of them.
    """
    if value not in allowed:
        raise ConfigError(f"{value!r}", where=option, allowed=", ".join(allowed))
    return value


def parse_at(texts: list[str] | None) -> dict[str, float]:
    """The values of `--at`, as {"x_m": 0.37}; whether a density has them is for the design space to say.

    Raises:
        ConfigError: One is not NAME=VALUE with a finite number, or a name is given twice.
    """
    found: dict[str, float] = {}
    for text in texts or []:
        name, equals, value = (part.strip() for part in text.partition("="))
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not (name and equals and math.isfinite(number)):
            raise ConfigError(f"{text!r}", where="--at", allowed="NAME=VALUE with a finite number, as x_m=0.37")
        if name in found:
            raise ConfigError(f"{name} is given twice: {found[name]:g} and {number:g}", where="--at")
        found[name] = number
    return found


def sensor_count(text: str | None, fallback: int | str | None) -> int | str | None:
    """The value of `--sensors`: a number from 1, `auto`, or the fallback.

    Raises:
        ConfigError: It is neither.
    """
    if text is None:
        return fallback
    if text == "auto":
        return "auto"
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(f"{text!r}", where="--sensors", allowed="a whole number from 1, or auto")
    return int(text)


def reach_of(runs: Sequence[Run]) -> float | None:
    """How far any ray of the first run's design space may be heard [m]; None without a run."""
    from lidardesign.space import RANGE

    return runs[0].config.space.high[RANGE] if runs else None


def reach_beside(files: Iterable[Path], runs: Sequence[Run]) -> float | None:
    """How far rays may be heard in the first of the runs, or in that of the first design that came from one [m]."""
    from lidardesign.design.files import load_design

    if runs:
        return reach_of(runs)
    for path in files:
        if is_input(path):
            continue
        try:
            run = run_of(load_design(path), path)
        except LidardesignError:
            # whoever reads it for good says what is wrong with it
            continue
        if run is not None:
            return reach_of([run])
    return None


def tell_notes(design: DesignSpec, shown: str, console: Output) -> None:
    """Say what the file of a rig did not: only what was read from others has such notes."""
    notes = design.provenance.get("notes")
    if "source" in design.provenance and isinstance(notes, list):
        for note in notes:
            console.note(f"note: {shown}: {note}")


def budgets_within(designs: Iterable[DesignSpec], budgets: Sequence[int], console: Output) -> list[int]:
    """The numbers of rays to evaluate at where none is asked for: those that every fixed ray list has.

    Where a rig has fewer rays than the task's largest budget, its own number takes the place of those beyond it.
    """
    from lidardesign.design.layouts.rays import own_count

    fixed = {design.name: own_count(design) for design in designs if design.layout == "fixed"}
    usual = sorted(set(budgets))
    if not fixed or min(fixed.values()) >= usual[-1]:
        return usual
    name = min(fixed, key=lambda name: fixed[name])
    console.note(f"note: {name} fires {fixed[name]} rays: at equal rays no more are compared; --rays has other numbers")
    return sorted({*(count for count in usual if count <= fixed[name]), fixed[name]})
