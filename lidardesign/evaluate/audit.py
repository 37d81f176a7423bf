"""The audit of a plan: every row under all effects and under the planned ones, scene by scene.

Both have the same random numbers: every effect draws from a stream of its own, so what differs is what was skipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lidardesign.evaluate.results import Row
from lidardesign.evaluate.statistics import paired_difference


@dataclass(frozen=True)
class AuditRow:
    """What the skipped effects are worth to one row.

    Arguments:
        design: Its name.
        rays: Rays per frame.
        planned, everything: Mean score under the planned effects, and under all.
        difference: Mean over scenes of planned minus all, in the metric's unit.
        ci_low, ci_high: Ends of its 95 % bootstrap interval.
        seconds, seconds_everything: Time to simulate and score all scenes [s].
        matched_to, matched_rays: As in the row at equal bandwidth.
    """

    design: str
    rays: int
    planned: float
    everything: float
    difference: float
    ci_low: float
    ci_high: float
    seconds: float
    seconds_everything: float
    matched_to: str | None = None
    matched_rays: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """All fields; the design that it was matched to only at equal bandwidth."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        if self.matched_to is None:
            del values["matched_to"], values["matched_rays"]
        return values


@dataclass(frozen=True, eq=False)
class Audit:
    """Whether what was skipped changes the metric.

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
        return sum(row.seconds for row in self.rows), sum(row.seconds_everything for row in self.rows)

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


def audit_rows(planned: Sequence[Row], everything: Sequence[Row], seed: int) -> list[AuditRow]:
    """The same rows under both, paired."""
    return [_audit_row(one, other, seed) for one, other in zip(planned, everything, strict=True)]


def _audit_row(planned: Row, everything: Row, seed: int) -> AuditRow:
    mean, low, high = paired_difference(planned.per_scene, everything.per_scene, seed)
    return AuditRow(
        planned.design,
        planned.rays,
        planned.value,
        everything.value,
        mean,
        low,
        high,
        planned.seconds,
        everything.seconds,
        planned.matched_to,
        planned.matched_rays,
    )
