r"""Fitted sensors replaced by real parts: by those that cost the likelihood least, inside the same constraints.

A part is a component of its own shape (see `shapes`), where the sensor stands. One sensor after the other takes the
part with which the mixture's log-likelihood is highest, until none changes any more; then the poses and the shares of
the rays are refitted with these shapes, which never lowers it. Where the parts lack the rays that are asked for, or
need more bandwidth than there is, sensors change to parts that help, each time the one that costs least per ray or
per bin gained.

A part fires its own pattern. Rays that look at nothing of the density are not read out; of the others it fires as many
as are asked for, evenly spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.design.em import Trace, climb
from lidardesign.design.ensemble import Ensemble
from lidardesign.design.ensemble import Part as Group
from lidardesign.design.features import Features
from lidardesign.design.mixture import Mixture, expect, log_density
from lidardesign.design.shapes import Shape, shaped_bounds, shaped_mixture
from lidardesign.design.snap_options import Options
from lidardesign.numerics import SLACK, systematic_draw
from lidardesign.run.clock import phase
from lidardesign.task import random_generator

# Parts are compared on so many samples: losses are then known to some hundredths of a nat.
COMPARED_SAMPLES = 4000
MOST_SWEEPS = 5
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
def nearest_parts(ensemble: Ensemble, options: Sequence[Options], seed: int) -> list[Choice]:
    """The part that every sensor of an ensemble becomes, in the order of the sensors.

    Arguments:
        ensemble: The fit.
        options: What each sensor may become.
        seed: Root of the draw of samples.
    """
    found: dict[int, Choice] = {}
    for index, (group, trace) in enumerate(zip(ensemble.parts, ensemble.traces, strict=True)):
        features = _thinned(group.features, random_generator(seed, "parts", index))
        own = [options[sensor] for sensor in group.group.sensors]
        choices = _nearest(trace.mixture, features, own, group)
        found |= dict(zip(group.group.sensors, choices, strict=True))
    return [found[sensor] for sensor in range(len(options))]


def _thinned(features: Features, generator: np.random.Generator) -> Features:
    if len(features) <= COMPARED_SAMPLES:
        return features
    drawn, times = np.unique(systematic_draw(features.weights, COMPARED_SAMPLES, generator), return_counts=True)
    return replace(features.subset(drawn), weights=times / times.sum())


def _nearest(mixture: Mixture, features: Features, options: list[Options], group: Group) -> list[Choice]:
    """Coordinate ascent over the shapes of a group's components, the heaviest first."""
    interval, axes = group.bounds.interval, features.axes
    chosen: list[Shape | None] = [None] * len(mixture)
    losses: list[tuple[float, ...]] = [()] * len(mixture)
    own = np.stack([_log_joint(mixture, row, features) for row in range(len(mixture))])
    rows = [int(row) for row in np.argsort(-mixture.weights, kind="stable") if options[row].shapes]
    for _ in range(MOST_SWEEPS):
        before = list(chosen)
        for row in rows:
            others = np.delete(own, row, axis=0)
            rest = np.logaddexp.reduce(others, axis=0) if len(others) else np.full(len(features), -np.inf)
            found = [
                _log_joint(shaped_mixture(mixture, _only(row, shape, len(mixture)), interval, axes), row, features)
                for shape in options[row].shapes
            ]
            worth = np.array([features.weights @ np.logaddexp(rest, one) for one in found])
            best = _first_of_best(worth, options[row].shapes)
            if not losses[row]:
                fitted = float(features.weights @ np.logaddexp(rest, own[row]))
                losses[row] = tuple(fitted - float(value) for value in worth)
            chosen[row], own[row] = options[row].shapes[best], found[best]
        if chosen == before:
            break
    return [Choice(shape, loss) for shape, loss in zip(chosen, losses, strict=True)]


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
def with_parts(ensemble: Ensemble, choices: Sequence[Choice], *, refitted: bool) -> Ensemble:
    """The ensemble with its components in the shapes of parts, their poses and shares refitted or as they were."""
    traces = []
    for group, trace in zip(ensemble.parts, ensemble.traces, strict=True):
        shapes = [choices[sensor].shape for sensor in group.group.sensors]
        mixture = shaped_mixture(trace.mixture, shapes, group.bounds.interval, group.features.axes)
        if refitted:
            bounds = shaped_bounds(group.bounds, shapes, group.features.axes)
            traces.append(replace(climb(mixture, group.features, bounds), notes=trace.notes))
        else:
            worth = expect(mixture, group.features).log_likelihood
            traces.append(Trace(mixture, worth, (worth,), trace.notes))
    return Ensemble(ensemble.parts, tuple(traces))
