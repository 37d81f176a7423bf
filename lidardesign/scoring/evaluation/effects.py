"""Which effects an evaluation simulated, and why: every effect over all scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lidardesign.simulate.detector.physics import EFFECTS
from lidardesign.simulate.plan import Choice, EffectPlan, Tolerance

MILLIMETRES = 1000.0


@dataclass(frozen=True)
class EffectSummary:
    """An effect over all scenes.

    Arguments:
        name: Of the effect.
        scenes_on: The share of scenes in which it was simulated.
        range_m: Its largest bound on ranges, in any scene [m].
        lost: Its largest bound on the share of returns.
        tolerance: Of all skipped effects together.
        reason: Why, in the scene where it could change most.
        seconds: What simulating it in all scenes takes, predicted [s].
        missing: What its simulation needs and is not there.
    """

    name: str
    scenes_on: float
    range_m: float
    lost: float
    tolerance: Tolerance
    reason: str
    seconds: float
    missing: str | None = None

    @property
    def on(self) -> bool:
        """Whether it was simulated anywhere."""
        return self.scenes_on > 0

    @property
    def exceeds(self) -> bool:
        """Whether it could change more than is tolerated."""
        return self.range_m > self.tolerance.range_m or self.lost > self.tolerance.lost

    def as_dict(self) -> dict[str, Any]:
        """The contract's keys for ranges; the same for returns, and what it costs."""
        return {
            "name": self.name,
            "on": self.on,
            "bound": self.range_m,
            "tolerance": self.tolerance.range_m,
            "unit": "m",
            "reason": self.reason,
            "lost": self.lost,
            "lost_tolerance": self.tolerance.lost,
            "scenes_on": self.scenes_on,
            "seconds": self.seconds,
            "missing": self.missing,
        }


def effect_summaries(plans: Sequence[EffectPlan]) -> list[EffectSummary]:
    """One line per effect, in the order in which light meets them."""
    return [_summary(name, plans) for name in EFFECTS]


def _summary(name: str, plans: Sequence[EffectPlan]) -> EffectSummary:
    tolerance = plans[0].tolerance
    decisions = [decision for plan in plans for decision in plan.decisions if decision.name == name]
    worst = max(decisions, key=lambda decision: decision.bound.relative(tolerance))
    return EffectSummary(
        worst.name,
        sum(decision.on for decision in decisions) / len(decisions),
        max(decision.bound.range_m for decision in decisions),
        max(decision.bound.lost for decision in decisions),
        tolerance,
        worst.bound.reason,
        sum(decision.seconds for decision in decisions),
        worst.missing,
    )


def effect_notes(effects: Sequence[EffectSummary], choice: Choice) -> list[str]:
    """What was not simulated although it matters."""
    notes = [
        f"{effect.name} is not simulated ({effect.missing}): it may move ranges by up to "
        f"{MILLIMETRES * effect.range_m:.3g} mm and change {effect.lost:.2g} of the returns"
        for effect in effects
        if effect.missing is not None and effect.exceeds
    ]
    left_out = [effect.name for effect in effects if effect.exceeds and not effect.on and effect.missing is None]
    if left_out and choice != "auto":
        notes.append(f"not simulated, as requested, though beyond the tolerance: {', '.join(left_out)}")
    return notes
