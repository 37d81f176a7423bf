"""From a design to the explicit list of rays that it fires.

Budgets are split by largest remainder. Rays start at their sensor's mean origin, in the layout `distributed`
across its origins; they are ordered by sensor (an explicit table keeps its own order), and fire evenly over
the frame: ray i of n at i / (n * rate).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.bandwidth import split_budget
from lidardesign.design.catalog.part import thinned
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.layouts.distributed import distributed_beams
from lidardesign.design.layouts.gates import SMALLEST_CELL, central_intervals, kept_gates
from lidardesign.design.layouts.grid import field_on_sphere, grid_tangent
from lidardesign.design.layouts.quantise import lloyd, samples_for
from lidardesign.design.layouts.shared_fields import Members, members, narrowed, shared_rays
from lidardesign.design.layouts.track import moved, placed
from lidardesign.design.mixture.bounds import bounds_of, groups
from lidardesign.design.mixture.conditions import conditioned
from lidardesign.design.mixture.support import Retarget
from lidardesign.design.sensor import (
    DesignSpec,
    Layout,
    Sensor,
    interval_factor,
    tangent_directions,
)
from lidardesign.errors import ConfigError
from lidardesign.geometry.rays import DEFAULT_RATE_HZ, Rays, fire_times
from lidardesign.numerics import sphere_exp, sphere_log, systematic_draw, unit_vectors
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.space import DesignSpace
from lidardesign.task import random_generator

Gates = Literal["sensor", "ray"]

# A design is asked for at many places of a track; the samples and the design decide what a refit finds.
_REFITS: WeakKeyDictionary[Samples, WeakKeyDictionary[DesignSpec, dict[tuple[int, int], DesignSpec]]] = (
    WeakKeyDictionary()
)


def lay_out(
    design: DesignSpec,
    count: int | None = None,
    samples: Samples | None = None,
    *,
    gates: Gates | None = None,
    rate_hz: float = DEFAULT_RATE_HZ,
    seed: int = 0,
    at: Mapping[str, float] | None = None,
    retarget: Retarget | None = None,
) -> Rays:
    """The rays of a design.

    At the number of rays of its explicit table, the design's table is the answer, gates included. Otherwise
    `grid` is even in each sensor's field of view; `density` quantises the samples inside each sensor; `scan`
    fires along each sensor's boresight, and at another number of rays is fitted anew to the samples;
    `distributed` starts rays across each sensor's origins, by the samples inside it or by its own Gaussian; `fixed`
    fires what stands in its table, of fewer rays an evenly spread subset.

    Arguments:
        design: The design.
        count: Rays per frame; None takes the design's own number.
        samples: Samples of the density, for `density` and `scan` at a new count and for gates per ray.
        gates: `sensor` gives each ray its sensor's gate; `ray` the interval of the ranges seen around it; None is
            `own_gates` of the layout.
        rate_hz: Frames per second [Hz].
        seed: For the quantisation.
        at: Condition values, as {"x_m": 0.37}: a track gives its rays there, and any other design moves there as
            it is, see `track.placed`.
        retarget: log p* of design points (N, 6), where the samples are of a density with conditions.

    Raises:
        ConfigError: No number of rays is known, the layout at this count needs samples, or a track's place is
            not given.
    """
    gates = gates or own_gates(design.layout)
    if design.track is not None:
        return _on_track(design, count, samples, at or {}, rate_hz, seed)
    # what moves was fitted where it was made: its rays are laid out there, then moved
    home = {**(at or {}), **design.at}
    if samples is not None and samples.space.conditioned:
        # distributed rays can also be laid out by their sensors alone
        asked = _asks_samples(design, count, gates) or (design.layout == "distributed" and retarget is not None)
        samples = conditioned(samples, home, retarget) if asked else None
    if design.layout == "scan" and count not in (None, 0) and count != own_count(design):
        # before it is placed: one refit then serves all places
        design, gates = refitted(design, count, samples, seed), "sensor"
    here = placed(design, home) if home else design
    rays = _laid_out(here, count, samples, gates, rate_hz, seed)
    return moved(rays, design, at) if at else rays


def _on_track(
    design: DesignSpec, count: int | None, samples: Samples | None, at: Mapping[str, float], rate_hz: float, seed: int
) -> Rays:
    """The rays of a track at a position; another number of them is another track."""
    total = own_count(design) if count is None else count
    if total not in (0, own_count(design)):
        design = refitted(design, total, samples, seed)
    here = placed(design, at)
    return _laid_out(here if total else replace(here, ray_table=None), total, None, "sensor", rate_hz, seed)


def _asks_samples(design: DesignSpec, count: int | None, gates: Gates) -> bool:
    """Whether the rays of a design at a count follow from samples of the density."""
    total = own_count(design) if count is None else count
    if total == 0 or (design.ray_table is not None and len(design.ray_table.sensor) == total):
        return False
    if design.layout == "scan":
        return total != own_count(design) or gates == "ray"
    return design.layout == "density" or (design.layout == "grid" and gates == "ray")


def _laid_out(
    design: DesignSpec, count: int | None, samples: Samples | None, gates: Gates, rate_hz: float, seed: int
) -> Rays:
    """The rays of a design where it stands, see `lay_out`."""
    total = own_count(design) if count is None else count
    if design.ray_table is not None and len(design.ray_table.sensor) == total:
        return _table_rays(design.ray_table, rate_hz)
    if design.layout == "fixed" and total:
        return _table_rays(_fewer(design, total), rate_hz)
    shares = _shares(design, total)
    if design.layout == "distributed":
        return _distributed_rays(design, shares, samples, gates, rate_hz, seed)
    if design.layout == "density" and gates == "ray" and samples is not None and total:
        shared = shared_rays(design, shares, samples, seed)
        if shared is not None:
            origin = np.array([s.origin_m for s in design.sensors], dtype=np.float64)[shared.sensor]
            return Rays(origin, shared.direction, shared.gate_m, shared.sensor, fire_times(int(total), rate_hz))
    seen = None
    if total and (gates == "ray" or design.layout == "density"):
        if samples is None:
            raise _needs_samples(design, total, gates)
        seen = members(design, samples.points, samples.weights)
    tangents = [
        _tangent(design.layout, sensor, int(n), seen[index] if seen else None, seed)
        for index, (sensor, n) in enumerate(zip(design.sensors, shares, strict=True))
    ]
    sensor = np.repeat(np.arange(len(shares)), shares)
    gate = np.array([s.gate_m for s in design.sensors])[sensor]
    if gates == "ray" and seen is not None and samples is not None:
        gate = _ray_gates(design, tangents, seen, samples.space)
        gate = narrowed(design, gate, sensor, samples) if design.layout == "density" else gate
    looking = [tangent_directions(s.frame, t) for s, t in zip(design.sensors, tangents, strict=True)]
    origin = np.array([s.origin_m for s in design.sensors], dtype=np.float64)[sensor]
    return Rays(origin, np.concatenate(looking), gate, sensor, fire_times(int(total), rate_hz))


def own_gates(layout: Layout) -> Gates:
    """The gates that rays have where nothing is asked for: a ray that starts where no other does has its own."""
    return "ray" if layout == "distributed" else "sensor"


def gates_of(design: DesignSpec, samples: Samples | None) -> Gates | None:
    """The gates that a design's rays keep at another number of rays; None where its own table tells nothing.

    A table tells by two rays of one sensor. Rays that start where others do have gates of their own by samples only.
    """
    table = design.ray_table
    if table is None:
        return None
    _, first, sensor = np.unique(table.sensor, return_index=True, return_inverse=True)
    if len(first) == len(sensor):
        return None
    per_ray = bool((table.gate_m != table.gate_m[first[sensor]]).any())
    return "ray" if per_ray and (samples is not None or design.layout == "distributed") else "sensor"


def _distributed_rays(
    design: DesignSpec, shares: np.ndarray, samples: Samples | None, gates: Gates, rate_hz: float, seed: int
) -> Rays:
    beams = distributed_beams(design, shares, samples, seed)
    origin, looking, gate = (
        np.concatenate([getattr(one, name) for one in beams]) for name in ("origin_m", "direction", "gate_m")
    )
    sensor = np.repeat(np.arange(len(shares)), shares)
    if gates == "sensor":
        gate = np.array([s.gate_m for s in design.sensors])[sensor]
    return Rays(origin, looking, gate, sensor, fire_times(int(shares.sum()), rate_hz))


@phase("rays")
def make_ray_table(
    design: DesignSpec, count: int, samples: Samples | None = None, gates: Gates | None = None, *, seed: int = 0
) -> Rays:
    """The explicit rays of a design's layout, laid out anew, as they are kept in its file."""
    rays = lay_out(replace(design, ray_table=None), count, samples, gates=gates, seed=seed)
    return rays.as_angles()


def own_count(design: DesignSpec) -> int:
    """The number of rays that a design was made for.

    Raises:
        ConfigError: The design leaves it open.
    """
    if design.rays is not None:
        return design.rays
    if design.ray_table is not None:
        return len(design.ray_table.sensor)
    if all(sensor.rays is not None for sensor in design.sensors):
        return sum(sensor.rays or 0 for sensor in design.sensors)
    if design.layout == "scan":
        return len(design.sensors)
    raise ConfigError("the design names no number of rays", where=design.name, hint="give --rays N")


def _shares(design: DesignSpec, total: int) -> np.ndarray:
    """Rays per sensor: the design's own at its own number, one each in a scan, else by weight."""
    own = [sensor.rays for sensor in design.sensors]
    if None not in own and sum(n or 0 for n in own) == total:
        return np.array(own, dtype=np.int64)
    if design.layout == "scan" and total not in (0, len(own)):
        raise ConfigError(
            f"{total} rays, but a scan of {len(own)} sensors fires one ray of each",
            where=design.name,
            allowed=f"{len(own)} rays, or `rays` for every sensor",
        )
    return split_budget(design.weights, total)


def refitted(design: DesignSpec, total: int, samples: Samples | None, seed: int = 0) -> DesignSpec:
    """A scan of another number of rays: every ray is a component, so the components are others.

    Keeps the design's constraints, but for the number of rays itself.

    Raises:
        ConfigError: There are no samples to fit to.
    """
    if samples is None:
        raise _needs_samples(design, total, "sensor")
    known = _REFITS.setdefault(samples, WeakKeyDictionary()).setdefault(design, {})
    if (total, seed) not in known:
        known[total, seed] = _refit(design, total, samples, seed)
    return known[total, seed]


def _refit(design: DesignSpec, total: int, samples: Samples, seed: int) -> DesignSpec:
    # fit lays out what it fits, so it stands above this module
    from lidardesign.design.fit import fit

    document = {**design.constraints}
    if "budget" in document:
        document["budget"] = {key: value for key, value in document["budget"].items() if key != "rays"}
    constraints = Constraints.from_mapping(document, where=f"constraints of {design.name}")
    if any(pin is not None for group in groups(constraints.rules, samples.space, 1) for pin in group.pins):
        raise ConfigError(
            f"a scan from a pinned origin cannot be fitted anew to {total} rays without its target density",
            where=design.name,
            allowed=f"{own_count(design)} rays",
            hint=f"lidardesign constrain RUN --layout scan --rays {total} with the same constraints",
        )
    fitted = fit(
        samples,
        layout="scan",
        rays=total,
        constraints=constraints,
        seed=seed,
        level=design.level,
        name=design.name,
    )
    return fitted.design


def _needs_samples(design: DesignSpec, total: int, gates: Gates) -> ConfigError:
    wanted = "gates per ray" if gates == "ray" else f"{total} rays in the layout `{design.layout}`"
    return ConfigError(
        f"{wanted} need samples of the learned density, and a design file alone has none",
        where=design.name,
        allowed=f"{len(design.ray_table.sensor)} rays" if design.ray_table is not None else None,
        hint=f"lidardesign fit RUN --layout {design.layout} --rays {total}",
    )


def _fewer(design: DesignSpec, total: int) -> Rays:
    """An evenly spread subset of a fixed design's rays, each sensor's in proportion."""
    table = design.ray_table
    if table is None or total > len(table.sensor):
        raise ConfigError(
            f"{total} rays, but the design's fixed pattern has {0 if table is None else len(table.sensor)}",
            where=design.name,
            allowed=None if table is None else f"at most {len(table.sensor)}",
            hint="a design of more parts: lidardesign catalog show NAME --rays N --out FILE",
        )
    own = np.bincount(table.sensor, minlength=len(design.sensors))
    shares = split_budget(own, total)
    of_sensor = [np.flatnonzero(table.sensor == index) for index in range(len(own))]
    kept = [rows[thinned(table.direction[rows], int(share))] for rows, share in zip(of_sensor, shares, strict=True)]
    chosen = np.sort(np.concatenate(kept))
    return table.subset(chosen)


def _table_rays(table: Rays, rate_hz: float) -> Rays:
    return replace(table, time_s=fire_times(len(table), rate_hz))


def _tangent(layout: str, sensor: Sensor, count: int, seen: Members | None, seed: int) -> np.ndarray:
    """Angles of a sensor's rays in its tangent plane, shape (count, 2) [rad]."""
    if layout == "scan":
        return np.zeros((count, 2))
    even = grid_tangent(*field_on_sphere(sensor), count)
    if layout == "grid" or seen is None or count == 0:
        return even
    return _density_tangent(sensor, count, seen, seed, even)


def _density_tangent(sensor: Sensor, count: int, seen: Members, seed: int, even: np.ndarray) -> np.ndarray:
    """Rays at the centres of Lloyd's cells of the samples inside a sensor; an even grid where too few.

    Cells divide the sphere around the sensor by chords, and centres are drawn out to it: a tangent plane stretches
    wide fields at their rims, and rays would be sparse there. In two dimensions the centres' density follows the
    square root of the samples' (Zador 1982): more rays where the density is, and none of its thin parts left without.
    """
    generator = random_generator(seed, "density layout")
    tangent, weights = seen.tangent, seen.weights
    most = samples_for(count)
    if len(seen) > most:
        tangent, weights = tangent[systematic_draw(weights, most, generator)], np.ones(most)
    if len(np.unique(tangent, axis=0)) < count:
        return even
    chords, _ = lloyd(sphere_exp(tangent), weights, count, generator)
    centres = np.clip(sphere_log(unit_vectors(chords)), *_field_ends(sensor))
    # row by row upwards, as the grid is: an order that depends on where the rays are, not on the seeding
    return centres[np.lexsort((centres[:, 0], centres[:, 1]))]


def _field_ends(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest angles in a sensor's tangent plane, shape (2,) each [rad]: cells of wide fields may bulge."""
    half = np.array(field_on_sphere(sensor)) / 2
    return -half, half


def _ray_gates(design: DesignSpec, tangents: list[np.ndarray], seen: list[Members], space: DesignSpace) -> np.ndarray:
    """The gate of each ray, from the ranges of the samples that are nearest to it, shape (N, 2) [m].

    Inside its sensor's gate, and moved no further than the design's constraints ask: they bound every ray.
    """
    constraints = Constraints.from_mapping(design.constraints, where=f"constraints of {design.name}")
    gates = []
    for index, (sensor, tangent, inside) in enumerate(zip(design.sensors, tangents, seen, strict=True)):
        own = np.tile(sensor.gate_m, (len(tangent), 1))
        if len(tangent) and len(inside):
            cell = cKDTree(tangent).query(inside.tangent)[1]
            wanted, effective = central_intervals(inside.range_m, inside.weights, cell, len(tangent), design.level)
            known = np.flatnonzero((effective >= SMALLEST_CELL) & (np.diff(wanted, axis=1)[:, 0] > 0))
            wanted = np.clip(wanted[known], *sensor.gate_m)
            bounds = bounds_of(constraints.rules, space, (index,), interval_factor(design.level))
            own[known] = kept_gates(wanted, sensor, bounds.take(np.zeros(len(known), dtype=np.int64)))
        gates.append(own)
    return np.concatenate(gates)
