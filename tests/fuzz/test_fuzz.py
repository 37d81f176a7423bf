"""A short run of the fuzzer, what long runs once found, and that the fuzzer finds what it looks for."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support.tables import each_row

from fuzz.attempts import Fuzzer, Tally, Target, attempt
from fuzz.commands import COMMANDS
from fuzz.fuzz_targets import NAMES, TARGETS, target_of
from fuzz.mutators import mutate_bytes
from lidardesign.errors import ConfigError, DataError

INPUTS = 12
TESTS = Path(__file__).parents[1]
FOUND = TESTS / "fuzz" / "found"


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


def test_a_file_that_reading_leaves_behind_is_found(tmp_path):
    def opened(folder):
        return lambda _: (folder / "EXECUTED").write_text("by a tag")

    fuzzer = Fuzzer(Target("any", 1, lambda _: [b"x"], mutate_bytes, opened), tmp_path, 0)
    assert fuzzer.run(b"x") == "reading made EXECUTED"


PLANTED = """
import ctypes, os, time, pytest
from pathlib import Path
from support.long_runs import ended_after
NAME, TITLE = "planted", "Planted faults"

@pytest.mark.parametrize("what", ["good", "fault", "crash", "hang"])
def test_planted(piece, what):
    def work():
        Path("begun-" + what).touch()
        with ended_after(1.0):
            {"crash": os.abort, "hang": lambda: ctypes.PyDLL(None).sleep(60)}.get(what, int)()
        return {"faults": ["found"] if what == "fault" else []}
    piece(work)

def parts(pieces):
    return [str(len(pieces)) + " pieces"]
"""


def test_a_long_run_goes_on_behind_crashes_and_hangs_and_tells_them(tmp_path):
    (tmp_path / "test_planted.py").write_text(PLANTED)
    paths = os.pathsep.join(map(str, (tmp_path, TESTS, TESTS.parent)))
    options = f"-p support.long_runs -p no:cacheprovider -c {os.devnull} -n 1 --page . --rootdir . test_planted.py"
    for again in (False, True):
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *options.split()],
            cwd=tmp_path, env={**os.environ, "PYTHONPATH": paths, "LONG_RUNS": str(tmp_path / "long")},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        (page,) = tmp_path.glob("planted-*.md")
        said = page.read_text()
        assert ended.returncode == 1, ended.stdout + ended.stderr
        assert "2 pieces" in said
        told = re.findall(r"test_planted\[(\w+)\]`: (.*found|[^-]*crashed)", said)
        assert {what for what, _ in told} == {"fault", "crash", "hang"}
        # what was done is not done again
        assert (tmp_path / "begun-good").exists() != again
        (tmp_path / "begun-good").unlink(missing_ok=True)
