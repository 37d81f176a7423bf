"""Rays by the density itself: quantised from the samples inside the sensors, each sensor's or all of a place together.

Sensors of a mixture overlap in direction where surfaces lie behind each other, and each listens at its own ranges. Once
every ray has its own gate that division means nothing any more: what counts is which directions are looked at. So the
samples of all sensors at a place are quantised together, a ray goes to the sensor that owns most of its cell, and its
gate holds what the cell sees. Measured on 50 held-out faces with 361 rays of 10 sensors in half the bandwidth of a grid
cropped to the training returns, after refinement: 9 % less error than that grid, 6 % with each sensor's rays by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.layouts.gates import (
    FIELD_ROUNDING_RAD,
    Members,
    RayRanges,
    gates_within,
    members,
    ray_gates,
    rays_in_fields,
)
from lidardesign.layouts.grid import field_on_sphere, grid_tangent
from lidardesign.layouts.layout import FitProblem, FittedDesign, Layout, missing_samples, shares_of
from lidardesign.mixture.bounds import bounds_of
from lidardesign.mixture.quantise import lloyd, samples_for
from lidardesign.numerics import sphere_exp, sphere_log, systematic_draw, unit_vectors
from lidardesign.samples import Samples
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays, fire_times
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.sensor import (
    DesignSpec,
    Gates,
    Sensor,
    interval_factor,
    tangent_coordinates,
    tangent_directions,
)
from lidardesign.task import random_generator

# Of a normal distribution, where nothing better is known of what a ray hears.
QUANTILES = 31
# Heights of directions that are told apart when rays are put in order.
ORDER_DECIMALS = 9


class DensityLayout(Layout):
    """Rays at the centres of cells of the samples that a sensor sees; with gates per ray those of all at its place."""

    name = "density"
    fitted_as = "density"
    follows_from_samples = True

    def fit(self, request: FitProblem) -> FittedDesign:
        """See `Layout`."""
        if request.gates == "ray" and request.budget.rays is not None:
            # the gates of rays keep the budget, not those of sensors
            request = replace(request, budget=replace(request.budget, limit_mbps=None))
        return super().fit(request)

    def lay_out(self, spec: DesignSpec, count: int, samples: Samples | None, gates: Gates, seed: int) -> Rays:
        """See `Layout`."""
        if samples is None:
            raise missing_samples(spec, count, gates)
        shares = shares_of(spec, count)
        shared = shared_rays(spec, shares, samples, seed) if gates == "ray" else None
        if shared is not None:
            return shared
        seen = members(spec, samples.points, samples.weights)
        tangents = [
            _density_tangent(sensor, int(n), own, seed)
            for sensor, n, own in zip(spec.sensors, shares, seen, strict=True)
        ]
        if gates == "sensor":
            return rays_in_fields(spec, tangents)
        gate = ray_gates(spec, tangents, seen, samples.space)
        return rays_in_fields(spec, tangents, _narrowed(spec, gate, np.repeat(np.arange(len(shares)), shares), samples))


def _density_tangent(sensor: Sensor, count: int, seen: Members, seed: int) -> np.ndarray:
    """Rays at the centres of Lloyd's cells of the samples inside a sensor; an even grid where too few.

    Cells divide the sphere around the sensor by chords, and centres are drawn out to it: a tangent plane stretches
    wide fields at their rims, and rays would be sparse there. In two dimensions the centres' density follows the
    square root of the samples' (Zador 1982): more rays where the density is, and none of its thin parts left without.
    """
    field, most = field_on_sphere(sensor), samples_for(count)
    generator = random_generator(seed, "density layout")
    tangent, weights = seen.tangent, seen.weights
    if count and len(seen) > most:
        tangent, weights = tangent[systematic_draw(weights, most, generator)], np.ones(most)
    if count == 0 or len(np.unique(tangent, axis=0)) < count:
        return grid_tangent(*field, count)
    chords, _ = lloyd(sphere_exp(tangent), weights, count, generator)
    # cells of wide fields may bulge
    half = np.array(field) / 2
    centres = np.clip(sphere_log(unit_vectors(chords)), -half, half)
    # row by row upwards, as the grid is: an order that depends on where the rays are, not on the seeding
    return centres[np.lexsort((centres[:, 0], centres[:, 1]))]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Samples inside some sensors' fields and gates: unit vectors (M, 3), ranges, weights and owners (M,)."""

    looking: np.ndarray
    range_m: np.ndarray
    weights: np.ndarray
    owner: np.ndarray

    @classmethod
    def of(cls, spec: DesignSpec, samples: Samples) -> _Seen:
        """The samples that the sensors of a design see, each with one of them."""
        parts = members(spec, samples.points, samples.weights)
        looking = [tangent_directions(s.frame, m.tangent) for s, m in zip(spec.sensors, parts, strict=True)]
        return cls(
            np.concatenate(looking),
            np.concatenate([part.range_m for part in parts]),
            np.concatenate([part.weights for part in parts]),
            np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
        )

    def take(self, rows: np.ndarray) -> _Seen:
        return _Seen(self.looking[rows], self.range_m[rows], self.weights[rows], self.owner[rows])

    def thinned(self, count: int, generator: np.random.Generator) -> _Seen:
        """As many samples as a number of cells needs, drawn by weight, so that they count alike."""
        if len(self.weights) <= samples_for(count):
            return self
        drawn = self.take(systematic_draw(self.weights, samples_for(count), generator))
        # where a few samples have nearly all weight they are drawn again and again, and cells would be left without
        if len(np.unique(drawn.looking, axis=0)) < count:
            return self
        return replace(drawn, weights=np.ones(len(drawn.weights)))


def shared_rays(design: DesignSpec, shares: np.ndarray, samples: Samples, seed: int) -> Rays | None:
    """The rays of a design whose sensors stand at one place or at a few; None where its samples are too few.

    Arguments:
        design: G sensors.
        shares: Rays of each by weight, shape (G,); sensors at one place share theirs out anew.
        samples: Samples of the density.
        seed: For the quantisation.
    """
    from scipy.spatial import cKDTree

    seen = _Seen.of(design, samples)
    origins = np.array([sensor.origin_m for sensor in design.sensors], dtype=np.float64)
    places, place = np.unique(origins, axis=0, return_inverse=True)
    place = place.reshape(-1)
    directions, sensors, ranges, weights, rays, count = [], [], [], [], [], 0
    for index in range(len(places)):
        here = int(shares[place == index].sum())
        if not here:
            continue
        own = seen.take(np.flatnonzero(place[seen.owner] == index))
        if len(np.unique(own.looking, axis=0)) < here:
            return None
        looking, sensor = _cells(own, here, design.sensors, random_generator(seed, "shared fields", index))
        directions.append(looking)
        sensors.append(sensor)
        # gates rest on all samples: their ends are rare
        ray = cKDTree(looking).query(own.looking)[1]
        # a ray between two that are nearer to all of its samples hears what its nearest sample does
        silent = np.setdiff1d(np.arange(here), ray)
        nearest = cKDTree(own.looking).query(looking[silent])[1] if len(silent) else silent
        ranges += [own.range_m, own.range_m[nearest]]
        weights += [own.weights, own.weights[nearest]]
        rays += [count + ray, count + silent]
        count += here
    if not count:
        return None
    looking, sensor = np.concatenate(directions), np.concatenate(sensors)
    heard = RayRanges(np.concatenate(ranges), np.concatenate(weights), np.concatenate(rays), count)
    gate = _priced_gates(design, heard, sensor, samples)
    order = np.lexsort((looking[:, 0], looking[:, 1], np.round(looking[:, 2], ORDER_DECIMALS), sensor))
    sensor = sensor[order]
    return Rays(origins[sensor], looking[order], gate[order], sensor, fire_times(count, DEFAULT_RATE_HZ))


def _cells(
    seen: _Seen, count: int, sensors: Sequence[Sensor], generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) of rays from one place and the sensor of each (N,).

    A ray looks at the middle of its own sensor's samples in the cell, inside that sensor's field: means of samples at
    the edge of a wide field bulge.
    """
    seen = seen.thinned(count, generator)
    _, labels = lloyd(seen.looking, seen.weights, count, generator)
    votes = np.bincount(labels * len(sensors) + seen.owner, seen.weights, count * len(sensors))
    owner = votes.reshape(count, len(sensors)).argmax(axis=1)
    own = seen.owner == owner[labels]
    sums = [np.bincount(labels[own], seen.weights[own] * axis[own], count) for axis in seen.looking.T]
    directions = unit_vectors(np.stack(sums, axis=1))
    for index, sensor in enumerate(sensors):
        rows = np.flatnonzero(owner == index)
        tangent, half = tangent_coordinates(sensor.frame, directions[rows]), np.array(sensor.field_of_view_rad) / 2
        beyond = (np.abs(tangent) > half + FIELD_ROUNDING_RAD).any(axis=1)
        directions[rows[beyond]] = tangent_directions(sensor.frame, np.clip(tangent[beyond], -half, half))
    return directions, owner


def _priced_gates(design: DesignSpec, heard: RayRanges, sensor: np.ndarray, samples: Samples) -> np.ndarray:
    """Gates by what rays hear, inside their sensors' bounds and the design's bandwidth, shape (N, 2) [m]."""
    constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
    bounds = bounds_of(constraints.rules, samples.space, tuple(sensor.tolist()), interval_factor(design.level))
    return gates_within(heard, bounds, design.level, *bandwidth_limit(constraints, len(sensor)))


def _narrowed(design: DesignSpec, gates: np.ndarray, sensor: np.ndarray, samples: Samples) -> np.ndarray:
    """Gates (N, 2) [m] that were not priced, where they are too wide for the design's bandwidth: towards their middles.

    Rays of which too little is known count as hearing most in the middle of their gates.
    """
    from scipy.special import ndtri

    constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
    model, limit = bandwidth_limit(constraints, len(gates))
    if limit is None or int(model.bins(gates[:, 1] - gates[:, 0]).sum()) <= limit:
        return gates
    shape = ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES)
    ranges = gates.mean(axis=1)[:, None] + np.diff(gates, axis=1) / 2 * shape / shape[-1]
    ray = np.repeat(np.arange(len(gates)), QUANTILES)
    heard = RayRanges(ranges.reshape(-1), np.ones(ranges.size), ray, len(gates))
    return _priced_gates(design, heard, sensor, samples)


def bandwidth_limit(constraints: Constraints, rays: int) -> tuple[Bandwidth, int | None]:
    """The read-out model, and how many bins a number of rays may take in the bandwidth budget."""
    budget = constraints.budget
    model = Bandwidth(budget.bin_ps, budget.bits_per_bin, budget.rate_hz)
    if budget.bandwidth_mbps is None:
        return model, None
    return model, max(int(budget.bandwidth_mbps / model.mbps_of_widths(np.zeros(1))), rays)
