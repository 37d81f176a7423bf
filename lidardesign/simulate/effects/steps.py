"""What a detector makes of small changes: a step over the edge of a bin, or none, and another chance for photons.

Behind rounding, what moves a range by little moves it by a whole bin, or not at all. An edge that is nearer than the
shift s is passed; beyond, at the distance d, with P(shift > d), taken as normal. What else moves ranges moves that
edge too: with the scale t of all of it, unknown but at most as bounded, the density at the edge is at most max over t
of phi(d / t) / t = 0.24 / d, and the mean shift 0.8 s, so that it is passed with at most 0.2 s / d. The matched filter
averages: its edges are as wide as a pulse, its steps lower, and each of n photons passes edges by itself.

A photon that goes to another bin, which one of n does with at most n s / bin, may make another bin the highest, and
others the ones that a dead time hides: the range strays once more, as chance has it. Multipath is left out of this: it
takes a thousand times as long as other effects, and one chance is as good as another.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from lidardesign.numerics import SQUARABLE, safe_divide
from lidardesign.simulate.effects.expected_counts import Blindness, Counts, variance_of_missing
from lidardesign.simulate.effects.first_hits import EffectBound

# Of a shift over the distance of an edge: how likely it is passed where other shifts are of unknown size.
PASSED_SHARE = 0.2
# An edge further than so many standard deviations of all shifts is not passed.
EDGE_REACH = 4.0
# Whether a return is reported that has barely enough light is a matter of these.
OF_BARE_LIGHT = {"photon_noise", "jitter", "quantisation"}
# By these rays meet what their first hits are not.
ELSEWHERE = {"footprint", "motion"}


def with_steps(counts: Counts, bounds: dict[str, EffectBound]) -> dict[str, EffectBound]:
    """What effects change of what a detector reports, by what they change of the light; names to bounds."""
    detector = counts.first_hits.detector
    if not detector.bin_m and detector.photons is None:
        return bounds
    moving = {name: np.sqrt(bound.squared_m2) for name, bound in bounds.items() if name != "quantisation"}
    changed = dict(bounds)
    chance = None if detector.photons is None else _Chance(counts)
    for name, shift_m in moving.items():
        squared_m2, lost = bounds[name].squared_m2, bounds[name].lost
        if detector.bin_m:
            others_m = sum((moving[other] for other in moving.keys() - {name}), np.zeros(len(shift_m)))
            squared_m2 = squared_m2 + _steps_m2(counts, shift_m, others_m)
        if chance is not None and name != "multipath":
            share = np.minimum(counts.in_air * shift_m / counts.bin_m, 1.0)
            squared_m2, lost = squared_m2 + share * chance.squared_m2, np.minimum(lost + share * chance.lost, 1.0)
        changed[name] = replace(bounds[name], squared_m2=squared_m2, lost=lost)
    if chance is not None:
        # how much light comes of what a beam or a ray of another time meets is not known: it may be barely enough
        for name, other in itertools.product(OF_BARE_LIGHT & bounds.keys(), ELSEWHERE & bounds.keys()):
            changed[name] = replace(changed[name], lost=np.maximum(changed[name].lost, bounds[other].lost))
    return changed


class _Chance:
    """How far ranges of photons stray, squared (N,) [m^2], and how many of them are lost (N,), by chance alone."""

    def __init__(self, counts: Counts) -> None:
        detector, sigma_m, blind = counts.first_hits.detector, counts.first_hits.sigma_m(), Blindness.of(counts)
        self.lost = counts.by_chance(blind, sigma_m)
        if detector.estimator == "peak":
            self.squared_m2 = 2 * counts.error_m(blind.left, sigma_m) ** 2
        else:
            self.squared_m2 = 2 * variance_of_missing(counts, counts.in_air, blind.left, sigma_m)


def _steps_m2(counts: Counts, shift_m: np.ndarray, others_m: np.ndarray) -> np.ndarray:
    """Mean squared steps over edges of bins by a shift (N,) where others shift by up to so much (N,) [m], (N,)."""
    first_hits, bin_m, alone_m2 = counts.first_hits, counts.bin_m, 0.0
    if first_hits.detector.photons is not None and first_hits.detector.estimator == "matched":
        others_m = others_m + first_hits.sigma_m()
        alone_m2 = bin_m * shift_m / np.maximum(counts.in_air, 1.0)
    edge_m = np.maximum(first_hits.bin_edge_m, SQUARABLE)
    return _passed(shift_m, others_m, edge_m) * first_hits.step_m**2 + alone_m2


def _passed(shift_m: np.ndarray, others_m: np.ndarray, edge_m: np.ndarray) -> np.ndarray:
    """How likely a shift (N,) passes an edge at a distance (N,) that others move by up to so much (N,) [m], (N,)."""
    from scipy.special import ndtr

    ratio = shift_m / edge_m
    within = (others_m > 0) & (edge_m <= EDGE_REACH * (shift_m + others_m))
    beyond = ndtr(-safe_divide(1.0, ratio, math.inf)) + PASSED_SHARE * ratio * within
    return np.where(ratio >= 1, 1.0, np.minimum(beyond, 1.0))
