"""Echoes with given expected counts, and detectors to count them with: light without a scene's geometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidardesign.scenes.scene import Body, Scene, Sphere
from lidardesign.simulate.detection import ArrivingLight, count_photons, detect
from lidardesign.simulate.detector.light import Background, Echoes
from lidardesign.simulate.detector.physics import Detector, Photons, Physics
from support.rays import rays_along

WAVELENGTH_M = 905e-9
PULSES = 1000
SCENE = Scene((Body(Sphere(1.0)),), name="synthetic light")
PHOTON_EFFECTS = frozenset({"photon_noise", "jitter", "ambient", "pile_up", "quantisation"})


class Detected(NamedTuple):
    path_m: np.ndarray
    body: np.ndarray


def counting_detector(rays: int, *, pulses: int = PULSES, dead_s: float = 0.0, repetition_hz: float = 1e6, **timing):
    """A detector that expects of each of so many rays as many counts in a frame as its echo's gain."""
    photons = Photons(
        wavelength_m=WAVELENGTH_M,
        pulse_energy_j=1.0,
        pulses_per_frame=pulses * rays,
        emission="scanned",
        repetition_hz=repetition_hz,
        aperture_m2=1e-6,
        field_of_view_sr=1e-6,
        efficiency=1.0,
        filter_m=1e-8,
        dark_hz=0.0,
        dead_s=dead_s,
    )
    aperture_m2 = 1 / (pulses * float(photons.emitted(rays)))
    photons = Photons(**{**photons.__dict__, "aperture_m2": aperture_m2})
    return Detector("synthetic", photons=photons, **timing)


def single_echoes(path_m, counts) -> Echoes:
    """One echo per ray, of body 0."""
    path_m = np.asarray(path_m, float)
    gain = np.broadcast_to(counts, path_m.shape).astype(float)
    return Echoes(np.arange(len(path_m)), path_m, gain, np.zeros(len(path_m), int))


def no_echoes() -> Echoes:
    return Echoes(np.zeros(0, int), np.zeros(0), np.zeros(0), np.zeros(0, int))


def windows(rays: int, start_m: float, end_m: float) -> np.ndarray:
    return np.tile([start_m, end_m], (rays, 1)).astype(float)


def background(rays: int, per_metre: float = 0.0) -> Background:
    """Even light, in counts per pulse and metre."""
    return Background(np.full(rays, float(per_metre)))


def one_sensor(windows_m):
    return rays_along(np.tile([1.0, 0.0, 0.0], (len(windows_m), 1)), windows_m)


def counted(windows_m, echoes, light, detector, effects, seed: int = 0):
    """Counts per bin, shape (N, B), of rays whose windows have equally many bins, and the bins."""
    physics = Physics(detector, frozenset(effects), seed)
    whole = ArrivingLight.of(one_sensor(windows_m), windows_m, echoes, light, physics)
    counts = count_photons(SCENE, 0, whole, physics)
    return counts.reshape(len(windows_m), -1), whole.bins


def detected(windows_m, echoes, light, detector, effects, seed: int = 0):
    physics = Physics(detector, frozenset(effects), seed)
    return Detected(*detect(SCENE, 0, one_sensor(windows_m), windows_m, echoes, light, physics))
