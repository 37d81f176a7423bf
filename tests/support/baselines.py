"""Baselines, each at the number of rays or in the bandwidth that a test asks for, and scenes for them."""

from __future__ import annotations

import numpy as np

from lidardesign.scenes.scene import Body, Scene, Sphere, rigid
from lidardesign.scoring.baselines.simple import Baselines


def balls(centre, radius=0.4, jitter=0.05, count=3, seed=8):
    """Scenes of a ball each, about a place."""
    shifts = np.random.default_rng(seed).normal(0, jitter, (count, 3))
    return [
        Scene((Body(Sphere(radius), "ball", "both", rigid(translation_m=centre + shift)),), f"ball {index}")
        for index, shift in enumerate(shifts)
    ]


class SceneBaselines(Baselines):
    def positions(self, name, count):
        return self.best([(name, self.options(name, count))])[0].positions

    def positions_within(self, name, limit_mbps, bandwidth):
        return self.best([(name, self.options_within(name, limit_mbps, bandwidth))])[0].positions
