"""The fingerprints of a task's scenes as another process finds them, in which names hash differently."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from lidardesign import registry as probe
from lidardesign.errors import LidardesignError
from lidardesign.registry import START_SECONDS, plugin_guard
from lidardesign.space import DesignSpace
from lidardesign.task import scenes_of
from lidardesign.testing.fingerprint import fingerprint
from lidardesign.testing.law import BrokenLawError
from lidardesign.testing.watch import Watch

if TYPE_CHECKING:
    from lidardesign.config import RunConfig

CHILD = (
    "import json, sys; request = json.loads(sys.stdin.readline()); sys.path[:] = request['path']; "
    "from lidardesign.testing.elsewhere import answer; answer(request)"
)
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
        "path": sys.path,
        "module": kind.__module__,
        "name": kind.__qualname__,
        "task": config.task.model_dump(mode="json"),
        "space": config.space.as_dict(),
        "seed": config.seed,
    }
    hash_seed = next(seed for seed in HASH_SEEDS if seed != os.environ.get("PYTHONHASHSEED"))
    try:
        ended = subprocess.run(
            [sys.executable, "-c", CHILD],
            input=json.dumps(request) + "\n",
            capture_output=True,
            text=True,
            check=False,
            timeout=START_SECONDS + SPLITS * seconds,
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
        )
    except subprocess.TimeoutExpired:
        raise BrokenLawError(f"scenes were not made within {SPLITS * seconds:g} s in another process") from None
    try:
        found = json.loads(ended.stdout)
    except ValueError:
        found = {"error": f"exit code {ended.returncode}"}
    if "error" in found:
        raise BrokenLawError(f"scenes failed in another process: {found['error']}")
    return found


def answer(request: dict[str, Any]) -> None:
    """In that process: make the scenes, say their fingerprints or what went wrong as JSON on stdout, and end.

    What the task prints, also by processes of its own, goes to stderr.
    """
    result = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        with plugin_guard(request["name"]), Watch(all_threads=True).during("scenes"):
            task = attrgetter(request["name"])(importlib.import_module(request["module"]))()
            config, space = task.Config(**request["task"]), DesignSpace.from_dict(request["space"])
            found: dict[str, Any] = {
                split: [fingerprint(scene) for scene in scenes_of(task, config, split, request["seed"], space)]
                for split in ("train", "test")
            }
    except LidardesignError as error:
        found = {"error": error.message}
    probe.answer(result, found)
