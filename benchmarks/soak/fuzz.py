"""Damaged files, `make fuzz`: all are read or refused with a message.

Good files of every kind are damaged by a seeded generator: bytes, numbers, words, keys, values, arrays and headers in
archives whose checksums are right again. What is refused at a new place is damaged further. A traceback, a warning, a
number that is not finite, code of the file that ran, a file that was left and a long time are faults: an input may take
5 s of processor time, a command 60 s, both 2 GiB beyond what they begin with. Inputs with faults are kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.soak.attempts import Fuzzer, Target
from benchmarks.soak.long_runs import FOLDER, amount, ended_after
from benchmarks.soak.targets import EVERY, TARGETS

MEMORY_BYTES = 2 << 30
# By the clock: another process may want the processor, too.
LONGEST_S = 600.0


def pytest_generate_tests(metafunc):
    inputs, shares = amount(metafunc.config), sum(target.share for target in EVERY.values())
    rows = []
    for target in EVERY.values():
        left = math.ceil(inputs * target.share / shares)
        rows += [(target.name, min(target.batch, left - at), at) for at in range(0, left, target.batch)]
    metafunc.parametrize(("name", "inputs", "seed"), rows)


@pytest.mark.long
@pytest.mark.usefixtures("own_cache")
def test_damaged_files_are_read_or_refused(tmp_path, piece, name, inputs, seed):
    piece(lambda: read_batch(EVERY[name], inputs, seed, tmp_path))


def read_batch(target: Target, inputs: int, seed: int, folder: Path, found: Path = FOLDER / "fuzz-found") -> dict:
    """Damage and read so many files; those that find a fault are kept, also the one that ends this process."""
    fuzzer, faults = Fuzzer(target, folder, seed), []
    # what good files do is known; whole commands would take long to show it again
    for content in fuzzer.seeds[:] if target in TARGETS else []:
        fuzzer.run(content)
    fuzzer.ends.clear()
    found.mkdir(parents=True, exist_ok=True)
    current = found / f"{target.folder}-{seed}"
    with limited_memory():
        for _ in range(inputs):
            content = fuzzer.next()
            current.write_bytes(content)
            with ended_after(LONGEST_S):
                fault = fuzzer.run(content)
            if fault:
                path = current.with_name(f"{current.name}-{hashlib.sha256(content).hexdigest()[:12]}")
                path.write_bytes(content)
                faults.append(f"{path}: {fault}")
    current.unlink()
    counts = {"damaged files": inputs, **{how: fuzzer.ends[how] for how in ("read", "refused")}}
    return {"case": "files" if target in TARGETS else "whole commands", "counts": counts, "faults": faults}


@contextlib.contextmanager
def limited_memory() -> Iterator[None]:
    """Allow so much more memory than there is by now."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY_BYTES, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
