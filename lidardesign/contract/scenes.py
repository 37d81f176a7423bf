"""Laws of a task's description (configuration, metric, defaults, design space) and of its scenes.

Scenes are reproducible, splits share none, and scenes can be sent to other processes.
"""

from __future__ import annotations

import importlib
import itertools
import json
import math
import os
import pickle
from importlib.util import find_spec
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.config import PRESETS, resolve
from lidardesign.contract.law import (
    BrokenLawError,
    Law,
    LawHolds,
    NotApplicable,
    Subject,
    geometry_fingerprint,
    restore_random_states,
)
from lidardesign.errors import ConfigError, LidardesignError
from lidardesign.plugins import plugin_guard
from lidardesign.rays.information import informs_rays
from lidardesign.run.content import fingerprint
from lidardesign.run.processes import ChildError, ask
from lidardesign.space import DesignSpace
from lidardesign.task import Split, scenes_of

if TYPE_CHECKING:
    from lidardesign.config import RunConfig

# Training scenes are drawn with other seeds where rays are chosen; so many further seeds are tried.
FURTHER_SEEDS = 2
SPLITS: tuple[Split, ...] = ("train", "test")
# Any number but 0, which would be no chance at all, and not the one of the process that asks.
HASH_SEEDS = ("20251", "20252")


def check_scenes(subject: Subject) -> LawHolds:
    """Both splits have scenes, and their bodies are within the program's bounds."""
    counts = {split: len(subject.scenes(split)) for split in SPLITS}
    for split, count in counts.items():
        if not count:
            raise BrokenLawError(f"the split {split} has no scenes", allowed="1 or more")
    frames = max(scene.frames for split in SPLITS for scene in subject.scenes(split))
    moving = f", up to {frames} frames" if frames > 1 else ""
    return LawHolds(f"{counts['train']} to train on, {counts['test']} held out{moving}", {**counts, "frames": frames})


def check_repeatable(subject: Subject) -> LawHolds:
    """The same configuration, split and seed give the same scenes, to the bit."""
    for split in SPLITS:
        first, again = subject.scenes(split), subject.new_scenes(split, subject.config.seed)
        if len(first) != len(again):
            raise BrokenLawError(f"the second time the split {split} has {len(again)} scenes, not {len(first)}")
        for number, (one, other) in enumerate(zip(first, again, strict=True)):
            if fingerprint(one) != fingerprint(other):
                raise BrokenLawError(
                    f"the second time the split {split} has a different scene {number} ({one.name!r})",
                    hint="draw all random numbers from lidardesign.task.random_generator(seed, ...)",
                )
    return LawHolds("made twice, bit for bit the same")


def check_seeds(subject: Subject) -> LawHolds | NotApplicable:
    """Another seed gives other training scenes: rays are chosen on further ones, by a task with `informs`."""
    first = {geometry_fingerprint(scene) for scene in subject.scenes("train")}
    other = {geometry_fingerprint(scene) for scene in subject.scenes("train", subject.config.seed + 1)}
    shared = len(first & other)
    if shared == len(first):
        same = "another seed gives the same training scenes"
        if not informs_rays(subject.task):
            return NotApplicable(f"{same}; without informs, no further ones are drawn")
        raise BrokenLawError(f"{same}, but rays are chosen on further ones", hint="draw random numbers from the seed")
    return LawHolds(f"{shared} of {len(first)} training scenes are the same with another seed", {"shared": shared})


def check_disjoint(subject: Subject) -> LawHolds:
    """No held-out scene is trained on, whatever the seed of the training scenes."""
    held_out = {geometry_fingerprint(scene): scene.name for scene in subject.scenes("test")}
    seeds = range(subject.config.seed, subject.config.seed + FURTHER_SEEDS + 1)
    for seed in seeds:
        for scene in subject.scenes("train", seed):
            name = held_out.get(geometry_fingerprint(scene))
            if name is not None:
                raise BrokenLawError(
                    f"the training scene {scene.name!r} of seed {seed} is the held-out scene {name!r}",
                    hint="name the split where random numbers are drawn: random_generator(seed, name, split, ...)",
                )
    return LawHolds(f"{len(held_out)} held out, none trained on with {len(seeds)} seeds", {"seeds": len(seeds)})


def check_elsewhere(subject: Subject) -> LawHolds | NotApplicable:
    """A worker process makes the same scenes, whatever the order of sets or earlier calls."""
    kind = type(subject.task)
    if kind.__module__ == "__main__" or "<locals>" in kind.__qualname__ or find_spec(kind.__module__) is None:
        return NotApplicable("the task's class cannot be imported in another process")
    found = fingerprints_in_process(subject.config, kind, subject.limit_s)
    for split in SPLITS:
        mine = [fingerprint(scene) for scene in subject.scenes(split)]
        if found[split] != mine:
            number = next((i for i, (a, b) in enumerate(zip(mine, found[split], strict=False)) if a != b), len(mine))
            raise BrokenLawError(
                f"another process makes a different scene {number} of the split {split}",
                hint="do not use hash(), the order of sets, the time or the process in scenes",
            )
    return LawHolds("another process makes them bit for bit the same")


def fingerprints_in_process(config: RunConfig, kind: type, seconds: float) -> dict[str, list[str]]:
    """Fingerprints of all scenes by split, made in a child process.

    Arguments:
        config: The configuration of the scenes.
        kind: The task's class; it must be importable.
        seconds: Time limit of the scenes of one split [s].

    Raises:
        BrokenLawError: It failed there, or took longer.
    """
    request = {
        "module": kind.__module__,
        "name": kind.__qualname__,
        "task": config.task.model_dump(mode="json"),
        "space": config.space.as_dict(),
        "seed": config.seed,
    }
    hash_seed = next(seed for seed in HASH_SEEDS if seed != os.environ.get("PYTHONHASHSEED"))
    try:
        found = ask(
            f"{__name__}:answer_fingerprints",
            request,
            len(SPLITS) * seconds,
            "there",
            {"PYTHONHASHSEED": hash_seed},
        )
    except ChildError as lost:
        raise BrokenLawError(f"scenes failed in another process, which {lost}") from None
    if "error" in found:
        raise BrokenLawError(f"scenes failed in another process: {found['error']}")
    return found


def answer_fingerprints(request: dict[str, Any], _: object) -> dict[str, Any]:
    """In the child: make the scenes, and return their fingerprints or the error."""
    try:
        with plugin_guard(request["name"]):
            task = attrgetter(request["name"])(importlib.import_module(request["module"]))()
            config, space = task.Config(**request["task"]), DesignSpace.from_dict(request["space"])
            return {
                split: [fingerprint(scene) for scene in scenes_of(task, config, split, request["seed"], space)]
                for split in SPLITS
            }
    except LidardesignError as error:
        return {"error": error.message}


def check_picklable(subject: Subject) -> LawHolds:
    """Scenes and the configuration survive pickling, which worker processes need."""
    size = 0
    for scene in (*subject.looked_at, subject.config.task):
        try:
            content = pickle.dumps(scene)
            again = pickle.loads(content)
        except Exception as error:
            what = getattr(scene, "name", "the configuration")
            raise BrokenLawError(f"{what!r} cannot be pickled: {type(error).__name__}: {error}") from error
        if fingerprint(again) != fingerprint(scene):
            raise BrokenLawError(f"{scene!r:.80} is different after pickling")
        size = max(size, len(content))
    return LawHolds(f"{size / 1000:.3g} kB at most", {"bytes": size})


SCENE_LAWS = (
    Law("scenes are made", "scenes", "both splits have scenes", check_scenes, needs=("space is fixed",)),
    Law(
        "scenes repeat",
        "scenes",
        "the same configuration, split and seed give the same scenes",
        check_repeatable,
        needs=("scenes are made",),
    ),
    Law(
        "scenes repeat elsewhere",
        "scenes",
        "another process makes the same scenes",
        check_elsewhere,
        needs=("scenes repeat",),
    ),
    Law("seeds differ", "scenes", "another seed gives other training scenes", check_seeds, needs=("scenes are made",)),
    Law(
        "splits are disjoint",
        "scenes",
        "no held-out scene is trained on, whatever the seed",
        check_disjoint,
        needs=("scenes are made",),
    ),
    Law("scenes are picklable", "scenes", "scenes survive pickling", check_picklable, needs=("scenes are made",)),
)


def check_config(subject: Subject) -> LawHolds:
    """Values survive JSON, and every key has a description."""
    kind, config = type(subject.config.task), subject.config.task
    with subject.calling("Config"):
        again = kind(**config.model_dump(mode="json"))
    if again.model_dump() != config.model_dump():
        raise BrokenLawError("values change in a round trip through JSON, in which runs are kept")
    mute = [name for name, info in kind.model_fields.items() if not info.description]
    if mute:
        raise BrokenLawError(
            f"{mute[0]!r} has no description", hint="Field(default, description=...); `tasks show` prints it"
        )
    return LawHolds(f"{len(kind.model_fields)} keys", {"keys": len(kind.model_fields)})


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
    allowed = "a name, a unit, better='lower' or 'higher', a finite worst value, a tolerance above 0"
    _refuse_wrong("metric", metric, wrong, allowed)
    return LawHolds(
        f"{metric.name} [{metric.unit}], {metric.better} is better, worst {metric.worst:g}",
        {"worst": float(metric.worst), "tolerance": float(metric.tolerance)},
    )


def _refuse_wrong(kind: str, holder: object, wrong: dict[str, bool], allowed: str) -> None:
    """Name the first member of an object that is wrong, if there is one."""
    for name in itertools.compress(wrong, wrong.values()):
        raise BrokenLawError(f"{kind}.{name} is {getattr(holder, name)!r}", allowed=allowed)


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def check_defaults(subject: Subject) -> LawHolds:
    """Suggested rays, level and settings are valid in every preset."""
    defaults = subject.task.defaults
    wrong = {
        "rays": not (isinstance(defaults.rays, list | tuple) and defaults.rays and all(map(_is_count, defaults.rays))),
        "level": not _is_finite(defaults.level) or not 0 < defaults.level < 1,
    }
    _refuse_wrong("defaults", defaults, wrong, "rays of 1 or more, a level between 0 and 1")
    unknown = [preset for preset in defaults.learning if preset not in PRESETS]
    if unknown:
        raise BrokenLawError(f"defaults.learning has the preset {unknown[0]!r}", allowed=", ".join(PRESETS))
    # JSON is YAML too
    values = subject.config.task.model_dump(mode="json")
    task = [f"task.{name}={json.dumps(value)}" for name, value in values.items()]
    for preset in PRESETS:
        try:
            with restore_random_states(subject.drawn, "space"):
                resolve(subject.task, preset=preset, overrides=task)
        except ConfigError as error:
            raise BrokenLawError(f"preset {preset}: {error.message}", allowed=error.allowed) from error
    return LawHolds(f"level {defaults.level:g}, evaluated at {', '.join(map(str, defaults.rays))} rays")


def _is_count(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= 1


def check_space(subject: Subject) -> LawHolds:
    """`space` gives the same DesignSpace every time, with a dimension to design."""
    with subject.calling("space"):
        first, again = (subject.task.space(subject.config.task) for _ in range(2))
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


INTERFACE_LAWS = (
    Law(
        "configuration is described",
        "interface",
        "Config survives JSON and describes every key",
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
