"""The methods `uniform` and `random`: rays over the whole design space, with the whole range as their gate.

Rays of `uniform` are even on the sphere. Free origin axes join the layout: two free axes in all give a grid, more a
low-discrepancy set. Those of `random` are uniform in the measure of the design space, drawn anew for every scene.
"""

from __future__ import annotations

import numpy as np

from lidardesign.methods.laid_out import LaidOut, Layout, Site, even_layout
from lidardesign.methods.returns import whole_range
from lidardesign.problem.problem import Problem
from lidardesign.task import random_generator


def random_layout(problem: Problem) -> Layout:
    """Rays uniform in the measure of the design space."""
    world = problem.world

    def lay_out(count: int, site: Site) -> tuple[np.ndarray, np.ndarray]:
        # the first position draws what a space without conditions draws
        later = [site.number] if site.number else []
        generator = random_generator(world.seed, "random baseline", count, site.draw, *later)
        return site.space.sample(count, generator), whole_range(world.space)

    return Layout("random", lay_out)


UNIFORM = LaidOut(
    "uniform", "even rays over the whole design space", lambda problem: [even_layout(problem.world.space)]
)
RANDOM = LaidOut(
    "random", "other rays in every scene, uniform in the design space", lambda problem: [random_layout(problem)],
    is_redrawn=True,
)  # fmt: skip
