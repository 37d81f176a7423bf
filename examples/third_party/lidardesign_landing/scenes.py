"""Scenes of the task landing: boxes of all sizes on flat ground, at rest or driving."""

from __future__ import annotations

import numpy as np
from lidardesign import Body, Box, Plane, Scene, rigid

from lidardesign_landing.config import LandingConfig

FRAME_RATE_HZ = 2.0
LARGEST_SPEED_M_S = 1.0
# What is lower is no hazard: see `hazards.RAISED_M`.
LOWEST_M, HIGHEST_M = 0.3, 1.2
NARROWEST_M, WIDEST_M = 0.2, 0.8


def build_scene(config: LandingConfig, name: str, generator: np.random.Generator) -> Scene:
    """One scene; the ground blocks rays and is no surface worth observing."""
    ground = Body(Plane(), "ground", "occluder")
    boxes = [_box(config, f"hazard {number}", generator) for number in range(config.hazards)]
    return Scene((ground, *boxes), name, frame_rate_hz=FRAME_RATE_HZ)


def _box(config: LandingConfig, name: str, generator: np.random.Generator) -> Body:
    """A box that stands on the ground, turned about the vertical."""
    width, depth = generator.uniform(NARROWEST_M, WIDEST_M, 2)
    height = generator.uniform(LOWEST_M, HIGHEST_M)
    x, y = generator.normal(0.0, config.spread_m, 2)
    heading, speed = generator.uniform(-np.pi, np.pi), generator.uniform(0.0, LARGEST_SPEED_M_S)
    cosine, sine = np.cos(heading), np.sin(heading)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    poses = rigid(rotation, (x, y, height / 2))
    if config.moving:
        travel_m = speed * np.arange(config.frames) / FRAME_RATE_HZ
        poses = np.stack([rigid(rotation, (x + s * cosine, y + s * sine, height / 2)) for s in travel_m])
    return Body(Box((width / 2, depth / 2, height / 2)), name, "both", poses)
