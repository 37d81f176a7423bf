"""What a learned density is worth, measured on fresh samples of it and on points that know nothing of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from lidardesign.density.diagnostics import coverage, quality, quality_by_group
from lidardesign.density.flow import DesignFlow
from lidardesign.density.independent import independent_points
from lidardesign.density.losses import draw_conditions
from lidardesign.density.objective import Coordinates
from lidardesign.density.overlap import Sides, overlap
from lidardesign.density.round_trip import TOLERANCE_NATS, round_trip_nats
from lidardesign.density.target import Target
from lidardesign.design.samples import Samples
from lidardesign.estimates import Estimate
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.space import DesignSpace

SAMPLE_CHUNK = 16384
CONDITION_GROUPS = 32
# So many samples go back to the flow's base.
ROUND_TRIPS = 1000
NOT_COVERED = (
    "coverage could not be measured and counts as 0, and misplaced leaves out what the density dropped: "
    "no independently drawn ray fits in the space"
)


class Learned(Protocol):
    """A flow, the target that it was learned for, and the stream that its samples are drawn from."""

    flow: DesignFlow
    target: Target
    coordinates: Coordinates
    generator: torch.Generator


@dataclass(frozen=True, eq=False)
class Probes:
    """Points that know nothing of a flow.

    Arguments:
        points: Design points inside the space, shape (N, 6).
        log_proposal: log of the density that they were drawn from, up to a constant, shape (N,).
        log_target: log p* at them, shape (N,).
    """

    points: np.ndarray
    log_proposal: np.ndarray
    log_target: np.ndarray


@dataclass(frozen=True, eq=False)
class Measured:
    """Fresh samples of a flow, and its figures with their errors.

    Arguments:
        samples: The samples with both log densities.
        estimates: ess, kl_nats, log_z, coverage, and misplaced: the share of the mass in the wrong place.
        round_trip_nats: See `round_trip`.
        notes: What the user should know.
    """

    samples: Samples
    estimates: dict[str, Estimate]
    round_trip_nats: float = 0.0
    notes: tuple[str, ...] = ()


def draw_probes(target: Target, scenes: Sequence[Scene], count: int, generator: np.random.Generator) -> Probes:
    """At most `count` probes of a target; none where no ray of the space comes near a surface."""
    ranks = target.ranks
    points, log_proposal = map(ranks.of_first, independent_points(target, scenes, count, generator))
    log_target = ranks.spread(target.log_density, points) if len(points) else log_proposal
    return Probes(points, log_proposal, log_target)


@phase("measuring")
def measure(learned: Learned, probes: Probes, count: int) -> Measured:
    """The figures of a flow from `count` fresh samples and from probes.

    Raises:
        NumericalError: A sample has no finite weight.
    """
    samples = draw_samples(learned, count)
    space = samples.space
    groups = condition_groups(space, samples.points)
    found = quality(samples.log_prob, samples.log_target, groups)
    covered, notes = Estimate(0.0, None), []
    sides = Sides(samples.log_weights, samples.log_weights, samples.log_weights, groups, groups)
    if len(probes.points):
        log_prob = log_density_of(learned, probes.points)
        log_z = _log_z_at(probes.points, samples, groups, found.log_z)
        covered = coverage(log_prob, probes.log_target, probes.log_proposal, log_z)
        log_weights = probes.log_target - probes.log_proposal
        theirs = condition_groups(space, probes.points)
        sides = Sides(samples.log_weights, probes.log_target - log_prob, log_weights, groups, theirs)
    else:
        notes.append(NOT_COVERED)
    apart = overlap(sides)
    estimates = {**found.estimates(), "coverage": covered, "misplaced": Estimate(apart.misplaced, apart.error)}
    off = round_trip_nats(learned.flow, ROUND_TRIPS, torch.Generator().manual_seed(0))
    if off > TOLERANCE_NATS:
        notes.append(
            f"log densities are off by up to {off:.2g} nats: the flow's splines are too steep to be inverted in "
            "float64; fewer learning.layers are easier to invert"
        )
    return Measured(samples, estimates, off, tuple(notes))


def draw_samples(learned: Learned, count: int) -> Samples:
    """Fresh samples of the flow with their log density and log target, in chunks."""
    points, log_prob = [], []
    flow, coordinates, ranks = learned.flow, learned.coordinates, learned.target.ranks
    with torch.no_grad():
        for start in range(0, count, SAMPLE_CHUNK):
            size = min(SAMPLE_CHUNK, count - start)
            conditions = draw_conditions(flow, size, learned.generator)
            conditions = None if conditions is None else ranks.part(conditions)
            values, log_density = flow(ranks.part(flow.draw_base(size, learned.generator)), conditions)
            unit = coordinates.join(values, conditions)
            points.append(ranks.gather(coordinates.space.from_unit(unit.cpu().double().numpy()), of=size))
            log_prob.append(ranks.gather(log_density.cpu().double().numpy(), of=size))
    points = np.concatenate(points)
    offset = coordinates.log_condition_density - coordinates.log_unit_volume
    log_target = ranks.spread(learned.target.log_density, points)
    return Samples(points, np.concatenate(log_prob) + offset, log_target, coordinates.space)


def log_density_of(learned: Learned, points: np.ndarray) -> np.ndarray:
    """The flow's log density per chart volume at any design points, (N, 6) to (N,); -inf outside the space."""
    return learned.target.ranks.spread(lambda rows: _log_density_of(learned, rows), points)


def _log_density_of(learned: Learned, points: np.ndarray) -> np.ndarray:
    flow, coordinates = learned.flow, learned.coordinates
    like = next(flow.parameters())
    # points on the space's faces may leave it by rounding
    unit = torch.as_tensor(coordinates.space.to_unit(points).clip(-1.0, 1.0)).to(like)
    conditions = unit[:, coordinates.conditions] if coordinates.conditions else None
    with torch.no_grad():
        parts = [
            flow.log_prob(unit[rows][:, coordinates.learned], None if conditions is None else conditions[rows])
            for rows in torch.arange(len(unit)).split(SAMPLE_CHUNK)
        ]
    log_prob = torch.cat(parts).cpu().double().numpy()
    log_prob = np.where(coordinates.space.contains(points), log_prob, -np.inf)
    return log_prob + coordinates.log_condition_density - coordinates.log_unit_volume


def condition_groups(space: DesignSpace, points: np.ndarray) -> np.ndarray | None:
    """Which part of the first conditioning dimension's bounds points (N, 6) lie in, shape (N,)."""
    if not space.conditioned:
        return None
    first = space.conditioned[0]
    share = (points[:, first] - space.low[first]) / (space.high[first] - space.low[first])
    return np.clip((share * CONDITION_GROUPS).astype(int), 0, CONDITION_GROUPS - 1)


def _log_z_at(points: np.ndarray, samples: Samples, groups: np.ndarray | None, mean_log_z: float) -> np.ndarray | float:
    """log Z of the condition group of each point; the mean where there are no conditions or no samples."""
    if groups is None:
        return mean_log_z
    by_group = np.full(CONDITION_GROUPS, mean_log_z)
    for group, part in quality_by_group(samples.log_weights, groups).items():
        by_group[group] = part.log_z
    return by_group[condition_groups(samples.space, points)]
