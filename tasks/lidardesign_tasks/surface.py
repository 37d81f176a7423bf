"""The Chamfer score (`surface_score`) and the truth of tasks that reconstruct a surface from returns."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from lidardesign import (
    DesignSpace,
    Information,
    Mesh,
    Metric,
    Returns,
    Scene,
    Score,
    metrics,
    random_generator,
    scattered_area_m2,
    surface_information,
)

MILLIMETRES = 1000.0
RECONSTRUCTION_POINTS = 4000
ITEMS = 200  # points of a surface for choosing rays
COVERED_M = 0.010
# returns further than this from the surface are outliers, unless the points of the surface are further apart
OUTLIER_M = 0.010
METRIC = "metric"
STEEPEST_DEG = 85.0  # flatter triangles bridge depth steps: with dense rays they made up half of the error


@dataclass(frozen=True, eq=False)
class LazyTruth(Mapping[str, Any]):
    """The truth of a scene under one key, computed at first use: learning does not use it.

    Arguments:
        scene: The scene without a truth.
        space: The design space.
        points: Number of points of a cloud.
        seed: Seed of their random positions.
        further: Further entries by key, as the metric under `metric`.
        fewer: Cached truths with other numbers of points.
    """

    key: ClassVar[str]
    scene: Scene
    space: DesignSpace
    points: int
    seed: int
    further: Mapping[str, Any] = field(default_factory=dict)
    fewer: dict[int, LazyTruth] = field(default_factory=dict, init=False, repr=False)

    @abstractmethod
    def find(self) -> Any:
        """Compute the value of the key; raises DataError where no admissible ray sees any target."""

    @cached_property
    def found(self) -> Any:
        """Cached result of `find`."""
        return self.find()

    def __getitem__(self, key: str) -> Any:
        return self.found if key == self.key else self.further[key]

    def __iter__(self) -> Iterator[str]:
        return iter((self.key, *self.further))

    def __len__(self) -> int:
        return 1 + len(self.further)


class VisibleTruth(LazyTruth):
    """The part of the targets that some admissible ray sees: a SurfaceCloud under `surface`."""

    key = "surface"

    def find(self) -> metrics.SurfaceCloud:
        """Compute the visible part of the targets."""
        return metrics.visible_surface(self.scene, self.space, self.points, random_generator(self.seed, "truth"))


def fewer_points(truth: Mapping[str, Any], count: int) -> Mapping[str, Any]:
    """The same truth with `count` points, which are ten times faster to find; other mappings are returned unchanged."""
    return truth.fewer.setdefault(count, replace(truth, points=count)) if isinstance(truth, LazyTruth) else truth


def with_visible_truth(
    scene: Scene, space: DesignSpace, points: int, generator: np.random.Generator, **further: Any
) -> Scene:
    """The scene with its truth: `surface`, the visible part of the targets as a `SurfaceCloud`, and further keys."""
    truth = VisibleTruth(scene, space, points, int(generator.integers(2**62)), further)
    return replace(scene, truth=truth)


def reconstruct(returns: Sequence[Returns], viewpoint_m: np.ndarray | None = None) -> metrics.SurfaceCloud | None:
    """Surface through all returns, triangulated as seen from a viewpoint; `None` where they span none.

    It uses rays and returns only: a return from an occluder inside the gate is taken for surface, and there is no
    surface where several neighbouring rays have no return.

    Arguments:
        returns: Returns of all frames.
        viewpoint_m: Common viewpoint, shape (3,); None: the mean origin of the rays.
    """
    origins = np.concatenate([frame.rays.origin_m for frame in returns])
    if not len(origins):
        return None
    points = np.concatenate([frame.points_m for frame in returns])
    is_one_place = viewpoint_m is None and bool((origins == origins[0]).all())
    viewpoint_m = origins.mean(axis=0) if viewpoint_m is None else viewpoint_m
    if is_one_place:
        # from their own origin, rays are seen in their directions at any range
        spacing = [metrics.ray_spacing(frame.rays.direction)[frame.returned] for frame in returns]
    else:
        spacing = [_spacing(frame, viewpoint_m) for frame in returns]
    surface = metrics.delaunay_surface(points, viewpoint_m, steepest_deg=STEEPEST_DEG, spacing=np.concatenate(spacing))
    if surface is None:
        return None
    return metrics.surface_cloud(*surface, RECONSTRUCTION_POINTS, random_generator(0, "reconstruction"))


def _spacing(frame: Returns, viewpoint_m: np.ndarray) -> np.ndarray:
    """Angular spacing of a frame's rays, seen from a viewpoint, at each of its returns, shape (K,) [rad].

    Rays without a return are placed at the returns' median range.
    """
    hit = frame.returned
    if not hit.any():
        return np.zeros(0)
    range_m = np.where(hit, frame.range_m, np.median(frame.range_m[hit]))
    away = frame.rays.origin_m + range_m[:, None] * frame.rays.direction - viewpoint_m
    length = np.linalg.norm(away, axis=1, keepdims=True)
    return metrics.ray_spacing(np.divide(away, length, out=np.zeros_like(away), where=length > 0))[hit]


def surface_score(metric: Metric, scene: Scene, returns: Sequence[Returns]) -> Score:
    """Chamfer distance of the reconstruction to the visible surface [mm], at most the metric's worst value.

    With a fixed receiver, returns are triangulated as seen from there.

    Details: `returns`, `outliers_percent`, the returns further than 10 mm from the visible surface (than the gaps
    between its points, where those are wider), and `coverage`, the share of the visible surface with the
    reconstruction within 10 mm.
    """
    details = {"returns": float(sum(int(frame.returned.sum()) for frame in returns))}
    viewpoint_m = None if scene.receiver is None else np.array(scene.receiver.origin_m)
    estimate, truth = reconstruct(returns, viewpoint_m), scene.truth["surface"]
    if details["returns"]:
        away_m = truth.distance_m(np.concatenate([frame.points_m for frame in returns]))
        details["outliers_percent"] = 100.0 * float((away_m > max(OUTLIER_M, truth.gap_m)).mean())
    if estimate is None:
        return Score(metric.worst, failed=True, details={**details, "coverage": 0.0})
    missed, wrong = estimate.distance_m(truth.points), truth.distance_m(estimate.points)
    details["coverage"] = float((missed <= COVERED_M).mean())
    return Score(min(MILLIMETRES * float(missed.mean() + wrong.mean()), metric.worst), details=details)


def surface_informs(scene: Scene, returns: Sequence[Returns], share: float) -> Information:
    """Information of returns about points of the visible surface, see `surface_information`."""
    return information_of([fewer_points(scene.truth, ITEMS)["surface"]] * scene.frames, scene, returns, share)


def information_of(
    surfaces: Sequence[metrics.SurfaceCloud | None], scene: Scene, returns: Sequence[Returns], share: float
) -> Information:
    """Information of returns about points of the visible surface of each frame, None where it has none."""
    points = [np.zeros((0, 3)) if surface is None else surface.points for surface in surfaces]
    counts = [importance_at(scene, places, frame) for frame, places in enumerate(points)]
    area_m2 = [scattered_area_m2(places) for places in points]
    return surface_information(
        [points[one.frame] for one in returns],
        returns,
        [body.is_target for body in scene.bodies],
        sum(area_m2[one.frame] for one in returns),
        weight=[counts[one.frame] for one in returns],
        share=share,
    )


def importance_at(scene: Scene, points_m: np.ndarray, frame: int) -> np.ndarray:
    """Importance at points (K, 3) [m] on the targets' meshes, that of the nearest vertex, 1 by default, (K,)."""
    from scipy.spatial import cKDTree

    meshes = [body for body in scene.bodies if body.is_target and isinstance(body.shape, Mesh)]
    if all(body.shape.importance is None for body in meshes):
        return np.ones(len(points_m))
    vertices = [body.shape.vertices @ body.pose(frame)[:3, :3].T + body.pose(frame)[:3, 3] for body in meshes]
    counts = [
        np.ones(len(mesh.vertices)) if mesh.importance is None else mesh.importance
        for mesh in (body.shape for body in meshes)
    ]
    return np.concatenate(counts)[cKDTree(np.concatenate(vertices)).query(points_m)[1]]
