"""Results of an evaluation: rows, paired differences, and an audit of the effects that were skipped.

A mean over scenes says little where scenes differ more than designs do. Differences are therefore taken scene
by scene, and their intervals are the ones that tell two designs apart. The audit has every row under all effects and
under the planned ones with the same random numbers: what differs is what was skipped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.estimates import HALF_INTERVAL, Estimate, Interval, as_documents
from lidardesign.evaluation.entries import EffectSummary, StrongestBaseline
from lidardesign.evaluation.mounting import MountError
from lidardesign.evaluation.sweep import Accuracy
from lidardesign.methods.cma import SearchRecord
from lidardesign.run.arrays import csv_table
from lidardesign.run.files import write_atomic
from lidardesign.task import Metric

# What one would place without a design: a grid over everything, and one cropped to what returns.
BY_HAND = ("uniform", "bounding")
ROW_KEYS = (
    "design", "rays", "value", "ci_low", "ci_high", "half_width", "worst_decile", "failures", "bandwidth_mbps",
    "seconds",
)  # fmt: skip


class _WithInterval:
    """A figure with the ends of its 95 % interval; None where all scenes are of one group."""

    ci_low: float | None
    ci_high: float | None

    @property
    def half_width(self) -> float | None:
        """Half of the interval, in the metric's unit; None without one."""
        return None if self.ci_low is None or self.ci_high is None else (self.ci_high - self.ci_low) / 2


@dataclass(frozen=True, eq=False)
class Row(_WithInterval):
    """One design or baseline at one number of rays.

    Arguments:
        design: Its name.
        rays: Rays per frame; with conditions, per condition value.
        value: Mean score over the held-out scenes, failures at the metric's worst value.
        ci_low, ci_high: Ends of the 95 % interval of the mean over groups of scenes; None where all are of one group.
        failures: Scenes with too few returns to score.
        bandwidth_mbps: What its gates cost to read out, averaged over condition values [Mbit/s].
        seconds: Time to simulate and score all scenes [s]; measured once where rows share their rays.
        per_scene: The score in every held-out scene, shape (S,).
        baseline: Whether it is a baseline.
        matched_to, matched_rays: The design and its number of rays whose bandwidth this baseline was given;
            None outside the comparison at equal bandwidth.
        details: The task's further figures by name, each a mean over the scenes that give it.
        groups: The number of every scene's group, shape (S,); None: every scene is its own.
        per_seed: Over several seeds the mean of each, to which `value` and `per_scene` are means.
        worst_decile: The mean score in the worst tenth of the scenes.
        lost: The mean score with each of the design's sensors lost, where that was asked for.
        better: lower or higher, as of the metric.
        gates: Different gates of its sensors.
    """

    design: str
    rays: int
    value: float
    ci_low: float | None
    ci_high: float | None
    failures: int
    bandwidth_mbps: float
    seconds: float
    per_scene: np.ndarray
    baseline: bool = False
    matched_to: str | None = None
    matched_rays: int | None = None
    details: Mapping[str, float] = field(default_factory=dict)
    groups: np.ndarray | None = None
    per_seed: tuple[float, ...] = ()
    worst_decile: float | None = None
    lost: tuple[float, ...] = ()
    better: str = "lower"
    gates: int = 1

    @property
    def worst_lost(self) -> float | None:
        """The mean score without the sensor whose loss costs most; None where that was not asked for."""
        return (max if self.better == "lower" else min)(self.lost, default=None)

    @property
    def drawn_interval(self) -> tuple[float, float]:
        """The interval for pictures, without width where there is none."""
        ends = (self.ci_low, self.ci_high)
        return (self.value, self.value) if None in ends else ends

    def as_dict(self) -> dict[str, Any]:
        """The contract's keys, `half_width`, `details`, and at equal bandwidth the design that it was matched to."""
        values = {name: getattr(self, name) for name in (*ROW_KEYS, "gates")} | {"details": dict(self.details)}
        if self.matched_to is not None:
            values |= {"matched_to": self.matched_to, "matched_rays": self.matched_rays}
        if self.per_seed:
            values["per_seed"] = list(self.per_seed)
        if self.lost:
            values |= {"lost": list(self.lost), "worst_lost": self.worst_lost}
        return values


@dataclass(frozen=True)
class Paired(_WithInterval):
    """The mean over scenes of a's score minus b's, in the metric's unit, with its 95 % interval.

    Arguments:
        a, b: Names of the two.
        rays: Rays per frame of both; of a alone at equal bandwidth.
        difference: Negative where a is lower.
        ci_low, ci_high: Ends of the interval; None where all scenes are of one group.
        rays_b: Rays per frame of b, where they differ: the comparison at equal bandwidth.
        percent: By how much a's mean is above b's [%], by logarithms; None where a mean is not above 0.
    """

    a: str
    b: str
    rays: int
    difference: float
    ci_low: float | None
    ci_high: float | None
    rays_b: int | None = None
    percent: Interval | None = None

    @property
    def interval(self) -> Interval:
        """The difference with the ends of its interval."""
        return Interval(self.difference, self.ci_low, self.ci_high)

    def as_dict(self) -> dict[str, Any]:
        """The contract's keys, `half_width` and `percent`, with `rays_b` at equal bandwidth."""
        names = ("a", "b", "rays", "difference", "ci_low", "ci_high", "half_width")
        values = {name: getattr(self, name) for name in names}
        values["percent"] = self.percent and list(self.percent)
        return values if self.rays_b is None else {**values, "rays_b": self.rays_b}


@dataclass(frozen=True, eq=False)
class Mounting:
    """Rows at equal rays with mounting errors.

    Arguments:
        error: The standard deviations of the errors.
        rows: The same designs and baselines, in the order of the exact rows.
        costs: Each of them against itself, mounted exactly, scene by scene.
    """

    error: MountError
    rows: Sequence[Row]
    costs: Sequence[Paired]

    def as_dict(self) -> dict[str, Any]:
        """For `--json`: rows, each with the cost of its mounting."""
        return {
            "place_m": self.error.place_m,
            "angle_rad": self.error.angle_rad,
            "rows": [
                {
                    "design": row.design,
                    "rays": row.rays,
                    "value": row.value,
                    "ci_low": row.ci_low,
                    "ci_high": row.ci_high,
                    "failures": row.failures,
                    "cost": {name: getattr(cost, name) for name in ("difference", "ci_low", "ci_high")},
                }
                for row, cost in zip(self.rows, self.costs, strict=True)
            ],
        }


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All rows of an evaluation.

    Arguments:
        metric: The metric of the values.
        scenes: The number of held-out scenes.
        rows: Designs, then baselines, at equal numbers of rays.
        paired: Every design against every baseline and every later design, at equal numbers of rays.
        equal_bandwidth: Every baseline with as many rays as fit in the bandwidth of each row of a design.
        paired_bandwidth: Every design against those.
        notes: Lines for readers.
        detector: The name of the detector.
        effects: The effects, simulated or not, with reasons.
        planning_seconds: Time to plan the effects [s].
        audit: The same rows under all effects, where that was asked for.
        mounting: The rows with mounting errors, where that was asked for.
        accuracy: The sweeps of accuracy, where that was asked for.
        searches: The searches of the baseline `cma`, where it was asked for.
        seeds: Of learning and fitting, where rows and differences are means over several.
        strongest_baseline: The best baseline at `middle_rays` on training scenes; None where no baseline was scored.
        named: Baselines that were asked for.
    """

    metric: Metric
    scenes: int
    rows: Sequence[Row]
    paired: Sequence[Paired]
    equal_bandwidth: Sequence[Row] = ()
    paired_bandwidth: Sequence[Paired] = ()
    notes: Sequence[str] = ()
    detector: str = "ideal"
    effects: Sequence[EffectSummary] = ()
    planning_seconds: float = 0.0
    audit: Audit | None = None
    mounting: Mounting | None = None
    accuracy: Accuracy | None = None
    searches: Sequence[SearchRecord] = ()
    seeds: Sequence[int] = ()
    strongest_baseline: StrongestBaseline | None = None
    named: Sequence[str] = ()

    @property
    def headline_rows(self) -> dict[str, Row]:
        """Every design's row by its name: at the middle number of rays, or the closest that it has."""
        rows, count = [row for row in self.rows if not row.baseline], middle_rays(self.rows)
        closest = {row.design: row for row in sorted(rows, key=lambda row: -abs(row.rays - count))}
        return {name: closest[name] for name in dict.fromkeys(row.design for row in rows)}

    @property
    def headline_pairs(self) -> dict[str, Paired]:
        """Each design against the strongest baseline at its number of rays in `headline_rows`, by the design's name."""
        baseline, counts = self.strongest_baseline, {name: row.rays for name, row in self.headline_rows.items()}
        against = [pair for pair in self.paired if baseline and pair.b == baseline.name]
        return {pair.a: pair for pair in against if pair.rays == counts[pair.a]}

    @property
    def best_row(self) -> Row:
        """The best of the rows in `headline_rows`: at the middle number of rays, where any design has that."""
        rows = list(self.headline_rows.values())
        usual = [row for row in rows if row.rays == middle_rays(self.rows)] or rows
        return (min if self.metric.better == "lower" else max)(usual, key=lambda row: row.value)

    @property
    def baseline_rows(self) -> list[Row]:
        """What stands for layouts by hand, the strongest baseline, and those asked for, at `headline_rows`' rays."""
        strongest = () if self.strongest_baseline is None else (self.strongest_baseline.name,)
        names, counts = {*BY_HAND, *strongest, *self.named}, {row.rays for row in self.headline_rows.values()}
        return [row for row in self.rows if row.baseline and row.design in names and row.rays in counts]

    @property
    def groups(self) -> int:
        """The number of independent groups of held-out scenes, over which intervals are taken."""
        known = next((row.groups for row in self.rows if row.groups is not None), None)
        return self.scenes if known is None else int(known.max()) + 1

    def estimates(self) -> dict[str, Estimate]:
        """The designs' values and their differences to others with half-widths, by a description."""
        unit, rows = self.metric.unit, [row for row in self.rows if not row.baseline]
        values = {
            f"{row.design} at {row.rays} rays": Estimate(row.value, row.half_width, unit, HALF_INTERVAL) for row in rows
        }
        differences = {
            f"{pair.a} - {pair.b} at {pair.rays} rays": Estimate(pair.difference, pair.half_width, unit, HALF_INTERVAL)
            for pair in self.paired
        }
        return {**values, **differences}

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON form of `evaluate`.

        Beyond the contract: `groups` of scenes, `seeds`, `equal_bandwidth` rows name the design and rays that they are
        `matched_to`, `paired_equal_bandwidth` compares each design with them (`rays_b` are the baseline's), `notes`,
        `detector`, `planning_seconds`, and `audit` and `mounting` where those were asked for.
        """
        metric = self.metric
        values = {
            "metric": {
                "name": metric.name,
                "unit": metric.unit,
                "better": metric.better,
                "worst": float(metric.worst),
            },
            "scenes": self.scenes,
            "groups": self.groups,
            "seeds": list(self.seeds),
            "rows": [row.as_dict() for row in self.rows],
            "paired": [pair.as_dict() for pair in self.paired],
            "strongest_baseline": self.strongest_baseline and asdict(self.strongest_baseline),
            "equal_bandwidth": [row.as_dict() for row in self.equal_bandwidth],
            "paired_equal_bandwidth": [pair.as_dict() for pair in self.paired_bandwidth],
            "detector": self.detector,
            "effects": [effect.as_dict() for effect in self.effects],
            "planning_seconds": self.planning_seconds,
            "accuracy": [] if self.accuracy is None else self.accuracy.as_rows(),
            "notes": list(self.notes),
            "cma": [asdict(search) for search in self.searches],
            "error_estimates": as_documents(self.estimates()),
        }
        asked = {"audit": self.audit, "mounting": self.mounting}
        return values | {name: found.as_dict() for name, found in asked.items() if found is not None}


def middle_rays(rows: Sequence[Row]) -> int:
    """The lower median of the numbers of rays at which most designs have a row, baselines where there are none."""
    designs = Counter(row.rays for row in rows if not row.baseline) or Counter(row.rays for row in rows)
    usual = sorted(count for count, number in designs.items() if number == max(designs.values()))
    return usual[(len(usual) - 1) // 2]


def leading_detail(rows: Sequence[Row]) -> str | None:
    """The first of the task's further figures, which tables show beside the score; None where it gives none."""
    return next((name for row in rows for name in row.details), None)


def verdict(evaluation: Evaluation, pair: Paired) -> str:
    """`better` or `worse` where the paired interval of a excludes zero, `open` where it does not or there is none."""
    if pair.ci_low is None or pair.ci_high is None:
        return "open"
    low, high = sorted(evaluation.metric.sign * end for end in (pair.ci_low, pair.ci_high))
    return "better" if high < 0 else "worse" if low > 0 else "open"


@dataclass(frozen=True, eq=False)
class AuditRow:
    """The change of one row by skipped effects.

    Arguments:
        planned, everything: The row under the planned effects, and under all.
        difference: Mean over scenes of planned minus all, in the metric's unit.
        ci_low, ci_high: Ends of its 95 % interval; None where all scenes are of one group.
    """

    planned: Row
    everything: Row
    difference: float
    ci_low: float | None
    ci_high: float | None

    def as_dict(self) -> dict[str, Any]:
        """For `--json`; the design that it was matched to only at equal bandwidth."""
        row = self.planned
        values = {
            "design": row.design,
            "rays": row.rays,
            "planned": row.value,
            "everything": self.everything.value,
            "difference": self.difference,
            "ci_low": self.ci_low,
            "ci_high": self.ci_high,
            "seconds": row.seconds,
            "seconds_everything": self.everything.seconds,
        }
        matched = {"matched_to": row.matched_to, "matched_rays": row.matched_rays}
        return values if row.matched_to is None else values | matched


@dataclass(frozen=True, eq=False)
class Audit:
    """Effects that were skipped, and whether they change the metric.

    Arguments:
        tolerance: The metric's own: differences below it do not matter.
        unit: The metric's.
        rows: Every row of the evaluation, those at equal bandwidth last.
        skipped: Effects that only the other side simulated, in any scene.
        unavailable: Effects that neither side could simulate.
    """

    tolerance: float
    unit: str
    rows: Sequence[AuditRow]
    skipped: Sequence[str]
    unavailable: Sequence[str]

    @property
    def failed(self) -> list[AuditRow]:
        """Rows whose mean moves by more than the tolerance."""
        return [row for row in self.rows if abs(row.difference) > self.tolerance]

    @property
    def worst(self) -> float:
        """The largest difference of means, in the metric's unit."""
        return max((abs(row.difference) for row in self.rows), default=0.0)

    @property
    def seconds(self) -> tuple[float, float]:
        """Time of all rows under the plan and under all effects [s]."""
        return sum(row.planned.seconds for row in self.rows), sum(row.everything.seconds for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """For `--json`."""
        planned, everything = self.seconds
        return {
            "passed": not self.failed,
            "tolerance": self.tolerance,
            "unit": self.unit,
            "worst": self.worst,
            "skipped": list(self.skipped),
            "unavailable": list(self.unavailable),
            "seconds": planned,
            "seconds_everything": everything,
            "rows": [row.as_dict() for row in self.rows],
        }


def csv_text(evaluation: Evaluation) -> str:
    """One line per row: equal rays first, then equal bandwidth, which names the design it was matched to."""
    unit = evaluation.metric.unit
    header = (
        "design",
        "rays",
        f"{evaluation.metric.name} [{unit}]",
        f"ci_low [{unit}]",
        f"ci_high [{unit}]",
        "failures",
        "scenes",
        "bandwidth [Mbit/s]",
        "seconds [s]",
        "matched_to",
        "matched_rays",
        f"worst decile [{unit}]",
        f"worst sensor lost [{unit}]",
    )
    rows = [
        (
            _no_formula(row.design),
            row.rays,
            row.value,
            row.ci_low,
            row.ci_high,
            row.failures,
            evaluation.scenes,
            row.bandwidth_mbps,
            row.seconds,
            _no_formula(row.matched_to or ""),
            "" if row.matched_rays is None else row.matched_rays,
            row.worst_decile,
            row.worst_lost,
        )
        for row in (*evaluation.rows, *evaluation.equal_bandwidth)
    ]
    return csv_table([header, *rows])


def write_csv(evaluation: Evaluation, path: Path) -> None:
    """Write the rows as UTF-8 CSV, whole or not at all."""
    write_atomic(Path(path), csv_text(evaluation))


def _no_formula(text: str) -> str:
    """A name, with an apostrophe in front where spreadsheets would read a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text
