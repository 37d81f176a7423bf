"""One HTML page about an evaluation: the result, designs in a scene, scores, where the time went, how to reproduce it.

The page is one file that works offline and makes no network request: plotly is inside it, and its content
security policy forbids every connection. All names are escaped.
"""

from __future__ import annotations

import html
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lidardesign.config import FILE_NAME, RunConfig
from lidardesign.constraints.slack import ConstraintSlack
from lidardesign.estimates import figure_and_interval
from lidardesign.evaluation.headline import headline_texts
from lidardesign.evaluation.request import EvaluationRequest
from lidardesign.evaluation.results import Evaluation, Paired, Row, verdict
from lidardesign.evaluation.sweep import Sweep
from lidardesign.report.choice import choice_section
from lidardesign.report.density_views import DensityView, density_view
from lidardesign.report.figures import (
    DASHES,
    FONT,
    MOST_DESIGNS,
    Series,
    curve_figure,
    far_baselines,
    marginal_figure,
    plane_figure,
    series,
)
from lidardesign.report.markup import embedded, figure, folded, page, paragraphs, section, swatch, switch
from lidardesign.report.pareto import PANEL_PX, accuracy_tables, pareto_figures
from lidardesign.report.scene_figure import SceneFigure, constraint_slack_of, evaluated_scene
from lidardesign.report.tables import (
    CommandTimes,
    Reproduction,
    audit_section,
    bandwidth_table,
    constraints_table,
    counted,
    effects_section,
    held_out_scenes,
    mounting_table,
    paired_tables,
    reproduction,
    rows_table,
    sensors_table,
    table,
    times_tables,
)
from lidardesign.report.view import view_section
from lidardesign.run.clock import phase
from lidardesign.run.files import write_atomic
from lidardesign.run.manifest import read_manifest, versions
from lidardesign.sensors.design import MOST_GAP, DesignSpec
from lidardesign.space import observed_point
from lidardesign.task import random_generator

CURVE_PX, SMALL_PX, PLANE_PX = 440, 250, 400
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
        title=f"{folder.resolve().name}: {evaluation.metric.name} on {held_out_scenes(evaluation.scenes)}",
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
    metric = report.evaluation.metric
    parts = [part for part in _parts(report) if part[2]]
    body = "\n".join(section(heading, content, identifier) for identifier, heading, content in parts)
    lead = f"{metric.name} in {metric.unit}, {metric.better} is better."
    from plotly.offline import get_plotlyjs

    links = [part[:2] for part in parts]
    return page(report.title, lead, embedded(FONT, id="page-font") + body, get_plotlyjs(), links)


def _parts(report: Report) -> list[tuple[str, str, str]]:
    """Identifier, heading and content of every section; the content may be empty."""
    evaluation = report.evaluation
    designs = [one.design for one in report.shown.designs]
    # lines without marks are told apart by their dashes
    looks = {curve.name: curve for curve in series(evaluation)}
    looks = {name: replace(look, dash=DASHES[index % len(DASHES)]) for index, (name, look) in enumerate(looks.items())}
    shown = [looks[one.name] for one in designs]
    constraints = "".join(constraints_table(name, bounds) for name, bounds in report.constraints.items())
    tables = [(f"Sensors of {one.name}", sensors_table(one), len(one.sensors)) for one in designs]
    sensors = tables[0][1] if len(tables) == 1 else "".join(folded(*one) for one in tables)
    return [
        ("result", "Result", result_section(evaluation, designs)),
        ("sensors", "Sensors", sensors),
        ("scene", "Designs in a scene", view_section(report.shown, shown, report.density_m)),
        ("scores", "Scores", _scores(evaluation)),
        ("mounting", "Mounted carelessly", mounting_table(evaluation)),
        ("density", "The learned density", _density(report.density, looks) if report.density else ""),
        ("choice", "Chosen rays and how far from the best", choice_section(designs, evaluation, looks)),
        ("constraints", "Constraints and how tight each is", constraints),
        ("physics", "Physics", effects_section(evaluation) if evaluation.effects else ""),
        ("audit", "Audit of the physics", audit_section(evaluation, evaluation.audit) if evaluation.audit else ""),
        ("accuracy", "What accuracy costs", _accuracy(evaluation.accuracy.sweeps if evaluation.accuracy else ())),
        ("time", "Where the time went", times_tables(report.times)),
        ("reproduce", "How to reproduce this", reproduction(report.reproduce)),
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
    notes = [paragraphs([note], "note") for note in evaluation.notes]
    further = folded("Further notes", "".join(notes[MOST_NOTES:]), len(notes) - MOST_NOTES)
    return (
        paragraphs(said, "verdict")
        + _table(evaluation, rows, pairs)
        + paragraphs([*_about(evaluation), *_certificates(evaluation, designs)])
        + "".join(notes[:MOST_NOTES])
        + further
    )


def _table(evaluation: Evaluation, rows: dict[str, Row], pairs: dict[str, Paired]) -> str:
    metric, baseline = evaluation.metric, evaluation.strongest_baseline
    shown = [*rows.values(), *evaluation.baseline_rows]
    headings = ["design", "rays", f"{metric.name} [{metric.unit}]", "95 % interval", "gates", "Mbit/s"]
    if baseline is not None:
        headings += [f"difference to {baseline.name}", "design is"]
    lines = []
    for row in shown:
        value, value_interval = _figures(row.value, row)
        cells = [row.design, str(row.rays), value, value_interval, str(row.gates), f"{row.bandwidth_mbps:.3g}"]
        pair = pairs.get(row.design)
        if baseline is not None:
            cells += ["", ""] if pair is None else ["{} ({})".format(*_figures(pair.difference, pair, sign="+")), ""]
        lines.append((cells, "" if pair is None else verdict(evaluation, pair), row.baseline))
    caption = "Designs, what one would place by hand (uniform, bounding), and the strongest baseline."
    return table(headings, lines, text_columns=1, caption=caption)


def _about(evaluation: Evaluation) -> list[str]:
    metric, baseline = evaluation.metric, evaluation.strongest_baseline
    about = (
        f"Means over {held_out_scenes(evaluation.scenes)}; a scene in which too few "
        f"rays return counts as {metric.worst:g} {metric.unit}."
    )
    if baseline is None:
        return [about]
    best = f"the best of {len(baseline.values)}" if len(baseline.values) > 1 else "the only one"
    return [
        f"{about} The strongest baseline is {baseline.name}, {best} on {counted(baseline.scenes, 'training scene')}."
    ]


def _certificates(evaluation: Evaluation, designs: Sequence[DesignSpec]) -> list[str]:
    """The certified gaps of chosen rays, in one sentence for all designs; empty without chosen rays."""
    rows = evaluation.headline_rows
    gaps = [
        f"{100 * entry['gap']:.1f} % ({design.name})"
        for design in designs
        for entry in design.certificates
        if design.name in rows and entry["rays"] == rows[design.name].rays and entry["gap"] <= MOST_GAP
    ]
    if not gaps:
        return []
    said = (
        "Certificate: on the training scenes, no other choice of as many of the same candidates could be better by more"
    )
    return [f"{said} than {', '.join(gaps)}."]


def _figures(value: float, item: Row | Paired, sign: str = "") -> tuple[str, str]:
    """A value and its interval as text, with no-break spaces in the interval."""
    figure, low, high = figure_and_interval(value, item.ci_low, item.ci_high, sign=sign)
    return figure, low if item.ci_low is None else f"{low}\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}{high}"


def _scores(evaluation: Evaluation) -> str:
    """Both curves with one legend, whose boxes switch curves in both, and all tables of scores, folded."""
    far = far_baselines(evaluation)
    legend = "".join(
        switch(
            curve.name,
            picture=swatch(curve.colour, curve.dash, curve.marker),
            checked=curve.name not in far,
            curve=str(index),
        )
        for index, curve in enumerate(series(evaluation))
    )
    hidden = [curve.name for curve in series(evaluation) if curve.name in far]
    note = f"Hidden at first, far worse than all designs at every number of rays: {', '.join(hidden)}."
    said = paragraphs([note] if hidden else [])
    means = f"means over {held_out_scenes(evaluation.scenes)}, with 95 % intervals as bands."
    captions = {
        "rays": f"Score against rays per frame: {means}",
        "bandwidth": "The same scores against the bandwidth that it takes to read the gates out.",
    }
    figures = "".join(
        figure(curve_figure(evaluation, against, far), f"curve-{against}", CURVE_PX, caption, "curves")
        for against, caption in captions.items()
    )
    matched = len(evaluation.equal_bandwidth)
    return (
        f'<fieldset><legend>Curves shown</legend><div class="curves-shown">{legend}</div></fieldset>{said}{figures}'
        + folded("All scores", rows_table(evaluation), len(evaluation.rows))
        + paired_tables(evaluation)
        + folded("Designs against baselines at equal bandwidth", bandwidth_table(evaluation), matched)
    )


def _density(view: DensityView, looks: Mapping[str, Series]) -> str:
    """Marginals, and the field in space, side by side where there is room."""
    names = list(view.marginals[0].designs) if view.marginals else []
    drawn = [name for name in names if name in looks][:MOST_DESIGNS]
    legend = "".join(
        f'<span class="switch">{swatch(looks[name].colour, looks[name].dash)}<span>{html.escape(name)}</span></span>'
        for name in drawn
    )
    legend = f'<span class="switch">{swatch("#b8c1cb", None)}<span>learned density</span></span>{legend}'
    about = (
        f"Drawn from {view.samples:,} weighted samples, equivalent to {view.effective:,.0f} equal ones. "
        "Below, how much of the density observes each place, seen along an axis, over the outlines of targets (solid) "
        f"and occluders (dotted) of {view.scene}."
    )
    marginals = "".join(
        figure(marginal_figure(one, looks), f"marginal-{index}", SMALL_PX, f"Share of the density along {one.label}")
        for index, one in enumerate(view.marginals)
    )
    planes = "".join(
        figure(plane_figure(one), f"plane-{index}", PLANE_PX, f"What is observed, {' and '.join(one.labels)}", "plane")
        for index, one in enumerate(view.planes)
    )
    more = len(names) - len(drawn)
    further = f"<p>{more} further designs are not drawn here.</p>" if more else ""
    return (
        f'<p>{html.escape(about)}</p><div class="curves-shown">{legend}</div>{further}'
        f'<div class="tiles">{marginals}</div><div class="tiles wide">{planes}</div>'
    )


def _accuracy(sweeps: Sequence[Sweep]) -> str:
    if not sweeps:
        return ""
    read = (
        "Error against seconds on this machine, one picture per numerical choice. Orange is the cheapest setting "
        "inside the tolerance (dashed), a ring the one of this run; pale settings are beaten in both; triangles on the "
        "lower edge have no error to show, references among them."
    )
    pictures = "".join(
        figure(one, f"accuracy-{index}", PANEL_PX, "Error against seconds")
        for index, one in enumerate(pareto_figures(sweeps))
    )
    return f'<p>{read}</p><div class="tiles wide">{pictures}</div>{accuracy_tables(sweeps)}'
