"""From a design to the explicit list of rays that it fires.

Budgets are split by largest remainder. Rays start at their sensor's mean origin, are ordered by sensor, and
fire evenly over the frame: ray i of n starts at i / (n * rate).
"""

from __future__ import annotations

import math

import numpy as np

from lidardesign.design.sensor import Design, Sensor, tangent_directions
from lidardesign.errors import ConfigError
from lidardesign.simulate.returns import Rays

# Shares of a ray closer than this are the same share: weights that were normalised differ by a few ulp.
REMAINDER_DECIMALS = 9


def split_budget(weights: np.ndarray, count: int) -> np.ndarray:
    """Whole numbers of rays in proportion to weights: (G,) to int64 (G,) with the sum `count` exactly.

    Largest remainder (Hamilton): every sensor gets the whole part of its quota, the rays left over go to the
    largest fractional parts, the lower index first where they tie.

    Raises:
        ConfigError: Weights that are negative, not finite or all zero; a negative count.
    """
    weights = np.asarray(weights, dtype=np.float64)
    if weights.ndim != 1 or not len(weights):
        raise ConfigError(
            f"weights of shape {weights.shape}", where="budget", allowed="one weight per sensor"
        )
    if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.max() > 0):
        raise ConfigError(
            "weights are negative, not finite or all zero", where="budget", allowed="0 or more, one above 0"
        )
    if count < 0:
        raise ConfigError(f"{count} rays", where="budget", allowed="0 or more")
    scaled = weights / weights.max()
    quotas = scaled / scaled.sum() * count
    shares = np.floor(quotas).astype(np.int64)
    order = np.argsort(-np.round(quotas - shares, REMAINDER_DECIMALS), kind="stable")
    shares[order[: count - int(shares.sum())]] += 1
    return shares


def grid_rows(horizontal: float, vertical: float, count: int) -> np.ndarray:
    """Rays per row of an even grid: field of view [rad], rays to int64 (rows,), summing to `count`.

    The number of rows makes the cells as square as whole numbers allow; the rays are spread over them as
    evenly and as symmetrically as possible, so a k by k budget in a square field is the regular grid.
    """
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    if vertical <= 0 or horizontal <= 0:
        rows = 1 if vertical <= 0 else count
    else:
        ideal = math.sqrt(count * vertical / horizontal)
        fewer = max(math.floor(ideal), 1)
        rows = min(fewer if ideal**2 <= fewer * (fewer + 1) else fewer + 1, count)
    # floor((2 i n + rows) / (2 rows)) rounds i n / rows half up in whole numbers, without a rounding error
    edges = (2 * np.arange(rows + 1, dtype=np.int64) * count + rows) // (2 * rows)
    return np.diff(edges)


def grid_tangent(horizontal: float, vertical: float, count: int) -> np.ndarray:
    """Cell-centred angles of an even grid in a field of view, row by row upwards: shape (count, 2) [rad]."""
    rows = grid_rows(horizontal, vertical, count)
    across = [(np.arange(n) + 0.5) / n - 0.5 for n in rows]
    up = [np.full(n, (row + 0.5) / len(rows) - 0.5) for row, n in enumerate(rows)]
    if not rows.size:
        return np.zeros((0, 2))
    return np.stack([horizontal * np.concatenate(across), vertical * np.concatenate(up)], axis=1)


def field_on_sphere(sensor: Sensor) -> tuple[float, float]:
    """The field of view, shrunk in proportion where its corner would lie beyond the antipode [rad]."""
    horizontal, vertical = sensor.field_of_view_rad
    corner = math.hypot(horizontal, vertical) / 2
    scale = math.pi / corner if corner > math.pi else 1.0
    return scale * horizontal, scale * vertical


def grid_directions(sensor: Sensor, count: int) -> np.ndarray:
    """Unit vectors of an even grid in a sensor's own field of view, shape (count, 3)."""
    return tangent_directions(sensor.frame, grid_tangent(*field_on_sphere(sensor), count))


def lay_out(design: Design, count: int | None = None, *, rate_hz: float = 10.0) -> Rays:
    """The rays of a design with an even grid in each sensor's field of view.

    Arguments:
        design: The design.
        count: Rays per frame; None takes the design's own number.
        rate_hz: Frames per second [Hz].

    Raises:
        ConfigError: No budget is known.
    """
    total = design.rays if count is None else count
    if total is None:
        raise ConfigError("the design names no number of rays", where=design.name, hint="give --rays N")
    shares = split_budget(design.weights, total)
    sensor = np.repeat(np.arange(len(shares)), shares)
    directions = [grid_directions(s, int(n)) for s, n in zip(design.sensors, shares, strict=True)]
    return Rays(
        origin_m=np.array([s.origin_m for s in design.sensors])[sensor],
        direction=np.concatenate(directions),
        gate_m=np.array([s.gate_m for s in design.sensors])[sensor],
        sensor=sensor,
        time_s=np.arange(total) / (max(total, 1) * rate_hz),
    )
