"""Workers that are processes of this machine: a lost one ends the evaluation, and none outlives the program."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from multiprocessing.context import SpawnProcess

import psutil
import pytest
from support.command_line import make_run, program
from support.plugins import install_plugins
from support.workers import make_request, results

from lidardesign.api.run import open_run
from lidardesign.errors import ConfigError, NumericalError, PluginError
from lidardesign.evaluation.score import evaluate
from lidardesign.task import load_task
from lidardesign.workers import opened_workers


def test_processes_score_as_this_one_does_and_end():
    request, before = make_request(), multiprocessing.active_children()
    with opened_workers(2, request.task, 6) as starmap:
        assert results(evaluate(replace(request, starmap=starmap))) == results(evaluate(request))
        assert len(multiprocessing.active_children()) == len(before) + 2
    assert multiprocessing.active_children() == before


def test_a_worker_that_dies_ends_the_evaluation_with_what_to_do(install):
    dies = "os.kill(os.getpid(), 9)"
    task = install(f"import os\n{BROKEN}".replace('raise RuntimeError("the map of test 1 is lost")', dies))
    request = make_request(task=task)
    with pytest.raises(NumericalError, match="died") as raised, opened_workers(2, task, 6) as starmap:
        evaluate(replace(request, starmap=starmap))
    assert "memory" in raised.value.hint


def test_a_system_that_allows_fewer_processes_leaves_none(monkeypatch):
    started, start = [], SpawnProcess.start

    def limited(self):
        if len(started) == 1:
            raise BlockingIOError(11, "Resource temporarily unavailable")
        start(self)
        started.append(self)

    monkeypatch.setattr(SpawnProcess, "start", limited)
    with (
        pytest.raises(ConfigError, match="3 processes could not be started: Resource"),
        opened_workers(3, make_request().task, 6),
    ):
        pass
    assert not started[0].is_alive()


def test_a_script_is_not_run_again_by_its_workers(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "print('begun', flush=True)\n"
        "from support.workers import make_request\n"
        "from lidardesign.workers import opened_workers\n"
        "request = make_request()\n"
        "with opened_workers(2, request.task, 2) as starmap:\n"
        "    print(*starmap(pow, [(2, 3), (3, 2)]))\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["begun", "8", "9"]


BROKEN = """
from lidardesign_tasks.flatland import FlatlandTask

class Task(FlatlandTask):
    name = "NAME"

    def score(self, scene, returns):
        if scene.name == "test 1":
            raise RuntimeError("the map of test 1 is lost")
        return super().score(scene, returns)
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Installs a task by its source."""

    def installed(source):
        install_plugins(tmp_path / "site", {"broken": source})
        monkeypatch.syspath_prepend(tmp_path / "site")
        return load_task("broken")

    yield installed
    sys.modules.pop("plugins_broken", None)


def test_what_a_plugin_raises_in_a_worker_arrives_whole(install):
    task = install(BROKEN)
    request, said = make_request(task=task), []
    for count in (1, 2):
        with (
            pytest.raises(PluginError, match="the map of test 1 is lost") as raised,
            opened_workers(count, task, 6) as starmap,
        ):
            evaluate(replace(request, starmap=starmap))
        said.append(raised.value.as_dict())
    assert said[0] == said[1]
    assert "plugins_broken.py" in str(raised.value.__cause__)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = make_run(tmp_path_factory.mktemp("runs") / "run", count=1000)
    open_run(folder).fit(layout="even", sensors=1).save()
    return folder


def children(pid):
    """Processes that a process started and that run."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return [child.pid for child in psutil.Process(pid).children() if runs(child.pid)]
    return []


def runs(pid):
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    return False


def wait_until(condition, seconds=60.0):
    """Poll; whether it became true in good time."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


USING_WORKERS = {
    "evaluate": ("--rays", 20_000, "--baseline", "none", "--set", "test=200"),
    "fit": ("--sensors", 2, "--name", "killed"),
    "constrain": ("--sensors", 2, "--name", "killed"),
}


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("command", USING_WORKERS)
def test_a_command_ends_when_a_worker_is_killed(run, command):
    ended = program(command, run, *USING_WORKERS[command], "--workers", 2, text=True)
    try:
        assert wait_until(lambda: len(children(ended.pid)) == 3 or ended.poll() is not None)
        os.kill(children(ended.pid)[-1], signal.SIGKILL)
        _, err = ended.communicate(timeout=60)
    finally:
        ended.kill()
    assert ended.returncode == 5
    assert "a worker process died" in err


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_the_program_however_it_ends(run, number):
    small = ("--rays", 20_000, "--baseline", "none", "--set", "test=200")
    ended = program("evaluate", run, *small, "--workers", 2, text=True)
    try:
        # two workers, and what keeps account of the semaphores that they share
        assert wait_until(lambda: len(children(ended.pid)) == 3 or ended.poll() is not None)
        workers = children(ended.pid)
        assert len(workers) == 3
        # past the imports of the workers, in the middle of the scenes
        time.sleep(2.0)
        ended.send_signal(number)
        _, err = ended.communicate(timeout=60)
    finally:
        ended.kill()
    assert wait_until(lambda: not any(runs(pid) for pid in workers))
    if number == signal.SIGINT:
        assert ended.returncode == 130
        assert err.splitlines()[-1] == "interrupted"
