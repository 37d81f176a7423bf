"""What rays return on the targets of the training scenes, at a bounded cost for scenes that move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.design.layouts.grid import low_discrepancy
from lidardesign.evaluate.baselines.candidates import RAY_AXES, Positions, whole_range
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.numerics import wrap_turn
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, ELEVATION, FULL_TURN, RANGE, DesignSpace, direction, observed_point

DENSE_RAYS = 4096  # per scene and frame: the ends of the central 99 % then rest on 20 rays in each
MOST_VIEWS = 128  # scenes times frames that are looked at: evenly spread where there are more


@dataclass(frozen=True, eq=False)
class Observed:
    """What rays return on targets.

    Arguments:
        points: Design points with a return, the azimuth unrolled to one arc, shape (K, 6).
        hits_m: Where they hit, shape (K, 3).
    """

    points: np.ndarray
    hits_m: np.ndarray


class TrainingViews:
    """The training scenes at up to `MOST_VIEWS` of their frames, evenly spread over scenes and time.

    Arguments:
        space: The design space.
        train: The training scenes.
    """

    def __init__(self, space: DesignSpace, train: Sequence[Scene]) -> None:
        self.space, self.train = space, train

    @cached_property
    def casters(self) -> list[tuple[Scene, SceneCaster]]:
        """A caster per scene and frame, built once."""
        chosen = [(self.train[index], frame) for index, frame in spread_frames(self.train)]
        return [(scene, SceneCaster(scene, frame)) for scene, frame in chosen]

    def hits(self, points: np.ndarray) -> Observed:
        """What rays at (N, 5 or 6) return on targets inside the space's range, over all views."""
        lowest, highest = whole_range(self.space)
        looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
        kept = [np.zeros((0, 6))]
        for scene, caster in self.casters:
            found = caster.first_hit(points[:, :3], looking)
            target = np.array([*(body.is_target for body in scene.bodies), False])[found.body]
            seen = target & (found.range_m >= lowest) & (found.range_m < highest)
            kept.append(np.column_stack([points[seen, :RAY_AXES], found.range_m[seen]]))
        design = np.concatenate(kept)
        spots = observed_point(design)
        if self.space.full_azimuth:
            design[:, AZIMUTH] = unrolled(design[:, AZIMUTH])
        return Observed(design, spots)

    def missing_returns(self, lists: Sequence[Positions]) -> list[float]:
        """The share of rays without a return inside their gate, over all views."""
        return [self._missing(positions) for positions in lists]

    def _missing(self, positions: Positions) -> float:
        returned = fired = 0
        for rays in positions:
            for _, caster in self.casters:
                range_m = caster.first_hit(rays.origin_m, rays.direction).range_m
                returned += int(((range_m >= rays.gate_m[:, 0]) & (range_m < rays.gate_m[:, 1])).sum())
                fired += len(rays)
        return 1.0 - returned / max(fired, 1)


def spread_frames(scenes: Sequence[Scene], most: int = MOST_VIEWS) -> list[tuple[int, int]]:
    """All (scene, frame), or `most` of them evenly spread."""
    every = [(index, frame) for index, scene in enumerate(scenes) for frame in range(scene.frames)]
    if len(every) <= most:
        return every
    # the middles of equal shares: no scene's first frame is favoured
    return [every[int((i + 0.5) * len(every) / most)] for i in range(most)]


def dense_points(space: DesignSpace) -> np.ndarray:
    """Dense rays over the space, even in its own measure, shape (DENSE_RAYS, 6)."""
    unit = np.full((DENSE_RAYS, len(space.free)), -1.0)
    axes = [i for i, dimension in enumerate(space.free) if dimension != RANGE]
    unit[:, axes] = 2 * low_discrepancy(DENSE_RAYS, len(axes)) - 1
    return space.from_unit(unit)


def unrolled(azimuth_rad: np.ndarray) -> np.ndarray:
    """Azimuths moved by whole turns onto one arc that starts behind the widest gap, shape (K,)."""
    if not len(azimuth_rad):
        return azimuth_rad
    turned = np.sort(wrap_turn(azimuth_rad))
    gaps = np.diff(np.append(turned, turned[0] + FULL_TURN))
    start = turned[(int(np.argmax(gaps)) + 1) % len(turned)]
    return wrap_turn(azimuth_rad, start)
