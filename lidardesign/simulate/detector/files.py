"""Detector files: YAML with units in its keys, checked value by value.

A quantity may be given in any of its units (`bin_ps` or `bin_ns`), once. The keys of the light budget come together
or not at all: without them any amount of light is detected, and no photon is counted.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidardesign.errors import ConfigError, page
from lidardesign.run.validation import is_name, suggest
from lidardesign.run.yaml import Document, load_yaml
from lidardesign.simulate.detector.physics import FWHM_PER_SIGMA, MOST_BINS, Detector, Photons

FOLDER = Path(__file__).parent / "presets"
TIMES = {"ps": 1e-12, "ns": 1e-9}
FREQUENCIES = {"hz": 1.0, "khz": 1e3, "mhz": 1e6}
ENERGIES = {"fj": 1e-15, "pj": 1e-12, "nj": 1e-9, "uj": 1e-6, "mj": 1e-3}
LENGTHS = {"nm": 1e-9, "um": 1e-6}
MOST_FOOTPRINT_RAYS = 1024


@dataclass(frozen=True)
class Quantity:
    """A number with a unit.

    Arguments:
        units: SI units per unit, by the suffix of its key; a dimensionless key has no suffix.
        low, high: Allowed interval, in SI units.
        above: Whether `low` itself is excluded.
        whole: Whether it is a whole number.
        default: Default value in SI units; None: none.
    """

    units: Mapping[str, float]
    low: float = 0.0
    high: float = math.inf
    above: bool = True
    whole: bool = False
    default: float | None = None

    def keys(self, name: str) -> list[str]:
        """Keys of a quantity in files, one per unit."""
        return [f"{name}_{unit}" if unit else name for unit in self.units]


ONE = {"": 1.0}
# The limits are wider than any part's, and keep typing errors and overflows out.
TIMING = {
    "pulse_fwhm": Quantity(TIMES, high=1e-6, above=False, default=0.0),
    "jitter_fwhm": Quantity(TIMES, high=1e-6, above=False, default=0.0),
    "bin": Quantity(TIMES, high=1e-6),
    "bins": Quantity(ONE, low=1, high=MOST_BINS, above=False, whole=True),
    "divergence": Quantity({"mrad": 1e-3, "deg": math.pi / 180}, high=math.pi / 2, above=False, default=0.0),
    "footprint_rays": Quantity(ONE, low=1, high=MOST_FOOTPRINT_RAYS, above=False, whole=True, default=1),
    "false_alarm": Quantity(ONE, high=0.5, default=0.01),
}
LIGHT = {
    "wavelength": Quantity(LENGTHS, low=280e-9, high=4000e-9, above=False),
    "energy": Quantity(ENERGIES, low=1e-21, high=1.0, above=False),
    "pulses_per_frame": Quantity(ONE, low=1, high=1e12, above=False),
    "repetition": Quantity(FREQUENCIES, low=1e-3, high=1e12, above=False),
    "aperture": Quantity({"mm2": 1e-6, "cm2": 1e-4}, low=1e-12, high=10.0, above=False),
    "field_of_view": Quantity({"usr": 1e-6, "msr": 1e-3, "sr": 1.0}, low=1e-15, high=2 * math.pi, above=False),
    "efficiency": Quantity(ONE, low=1e-9, high=1.0, above=False),
    "filter_width": Quantity(LENGTHS, low=1e-15, above=False),
    "dark_rate": Quantity(FREQUENCIES, high=1e12, above=False),
    "dead_time": Quantity({**TIMES, "us": 1e-6}, high=1.0, above=False),
}
CHOICES = {
    "estimator": ("peak", "matched"),
    "emission": ("scanned", "flood"),
    "histogram_start": ("gate", "pulse"),
    "correction": ("none", "coates"),
    "emitters": ("sensor", "shared"),
}
QUANTITIES = {**TIMING, **LIGHT}


def detector_names() -> list[str]:
    """Names of the shipped detectors."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_detector(name_or_path: str | Path) -> Detector:
    """A shipped detector by its name, or one from a YAML file.

    Raises:
        ConfigError: There is no such detector or file, or a value in it is unknown, missing or not possible; the
            message names file, line and column.
    """
    text = str(name_or_path)
    if text in detector_names():
        return _detector(load_yaml(FOLDER / f"{text}.yaml"), text)
    path = Path(text)
    # an empty path is the current folder, and a name that is too long for a file is no file
    if not text.strip() or not os.path.exists(path):
        names = detector_names()
        raise ConfigError(
            f"there is no detector {text!r}",
            where="--detector",
            allowed=f"{', '.join(names)}, or the path of a detector file",
            hint=suggest(text, names) or f"{page('detectors.md')} says how to write one",
        )
    document = load_yaml(path)
    if not document.mapping:
        raise ConfigError("does not describe a detector", where=str(path), hint="--detector ideal needs no file")
    return _detector(document, path.stem)


def _detector(document: Document, fallback: str) -> Detector:
    _check_keys(document)
    chosen = {name: _choice(document, name, options) for name, options in CHOICES.items()}
    found = {name: _number(document, name, quantity) for name, quantity in QUANTITIES.items()}
    photons = _photons(document, found, chosen["emission"])
    name = document.mapping.get("name", fallback)
    if not is_name(name):
        raise ConfigError(
            f"name: found {name!r}", where=document.locate(("name",)), allowed="text without control characters"
        )
    detector = Detector(
        name=name,
        pulse_sigma_s=found["pulse_fwhm"] / FWHM_PER_SIGMA,
        jitter_sigma_s=found["jitter_fwhm"] / FWHM_PER_SIGMA,
        bin_s=found["bin"],
        divergence_rad=found["divergence"],
        footprint_rays=round(found["footprint_rays"]),
        photons=photons,
        estimator=chosen["estimator"] or "peak",
        false_alarm=found["false_alarm"],
        bins=None if found["bins"] is None else round(found["bins"]),
        histogram_start=chosen["histogram_start"] or "gate",
        correction=chosen["correction"] or "none",
        emitters=chosen["emitters"] or "sensor",
    )
    _check_together(document, detector)
    return detector


def _check_keys(document: Document) -> None:
    spelled = {key: name for name, quantity in QUANTITIES.items() for key in quantity.keys(name)}
    seen: dict[str, str] = {}
    for key in document.mapping:
        where = document.locate((key,), key=True)
        name = key if key == "name" or key in CHOICES else spelled.get(key)
        if name is None:
            meant = key if key in QUANTITIES else key.rpartition("_")[0]
            allowed = QUANTITIES[meant].keys(meant) if meant in QUANTITIES else [*spelled, "name", *CHOICES]
            raise ConfigError(
                f"unknown key {key!r}", where=where, allowed=", ".join(allowed), hint=suggest(key, allowed)
            )
        if name in seen:
            raise ConfigError(
                f"{key!r} and {seen[name]!r} are the same quantity", where=where, allowed="only one of them"
            )
        seen[name] = key


def _number(document: Document, name: str, quantity: Quantity) -> float | None:
    """A quantity in SI units, or its default."""
    for key, scale in zip(quantity.keys(name), quantity.units.values(), strict=True):
        if key in document.mapping:
            return _checked(document.mapping[key], document.locate((key,)), key, quantity, scale)
    return quantity.default


def _checked(value: Any, where: str, key: str, quantity: Quantity, scale: float) -> float:
    low, high = quantity.low / scale, quantity.high / scale
    kind = "a whole number" if quantity.whole else "a number"
    allowed = f"{kind}{' above' if quantity.above else ' from'} {low:g}"
    allowed += "" if math.isinf(high) else f"{' up' if quantity.above else ''} to {high:g}"
    right = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    number = float(value) * scale if right and not (quantity.whole and value != int(value)) else math.nan
    inside = quantity.low < number if quantity.above else quantity.low <= number
    if not inside or number > quantity.high or not math.isfinite(number):
        raise ConfigError(f"{key}: found {value!r}", where=where, allowed=allowed)
    return number


def _choice(document: Document, name: str, options: tuple[str, ...]) -> Any:
    found = document.mapping.get(name)
    if name in document.mapping and found not in options:
        raise ConfigError(f"{name}: found {found!r}", where=document.locate((name,)), allowed=", ".join(options))
    return found


def _photons(document: Document, found: Mapping[str, float | None], emission: Any) -> Photons | None:
    """The light budget; None if the file has none of its keys."""
    missing = [LIGHT[name].keys(name)[0] for name in LIGHT if found[name] is None]
    missing += [] if emission else ["emission"]
    if len(missing) == len(LIGHT) + 1:
        return None
    if missing:
        raise ConfigError(
            f"counts photons, but does not give {', '.join(missing)}",
            where=document.where,
            hint="give all of them, or none for a detector that any light triggers",
        )
    return Photons(
        wavelength_m=found["wavelength"],
        pulse_energy_j=found["energy"],
        pulses_per_frame=found["pulses_per_frame"],
        emission=emission,
        repetition_hz=found["repetition"],
        aperture_m2=found["aperture"],
        field_of_view_sr=found["field_of_view"],
        efficiency=found["efficiency"],
        filter_m=found["filter_width"],
        dark_hz=found["dark_rate"],
        dead_s=found["dead_time"],
    )


def _check_together(document: Document, detector: Detector) -> None:
    """Check the values that depend on each other."""
    if detector.footprint_rays > 1 and detector.divergence_rad == 0:
        raise ConfigError(
            f"footprint_rays: {detector.footprint_rays} rays in a beam of divergence 0 are all the same ray",
            where=document.locate(("footprint_rays",)),
            hint="give divergence_mrad, or footprint_rays: 1",
        )
    if detector.bins is not None and detector.bin_s is None:
        raise ConfigError("bins without a width", where=document.locate(("bins",)), hint="give bin_ps")
    photons = detector.photons
    if photons is None:
        return
    if detector.bins is not None and detector.bins * detector.bin_s * photons.repetition_hz > 1:
        raise ConfigError(
            f"bins: {detector.bins} bins last longer than the {1e9 / photons.repetition_hz:g} ns between pulses",
            where=document.locate(("bins",)),
            allowed=f"at most {math.floor(1 / (photons.repetition_hz * detector.bin_s))}",
        )
    if photons.filter_m >= photons.wavelength_m:
        key = next(key for key in LIGHT["filter_width"].keys("filter_width") if key in document.mapping)
        raise ConfigError(
            f"{key}: the filter is as wide as the wavelength",
            where=document.locate((key,)),
            allowed=f"less than {1e9 * photons.wavelength_m:g} nm",
        )
