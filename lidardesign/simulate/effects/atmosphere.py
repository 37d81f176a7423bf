"""Atmosphere: extinction of light and backscatter from haze.

Light fades as exp(-alpha * length) over its whole way, twice the half path (Beer, Lambert). Haze at a range r of a ray
sends back, per metre, beta times the solid angle of the aperture there times exp(-alpha (r + b)), with b the way from
there to the receiver: b = r at the emitter's own place (the lidar equation; Measures 1984, chapter 7).

There a pixel looks along the ray, focused at the range f of the ray's hit, or at infinity. Haze at r is blurred on it
to the solid angle A (1 / r - 1 / f)^2, as an aperture A seen from r is wider than from f; a pixel of a smaller solid
angle receives its share of that (the overlap of an ideal lens). So haze right before the sensor is limited by the
pixel's solid angle, instead of 1 / r^2. A fixed receiver elsewhere receives all haze in its view.

Bound of its effect (`bound`): over a range R the air leaves exp(-2 alpha R) of an echo's photons: range errors grow
and returns are lost, as from fewer photons. Haze sends h counts into a bin, most at the gate's start; it is taken
for the echo with at most (B - 1) exp(-(sqrt(s) - sqrt(h))^2) (see `Counts.mistaken`), and raises the detection
threshold. A ray without a return may take any count of it for one: 1 - exp(-all of its counts), as one count is enough
in the dark. With dead time, haze before an echo reduces its counts (see `Blindness`), and the detector times the first
photon of a pulse, which comes later where there are fewer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scenes.rays import Hits, Rays, in_view, path_of_range, range_of_path
from lidardesign.scenes.scene import Medium, Receiver, Scene
from lidardesign.simulate.detector.light import Background, Beams, Echoes
from lidardesign.simulate.detector.physics import Detector, Photons
from lidardesign.simulate.effects.expected_counts import Blindness, Counts, Echo, changed_share
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits

# Cells of haze along a ray, each longer than the one before by the same factor: counts are even within a cell, and
# over a gate from 1 cm to 10 m its profile falls by a third from each to the next.
CELLS = 32
# Points per cell at which the profile is integrated (Gauss and Legendre): it is smooth, so these are exact to 1e-6.
NODES = 4
# The first of K photons comes earlier by at most this many standard deviations per unit of ln K: (1 / sqrt(pi)) / ln 2,
# between one and two of them; more photons change it by less
LATER_PER_LOG = 0.82


def through_air(
    scene: Scene,
    rays: Rays,
    beams: Beams,
    hits: Hits,
    windows_m: np.ndarray,
    echoes: Echoes,
    detector: Detector,
    background: Background,
) -> tuple[Echoes, Background]:
    """Echoes attenuated by the air, and the background with the backscatter of haze up to each beam's first hit.

    Arguments:
        scene: Its medium; without one, nothing changes.
        rays: All rays of a list, N of them; those of a sensor share its emitter's energy.
        beams: The thin beams of the rays.
        hits: First hits of the beams.
        windows_m: The rays' gates as half paths, shape (N, 2) [m].
        echoes: Echoes of surfaces.
        detector: Backscatter is counted only by a detector that counts photons.
        background: The background so far.
    """
    medium, photons = scene.medium, detector.photons
    if medium is None:
        return echoes, background
    faded = replace(echoes, gain=echoes.gain * np.exp(-2 * medium.extinction_per_m * echoes.path_m))
    if photons is None or medium.backscatter_per_m_sr == 0:
        return faded, background
    stops_m = _stops(rays, beams, hits, scene.receiver)
    ends = np.full(len(rays), -np.inf)
    np.maximum.at(ends, beams.ray, stops_m)
    edges_m = _cells(windows_m[:, 0], np.clip(ends, windows_m[:, 0], windows_m[:, 1]), photons.aperture_m2)
    gain = _haze_gain(rays, scene.receiver, medium, photons, ends, edges_m) * _lit_shares(beams, stops_m, edges_m)
    emitted = photons.emitted(detector.sharing(rays)) * detector.light_of(rays)
    counts = emitted[:, None] * photons.efficiency * gain
    return faded, replace(background, edges_m=edges_m, counts=counts)


def _stops(rays: Rays, beams: Beams, hits: Hits, receiver: Receiver | None) -> np.ndarray:
    """Half paths at which beams end, infinite without a hit, shape (B,) [m]."""
    if receiver is None:
        return hits.range_m
    hit = np.isfinite(hits.range_m)
    stops_m = np.full(len(beams), np.inf)
    stops_m[hit] = path_of_range(rays.subset(beams.ray[hit]), receiver, hits.range_m[hit])
    return stops_m


def _lit_shares(beams: Beams, stops_m: np.ndarray, edges_m: np.ndarray) -> np.ndarray:
    """Share of each ray's light in its cells, averaged over the length of cells that beams end in, shape (N, C)."""
    rays, cells = edges_m.shape[0], edges_m.shape[1] - 1
    passed = np.zeros((rays, cells))
    for cell in range(cells):
        low, high = edges_m[beams.ray, cell], edges_m[beams.ray, cell + 1]
        part = np.clip(safe_divide(np.minimum(stops_m, high) - low, high - low), 0.0, 1.0)
        passed[:, cell] = np.bincount(beams.ray, weights=beams.share * part, minlength=rays)
    return passed


def _cells(starts: np.ndarray, ends: np.ndarray, aperture_m2: float) -> np.ndarray:
    """Edges of cells between half paths (N,) and (N,), evenly spaced in their logarithm, shape (N, CELLS + 1) [m].

    Within the aperture's own radius the profile is flat: paths are counted from that far behind.
    """
    radius_m = math.sqrt(aperture_m2 / math.pi)
    low, high = np.log(starts + radius_m), np.log(ends + radius_m)
    edges = np.exp(low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, CELLS + 1)) - radius_m
    edges[:, 0], edges[:, -1] = starts, ends
    return np.maximum.accumulate(np.clip(edges, starts[:, None], ends[:, None]), axis=1)


def _haze_gain(
    rays: Rays, receiver: Receiver | None, medium: Medium, photons: Photons, focus_m: np.ndarray, edges_m: np.ndarray
) -> np.ndarray:
    """Share of each ray's light that haze in cells of half paths (N, C + 1) scatters into its pixel, (N, C).

    Arguments:
        rays, receiver, medium, photons: Rays, receiver, medium, and the detector's aperture and pixel.
        focus_m: Focus distance of each ray's pixel, shape (N,) [m].
        edges_m: Edges of the cells [m].
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    ranges = np.stack([range_of_path(rays, receiver, column) for column in edges_m.T], axis=1)
    # paths shorter than the way from emitter to receiver come from no range
    ranges = np.nan_to_num(ranges, nan=0.0)
    middle, half = (ranges[:, 1:] + ranges[:, :-1]) / 2, (ranges[:, 1:] - ranges[:, :-1]) / 2
    gain = np.zeros_like(middle)
    for node, weight in zip(nodes, weights, strict=True):
        # Share of the light that haze at ranges (N, C) scatters into the aperture and the pixel per metre [1/m]
        range_m = middle + node * half
        # Share of the light in the aperture that falls on the ray's pixel, (N, C)
        blurred = 1 - safe_divide(range_m, np.broadcast_to(focus_m[:, None], range_m.shape), 1.0)
        sharp = photons.field_of_view_sr * range_m**2
        overlap = np.minimum(safe_divide(sharp, photons.aperture_m2 * blurred**2, 1.0), 1.0)
        back_m, seen = range_m, 1.0
        if receiver is not None:
            place = np.asarray(receiver.origin_m)
            points = rays.origin_m[:, None] + range_m[..., None] * rays.direction[:, None]
            back_m, seen = np.linalg.norm(points - place, axis=-1), in_view(receiver, points)
            overlap = np.where((rays.origin_m == place).all(axis=1)[:, None], overlap, 1.0)
        faded = np.exp(-medium.extinction_per_m * (range_m + back_m))
        # The solid angle of a disc seen from its axis: area / distance^2 from afar, half of all around on it
        squared = photons.aperture_m2 / math.pi
        slant = np.sqrt(back_m**2 + squared)
        # 2 pi (1 - d / slant) without its cancellation from afar
        caught_sr = (2 * math.pi * squared / (slant * (slant + back_m))) * overlap
        gain += weight * half * (medium.backscatter_per_m_sr * caught_sr * faded * seen)
    return gain


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why the air changes nothing, or None."""
    if scene.medium is None or scene.medium.extinction_per_m == scene.medium.backscatter_per_m_sr == 0:
        return "the air is clear"
    return None if detector.photons is not None else "the detector registers any echo, however weak"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of extinction and backscatter."""
    sigma_m = first_hits.sigma_m()
    blind, without = Blindness.of(counts), Blindness.of(counts, haze=False)
    clear, left = counts.signal, blind.left
    haze, fullest = (counts.pulses * part for part in counts.haze_per_pulse)
    # haze raises the detection threshold
    fewer = counts.more_missed(Echo(clear, sigma_m), Echo(left, sigma_m, haze / counts.bins))
    any_count = -np.expm1(-haze)
    own = counts.per_bin * blind.under
    wrong = np.minimum(counts.mistaken(left, counts.per_bin + fullest, own, sigma_m), any_count)
    changed = np.maximum(changed_share(clear, counts.in_air), changed_share(without.left, left))
    squared = counts.error_m(left, sigma_m) ** 2 * np.minimum(2 * np.sqrt(changed) + any_count, 1.0)
    squared += np.minimum(changed + any_count, 1.0) * counts.level_m2
    # of fewer photons in a pulse the first one, which a blind detector times, comes later
    thinned = safe_divide(counts.signal, counts.in_air, 1.0)
    squared += (sigma_m * np.minimum(LATER_PER_LOG * np.log(thinned), Blindness.of(counts, air=False).early)) ** 2
    lost = np.where(first_hits.returned, fewer + wrong, any_count)
    medium = first_hits.scene.medium
    return EffectBound(
        squared,
        np.minimum(lost, 1.0),
        f"air that dims light by {100 * -np.expm1(-2 * medium.extinction_per_m):.3g} % per metre of range",
    )
