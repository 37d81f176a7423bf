"""Held-out scenes scored by workers: the same rows for any number of them, in any order, whoever is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.scoring import MissTask
from support.tables import each_row
from support.workers import SEED, make_request, results

from lidardesign import errors
from lidardesign.errors import ConfigError, PluginError
from lidardesign.evaluate.scene_scores import ScenePass, SceneScores
from lidardesign.evaluate.score import evaluate
from lidardesign.evaluate.workers import worker
from lidardesign.evaluate.workers import worker as messages
from lidardesign.evaluate.workers.pool import WorkerScorer, check_workers, workers_of
from lidardesign.geometry.rays import Rays
from lidardesign.scene import Body, Mesh, Scene, Sphere, rigid
from lidardesign.simulate.detector.files import detector_names, load_detector
from lidardesign.simulate.plan import Planner, Tolerance
from lidardesign.simulate.simulate import build_casters
from lidardesign.task import Score


class ShuffledEngine:
    """Answers all questions in this process, in a random order."""

    def __init__(self, seed):
        self._generator = np.random.default_rng(seed)
        self.closed = False

    def prepare(self, message):
        document, _ = messages.unpack(worker.answer(message))
        assert document == {}

    def answers(self, questions):
        asked = list(questions)
        for number in self._generator.permutation(len(asked)):
            yield int(number), worker.answer(asked[number])

    def close(self):
        self.closed = True


class OrderedEngine(ShuffledEngine):
    """Answers the last of two questions first, and counts them."""

    asked = 0

    def answers(self, questions):
        waiting = []
        for number, message in enumerate(questions):
            self.asked += 1
            waiting.append((number, message))
            if len(waiting) == 2:
                number, message = waiting.pop()
                yield number, worker.answer(message)
        for number, message in waiting:
            yield number, worker.answer(message)


def random_rays(count, seed):
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, 3))
    return Rays(
        generator.normal(size=(count, 3)),
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        np.sort(generator.random((count, 2)), axis=1),
        generator.integers(0, 9, count),
        generator.random(count),
    )


@pytest.mark.parametrize("counts", [[[3]], [[2, 2], [0, 0], [5, 5]], [[0]], []])
def test_rays_arrive_to_the_last_bit(counts):
    lists = [
        tuple(random_rays(n, 10 * i + j) for j, n in enumerate(positions)) for i, positions in enumerate(counts)
    ]
    found, arrays = messages.rays_as_arrays(lists)
    document, arrived = messages.unpack(messages.pack({"counts": found}, **arrays))
    again = messages.rays_from_arrays(document["counts"], arrived)
    assert [[len(rays) for rays in positions] for positions in again] == counts
    for positions, others in zip(lists, again, strict=True):
        for rays, other in zip(positions, others, strict=True):
            for name in messages.RAY_FIELDS:
                assert getattr(rays, name).tobytes() == getattr(other, name).tobytes()


@each_row("name", detector_names())
@each_row("choice", ["auto", "all", frozenset({"jitter", "footprint"})])
def test_planners_and_plans_arrive_whole(name, choice):
    detector = load_detector(name)
    for tolerance in (None, Tolerance(1e-3 / 3, 0.1)):
        planner = Planner(detector, choice, tolerance)
        arrived, _ = messages.unpack(messages.pack(messages.planner_as_document(planner)))
        assert messages.planner_from_document(arrived) == planner
    scene = Scene((Body(Sphere(0.4), poses=rigid(translation_m=(2, 0, 0))),))
    plan = Planner(detector).plan(scene, [random_rays(5, 0)], build_casters(scene))
    found = SceneScores(plan, 0.1 / 3, [(Score(1 / 3, False, {"seen": np.float32(0.1), "n": 3}), 0.25)])
    arrived, _ = messages.unpack(messages.pack(messages.scores_as_document(found)))
    again = messages.scores_from_document(arrived)
    assert again.plan == plan
    assert again.planning_seconds == found.planning_seconds
    assert again.scores == [(Score(1 / 3, False, {"seen": float(np.float32(0.1)), "n": 3.0}), 0.25)]


def test_details_that_are_not_finite_arrive_as_they_are():
    plan = Planner().plan(make_request().test[0], [], [])
    found = SceneScores(plan, 0.0, [(Score(5.0, True, {"a": math.nan, "b": -math.inf}), 0.0)])
    arrived, _ = messages.unpack(messages.pack(messages.scores_as_document(found)))
    details = messages.scores_from_document(arrived).scores[0][0].details
    assert math.isnan(details["a"])
    assert details["b"] == -math.inf


def test_an_outline_tells_scenes_apart_but_not_roundings():
    request = make_request()
    mesh = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]), "unsigned")
    base = Scene((Body(mesh), Body(Sphere(0.3), "ball")), "mixed")
    assert messages.same_outline(messages.outline(base), messages.outline(base))
    for scene in request.test[1:]:
        assert not messages.same_outline(messages.outline(request.test[0]), messages.outline(scene))

    def moved(by_m):
        shifted = Mesh(mesh.vertices + np.array([by_m, 0, 0]), mesh.faces, "unsigned")
        return messages.outline(Scene((Body(shifted), Body(Sphere(0.3), "ball")), "mixed"))

    assert messages.same_outline(messages.outline(base), moved(1e-12))
    assert not messages.same_outline(messages.outline(base), moved(1e-3))
    renamed = replace(base, name="other")
    assert not messages.same_outline(messages.outline(base), messages.outline(renamed))


@each_row("kind", ["ConfigError", "DataError", "PluginError", "NumericalError", "InfeasibleError"])
def test_errors_arrive_whole_with_the_workers_traceback(kind):
    error = getattr(errors, kind)("found", where="here", allowed="this", hint="that")
    document, _ = messages.unpack(messages.pack(messages.error_as_document(error, "line 7")))
    with pytest.raises(type(error)) as raised:
        messages.raise_from_document(document)
    assert raised.value.as_dict() == error.as_dict()
    assert "line 7" in str(raised.value.__cause__)


@pytest.mark.parametrize(("error", "kind"), [(MemoryError("full"), MemoryError), (KeyError("x"), RuntimeError)])
def test_errors_of_other_kinds_keep_their_name(error, kind):
    with pytest.raises(kind, match=type(error).__name__):
        messages.raise_from_document(messages.error_as_document(error, ""))


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
    engine = OrderedEngine(0)
    fired = ScenePass(lambda number: [(random_rays(3, number),)], Planner())
    with WorkerScorer(engine) as scorer, pytest.raises(PluginError, match="no score of test 2"):
        scorer(make_request(), fired, None)
    assert engine.asked < 6


def test_scenes_that_a_worker_makes_otherwise_are_refused():
    request = make_request()
    other = replace(request, test=request.task.scenes(request.config, "test", SEED + 1))
    with WorkerScorer(ShuffledEngine(0)) as scorer, pytest.raises(PluginError, match="another scene 'test 0'"):
        evaluate(replace(other, scorer=scorer))


def test_a_worker_of_another_version_is_refused(monkeypatch):
    request = make_request()
    asked = worker.preparation(request)
    monkeypatch.setattr(worker, "__version__", "9.9")
    document, _ = messages.unpack(worker.answer(asked))
    with pytest.raises(ConfigError, match=r"has lidardesign 9\.9"):
        messages.raise_from_document(document["error"])


def test_a_task_that_is_not_installed_is_refused_before_any_worker_is_asked():
    class Engine(ShuffledEngine):
        def prepare(self, message):
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
