"""What goes to workers and comes back: plain numbers, text and arrays as bytes, without pickle.

A message is an npz archive with one JSON document in it. Numbers come through unchanged to the last bit. Scenes do not
travel: a task makes the same ones from its configuration and a seed everywhere, and every request carries an outline of
its scene by which that is checked.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lidardesign import errors
from lidardesign.errors import LidardesignError
from lidardesign.evaluate.candidates import Positions
from lidardesign.evaluate.passes import SceneScores
from lidardesign.numerics import COARSE_SLACK
from lidardesign.scene import Mesh, Scene
from lidardesign.simulate.detector import Detector, Photons
from lidardesign.simulate.plan import Bound, Decision, Plan, Planner, Tolerance
from lidardesign.simulate.returns import Rays
from lidardesign.simulate.triangles import SecondCasts
from lidardesign.task import Score

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


def plan_from_document(document: dict[str, Any]) -> Plan:
    """The inverse of `dataclasses.asdict` for a plan."""
    decisions = (Decision(**{**one, "bound": Bound(**one["bound"])}) for one in document["decisions"])
    return Plan(tuple(decisions), Tolerance(**document["tolerance"]))


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
