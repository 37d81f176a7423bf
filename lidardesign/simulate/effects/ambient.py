"""Ambient light and dark counts.

A surface under the spectral irradiance E of the ambient light has the radiance reflectance * E / pi, in all directions.
A pixel sees it through the aperture A, the filter's width W and its solid angle Omega:

    rate = E reflectance / pi * W * A * Omega * efficiency / (photon energy) + dark counts      [1/s]

A metre of range lasts 2 / c. Rays without a hit receive no ambient light: a scene has no background.

Bound of its effect (`bound`), by false peaks, hidden echoes, and returns where there is none: with mean counts b per
bin, B bins and s counts in the echo's bin, another bin wins with at most (B - 1) exp(-(sqrt(s + b) - sqrt(b))^2): the
union over bins of Chernoff's bound. A detection threshold with the probability `false_alarm` hides echoes below it, and
rays without a return have false alarms with this probability. Counts under the echo add to its range error: in strong
background, b per metre, n photons of a Gaussian have the additional variance (sigma^2 / n) (4 sqrt(pi) sigma b / n)
(Cramer and Rao's bound); the error of the highest bin grows by the factor (1 + b / s)^(1/4). The level of background
also shifts the matched filter between bins, by at most half a step (`FirstHits.step_m`).

A false peak needs a count: its probability is at most 1 - exp(-B b). With dead time, light before an echo reduces its
counts (see `Blindness`), and the background is uneven, so that more of it is taken for returns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scenes.rays import Hits, Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.light import Background, Beams, reflectances
from lidardesign.simulate.detector.physics import Detector
from lidardesign.simulate.effects.expected_counts import (
    Blindness,
    Counts,
    ambient_per_metre,
    count_text,
    missed_behind,
    unevenness,
    variance_of_missing,
)
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits

# Upper limit of the background rate: above it any detector counts in every pulse at once [1/m]
MOST_PER_METRE = 1e12


def add_ambient(
    scene: Scene, rays: Rays, beams: Beams, hits: Hits, detector: Detector, background: Background
) -> Background:
    """The background with ambient light and dark counts added.

    Arguments:
        scene: Its light and its bodies' reflectances.
        rays: N rays.
        beams: The thin beams of the rays.
        hits: First hits of the beams.
        detector: The detector; one that does not count photons has no background.
        background: The background so far.
    """
    photons = detector.photons
    if photons is None:
        return background
    reflectance = beams.share * reflectances(scene, hits)
    average = np.bincount(beams.ray, weights=reflectance, minlength=len(rays))
    per_metre = background.per_metre + ambient_per_metre(scene, photons, average)
    return replace(background, per_metre=np.minimum(per_metre, MOST_PER_METRE))


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why there are neither ambient nor dark counts, or None."""
    if detector.photons is None:
        return "the detector does not count photons"
    dark = scene.ambient is None or scene.ambient.illuminance_lux == 0
    return "it is dark and the detector is quiet" if dark and detector.photons.dark_hz == 0 else None


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of ambient light and dark counts."""
    sigma_m = first_hits.sigma_m()
    blind, in_the_dark = Blindness.of(counts), Blindness.of(counts, ambient=False)
    signal, per_bin = blind.left, counts.per_bin
    any_count = -np.expm1(-per_bin * counts.bins)
    hidden = np.maximum(missed_behind(counts, blind, sigma_m) - counts.missed(in_the_dark.left, 0.0, sigma_m), 0.0)
    wrong = np.minimum(counts.mistaken(signal, per_bin, per_bin * blind.under, sigma_m), any_count)
    # light that is no echo makes a return where one count is enough, and none where background asks for more
    stray = counts.leaked(sigma_m) + counts.pulses * counts.haze_per_pulse[0]
    unmade = np.where(counts.needed(per_bin) > 1, -np.expm1(-stray), 0.0)
    alarms = np.minimum(first_hits.detector.false_alarm + unevenness(counts, blind), any_count)
    lost = np.minimum(np.where(first_hits.returned, wrong + hidden, alarms + unmade), 1.0)
    squared = np.minimum(_strayed(counts, signal, sigma_m), first_hits.width_m) ** 2
    squared += variance_of_missing(counts, in_the_dark.left, signal, sigma_m) + any_count * counts.level_m2
    return EffectBound(squared, lost, _reason(first_hits, per_bin * counts.bins))


def _strayed(counts: Counts, signal: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    """Range error caused by background counts under the echo, shape (N,) [m]."""
    error, per_bin = counts.error_m(signal, sigma_m), counts.per_bin
    if counts.first_hits.detector.estimator == "matched":
        per_metre = per_bin / counts.bin_m
        return error * np.sqrt(4 * math.sqrt(math.pi) * sigma_m * safe_divide(per_metre, np.maximum(signal, 1.0)))
    echo = np.maximum(signal, 1.0) * counts.share_in_bins(1, sigma_m)
    return error * np.sqrt(np.sqrt(1 + safe_divide(per_bin, echo)) - 1)


def _reason(first_hits: FirstHits, in_gate: np.ndarray) -> str:
    gate = float(np.median(in_gate[first_hits.returned] if first_hits.returned.any() else in_gate))
    ambient = first_hits.scene.ambient
    light = "dark counts" if ambient is None else f"{ambient.illuminance_lux:,.0f} lux ({ambient.source}), dark counts"
    return f"{light}: about {count_text(gate)} in a gate"
