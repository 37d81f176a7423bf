"""A worker: makes a task's held-out scenes once, then scores sets of rays in those that it is asked about.

`answer` takes and gives bytes and never raises, so it serves any engine. `python -m lidardesign.evaluate.worker` serves
a pipe: messages come on standard input and answers go to standard output, each after its length. What the task or a
library prints goes to standard error.
"""

from __future__ import annotations

import os
import queue
import signal
import struct
import sys
import threading
import traceback
from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import Any, BinaryIO

from lidardesign import __version__
from lidardesign.errors import ConfigError, PluginError
from lidardesign.evaluate import messages
from lidardesign.evaluate.passes import ScenePass, score_in_scene
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.registry import load_task, plugin_guard
from lidardesign.scene import Scene
from lidardesign.space import DesignSpace
from lidardesign.task import Task, scenes_of

LENGTH = struct.Struct(">Q")
# Exit code where the process that asks has gone.
EXIT_ALONE = 1


def preparation(request: EvaluationRequest) -> bytes:
    """A message that has a worker make the scenes, so that they are there when rays come."""
    return messages.pack({"task": _task_document(request), "scene": None})


def question(request: EvaluationRequest, scene_pass: ScenePass, number: int) -> bytes:
    """The message that asks for the scores in one held-out scene.

    Arguments:
        request: Whose task, configuration and seed make the scenes.
        scene_pass: What is fired, and under which effects.
        number: Of the scene.
    """
    counts, arrays = messages.rays_as_arrays(scene_pass.fired(number))
    known = scene_pass.known(number)
    document = {
        "task": _task_document(request),
        "scene": number,
        "outline": messages.outline(request.test[number]),
        "counts": counts,
        "planner": messages.planner_as_document(scene_pass.planner),
        "plan": None if known is None else asdict(known),
    }
    return messages.pack(document, **arrays)


def _task_document(request: EvaluationRequest) -> dict[str, Any]:
    return {
        "version": __version__,
        "name": request.task.name,
        "config": request.config.model_dump(mode="json"),
        "space": request.space.as_dict(),
        "seed": request.seed,
    }


# Threads of one process take turns: tasks need not be safe to be called twice at a time.
_one_at_a_time = threading.Lock()


def answer(message: bytes) -> bytes:
    """What came of a message: nothing for a preparation, the scores of a scene, or the error that was met."""
    with _one_at_a_time:
        try:
            document, arrays = messages.unpack(message)
            return messages.pack(_answered(document, arrays))
        except Exception as error:
            # whatever goes wrong in here is the asking side's to report
            return messages.pack({"error": messages.error_as_document(error, traceback.format_exc())})


def _answered(document: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    asked = document["task"]
    if asked["version"] != __version__:
        raise ConfigError(
            f"a worker has lidardesign {__version__}",
            where="--workers",
            allowed=asked["version"],
            hint="install the same version everywhere",
        )
    task, scenes = _made(messages.pack(asked))
    if document["scene"] is None:
        return {}
    scene = _checked(task, scenes, document)
    lists = messages.rays_from_arrays(document["counts"], arrays)
    planner = messages.planner_from_document(document["planner"])
    known = None if document["plan"] is None else messages.plan_from_document(document["plan"])
    return messages.scores_as_document(score_in_scene(task, scene, lists, planner, known, asked["seed"]))


@lru_cache(maxsize=1)
def _made(asked: bytes) -> tuple[Task, Sequence[Scene]]:
    """The task and the held-out scenes of a request; those of the last one are kept."""
    document, _ = messages.unpack(asked)
    task = load_task(document["name"])
    config = task.Config.model_validate(document["config"])
    with plugin_guard(task.name):
        scenes = scenes_of(task, config, "test", document["seed"], DesignSpace.from_dict(document["space"]))
        return task, list(scenes)


def _checked(task: Task, scenes: Sequence[Scene], document: dict[str, Any]) -> Scene:
    number, expected = document["scene"], document["outline"]
    if number < len(scenes) and messages.same_outline(messages.outline(scenes[number]), expected):
        return scenes[number]
    raise PluginError(
        f"a worker made another scene {expected['name']!r} than this process",
        where=f"task {task.name}",
        allowed="scenes that follow from configuration, split and seed alone",
        hint="install the same version of the task everywhere; --workers 1 needs no second process",
    )


def send(pipe: BinaryIO, message: bytes) -> None:
    """Write a message after its length."""
    pipe.write(LENGTH.pack(len(message)))
    pipe.write(message)
    pipe.flush()


def receive(pipe: BinaryIO) -> bytes | None:
    """The next message, or None where the other side has gone."""
    head = pipe.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (length,) = LENGTH.unpack(head)
    message = pipe.read(length)
    return message if len(message) == length else None


def _listen(pipe: BinaryIO, asked: queue.SimpleQueue[bytes]) -> None:
    """Hand messages on; without anybody who asks, end at once, in the middle of a scene too."""
    while (message := receive(pipe)) is not None:
        asked.put(message)
    os._exit(EXIT_ALONE)


def main() -> None:
    """Serve standard input until it ends; interruptions are for the process that asks."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    asked: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, asked), daemon=True).start()
    while True:
        send(answers, answer(asked.get()))


if __name__ == "__main__":
    main()
