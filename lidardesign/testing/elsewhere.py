"""The fingerprints of a task's scenes as another process finds them, in which names hash differently."""

from __future__ import annotations

import importlib
import os
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from lidardesign.errors import LidardesignError
from lidardesign.registry import plugin_guard
from lidardesign.run.child import ChildError, ask
from lidardesign.space import DesignSpace
from lidardesign.task import scenes_of
from lidardesign.testing.fingerprint import fingerprint
from lidardesign.testing.law import BrokenLawError
from lidardesign.testing.watch import Watch

if TYPE_CHECKING:
    from lidardesign.config import RunConfig

# Any number but 0, which would be no chance at all, and not the one of the process that asks.
HASH_SEEDS = ("20251", "20252")
SPLITS = 2


def fingerprints_in_process(config: RunConfig, kind: type, seconds: float) -> dict[str, list[str]]:
    """Fingerprints of all scenes by split, made in a process of its own.

    Arguments:
        config: Whose scenes.
        kind: The task's class; it must be importable.
        seconds: How long the scenes of one split may take there.

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
        found = ask(f"{__name__}:answer", request, SPLITS * seconds, "there", {"PYTHONHASHSEED": hash_seed})
    except ChildError as lost:
        raise BrokenLawError(f"scenes failed in another process, which {lost}") from None
    if "error" in found:
        raise BrokenLawError(f"scenes failed in another process: {found['error']}")
    return found


def answer(request: dict[str, Any], _: object) -> dict[str, Any]:
    """In that process: make the scenes, and say their fingerprints or what went wrong."""
    try:
        with plugin_guard(request["name"]), Watch(all_threads=True).during("scenes"):
            task = attrgetter(request["name"])(importlib.import_module(request["module"]))()
            config, space = task.Config(**request["task"]), DesignSpace.from_dict(request["space"])
            return {
                split: [fingerprint(scene) for scene in scenes_of(task, config, split, request["seed"], space)]
                for split in ("train", "test")
            }
    except LidardesignError as error:
        return {"error": error.message}
