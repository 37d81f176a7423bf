"""The report's first section: a row of every design, against the strongest rival on training scenes."""

from __future__ import annotations

from collections.abc import Sequence

from lidardesign.estimates import figure_and_interval
from lidardesign.rays.certificate import certificates_of
from lidardesign.report.markup import folded, paragraphs
from lidardesign.report.tables import counted, held_out_scenes, table
from lidardesign.scoring.evaluation.results import Evaluation, Paired, Row, verdict
from lidardesign.scoring.evaluation.thresholds import difference_text
from lidardesign.sensors.design import DesignSpec

MOST_SENTENCES = 3  # of designs that have one each; a table says the same of all
MOST_NOTES = 2  # that are not folded


def result_section(evaluation: Evaluation, designs: Sequence[DesignSpec]) -> str:
    """Who is better and by how much, how far chosen rays are from the best, and what a reader should know.

    Arguments:
        evaluation: The scores.
        designs: The designs, whose chosen rays may have certificates.
    """
    rows, pairs = evaluation.headline_rows, evaluation.headline_pairs
    said = [headline(evaluation, pairs[name]) for name in rows if name in pairs]
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


def headline(evaluation: Evaluation, pair: Paired) -> str:
    """A pair in a sentence: who is better and by how much, or that no difference was found."""
    text = difference_text(pair, evaluation.metric.better, evaluation.metric.unit)
    return f"{text.replace('no difference', 'No difference', 1) if text.startswith('no difference') else text}."


def _table(evaluation: Evaluation, rows: dict[str, Row], pairs: dict[str, Paired]) -> str:
    metric, rival = evaluation.metric, evaluation.strongest_rival
    shown = [*rows.values(), *evaluation.rival_rows]
    headings = ["design", "rays", f"{metric.name} [{metric.unit}]", "95 % interval", "Mbit/s"]
    if rival is not None:
        headings += [f"difference to {rival.name}", "design is"]
    lines = []
    for row in shown:
        value, value_interval = _figures(row.value, row)
        cells = [row.design, str(row.rays), value, value_interval, f"{row.bandwidth_mbps:.3g}"]
        pair = pairs.get(row.design)
        if rival is not None:
            cells += ["", ""] if pair is None else ["{} ({})".format(*_figures(pair.difference, pair, sign="+")), ""]
        lines.append((cells, "" if pair is None else verdict(evaluation, pair), row.baseline))
    return table(headings, lines, text_columns=1, caption="Designs, and the strongest rival on training scenes.")


def _about(evaluation: Evaluation) -> list[str]:
    metric, rival = evaluation.metric, evaluation.strongest_rival
    about = (
        f"Means over {held_out_scenes(evaluation.scenes)}; a scene in which too few "
        f"rays return counts as {metric.worst:g} {metric.unit}."
    )
    if rival is None:
        return [about]
    best = f"the best of {len(rival.values)}" if len(rival.values) > 1 else "the only one"
    return [f"{about} The strongest rival is {rival.name}, {best} on {counted(rival.scenes, 'training scene')}."]


def _certificates(evaluation: Evaluation, designs: Sequence[DesignSpec]) -> list[str]:
    """How far chosen rays are from the best, in one sentence for all designs; none where no rays were chosen."""
    rows = evaluation.headline_rows
    gaps = [
        f"{100 * entry['gap']:.1f} % ({design.name})"
        for design in designs
        for entry in certificates_of(design)
        if design.name in rows and entry["rays"] == rows[design.name].rays
    ]
    if not gaps:
        return []
    said = "Certificate: no other choice of as many of the same candidates lowers the loss on training scenes by more"
    return [f"{said} than {', '.join(gaps)}."]


def _figures(value: float, item: Row | Paired, sign: str = "") -> tuple[str, str]:
    """A figure and its interval, which stays in one line, also where cells wrap."""
    figure, low, high = figure_and_interval(value, item.ci_low, item.ci_high, sign=sign)
    return figure, low if item.ci_low is None else f"{low}\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}{high}"
