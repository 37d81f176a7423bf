"""First hits of all rays in a frame of a scene, from which the bounds of effects are computed."""

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

# Lower limit of the cosine of incidence: ranges then change by up to 50 times a lateral step.
FLATTEST_COSINE = 0.02
# Neighbouring rays that each ray is compared with.
NEIGHBOURS = 4
# Half width of the matched filter in standard deviations of the pulse.
PULSE_REACH = 4.0
# Of a pulse r bins wide, the matched filter leaves the share exp(-3.2 r) + 0.05 / r^2 of a step between bins, at most
FILTER_SOFTENS, FILTER_LEAVES = 3.2, 0.05


@dataclass(frozen=True, eq=False)
class EffectBound:
    """Upper bound of an effect, ray by ray.

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
        scene: The scene.
        frame: The time frame.
        detector: The detector.
        rays: The rays of all lists, N of them.
        row: Index of each ray's list, ascending, shape (N,).
        sharing: Number of rays that share each ray's emitter energy, shape (N,).
        hits: The first hits.
        caster: Caster of the frame, for the few further rays that a bound may need.
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
        """First hits of lists of rays in a frame."""
        rays = Rays.joined(lists)
        row = np.repeat(np.arange(len(lists)), [len(one) for one in lists])
        sharing = np.concatenate([detector.sharing(one) for one in lists])
        hits = caster.first_hit(rays.origin_m, rays.direction)
        return cls(scene, frame, detector, rays, row, sharing, hits, caster)

    def __len__(self) -> int:
        return len(self.rays)

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
        """Mask of rays with a return by geometry alone, shape (N,)."""
        return gate_outcomes(self.hits.range_m, self.rays.gate_m) == Outcome.RETURN

    @cached_property
    def range_m(self) -> np.ndarray:
        """Ranges of first hits, 0 where there is none, shape (N,) [m]."""
        return np.where(self.hits.body >= 0, self.hits.range_m, 0.0)

    @cached_property
    def cosine(self) -> np.ndarray:
        """Cosine of incidence at the first hit, at least `FLATTEST_COSINE`; 1 on a miss, shape (N,)."""
        along = np.abs(np.einsum("nk,nk->n", self.hits.normal, self.rays.direction))
        return np.where(self.hits.body >= 0, np.maximum(along, FLATTEST_COSINE), 1.0)

    @cached_property
    def tangent(self) -> np.ndarray:
        """Tangent of incidence, the change of range per lateral step, shape (N,)."""
        return np.sqrt(np.maximum(1 / self.cosine**2 - 1, 0.0))

    @cached_property
    def window_m(self) -> np.ndarray:
        """Gates as half paths, shape (N, 2) [m]."""
        return path_windows(self.rays, self.scene.receiver)

    @cached_property
    def width_m(self) -> np.ndarray:
        """Length of each ray's gate in half path, an upper bound of any range error, shape (N,) [m]."""
        return self.window_m[:, 1] - self.window_m[:, 0]

    @cached_property
    def path_m(self) -> np.ndarray:
        """Half paths of first hits, 0 where there is none, shape (N,) [m]."""
        return path_of_range(self.rays, self.scene.receiver, self.range_m)

    @cached_property
    def path_per_range(self) -> np.ndarray:
        """Derivative of half path by range, at least `FLATTEST_COSINE`; 1 without a receiver, shape (N,)."""
        if self.scene.receiver is None:
            return np.ones(len(self))
        back = (
            self.rays.origin_m - np.asarray(self.scene.receiver.origin_m) + self.range_m[:, None] * self.rays.direction
        )
        along = np.einsum("nk,nk->n", back, self.rays.direction)
        return np.maximum((1 + safe_divide(along, np.linalg.norm(back, axis=1), 1.0)) / 2, FLATTEST_COSINE)

    def half_path_m(self, range_m: np.ndarray, aside_m: np.ndarray) -> np.ndarray:
        """Largest change of half path where a hit moves by (N,) in range and by (N,) laterally [m], shape (N,) [m]."""
        if self.scene.receiver is None:
            return range_m
        together = (self.rays.origin_m == np.asarray(self.scene.receiver.origin_m)).all(axis=1)
        return np.where(together, range_m, (range_m + np.hypot(range_m, aside_m)) / 2)

    @cached_property
    def before_m(self) -> np.ndarray:
        """Length of each ray's window before its return; the whole window without one, shape (N,) [m]."""
        return np.where(self.returned, np.clip(self.path_m - self.window_m[:, 0], 0.0, self.width_m), self.width_m)

    @cached_property
    def gate_edge_m(self) -> np.ndarray:
        """Distance of each first hit from the nearer end of its window, infinite on a miss, shape (N,) [m]."""
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
        """Standard deviation of one photon's half path by pulse, timing and a slanted beam's spread, shape (N,) [m].

        A uniform disc of radius a has the standard deviation a / 2 along any axis, here times the tangent of incidence.
        """
        timed = self.detector.timing_sigma_s if jitter else self.detector.pulse_sigma_s
        return np.hypot(metres(timed), self.beam_m * self.tangent / 2)

    @cached_property
    def resolution_m(self) -> float:
        """Half path within which echoes merge: a bin or the width of the pulse, whichever is larger [m].

        The matched filter averages over all of a pulse, far into its tails.
        """
        averages = self.detector.photons is not None and self.detector.estimator == "matched"
        return max(resolution_m(self.detector), averages * PULSE_REACH * metres(self.detector.timing_sigma_s))

    @cached_property
    def rounding_m(self) -> np.ndarray:
        """Rounding error of each first hit, the distance to its bin's reported half path, shape (N,) [m]."""
        low, high = ends_of_bins(self.path_m, self.window_m, self.detector)
        if self.detector.photons is None:
            return np.abs(self.path_m - (low + high) / 2)
        # a histogram's first and last bin have their middle, as far as it lies in the window
        first, bin_m = bins_start(self.window_m, self.detector), self.detector.bin_m
        middle = first + (np.floor((self.path_m - first) / bin_m) + 0.5) * bin_m
        return np.abs(self.path_m - np.clip(middle, low, high))

    @cached_property
    def bin_edge_m(self) -> np.ndarray:
        """Distance of each first hit from the nearer end of its bin, cut to the window, shape (N,) [m]."""
        low, high = ends_of_bins(self.path_m, self.window_m, self.detector)
        return np.minimum(self.path_m - low, high - self.path_m)

    @cached_property
    def step_m(self) -> np.ndarray:
        """Largest step of the range where an echo moves from one of the detector's bins to the next, shape (N,) [m].

        One bin, but less for the matched filter, which interpolates: its residual rounding was computed for a Gaussian
        of the standard deviation r bins at all positions, levels of background and widths of the filter.
        """
        bin_m = self.detector.bin_m or 0.0
        if bin_m == 0 or self.detector.photons is None or self.detector.estimator == "peak":
            return np.full(len(self), bin_m)
        spread = self.sigma_m(jitter=False) / bin_m
        return np.minimum(np.exp(-FILTER_SOFTENS * spread) + FILTER_LEAVES / np.maximum(spread, 1.0) ** 2, 1.0) * bin_m


# A step in range counts as an edge if it exceeds the slope of both surfaces by this factor.
STEEPER = 2.0


def edge_probability(first_hits: FirstHits, aside_m: np.ndarray) -> np.ndarray:
    """Probability that an edge lies within a lateral distance of each first hit, shape (N,).

    Two neighbouring rays, a distance d apart, that end on different bodies, or further apart in range than the slope
    of either explains, have an edge somewhere between them: within a <= d of one with the probability a / d, wherever
    it is. Only the nearest few rays of each list are compared. An estimate: edges between rays that both end on one
    surface are missed; in expectation over ray positions they weigh as much as the detected ones.

    Arguments:
        first_hits: First hits of the rays.
        aside_m: Lateral distance, shape (N,) [m].
    """
    if not aside_m.any():
        return np.zeros(len(first_hits))
    range_m, body, tangent = first_hits.range_m, first_hits.hits.body, first_hits.tangent
    origin, along = first_hits.rays.origin_m, first_hits.rays.direction
    met = body >= 0
    chance = np.zeros(len(first_hits))
    for other in first_hits.neighbours.T:
        reach_m = np.minimum(first_hits.hits.range_m, first_hits.hits.range_m[other])
        # distance of rays from their neighbours at the shorter range of the two [m]
        reach_m = np.where(np.isfinite(reach_m), reach_m, 0.0)
        apart_m = np.linalg.norm(origin - origin[other] + reach_m[:, None] * (along - along[other]), axis=1)
        sloped_m = STEEPER * apart_m * (1 + tangent + tangent[other])
        edge = (body != body[other]) | (met & met[other] & (np.abs(range_m - range_m[other]) > sloped_m))
        further = np.maximum(aside_m, aside_m[other])
        share = np.minimum(safe_divide(further, apart_m, 1.0), 1.0)
        chance = np.maximum(chance, np.where(edge & (further > 0), share, 0.0))
    return chance
