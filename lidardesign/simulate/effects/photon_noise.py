"""Light comes in photons: how many are counted is Poisson, and when within the pulse is chance.

A ray's photons are drawn with one number for how many there are and two for each of them, so that a little more or
less light changes a few photons and leaves the others.

What it could change (`bound`): n photons of a pulse (c / 2) sigma_p wide give a range that strays by (c / 2) sigma_p /
sqrt(n) (Cramer and Rao's bound for a Gaussian without background), or as far as the highest bin does; see
`estimate_error_m`. Where photons are timed with an error too, other photons bring other errors, and both count. The
number is Poisson: the return is lost with the probability that the echo's bins hold fewer than a return needs. A pulse
has a width: a gate's end that cuts it off moves the mean of what is left by sigma phi(z) / Phi(z), z the distance in
sigma, and a surface outside the gate spills n Phi(-z) photons into it, which make a return with at most the probability
that there is any. n is what a detector that is blind after a count leaves of them. An estimate where n is a few:
photons are then in the tail as often as not, and a lost return has no range.
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

# draws of a ray: 0 for the number of photons, from here on two per photon
FIRST_PHOTON = 1


def draw_numbers(expected: np.ndarray, rays: np.ndarray, key: int) -> np.ndarray:
    """Poisson counts of expected ones of rays, shapes (R,)."""
    # compiled, which bounds do without
    from lidardesign.simulate.detector.kernels import poisson_of_rays

    return poisson_of_rays(expected, rays, np.uint64(key))


def draw_places(ray: np.ndarray, order: np.ndarray, key: int) -> tuple[np.ndarray, np.ndarray]:
    """For photons, by ray and order in it: a number in (0, 1) that chooses an echo, and a normal one for the pulse."""
    from lidardesign.simulate.detector.streams import normals, uniforms

    draw = FIRST_PHOTON + 2 * order
    return uniforms(key, ray, draw), normals(key, ray, draw + 1)


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why light is smooth, if so."""
    return None if detector.photons is not None else "the detector does not count photons"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Of few photons."""
    sigma_m, blind = first_hits.sigma_m(), Blindness.of(counts)
    missed = missed_behind(counts, blind, sigma_m)
    invented = -np.expm1(-counts.leaked(sigma_m))
    reason = f"a return has about {counts.typical} photons"
    squared = counts.error_m(blind.left, sigma_m) ** 2 + _cut_m(first_hits, sigma_m) ** 2
    return EffectBound(squared, np.where(first_hits.returned, missed, invented), reason)


def _cut_m(first_hits: FirstHits, sigma_m: np.ndarray) -> np.ndarray:
    """How far the mean of a pulse moves where the gate's end cuts it off, shape (N,) [m]."""
    from scipy.special import ndtr

    away = np.where(first_hits.returned, first_hits.gate_edge_m, np.inf) / np.maximum(sigma_m, SQUARABLE)
    return sigma_m * np.exp(-(away**2) / 2) / (math.sqrt(2 * math.pi) * ndtr(away))
