"""What is chosen from: rays cast into scenes, what they tell there, and a few gates for each.

Gates hold quantiles of what a ray, and rays near it, return that tells something. Narrow gates cost fewer bits and lose
what lies outside; which of them pays is for the choice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.layouts.gates import central_intervals
from lidardesign.rays.coverage import InformedScene
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.returns import simulate_many
from lidardesign.task import Information

CANDIDATES_PER_RAY = 5
# Shares of what a ray returns that its gates hold; the first of them counts what rays near it return too.
LEVELS = (1.0, 1.0, 0.98, 0.9, 0.75)
SENSOR_LEVELS = (1.0, 0.98, 0.9, 0.75, 0.5, 0.25)  # the same of what all rays of a sensor return
NEIGHBOURS = 7  # of a ray, with itself: those around it in a hexagonal lattice
FEWEST_RETURNS = 3  # of a ray by itself, below which its gates rest on those of rays near it


def inform(
    scene: Scene,
    rays: Rays,
    visits: Sequence[slice],
    informs: Callable[[Scene, Sequence[Returns]], Information],
) -> InformedScene:
    """What a task says of the returns of rays in a scene, through the rays' own gates.

    Arguments:
        scene: The scene.
        rays: All candidates.
        visits: The rays at each condition, one after the other; at the other conditions these have no returns.
        informs: What the task says of a scene's returns.
    """
    fired = simulate_many(scene, [rays.subset(visit) for visit in visits])
    returns = [_among(rays, visit, frame) for visit, frames in zip(visits, fired, strict=True) for frame in frames]
    return InformedScene.of(informs(scene, returns), returns)


def _among(rays: Rays, fired: slice, returns: Returns) -> Returns:
    """The returns of some rays among all rays, of which the others return nothing."""
    outcome, range_m, body = np.full(len(rays), Outcome.MISS), np.full(len(rays), np.nan), np.full(len(rays), -1)
    outcome[fired], range_m[fired], body[fired] = returns.outcome, returns.range_m, returns.body
    return Returns(rays, outcome, range_m, body, returns.frame)


def gate_choices(rays: Rays, visits: Sequence[slice], informed: Sequence[InformedScene], margin_m: float) -> np.ndarray:
    """A few gates for each ray, inside its own, (N, G, 2) [m]; a ray that tells nothing has its own alone.

    Arguments:
        rays: The candidates, with the widest gates that they may have.
        visits: The rays at each condition; only those of one are near each other.
        informed: What the task says of training scenes.
        margin_m: By how much gates that hold all of a ray's returns are longer at both ends: other scenes differ.
    """
    count = len(rays)
    ray, range_m = _telling_returns(informed)
    if not len(ray):
        return np.repeat(rays.gate_m[:, None], len(LEVELS), axis=1)
    count = len(rays)
    seen = rays.origin_m + np.median(range_m) * rays.direction
    near = [
        visit.start + rows
        for visit in visits
        for rows in cKDTree(seen[visit]).query(seen[visit], [*range(1, min(NEIGHBOURS, len(seen[visit])) + 1)])[1]
    ]
    order = np.argsort(ray, kind="stable")
    start = np.searchsorted(ray[order], np.arange(count + 1))
    parts = [range_m[order[start[n] : start[n + 1]]] for n in range(count)]
    shared = [np.concatenate([parts[n] for n in group]) for group in near]
    alone = [part if len(part) >= FEWEST_RETURNS else group for part, group in zip(parts, shared, strict=True)]
    ends = []
    for source, levels in ((shared, LEVELS[:1]), (alone, LEVELS[1:])):
        label = np.repeat(np.arange(count), [len(part) for part in source])
        ends.append(central_intervals(np.concatenate(source), np.ones(len(label)), label, count, np.array(levels))[0])
    return _inside(rays, np.concatenate(ends, axis=1), LEVELS, margin_m)


def sensor_gates(rays: Rays, visits: Sequence[slice], informed: Sequence[InformedScene], margin_m: float) -> np.ndarray:
    """A few gates of each ray's sensor, each narrower than the one before, (N, G, 2) [m]; as `gate_choices`."""
    ray, range_m = _telling_returns(informed)
    sensor, sensors = rays.sensor[ray], int(rays.sensor.max()) + 1
    ends, _ = central_intervals(range_m, np.ones(len(ray)), sensor, sensors, np.array(SENSOR_LEVELS))
    narrow = _inside(rays, ends[rays.sensor], SENSOR_LEVELS, margin_m)
    return np.concatenate([rays.gate_m[:, None], narrow], axis=1)


def _inside(rays: Rays, ends_m: np.ndarray, levels: Sequence[float], margin_m: float) -> np.ndarray:
    """Gates (N, L, 2) that hold these ends inside the rays' own, those of all returns longer at both; or their own."""
    wider = np.where(np.array(levels) == 1.0, margin_m, 0.0)
    wider = np.stack([-wider, np.where(wider > 0, np.nextafter(wider, np.inf), 0.0)], axis=1)
    own = rays.gate_m[:, None]
    return np.where(np.isnan(ends_m), own, np.clip(ends_m + wider, own[..., :1], own[..., 1:]))


def _telling_returns(informed: Sequence[InformedScene]) -> tuple[np.ndarray, np.ndarray]:
    """Every return that tells something: its ray (K,) and range (K,) [m]."""
    returns = [scene.telling_returns for scene in informed]
    return tuple(np.concatenate(column) for column in zip(*returns, strict=True))
