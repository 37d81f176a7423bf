"""Beams that leave an emitter, echoes that return to the receiver, and background light.

Beams and echoes are flat lists with the index of each entry's ray, so that a ray may have many.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidardesign.scenes.rays import FlatLists, Hits, Rays
from lidardesign.scenes.scene import Ambient, Scene

# First hits of rays (N, 3), (N, 3) that are sent at times (N,) [s] within the frame.
Tracer = Callable[[np.ndarray, np.ndarray, np.ndarray], Hits]


@dataclass(frozen=True, eq=False)
class Beams(FlatLists):
    """Thin beams of light, B of them.

    Arguments:
        ray: Index of each beam's ray, ascending, shape (B,).
        origin_m: Origins [m], shape (B, 3).
        direction: Unit vectors, shape (B, 3).
        time_s: Firing times within the frame [s], shape (B,).
        share: Shares of the ray's light, which add up to 1 for each ray, shape (B,).
    """

    ray: np.ndarray
    origin_m: np.ndarray
    direction: np.ndarray
    time_s: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, rays: Rays) -> Beams:
        """One thin beam per ray."""
        count = len(rays)
        return cls(np.arange(count), rays.origin_m, rays.direction, rays.time_s, np.ones(count))


@dataclass(frozen=True, eq=False)
class Echoes(FlatLists):
    """Light that comes back, E echoes.

    Arguments:
        ray: Index of each echo's ray, shape (E,).
        path_m: Half of the path from emitter to receiver, the range where both are at one place [m], shape (E,).
        gain: Share of the ray's light that reaches 1 m^2 of aperture: share * reflectance * cosine / (pi * distance^2)
            times further attenuation, shape (E,) [1/m^2].
        body: Index of the body that reflected it, shape (E,).
    """

    ray: np.ndarray
    path_m: np.ndarray
    gain: np.ndarray
    body: np.ndarray


@dataclass(frozen=True, eq=False)
class Background:
    """Background counts per pulse of N rays: ambient light, dark counts and haze.

    Arguments:
        per_metre: Ambient light and dark counts per metre of range, uniform over the gate, shape (N,).
        edges_m: Edges of cells of haze in half path, shape (N, C + 1) [m]; None: clear air.
        counts: Counts per pulse in each of those cells, shape (N, C); None: clear air.
    """

    per_metre: np.ndarray
    edges_m: np.ndarray | None = None
    counts: np.ndarray | None = None


def reflectances(scene: Scene, hits: Hits) -> np.ndarray:
    """Reflectance at each hit, 0 where there is none, shape (N,)."""
    return np.array([*(body.reflectance for body in scene.bodies), 0.0])[hits.body]


def direct_echoes(scene: Scene, beams: Beams, hits: Hits) -> Echoes:
    """Echoes of first hits at the receiver, visible or not: share * reflectance * cosine / (pi * distance^2)."""
    seen = np.flatnonzero(hits.body >= 0)
    points = beams.origin_m[seen] + hits.range_m[seen, None] * beams.direction[seen]
    origins = beams.origin_m[seen]
    home = origins if scene.receiver is None else np.broadcast_to(np.asarray(scene.receiver.origin_m), origins.shape)
    back = home - points
    # a beam that starts at the receiver returns along the same path, to the last bit
    back_m = np.where((origins == home).all(axis=1), hits.range_m[seen], np.linalg.norm(back, axis=1))
    reflectance = reflectances(scene, hits)[seen]
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.maximum(np.einsum("nk,nk->n", hits.normal[seen], back) / back_m, 0.0)
        gain = beams.share[seen] * reflectance * cosine / (np.pi * back_m**2)
    # a surface that touches the receiver blinds it, unless it is black: finite, and stronger than anything else
    gain = np.nan_to_num(gain, nan=np.finfo(float).max, posinf=np.finfo(float).max) * (reflectance > 0)
    return Echoes(beams.ray[seen], (hits.range_m[seen] + back_m) / 2, gain, hits.body[seen])


# The sun is the global spectrum of ASTM G173-03, which gives 109,495 lux (683 lm/W and the photopic curve of CIE 1924).
# Rooms have white LEDs: CIE's illuminant LED-B3 (CIE 15:2018, 4103 K). Both are means of 10 nm; finer lines, as of
# oxygen at 760 nm, are not resolved.
STEP_NM = 10.0
FIRST_NM = 380.0
# W / (m^2 nm) at 100,000 lux
SUN_AT_100_KLUX = np.array(
    [
        0.605,
        0.615,
        0.909,
        1.06,
        1.12,
        1.03,
        1.23,
        1.37,
        1.43,
        1.42,
        1.46,
        1.38,
        1.41,
        1.42,
        1.36,
        1.4,
        1.4,
        1.41,
        1.38,
        1.36,
        1.37,
        1.32,
        1.34,
        1.34,
        1.32,
        1.29,
        1.32,
        1.28,
        1.24,
        1.29,
        1.27,
        1.1,
        1.18,
        1.19,
        1.0,
        1.02,
        1.11,
        1.13,
        0.718,
        0.988,
        1.07,
        1.02,
        0.989,
        0.945,
        0.8,
        0.85,
        0.914,
        0.877,
        0.898,
        0.859,
        0.856,
        0.825,
        0.644,
        0.617,
        0.642,
        0.424,
        0.278,
        0.307,
        0.378,
        0.558,
        0.595,
        0.678,
        0.671,
        0.656,
        0.639,
        0.628,
        0.614,
        0.597,
        0.578,
        0.559,
        0.545,
        0.514,
        0.456,
        0.354,
        0.133,
        0.118,
        0.192,
        0.173,
        0.315,
        0.384,
        0.393,
        0.403,
        0.39,
        0.401,
        0.415,
        0.422,
        0.422,
        0.415,
        0.382,
        0.348,
        0.378,
        0.378,
        0.339,
        0.304,
        0.265,
        0.194,
        0.145,
        0.0198,
        1.22e-05,
        3.71e-05,
        0.000164,
        0.000168,
        0.000647,
        0.00306,
        0.0152,
        0.0287,
        0.035,
        0.0599,
        0.0992,
        0.0634,
        0.0911,
        0.141,
        0.19,
        0.222,
        0.24,
        0.246,
        0.248,
        0.247,
        0.244,
        0.227,
        0.221,
        0.228,
        0.217,
        0.212,
        0.217,
        0.217,
        0.203,
        0.201,
        0.202,
        0.193,
        0.189,
        0.189,
        0.184,
        0.174,
    ]
)
# W / (m^2 nm) at 1 lux; its first and last values lie below and above what CIE lists
LED_AT_1_LUX = np.array(
    [
        5e-9,
        1e-8,
        5.75e-8,
        2.93e-7,
        1.33e-6,
        4.51e-6,
        1.23e-5,
        1.75e-5,
        1.05e-5,
        6.17e-6,
        5.32e-6,
        6.81e-6,
        8.9e-6,
        1.05e-5,
        1.15e-5,
        1.24e-5,
        1.33e-5,
        1.42e-5,
        1.51e-5,
        1.57e-5,
        1.62e-5,
        1.65e-5,
        1.65e-5,
        1.6e-5,
        1.49e-5,
        1.35e-5,
        1.17e-5,
        9.85e-6,
        8.05e-6,
        6.43e-6,
        5.04e-6,
        3.89e-6,
        2.96e-6,
        2.23e-6,
        1.66e-6,
        1.24e-6,
        9.15e-7,
        6.8e-7,
        5.03e-7,
        3.73e-7,
        2.8e-7,
    ]
)
# LED-B3 falls by this factor every 10 nm where CIE's list ends at 780 nm; it is taken to go on so
LED_FALL = 0.75
# points at which a filter's band is averaged
BAND_POINTS = 33


def spectral_irradiance(ambient: Ambient, wavelength_m: float, filter_m: float) -> float:
    """Mean spectral irradiance of ambient light in a filter's band [W / (m^2 m)].

    Arguments:
        ambient: Its illuminance and source.
        wavelength_m: Centre of the filter [m].
        filter_m: Its width [m].
    """
    band_nm = 1e9 * (wavelength_m + filter_m * ((np.arange(BAND_POINTS) + 0.5) / BAND_POINTS - 0.5))
    if ambient.source == "sun":
        per_nm = _table(SUN_AT_100_KLUX, band_nm) * ambient.illuminance_lux / 1e5
    else:
        last_nm = FIRST_NM + STEP_NM * (len(LED_AT_1_LUX) - 1)
        fall = LED_FALL ** (np.maximum(band_nm - last_nm, 0.0) / STEP_NM)
        per_nm = _table(LED_AT_1_LUX, band_nm) * fall * ambient.illuminance_lux
    return float(per_nm.mean()) * 1e9


def _table(values: np.ndarray, wavelength_nm: np.ndarray) -> np.ndarray:
    """Linear interpolation between the middles of a table's cells, constant beyond its ends."""
    return np.interp(wavelength_nm, FIRST_NM + STEP_NM * np.arange(len(values)), values)
