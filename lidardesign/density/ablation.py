"""The density without its occlusion term, sampled without learning: what designs are compared with to show its worth.

Independent points of the surfaces are exact weighted samples of it, because its value at them is known: no flow has to
be trained for the ablation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.density.independent import independent_points
from lidardesign.density.settings import DensitySettings
from lidardesign.density.target import build_target
from lidardesign.design.samples import Samples
from lidardesign.scene import Scene
from lidardesign.space import DesignSpace


def samples_without_visibility(
    scenes: Sequence[Scene], space: DesignSpace, settings: DensitySettings, count: int, generator: np.random.Generator
) -> Samples:
    """Weighted samples of the density with T = 1 everywhere, at most `count`; log_prob is known up to a constant.

    Arguments:
        scenes: The training scenes.
        space: The design space.
        settings: Sigma and what goes with it.
        count: The number of draws; those that leave the space are dropped.
        generator: Of all draws.
    """
    target = build_target(scenes, space, settings, "off")
    points, log_density = independent_points(target, scenes, count, generator)
    return Samples(points, log_density, target.log_density(points), space)
