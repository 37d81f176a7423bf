r"""The constrained M-step: each block of parameters at its best inside its `Bounds`.

`maximise` joins the blocks: `_fit_origins` (with `origin_step`) keeps origins in their boxes, `fit_gate` keeps the
bounds on the start, end and width of gates, `_fit_directions` turns boresights inside theirs, and `fit_field` keeps
fields of view.

Origin, gate, and angular spreads with roll are exact maximisers of the expected log-likelihood Q inside
their bounds (an origin between excluded boxes is at least no worse than before, see `origin_step`). The boresight
moves by the weighted mean of the tangent coordinates along the sphere (exponential map); that is exact in the
flat limit, so `em` accepts it only where the log-likelihood does not fall and otherwise keeps the boresight, which
makes the remaining step exact.
"""

from __future__ import annotations

import math

import numpy as np

from lidardesign.mixture.bounds import LARGEST_ROLL_RAD, Bounds, Floors, clip_azimuth
from lidardesign.mixture.components import SMALLEST_WEIGHT, Features, Mixture, Statistics
from lidardesign.mixture.origin_step import OriginLimits, best_origins
from lidardesign.numerics import COARSE_SLACK, SLACK, box_quadratic_minimum, sphere_exp, sphere_log, wrap_angle
from lidardesign.sensors.sensor import boresight_frame

# A component with less than this share of the samples keeps its parameters: its moments are rounding noise.
SMALLEST_MASS = SLACK
# Boresights this close to a pole have no usable azimuth metric; the box is then enforced by clipping alone.
POLE_COSINE = COARSE_SLACK


def maximise(
    mixture: Mixture, statistics: Statistics, features: Features, bounds: Bounds, floors: Floors, step: float
) -> Mixture:
    """New parameters from the statistics at the old ones.

    Arguments:
        mixture: The old parameters; statistics are in its boresight frames.
        statistics: From `mixture.expect`.
        features: What the statistics were taken of.
        bounds: Admissible parameters.
        floors: Smallest standard deviations.
        step: Share of the boresight's mean step that is taken, 0 to 1.
    """
    alive = statistics.mass > SMALLEST_MASS
    mass = np.where(alive, statistics.mass, 1.0)
    phi, tangent = statistics.phi / mass[:, None], statistics.tangent / mass[:, None, None]
    origin, covariance = _fit_origins(mixture, phi, features, bounds, floors)
    azimuth, elevation, roll, angular = _fit_directions(mixture, tangent, features, bounds, floors, step)
    mean, spread = mixture.range_m, mixture.spread_range_m
    if features.axes.range:
        scale, first = features.scale[-1], phi[:, features.axes.linear]
        variance = np.maximum(phi[:, -1] - np.square(first), 0.0) * scale**2
        mean, spread = fit_gate(features.centre[-1] + scale * first, variance, bounds, floors.range_m)
    weights = np.maximum(statistics.mass, SMALLEST_WEIGHT)
    result = Mixture(weights / weights.sum(), origin, covariance, azimuth, elevation, roll, angular, mean, spread)
    if alive.all():
        return result
    rows = {"weights": result.weights}
    for name in [name for name in result.__dataclass_fields__ if name != "weights"]:
        new = getattr(result, name)
        rows[name] = np.where(alive.reshape(-1, *[1] * (new.ndim - 1)), new, getattr(mixture, name))
    return Mixture(**rows)


def _fit_origins(
    mixture: Mixture, phi: np.ndarray, features: Features, bounds: Bounds, floors: Floors
) -> tuple[np.ndarray, np.ndarray]:
    """Mean origins in their boxes and covariances with bounded eigenvalues, (K, 3) and (K, 3, 3)."""
    axes = list(features.axes.origin)
    count = len(axes)
    origin, covariance = mixture.origin_m.copy(), np.zeros_like(mixture.origin_covariance_m2)
    if not count:
        return origin, covariance
    scale, first = features.scale[:count], phi[:, 1 : 1 + count]
    mean = features.centre[:count] + scale * first
    start = 1 + features.axes.linear
    scatter = np.empty((len(mixture), count, count))
    for column, (i, j) in enumerate(features.pairs[: count * (count + 1) // 2]):
        value = (phi[:, start + column] - first[:, i] * first[:, j]) * scale[i] * scale[j]
        scatter[:, i, j] = scatter[:, j, i] = value
    # a floor above the largest admitted spread yields to it
    most = np.square(bounds.origin_spread)
    limits = OriginLimits(
        low=bounds.origin_low[:, axes],
        high=bounds.origin_high[:, axes],
        free_low=bounds.free_low[:, :, axes],
        free_high=bounds.free_high[:, :, axes],
        interval=bounds.interval,
        least=np.minimum(floors.origin_m**2, most),
        most=most,
        # fewer free axes leave the origin no thickness at all
        thinnest=np.square(bounds.origin_thickness) if count == 3 else np.full(len(mixture), np.inf),
    )
    old = mixture.origin_m[:, axes], mixture.origin_covariance_m2[:, axes][:, :, axes]
    block = np.ix_(range(len(mixture)), axes, axes)
    origin[:, axes], covariance[block] = best_origins(mean, scatter, limits, *old)
    return origin, covariance


def fit_gate(mean: np.ndarray, variance: np.ndarray, bounds: Bounds, floor: float) -> tuple[np.ndarray, np.ndarray]:
    r"""Mean and spread of a normal distribution whose interval m -+ z s keeps bounds, at its best.

    For a spread s the best mean is the sample mean clipped to [max(start_low + z s, end_low - z s),
    min(start_high + z s, end_high - z s)]; with a clipped mean a + b s the likelihood is stationary where
    s^2 + e b s - (v + e^2) = 0, e = sample mean - a. So the maximum is among these roots, the ends of the
    admissible spreads and the kinks between the pieces: all are tried.

    Arguments:
        mean, variance: Of the samples, shape (K,) [m, m^2].
        bounds: Bounds on start, end and width.
        floor: Smallest spread where the bounds do not force a smaller one [m].

    Returns:
        Mean and spread, shape (K,) each [m].
    """
    z = bounds.interval
    low = np.maximum(bounds.width_low, bounds.end_low - bounds.start_high) / (2 * z)
    high = np.minimum(bounds.width_high, bounds.end_high - bounds.start_low) / (2 * z)
    low = np.minimum(np.maximum(low, floor), high)
    candidates = [np.sqrt(variance), low, np.where(np.isfinite(high), high, low)]
    for edge, slope in (
        (bounds.start_low, z),
        (bounds.end_low, -z),
        (bounds.start_high, z),
        (bounds.end_high, -z),
    ):
        bound = np.isfinite(edge)
        away = np.where(bound, mean - np.where(bound, edge, 0.0), 0.0)
        root = (-away * slope + np.sqrt(np.square(away * slope) + 4 * (variance + np.square(away)))) / 2
        candidates += [np.where(bound, root, low), np.where(bound, np.abs(away) / z, low)]
    for end, start in ((bounds.end_low, bounds.start_low), (bounds.end_high, bounds.start_high)):
        both = np.isfinite(end) & np.isfinite(start)
        candidates.append((np.where(both, end, 0.0) - np.where(both, start, 0.0)) / (2 * z))
    spreads = np.clip(np.stack(candidates), low, high)
    lower = np.maximum(bounds.start_low + z * spreads, bounds.end_low - z * spreads)
    upper = np.minimum(bounds.start_high + z * spreads, bounds.end_high - z * spreads)
    means = np.minimum(np.maximum(mean, lower), np.maximum(upper, lower))
    quality = -np.log(spreads) - (variance + np.square(mean - means)) / (2 * np.square(spreads))
    best = quality.argmax(axis=0), np.arange(len(mean))
    return means[best], spreads[best]


def _fit_directions(
    mixture: Mixture,
    tangent: np.ndarray,
    features: Features,
    bounds: Bounds,
    floors: Floors,
    step: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Boresight azimuth, elevation and roll (K,), and spreads (K, 2)."""
    axes = features.axes
    if not axes.angular:
        return mixture.azimuth_rad, mixture.elevation_rad, mixture.roll_rad, mixture.spread_rad
    mean = tangent[:, :, 0]
    azimuth, elevation = _move_boresights(mixture, step * mean, bounds, (axes.horizontal, axes.vertical))
    old, new = mixture.frames, boresight_frame(azimuth, elevation)
    # tangent coordinates of the new boresights in the old frames
    local = np.einsum("kij,kj->ki", old, new[:, 0])
    taken = sphere_log(local)
    # parallel transport along the geodesic is the rotation that takes one boresight to the other (Rodrigues:
    # R x = x - (f + f')(f' . x) / (1 + f . f') + ... on vectors orthogonal to f); `turn` expresses transported axes
    # in those of the new frame
    total = old[:, 0] + new[:, 0]
    along = np.einsum("kij,kj->ki", old[:, 1:], new[:, 0]) / (1 + local[:, :1])
    transported = old[:, 1:] - along[:, :, None] * total[:, None]
    turn = np.einsum("kij,kmj->kim", new[:, 1:], transported)
    crossed = mean[:, :, None] * taken[:, None]
    moment = tangent[:, :, 1:] - crossed - np.swapaxes(crossed, 1, 2) + taken[:, :, None] * taken[:, None]
    moment = turn @ moment @ np.swapaxes(turn, 1, 2)
    previous = np.arctan2(-turn[:, 0, 1], turn[:, 0, 0]) if axes.angular == 2 else np.zeros(len(mixture))
    roll, spread = fit_field(moment, previous, bounds, floors.angle_rad, axes.angular == 2)
    return azimuth, elevation, roll, spread


def _move_boresights(
    mixture: Mixture, wanted: np.ndarray, bounds: Bounds, used: tuple[bool, bool]
) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation after a tangent step (K, 2) in rolled axes, projected into the boresight boxes.

    The projection is in the metric of the component's spreads, so the step along a face of the box is the best.
    """
    sin_r, cos_r = np.sin(mixture.roll_rad), np.cos(mixture.roll_rad)
    rotation = np.stack([np.stack([cos_r, -sin_r], -1), np.stack([sin_r, cos_r], -1)], 1)
    east_north = np.einsum("kij,kj->ki", rotation, wanted)
    cosine = np.cos(mixture.elevation_rad)
    offset = wrap_angle(mixture.azimuth_rad - bounds.azimuth_centre)
    usable = (bounds.azimuth_half < math.pi) & (cosine > POLE_COSINE)
    low_tilt, high_tilt = (bound - mixture.elevation_rad for bound in (bounds.elevation_low, bounds.elevation_high))
    low = np.where(usable, (-bounds.azimuth_half - offset) * cosine, -np.inf)
    high = np.where(usable, (bounds.azimuth_half - offset) * cosine, np.inf)
    low = np.stack([low, np.where(bounds.elevation_low <= -math.pi / 2, -np.inf, low_tilt)], 1)
    high = np.stack([high, np.where(bounds.elevation_high >= math.pi / 2, np.inf, high_tilt)], 1)
    precision = rotation @ (np.square(1 / mixture.spread_rad)[:, :, None] * np.swapaxes(rotation, 1, 2))
    step = box_quadratic_minimum(precision, east_north, np.minimum(low, high), high) * np.array(used, dtype=np.float64)
    level = boresight_frame(mixture.azimuth_rad, mixture.elevation_rad)
    forward = np.einsum("kj,kji->ki", sphere_exp(step), level)
    azimuth = np.arctan2(forward[:, 1], forward[:, 0]) if used[0] else mixture.azimuth_rad
    elevation = np.arctan2(forward[:, 2], np.hypot(forward[:, 0], forward[:, 1])) if used[1] else mixture.elevation_rad
    still = (step == 0).all(axis=1)
    azimuth = clip_azimuth(np.where(still, mixture.azimuth_rad, azimuth), bounds)
    elevation = np.where(still, mixture.elevation_rad, elevation)
    return azimuth, np.clip(elevation, bounds.elevation_low, bounds.elevation_high)


def fit_field(
    moment: np.ndarray, previous: np.ndarray, bounds: Bounds, floor: float, rolls: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Roll and spreads inside their bounds at the largest likelihood.

    The optimum has the axes of the moment's eigenvectors or, where that would swap horizontal and vertical, or break a
    bound, a roll at the limit; the previous roll is tried too, so that the step never loses.

    Arguments:
        moment: Second moments of the tangent coordinates about the boresight, roll 0 axes, (K, 2, 2) [rad^2].
        previous: The roll before, shape (K,) [rad].
        bounds: Bounds on roll and spreads.
        floor: Smallest spread where the bounds do not force a smaller one [rad].
        rolls: Whether there is a roll to choose.
    """
    eigen = 0.5 * np.arctan2(2 * moment[:, 0, 1], moment[:, 0, 0] - moment[:, 1, 1])
    # the axis called horizontal is the eigenvector nearer to it
    eigen = np.where(np.abs(eigen) > LARGEST_ROLL_RAD, eigen - np.copysign(math.pi / 2, eigen), eigen)
    zero = np.zeros(len(moment))
    turned = wrap_angle(2 * np.asarray(previous)) / 2
    turned = np.where(np.abs(turned) > LARGEST_ROLL_RAD, zero, turned)
    rolls_tried = np.stack([eigen, zero, bounds.roll_high, bounds.roll_low, turned]) if rolls else zero[None]
    rolls_tried = np.clip(rolls_tried, bounds.roll_low, bounds.roll_high) if rolls else rolls_tried
    low = np.minimum(np.maximum(bounds.spread_low, floor), bounds.spread_high)
    cos, sin = np.cos(rolls_tried), np.sin(rolls_tried)
    xx, xy, yy = moment[:, 0, 0], moment[:, 0, 1], moment[:, 1, 1]
    variance = np.stack(
        [cos**2 * xx + 2 * cos * sin * xy + sin**2 * yy, sin**2 * xx - 2 * cos * sin * xy + cos**2 * yy], -1
    )
    spread = np.clip(np.sqrt(np.maximum(variance, 0.0)), low, bounds.spread_high)
    quality = (-np.log(spread) - variance / (2 * np.square(spread))).sum(axis=-1)
    best = quality.argmax(axis=0), np.arange(len(moment))
    return rolls_tried[best], spread[best]
