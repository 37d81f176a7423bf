"""What `--dry-run` says of the commands that make, score and export designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.cli.dry_run import Plan, last_time

if TYPE_CHECKING:
    from lidardesign.cli.runs import Run
    from lidardesign.cli.weighting import Weighting
    from lidardesign.design.constraints import Constraints
    from lidardesign.design.sensor import Design

CONFIGURATION, MANIFEST, SAMPLES = "config.yaml", "manifest.json", "samples.npz"


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
        from lidardesign.design.constraints import check_feasible

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
    designs: Sequence[tuple[Design, Path]],
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
    from lidardesign.design.outside import outside_notes
    from lidardesign.evaluate.ray_numbers import can_fire, fired_numbers, left_out

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
