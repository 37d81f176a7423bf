"""Flatland: the two-dimensional scenes of the paper's figures 2 and 3, in seconds.

The plane z = 0 of an ordinary 3D world. Sensors sit on the line y = 0 and look up (+y), so that of the six
dimensions only x in [0, 1] m, azimuth in [pi/4, 3 pi/4] and range in [0, 1.2] m are free (Behari et al. 2026,
figure 3). A surface is a chain of capsules lying in the plane; discs are spheres cut by it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from lidardesign import (
    Body,
    Capsule,
    Defaults,
    DesignSpace,
    Information,
    Metric,
    Returns,
    Scene,
    SceneCaster,
    Score,
    Sphere,
    Split,
    aim,
    metrics,
    random_generator,
    rigid,
    surface_information,
)
from lidardesign_tasks.surroundings import Surroundings

MILLIMETRES = 1000.0
BUMP_VERTICES = np.array([-1.5, -0.9, -0.4, 0.0, 0.4, 0.9, 1.5])  # bends of the curve, in widths of the bump
LARGEST_GAP_M = 0.15  # neighbouring returns further apart than this belong to different curves
TRUTH_STEP_M = 0.004  # a fifth of the density's sigma
ITEMS = 200  # points of the curve for choosing rays
TRUTH_ORIGINS = 17  # positions on the sensor line from which visibility is tested
# closed forms of primitives are exact to rounding; neighbouring truth points are 40 times further apart
SAME_POINT_M = 1e-4


class FlatlandConfig(Surroundings):
    """Type, number and variation of the scenes, and their surroundings."""

    scene: Literal["surface", "discs", "occluded"] = Field(
        "surface", description="a bumpy curve, two discs, or the curve behind an occluding disc"
    )
    train: int = Field(20, ge=1, le=10_000, description="training scenes")
    test: int = Field(20, ge=1, le=10_000, description="held-out scenes")
    variation: float = Field(1.0, gt=0, le=2, description="how much scenes differ")


class FlatlandTask:
    """Reconstruct a curve in the plane from returns of sensors on a line below it."""

    name: ClassVar[str] = "flatland"
    summary: ClassVar[str] = "2D scenes in a 3D design space (x, azimuth, range): the paper's figures 2 and 3"
    api_version: ClassVar[int] = 1
    Config: ClassVar[type[FlatlandConfig]] = FlatlandConfig
    metric: ClassVar[Metric] = Metric("Chamfer distance", "mm", "lower", worst=500.0, tolerance=0.5)
    defaults: ClassVar[Defaults] = Defaults(
        rays=(8, 16, 32, 64),
        density={"sigma_m": 0.02},
        learning={"draft": {"samples": 20_000}, "standard": {"samples": 50_000}, "fine": {"samples": 100_000}},
    )

    def space(self, config: FlatlandConfig) -> DesignSpace:
        """The paper's three free dimensions; y, z and elevation are 0."""
        return DesignSpace(low=(0.0, 0.0, 0.0, math.pi / 4, 0.0, 0.0), high=(1.0, 0.0, 0.0, 3 * math.pi / 4, 0.0, 1.2))

    def scenes(
        self, config: FlatlandConfig, split: Split, seed: int, space: DesignSpace | None = None
    ) -> Sequence[Scene]:
        """Random scenes of one class; each has a generator of its own, so counts do not change them."""
        space = space or self.space(config)
        count = config.train if split == "train" else config.test
        return [
            build_scene(config, space, f"{split} {index}", random_generator(seed, "flatland", split, index))
            for index in range(count)
        ]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Symmetric Chamfer distance [mm] between the curve through the returns and the visible curve."""
        points = measured_points(returns)
        curve = reconstruct_curve(points)
        if curve is None:
            return Score(self.metric.worst, failed=True, details={"returns": float(len(points))})
        value = MILLIMETRES * metrics.chamfer_m(curve, scene.truth["curve_m"])
        return Score(min(value, self.metric.worst), details={"returns": float(len(points))})

    def informs(self, scene: Scene, returns: Sequence[Returns], share: float) -> Information:
        """Information of returns about points of the visible curve, larger for nearer points."""
        curve = in_space(scene.truth["curve_m"])
        points = curve[np.linspace(0, len(curve) - 1, min(ITEMS, len(curve))).astype(int)]
        is_target = [body.is_target for body in scene.bodies]
        length_m = TRUTH_STEP_M * len(curve) * len(returns)
        points_m = [points] * len(returns)
        return surface_information(points_m, returns, is_target, length_m, dimensions=1, share=share)


def measured_points(returns: Sequence[Returns]) -> np.ndarray:
    """The returns of all frames in the plane, shape (N, 2) [m]."""
    return np.concatenate([frame.points_m for frame in returns])[:, :2]


def in_space(points: np.ndarray) -> np.ndarray:
    """Points (N, 2) of the plane z = 0 as points (N, 3) [m]."""
    return np.column_stack([points, np.zeros(len(points))])


def build_scene(config: FlatlandConfig, space: DesignSpace, name: str, generator: np.random.Generator) -> Scene:
    """One scene with its truth: the points of target outlines that an admissible ray sees, (K, 2) [m]."""
    build = discs if config.scene == "discs" else surface
    bodies = build(config.variation, generator)
    if config.scene == "occluded":
        bodies = (*bodies, occluder(config.variation, generator))
    scene = Scene(bodies, name)
    return config.around(Scene(bodies, name, truth={"curve_m": visible_outline(scene, space)}))


def surface(variation: float, generator: np.random.Generator) -> tuple[Body, ...]:
    """A curve with one bump whose place, height and width differ between scenes, and a few waves."""
    ends = np.array([0.15, 0.85]) + np.clip(variation * generator.normal(0.0, 0.015, 2), -0.03, 0.03)
    height = 0.80 + variation * generator.normal(0.0, 0.02)
    tilt = variation * generator.normal(0.0, 0.08)
    # bounded so that the bump stays between the ends
    centre = 0.45 + np.clip(variation * generator.normal(0.0, 0.04), -0.06, 0.06)
    width = 0.09 * math.exp(np.clip(variation * generator.normal(0.0, 0.15), -0.35, 0.35))
    bump = 0.14 * math.exp(variation * generator.normal(0.0, 0.2))
    x = np.array([ends[0], *(centre + width * BUMP_VERTICES), ends[1]])
    y = height + tilt * (x - 0.5) - bump * np.exp(-(((x - centre) / width) ** 2))
    for wave, amplitude in enumerate(variation * generator.normal(0.0, 0.008, 3), start=1):
        y = y + amplitude * np.sin(2 * math.pi * wave * x + generator.uniform(0, 2 * math.pi))
    return chain(np.stack([x, y], axis=1), radius_m=0.01)


def discs(variation: float, generator: np.random.Generator) -> tuple[Body, ...]:
    """A small disc on the left and a larger one further up on the right."""
    placed = []
    for name, centre, radius in (("left", (0.30, 0.65), 0.09), ("right", (0.68, 0.80), 0.13)):
        middle = np.array(centre) + variation * generator.normal(0.0, 0.025, 2)
        placed.append(disc(name, middle, radius * math.exp(variation * generator.normal(0.0, 0.08)), "both"))
    return tuple(placed)


def occluder(variation: float, generator: np.random.Generator) -> Body:
    """A disc between the sensor line and the curve, which blocks rays and is no target."""
    middle = np.array([0.62, 0.35]) + variation * generator.normal(0.0, 0.02, 2)
    return disc("occluder", middle, 0.07, "occluder")


def disc(name: str, centre: np.ndarray, radius_m: float, role: Literal["both", "occluder"]) -> Body:
    """A sphere with its centre in the plane z = 0."""
    return Body(Sphere(float(radius_m)), name, role, rigid(translation_m=(*centre, 0.0)))


def chain(vertices: np.ndarray, radius_m: float) -> tuple[Body, ...]:
    """Capsules along a polyline in the plane z = 0, vertices of shape (V, 2) [m]."""
    bodies = []
    for index, (start, end) in enumerate(itertools.pairwise(vertices)):
        length = float(np.linalg.norm(end - start))
        along, normal = np.append((end - start) / length, 0.0), np.array([0.0, 0.0, 1.0])
        rotation = np.stack([np.cross(normal, along), normal, along], axis=1)
        pose = rigid(rotation, (*((start + end) / 2), 0.0))
        bodies.append(Body(Capsule(radius_m, length / 2), f"segment {index}", "both", pose))
    return tuple(bodies)


def outline(body: Body) -> np.ndarray:
    """Points on the cut of a sphere or capsule with the plane z = 0, `TRUTH_STEP_M` apart, shape (K, 2)."""
    half_length = body.shape.half_length_m if isinstance(body.shape, Capsule) else 0.0
    radius = body.shape.radius_m
    turn = np.linspace(0.0, math.pi, math.ceil(math.pi * radius / TRUTH_STEP_M) + 1)
    cap = np.stack([radius * np.cos(turn), half_length + radius * np.sin(turn)], axis=1)
    side = np.linspace(-half_length, half_length, math.ceil(2 * half_length / TRUTH_STEP_M) + 1)[1:-1]
    half = np.concatenate([cap, np.stack([np.full(len(side), radius), side], axis=1)])
    # the other half is the first one turned by half a turn; columns are across and along the capsule's axis
    across, along = np.concatenate([half, -half]).T
    pose = body.pose()
    axis = pose[:2, 2] if isinstance(body.shape, Capsule) else np.array([0.0, 1.0])
    return pose[:2, 3] + across[:, None] * np.array([-axis[1], axis[0]]) + along[:, None] * axis


def visible_outline(scene: Scene, space: DesignSpace) -> np.ndarray:
    """Points of target outlines that are the first hit of some admissible ray, shape (K, 2) [m]."""
    points = np.concatenate([outline(body) for body in scene.bodies if body.is_target])
    flat = in_space(points)
    origins = np.linspace(space.low[:3], space.high[:3], TRUTH_ORIGINS)
    design = aim(np.repeat(origins, len(flat), axis=0), np.tile(flat, (len(origins), 1)))
    seen = space.contains(design)
    directions = (np.tile(flat, (len(origins), 1)) - design[:, :3]) / design[:, 5:]
    hits = SceneCaster(scene).first_hit(design[seen, :3], directions[seen])
    seen[seen] = np.abs(hits.range_m - design[seen, 5]) < SAME_POINT_M
    return points[seen.reshape(len(origins), -1).any(axis=0)]


def reconstruct_curve(points: np.ndarray) -> np.ndarray | None:
    """Points along straight lines between returns in the order of x, shape (K, 2); `None` below two returns.

    Seen from below a curve is a height over x. Neighbours more than `LARGEST_GAP_M` apart are not joined.
    """
    if len(points) < 2:
        return None
    points = points[np.lexsort((points[:, 1], points[:, 0]))]
    along = np.diff(points, axis=0)
    length = np.linalg.norm(along, axis=1)
    steps = np.where(length <= LARGEST_GAP_M, np.ceil(length / TRUTH_STEP_M), 1.0).clip(min=1.0)
    inner = steps.astype(int) - 1
    line = np.repeat(np.arange(len(inner)), inner)
    number = np.arange(1, len(line) + 1) - np.repeat(np.cumsum(inner) - inner, inner)
    between = points[line] + (number * (1.0 / steps)[line])[:, None] * along[line]
    return np.concatenate([points, between])
