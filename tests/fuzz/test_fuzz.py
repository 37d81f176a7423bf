"""A short run of the fuzzer, what long runs once found, and that the fuzzer finds what it looks for."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from benchmarks.soak.attempts import Fuzzer, Target, attempt
from benchmarks.soak.mutators import mutate_bytes
from benchmarks.soak.targets import EVERY, TARGETS
from lidardesign.errors import ConfigError, DataError

ROOT = Path(__file__).parents[2]
FOUND = Path(__file__).parent / "found"
COMMANDS_IN_THE_SUITE = ("show DESIGN", "constrain --constraints", "fit RUN")


@pytest.fixture(autouse=True)
def caches(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.parametrize("name", [*(target.name for target in TARGETS), *COMMANDS_IN_THE_SUITE])
def test_good_files_are_read_and_damaged_ones_read_or_refused(tmp_path, name):
    target = EVERY[name]
    fuzzer = Fuzzer(target, tmp_path, seed=2026)
    for content in fuzzer.seeds[:] if target in TARGETS else []:
        assert fuzzer.run(content) is None
    assert not fuzzer.ends["refused"]
    for number in range(12 if target.share > 100 else 4):
        content = fuzzer.next()
        fault = fuzzer.run(content)
        assert fault is None, f"input {number}, {content[:300]!r}: {fault}"


@pytest.mark.parametrize("path", sorted(FOUND.glob("*/*")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_what_a_long_run_found_is_read_or_refused(tmp_path, path):
    (target,) = (target for target in TARGETS if target.folder == path.parent.name)
    assert Fuzzer(target, tmp_path, seed=0).run(path.read_bytes()) is None


def out_of_memory(_):
    try:
        raise MemoryError
    except MemoryError as error:
        raise DataError("cannot be read") from error


def without_words(_):
    raise ConfigError(" ")


FAULTS = {
    "IndexError": lambda _: [][0],
    "SystemExit": lambda _: sys.exit(3),
    "overflow": lambda _: warnings.warn("overflow", RuntimeWarning, stacklevel=1),
    "result['values'] is not finite": lambda _: {"values": np.array([1.0, np.nan])},
    "ran out of memory": out_of_memory,
    "a message of": without_words,
    "processor time": lambda _: sum(range(300_000)),
}


@pytest.mark.parametrize("words", FAULTS)
def test_a_fault_is_found(words):
    assert words in attempt(FAULTS[words], b"", 1e-3 if words == "processor time" else 10.0)[2]


def test_a_file_that_reading_leaves_behind_is_found(tmp_path):
    def opened(folder):
        return lambda _: (folder / "EXECUTED").write_text("by a tag")

    fuzzer = Fuzzer(Target("any", 1, lambda _: [b"x"], mutate_bytes, opened), tmp_path, 0)
    assert fuzzer.run(b"x") == "reading made EXECUTED"


PLANTED = """
import ctypes, os, pytest
from pathlib import Path
from benchmarks.soak.long_runs import ended_after

@pytest.mark.parametrize("what", ["good", "fault", "crash", "hang"])
def test_planted(piece, what):
    def work():
        Path("begun-" + what).touch()
        with ended_after(1.0):
            {"crash": os.abort, "hang": lambda: ctypes.PyDLL(None).sleep(60)}.get(what, int)()
        return {"faults": ["found"] if what == "fault" else []}
    piece(work)
"""


def test_a_long_run_goes_on_behind_crashes_and_hangs_and_tells_them(tmp_path):
    (tmp_path / "test_planted.py").write_text(PLANTED)
    options = f"-p benchmarks.soak.long_runs -p no:cacheprovider -c {os.devnull} -n 1 --rootdir . --page ."
    paths = {"PYTHONPATH": str(ROOT), "LONG_RUNS": str(tmp_path / "long")}
    for again in (False, True):
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *options.split(), "test_planted.py"],
            cwd=tmp_path, env={**os.environ, **paths}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        (page,) = tmp_path.glob("test_planted-*.md")
        said = page.read_text()
        assert ended.returncode == 1, ended.stdout + ended.stderr
        assert "| all | 2 | 1 |" in said
        told = re.findall(r"test_planted\[(\w+)\]`: (.*found|[^-]*crashed)", said)
        assert {what for what, _ in told} == {"fault", "crash", "hang"}
        # what was done is not done again
        assert (tmp_path / "begun-good").exists() != again
        (tmp_path / "begun-good").unlink(missing_ok=True)
