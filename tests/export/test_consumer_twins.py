"""What simulators that are not installed here make of the numbers written for them, at the ends of their ranges.

Each twin was written from the published source of its program, as of 2026-11-22, and reads nothing but the files.
"""

import xml.etree.ElementTree as ElementTree

import numpy as np
from support.tables import each_row

from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.export.registry import EXPORTERS
from lidardesign.geometry.rays import Rays

ONE = DesignSpec("one", (Sensor("one", 1.0, np.zeros(3), np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.1, 0.1, 1.0, 0.1),))


def rays_with_gates(gates_m):
    """Rays forward from the origin, each with a gate."""
    count = len(gates_m)
    return Rays(np.zeros((count, 3)), np.tile([1.0, 0, 0], (count, 1)), gates_m, np.zeros(count), np.zeros(count))


# HELIOS++ -----------------------------------------------------------------------------------------------------------

# src/scanner/ScanningDevice.cpp, detector/FullWaveformPulseRunnable.cpp, maths/model/*EnergyModel.cpp, WaveMaths.cpp;
# what a scanner file leaves out is of assetloading/XmlAssetsLoader.cpp
C_M_NS = 0.299792458
POWER_W, APERTURE_M, EFFICIENCY, VISIBILITY_KM, WAVELENGTH_M = 4.0, 0.15, 0.99, 23.0, 1064e-9
# how a version spreads the power over the beam, and the least intensity [nW] that is an echo
HELIOS = [(beam, least) for beam in ("focused", "focused, radii in rad", "Gaussian") for least in (1e-3, 1e-4)]


def helios_intensity(beam, divergence_rad, start_m, range_m, brightness):
    """The received power [nW] of a surface of so much reflectance times cosine."""
    if beam == "Gaussian":
        share = 1 - np.exp(-2.0)
    else:
        waist_m = WAVELENGTH_M / (np.pi * divergence_rad)
        with np.errstate(divide="ignore"):
            defocus = 1 - np.divide(range_m, start_m)
        width_m = waist_m * np.hypot(defocus, range_m * WAVELENGTH_M / (np.pi * waist_m**2))
        radius_m = divergence_rad / 2 * (range_m if beam == "focused" else 1.0)
        share = -np.expm1(-2 * (radius_m / width_m) ** 2)
    air = np.exp(-2 * range_m * 3.91 / VISIBILITY_KM * (WAVELENGTH_M * 1e9 / 0.55) ** -1.3)
    return 1e9 * POWER_W * share * APERTURE_M**2 * EFFICIENCY * air * np.pi / 4 * brightness / range_m**2


def helios_range_m(scanner, channel, range_m, version, brightness, start_m=None):
    """The range of a point that HELIOS++ writes for a surface in front of a channel; None: it writes none."""
    beam, least = version
    waveform = scanner.find("FWFSettings")
    pulse, bin_ns = float(scanner.get("pulseLength_ns")), float(waveform.get("binSize_ns"))
    start = float(channel.get("rangeMin_m")) if start_m is None else start_m
    if range_m < start or range_m > float(channel.get("rangeMax_m")):
        return None
    intensity = helios_intensity(beam, float(scanner.get("beamDivergence_rad")), start, range_m, brightness)
    time = 7 / pulse * bin_ns * np.arange(int(pulse / bin_ns))
    wave = time**2 * np.exp(-time)
    peak = int(wave.argmax())
    first_ns = range_m / C_M_NS - peak * bin_ns
    if start / C_M_NS > first_ns:
        return None
    last_ns = range_m / C_M_NS + pulse - peak * bin_ns
    # older versions count the bins of the difference, newer ones have one more
    sizes = [int((last_ns - first_ns) / bin_ns), int(np.ceil(last_ns / bin_ns + 1) - np.ceil(first_ns / bin_ns))]
    assert min(sizes) >= len(wave), "a version writes past the end of the waveform"
    whole = np.zeros(sizes[beam == "Gaussian"])
    whole[: len(wave)] = intensity * wave
    reach = int(float(waveform.get("winSize_ns")) / bin_ns)
    for at, value in enumerate(whole):
        before, after = whole[max(0, at - reach) + 1 : at], whole[at + 1 : at + reach]
        around = np.concatenate([before, after])
        if value >= least and (around >= least).all() and (around < value).all():
            return C_M_NS * (at * bin_ns + first_ns)
    return None


def helios_scanner(folder, gates_m):
    notes = EXPORTERS["helios"].write(ONE, rays_with_gates(gates_m), folder)
    scanner = ElementTree.parse(folder / "scanners.xml").find("scanner")
    return scanner, list(scanner.iter("channel")), notes


@each_row("version", HELIOS)
def test_helios_returns_what_lies_inside_a_gate_wherever_that_starts(tmp_path, version):
    gates_m = np.array([[0, 0.0005], [0, 25], [1e-6, 25], [0.001, 25], [0.02, 3], [0.4, 0.5], [5, 25], [24.9, 25]])
    scanner, channels, notes = helios_scanner(tmp_path / "out", gates_m)
    [lost] = [note for note in notes if "behind a gate's start" in note]
    lost_m = float(lost.split(" mm")[0].split()[-1]) / 1000 + 1e-4
    for channel, (start, end) in zip(channels, gates_m, strict=True):
        nearest = max(start, 0.001) + lost_m
        for range_m in nearest + np.array([0, 0.01, 0.5, 1]) * (end - nearest) if end > nearest else []:
            # a tenth of the light, at 60 degrees
            found = helios_range_m(scanner, channel, range_m, version, 0.05)
            assert found is not None, (start, range_m)
            assert abs(found - range_m) < 1e-9
        for range_m in (0.9 * start, end + 0.002):
            assert helios_range_m(scanner, channel, range_m, version, 1.0) is None
    assert any("3 of 8 rays start below 0.001 m" in note for note in notes)


@each_row("version", HELIOS)
def test_helios_would_send_no_power_through_a_gate_from_0(tmp_path, version):
    scanner, [channel], _ = helios_scanner(tmp_path / "out", np.array([[0.0, 25]]))
    found = helios_range_m(scanner, channel, 1.0, version, 1.0, start_m=0.0)
    assert (found is None) == (version[0] != "Gaussian")
