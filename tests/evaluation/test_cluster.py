"""Held-out scenes scored by the workers of a dask scheduler: the same rows, also when a worker is lost."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
import warnings
from dataclasses import replace

import pytest
from support.plugins import GOOD, install_plugins
from support.workers import make_request, results

from lidardesign import workers
from lidardesign.errors import ConfigError
from lidardesign.evaluation.score import evaluate
from lidardesign.task import load_task
from lidardesign.workers import opened_workers

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

pytestmark = [
    # what dask.distributed leaves to be collected at the end of a test is not ours to close
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning:(distributed|tornado|dask).*")
]
PATIENCE_S = 60.0


class LocalScheduler:
    """A scheduler and workers in processes of their own, as the documentation starts them."""

    def __init__(self, folder):
        self._folder, self._started = folder, []
        self._known = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", self._known)

    def wait(self):
        """Wait until the scheduler says where it is."""
        known, end = self._known, time.monotonic() + PATIENCE_S
        # the scheduler makes its file before it fills it
        while not (known.exists() and known.read_text().endswith("}")) and time.monotonic() < end:
            time.sleep(0.05)
        self.address = json.loads(known.read_text())["address"]

    def add_worker(self):
        return self._start(
            "worker", self.address, "--nthreads", "1", "--no-nanny", "--local-directory", self._folder / "scratch"
        )

    def _start(self, kind, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard", *map(str, arguments)]
        log = open(self._folder / f"{kind}{len(self._started)}.log", "w")  # noqa: SIM115 (closed with the process)
        popen = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
        self._started.append((popen, log))
        return popen

    def close(self):
        for popen, log in reversed(self._started):
            popen.kill()
            popen.wait()
            log.close()


def after_one_scene(kill):
    """Progress that kills once the first scene is there."""
    return lambda name, done, total: kill() if done == 1 else None


def score_by(address):
    request = make_request()
    with opened_workers(address, request.task, 6) as starmap:
        evaluate(replace(request, starmap=starmap))


@pytest.fixture
def scheduler(tmp_path):
    started = LocalScheduler(tmp_path)
    try:
        started.wait()
        yield started
    finally:
        started.close()


@pytest.mark.slow
def test_a_cluster_scores_as_this_process_does_though_a_worker_is_lost(scheduler):
    request = make_request()
    expected = results(evaluate(request))
    lost = scheduler.add_worker()
    scheduler.add_worker()
    with opened_workers(scheduler.address, request.task, 6) as starmap:
        assert results(evaluate(replace(request, starmap=starmap), progress=after_one_scene(lost.kill))) == expected
        assert lost.wait(PATIENCE_S) == -signal.SIGKILL
        assert results(evaluate(replace(request, starmap=starmap))) == expected


@pytest.mark.slow
def test_a_scheduler_that_is_lost_ends_the_evaluation_with_its_address(scheduler):
    request = make_request()
    scheduler.add_worker()
    with (
        pytest.raises(ConfigError, match=f"the scheduler at {scheduler.address} was lost"),
        opened_workers(scheduler.address, request.task, 6) as starmap,
    ):
        evaluate(replace(request, starmap=starmap), progress=after_one_scene(scheduler.scheduler.kill))


def test_a_scheduler_without_workers_and_workers_of_other_packages_are_refused(scheduler, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(workers, "WORKER_SECONDS", 0.5)
        with pytest.raises(ConfigError, match=f"{scheduler.address} had no worker"):
            score_by(scheduler.address)
    scheduler.add_worker()
    with monkeypatch.context() as patch:
        patch.setattr(workers, "__version__", "9.9")
        with pytest.raises(ConfigError, match=r"the cluster has lidardesign [^9].*\n  allowed: lidardesign 9\.9"):
            score_by(scheduler.address)
    install_plugins(tmp_path / "site", {"ball": GOOD})
    monkeypatch.syspath_prepend(tmp_path / "site")
    with pytest.raises(ConfigError, match="plugins_ball"), opened_workers(scheduler.address, load_task("ball"), 6):
        pass


def test_an_address_where_nothing_answers_is_refused(monkeypatch):
    monkeypatch.setattr(workers, "SCHEDULER_SECONDS", 0.5)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(ConfigError, match=f"no scheduler answers at {address}"):
        score_by(address)


def test_an_address_where_something_else_listens_is_refused(monkeypatch):
    monkeypatch.setattr(workers, "SCHEDULER_SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(ConfigError, match="is not a dask scheduler"):
            score_by(address)


def test_without_dask_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"lidardesign\[cluster\]"):
        score_by("tcp://127.0.0.1:1")


@pytest.mark.slow
def test_a_cluster_that_lost_its_last_worker_is_given_up(scheduler, monkeypatch):
    request = make_request()
    only = scheduler.add_worker()

    def kill():
        monkeypatch.setattr(workers, "WORKER_SECONDS", 0.3)
        only.kill()

    with (
        pytest.raises(ConfigError, match="no worker within"),
        opened_workers(scheduler.address, request.task, 6) as starmap,
    ):
        evaluate(replace(request, starmap=starmap), progress=after_one_scene(kill))
