"""Choice of the effects to simulate for a scene, a detector and lists of rays, from bounds of each effect.

Each effect's `bound` (`simulate.effects`) is an upper bound of its change. The smallest are skipped while their sum
stays within a tolerance: errors of range add up in the worst case, and so do shares of returns. The tolerance holds for
reported returns, with rounding and photon noise, ray by ray with the same random numbers (`add_quantisation_bounds`;
benchmarks/soak/promise.py tests it). Effects that are absent from a scene are ruled out without casting a ray.

The time of an effect is predicted per ray and frame, as measured on one core (2.5 GHz) with a face of 20,000 triangles,
some hundred photons per ray and a gate of 1 m, each effect added to photon noise alone. Elsewhere the relation between
effects holds roughly; full sunlight and wide gates take several times as much.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import SQUARABLE, safe_divide
from lidardesign.run.clock import phase
from lidardesign.run.validation import suggest
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Rays, path_windows
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.physics import (
    COUNTED,
    EFFECTS,
    IDEAL,
    Detector,
    Physics,
    check_effects,
    check_windows,
)
from lidardesign.simulate.effects import (
    ambient,
    atmosphere,
    footprint,
    jitter,
    motion,
    multipath,
    photon_noise,
    pile_up,
    quantisation,
    shadowing,
    specular,
)
from lidardesign.simulate.effects.expected_counts import Blindness, Counts, variance_of_missing
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits
from lidardesign.simulate.light_transport import transport
from lidardesign.simulate.returns import build_casters
from lidardesign.task import Metric

# Per further sub-ray of a beam [s].
SUB_RAY_SECONDS = 3e-7
# Per ray, with any detector [s]; multipath light is rendered by another program.
LIGHT_SECONDS = {"motion": 4e-7, "specular": 1.8e-6, "shadowing": 1e-6, "multipath": 3e-3}
# Per ray, where photons are counted [s].
PHOTON_SECONDS = {"photon_noise": 2e-6, "jitter": 3e-7, "ambient": 4e-7, "pile_up": 5e-6, "atmosphere": 3.5e-6}
ROUNDING_SECONDS = 1e-7
EFFECT_MODULES = {
    "footprint": footprint,
    "motion": motion,
    "specular": specular,
    "multipath": multipath,
    "shadowing": shadowing,
    "atmosphere": atmosphere,
    "photon_noise": photon_noise,
    "jitter": jitter,
    "ambient": ambient,
    "pile_up": pile_up,
    "quantisation": quantisation,
}
# Words that choose effects, instead of names.
CHOICES = ("auto", "all", "none")
Choice = Literal["auto", "all", "none"] | frozenset[str]
# Tolerated range error as a share of a bin, or without bins [m].
TOLERATED_BIN_SHARE, TOLERATED_RANGE_M = 0.1, 0.001
TOLERATED_RETURNS = 0.001  # a share of them
# Units of metrics that are lengths [m].
LENGTHS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
# Words that `--effects` accepts besides names; the audit is not a choice of effects.
WORDS = (*CHOICES, "audit")
# Most frames of a moving scene that bounds are averaged over, evenly spread.
MOST_FRAMES = 16
# Where these are on, a ray may have several echoes.
SEVERAL_ECHOES = frozenset({"footprint", "specular", "multipath"})
# Effects whose bounds depend on first hits alone, behind mirrors and glass too.
OF_FIRST_HITS = ("specular", "multipath", "shadowing")
# Probability that a shift passes an edge, per shift over distance, with other shifts of unknown size.
PASSED_SHARE = 0.2
# Edges further than this many standard deviations of all shifts are not passed.
EDGE_REACH = 4.0
# Effects that decide whether a return near the detection threshold is reported.
OF_BARE_LIGHT = {"photon_noise", "jitter", "quantisation"}
# Effects by which rays hit other surfaces than their first hits.
ELSEWHERE = {"footprint", "motion"}


def predicted_seconds(effect: str, detector: Detector, rays: int) -> float:
    """Predicted time of simulating an effect for this many rays over all frames [s]."""
    if effect == "footprint":
        return rays * (detector.footprint_rays - 1) * SUB_RAY_SECONDS
    known = LIGHT_SECONDS if detector.photons is None else LIGHT_SECONDS | PHOTON_SECONDS
    return rays * known.get(effect, ROUNDING_SECONDS)


@dataclass(frozen=True)
class Tolerance:
    """Tolerated change by all skipped effects together.

    Arguments:
        range_m: Rms error of reported ranges over returns [m].
        lost: Share of returns that are lost, invented or taken from somewhere else.

    Raises:
        ConfigError: A value that is not above 0, or not finite.
    """

    range_m: float
    lost: float = TOLERATED_RETURNS

    def __post_init__(self) -> None:
        for name, value in (("of ranges", self.range_m), ("of returns", self.lost)):
            if not math.isfinite(value) or value <= 0:
                raise ConfigError(f"a tolerance {name} of {value:g}", where="effects", allowed="finite, above 0")

    @classmethod
    def of(cls, detector: Detector) -> Tolerance:
        """Default tolerance of a detector: a tenth of a bin, or 1 mm without bins, and a thousandth of the returns."""
        return cls(TOLERATED_RANGE_M if detector.bin_m is None else TOLERATED_BIN_SHARE * detector.bin_m)

    def within(self, metric: Metric) -> Tolerance:
        """This tolerance with the range error limited to the tolerance of a metric that is a length."""
        limit_m = metric.tolerance * LENGTHS_M.get(metric.unit, math.inf)
        return replace(self, range_m=min(self.range_m, limit_m)) if limit_m > 0 else self


@dataclass(frozen=True)
class Bound:
    """Upper bound of an effect in the list of rays that it changes most.

    Arguments:
        range_m: Error of range, rms over returns [m].
        lost: Share of returns that are lost, invented or taken from somewhere else, at most 1.
        reason: Why, in one line.
    """

    range_m: float
    lost: float
    reason: str

    def relative(self, tolerance: Tolerance) -> float:
        """The bound in units of the tolerance, the larger of range error and lost share."""
        return max(self.range_m / tolerance.range_m, self.lost / tolerance.lost)


@dataclass(frozen=True)
class Decision:
    """An effect in a plan.

    Arguments:
        name: Name of the effect, out of `EFFECTS`.
        on: Whether it is simulated.
        bound: Upper bound of its effect.
        seconds: Predicted time of simulating it on a typical core [s].
        missing: Missing requirement of its simulation; None: nothing is missing.
    """

    name: str
    on: bool
    bound: Bound
    seconds: float
    missing: str | None = None


@dataclass(frozen=True)
class EffectPlan:
    """Effects to simulate in a scene, the same for all lists of rays.

    Arguments:
        decisions: One per effect, in the order in which light meets them.
        tolerance: Tolerance of the skipped effects.
    """

    decisions: tuple[Decision, ...]
    tolerance: Tolerance

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects to simulate."""
        return frozenset(decision.name for decision in self.decisions if decision.on)


@dataclass(frozen=True)
class Planner:
    """Rule by which effects are chosen.

    Arguments:
        detector: The detector.
        choice: `auto` takes the effects above the tolerance, `all` those that the detector and this machine support,
            `none` nothing; names are taken as they are.
        tolerance: Tolerance of the effects that `auto` skips; None: `Tolerance.of` the detector.

    Raises:
        ConfigError: An unknown effect among names; all are listed.
    """

    detector: Detector = IDEAL
    choice: Choice = "auto"
    tolerance: Tolerance | None = None

    def __post_init__(self) -> None:
        if self.choice not in CHOICES:
            check_effects(self.choice)

    @property
    def tolerated(self) -> Tolerance:
        """Tolerance of the effects that `auto` skips."""
        return self.tolerance or Tolerance.of(self.detector)

    @phase("planning")
    def plan(self, scene: Scene, lists: Sequence[Rays], casters: Sequence[SceneCaster] | None = None) -> EffectPlan:
        """Choose the effects to simulate for lists of rays in a scene.

        Arguments:
            scene: The scene.
            lists: Lists of rays; the one that changes most decides.
            casters: One per frame; None builds them where a ray has to be cast.

        Raises:
            ConfigError: An effect that was named cannot be simulated here, or a gate lies outside the histogram.
        """
        for rays in lists:
            check_windows(path_windows(rays, scene.receiver), self.detector)
        found = _bounds(scene, lists, self.detector, casters)
        count = sum(len(rays) for rays in lists) * scene.frames
        if self.choice == "auto":
            wanted = _called_for(found, self.tolerated)
            if self.detector.photons is not None and wanted & SEVERAL_ECHOES and not wanted & COUNTED:
                # counted echoes mix in another way than uncounted ones
                wanted.add(max(COUNTED, key=lambda name: (found[name].relative(self.tolerated), name)))
        elif self.choice == "all":
            wanted = frozenset(EFFECTS) - ({"motion"} if motion.is_instant(self.detector) else set())
        else:
            wanted = frozenset() if self.choice == "none" else self.choice
        missing = {name: transport.missing() if name == "multipath" else None for name in sorted(wanted)}
        for name, reason in missing.items():
            if reason is not None and isinstance(self.choice, frozenset):
                raise ConfigError(f"{name} cannot be simulated here: {reason}", where="--effects", hint="leave it out")
        on = {name for name, reason in missing.items() if reason is None}
        decisions = (
            Decision(name, name in on, found[name], predicted_seconds(name, self.detector, count), missing.get(name))
            for name in EFFECTS
        )
        return EffectPlan(tuple(decisions), self.tolerated)

    def physics(self, plan: EffectPlan, seed: int) -> Physics | None:
        """`Physics` of a plan for `simulate`; None without effects."""
        return Physics(self.detector, plan.effects, seed) if plan.effects else None


def parse_effects(text: str) -> Choice:
    """Parse `auto`, `all`, `none`, or names of effects between commas.

    Raises:
        ConfigError: An unknown effect; all are listed.
    """
    names = [name.strip() for name in text.split(",")]
    if names[0] in CHOICES and len(names) == 1:
        return names[0]  # type: ignore[return-value]
    for name in names:
        if name not in EFFECTS:
            raise ConfigError(
                f"unknown effect {name!r}",
                where="--effects",
                allowed=f"one of {', '.join(WORDS)} alone, or any of {', '.join(EFFECTS)}",
                hint=None if name in WORDS else suggest(name.lower(), [*EFFECTS, *WORDS]),
            )
    return frozenset(names)


def _called_for(found: dict[str, Bound], tolerance: Tolerance) -> set[str]:
    """Names of the effects that remain after skipping the smallest while their sum is within the tolerance."""
    on = set()
    range_m = lost = 0.0
    for name in sorted(found, key=lambda name: found[name].relative(tolerance)):
        bound = found[name]
        if range_m + bound.range_m > tolerance.range_m or lost + bound.lost > tolerance.lost:
            on.add(name)
        else:
            range_m, lost = range_m + bound.range_m, lost + bound.lost
    return on


def _bounds(
    scene: Scene, lists: Sequence[Rays], detector: Detector, casters: Sequence[SceneCaster] | None
) -> dict[str, Bound]:
    """Bound of every effect over evenly spread frames, for the list that it changes most."""
    absent = {name: EFFECT_MODULES[name].why_absent(detector, scene, lists) for name in EFFECTS}
    present = [name for name, reason in absent.items() if reason is None]
    found = {name: Bound(0.0, 0.0, reason) for name, reason in absent.items() if reason is not None}
    if not present:
        return found
    fired = [rays for rays in lists if len(rays)]
    if not fired:
        return found | {name: Bound(0.0, 0.0, "no ray is fired") for name in present}
    sums = {name: _BoundSum(len(fired)) for name in present}
    casters = build_casters(scene) if casters is None else casters
    # all frames, or the middles of equal shares of time
    most = min(scene.frames, MOST_FRAMES)
    for frame in (int((i + 0.5) * scene.frames / most) for i in range(most)):
        counts = Counts(FirstHits.of(scene, frame, detector, fired, casters[frame]))
        for name, bound in _frame_bounds(counts, present).items():
            sums[name].add(counts.first_hits, bound)
    return found | {name: total.bound() for name, total in sums.items()}


def _frame_bounds(counts: Counts, present: Sequence[str]) -> dict[str, EffectBound]:
    """Bound of each effect in a frame; rays whose first hit is on mirrors or glass count as lost."""
    bounds = {name: EFFECT_MODULES[name].bound(counts.first_hits, counts) for name in present}
    # errors of half path become errors of range with a bistatic receiver
    stretched = 1 / counts.first_hits.path_per_range**2
    bounds = {
        name: replace(bound, squared_m2=bound.squared_m2 * stretched)
        for name, bound in add_quantisation_bounds(counts, bounds).items()
    }
    led = bounds["specular"].lost if "specular" in bounds else np.zeros(0)
    if not led.any():
        return bounds
    return {
        name: bound
        if name in OF_FIRST_HITS
        else replace(
            bound, lost=np.maximum(bound.lost, led), reason=f"{bound.reason}; unknown behind mirrors and glass"
        )
        for name, bound in bounds.items()
    }


class _BoundSum:
    """Sums of an effect's bounds over frames, list by list."""

    def __init__(self, lists: int) -> None:
        self._squared_m2, self._lost, self._returns = np.zeros(lists), np.zeros(lists), np.zeros(lists)
        self._unseen_m2, self._rays = np.zeros(lists), np.zeros(lists)
        self._reason, self._largest = "", -1.0

    def add(self, first_hits: FirstHits, bound: EffectBound) -> None:
        def per_list(values: np.ndarray) -> np.ndarray:
            return np.bincount(first_hits.row, weights=values, minlength=len(self._lost))

        squared, lost = per_list(bound.squared_m2 * first_hits.returned), per_list(bound.lost)
        self._unseen_m2 += per_list(bound.squared_m2)
        self._rays += per_list(np.ones(len(first_hits)))
        self._squared_m2 += squared
        self._lost += lost
        self._returns += per_list(first_hits.returned.astype(float))
        if float(squared.max() + lost.max()) > self._largest:
            self._largest, self._reason = float(squared.max() + lost.max()), bound.reason

    def bound(self) -> Bound:
        # without a single return, false returns of any ray count
        returns = np.maximum(self._returns, 1.0)
        squared_m2 = np.where(self._returns > 0, self._squared_m2 / returns, self._unseen_m2 / self._rays)
        lost = np.minimum(self._lost / returns, 1.0)
        return Bound(float(np.sqrt(squared_m2.max())), float(lost.max()), self._reason)


def add_quantisation_bounds(counts: Counts, bounds: dict[str, EffectBound]) -> dict[str, EffectBound]:
    """Bounds of reported returns, with quantisation and photon noise, from bounds of the light; names to bounds.

    After rounding, a small shift moves a range by a whole bin, or not at all. An edge that is nearer than the shift s
    is passed; beyond, at the distance d, with P(shift > d), taken as normal. Other effects shift ranges relative to
    that edge too: with their scale t, unknown but at most as bounded, the density at the edge is at most
    max over t of phi(d / t) / t = 0.24 / d, and the mean shift 0.8 s, so that it is passed with at most 0.2 s / d. The
    matched filter averages: its edges are as wide as a pulse, its steps lower, and each of n photons passes edges by
    itself.

    A photon that changes bins, which one of n does with at most n s / bin, may make another bin the highest and change
    the photons that dead time hides: the range errs once more, at random. Multipath is left out of this: it takes a
    thousand times as long as other effects, and gives another equally likely outcome.
    """
    detector = counts.first_hits.detector
    if not detector.bin_m and detector.photons is None:
        return bounds
    moving = {name: np.sqrt(bound.squared_m2) for name, bound in bounds.items() if name != "quantisation"}
    changed = dict(bounds)
    chance = None if detector.photons is None else _bound_of_chance(counts)
    for name, shift_m in moving.items():
        squared_m2, lost = bounds[name].squared_m2, bounds[name].lost
        if detector.bin_m:
            others_m = sum((moving[other] for other in moving.keys() - {name}), np.zeros(len(shift_m)))
            squared_m2 = squared_m2 + _steps_m2(counts, shift_m, others_m)
        if chance is not None and name != "multipath":
            share = np.minimum(counts.in_air * shift_m / counts.bin_m, 1.0)
            squared_m2, lost = squared_m2 + share * chance.squared_m2, np.minimum(lost + share * chance.lost, 1.0)
        changed[name] = replace(bounds[name], squared_m2=squared_m2, lost=lost)
    if chance is not None:
        # the light from surfaces that a wide beam or a later ray hits is not known: it may be at the threshold
        for name, other in itertools.product(OF_BARE_LIGHT & bounds.keys(), ELSEWHERE & bounds.keys()):
            changed[name] = replace(changed[name], lost=np.maximum(changed[name].lost, bounds[other].lost))
    return changed


def _bound_of_chance(counts: Counts) -> EffectBound:
    """Bound of the difference between two draws of photons."""
    sigma_m, blind = counts.first_hits.sigma_m(), Blindness.of(counts)
    if counts.first_hits.detector.estimator == "peak":
        variance_m2 = counts.error_m(blind.left, sigma_m) ** 2
    else:
        variance_m2 = variance_of_missing(counts, counts.in_air, blind.left, sigma_m)
    return EffectBound(2 * variance_m2, counts.false_return_probability(blind, sigma_m), "other photons are drawn")


def _steps_m2(counts: Counts, shift_m: np.ndarray, others_m: np.ndarray) -> np.ndarray:
    """Mean squared step over edges of bins by a shift (N,) with other shifts up to (N,) [m], shape (N,) [m^2]."""
    first_hits, bin_m, alone_m2 = counts.first_hits, counts.bin_m, 0.0
    if first_hits.detector.photons is not None and first_hits.detector.estimator == "matched":
        others_m = others_m + first_hits.sigma_m()
        alone_m2 = bin_m * shift_m / np.maximum(counts.in_air, 1.0)
    edge_m = np.maximum(first_hits.bin_edge_m, SQUARABLE)
    return _passed(shift_m, others_m, edge_m) * first_hits.step_m**2 + alone_m2


def _passed(shift_m: np.ndarray, others_m: np.ndarray, edge_m: np.ndarray) -> np.ndarray:
    """Probability that a shift (N,) passes an edge at a distance (N,), with other shifts up to (N,) [m], shape (N,)."""
    from scipy.special import ndtr

    ratio = shift_m / edge_m
    within = (others_m > 0) & (edge_m <= EDGE_REACH * (shift_m + others_m))
    beyond = ndtr(-safe_divide(1.0, ratio, math.inf)) + PASSED_SHARE * ratio * within
    return np.where(ratio >= 1, 1.0, np.minimum(beyond, 1.0))
