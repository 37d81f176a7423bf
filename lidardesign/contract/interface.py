"""Laws of what a task says about itself: its configuration, metric, defaults and design space."""

from __future__ import annotations

import math

import numpy as np
from pydantic import ValidationError

from lidardesign.config import PRESETS, resolve
from lidardesign.contract.law import BrokenLawError, Law, LawHolds, NotApplicable, Subject, restore_random_states
from lidardesign.errors import ConfigError
from lidardesign.space import DesignSpace


def check_config(subject: Subject) -> LawHolds:
    """Unknown keys and NaN are refused, values come back from JSON as they were, every key says what it is."""
    kind, config = type(subject.config.task), subject.config.task
    with subject.calling("Config"):
        if _takes(kind, {**config.model_dump(), "no_such_key": 1}):
            raise BrokenLawError("takes a key that it does not know", hint="keep extra='forbid' of TaskConfig")
        numbers = [name for name, value in config if isinstance(value, int | float)]
        taken = [name for name in numbers if _takes(kind, {**config.model_dump(), name: float("nan")})]
        again = kind(**config.model_dump(mode="json"))
    if taken:
        raise BrokenLawError(f"takes NaN for {taken[0]!r}", hint="keep allow_inf_nan=False of TaskConfig")
    if again.model_dump() != config.model_dump():
        raise BrokenLawError("values change on the way through JSON, in which runs are kept")
    mute = [name for name, info in kind.model_fields.items() if not info.description]
    if mute:
        raise BrokenLawError(
            f"{mute[0]!r} has no description", hint="Field(default, description=...); `tasks show` prints it"
        )
    return LawHolds(f"{len(kind.model_fields)} keys", {"keys": len(kind.model_fields)})


def _takes(kind: type, values: dict[str, object]) -> bool:
    try:
        kind(**values)
    except ValidationError:
        return False
    return True


def check_metric(subject: Subject) -> LawHolds:
    """The metric has a name, a direction, a finite worst value and a tolerance above 0."""
    metric = subject.metric
    wrong = {
        "name": not isinstance(metric.name, str) or not metric.name.strip(),
        "unit": not isinstance(metric.unit, str),
        "better": metric.better not in ("lower", "higher"),
        "worst": not _is_finite(metric.worst),
        "tolerance": not _is_finite(metric.tolerance) or metric.tolerance <= 0,
    }
    for name, is_wrong in wrong.items():
        if is_wrong:
            raise BrokenLawError(
                f"metric.{name} is {getattr(metric, name)!r}",
                allowed="a name, a unit, better='lower' or 'higher', a finite worst value, a tolerance above 0",
            )
    return LawHolds(
        f"{metric.name} [{metric.unit}], {metric.better} is better, worst {metric.worst:g}",
        {"worst": float(metric.worst), "tolerance": float(metric.tolerance)},
    )


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def check_defaults(subject: Subject) -> LawHolds:
    """Suggested rays, level and settings are ones that the commands accept, in every preset."""
    defaults = subject.task.defaults
    allowed = "rays of 1 or more, a level between 0 and 1"
    wrong = {
        "rays": not (isinstance(defaults.rays, list | tuple) and defaults.rays and all(map(_is_count, defaults.rays))),
        "level": not _is_finite(defaults.level) or not 0 < defaults.level < 1,
    }
    for name, is_wrong in wrong.items():
        if is_wrong:
            raise BrokenLawError(f"defaults.{name} is {getattr(defaults, name)!r}", allowed=allowed)
    unknown = [preset for preset in defaults.learning if preset not in PRESETS]
    if unknown:
        raise BrokenLawError(f"defaults.learning has the preset {unknown[0]!r}", allowed=", ".join(PRESETS))
    task = {f"task.{name}": value for name, value in subject.config.task.model_dump(mode="json").items()}
    for preset in PRESETS:
        try:
            with restore_random_states(subject.drawn, "space"):
                resolve(subject.task, preset=preset, overrides=[f"{key}={_as_yaml(v)}" for key, v in task.items()])
        except ConfigError as error:
            raise BrokenLawError(f"preset {preset}: {error.message}", allowed=error.allowed) from error
    rays = ", ".join(map(str, defaults.rays))
    return LawHolds(f"level {defaults.level:g}, evaluated at {rays} rays")


def _as_yaml(value: object) -> str:
    import json

    return json.dumps(value)


def _is_count(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= 1


def check_space(subject: Subject) -> LawHolds:
    """`space` gives a DesignSpace, the same one every time, with a dimension to design."""
    with subject.calling("space"):
        first, again = (subject.task.space(subject.config.task) for _ in range(2))
    for space in (first, again):
        if not isinstance(space, DesignSpace):
            found = type(space).__name__
            raise BrokenLawError(f"space() returned {found}", allowed="lidardesign.space.DesignSpace")
    if first.as_dict() != again.as_dict():
        raise BrokenLawError("space() returned a different one the second time", allowed="the same every time")
    designed = len(set(subject.config.space.free) - set(subject.config.space.conditioned))
    if not designed:
        raise BrokenLawError("every dimension of the design space is fixed", hint="free at least one")
    return LawHolds(f"{designed} of 6 dimensions are designed", {"designed": designed})


def check_conditions(subject: Subject) -> LawHolds | NotApplicable:
    """The condition values that designs are evaluated at lie in the design space, and each names every condition."""
    if not subject.config.space.conditioned:
        return NotApplicable("the density has no conditions")
    count = len(subject.conditions)
    return LawHolds(f"{count} values of {', '.join(subject.config.space.condition)}", {"values": count})


LAWS = (
    Law(
        "configuration is strict",
        "interface",
        "Config refuses unknown keys and NaN, survives JSON and describes every key",
        check_config,
    ),
    Law("metric is defined", "interface", "the metric has a unit, a direction and bounds", check_metric),
    Law("defaults are accepted", "interface", "what the task suggests is accepted by the commands", check_defaults),
    Law("space is fixed", "interface", "space(config) gives the same DesignSpace every time", check_space),
    Law(
        "conditions lie in the space",
        "interface",
        "conditions(config) names every condition, within the design space",
        check_conditions,
        needs=("space is fixed",),
    ),
)
