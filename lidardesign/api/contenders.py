"""Several designs beside each other: collected, named apart, and the run in whose scenes all of them are scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lidardesign.api.design import Design
from lidardesign.errors import ConfigError, DataError, pasted
from lidardesign.formats.designs import reach_beside, read_design, run_of
from lidardesign.run.clock import phase
from lidardesign.run_folder import Notes, RunFolder, log_note
from lidardesign.sensors.compare import outside_space
from lidardesign.task import moved_files, scoring_settings


@phase("designs")
def collect_designs(
    targets: Sequence[Design | Path], judge: RunFolder | None = None, notes: Notes = log_note, names: Sequence[str] = ()
) -> list[Design]:
    """The designs that were named: of run folders all designs, of files the file; each once.

    Arguments:
        targets: Designs, design files and run folders.
        judge: The run in whose scenes they are scored, where one was named.
        notes: Called with every note.
        names: The designs that are wanted; where a run has all of them, its others are not read.

    Raises:
        DataError: One is not there, or there are none.
    """
    designs: list[Design] = []
    paths = [target for target in targets if isinstance(target, Path)]
    opened = {path: RunFolder.open(path) for path in paths if path.is_dir()}
    runs = [judge] if judge else list(opened.values())
    reach_m = reach_beside([path for path in paths if path.is_file()], runs)
    for target in targets:
        if isinstance(target, Design):
            designs.append(target)
        elif target in opened:
            run = opened[target]
            wanted = [path for path in run.design_paths() if path.stem in names]
            found = wanted if wanted and len(wanted) == len(set(names)) else run.design_paths()
            designs += [Design(read_design(path, notes), run, path) for path in found]
        elif not target.exists():
            raise DataError("no such run or design", where=str(target), hint="give run folders or design files")
        else:
            design = read_design(target, notes, reach_m)
            designs.append(Design(design, run_of(design, target), target))
    seen: dict[object, Design] = {}
    for design in designs:
        # they may be renamed: a user's own keep their names
        copy = Design(design.specification, design.run, design.path)
        seen.setdefault(id(design) if design.path is None else design.path.resolve(), copy)
    if not seen:
        where = str(runs[0].folder if judge else next(iter(opened)))
        raise DataError("the run has no designs yet", where=where, hint=f"lidardesign fit {pasted(where)}")
    return list(seen.values())


def select_by_name(designs: list[Design], names: Sequence[str]) -> list[Design]:
    """The designs of these names; all of them without names.

    Raises:
        ConfigError: There is no design of a name.
    """
    known = {design.name for design in designs}
    for name in names:
        if name not in known:
            raise ConfigError(f"no design {name!r}", where="--designs", allowed=", ".join(sorted(known)) or "none")
    return [design for design in designs if not names or design.name in names]


def name_apart(designs: list[Design]) -> list[Design]:
    """Make the names of designs distinct, by their run's folder in front or their file's suffix behind.

    Raises:
        ConfigError: Two names are still equal.
    """
    alike: dict[str, list[Design]] = {}
    for design in designs:
        alike.setdefault(design.name, []).append(design)
    for name, group in alike.items():
        # of their runs, or of their files
        places = [each.run.folder if each.run else each.path.parent if each.path else Path() for each in group]
        folders = [place.resolve().name for place in places]
        for design, folder in zip(group, folders, strict=True):
            # files of one folder, as rig.csv and rig.sdf, differ in their endings alone
            ending = design.path.suffix if design.path is not None and folders.count(folder) > 1 else ""
            front = f"{folder}/" if len(set(folders)) > 1 else ""
            if len(group) > 1:
                design.specification = replace(design.specification, name=f"{front}{name}{ending}")
    names = [design.name for design in designs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise ConfigError(f"two designs are called {twice!r}", hint="rename one of the files")
    return designs


def scoring_run(designs: Sequence[Design], judge: RunFolder | None, notes: Notes = log_note) -> RunFolder:
    """The run in whose scenes designs are scored: the named one, else the one that they came from.

    Arguments:
        designs: The designs; of those from a run of other settings a note says whether they fit here.
        judge: The run that was named.
        notes: Called with every note.

    Raises:
        ConfigError: There is none, or runs differ and none was named.
    """
    candidates = [judge] if judge else [design.run for design in designs if design.run is not None]
    if not candidates:
        raise ConfigError(
            "no design comes from a run that can be found, so the task is unknown",
            hint="name the run whose scenes are used: --in RUN",
        )
    judge = candidates[0]
    other = next((run for run in candidates if _settings(run) != _settings(judge)), None)
    if other is not None:
        raise ConfigError(
            f"{judge.folder} and {other.folder} differ in task, configuration or design space",
            hint="name the run whose scenes are used: --in RUN",
        )
    for design in designs:
        condition = design.specification.condition
        if condition is not None and condition not in judge.config.space.condition:
            raise ConfigError(
                f"its rays follow {condition}, which the task {judge.task.name} does not have as a condition",
                where=f"design {design.name}",
                hint="fit a design at one value: lidardesign fit RUN --at",
            )
        if design.run is not None and _settings(design.run) != _settings(judge):
            outside = outside_space(design.specification, judge.config.space)
            there = f"; {outside} its design space" if outside else ""
            moved = ", ".join(moved_files(design.run.config.task, judge.config.task))
            there += f"; held out in one of these runs and learned from in the other: {moved}" if moved else ""
            notes(f"{design.name} of {design.run.folder} is scored in the scenes of {judge.folder}{there}")
    return judge


def _settings(run: RunFolder) -> tuple[Any, ...]:
    """A key that is equal for runs whose designs can be scored in the same scenes."""
    return run.config.task_name, scoring_settings(run.task, run.config.task), run.config.space
