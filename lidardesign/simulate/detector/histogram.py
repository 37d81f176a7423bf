"""Histograms of photons over time: one per ray, as long as its window, side by side in one flat array."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import SLACK
from lidardesign.scene import SPEED_OF_LIGHT_M_S
from lidardesign.simulate.detector.detector import FWHM_PER_SIGMA, Detector, metres
from lidardesign.simulate.detector.light import Echoes

# Where a detector has no bins, or times are not rounded, they are this share of a photon's timing error wide: too
# fine to be seen, as their own error, a bin / sqrt(12), is 7 % of one photon's
BINS_PER_SIGMA = 4
# and never narrower than this, which is no error to anyone [m]
FINEST_BIN_M = 1e-5
# A histogram of more bins is a mistake: 1 km in millimetres
MOST_BINS = 1_000_000
# Lengths of windows that were meant to be whole numbers of bins may exceed them by rounding, relative


@dataclass(frozen=True, eq=False)
class Bins:
    """Where the bins of N rays lie.

    Arguments:
        windows_m: The half paths that each ray listens to, shape (N, 2) [m]; its first and last bin end there.
        first_m: Where its first bin would start if it were whole, at most its window's start, shape (N,) [m].
        width_m: Of a bin, as a one-way range [m].
        offset: Bins of ray i are offset[i] to offset[i + 1] of a flat array, shape (N + 1,).
    """

    windows_m: np.ndarray
    first_m: np.ndarray
    width_m: float
    offset: np.ndarray

    def __len__(self) -> int:
        return len(self.first_m)

    @classmethod
    def over(cls, windows_m: np.ndarray, first_m: np.ndarray, width_m: float) -> Bins:
        """Bins of a width that cover windows (N, 2), the first of each from first_m (N,) on.

        Raises:
            ConfigError: A window has too many bins.
        """
        span = (windows_m[:, 1] - first_m) / width_m
        number = np.where(windows_m[:, 1] > windows_m[:, 0], np.ceil(span * (1 - SLACK)), 0.0)
        most = number.max(initial=0)
        if most > MOST_BINS:
            raise ConfigError(
                f"a gate of {(windows_m[:, 1] - windows_m[:, 0]).max():g} m has {most:.3g} bins of {width_m:.3g} m",
                where="detector",
                allowed=f"at most {MOST_BINS:,}",
                hint="narrower gates or wider bins",
            )
        return cls(windows_m, first_m, width_m, np.concatenate([[0], np.cumsum(number.astype(np.int64))]))

    @property
    def heard_ends(self) -> np.ndarray:
        """The shares of each ray's first and last bin that lie in its window, shape (N, 2)."""
        before, after = ((self.windows_m[:, end] - self.first_m) / self.width_m for end in (0, 1))
        return np.clip(np.stack([1 - before, after - np.diff(self.offset) + 1], axis=1), 0.0, 1.0)

    def part(self, begin: int, end: int) -> Bins:
        """The bins of rays begin to end."""
        offset = self.offset[begin : end + 1] - self.offset[begin]
        return Bins(self.windows_m[begin:end], self.first_m[begin:end], self.width_m, offset)


def bins_of(windows_m: np.ndarray, echoes: Echoes, detector: Detector, quantised: bool) -> Bins:
    """The bins that a detector sorts photons into.

    Where times are rounded (`quantised`), the detector's own. Otherwise as wide, or where it has none a share of the
    timing error, and laid so that each ray's strongest echo lies in the middle of one.

    Raises:
        ConfigError: A window has too many bins.
    """
    own = detector.bin_m
    if quantised and own is not None:
        from lidardesign.simulate.effects.quantisation import bins_start

        return Bins.over(windows_m, bins_start(windows_m, detector), own)
    width_m = bin_width_m(detector)
    starts = windows_m[:, 0].copy()
    inside = np.flatnonzero((echoes.path_m >= starts[echoes.ray]) & (echoes.path_m < windows_m[echoes.ray, 1]))
    # ascending in gain: of several assignments to one ray the last, strongest one stays
    strongest = inside[np.argsort(echoes.gain[inside], kind="stable")]
    middle = starts.copy()
    middle[echoes.ray[strongest]] = echoes.path_m[strongest] - width_m / 2
    bins_before = np.ceil((middle - starts) / width_m)
    return Bins.over(windows_m, np.minimum(middle - bins_before * width_m, starts), width_m)


def check_windows(windows_m: np.ndarray, detector: Detector) -> None:
    """Refuse windows (N, 2) [m] that a detector's histogram does not cover.

    Raises:
        ConfigError: A window starts or ends outside the histogram, is longer than it, or longer than the light of one
            pulse can travel before the next.
    """
    if detector.bins is None and detector.photons is None:
        return
    wide = windows_m[windows_m[:, 1] > windows_m[:, 0]]
    if not len(wide):
        return
    where = f"detector {detector.name}"
    if detector.bins is not None and detector.bin_m is not None:
        reach = detector.bins * detector.bin_m
        what = f"{detector.bins} bins of {1e12 * detector.bin_s:g} ps, {reach:.4g} m"
        length = (wide[:, 1] - wide[:, 0]).max()
        if detector.histogram_start == "gate" and length > reach * (1 + SLACK):
            raise ConfigError(
                f"a gate of {length:.4g} m is longer than the histogram", where=where, allowed=what, hint=_NARROWER
            )
        if detector.histogram_start == "pulse" and wide[:, 1].max() > reach * (1 + SLACK):
            low, high = wide[np.argmax(wide[:, 1])]
            inside = "starts outside" if low >= reach else "ends outside"
            raise ConfigError(
                f"a gate from {low:.4g} to {high:.4g} m {inside} the histogram, which starts with the pulse",
                where=where,
                allowed=what,
                hint=_NARROWER,
            )
    if detector.photons is not None:
        reach = SPEED_OF_LIGHT_M_S / (2 * detector.photons.repetition_hz)
        if wide[:, 1].max() > reach * (1 + SLACK):
            raise ConfigError(
                f"a gate ends at {wide[:, 1].max():.4g} m, where light of the next pulse is on its way",
                where=where,
                allowed=f"at most {reach:.4g} m at {detector.photons.repetition_hz:g} pulses per second",
                hint=_NARROWER,
            )


_NARROWER = "narrower gates, or a detector file with a longer histogram and a lower repetition rate"


def bin_width_m(detector: Detector) -> float:
    """A detector's bins, or where it has none the finer ones that its photons are sorted into [m]."""
    return detector.bin_m or max(metres(detector.timing_sigma_s) / BINS_PER_SIGMA, FINEST_BIN_M)


def resolution_m(detector: Detector) -> float:
    """How far apart two echoes must be to be told apart: a bin, or the pulse's full width at half maximum [m]."""
    return max(detector.bin_m or 0.0, metres(FWHM_PER_SIGMA * detector.pulse_sigma_s))
