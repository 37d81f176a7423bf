"""Detector files: units in keys, strict values, presets with sources, light that is shared and never made."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from lidardesign.errors import ConfigError
from lidardesign.simulate.detector.files import CHOICES, FOLDER, QUANTITIES, detector_names, load_detector
from lidardesign.simulate.detector.physics import IDEAL, metres

ROOT = Path(__file__).parents[2]
LIGHT = """\
emission: scanned
wavelength_nm: 670
energy_fj: 10
pulses_per_frame: 1000
repetition_mhz: 10
aperture_mm2: 20
field_of_view_usr: 10
efficiency: 0.1
filter_width_nm: 10
dark_rate_hz: 100
dead_time_ns: 77
"""


def load(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return load_detector(path)


@pytest.mark.parametrize("name", detector_names())
def test_presets_load_bear_their_own_name_and_say_why_beside_every_number(name):
    assert load_detector(name).name == name
    for line in (FOLDER / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
        if re.match(r"\w+: *[0-9.]+", line) and not line.startswith("false_alarm"):
            assert "#" in line, line


def test_widths_at_half_maximum_become_standard_deviations(tmp_path):
    detector = load(tmp_path, "pulse_fwhm_ps: 100\njitter_fwhm_ns: 0.2\n")
    assert detector.pulse_sigma_s == pytest.approx(100e-12 / 2.3548200450309493)
    assert detector.jitter_sigma_s == pytest.approx(200e-12 / 2.3548200450309493)


def test_a_quantity_is_the_same_in_each_of_its_units(tmp_path):
    assert load(tmp_path, "bin_ps: 250").bin_s == pytest.approx(load(tmp_path, "bin_ns: 0.25").bin_s, rel=1e-15)
    assert load(tmp_path, "bin_ps: 250").bin_m == pytest.approx(metres(250e-12))


def test_a_file_without_a_name_is_called_as_its_file_and_one_of_a_name_alone_is_ideal(tmp_path):
    assert load(tmp_path, "bin_ps: 8").name == "mine"
    assert load(tmp_path, "name: ideal") == IDEAL == load_detector("ideal")


@pytest.mark.parametrize("rays", [1, 7, 576])
@pytest.mark.parametrize("emission", ["scanned", "flood"])
def test_rays_share_all_light_and_no_more(tmp_path, emission, rays):
    photons = load(tmp_path, LIGHT.replace("scanned", emission)).photons
    sent = rays * photons.pulses(rays) * photons.emitted(rays) * photons.photon_energy_j
    assert sent == pytest.approx(1000 * 10e-15, rel=1e-12)


BAD = {
    "wrong unit": ("bin_mm: 8", ["mine.yaml:1:1", "unknown key 'bin_mm'", "bin_ps, bin_ns"]),
    "a unit too many": ("bin_ps: 8\nbins_ps: 3", ["mine.yaml:2:1", "unknown key 'bins_ps'", "allowed: bins"]),
    "unknown": ("pulse_fwmh_ps: 8", ["unknown key 'pulse_fwmh_ps'", "did you mean 'pulse_fwhm_ps'"]),
    "twice": ("bin_ps: 8\nbin_ns: 8", ["mine.yaml:2:1", "same quantity"]),
    "negative": ("name: a\nbin_ps: -8", ["mine.yaml:2:9", "bin_ps: found -8", "above 0"]),
    "too large to be one": ("bin_ps: 1e400", ["mine.yaml"]),
    "half a bin": ("bin_ps: 8\nbins: 1.5", ["1.5", "a whole number"]),
    "a list": ("- 1", ["list"]),
    "an unknown estimator": ("estimator: mean", ["'mean'", "peak, matched"]),
    "a name that is a number": ("name: 3", ["name: found 3", "text"]),
    "certain false alarms": ("false_alarm: 1", ["false_alarm", "0.5"]),
    "sub-rays of a line": ("footprint_rays: 7", ["mine.yaml:1:17", "divergence 0"]),
    "bins without a width": ("bins: 128", ["bin_ps"]),
    "some light": ("wavelength_nm: 670", ["does not give energy_fj", "dead_time_ps, emission"]),
    "more than all photons": (LIGHT.replace("0.1", "1.1"), ["efficiency: found 1.1", "to 1"]),
    "a wavelength in micrometres": (LIGHT.replace("670", "0.67"), ["wavelength_nm: found 0.67", "280"]),
    "a wide filter": (LIGHT.replace("filter_width_nm: 10", "filter_width_nm: 670"), ["filter_width_nm", "670 nm"]),
    "a histogram longer than a period": (LIGHT + "bin_ns: 1\nbins: 128", ["100 ns between pulses", "at most 100"]),
    "not YAML": ("bin_ps: [", ["mine.yaml", "YAML"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_say_where_what_and_what_is_allowed(tmp_path, case):
    text, fragments = BAD[case]
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    for fragment in fragments:
        assert fragment in str(caught.value), str(caught.value)


def test_an_unknown_detector_lists_those_that_there_are(tmp_path):
    with pytest.raises(ConfigError) as caught:
        load_detector("single-foton")
    assert "single-photon" in str(caught.value)
    assert "consumer-8x8, ideal, single-photon" in str(caught.value)
    with pytest.raises(ConfigError, match="no detector"):
        load_detector(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_detector(tmp_path)


def test_every_key_is_in_the_documentation():
    text = (ROOT / "docs" / "detectors.md").read_text(encoding="utf-8")
    keys = [key for name, quantity in QUANTITIES.items() for key in quantity.keys(name)[:1]]
    for key in [*keys, *CHOICES, "name", *detector_names()]:
        assert f"`{key}`" in text, key
    for name, options in CHOICES.items():
        for option in options:
            assert f"`{option}`" in text, (name, option)


def test_the_documentation_s_examples_are_detectors_with_and_without_photons(tmp_path):
    text = (ROOT / "docs" / "detectors.md").read_text(encoding="utf-8")
    found = [load(tmp_path, block) for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)]
    assert all(detector.bin_s for detector in found)
    assert {detector.photons is None for detector in found} == {True, False}


STRANGE = ["-1", "0", "1e308", "-1e308", "1e-308", "x", "''", "~", "true", "[]", "{}", ".nan", "-.inf", "1:30", "0x10"]
NEVER = set(STRANGE) - {"0", "1e-308"}


@pytest.mark.parametrize("name", QUANTITIES)
def test_strange_values_of_any_quantity_are_refused_or_possible(tmp_path, name):
    others = [line for line in LIGHT.splitlines() if not re.match(rf"{name}(_[a-z0-9]+)?:", line)]
    for key in QUANTITIES[name].keys(name):
        for value in STRANGE:
            try:
                detector = load(tmp_path, "\n".join([*others, f"{key}: {value}"]))
            except ConfigError as error:
                complaint = str(error)
            else:
                complaint = ""
                numbers = [*vars(detector).values(), *vars(detector.photons).values()]
                assert all(math.isfinite(number) for number in numbers if isinstance(number, float))
            # the last line's value, or what is missing where it is all of a quantity
            assert not complaint or "mine.yaml" in complaint
            assert bool(complaint) or value not in NEVER, (key, value)
