"""Expected counts of light that the emitter did not send, and of what the air sends back."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.simulate.bounds.sight import Sight
from lidardesign.simulate.daylight import spectral_irradiance
from lidardesign.simulate.detector import SPEED_OF_LIGHT_M_S


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
    blurred beyond the pixel, which catches pixel / (1 - r / f)^2 instead. A fixed receiver is taken to be as far away
    as the emitter, and to catch all.
    """
    photons, medium = sight.detector.photons, sight.scene.medium
    if medium is None:
        return np.zeros(len(sight)), np.zeros(len(sight))
    start, end = sight.window_m[:, 0], sight.window_m[:, 0] + sight.before_m
    light = emitted * photons.efficiency * medium.backscatter_per_m_sr
    light = light * np.exp(-2 * medium.extinction_per_m * start)
    focus = 1 / np.maximum(sight.hits.range_m, np.finfo(float).tiny)
    sharp = 1 / (focus + math.sqrt(photons.field_of_view_sr / photons.aperture_m2))
    sharp = np.clip(sharp, start, end) if sight.scene.receiver is None else start
    before = safe_divide(sharp - start, (1 - start * focus) * (1 - sharp * focus))
    squared = photons.aperture_m2 / math.pi
    near, far = np.sqrt(sharp**2 + squared), np.sqrt(end**2 + squared)
    # differences of roots without their cancellation
    behind = 2 * math.pi * (end - sharp) * (1 - (end + sharp) / (far + near))
    whole = light * (photons.field_of_view_sr * before + behind)
    return whole, np.minimum(2 * math.pi * light * bin_m * squared / (near * (near + sharp)), whole)
