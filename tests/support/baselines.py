"""Methods, each at the number of rays or in the bandwidth that a test asks for, and scenes for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.errors import InfeasibleError
from lidardesign.methods.returns import returns_of
from lidardesign.problem.method import METHODS, design_by
from lidardesign.problem.problem import Problem
from lidardesign.problem.world import World
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Body, Scene, Sphere, rigid
from lidardesign.scoring.fired import fired

NO_RAYS = Rays(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty(0), np.empty(0))


def balls(centre, radius=0.4, jitter=0.05, count=3, seed=8):
    """Scenes of a ball each, about a place."""
    shifts = np.random.default_rng(seed).normal(0, jitter, (count, 3))
    return [
        Scene((Body(Sphere(radius), "ball", "both", rigid(translation_m=centre + shift)),), f"ball {index}")
        for index, shift in enumerate(shifts)
    ]


@dataclass(frozen=True, eq=False)
class SceneWorld(World):
    """Scenes without a task, in which rays are judged by the share of them without a return, or by a function."""

    judge: Callable | None = None

    @cached_property
    def conditions(self):
        return [{}]

    def losses(self, lists, count, devices=None):
        return self.judge(lists) if self.judge else [self.missing(one) for one in lists]

    def missing(self, positions):
        casters = [caster for _, caster in returns_of(self).casters]
        found = [(rays, caster.first_hit(rays.origin_m, rays.direction)) for rays in positions for caster in casters]
        returned = sum(
            np.sum((hit.range_m >= rays.gate_m[:, 0]) & (hit.range_m < rays.gate_m[:, 1])) for rays, hit in found
        )
        return 1 - returned / max(len(casters) * sum(map(len, positions)), 1)


def problem_of(space, train, seed=0, judge=None, **changes):
    """A problem in a world of scenes without conditions."""
    return Problem(SceneWorld(None, None, space, seed, train, judge=judge), **changes)


def rays_of(name, problem):
    """The rays of the design that a method makes for a problem."""
    try:
        design = design_by(METHODS.load(name), problem).design
    except InfeasibleError:
        return NO_RAYS
    (rays,) = fired(design, design.count)
    return rays
