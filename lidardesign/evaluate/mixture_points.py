"""Design points that a design's sensors stand for, spread evenly through their normal distributions: no randomness."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from lidardesign.design.grid import low_discrepancy
from lidardesign.design.sensor import Design, Sensor, tangent_directions
from lidardesign.design.track import placed
from lidardesign.space import angles

POINTS = 48_000  # of a design, shared by its sensors
FEWEST = 64  # of a sensor
PLACES = 9  # along a track


def mixture_points(design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Points of a design's mixture and their weights, shapes (N, 6) and (N,); the weights sum to 1.

    A track counts at evenly spread knots, equally.
    """
    moments = _along_track(design)
    sensors = [sensor for moment in moments for sensor in moment.sensors]
    weights = np.concatenate([moment.weights for moment in moments]) / len(moments)
    count = max(POINTS // len(sensors), FEWEST)
    normal = ndtri(low_discrepancy(count, 6))
    points = np.concatenate([sensor_points(sensor, normal) for sensor in sensors])
    return points, np.repeat(weights / count, count)


def sensor_points(sensor: Sensor, normal: np.ndarray) -> np.ndarray:
    """Design points of a sensor at standard normal coordinates, (N, 6) to (N, 6): origin, direction and range.

    Ranges below 0 are none, and become 0.
    """
    origin = normal[:, :3] @ _square_root(sensor.origin_covariance_m2).T
    spread = np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad])
    tangent, range_m = normal[:, 3:5] * spread, sensor.range_m + sensor.spread_range_m * normal[:, 5]
    follow = sensor.coupling
    if follow is not None:
        tangent = origin @ follow.direction_per_m.T + normal[:, 3:5] * follow.spread_rad
        range_m = sensor.range_m + origin @ follow.range_per_m + tangent @ follow.range_per_rad
        range_m = range_m + follow.spread_m * normal[:, 5]
    azimuth, elevation = angles(tangent_directions(sensor.frame, tangent))
    return np.column_stack([origin + sensor.origin_m, azimuth, elevation, np.maximum(range_m, 0.0)])


def _along_track(design: Design) -> list[Design]:
    track = design.track
    if track is None:
        return [design]
    chosen = np.unique(np.linspace(0, len(track.knots) - 1, PLACES).round().astype(int))
    return [placed(design, {track.dimension: float(track.knots[index])}) for index in chosen]


def _square_root(covariance: np.ndarray) -> np.ndarray:
    """A with A A' = covariance, also where that is singular: origins are often fixed along an axis."""
    values, vectors = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    return vectors * np.sqrt(np.maximum(values, 0.0))
