"""What a worker does: it makes a task's held-out scenes once, then scores sets of rays in those that it is asked about.

Scenes do not travel: a task makes the same ones from its configuration and a seed everywhere, and every job carries an
outline of its scene by which that is checked.
"""

from __future__ import annotations

import json
import threading
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from lidardesign import __version__
from lidardesign.errors import ConfigError, LidardesignError, PluginError
from lidardesign.evaluate.baselines.candidates import RaysPerCondition
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.scene_scores import ScenePass, SceneScores, score_in_scene
from lidardesign.numerics import COARSE_SLACK
from lidardesign.registry import load_task, plugin_guard
from lidardesign.scene import Mesh, Scene
from lidardesign.simulate.plan import EffectPlan, Planner
from lidardesign.space import DesignSpace
from lidardesign.task import Metric, Score, Task, metric_of, scenes_of

# Far more than processors of different makes round differently, far less than any metric tells apart [m].
OUTLINE_TOLERANCE_M = COARSE_SLACK


@dataclass(frozen=True)
class SceneSource:
    """What held-out scenes are made from.

    Arguments:
        version: Of this program.
        task: The name of an installed task.
        config: Its configuration as JSON.
        space: The design space as JSON.
        seed: Root of the effects' random streams.
        held_out_seed: Root of the scenes.
    """

    version: str
    task: str
    config: str
    space: str
    seed: int
    held_out_seed: int

    @classmethod
    def of(cls, request: EvaluationRequest | ScenePass) -> SceneSource:
        """What makes the scenes of a request, or of a pass over them."""
        config, space = json.dumps(request.config.model_dump(mode="json")), json.dumps(request.space.as_dict())
        return cls(__version__, request.task.name, config, space, request.seed, request.held_out_seed)


@dataclass(frozen=True, eq=False)
class SceneJob:
    """One held-out scene, and what is fired in it.

    Arguments:
        source: What makes the scene.
        number: Of the scene.
        outline: Of the scene that is meant.
        sets: The sets of rays.
        planner: How effects are chosen.
        plan: The plan where it is known already.
    """

    source: SceneSource
    number: int
    outline: dict[str, Any]
    sets: Sequence[RaysPerCondition]
    planner: Planner
    plan: EffectPlan | None

    @classmethod
    def of(cls, scenes: ScenePass, number: int) -> SceneJob:
        """The job of one scene of a pass."""
        return cls(
            SceneSource.of(scenes),
            number,
            scene_outline(scenes.scenes[number]),
            list(scenes.fired(number)),
            scenes.planner,
            scenes.known(number),
        )


class WorkerTraceback(Exception):  # noqa: N818 (it carries a worker's traceback and is never raised by itself)
    """Place in a worker where an error arose; LIDARDESIGN_DEBUG=1 shows it."""


@dataclass(frozen=True, eq=False)
class SceneFailure:
    """An error that a worker met, with where it arose."""

    error: Exception
    traceback: str

    @classmethod
    def of(cls, error: Exception) -> SceneFailure:
        """The error; one of no kind of this program with its name in its text, as a RuntimeError or MemoryError."""
        where = "".join(traceback.format_exception(error))
        if isinstance(error, LidardesignError):
            return cls(error, where)
        kind = MemoryError if isinstance(error, MemoryError) else RuntimeError
        return cls(kind(f"{type(error).__name__}: {' '.join(str(error).split())}"), where)

    def reraise(self) -> None:
        """Raise the error as it would have been raised in this process."""
        raise self.error from WorkerTraceback(f"\n\nin a worker:\n{self.traceback}")


# Threads of one process take turns: tasks need not be safe to be called twice at a time.
_one_at_a_time = threading.Lock()


def score_job(job: SceneJob) -> SceneScores | SceneFailure:
    """The scores in a scene, or the error that was met; it never raises."""
    with _one_at_a_time:
        try:
            task, metric, scenes = make_scenes(job.source)
            if not (job.number < len(scenes) and same_outline(scene_outline(scenes[job.number]), job.outline)):
                raise PluginError(
                    f"a worker made another scene {job.outline['name']!r} than this process",
                    where=f"task {task.name}",
                    allowed="scenes that depend on configuration, split and seed alone",
                    hint="install the same version of the task everywhere; --workers 1 needs no second process",
                )
            found = score_in_scene(
                task, metric, scenes[job.number], job.sets, job.planner, job.plan, job.source.seed
            )
            # a task may give any mapping
            scores = [(Score(one.value, one.failed, dict(one.details)), seconds) for one, seconds in found.scores]
            return SceneScores(found.plan, found.planning_seconds, scores, found.second_casts)
        except Exception as error:
            # whatever goes wrong in here is the asking side's to report
            return SceneFailure.of(error)


@lru_cache(maxsize=1)
def make_scenes(source: SceneSource) -> tuple[Task, Metric, Sequence[Scene]]:
    """The task, its metric and the held-out scenes of a source; those of the last one are kept."""
    if source.version != __version__:
        raise ConfigError(
            f"a worker has lidardesign {__version__}",
            where="--workers",
            allowed=source.version,
            hint="install the same version everywhere",
        )
    task = load_task(source.task)
    config, space = task.Config.model_validate(json.loads(source.config)), json.loads(source.space)
    with plugin_guard(task.name):
        scenes = scenes_of(task, config, "test", source.held_out_seed, DesignSpace.from_dict(space))
        return task, metric_of(task, config), list(scenes)


def scene_outline(scene: Scene) -> dict[str, Any]:
    """What tells a scene from others: its name, frames and bodies, and where these are on average [m]."""

    def extent(shape: Any) -> list[float]:
        if isinstance(shape, Mesh):
            return [float(len(shape.faces)), *shape.vertices.mean(axis=0), *shape.vertices.std(axis=0)]
        return [float(number) for value in vars(shape).values() for number in np.atleast_1d(value)]

    bodies = [[body.name, body.role, type(body.shape).__name__] for body in scene.bodies]
    places = [[*body.poses.reshape(-1, 16).mean(axis=0), *extent(body.shape)] for body in scene.bodies]
    return {"name": scene.name, "frames": scene.frames, "bodies": bodies, "places": places}


def same_outline(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two outlines are of the same scene, but for how processors round."""
    if any(one[name] != other[name] for name in ("name", "frames", "bodies")):
        return False
    pairs = zip(one["places"], other["places"], strict=True)
    return all(len(a) == len(b) and np.allclose(a, b, rtol=0.0, atol=OUTLINE_TOLERANCE_M) for a, b in pairs)
