"""What the report of `evaluate` is made of beside the scores: the 3D view, the density, constraints and times."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.run.clock import phase

if TYPE_CHECKING:
    import numpy as np

    from lidardesign.cli.runs import Run
    from lidardesign.design.sensor import Design
    from lidardesign.design.tightness import Tightness
    from lidardesign.evaluate.density_views import DensityView
    from lidardesign.evaluate.report import Report
    from lidardesign.evaluate.report_tables import CommandTimes, Reproduction
    from lidardesign.evaluate.request import EvaluationRequest
    from lidardesign.evaluate.results import Evaluation
    from lidardesign.evaluate.shown import Shown

# Drawn in the 3D view of what the density observes: enough to see its shape, few enough to see through.
DENSITY_POINTS = 3000
# Of the points' draw, beside everything else that is drawn from a run's seed.
STREAM = "report"
THIS = "evaluate"


def write_page(
    evaluation: Evaluation,
    request: EvaluationRequest,
    run: Run,
    times: Mapping[str, Mapping[str, float]],
    path: Path,
) -> None:
    """Write the report of an evaluation.

    Arguments:
        evaluation: What was found.
        request: What was asked for.
        run: The run whose density the designs are of.
        times: Seconds by phase of each command on the run, of this one until now.
        path: The HTML file.
    """
    from lidardesign.evaluate.report import write_report

    write_report(report_of(evaluation, request, run, times), path)


@phase("report")
def report_of(
    evaluation: Evaluation, request: EvaluationRequest, run: Run, times: Mapping[str, Mapping[str, float]]
) -> Report:
    """Everything that a report is made of; see `write_page`."""
    from lidardesign.evaluate.report import Report

    density, points = _density(request, run)
    scenes = "1 held-out scene" if evaluation.scenes == 1 else f"{evaluation.scenes} held-out scenes"
    return Report(
        evaluation,
        _shown(evaluation, request),
        title=f"{run.task.name}: {evaluation.metric.name} on {scenes}",
        density=density,
        density_m=points,
        constraints={design.name: _tightness(design, run) for design in request.designs},
        times=_times(run, times),
        reproduce=_reproduction(request, run),
    )


def _shown(evaluation: Evaluation, request: EvaluationRequest) -> Shown:
    """The first held-out scene with all designs, under the effects that were simulated where any were."""
    from lidardesign.design.track import placed
    from lidardesign.evaluate.entries import ordered_conditions
    from lidardesign.evaluate.shown import shown_in
    from lidardesign.simulate.returns import Rays

    def laid_out(design: Design, at: Any) -> Rays:
        count = design.rays or max(request.rays)
        return request.lay_out(design, count, request.samples.get(design.name), at=at)

    return shown_in(
        request.test[0],
        request.designs,
        ordered_conditions(request),
        placed,
        laid_out,
        planner=request.planner if any(effect.on for effect in evaluation.effects) else None,
        seed=request.seed,
    )


def _density(request: EvaluationRequest, run: Run) -> tuple[DensityView | None, np.ndarray | None]:
    """The learned density to look at, and points that it observes; nothing where a run has no samples."""
    from lidardesign.design.samples import FILE_NAME, load_samples
    from lidardesign.evaluate.density_views import density_view
    from lidardesign.space import observed_point
    from lidardesign.task import random_generator

    if not (run.folder / FILE_NAME).exists():
        return None, None
    samples = load_samples(run.folder)
    drawn = samples.resample(DENSITY_POINTS, random_generator(run.config.seed, STREAM))
    return density_view(samples, request.test[0], request.designs), observed_point(drawn)


def _tightness(design: Design, run: Run) -> list[Tightness]:
    """How tight each constraint of a design is, those of its space last."""
    from lidardesign.design.check import check_design
    from lidardesign.design.files import design_document
    from lidardesign.design.tightness import SPACE_MARK, tightness

    checks = check_design(design_document(design), design.constraints, run.config.space)
    found = tightness(checks, [sensor.name for sensor in design.sensors])
    return sorted(found, key=lambda one: one.name.startswith(SPACE_MARK))


def _times(run: Run, times: Mapping[str, Mapping[str, float]]) -> list[CommandTimes]:
    """The times of commands on a run, with what its manifest says of when they ran and what memory they took."""
    from lidardesign.evaluate.report_tables import CommandTimes
    from lidardesign.run.manifest import read_manifest

    kept = read_manifest(run.folder).get("timings") or {}
    entries = {name: entry for name, entry in kept.items() if isinstance(entry, dict) and name != THIS}
    return [
        CommandTimes(
            f"lidardesign {name}" + (", up to this report" if name == THIS else ""),
            str(entries.get(name, {}).get("when", "")),
            {phase: float(seconds) for phase, seconds in phases.items()},
            _bytes(entries.get(name, {})),
        )
        for name, phases in times.items()
    ]


def _bytes(entry: dict[str, Any]) -> int | None:
    value = entry.get("peak_memory_bytes")
    return value if isinstance(value, int) else None


def _reproduction(request: EvaluationRequest, run: Run) -> Reproduction:
    """Commands, seeds and versions of the run, its designs and this evaluation."""
    from lidardesign.evaluate.report_tables import Reproduction
    from lidardesign.run.config import FILE_NAME
    from lidardesign.run.manifest import read_manifest, versions

    manifest = read_manifest(run.folder)
    commands = [("The scores and this page", _line(["lidardesign", *sys.argv[1:]]))]
    learned = manifest.get("command")
    if isinstance(learned, list) and learned:
        commands.insert(0, ("The run that was learned", _line(learned)))
    facts = [("task", run.task.name), ("seed of the scenes", str(request.seed))]
    facts += [("seed of the run", str(run.config.seed))]
    facts += [(f"design {design.name}", _made_by(design)) for design in request.designs]
    facts += [(f"version of {name}", found) for name, found in versions().items()]
    config = run.folder / FILE_NAME
    return Reproduction(commands, facts, config.read_text(encoding="utf-8") if config.is_file() else "")


def _made_by(design: Design) -> str:
    """What a design's file says of where it came from."""
    known = design.provenance
    further = {name: value for name, value in known.items() if name not in ("versions", "task", "run")}
    told = ", ".join(f"{name} {value}" for name, value in further.items())
    return told or "made by hand"


def _line(words: Sequence[Any]) -> str:
    return shlex.join(str(word) for word in words)
