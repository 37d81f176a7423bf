"""What the report of `evaluate` is made of beside the scores: pictures, where the time went, how to reproduce it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.run.clock import phase

if TYPE_CHECKING:
    import numpy as np

    from lidardesign.design.sensor import DesignSpec
    from lidardesign.evaluate.figures.figure_data import Pictured
    from lidardesign.evaluate.report.report import Report
    from lidardesign.evaluate.report.tables import CommandTimes, Reproduction
    from lidardesign.evaluate.request import EvaluationRequest
    from lidardesign.evaluate.results import Evaluation
    from lidardesign.workflow.runs import Run

# Drawn in the 3D view of what the density observes: enough to see its shape, few enough to see through.
DENSITY_POINTS = 3000
# Of the points' draw, beside everything else that is drawn from a run's seed.
STREAM = "report"
THIS = "evaluate"


def write_page(evaluation: Evaluation, request: EvaluationRequest, run: Run, pictured: Pictured, path: Path) -> None:
    """Write the report of an evaluation.

    Arguments:
        evaluation: What was found.
        request: What was asked for.
        run: The run whose density the designs are of.
        pictured: What is drawn beside the scores.
        path: The HTML file.
    """
    from lidardesign.evaluate.report.report import write_report

    write_report(report_of(evaluation, request, run, pictured), path)


@phase("report")
def report_of(evaluation: Evaluation, request: EvaluationRequest, run: Run, pictured: Pictured) -> Report:
    """Everything that a report is made of; see `write_page`."""
    from lidardesign.evaluate.report.report import Report
    from lidardesign.evaluate.verdicts import held_out

    return Report(
        evaluation,
        pictured.shown,
        title=f"{run.task.name}: {evaluation.metric.name} on {held_out(evaluation.scenes)}",
        density=pictured.density,
        density_m=_density_points(request, run),
        constraints=pictured.tightness,
        times=_times(run, pictured.times),
        reproduce=_reproduction(request, run),
    )


def _density_points(request: EvaluationRequest, run: Run) -> np.ndarray | None:
    """Points that the learned density observes; None where no run left samples."""
    from lidardesign.space import observed_point
    from lidardesign.task import random_generator

    density = request.density() if request.density is not None else None
    if density is None:
        return None
    return observed_point(density.samples.resample(DENSITY_POINTS, random_generator(run.config.seed, STREAM)))


def _times(run: Run, times: Mapping[str, Mapping[str, float]]) -> list[CommandTimes]:
    """The times of commands on a run, with what its manifest says of when they ran and what memory they took."""
    from lidardesign.evaluate.report.tables import CommandTimes
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
    from lidardesign.config import FILE_NAME
    from lidardesign.evaluate.report.tables import Reproduction
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


def _made_by(design: DesignSpec) -> str:
    """What a design's file says of where it came from."""
    known = design.provenance
    further = {name: value for name, value in known.items() if name not in ("versions", "task", "run")}
    told = ", ".join(f"{name} {value}" for name, value in further.items())
    return told or "made by hand"


def _line(words: Sequence[Any]) -> str:
    return shlex.join(str(word) for word in words)
