"""The options of `evaluate` that say what measures and which effects are simulated."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    from lidardesign.simulate.plan import Planner

MILLIMETRES = 1000.0

Effects = Annotated[
    str,
    typer.Option(
        "--effects",
        metavar="auto|all|none|audit|LIST",
        help="Physical effects: those that each scene calls for, all, none, or names between commas; audit: as auto, "
        "and every row under all effects too (exit 1 where a score moves by more than the metric's tolerance).",
    ),
]
Detector = Annotated[
    str,
    typer.Option(
        "--detector",
        metavar="NAME|FILE",
        help="What measures: ideal, single-photon, consumer-8x8, or a YAML file.",
    ),
]
RangeTolerance = Annotated[
    float | None,
    typer.Option(
        "--range-tolerance-mm",
        metavar="MM",
        help="What all skipped effects together may change of ranges, rms.",
        show_default="a tenth of a bin, or 1, and at most the metric's tolerance where it is a length",
    ),
]
ReturnTolerance = Annotated[
    float | None,
    typer.Option(
        "--return-tolerance",
        metavar="SHARE",
        help="What all skipped effects together may change of returns.",
        show_default="0.001",
    ),
]


def planner_of(
    effects: str, detector: str, range_tolerance_mm: float | None, return_tolerance: float | None
) -> tuple[Planner, bool]:
    """How effects are chosen, and whether the choice is audited.

    Raises:
        ConfigError: An unknown effect or detector, or a tolerance that is not above 0.
    """
    from lidardesign.simulate.detector.files import load_detector
    from lidardesign.simulate.plan import Planner, Tolerance, parse_effects

    _check_tolerance("--range-tolerance-mm", range_tolerance_mm)
    _check_tolerance("--return-tolerance", return_tolerance)
    audit = effects.strip() == "audit"
    choice = parse_effects("auto" if audit else effects)
    measuring = load_detector(detector)
    tolerance = Tolerance.of(measuring)
    range_m = tolerance.range_m if range_tolerance_mm is None else range_tolerance_mm / MILLIMETRES
    lost = tolerance.lost if return_tolerance is None else return_tolerance
    return Planner(measuring, choice, Tolerance(range_m, lost)), audit


def _check_tolerance(option: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise ConfigError(f"{value:g}", where=option, allowed="a finite number above 0")
