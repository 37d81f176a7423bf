"""Expected counts of signal and background, and the probabilities of missed and false returns.

Counts are Poisson. A return is the highest of B bins, or the best fit of a pulse, reported if the m bins of one pulse's
width around it hold at least k counts, the fewest that background alone brings to any of B such places with at most the
detector's probability of a false alarm.

A detector with dead time counts a part of echoes and of background (`Blindness`). Per pulse s counts of the echo, m
counts before it and w in the whole gate are expected. Of the echo the first photon counts, with the probability
exp(-m) (1 - exp(-s)); every count also blinds the c pulses that its dead time reaches into, which leaves
the share 1 / (1 + c (1 - exp(-w))) of them. Of K photons, normal with sigma, the first is early by at most sigma
min(sqrt(2 ln K), (K - 1) / sqrt(pi)), in the mean over K >= 1 as well (both bounds are concave in K or linear; Jensen),
with E K = s / (1 - exp(-s)).

Background is thinned alike: from all of it at the gate's start to exp(-m) under the echo. The detection threshold
follows its mean level, which lies below that at the start, so that the start itself may be taken for a return.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from lidardesign.numerics import COARSE_SLACK, EPSILON, SQUARABLE, TINY, safe_divide
from lidardesign.scenes.rays import range_of_path
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S, Scene
from lidardesign.simulate.detector.light import reflectances, spectral_irradiance
from lidardesign.simulate.detector.physics import FWHM_PER_SIGMA, MOST_COUNTS, Photons, bin_width_m, metres
from lidardesign.simulate.effects.first_hits import FirstHits

# Rays pass a receiver no nearer than this share of their way: differences of arctangents are then exact to 1e-9.
NEAREST_SHARE = COARSE_SLACK


def ambient_per_metre(scene: Scene, photons: Photons, reflectance: np.ndarray) -> np.ndarray:
    """Ambient and dark counts per pulse and metre of range, by the reflectance of what is seen, shape (N,) for (N,).

    A hit surface has the radiance reflectance E / pi, seen through the aperture and the pixel's field of view; rays
    without a hit receive no ambient light; a metre of range takes 2 / c.
    """
    rate_hz = np.full(len(reflectance), photons.dark_hz)
    if scene.ambient is not None:
        irradiance = spectral_irradiance(scene.ambient, photons.wavelength_m, photons.filter_m)
        power_w = irradiance / math.pi * photons.filter_m * photons.aperture_m2 * photons.field_of_view_sr
        rate_hz += reflectance * power_w * photons.efficiency / photons.photon_energy_j
    return rate_hz * 2 / SPEED_OF_LIGHT_M_S


def haze_per_pulse(first_hits: FirstHits, emitted: np.ndarray, bin_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Upper bounds of backscattered counts per pulse, in the window up to the return and in one bin, shapes (N,).

    From r to r + dr it sends beta Omega(r) exp(-2 alpha r) dr into an aperture, a disc of radius a seen under the solid
    angle Omega = 2 pi (1 - r / sqrt(r^2 + a^2)), with the integral 2 pi (r - sqrt(r^2 + a^2)); extinction within the
    window is ignored. Before the range 1 / (1 / f + sqrt(pixel / A)), f the range of the first hit, haze is blurred
    beyond the pixel, which catches pixel / (1 - r / f)^2 instead. For a fixed receiver see `_haze_beside_rays`.
    """
    photons, medium = first_hits.detector.photons, first_hits.scene.medium
    if medium is None:
        return np.zeros(len(first_hits)), np.zeros(len(first_hits))
    start, end = first_hits.window_m[:, 0], first_hits.window_m[:, 0] + first_hits.before_m
    light = emitted * photons.efficiency * medium.backscatter_per_m_sr
    light = light * np.exp(-2 * medium.extinction_per_m * start)
    if first_hits.scene.receiver is not None:
        whole, fullest = _haze_beside_rays(first_hits, end, bin_m)
        return light * whole, light * fullest
    focus = 1 / np.maximum(first_hits.hits.range_m, SQUARABLE)
    sharp = 1 / (focus + math.sqrt(photons.field_of_view_sr / photons.aperture_m2))
    sharp = np.clip(sharp, start, end)
    before = safe_divide(sharp - start, (1 - start * focus) * (1 - sharp * focus))
    squared = photons.aperture_m2 / math.pi
    near, far = np.sqrt(sharp**2 + squared), np.sqrt(end**2 + squared)
    # differences of roots without their cancellation
    behind = 2 * math.pi * (end - sharp) * (1 - (end + sharp) / (far + near))
    whole = light * (photons.field_of_view_sr * before + behind)
    return whole, np.minimum(2 * math.pi * light * bin_m * squared / (near * (near + sharp)), whole)


def _haze_beside_rays(first_hits: FirstHits, end_m: np.ndarray, bin_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Solid angle times length of the haze seen by a fixed receiver, up to half paths (N,) and in one bin, shapes (N,).

    It sees all of a ray that passes it at the distance h, c from the ray's start: at most the integral of
    A / (h^2 + (r - c)^2), A / h times the difference of arctan((r - c) / h), and no more than half of all around. Half
    a path grows by (1 + (r - c) / b) / 2 per range, b the way from there to the receiver: least where the ray starts.
    """
    rays, receiver = first_hits.rays, first_hits.scene.receiver
    aperture_m2 = first_hits.detector.photons.aperture_m2
    ends = [range_of_path(rays, receiver, path_m) for path_m in (first_hits.window_m[:, 0], end_m)]
    low, high = (np.nan_to_num(range_m, nan=0.0) for range_m in ends)
    offset = np.asarray(receiver.origin_m) - rays.origin_m
    along = np.einsum("nk,nk->n", offset, rays.direction)
    aside = np.linalg.norm(offset - along[:, None] * rays.direction, axis=1)
    # a ray through the receiver itself: so close that the limit of all around decides
    aside = np.maximum(aside, NEAREST_SHARE * (1 + np.abs(along)))
    seen = aperture_m2 / aside * (np.arctan((high - along) / aside) - np.arctan((low - along) / aside))
    length = np.maximum(high - low, 0.0)
    whole = np.clip(seen, 0.0, 2 * math.pi * length)
    nearest = np.hypot(aside, np.clip(along, low, np.maximum(low, high)) - along)
    in_bin = np.minimum(safe_divide(bin_m, (1 + (low - along) / np.hypot(aside, low - along)) / 2, np.inf), length)
    return whole, np.minimum(np.minimum(aperture_m2 / nearest**2, 2 * math.pi) * in_bin, whole)


# Steps per unit of the logarithm, 1 % each, to which levels of background are rounded.
LEVELS_PER_UNIT = 100
# Counts from here on are shown as whole numbers.
MANY = 100
# Error of the highest bin in units of (sigma^5 / (n b))^(1/4), see `Counts.error_m`.
PEAK_STRAY = 1.5


@dataclass(frozen=True, eq=False)
class Echo:
    """Expected echoes of N rays.

    Arguments:
        signal: Counts, shape (N,).
        sigma_m: Standard deviation of one photon's half path, shape (N,) [m].
        level: Counts per bin besides ambient and dark ones, shape (N,).
    """

    signal: np.ndarray
    sigma_m: np.ndarray
    level: np.ndarray | float = 0.0


@dataclass(frozen=True, eq=False)
class Counts:
    """Expected counts per frame of every ray, for a detector that counts photons.

    Arguments:
        first_hits: First hits of the rays.
    """

    first_hits: FirstHits

    @cached_property
    def pulses(self) -> np.ndarray:
        """Pulses of each ray in a frame, shape (N,)."""
        return self.first_hits.detector.photons.pulses(self.first_hits.sharing)

    @cached_property
    def _emitted(self) -> np.ndarray:
        """Emitted photons of each ray per pulse, shape (N,)."""
        detector = self.first_hits.detector
        return detector.photons.emitted(self.first_hits.sharing) * detector.light_of(self.first_hits.rays)

    @cached_property
    def _of_first_hit(self) -> np.ndarray:
        photons = self.first_hits.detector.photons
        per_gain = self._emitted * photons.aperture_m2 * photons.efficiency
        # limited before the product: a surface that touches the receiver has the largest gain there is
        return np.minimum(self.first_hits.gain, MOST_COUNTS / (per_gain * self.pulses)) * per_gain

    def leaked(self, sigma_m: np.ndarray, nearer_m: np.ndarray | float = 0.0) -> np.ndarray:
        """Counts per frame that a hit outside the gate spills into it in clear air, shape (N,).

        At most the part of a Gaussian beyond the nearer end of the window, which is `nearer_m` nearer [m].
        """
        share = scipy.special.ndtr((nearer_m - self.first_hits.gate_edge_m) / np.maximum(sigma_m, SQUARABLE))
        return np.where(self.first_hits.returned, 0.0, self._of_first_hit * self.pulses * share)

    def spilled(self, moved_m: np.ndarray) -> np.ndarray:
        """Probability that a pulse spills into a gate because its hit moves by (N,) [m], shape (N,)."""
        if self.first_hits.detector.photons is None:
            return np.zeros(len(self.first_hits))
        sigma_m = self.first_hits.sigma_m()
        return -np.expm1(np.minimum(self.leaked(sigma_m) - self.leaked(sigma_m, moved_m), 0.0))

    @cached_property
    def signal(self) -> np.ndarray:
        """Counts of a return per frame in clear air, 0 without one, shape (N,)."""
        return np.where(self.first_hits.returned, self._of_first_hit, 0.0) * self.pulses

    @property
    def typical(self) -> str:
        """Median of `in_air` over returns, as text."""
        returned = self.in_air[self.first_hits.returned]
        return count_text(float(np.median(returned))) if len(returned) else "no"

    @cached_property
    def in_air(self) -> np.ndarray:
        """Counts of a return per frame after extinction by the air, shape (N,)."""
        medium = self.first_hits.scene.medium
        if medium is None:
            return self.signal
        path_m = self.first_hits.window_m[:, 0] + self.first_hits.before_m
        return self.signal * np.exp(-2 * medium.extinction_per_m * path_m)

    @cached_property
    def background_per_metre(self) -> np.ndarray:
        """Ambient light and dark counts per pulse and metre, shape (N,)."""
        scene = self.first_hits.scene
        return ambient_per_metre(scene, self.first_hits.detector.photons, reflectances(scene, self.first_hits.hits))

    @cached_property
    def haze_per_pulse(self) -> tuple[np.ndarray, np.ndarray]:
        """Upper bounds of backscattered counts per pulse, in the window up to the return and in one bin, (N,)."""
        return haze_per_pulse(self.first_hits, self._emitted, self.bin_m)

    @cached_property
    def bin_m(self) -> float:
        """The width of a histogram's bins [m]."""
        return bin_width_m(self.first_hits.detector)

    @cached_property
    def bins(self) -> np.ndarray:
        """Number of bins in each window, shape (N,)."""
        return np.maximum(np.ceil(self.first_hits.width_m / self.bin_m), 1.0)

    @cached_property
    def per_bin(self) -> np.ndarray:
        """Ambient and dark counts per frame in a bin, or in the window if narrower, shape (N,)."""
        return self.background_per_metre * np.minimum(self.bin_m, self.first_hits.width_m) * self.pulses

    @cached_property
    def pulse_bins(self) -> int:
        """Full width at half maximum of a pulse in bins, an odd number."""
        return 2 * int(FWHM_PER_SIGMA * metres(self.first_hits.detector.timing_sigma_s) / (2 * self.bin_m)) + 1

    def needed(self, per_bin: np.ndarray) -> np.ndarray:
        """Detection threshold: fewest counts in a pulse's width that are reported, by background per bin, shapes (N,).

        Levels and numbers of bins are rounded up to one of `LEVELS_PER_UNIT` per factor e, so that few are computed.
        """
        with np.errstate(divide="ignore"):
            steps = [np.ceil(LEVELS_PER_UNIT * np.log(values)) for values in (per_bin * self.pulse_bins, self.bins)]
        level, bins = (np.exp(step / LEVELS_PER_UNIT) for step in steps)
        # pairs as complex numbers: the fastest for `unique`
        pairs, place = np.unique(level + 1j * bins, return_inverse=True)
        return needed_counts(pairs.real, pairs.imag, self.first_hits.detector.false_alarm)[place]

    def share_in_bins(self, count: int, sigma_m: np.ndarray) -> np.ndarray:
        """Share of an echo's photons in an odd number of bins, at most the share inside its gate, shape (N,)."""
        away = (self.first_hits.window_m - self.first_hits.path_m[:, None]).T / np.maximum(sigma_m, SQUARABLE)
        inside = np.where(self.first_hits.returned, scipy.special.ndtr(away[1]) - scipy.special.ndtr(away[0]), 1.0)
        # in the worst case the echo lies on an edge of the middle bin
        spread_m = math.sqrt(2) * np.maximum(sigma_m, SQUARABLE)
        ends = (scipy.special.erf((count + step) / 2 * self.bin_m / spread_m) for step in (-1, 1))
        return np.minimum(0.5 * sum(ends), inside)

    def missed(self, signal: np.ndarray, per_bin: np.ndarray | float, sigma_m: np.ndarray) -> np.ndarray:
        """Probability that the echo's bins hold fewer counts than the detection threshold, shape (N,).

        Arguments:
            signal: Counts of the echo, shape (N,).
            per_bin: Background counts in each bin, shape (N,).
            sigma_m: Standard deviation of one photon's half path, shape (N,) [m].
        """
        per_bin = np.broadcast_to(per_bin, signal.shape)
        expected = signal * self.share_in_bins(self.pulse_bins, sigma_m) + per_bin * self.pulse_bins
        return scipy.special.pdtr(self.needed(per_bin) - 1, expected)

    def more_missed(self, before: Echo, after: Echo) -> np.ndarray:
        """Increase of the probability that an echo is missed, with or without ambient light, the larger, (N,)."""
        changes = [
            self.missed(after.signal, level + after.level, after.sigma_m)
            - self.missed(before.signal, level + before.level, before.sigma_m)
            for level in (self.per_bin, np.zeros_like(self.per_bin))
        ]
        return np.maximum(np.maximum(*changes), 0.0)

    def mistaken(self, signal: np.ndarray, other: np.ndarray, per_bin: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
        """Upper bound of the probability that another bin holds more counts than the echo's, shape (N,).

        The union over all bins of P(X >= Y) <= exp(-(sqrt(E Y) - sqrt(E X))^2), Chernoff's bound for a difference of
        Poisson counts X of the fullest other bin (`other`) and Y of the echo's. The matched filter compares places as
        wide as a pulse, no worse than by their sums.
        """
        wide = self.pulse_bins if self.first_hits.detector.estimator == "matched" else 1
        expected = signal * self.share_in_bins(wide, sigma_m) + wide * per_bin
        lead = np.maximum(np.sqrt(expected) - np.sqrt(wide * other), 0.0)
        return np.minimum((self.bins - 1) * np.exp(-(lead**2)), 1.0)

    def missed_on_edges(self, signal: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
        """Increase of the probability that an echo is missed on the edge of a bin over its middle, shape (N,)."""
        middle = scipy.special.erf(self.pulse_bins * self.bin_m / (2 * math.sqrt(2) * np.maximum(sigma_m, SQUARABLE)))
        share = safe_divide(middle, self.share_in_bins(self.pulse_bins, sigma_m), 1.0)
        return self.more_missed(Echo(signal * share, sigma_m), Echo(signal, sigma_m))

    def slant_loss(self) -> np.ndarray:
        """Increase of the probability that an echo is missed because a slanted beam spreads it, shape (N,)."""
        timed_m = np.full(len(self.first_hits), metres(self.first_hits.detector.timing_sigma_s))
        return self.more_missed(Echo(self.in_air, timed_m), Echo(self.in_air, self.first_hits.sigma_m()))

    def false_return_probability(self, blind: Blindness, sigma_m: np.ndarray) -> np.ndarray:
        """Probability that background is taken for the echo, or background or haze for a missing one, shape (N,)."""
        any_haze = -np.expm1(-self.pulses * self.haze_per_pulse[0])
        any_count = -np.expm1(-self.per_bin * self.bins)
        wrong = self.mistaken(blind.left, self.per_bin, self.per_bin * blind.under, sigma_m)
        alarms = self.first_hits.detector.false_alarm + unevenness(self, blind)
        alone = np.minimum(np.minimum(alarms, any_count) + any_haze, 1.0)
        return np.where(self.first_hits.returned, np.minimum(wrong, any_count), alone)

    @cached_property
    def level_m2(self) -> np.ndarray:
        """Squared range shift of the matched filter between bins by another background level, shape (N,) [m^2]."""
        matched = self.first_hits.detector.estimator == "matched" and self.first_hits.detector.bin_m is not None
        return (self.first_hits.step_m / 2) ** 2 * matched

    def error_m(self, signal: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
        """Rms range error from n photons (N,) with standard deviation sigma (N,) [m], shape (N,) [m].

        The matched filter averages: sigma / sqrt(n). The highest bin is a mode: it lies up to where the expected counts
        n b f fall short of the peak's by about their own noise; with f a Gaussian, e^4 = (8 sqrt(2 pi)) sigma^5 / (n b)
        up to a factor (Chernoff 1964: a mode converges slower than a mean), and no further than the earliest photon,
        which the highest bin may hold where most bins hold one: sigma sqrt(1 + ln n).
        """
        count = np.maximum(signal, 1.0)
        averaged = sigma_m / np.sqrt(count)
        if self.first_hits.detector.estimator == "matched":
            return averaged
        mode = PEAK_STRAY * (sigma_m**5 / (count * self.bin_m)) ** 0.25
        return np.minimum(np.maximum(averaged, mode), sigma_m * np.sqrt(1 + np.log(count)))


def count_text(number: float) -> str:
    """An expected count as text."""
    return f"{number:,.0f}" if number >= MANY else f"{number:.2g}"


def needed_counts(per_bin: np.ndarray, bins: np.ndarray, false_alarm: float) -> np.ndarray:
    """Fewest counts k >= 1 that B bins of Poisson background reach with at most the false-alarm probability, (N,).

    The union over bins: B P(X >= k) <= false_alarm.
    """
    allowed = np.clip(false_alarm / bins, EPSILON, 1.0)
    least = np.maximum(per_bin, TINY)
    quiet = -np.expm1(-least) <= allowed
    with np.errstate(invalid="ignore"):
        needed = np.ceil(np.nan_to_num(scipy.special.pdtrik(1 - allowed, least))) + 1
    # the inverse is of a smooth curve through the steps: one step more where it falls short
    needed += 1 - scipy.special.pdtr(needed - 1, least) > allowed
    return np.where(quiet, 1.0, np.maximum(needed, 1.0))


def changed_share(signal: np.ndarray, fewer: np.ndarray) -> np.ndarray:
    """Share of an echo's photons that are lost, shape (N,)."""
    return np.clip(1 - safe_divide(fewer, signal, 1.0), 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Blindness:
    """Expected counts of N rays under dead time.

    Arguments:
        left: Counted photons of the echo, shape (N,).
        awake: Counted share of the background at the gate's start, shape (N,).
        under: Counted share of the background under the echo, shape (N,).
        level: Counted share of all background, shape (N,).
        early: Upper bound of the lead of an echo's first photon, in standard deviations, shape (N,).
        per_pulse: Photons per pulse that arrive, shape (N,).
    """

    left: np.ndarray
    awake: np.ndarray
    under: np.ndarray
    level: np.ndarray
    early: np.ndarray
    per_pulse: np.ndarray

    @classmethod
    def of(cls, counts: Counts, *, ambient: bool = True, haze: bool = True, air: bool = True) -> Blindness:
        """Dead time with or without ambient light and dark counts, backscatter (`haze`) and extinction (`air`)."""
        first_hits, photons = counts.first_hits, counts.first_hits.detector.photons
        # photons that spill into a gate from outside count as an echo
        arriving = (counts.in_air if air else counts.signal) + counts.leaked(first_hits.sigma_m())
        echo = safe_divide(arriving, counts.pulses)
        from_air = counts.haze_per_pulse[0] * haze
        per_metre = counts.background_per_metre * ambient
        whole = per_metre * first_hits.width_m + from_air + echo
        if photons.dead_s == 0:
            every = np.ones(len(first_hits))
            return cls(counts.in_air, every, every, every, np.zeros(len(first_hits)), whole)
        first = -np.expm1(-echo)
        covered = np.floor((photons.dead_s + first_hits.width_m / metres(1)) * photons.repetition_hz)
        awake = 1 / (1 + covered * -np.expm1(-whole))
        under = awake * np.exp(-(per_metre * first_hits.before_m + from_air))
        level = awake * safe_divide(-np.expm1(-whole), whole, 1.0)
        several = np.maximum(safe_divide(echo, first, 1.0), 1.0)
        early = np.minimum(np.sqrt(2 * np.log(several)), (several - 1) / math.sqrt(math.pi))
        return cls(counts.pulses * under * first, awake, under, level, early, whole)


def missed_behind(counts: Counts, blind: Blindness, sigma_m: np.ndarray) -> np.ndarray:
    """Probability that the counted echo is below the threshold of its gate's mean background, shape (N,)."""
    width = counts.pulse_bins
    expected = blind.left * counts.share_in_bins(width, sigma_m) + width * counts.per_bin * blind.under
    return scipy.special.pdtr(counts.needed(counts.per_bin * blind.level) - 1, expected)


def unevenness(counts: Counts, blind: Blindness) -> np.ndarray:
    """Increase of the false-alarm probability by the higher background at the gate's start, shape (N,).

    The union over all bins at the start's level, less that at the mean level.
    """
    needed = counts.needed(counts.per_bin * blind.level)
    mean, start = (counts.pulse_bins * counts.per_bin * share for share in (blind.level, blind.awake))
    return np.clip(
        counts.bins * (scipy.special.pdtrc(needed - 1, start) - scipy.special.pdtrc(needed - 1, mean)), 0.0, 1.0
    )


def variance_of_missing(counts: Counts, before: np.ndarray, left: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    """Variance of range by lost photons: the estimate's own if many are lost, a share of it if few are, (N,)."""
    gone = changed_share(before, left)
    error = counts.error_m(left, sigma_m) ** 2
    if counts.first_hits.detector.estimator == "matched":
        return error * gone
    return error * np.minimum(2 * np.sqrt(gone), 1.0)
