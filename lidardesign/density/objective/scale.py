"""A check that lengths fit together: the targets, where sensors are, how far they reach, and sigma. Needs no torch.

Rays are aimed from random origins of the design space at points that are uniform in area on the targets of a few scenes
and frames, and cast. Their hits show, before anything is learned, that the space looks past the targets or ends
before them, that they are hidden, that they are seen edge-on, and that sigma blurs them away. Where an angle is fixed
hardly any point can be aimed at: uniform rays of the space take their place.

Each note has a measured number and its threshold. What the tasks here have is on the good side of every threshold by
far; what designs lose beyond it is in docs/meshes.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.config import RunConfig
from lidardesign.density.fields.distance import scene_columns
from lidardesign.density.objective.visibility import Optics
from lidardesign.run.clock import phase
from lidardesign.scenes.casting import shared_caster
from lidardesign.scenes.scene import Mesh, Plane, Scene
from lidardesign.scenes.surface import sample_body, target_area_m2
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, aim, direction, observed_point
from lidardesign.task import random_generator

RAYS = 8192
MOST_COLUMNS = 64
# Shares of fewer rays are not reported.
FEWEST_RAYS = 32
# Casting finds a point again within this share of its range.
SAME_PLACE = 1e-3
# Below this share of the targets' surface in the space's angles, or in its angles and range, it looks past them.
LEAST_IN_VIEW = 0.01
# Above this share of the visible surface out of range, a note is given.
MOST_OUT_OF_RANGE = 0.5
# Above this share of the rays, other bodies hide the targets.
MOST_HIDDEN = 0.99
# Above this share of the origins, sensors are inside the targets.
MOST_INSIDE = 0.5
# Below this mean cosine of incidence surfaces are seen edge-on; from all around a convex body has 1/2.
LEAST_COSINE = 0.1
# Below this share of what the density prefers rays pass the targets; a sigma is named that lets the other one return.
LEAST_RETURNING, ENOUGH_RETURNING = 0.02, 0.2
# Above so many sigmas of range, what a flow learns in the usual time is too rough.
MOST_SIGMAS = 1000.0
# Sigma that does not blur away what there is to see is at most this share of it.
GOOD_SHARE = 0.25
LOOK_THERE = "let its origins and angles look where the targets are"
# Lengths that differ by this factor are more likely in different units.
OTHER_UNIT = 100.0


@dataclass(frozen=True, eq=False)
class _Sample:
    """Some columns of scenes, and how rays are aimed at them.

    Arguments:
        scenes: The scenes.
        columns: Scene and frame of each column.
        space: The design space.
        generator: Of all draws.
    """

    scenes: Sequence[Scene]
    columns: Sequence[tuple[int, int]]
    space: DesignSpace
    generator: np.random.Generator

    def rays_at(self, blur_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Design points (N, 6) that observe points of targets, blurred in all directions, and their columns (N,)."""
        count, parts, of = -(-RAYS // len(self.columns)), [], []
        for number, (index, frame) in enumerate(self.columns):
            scene, points = self.scenes[index], self.space.sample(count, self.generator)
            if self.space.turns:
                targets = [body for body in scene.bodies if body.is_target]
                surface = sample_body(targets, self.space, count, self.generator, frame).points
                points = aim(points[:, :3], surface + blur_m * self.generator.normal(size=surface.shape))
            else:
                caster = shared_caster(scene, frame, only="targets")
                points[:, RANGE] = caster.first_hit(points[:, :3], _directions(points)).range_m
            points = points[np.isfinite(points[:, RANGE]) & (points[:, RANGE] > 0)]
            parts.append(points)
            of.append(np.full(len(points), number))
        return np.concatenate(parts), np.concatenate(of)

    def first_hits(self, points: np.ndarray, column: np.ndarray) -> _SampledHits:
        """First hits of rays (N, 6) in their columns (N,)."""
        met = _SampledHits(np.full(len(points), np.inf), np.zeros(len(points), dtype=bool), np.zeros(len(points)))
        for number in np.unique(column):
            rows, (index, frame) = np.flatnonzero(column == number), self.columns[number]
            directions = _directions(points[rows])
            hits = shared_caster(self.scenes[index], frame).first_hit(points[rows, :3], directions)
            is_target = np.array([body.is_target for body in self.scenes[index].bodies])
            met.range_m[rows] = hits.range_m
            met.target[rows] = (hits.body >= 0) & is_target[hits.body]
            met.cosine[rows] = np.abs(np.einsum("nk,nk->n", hits.normal, directions))
        return met

    def inside_share(self, points: np.ndarray, column: np.ndarray) -> float:
        """The share of rays (N, 6) that start inside closed targets: those with an odd number of crossings."""
        odd = np.zeros(len(points), dtype=bool)
        for number in np.unique(column):
            rows, (index, frame) = np.flatnonzero(column == number), self.columns[number]
            caster, count = shared_caster(self.scenes[index], frame, only="targets"), len(rows)
            ways = points[rows, :3], _directions(points[rows]), np.zeros(count), np.full(count, np.inf)
            odd[rows] = np.bincount(caster.crossings(*ways).row, minlength=count) % 2 == 1
        return float(odd.mean())


@dataclass(frozen=True, eq=False)
class _SampledHits:
    """Ranges of first hits [m], whether they are on targets, and the cosines of incidence, each (N,)."""

    range_m: np.ndarray
    target: np.ndarray
    cosine: np.ndarray


def _directions(points: np.ndarray) -> np.ndarray:
    return direction(points[:, AZIMUTH], points[:, ELEVATION])


@phase("scale")
def scale_notes(scenes: Sequence[Scene], config: RunConfig) -> list[str]:
    """Notes on lengths of training scenes, design space and sigma that do not fit together, each with a remedy.

    Arguments:
        scenes: The training scenes.
        config: The run's configuration.
    """
    generator, columns = random_generator(config.seed, "scale"), scene_columns(scenes)
    if len(columns) > MOST_COLUMNS:
        columns = [columns[number] for number in sorted(generator.choice(len(columns), MOST_COLUMNS, replace=False))]
    sample = _Sample(scenes, columns, config.space, generator)
    points, column = sample.rays_at()
    if len(points) < FEWEST_RAYS:
        return [f"{len(points)} of {RAYS:,} random rays of the design space meet a target; {LOOK_THERE}"]
    met = sample.first_hits(points, column)
    return _view_notes(sample, points, column, met) or _sigma_notes(sample, points, met, config)


def _in_angles(space: DesignSpace, points: np.ndarray) -> np.ndarray:
    anywhere = points.copy()
    anywhere[:, RANGE] = space.low[RANGE]
    return space.contains(anywhere)


def _unit_doubt(one_m: float, other_m: float) -> str:
    """A question about units where two lengths differ by a factor that suggests different ones; else empty."""
    return " (are all lengths in metres?)" if max(one_m, other_m) > OTHER_UNIT * min(one_m, other_m) else ""


def _visible(points: np.ndarray, met: _SampledHits) -> np.ndarray:
    return met.target & (met.range_m >= (1 - SAME_PLACE) * points[:, RANGE])


def _view_notes(sample: _Sample, points: np.ndarray, column: np.ndarray, met: _SampledHits) -> list[str]:
    """Notes on targets that rays of the space cannot reach."""
    space, reach_m = sample.space, sample.space.high[RANGE]
    viewed, across_m = _in_angles(space, points), float(np.ptp(observed_point(points), axis=0).max())
    shapes = [body.shape for scene in sample.scenes for body in scene.bodies if body.is_target]
    closed = all(shape.sign == "solid" if isinstance(shape, Mesh) else not isinstance(shape, Plane) for shape in shapes)
    if closed and sample.inside_share(points, column) > MOST_INSIDE:
        return [
            f"sensors are inside the targets, which are {across_m:.3g} m across: are all lengths in metres? "
            "If so, move the design space out of them, or give the walls of a room a thickness"
        ]
    sizes = f"they are {across_m:.3g} m across, its rays reach {reach_m:.3g} m{_unit_doubt(across_m, reach_m)}"
    if viewed.mean() < LEAST_IN_VIEW:
        return [
            f"the design space looks past the targets: {viewed.mean():.2%} of their surface is within its angles; "
            f"{sizes}; {LOOK_THERE}"
        ]
    notes = []
    hidden = ~met.target & (met.range_m < (1 - SAME_PLACE) * points[:, RANGE])
    if hidden[viewed].mean() > MOST_HIDDEN:
        notes.append(
            f"occluders hide {hidden[viewed].mean():.1%} of the targets' surface: hardly anything is ever visible; "
            "check the occluders' places and the bodies' roles"
        )
    if RANGE not in space.free:
        return notes
    heard = (space.low[RANGE] <= points[:, RANGE]) & (points[:, RANGE] <= reach_m)
    seen = viewed & _visible(points, met)
    ranges, missed = points[seen, RANGE], 1 - heard[seen].mean() if seen.any() else 0.0
    if len(ranges) >= FEWEST_RAYS and missed > MOST_OUT_OF_RANGE:
        notes.append(
            f"{missed:.0%} of the surface that rays meet is out of the design space's range: it is "
            f"{ranges.min():.3g} to {ranges.max():.3g} m away, and the range is {space.low[RANGE]:.3g} to "
            f"{reach_m:.3g} m{_unit_doubt(float(np.median(ranges)), reach_m)}; set space.range_m"
        )
    elif (viewed & heard).mean() < LEAST_IN_VIEW:
        notes.append(
            f"the design space reaches {(viewed & heard).mean():.2%} of the targets' surface: {sizes}; cut the targets "
            "to what sensors may reach, or raise space.range_m"
        )
    return notes


def _sigma_notes(sample: _Sample, points: np.ndarray, met: _SampledHits, config: RunConfig) -> list[str]:
    """Notes on a sigma that does not suit the visible surface."""
    sigma_m = config.density.sigma_m
    seen = _in_angles(sample.space, points) & _visible(points, met)
    if seen.sum() < FEWEST_RAYS:
        return []
    spread_m = float(np.sqrt(observed_point(points[seen]).var(axis=0).sum()))
    if sigma_m > spread_m:
        return [
            f"sigma {sigma_m:g} m blurs the targets away: what is seen of them spreads only {spread_m:.2g} m (rms) "
            "around its middle, and the density can hardly tell it from the space around"
            f"{_unit_doubt(sigma_m, spread_m)}; lower density.sigma_m to {GOOD_SHARE * spread_m:.2g} m or less"
        ]
    cosine = float(met.cosine[seen].mean())
    if cosine < LEAST_COSINE:
        return [
            f"the targets are seen edge-on: rays meet their surface at {math.degrees(math.asin(cosine)):.2g} degrees "
            "on average, and few return; move the design space's origins to where more of it faces them"
        ]
    low_m, high_m = sample.space.low[RANGE], sample.space.high[RANGE]
    least_m = (high_m - low_m) / MOST_SIGMAS
    if sigma_m < least_m:
        ranges = points[seen, RANGE]
        raised = f"raise density.sigma_m to {least_m:.2g} m, or " if least_m <= GOOD_SHARE * spread_m else ""
        return [
            f"sigma {sigma_m:g} m is 1/{(high_m - low_m) / sigma_m:,.0f} of the design space's range, {low_m:.3g} to "
            f"{high_m:.3g} m{_unit_doubt(least_m, sigma_m)}: so thin a density is hard to learn; {raised}narrow "
            f"space.range_m: what is seen of the targets is {ranges.min():.3g} to {ranges.max():.3g} m away"
        ]
    return _thin_notes(sample, config, least_m) if sample.space.turns and least_m > 0 else []


def _thin_notes(sample: _Sample, config: RunConfig, least_m: float) -> list[str]:
    """A note where rays that the density prefers miss targets thinner than sigma."""
    optics = Optics.of(config.density)
    share = _returning_share(sample, optics)
    if share >= LEAST_RETURNING:
        return []
    enough, better = optics, share
    while better < ENOUGH_RETURNING and enough.sigma_m / 2 >= least_m:
        enough = enough.widened(enough.sigma_m / 2)
        better = _returning_share(sample, enough)
    return [
        f"{share:.1%} of the rays that the density prefers return: the targets are thinner than sigma, "
        f"{optics.sigma_m:g} m; with density.sigma_m={enough.sigma_m:.2g} {better:.0%} would return"
    ]


def _returning_share(sample: _Sample, optics: Optics) -> float:
    """The share of the target density's mass whose rays meet a target; 1 where too few samples are found.

    Blurring surfaces by sigma in all directions gives the density without its visibility, where they are flat.
    """
    points, column = sample.rays_at(optics.sigma_m)
    points, kept = sample.space.wrap(points), sample.space.contains(points)
    points, column = points[kept], column[kept]
    met = sample.first_hits(points, column)
    reaches = met.range_m >= points[:, RANGE] - optics.margin_m
    area_m2 = np.array([target_area_m2(sample.scenes[index], sample.space) for index, _ in sample.columns])
    weights = np.where(reaches, area_m2[column] / np.square(points[:, RANGE]), 0.0)
    if reaches.sum() < FEWEST_RAYS or not weights.any():
        return 1.0
    return float(weights[met.target].sum() / weights.sum())
