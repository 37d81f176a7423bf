"""Light of the surroundings and dark counts.

A surface under the spectral irradiance E of the ambient light has the radiance reflectance * E / pi, in all
directions. A pixel sees it through the aperture A, the filter's width W and its solid angle Omega:

    rate = E reflectance / pi * W * A * Omega * efficiency / (photon energy) + dark counts      [1/s]

A metre of range lasts 2 / c. Rays that meet nothing see no light: a scene without a background has none.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lidardesign.scene import SPEED_OF_LIGHT_M_S, Scene
from lidardesign.simulate.daylight import spectral_irradiance
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.echoes import Background, Beams
from lidardesign.simulate.hits import Hits
from lidardesign.simulate.returns import Rays

# Brighter light is no brighter: every pulse of any detector counts it at once
MOST_PER_METRE = 1e12


def lit(
    scene: Scene, rays: Rays, beams: Beams, hits: Hits, detector: Detector, background: Background
) -> Background:
    """The background with ambient light and dark counts.

    Arguments:
        scene: Its light and its bodies' reflectances.
        rays: N rays.
        beams: The thin beams that they consist of.
        hits: What those meet first.
        detector: One that does not count photons sees no background.
        background: What is counted besides.
    """
    photons = detector.photons
    if photons is None:
        return background
    rate_hz = np.full(len(rays), photons.dark_hz)
    if scene.ambient is not None:
        seen = hits.body >= 0
        reflectance = np.zeros(len(beams))
        reflectance[seen] = np.array([body.reflectance for body in scene.bodies])[hits.body[seen]]
        average = np.bincount(beams.ray, weights=beams.share * reflectance, minlength=len(rays))
        irradiance = spectral_irradiance(scene.ambient, photons.wavelength_m, photons.filter_m)
        power_w = irradiance / math.pi * photons.filter_m * photons.aperture_m2 * photons.field_of_view_sr
        rate_hz += average * power_w * photons.efficiency / photons.photon_energy_j
    per_metre = background.per_metre + rate_hz * 2 / SPEED_OF_LIGHT_M_S
    return replace(background, per_metre=np.minimum(per_metre, MOST_PER_METRE))
