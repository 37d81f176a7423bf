"""Real parts at poses: components of fixed shape, and their information about scenes as candidates.

A part's field of view and range cannot be narrowed, only its pose is free; only outside the design space's range, where
no task has anything, does its read-out stop. It may be mounted upright or turned by a quarter about its boresight. A
component's roll stays within an eighth of a turn, so a part that is turned is a component whose two spreads are
exchanged.

To cast every one of thousands of parts at poses would be millions of rays. Parts at one place share rays: their
directions are binned in cells of a sphere, each cell is cast once from each place, and the information of a part at a
pose is that of the cells of its rays, inside its own gate. Of dense patterns an even subset is used, and of many items
a random draw. Cells are as small as the number of rays to be cast allows. The cell's ray is that of one of the parts,
so that patterns in a plane stay in it.

Under a detector with wide beams a zone is what it is: a few thin beams over the part's own angles, whose light the
detector merges into one return. Parts with the same angle share such rays, in cells of a quarter of it at least.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from lidardesign.constraints.document import SensorRules
from lidardesign.mixture.components import Axes
from lidardesign.numerics import FULL_TURN, SLACK
from lidardesign.parts.catalogue import Pose
from lidardesign.parts.part import Part, to_angles, to_directions
from lidardesign.rays import kernels
from lidardesign.rays.coverage import Coverage, gather
from lidardesign.rays.training_scenes import Informs, SceneInformation
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.pattern import even_subset
from lidardesign.sensors.sensor import boresight_frame, boresight_of
from lidardesign.simulate.detector.physics import IDEAL, Detector, Physics
from lidardesign.simulate.returns import build_casters, simulate_many
from lidardesign.space import RANGE, DesignSpace, angles
from lidardesign.task import random_generator

# What constraints may ask of a part, which it keeps or does not.
BOUNDED = ("field_of_view.horizontal_deg", "field_of_view.vertical_deg", "gate.start_m", "gate.end_m", "gate.width_m")
MOST_CAST = 60_000  # rays of a scene, over all places
MOST_CASTS = 1_000_000  # of a scene, over all its frames
MOST_MEMBERS = 20_000_000  # rays kept of all parts' patterns
MOST_ITEMS = 60  # of a scene: the choice of a few parts needs few
SIZED = 10  # one part in so many is used for the first size of cells
COARSE_CELL_RAD = math.radians(3.0)  # from which the size of cells is found
LEAST_BEAM_RAD = 0.01  # narrower beams count as lines
CELLS_PER_BEAM = 4  # along its width, at most
BEAM_RAYS = 4  # of a wide beam
MOST_PER_BEAM = 1 << 48  # larger than the number of any place and cell


@dataclass(frozen=True, eq=False)
class PartShape:
    """A part in one of its two ways to be mounted.

    Arguments:
        part: The part.
        turned: Whether its horizontal angle runs along the component's vertical one.
        gate_m: The ranges that it measures inside the design space.
    """

    part: Part
    turned: bool
    gate_m: tuple[float, float]

    def pose(self, origin_m: np.ndarray, azimuth_rad: float, elevation_rad: float, roll_rad: float, axes: Axes) -> Pose:
        """The part's pose for a component's origin and boresight, with the centre of its field along the boresight.

        Where the design space holds all rays in a plane, its row or column nearest to the centre lies in that plane.
        """
        roll_rad = roll_rad + math.pi / 2 if self.turned else roll_rad
        frame = boresight_frame(*self._aimed(axes)).T @ boresight_frame(azimuth_rad, elevation_rad, roll_rad)
        return Pose(np.asarray(origin_m, dtype=np.float64), *boresight_of(frame))

    def _aimed(self, axes: Axes) -> tuple[float, float]:
        """Azimuth and elevation, in the part's frame, of the direction aligned with the component's boresight [rad]."""
        part = self.part
        if axes.angular == 2:
            return part.centre_rad
        held = [not axes.vertical, not axes.horizontal] if self.turned else [not axes.horizontal, not axes.vertical]
        found = np.array(part.centre_rad)
        every = to_angles(part.projection, part.directions)
        for axis in np.flatnonzero(held):
            found[axis] = every[np.abs(every[:, axis] - found[axis]).argmin(), axis]
        azimuth, elevation = angles(to_directions(part.projection, found[None]))
        return float(azimuth[0]), float(elevation[0])


def gate_inside(part: Part, space: DesignSpace) -> tuple[float, float] | None:
    """A part's range inside the design space's [m], its own where that is fixed; None where they do not meet."""
    near, far = part.range_m
    if RANGE not in space.free:
        return (near, far) if near <= space.low[RANGE] < far else None
    start, end = max(near, space.low[RANGE]), min(far, space.high[RANGE])
    return (start, end) if start < end else None


def shapes_of(part: Part, space: DesignSpace) -> list[PartShape]:
    """The ways to mount a part: none where it measures nothing inside the space, one where both angles are equal."""
    gate = gate_inside(part, space)
    if gate is None:
        return []
    horizontal, vertical = part.field_of_view_rad
    return [PartShape(part, turned, gate) for turned in ((False, True) if horizontal != vertical else (False,))]


def broken_keys(shape: PartShape, rules: SensorRules) -> set[str]:
    """Keys of the constraints that a part violates."""
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


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """A part at a pose.

    Arguments:
        shape: The part, upright or turned, and the gate of its rays.
        pose: Where it stands and looks.
        place: The number of the mount or origin at which it stands.
        entry: The number of the entry of `each` that it keeps; beyond these, of the rules of all others.
    """

    shape: PartShape
    pose: Pose
    place: int
    entry: int = 0

    @property
    def part(self) -> Part:
        """The kind of part."""
        return self.shape.part


def cells_of(directions: np.ndarray, size_rad: float) -> tuple[np.ndarray, int]:
    """The cell of each unit vector (N, 3) on a sphere of rows of nearly square cells, and how many cells there are."""
    rows = math.ceil(math.pi / size_rad)
    middle = math.pi * ((np.arange(rows) + 0.5) / rows - 0.5)
    columns = np.maximum(np.round(2 * rows * np.cos(middle)), 1).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(columns)])
    x, y, z = directions.T
    row = np.clip(((np.arcsin(np.clip(z, -1.0, 1.0)) / math.pi + 0.5) * rows).astype(np.int64), 0, rows - 1)
    turn = np.mod(np.arctan2(y, x), FULL_TURN) / FULL_TURN
    return first[row] + np.minimum((turn * columns[row]).astype(np.int64), columns[row] - 1), int(first[-1])


class PartBundle:
    """The rays that parts at poses share.

    Arguments:
        placed: The parts.
        most_rays: The largest number of rays of each, an even subset of its pattern.
        frames: Number of casts in a scene.
        detector: The detector; beams are lines where it has no wide ones.

    `rays` are to be cast; those of part i are `members[first[i]:first[i + 1]]`, some more than once. Of them a part
    has `usual_rays` in the middle. Beams are the same between `ends`, each with its `physics`.
    """

    def __init__(self, placed: Sequence[PlacedPart], most_rays: int, frames: int, detector: Detector = IDEAL) -> None:
        self.placed, self.most_rays = placed, most_rays
        self.is_wide = detector.footprint_rays > 1 and detector.divergence_rad > 0
        self._beams = sorted({self._beam(one) for one in placed})
        self.most_pattern = min(most_rays, max(MOST_MEMBERS // len(placed), 1))
        self._patterns: dict[str, np.ndarray] = {}
        size_rad, most = COARSE_CELL_RAD, min(MOST_CAST, MOST_CASTS // frames // (BEAM_RAYS if self.is_wide else 1))
        size_rad *= math.sqrt(len(np.unique(np.concatenate(self._keys(placed[::SIZED], size_rad)))) / most)
        while True:
            keys = self._keys(placed, size_rad)
            cast, index, members = np.unique(np.concatenate(keys), return_index=True, return_inverse=True)
            if len(cast) <= most:
                break
            size_rad *= max(math.sqrt(len(cast) / most), 1.05)
        self.first = np.cumsum([0, *map(len, keys)])
        self.members = members.astype(np.int32)
        self.usual_rays = float(np.median([len(np.unique(key)) for key in keys[::SIZED]]))
        owner = np.searchsorted(self.first, index, side="right") - 1
        origin, looking = np.empty((len(cast), 3)), np.empty((len(cast), 3))
        for part in np.unique(owner):
            own = owner == part
            origin[own] = placed[part].pose.origin_m
            looking[own] = self._looking(placed[part])[index[own] - self.first[part]]
        gate_m = (min(one.shape.gate_m[0] for one in placed), max(one.shape.gate_m[1] for one in placed))
        count, wide = len(cast), replace(detector, footprint_rays=BEAM_RAYS, bins=None)
        self.ends = np.searchsorted(cast, MOST_PER_BEAM * np.arange(len(self._beams) + 1))
        # of beams of an angle a detector merges the light into returns
        self.physics = [
            Physics(replace(wide, divergence_rad=beam), frozenset({"footprint"})) if beam else None
            for beam in self._beams
        ]
        self.rays = Rays(origin, looking, np.tile(gate_m, (count, 1)), np.zeros(count, dtype=np.intp), np.zeros(count))

    def returns(self, scene: Scene) -> list[Returns]:
        """The returns of the rays in a scene, one entry per frame."""
        casters = build_casters(scene)
        groups = [self.rays.subset(slice(*pair)) for pair in itertools.pairwise(self.ends)]
        every = [
            simulate_many(scene, [rays], casters=casters, physics=physics)[0]
            for rays, physics in zip(groups, self.physics, strict=True)
        ]
        joined = [
            [np.concatenate([getattr(one, name) for one in frames]) for name in ("outcome", "range_m", "body")]
            for frames in zip(*every, strict=True)
        ]
        return [Returns(self.rays, *columns, frame=frame) for frame, columns in enumerate(joined)]

    def _beam(self, placed: PlacedPart) -> float:
        """The angle of a part's beams; 0: lines."""
        beam = placed.part.beam_rad
        return beam if self.is_wide and beam >= LEAST_BEAM_RAD else 0.0

    def _looking(self, placed: PlacedPart) -> np.ndarray:
        part = placed.part
        if part.name not in self._patterns:
            rays = part.directions
            self._patterns[part.name] = rays[even_subset(rays, min(len(rays), self.most_pattern))]
        return self._patterns[part.name] @ placed.pose.frame

    def _keys(self, placed: Sequence[PlacedPart], size_rad: float) -> list[np.ndarray]:
        """A number for the cell and place of each ray, by part."""
        keys = []
        for one in placed:
            beam = self._beam(one)
            cell, cells = cells_of(self._looking(one), max(size_rad, beam / CELLS_PER_BEAM))
            keys.append(self._beams.index(beam) * MOST_PER_BEAM + one.place * cells + cell)
        return keys


@phase("what returns tell")
def parts_inform(
    bundle: PartBundle,
    scenes: Iterable[Scene],
    informs: Informs,
    count: int,
    seed: int,
    *,
    first_scene: int = 0,
    among: Sequence[int] | None = None,
) -> list[SceneInformation]:
    """Information of every part, as a candidate, about each scene.

    Arguments:
        bundle: The parts and their rays.
        scenes: Training scenes.
        informs: The task's information of a scene's returns.
        count: Number of parts of a design, on which the information of a return depends.
        seed: Root of the draws of items.
        first_scene: The number of the first scene, for these draws.
        among: Some of the parts, where others are not asked for.
    """
    rows, rays = np.arange(len(bundle.placed)) if among is None else np.array(among), bundle.rays
    placed = [bundle.placed[row] for row in rows]
    own = [bundle.members[bundle.first[row] : bundle.first[row + 1]] for row in rows]
    first, members = np.cumsum([0, *map(len, own)]), bundle.members if among is None else np.concatenate(own)
    gate_m = np.array([one.shape.gate_m for one in placed])
    # rays kept of a dense pattern stand for several each
    fired = np.minimum([one.part.rays for one in placed], bundle.most_rays)
    times = fired / np.minimum(fired, bundle.most_pattern)
    share, told = min(count * bundle.usual_rays / len(rays), 1.0), []
    for number, scene in enumerate(scenes, first_scene):
        returns = bundle.returns(scene)
        informed = SceneInformation.of(informs(scene, returns, share), returns)
        informed = _fewer_items(informed, random_generator(seed, "items of parts", number))
        order = np.argsort(informed.ray, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(informed.ray, minlength=len(rays)))])
        entries = kernels.ByRay(
            start, informed.item[order], informed.worth[order], np.zeros(0, np.uint8), informed.weight, informed.sums
        )
        every = np.empty((len(placed), len(informed.weight)), dtype=np.float32)
        kernels.gather_parts(entries, informed.range_m[order], first, members, gate_m, every)
        if len(informed.sums):
            # beyond its end the table of sums is constant: capping changes no F and tightens bounds
            every = np.minimum(every * times[:, None], len(informed.sums) - 1, dtype=np.float32)
        part, item = np.nonzero(every)
        worth, item, part = every[part, item], item.astype(np.int32), part.astype(np.int32)
        told.append(replace(informed, ray=part, item=item, worth=worth, range_m=np.zeros(len(part))))
    return told


def part_table(informed: Sequence[SceneInformation], parts: int) -> Coverage:
    """The table of `parts` parts, each with one open gate, over all items of scenes."""
    return gather(informed, np.tile([0.0, np.inf], (parts, 1, 1)), np.zeros((parts, 1)))


def _fewer_items(informed: SceneInformation, generator: np.random.Generator) -> SceneInformation:
    """A random draw of the items, without harm, since a part's gate cannot exclude returns."""
    none = {"spoiling": np.zeros(0, np.int32), "harm": np.zeros(0), "harm_range_m": np.zeros(0), "is_repeated": False}
    return replace(informed.with_fewer_items(MOST_ITEMS, generator), **none)
