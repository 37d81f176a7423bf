"""The report's tables about physics: what was simulated and why, and what skipping the rest changes."""

from __future__ import annotations

import html
from collections.abc import Sequence

from lidardesign.evaluate.audit import Audit, AuditRow
from lidardesign.evaluate.effects import EffectSummary
from lidardesign.evaluate.results import Evaluation
from lidardesign.evaluate.verdicts import figure, plain, table

MILLIMETRES = 1000.0
SHORT_S = 0.01  # costs from here on are shown as their limit


def effects_section(evaluation: Evaluation) -> str:
    """What could change the scores, and what of it was simulated; one sentence where nothing could."""
    effects = evaluation.effects
    detector = html.escape(evaluation.detector)
    if not any(effect.on or effect.range_m or effect.lost for effect in effects):
        return f"<p>The detector is {detector}. No scene calls for any effect: returns are exact first hits.</p>"
    tolerance = effects[0].tolerance
    head = (
        f"<p>The detector is {detector}. For each effect, the most that it could change in any scene and row: errors "
        f"of range (rms) and the share of returns lost, invented or misplaced. All that is skipped may change "
        f"{MILLIMETRES * tolerance.range_m:.3g} mm and {tolerance.lost:.2g} of the returns together.</p>"
    )
    headings = ["effect", "simulated", "reason", "range [mm]", "returns", "cost [s]"]
    caption = "The plan of effects: what was simulated, why, and what it costs."
    lines = [(_effect_cells(effect), "", False) for effect in effects]
    return f'{head}<div class="reasons">{table(headings, lines, text_columns=3, caption=caption)}</div>'


def audit_section(evaluation: Evaluation, audit: Audit) -> str:
    """Every row under the plan and under all effects, with a verdict each."""
    planned, everything = audit.seconds
    there = {effect.name for effect in evaluation.effects if effect.range_m or effect.lost}
    skipped = html.escape(", ".join(_words(name) for name in audit.skipped if name in there))
    skipped = skipped or "nothing that is there"
    passed = "failed" if audit.failed else "passed"
    head = (
        f"<p>The audit {passed}. The plan skips {skipped}; all rows took {planned:.2f} s under it and "
        f"{everything:.2f} s under all effects, with the same random numbers. A mean may move by {audit.tolerance:g} "
        f"{html.escape(audit.unit)}, the metric's tolerance; the largest difference is {audit.worst:.2g}.</p>"
    )
    unit = audit.unit
    headings = ["design", "rays", f"planned [{unit}]", f"all [{unit}]", "difference", "95 % interval"]
    lines = [
        (_audit_cells(row), "worse" if row in audit.failed else "better", bool(index and _starts(audit.rows, index)))
        for index, row in enumerate(audit.rows)
    ]
    words = {"worse": "too far", "better": "within"}
    headings += ["planned [s]", "all [s]", "moved"]
    return head + table(headings, lines, text_columns=1, words=words, caption="Every row under the plan and under all.")


def _starts(rows: Sequence[AuditRow], index: int) -> bool:
    """Whether a row begins a group: another design, or the rows at equal bandwidth of another one."""
    row, before = rows[index], rows[index - 1]
    if row.matched_to is None:
        return row.design != before.design
    return (row.matched_to, row.matched_rays) != (before.matched_to, before.matched_rays)


def _effect_cells(effect: EffectSummary) -> list[str]:
    shown = [_words(effect.name), _simulated(effect), effect.reason]
    bounds = (plain(MILLIMETRES * effect.range_m, 3), plain(effect.lost, 2))
    return [*shown, *bounds, plain(effect.seconds, 2, tiny=SHORT_S)]


def _simulated(effect: EffectSummary) -> str:
    if effect.on:
        return "yes" if effect.scenes_on == 1 else f"in {100 * effect.scenes_on:.0f} % of scenes"
    return "no" if effect.missing is None else "not possible here"


def _audit_cells(row: AuditRow) -> list[str]:
    name = row.design if row.matched_to is None else f"{row.design} (bandwidth of {row.matched_to})"
    cells = [name, str(row.rays), figure(row.planned), figure(row.everything), f"{row.difference:.2g}"]
    return [*cells, f"{row.ci_low:.2g} to {row.ci_high:.2g}", *_times(row), ""]


def _times(row: AuditRow) -> list[str]:
    return [f"{row.seconds:.2f}", f"{row.seconds_everything:.2f}"]


def _words(name: str) -> str:
    return name.replace("_", " ")
