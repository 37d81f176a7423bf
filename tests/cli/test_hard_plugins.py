"""Tasks that break the contract while they are evaluated: one message that names them, and exit 6."""

from __future__ import annotations

import os

import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.conditioned_runs import make_conditioned_run

from lidardesign import open_run
from lidardesign.errors import PluginError
from lidardesign.space import DesignSpace
from lidardesign.task import scenes_of


def broken():
    raise RuntimeError("the map is lost")


# what `conditions` gives, exit code, words of the message
CONDITIONS = {
    "raises": (broken, 6, "the map is lost"),
    "none": (lambda: None, 6, "task flatland"),
    "a number": (lambda: 5, 6, "task flatland"),
    "numbers": (lambda: [1.0], 6, "task flatland"),
    "text": (lambda: [{"x_m": "far"}], 6, "far"),
    "nothing": (list, 6, "no condition value"),
    "open": (lambda: [{}], 6, "x_m open"),
    "outside": (lambda: [{"x_m": 99.0}], 2, "task flatland, conditions: x_m=99 is outside"),
    "nan": (lambda: [{"x_m": float("nan")}], 2, "task flatland, conditions: x_m=nan is outside"),
    "another dimension": (lambda: [{"x_m": 0.5, "z_m": 0.0}], 2, "'z_m' is not a condition"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    opened = open_run(make_conditioned_run(tmp_path_factory.mktemp("runs") / "run", count=3000))
    opened.fit(sensors=1, rays=3, name="fit").save()
    return opened.folder


@pytest.mark.parametrize("given", CONDITIONS)
def test_conditions_that_are_none_are_the_tasks_fault_and_no_traceback(lidardesign, run, monkeypatch, given):
    answer, code, words = CONDITIONS[given]
    monkeypatch.setattr(FlatlandTask, "conditions", lambda self, config: answer(), raising=False)
    result = lidardesign("evaluate", run, "--rays", 3, "--json")
    assert result.code == code, result.err
    assert words in result.err
    assert "internal error" not in result.err


def test_scenes_that_are_none_are_the_tasks_fault():
    task = FlatlandTask()
    task.scenes = lambda config, split, seed: [{"bodies": []}]
    with pytest.raises(PluginError, match=r"scenes\(\) returned a dict"):
        scenes_of(task, None, "train", 0, DesignSpace((0.0,) * 6, (1.0,) * 6))


def fork():
    if child := os.fork():
        os.waitpid(child, 0)


@pytest.mark.parametrize(
    ("does", "code"), [(lambda: os._exit(0), 6), (lambda: os.chdir("/"), 0), (lambda: os.umask(0o777), 0), (fork, 0)]
)
def test_scoring_neither_ends_nor_moves_nor_multiplies_the_program(lidardesign, run, monkeypatch, tmp_path, does, code):
    scores = FlatlandTask.score
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(FlatlandTask, "score", lambda *given: (does(), scores(*given))[1])
    result = lidardesign("evaluate", run, "--rays", 3, "--baseline", "none", "--csv", "scores.csv")
    with open("ends", "a") as ends:
        ends.write(f"{os.getpid()}\n")
    assert (tmp_path / "ends").read_text() == f"{os.getpid()}\n"
    assert result.code == code, result.err
    assert [path.stat().st_mode & 0o600 for path in tmp_path.glob("*.csv")] == [0o600] * (code == 0)
