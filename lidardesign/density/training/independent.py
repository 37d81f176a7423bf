"""Points that know nothing of the flow, with the density that they were drawn from: for balancing and for coverage.

- Targets of primitives or moving bodies, both angles free: scene points drawn exactly in proportion to the sum of the
  bodies' surface terms, each observed from a uniform origin. Weights p* / q are then the visible share over r^2.
- Meshes at rest, both angles free: the shell around the surfaces (`shell`).
- An angle fixed: hardly any surface point can be aimed at from a given origin, but few dimensions are free, so uniform
  points of the space are resampled by the surface proximity, which is then their density; with more free dimensions
  uniform rays are traced (`proposals`).
- The range fixed: hardly any surface point is that far from a given origin. Uniform points are resampled, too.

The density without its occlusion term, sampled without learning: what designs are compared with to show its worth.

Independent points of the surfaces are exact weighted samples of it, because its value at them is known: no flow has to
be trained for the ablation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.target.frames import FramesTarget, near_pairs, row_log_sums
from lidardesign.density.target.target import Target, build_target
from lidardesign.density.training.proposals import log_chart_factor, propose, shell_proposals
from lidardesign.numerics import normalised_weights
from lidardesign.samples import Samples
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, observed_point

# Up to so many free dimensions, uniform candidates meet the surfaces often enough to be resampled.
RESAMPLED_DIMENSIONS = 3
CANDIDATES = 131_072
# Surfaces that fill less than a millionth of the space are given up.
CANDIDATE_ROUNDS = 8
FARTHEST_SIGMAS = 6.0
# Scene points are proposed this far around bounding boxes; the surface term is below e^-12 beyond.
REACH_SIGMAS = 5.0
DRAWS_AT_ONCE = 262_144
# Bodies so thin beside their boxes that fewer draws than this share hit their surface are drawn in vain.
MOST_ROUNDS = 400
# Few origins of a wide ceiling may see a point under the space's angles: each point is tried from several.
ORIGINS_PER_POINT = 4
AIMING_ROUNDS = 8
TERM_TOLERANCE_NATS = 16.0
ROWS_AT_ONCE = 4096


def independent_points(
    target: Target, scenes: Sequence[Scene], count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 6) inside the space, at most `count`, and their log density per chart volume up to a constant.

    Empty where no ray of the space comes near a target.
    """
    space, sigma_m = target.space, target.optics.sigma_m
    if RANGE not in space.free:
        return resampled_proposals(target, count, generator)
    if AZIMUTH in space.free and ELEVATION in space.free:
        if isinstance(target, FramesTarget) and np.isfinite(target.field.low).all():
            return proximity_proposals(target, count, generator)
        if not isinstance(target, FramesTarget):
            return shell_proposals(target.field, scenes, space, count, sigma_m, generator)
    elif len(space.free) <= RESAMPLED_DIMENSIONS:
        return resampled_proposals(target, count, generator)
    proposals = propose(scenes, space, count, sigma_m, generator)
    return proposals.points, proposals.log_density


def resampled_proposals(
    target: Target, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Uniform points resampled by surface proximity, (count, 6), and their log density up to a constant, (count,).

    Empty where no candidate comes within `FARTHEST_SIGMAS` of any surface.
    """
    for _ in range(CANDIDATE_ROUNDS):
        candidates = target.space.sample(CANDIDATES, generator)
        log_proximity = target.log_proximity(candidates)
        near = log_proximity > target.log_peak - FARTHEST_SIGMAS**2 / 2
        if near.any():
            break
    candidates, log_proximity = candidates[near], log_proximity[near]
    if not len(candidates):
        return candidates, log_proximity
    chosen = generator.choice(len(candidates), size=count, p=normalised_weights(log_proximity))
    return candidates[chosen], log_proximity[chosen]


def proximity_proposals(
    target: FramesTarget, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Scene points in proportion to the surface terms of all bodies, seen from uniform origins."""
    parts, missing = [], count
    for _ in range(AIMING_ROUNDS):
        parts.append(_aimed(target, missing, generator))
        missing -= len(parts[-1])
        if missing <= 0:
            break
    points = np.concatenate(parts)[:count]
    return points, _log_proposal_density(target, points)


def _aimed(target: FramesTarget, count: int, generator: np.random.Generator) -> np.ndarray:
    """Admissible design points among `count` scene points seen from uniform origins each of them several times."""
    space = target.space
    surface = np.repeat(draw_near_surfaces(target, count, generator), ORIGINS_PER_POINT, axis=0)
    points = space.wrap(aim(space.sample(len(surface), generator)[:, :3], surface))
    kept = space.contains(points) & (points[:, RANGE] > 0)
    return points[kept]


def _log_proposal_density(target: FramesTarget, points: np.ndarray) -> np.ndarray:
    """log of the sum over bodies of weight * exp(-d^2 / (2 sigma^2)) per chart volume, up to a constant, (N,)."""
    sigma_m, observed = target.optics.sigma_m, observed_point(points)
    bodies = target.field.apart()
    weights = target.log_column_weights[target.field.column]
    log_density = np.empty(len(points))
    for start in range(0, len(points), ROWS_AT_ONCE):
        rows = slice(start, min(start + ROWS_AT_ONCE, len(points)))
        pairs = near_pairs(bodies, observed[rows], weights, sigma_m, TERM_TOLERANCE_NATS)
        log_density[rows] = row_log_sums(weights[pairs.columns] - np.square(pairs.distances / sigma_m) / 2, pairs)[0]
    return log_density + 2 * np.log(points[:, RANGE]) + log_chart_factor(target.space, points)


def draw_near_surfaces(target: FramesTarget, count: int, generator: np.random.Generator) -> np.ndarray:
    """Scene points (at most count, 3) whose density is the sum over bodies of weight * exp(-d^2 / (2 sigma^2)).

    Uniform points of the bodies' padded boxes, each box as often as its weight times its volume, are kept with the
    probability of their own body's term: no body's integral is needed.
    """
    from lidardesign.density.fields import body_kernels

    bodies, sigma_m = target.field, target.optics.sigma_m
    low, high = bodies.low - REACH_SIGMAS * sigma_m, bodies.high + REACH_SIGMAS * sigma_m
    mass = np.exp(target.log_column_weights[bodies.column]) * (high - low).prod(axis=1)
    cumulated = np.cumsum(mass / mass.sum())
    found: list[np.ndarray] = []
    for _ in range(MOST_ROUNDS):
        body = np.searchsorted(cumulated, generator.random(DRAWS_AT_ONCE), side="right").clip(max=len(bodies) - 1)
        points = generator.uniform(low[body], high[body])
        distances = np.empty(len(points))
        body_kernels.distances_of(*bodies.shapes, body, points, distances)
        found.append(points[generator.random(len(points)) < np.exp(-np.square(distances / sigma_m) / 2)])
        if sum(map(len, found)) >= count:
            break
    return np.concatenate(found)[:count]


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
