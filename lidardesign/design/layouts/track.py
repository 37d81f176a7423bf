"""Rays along a track: where each ray looks and listens at any position between the knots.

Directions and gates are linear in between, so they are continuous, pass through the knots exactly, and keep every
bound on elevation, azimuth, start, end and width that both neighbouring knots keep: each is a convex set per ray.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lidardesign.design.mixture.support import condition_text
from lidardesign.design.sensor import DesignSpec, Sensor, Track, interval_factor
from lidardesign.errors import ConfigError
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import wrap_angle, wrap_turn
from lidardesign.space import DIMENSIONS

# Conditions that a sensor can travel along: where a ray starts, not where it looks.
TRAVELLED = DIMENSIONS[:3]


def placed(design: DesignSpec, at: Mapping[str, float]) -> DesignSpec:
    """The design as it is at one value of its conditions.

    A track gives its rays there, as an explicit table with one sensor per ray. Other designs are bolted onto what
    moves: the named coordinate of every origin becomes the value, and directions and gates stay.

    Arguments:
        design: Any design.
        at: Values by dimension, as {"x_m": 0.37}.

    Raises:
        ConfigError: A track without a value of its dimension, or one beyond its ends; a name that is no coordinate.
    """
    if design.track is not None:
        # The rays of a track at a position, as a scan with an explicit table
        unknown = [name for name in at if name != design.track.dimension and at[name] != design.at.get(name)]
        if unknown:
            raise ConfigError(
                f"the track of {design.name} does not follow {condition_text({unknown[0]: at[unknown[0]]})}",
                where="--at",
                allowed=design.track.dimension,
            )
        if design.track.dimension not in at:
            first, last = travels(design.track)
            raise ConfigError(
                f"{design.name} has rays for every {design.track.dimension}: it needs to know where",
                where="--at",
                allowed=f"{design.track.dimension} from {first:g} to {last:g}",
                hint=f"give --at {design.track.dimension}={(first + last) / 2:g}",
            )
        value = float(at[design.track.dimension])
        azimuth, elevation, gate = interpolated(design.track, value)
        move = {DIMENSIONS.index(design.track.dimension): value}
        means = np.array([sensor.origin_m for sensor in design.sensors], dtype=np.float64)
        table = Rays.from_angles(
            _moved(means[design.track.sensor], move), azimuth, elevation, gate, design.track.sensor
        )
        sensors = tuple(
            _turned(
                sensor, design.track, value, np.flatnonzero(design.track.sensor == index), (azimuth, elevation, gate)
            )
            for index, sensor in enumerate(design.sensors)
        )
        return replace(design, sensors=sensors, ray_table=table, track=None, at={**design.at, **at})
    moves = _moves(design, at)
    table = design.ray_table
    if table is not None:
        table = replace(table, origin_m=_moved(table.origin_m, moves))
    sensors = tuple(_bolted(sensor, moves) for sensor in design.sensors)
    return replace(design, sensors=sensors, ray_table=table, at={**design.at, **at})


def moved(rays: Rays, design: DesignSpec, at: Mapping[str, float]) -> Rays:
    """Rays of a design that is no track, with every origin's named coordinate at a value.

    Raises:
        ConfigError: A name that is no coordinate of the origin, at another value than the design's own.
    """
    return replace(rays, origin_m=_moved(rays.origin_m, _moves(design, at)))


def interpolated(track: Track, at: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth and elevation (N,) [rad] and gates (N, 2) [m] at one position; exactly the knot's at a knot.

    Raises:
        ConfigError: The position lies beyond the track's ends, or is no number.
    """
    first, last = float(track.knots[0]), float(track.knots[-1])
    if not (math.isfinite(at) and first <= at <= last):
        raise ConfigError(
            f"{track.dimension}={at:g} is beyond the ends of the track",
            where="--at",
            allowed=f"{first:g} to {last:g}",
        )
    right = int(np.clip(np.searchsorted(track.knots, at), 1, len(track.knots) - 1))
    share = (at - track.knots[right - 1]) / (track.knots[right] - track.knots[right - 1])

    def between(values: np.ndarray) -> np.ndarray:
        return (1 - share) * values[right - 1] + share * values[right]

    return between(track.azimuth_rad), between(track.elevation_rad), between(track.gate_m)


def boresight_azimuth(unrolled_rad: float) -> float:
    """An azimuth as it is written: as it stands within a turn of 0, else in [0, 2 pi) [rad]."""
    within = -2 * math.pi < unrolled_rad < 2 * math.pi
    return float(unrolled_rad if within else wrap_turn(wrap_angle(np.float64(unrolled_rad))))


def travels(track: Track) -> tuple[float, float]:
    """The ends of a track [m]."""
    return float(track.knots[0]), float(track.knots[-1])


def _turned(
    sensor: Sensor, track: Track, value: float, rays: np.ndarray, looks: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Sensor:
    """A sensor at a position; where one ray is all it fires, its boresight and gate are the ray's."""
    here = _bolted(sensor, {DIMENSIONS.index(track.dimension): value})
    if len(rays) != 1:
        return here
    azimuth, elevation, gate = (values[rays[0]] for values in looks)
    start, end = gate
    return replace(
        here,
        azimuth_rad=boresight_azimuth(azimuth),
        elevation_rad=float(elevation),
        range_m=float(start + end) / 2,
        spread_range_m=float(end - start) / (2 * interval_factor(sensor.level)),
    )


def _bolted(sensor: Sensor, moves: Mapping[int, float]) -> Sensor:
    """A sensor whose origin has these coordinates, without spread along them."""
    covariance = np.array(sensor.origin_covariance_m2, dtype=np.float64)
    for axis in moves:
        covariance[axis, :] = covariance[:, axis] = 0.0
    return replace(sensor, origin_m=_moved(sensor.origin_m, moves), origin_covariance_m2=covariance)


def _moves(design: DesignSpec, at: Mapping[str, float]) -> dict[int, float]:
    """The coordinates of origins that change. Only origins move; a design for one direction is not one for another."""
    for name, value in at.items():
        if name not in DIMENSIONS:
            allowed = ", ".join(DIMENSIONS)
            raise ConfigError(f"{name!r} is no dimension of the design space", where="--at", allowed=allowed)
        if not math.isfinite(value):
            raise ConfigError(f"{name}={value}", where="--at", allowed="a finite number")
        if name not in TRAVELLED and design.at.get(name) != value:
            raise ConfigError(
                f"{design.name} cannot be moved to {name}={value:g}",
                where="--at",
                allowed=condition_text({name: design.at[name]}) if name in design.at else ", ".join(TRAVELLED),
                hint=f"lidardesign fit RUN --at {name}={value:g}",
            )
    return {DIMENSIONS.index(name): float(value) for name, value in at.items() if name in TRAVELLED}


def _moved(origin_m: np.ndarray, moves: Mapping[int, float]) -> np.ndarray:
    moved = np.array(origin_m, dtype=np.float64)
    for axis, value in moves.items():
        moved[..., axis] = value
    return moved
