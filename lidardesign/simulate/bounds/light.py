"""Expected counts of light that the emitter did not send, and of what the air sends back."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.numerics import COARSE_SLACK, TINY, safe_divide
from lidardesign.scene import SPEED_OF_LIGHT_M_S
from lidardesign.simulate.bistatic import range_of_path
from lidardesign.simulate.bounds.sight import Sight
from lidardesign.simulate.daylight import spectral_irradiance

# Rays pass a receiver no nearer than this share of their way: differences of arctangents are then exact to 1e-9.
NEAREST_SHARE = COARSE_SLACK


def ambient_per_metre(sight: Sight) -> np.ndarray:
    """Ambient and dark counts per pulse and metre of range, shape (N,).

    What a ray meets has the radiance reflectance E / pi, seen through the aperture and the pixel's field of view, and
    what meets nothing sees no light; a metre of range takes 2 / c.
    """
    photons, ambient = sight.detector.photons, sight.scene.ambient
    rate_hz = np.full(len(sight), photons.dark_hz)
    if ambient is not None:
        irradiance = spectral_irradiance(ambient, photons.wavelength_m, photons.filter_m)
        power_w = irradiance / math.pi * photons.filter_m * photons.aperture_m2 * photons.field_of_view_sr
        reflectance = np.array([*(body.reflectance for body in sight.scene.bodies), 0.0])[sight.hits.body]
        rate_hz += reflectance * power_w * photons.efficiency / photons.photon_energy_j
    return rate_hz * 2 / SPEED_OF_LIGHT_M_S


def haze_per_pulse(sight: Sight, emitted: np.ndarray, bin_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Counts per pulse that the air sends back, at most: in the window up to the return, and in one bin, shapes (N,).

    From r to r + dr it sends beta Omega(r) exp(-2 alpha r) dr into an aperture, a disc of radius a seen under the solid
    angle Omega = 2 pi (1 - r / sqrt(r^2 + a^2)), with the integral 2 pi (r - sqrt(r^2 + a^2)); what fades within the
    window is not taken off. Before the range 1 / (1 / f + sqrt(pixel / A)), f that of what the ray meets, haze is
    blurred beyond the pixel, which catches pixel / (1 - r / f)^2 instead. Of a fixed receiver see `_beside`.
    """
    photons, medium = sight.detector.photons, sight.scene.medium
    if medium is None:
        return np.zeros(len(sight)), np.zeros(len(sight))
    start, end = sight.window_m[:, 0], sight.window_m[:, 0] + sight.before_m
    light = emitted * photons.efficiency * medium.backscatter_per_m_sr
    light = light * np.exp(-2 * medium.extinction_per_m * start)
    if sight.scene.receiver is not None:
        whole, fullest = _beside(sight, end, bin_m)
        return light * whole, light * fullest
    focus = 1 / np.maximum(sight.hits.range_m, TINY)
    sharp = 1 / (focus + math.sqrt(photons.field_of_view_sr / photons.aperture_m2))
    sharp = np.clip(sharp, start, end)
    before = safe_divide(sharp - start, (1 - start * focus) * (1 - sharp * focus))
    squared = photons.aperture_m2 / math.pi
    near, far = np.sqrt(sharp**2 + squared), np.sqrt(end**2 + squared)
    # differences of roots without their cancellation
    behind = 2 * math.pi * (end - sharp) * (1 - (end + sharp) / (far + near))
    whole = light * (photons.field_of_view_sr * before + behind)
    return whole, np.minimum(2 * math.pi * light * bin_m * squared / (near * (near + sharp)), whole)


def _beside(sight: Sight, end_m: np.ndarray, bin_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Solid angle times length of the haze that a fixed receiver hears, up to half paths (N,), and in one bin, (N,).

    It sees all of a ray that passes it at the distance h, c from the ray's start: at most the integral of
    A / (h^2 + (r - c)^2), A / h times the difference of arctan((r - c) / h), and no more than half of all around. Half
    a path grows by (1 + (r - c) / b) / 2 per range, b the way from there to the receiver: least where the ray starts.
    """
    rays, receiver = sight.rays, sight.scene.receiver
    aperture_m2 = sight.detector.photons.aperture_m2
    ends = [range_of_path(rays, receiver, path_m) for path_m in (sight.window_m[:, 0], end_m)]
    low, high = (np.nan_to_num(range_m, nan=0.0) for range_m in ends)
    offset = np.asarray(receiver.origin_m) - rays.origin_m
    along = np.einsum("nk,nk->n", offset, rays.direction)
    aside = np.linalg.norm(offset - along[:, None] * rays.direction, axis=1)
    # a ray through the receiver itself: so close that the limit of all around decides
    aside = np.maximum(aside, NEAREST_SHARE * (1 + np.abs(along)))
    seen = aperture_m2 / aside * (np.arctan((high - along) / aside) - np.arctan((low - along) / aside))
    length = np.maximum(high - low, 0.0)
    whole = np.clip(seen, 0.0, 2 * math.pi * length)
    nearest = np.hypot(aside, np.clip(along, low, np.maximum(low, high)) - along)
    slowest = (1 + (low - along) / np.hypot(aside, low - along)) / 2
    in_bin = np.minimum(safe_divide(bin_m, slowest, np.inf), length)
    return whole, np.minimum(np.minimum(aperture_m2 / nearest**2, 2 * math.pi) * in_bin, whole)
