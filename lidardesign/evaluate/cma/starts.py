"""Where a direct search starts: what an engineer would try first, with as many sensors as the design has.

All are built from where training returns are. Sensors at given origins tile the returns as they see them, in every
arrangement of rows, with equal weights or weights by returns; another tiling covers the whole space. Sensors whose
origins are spread out tile the origins, and look in parallel or at where the returns are. Scans are the even layouts
that `bounding` and `uniform` take, with one gate, or with gates by the returns next to each ray.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.design.layouts.grid import low_discrepancy
from lidardesign.design.mixture.bounds import Bounds
from lidardesign.design.sensor import Coupling, Sensor, boresight_frame
from lidardesign.evaluate.baselines.bounding import bounding, parallel_angles
from lidardesign.evaluate.baselines.candidates import LayoutSite, opened_gate, whole_range
from lidardesign.evaluate.baselines.even import central, even_placement
from lidardesign.evaluate.baselines.views import RAY_AXES, Observed, TrainingViews, dense_points, unrolled
from lidardesign.evaluate.cma.model import with_gate
from lidardesign.evaluate.cma.parameters import NARROWEST_RAD, SearchRules, admitted_origins
from lidardesign.numerics import TINY, sphere_exp, sphere_log
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, angles, direction

# Returns further apart than this from their middle are tiled in azimuth and elevation, others in a tangent plane.
TANGENT_RAD = math.radians(70)
# A central 99 % means nothing from fewer returns.
FEWEST_RETURNS = 20
# The angular spread of sensors whose rays are parallel, to start with.
PARALLEL_RAD = math.radians(2)

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
    observed = views.hits(dense_points(rules.space))
    if rules.one_sensor_per_ray:
        return scan_starts(rules, views, observed, count)
    kinds = (_focused, _parallel) if rules.spread_axes else (_tilings,)
    found = [start for kind in kinds if len(observed.points) for start in kind(rules, observed, count)]
    found.append(_even(rules, count))
    if rules.gates:
        return found
    whole_m = whole_range(rules.space).tolist()
    return [tuple(with_gate(sensor, *whole_m) for sensor in start) for start in found]


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
    if rules.axes.origin:
        low, high = central(observed.points[:, :3])
        sets += [_spread_origins(bounds, count), np.tile((low + high) / 2, (count, 1))]
    return [admitted_origins(origins, bounds, rules.constraints) for origins in sets]


def _spread_origins(bounds: Bounds, count: int) -> np.ndarray:
    return bounds.origin_low + low_discrepancy(count, 3) * (bounds.origin_high - bounds.origin_low)


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
    """The central 99 % of distances inside the range of the space, shape (2,) [m]."""
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


def _even(rules: SearchRules, count: int) -> Start:
    """The whole space in tiles whose cells are as square as can be, with the whole range."""
    space, bounds = rules.space, rules.bounds(count)
    low, high = (np.array(end)[[AZIMUTH, ELEVATION]] for end in (space.low, space.high))
    width, height = (high - low) * [math.cos((low[1] + high[1]) / 2), 1.0]
    rows = int(np.clip(round(math.sqrt(count * height / max(width, NARROWEST_RAD))), 1, count))
    origins = admitted_origins(_spread_origins(bounds, count), bounds, rules.constraints)
    sensors = []
    for index, tile in enumerate(tiles(low, high, count, rows)):
        azimuth, elevation = ((tile.low + tile.high) / 2).tolist()
        field = (tile.high - tile.low) * [math.cos(elevation), 1.0]
        sensor = _sensor(rules, index, 1.0 / count, origins[index], (azimuth, elevation), field, whole_range(space))
        if rules.spread_axes:
            extent = (bounds.origin_high - bounds.origin_low)[index] / math.sqrt(count)
            sensor = _spread_out(rules, sensor, extent, 0.0, sensor.spread_horizontal_rad, sensor.spread_vertical_rad)
        sensors.append(sensor)
    return tuple(sensors)


def _spread_out(rules: SearchRules, sensor: Sensor, extent_m: np.ndarray, focus: float, *spread_rad: float) -> Sensor:
    """A sensor whose origins fill a box, with rays that meet at its mean range over the focus (0: parallel)."""
    along = np.isin(np.arange(3), rules.spread_axes)
    deviation = np.where(along, np.maximum(extent_m, 0.0) / (2 * rules.interval), 0.0)
    slopes = -focus * sensor.frame[1:] / max(sensor.range_m, NARROWEST_RAD)
    coupling = Coupling(slopes, np.zeros(3), np.zeros(2), np.array(spread_rad), sensor.spread_range_m)
    whole = np.hypot(spread_rad, np.sqrt(np.square(slopes * deviation).sum(axis=1)))
    return replace(
        sensor,
        origin_covariance_m2=np.diag(np.square(deviation)),
        spread_horizontal_rad=float(whole[0]),
        spread_vertical_rad=float(whole[1]),
        coupling=coupling,
    )


def _origin_tiles(
    rules: SearchRules, low: np.ndarray, high: np.ndarray, count: int
) -> Iterator[list[tuple[np.ndarray, Tile]]]:
    """Origins and the boxes (3,) about them: every arrangement of tiles along the two longest spread axes."""
    axes = sorted(rules.spread_axes, key=lambda axis: low[axis] - high[axis])[:2]
    pair = (axes * 2)[:2]
    for rows in range(1, count + 1) if len(axes) == 2 else (1,):
        plane = tiles(low[pair], high[pair], count, rows)
        boxes = [Tile(low.copy(), high.copy()) for _ in plane]
        for box, tile in zip(boxes, plane, strict=True):
            for place, axis in enumerate(axes):
                box.low[axis], box.high[axis] = tile.low[place], tile.high[place]
        middles = np.array([(box.low + box.high) / 2 for box in boxes])
        yield list(zip(admitted_origins(middles, rules.bounds(count), rules.constraints), boxes, strict=True))


def _parallel(rules: SearchRules, observed: Observed, count: int) -> Iterator[Start]:
    """Origins over the returns, looking straight down where that is admitted."""
    azimuth, elevation = parallel_angles(rules.space, observed)
    looking = direction(azimuth, elevation)
    low, high = (np.clip(end, rules.space.low[:3], rules.space.high[:3]) for end in central(observed.hits_m))
    field = 2 * rules.interval * np.full(2, PARALLEL_RAD)
    for parts in _origin_tiles(rules, low, high, count):
        start = []
        for index, (origin, box) in enumerate(parts):
            gate = _gate(rules, np.maximum((observed.hits_m - origin) @ looking, 0.0))
            sensor = _sensor(rules, index, 1.0 / count, origin, (azimuth, elevation), field, gate)
            start.append(_spread_out(rules, sensor, box.high - box.low, 0.0, PARALLEL_RAD, PARALLEL_RAD))
        yield tuple(start)


def _focused(rules: SearchRules, observed: Observed, count: int) -> Iterator[Start]:
    """Origins over all that see returns, each part looking at the middle of what it sees, or half as focused."""
    for parts in _origin_tiles(rules, *central(observed.points[:, :3]), count):
        for focus in (1.0, 0.5):
            yield tuple(
                _looking_at(rules, observed, index, origin, box, count, focus)
                for index, (origin, box) in enumerate(parts)
            )


def _looking_at(
    rules: SearchRules, observed: Observed, index: int, origin: np.ndarray, box: Tile, count: int, focus: float
) -> Sensor:
    """The sensor whose origins fill a box, looking at what is seen from there."""
    starts_m = observed.points[:, :3]
    inside = ((starts_m >= box.low) & (starts_m <= box.high))[:, list(rules.spread_axes)].all(axis=1)
    chosen = inside if inside.sum() >= FEWEST_RETURNS else np.ones(len(inside), dtype=bool)
    hits, middle = observed.hits_m[chosen], observed.hits_m[chosen].mean(axis=0)
    azimuth, elevation = (float(angle) for angle in angles(middle - origin))
    gate = _gate(rules, np.linalg.norm(hits - origin, axis=1))
    sensor = _sensor(rules, index, 1.0 / count, origin, (azimuth, elevation), np.zeros(2), gate)
    across = (hits - middle) @ sensor.frame[1:].T / max(float(np.linalg.norm(middle - origin)), NARROWEST_RAD)
    return _spread_out(
        rules, sensor, box.high - box.low, focus, *np.maximum(across.std(axis=0), NARROWEST_RAD).tolist()
    )


def scan_starts(rules: SearchRules, views: TrainingViews, observed: Observed, count: int) -> list[Start]:
    """Even rays with one gate, as the simple rivals have them, and with gates by the returns next to each ray."""
    found = []
    for points, gate in scan_layouts(rules.space, views, observed, count):
        every = np.tile(gate if rules.gates else whole_range(rules.space), (count, 1))
        for gates in (every, nearby_gates(rules, observed, points, every))[: 1 + rules.gates]:
            found.append(
                tuple(
                    _sensor(rules, i, 1.0 / count, point[:3], (point[AZIMUTH], point[ELEVATION]), np.zeros(2), gate_m)
                    for i, (point, gate_m) in enumerate(zip(points, gates, strict=True))
                )
            )
    return found


def scan_layouts(
    space: DesignSpace, views: TrainingViews, observed: Observed, count: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points (N, 5) and one gate (2,) each: those of `bounding`, at equal shares of the returns, and of `uniform`."""
    laid_out = [layout.lay_out(count, LayoutSite(space)) for layout in bounding(views)]
    found = [(points, gates[0]) for points, gates in laid_out]
    angular = [axis for axis in (AZIMUTH, ELEVATION) if axis in space.free]
    if len(angular) == 1 and len(observed.points) and found:
        points = found[0][0].copy()
        points[:, angular[0]] = np.quantile(observed.points[:, angular[0]], (np.arange(count) + 0.5) / count)
        found.append((points, found[0][1]))
    low, high = np.array(space.low[:RAY_AXES]), np.array(space.high[:RAY_AXES])
    return [*found, (even_placement(low, high, count), whole_range(space))]


def nearby_gates(rules: SearchRules, observed: Observed, points: np.ndarray, gates: np.ndarray) -> np.ndarray:
    """Gates (N, 2) by the returns whose rays are nearest to each ray; where they are few, the one it had [m]."""
    free = [axis for axis in range(RAY_AXES) if axis in rules.space.free]
    if not (free and len(observed.points)):
        return gates
    scale = np.maximum(np.ptp(observed.points[:, free], axis=0), TINY)
    nearest = cKDTree(points[:, free] / scale).query(observed.points[:, free] / scale)[1]
    found = gates.copy()
    for ray in range(len(points)):
        range_m = observed.points[nearest == ray, RANGE]
        if len(range_m) >= FEWEST_RETURNS:
            found[ray] = _gate(rules, range_m)
    return found
