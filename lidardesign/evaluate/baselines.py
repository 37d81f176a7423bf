"""The simple rivals of every design: `uniform`, `random` and `bounding`.

Each is built for exactly N rays, alone from the design space and, for `bounding`, from what dense rays return
in the training scenes. A baseline is one or more candidate layouts; where there are several, the best on
training scenes is taken at each number of rays.

- `uniform`: rays even in azimuth and elevation over the whole design space (the paper's grid), with the whole
  range as their gate. Free origin axes join the layout: two free axes in all give a grid, more a
  low-discrepancy set.
- `random`: rays uniform in the measure of the design space, with the whole range as their gate, drawn anew for
  every scene.
- `bounding`: the even layout again, cropped per axis to the central 99 % of the training returns in angle and
  range. With free origins the better of two, on training scenes: parallel rays (vertical where the space
  allows it) from an even grid over the returns' box, and an even or low-discrepancy set in the central 99 %
  box of origins and angles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.errors import ConfigError
from lidardesign.evaluate.placement import (
    RAY_AXES,
    even_placement,
    low_discrepancy,
    opened_gate,
    rays_at,
)
from lidardesign.scene import Scene
from lidardesign.simulate.raycast import SceneCaster
from lidardesign.simulate.returns import Rays
from lidardesign.space import AZIMUTH, ELEVATION, FULL_TURN, RANGE, DesignSpace, direction
from lidardesign.task import random_generator

CENTRAL_SHARE = 0.99
DENSE_RAYS = 4096  # per training scene: the ends of the central 99 % then rest on 20 rays in each scene
ALIGNED = math.cos(
    math.pi / 4
)  # an origin axis within 45 degrees of parallel rays only moves them along themselves

Judge = Callable[[Rays], float]


@dataclass(frozen=True, eq=False)
class Candidate:
    """One layout that a baseline may take.

    Arguments:
        name: For messages.
        place: Even or random points (x, y, z, azimuth, elevation) of any number, (count) to (count, 5).
        gate_m: The gate of all its rays, shape (2,).
    """

    name: str
    place: Callable[[int], np.ndarray]
    gate_m: np.ndarray

    def rays(self, count: int) -> Rays:
        """Exactly `count` rays."""
        return rays_at(self.place(count), self.gate_m)

    def rays_within(self, limit_mbps: float, bandwidth: Bandwidth) -> Rays:
        """As many rays as fit in a bandwidth [Mbit/s]; none where not even one fits."""
        width_m = self.gate_m[1] - self.gate_m[0]
        single = bandwidth.mbps_of_widths(np.array([width_m]))
        # the ratio of two multiples of one bin may lie an ulp below a whole number
        count = math.floor(limit_mbps / single * (1 + np.finfo(float).eps))
        while count and bandwidth.mbps_of_widths(np.array([width_m]), count) > limit_mbps:
            count -= 1
        return self.rays(count)


@dataclass(frozen=True, eq=False)
class Observed:
    """What dense rays return on the targets of the training scenes.

    Arguments:
        points: Design points with a return, the azimuth unrolled to one arc, shape (K, 6).
        hits_m: Where they hit, shape (K, 3).
    """

    points: np.ndarray
    hits_m: np.ndarray


class Baselines:
    """Builds baselines for one design space and one set of training scenes, which it traces once.

    Arguments:
        space: The design space.
        train: Training scenes.
        seed: Root of the random baseline.
        judge: What a list of rays is worth on training scenes, lower is better; None counts missing returns.
    """

    def __init__(
        self, space: DesignSpace, train: Sequence[Scene], seed: int, judge: Judge | None = None
    ) -> None:
        self.space, self.train, self.seed = space, train, seed
        self._judge = judge or self._missing_returns
        self._candidates: dict[str, list[Candidate]] = {}
        self._casters: list[tuple[Scene, SceneCaster]] = []
        self._worth: dict[tuple[str, str, int], float] = {}

    def rays(self, name: str, count: int) -> Rays:
        """A baseline at exactly `count` rays."""
        return self._best(name, [(option, option.rays(count)) for option in self.candidates(name)])

    def rays_within(self, name: str, limit_mbps: float, bandwidth: Bandwidth) -> Rays:
        """A baseline with as many rays as fit in a bandwidth [Mbit/s]."""
        options = self.candidates(name)
        return self._best(name, [(option, option.rays_within(limit_mbps, bandwidth)) for option in options])

    def candidates(self, name: str) -> list[Candidate]:
        """The layouts that a baseline chooses from.

        Raises:
            ConfigError: There is no such baseline.
        """
        if name not in BASELINES:
            raise ConfigError(f"unknown baseline {name!r}", where="baselines", allowed=", ".join(BASELINES))
        if name not in self._candidates:
            self._candidates[name] = BASELINES[name](self)
        return self._candidates[name]

    def casters(self) -> list[tuple[Scene, SceneCaster]]:
        """A caster per training scene and frame, built once."""
        if not self._casters:
            self._casters = [(s, SceneCaster(s, frame)) for s in self.train for frame in range(s.frames)]
        return self._casters

    def hits(self, points: np.ndarray) -> Observed:
        """What rays at (N, 5 or 6) return on targets inside the space's range, over all training scenes."""
        lowest, highest = opened_gate(self.space.low[RANGE], self.space.high[RANGE])
        looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
        kept = []
        for scene, caster in self.casters():
            found = caster.first_hit(points[:, :3], looking)
            target = np.array([*(body.is_target for body in scene.bodies), False])[found.body]
            seen = target & (found.range_m >= lowest) & (found.range_m < highest)
            kept.append(np.column_stack([points[seen, :RAY_AXES], found.range_m[seen]]))
        design = np.concatenate(kept) if kept else np.zeros((0, 6))
        spots = design[:, :3] + design[:, RANGE:] * direction(design[:, AZIMUTH], design[:, ELEVATION])
        if self.space.full_azimuth:
            design[:, AZIMUTH] = unrolled(design[:, AZIMUTH])
        return Observed(design, spots)

    def _best(self, name: str, options: list[tuple[Candidate, Rays]]) -> Rays:
        """The rays that are worth most on training scenes; the first where several are worth the same."""
        if len(options) == 1:
            return options[0][1]
        worth = []
        for candidate, rays in options:
            key = (name, candidate.name, len(rays))
            if key not in self._worth:
                self._worth[key] = self._judge(rays)
            worth.append(self._worth[key])
        return options[int(np.argmin(worth))][1]

    def _missing_returns(self, rays: Rays) -> float:
        """The share of rays without a return inside their gate, over all training scenes."""
        returned = 0
        for _, caster in self.casters():
            range_m = caster.first_hit(rays.origin_m, rays.direction).range_m
            returned += int(((range_m >= rays.gate_m[:, 0]) & (range_m < rays.gate_m[:, 1])).sum())
        return 1.0 - returned / max(len(rays) * len(self.casters()), 1)


def build_baseline(
    name: str,
    space: DesignSpace,
    train_scenes: Sequence[Scene],
    count: int,
    seed: int,
    judge: Judge | None = None,
) -> Rays:
    """One baseline at exactly `count` rays; `Baselines` builds many without tracing the scenes anew."""
    return Baselines(space, train_scenes, seed, judge).rays(name, count)


def unrolled(azimuth_rad: np.ndarray) -> np.ndarray:
    """Azimuths moved by whole turns onto one arc that starts behind the widest gap, shape (K,)."""
    if not len(azimuth_rad):
        return azimuth_rad
    turned = np.sort(np.mod(azimuth_rad, FULL_TURN))
    gaps = np.diff(np.append(turned, turned[0] + FULL_TURN))
    start = turned[(int(np.argmax(gaps)) + 1) % len(turned)]
    return start + np.mod(azimuth_rad - start, FULL_TURN)


def _uniform(source: Baselines) -> list[Candidate]:
    space = source.space
    low, high = np.array(space.low[:RAY_AXES]), np.array(space.high[:RAY_AXES])
    return [Candidate("even", lambda count: even_placement(low, high, count), _whole_range(space))]


def _random(source: Baselines) -> list[Candidate]:
    return [_random_draw(source.space, source.seed, 0)]


def _random_draw(space: DesignSpace, seed: int, scene: int) -> Candidate:
    def place(count: int) -> np.ndarray:
        return space.sample(count, random_generator(seed, "random baseline", count, scene))

    return Candidate("random", place, _whole_range(space))


def random_rays(space: DesignSpace, count: int, seed: int, scene: int) -> Rays:
    """The baseline `random` drawn anew for a scene, so that no lucky draw stands for all scenes."""
    return _random_draw(space, seed, scene).rays(count)


def _bounding(source: Baselines) -> list[Candidate]:
    space = source.space
    observed = source.hits(_dense_points(space))
    if not len(observed.points):
        return _uniform(source)
    low, high = _central(observed.points)
    cropped = Candidate(
        "cropped",
        lambda count: even_placement(low[:RAY_AXES], high[:RAY_AXES], count),
        opened_gate(low[RANGE], high[RANGE]),
    )
    if all(a == b for a, b in zip(space.low[:3], space.high[:3], strict=True)):
        return [cropped]
    parallel = _parallel(source, observed)
    return [cropped] if parallel is None else [parallel, cropped]


BASELINES: dict[str, Callable[[Baselines], list[Candidate]]] = {
    "uniform": _uniform,
    "random": _random,
    "bounding": _bounding,
}


def _whole_range(space: DesignSpace) -> np.ndarray:
    return opened_gate(space.low[RANGE], space.high[RANGE])


def _dense_points(space: DesignSpace) -> np.ndarray:
    """Dense rays over the space, even in its own measure, shape (DENSE_RAYS, 6)."""
    unit = np.full((DENSE_RAYS, len(space.free)), -1.0)
    axes = [i for i, dimension in enumerate(space.free) if dimension != RANGE]
    unit[:, axes] = 2 * low_discrepancy(DENSE_RAYS, len(axes)) - 1
    return space.from_unit(unit)


def _central(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the central 99 % of each column, shapes (D,)."""
    tail = (1 - CENTRAL_SHARE) / 2
    low, high = np.quantile(points, [tail, 1 - tail], axis=0)
    return low, np.maximum(low, high)


def _parallel(source: Baselines, observed: Observed) -> Candidate | None:
    """Parallel rays from an even grid over the returns' box, within the admissible origins.

    An origin axis that runs along the rays stays at the bound behind the scene. None where such rays
    return nothing.
    """
    space = source.space
    azimuth, elevation = _parallel_angles(space, observed)
    looking = direction(azimuth, elevation)
    low, high = _central(observed.hits_m)
    low, high = (np.clip(end, space.low[:3], space.high[:3]) for end in (low, high))
    for axis in np.flatnonzero(np.abs(looking) > ALIGNED):
        low[axis] = high[axis] = space.low[axis] if looking[axis] > 0 else space.high[axis]
    low, high = np.append(low, [azimuth, elevation]), np.append(high, [azimuth, elevation])
    seen = source.hits(even_placement(low, high, DENSE_RAYS))
    if not len(seen.points):
        return None
    nearest, furthest = _central(seen.points[:, RANGE])
    gate = opened_gate(float(nearest), float(furthest))
    return Candidate("parallel", lambda count: even_placement(low, high, count), gate)


def _parallel_angles(space: DesignSpace, observed: Observed) -> tuple[float, float]:
    """Straight down where the space allows it, else straight up, else the median direction of the returns."""
    middle = np.median(observed.points[:, AZIMUTH])
    pole = math.pi / 2
    for elevation in (-pole, pole):
        if space.low[ELEVATION] <= elevation <= space.high[ELEVATION]:
            return float(middle), elevation
    return float(middle), float(np.median(observed.points[:, ELEVATION]))
