"""The task street: sensors on a car's roof must see the road users around it, each by a few returns.

What a choice of rays is worth is the mean of min(n, 5) / 5 over road users, n the returns of each: the fifth return on
one is its last that tells anything.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from lidardesign import Defaults, DesignSpace, Information, Metric, Returns, Scene, Score, Split, random_generator

from lidardesign_street.config import StreetConfig
from lidardesign_street.scenes import BANDS_M, build_scene
from lidardesign_street.users import FEWEST_RETURNS, distances_m, on_users

PERCENT = 100.0
LOWEST_RAD, HIGHEST_RAD = math.radians(-35.0), math.radians(15.0)
NEAREST_M, FARTHEST_M = 1.0, 60.0


class StreetTask:
    """Find the road users around a car."""

    name: ClassVar[str] = "street"
    summary: ClassVar[str] = "sensors on a car's roof look for cars, cyclists and pedestrians in a street"
    api_version: ClassVar[int] = 1
    Config: ClassVar[type[StreetConfig]] = StreetConfig
    metric: ClassVar[Metric] = Metric("missed road users", "%", "lower", worst=PERCENT, tolerance=1.0)
    defaults: ClassVar[Defaults] = Defaults(
        rays=(500, 1000, 2000), density={"sigma_m": 2.0}, learning={"draft": {"steps": 500}}
    )

    def space(self, config: StreetConfig) -> DesignSpace:
        """Rays from above the roof all around, from the street beside the car to a little above the horizon."""
        low, high = config.origin_box_m
        return DesignSpace(low=(*low, 0.0, LOWEST_RAD, NEAREST_M), high=(*high, 2 * math.pi, HIGHEST_RAD, FARTHEST_M))

    def scenes(self, config: StreetConfig, split: Split, seed: int) -> Sequence[Scene]:
        """Random moments; a generator per scene, so that more scenes keep the first ones."""
        count = config.train if split == "train" else config.test
        return [
            build_scene(config, f"{split} {index}", random_generator(seed, self.name, split, index))
            for index in range(count)
        ]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """The share of road users with too few returns [%], also by how far they are."""
        user, _ = on_users(scene, returns[0].points_m)
        distance = distances_m(scene)
        missed = PERCENT * (np.bincount(user, minlength=len(distance)) < FEWEST_RETURNS)
        band = np.digitize(distance, [high for _, high in BANDS_M[:-1]])
        details = {
            f"{low:g}-{high:g} m [%]": float(missed[band == number].mean())
            for number, (low, high) in enumerate(BANDS_M)
            if (band == number).any()
        }
        return Score(float(missed.mean()), details=details)

    def informs(self, scene: Scene, returns: Sequence[Returns]) -> Information:
        """Which returns are of which road users, for choosing rays: items are road users."""
        user, point = on_users(scene, returns[0].points_m)
        ray = np.flatnonzero(returns[0].returned)[point]
        counts = np.arange(FEWEST_RETURNS + 1.0) / FEWEST_RETURNS
        frame = np.zeros(len(scene.truth["centre_m"]), dtype=np.int64)
        return Information(ray, user, np.ones(len(ray)), frame, sums=counts, unit="road users")
