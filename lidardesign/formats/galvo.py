r"""Rays for a two-mirror scanner with a gated single-photon detector: mirror angles in the order of least travel.

The beam meets the x mirror, then the y mirror. Turning a mirror by an angle turns the beam by twice that angle: the
optical scan angles x and y here are twice the mechanical ones. The x mirror fans the beam out sideways, the y mirror
turns that fan about the sideways axis:

.. math:: v = \cos x \cos y\; f + \sin x\; h + \cos x \sin y\; u

with f the boresight (where x = y = 0), h the direction of growing azimuth and u that of growing elevation, right-handed
and without roll. For mirrors at one place this is exact (two rotations by twice the mirrors' angles); on a flat screen
at the distance D it lands at D tan(x) / cos(y) sideways and D tan(y) upwards, the known pincushion of such scanners.
Light needs 2 range / c forth and back, so gates are two-way times.

A file has one row per ray, in the order in which the mirrors reach them. A scanner has one origin, so rays with another
origin are the rows of another `position`, with its own origin, boresight and tour: the scanner is moved there, or a
second one is placed there. A position's boresight is the middle of its rays.

The order is a short round trip. Both mirrors turn at once, so a step takes as long as the one that turns further: the
length of a step is the larger of its two angles. Frames follow each other, so the tour is closed. Tours start from the
nearest neighbour and from the rays' own order, and are improved by reversing segments (2-opt, Croes 1958) until none
shortens them. The result is deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidardesign.errors import ConfigError, DataError
from lidardesign.formats import Format
from lidardesign.formats.ray_lists import LOST, row_of_numbers
from lidardesign.numerics import COARSE_SLACK, EPSILON, ROUNDING, SLACK
from lidardesign.run.arrays import csv_rows
from lidardesign.run.files import write_atomic
from lidardesign.run.inputs import RAY_TABLE, read_head
from lidardesign.scenes.rays import Rays, fire_times
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import boresight_frame
from lidardesign.space import angles

NEIGHBOURS = 6  # nearest stops to which 2-opt may connect a stop
# Nearest-neighbour tours cost time with the square of their stops; larger ones start from the rays' own order alone.
MOST_NEAREST = 20_000
# Rounds of improvement: 576 stops take 40, 5000 take 200; bounds the time of ever larger tours.
MOST_ROUNDS = 500
# Gains below this share of the tour's extent are rounding noise, and could alternate for ever.
LEAST_GAIN = ROUNDING
# Columns of a file, those of whole numbers first.
WHOLE = ("step", "position", "gate_start_ps", "gate_width_ps", "sensor", "ray")
COLUMNS = (
    "step", "position", "origin_x_m", "origin_y_m", "origin_z_m", "boresight_azimuth_deg", "boresight_elevation_deg",
    "x_deg", "y_deg", "gate_start_ps", "gate_width_ps", "sensor", "ray",
)  # fmt: skip
# Byte order mark that spreadsheets put in front of UTF-8.
BOM = b"\xef\xbb\xbf"
# Angles at the limit come out of sines and cosines a few units in the last place off.
ROUNDING_DEG = SLACK
# Whole numbers up to here are exact as float64; light takes 104 days for so many picoseconds.
MOST_WHOLE = 2**53
LIMIT_DEG = 20.0  # optical, to each side
SPEED_OF_LIGHT_M_PER_PS = SPEED_OF_LIGHT_M_S * 1e-12
# Times of whole picoseconds come back from metres a few units in the last place off (1e-8 ps at 10 km).
ROUNDING_PS = COARSE_SLACK
# Boresights are given in so many decimals of a degree, which moves no ray by more than a microdegree.
BORESIGHT_DECIMALS = 6
# Centring converges within a few steps for fields of any size below a hemisphere.
CENTRING_STEPS = 20


def short_tour(points: np.ndarray) -> np.ndarray:
    """Order of stops (N, 2) along a short closed tour, indices of shape (N,).

    It begins after the longest step, which closes the tour.
    """
    count = len(points)
    if count < 4:
        return np.arange(count)
    # The nearest other stops of each, shape (N, K)
    from scipy.spatial import cKDTree

    found = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)), p=np.inf)[1]
    # where many stops are at one place, a stop need not be the first of its own neighbours
    own = found == np.arange(len(points))[:, None]
    own[~own.any(axis=1), -1] = True
    near = found[~own].reshape(len(points), -1)
    starts = [np.arange(count), *([_nearest(points)] if count <= MOST_NEAREST else [])]
    best = min((_improved(points, near, start) for start in starts), key=lambda tour: travel(points[tour]))
    return np.roll(best, -1 - int(_lengths(points[best], points[np.roll(best, -1)]).argmax()))


def travel(stops: np.ndarray) -> float:
    """Length of the closed tour over stops (N, 2) in their order."""
    return float(_lengths(stops, np.roll(stops, -1, axis=0)).sum())


def _lengths(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs(first - second).max(axis=-1)


def _nearest(points: np.ndarray) -> np.ndarray:
    """Nearest-neighbour tour from the stop at the lowest corner, indices of shape (N,)."""
    left, here = np.arange(len(points)), int((points - points.min(axis=0)).sum(axis=1).argmin())
    order = []
    while len(left):
        order.append(left[here])
        place = points[left[here]]
        left[here:-1] = left[here + 1 :]
        left = left[:-1]
        if len(left):
            here = int(_lengths(points[left], place).argmin())
    return np.array(order)


def _improved(points: np.ndarray, near: np.ndarray, tour: np.ndarray) -> np.ndarray:
    """The tour after up to `MOST_ROUNDS` rounds of 2-opt."""
    least, rounds = LEAST_GAIN * float(np.ptp(points, axis=0).max()), 0
    while rounds < MOST_ROUNDS and _turned(points, near, tour, least):
        rounds += 1
    return tour


def _turned(points: np.ndarray, near: np.ndarray, tour: np.ndarray, least: float) -> bool:
    """Do one round of 2-opt in place, reversing segments without overlap, the best first; True if any shortens it."""
    count, place = len(tour), np.argsort(tour)
    here, there = np.repeat(place, near.shape[1]), place[near.ravel()]
    # an edge is indexed by its first end; a stop is the first end of one edge and the last of another
    edges = np.concatenate([np.stack([here, there]), np.stack([here - 1, there - 1]) % count], axis=1)
    first, last = edges.min(axis=0), edges.max(axis=0)
    stops = points[tour]
    a, b, c, d = stops[first], stops[(first + 1) % count], stops[last], stops[(last + 1) % count]
    gain = _lengths(a, b) + _lengths(c, d) - _lengths(a, c) - _lengths(b, d)
    helpful = np.flatnonzero((gain > least) & (last > first + 1))
    free = np.ones(count + 1, dtype=bool)
    for move in helpful[np.argsort(-gain[helpful], kind="stable")]:
        low, high = int(first[move]), int(last[move])
        if free[low] and free[high + 1] and free[low : high + 2].all():
            free[low : high + 2] = False
            tour[low + 1 : high + 1] = tour[low + 1 : high + 1][::-1].copy()
    return bool(len(helpful))


@dataclass(frozen=True, eq=False)
class Position:
    """Origin and boresight of a scanner, and its rays in firing order.

    Arguments:
        origin_m: Origin [m], shape (3,).
        boresight_deg: Azimuth and elevation with both mirrors at zero [deg].
        ray: Indices into the design's rays, shape (K,).
        angles_deg: Optical scan angles x and y, shape (K, 2).
        own_travel_deg: Length of the closed tour in the design's own order [deg].
    """

    origin_m: np.ndarray
    boresight_deg: tuple[float, float]
    ray: np.ndarray
    angles_deg: np.ndarray
    own_travel_deg: float


def write_galvo(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write the file, atomically; returns a summary and notes of what the format cannot hold.

    Raises:
        ConfigError: Rays of one sensor start at several places, or look beyond what the mirrors reach.
    """
    positions = plan(design, rays)
    gates = gate_ps(rays.gate_m)
    lines = [",".join(COLUMNS)]
    for number, one in enumerate(positions):
        shared = [repr(float(value)) for value in (*one.origin_m, *one.boresight_deg)]
        for ray, (x, y) in zip(one.ray.tolist(), one.angles_deg.tolist(), strict=True):
            start, width = gates[ray].tolist()
            row = (len(lines) - 1, number, *shared, repr(x), repr(y), start, width, int(rays.sensor[ray]), ray)
            lines.append(",".join(map(str, row)))
    write_atomic(path, "\n".join(lines) + "\n")
    return [
        *_summary(positions),
        *LOST,
        "gates are whole picoseconds (0.15 mm), opened outward; firing times follow from the order of the rows",
    ]


GALVO = Format(
    "galvo",
    ".galvo.csv",
    "mirror angles in the order of least travel, gates in ps: +-20 degrees per axis",
    write_galvo,
    reader="a script that drives two mirrors and a gated detector",
    checked="read by `capture`",
)


def plan(design: DesignSpec, rays: Rays) -> list[Position]:
    """Positions of a scanner that fires all rays, in the order of their first rays.

    Raises:
        ConfigError: Rays of one sensor start at several places, or look beyond what the mirrors reach.
    """
    origins, first, place = np.unique(rays.origin_m, axis=0, return_index=True, return_inverse=True)
    place = place.reshape(-1)
    for index, sensor in enumerate(design.sensors):
        places = len(np.unique(place[rays.sensor == index]))
        if places > 1:
            raise ConfigError(
                f"the rays of sensor {sensor.name!r} start at {places} places, but a steering mirror stands at one",
                where=design.name,
                allowed="one origin per sensor",
                hint="lidardesign constrain RUN without origin.spread_m, or with origin.fixed_m in the constraints",
            )
    positions = []
    for here in np.argsort(first):
        chosen = np.flatnonzero(place == here)
        boresight = middle_boresight_deg(rays.direction[chosen])
        angles_deg = scan_angles_deg(degree_frame(*boresight), rays.direction[chosen])
        order = short_tour(angles_deg)
        positions.append(Position(origins[here], boresight, chosen[order], angles_deg[order], travel(angles_deg)))
    _refuse_far_rays(design, rays, positions)
    return positions


def read_galvo(path: Path) -> Rays:
    """Read the rays of a file of `write_galvo`, in the design's own order.

    They fire at the times of their steps, 10 frames a second. Directions are exact to rounding, gates are rounded
    outward to whole picoseconds.

    Raises:
        DataError: The file is missing, is no such table, or has values out of range.
    """
    table = _columns(path)
    count = len(table["ray"])
    if sorted(table["ray"].tolist()) != list(range(count)) or sorted(table["step"].tolist()) != list(range(count)):
        raise DataError(
            "rays or steps are missing or given twice", where=str(path), allowed=f"each of 0 to {count - 1}"
        )
    directions = np.empty((count, 3))
    boresights = np.stack([table["boresight_azimuth_deg"], table["boresight_elevation_deg"]], axis=1)
    scan_deg = np.stack([table["x_deg"], table["y_deg"]], axis=1)
    for boresight in np.unique(boresights, axis=0):
        rows = (boresights == boresight).all(axis=1)
        directions[rows] = scan_directions(degree_frame(*boresight), scan_deg[rows])
    gates = gate_m(np.stack([table["gate_start_ps"], table["gate_width_ps"]], axis=1))
    origins = np.stack([table[f"origin_{axis}_m"] for axis in "xyz"], axis=1)
    times = fire_times(count, Bandwidth().rate_hz)[table["step"]]
    return Rays(origins, directions, gates, table["sensor"], times).subset(np.argsort(table["ray"]))


def is_galvo_file(path: Path) -> bool:
    """True if a file has the header of `write_galvo`."""
    try:
        return read_head(path, RAY_TABLE).removeprefix(BOM).startswith(",".join(COLUMNS).encode())
    except DataError:
        return False


def _refuse_far_rays(design: DesignSpec, rays: Rays, positions: list[Position]) -> None:
    ray = np.concatenate([one.ray for one in positions] or [np.zeros(0, dtype=np.int64)])
    angles_deg = np.concatenate([one.angles_deg for one in positions] or [np.zeros((0, 2))])
    beyond = np.abs(angles_deg).max(axis=1) > LIMIT_DEG + ROUNDING_DEG
    if not beyond.any():
        return
    worst = int(np.abs(angles_deg).max(axis=1).argmax())
    x, y = angles_deg[worst]
    sensor = design.sensors[int(rays.sensor[ray[worst]])].name
    raise ConfigError(
        f"{int(beyond.sum())} of {len(ray)} rays are beyond the mirrors' reach, the farthest at x = {x:.2f}, "
        f"y = {y:.2f} degrees from the middle of the rays (ray {ray[worst]}, sensor {sensor!r})",
        where=design.name,
        allowed=f"+-{LIMIT_DEG:g} degrees of optical scan angle per axis",
        hint="constrain field_of_view and boresight (such as boresight.elevation_deg.max=20), or use fewer sensors",
    )


def _summary(positions: list[Position]) -> list[str]:
    if not positions:
        return []
    after = sum(travel(one.angles_deg) for one in positions)
    before = sum(one.own_travel_deg for one in positions)
    widest = np.abs(np.concatenate([one.angles_deg for one in positions])).max(axis=0)
    notes = [
        f"the mirrors travel {after:.1f} degrees per frame, {before:.1f} in the design's own order",
        f"optical angles (twice the mechanical ones) up to +-{widest[0]:.2f} in x and +-{widest[1]:.2f} degrees in y",
    ]
    if len(positions) > 1:
        notes.append(f"the rays start at {len(positions)} places: one scanner each, or one that is moved there")
    else:
        azimuth, elevation = positions[0].boresight_deg
        place = ", ".join(f"{value:g}" for value in positions[0].origin_m)
        notes.append(f"scanner at ({place}) m, boresight at azimuth {azimuth:g}, elevation {elevation:g} degrees")
    return notes


def _columns(path: Path) -> dict[str, np.ndarray]:
    where = str(path)
    (_, header), *rows = csv_rows(path, RAY_TABLE) or [(1, [])]
    if tuple(header) != COLUMNS:
        raise DataError("is not a ray list of the galvo format", where=where, allowed=",".join(COLUMNS))
    values = np.array([_numbers(row, f"{where}:{line}") for line, row in rows]).reshape(-1, len(COLUMNS))
    return {
        name: column.astype(np.int64) if name in WHOLE else column
        for name, column in zip(COLUMNS, values.T, strict=True)
    }


def _numbers(row: list[str], where: str) -> list[float]:
    """Checked values of a row: finite, within limits, and whole and not negative in the columns `WHOLE`."""
    found = row_of_numbers(where, row, COLUMNS, WHOLE)
    for name, value in found.items():
        if name in WHOLE and (value != int(value) or value > MOST_WHOLE):
            raise DataError(f"{name} is {value:g}", where=where, allowed="whole numbers, 0 or more")
        if name in ("x_deg", "y_deg") and abs(value) > LIMIT_DEG + ROUNDING_DEG:
            raise DataError(f"{name} is {value:g}", where=where, allowed=f"+-{LIMIT_DEG:g} degrees")
    return list(found.values())


def scan_angles_deg(frame: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Optical scan angles (x, y) of unit vectors in a boresight's frame: (3, 3), (N, 3) to (N, 2) [deg]."""
    forward, sideways, upward = (directions @ frame.T).T
    return np.degrees(np.stack([np.arctan2(sideways, np.hypot(forward, upward)), np.arctan2(upward, forward)], axis=1))


def scan_directions(frame: np.ndarray, angles_deg: np.ndarray) -> np.ndarray:
    """Unit vectors of optical scan angles (x, y): (3, 3), (N, 2) [deg] to (N, 3); the inverse of `scan_angles_deg`."""
    x, y = np.radians(angles_deg).T
    return np.stack([np.cos(x) * np.cos(y), np.sin(x), np.cos(x) * np.sin(y)], axis=1) @ frame


def degree_frame(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Rows forward, sideways, upward of a boresight [deg], shape (3, 3)."""
    return boresight_frame(np.radians(azimuth_deg), np.radians(elevation_deg))


def middle_boresight_deg(directions: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the boresight with the smallest largest scan angle of rays (N, 3).

    From the mean direction, the boresight is moved to the middle of the rays' extent in x and y until it stays there.
    """
    mean = directions.mean(axis=0)
    forward = mean if np.linalg.norm(mean) > EPSILON else directions[0]
    found: list[tuple[float, tuple[float, float]]] = []
    for _ in range(CENTRING_STEPS):
        azimuth, elevation = angles(forward)
        centre = (
            round(float(np.degrees(azimuth)), BORESIGHT_DECIMALS),
            round(float(np.degrees(elevation)), BORESIGHT_DECIMALS),
        )
        frame = degree_frame(*centre)
        seen = scan_angles_deg(frame, directions)
        found.append((float(np.abs(seen).max()), centre))
        forward = scan_directions(frame, (seen.min(axis=0) + seen.max(axis=0))[None] / 2)[0]
    return min(found)[1]


def gate_ps(gate_m: np.ndarray) -> np.ndarray:
    """Start and width of gates (N, 2) [m] in whole picoseconds of two-way time, rounded outward, shape (N, 2)."""
    times = 2 * np.asarray(gate_m, dtype=np.float64) / SPEED_OF_LIGHT_M_PER_PS
    start = np.floor(times[:, 0] + ROUNDING_PS)
    end = np.ceil(times[:, 1] - ROUNDING_PS)
    return np.stack([start, np.maximum(end - start, 0)], axis=1).astype(np.int64)


def gate_m(start_width_ps: np.ndarray) -> np.ndarray:
    """Gates (N, 2) [m] of starts and widths of two-way time, shape (N, 2) [ps]."""
    start, width = np.asarray(start_width_ps, dtype=np.float64).T
    return np.stack([start, start + width], axis=1) * SPEED_OF_LIGHT_M_PER_PS / 2
