"""A user's choices for a fit, and those that do not go together."""

import math
import re
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Annotated, Any

from lidardesign.choices.fit import BEST, CONSTRAINTS, FitChoices
from lidardesign.choices.flag import complete
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError
from lidardesign.limits import MOST_FITTED
from lidardesign.rays.information import informs_rays
from lidardesign.run_folder import RunFolder
from lidardesign.sensors.design import LayoutName
from lidardesign.space import condition_values

# Of designs: names that a file may have everywhere.
NAME_PATTERN = re.compile(r"[^\W.][\w.+-]{0,99}")


class DesignChoices(FitChoices, total=False):
    """A user's choices for a fit under constraints."""

    constraints: Annotated[Constraints | Mapping[str, Any] | Path | str | None, CONSTRAINTS]


def fit_choices(given: Mapping[str, Any]) -> DesignChoices:
    """A user's choices for a fit, complete, with texts of numbers, parts and conditions as what they stand for.

    Raises:
        ConfigError: One is out of its limits, or is no name, number of sensors, part or condition.
    """
    choices = complete(DesignChoices, given)
    if choices["name"] is not None:
        check_name(choices["name"])
    choices["sensors"], choices["parts"] = sensor_number(choices), part_names(choices)
    choices["at"] = condition_values(choices["at"])
    return choices


def check_name(name: str) -> None:
    """Refuse what cannot be the name of a design.

    Raises:
        ConfigError: It cannot.
    """
    if not NAME_PATTERN.fullmatch(name):
        allowed = "letters, digits, _, -, + and . (not in front), at most 100"
        raise ConfigError(f"{name!r} is not a name for a design", where="--name", allowed=allowed)


def part_names(choices: DesignChoices) -> Sequence[str] | str | None:
    """The parts that are named, `catalog` for all that are shipped, or the modules that are described.

    Raises:
        ConfigError: A name is empty, or a module lacks something.
    """
    parts, module = choices["parts"], [choices[key] for key in ("modules", "fov", "zones")]  # type: ignore[literal-required]
    if module == [None, None, None]:
        if parts is None or parts == "catalog" or not isinstance(parts, str):
            return parts
        names = [name.strip() for name in parts.split(",")]
        if not all(names):
            raise ConfigError(f"{parts!r} has an empty part name", where="--parts", allowed="NAME,NAME or catalog")
        return names
    if None in module or (parts, choices["sensors"]) != (None, None):
        allowed = "--modules N --fov WxH --zones CxR, without --sensors and --parts"
        raise ConfigError("the description of the modules is incomplete", where="--modules", allowed=allowed)
    return [f"module-{choices['fov']}-{choices['zones']}"]


def sensor_number(choices: DesignChoices) -> int | str | None:
    """The number of sensors: a number, "best", or a text of two numbers such as 1-4.

    Raises:
        ConfigError: It is none of these.
    """
    asked = choices["sensors"] if choices["modules"] is None else choices["modules"]
    count = int(asked) if isinstance(asked, str) and re.fullmatch("[0-9]{1,9}", asked) else asked
    if count not in (None, BEST, *range(1, MOST_FITTED + 1)) and not sensor_numbers(count):
        allowed = f"a whole number from 1 to {MOST_FITTED}, best, or with parts numbers such as 1-4"
        raise ConfigError(repr(count), where="--sensors", allowed=allowed)
    return count


def sensor_numbers(sensors: int | str | None) -> range | None:
    """The numbers of sensors of a text such as 1-4; None where there is a single one."""
    found = re.fullmatch(r"(\d{1,4})-(\d{1,4})", sensors) if isinstance(sensors, str) else None
    low, high = (int(text) for text in found.groups()) if found else (0, 0)
    return range(low, high + 1) if 1 <= low < high <= MOST_FITTED else None


def check_layout(layout: LayoutName, constraints: Constraints, run: RunFolder, choices: DesignChoices) -> None:
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
        (f"{choices['channels']} channels in {place}", "--channels", "--layout spinning, without parts"): (
            choices["channels"] is not None and layout != "spinning"
        ),
        (f"a gate per ray in the layout {layout}", "--gates", "--layout chosen"): (
            choices["gates"] == "ray" and layout != "chosen" and constraints.parts is None
        ),
        (f"sensors that may fail in {place}", "survive", "--layout chosen, without parts"): (
            bool(constraints.survive) and place != "the layout chosen"
        ),
        ("spinning sensors with --at or --weight", "--layout", "chosen, even"): (
            layout == "spinning" and (bool(choices["at"]) or bool(choices["weights"]))
        ),
        (f"patterns that follow what they see in {place}", "--adaptive", "--layout chosen, without parts"): (
            (choices["adaptive"] or 1) > 1 and place != "the layout chosen"
        ),
        ("patterns that follow what they see, together with survive", "--adaptive", "one of the two"): (
            (choices["adaptive"] or 1) > 1 and bool(constraints.survive)
        ),
        (f"{choices['sensors']!r} sensors in the layout spinning", "--sensors", "a whole number"): (
            layout == "spinning" and isinstance(choices["sensors"], str)
        ),
    }
    refuse_first(faults)


def check_goal(layout: LayoutName, constraints: Constraints, run: RunFolder, choices: DesignChoices) -> None:
    """Refuse a goal that no score can be held against, and what cannot be sought for one.

    Raises:
        ConfigError: There is one.
    """
    goal, least, are_parts = choices["goal"], choices["least"], constraints.parts is not None
    faults = {
        ("no goal", "--least", "--goal SCORE --least WHAT"): goal is None and least is not None,
        ("a goal for sensors that spin", "--goal", "the layouts chosen and even"): (
            goal is not None and layout == "spinning"
        ),
        ("a goal for patterns that follow what they see", "--adaptive", "one of the two"): (
            goal is not None and (choices["adaptive"] or 1) > 1
        ),
        (f"{least} with a design of parts", "--least", "parts"): are_parts and least not in (None, "parts"),
        ("no parts are named", "--least parts", "--parts NAME,NAME"): not are_parts and least == "parts",
        (f"{choices['sensors']} sensors with --least sensors", "--sensors", "sensors.max, or nothing"): (
            least == "sensors" and isinstance(choices["sensors"], int)
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
