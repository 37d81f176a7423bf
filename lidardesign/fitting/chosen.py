"""Rays that are chosen on training scenes for fitted sensors: the second to the fifth step from a density to rays.

The density proposes rays inside the sensors, training scenes that it was not learned from give their information, and
a set of rays with the most information is chosen. Fields of view and gates then shrink to the chosen rays. Along a
condition, as a robot's position, rays are chosen at each of its values that designs are scored at, and form a pattern.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from lidardesign.constraints.document import SensorRules, rules_of
from lidardesign.errors import check_number
from lidardesign.fitting.request import FitRequest
from lidardesign.mixture.bounds import INWARD, bounds_of
from lidardesign.mixture.fit import FittedSensors
from lidardesign.numerics import COARSE_SLACK
from lidardesign.rays.gates import admitted_choices
from lidardesign.rays.information import FEW_SCENES, MOST_SELECTED, features_of
from lidardesign.rays.pool import CandidatePool, cached_information
from lidardesign.rays.proposals import (
    CANDIDATES_PER_RAY,
    LEAST_CANDIDATES_OF_REGIONS,
    Proposals,
    first_candidates,
    owners,
    rays_of_points,
)
from lidardesign.rays.selection import Selected, Selection, inform_enough, select
from lidardesign.rays.training_scenes import CHOICE, HELD_BACK, SceneInformation, TrainingScenes
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.adaptive import AdaptivePatterns
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.pattern import Pattern
from lidardesign.sensors.sensor import CENTRING_ROUNDS, Sensor, centred_boresight, interval_factor
from lidardesign.space import (
    AZIMUTH,
    DIMENSIONS,
    ELEVATION,
    RANGE,
    DesignSpace,
    aim,
    direction,
    observed_point,
)
from lidardesign.task import random_generator

# Fields hold their outermost rays, whatever digits of angles a file rounds.
FIELD_SLACK = COARSE_SLACK / 10


class ChosenRays(NamedTuple):
    """Sensors with the rays that were chosen for them.

    Arguments:
        sensors: With fields of view and gates no larger than their rays need.
        patterns: One for each number of rays, ascending.
        certificates: Of the numbers of rays that were certified.
        silent: The share of scenes held back about which the largest number of rays has no information.
        shared: The share of what sensors see that several of them see; 1 where none may fail.
        adaptive: Patterns that follow what they see; None where they are not asked for, or bring nothing.
    """

    sensors: tuple[Sensor, ...]
    patterns: tuple[Pattern, ...]
    certificates: tuple[dict[str, object], ...]
    silent: float
    shared: float = 1.0
    adaptive: AdaptivePatterns | None = None


def choose_rays(
    request: FitRequest,
    training: TrainingScenes,
    samples: Samples,
    fitted: FittedSensors,
    *,
    pool: CandidatePool | None,
    certified: Sequence[int] = (),
    each_fires: bool = False,
    is_trial: bool = False,
    progress: Callable[[str], None] = lambda step: None,
) -> ChosenRays:
    """The rays of fitted sensors, one choice for each number of rays.

    Arguments:
        request: What is asked for: numbers of rays, constraints, gates, and how many patterns follow what they see.
        training: Training scenes of the run.
        samples: Of the density, at all values of its condition.
        fitted: The sensors.
        pool: The pool of candidates at their place; None casts candidates anew.
        certified: The numbers of rays for which a bound is found.
        each_fires: Whether every sensor has to fire a ray.
        is_trial: Whether the first few scenes are enough where candidates are cast anew, and one pattern.
        progress: Called with every step.

    Raises:
        ConfigError: More rays than can be chosen.
        InfeasibleError: No ray inside the sensors has information about the training scenes, or no choice of so many
            rays fits within the bandwidth.
    """
    constraints, counts, level, gates = request.constraints, request.counts, request.level, request.gates
    check_number(counts[-1], "--rays", 1, MOST_SELECTED)
    budget, conditions = constraints.budget, training.run.conditions(samples.space)
    placed, may_fail = fitted.sensors, bool(constraints.survive)
    if may_fail:
        placed = share_fields(placed, constraints.rules, level, samples)
    proposals = Proposals(placed, constraints.rules, level, samples, by_turns=may_fail)
    in_regions = any(sensor.origin_covariance_m2 is not None for sensor in placed)
    wanted = max(CANDIDATES_PER_RAY * counts[-1], LEAST_CANDIDATES_OF_REGIONS if in_regions else 0)
    weights = np.array([sensor.weight for sensor in placed])
    least = np.full(len(weights), CANDIDATES_PER_RAY if each_fires else 0)
    if len(conditions) > 1:
        # so that patterns along a condition fire as many rays of each sensor everywhere
        least = np.maximum(least, split_budget(weights, counts[-1], each=each_fires))
    picked = None if pool is None else _candidates_from_pool(pool, proposals, conditions, wanted, least)
    lists = picked[0] if picked else _draw_candidates(proposals, conditions, wanted, least, training.seed)
    ends = np.cumsum([0, *map(len, lists)]).tolist()
    admitted = partial(
        admitted_choices,
        sensors=placed,
        rules=constraints.rules,
        level=level,
        space=samples.space,
        margin_m=training.margin_m,
        is_shared=gates != "ray",
    )
    selection = Selection(
        rays=Rays.joined(lists),
        visits=[slice(*pair) for pair in itertools.pairwise(ends)],
        gates=admitted,
        bandwidth=budget.readout,
        limit_mbps=np.inf if budget.bandwidth_mbps is None else budget.bandwidth_mbps,
        shares=weights if len(lists) > 1 else None,
        is_shared=gates != "ray",
        each_fires=each_fires,
        may_fail=may_fail,
    )
    if picked:
        informed, held_back = picked[1:]
    elif is_trial:
        informed = training.inform(CHOICE, selection.rays, selection.visits, 0, FEW_SCENES)
        held_back = informed  # not used in trials
    else:
        # too few of a pool are inside the sensors: the run goes on keeping the pool
        inform = cached_information if pool is None and training.keeps else inform_enough
        informed, held_back = inform(selection, training, counts[len(counts) // 2], progress)
    selected = select(selection, informed, held_back, counts, certified, progress)
    is_adaptive = request.adaptive > 1 and not is_trial
    adaptive = _adaptive(selection, selected[-1], training, request.adaptive, progress) if is_adaptive else None
    patterns = tuple(_pattern(one, conditions, samples) for one in selected)
    every = (*patterns, *(() if adaptive is None else adaptive.patterns))
    per_sensor = patterns[-1].per_sensor(len(placed))
    sensors = tuple(
        _around_rays(sensor, index, every, rules_of(constraints.rules, index), samples)
        for index, sensor in enumerate(placed)
    )
    shares = per_sensor / per_sensor.sum()
    return ChosenRays(
        tuple(replace(sensor, weight=float(share)) for sensor, share in zip(sensors, shares, strict=True)),
        patterns,
        tuple(one.certificate for one in selected if one.certificate is not None),
        selected[-1].silent,
        proposals.share_of_several(conditions[len(conditions) // 2]) if may_fail else 1.0,
        adaptive,
    )


def _adaptive(
    selection: Selection,
    selected: Selected,
    training: TrainingScenes,
    most: int,
    progress: Callable[[str], None],
) -> AdaptivePatterns | None:
    """Patterns that follow what they see, of the candidates and gates of a choice."""
    from lidardesign.rays.adaptive import PatternSearch, training_frames

    rays, features = selection.rays, features_of(training.run.task)
    if features is not None and training.first(HELD_BACK)[0].frames == 1:
        features = None
    frames, held_back = (
        training_frames(training, purpose, rays, selection.share, features) for purpose in (CHOICE, HELD_BACK)
    )
    search = PatternSearch(selection, selected.gates_m, selected.choice, frames, held_back, training.seed)
    found = search.best(most, progress)
    if found is None:
        return None
    patterns = []
    for number, gate in enumerate(found.gates):
        rows = found.rows(number, rays.sensor)
        fired = replace(rays.subset(rows), gate_m=search.gate_m(gate)[rows])
        patterns.append(Pattern.of(fired.as_angles()))
    return AdaptivePatterns(found.rule, tuple(patterns), found.shares)


@phase("candidates")
def _draw_candidates(
    proposals: Proposals, conditions: Sequence[dict[str, float]], count: int, least: np.ndarray, seed: int
) -> list[Rays]:
    return [
        proposals.draw(count, at, random_generator(seed, "candidates", number), least)
        for number, at in enumerate(conditions)
    ]


@phase("candidates")
def _candidates_from_pool(
    pool: CandidatePool, proposals: Proposals, conditions: Sequence[dict[str, float]], count: int, least: np.ndarray
) -> tuple[list[Rays], list[SceneInformation], list[SceneInformation]] | None:
    """The first `count` rays of a pool inside the sensors per condition, with their information; None if too few."""
    number, known, lists = np.full(len(pool.points), -1), 0, []
    for visit, at in zip(pool.visits, conditions, strict=True):
        sensors, points = proposals.sensors_at(at), pool.points[visit]
        space = proposals.samples.space.at(at)
        owner, fired = owners(sensors, proposals.rules, proposals.level, points, space, by_turns=proposals.by_turns)
        inside = np.flatnonzero(owner >= 0)
        chosen = inside[first_candidates(owner[inside], count, least)]
        if len(chosen) < count or (np.bincount(owner[chosen], minlength=len(least)) < least).any():
            return None
        number[visit.start + chosen] = known + np.arange(len(chosen))
        known += len(chosen)
        lists.append(rays_of_points(fired[chosen], owner[chosen], sensors))
    informed, held_back = ([scene.of_rays(number) for scene in part] for part in (pool.informed, pool.held_back))
    return lists, informed, held_back


def _pattern(selected: Selected, conditions: Sequence[dict[str, float]], samples: Samples) -> Pattern:
    if len(conditions) == 1:
        return Pattern.of(selected.rays[0])
    (axis,) = samples.space.conditioned
    name, ends = DIMENSIONS[axis], (samples.space.low[axis], samples.space.high[axis])
    return Pattern.along(name, [at[name] for at in conditions], selected.rays, ends)


def _around_rays(
    sensor: Sensor, index: int, patterns: Sequence[Pattern], rules: SensorRules, samples: Samples
) -> Sensor:
    """A sensor with the smallest field of view and gate that hold its rays, and that constraints allow."""
    rows = [(pattern, pattern.sensor == index) for pattern in patterns]
    azimuth_rad, elevation_rad = (
        np.concatenate([getattr(pattern, name)[:, own].ravel() for pattern, own in rows])
        for name in ("azimuth_rad", "elevation_rad")
    )
    gate_m = np.concatenate([pattern.gate_m[:, own].reshape(-1, 2) for pattern, own in rows])
    if not len(gate_m):
        return sensor
    looking = direction(azimuth_rad, elevation_rad)
    return replace(
        smallest_field(sensor, looking, rules, samples.space),
        gate_m=(float(gate_m[:, 0].min()), float(gate_m[:, 1].max())),
    )


def smallest_field(sensor: Sensor, looking: np.ndarray, rules: SensorRules, space: DesignSpace) -> Sensor:
    """The sensor, turned where it may turn, with the smallest field inside its own that holds directions (N, 3).

    It is unchanged where no field inside its own holds them.
    """
    widest, fields, bounds = np.array(sensor.field_of_view_rad), rules.field_of_view, rules.boresight
    least = np.radians([fields.horizontal_deg.min or 0.0, fields.vertical_deg.min or 0.0])
    ends = (bounds.azimuth_deg.min, bounds.azimuth_deg.max, bounds.elevation_deg.min, bounds.elevation_deg.max)
    may_turn = all(end is None for end in ends) and space.turns
    tried, best, smallest = sensor, sensor, math.inf
    for _ in range(CENTRING_ROUNDS if may_turn else 1):
        tangent = tried.tangent_of(looking)
        view = np.maximum(2 * np.abs(tangent).max(axis=0) * (1 + FIELD_SLACK) + FIELD_SLACK, least)
        view = np.minimum(np.where(widest > 0, view, 0.0), widest + FIELD_SLACK)
        area = float(view[view > 0].prod())
        if (2 * np.abs(tangent).max(axis=0) <= np.minimum(view, widest) + FIELD_SLACK).all() and area < smallest:
            best, smallest = replace(tried, field_of_view_rad=tuple(np.minimum(view, widest).tolist())), area
        azimuth, elevation = centred_boresight(tried.frame, tangent)
        tried = replace(tried, azimuth_rad=azimuth, elevation_rad=elevation)
    return best


def share_fields(
    sensors: Sequence[Sensor], rules: Sequence[SensorRules], level: float, samples: Samples
) -> tuple[Sensor, ...]:
    """Sensors of equal shares that see as much of the density as constraints allow, so that each can replace others."""
    wide = [_with_widest_field(sensor, index, rules, level, samples) for index, sensor in enumerate(sensors)]
    return tuple(replace(sensor, weight=1 / len(wide)) for sensor in wide)


def _with_widest_field(
    sensor: Sensor, index: int, rules: Sequence[SensorRules], level: float, samples: Samples
) -> Sensor:
    space, own = samples.space, rules_of(rules, index)
    origins = samples.points[:, :3].copy()
    if sensor.origin_covariance_m2 is None:
        placed = [axis for axis in range(3) if axis not in space.conditioned]
        origins[:, placed] = np.asarray(sensor.origin_m)[placed]
    points = space.wrap(aim(origins, observed_point(samples.points)))
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    values = np.column_stack([sensor.tangent_of(looking), points[:, RANGE]])
    low, high = np.transpose([central_share(column, samples.weights, level) for column in values.T])
    inside = ((low <= values) & (values <= high)).all(axis=1)
    bounds = bounds_of(rules, space, (index,), interval_factor(level))
    start = max(min(float(low[-1]), sensor.gate_m[0]), float(bounds.start_low[0]))
    end = min(max(float(high[-1]), sensor.gate_m[1]), float(bounds.end_high[0]))
    limits = (own.field_of_view.horizontal_deg.max, own.field_of_view.vertical_deg.max)
    view = tuple(
        (2 * math.pi if limit is None else (1 - INWARD) * math.radians(limit)) if field > 0 else 0.0
        for field, limit in zip(sensor.field_of_view_rad, limits, strict=True)
    )
    gate_m = (start, end) if end - start <= bounds.width_high[0] else sensor.gate_m
    return smallest_field(replace(sensor, field_of_view_rad=view, gate_m=gate_m), looking[inside], own, space)


def central_share(values: np.ndarray, weights: np.ndarray, level: float) -> tuple[float, float]:
    """The ends of the central share of weighted values, (N,) each."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order]) / weights.sum()
    first, last = np.searchsorted(below, [(1 - level) / 2, (1 + level) / 2])
    return float(values[order[first]]), float(values[order[min(last, len(order) - 1)]])
