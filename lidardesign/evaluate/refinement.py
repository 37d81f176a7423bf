"""Refinement (`--refine`): a design looks at training scenes, and its density learns where the error is.

`Refiner.run` is the loop of rounds. Each round tries how wide intervals should be: another level, or samples spread
further in range, because scenes that were not learned from are elsewhere; where every ray has a gate of its own, the
first one also tries gates by what rays meet in training scenes (`Gating`): a fit knows ranges by the samples around a
ray; the ray itself, traced through scenes, meets less. Then it takes the residuals of the best design so far on some
training scenes, moves the density towards them (`reweighting.Attention`), and fits again under the same constraints.
Whatever scores better on other training scenes is kept. A step that gains nothing is halved; after two rounds in a
row without a gain it ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtri

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.fit import FitResult
from lidardesign.design.layouts.density import bandwidth_limit
from lidardesign.design.layouts.gates import RayRanges, gates_within
from lidardesign.design.layouts.rays import gates_of, layout_of
from lidardesign.design.mixture.bounds import bounds_of
from lidardesign.design.sensor import DesignSpec, interval_factor
from lidardesign.errors import InfeasibleError, NumericalError
from lidardesign.evaluate.baselines.candidates import RaysPerCondition
from lidardesign.evaluate.reweighting import Attention, Reweighting
from lidardesign.evaluate.scene_scores import checked_residuals, checked_score
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Rays, Returns
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.simulate.simulate import build_casters, simulate
from lidardesign.space import RANGE, DesignSpace
from lidardesign.task import Metric, Task

# Every return stands for so many, spread about it: scenes that were not traced are elsewhere.
QUANTILES = 5
# Bandwidth alone limits the gates.
EVERYTHING = 1.0
# So many rounds in a row without a gain end it.
PATIENCE = 2
# A wider interval costs bandwidth: ten percent more of it have to bring at least one percent of the score.
SCORE_PER_BANDWIDTH = 0.1
# Levels that are tried, and how far samples are spread in range, in the density's own sigma.
LEVELS = (0.8, 0.9, 0.95, 0.98, 0.99, 0.999)
SPREADS = (0.0, 2.0, 4.0)
MILLIMETRES = 1000.0


@dataclass(frozen=True)
class Shape:
    """What refinement chooses beside where to look.

    Arguments:
        level: The share that intervals hold.
        range_spread_m: Standard deviation by which samples are spread in range [m].
        traced_gates: Whether rays get gates by what they would hear themselves on training scenes.
    """

    level: float
    range_spread_m: float = 0.0
    traced_gates: bool = False


@dataclass(frozen=True, eq=False)
class Trial:
    """A design that was fitted on the way.

    Arguments:
        result: What the fit gave.
        positions: Its rays per condition value.
        bandwidth_mbps: What these cost to read out [Mbit/s].
    """

    result: FitResult
    positions: RaysPerCondition
    bandwidth_mbps: float


# Fits a design to a reweighted density, with the same constraints.
Refit = Callable[[Reweighting | None, Shape], Trial]


@dataclass(frozen=True)
class Round:
    """What one trial brought.

    Arguments:
        number: The round, 0 is the design that it starts with.
        change: What was changed, in words.
        score: The mean score on the held-back scenes; None where the fit was refused.
        bandwidth_mbps: Of the design [Mbit/s].
        kept: Whether it is the best so far.
        seconds: What it took [s].
    """

    number: int
    change: str
    score: float | None
    bandwidth_mbps: float | None
    kept: bool
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """The keys that scripts read."""
        return {
            "round": self.number,
            "change": self.change,
            "score": self.score,
            "bandwidth_mbps": self.bandwidth_mbps,
            "kept": self.kept,
            "seconds": self.seconds,
        }


@dataclass(frozen=True, eq=False)
class Refinement:
    """The best design that was found, and how.

    Arguments:
        trial: The best design.
        reweighting: What its density was multiplied by; None where nothing was gained.
        shape: Its level and spread.
        rounds: Everything that was tried.
        looked_at, judged_on: Numbers of training scenes.
    """

    trial: Trial
    reweighting: Reweighting | None
    shape: Shape
    rounds: tuple[Round, ...]
    looked_at: int
    judged_on: int

    @property
    def start(self) -> float:
        """The score on the held-back scenes that it began with."""
        return float(self.rounds[0].score or 0.0)

    @property
    def end(self) -> float:
        """The score on the held-back scenes of the best."""
        return float([one.score for one in self.rounds if one.kept][-1] or 0.0)


@dataclass(frozen=True, eq=False)
class _State:
    """A design on the way: how it scores (lower is better), and what it was fitted to."""

    trial: Trial
    score: float
    log_factors: np.ndarray
    shape: Shape


class Refiner:
    """Refines one design.

    Arguments:
        task: A task that gives residuals.
        metric: What its scores mean.
        refit: How designs are fitted.
        look: Training scenes whose residuals move the density.
        judge: Other training scenes, which say what is kept.
        attention: Anchors over the density.
        sigma_m: The density's own spread, the unit in which samples are spread in range [m].
        spreads: Whether samples may be spread in range.
        progress: Called with everything that was tried.
    """

    def __init__(
        self,
        task: Task,
        metric: Metric,
        refit: Refit,
        look: Sequence[Scene],
        judge: Sequence[Scene],
        attention: Attention,
        *,
        sigma_m: float,
        spreads: bool = True,
        progress: Callable[[Round], None] | None = None,
    ) -> None:
        self.task, self.metric, self.refit, self.attention = task, metric, refit, attention
        self.look, self.judge = [(s, build_casters(s)) for s in look], [(s, build_casters(s)) for s in judge]
        self.spreads = tuple(sigma_m * one for one in SPREADS) if spreads else (0.0,)
        self.progress = progress
        self.sign = 1.0 if metric.better == "lower" else -1.0
        self.rounds: list[Round] = []
        self._tested: set[tuple[bytes, Shape]] = set()
        self._favoured = ""

    @phase("refinement")
    def run(self, rounds: int, shape: Shape, log_factors: np.ndarray | None = None) -> Refinement:
        """Refine a design by at most so many rounds.

        Arguments:
            rounds: At most so many.
            shape: What it starts with.
            log_factors: What the density is multiplied by at the anchors to start with, shape (K,); None is 1.

        Raises:
            InfeasibleError, ConfigError: The design that it starts with cannot be fitted.
        """
        best = self._start(shape, np.zeros(len(self.attention.points_m)) if log_factors is None else log_factors)
        step, idle, gains = 0.5, 0, None
        for number in range(1, rounds + 1):
            before = best
            if number == 1 and (len(best.trial.positions) == 1 and has_ray_gates(best.trial.result.design)):
                shape = replace(best.shape, traced_gates=True)
                best = self._try(number, "gates by traced returns", best, shape=shape)
            best = self._best_interval(number, best, "range_spread_m" if number % 2 else "level")
            gains = self._gains(best) if gains is None or best is not before else gains
            found = self._step_to_error(number, best, gains, step)
            idle = idle + 1 if found is before else 0
            if found is best:
                step /= 2
            else:
                best, gains = found, None
            if idle == PATIENCE:
                break
        return Refinement(
            best.trial,
            self._reweighting(best.log_factors),
            best.shape,
            tuple(self.rounds),
            len(self.look),
            len(self.judge),
        )

    def _reweighting(self, log_factors: np.ndarray) -> Reweighting | None:
        return self.attention.reweighting(log_factors) if np.any(log_factors) else None

    def _start(self, shape: Shape, log_factors: np.ndarray) -> _State:
        started = time.perf_counter()
        first = self.refit(self._reweighting(log_factors), shape)
        best = _State(first, self._score(first), log_factors, shape)
        self._note(started, 0, "start", self.sign * best.score, first.bandwidth_mbps, True)
        return best

    def _best_interval(self, number: int, best: _State, name: str) -> _State:
        """Wider intervals as long as they are worth it; narrower ones where the first wider one is not."""
        choices = np.array(LEVELS if name == "level" else self.spreads)
        place = int(np.argmin(np.abs(choices - getattr(best.shape, name))))
        for direction in (1, -1):
            before = best
            while 0 <= place + direction < len(choices):
                value = float(choices[place + direction])
                words = f"level {value:g}" if name == "level" else f"ranges spread by {MILLIMETRES * value:g} mm"
                found = self._try(number, words, best, shape=replace(best.shape, **{name: value}))
                if found is best:
                    break
                best, place = found, place + direction
            if best is not before:
                break
        return best

    def _gains(self, best: _State) -> dict[str, np.ndarray]:
        """Where the error of a design is, in each sense that a step may follow."""
        traced = [(scene, _returns(scene, casters, best.trial.positions)) for scene, casters in self.look]
        return self.attention.gains(
            [(checked_residuals(self.task, scene, returns), returns) for scene, returns in traced]
        )

    def _step_to_error(self, number: int, best: _State, gains: dict[str, np.ndarray], step: float) -> _State:
        """The design after a step towards its error, where that is better; what was better last goes first."""
        for name in sorted(gains, key=lambda name: name != self._favoured):
            factors = self.attention.moved(best.log_factors, gains[name], step)
            if np.any(factors - best.log_factors):
                found = self._try(number, f"towards {name}, step {step:g}", best, log_factors=factors)
                if found is not best:
                    self._favoured = name
                    return found
        return best

    def _try(self, number: int, change: str, best: _State, **changed: Any) -> _State:
        """The better of a design and a changed one; more bandwidth has to be worth it."""
        started = time.perf_counter()
        wanted = replace(best, **changed)
        key = (wanted.log_factors.tobytes(), wanted.shape)
        if key in self._tested:  # it was not better than a design that this one is no worse than
            return best
        self._tested.add(key)
        try:
            trial = self.refit(self._reweighting(wanted.log_factors), wanted.shape)
        except (InfeasibleError, NumericalError) as error:
            self._note(started, number, f"{change}: {error.message}", None, None, False)
            return best
        found = replace(wanted, trial=trial, score=self._score(trial))
        more = trial.bandwidth_mbps / best.trial.bandwidth_mbps - 1 if wanted.shape != best.shape else 0.0
        kept = found.score < best.score - SCORE_PER_BANDWIDTH * max(more, 0.0) * abs(best.score)
        self._note(started, number, change, self.sign * found.score, trial.bandwidth_mbps, kept)
        return found if kept else best

    def _score(self, trial: Trial) -> float:
        """The mean score on the held-back scenes, turned so that lower is better."""
        values = [
            checked_score(self.task, self.metric, scene, _returns(scene, casters, trial.positions)).value
            for scene, casters in self.judge
        ]
        return self.sign * float(np.mean(values))

    def _note(self, started: float, *values: Any) -> None:
        """A round of these values, in the order of `Round`, that took from `started` until now."""
        self.rounds.append(Round(*values, time.perf_counter() - started))
        if self.progress:
            self.progress(self.rounds[-1])


def _returns(scene: Scene, casters: Sequence[SceneCaster], positions: RaysPerCondition) -> list[Returns]:
    """One list of returns per condition value and frame."""
    return [frame for rays in positions for frame in simulate(scene, rays, casters=casters)]


@dataclass(frozen=True, eq=False)
class Gating:
    """How rays get gates by traced returns.

    Arguments:
        scenes: Training scenes with their casters.
        space: The design space; its ranges are what an open gate hears.
        sigma_m: Standard deviation by which returns are spread at least: the density's own [m].
    """

    scenes: Sequence[tuple[Scene, Sequence[SceneCaster]]]
    space: DesignSpace
    sigma_m: float

    @phase("gates")
    def __call__(self, design: DesignSpec, rays: Rays, spread_m: float = 0.0) -> DesignSpec:
        """The design with gates by returns, in its bandwidth budget or else in no more than it had.

        A ray without returns keeps its own gate, and all keep theirs where new ones would hold fewer returns.

        Arguments:
            design: With a gate per ray: a scan, or a table of rays.
            rays: Its own rays.
            spread_m: Standard deviation by which the design's samples are spread in range [m]; returns are, too.
        """
        ranges = self._ranges(rays, max(spread_m, self.sigma_m))
        known = np.flatnonzero(np.bincount(ranges.ray, minlength=len(rays)))
        if not len(known):
            return design
        place = np.full(len(rays), -1)
        place[known] = np.arange(len(known))
        constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
        sensors = tuple(range(len(design.sensors)))
        bounds = bounds_of(constraints.rules, self.space, sensors, interval_factor(design.level))
        model, limit = bandwidth_limit(constraints, len(rays))
        bins = model.bins(np.diff(rays.gate_m, axis=1)[:, 0])
        most = (int(bins.sum()) if limit is None else limit) - int(bins.sum() - bins[known].sum())
        own = RayRanges(ranges.range_m, ranges.weights, place[ranges.ray], len(known))
        gates = rays.gate_m.copy()
        gates[known] = gates_within(own, bounds.take(rays.sensor[known]), EVERYTHING, model, most)
        too_wide = int(model.bins(gates[:, 1] - gates[:, 0])[known].sum()) > most
        if too_wide or ranges.held_by(gates) < ranges.held_by(rays.gate_m):
            return design
        return _with_gates(design, gates)

    def _ranges(self, rays: Rays, spread_m: float) -> RayRanges:
        """The targets that rays meet with open gates, over all scenes and their frames."""
        low, high = self.space.low[RANGE], self.space.high[RANGE]
        open_rays = replace(rays, gate_m=np.tile([low, high], (len(rays), 1)))
        ranges, indices = [], []
        for scene, casters in self.scenes:
            is_target = np.array([*(body.is_target for body in scene.bodies), False])
            for frame in simulate(scene, open_rays, casters=casters):
                hit = np.flatnonzero(frame.returned & is_target[frame.body])
                ranges.append(frame.range_m[hit])
                indices.append(hit)
        offsets = spread_m * ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES)
        spread = np.clip(np.concatenate(ranges)[:, None] + offsets, low, high).reshape(-1)
        return RayRanges(spread, np.ones(len(spread)), np.repeat(np.concatenate(indices), QUANTILES), len(rays))


def has_ray_gates(design: DesignSpec) -> bool:
    """Whether every ray of a design has a gate of its own, which does not move along a track."""
    if design.track is not None:
        return False
    return layout_of(design).one_sensor_per_ray or (design.ray_table is not None and gates_of(design) == "ray")


def _with_gates(design: DesignSpec, gates: np.ndarray) -> DesignSpec:
    if design.ray_table is not None and not layout_of(design).one_sensor_per_ray:
        return replace(design, ray_table=replace(design.ray_table, gate_m=gates))
    width = 2 * interval_factor(design.level)
    beams = [
        replace(sensor, range_m=float(gate.mean()), spread_range_m=float(gate[1] - gate[0]) / width)
        for sensor, gate in zip(design.sensors, gates, strict=True)
    ]
    return replace(design, sensors=tuple(beams))
