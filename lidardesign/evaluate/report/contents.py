"""What the report of an evaluation holds beside the scores: pictures, where the time went, how to reproduce it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from lidardesign.config import FILE_NAME, RunConfig
from lidardesign.evaluate.figures.scene_figure import FigureData
from lidardesign.evaluate.report.report import Report
from lidardesign.evaluate.report.tables import CommandTimes, Reproduction, held_out_scenes
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.results import Evaluation
from lidardesign.run.clock import phase
from lidardesign.run.manifest import read_manifest, versions
from lidardesign.space import observed_point
from lidardesign.task import random_generator

# Drawn in the 3D view of what the density observes: enough to see its shape, few enough to see through.
DENSITY_POINTS = 3000
# Of the points' draw, beside everything else that is drawn from a run's seed.
STREAM = "report"
COMMAND = "evaluate"


@phase("report")
def evaluation_report(
    evaluation: Evaluation,
    request: EvaluationRequest,
    folder: Path,
    config: RunConfig,
    pictured: FigureData,
    command: Sequence[str],
) -> Report:
    """Everything that the report of an evaluation is made of.

    Arguments:
        evaluation: The scores.
        request: What was asked for.
        folder, config: The run whose density the designs are of.
        pictured: What is drawn beside the scores.
        command: The command line that makes the page again.
    """
    manifest = read_manifest(folder)
    density = request.density() if request.density is not None else None
    points = None
    if density is not None:
        points = observed_point(density.samples.resample(DENSITY_POINTS, random_generator(config.seed, STREAM)))
    commands = [("The scores and this page", _line(command))]
    learned = manifest.get("command")
    if isinstance(learned, list) and learned:
        commands.insert(0, ("The run that was learned", _line(learned)))
    facts = [
        ("task", config.task_name),
        ("seed of the scenes", str(request.seed)),
        ("seed of the run", str(config.seed)),
        *((f"design {design.name}", _origin(design.provenance)) for design in request.designs),
        *((f"version of {name}", version) for name, version in versions().items()),
    ]
    times = []
    for name, phases in pictured.times.items():
        entry = (manifest.get("timings") or {}).get(name)
        entry = entry if isinstance(entry, dict) and name != COMMAND else {}
        memory = entry.get("peak_memory_bytes")
        title = f"lidardesign {name}" + (", up to this report" if name == COMMAND else "")
        seconds = {phase: float(value) for phase, value in phases.items()}
        times.append(
            CommandTimes(title, str(entry.get("when", "")), seconds, memory if isinstance(memory, int) else None)
        )
    settings = folder / FILE_NAME
    return Report(
        evaluation,
        pictured.shown,
        title=f"{config.task_name}: {evaluation.metric.name} on {held_out_scenes(evaluation.scenes)}",
        density=pictured.density,
        density_m=points,
        constraints=pictured.tightness,
        times=times,
        reproduce=Reproduction(commands, facts, settings.read_text(encoding="utf-8") if settings.is_file() else ""),
    )


def _origin(provenance: Mapping[str, object]) -> str:
    """What a design's file says of where it came from."""
    further = {name: value for name, value in provenance.items() if name not in ("versions", "task", "run")}
    return ", ".join(f"{name} {value}" for name, value in further.items()) or "made by hand"


def _line(words: Sequence[object]) -> str:
    return shlex.join(str(word) for word in words)
