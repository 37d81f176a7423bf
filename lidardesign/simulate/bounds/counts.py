"""Expected counts of signal and background, and how likely a detector misses the one or mistakes the other for it.

Counts are Poisson. A return is the highest of B bins, or where a pulse fits best, reported if the m bins of one pulse's
width around it hold at least k counts, the fewest that background alone brings to any of B such places with at most the
detector's probability of a false alarm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidardesign.numerics import EPSILON, TINY, safe_divide
from lidardesign.simulate.bounds.light import ambient_per_metre, haze_per_pulse
from lidardesign.simulate.bounds.sight import Sight
from lidardesign.simulate.detector import FWHM_PER_SIGMA, Detector, metres
from lidardesign.simulate.histogram import bin_width_m

# Steps of the logarithm, 1 % each, in which levels of background are told apart.
LEVELS_PER_UNIT = 100
# Counts from here on are shown as whole numbers.
MANY = 100
# The highest of a histogram's bins strays by this many of (sigma^5 / (n b))^(1/4), see `peak_error_m`.
PEAK_STRAY = 1.5


@dataclass(frozen=True, eq=False)
class Echo:
    """What arrives of the echoes of N rays.

    Arguments:
        signal: Counts, shape (N,).
        sigma_m: How far one photon strays, shape (N,) [m].
        level: Counts per bin besides ambient and dark ones, shape (N,).
    """

    signal: np.ndarray
    sigma_m: np.ndarray
    level: np.ndarray | float = 0.0


@dataclass(frozen=True, eq=False)
class Counts:
    """Counts per frame of every ray of a sight, for a detector that counts photons.

    Arguments:
        sight: What the rays meet.
    """

    sight: Sight

    @cached_property
    def pulses(self) -> np.ndarray:
        """Pulses of each ray in a frame, shape (N,)."""
        return self._by_sharing("pulses")

    @cached_property
    def signal_per_pulse(self) -> np.ndarray:
        """Counts of a return in clear air, 0 where there is none, shape (N,)."""
        return np.where(self.sight.returned, self._of_first_hit, 0.0)

    @cached_property
    def _of_first_hit(self) -> np.ndarray:
        photons = self.sight.detector.photons
        return self._by_sharing("emitted") * photons.aperture_m2 * photons.efficiency * self.sight.gain

    def leaked(self, sigma_m: np.ndarray) -> np.ndarray:
        """Counts that the pulse of a hit outside the gate spills into it in a frame, in clear air, shape (N,).

        The part of a Gaussian inside the window, at most its part beyond the nearer end.
        """
        from scipy.special import ndtr

        share = ndtr(-self.sight.gate_edge_m / np.maximum(sigma_m, TINY))
        return np.where(self.sight.returned, 0.0, self._of_first_hit * self.pulses * share)

    @cached_property
    def signal(self) -> np.ndarray:
        """Counts of the first hit in a frame, in clear air, shape (N,)."""
        return self.signal_per_pulse * self.pulses

    @property
    def typical(self) -> str:
        """The median of `in_air` over returns, for people."""
        returned = self.in_air[self.sight.returned]
        return counted(float(np.median(returned))) if len(returned) else "no"

    @cached_property
    def in_air(self) -> np.ndarray:
        """`signal` weakened by the air, shape (N,)."""
        medium = self.sight.scene.medium
        if medium is None:
            return self.signal
        path_m = self.sight.window_m[:, 0] + self.sight.before_m
        return self.signal * np.exp(-2 * medium.extinction_per_m * path_m)

    @cached_property
    def background_per_metre(self) -> np.ndarray:
        """Ambient light and dark counts per pulse and metre, shape (N,)."""
        return ambient_per_metre(self.sight)

    @cached_property
    def haze_per_pulse(self) -> tuple[np.ndarray, np.ndarray]:
        """Counts that the air sends back: in the whole window, and in its fullest bin, shapes (N,)."""
        return haze_per_pulse(self.sight, self._by_sharing("emitted"), self.bin_m)

    @cached_property
    def bin_m(self) -> float:
        """The width of a histogram's bins [m]."""
        return bin_width_m(self.sight.detector)

    @cached_property
    def bins(self) -> np.ndarray:
        """How many of them a window has, shape (N,)."""
        return np.maximum(np.ceil(self.sight.width_m / self.bin_m), 1.0)

    @cached_property
    def per_bin(self) -> np.ndarray:
        """Ambient and dark counts per bin in a frame, shape (N,)."""
        return self.background_per_metre * self.bin_m * self.pulses

    @cached_property
    def pulse_bins(self) -> int:
        """How many bins a pulse is wide, at half of its height: 2 half + 1."""
        return 2 * int(FWHM_PER_SIGMA * metres(self.sight.detector.timing_sigma_s) / (2 * self.bin_m)) + 1

    def needed(self, per_bin: np.ndarray) -> np.ndarray:
        """The fewest counts in a pulse's width that are reported in so much background per bin (N,), shape (N,).

        Levels and numbers of bins are rounded up to one of `LEVELS_PER_UNIT` per factor e: few are worked out.
        """
        level, bins = (_rounded_up(values) for values in (per_bin * self.pulse_bins, self.bins))
        # pairs as complex numbers: those are told apart fastest
        pairs, place = np.unique(level + 1j * bins, return_inverse=True)
        return needed_counts(pairs.real, pairs.imag, self.sight.detector.false_alarm)[place]

    def missed(self, signal: np.ndarray, per_bin: np.ndarray | float, sigma_m: np.ndarray) -> np.ndarray:
        """Probability that the echo's bins hold fewer counts than it takes to be reported, shape (N,).

        Arguments:
            signal: Counts of the echo, shape (N,).
            per_bin: Background counts in each bin, shape (N,).
            sigma_m: How far one photon strays, shape (N,) [m].
        """
        from scipy.special import pdtr

        per_bin = np.broadcast_to(per_bin, signal.shape)
        expected = signal * share_in_bins(self.pulse_bins, self.bin_m, sigma_m) + per_bin * self.pulse_bins
        return pdtr(self.needed(per_bin) - 1, expected)

    def more_missed(self, before: Echo, after: Echo) -> np.ndarray:
        """How much more often an echo is missed, in the light of the surroundings or in the dark, shape (N,)."""
        changes = [
            self.missed(after.signal, level + after.level, after.sigma_m)
            - self.missed(before.signal, level + before.level, before.sigma_m)
            for level in (self.per_bin, np.zeros_like(self.per_bin))
        ]
        return np.maximum(np.maximum(*changes), 0.0)

    def mistaken(
        self, signal: np.ndarray, other: np.ndarray, per_bin: np.ndarray, sigma_m: np.ndarray
    ) -> np.ndarray:
        """Bound of the probability that another bin beats the echo's, shape (N,).

        The union over all bins of P(X >= Y) <= exp(-(sqrt(E Y) - sqrt(E X))^2), Chernoff's bound for a difference of
        Poisson counts X of the fullest other bin (`other`) and Y of the echo's. The matched filter compares places as
        wide as a pulse, no worse than by their sums.
        """
        wide = self.pulse_bins if self.sight.detector.estimator == "matched" else 1
        expected = signal * share_in_bins(wide, self.bin_m, sigma_m) + wide * per_bin
        lead = np.maximum(np.sqrt(expected) - np.sqrt(wide * other), 0.0)
        return np.minimum((self.bins - 1) * np.exp(-(lead**2)), 1.0)

    def error_m(self, signal: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
        """How far the range from so many photons strays, rms, shape (N,) [m]."""
        return estimate_error_m(self.sight.detector, signal, sigma_m)

    def _by_sharing(self, name: str) -> np.ndarray:
        shared, place = np.unique(self.sight.sharing, return_inverse=True)
        return np.array([getattr(self.sight.detector.photons, name)(int(rays)) for rays in shared])[place]


def _rounded_up(values: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.exp(np.ceil(LEVELS_PER_UNIT * np.log(values)) / LEVELS_PER_UNIT)


def counted(number: float) -> str:
    """An expected count for people."""
    return f"{number:,.0f}" if number >= MANY else f"{number:.2g}"


def share_in_bins(count: int, bin_m: float, sigma_m: np.ndarray) -> np.ndarray:
    """Share of an echo's photons in an odd number of bins, in the worst case: it lies on an edge of the middle one."""
    from scipy.special import erf

    spread_m = math.sqrt(2) * np.maximum(sigma_m, TINY)
    return 0.5 * (erf((count - 1) / 2 * bin_m / spread_m) + erf((count + 1) / 2 * bin_m / spread_m))


def needed_counts(per_bin: np.ndarray, bins: np.ndarray, false_alarm: float) -> np.ndarray:
    """Fewest counts k >= 1 that B bins of Poisson background reach with a probability of at most that, shape (N,).

    The union over bins: B P(X >= k) <= false_alarm.
    """
    from scipy.special import pdtr, pdtrik

    allowed = np.clip(false_alarm / bins, EPSILON, 1.0)
    least = np.maximum(per_bin, TINY)
    quiet = -np.expm1(-least) <= allowed
    with np.errstate(invalid="ignore"):
        needed = np.ceil(np.nan_to_num(pdtrik(1 - allowed, least))) + 1
    # the inverse is of a smooth curve through the steps: one step more where it fell short
    needed += 1 - pdtr(needed - 1, least) > allowed
    return np.where(quiet, 1.0, np.maximum(needed, 1.0))


def estimate_error_m(detector: Detector, signal: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    """How far the range from n photons (N,) that stray by sigma (N,) [m] strays, rms, shape (N,) [m].

    The matched filter averages: sigma / sqrt(n). The highest bin is a mode: it strays to where the expected counts
    n b f fall short of the peak's by about their own noise; with f a Gaussian, e^4 = (8 sqrt(2 pi)) sigma^5 / (n b) up
    to a factor (Chernoff 1964: a mode converges slower than a mean), and no further than the earliest photon, which the
    highest bin may hold where most bins hold one: sigma sqrt(1 + ln n).
    """
    count = np.maximum(signal, 1.0)
    averaged = sigma_m / np.sqrt(count)
    if detector.estimator == "matched":
        return averaged
    mode = PEAK_STRAY * (sigma_m**5 / (count * bin_width_m(detector))) ** 0.25
    return np.minimum(np.maximum(averaged, mode), sigma_m * np.sqrt(1 + np.log(count)))


def changed_share(signal: np.ndarray, fewer: np.ndarray) -> np.ndarray:
    """Share of an echo's photons that are not there any more, shape (N,)."""
    return np.clip(1 - safe_divide(fewer, signal, 1.0), 0.0, 1.0)
