"""`--dry-run`: what a command would do, read and write, and how long it took before; nothing is done.

What `learn --dry-run` says.

What `--dry-run` says of the commands that make, score and export designs.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli.output import plain_json
from lidardesign.errors import DataError
from lidardesign.run.files import STDIO

if TYPE_CHECKING:
    from pydantic import BaseModel
    from rich.console import Console as RichConsole

    from lidardesign.cli.output import Output
    from lidardesign.design.constraints.document import Constraints
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.workflow.learning_budget import Goal
    from lidardesign.workflow.run_lifecycle import Job
    from lidardesign.workflow.runs import Run
    from lidardesign.workflow.weighting import Weighting


DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Check everything that can be checked at once, say what would be done, read and written, and do nothing.",
    ),
]
BYTES_PER_MEGABYTE = 1e6
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Before:
    """How long something like it took.

    Arguments:
        seconds: Wall time [s].
        where: Whose time that was.
    """

    seconds: float
    where: str


@dataclass(frozen=True)
class Plan:
    """What a command would do.

    Arguments:
        command: The command.
        steps: What it would do, one line each, in order.
        reads: Files and folders that it would read.
        writes: Files and folders that it would write; a folder's name ends in a stroke.
        settings: What it would do it with, for `--json`.
        before: How long that took before, where that is known.
    """

    command: str
    steps: Sequence[str]
    reads: Sequence[Path | str] = ()
    writes: Sequence[Path | str] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    before: Before | None = None

    def as_dict(self) -> dict[str, Any]:
        """The document of `--json`."""
        before = None if self.before is None else {"seconds": self.before.seconds, "of": self.before.where}
        return {
            "dry_run": True,
            "command": self.command,
            "steps": list(self.steps),
            "reads": [{"path": str(path), "bytes": _bytes_of(path)} for path in self.reads],
            "writes": [{"path": str(path), "replaces": _is_replaced(path)} for path in self.writes],
            "settings": dict(self.settings),
            "before": before,
        }


def tell_plan(plan: Plan, console: Output) -> None:
    """Give a plan as the result of its command.

    Raises:
        DataError: What would be written could not be.
    """
    for path in plan.writes:
        check_can_be_written(path)
    document = plan.as_dict()
    console.result(document, lambda rich: _show(document, rich), show_costs=False)


def _show(document: Mapping[str, Any], rich: RichConsole) -> None:
    def line(text: str) -> None:
        rich.print(text, soft_wrap=True, markup=False)

    line(f"{document['command']} would")
    for step in document["steps"]:
        line(f"  {step}")
    for entry in document["reads"]:
        size = "" if entry["bytes"] is None else f" ({_size(entry['bytes'])})"
        line(f"read   {_named(entry['path'], 'standard input')}{size}")
    for entry in document["writes"]:
        replaces = " (replaced)" if entry["replaces"] else ""
        line(f"write  {_named(entry['path'], 'standard output')}{replaces}")
    if not document["writes"]:
        line("write  nothing")
    if document["before"]:
        line(f"time   {document['before']['of']} took {document['before']['seconds']:.1f} s")
    line("nothing was done: leave out --dry-run to do it")


def _named(path: str, standard: str) -> str:
    return standard if path == STDIO else path


def _size(size: int) -> str:
    return f"{size / BYTES_PER_MEGABYTE:.1f} MB" if size >= BYTES_PER_MEGABYTE else f"{size:,} bytes"


def _bytes_of(path: Path | str) -> int | None:
    return os.path.getsize(path) if str(path) != STDIO and os.path.isfile(path) else None


def _is_replaced(path: Path | str) -> bool:
    return str(path) != STDIO and os.path.isfile(path)


def check_can_be_written(path: Path | str) -> None:
    """Refuse a place where nothing can be written.

    Raises:
        DataError: A file stands where a folder would be, a folder where the file would, or writing is forbidden.
    """
    if str(path) == STDIO:
        return
    is_folder = str(path).endswith("/")
    target = Path(path)
    if target.is_dir() and not is_folder:
        raise DataError("is a folder", where=str(path), hint="give the name of a file")
    if target.is_file() and is_folder:
        raise DataError("is a file", where=str(target), hint="give a new folder, or one that is there")
    there = next(parent for parent in (target, *target.absolute().parents) if parent.exists())
    if there != target and not there.is_dir():
        raise DataError(f"cannot be made: {there} is a file", where=str(path), hint="give another place")
    if not os.access(there, os.W_OK):
        raise DataError(f"cannot be written: {there} is read-only", where=str(path), hint="give another place")


def last_time(run: Path | None, command: str) -> Before | None:
    """How long a command took the last time on a run, as its manifest has it; None where it does not."""
    if run is None:
        return None
    entry = _manifest(run).get("timings", {}).get(command)
    seconds = entry.get("seconds") if isinstance(entry, dict) else None
    return Before(seconds, f"the last {command} of {run}") if isinstance(seconds, int | float) else None


def _manifest(run: Path) -> dict[str, Any]:
    """A run's manifest; an empty one where it cannot be read: whoever needs it says so."""
    from lidardesign.run.manifest import read_manifest

    try:
        return read_manifest(run)
    except DataError:
        return {}


def like_time(run: Path, alike: Mapping[str, Any]) -> Before | None:
    """How long learning took in a run beside another one, whose configuration has the same sections.

    Arguments:
        run: The run to be; those in its folder are looked at.
        alike: The sections of the configuration that must be the same.
    """
    from lidardesign.errors import LidardesignError
    from lidardesign.run.yaml import load_yaml

    for manifest in sorted(run.absolute().parent.glob(f"*/{MANIFEST}")):
        other = manifest.parent
        try:
            found = load_yaml(other / "config.yaml").mapping
        except LidardesignError:
            continue
        before = last_time(other, "learn")
        if before is not None and all(found.get(name) == value for name, value in alike.items()):
            return Before(before.seconds, f"learning {other.name}, which has the same settings,")
    return None


WRITTEN = (
    "config.yaml",
    "manifest.json",
    "progress.jsonl",
    "checkpoint.safetensors",
    "flow.safetensors",
    "samples.npz",
    "snapshots/",
)
# The sections that learning takes its time from; a seed changes nothing of that.
ALIKE = ("task_name", "task", "space", "density", "learning")


def learn_plan(job: Job, device: str, config_file: Path | None) -> Plan:
    """The plan of a learning.

    Arguments:
        job: What would be learned where.
        device: Where the flow would be trained.
        config_file: The configuration file that was given.
    """
    settings = plain_json(job.settings.as_document())
    learning = job.settings.learning
    steps = [
        f"{'go on with' if job.has_checkpoint else 'learn'} task {job.task.name}, preset {job.settings.preset}, "
        f"seed {job.settings.seed}, on {device}",
        _length(job.goal, learning.steps, learning.batch),
        f"draw {learning.samples:,} samples for fit and constrain, and measure how good they are",
    ]
    reads = [path for path in (config_file, *_inputs(job.settings.task)) if path is not None]
    if job.begun:
        reads += sorted(path for path in job.run.iterdir() if path.is_file() and not path.name.startswith("."))
    return Plan(
        "learn",
        steps,
        reads,
        [job.run / name if not name.endswith("/") else f"{job.run / name}/" for name in WRITTEN],
        settings,
        None if job.begun else like_time(job.run, {name: settings[name] for name in ALIKE}),
    )


def _length(goal: Goal, steps: int, batch: int) -> str:
    if goal.tolerance is not None:
        return (
            f"until at most {goal.tolerance:g} of its mass is in the wrong place, in stages from {steps // 8:,} steps"
        )
    if goal.time_budget_s is not None:
        return f"as many steps as end within {goal.time_budget_s:g} s"
    return f"{steps:,} steps of {batch:,} points"


def _inputs(config: BaseModel) -> list[Path]:
    """The files and folders that a task's configuration names."""

    def within(value: Any) -> list[Path]:
        if isinstance(value, Path):
            return [value]
        if isinstance(value, dict):
            value = list(value.values())
        if isinstance(value, list | tuple):
            return [path for item in value for path in within(item)]
        return _inputs(value) if hasattr(value, "model_fields_set") else []

    return within([value for _, value in config])


CONFIGURATION, SAMPLES = "config.yaml", "samples.npz"


def fit_plan(
    run: Run,
    command: str,
    name: str,
    read: Sequence[Path | None],
    *,
    seed: int,
    constraints: Constraints | None,
    at: Mapping[str, float],
    weighting: Weighting,
    refine: int | None,
    choices: Mapping[str, Any],
) -> Plan:
    """The plan of a fit; what it is made of is as `fit_and_write` takes it, `read` are files that were given.

    Raises:
        DataError: The run has no samples yet, or they are not those that were recorded.
        InfeasibleError: The constraints contradict each other.
    """
    from lidardesign.run.manifest import verify

    verify(run.folder, SAMPLES)
    if constraints is not None:
        from lidardesign.design.constraints.feasibility import check_feasible

        counted = choices["sensors"] if isinstance(choices["sensors"], int) else None
        check_feasible(constraints, run.config.space, sensors=counted, rays=choices["rays"])
    settings = {
        **choices,
        "name": name,
        "seed": seed,
        "at": dict(at),
        "weights": list(weighting.settings),
        "refine": refine,
        "constraints": None if constraints is None else constraints.as_document(),
    }
    return Plan(
        command,
        _fit_steps(settings, run.task.name),
        [*filter(None, read), *(run.folder / name for name in (CONFIGURATION, MANIFEST, SAMPLES))],
        [run.design_path(name), run.folder / MANIFEST],
        settings,
        last_time(run.folder, command),
    )


def _fit_steps(settings: Mapping[str, Any], task: str) -> list[str]:
    rays = "rays left open" if settings["rays"] is None else f"{settings['rays']} rays"
    counted = {None: "sensors as many as follow", "auto": "sensors as many as held-out likelihood says"}
    sensors = counted.get(settings["sensors"], f"{settings['sensors']} sensors")
    sensors = "one sensor per ray" if settings["layout"] == "scan" else sensors
    place = "".join(f", {key} = {value:g}" for key, value in settings["at"].items())
    first = f"fit {sensors}, layout {settings['layout']}, {rays}, level {settings['level']:g}{place}, seed "
    steps = [f"{first}{settings['seed']}"]
    if settings["weights"]:
        steps.append(f"weigh the density with {', '.join(settings['weights'])}")
    if settings["constraints"]:
        steps.append(f"keep to constraints of {', '.join(settings['constraints'])}; check them on the finished file")
    if settings["refine"]:
        steps.append(f"refine it in up to {settings['refine']} rounds on training scenes of task {task}")
    return steps


def evaluate_plan(
    run: Run,
    designs: Sequence[tuple[DesignSpec, Path]],
    *,
    rays: Sequence[int],
    baselines: Sequence[str],
    outputs: Mapping[str, Path | None],
    settings: Mapping[str, Any],
) -> Plan:
    """The plan of an evaluation.

    Arguments:
        run: The run whose task judges.
        designs: The designs and their files.
        rays: Numbers of rays that are asked for.
        baselines: All of them, by name.
        outputs: Files to write, by option.
        settings: Further options, for `--json` and, where they are set, for people.

    Raises:
        ConfigError: No design can fire any of the numbers of rays.
    """
    from lidardesign.design.compare import outside_notes
    from lidardesign.evaluate.request import can_fire, fired_numbers, left_out

    judged = [design for design, _ in designs]
    kept = fired_numbers(judged, rays)
    counts = ", ".join(map(str, kept))
    scored = sum(can_fire(design, count) for design in judged for count in kept)
    rows, matched = scored + len(baselines) * len(kept), scored * len(baselines)
    said = ", ".join(f"{name} {value}" for name, value in settings.items() if value not in (None, (), [], False))
    steps = [
        f"score {_listed([design.name for design in judged])} in the held-out scenes of task {run.task.name}, "
        f"with {counts} rays per frame",
        f"beside {', '.join(baselines)}: {rows} rows at equal rays, up to {matched} at equal bandwidth",
        *left_out(judged, rays),
        *(line for design in judged for line in outside_notes(design, run.config.space)),
        *([f"with {said}"] if said else []),
    ]
    folders = [run.folder / name for name in (CONFIGURATION, MANIFEST)]
    samples = [run.folder / SAMPLES] if (run.folder / SAMPLES).exists() else []
    written = [f"{path}/" if option == "--plots" else path for option, path in outputs.items() if path is not None]
    return Plan(
        "evaluate",
        steps,
        [path for _, path in designs] + folders + samples,
        [*written, run.folder / MANIFEST],
        {"designs": [design.name for design in judged], "rays": kept, "baselines": list(baselines), **settings},
        last_time(run.folder, "evaluate"),
    )


def _listed(names: Sequence[str], most: int = 8) -> str:
    more = "" if len(names) <= most else f" and {len(names) - most} more"
    return ", ".join(names[:most]) + more


def export_plan(
    path: Path,
    target: Path,
    *,
    name: str,
    summary: str,
    count: int | None,
    at: Mapping[str, float],
    folder: Path | None,
    writes_folder: bool,
) -> Plan:
    """The plan of an export.

    Arguments:
        path, target: The design's file, and what would be written.
        name, summary: The format.
        count: Its rays; None where the format holds none.
        at: Condition values.
        folder: The run that the design came from, if it is there.
        writes_folder: Whether the format is a folder of files.
    """
    content = "its sensors" if count is None else f"its {count} rays"
    place = "".join(f" at {key} = {value:g}" for key, value in at.items())
    run = [] if folder is None else [folder / CONFIGURATION, folder / MANIFEST]
    return Plan(
        "export",
        [f"write {content}{place} as {name}: {summary}", "read the file back, and say what its numbers lose"],
        [path, *run],
        [f"{target}/" if writes_folder else target],
        {"format": name, "rays": count, "at": dict(at)},
        last_time(folder, "export"),
    )
