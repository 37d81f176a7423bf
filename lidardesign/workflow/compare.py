"""Two designs beside each other: what differs in their sensors, and in their scores in the scenes of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lidardesign.design.compare import outside_notes, paired_sensors, readout_of
from lidardesign.design.layouts.rays import layout_of
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError
from lidardesign.evaluate.request import fired_numbers, left_out
from lidardesign.evaluate.results import Paired
from lidardesign.evaluate.score import evaluate
from lidardesign.evaluate.statistics import paired_difference
from lidardesign.run.clock import phase
from lidardesign.workflow.designs import Design, judging_run
from lidardesign.workflow.evaluate import evaluation_request
from lidardesign.workflow.run_folder import Notes, RunFolder, log_note, reach_beside, read_design, run_of

NO_SCORES: dict[str, Any] = {"metric": None, "scenes": None, "rows": [], "paired": []}


def compare_designs(
    files: tuple[Path, Path],
    run_folder: Path | None = None,
    rays: Sequence[int] | None = None,
    seed: int | None = None,
    notes: Notes = log_note,
) -> dict[str, Any]:
    """What differs between two designs, as plain values; without a run that says what they see, no scores.

    Arguments:
        files: Design files, or files of rigs.
        run_folder: The run in whose scenes they are scored; the one that they came from by default.
        rays: Numbers of rays; by default both as they are, else the task's.
        seed: Root of the random streams; the run's by default.
        notes: Called with every note.

    Raises:
        ConfigError: Numbers of rays without a run, or with a design that fires none of them.
        DataError: A file cannot be read.
    """
    designs, run = _read(files, run_folder, notes)
    if run is None and rays:
        raise ConfigError(
            "no run is known in whose scenes the designs could be scored", where="--rays", hint="--in RUN"
        )
    specifications = [design.specification for design in designs]
    entries = [
        {
            "design": str(design.path),
            "name": design.specification.name,
            "layout": design.specification.layout,
            "sensors": len(design.specification.sensors),
            "bandwidth": readout_of(design.specification).as_dict(),
        }
        for design in designs
    ]
    pairs = [pair.as_dict() for pair in paired_sensors(*specifications)]
    scores = NO_SCORES if run is None else _scores(run, designs, rays, seed, notes)
    return {"designs": entries, "sensors": pairs, **scores}


@phase("designs")
def _read(files: tuple[Path, Path], run_folder: Path | None, notes: Notes) -> tuple[list[Design], RunFolder | None]:
    """Both designs under names that differ, and the run whose scenes they are scored in, if one is known."""
    given = [RunFolder.open(run_folder)] if run_folder is not None else []
    reach_m = reach_beside(files, given)
    designs = []
    for path in files:
        specification = read_design(path, notes, reach_m)
        designs.append(Design(specification, run_of(specification, path), path))
    if designs[0].specification.name == designs[1].specification.name:
        for design, place in zip(designs, ("first", "second"), strict=True):
            design.specification = replace(design.specification, name=f"{design.specification.name} ({place})")
    if not given and all(design.run is None for design in designs):
        notes("no run is known, so there are no scores; --in RUN names one whose scenes are used")
        return designs, None
    return designs, judging_run(designs, given, notes)


def _scores(
    run: RunFolder, designs: Sequence[Design], rays: Sequence[int] | None, seed: int | None, notes: Notes
) -> dict[str, Any]:
    """Scores on held-out scenes and their paired differences, first minus second."""
    specifications = [design.specification for design in designs]
    own = [readout_of(specification).rays for specification in specifications]
    counts = rays or _usual_counts(specifications, own, run, notes)
    for specification in specifications:  # one that has no row at all is refused
        fired_numbers([specification], counts)
    for line in left_out(specifications, counts):
        notes(line)
    request = replace(evaluation_request(run, designs, counts, [], seed), equal_bandwidth=False)
    for specification in specifications:
        for line in outside_notes(specification, run.config.space):
            notes(line)
    evaluation = evaluate(request)
    rows, paired = list(evaluation.rows), list(evaluation.paired)
    if not rays and None not in own and own[0] != own[1]:
        # both with the rays that each was made for, in the same scenes
        first, second = (
            evaluate(replace(request, designs=[design], rays=[int(count or 0)])).rows[0]
            for design, count in zip(request.designs, own, strict=True)
        )
        difference = paired_difference(first.per_scene, second.per_scene, request.seed, first.groups)
        paired.insert(0, Paired(first.design, second.design, first.rays, *difference, rays_b=second.rays))
        own_rows = {(row.design, row.rays): row for row in (first, second)}
        rows = [first, second, *(row for row in rows if (row.design, row.rays) not in own_rows)]
    metric = evaluation.metric
    return {
        "metric": {"name": metric.name, "unit": metric.unit, "better": metric.better, "worst": metric.worst},
        "scenes": evaluation.scenes,
        "rows": [row.as_dict() for row in rows],
        "paired": [pair.as_dict() for pair in paired],
    }


def _usual_counts(designs: Sequence[DesignSpec], own: Sequence[int | None], run: RunFolder, notes: Notes) -> list[int]:
    """Rays at which two designs are compared: what both were made for, else the budgets that both have.

    Where a rig has fewer rays than the task's largest budget, its own number takes the place of those beyond it.
    """
    if own[0] is not None and own[0] == own[1]:
        return [own[0]]
    sizes = {design.name: layout_of(design).most_count(design) for design in designs}
    fixed = {name: size for name, size in sizes.items() if size is not None}
    usual = sorted(set(run.task.defaults.rays))
    if not fixed or min(fixed.values()) >= usual[-1]:
        return usual
    name = min(fixed, key=lambda name: fixed[name])
    notes(f"{name} fires {fixed[name]} rays: no others are compared; --rays sets other numbers")
    return sorted({*(count for count in usual if count <= fixed[name]), fixed[name]})
