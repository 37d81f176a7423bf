r"""Where real parts would see most: poses for one or several of a kind, by likelihood.

A part that sees a scene point s at the range r puts rays on it in proportion to 1 / (r^2 Omega), with Omega the solid
angle that its rays share; one that does not see it puts none. So k parts have the density
$q(s) = \frac{1}{k} \sum_j \frac{v_j(s)}{r_j(s)^2}$ up to a constant, with v how visible s is from their place. The
poses maximise the mean of log(q + clutter) over scene points drawn from the learned density; the clutter keeps
points that no part sees from deciding alone.

Proposals are the components of mixtures of the part's shape, fitted where it may stand; they are taken one after the
other, each time the one that gains most.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lidardesign.design.catalog.part import Part
from lidardesign.design.catalog.placing import Pose, interleaved
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.layouts.grid import low_discrepancy
from lidardesign.design.mixture.bounds import bounds_of
from lidardesign.design.mixture.em import fit_mixture
from lidardesign.design.mixture.features import Axes, Features
from lidardesign.design.mixture.mixture import Mixture
from lidardesign.design.sensor import DEFAULT_LEVEL, interval_factor
from lidardesign.design.snap.shapes import PartShape, in_view, shaped_bounds, shapes_of
from lidardesign.numerics import effective_count
from lidardesign.run.clock import phase
from lidardesign.space import AZIMUTH, DIMENSIONS, RANGE, DesignSpace, aim, observed_point
from lidardesign.task import random_generator

Retarget = Callable[[np.ndarray], np.ndarray]

# Scene points that poses are judged by: enough to tell apart shares of a hundredth.
POINTS = 3000
# Places that are tried where origins are free.
PLACES = 32
# Of these the likeliest for one part are looked at more closely: from where everything is hidden none is.
CLOSER_PLACES = 8
# Fitted together they find boresights of their own; more parts repeat these, their rays interleaved.
MOST_APART = 16
RESTARTS = 4
# The share of scene points that is taken for clutter.
CLUTTER = 0.05
# Fewer effective points than this tell nothing about where to look.
LEAST_POINTS = 10.0


@dataclass(frozen=True, eq=False)
class ScenePoints:
    """Equally likely scene points, and the design points that they were seen by.

    Arguments:
        points: Design points, shape (N, 6).
        log_target: log p* at them, shape (N,); only read where there is a `retarget`.
        space: The design space; its conditions are where what carries the part may be.
        retarget: log p* of other design points (N, 6); None takes every point as visible from everywhere.
    """

    points: np.ndarray
    log_target: np.ndarray
    space: DesignSpace
    retarget: Retarget | None = None
    _seen: dict[tuple[float, ...], np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def travelled(self) -> list[int]:
        """Origin axes along which the part is carried."""
        return [axis for axis in self.space.conditioned if axis < AZIMUTH]

    @property
    def still(self) -> DesignSpace:
        """The space of a part where it is bolted on: what carries it stands at its first place."""
        low, high = list(self.space.low), list(self.space.high)
        for axis in self.travelled:
            high[axis] = low[axis]
        kept = tuple(name for name in self.space.condition if DIMENSIONS.index(name) not in self.travelled)
        return replace(self.space, low=tuple(low), high=tuple(high), condition=kept)

    def brought_back(self) -> np.ndarray:
        """The design points as they are seen from what carries them, at its first place, shape (N, 6)."""
        back = self.points.copy()
        back[:, self.travelled] = np.array(self.space.low)[self.travelled]
        return back

    def visible(self, origin_m: np.ndarray) -> np.ndarray:
        """How visible each scene point is from an origin, relative to where it was seen from, (N,) in [0, 1]."""
        place = tuple(float(value) for value in origin_m)
        if place not in self._seen:
            self._seen[place] = self._visible(origin_m)
        return self._seen[place]

    def _visible(self, origin_m: np.ndarray) -> np.ndarray:
        origins = np.tile(origin_m, (len(self.points), 1))
        origins[:, self.travelled] = self.points[:, self.travelled]
        if self.retarget is None or np.array_equal(origins, self.points[:, :3]):
            return np.ones(len(self.points))
        aimed = self.space.wrap(aim(origins, observed_point(self.points)))
        with np.errstate(invalid="ignore"):
            gain = np.asarray(self.retarget(aimed), dtype=np.float64) - self.log_target
        return np.exp(np.minimum(np.where(np.isnan(gain), -np.inf, gain), 0.0))


@dataclass(frozen=True, eq=False)
class Proposals:
    """Poses to choose from.

    Arguments:
        poses: P poses.
        density: How densely a part at each would put rays on each scene point, shape (P, N) [1 / m^2].
    """

    poses: list[Pose]
    density: np.ndarray


class PosedPart:
    """Poses for any number of a part, found once per number.

    Arguments:
        part: The kind of part.
        scene: What it is to see.
        seed: Root of the random streams.

    `places_m` are the origins that are tried, shape (M, 3).
    """

    def __init__(self, part: Part, scene: ScenePoints, seed: int) -> None:
        self.part, self.scene, self.seed = part, scene, seed
        self.places_m = places(scene.still)
        self._points = scene.brought_back()
        self._fits: dict[tuple[int, int], list[Pose]] = {}

    @phase("poses")
    def best(self, number: int) -> list[Pose]:
        """The likeliest poses of so many parts, one place per part."""
        apart = min(number, MOST_APART)
        every = [pose for place in self._closer for pose in self._at(place, apart)]
        return self._greedy(self._proposals(every), number)

    @cached_property
    def _closer(self) -> list[int]:
        """The places from where one part would put most rays on the scene if nothing hid it."""
        if len(self.places_m) <= CLOSER_PLACES:
            return list(range(len(self.places_m)))
        everything = np.ones(len(self._points))
        first = [self._fit(place, 1, everything)[0] for place in range(len(self.places_m))]
        worth = [self._worth(self._density(pose, everything)) for pose in first]
        return sorted(np.argsort(-np.array(worth), kind="stable")[:CLOSER_PLACES].tolist())

    def _at(self, place: int, number: int) -> list[Pose]:
        one = self._fitted(place, 1)
        return one if number == 1 else [*one, *self._fitted(place, number)]

    def _fitted(self, place: int, number: int) -> list[Pose]:
        if (place, number) not in self._fits:
            self._fits[place, number] = self._fit(place, number, self.scene.visible(self.places_m[place]))
        return self._fits[place, number]

    def _fit(self, place: int, number: int, visible: np.ndarray) -> list[Pose]:
        generator = random_generator(self.seed, "part", self.part.name, place, number)
        here, space = self.places_m[place], self.scene.still
        return fitted_poses(self.part, self._points, visible, here, space, number, generator)

    def _proposals(self, poses: list[Pose]) -> Proposals:
        rows = [self._density(pose, self.scene.visible(pose.origin_m)) for pose in poses]
        return Proposals(poses, np.stack(rows))

    def _density(self, pose: Pose, visible: np.ndarray) -> np.ndarray:
        offset = observed_point(self._points) - pose.origin_m
        range_m = np.linalg.norm(offset, axis=1)
        low, high = self.scene.space.low[RANGE], self.scene.space.high[RANGE]
        near, far = self.part.range_m
        inside = (range_m > 0) & (range_m >= max(near, low)) & (range_m <= min(far, high))
        inside[inside] = in_view(self.part, (offset[inside] / range_m[inside, None]) @ pose.frame.T)
        return np.where(inside, visible, 0.0) / np.where(inside, np.square(range_m), 1.0)

    def _worth(self, density: np.ndarray) -> float:
        """Mean log density over the scene points [nats]; the clutter is that of the middle of the design space."""
        middle = (self.scene.space.low[RANGE] + self.scene.space.high[RANGE]) / 2
        return float(np.log((1 - CLUTTER) * density + CLUTTER / middle**2).mean())

    def _greedy(self, proposals: Proposals, number: int) -> list[Pose]:
        taken: list[int] = []
        total = np.zeros(proposals.density.shape[1])
        for count in range(1, number + 1):
            # a part counts once it is there: the shares of the first ones are not those of the last
            worth = [self._worth((total + one) / count) for one in proposals.density]
            taken.append(int(np.argmax(worth)))
            total = total + proposals.density[taken[-1]]
        return _repeated(self.part, [proposals.poses[index] for index in taken])


def _repeated(part: Part, poses: list[Pose]) -> list[Pose]:
    """The same poses; parts that have one in common fire between each other's rays."""
    found: list[Pose] = []
    for pose in dict.fromkeys(poses):
        found += interleaved(part, pose, poses.count(pose))
    return found


def places(space: DesignSpace) -> np.ndarray:
    """Origins that are tried: the only one, or an even set over the admissible box, shape (M, 3) [m]."""
    low, high = (np.array(bounds[:3], dtype=np.float64) for bounds in (space.low, space.high))
    free = np.flatnonzero(high > low)
    if not len(free):
        return low[None]
    tried = np.tile(low, (PLACES, 1))
    tried[:, free] += low_discrepancy(PLACES, len(free)) * (high - low)[free]
    # the middle is what an engineer would try first
    return np.concatenate([((low + high) / 2)[None], tried])


def fitted_poses(
    part: Part,
    points: np.ndarray,
    weights: np.ndarray,
    origin_m: np.ndarray,
    space: DesignSpace,
    number: int,
    generator: np.random.Generator,
) -> list[Pose]:
    """Poses at an origin from a mixture of components of the part's shape; the likelier of upright and turned.

    Arguments:
        part: The part.
        points: Design points that saw the scene points, shape (N, 6).
        weights: How visible these are from the origin, shape (N,).
        origin_m: Shape (3,).
        space: The design space.
        number: How many poses.
        generator: Source of the seeds.

    Returns:
        The poses; the middle of the admissible directions where next to nothing is visible.
    """
    here = replace(space, low=(*origin_m, *space.low[3:]), high=(*origin_m, *space.high[3:]))
    shapes = shapes_of(part, here)
    aimed = here.wrap(aim(np.tile(origin_m, (len(points), 1)), observed_point(points)))
    kept = (weights > 0) & (aimed[:, RANGE] > 0)
    if effective_count(weights[kept]) < LEAST_POINTS:
        middle = (np.array(space.low[3:5]) + np.array(space.high[3:5])) / 2
        return [shapes[0].pose(origin_m, float(middle[0]), float(middle[1]), 0.0, Axes.of(here))]
    features = Features.of(aimed[kept], weights[kept], Axes.of(here), here)
    fits = [_fit(features, here, shape, number, generator) for shape in shapes]
    (mixture, _), shape = max(zip(fits, shapes, strict=True), key=lambda one: one[0][1])
    return [_pose(shape, mixture, row, origin_m, features.axes) for row in range(number)]


def _fit(
    features: Features, space: DesignSpace, shape: PartShape, number: int, generator: np.random.Generator
) -> tuple[Mixture, float]:
    free = bounds_of(Constraints().rules, space, tuple(range(number)), interval_factor(DEFAULT_LEVEL))
    bounds = shaped_bounds(free, [shape] * number, features.axes)
    trace = fit_mixture(features, bounds, generator, restarts=RESTARTS)
    return trace.mixture, trace.log_likelihood


def _pose(shape: PartShape, mixture: Mixture, row: int, origin_m: np.ndarray, axes: Axes) -> Pose:
    azimuth = float(mixture.azimuth_rad[row]) if axes.horizontal else axes.azimuth_rad
    elevation = float(mixture.elevation_rad[row]) if axes.vertical else axes.elevation_rad
    return shape.pose(origin_m, azimuth, elevation, float(mixture.roll_rad[row]), axes)
