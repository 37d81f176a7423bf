"""Fitted sensors replaced by real parts: by those that cost the likelihood least, inside the same constraints.

A part is a component of its own shape (see `shapes`), where the sensor stands. One sensor after the other takes the
part with which the mixture's log-likelihood is highest, until none changes any more; then the poses are refitted with
these shapes and the sensors' own shares of the rays, which never lowers it. Where the parts lack the rays that are
asked for, or need more bandwidth than there is, sensors change to parts that help, each time the one that costs least
per ray or per bin gained (see `snap_rays`).

A part with fewer rays than its sensor's share of them has only as much weight as it has rays. A part fires its own
pattern: rays that look at nothing of the density are not read out, and of the others it fires as many as are asked
for, evenly spread.

Which parts may stand in for a sensor: those whose own field of view and range keep its constraints.

A part's field of view and range cannot be narrowed; only outside the design space's range, where no task has anything,
does its read-out stop. So a constraint that no part keeps is said by name.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.design.catalog.library import SUFFIX, Library, load_library
from lidardesign.design.catalog.part import Part
from lidardesign.design.constraints.document import SensorRules, Snap, rules_of
from lidardesign.design.mixture.bounds import Bounds, Floors
from lidardesign.design.mixture.em import CONVERGENCE_NATS, EMResult
from lidardesign.design.mixture.ensemble import Ensemble
from lidardesign.design.mixture.ensemble import GroupSamples as Group
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
    parts = [[] if one.snap is None else parts_of(one.snap) for one in rules]
    last = len(rules) - 1
    options = [
        _options(rules[min(sensor, last)], space, middle, parts[min(sensor, last)])
        for sensor, middle in enumerate(middles_m)
    ]
    refused = [
        sensor
        for sensor, option in enumerate(options)
        if option.lacking and (snap := rules_of(rules, sensor).snap) is not None and snap.otherwise == "refuse"
    ]
    if refused:
        names = tuple(dict.fromkeys(name for index in refused for name in options[index].lacking))
        which = ", ".join(f"s{index}" for index in refused)
        raise InfeasibleError(
            f"no part can stand in for {which} and keep {', '.join(names)}",
            conflicts=[*names, rules_of(rules, refused[0]).path("snap")],
            hint="loosen one of the constraints named, or leave such sensors as they are: --set snap.otherwise=keep",
        )
    return options


def parts_of(snap: Snap) -> list[Part]:
    """The parts, in all modes where none is named, that a constraint file chooses from.

    Of the whole catalogue, those of which a source says from where they measure.

    Raises:
        ConfigError: A name or path that is no part.
    """
    if snap.parts is None:
        return list(_catalogue())
    found: dict[str, Part] = {}
    for text in snap.parts:
        found |= {part.name: part for part in _named(text)}
    return list(found.values())


@lru_cache(maxsize=1)
def _catalogue() -> tuple[Part, ...]:
    # kept, because patterns of hundred thousands of rays take a while
    return tuple(part for part in load_library().every_mode() if part.value("near_m") is not None)


def _split(text: str) -> tuple[Path | None, str]:
    """The path that a text names, None where it is a name, and the mode behind it."""
    path, mode = text.rsplit(":", 1) if f"{SUFFIX}:" in text else (text, "")
    return (Path(path) if path.endswith(SUFFIX) or Path(path).is_dir() else None), mode


def _named(text: str) -> list[Part]:
    """The parts of a name, of `NAME:MODE`, or of the path of a file or folder; all modes where none is named."""
    path, mode = _split(text)
    if path is None:
        library, stems, mode = load_library(), [text.partition(":")[0]], text.partition(":")[2]
    else:
        library = load_library([path])
        files = {str(file) for file in _inside(path)}
        stems = [name for name, origin in library.origins.items() if origin in files]
    if mode:
        return [library.part(f"{stem}:{mode}") for stem in stems]
    return [part for stem in stems for part in _modes(library, library.part(stem))]


def _inside(path: Path) -> list[Path]:
    return sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]


def _modes(library: Library, part: Part) -> list[Part]:
    stem = part.name.partition(":")[0]
    return [library.part(f"{stem}:{mode}") for mode in part.modes] or [part]


def _options(rules: SensorRules, space: DesignSpace, middle_m: float, parts: Sequence[Part]) -> PartOptions:
    if rules.snap is None:
        return PartOptions([], snapped=False)
    every = [shapes_of(part, space) for part in parts]
    heard = [shapes for shapes in every if shapes and shapes[0].gate_m[0] <= middle_m <= shapes[0].gate_m[1]]
    broken = [_broken(shapes[0], rules) for shapes in heard]
    kept = [shape for shapes, found in zip(heard, broken, strict=True) if not found for shape in shapes]
    if kept:
        return PartOptions(kept, snapped=True)
    lacking = _smallest_lacking(broken) if broken else ()
    return PartOptions([], snapped=False, lacking=tuple(map(rules.path, lacking)) or (SPACE_RANGE,))


def _broken(shape: PartShape, rules: SensorRules) -> set[str]:
    """Keys of the constraints that a part does not keep."""
    horizontal, vertical = (math.degrees(angle) for angle in shape.part.field_of_view_rad)
    start, end = shape.gate_m
    values = (horizontal, vertical, start, end, end - start)
    found = set()
    for key, value in zip(BOUNDED, values, strict=True):
        bounds: Any = rules
        for part in key.split("."):
            bounds = getattr(bounds, part)
        if bounds.min is not None and value < bounds.min * (1 - SLACK):
            found.add(f"{key}.min")
        if bounds.max is not None and value > bounds.max * (1 + SLACK):
            found.add(f"{key}.max")
    return found


def _smallest_lacking(broken: Sequence[set[str]]) -> tuple[str, ...]:
    """The fewest constraints of which every part breaks at least one."""
    every = sorted(set().union(*broken))
    sizes = (itertools.combinations(every, size) for size in range(1, len(every) + 1))
    return next(names for one in sizes for names in one if all(set(names) & found for found in broken))


# Parts are compared on so many samples: losses are then known to some hundredths of a nat.
COMPARED_SAMPLES = 4000
MOST_SWEEPS = 5
MOST_TURNS = 50
# Zones of the multi-zone rangers that most parts of the catalogue are compared with.
USUAL_RAYS = 64
# Parts whose likelihoods differ by less are equally near: the one with more rays is taken [nats].
EQUAL_NATS = SLACK


@dataclass(frozen=True, eq=False)
class PartChoice:
    """The part of one sensor, and what the other parts would have been worth in its place.

    Arguments:
        shape: The part; None leaves the sensor as it is.
        losses: What each of its options loses beside the sensor as fitted [nats], in the order of the options.
    """

    shape: PartShape | None
    losses: tuple[float, ...] = ()


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
    found: dict[int, PartChoice] = {}
    for index, (group, trace) in enumerate(zip(ensemble.parts, ensemble.traces, strict=True)):
        features = _thinned(group.features, random_generator(seed, "parts", index))
        own = [options[sensor] for sensor in group.group.sensors]
        choices = _nearest(trace.mixture, features, own, group, rays * group.share)
        found |= dict(zip(group.group.sensors, choices, strict=True))
    return [found[sensor] for sensor in range(len(options))]


def _thinned(features: Features, generator: np.random.Generator) -> Features:
    if len(features) <= COMPARED_SAMPLES:
        return features
    drawn, times = np.unique(systematic_draw(features.weights, COMPARED_SAMPLES, generator), return_counts=True)
    return replace(features.subset(drawn), weights=times / times.sum())


def _nearest(
    mixture: Mixture, features: Features, options: list[PartOptions], group: Group, rays: float
) -> list[PartChoice]:
    """Coordinate ascent over the shapes of a group's components, the heaviest first."""
    chosen: list[PartShape | None] = [None] * len(mixture)
    losses: list[tuple[float, ...]] = [()] * len(mixture)
    own = np.stack([_log_joint(mixture, row, features) for row in range(len(mixture))])
    rows = [int(row) for row in np.argsort(-mixture.weights, kind="stable") if options[row].shapes]
    # a component's own density does not depend on what the others become
    as_parts = {row: _as_parts(mixture, row, options[row].shapes, features, group, rays) for row in rows}
    for _ in range(MOST_SWEEPS):
        before = list(chosen)
        for row in rows:
            others = np.delete(own, row, axis=0)
            rest = np.logaddexp.reduce(others, axis=0) if len(others) else np.full(len(features), -np.inf)
            worth = np.array([features.weights @ np.logaddexp(rest, one) for one in as_parts[row]])
            best = _first_of_best(worth, options[row].shapes)
            if not losses[row]:
                fitted = float(features.weights @ np.logaddexp(rest, own[row]))
                losses[row] = tuple(fitted - float(value) for value in worth)
            chosen[row], own[row] = options[row].shapes[best], as_parts[row][best]
        if chosen == before:
            break
    return [PartChoice(shape, loss) for shape, loss in zip(chosen, losses, strict=True)]


def _as_parts(
    mixture: Mixture, row: int, shapes: Sequence[PartShape], features: Features, group: Group, rays: float
) -> list[np.ndarray]:
    """A component's share times its density at every sample, in log, were it each of some parts: (N,) each."""
    known: dict[tuple[float, ...], np.ndarray] = {}
    found = []
    for shape in shapes:
        key = (*shape.field_of_view_rad, *shape.gate_m)
        if key not in known:
            only = shaped_mixture(mixture, _only(row, shape, len(mixture)), group.bounds.interval, features.axes)
            known[key] = _log_joint(only, row, features)
        found.append(known[key] + min(0.0, math.log(shape.part.rays / (rays * float(mixture.weights[row])))))
    return found


def _only(row: int, shape: PartShape, count: int) -> list[PartShape | None]:
    shapes: list[PartShape | None] = [None] * count
    shapes[row] = shape
    return shapes


def _log_joint(mixture: Mixture, row: int, features: Features) -> np.ndarray:
    """Log of a component's share times its density at every sample, shape (N,)."""
    return float(np.log(mixture.weights[row])) + log_density(mixture.take(np.array([row])), features)


def _first_of_best(worth: np.ndarray, shapes: Sequence[PartShape]) -> int:
    """The most likely shape; of equally likely ones that of the part with most rays, then the first by name."""
    near = np.flatnonzero(worth >= worth.max() - EQUAL_NATS)
    return int(min(near, key=lambda index: (-shapes[index].part.rays, shapes[index].part.name, shapes[index].turned)))


@phase("parts")
def fit_part_poses(ensemble: Ensemble, choices: Sequence[PartChoice], held: Sequence[bool]) -> Ensemble:
    """The ensemble with its components in the shapes of parts, their poses refitted.

    The shares of the rays stay those of the sensors: wide parts that see the same would divide them at random.

    Arguments:
        ensemble: The fit.
        choices: What each sensor becomes.
        held: Which sensors look where they did.
    """
    traces = []
    for group, trace in zip(ensemble.parts, ensemble.traces, strict=True):
        shapes = [choices[sensor].shape for sensor in group.group.sensors]
        still = np.array([held[sensor] for sensor in group.group.sensors])
        mixture = shaped_mixture(trace.mixture, shapes, group.bounds.interval, group.features.axes)
        bounds = _held(shaped_bounds(group.bounds, shapes, group.features.axes), mixture, still)
        found, history = _turned(mixture, group.features, bounds, still)
        traces.append(EMResult(found, history[-1], history, trace.notes))
    return Ensemble(ensemble.parts, tuple(traces))


def _turned(
    mixture: Mixture, features: Features, bounds: Bounds, still: np.ndarray
) -> tuple[Mixture, tuple[float, ...]]:
    """Expectation maximisation with the shares held, and the log-likelihood of every step: it never falls."""
    floors, statistics = Floors.of(features), expect(mixture, features)
    history = [statistics.log_likelihood]
    for _ in range(MOST_TURNS):
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
    return mixture, tuple(history)


def _held(bounds: Bounds, mixture: Mixture, still: np.ndarray) -> Bounds:
    """Bounds in which some components cannot turn."""
    return replace(
        bounds,
        azimuth_centre=np.where(still, mixture.azimuth_rad, bounds.azimuth_centre),
        azimuth_half=np.where(still, 0.0, bounds.azimuth_half),
        elevation_low=np.where(still, mixture.elevation_rad, bounds.elevation_low),
        elevation_high=np.where(still, mixture.elevation_rad, bounds.elevation_high),
    )
