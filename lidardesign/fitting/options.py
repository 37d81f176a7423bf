"""A user's choices for a fit, and those that do not go together."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, get_args

from lidardesign.constraints.document import MOST_FITTED, Constraints
from lidardesign.errors import MAX_SEED, ConfigError, check_choice, check_number
from lidardesign.rays.information import informs_rays
from lidardesign.run_folder import RunFolder
from lidardesign.sensors.design import FITTED_LAYOUTS, Gates, LayoutName
from lidardesign.sensors.sensor import LEVELS, MOST_RAYS

BEST = "best"  # as many sensors as score best on training scenes
LEAST = ("bandwidth", "rays", "sensors", "parts")  # of what a design for a goal has as little as it can
MOST_PATTERNS = 64  # that follow what they see
# Of designs: names that a file may have everywhere.
NAME_PATTERN = re.compile(r"[^\W.][\w.+-]{0,99}")


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """A user's choices for a fit; defaults follow from an earlier design, the constraints or the task.

    Arguments:
        sensors: Number of sensors, or "best": as many as score best on training scenes; of parts also "1-4": as
            "best", with a table of these numbers.
        constraints: Constraints, a mapping of them, or a YAML file of them.
        layout: chosen, even or spinning.
        rays: Rays per frame over all sensors.
        channels: Rings of each sensor that spins.
        gates: "sensor" or "ray": one gate per sensor, or one per ray.
        level: The share of rays and returns that fields of view and gates hold.
        at: Values of conditions that the design is for, such as {"x_m": 0.37}.
        weights: Settings of the task towards which the learned density is weighted.
        parts: Real parts that the design is made of: names, `NAME:MODE`, paths of part files, or "catalog".
        like: The file of a rig to be like: as many sensors at its places, none wider, as many rays.
        name: The design's name.
        seed: Seed of all random numbers; the run's by default.
        certify: Whether every number of rays gets a certificate, not the middle one alone.
        detector: The detector under which designs that are tried are judged: a name, or its file; ideal by default.
        settings: Settings of the task for the scenes that designs are chosen and judged in.
        survive: 1: rays are chosen for the loss of any one sensor, too; by default as constraints say.
        goal: The score that the design has to keep on training scenes that were held back, in the metric's unit.
        least: What it then has the least of: bandwidth, rays, sensors or parts.
        adaptive: At most so many patterns follow what they see; 1 for none, by default as the design.

    Raises:
        ConfigError: An invalid name, layout, choice of gates or of what is least.
    """

    sensors: int | str | None = None
    constraints: Constraints | Mapping[str, Any] | Path | str | None = None
    layout: str | None = None
    rays: int | None = None
    channels: int | None = None
    gates: str | None = None
    level: float | None = None
    at: Mapping[str, float] = field(default_factory=dict)
    weights: Sequence[str] | Mapping[str, Any] = ()
    parts: Sequence[str] | str | None = None
    like: Path | str | None = None
    name: str | None = None
    seed: int | None = None
    certify: bool = False
    detector: Path | str | None = None
    settings: Sequence[str] | Mapping[str, Any] = ()
    survive: int | None = None
    goal: float | None = None
    least: str | None = None
    adaptive: int | None = None

    def __post_init__(self) -> None:
        if self.name is not None and not NAME_PATTERN.fullmatch(self.name):
            allowed = "letters, digits, _, -, + and . (not in front), at most 100"
            raise ConfigError(f"{self.name!r} is not a name for a design", where="--name", allowed=allowed)
        for name, known in {"layout": FITTED_LAYOUTS, "gates": get_args(Gates), "least": LEAST}.items():
            if getattr(self, name) is not None:
                check_choice(getattr(self, name), f"--{name}", known)
        if self.sensors not in (None, BEST, *range(1, MOST_FITTED + 1)) and not self.numbers:
            allowed = f"a whole number from 1 to {MOST_FITTED}, best, or with parts numbers such as 1-4"
            raise ConfigError(repr(self.sensors), where="--sensors", allowed=allowed)
        limits = {
            "rays": (1, MOST_RAYS),
            "channels": (1, MOST_FITTED),
            "seed": (0, MAX_SEED),
            "survive": (0, 1),
            "adaptive": (1, MOST_PATTERNS),
        }
        for name, (low, high) in limits.items():
            if getattr(self, name) is not None:
                check_number(getattr(self, name), f"--{name}", low, high, whole=True)
        if self.level is not None:
            check_number(self.level, "--level", *LEVELS)

    @property
    def numbers(self) -> range | None:
        """The numbers of sensors of a text such as 1-4; None where there is a single one."""
        found = re.fullmatch(r"(\d{1,4})-(\d{1,4})", self.sensors) if isinstance(self.sensors, str) else None
        low, high = (int(text) for text in found.groups()) if found else (0, 0)
        return range(low, high + 1) if 1 <= low < high <= MOST_FITTED else None


def check_layout(layout: LayoutName, constraints: Constraints, run: RunFolder, options: FitOptions) -> None:
    """Refuse choices that a layout cannot have.

    Raises:
        ConfigError: There is one.
    """
    if layout != "even" and not informs_rays(run.task):
        raise ConfigError(
            f"the task {run.task.name} has no method informs",
            where=f"--layout {layout}",
            allowed="tasks with informs",
            hint="--layout even, or give the task a method informs(scene, returns)",
        )
    place = f"the layout {layout}" if constraints.parts is None else "a design of real parts"
    faults = {
        (f"{options.channels} channels in {place}", "--channels", "--layout spinning, without parts"): (
            options.channels is not None and layout != "spinning"
        ),
        (f"a gate per ray in the layout {layout}", "--gates", "--layout chosen"): (
            options.gates == "ray" and layout != "chosen" and constraints.parts is None
        ),
        (f"sensors that may fail in {place}", "survive", "--layout chosen, without parts"): (
            bool(constraints.survive) and place != "the layout chosen"
        ),
        ("spinning sensors with --at or --weight", "--layout", "chosen, even"): (
            layout == "spinning" and (bool(options.at) or bool(options.weights))
        ),
        (f"patterns that follow what they see in {place}", "--adaptive", "--layout chosen, without parts"): (
            (options.adaptive or 1) > 1 and place != "the layout chosen"
        ),
        ("patterns that follow what they see, together with survive", "--adaptive", "one of the two"): (
            (options.adaptive or 1) > 1 and bool(constraints.survive)
        ),
        (f"{options.sensors!r} sensors in the layout spinning", "--sensors", "a whole number"): (
            layout == "spinning" and isinstance(options.sensors, str)
        ),
    }
    refuse_first(faults)


def check_goal(layout: LayoutName, constraints: Constraints, run: RunFolder, options: FitOptions) -> None:
    """Refuse a goal that no score can be held against, and what cannot be sought for one.

    Raises:
        ConfigError: There is one.
    """
    goal, least, are_parts = options.goal, options.least, constraints.parts is not None
    faults = {
        ("no goal", "--least", "--goal SCORE --least WHAT"): goal is None and least is not None,
        ("a goal for sensors that spin", "--goal", "the layouts chosen and even"): (
            goal is not None and layout == "spinning"
        ),
        ("a goal for patterns that follow what they see", "--adaptive", "one of the two"): (
            goal is not None and (options.adaptive or 1) > 1
        ),
        (f"{least} with a design of parts", "--least", "parts"): are_parts and least not in (None, "parts"),
        ("no parts are named", "--least parts", "--parts NAME,NAME"): not are_parts and least == "parts",
        (f"{options.sensors} sensors with --least sensors", "--sensors", "sensors.max, or nothing"): (
            least == "sensors" and isinstance(options.sensors, int)
        ),
    }
    refuse_first(faults)
    if goal is not None:
        # the metric of meshes is that of their size, which has to be read
        metric, (low, high) = run.metric, run.metric.limits
        is_number = isinstance(goal, Real) and not isinstance(goal, bool)
        if not (is_number and math.isfinite(goal) and low <= goal <= high):
            allowed = f"a number from {low:g} to {high:g} {metric.unit}"
            raise ConfigError(f"{goal!r} as {metric.name}", where="--goal", allowed=allowed)


def refuse_first(faults: Mapping[tuple[str, str, str], object]) -> None:
    """Refuse the first fault that is found, of a fault, the option and what is allowed.

    Raises:
        ConfigError: There is one.
    """
    for (fault, where, allowed), is_found in faults.items():
        if is_found:
            raise ConfigError(fault, where=where, allowed=allowed)
