"""Held-out scenes scored by workers: the same rows for any number of them, in any order."""

from __future__ import annotations

import itertools
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from multiprocessing.reduction import ForkingPickler
from types import MappingProxyType

import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.scoring import MissTask
from support.workers import make_request, random_rays, results

from lidardesign import errors, workers
from lidardesign.errors import ConfigError, LidardesignError, PluginError
from lidardesign.evaluation.score import evaluate
from lidardesign.scoring.scene_scores import score_scenes
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.plan import Planner
from lidardesign.task import Score
from lidardesign.workers import check_workers, opened_workers


def arrived(thing):
    """What an executor makes of something on the way to a worker, or back."""
    return ForkingPickler.loads(ForkingPickler.dumps(thing))


class BackwardExecutor(Executor):
    """Does the last of all the jobs that it has first, in this process."""

    def __init__(self):
        self.asked, self._waiting = 0, []

    def submit(self, function, /, *arguments):
        future = Future()
        self.asked += 1
        self._waiting.append((future, partial(function, *map(arrived, arguments))))
        if len(self._waiting) == 2:
            for other, job in reversed(self._waiting):
                try:
                    other.set_result(arrived(job()))
                except LidardesignError as error:
                    other.set_exception(arrived(error))
            self._waiting.clear()
        return future


@pytest.fixture
def executor():
    return BackwardExecutor()


@pytest.fixture
def starmap(executor):
    return partial(workers._map_there, executor.submit, lambda: 2, FlatlandTask())


def test_rows_do_not_depend_on_who_scores_or_in_which_order(starmap):
    request = make_request()
    assert results(evaluate(replace(request, starmap=starmap))) == results(evaluate(request))


def test_effects_are_planned_and_audited_by_workers_as_they_are_here():
    planner = Planner(load_detector("single-photon"))
    request = make_request(planner=planner, audit=True, rays=(8,), equal_bandwidth=False, baselines=("uniform",))
    request = replace(request, test=request.test[:2])
    starmap = partial(workers._map_there, BackwardExecutor().submit, lambda: 0, request.task)
    assert results(evaluate(replace(request, starmap=starmap))) == results(evaluate(request))


@pytest.mark.parametrize("kind", ["ConfigError", "DataError", "PluginError", "NumericalError", "InfeasibleError"])
def test_errors_arrive_whole(kind):
    error = getattr(errors, kind)("found", where="here", allowed="this", hint="that")
    assert arrived(error).as_dict() == error.as_dict()
    assert (type(arrived(error)), str(arrived(error))) == (type(error), str(error))


def test_details_of_any_mapping_arrive(monkeypatch, starmap):
    monkeypatch.setattr(
        FlatlandTask, "score", lambda self, scene, returns: Score(0.5, details=MappingProxyType({"seen": 3.0}))
    )
    evaluation = evaluate(make_request(starmap=starmap))
    assert evaluation.rows[0].details == {"seen": 3.0}


def test_progress_names_each_scene_before_it_is_waited_for(starmap):
    counted = []
    evaluate(make_request(starmap=starmap), progress=lambda *arguments: counted.append(arguments))
    assert counted == [*((f"test {number}", number, 6) for number in range(6)), ("", 6, 6)]


def test_the_first_scenes_error_is_raised_and_no_further_scene_is_begun(monkeypatch, starmap, executor):
    def score(self, scene, returns):
        if scene.name in ("test 0", "test 1"):
            raise ValueError(f"no score of {scene.name}")
        return Score(1.0)

    monkeypatch.setattr(FlatlandTask, "score", score)
    asked = make_request()
    with pytest.raises(PluginError, match="no score of test 0"):
        score_scenes(
            asked.task,
            asked.metric,
            asked.seed,
            asked.test,
            lambda number: [(random_rays(3, number),)],
            Planner(),
            starmap=starmap,
        )
    assert executor.asked < 6


def test_a_worker_of_another_version_is_refused():
    with pytest.raises(ConfigError, match="the cluster has lidardesign"):
        workers._call("lidardesign 9.9", FlatlandTask(), divmod, 7, 3)


@pytest.mark.parametrize("task", [type("Other", (FlatlandTask,), {})(), MissTask()])
def test_a_task_that_is_not_installed_is_refused_before_any_worker_is_asked(task):
    with pytest.raises(ConfigError, match=task.name), opened_workers("tcp://127.0.0.1:1", task, 6):
        pass


GOOD = {"1": 1, " 4 ": 4, "1024": 1024, "tcp://10.0.0.7:8786": "tcp://10.0.0.7:8786", "tcp://[::1]:1": "tcp://[::1]:1"}
BAD = ("0", "-1", "1025", "1.5", "", "two", "tcp://", "tcp://host", "tcp://host:0", "tcp://host:99999", "tcp://a:b:1")
BAD += ("http://host:80", "tcp://host:80/x", "99999999999999999999", "tcp:// :80", "²")


@pytest.mark.parametrize("text", GOOD)
def test_workers_are_a_number_or_an_address(text):
    assert check_workers(text) == GOOD[text]


@pytest.mark.parametrize("text", BAD)
def test_workers_that_are_neither_are_refused(text):
    with pytest.raises(ConfigError, match="--workers"):
        check_workers(text)


@pytest.mark.parametrize(("count", "scenes"), [(1, 9), (8, 1)])
def test_one_process_is_this_one(count, scenes):
    with opened_workers(count, MissTask(), scenes) as starmap:
        assert starmap is itertools.starmap
