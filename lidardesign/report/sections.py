"""The report's sections of tables: sensors, scores, constraints, effects, audit, times; their words are templates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from lidardesign.constraints.slack import ConstraintSlack
from lidardesign.evaluation.results import Evaluation, leading_detail, verdict
from lidardesign.report.figures import curve_figure, far_baselines, series
from lidardesign.run.clock import INSIDE, OTHER
from lidardesign.run.markup import TINY, rendered
from lidardesign.sensors.design import DesignSpec

MOST_SENSORS = 60  # listed in a table
# Phases of a smaller share of their command, or deeper, are left out; `other` has what they took.
LEAST_SHARE, DEEPEST = 0.005, 2
PERCENT = 100.0


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

    @property
    def shown(self) -> list[tuple[str, int, float, float]]:
        """Two levels of phases that matter, and what all others took: name, level, seconds, share [%]."""
        shown = {
            name: seconds
            for name, seconds in self.phases.items()
            if name != OTHER and name.count(INSIDE) < DEEPEST and seconds >= LEAST_SHARE * self.seconds
        }
        rest = self.seconds - math.fsum(seconds for name, seconds in shown.items() if INSIDE not in name)
        shown[OTHER] = max(rest, 0.0)
        return [
            (name.rpartition(INSIDE)[2], name.count(INSIDE), seconds, PERCENT * seconds / self.seconds)
            for name, seconds in shown.items()
        ]


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


def sensors_section(designs: Sequence[DesignSpec]) -> str:
    """The sensors of designs in degrees and metres; of several designs folded."""
    return rendered("report/templates/sensors.html", designs=designs, most=MOST_SENSORS)


def scores_section(evaluation: Evaluation) -> str:
    """Both curves with one legend, whose boxes switch curves in both, and all tables of scores, folded."""
    far = far_baselines(evaluation)
    own = {(row.design, row.rays): row for row in evaluation.rows if not row.baseline}
    baselines = {row.design for row in evaluation.rows if row.baseline}
    paired = [(pair, verdict(evaluation, pair)) for pair in evaluation.paired]
    matched = zip(evaluation.equal_bandwidth, evaluation.paired_bandwidth, strict=True)
    return rendered(
        "report/templates/scores.html",
        evaluation=evaluation,
        curves=series(evaluation),
        far=far,
        by_rays=curve_figure(evaluation, "rays", far),
        by_bandwidth=curve_figure(evaluation, "bandwidth", far),
        has_losses=any(row.lost for row in evaluation.rows),
        detail=leading_detail(evaluation.rows),
        paired={
            "Designs against baselines": [one for one in paired if one[0].b in baselines],
            "Designs against designs": [one for one in paired if one[0].b not in baselines],
        },
        matched=[(own[pair.a, pair.rays], row, pair, verdict(evaluation, pair)) for row, pair in matched],
    )


def mounting_section(evaluation: Evaluation) -> str:
    """All rows at equal rays beside themselves with misplaced sensors; empty where that was not asked for."""
    mounting = evaluation.mounting
    lines = () if mounting is None else zip(mounting.rows, evaluation.rows, mounting.costs, strict=True)
    rows = [(row, own, cost, verdict(evaluation, cost)) for row, own, cost in lines]
    return rendered("report/templates/mounting.html", mounting=mounting, rows=rows, unit=evaluation.metric.unit)


def constraints_section(designs: Mapping[str, Sequence[ConstraintSlack]]) -> str:
    """A row per bound of each design: the tightest sensor, its slack and the used share of the bound."""
    bounds = {
        name: [(one, number(one.bound), number(one.value), _room(one), _used(one)) for one in found]
        for name, found in designs.items()
    }
    return rendered("report/templates/constraints.html", designs=bounds)


def _room(one: ConstraintSlack) -> str:
    if one.room is None:
        return "-"
    bounds = one.bound if isinstance(one.bound, list | tuple) else [one.bound]
    # next to none is none
    return "0" if abs(one.room) < TINY * max(abs(float(value)) for value in bounds) else number(one.room)


def _used(one: ConstraintSlack) -> float | None:
    """The used share of a bound [%]."""
    return None if one.share is None else PERCENT * min(max(1.0 - one.share, 0.0), 1.0)


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


def times_section(commands: Sequence[CommandTimes]) -> str:
    """Every command with its phases, their seconds and shares as bars."""
    return rendered("report/templates/times.html", commands=[one for one in commands if one.seconds > 0])


def effects_section(evaluation: Evaluation) -> str:
    """The effects that could change the scores, simulated or not; one sentence where none could."""
    is_needed = any(effect.on or effect.range_m or effect.lost for effect in evaluation.effects)
    return rendered("report/templates/effects.html", evaluation=evaluation, is_needed=is_needed)


def audit_section(evaluation: Evaluation) -> str:
    """Every row under the plan and under all effects, with a verdict each; empty where that was not asked for."""
    there = {effect.name for effect in evaluation.effects if effect.range_m or effect.lost}
    return rendered("report/templates/audit.html", audit=evaluation.audit, there=there)
