"""The report's tables and sentences: who is better, by how much, and whether the scenes can tell."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

from lidardesign.design.sensor import DesignSpec
from lidardesign.evaluate.results import Evaluation, Paired, Row, leading_detail

MOST_SENSORS = 60  # listed in a table
TINY = 1e-4  # from here on the limit is shown
VERDICTS = {"better": "better", "worse": "worse", "open": "not clear"}


def figure(value: float) -> str:
    """A number with four digits for people."""
    return f"{value:#.4g}".removesuffix(".")


def plain(value: float, digits: int, tiny: float = TINY) -> str:
    """A number of at least 0 without an exponent; what is tiny as its upper limit."""
    if 0 < value < tiny:
        return f"<{tiny:g}"
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if rounded >= 10 ** (digits - 1) else f"{rounded:g}"


def held_out(scenes: int) -> str:
    """How many held-out scenes, in words."""
    return "1 held-out scene" if scenes == 1 else f"{scenes} held-out scenes"


def verdict(evaluation: Evaluation, pair: Paired) -> str:
    """`better` or `worse` where the paired interval of a excludes zero, `open` where it does not."""
    sign = 1.0 if evaluation.metric.better == "lower" else -1.0
    low, high = sorted((sign * pair.ci_low, sign * pair.ci_high))
    return "better" if high < 0 else "worse" if low > 0 else "open"


def summary_sentences(evaluation: Evaluation) -> list[str]:
    """One sentence per design at the largest number of rays, against each baseline."""
    metric = evaluation.metric
    sentences = [
        f"{metric.name} in {metric.unit}, {metric.better} is better, mean over {held_out(evaluation.scenes)}. A scene "
        f"in which too few rays return counts as {metric.worst:g} {metric.unit}."
    ]
    values = {(row.design, row.rays): row.value for row in evaluation.rows}
    baselines = {row.design for row in evaluation.rows if row.baseline}
    for name in dict.fromkeys(row.design for row in evaluation.rows if not row.baseline):
        most = max(row.rays for row in evaluation.rows if row.design == name)
        pairs = [p for p in evaluation.paired if p.a == name and p.rays == most and p.b in baselines]
        told = ", ".join(_told(evaluation, pair, values[pair.b, most]) for pair in pairs)
        sentences.append(
            f"{name} with {most} rays: {figure(values[name, most])} {metric.unit}"
            + (f"; {told}." if told else ".")
        )
    return sentences


def rows_table(evaluation: Evaluation) -> str:
    """All rows at equal rays."""
    unit = evaluation.metric.unit
    headings = ["design", "rays", f"{evaluation.metric.name} [{unit}]", "95 % interval", "failures"]
    detail = leading_detail(evaluation.rows)
    headings += [] if detail is None else [_words(detail)]
    caption = f"Means over {held_out(evaluation.scenes)}; seconds are those of simulating and scoring all."
    headings += ["Mbit/s", "seconds"]
    return table(headings, _grouped(evaluation.rows, detail), text_columns=1, caption=caption)


def paired_table(evaluation: Evaluation) -> str:
    """All paired differences, with a verdict in words."""
    if not evaluation.paired:
        return "<p>There is nothing to compare with.</p>"
    headings = ["a", "b", "rays", f"a - b [{evaluation.metric.unit}]", "95 % interval", "a is"]
    lines = [
        (
            [pair.a, pair.b, str(pair.rays), figure(pair.difference), _interval(pair), ""],
            verdict(evaluation, pair),
            bool(index and pair.a != evaluation.paired[index - 1].a),
        )
        for index, pair in enumerate(evaluation.paired)
    ]
    caption = "Differences scene by scene at equal numbers of rays, with their 95 % bootstrap intervals over scenes."
    return table(headings, lines, text_columns=2, caption=caption)


def bandwidth_table(evaluation: Evaluation) -> str:
    """Each design against baselines that were given as many rays as fit in its bandwidth."""
    unit = evaluation.metric.unit
    headings = ["design", "baseline", "rays", "its rays", "Mbit/s", f"design [{unit}]", f"baseline [{unit}]"]
    own = {(row.design, row.rays): row for row in evaluation.rows if not row.baseline}
    lines = []
    for index, (row, pair) in enumerate(
        zip(evaluation.equal_bandwidth, evaluation.paired_bandwidth, strict=True)
    ):
        mine = own[pair.a, pair.rays]
        cells = [pair.a, pair.b, str(pair.rays), str(row.rays), figure(mine.bandwidth_mbps)]
        cells += [figure(mine.value), figure(row.value), f"{figure(pair.difference)} ({_interval(pair)})", ""]
        lines.append(
            (
                cells,
                verdict(evaluation, pair),
                bool(index and row.design == evaluation.equal_bandwidth[0].design),
            )
        )
    caption = "Each design against baselines with as many rays (their rays) as fit in its bandwidth."
    headings += ["difference (95 % interval)", "design is"]
    return table(headings, lines, text_columns=2, caption=caption)


def sensors_table(design: DesignSpec) -> str:
    """A design's sensors in degrees and metres."""
    headings = [
        "sensor",
        "share",
        "origin [m]",
        "azimuth, elevation [deg]",
        "field of view [deg]",
        "gate [m]",
    ]
    lines = []
    for sensor, weight in zip(design.sensors[:MOST_SENSORS], design.weights, strict=False):
        horizontal, vertical = (math.degrees(angle) for angle in sensor.field_of_view_rad)
        start, end = sensor.gate_m
        # adding zero takes the sign from a rounded -0
        looks = [round(math.degrees(angle), 1) + 0.0 for angle in (sensor.azimuth_rad, sensor.elevation_rad)]
        cells = [
            sensor.name,
            f"{weight:.3f}",
            " ".join(f"{round(value, 3) + 0.0:.3f}" for value in sensor.origin_m),
            ", ".join(f"{angle:.1f}" for angle in looks),
            f"{horizontal:.1f} x {vertical:.1f}",
            f"{start:.3f} to {end:.3f}",
        ]
        lines.append((cells, "", False))
    rest = len(design.sensors) - MOST_SENSORS
    caption = f"Sensors of {design.name}: shares of the rays, and intervals that hold {100 * design.level:g} % of each."
    listed = table(headings, lines, text_columns=1, caption=caption)
    return listed + (f"<p>and {rest} more.</p>" if rest > 0 else "")


def _told(evaluation: Evaluation, pair: Paired, other: float) -> str:
    word = verdict(evaluation, pair)
    if word == "open":
        return f"no clear difference from {pair.b} ({figure(other)})"
    share = f"{abs(pair.difference) / abs(other):.0%} " if other else ""
    return f"{share}{word} than {pair.b} ({figure(other)})"


def _interval(item: Row | Paired) -> str:
    return f"{figure(item.ci_low)} to {figure(item.ci_high)}"


def _words(name: str) -> str:
    return name.replace("_", " ")


def _grouped(rows: Sequence[Row], detail: str | None) -> list[tuple[list[str], str, bool]]:
    lines = []
    for index, row in enumerate(rows):
        cells = [row.design, str(row.rays), figure(row.value), _interval(row), str(row.failures)]
        if detail is not None:
            cells.append(figure(row.details[detail]) if detail in row.details else "-")
        cells += [figure(row.bandwidth_mbps), f"{row.seconds:.2f}"]
        lines.append((cells, "", bool(index and row.design != rows[index - 1].design)))
    return lines


def table(
    headings: Sequence[str],
    lines: Sequence[tuple[list[str], str, bool]],
    *,
    text_columns: int,
    words: Mapping[str, str] = VERDICTS,
    caption: str = "",
) -> str:
    """An HTML table; a line is its cells, a verdict for the last cell (in `words`), and whether a group begins."""
    head = "".join(
        f'<th{" class=text" if column < text_columns else ""} scope="col">{html.escape(heading)}</th>'
        for column, heading in enumerate(headings)
    )
    body = "".join(_line(cells, word, words, first, text_columns) for cells, word, first in lines)
    title = html.escape(caption)
    named = f' role="region" aria-label="{title}"' if title else ""
    told = f"<caption><span>{title}</span></caption>" if title else ""
    return (
        f'<div class="scroll" tabindex="0"{named}><table>{told}<thead><tr>{head}</tr></thead><tbody>{body}</tbody>'
        "</table></div>"
    )


def _line(cells: list[str], word: str, words: Mapping[str, str], first: bool, text_columns: int) -> str:
    shown = [
        f"<td{' class=name' if column < text_columns else ''}>{html.escape(cell)}</td>"
        for column, cell in enumerate(cells)
    ]
    shown[0] = f'<th scope="row" class="name">{html.escape(cells[0])}</th>'
    if word:
        shown[-1] = f'<td class="{word}">{words[word]}</td>'
    return f"<tr{' class=first' if first else ''}>{''.join(shown)}</tr>"
