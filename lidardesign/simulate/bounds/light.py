"""Expected counts of light that the emitter did not send, and of what the air sends back."""

from __future__ import annotations

import math

import numpy as np

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

    From r to r + dr it sends beta exp(-2 alpha r) / r^2 dr to 1 m^2 of aperture, most at the window's start a; over the
    whole window at most beta (1 / a - 1 / b), whatever fades besides.
    """
    photons, medium = sight.detector.photons, sight.scene.medium
    if medium is None:
        return np.zeros(len(sight)), np.zeros(len(sight))
    start, end = sight.window_m[:, 0], sight.window_m[:, 0] + sight.before_m
    light = emitted * photons.aperture_m2 * photons.efficiency * medium.backscatter_per_m_sr
    light = light * np.exp(-2 * medium.extinction_per_m * start)
    # a window that starts at the sensor hears the air in front of it at once
    nearest = np.maximum(start, math.sqrt(photons.aperture_m2))
    whole = light * (1 / nearest - 1 / np.maximum(end, nearest))
    return whole, np.minimum(light * bin_m / nearest**2, whole)
