"""How much of a random run's design space listens near a target: plain distances to spheres and capsules."""

from __future__ import annotations

import numpy as np

from lidardesign.scene import Body, Capsule, Scene
from lidardesign.space import DesignSpace, observed_point
from lidardesign.task import random_generator
from soak.plans import RunPlan
from soak.scaled_flatland import ScaledFlatlandConfig, ScaledFlatlandTask

POINTS = 20_000
# Beyond so many spreads the surface term is below 2e-8.
NEAR_SIGMAS = 6.0


def share_near_targets(plan: RunPlan) -> float:
    """The share of even design points whose scene point lies near a target of any training scene."""
    space = DesignSpace.from_dict({"condition": (), **plan.config["space"]})
    config = ScaledFlatlandConfig.model_validate(plan.config["task"])
    scenes = ScaledFlatlandTask().scenes(config, "train", plan.seed, space)
    points = observed_point(space.sample(POINTS, random_generator(plan.seed, "soak", "sight")))
    near = NEAR_SIGMAS * plan.config["density"]["sigma_m"]
    return float(np.any([distance_to_targets(scene, points) < near for scene in scenes], axis=0).mean())


def distance_to_targets(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Distances of points (N, 3) from the surface of the nearest target, shape (N,) [m]."""
    return np.min([np.abs(_signed_distance(body, points)) for body in scene.bodies if body.is_target], axis=0)


def _signed_distance(body: Body, points: np.ndarray) -> np.ndarray:
    pose = body.pose()
    half_length = body.shape.half_length_m if isinstance(body.shape, Capsule) else 0.0
    offset = points - pose[:3, 3]
    along = np.clip(offset @ pose[:3, 2], -half_length, half_length)
    return np.linalg.norm(offset - along[:, None] * pose[:3, 2], axis=1) - body.shape.radius_m
