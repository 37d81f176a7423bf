"""The designs that a command is to judge, and the run whose scenes they are judged in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.errors import ConfigError, DataError
from lidardesign.run.clock import phase
from lidardesign.run.files import is_there
from lidardesign.workflow.runs import open_run, reach_beside, read_design, run_of

if TYPE_CHECKING:
    from lidardesign.cli.output import Output
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.evaluate.score import EvaluationRequest
    from lidardesign.workflow.runs import Run

ALWAYS = ("uniform", "random", "bounding")


@dataclass
class JudgedDesign:
    """One design to evaluate and the run that it came from."""

    design: DesignSpec
    path: Path
    run: Run | None


@phase("designs")
def collect(targets: list[Path], console: Output) -> tuple[list[JudgedDesign], list[Run]]:
    """The designs that were named, and the runs: of folders all designs, of files the file."""
    entries: list[JudgedDesign] = []
    opened = {target: open_run(target) for target in targets if target.is_dir()}
    runs = list(opened.values())
    reach_m = reach_beside([target for target in targets if target.is_file()], runs)
    for target in targets:
        if target in opened:
            run = opened[target]
            entries += [JudgedDesign(read_design(path, console), path, run) for path in run.designs()]
        elif not is_there(target):
            raise DataError("no such run or design", where=str(target), hint="give run folders or design files")
        else:
            design = read_design(target, console, reach_m)
            entries.append(JudgedDesign(design, target, run_of(design, target)))
    seen: dict[Path, JudgedDesign] = {}
    for entry in entries:
        seen.setdefault(entry.path.resolve(), entry)
    return list(seen.values()), runs


def named_apart(entries: list[JudgedDesign]) -> list[JudgedDesign]:
    """Designs that share a name take in front their run's name, or behind their file's ending, as tells them apart."""
    alike: dict[str, list[JudgedDesign]] = {}
    for entry in entries:
        alike.setdefault(entry.design.name, []).append(entry)
    for name, group in alike.items():
        folders = [(entry.run.folder if entry.run else entry.path.parent).resolve().name for entry in group]
        for entry, folder in zip(group, folders, strict=True):
            # files of one folder, as rig.csv and rig.sdf, differ in their endings alone
            ending = entry.path.suffix if folders.count(folder) > 1 else ""
            front = f"{folder}/" if len(set(folders)) > 1 else ""
            if len(group) > 1:
                entry.design = replace(entry.design, name=f"{front}{name}{ending}")
    names = [entry.design.name for entry in entries]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise ConfigError(f"two designs are called {twice!r}", hint="rename one of the files")
    return entries


def common_run(entries: list[JudgedDesign], runs: list[Run]) -> Run:
    """The run whose task and configuration all designs are judged by."""
    candidates = [*runs, *(entry.run for entry in entries if entry.run is not None)]
    if not candidates:
        raise ConfigError(
            "no design names a run that is there, so the task is unknown",
            hint="give the run folder too: lidardesign evaluate RUN DESIGN",
        )
    first = candidates[0]
    for other in candidates[1:]:
        if _judged_by(other) != _judged_by(first):
            raise ConfigError(
                f"{first.folder} and {other.folder} differ in task, configuration or design space",
                hint="evaluate them one by one: scores of different scenes do not compare",
            )
    if not entries:
        raise DataError("the run has no designs yet", where=str(first.folder), hint=f"lidardesign fit {first.folder}")
    return first


def _judged_by(run: Run) -> tuple[Any, ...]:
    """What runs share whose designs are scored in the same scenes."""
    from lidardesign.task import judged_by_keys

    config = run.config
    return config.task_name, judged_by_keys(run.task, config.task), config.space


def request_of(
    run: Run, entries: list[JudgedDesign], rays: list[int] | None, baselines: list[str], seed: int | None
) -> EvaluationRequest:
    """The request that scores designs in a run's scenes.

    Arguments:
        run: Whose task and configuration judge.
        entries: The designs.
        rays: Numbers of rays; None: the task's.
        baselines: By name.
        seed: Root of the random streams; None: the run's.
    """
    from lidardesign.evaluate.score import EvaluationRequest
    from lidardesign.samples import FILE_NAME
    from lidardesign.workflow.layouts import layouts_of, learned_density, may_need_samples, twin_without_visibility
    from lidardesign.workflow.weighting import designs_samples

    config, task = run.config, run.task
    seed = config.seed if seed is None else seed
    made = [(entry.design, entry.run) for entry in entries if entry.run is not None]
    layouts = layouts_of(made)
    # designs of one run and weighting share its samples, and what is worked out from them
    laid_out = [
        (design, origin) for design, origin in made if may_need_samples(design) and (origin.folder / FILE_NAME).exists()
    ]
    samples = designs_samples(laid_out, layouts.targets)
    return EvaluationRequest(
        task=task,
        config=config.task,
        space=config.space,
        seed=seed,
        designs=[entry.design for entry in entries],
        rays=sorted(set(rays or task.defaults.rays)),
        baselines=tuple(dict.fromkeys(baselines)),
        samples=samples,
        train=run.scenes("train", seed),
        test=run.scenes("test", seed),
        lay_out=layouts,
        without_visibility=(lambda: twin_without_visibility(*made[0], layouts)) if made else None,
        density=cache(lambda: learned_density(made[0][1] if made else run)),
    )
