"""The rows of an evaluation: the rays of every design and baseline, at equal rays and at equal bandwidth.

Baselines are built from training scenes alone. Designs are compared with the strongest of them there. The
effects of all rows, with their reasons, are summed up over scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from lidardesign.evaluation.request import EvaluationRequest, numbers_fired
from lidardesign.methods.cma import SearchRecord
from lidardesign.rays.training_scenes import HELD_BACK
from lidardesign.run.clock import phase
from lidardesign.scoring.fired import ONE_DEVICE, Devices, Positions, assign_devices, fired
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.detector.physics import EFFECTS
from lidardesign.simulate.plan import Choice, EffectPlan, Tolerance

# The strongest baseline is found on training scenes that no baseline's rays were chosen on: picking the best
# of several by their scores on held-out scenes would favour a lucky one.
MOST_BASELINE_SCENES = 20
FEWEST_BASELINE_SCENES = 5
LARGEST_BASELINE_SHARE = 0.1  # of the rays that an evaluation fires may be fired to find it
MILLIMETRES = 1000.0
SINGLE = "-single"  # ends the name of the best single pattern of a design whose patterns follow what they see


@dataclass(frozen=True, eq=False)
class Entry:
    """A row of an evaluation before it is scored.

    Arguments:
        name: The design's or baseline's.
        positions: The rays per condition value.
        baseline: Whether it is a baseline.
        redraw: Gives the rays of a scene, for layouts drawn anew in each.
        matched_to, matched_rays: The design and its number of rays whose bandwidth this baseline was given.
        search: The record of a direct search for its rays.
        devices: Devices of a baseline, those of the design that it stands beside.
    """

    name: str
    positions: Positions
    baseline: bool
    redraw: Callable[[int], Positions] | None = None
    matched_to: str | None = None
    matched_rays: int | None = None
    search: SearchRecord | None = None
    devices: Devices = ONE_DEVICE

    @property
    def rays(self) -> int:
        """Rays per condition value."""
        return len(self.positions[0])

    @property
    def gates(self) -> int:
        """Different gates of its sensors, at the condition value where they are most."""
        return max(len(np.unique(np.column_stack([rays.sensor, rays.gate_m]), axis=0)) for rays in self.positions)

    def mbps(self, bandwidth: Bandwidth) -> float:
        """The bandwidth of its rays, averaged over condition values [Mbit/s]."""
        return mean_mbps(self.positions, bandwidth)

    def rays_in(self, scene: int) -> Positions:
        """The rays that it fires in a held-out scene."""
        return self.positions if self.redraw is None else self.redraw(scene)

    def lit_in(self, scene: int) -> Positions:
        """The rays that it fires in a held-out scene, each with its device's light."""
        return assign_devices(self.rays_in(scene), self.devices)

    @cached_property
    def key(self) -> tuple[Any, ...]:
        """A key that is equal for entries that fire the same rays."""
        if not self.baseline:
            return ("design", self.name, self.rays)
        arrays = (array for rays in self.positions for array in (rays.origin_m, rays.direction, rays.gate_m))
        return (self.name, self.devices, *(array.tobytes() for array in arrays))


@phase("rays")
def design_entries(request: EvaluationRequest, counts: Sequence[int]) -> list[Entry]:
    """The entries of designs at those numbers of rays that they can fire.

    Raises:
        ConfigError: The rays of a design end before where it is evaluated.
    """
    return [
        entry
        for design in request.designs
        for count in numbers_fired(design, counts, request.alone)
        for entry in _of_design(request, design, count)
    ]


def _of_design(request: EvaluationRequest, design: DesignSpec, count: int) -> list[Entry]:
    """The entry of a design; where its patterns follow what they see, with the best single one beside it."""
    rays_of = partial(fired, design, count, request.conditions, request.planner)
    fixed = Entry(design.name, rays_of(), baseline=False)
    if design.following(count) is None:
        return [fixed]
    return [replace(fixed, positions=rays_of(request.task)), replace(fixed, name=f"{design.name}{SINGLE}")]


@phase("strongest baseline")
def strongest_baseline(request: EvaluationRequest, entries: Sequence[Entry], rays: int) -> StrongestBaseline | None:
    """The best of all baselines at a number of rays, under the effects of the evaluation; None without baselines.

    Arguments:
        request: The evaluation.
        entries: All its entries.
        rays: The number of rays.
    """
    baselines = [entry for entry in entries if entry.baseline and entry.matched_to is None and entry.rays == rays]
    if not baselines or not request.train:
        return None
    in_all = sum(entry.rays for entry in entries) * len(request.test)
    affordable = int(LARGEST_BASELINE_SHARE * in_all / (rays * len(baselines)))
    # the first ones where a request has no others
    held_back = request.train if request.training is None else request.training.scenes(HELD_BACK)
    count = min(max(affordable, FEWEST_BASELINE_SCENES), MOST_BASELINE_SCENES)
    scorer = request.scorer(held_back)
    numbers = range(len(scorer.scenes(count)))
    scores = [scorer.scores_in(number, [entry.lit_in(number) for entry in baselines]) for number in numbers]
    values = dict(zip((entry.name for entry in baselines), np.mean(scores, axis=0).tolist(), strict=True))
    return StrongestBaseline.best_of(values, request.metric.better, rays, len(numbers))


@dataclass(frozen=True)
class StrongestBaseline:
    """The best of all baselines at one number of rays.

    Arguments:
        name: Its name.
        rays: Rays per frame.
        scenes: The number of training scenes that it was found on.
        values: The mean score of every baseline on them.
    """

    name: str
    rays: int
    scenes: int
    values: Mapping[str, float]

    @classmethod
    def best_of(cls, values: Mapping[str, float], better: str, rays: int, scenes: int) -> StrongestBaseline:
        """The best of mean scores by name; the first of equal ones."""
        choose = min if better == "lower" else max
        return cls(choose(values, key=lambda name: values[name]), rays, scenes, dict(values))


def mean_baseline(found: Iterable[StrongestBaseline | None], better: str) -> StrongestBaseline | None:
    """The strongest baseline of several seeds, by its mean score over them; None where one seed has none."""
    each = list(found)
    known = [one for one in each if one is not None]
    if not known or len(known) < len(each):
        return None
    names = [name for name in known[0].values if all(name in one.values for one in known)]
    values = {name: float(np.mean([one.values[name] for one in known])) for name in names}
    return StrongestBaseline.best_of(values, better, known[0].rays, sum(one.scenes for one in known))


def effect_summaries(plans: Sequence[EffectPlan]) -> list[EffectSummary]:
    """A summary per effect, in the order of the simulation."""
    tolerance, summaries = plans[0].tolerance, []
    for name in EFFECTS:
        decisions = [decision for plan in plans for decision in plan.decisions if decision.name == name]
        worst = max(decisions, key=lambda decision: decision.bound.relative(tolerance))
        summaries.append(
            EffectSummary(
                worst.name,
                sum(decision.on for decision in decisions) / len(decisions),
                max(decision.bound.range_m for decision in decisions),
                max(decision.bound.lost for decision in decisions),
                tolerance,
                worst.bound.reason,
                sum(decision.seconds for decision in decisions),
                worst.missing,
            )
        )
    return summaries


@dataclass(frozen=True)
class EffectSummary:
    """An effect over all scenes.

    Arguments:
        name: Of the effect.
        scenes_on: The share of scenes in which it was simulated.
        range_m: Its largest bound on ranges, in any scene [m].
        lost: Its largest bound on the share of returns.
        tolerance: Of all skipped effects together.
        reason: The reason, in the scene where it could change most.
        seconds: Predicted time to simulate it in all scenes [s].
        missing: A missing requirement of its simulation.
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
        """True where it was simulated in any scene."""
        return self.scenes_on > 0

    @property
    def exceeds(self) -> bool:
        """True where its bound exceeds the tolerance."""
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


def effect_notes(effects: Sequence[EffectSummary], choice: Choice) -> list[str]:
    """Lines on effects that were not simulated although they matter."""
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
