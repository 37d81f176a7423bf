r"""Fitted sensors replaced by real parts: by those that cost the likelihood least, inside the same constraints.

A part is a component of its own shape (see `shapes`), where the sensor stands. One sensor after the other takes the
part with which the mixture's log-likelihood is highest, until none changes any more; then the poses are refitted with
these shapes and the sensors' own shares of the rays, which never lowers it. Where the parts lack the rays that are
asked for, or need more bandwidth than there is, sensors change to parts that help, each time the one that costs least
per ray or per bin gained (see `snap_rays`).

A part with fewer rays than its sensor's share of them has only as much weight as it has rays. A part fires its own
pattern: rays that look at nothing of the density are not read out, and of the others it fires as many as are asked
for, evenly spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.design.bounds import Bounds, Floors
from lidardesign.design.em import CONVERGENCE_NATS, Trace
from lidardesign.design.ensemble import Ensemble
from lidardesign.design.ensemble import Part as Group
from lidardesign.design.features import Features
from lidardesign.design.mixture import Mixture, expect, log_density
from lidardesign.design.mstep import maximise
from lidardesign.design.shapes import Shape, shaped_bounds, shaped_mixture
from lidardesign.design.snap_options import Options
from lidardesign.numerics import SLACK, systematic_draw
from lidardesign.run.clock import phase
from lidardesign.task import random_generator

# Parts are compared on so many samples: losses are then known to some hundredths of a nat.
COMPARED_SAMPLES = 4000
MOST_SWEEPS = 5
MOST_TURNS = 50
# Zones of the multi-zone rangers that most parts of the catalogue are compared with.
USUAL_RAYS = 64
# Parts whose likelihoods differ by less are equally near: the one with more rays is taken [nats].
EQUAL_NATS = SLACK


@dataclass(frozen=True, eq=False)
class Choice:
    """The part of one sensor, and what the other parts would have been worth in its place.

    Arguments:
        shape: The part; None leaves the sensor as it is.
        losses: What each of its options loses beside the sensor as fitted [nats], in the order of the options.
    """

    shape: Shape | None
    losses: tuple[float, ...] = ()


@phase("parts")
def nearest_parts(ensemble: Ensemble, options: Sequence[Options], rays: int | None, seed: int) -> list[Choice]:
    """The part that every sensor of an ensemble becomes, in the order of the sensors.

    Arguments:
        ensemble: The fit.
        options: What each sensor may become.
        rays: Rays of all sensors together; None counts as many as zones of a usual ranger for each.
        seed: Root of the draw of samples.
    """
    rays = USUAL_RAYS * len(options) if rays is None else rays
    found: dict[int, Choice] = {}
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


def _nearest(mixture: Mixture, features: Features, options: list[Options], group: Group, rays: float) -> list[Choice]:
    """Coordinate ascent over the shapes of a group's components, the heaviest first."""
    chosen: list[Shape | None] = [None] * len(mixture)
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
    return [Choice(shape, loss) for shape, loss in zip(chosen, losses, strict=True)]


def _as_parts(
    mixture: Mixture, row: int, shapes: Sequence[Shape], features: Features, group: Group, rays: float
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


def _only(row: int, shape: Shape, count: int) -> list[Shape | None]:
    shapes: list[Shape | None] = [None] * count
    shapes[row] = shape
    return shapes


def _log_joint(mixture: Mixture, row: int, features: Features) -> np.ndarray:
    """Log of a component's share times its density at every sample, shape (N,)."""
    return float(np.log(mixture.weights[row])) + log_density(mixture.take(np.array([row])), features)


def _first_of_best(worth: np.ndarray, shapes: Sequence[Shape]) -> int:
    """The most likely shape; of equally likely ones that of the part with most rays, then the first by name."""
    near = np.flatnonzero(worth >= worth.max() - EQUAL_NATS)
    return int(min(near, key=lambda index: (-shapes[index].part.rays, shapes[index].part.name, shapes[index].turned)))


@phase("parts")
def with_parts(ensemble: Ensemble, choices: Sequence[Choice], held: Sequence[bool]) -> Ensemble:
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
        traces.append(Trace(found, history[-1], history, trace.notes))
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
