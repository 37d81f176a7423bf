"""Clocks: every second is counted once, phases inside of phases, clocks inside of clocks."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidardesign.errors import ConfigError
from lidardesign.run import clock as clocks
from lidardesign.run.clock import Clock, peak_memory_bytes, phase, running
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import keep_timings, read_manifest, start_manifest


class Hands:
    """A time that only moves when it is told to."""

    def __init__(self):
        self.now = 100.0

    def perf_counter(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def hands(monkeypatch):
    hands = Hands()
    monkeypatch.setattr(clocks.time, "perf_counter", hands.perf_counter)
    return hands


def test_phases_and_other_add_up_to_the_whole_time(hands):
    with running() as clock:
        hands.sleep(1)
        with phase("learning"):
            hands.sleep(2)
            with phase("target"):
                hands.sleep(4)
        with phase("writing"):
            hands.sleep(8)
    assert clock.timings() == {"learning": 6, "learning/target": 4, "writing": 8, "other": 1}
    assert clock.seconds == 15


def test_phases_come_in_the_order_of_their_beginning_and_count_every_time(hands):
    with running() as clock:
        for _ in range(3):
            with phase("b"):
                hands.sleep(1)
                with phase("a"):
                    hands.sleep(1)
            with phase("a"):
                hands.sleep(5)
    assert list(clock.timings().items()) == [("b", 6), ("b/a", 3), ("a", 15), ("other", 0)]


def test_a_phase_inside_of_itself_is_one_phase(hands):
    @phase("work")
    def work(depth):
        hands.sleep(1)
        if depth:
            work(depth - 1)

    with running() as clock:
        work(3)
    assert clock.timings() == {"work": 4, "other": 0}


def test_every_running_clock_counts_from_its_own_beginning(hands):
    with running() as outer, phase("all"):
        hands.sleep(1)
        with running() as inner, phase("part"):
            hands.sleep(2)
    assert outer.timings() == {"all": 3, "all/part": 2, "other": 0}
    assert inner.timings() == {"part": 2, "other": 0}


def test_a_phase_that_raises_is_counted_and_left(hands):
    @phase("a")
    @phase("b")
    def interrupted():
        hands.sleep(1)
        raise KeyboardInterrupt

    with running() as clock:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
        with phase("c"):
            hands.sleep(1)
    assert clock.timings() == {"a": 1, "a/b": 1, "c": 1, "other": 0}


def test_without_a_clock_phases_do_nothing():
    with phase("alone"):
        value = 3
    assert value == 3
    with running() as clock:
        pass
    with phase("after"):
        pass
    assert list(clock.timings()) == ["other"]


def test_the_manifest_keeps_the_last_times_of_every_command(tmp_path, hands):
    start_manifest(tmp_path, command=["lidardesign", "learn"], seed=1)
    for command, seconds in (("learn", 5), ("fit", 1), ("fit", 2)):
        with running() as clock, phase("work"):
            hands.sleep(seconds)
        keep_timings(tmp_path, command, clock)
    timings = read_manifest(tmp_path)["timings"]
    assert {name: entry["seconds"] for name, entry in timings.items()} == {"learn": 5, "fit": 2}
    assert timings["fit"]["phases"] == {"work": 2, "other": 0}
    assert timings["fit"]["when"].endswith("+00:00")


def test_times_of_older_runs_give_way(tmp_path):
    start_manifest(tmp_path, command=[], seed=1)
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "timings": {"learning": 3.5}}))
    keep_timings(tmp_path, "fit", Clock())
    assert list(read_manifest(tmp_path)["timings"]) == ["fit"]


def test_times_are_not_written_into_a_run_that_another_command_writes(tmp_path):
    start_manifest(tmp_path, command=[], seed=1)
    with run_lock(tmp_path), pytest.raises(ConfigError, match="writing this run"):
        keep_timings(tmp_path, "fit", Clock(), wait_s=0.0)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells it there")
def test_a_process_does_not_count_the_memory_of_the_one_that_started_it():
    held = np.ones(60_000_000)  # 480 MB
    code = "from lidardesign.run.clock import peak_memory_bytes; print(peak_memory_bytes())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, close_fds=False)
    assert 1e6 < int(done.stdout) < held.nbytes
    assert peak_memory_bytes() > held.nbytes
