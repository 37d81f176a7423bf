"""Ground truth of visible boxes from a robot's position, and assignment of its returns to boxes.

All bodies are boxes with a vertical axis, so the sensor's vertical plane cuts each in a rectangle. Between
neighbouring elevations of rectangles' corners a ray's first hit is on the same rectangle: one ray per such step finds
all visible boxes exactly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign import AZIMUTH, ELEVATION, RANGE, ConfigError, DesignSpace, Information, Metric, Returns, Scene, Score

PERCENT = 100.0
# Largest step between neighbouring elevations, to which the ends of the design space's range cut faces.
LARGEST_STEP_RAD = math.radians(0.5)
# Smallest angle of a visible box in all, 0.2 mm at 2 m: smaller slivers depend on rounding.
SMALLEST_VISIBLE_RAD = 1e-4
# A return is on the nearest surface in its plane, unless that is further away than this: several times the range
# error of a single-photon detector (50 ps, 7.5 mm), less than half of the lowest box.
ON_FACE_M = 0.02


@dataclass(frozen=True, eq=False)
class PlaneCut:
    """Cut of a scene by the sensor's vertical plane, in coordinates (distance, height above the sensor).

    Arguments:
        body: Indices of the cut bodies, shape (B,).
        low: Nearest distance and lowest height of each [m], shape (B, 2).
        high: Furthest distance and largest height [m], shape (B, 2).
        is_box: Mask of target boxes, shape (B,).
    """

    body: np.ndarray
    low: np.ndarray
    high: np.ndarray
    is_box: np.ndarray

    def first_hits(self, elevation_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of rays from the sensor: rows of rectangles (-1 on a miss) and ranges [m], both (N,)."""
        if not len(self.body):
            return np.full(len(elevation_rad), -1), np.full(len(elevation_rad), np.inf)
        ray = np.stack([np.cos(elevation_rad), np.sin(elevation_rad)], axis=-1)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            entry, leave = self.low / ray, self.high / ray
        near = np.fmin(entry, leave).max(axis=-1)
        far = np.fmax(entry, leave).min(axis=-1)
        range_m = np.where((near <= far) & (far >= 0), np.where(near >= 0, near, far), np.inf)
        row = range_m.argmin(axis=1)
        nearest = range_m[np.arange(len(row)), row]
        return np.where(np.isfinite(nearest), row, -1), nearest

    def distance_m(self, points: np.ndarray) -> np.ndarray:
        """Distance of points in the plane to every rectangle's outline, (N, 2) to (N, B)."""
        outside = np.maximum(self.low - points[:, None], points[:, None] - self.high)
        deepest = outside.max(axis=-1)
        return np.where(deepest > 0, np.linalg.norm(np.maximum(outside, 0), axis=-1), -deepest)


def cut_scene(scene: Scene, origin_m: np.ndarray, azimuth_rad: float) -> PlaneCut:
    """Cut of a scene of upright boxes by the half plane from an origin (3,) [m] towards an azimuth [rad]."""
    poses = np.array([body.pose() for body in scene.bodies]).reshape(-1, 4, 4)
    half = np.array([body.shape.half_extents_m for body in scene.bodies]).reshape(-1, 3)
    near, far = _crossed(poses, half[:, :2], origin_m, np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0]))
    rows = np.flatnonzero(near < far)
    middle, reach = poses[rows, 2, 3] - origin_m[2], half[rows, 2]
    low, high = np.stack([near[rows], middle - reach], axis=1), np.stack([far[rows], middle + reach], axis=1)
    return PlaneCut(rows, low, high, np.array([scene.bodies[row].is_target for row in rows], dtype=bool))


def _crossed(
    poses: np.ndarray, half_m: np.ndarray, origin_m: np.ndarray, forward: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges at which a horizontal line from the origin enters and leaves the footprints of boxes, (B,) each [m].

    On a miss it leaves before it enters.
    """
    start = np.einsum("bji,bj->bi", poses[:, :3, :2], origin_m - poses[:, :3, 3])
    along = np.einsum("bji,j->bi", poses[:, :3, :2], forward)
    is_parallel, is_between = along == 0, np.abs(start) <= half_m
    step = np.where(is_parallel, 1.0, along)
    ends = np.sort([(-half_m - start) / step, (half_m - start) / step], axis=0)
    enters = np.where(is_parallel, np.where(is_between, 0.0, np.inf), ends[0])
    leaves = np.where(is_parallel, np.where(is_between, np.inf, -np.inf), ends[1])
    return np.maximum(enters.max(axis=1, initial=0.0), 0.0), leaves.min(axis=1, initial=np.inf)


def visible_boxes(cut: PlaneCut, space: DesignSpace) -> np.ndarray:
    """Ascending body indices of the boxes that are visible to some admissible ray of the plane, shape (V,).

    One ray is cast for each step of elevations with the same first hit.
    """
    low, high = space.low[ELEVATION], space.high[ELEVATION]
    corners = [np.arctan2(z, s) for s in (cut.low[:, 0], cut.high[:, 0]) for z in (cut.low[:, 1], cut.high[:, 1])]
    even = np.linspace(low, high, math.ceil((high - low) / LARGEST_STEP_RAD) + 1)
    edges = np.unique(np.clip(np.concatenate([*corners, even]), low, high))
    row, range_m = cut.first_hits((edges[:-1] + edges[1:]) / 2)
    seen = (row >= 0) & (range_m >= space.low[RANGE]) & (range_m <= space.high[RANGE])
    seen[seen] = cut.is_box[row[seen]]
    bodies, box = np.unique(cut.body[row[seen]], return_inverse=True)
    return bodies[np.bincount(box, np.diff(edges)[seen], len(bodies)) >= SMALLEST_VISIBLE_RAD]


@dataclass(frozen=True, eq=False)
class BoxTruth(Mapping[str, list[np.ndarray]]):
    """Visible boxes (`visible`) and all boxes in the plane (`standing`) per robot position.

    Each is a list of body indices per position, computed at first use: learning does not use it.

    Arguments:
        scene: The scene without a truth.
        space: The design space, with a fixed azimuth.
        origins_m: Origins of the sensor at the evaluated positions, shape (P, 3).
    """

    scene: Scene
    space: DesignSpace
    origins_m: np.ndarray

    @cached_property
    def cuts(self) -> list[PlaneCut]:
        """Cut of the scene at every position."""
        return [self._cut(origin) for origin in self.origins_m]

    @cached_property
    def visible(self) -> list[np.ndarray]:
        """Body indices of the boxes that are visible to an admissible ray, per position."""
        return [visible_boxes(cut, self.space) for cut in self.cuts]

    @cached_property
    def standing(self) -> list[np.ndarray]:
        """Body indices of all boxes in the plane, per position."""
        return [cut.body[cut.is_box] for cut in self.cuts]

    def any_visible(self) -> bool:
        """True if a box is visible from any position; stops at the first one."""
        return any(len(visible_boxes(self._cut(origin), self.space)) for origin in self.origins_m)

    def _cut(self, origin_m: np.ndarray) -> PlaneCut:
        return cut_scene(self.scene, origin_m, self.space.low[AZIMUTH])

    def __getitem__(self, key: str) -> list[np.ndarray]:
        if key not in ("visible", "standing"):
            raise KeyError(key)
        return getattr(self, key)

    def __iter__(self) -> Iterator[str]:
        return iter(("visible", "standing"))

    def __len__(self) -> int:
        return 2


def seen_boxes(cut: PlaneCut, points_m: np.ndarray, origin_m: np.ndarray, azimuth_rad: float) -> np.ndarray:
    """Ascending body indices of the boxes that measured points (N, 3) [m] are on.

    See `boxes_of`.
    """
    boxes = np.unique(boxes_of(cut, points_m, origin_m, azimuth_rad))
    return boxes[boxes >= 0]


def boxes_of(cut: PlaneCut, points_m: np.ndarray, origin_m: np.ndarray, azimuth_rad: float) -> np.ndarray:
    """Body index of the box that each measured point (N, 3) [m] is on, -1 for none, shape (N,).

    A point is on the nearest outline in the plane, box or not, if it is within `ON_FACE_M` of the outline and of the
    plane.
    """
    if not len(cut.body):
        return np.full(len(points_m), -1)
    offset = points_m - origin_m
    forward = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
    aside = np.abs(offset[:, 0] * forward[1] - offset[:, 1] * forward[0])
    distance = cut.distance_m(np.stack([offset[:, :2] @ forward, offset[:, 2]], axis=-1))
    nearest = distance.argmin(axis=1)
    on_face = np.maximum(distance.min(axis=1), aside) <= ON_FACE_M
    return np.where(on_face & cut.is_box[nearest], cut.body[nearest], -1)


def miss_score(metric: Metric, scene: Scene, returns: Sequence[Returns]) -> Score:
    """Share of visible (box, position) pairs without a return on the box [%].

    A design without a single return fails. Details: `returns`, `boxes` (visible pairs), `boxes_seen`, and
    `hidden_percent`, the share of boxes in the plane that are visible to no admissible ray.

    Raises:
        ConfigError: The number of returns is not the number of evaluated positions.
    """
    truth = scene.truth
    missed = sum(map(len, missed_boxes(scene, returns)))
    boxes, standing = sum(map(len, truth.visible)), sum(map(len, truth.standing))
    count = sum(int(one.returned.sum()) for one in returns)
    details = {
        "returns": float(count),
        "boxes": float(boxes),
        "boxes_seen": float(boxes - missed),
        "hidden_percent": PERCENT * (1 - boxes / standing),
    }
    if not count:
        return Score(metric.worst, failed=True, details=details)
    return Score(PERCENT * (1 - (boxes - missed) / boxes), details=details)


def missed_boxes(scene: Scene, returns: Sequence[Returns]) -> list[np.ndarray]:
    """Body indices of the visible boxes without a return, per position.

    Raises:
        ConfigError: The number of returns is not the number of evaluated positions.
    """
    truth = scene.truth
    _require_positions(scene, returns)
    azimuth = truth.space.low[AZIMUTH]
    return [
        np.setdiff1d(visible, seen_boxes(cut, one.points_m, origin, azimuth))
        for one, cut, origin, visible in zip(returns, truth.cuts, truth.origins_m, truth.visible, strict=True)
    ]


def _require_positions(scene: Scene, returns: Sequence[Returns]) -> None:
    """Refuse a number of returns that is not that of the evaluated positions."""
    positions = len(scene.truth.origins_m)
    if len(returns) != positions:
        raise ConfigError(
            f"{len(returns)} lists of returns", where=f"scene {scene.name}", allowed=f"{positions} positions"
        )


def box_information(scene: Scene, returns: Sequence[Returns]) -> Information:
    """Information of returns on visible boxes: a single one gives full information of a box at a position.

    Raises:
        ConfigError: The number of returns is not the number of evaluated positions.
    """
    truth = scene.truth
    _require_positions(scene, returns)
    rays, items, frames, known = [], [], [], 0
    for one, cut, origin, visible in zip(returns, truth.cuts, truth.origins_m, truth.visible, strict=True):
        item = np.full(len(scene.bodies) + 1, -1)  # the last is for no box
        item[visible] = known + np.arange(len(visible))
        of_ray = item[boxes_of(cut, one.points_m, origin, truth.space.low[AZIMUTH])]
        rays.append(np.flatnonzero(one.returned)[of_ray >= 0])
        items.append(of_ray[of_ray >= 0])
        frames.append(np.full(len(visible), len(frames)))
        known += len(visible)
    ray = np.concatenate(rays)
    return Information(ray, np.concatenate(items), np.ones(len(ray)), np.concatenate(frames))
