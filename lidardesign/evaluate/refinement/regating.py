"""Gates of single rays from what the rays themselves would hear on training scenes.

A fit knows ranges by the samples around a ray; the ray itself, traced through scenes, meets less. With gates by the
traced returns 361 rays on held-out faces had 10 % less error in the same bandwidth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.layouts.density import bandwidth_limit
from lidardesign.design.layouts.gates import RayRanges, gates_within
from lidardesign.design.layouts.rays import gates_of, layout_of
from lidardesign.design.mixture.bounds import bounds_of
from lidardesign.design.sensor import DesignSpec, Sensor, interval_factor
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Rays
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.simulate.simulate import simulate
from lidardesign.space import RANGE, DesignSpace

# Every return stands for so many, spread about it: scenes that were not traced are elsewhere.
QUANTILES = 5
# Bandwidth alone limits the gates.
EVERYTHING = 1.0


@dataclass(frozen=True, eq=False)
class Gating:
    """How rays get gates by traced returns.

    Arguments:
        scenes: Training scenes with their casters.
        space: The design space; its ranges are what an open gate hears.
        sigma_m: Standard deviation by which returns are spread at least: the density's own [m].
    """

    scenes: Sequence[tuple[Scene, Sequence[SceneCaster]]]
    space: DesignSpace
    sigma_m: float

    @phase("gates")
    def __call__(self, design: DesignSpec, rays: Rays, spread_m: float = 0.0) -> DesignSpec:
        """The design with gates by returns, in its bandwidth budget or else in no more than it had.

        A ray without returns keeps its own gate, and all keep theirs where new ones would hold fewer returns.

        Arguments:
            design: With a gate per ray: a scan, or a table of rays.
            rays: Its own rays.
            spread_m: Standard deviation by which the design's samples are spread in range [m]; returns are, too.
        """
        ranges = self._ranges(rays, max(spread_m, self.sigma_m))
        known = np.flatnonzero(np.bincount(ranges.ray, minlength=len(rays)))
        if not len(known):
            return design
        place = np.full(len(rays), -1)
        place[known] = np.arange(len(known))
        constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
        sensors = tuple(range(len(design.sensors)))
        bounds = bounds_of(constraints.rules, self.space, sensors, interval_factor(design.level))
        bounds = bounds.take(rays.sensor[known])
        model, limit = bandwidth_limit(constraints, len(rays))
        bins = model.bins(np.diff(rays.gate_m, axis=1)[:, 0])
        most = (int(bins.sum()) if limit is None else limit) - int(bins.sum() - bins[known].sum())
        own = RayRanges(ranges.range_m, ranges.weights, place[ranges.ray], len(known))
        gates = rays.gate_m.copy()
        gates[known] = gates_within(own, bounds, EVERYTHING, model, most)
        too_wide = int(model.bins(gates[:, 1] - gates[:, 0])[known].sum()) > most
        if too_wide or ranges.held_by(gates) < ranges.held_by(rays.gate_m):
            return design
        return _with_gates(design, gates)

    def _ranges(self, rays: Rays, spread_m: float) -> RayRanges:
        """The targets that rays meet with open gates, over all scenes and their frames."""
        low, high = self.space.low[RANGE], self.space.high[RANGE]
        gates = np.tile([low, high], (len(rays), 1))
        open_rays = Rays(rays.origin_m, rays.direction, gates, rays.sensor, rays.time_s)
        ranges, indices = [], []
        for scene, casters in self.scenes:
            is_target = np.array([body.is_target for body in scene.bodies])
            for frame in simulate(scene, open_rays, casters=casters):
                hit = np.flatnonzero(frame.returned)
                hit = hit[is_target[frame.body[hit]]]
                ranges.append(frame.range_m[hit])
                indices.append(hit)
        offsets = spread_m * ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES)
        spread = np.clip(np.concatenate(ranges)[:, None] + offsets, low, high).reshape(-1)
        return RayRanges(spread, np.ones(len(spread)), np.repeat(np.concatenate(indices), QUANTILES), len(rays))


def has_ray_gates(design: DesignSpec) -> bool:
    """Whether every ray of a design has a gate of its own, which does not move along a track."""
    if design.track is not None:
        return False
    return layout_of(design).one_sensor_per_ray or (design.ray_table is not None and gates_of(design) == "ray")


def _with_gates(design: DesignSpec, gates: np.ndarray) -> DesignSpec:
    if design.ray_table is not None and not layout_of(design).one_sensor_per_ray:
        return replace(design, ray_table=replace(design.ray_table, gate_m=gates))
    factor = interval_factor(design.level)
    sensors = [_gated(sensor, gate, factor) for sensor, gate in zip(design.sensors, gates, strict=True)]
    return replace(design, sensors=tuple(sensors))


def _gated(sensor: Sensor, gate: np.ndarray, factor: float) -> Sensor:
    """A beam that listens in another interval."""
    return replace(sensor, range_m=float(gate.mean()), spread_range_m=float(gate[1] - gate[0]) / (2 * factor))
