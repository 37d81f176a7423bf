"""Photon noise: Poisson counts, and random times of the photons within the pulse.

A ray's photons take one random number for their count and two for each photon, so that a small change of light changes
a few photons and leaves the others.

Bound of its effect (`bound`): n photons of a pulse (c / 2) sigma_p wide give a range with the error (c / 2) sigma_p /
sqrt(n) (Cramer and Rao's bound for a Gaussian without background), or that of the highest bin; see
`Counts.error_m`. Where photons have timing errors too, other photons have other errors, and both count. The number is
Poisson: the return is lost with the probability that the echo's bins hold fewer than a return needs. A pulse has a
width: a gate's end that cuts it off moves the mean of the rest by sigma phi(z) / Phi(z), z the distance in sigma, and a
surface outside the gate spills n Phi(-z) photons into it, which make a return with at most the probability that there
is any. n counts the photons that dead time leaves. It is an estimate for small n: photons are then in the tail as often
as not, and a lost return has no range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.numerics import SQUARABLE
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.physics import Detector
from lidardesign.simulate.effects.expected_counts import Blindness, Counts, missed_behind
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits

# draws of a ray: 0 for the number of photons, then two per photon
FIRST_PHOTON = 1


def draw_numbers(expected: np.ndarray, rays: np.ndarray, key: int) -> np.ndarray:
    """Poisson counts of rays with these expected counts, shapes (R,)."""
    # compiled on import, which bounds do not need
    from lidardesign.simulate.detector.kernels import poisson_of_bins

    return poisson_of_bins(expected, np.arange(len(rays) + 1), rays, np.uint64(key), 0)


def draw_places(ray: np.ndarray, order: np.ndarray, key: int) -> tuple[np.ndarray, np.ndarray]:
    """Per photon, by ray and order: a uniform number for its echo and a normal one for its time in the pulse."""
    from lidardesign.simulate.detector.streams import normals, uniforms

    draw = FIRST_PHOTON + 2 * order
    return uniforms(key, ray, draw), normals(key, ray, draw + 1)


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why photon noise changes nothing, or None."""
    return None if detector.photons is not None else "the detector does not count photons"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of photon noise."""
    from scipy.special import ndtr

    sigma_m, blind = first_hits.sigma_m(), Blindness.of(counts)
    missed = missed_behind(counts, blind, sigma_m)
    invented = -np.expm1(-counts.leaked(sigma_m))
    reason = f"a return has about {counts.typical} photons"
    # the mean of a pulse is shifted by its truncation at the gate's end
    away = np.where(first_hits.returned, first_hits.gate_edge_m, np.inf) / np.maximum(sigma_m, SQUARABLE)
    cut_m = sigma_m * np.exp(-(away**2) / 2) / (math.sqrt(2 * math.pi) * ndtr(away))
    squared = counts.error_m(blind.left, sigma_m) ** 2 + cut_m**2
    return EffectBound(squared, np.where(first_hits.returned, missed, invented), reason)
