"""Baselines, each at the number of rays or in the bandwidth that a test asks for, and scenes for them."""

from __future__ import annotations

import numpy as np
from lidardesign.scoring.baselines.simple import Baselines

from lidardesign.scenes.scene import Body, Scene, Sphere, rigid


def balls(centre, radius=0.4, jitter=0.05, count=3, seed=8):
    """Scenes of a ball each, about a place."""
    shifts = np.random.default_rng(seed).normal(0, jitter, (count, 3))
    return [
        Scene((Body(Sphere(radius), "ball", "both", rigid(translation_m=centre + shift)),), f"ball {index}")
        for index, shift in enumerate(shifts)
    ]


class SceneBaselines(Baselines):
    """Baselines that are judged by the share of rays without a return, and whose `greedy` is `uniform`."""

    def __init__(self, space, train, seed, judge=None, **options):
        options.setdefault("chosen", lambda views: self.candidates("uniform")[0])
        super().__init__(space, train, seed, judge or self.missing, **options)

    def missing(self, lists):
        return [1 - self.returned(one) / max(len(self.views.casters) * sum(map(len, one)), 1) for one in lists]

    def returned(self, positions):
        found = [
            (rays, caster.first_hit(rays.origin_m, rays.direction))
            for rays in positions
            for _, caster in self.views.casters
        ]
        return sum(
            np.sum((hit.range_m >= rays.gate_m[:, 0]) & (hit.range_m < rays.gate_m[:, 1])) for rays, hit in found
        )

    def positions(self, name, count):
        return self.best([(name, self.options(name, count))])[0].positions

    def positions_within(self, name, limit_mbps, bandwidth):
        return self.best([(name, self.options_within(name, limit_mbps, bandwidth))])[0].positions
