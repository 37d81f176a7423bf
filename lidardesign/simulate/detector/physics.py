"""Detectors: laser, receiver, timing and histogram bins, and the names of the optional effects.

A detector without photons (`ideal`) reports exact first hits. One with photons has a light budget: emitted energy,
collected share and timing. Every sensor has an emitter of its own, whose energy its rays share in a frame: a scanned
emitter gives each ray its share of the pulses, a flood gives each its share of every pulse.

Histograms of photons over time are one per ray, as long as its window, side by side in one flat array.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import SLACK
from lidardesign.run.validation import suggest
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S, Scene
from lidardesign.simulate.detector.light import Echoes

PLANCK_J_S = 6.62607015e-34
# Upper limit of counts, still exact in float64.
MOST_COUNTS = 2.0**40
# Full width at half maximum over standard deviation of a Gaussian.
FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))

Estimator = Literal["peak", "matched"]


@dataclass(frozen=True)
class Photons:
    """The light budget of a detector that counts photons.

    Arguments:
        wavelength_m: Wavelength of the laser [m].
        pulse_energy_j: Energy of one pulse of an emitter, over all rays that share it [J].
        pulses_per_frame: Pulses of an emitter in a frame, over all rays that share it.
        emission: Whether rays share the pulses in time (`scanned`) or each pulse in energy (`flood`).
        repetition_hz: Pulse repetition rate [Hz].
        aperture_m2: Area of the receiving aperture [m^2].
        field_of_view_sr: Solid angle that one ray's pixel sees ambient light from [sr].
        efficiency: Share of photons at the aperture that are counted: optics, fill factor and detection together.
        filter_m: Width of the optical filter [m].
        dark_hz: Counts per second in darkness [Hz].
        dead_s: Dead time after a count [s].
    """

    wavelength_m: float
    pulse_energy_j: float
    pulses_per_frame: float
    emission: Literal["scanned", "flood"]
    repetition_hz: float
    aperture_m2: float
    field_of_view_sr: float
    efficiency: float
    filter_m: float
    dark_hz: float
    dead_s: float

    @property
    def photon_energy_j(self) -> float:
        """Energy of a photon, h c / wavelength [J]."""
        return PLANCK_J_S * SPEED_OF_LIGHT_M_S / self.wavelength_m

    def pulses(self, sharing: np.ndarray) -> np.ndarray:
        """Pulses per ray and frame where so many rays share an emitter, shape (N,) for (N,)."""
        return self.pulses_per_frame / np.where(self.emission == "scanned", np.maximum(sharing, 1), 1)

    def emitted(self, sharing: np.ndarray) -> np.ndarray:
        """Emitted photons per ray and pulse where so many rays share an emitter, shape (N,) for (N,)."""
        return (
            self.pulse_energy_j / np.where(self.emission == "flood", np.maximum(sharing, 1), 1) / self.photon_energy_j
        )


@dataclass(frozen=True)
class Detector:
    """Parameters of a detector.

    Arguments:
        name: Name in reports.
        pulse_sigma_s: Standard deviation of the laser pulse, taken as Gaussian [s].
        jitter_sigma_s: Standard deviation of the timing of one photon besides the pulse [s].
        bin_s: Width of a histogram's bins; None: times are not rounded [s].
        divergence_rad: Full angle of a ray's beam, in which its light is spread evenly [rad]; 0: a line.
        footprint_rays: Sub-rays that a beam is split into.
        photons: The light budget; None: any amount of light is detected, without false alarms.
        estimator: The range from the histogram: its highest bin, or the log-matched filter with the pulse.
        false_alarm: Probability that a gate full of background light alone is taken for a return.
        bins: Number of bins of a histogram; None: as many as a gate needs.
        histogram_start: Start of its first bin: with the gate, or with the pulse, at range 0.
        correction: Correction for dead time where returns are detected (`coates`).
        emitters: One for every sensor, or a single one that is shared by all rays of a list.
    """

    name: str
    pulse_sigma_s: float = 0.0
    jitter_sigma_s: float = 0.0
    bin_s: float | None = None
    divergence_rad: float = 0.0
    footprint_rays: int = 1
    photons: Photons | None = field(default=None)
    estimator: Estimator = "peak"
    false_alarm: float = 0.01
    bins: int | None = None
    histogram_start: Literal["gate", "pulse"] = "gate"
    correction: Literal["none", "coates"] = "none"
    emitters: Literal["sensor", "shared"] = "sensor"

    def sharing(self, rays: Rays) -> np.ndarray:
        """Number of rays that share each ray's emitter, shape (N,)."""
        if self.emitters == "shared":
            return np.full(len(rays), len(rays))
        _, place, count = np.unique(rays.sensor, return_inverse=True, return_counts=True)
        return count[place]

    def light_of(self, rays: Rays) -> np.ndarray | float:
        """Light of each ray's emitter as a multiple of `photons`, shape (N,) or one for all."""
        return 1.0 if self.emitters == "shared" or rays.light is None else rays.light

    @property
    def is_flood(self) -> bool:
        """True if each pulse lights all rays of an emitter at once."""
        return self.photons is not None and self.photons.emission == "flood"

    @property
    def timing_sigma_s(self) -> float:
        """Standard deviation of a photon's time by pulse and jitter together [s]."""
        return math.hypot(self.pulse_sigma_s, self.jitter_sigma_s)

    @property
    def bin_m(self) -> float | None:
        """The one-way range of a bin [m]."""
        return None if self.bin_s is None else metres(self.bin_s)


IDEAL = Detector("ideal")


def metres(seconds: float) -> float:
    """One-way range of a round-trip time, c t / 2 [m]."""
    return SPEED_OF_LIGHT_M_S * seconds / 2


# Bins per timing error of a photon where a detector has no bins or times are not rounded: their own error,
# a bin / sqrt(12), is 7 % of one photon's
BINS_PER_SIGMA = 4
# and at least this wide [m]
FINEST_BIN_M = 1e-5
# A histogram of more bins is refused: 1 km in millimetres
MOST_BINS = 1_000_000
# Bins that are filled at once: 32 MB of counts, whatever the number of rays
BINS_AT_ONCE = 1 << 22
# Rays that are counted at once: of the photons that are followed one by one, some 100 MB at most
RAYS_AT_ONCE = 4096
_NARROWER = "narrower gates, or a detector file with a longer histogram and a lower repetition rate"


@dataclass(frozen=True, eq=False)
class Bins:
    """Histogram bins of N rays.

    Arguments:
        windows_m: Each ray's gate in half paths, shape (N, 2) [m]; its first and last bin end there.
        first_m: Start of its first bin, if that were whole, at most its window's start, shape (N,) [m].
        width_m: Width of a bin, as a one-way range [m].
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
    def end_shares(self) -> np.ndarray:
        """Shares of each ray's first and last bin in its window, shape (N, 2)."""
        before, after = ((self.windows_m[:, end] - self.first_m) / self.width_m for end in (0, 1))
        return np.clip(np.stack([1 - before, after - np.diff(self.offset) + 1], axis=1), 0.0, 1.0)

    def part(self, begin: int, end: int) -> Bins:
        """The bins of rays begin to end."""
        offset = self.offset[begin : end + 1] - self.offset[begin]
        return Bins(self.windows_m[begin:end], self.first_m[begin:end], self.width_m, offset)


def chunks(offset: np.ndarray) -> Iterator[tuple[int, int]]:
    """Begin and end of chunks of rays whose bins, offset[i] to offset[i + 1], fit into memory."""
    begin = 0
    while begin < len(offset) - 1:
        end = int(np.searchsorted(offset, offset[begin] + BINS_AT_ONCE, side="right")) - 1
        end = min(max(end, begin + 1), begin + RAYS_AT_ONCE)
        yield begin, end
        begin = end


def bins_of(windows_m: np.ndarray, echoes: Echoes, detector: Detector, quantised: bool) -> Bins:
    """The bins that a detector sorts photons into.

    Where times are rounded (`quantised`), the detector's own. Otherwise as wide, or where it has none a share of the
    timing error, and laid so that each ray's strongest echo lies in the middle of one.

    Raises:
        ConfigError: A window has too many bins.
    """
    own = detector.bin_m
    if quantised and own is not None:
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
            raise ConfigError(
                f"a gate from {low:.4g} to {high:.4g} m {'starts' if low >= reach else 'ends'} outside the histogram, "
                "which starts with the pulse",
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


def bin_width_m(detector: Detector) -> float:
    """Width of a detector's bins, or of the finer ones that are used where it has none [m]."""
    return detector.bin_m or max(metres(detector.timing_sigma_s) / BINS_PER_SIGMA, FINEST_BIN_M)


def resolution_m(detector: Detector) -> float:
    """Smallest separation of two resolved echoes: a bin, or the pulse's full width at half maximum if larger [m]."""
    return max(detector.bin_m or 0.0, metres(FWHM_PER_SIGMA * detector.pulse_sigma_s))


def bins_start(windows_m: np.ndarray, detector: Detector) -> np.ndarray:
    """Start of the bin that contains the start of each window (N, 2) [m], shape (N,) [m]."""
    starts = windows_m[:, 0]
    return starts if detector.histogram_start == "gate" else np.floor(starts / detector.bin_m) * detector.bin_m


def ends_of_bins(path_m: np.ndarray, windows_m: np.ndarray, detector: Detector) -> tuple[np.ndarray, np.ndarray]:
    """Start and end of the bins of half paths (N,), cut to windows (N, 2) [m], shapes (N,) [m]."""
    first = bins_start(windows_m, detector)
    low = first + np.floor((path_m - first) / detector.bin_m) * detector.bin_m
    return np.maximum(low, windows_m[:, 0]), np.minimum(low + detector.bin_m, windows_m[:, 1])


# In the order in which light meets them; each is a module of `simulate.effects`.
EFFECTS = {
    "footprint": "beams have a width: mixed pixels, several returns",
    "motion": "things move within a frame",
    "specular": "mirrors and glass send light elsewhere",
    "multipath": "light comes back by other surfaces",
    "shadowing": "the receiver may not see what the emitter lights",
    "atmosphere": "air weakens light and scatters some of it back",
    "photon_noise": "light comes in photons",
    "jitter": "photons are timed with an error",
    "ambient": "ambient light and dark counts",
    "pile_up": "a detector is blind after a count",
    "quantisation": "times are rounded to bins",
}
# Effects that require counting photons; without them a detector reports the strongest echo.
COUNTED = frozenset({"photon_noise", "jitter", "ambient", "pile_up", "quantisation", "atmosphere"})


@dataclass(frozen=True)
class Physics:
    """A detector and the effects that are simulated.

    Arguments:
        detector: The detector.
        effects: Names out of `EFFECTS`.
        seed: Seed of the random numbers of every effect.
        repeat: Index of the measurement: repeated measurements have independent random numbers.

    Raises:
        ConfigError: An unknown effect; all are listed.
    """

    detector: Detector = IDEAL
    effects: frozenset[str] = frozenset()
    seed: int = 0
    repeat: int = 0

    def __post_init__(self) -> None:
        check_effects(self.effects)

    def stream(self, effect: str, scene: Scene, frame: int) -> int:
        """Key of an effect's random numbers in a frame of a scene, independent of other effects."""
        label = "\0".join(map(str, (self.seed, effect, scene.name, frame, *([self.repeat] if self.repeat else []))))
        return int.from_bytes(hashlib.sha256(label.encode()).digest()[:8], "little")


def check_effects(names: Iterable[str]) -> None:
    """Refuse names that are no effects.

    Raises:
        ConfigError: An unknown effect; all are listed.
    """
    for name in sorted(set(names) - EFFECTS.keys()):
        raise ConfigError(
            f"unknown effect {name!r}", where="effects", allowed=", ".join(EFFECTS), hint=suggest(name.lower(), EFFECTS)
        )
