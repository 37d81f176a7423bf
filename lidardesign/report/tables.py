"""The report's tables: scores, differences, constraints, effects, times, how to reproduce."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from lidardesign.constraints.slack import ConstraintSlack
from lidardesign.evaluation.entries import MILLIMETRES, EffectSummary
from lidardesign.evaluation.results import (
    Audit,
    AuditRow,
    Evaluation,
    Paired,
    Row,
    leading_detail,
    verdict,
)
from lidardesign.report.markup import definitions, folded
from lidardesign.run.clock import INSIDE, OTHER
from lidardesign.sensors.design import DesignSpec

# The words of the report.
VERDICT_WORDS = {"better": "better", "worse": "worse", "open": "no significant difference"}
MOST_SENSORS = 60  # listed in a table
TINY = 1e-4  # from here on the limit is shown
# Phases of a smaller share of their command, or deeper, are left out; `other` has what they took.
LEAST_SHARE, DEEPEST = 0.005, 2
MEBIBYTE = 1024**2
PERCENT = 100.0
SHORT_S = 0.01  # costs from here on are shown as their limit


def four_digits(value: float) -> str:
    """A number with four digits for people."""
    return f"{value:#.4g}".removesuffix(".")


def plain_number(value: float, digits: int, tiny: float = TINY) -> str:
    """A number of at least 0 without an exponent; below `tiny` as `<tiny`."""
    if 0 < value < tiny:
        return f"<{tiny:g}"
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if rounded >= 10 ** (digits - 1) else f"{rounded:g}"


def counted(number: int, noun: str) -> str:
    """A number with its noun, as "1 ray" or "2 rays"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def held_out_scenes(scenes: int) -> str:
    """A number of held-out scenes in words."""
    return counted(scenes, "held-out scene")


def rows_table(evaluation: Evaluation) -> str:
    """All rows at equal rays."""
    metric, detail = evaluation.metric, leading_detail(evaluation.rows)
    details = [] if detail is None else [detail]
    worst = ["worst_decile", *(["worst_lost"] if any(row.lost for row in evaluation.rows) else [])]
    headings = ["design", "rays", f"{metric.name} [{metric.unit}]", "95 % interval", *map(_words, worst), "failures"]
    headings += [*map(_words, details), "Mbit/s", "seconds"]
    lines = []
    for index, row in enumerate(evaluation.rows):
        cells = [row.design, str(row.rays), four_digits(row.value), interval(row)]
        values = [getattr(row, name) for name in worst]
        cells += ["-" if value is None else four_digits(value) for value in values] + [str(row.failures)]
        cells += [four_digits(row.details[name]) if name in row.details else "-" for name in details]
        cells += [four_digits(row.bandwidth_mbps), f"{row.seconds:.2f}"]
        lines.append((cells, "", bool(index and row.design != evaluation.rows[index - 1].design)))
    caption = f"Means over {held_out_scenes(evaluation.scenes)}; seconds are those of simulating and scoring all."
    return table(headings, lines, text_columns=1, caption=caption)


def mounting_table(evaluation: Evaluation) -> str:
    """All rows at equal rays beside themselves with misplaced sensors; empty where that was not asked for."""
    mounting, unit = evaluation.mounting, evaluation.metric.unit
    if mounting is None:
        return ""
    headings = [
        "design",
        "rays",
        f"exact [{unit}]",
        f"careless [{unit}]",
        "failures",
        f"difference [{unit}]",
        "95 % interval",
        "careless is",
    ]
    lines = []
    for index, (row, own, cost) in enumerate(zip(mounting.rows, evaluation.rows, mounting.costs, strict=True)):
        values = map(four_digits, (own.value, row.value))
        cells = [row.design, str(row.rays), *values, str(row.failures), four_digits(cost.difference), interval(cost)]
        begins = bool(index and row.design != mounting.rows[index - 1].design)
        lines.append(([*cells, ""], verdict(evaluation, cost), begins))
    caption = f"Every sensor off by {mounting.error} per axis in every scene, against the design mounted exactly."
    return table(headings, lines, text_columns=1, caption=caption)


def paired_tables(evaluation: Evaluation) -> str:
    """All paired differences with a verdict in words, folded: designs against baselines, then against each other."""
    if not evaluation.paired:
        return "<p>There is nothing to compare with.</p>"
    baselines = {row.design for row in evaluation.rows if row.baseline}
    kinds = {
        "Designs against baselines": [pair for pair in evaluation.paired if pair.b in baselines],
        "Designs against designs": [pair for pair in evaluation.paired if pair.b not in baselines],
    }
    return "".join(folded(name, _paired_table(evaluation, pairs), len(pairs)) for name, pairs in kinds.items() if pairs)


def _paired_table(evaluation: Evaluation, pairs: Sequence[Paired]) -> str:
    headings = ["a", "b", "rays", f"a - b [{evaluation.metric.unit}]", "95 % interval", "a is"]
    lines = [
        (
            [pair.a, pair.b, str(pair.rays), four_digits(pair.difference), interval(pair), ""],
            verdict(evaluation, pair),
            bool(index and pair.a != pairs[index - 1].a),
        )
        for index, pair in enumerate(pairs)
    ]
    caption = "Differences scene by scene at equal numbers of rays, with their 95 % intervals over scenes."
    return table(headings, lines, text_columns=2, caption=caption)


def bandwidth_table(evaluation: Evaluation) -> str:
    """Each design against baselines of as many rays as fit in its bandwidth; empty where there are none."""
    if not evaluation.equal_bandwidth:
        return ""
    unit = evaluation.metric.unit
    headings = [
        "design",
        "baseline",
        "rays",
        "its rays",
        "Mbit/s",
        f"design [{unit}]",
        f"its [{unit}]",
        "difference (95 % interval)",
        "design is",
    ]
    own = {(row.design, row.rays): row for row in evaluation.rows if not row.baseline}
    pairs = zip(evaluation.equal_bandwidth, evaluation.paired_bandwidth, strict=True)
    lines = []
    for index, (row, pair) in enumerate(pairs):
        mine = own[pair.a, pair.rays]
        cells = [
            pair.a,
            pair.b,
            str(pair.rays),
            str(row.rays),
            *map(four_digits, (mine.bandwidth_mbps, mine.value, row.value)),
            f"{four_digits(pair.difference)} ({interval(pair)})",
            "",
        ]
        begins = bool(index and row.design == evaluation.equal_bandwidth[0].design)
        lines.append((cells, verdict(evaluation, pair), begins))
    caption = "Each design against baselines with as many rays (their rays) as fit in its bandwidth."
    return table(headings, lines, text_columns=2, caption=caption)


def sensors_table(design: DesignSpec) -> str:
    """A design's sensors in degrees and metres."""
    shown = zip(design.sensors[:MOST_SENSORS], design.weights, strict=False)
    rows = [{**sensor.as_text(), "share": f"{weight:.3f}"} for sensor, weight in shown]
    lines = [(list(row.values()), "", False) for row in rows]
    rest = len(design.sensors) - MOST_SENSORS
    held = f"shares of the rays, and intervals that hold {100 * design.level:g} % of each"
    caption = f"Sensors of {design.name} in {design.frame}: {held}."
    more = f"<p>and {rest} more.</p>" if rest > 0 else ""
    return table(list(rows[0]), lines, text_columns=1, caption=caption) + more


def interval(item: Row | Paired) -> str:
    """The interval of a row or pair, with four digits or fewer; a dash where it has none."""
    if item.ci_low is None or item.ci_high is None:
        return "-"
    # in one line, also where cells wrap
    return "\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}".join(map(four_digits, (item.ci_low, item.ci_high)))


def _words(name: str) -> str:
    return name.replace("_", " ")


def table(
    headings: Sequence[str],
    lines: Sequence[tuple[list[str], str, bool]],
    *,
    text_columns: int,
    caption: str,
    words: Mapping[str, str] = VERDICT_WORDS,
) -> str:
    """An HTML table; a line is its cells, a verdict for the last cell (in `words`), and whether a group begins."""
    head = "".join(
        f'<th{" class=text" if column < text_columns else ""} scope="col">{html.escape(heading)}</th>'
        for column, heading in enumerate(headings)
    )
    body = ""
    for (name, *cells), word, first in lines:
        shown = [
            f'<th scope="row" class="name">{html.escape(name)}</th>',
            *(
                f"<td{' class=name' if column < text_columns else ''}>{html.escape(cell)}</td>"
                for column, cell in enumerate(cells, start=1)
            ),
        ]
        if word:
            shown[-1] = f'<td class="{word}">{words[word]}</td>'
        body += f"<tr{' class=first' if first else ''}>{''.join(shown)}</tr>"
    title = html.escape(caption)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{title}"><table><caption><span>{title}</span>'
        f"</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


@dataclass(frozen=True)
class CommandTimes:
    """The time of one command by phase.

    Arguments:
        command: Its name, as `learn`.
        when: Time of its end, as written in the run.
        phases: Seconds by phase, phases inside of phases as "learning/target".
        memory_bytes: Peak memory; None where that is not known.
    """

    command: str
    when: str
    phases: Mapping[str, float]
    memory_bytes: int | None = None

    @property
    def seconds(self) -> float:
        """All of its time [s]."""
        return math.fsum(seconds for name, seconds in self.phases.items() if INSIDE not in name)


@dataclass(frozen=True)
class Reproduction:
    """Commands and facts to reproduce the results.

    Arguments:
        commands: Purposes and command lines, in order.
        facts: Seed, versions and the like, by name.
        config: The run's configuration as YAML; empty where there is none.
    """

    commands: Sequence[tuple[str, str]] = ()
    facts: Sequence[tuple[str, str]] = field(default_factory=tuple)
    config: str = ""


def constraints_table(name: str, found: Sequence[ConstraintSlack]) -> str:
    """A row per bound of a design: the tightest sensor, its slack and the used share of the bound."""
    if not found:
        return f"<p>{html.escape(name)} has no constraints.</p>"
    headings = ("constraint", "bound", "closest", "room", "used", "verdict")
    caption = f"Constraints of {name}. Closest: the sensor with the least room. Used: the share of the bound."
    tight = ", ".join(one.name for one in found if one.broken or one.tight) or "none"
    content = _scrolled(headings, (0, 4), map(_constraint_row, found), caption)
    return folded(f"{name}: {counted(len(found), 'bound')}; tight: {tight}", content)


def _constraint_row(one: ConstraintSlack) -> str:
    owner = f"{html.escape(one.sensor)}: " if one.sensor else ""
    how = {"broken": "worse", "at the bound": "open", "kept": "better"}[one.word]
    several = one.sensors > 1 and (one.broken or one.tight)
    count = f" ({one.broken or one.tight} of {one.sensors})" if several else ""
    room = "-" if one.room is None else _room(one.room, one.bound)
    return (
        f'<tr><th scope="row" class="name">{html.escape(one.name)}</th>'
        f'<td class="wraps">{html.escape(number(one.bound))}</td>'
        f'<td class="wraps">{owner}{html.escape(number(one.value))}</td><td>{room}</td>'
        f'<td class="bars">{_used(one)}</td><td class="{how}">{one.word}{count}</td></tr>'
    )


def _room(room: float, bound: Any) -> str:
    size = max(abs(float(value)) for value in (bound if isinstance(bound, list | tuple) else [bound]))
    # next to none is none
    return "0" if abs(room) < TINY * size else number(room)


def _used(one: ConstraintSlack) -> str:
    """A bar of the used share of a bound, with the share as text for screen readers."""
    if one.share is None:
        return "-"
    used = PERCENT * min(max(1.0 - one.share, 0.0), 1.0)
    kind = " broken" if one.broken else " full" if one.tight else ""
    bar = f'<i style="width:{used:.1f}%"></i>'
    return f'<span class="room{kind}" role="img" aria-label="{used:.0f} % used">{bar}</span>'


def number(value: Any) -> str:
    """A value, or a list or mapping of values, as text; a list of places as their number."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {number(item)}" for name, item in value.items())
    if isinstance(value, list | tuple):
        places = bool(value) and isinstance(value[0], list | tuple)
        return f"{len(value)} places" if places else ", ".join(number(item) for item in value)
    if value is None:
        return "-"
    # adding zero takes the sign from a -0
    return f"{value + 0.0:.4g}" if isinstance(value, float) else str(value)


def times_tables(commands: Sequence[CommandTimes]) -> str:
    """Every command with its phases, their seconds and shares as bars."""
    return "".join(_times_table(one) for one in commands if one.seconds > 0)


def _times_table(one: CommandTimes) -> str:
    memory = "" if one.memory_bytes is None else f", at most {one.memory_bytes / MEBIBYTE:,.0f} MiB of memory"
    when = f" ({one.when})" if one.when else ""
    caption = f"{one.command}: {one.seconds:.2f} s{memory}{when}. Hatched phases are parts of the one above."
    # two levels of phases that matter, and what all others took
    shown = {
        name: seconds
        for name, seconds in one.phases.items()
        if name != OTHER and name.count(INSIDE) < DEEPEST and seconds >= LEAST_SHARE * one.seconds
    }
    rest = one.seconds - math.fsum(seconds for name, seconds in shown.items() if INSIDE not in name)
    shown[OTHER] = max(rest, 0.0)
    rows = (_time_row(name, seconds, one.seconds) for name, seconds in shown.items())
    content = _scrolled(("phase", "seconds", "share", "bar"), (0, 3), rows, caption)
    return folded(f"{one.command}: {one.seconds:.3g} s", content)


def _time_row(name: str, seconds: float, total: float) -> str:
    *outside, own = name.split(INSIDE)
    share = PERCENT * seconds / total
    indent = f' style="padding-left:{12 + 20 * len(outside)}px"'
    inside = " inside" if outside else ""
    return (
        f'<tr><th scope="row" class="name"{indent}>{html.escape(own)}</th><td>{seconds:.2f}</td><td>{share:.0f} %</td>'
        f'<td class="bars"><span class="bar{inside}" aria-hidden="true" style="width:{share:.1f}%"></span></td></tr>'
    )


def reproduction(how: Reproduction) -> str:
    """Commands, seeds, versions, and the configuration that the run was learned with."""
    parts = [f"<p>{html.escape(what)}</p><pre>{html.escape(command)}</pre>" for what, command in how.commands]
    parts.append(definitions(how.facts))
    if how.config:
        parts.append(folded("The run's configuration", f"<pre>{html.escape(how.config)}</pre>"))
    return "".join(parts)


def _scrolled(headings: Sequence[str], text: Sequence[int], rows: Iterable[str], caption: str) -> str:
    """A scrolling HTML table of rows in markup; `text` columns are aligned left."""
    label = html.escape(caption)
    head = "".join(
        f'<th scope="col"{" class=text" if index in text else ""}>{html.escape(heading)}</th>'
        for index, heading in enumerate(headings)
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{label}"><table><caption><span>{label}</span>'
        f"</caption><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def effects_section(evaluation: Evaluation) -> str:
    """The section of effects that could change the scores, simulated or not; one sentence where none could."""
    effects = evaluation.effects
    detector = html.escape(evaluation.detector)
    if not any(effect.on or effect.range_m or effect.lost for effect in effects):
        return f"<p>The detector is {detector}. No effect is needed in any scene: returns are exact first hits.</p>"
    tolerance = effects[0].tolerance
    head = (
        f"<p>The detector is {detector}. For each effect, the most that it could change in any scene and row: errors "
        f"of range (rms) and the share of returns lost, invented or misplaced. Together, skipped effects may change "
        f"{MILLIMETRES * tolerance.range_m:.3g} mm and {tolerance.lost:.2g} of the returns.</p>"
    )
    headings = ["effect", "simulated", "reason", "range [mm]", "returns", "cost [s]"]
    caption = "The plan of effects: what was simulated, why, and what it costs."
    lines = [(_effect_cells(effect), "", False) for effect in effects]
    content = f'<div class="reasons">{table(headings, lines, text_columns=3, caption=caption)}</div>'
    return head + folded("All effects", content, len(lines))


def audit_section(evaluation: Evaluation, audit: Audit) -> str:
    """Every row under the plan and under all effects, with a verdict each."""
    planned, everything = audit.seconds
    there = {effect.name for effect in evaluation.effects if effect.range_m or effect.lost}
    skipped = html.escape(
        ", ".join(_words(name) for name in audit.skipped if name in there) or "nothing that the scenes have"
    )
    head = (
        f"<p>The audit {'failed' if audit.failed else 'passed'}. The plan skips {skipped}; all rows took {planned:.2f} "
        f"s under it and {everything:.2f} s under all effects, with the same random numbers. A mean may move by "
        f"{audit.tolerance:g} {html.escape(audit.unit)}, the metric's tolerance; the largest difference is "
        f"{audit.worst:.2g}.</p>"
    )
    headings = [
        "design",
        "rays",
        f"planned [{audit.unit}]",
        f"all [{audit.unit}]",
        "difference",
        "95 % interval",
        "planned [s]",
        "all [s]",
        "moved",
    ]
    lines = [
        (_audit_cells(row), "worse" if row in audit.failed else "better", bool(index and _starts(audit.rows, index)))
        for index, row in enumerate(audit.rows)
    ]
    words = {"worse": "too far", "better": "within"}
    content = table(headings, lines, text_columns=1, words=words, caption="Every row under the plan and under all.")
    return head + folded("All rows", content, len(lines))


def _starts(rows: Sequence[AuditRow], index: int) -> bool:
    row, before = rows[index].planned, rows[index - 1].planned
    if row.matched_to is None:
        return row.design != before.design
    return (row.matched_to, row.matched_rays) != (before.matched_to, before.matched_rays)


def _effect_cells(effect: EffectSummary) -> list[str]:
    simulated = "no" if effect.missing is None else "not possible here"
    if effect.on:
        simulated = "yes" if effect.scenes_on == 1 else f"in {100 * effect.scenes_on:.0f} % of scenes"
    bounds = (plain_number(MILLIMETRES * effect.range_m, 3), plain_number(effect.lost, 2))
    return [_words(effect.name), simulated, effect.reason, *bounds, plain_number(effect.seconds, 2, tiny=SHORT_S)]


def _audit_cells(audited: AuditRow) -> list[str]:
    row, other = audited.planned, audited.everything
    name = row.design if row.matched_to is None else f"{row.design} (bandwidth of {row.matched_to})"
    cells = [name, str(row.rays), four_digits(row.value), four_digits(other.value), f"{audited.difference:.2g}"]
    known = audited.ci_low is not None and audited.ci_high is not None
    interval = f"{audited.ci_low:.2g} to {audited.ci_high:.2g}" if known else "-"
    return [*cells, interval, f"{row.seconds:.2f}", f"{other.seconds:.2f}", ""]
