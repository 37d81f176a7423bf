"""What a user may choose for an evaluation, checked before anything is opened."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lidardesign.design.sensor import MOST_RAYS
from lidardesign.errors import MAX_SEED, ConfigError, check_number
from lidardesign.evaluate.baselines.cma import CMA
from lidardesign.evaluate.baselines.simple import check_baseline
from lidardesign.evaluate.mounting import MountError
from lidardesign.evaluate.workers.pool import check_workers
from lidardesign.numerics import SLACK
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.plan import Planner, Tolerance, parse_effects

CMA_SECONDS = (0.1, 7 * 24 * 3600.0)
# A picometre, and further than any sensor reaches.
RANGE_TOLERANCES_MM = (SLACK, 1e9)
RETURN_TOLERANCES = (SLACK, 1.0)
MILLIMETRES = 1000.0


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """What a user may choose for an evaluation.

    Arguments:
        rays: Numbers of rays per frame; the task's by default, and those of smaller fixed patterns.
        baselines: Further baselines beside uniform, random, bounding, silhouette and greedy, by name.
        seed: Seed of all random numbers; the run's by default.
        effects: auto, all, none, audit, or names of effects between commas.
        detector: The name of a detector, or its file.
        range_tolerance_mm: What all skipped effects together may change of ranges.
        return_tolerance: Share of returns that all skipped effects together may change.
        settings: Settings of the task to judge by other scenes than were learned.
        workers: Processes that score scenes, or the address of a scheduler.
        cma_seconds: Wall time of each search of the baseline cma [s].
        accuracy: Whether what accuracy costs will be measured, too.
        scenes_seed: Root of the held-out scenes; `seed` by default.
        designs: Names of the designs that are scored; all by default.
        mount_error: Standard deviations of how sensors are misplaced in further rows, as "5mm,0.5deg".
        fail_above: What no design may be worse than, in the metric's unit; `Scores.check` sees to it.
        fail_unless_better: A baseline or design that every other design must be better than; so does this.

    Raises:
        ConfigError: One of them says nothing that can be done.
    """

    rays: Sequence[int] | None = None
    baselines: Sequence[str] = ()
    seed: int | None = None
    effects: str = "auto"
    detector: str = "ideal"
    range_tolerance_mm: float | None = None
    return_tolerance: float | None = None
    settings: Sequence[str] | Mapping[str, Any] = ()
    workers: int | str = 1
    cma_seconds: float | None = None
    accuracy: bool = False
    scenes_seed: int | None = None
    designs: Sequence[str] = ()
    mount_error: str | None = None
    fail_above: float | None = None
    fail_unless_better: str | None = None

    def __post_init__(self) -> None:
        check_workers(str(self.workers))
        self.misplacement()
        for name in self.baselines:
            check_baseline(name, where="--baseline")
        limits = {
            "cma_seconds": CMA_SECONDS,
            "range_tolerance_mm": RANGE_TOLERANCES_MM,
            "return_tolerance": RETURN_TOLERANCES,
            "seed": (0, MAX_SEED),
            "scenes_seed": (0, MAX_SEED),
        }
        for name, (low, high) in limits.items():
            if getattr(self, name) is not None:
                check_number(getattr(self, name), f"--{name.replace('_', '-')}", low, high, whole="seed" in name)
        if self.fail_above is not None and not math.isfinite(self.fail_above):
            raise ConfigError(f"{self.fail_above}", where="--fail-above", allowed="a finite number")
        for count in self.rays or ():
            check_number(count, "--rays", 1, MOST_RAYS, whole=True)
        if self.cma_seconds is not None and CMA not in self.baselines:
            raise ConfigError(
                "there is no search", where="--cma-seconds", hint=f"add --baseline {CMA}, or leave it out"
            )

    def misplacement(self) -> MountError | None:
        """How carelessly sensors are mounted in further rows."""
        return None if self.mount_error is None else MountError.parse(self.mount_error)

    def planner(self) -> tuple[Planner, bool]:
        """How effects are chosen, and whether the choice is audited.

        Raises:
            ConfigError: An unknown effect or detector.
        """
        audit = self.effects.strip() == "audit"
        choice = parse_effects("auto" if audit else self.effects)
        detector = load_detector(self.detector)
        tolerance = Tolerance.of(detector)
        if self.range_tolerance_mm is not None:
            tolerance = replace(tolerance, range_m=self.range_tolerance_mm / MILLIMETRES)
        if self.return_tolerance is not None:
            tolerance = replace(tolerance, lost=self.return_tolerance)
        return Planner(detector, choice, tolerance), audit
