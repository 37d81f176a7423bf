"""Which real part stands in for each fitted sensor: of those that keep its constraints, the likeliest.

A part's field of view and range cannot be narrowed; only outside the design space's range, where no task has anything,
does its read-out stop. So a constraint that no part keeps is said by name.

A part is a component of its own shape (see `shapes`), where the sensor stands. One sensor after the other takes the
part with which the mixture's log-likelihood is highest, until none changes any more; then the poses are refitted with
these shapes and the sensors' own shares of the rays, which never lowers it. Where the parts lack the rays that are
asked for, or need more bandwidth than there is, sensors change to parts that help (see `fit`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter
from pathlib import Path

import numpy as np

from lidardesign.design.catalog.library import SUFFIX, load_library
from lidardesign.design.catalog.part import Part
from lidardesign.design.constraints.document import SensorRules, Snap, rules_of
from lidardesign.design.mixture.bounds import Bounds, Floors
from lidardesign.design.mixture.em import CONVERGENCE_NATS, EMResult
from lidardesign.design.mixture.ensemble import Ensemble
from lidardesign.design.mixture.features import Features
from lidardesign.design.mixture.m_step import maximise
from lidardesign.design.mixture.mixture import Mixture, expect, log_density
from lidardesign.design.snap.shapes import PartShape, shaped_bounds, shaped_mixture, shapes_of
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import SLACK, systematic_draw
from lidardesign.run.clock import phase
from lidardesign.space import DesignSpace
from lidardesign.task import random_generator

SPACE_RANGE = "space.range_m"
BOUNDED = ("field_of_view.horizontal_deg", "field_of_view.vertical_deg", "gate.start_m", "gate.end_m", "gate.width_m")
# Parts are compared on so many samples: losses are then known to some hundredths of a nat.
COMPARED_SAMPLES = 4000
MOST_SWEEPS = 5
MOST_ROTATIONS = 50
# Zones of the multi-zone rangers that most parts of the catalogue are compared with.
USUAL_RAYS = 64
# Parts whose likelihoods differ by less are equally near: the one with more rays is taken [nats].
EQUAL_NATS = SLACK


@dataclass(frozen=True, eq=False)
class PartOptions:
    """The parts that a sensor may become.

    Arguments:
        shapes: The parts, each upright and turned where that differs; empty where the sensor stays as it is.
        snapped: Whether the sensor is to become a part.
        lacking: Names of a smallest set of constraints that no part keeps together; empty where some do.
    """

    shapes: list[PartShape]
    snapped: bool
    lacking: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PartChoice:
    """The part of one sensor, and what the other parts would have been worth in its place.

    Arguments:
        shape: The part; None leaves the sensor as it is.
        losses: What each of its options loses beside the sensor as fitted [nats], in the order of the options.
    """

    shape: PartShape | None
    losses: tuple[float, ...] = ()


def wants_parts(rules: Sequence[SensorRules]) -> bool:
    """Whether any sensor is to become a part."""
    return any(one.snap is not None for one in rules)


def part_options(rules: Sequence[SensorRules], space: DesignSpace, middles_m: Sequence[float]) -> list[PartOptions]:
    """What each of some sensors may become.

    Arguments:
        rules: What the sensors must keep.
        space: The design space.
        middles_m: The mean range of each sensor: a part that does not measure there is none for it.

    Raises:
        InfeasibleError: No part keeps a sensor's constraints, and it is not said that it may stay as it is.
        ConfigError: A part that is not there, or no part file.
    """
    rules = rules[: len(middles_m)]
    shapes = [
        [] if one.snap is None else [shapes for part in parts_of(one.snap) if (shapes := shapes_of(part, space))]
        for one in rules
    ]
    options, conflicts, refused = [], [], []
    for sensor, middle_m in enumerate(middles_m):
        own, kept, broken = rules_of(rules, sensor), [], []
        if own.snap is None:
            options.append(PartOptions([], snapped=False))
            continue
        for one in shapes[min(sensor, len(rules) - 1)]:
            if one[0].gate_m[0] <= middle_m <= one[0].gate_m[1]:
                broken.append(_broken_keys(one[0], own))
                kept += [] if broken[-1] else one
        # the fewest constraints of which every part breaks at least one
        every = sorted(set().union(*broken))
        sizes = range(1, len(every) + 1) if broken and not kept else ()
        sets = (keys for size in sizes for keys in itertools.combinations(every, size))
        fewest = next((keys for keys in sets if all(set(keys) & found for found in broken)), ())
        lacking = () if kept else tuple(map(own.path, fewest)) or (SPACE_RANGE,)
        options.append(PartOptions(kept, snapped=bool(kept), lacking=lacking))
        if lacking and own.snap.otherwise == "refuse":
            conflicts += lacking
            refused.append(sensor)
    if refused:
        names = tuple(dict.fromkeys(conflicts))
        raise InfeasibleError(
            f"no part can stand in for {', '.join(f's{sensor}' for sensor in refused)} and keep {', '.join(names)}",
            conflicts=[*names, rules_of(rules, refused[0]).path("snap")],
            hint="loosen one of the constraints named, or leave such sensors as they are: --set snap.otherwise=keep",
        )
    return options


def _broken_keys(shape: PartShape, rules: SensorRules) -> set[str]:
    """Keys of the constraints that a part does not keep."""
    start, end = shape.gate_m
    values = (*(math.degrees(angle) for angle in shape.part.field_of_view_rad), start, end, end - start)
    broken = set()
    for key, value in zip(BOUNDED, values, strict=True):
        bounds = attrgetter(key)(rules)
        if bounds.min is not None and value < bounds.min * (1 - SLACK):
            broken.add(f"{key}.min")
        if bounds.max is not None and value > bounds.max * (1 + SLACK):
            broken.add(f"{key}.max")
    return broken


def parts_of(snap: Snap) -> list[Part]:
    """The parts, in all modes where none is named, that a constraint file chooses from.

    Of the whole catalogue, those of which a source says from where they measure.

    Raises:
        ConfigError: A name or path that is no part.
    """
    if snap.parts is None:
        return list(_catalogue())
    parts: dict[str, Part] = {}
    for text in snap.parts:
        # a name, or the path of a file or folder, with a mode behind it or not
        name, mode = text.rsplit(":", 1) if f"{SUFFIX}:" in text else (text, "")
        path = Path(name)
        if name.endswith(SUFFIX) or path.is_dir():
            library = load_library([path])
            files = {str(file) for file in path.glob(f"*{SUFFIX}")} if path.is_dir() else {str(path)}
            stems = [stem for stem, origin in library.origins.items() if origin in files]
        else:
            library = load_library()
            stem, _, mode = text.partition(":")
            stems = [stem]
        for stem in stems:
            parts |= {part.name: part for part in library.in_modes(stem, mode)}
    return list(parts.values())


@lru_cache(maxsize=1)
def _catalogue() -> tuple[Part, ...]:
    # kept, because patterns of hundred thousands of rays take a while
    return tuple(part for part in load_library().every_mode() if part.value("near_m") is not None)


@phase("parts")
def nearest_parts(ensemble: Ensemble, options: Sequence[PartOptions], rays: int | None, seed: int) -> list[PartChoice]:
    """The part that every sensor of an ensemble becomes, in the order of the sensors.

    Arguments:
        ensemble: The fit.
        options: What each sensor may become.
        rays: Rays of all sensors together; None counts as many as zones of a usual ranger for each.
        seed: Root of the draw of samples.
    """
    rays = USUAL_RAYS * len(options) if rays is None else rays
    choices: dict[int, PartChoice] = {}
    for index, (part, result) in enumerate(zip(ensemble.parts, ensemble.results, strict=True)):
        features = part.features
        if len(features) > COMPARED_SAMPLES:
            drawn = systematic_draw(features.weights, COMPARED_SAMPLES, random_generator(seed, "parts", index))
            drawn, times = np.unique(drawn, return_counts=True)
            features = replace(features.subset(drawn), weights=times / times.sum())
        shapes = [options[sensor].shapes for sensor in part.group.sensors]
        nearest = _nearest(result.mixture, features, shapes, part.bounds.interval, rays * part.share)
        choices |= dict(zip(part.group.sensors, nearest, strict=True))
    return [choices[sensor] for sensor in range(len(options))]


def _nearest(
    mixture: Mixture, features: Features, options: Sequence[Sequence[PartShape]], interval: float, rays: float
) -> list[PartChoice]:
    """Coordinate ascent over the shapes of a group's components, the heaviest first."""
    chosen: list[PartShape | None] = [None] * len(mixture)
    losses: list[tuple[float, ...]] = [()] * len(mixture)
    singles = [mixture.take(np.array([row])) for row in range(len(mixture))]
    log_share = [float(np.log(weight)) for weight in mixture.weights]
    # the log of each component's share times its density at every sample
    own = np.stack([log_share[row] + log_density(single, features) for row, single in enumerate(singles)])
    rows = [int(row) for row in np.argsort(-mixture.weights, kind="stable") if options[row]]
    # the same were it each of its parts, which does not depend on what the others become
    as_parts: dict[int, list[np.ndarray]] = {}
    for row in rows:
        known: dict[tuple[float, ...], np.ndarray] = {}
        as_parts[row] = []
        for shape in options[row]:
            key = (*shape.field_of_view_rad, *shape.gate_m)
            if key not in known:
                single = shaped_mixture(singles[row], [shape], interval, features.axes)
                known[key] = log_share[row] + log_density(single, features)
            # a part with fewer rays than its sensor's share of them has only as much weight as it has rays
            fewer = math.log(shape.part.rays / (rays * float(mixture.weights[row])))
            as_parts[row].append(known[key] + min(0.0, fewer))
    for _ in range(MOST_SWEEPS):
        before = list(chosen)
        for row in rows:
            others = np.delete(own, row, axis=0)
            rest = np.logaddexp.reduce(others, axis=0) if len(others) else np.full(len(features), -np.inf)
            values = np.array([features.weights @ np.logaddexp(rest, part) for part in as_parts[row]])
            if not losses[row]:
                fitted = float(features.weights @ np.logaddexp(rest, own[row]))
                losses[row] = tuple(fitted - float(value) for value in values)
            # of equally likely parts the one with most rays, then the first by name
            ranked = ((-s.part.rays, s.part.name, s.turned, index) for index, s in enumerate(options[row]))
            best = min(rank for rank in ranked if values[rank[-1]] >= values.max() - EQUAL_NATS)[-1]
            chosen[row], own[row] = options[row][best], as_parts[row][best]
        if chosen == before:
            break
    return [PartChoice(shape, loss) for shape, loss in zip(chosen, losses, strict=True)]


@phase("parts")
def fit_part_poses(ensemble: Ensemble, choices: Sequence[PartChoice], held: Sequence[bool]) -> Ensemble:
    """The ensemble with its components in the shapes of parts, their poses refitted.

    The shares of the rays stay those of the sensors: wide parts that see the same would divide them at random.

    Arguments:
        ensemble: The fit.
        choices: What each sensor becomes.
        held: Which sensors look where they did.
    """
    results = []
    for part, result in zip(ensemble.parts, ensemble.results, strict=True):
        shapes = [choices[sensor].shape for sensor in part.group.sensors]
        still = np.array([held[sensor] for sensor in part.group.sensors])
        mixture = shaped_mixture(result.mixture, shapes, part.bounds.interval, part.features.axes)
        bounds = shaped_bounds(part.bounds, shapes, part.features.axes)
        bounds = replace(
            bounds,
            azimuth_centre=np.where(still, mixture.azimuth_rad, bounds.azimuth_centre),
            azimuth_half=np.where(still, 0.0, bounds.azimuth_half),
            elevation_low=np.where(still, mixture.elevation_rad, bounds.elevation_low),
            elevation_high=np.where(still, mixture.elevation_rad, bounds.elevation_high),
        )
        results.append(replace(_rotate(mixture, part.features, bounds, still), notes=result.notes))
    return Ensemble(ensemble.parts, tuple(results))


def _rotate(mixture: Mixture, features: Features, bounds: Bounds, still: np.ndarray) -> EMResult:
    """Expectation maximisation with the shares held; some components do not roll. The likelihood never falls."""
    floors, statistics = Floors.of(features), expect(mixture, features)
    history = [statistics.log_likelihood]
    for _ in range(MOST_ROTATIONS):
        for step in (1.0, 0.0):
            moved = maximise(mixture, statistics, features, bounds, floors, step).with_weights(mixture.weights)
            # the roll has no bounds of its own
            moved = replace(moved, roll_rad=np.where(still, mixture.roll_rad, moved.roll_rad))
            outcome = expect(moved, features)
            if outcome.log_likelihood >= history[-1]:
                break
        gain = outcome.log_likelihood - history[-1]
        if not gain > 0:
            break
        mixture, statistics = moved, outcome
        history.append(outcome.log_likelihood)
        if gain < CONVERGENCE_NATS:
            break
    return EMResult(mixture, history[-1], tuple(history))
