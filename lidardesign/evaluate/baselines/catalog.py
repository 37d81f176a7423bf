"""The baseline `catalog:NAME`: a real part of the catalogue, or several of it, where they see most.

NAME is a part, `PART:MODE`, or the path of a part file. A part fires its own pattern with its own range; of fewer rays
than it has, it fires those that look where the density is, evenly spread, and more rays take more parts. Outside the
design space's range no task has anything to tell, so its read-out stops there. The pose is the likeliest admissible
one (see `part_poses`), or what `catalog:NAME@X,Y,Z,AZIMUTH,ELEVATION,ROLL` says (metres and degrees, the roll may be
left out). Several parts stand where they are likeliest together, or at the likeliest pose of one, side by side or with
their rays interleaved: whichever scores best on training scenes.

A part is bolted onto what moves: where the density has conditions, its pose goes with their values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.catalog.library import find_part
from lidardesign.design.catalog.part import Part
from lidardesign.design.catalog.placing import Pose, interleaved, part_rays, parts_for, side_by_side
from lidardesign.design.sensor import MOST_RAYS
from lidardesign.design.snap.shapes import gate_inside, worth_firing
from lidardesign.errors import ConfigError
from lidardesign.evaluate.baselines.candidates import Positions, whole_range
from lidardesign.evaluate.baselines.observed import TrainingViews, dense_points
from lidardesign.evaluate.baselines.part_poses import POINTS, PosedPart, Retarget, ScenePoints
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import EPSILON, systematic_draw
from lidardesign.samples import Samples
from lidardesign.space import FARTHEST_M, DesignSpace
from lidardesign.task import random_generator

FAMILY = "catalog"
POSE_NUMBERS = (5, 6)
FORM = "NAME@X,Y,Z,AZIMUTH,ELEVATION[,ROLL] in metres and degrees"


class Density(NamedTuple):
    """What a run has learned, for baselines that look where it is.

    Arguments:
        samples: Its samples.
        retarget: log p* of other design points, (N, 6) to (N,); None where nothing can be asked.
    """

    samples: Samples
    retarget: Retarget | None = None


class Surroundings(Protocol):
    """What a part is placed by: see `lidardesign.evaluate.baselines.simple.Baselines`."""

    space: DesignSpace
    seed: int
    views: TrainingViews
    density: Callable[[], Density | None] | None

    @property
    def scene_points(self) -> ScenePoints:
        """What parts are to see."""
        ...


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
        numbers = [float(one) for one in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in POSE_NUMBERS or not np.isfinite(numbers).all() or abs(numbers[4]) > 90:
        raise ConfigError(f"{text!r} is no pose", where=f"catalog:{name}", allowed=FORM)
    if np.abs(numbers[:3]).max() > FARTHEST_M:
        allowed = f"at most {FARTHEST_M:g} m along each axis"
        raise ConfigError(f"{text!r} is too far away", where=f"catalog:{name}", allowed=allowed)
    azimuth, elevation, roll = (math.radians(value) for value in [*numbers[3:], 0.0][:3])
    return part, Pose(np.array(numbers[:3]), azimuth, elevation, roll)


def part_candidates(source: Surroundings, argument: str) -> list[PartCandidate]:
    """The ways to place as many parts as some rays take.

    Raises:
        ConfigError: The part measures nothing in the design space's range, or there is nothing to look at.
    """
    part, given = split_argument(argument)
    if gate_inside(part, source.space) is None:
        near, far = part.range_m
        low, high = whole_range(source.space)
        raise ConfigError(
            f"{part.name} measures from {near:g} to {far:g} m, and the design space is {low:g} to {high:g} m away",
            where=f"catalog:{argument}",
            hint="a part that measures there: lidardesign catalog list",
        )
    scene = source.scene_points
    if given is not None:
        return [PartCandidate("given", part, scene, lambda number: interleaved(part, given, number))]
    posed = PosedPart(part, scene, source.seed)
    return [
        PartCandidate("apart", part, scene, posed.best),
        PartCandidate("interleaved", part, scene, lambda number: interleaved(part, posed.best(1)[0], number)),
        PartCandidate("side by side", part, scene, lambda number: side_by_side(part, posed.best(1)[0], number)),
    ]


def part_notes(rows: Sequence[tuple[str, Positions]]) -> list[str]:
    """How many parts the rows of `catalog:NAME` took, by their names and rays; silent where one was enough."""
    parts: dict[str, dict[int, int]] = {}
    for name, positions in rows:
        if name.startswith(f"{FAMILY}:"):
            parts.setdefault(name, {})[len(positions[0])] = len(np.unique(positions[0].sensor))
    return [
        f"{name} is {', '.join(f'{number} parts at {rays} rays' for rays, number in found.items() if number > 1)}"
        for name, found in parts.items()
        if max(found.values()) > 1
    ]


def scene_points(source: Surroundings) -> ScenePoints:
    """Scene points of the learned density; of training returns where no run has samples.

    Raises:
        ConfigError: Nothing returns from the training scenes either.
    """
    density = None if source.density is None else source.density()
    generator = random_generator(source.seed, "catalog")
    if density is not None:
        samples = density.samples
        drawn = systematic_draw(samples.weights, POINTS, generator)
        return ScenePoints(samples.points[drawn], samples.log_target[drawn], source.space, density.retarget)
    found = source.views.hits(dense_points(source.space)).points
    if not len(found):
        raise ConfigError("nothing returns from the training scenes: no pose is better than another", where="catalog")
    drawn = systematic_draw(np.ones(len(found)), POINTS, generator)
    return ScenePoints(source.space.wrap(found[drawn]), np.zeros(POINTS), source.space)


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

    def positions(self, spaces: Sequence[DesignSpace], count: int, scene: int = 0) -> Positions:
        """See `lidardesign.evaluate.baselines.candidates.Candidate`."""
        rays = self._rays(count)
        return tuple(_carried(rays, space, self.scene.travelled) for space in spaces)

    def positions_within(self, spaces: Sequence[DesignSpace], limit_mbps: float, bandwidth: Bandwidth) -> Positions:
        """See `lidardesign.evaluate.baselines.candidates.Candidate`.

        Raises:
            ConfigError: More rays than any sensor fires fit in.
        """
        width_m = np.diff(self.gate_m)
        count = math.floor(limit_mbps / bandwidth.mbps_of_widths(width_m) * (1 + EPSILON))
        if count > MOST_RAYS:
            raise ConfigError(
                f"a design of {limit_mbps:.3g} Mbit/s compares with {count:.3g} rays of {self.part.name}",
                where="bandwidth",
                allowed=f"at most {MOST_RAYS:,} rays",
            )
        while count and bandwidth.mbps_of_widths(width_m, count) > limit_mbps:
            count -= 1
        return self.positions(spaces, count)

    @property
    def gate_m(self) -> np.ndarray:
        """The part's ranges inside the design space's, which hears its own end, shape (2,)."""
        low, high = whole_range(self.scene.space)
        near, far = self.part.range_m
        return np.array([max(near, low), min(far, high)])

    def _rays(self, count: int) -> Rays:
        if count not in self._known:
            self._known[count] = self._fired(count)
        return self._known[count]

    def _fired(self, count: int) -> Rays:
        poses = self._poses(parts_for(self.part, count))
        points = self.scene.brought_back()
        even = np.ones(len(points))
        shares = [count // len(poses) + (index < count % len(poses)) for index in range(len(poses))]
        lists = [
            part_rays(self.part, pose, share, wanted=worth_firing(self.part, pose, points, even, least=share))
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
    """The rays where what carries the part stands in a space."""
    origin = rays.origin_m.copy()
    origin[:, axes] = np.array(space.low)[axes]
    return Rays(origin, rays.direction, rays.gate_m, rays.sensor, rays.time_s)
