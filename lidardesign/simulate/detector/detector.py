"""Detectors: what a receiver and its laser do to light, from presets or a YAML file with units in its keys.

A detector without photons (`ideal`) reports exact first hits. One with photons says how much light is sent, how much
of it is caught, and how its arrival is timed. Emitted energy is shared among the rays of a frame: a scanned emitter
gives each ray its share of the pulses, a flood gives each its share of every pulse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from lidardesign.scene import SPEED_OF_LIGHT_M_S

PLANCK_J_S = 6.62607015e-34
# Full width at half maximum over standard deviation of a Gaussian.
FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))

Emission = Literal["scanned", "flood"]
Estimator = Literal["peak", "matched"]
HistogramStart = Literal["gate", "pulse"]
Correction = Literal["none", "coates"]


@dataclass(frozen=True)
class Photons:
    """The light budget of a detector that counts photons.

    Arguments:
        wavelength_m: Of the laser [m].
        pulse_energy_j: One pulse of the emitter, all rays that share it together [J].
        pulses_per_frame: Pulses in a frame, all rays together.
        emission: Whether rays share the pulses in time (`scanned`) or each pulse in energy (`flood`).
        repetition_hz: Pulses per second, which says how long a dead time blinds it [Hz].
        aperture_m2: Area of the receiving aperture [m^2].
        field_of_view_sr: Solid angle that one ray's pixel sees ambient light from [sr].
        efficiency: Share of photons at the aperture that are counted: optics, fill factor and detection together.
        filter_m: Width of the optical filter [m].
        dark_hz: Counts per second in darkness [Hz].
        dead_s: How long it is blind after a count [s].
    """

    wavelength_m: float
    pulse_energy_j: float
    pulses_per_frame: float
    emission: Emission
    repetition_hz: float
    aperture_m2: float
    field_of_view_sr: float
    efficiency: float
    filter_m: float
    dark_hz: float
    dead_s: float

    @property
    def photon_energy_j(self) -> float:
        """h c / wavelength [J]."""
        return PLANCK_J_S * SPEED_OF_LIGHT_M_S / self.wavelength_m

    def pulses(self, rays: int) -> float:
        """Pulses that each of so many rays gets in a frame."""
        return self.pulses_per_frame / (max(rays, 1) if self.emission == "scanned" else 1)

    def emitted(self, rays: int) -> float:
        """Photons of one pulse that each of so many rays sends."""
        shared = self.pulse_energy_j / (max(rays, 1) if self.emission == "flood" else 1)
        return shared / self.photon_energy_j


@dataclass(frozen=True)
class Detector:
    """How returns are measured.

    Arguments:
        name: For people.
        pulse_sigma_s: Standard deviation of the laser pulse, taken as Gaussian [s].
        jitter_sigma_s: Standard deviation of the timing of one photon, besides [s].
        bin_s: Width of a histogram's bins; None: times are not rounded [s].
        divergence_rad: Full angle of a ray's beam, in which its light is spread evenly [rad]; 0: a line.
        footprint_rays: Sub-rays that a beam is split into.
        photons: The light budget; None: any light at all is enough, and none is mistaken for it.
        estimator: The range from the histogram: its highest bin, or the log-matched filter with the pulse.
        false_alarm: Probability that a gate full of background light alone is taken for a return.
        bins: How many bins a histogram has; None: as many as a gate needs.
        histogram_start: Where its first bin starts: with the gate, or with the pulse, at range 0.
        correction: Whether it reckons with its own dead time where it judges a histogram (`coates`).
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
    histogram_start: HistogramStart = "gate"
    correction: Correction = "none"

    @property
    def timing_sigma_s(self) -> float:
        """Standard deviation of when one photon is counted: pulse and jitter together [s]."""
        return math.hypot(self.pulse_sigma_s, self.jitter_sigma_s)

    @property
    def bin_m(self) -> float | None:
        """The one-way range of a bin [m]."""
        return None if self.bin_s is None else metres(self.bin_s)


IDEAL = Detector("ideal")


def metres(seconds: float) -> float:
    """The one-way range that light travels forth and back in a time: c t / 2."""
    return SPEED_OF_LIGHT_M_S * seconds / 2
