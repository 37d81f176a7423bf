"""The task landing: a drone descends to a landing place and must see the boxes that stand around it.

The drone's height is a condition: its sensors fire other rays from 6 m than from 2 m, and the score is a mean over
heights. The task shows conditions, bodies that only block rays, optional motion, and what returns tell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np
from lidardesign import Defaults, DesignSpace, Information, Metric, Returns, Scene, Score, Split, random_generator

from lidardesign_landing.config import LandingConfig
from lidardesign_landing.hazards import FEWEST_RETURNS, Seen, on_hazards, seen
from lidardesign_landing.scenes import build_scene

PERCENT = 100.0
# From straight down to so far below the horizon.
FLATTEST_RAD = -0.35
HEIGHTS = 3


class LandingTask:
    """Find what stands around a landing place."""

    name: ClassVar[str] = "landing"
    summary: ClassVar[str] = "a descending drone looks for boxes around its landing place"
    api_version: ClassVar[int] = 1
    Config: ClassVar[type[LandingConfig]] = LandingConfig
    metric: ClassVar[Metric] = Metric("missed hazards", "%", "lower", worst=PERCENT, tolerance=1.0)
    defaults: ClassVar[Defaults] = Defaults(
        rays=(64, 128, 256), density={"sigma_m": 0.1}, learning={"draft": {"steps": 800}}
    )

    def space(self, config: LandingConfig) -> DesignSpace:
        """Rays downward from above the landing place; the height is given, direction and range are designed."""
        low, high = config.height_m
        return DesignSpace(
            low=(0.0, 0.0, low, 0.0, -math.pi / 2, 0.1),
            high=(0.0, 0.0, high, 2 * math.pi, FLATTEST_RAD, 2.5 * high),
            condition=("z_m",),
        )

    def conditions(self, config: LandingConfig) -> list[dict[str, float]]:
        """The heights that designs are judged at, from the top down."""
        low, high = config.height_m
        return [{"z_m": float(height)} for height in np.linspace(high, low, HEIGHTS)]

    def scenes(self, config: LandingConfig, split: Split, seed: int) -> Sequence[Scene]:
        """Random boxes; a generator per scene, so that more scenes keep the first ones."""
        count = config.train if split == "train" else config.test
        return [
            build_scene(config, f"{split} {index}", random_generator(seed, self.name, split, index))
            for index in range(count)
        ]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """The mean error over heights and frames [%]; nothing seen is everything missed."""
        found = list(looks(scene, returns))
        details = {
            "phantoms": float(np.mean([len(one.phantoms_m) for one in found])),
            "raised returns": float(np.mean([one.raised for one in found])),
        }
        return Score(PERCENT * float(np.mean([one.error for one in found])), details=details)

    def informs(self, scene: Scene, returns: Sequence[Returns]) -> Information:
        """Which returns are of which hazards, for choosing rays: items are hazards, anew at each height and frame."""
        shown = [on_hazards(scene, one.points_m, one.frame) for one in returns]
        found = [np.nonzero(near) for near in shown]
        hazards = len(shown[0])
        item = np.concatenate([look * hazards + hazard for look, (hazard, _) in enumerate(found)])
        ray = np.concatenate(
            [np.flatnonzero(one.returned)[point] for one, (_, point) in zip(returns, found, strict=True)]
        )
        frame = np.repeat(np.arange(len(returns)), hazards)
        counts = np.arange(FEWEST_RETURNS + 1.0)
        return Information(ray, item, np.ones(len(ray)), frame, sums=counts, complete=FEWEST_RETURNS, unit="returns")


def looks(scene: Scene, returns: Sequence[Returns]) -> Iterator[Seen]:
    """What each look shows: all frames at the first height, then those at the next."""
    for one in returns:
        yield seen(scene, one.points_m, one.frame)
