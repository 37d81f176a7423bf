"""First hits of all rays of a scene's frame, and what an effect could change of them: bounds start from here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Hits, Outcome, Rays, gate_outcomes, path_of_range, path_windows
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.light import Beams, direct_echoes
from lidardesign.simulate.detector.physics import Detector, bins_start, ends_of_bins, metres, resolution_m

# A surface that is grazed more flatly than this counts as met at it: ranges then change by up to 50 times a step aside.
FLATTEST_COSINE = 0.02
# Rays whose ends a step aside is compared with.
NEIGHBOURS = 4
# The matched filter takes photons up to so many standard deviations from its pulse's centre into account.
PULSE_REACH = 4.0
# Of a pulse r bins wide, the matched filter leaves the share exp(-3.2 r) + 0.05 / r^2 of a step between bins, at most
FILTER_SOFTENS, FILTER_LEAVES = 3.2, 0.05


@dataclass(frozen=True, eq=False)
class EffectBound:
    """What an effect could change, ray by ray.

    Arguments:
        squared_m2: Mean squared error of half the path of a return, (N,) [m^2].
        lost: Probability that a return is lost, or invented, or taken from somewhere else, (N,).
        reason: Why, in one line.
    """

    squared_m2: np.ndarray
    lost: np.ndarray
    reason: str


@dataclass(frozen=True, eq=False)
class FirstHits:
    """First hits of all rays in a frame.

    Arguments:
        scene: What they meet.
        frame: The time frame.
        detector: What receives their light.
        rays: Those of all lists, N.
        row: The list of each, ascending, shape (N,).
        sharing: How many rays share its emitter's energy, shape (N,).
        hits: What they meet first.
        caster: Of the frame, for the few further rays that a bound may need.
    """

    scene: Scene
    frame: int
    detector: Detector
    rays: Rays
    row: np.ndarray
    sharing: np.ndarray
    hits: Hits
    caster: SceneCaster

    @classmethod
    def of(cls, scene: Scene, frame: int, detector: Detector, lists: Sequence[Rays], caster: SceneCaster) -> FirstHits:
        """What lists of rays meet in a frame."""
        names = ("origin_m", "direction", "gate_m", "sensor", "time_s")
        rays = Rays(*(np.concatenate([getattr(one, name) for one in lists]) for name in names))
        sizes = np.array([len(one) for one in lists])
        row = np.repeat(np.arange(len(lists)), sizes)
        hits = caster.first_hit(rays.origin_m, rays.direction)
        return cls(scene, frame, detector, rays, row, sizes[row], hits, caster)

    def __len__(self) -> int:
        return len(self.rays)

    def nothing(self, reason: str) -> EffectBound:
        """No error, and nothing lost."""
        return EffectBound(np.zeros(len(self)), np.zeros(len(self)), reason)

    @cached_property
    def neighbours(self) -> np.ndarray:
        """The `NEIGHBOURS` rays of the same list that end nearest to each; itself where there are fewer, (N, K)."""
        met = self.range_m[self.hits.body >= 0]
        ends = self.rays.origin_m + (float(np.median(met)) if len(met) else 1.0) * self.rays.direction
        # the lists side by side, further from each other than the rays of any
        apart = 4 * (1 + np.abs(ends).max(initial=0.0) + np.abs(self.rays.origin_m).max(initial=0.0))
        places = np.concatenate([self.rays.origin_m, ends, apart * self.row[:, None]], axis=1)
        from scipy.spatial import cKDTree

        away, near = cKDTree(places).query(places, k=NEIGHBOURS + 1, distance_upper_bound=apart)
        return np.where(np.isfinite(away), near, np.arange(len(self))[:, None])

    @cached_property
    def returned(self) -> np.ndarray:
        """Which rays have a return by geometry alone, shape (N,)."""
        return gate_outcomes(self.hits.range_m, self.rays.gate_m) == Outcome.RETURN

    @cached_property
    def range_m(self) -> np.ndarray:
        """Ranges of first hits, 0 where there is none, shape (N,) [m]."""
        return np.where(self.hits.body >= 0, self.hits.range_m, 0.0)

    @cached_property
    def cosine(self) -> np.ndarray:
        """Of incidence at the first hit, at least `FLATTEST_COSINE`; 1 on a miss, shape (N,)."""
        along = np.abs(np.einsum("nk,nk->n", self.hits.normal, self.rays.direction))
        return np.where(self.hits.body >= 0, np.maximum(along, FLATTEST_COSINE), 1.0)

    @cached_property
    def tangent(self) -> np.ndarray:
        """Of incidence: how much the range changes by a step aside, shape (N,)."""
        return np.sqrt(np.maximum(1 / self.cosine**2 - 1, 0.0))

    @cached_property
    def window_m(self) -> np.ndarray:
        """Gates as half paths, shape (N, 2) [m]."""
        return path_windows(self.rays, self.scene.receiver)

    @cached_property
    def width_m(self) -> np.ndarray:
        """How much of half a path each ray listens to: no return is further off than that, shape (N,) [m]."""
        return self.window_m[:, 1] - self.window_m[:, 0]

    @cached_property
    def path_m(self) -> np.ndarray:
        """Half paths of first hits, 0 where there is none, shape (N,) [m]."""
        return path_of_range(self.rays, self.scene.receiver, self.range_m)

    @cached_property
    def path_per_range(self) -> np.ndarray:
        """How much half a path grows by a longer range, at least `FLATTEST_COSINE`: 1 without a receiver, (N,)."""
        if self.scene.receiver is None:
            return np.ones(len(self))
        back = (
            self.rays.origin_m - np.asarray(self.scene.receiver.origin_m) + self.range_m[:, None] * self.rays.direction
        )
        along = np.einsum("nk,nk->n", back, self.rays.direction)
        return np.maximum((1 + safe_divide(along, np.linalg.norm(back, axis=1), 1.0)) / 2, FLATTEST_COSINE)

    def half_path_m(self, range_m: np.ndarray, aside_m: np.ndarray) -> np.ndarray:
        """How much half a path changes at most where a hit lies further by (N,) and aside by (N,) [m], shape (N,)."""
        if self.scene.receiver is None:
            return range_m
        together = (self.rays.origin_m == np.asarray(self.scene.receiver.origin_m)).all(axis=1)
        return np.where(together, range_m, (range_m + np.hypot(range_m, aside_m)) / 2)

    @cached_property
    def before_m(self) -> np.ndarray:
        """How much of its window lies before a ray's return; the whole window without one, shape (N,) [m]."""
        return np.where(self.returned, np.clip(self.path_m - self.window_m[:, 0], 0.0, self.width_m), self.width_m)

    @cached_property
    def gate_edge_m(self) -> np.ndarray:
        """How far a first hit lies from the nearer end of its window, infinite on a miss, shape (N,) [m]."""
        return np.where(self.hits.body >= 0, np.abs(self.path_m[:, None] - self.window_m).min(axis=1), np.inf)

    @cached_property
    def gain(self) -> np.ndarray:
        """Share of a ray's light that its first hit sends to 1 m^2 of aperture, inside or outside the gate, (N,)."""
        echoes = direct_echoes(self.scene, Beams.of(self.rays), self.hits)
        gain = np.zeros(len(self))
        gain[echoes.ray] = echoes.gain
        return gain

    @cached_property
    def beam_m(self) -> np.ndarray:
        """Radius of each beam at its first hit; 0 where beams are lines, shape (N,) [m]."""
        return (self.detector.divergence_rad / 2 if self.detector.footprint_rays > 1 else 0.0) * self.range_m

    def sigma_m(self, *, jitter: bool = True) -> np.ndarray:
        """How far one photon of an echo strays: the pulse, timing errors, and a slanted beam's spread, (N,) [m].

        A beam that is even over a disc of radius a strays by a / 2 along any axis, times the tangent of incidence.
        """
        timed = self.detector.timing_sigma_s if jitter else self.detector.pulse_sigma_s
        return np.hypot(metres(timed), self.beam_m * self.tangent / 2)

    @cached_property
    def resolution_m(self) -> float:
        """Echoes closer than this are one: a bin or the width of the pulse, whichever is more [m].

        The matched filter averages over all of a pulse, far into its tails.
        """
        averages = self.detector.photons is not None and self.detector.estimator == "matched"
        return max(resolution_m(self.detector), averages * PULSE_REACH * metres(self.detector.timing_sigma_s))

    @cached_property
    def rounding_m(self) -> np.ndarray:
        """How far each first hit lies from where its bin is reported, (N,) [m]."""
        low, high = ends_of_bins(self.path_m, self.window_m, self.detector)
        if self.detector.photons is None:
            return np.abs(self.path_m - (low + high) / 2)
        # a histogram's first and last bin have their middle, as far as it lies in the window
        first, bin_m = bins_start(self.window_m, self.detector), self.detector.bin_m
        middle = first + (np.floor((self.path_m - first) / bin_m) + 0.5) * bin_m
        return np.abs(self.path_m - np.clip(middle, low, high))

    @cached_property
    def bin_edge_m(self) -> np.ndarray:
        """How far each first hit lies from the nearer end of its bin, or of the part that is listened to, (N,) [m]."""
        low, high = ends_of_bins(self.path_m, self.window_m, self.detector)
        return np.minimum(self.path_m - low, high - self.path_m)

    @cached_property
    def step_m(self) -> np.ndarray:
        """How far a range jumps at most where an echo goes from one of the detector's bins to the next, (N,) [m].

        By a bin, but the matched filter finds its place between bins: what is left there of rounding was computed for
        a Gaussian of the standard deviation r bins in all its places, levels of background and widths of the filter.
        """
        bin_m = self.detector.bin_m or 0.0
        if bin_m == 0 or self.detector.photons is None or self.detector.estimator == "peak":
            return np.full(len(self), bin_m)
        spread = self.sigma_m(jitter=False) / bin_m
        return np.minimum(np.exp(-FILTER_SOFTENS * spread) + FILTER_LEAVES / np.maximum(spread, 1.0) ** 2, 1.0) * bin_m


# A step in range counts as an edge where it exceeds the slope of both surfaces this many times over.
STEEPER = 2.0


def edge_probability(first_hits: FirstHits, aside_m: np.ndarray) -> np.ndarray:
    """Probability that an edge lies within a distance aside of where a ray ends, shape (N,).

    Two neighbouring rays, a distance d apart, that end on different bodies, or further apart in range than the slope
    of either explains, have an edge somewhere between them: within a <= d of one with the probability a / d, wherever
    it is. The nearest few of each list are asked. An estimate: edges between rays that both end on one
    surface are not seen, in expectation over where rays fall they weigh as much as those that are.

    Arguments:
        first_hits: What rays meet.
        aside_m: How far aside, shape (N,) [m].
    """
    if not aside_m.any():
        return np.zeros(len(first_hits))
    range_m, body, tangent = first_hits.range_m, first_hits.hits.body, first_hits.tangent
    origin, along = first_hits.rays.origin_m, first_hits.rays.direction
    met = body >= 0
    chance = np.zeros(len(first_hits))
    for other in first_hits.neighbours.T:
        reach_m = np.minimum(first_hits.hits.range_m, first_hits.hits.range_m[other])
        # how far rays are from their neighbours at the shorter range of the two, along both [m]
        reach_m = np.where(np.isfinite(reach_m), reach_m, 0.0)
        apart_m = np.linalg.norm(origin - origin[other] + reach_m[:, None] * (along - along[other]), axis=1)
        sloped_m = STEEPER * apart_m * (1 + tangent + tangent[other])
        edge = (body != body[other]) | (met & met[other] & (np.abs(range_m - range_m[other]) > sloped_m))
        further = np.maximum(aside_m, aside_m[other])
        share = np.minimum(safe_divide(further, apart_m, 1.0), 1.0)
        chance = np.maximum(chance, np.where(edge & (further > 0), share, 0.0))
    return chance
