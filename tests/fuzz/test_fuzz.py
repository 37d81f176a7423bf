"""A short run of the fuzzer, what long runs once found, and that the fuzzer itself finds what it looks for."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support.tables import each_row

from fuzz import campaign
from fuzz.attempts import Fuzzer, Tally, Target, attempt, not_finite
from fuzz.campaign import Job, run_job, together
from fuzz.commands import COMMANDS
from fuzz.fuzz_targets import NAMES, TARGETS, target_of
from fuzz.mutators import mutate_bytes
from lidardesign.errors import ConfigError, DataError

INPUTS = 12
FOUND = Path(__file__).parent / "found"


@pytest.fixture(autouse=True)
def caches(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@each_row("name", NAMES)
def test_good_files_are_read_and_damaged_ones_read_or_refused(tmp_path, name):
    fuzzer = Fuzzer(target_of(name), tmp_path, seed=2026)
    good = fuzzer.seeds[:]
    for content in good:
        assert fuzzer.run(content) is None
    assert fuzzer.tally.refused == 0
    for number in range(INPUTS):
        content = fuzzer.next()
        fault = fuzzer.run(content)
        assert fault is None, f"input {number}, {content[:300]!r}: {fault}"


@each_row("path", sorted(FOUND.glob("*/*")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_what_a_long_run_found_is_read_or_refused(tmp_path, path):
    folder = path.parent.name
    fuzzer = Fuzzer(next(target for target in TARGETS if _folder(target.name) == folder), tmp_path, seed=0)
    assert fuzzer.run(path.read_bytes()) is None


def _folder(name: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in name).strip("-")


def test_everything_that_was_found_belongs_to_a_target():
    assert {path.name for path in FOUND.iterdir()} <= {_folder(name) for name in NAMES}


COMMANDS_IN_THE_SUITE = ("show DESIGN", "constrain --constraints", "fit, samples changed")


@each_row("name", COMMANDS_IN_THE_SUITE)
def test_whole_commands_end_with_a_message_and_nothing_half_written(tmp_path, name):
    fuzzer = Fuzzer(next(target for target in COMMANDS if target.name == name), tmp_path, seed=2026)
    for _ in range(4):
        content = fuzzer.next()
        fault = fuzzer.run(content)
        assert fault is None, f"{content[:300]!r}: {fault}"


def test_damage_repeats_for_a_seed_and_differs_between_seeds(tmp_path):
    def inputs(seed, place):
        fuzzer = Fuzzer(target_of("mesh, OBJ"), tmp_path / place, seed)
        return [fuzzer.next() for _ in range(20)]

    assert inputs(1, "a") == inputs(1, "b")
    assert inputs(1, "c") != inputs(2, "d")


# --- what the fuzzer must find


@dataclass(frozen=True)
class Numbers:
    values: np.ndarray


def out_of_memory(_):
    try:
        raise MemoryError
    except MemoryError as error:
        raise DataError("cannot be read") from error


def warned(_):
    warnings.warn("overflow", RuntimeWarning, stacklevel=1)


def refused(_):
    raise ConfigError("is no file", where="input")


FAULTS = {
    "a traceback": (lambda _: [][0], "IndexError"),
    "the end of the process": (lambda _: exit(3), "SystemExit"),
    "a warning": (warned, "overflow"),
    "a number that is none": (lambda _: Numbers(np.array([1.0, np.nan])), "result.values is not finite"),
    "hidden lack of memory": (out_of_memory, "ran out of memory"),
    "a message without words": (lambda _: (_ for _ in ()).throw(ConfigError(" ")), "a message of"),
    "a long time": (lambda _: sum(range(300_000)), "processor time"),
}


@each_row("kind", FAULTS)
def test_a_fault_is_found(kind):
    read, words = FAULTS[kind]
    _, fault = attempt(read, b"", Tally(), 1e-3 if kind == "a long time" else 10.0)
    assert words in fault


def test_a_refusal_and_a_result_are_no_faults():
    tally = Tally()
    assert attempt(refused, b"", tally, 10.0)[1] is None
    assert attempt(lambda _: ({"a": [1.0, "x"]}, None), b"", tally, 10.0)[1] is None
    assert (tally.refused, tally.read) == (1, 1)
    assert not_finite(({"a": [1.0, float("inf")]},)) == "result[0]['a'][1] is inf"


def test_a_file_that_reading_leaves_behind_is_found(tmp_path):
    def opened(folder):
        return lambda _: (folder / "EXECUTED").write_text("by a tag")

    fuzzer = Fuzzer(Target("any", 1, lambda _: [b"x"], mutate_bytes, opened), tmp_path, 0)
    assert fuzzer.run(b"x") == "reading made EXECUTED"


CRASHING = """
import json, os, sys, time
from pathlib import Path
name, seed, first, inputs, folder = sys.argv[1:]
first, inputs, folder = int(first), int(inputs), Path(folder)
tally = dict(read=3, refused=1, broken=0, places=["a"], slowest_s=0.1, seconds=0.2, memory_mib=5.0)
(folder / "faults").mkdir()
(folder / "tally.json").write_text(json.dumps({"beat": 4, **tally}))
(folder / "current").write_bytes(b"5\\nthe culprit")
if first == 0:
    WHAT
"""


@each_row(
    ("what", "words"),
    [
        ("os.abort()", "ended with -6"),
        ("time.sleep(60)", "it hangs"),
        ("while True: pass", "it hangs"),
        ("raise ValueError('x')", "ValueError: x"),
    ],
)
def test_an_input_that_ends_or_stops_its_process_is_kept_and_the_batch_goes_on(tmp_path, monkeypatch, what, words):
    worker = tmp_path / "worker.py"
    worker.write_text(CRASHING.replace("WHAT", what))
    monkeypatch.setattr(campaign, "WORKER", worker)
    monkeypatch.setattr(campaign, "HANG_S", 1.0 if "sleep" in what else 60.0)
    monkeypatch.setattr(campaign, "HANG_PROCESSOR_S", 0.5)
    job = Job("any", 9, 0)
    found = run_job(job, tmp_path / "kept")
    assert [words in reason for reason in found.faults.values()] == [True]
    assert [Path(path).read_bytes() for path in found.faults] == [b"the culprit"]
    assert (found.inputs, found.read, found.refused) == (4 + 1 + 4, 6, 2)
    assert together([(job, found)])["any"].memory_mib == 5.0


def test_the_worker_reads_a_batch_and_counts_it(tmp_path):
    found = run_job(Job("progress (JSON lines)", 25, 3), tmp_path / "kept")
    assert not found.faults, json.dumps(found.faults)
    assert (found.inputs, found.read + found.refused) == (25, 25)
