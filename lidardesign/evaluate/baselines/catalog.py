r"""The baseline `catalog:NAME`: a real part of the catalogue, or several of it, where they see most.

NAME is a part, `PART:MODE`, or the path of a part file. A part fires its own pattern with its own range; of fewer rays
than it has, it fires those that look where the density is, evenly spread, and more rays take more parts. Outside the
design space's range no task has anything to tell, so its read-out stops there. The pose is the likeliest admissible
one, or what `catalog:NAME@X,Y,Z,AZIMUTH,ELEVATION,ROLL` says (metres and degrees, the roll may be left out). Several
parts stand where they are likeliest together, or at the likeliest pose of one, side by side or with their rays
interleaved: whichever scores best on training scenes. A part is bolted onto what moves: where the density has
conditions, its pose goes with their values.

A part that sees a scene point s at the range r puts rays on it in proportion to 1 / (r^2 Omega), with Omega the solid
angle that its rays share; one that does not see it puts none. So k parts have the density
$q(s) = \frac{1}{k} \sum_j \frac{v_j(s)}{r_j(s)^2}$ up to a constant, with v how visible s is from their place. The
poses maximise the mean of log(q + clutter) over scene points drawn from the learned density; the clutter keeps
points that no part sees from deciding alone. Proposals are the components of mixtures of the part's shape, fitted
where it may stand; they are taken one after the other, each time the one that gains most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.catalog.library import Pose, find_part, interleaved, part_rays, parts_for, side_by_side
from lidardesign.design.catalog.part import Part
from lidardesign.design.catalog.shapes import (
    PartShape,
    gate_inside,
    in_part_view,
    shaped_bounds,
    shapes_of,
    useful_ray_filter,
)
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.layouts.grid import low_discrepancy
from lidardesign.design.mixture.bounds import bounds_of
from lidardesign.design.mixture.em import fit_mixture
from lidardesign.design.mixture.features import Axes, Features
from lidardesign.design.mixture.mixture import Mixture
from lidardesign.design.sensor import DEFAULT_LEVEL, MOST_RAYS, interval_factor
from lidardesign.errors import BackgroundNote, ConfigError
from lidardesign.evaluate.baselines.candidates import RaysPerCondition, rays_within, whole_range
from lidardesign.evaluate.baselines.views import TrainingViews, dense_points
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import effective_count, systematic_draw
from lidardesign.run.clock import phase
from lidardesign.run.yaml import plain_number
from lidardesign.samples import Samples
from lidardesign.space import AZIMUTH, DIMENSIONS, FARTHEST_M, RANGE, DesignSpace, aim, observed_point
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
        ends = enumerate(zip(self.space.low, self.space.high, strict=True))
        high = tuple(low if axis in self.travelled else high for axis, (low, high) in ends)
        kept = tuple(name for name in self.space.condition if DIMENSIONS.index(name) not in self.travelled)
        return replace(self.space, high=high, condition=kept)

    def brought_back(self) -> np.ndarray:
        """The design points as they are seen from what carries them, at its first place, shape (N, 6)."""
        back = self.points.copy()
        back[:, self.travelled] = np.array(self.space.low)[self.travelled]
        return back

    def visible(self, origin_m: np.ndarray) -> np.ndarray:
        """How visible each scene point is from an origin, relative to where it was seen from, (N,) in [0, 1]."""
        origins = np.tile(origin_m, (len(self.points), 1))
        origins[:, self.travelled] = self.points[:, self.travelled]
        if self.retarget is None or np.array_equal(origins, self.points[:, :3]):
            return np.ones(len(self.points))
        place = tuple(map(float, origin_m))
        if place not in self._seen:
            aimed = self.space.wrap(aim(origins, observed_point(self.points)))
            with np.errstate(invalid="ignore"):
                gain = np.asarray(self.retarget(aimed), dtype=np.float64) - self.log_target
            self._seen[place] = np.exp(np.minimum(np.where(np.isnan(gain), -np.inf, gain), 0.0))
        return self._seen[place]


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
        # one alone, then those that were fitted together
        sizes = dict.fromkeys((1, min(number, MOST_APART)))
        every = [pose for place in self._closer for size in sizes for pose in self._fitted(place, size)]
        return self._greedy(every, number)

    @cached_property
    def _closer(self) -> list[int]:
        """The places from where one part would put most rays on the scene if nothing hid it."""
        if len(self.places_m) <= CLOSER_PLACES:
            return list(range(len(self.places_m)))
        everything = np.ones(len(self._points))
        first = [self._fit(place, 1, everything)[0] for place in range(len(self.places_m))]
        likelihood = [self._log_likelihood(self._density(pose, everything)) for pose in first]
        return sorted(np.argsort(-np.array(likelihood), kind="stable")[:CLOSER_PLACES].tolist())

    def _fitted(self, place: int, number: int) -> list[Pose]:
        if (place, number) not in self._fits:
            self._fits[place, number] = self._fit(place, number, self.scene.visible(self.places_m[place]))
        return self._fits[place, number]

    def _fit(self, place: int, number: int, visible: np.ndarray) -> list[Pose]:
        here, space = self.places_m[place], self.scene.still
        return fitted_poses(
            self.part,
            self._points,
            visible,
            here,
            space,
            number,
            random_generator(self.seed, "part", self.part.name, place, number),
        )

    def _density(self, pose: Pose, visible: np.ndarray) -> np.ndarray:
        offset = observed_point(self._points) - pose.origin_m
        range_m = np.linalg.norm(offset, axis=1)
        low, high = self.scene.space.low[RANGE], self.scene.space.high[RANGE]
        near, far = self.part.range_m
        inside = (range_m > 0) & (range_m >= max(near, low)) & (range_m <= min(far, high))
        inside[inside] = in_part_view(self.part, (offset[inside] / range_m[inside, None]) @ pose.frame.T)
        return np.where(inside, visible, 0.0) / np.where(inside, np.square(range_m), 1.0)

    def _log_likelihood(self, density: np.ndarray) -> float:
        """Mean log density over the scene points [nats]; the clutter is that of the middle of the design space."""
        middle = (self.scene.space.low[RANGE] + self.scene.space.high[RANGE]) / 2
        return float(np.log((1 - CLUTTER) * density + CLUTTER / middle**2).mean())

    def _greedy(self, poses: Sequence[Pose], number: int) -> list[Pose]:
        """So many of some poses, one after the other that gains most."""
        densities = [self._density(pose, self.scene.visible(pose.origin_m)) for pose in poses]
        taken: list[Pose] = []
        total = np.zeros(len(self._points))
        for count in range(1, number + 1):
            # a part counts once it is there: the shares of the first ones are not those of the last
            best = int(np.argmax([self._log_likelihood((total + one) / count) for one in densities]))
            taken.append(poses[best])
            total = total + densities[best]
        # parts that have a pose in common fire between each other's rays
        return [one for pose in dict.fromkeys(taken) for one in interleaved(self.part, pose, taken.count(pose))]


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
    free = bounds_of(Constraints().rules, here, tuple(range(number)), interval_factor(DEFAULT_LEVEL))
    bounds = [shaped_bounds(free, [shape] * number, features.axes) for shape in shapes]
    fits = [fit_mixture(features, one, generator, restarts=RESTARTS) for one in bounds]
    fit, shape = max(zip(fits, shapes, strict=True), key=lambda one: one[0].log_likelihood)
    return [_pose(shape, fit.mixture, row, origin_m, features.axes) for row in range(number)]


def _pose(shape: PartShape, mixture: Mixture, row: int, origin_m: np.ndarray, axes: Axes) -> Pose:
    azimuth = float(mixture.azimuth_rad[row]) if axes.horizontal else axes.azimuth_rad
    elevation = float(mixture.elevation_rad[row]) if axes.vertical else axes.elevation_rad
    return shape.pose(origin_m, azimuth, elevation, float(mixture.roll_rad[row]), axes)


FAMILY = "catalog"
FORM = "NAME@X,Y,Z,AZIMUTH,ELEVATION[,ROLL] in metres and degrees"


class Density(NamedTuple):
    """What a run has learned, for baselines that look where it is.

    Arguments:
        samples: Its samples.
        retarget: log p* of other design points, (N, 6) to (N,); None where nothing can be asked.
    """

    samples: Samples
    retarget: Retarget | None = None


def split_argument(argument: str) -> tuple[Part, Pose | None]:
    """The part and the pose that `NAME` or `NAME@POSE` names.

    Raises:
        ConfigError: There is no such part, or the pose is not 5 or 6 numbers, or farther away than anything.
    """
    name, at, text = argument.partition("@")
    part = find_part(name)
    if not at:
        return part, None
    try:
        numbers = [plain_number(one) for one in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (5, 6) or not np.isfinite(numbers).all() or abs(numbers[4]) > 90:
        raise ConfigError(f"{text!r} is not a pose", where=f"catalog:{name}", allowed=FORM)
    if np.abs(numbers[:3]).max() > FARTHEST_M:
        raise ConfigError(
            f"{text!r} is too far away",
            where=f"catalog:{name}",
            allowed=f"at most {FARTHEST_M:g} m along each axis",
        )
    azimuth, elevation, roll = (math.radians(value) for value in [*numbers[3:], 0.0][:3])
    return part, Pose(np.array(numbers[:3]), azimuth, elevation, roll)


def part_candidates(
    argument: str, space: DesignSpace, seed: int, points: Callable[[], ScenePoints]
) -> list[PartCandidate]:
    """The ways to place as many parts as some rays take.

    Arguments:
        argument: The part, as `split_argument` reads it.
        space: The design space.
        seed: Root of the random streams.
        points: Gives what the parts are to see.

    Raises:
        ConfigError: The part measures nothing in the design space's range, or there is nothing to look at.
    """
    part, given = split_argument(argument)
    if gate_inside(part, space) is None:
        (near, far), (low, high) = part.range_m, whole_range(space)
        raise ConfigError(
            f"{part.name} measures from {near:g} to {far:g} m, and the design space is {low:g} to {high:g} m away",
            where=f"catalog:{argument}",
            hint="a part that measures there: lidardesign catalog list",
        )
    scene = points()
    if given is not None:
        return [PartCandidate("given", part, scene, lambda number: interleaved(part, given, number))]
    posed = PosedPart(part, scene, seed)
    return [
        PartCandidate("apart", part, scene, posed.best),
        PartCandidate("interleaved", part, scene, lambda number: interleaved(part, posed.best(1)[0], number)),
        PartCandidate("side by side", part, scene, lambda number: side_by_side(part, posed.best(1)[0], number)),
    ]


def part_notes(rows: Sequence[tuple[str, RaysPerCondition]]) -> list[str]:
    """How many parts the rows of `catalog:NAME` took, by their names and rays; silent where one was enough."""
    parts: dict[str, dict[int, int]] = {}
    for name, positions in rows:
        if name.startswith(f"{FAMILY}:"):
            parts.setdefault(name, {})[len(positions[0])] = len(np.unique(positions[0].sensor))
    several = {
        name: [f"{number} parts at {rays} rays" for rays, number in found.items() if number > 1]
        for name, found in parts.items()
    }
    return [BackgroundNote(f"{name} is {', '.join(texts)}") for name, texts in several.items() if texts]


def scene_points(views: TrainingViews, seed: int, density: Density | None) -> ScenePoints:
    """Scene points of the learned density; of training returns where no run has samples.

    Raises:
        ConfigError: Nothing returns from the training scenes either.
    """
    space, generator = views.space, random_generator(seed, "catalog")
    if density is not None:
        samples = density.samples
        drawn = systematic_draw(samples.weights, POINTS, generator)
        return ScenePoints(samples.points[drawn], samples.log_target[drawn], space, density.retarget)
    returned = views.hits(dense_points(space)).points
    if not len(returned):
        raise ConfigError(
            "nothing returns from the training scenes, so no pose is better than another", where="catalog"
        )
    drawn = systematic_draw(np.ones(len(returned)), POINTS, generator)
    return ScenePoints(space.wrap(returned[drawn]), np.zeros(POINTS), space)


class PartCandidate:
    """Parts of a kind as a baseline's layout.

    Arguments:
        name: How several of them stand.
        part: The kind of part.
        scene: What it is to see; decides which rays fire where not all do.
        poses: Poses of any number of parts, with what carries them at its first place.
    """

    drawn_anew = False

    def __init__(self, name: str, part: Part, scene: ScenePoints, poses: Callable[[int], list[Pose]]) -> None:
        self.name, self.part, self.scene, self._poses = name, part, scene, poses
        self._known: dict[int, Rays] = {}

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> RaysPerCondition:
        """See `lidardesign.evaluate.baselines.candidates.Candidate`."""
        if count not in self._known:
            self._known[count] = self._fired(count)
        return tuple(_carried(self._known[count], space, self.scene.travelled) for space in spaces)

    def positions_within(
        self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth
    ) -> RaysPerCondition | None:
        """See `lidardesign.evaluate.baselines.candidates.Candidate`."""
        count = rays_within(limit_mbps, bandwidth, self.gate_m)
        return self.positions(spaces, count) if count <= MOST_RAYS else None

    @property
    def gate_m(self) -> np.ndarray:
        """The part's ranges inside the design space's, which hears its own end, shape (2,)."""
        low, high = whole_range(self.scene.space)
        near, far = self.part.range_m
        return np.array([max(near, low), min(far, high)])

    def _fired(self, count: int) -> Rays:
        poses = self._poses(parts_for(self.part, count))
        points = self.scene.brought_back()
        even = np.ones(len(points))
        shares = [count // len(poses) + (index < count % len(poses)) for index in range(len(poses))]
        lists = [
            part_rays(self.part, pose, share, wanted=useful_ray_filter(self.part, pose, points, even, least=share))
            for pose, share in zip(poses, shares, strict=True)
        ]
        return Rays(
            np.concatenate([rays.origin_m for rays in lists]),
            np.concatenate([rays.direction for rays in lists]),
            np.tile(self.gate_m, (count, 1)),
            np.repeat(np.arange(len(poses)), shares),
            np.concatenate([rays.time_s for rays in lists]),
        )


def _carried(rays: Rays, space: DesignSpace, axes: Sequence[int]) -> Rays:
    origin = rays.origin_m.copy()
    origin[:, axes] = np.array(space.low)[axes]
    return replace(rays, origin_m=origin)
