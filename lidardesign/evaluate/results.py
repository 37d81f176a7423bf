"""What an evaluation found: one row per design or baseline and number of rays, and paired differences.

A mean over scenes says little where scenes differ more than designs do. Differences are therefore taken scene
by scene, and their intervals are the ones that tell two designs apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.estimates import HALF_INTERVAL, Estimate, as_documents
from lidardesign.task import Metric

if TYPE_CHECKING:
    from lidardesign.evaluate.accuracy import Accuracy
    from lidardesign.evaluate.audit import Audit
    from lidardesign.evaluate.cma_candidate import Record
    from lidardesign.evaluate.effects import EffectSummary


@dataclass(frozen=True, eq=False)
class Row:
    """One design or baseline at one number of rays.

    Arguments:
        design: Its name.
        rays: Rays per frame; with conditions, per condition value.
        value: Mean score over the held-out scenes, failures at the metric's worst value.
        ci_low, ci_high: Ends of the 95 % bootstrap interval of the mean.
        failures: Scenes with too few returns to score.
        bandwidth_mbps: What its gates cost to read out, averaged over condition values [Mbit/s].
        seconds: Time to simulate and score all scenes [s]; measured once where rows share their rays.
        per_scene: The score in every held-out scene, shape (S,).
        baseline: Whether it is a baseline.
        matched_to, matched_rays: The design and its number of rays whose bandwidth this baseline was given;
            None outside the comparison at equal bandwidth.
        details: The task's further figures by name, each a mean over the scenes that give it.
    """

    design: str
    rays: int
    value: float
    ci_low: float
    ci_high: float
    failures: int
    bandwidth_mbps: float
    seconds: float
    per_scene: np.ndarray
    baseline: bool = False
    matched_to: str | None = None
    matched_rays: int | None = None
    details: Mapping[str, float] = field(default_factory=dict)

    @property
    def half_width(self) -> float:
        """Half of the interval: how far the value may be off over other scenes, in the metric's unit."""
        return (self.ci_high - self.ci_low) / 2

    def as_dict(self) -> dict[str, Any]:
        """The contract's keys, `half_width`, `details`, and at equal bandwidth the design that it was matched to."""
        values: dict[str, Any] = {
            "design": self.design,
            "rays": self.rays,
            "value": self.value,
            "ci_low": self.ci_low,
            "ci_high": self.ci_high,
            "half_width": self.half_width,
            "failures": self.failures,
            "bandwidth_mbps": self.bandwidth_mbps,
            "seconds": self.seconds,
            "details": dict(self.details),
        }
        if self.matched_to is not None:
            values |= {"matched_to": self.matched_to, "matched_rays": self.matched_rays}
        return values


@dataclass(frozen=True)
class Paired:
    """The mean over scenes of a's score minus b's, in the metric's unit, with its 95 % bootstrap interval.

    Arguments:
        a, b: Names of the two.
        rays: Rays per frame of both; of a alone at equal bandwidth.
        difference: Negative where a is lower.
        ci_low, ci_high: Ends of the interval.
        rays_b: Rays per frame of b, where they differ: the comparison at equal bandwidth.
    """

    a: str
    b: str
    rays: int
    difference: float
    ci_low: float
    ci_high: float
    rays_b: int | None = None

    @property
    def half_width(self) -> float:
        """Half of the interval, in the metric's unit."""
        return (self.ci_high - self.ci_low) / 2

    def as_dict(self) -> dict[str, Any]:
        """The contract's keys and `half_width`, with `rays_b` at equal bandwidth."""
        names = ("a", "b", "rays", "difference", "ci_low", "ci_high", "half_width")
        values = {name: getattr(self, name) for name in names}
        return values if self.rays_b is None else {**values, "rays_b": self.rays_b}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All rows of an evaluation.

    Arguments:
        metric: What the values mean.
        scenes: The number of held-out scenes.
        rows: Designs, then baselines, at equal numbers of rays.
        paired: Every design against every baseline and every later design, at equal numbers of rays.
        equal_bandwidth: Every baseline with as many rays as fit in the bandwidth of each row of a design.
        paired_bandwidth: Every design against those.
        notes: What a reader should know, one line each.
        detector: The name of what measured.
        effects: What was simulated, and why.
        planning_seconds: Time to find that out [s].
        audit: The same rows under all effects, where that was asked for.
        accuracy: What accuracy costs in time, where that was asked for.
        searches: How the rows of `cma` were found, where they were asked for.
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
    accuracy: Accuracy | None = None
    searches: Sequence[Record] = ()

    def estimates(self) -> dict[str, Estimate]:
        """The designs' values and their differences to the baselines with half of their intervals, by what they are."""
        unit, rows = self.metric.unit, [row for row in self.rows if not row.baseline]
        values = {
            f"{row.design} at {row.rays} rays": Estimate(row.value, row.half_width, unit, HALF_INTERVAL)
            for row in rows
        }
        differences = {
            f"{pair.a} - {pair.b} at {pair.rays} rays": Estimate(pair.difference, pair.half_width, unit, HALF_INTERVAL)
            for pair in self.paired
        }
        return {**values, **differences}

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON form of `evaluate`.

        Beyond the contract: `equal_bandwidth` rows name the design and rays that they are `matched_to`,
        `paired_equal_bandwidth` compares each design with them (`rays_b` are the baseline's), `notes`, `detector`,
        `planning_seconds`, and `audit` where that was asked for.
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
            "rows": [row.as_dict() for row in self.rows],
            "paired": [pair.as_dict() for pair in self.paired],
            "equal_bandwidth": [row.as_dict() for row in self.equal_bandwidth],
            "paired_equal_bandwidth": [pair.as_dict() for pair in self.paired_bandwidth],
            "detector": self.detector,
            "effects": [effect.as_dict() for effect in self.effects],
            "planning_seconds": self.planning_seconds,
            "accuracy": [] if self.accuracy is None else self.accuracy.as_rows(),
            "notes": list(self.notes),
            "cma": [search.as_dict() for search in self.searches],
            "error_estimates": as_documents(self.estimates()),
        }
        return values if self.audit is None else {**values, "audit": self.audit.as_dict()}


def leading_detail(rows: Sequence[Row]) -> str | None:
    """The first of the task's further figures, which tables show beside the score; None where it gives none."""
    return next((name for row in rows for name in row.details), None)


def worse_than_threshold(evaluation: Evaluation, limit: float) -> list[Row]:
    """Rows of designs whose mean misses a limit in the metric's unit; baselines never count.

    Where lower is better, a row misses the limit by lying above it; where higher is better, by lying below
    it: `--fail-above` then reads as "fail where worse than". A value equal to the limit meets it.
    """
    sign = 1.0 if evaluation.metric.better == "lower" else -1.0
    return [row for row in evaluation.rows if not row.baseline and sign * row.value > sign * limit]
