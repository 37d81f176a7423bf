"""A worker: makes a task's held-out scenes once, then scores sets of rays in those that it is asked about.

`answer` takes and gives bytes and never raises, so it serves any engine. As a program of its own
(`python -m lidardesign.evaluate.workers.worker`) it serves a pipe: messages come on standard input and answers go to
standard output, each after its length. What the task or a library prints goes to standard error.

What goes to workers and comes back: plain numbers, text and arrays as bytes, without pickle.

A message is an npz archive with one JSON document in it. Numbers come through unchanged to the last bit. Scenes do not
travel: a task makes the same ones from its configuration and a seed everywhere, and every request carries an outline of
its scene by which that is checked.
"""

from __future__ import annotations

import io
import json
import os
import queue
import signal
import struct
import sys
import threading
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, BinaryIO

import numpy as np

from lidardesign import __version__, errors
from lidardesign.errors import ConfigError, LidardesignError, PluginError
from lidardesign.evaluate.baselines.candidates import Positions
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.scene_scores import ScenePass, SceneScores, score_in_scene
from lidardesign.evaluate.workers import worker as messages
from lidardesign.geometry.rays import Rays
from lidardesign.geometry.triangles import SecondCasts
from lidardesign.numerics import COARSE_SLACK
from lidardesign.registry import load_task, plugin_guard
from lidardesign.scene import Mesh, Scene
from lidardesign.simulate.detector.detector import Detector, Photons
from lidardesign.simulate.plan import Bound, Decision, EffectPlan, Planner, Tolerance
from lidardesign.space import DesignSpace
from lidardesign.task import Score, Task, scenes_of

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


RAY_FIELDS = ("origin_m", "direction", "gate_m", "sensor", "time_s")
# Far more than processors of different makes round differently, far less than any metric tells apart [m].
OUTLINE_TOLERANCE_M = COARSE_SLACK
DOCUMENT = "document"


def pack(document: dict[str, Any], **arrays: np.ndarray) -> bytes:
    """A document of plain values and arrays by name, as bytes."""
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
    np.savez(buffer, **{DOCUMENT: text}, **arrays)
    return buffer.getvalue()


def unpack(message: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The document and the arrays of a message."""
    with np.load(io.BytesIO(message), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return json.loads(arrays.pop(DOCUMENT).tobytes()), arrays


def rays_as_arrays(lists: Sequence[Positions]) -> tuple[list[list[int]], dict[str, np.ndarray]]:
    """Sets of rays as the numbers of rays at every position, and all rays one after the other."""
    every = [rays for positions in lists for rays in positions]
    arrays = {name: np.concatenate([getattr(rays, name) for rays in every]) for name in RAY_FIELDS} if every else {}
    return [[len(rays) for rays in positions] for positions in lists], arrays


def rays_from_arrays(counts: list[list[int]], arrays: dict[str, np.ndarray]) -> list[Positions]:
    """The inverse of `rays_as_arrays`."""
    lists, start = [], 0
    for set_counts in counts:
        positions = []
        for count in set_counts:
            positions.append(Rays(**{name: arrays[name][start : start + count] for name in RAY_FIELDS}))
            start += count
        lists.append(tuple(positions))
    return lists


def planner_as_document(planner: Planner) -> dict[str, Any]:
    """A planner as plain values."""
    choice = planner.choice if isinstance(planner.choice, str) else sorted(planner.choice)
    tolerance = None if planner.tolerance is None else asdict(planner.tolerance)
    return {"detector": asdict(planner.detector), "choice": choice, "tolerance": tolerance}


def planner_from_document(document: dict[str, Any]) -> Planner:
    """The inverse of `planner_as_document`."""
    values = dict(document["detector"])
    photons = values.pop("photons")
    detector = Detector(**values, photons=None if photons is None else Photons(**photons))
    choice, tolerance = document["choice"], document["tolerance"]
    return Planner(
        detector,
        choice if isinstance(choice, str) else frozenset(choice),
        None if tolerance is None else Tolerance(**tolerance),
    )


def plan_from_document(document: dict[str, Any]) -> EffectPlan:
    """The inverse of `dataclasses.asdict` for a plan."""
    decisions = (Decision(**{**one, "bound": Bound(**one["bound"])}) for one in document["decisions"])
    return EffectPlan(tuple(decisions), Tolerance(**document["tolerance"]))


def scores_as_document(found: SceneScores) -> dict[str, Any]:
    """What came of a scene as plain values."""
    scores = [
        {
            "value": float(score.value),
            "failed": bool(score.failed),
            "details": {name: float(value) for name, value in score.details.items()},
            "seconds": seconds,
        }
        for score, seconds in found.scores
    ]
    return {
        "plan": asdict(found.plan),
        "planning_seconds": found.planning_seconds,
        "scores": scores,
        "second_casts": asdict(found.second_casts),
    }


def scores_from_document(document: dict[str, Any]) -> SceneScores:
    """The inverse of `scores_as_document`."""
    scores = [(Score(one["value"], one["failed"], one["details"]), one["seconds"]) for one in document["scores"]]
    second_casts = SecondCasts(**document["second_casts"])
    return SceneScores(plan_from_document(document["plan"]), document["planning_seconds"], scores, second_casts)


def outline(scene: Scene) -> dict[str, Any]:
    """What tells a scene from others: its name, frames and bodies, and where these are on average [m]."""
    bodies = [[body.name, body.role, type(body.shape).__name__] for body in scene.bodies]
    places = [
        [*body.poses.reshape(-1, 16).mean(axis=0), *_extent(body.shape)] for body in scene.bodies
    ]
    return {"name": scene.name, "frames": scene.frames, "bodies": bodies, "places": places}


def _extent(shape: Any) -> list[float]:
    if isinstance(shape, Mesh):
        return [float(len(shape.faces)), *shape.vertices.mean(axis=0), *shape.vertices.std(axis=0)]
    return [float(number) for value in vars(shape).values() for number in np.atleast_1d(value)]


def same_outline(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two outlines are of the same scene, but for how processors round."""
    if any(one[name] != other[name] for name in ("name", "frames", "bodies")):
        return False
    pairs = zip(one["places"], other["places"], strict=True)
    return all(len(a) == len(b) and np.allclose(a, b, rtol=0.0, atol=OUTLINE_TOLERANCE_M) for a, b in pairs)


@dataclass(frozen=True)
class _Failure:
    """Keys of an error that travels."""

    kind: str
    message: str
    where: str | None
    allowed: str | None
    hint: str | None
    traceback: str


class WorkerTraceback(Exception):  # noqa: N818 (it carries a worker's traceback and is never raised by itself)
    """Where in a worker an error arose; the cause of the error that this process raises, shown by `--debug`."""


def error_as_document(error: BaseException, traceback: str) -> dict[str, Any]:
    """An error with the traceback of its worker, as plain values."""
    if isinstance(error, LidardesignError):
        return asdict(_Failure(type(error).__name__, error.message, error.where, error.allowed, error.hint, traceback))
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return asdict(_Failure(type(error).__name__, text, None, None, None, traceback))


def raise_from_document(document: dict[str, Any]) -> None:
    """Raise an error of a worker as it would have been raised here.

    Raises:
        LidardesignError: The error that the worker met.
        MemoryError: The worker had no memory left.
        RuntimeError: A fault of this program, with its name and text.
    """
    failure = _Failure(**document)
    cause = WorkerTraceback(f"\n\nin a worker:\n{failure.traceback}")
    kind = getattr(errors, failure.kind, None)
    if failure.kind == MemoryError.__name__:
        raise MemoryError(failure.message) from cause
    if kind is None:
        raise RuntimeError(failure.message) from cause
    raise kind(failure.message, where=failure.where, allowed=failure.allowed, hint=failure.hint) from cause
