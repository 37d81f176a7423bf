"""Where a direct search starts: what an engineer would try first, with as many sensors as the design has.

All are built from where training returns are, or, where there are none, from the whole space. Sensors at given origins
tile the returns as they see them, in every arrangement of rows, with equal weights or weights by returns. Scans are the
even layouts that `bounding` and `uniform` take, with one gate or a gate per ray.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lidardesign.design.layouts.grid import low_discrepancy
from lidardesign.design.sensor import Sensor, boresight_frame
from lidardesign.evaluate.baselines.bounding import bounding
from lidardesign.evaluate.baselines.candidates import LayoutSite, opened_gate, whole_range
from lidardesign.evaluate.baselines.even import central, even_placement
from lidardesign.evaluate.baselines.views import RAY_AXES, Observed, TrainingViews, dense_points, unrolled
from lidardesign.evaluate.cma.model import SearchRules
from lidardesign.numerics import TINY, sphere_exp, sphere_log
from lidardesign.space import AZIMUTH, ELEVATION, angles, observed_point

# Returns further apart than this from their middle are tiled in azimuth and elevation, others in a tangent plane.
TANGENT_RAD = math.radians(70)
# A central 99 % means nothing from fewer returns.
FEWEST_RETURNS = 20

Start = tuple[Sensor, ...]


class Tile(NamedTuple):
    """A part of a plane: its corners (2,) each."""

    low: np.ndarray
    high: np.ndarray


def starts(rules: SearchRules, views: TrainingViews, count: int) -> list[Start]:
    """The sensors to start from, the likeliest to be good first; duplicates may occur.

    Arguments:
        rules: What all candidates share.
        views: The training scenes.
        count: The number of sensors; of a scan, of rays.
    """
    if rules.one_sensor_per_ray:
        return scan_starts(rules, views, count)
    observed = views.observed(views.space)
    if not len(observed.points):
        points = dense_points(rules.space)
        whole = np.column_stack([points[:, :RAY_AXES], np.full(len(points), whole_range(rules.space).mean())])
        observed = Observed(whole, observed_point(whole))
    return list(_tilings(rules, observed, count))


def tiles(low: np.ndarray, high: np.ndarray, count: int, rows: int) -> list[Tile]:
    """A rectangle in as many equal tiles as asked for, in rows along its second axis."""
    edges = np.round(np.arange(rows + 1) * count / rows).astype(np.int64)
    found = []
    for bottom, top in pairwise(edges.tolist()):
        across = top - bottom
        for column in range(across):
            shares = np.array([[column / across, bottom / count], [(column + 1) / across, top / count]])
            found.append(Tile(*(low + shares * (high - low))))
    return found


def _tilings(rules: SearchRules, observed: Observed, count: int) -> Iterator[Start]:
    """Every arrangement of tiles over the returns, from every set of origins."""
    for origins in _origin_sets(rules, observed, count):
        distinct, which = np.unique(origins, axis=0, return_inverse=True)
        views = [_seen(rules, observed, origin) for origin in distinct]
        ends = [Tile(*central(view.places)) for view in views]
        if len(distinct) > 1:  # from several places, each may look at everything
            yield tuple(
                _tile_sensor(rules, views[v], ends[v], index, 1.0 / count)[0] for index, v in enumerate(which.ravel())
            )
        for rows in range(1, count + 1):
            split = [tiles(*end, count, rows) for end in ends]
            sensors, returns = zip(
                *(
                    _tile_sensor(rules, views[view], split[view][index], index, 1.0 / count)
                    for index, view in enumerate(which.ravel())
                ),
                strict=True,
            )
            yield sensors
            if count > 1 and min(returns) > 0:
                yield tuple(replace(one, weight=n / sum(returns)) for one, n in zip(sensors, returns, strict=True))


def _origin_sets(rules: SearchRules, observed: Observed, count: int) -> list[np.ndarray]:
    """Origins (G, 3) each: the middle of what is admitted, and where that is a box, spread over it."""
    bounds = rules.bounds(count)
    sets = [(bounds.origin_low + bounds.origin_high) / 2]
    if rules.axes.origin and rules.origins is None:
        low, high = central(observed.points[:, :3])
        spread = bounds.origin_low + low_discrepancy(count, 3) * (bounds.origin_high - bounds.origin_low)
        sets += [spread, np.tile((low + high) / 2, (count, 1))]
    return [rules.standing(origins) for origins in sets]


class _Seen(NamedTuple):
    """The returns as an origin sees them: where in a plane (K, 2), how far (K,), and the frame of a tangent plane.

    Without a frame the plane is that of azimuth and elevation.
    """

    origin: np.ndarray
    places: np.ndarray
    distance: np.ndarray
    frame: np.ndarray | None


def _seen(rules: SearchRules, observed: Observed, origin: np.ndarray) -> _Seen:
    away = observed.hits_m - origin
    distance = np.linalg.norm(away, axis=1)
    looking = away / np.maximum(distance, TINY)[:, None]
    frame = boresight_frame(*(float(angle) for angle in angles(looking.mean(axis=0))))
    if rules.axes.angular == 2 and (looking @ frame[0]).min() > math.cos(TANGENT_RAD):
        return _Seen(origin, sphere_log(looking @ frame.T), distance, frame)
    turned, raised = angles(looking)
    return _Seen(origin, np.stack([unrolled(turned), raised], axis=1), distance, None)


def _tile_sensor(rules: SearchRules, seen: _Seen, tile: Tile, index: int, weight: float) -> tuple[Sensor, int]:
    """The sensor of one tile of the returns, and how many returns lie in it."""
    middle = (tile.low + tile.high) / 2
    if seen.frame is None:
        azimuth, elevation = middle.tolist()
        field = (tile.high - tile.low) * [math.cos(elevation), 1.0]
    else:
        azimuth, elevation = (float(angle[0]) for angle in angles(sphere_exp(middle[None]) @ seen.frame))
        field = tile.high - tile.low
    inside = ((seen.places >= tile.low) & (seen.places <= tile.high)).all(axis=1)
    gate = _gate(rules, seen.distance[inside] if inside.sum() >= FEWEST_RETURNS else seen.distance)
    return _sensor(rules, index, weight, seen.origin, (azimuth, elevation), field, gate), int(inside.sum())


def _gate(rules: SearchRules, range_m: np.ndarray) -> np.ndarray:
    """The central 99 % of distances inside the range of the space, shape (2,) [m]; all of it where gates stay open."""
    if not rules.gates:
        return whole_range(rules.space)
    low, high = np.clip(central(range_m), *whole_range(rules.space))
    return opened_gate(float(low), float(high))


def _sensor(
    rules: SearchRules,
    index: int,
    weight: float,
    origin: np.ndarray,
    boresight: tuple[float, float],
    field: np.ndarray,
    gate: np.ndarray,
) -> Sensor:
    """A sensor whose intervals are a field of view (2,) [rad] and a gate (2,) [m]."""
    spread = field / (2 * rules.interval)
    return Sensor(
        name=f"s{index}",
        weight=weight,
        origin_m=origin,
        origin_covariance_m2=np.zeros((3, 3)),
        azimuth_rad=boresight[0],
        elevation_rad=boresight[1],
        roll_rad=0.0,
        spread_horizontal_rad=float(spread[0]),
        spread_vertical_rad=float(spread[1]),
        range_m=float(gate.mean()),
        spread_range_m=float(gate[1] - gate[0]) / (2 * rules.interval),
        level=rules.level,
    )


def scan_starts(rules: SearchRules, views: TrainingViews, count: int) -> list[Start]:
    """Even rays as the simple rivals have them: those of `bounding`, with one gate or one per ray, and of `uniform`.

    Where one angle is free, also rays at equal shares of the returns.
    """
    space, points, site = rules.space, views.observed(views.space).points, LayoutSite(rules.space)
    layouts = [layout.lay_out(count, site) for layout in bounding(views, gates_per_ray=rules.gates)]
    angular = [axis for axis in (AZIMUTH, ELEVATION) if axis in space.free]
    if len(angular) == 1 and layouts:
        rays = layouts[0][0].copy()
        rays[:, angular[0]] = np.quantile(points[:, angular[0]], (np.arange(count) + 0.5) / count)
        layouts += [(rays, gates) for _, gates in layouts[: 1 + rules.gates]]
    low, high, whole = np.array(space.low[:RAY_AXES]), np.array(space.high[:RAY_AXES]), whole_range(space)
    layouts.append((even_placement(low, high, count), np.tile(whole, (count, 1))))
    return [
        tuple(
            _sensor(rules, i, 1.0 / count, ray[:3], (ray[AZIMUTH], ray[ELEVATION]), np.zeros(2), gate)
            for i, (ray, gate) in enumerate(zip(rays, gates if rules.gates else [whole] * count, strict=True))
        )
        for rays, gates in layouts
    ]
