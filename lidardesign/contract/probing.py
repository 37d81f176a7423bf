"""Rays that see a scene's targets, and what becomes of their returns when they are disturbed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.scenes.surface import sample_body
from lidardesign.space import AZIMUTH, ELEVATION, FARTHEST_M, RANGE, DesignSpace, aim, direction

DRAW_ROUNDS = 12
# Of a scene that moves, so many frames are aimed at.
MOST_FRAMES = 8
# Half the gate where the space fixes the range, as a share of it.
HALF_GATE = 0.05
SEED = 20_251


def rays_at_targets(scene: Scene, space: DesignSpace, casters: Sequence[SceneCaster], count: int) -> Rays:
    """Rays of a design space to visible points of targets, even over their area, listening all the way.

    Arguments:
        scene: Whose targets; of moving ones, places in several frames.
        space: The design space at one condition value.
        casters: One per frame.
        count: How many at most; fewer where little can be seen.
    """
    generator = np.random.default_rng(SEED)
    frames = np.unique(np.linspace(0, scene.frames - 1, min(scene.frames, MOST_FRAMES)).astype(int))
    found: list[np.ndarray] = []
    for _ in range(DRAW_ROUNDS):
        for frame in frames:
            per = -(-count // len(frames))
            found.append(rays_that_meet(scene, space, casters[frame], int(frame), per, generator))
        if sum(map(len, found)) >= count:
            break
    return full_rays(generator.permutation(np.concatenate(found))[:count], space)


def full_rays(points: np.ndarray, space: DesignSpace) -> Rays:
    """Rays of design points (N, 6) that listen over the whole range of a design space."""
    low, high = space.low[RANGE], space.high[RANGE]
    gate = (low, high) if low < high else (low * (1 - HALF_GATE), high * (1 + HALF_GATE))
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    count = len(points)
    return Rays(points[:, :3], looking, np.tile(gate, (count, 1)), np.zeros(count), np.zeros(count))


def rays_that_meet(
    scene: Scene, space: DesignSpace, caster: SceneCaster, frame: int, count: int, generator: np.random.Generator
) -> np.ndarray:
    """Rays of a design space towards targets that meet a target first, observed design points of shape (K, 6).

    Arguments:
        scene: Whose targets, at one of its frames.
        space: The design space at one condition value.
        caster: Of that frame.
        frame: Its number.
        count: How many are tried.
        generator: Draws origins and places.
    """
    origins = space.sample(count, generator)[:, :3]
    points = sample_body([body for body in scene.bodies if body.is_target], space, count, generator, frame).points
    design = aim(origins, points)
    low, high = np.array(space.low), np.array(space.high)
    # a space of fewer dimensions hardly ever holds the ray to a point drawn in all three
    design = np.where(low == high, low, design)
    hits = caster.first_hit(design[:, :3], direction(design[:, AZIMUTH], design[:, ELEVATION]))
    design[:, RANGE] = np.where(np.isfinite(hits.range_m), hits.range_m, 2 * FARTHEST_M)
    kept = np.array([*(body.is_target for body in scene.bodies), False])[hits.body] & space.contains(design)
    return design[kept]


def shuffled(returns: Sequence[Returns], generator: np.random.Generator) -> list[Returns]:
    """The same returns with their rays in another order, each list in one of its own."""
    return [returns_of_rays(one, generator.permutation(len(one.rays))) for one in returns]


def returns_of_rays(returns: Returns, chosen: np.ndarray) -> Returns:
    """The returns of the rays at an index or mask."""
    columns = (returns.outcome[chosen], returns.range_m[chosen], returns.body[chosen])
    return Returns(returns.rays.subset(chosen), *columns, returns.frame)


def without_returns(returns: Sequence[Returns]) -> list[Returns]:
    """The same rays, none of which received anything."""
    return [
        Returns(
            one.rays,
            np.full_like(one.outcome, Outcome.MISS),
            np.full_like(one.range_m, np.nan),
            np.full_like(one.body, -1),
            one.frame,
        )
        for one in returns
    ]
