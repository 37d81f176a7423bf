"""One HTML page about an evaluation: the result, designs in a scene, scores, where the time went, how to reproduce it.

The page is one file that works offline and makes no network request: plotly is inside it, and its content
security policy forbids every connection. All names are escaped.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path

import numpy as np

from lidardesign.config import FILE_NAME, RunConfig
from lidardesign.constraints.slack import ConstraintSlack
from lidardesign.estimates import figure_and_interval
from lidardesign.evaluation.headline import headline_texts
from lidardesign.evaluation.request import EvaluationRequest
from lidardesign.evaluation.results import Evaluation, Paired, Row, verdict
from lidardesign.report.choice import choice_section
from lidardesign.report.density_views import DensityView, density_view
from lidardesign.report.figures import DASHES, FONT, MOST_DESIGNS, Series, marginal_figure, plane_figure, series
from lidardesign.report.pareto import accuracy_section
from lidardesign.report.scene_figure import SceneFigure, constraint_slack_of, evaluated_scene
from lidardesign.report.sections import (
    CommandTimes,
    Reproduction,
    audit_section,
    constraints_section,
    effects_section,
    mounting_section,
    scores_section,
    sensors_section,
    times_section,
)
from lidardesign.report.view import view_section
from lidardesign.run.clock import phase
from lidardesign.run.files import write_atomic
from lidardesign.run.manifest import read_manifest, versions
from lidardesign.run.markup import counted, rendered
from lidardesign.sensors.design import MOST_GAP, DesignSpec
from lidardesign.space import observed_point
from lidardesign.task import random_generator

# Drawn in the 3D view of what the density observes: enough to see its shape, few enough to see through.
DENSITY_POINTS = 3000
COMMAND = "evaluate"  # whose report it is, and which is not over yet
# In the first section: sentences about designs (a table has all), and notes that are not folded.
MOST_SENTENCES, MOST_NOTES = 3, 2


@dataclass(frozen=True, eq=False)
class Report:
    """The content of a report.

    Arguments:
        evaluation: The evaluation.
        shown: The designs in a held-out scene.
        title: The page's title.
        density: Views of the learned density; None where a run has no samples.
        density_m: Points that it observes, drawn by their weights, shape (K, 3) [m].
        constraints: The slack of each constraint, by the name of the design.
        times: Times of each command by phase.
        reproduce: Commands and facts to reproduce the results.
    """

    evaluation: Evaluation
    shown: SceneFigure
    title: str
    density: DensityView | None = None
    density_m: np.ndarray | None = None
    constraints: Mapping[str, Sequence[ConstraintSlack]] = field(default_factory=dict)
    times: Sequence[CommandTimes] = ()
    reproduce: Reproduction = field(default_factory=Reproduction)


@phase("report")
def evaluation_report(
    evaluation: Evaluation,
    request: EvaluationRequest,
    folder: Path,
    config: RunConfig,
    times: Mapping[str, Mapping[str, float]],
    command: Sequence[str],
) -> Report:
    """The content of the report of an evaluation.

    Arguments:
        evaluation: The scores.
        request: The request of the evaluation.
        folder, config: The run whose density the designs were fitted to.
        times: Seconds of each command by phase, as of `Clock.timings`.
        command: The command line that makes the page again.
    """
    manifest = read_manifest(folder)
    samples, shown, view, points = request.density(), evaluated_scene(evaluation, request), None, None
    if samples is not None:
        view = density_view(samples, shown.scene, request.designs)
        points = observed_point(samples.resample(DENSITY_POINTS, random_generator(config.seed, "report")))
    made_by = {"The run that was learned": manifest.get("command"), "The scores and this page": list(command)}
    commands = [
        (what, shlex.join(map(str, words))) for what, words in made_by.items() if isinstance(words, list) and words
    ]
    facts = [
        ("task", config.task_name),
        ("seed of the scenes", str(request.seed if request.scenes_seed is None else request.scenes_seed)),
        ("seed of the run", str(config.seed)),
        *((f"design {design.name}", _origin(design.provenance)) for design in request.designs),
        *((f"version of {name}", version) for name, version in versions().items()),
    ]
    taken = []
    for name, phases in times.items():
        entry = (manifest.get("timings") or {}).get(name)
        entry = entry if isinstance(entry, dict) and name != COMMAND else {}
        memory = entry.get("peak_memory_bytes")
        title = f"lidardesign {name}" + (", up to this report" if name == COMMAND else "")
        seconds = {phase: float(value) for phase, value in phases.items()}
        memory = memory if isinstance(memory, int) else None
        taken.append(CommandTimes(title, str(entry.get("when", "")), seconds, memory))
    settings = folder / FILE_NAME
    return Report(
        evaluation,
        shown,
        title=f"{folder.resolve().name}: {evaluation.metric.name} on {counted(evaluation.scenes, 'held-out scene')}",
        density=view,
        density_m=points,
        constraints={design.name: constraint_slack_of(design, request.space) for design in request.designs},
        times=taken,
        reproduce=Reproduction(commands, facts, settings.read_text(encoding="utf-8") if settings.is_file() else ""),
    )


def _origin(provenance: Mapping[str, object]) -> str:
    elsewhere = ("versions", "task", "run")
    told = [f"{name} {value}" for name, value in provenance.items() if name not in elsewhere]
    return ", ".join(told) or "made by hand"


def write_report(report: Report, path: Path) -> None:
    """Write the page, whole or not at all."""
    write_atomic(Path(path), report_html(report))


def report_html(report: Report) -> str:
    """The page as text."""
    from plotly.offline import get_plotlyjs

    return rendered(
        "report/templates/page.html",
        title=report.title,
        metric=report.evaluation.metric,
        style=asset("report.css"),
        font=FONT,
        sections=[one for one in _sections(report) if one[2].strip()],
        plotly=get_plotlyjs(),
        scripts=[asset(name) for name in ("scene.js", "paint.js", "view.js", "page.js")],
    )


def asset(name: str) -> str:
    """The text of a file of the page."""
    return files("lidardesign.report").joinpath("assets", name).read_text(encoding="utf-8")


def _sections(report: Report) -> list[tuple[str, str, str]]:
    """Identifier, heading and content of every section; the content may be empty."""
    evaluation = report.evaluation
    designs = [one.design for one in report.shown.designs]
    # lines without marks are told apart by their dashes
    looks = {curve.name: curve for curve in series(evaluation)}
    looks = {name: replace(look, dash=DASHES[index % len(DASHES)]) for index, (name, look) in enumerate(looks.items())}
    shown = [looks[one.name] for one in designs]
    return [
        ("result", "Result", result_section(evaluation, designs)),
        ("sensors", "Sensors", sensors_section(designs)),
        ("scene", "Designs in a scene", view_section(report.shown, shown, report.density_m)),
        ("scores", "Scores", scores_section(evaluation)),
        ("mounting", "Mounting errors", mounting_section(evaluation)),
        ("density", "The learned density", density_section(report.density, looks) if report.density else ""),
        ("choice", "Chosen rays and how far from the best", choice_section(designs, evaluation, looks)),
        ("constraints", "Constraints and how tight each is", constraints_section(report.constraints)),
        ("physics", "Physics", effects_section(evaluation) if evaluation.effects else ""),
        ("audit", "Audit of the physics", audit_section(evaluation)),
        (
            "accuracy",
            "What accuracy costs",
            accuracy_section(evaluation.accuracy.sweeps if evaluation.accuracy else ()),
        ),
        ("time", "Where the time went", times_section(report.times)),
        ("reproduce", "How to reproduce this", rendered("report/templates/reproduce.html", how=report.reproduce)),
    ]


def result_section(evaluation: Evaluation, designs: Sequence[DesignSpec]) -> str:
    """The section of the result: differences to the strongest baseline, certificates of chosen rays, and notes.

    Arguments:
        evaluation: The scores.
        designs: The designs, whose chosen rays may have certificates.
    """
    rows, pairs = evaluation.headline_rows, evaluation.headline_pairs
    said = [f"{text}." for text in headline_texts(evaluation)]
    if not said:
        unit = evaluation.metric.unit
        said = [f"{row.design}: {_figures(row.value, row)[0]} {unit} at {row.rays} rays." for row in rows.values()]
        # a long list says less than the table below it
        said = said if len(said) <= MOST_SENTENCES else []
    return rendered(
        "report/templates/result.html",
        evaluation=evaluation,
        sentences=said,
        rows=[
            (row, *_figures(row.value, row), *_difference(evaluation, pairs.get(row.design)))
            for row in (*rows.values(), *evaluation.baseline_rows)
        ],
        gaps=[
            f"{100 * entry['gap']:.1f} % ({design.name})"
            for design in designs
            for entry in design.certificates
            if design.name in rows and entry["rays"] == rows[design.name].rays and entry["gap"] <= MOST_GAP
        ],
        most_notes=MOST_NOTES,
    )


def _difference(evaluation: Evaluation, pair: Paired | None) -> tuple[str, str]:
    """A difference with its interval as text, and its verdict; both empty without one."""
    if pair is None:
        return "", ""
    return "{} ({})".format(*_figures(pair.difference, pair, sign="+")), verdict(evaluation, pair)


def _figures(value: float, item: Row | Paired, sign: str = "") -> tuple[str, str]:
    """A value and its interval as text, with no-break spaces in the interval."""
    figure, low, high = figure_and_interval(value, item.ci_low, item.ci_high, sign=sign)
    return figure, low if item.ci_low is None else f"{low}\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}{high}"


def density_section(view: DensityView, looks: Mapping[str, Series]) -> str:
    """Marginals, and the field in space, side by side where there is room."""
    names = list(view.marginals[0].designs) if view.marginals else []
    drawn = [looks[name] for name in names if name in looks][:MOST_DESIGNS]
    return rendered(
        "report/templates/density.html",
        view=view,
        drawn=drawn,
        further=len(names) - len(drawn),
        marginals=[(marginal_figure(one, looks), one) for one in view.marginals],
        planes=[(plane_figure(one), one) for one in view.planes],
    )
