"""Held-out scenes scored by workers: the same rows for any number of them, in any order, whoever is lost."""

from __future__ import annotations

import math
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.scoring import MissTask
from support.tables import each_row
from support.workers import SEED, make_request, random_rays, results

from lidardesign import errors
from lidardesign.errors import ConfigError, LidardesignError, PluginError
from lidardesign.evaluate.scene_scores import SceneScores
from lidardesign.evaluate.score import evaluate
from lidardesign.evaluate.workers import worker
from lidardesign.evaluate.workers.pool import WorkerScorer, check_workers, workers_of
from lidardesign.evaluate.workers.worker import (
    SceneFailure,
    SceneJob,
    make_scenes,
    same_outline,
    scene_outline,
    score_job,
)
from lidardesign.scene import Body, Mesh, Scene, Sphere, rigid
from lidardesign.simulate.detector.files import detector_names, load_detector
from lidardesign.simulate.plan import Planner, Tolerance
from lidardesign.simulate.simulate import build_casters
from lidardesign.task import Score


class ShuffledEngine:
    """Does all jobs in this process, in a random order."""

    def __init__(self, seed):
        self._generator = np.random.default_rng(seed)
        self._threads, self._waiting = ThreadPoolExecutor(1), []
        self.closed, self.asked = False, 0

    def prepare(self, source):
        make_scenes(source)

    def at_once(self):
        return 100

    def submit(self, job):
        future = Future()
        self.asked += 1
        self._waiting.append((future, job))
        self._threads.submit(self._answer)
        return future

    def _answer(self):
        future, job = self._waiting.pop(self._generator.integers(len(self._waiting)))
        future.set_result(score_job(arrived(job)))

    def check(self):
        pass

    def close(self):
        self._threads.shutdown()
        self.closed = True


class BackwardEngine(ShuffledEngine):
    """Does the last of two jobs first."""

    def at_once(self):
        return 2

    def submit(self, job):
        future = Future()
        self.asked += 1
        self._waiting.append((future, job))
        if len(self._waiting) == 2:
            for other, asked in reversed(self._waiting):
                other.set_result(score_job(asked))
            self._waiting.clear()
        return future


def arrived(thing):
    """What an executor makes of something on the way to a worker, or back."""
    return ForkingPickler.loads(ForkingPickler.dumps(thing))


@each_row("name", detector_names())
@each_row("choice", ["auto", "all", frozenset({"jitter", "footprint"})])
def test_jobs_and_scores_arrive_to_the_last_bit(name, choice):
    request = make_request(planner=Planner(load_detector(name), choice, Tolerance(1e-3 / 3, 0.1)))
    scene = Scene((Body(Sphere(0.4), poses=rigid(translation_m=(2, 0, 0))),))
    plan = Planner(load_detector(name)).plan(scene, [random_rays(5, 0)], build_casters(scene))
    sets = [(random_rays(2, 1), random_rays(2, 2)), (random_rays(0, 3),)]
    job = SceneJob.of(request.scene_pass(lambda number: sets, request.planner, [plan]), 0)
    again = arrived(job)
    assert (again.source, again.number, again.outline) == (job.source, job.number, job.outline)
    assert (again.planner, again.plan) == (job.planner, job.plan)
    for positions, others in zip(job.sets, again.sets, strict=True):
        for rays, other in zip(positions, others, strict=True):
            for field in ("origin_m", "direction", "gate_m", "sensor", "time_s"):
                assert getattr(rays, field).tobytes() == getattr(other, field).tobytes()
    details = {"seen": np.float32(0.1), "n": 3, "far": -math.inf}
    scores = arrived(SceneScores(plan, 0.1 / 3, [(Score(1 / 3, False, details), 0.25)]))
    assert (scores.plan, scores.planning_seconds) == (plan, 0.1 / 3)
    assert scores.scores == [(Score(1 / 3, False, details), 0.25)]


def test_an_outline_tells_scenes_apart_but_not_roundings():
    request = make_request()
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]), "unsigned")
    base = Scene((Body(mesh), Body(Sphere(0.3), "ball")), "mixed")
    assert same_outline(scene_outline(base), scene_outline(base))
    for scene in request.test[1:]:
        assert not same_outline(scene_outline(request.test[0]), scene_outline(scene))

    def moved(by_m):
        shifted = Mesh(mesh.vertices + np.array([by_m, 0, 0]), mesh.faces, "unsigned")
        return scene_outline(Scene((Body(shifted), Body(Sphere(0.3), "ball")), "mixed"))

    assert same_outline(scene_outline(base), moved(1e-12))
    assert not same_outline(scene_outline(base), moved(1e-3))
    renamed = replace(base, name="other")
    assert not same_outline(scene_outline(base), scene_outline(renamed))


@each_row("kind", ["ConfigError", "DataError", "PluginError", "NumericalError", "InfeasibleError"])
def test_errors_arrive_whole_with_the_workers_traceback(kind):
    def failing():
        raise getattr(errors, kind)("found", where="here", allowed="this", hint="that")

    with pytest.raises(LidardesignError) as first:
        failing()
    with pytest.raises(type(first.value)) as raised:
        arrived(SceneFailure.of(first.value)).reraise()
    assert raised.value.as_dict() == first.value.as_dict()
    assert str(raised.value) == str(first.value)
    assert "in failing" in str(raised.value.__cause__)


@pytest.mark.parametrize(("error", "kind"), [(MemoryError("full"), MemoryError), (KeyError("x"), RuntimeError)])
def test_errors_of_other_kinds_keep_their_name(error, kind):
    with pytest.raises(kind, match=type(error).__name__):
        arrived(SceneFailure.of(error)).reraise()


@pytest.mark.parametrize("seed", range(3))
def test_rows_do_not_depend_on_the_order_of_answers(seed):
    request = make_request()
    engine = ShuffledEngine(seed)
    with WorkerScorer(engine) as scorer:
        scorer.prepare(request)
        assert results(evaluate(replace(request, scorer=scorer))) == results(evaluate(request))
    assert engine.closed


def test_effects_are_planned_and_audited_by_workers_as_they_are_here():
    request = make_request(
        planner=Planner(load_detector("single-photon")), audit=True, rays=(8,), equal_bandwidth=False
    )
    request = replace(request, test=request.test[:2])
    with WorkerScorer(ShuffledEngine(0)) as scorer:
        assert results(evaluate(replace(request, scorer=scorer))) == results(evaluate(request))


def test_progress_counts_scenes_and_never_goes_back():
    told = []
    request = make_request()
    with WorkerScorer(ShuffledEngine(1)) as scorer:
        evaluate(replace(request, scorer=scorer), progress=lambda done, total, name: told.append((done, total)))
    assert [total for _, total in told] == [6] * len(told)
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[0][0] == 0
    assert told[-1][0] == 6


def test_the_first_scenes_error_is_raised_and_no_further_scene_is_begun(monkeypatch):
    def score(self, scene, returns):
        if scene.name in ("test 2", "test 3"):
            raise ValueError(f"no score of {scene.name}")
        return Score(1.0)

    monkeypatch.setattr(FlatlandTask, "score", score)
    engine = BackwardEngine(0)
    scenes = make_request().scene_pass(lambda number: [(random_rays(3, number),)], Planner())
    with WorkerScorer(engine) as scorer, pytest.raises(PluginError, match="no score of test 2"):
        scorer(scenes, None)
    assert engine.asked < 6


def test_scenes_that_a_worker_makes_otherwise_are_refused():
    request = make_request()
    other = replace(request, test=request.task.scenes(request.config, "test", SEED + 1))
    with WorkerScorer(ShuffledEngine(0)) as scorer, pytest.raises(PluginError, match="another scene 'test 0'"):
        evaluate(replace(other, scorer=scorer))


def test_a_worker_of_another_version_is_refused(monkeypatch):
    request = make_request()
    job = SceneJob.of(request.scene_pass(lambda number: [], Planner()), 0)
    make_scenes.cache_clear()
    monkeypatch.setattr(worker, "__version__", "9.9")
    with pytest.raises(ConfigError, match=r"has lidardesign 9\.9"):
        score_job(job).reraise()


def test_a_task_that_is_not_installed_is_refused_before_any_worker_is_asked():
    class Engine(ShuffledEngine):
        def prepare(self, source):
            raise AssertionError("asked")

    for task in (type("Other", (FlatlandTask,), {})(), MissTask()):
        with pytest.raises(ConfigError, match=f"{task.name}"):
            WorkerScorer(Engine(0)).prepare(make_request(task=task))


GOOD = {"1": 1, " 4 ": 4, "1024": 1024, "tcp://10.0.0.7:8786": "tcp://10.0.0.7:8786", "tcp://[::1]:1": "tcp://[::1]:1"}
BAD = ("0", "-1", "1025", "1.5", "", "two", "tcp://", "tcp://host", "tcp://host:0", "tcp://host:99999", "tcp://a:b:1")
BAD += ("http://host:80", "tcp://host:80/x", "99999999999999999999", "tcp:// :80", "²")


@each_row("text", GOOD)
def test_workers_are_a_number_or_an_address(text):
    assert check_workers(text) == GOOD[text]


@each_row("text", BAD)
def test_workers_that_are_neither_are_refused(text):
    with pytest.raises(ConfigError, match="--workers"):
        check_workers(text)


def test_one_process_is_no_worker():
    for wanted, most in ((1, 9), (8, 1)):
        with workers_of(wanted, most) as scorer:
            assert scorer is None
