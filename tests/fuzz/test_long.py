"""The long run of the fuzzer, `make fuzz`: batches of damaged files of every kind, whose faults are kept."""

from __future__ import annotations

import contextlib
import hashlib
import math
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.long_runs import FOLDER, amount, ended_after, paragraph

from fuzz.attempts import Fuzzer, Tally, Target
from fuzz.commands import COMMANDS
from fuzz.fuzz_targets import TARGETS

NAME, TITLE = "fuzz", "Damaged files"
EVERY = {target.name: target for target in (*TARGETS, *COMMANDS)}
BATCH, COMMAND_BATCH = 1000, 60
MEMORY_BYTES = 2 << 30
# By the clock: another process may want the processor, too.
LONGEST_S = 600.0


def pytest_generate_tests(metafunc):
    inputs, shares = amount(metafunc.config), sum(target.share for target in EVERY.values())
    rows = []
    for target in EVERY.values():
        left, batch = math.ceil(inputs * target.share / shares), BATCH if target in TARGETS else COMMAND_BATCH
        rows += [(target.name, min(batch, left - first), first) for first in range(0, left, batch)]
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
    fuzzer.tally = Tally()
    found.mkdir(parents=True, exist_ok=True)
    current = found / "{}-{}".format("".join(c if c.isalnum() else "-" for c in target.name), seed)
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
    tally = fuzzer.tally
    return {"name": target.name, "inputs": inputs, "read": tally.read, "refused": tally.refused,
            "slowest_s": tally.slowest_s, "faults": faults}  # fmt: skip


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


def parts(pieces: list[dict]) -> list[str]:
    """What the page says."""
    inputs, read, refused = (sum(one[key] for one in pieces) for key in ("inputs", "read", "refused"))
    slowest = max(pieces, key=lambda one: one["slowest_s"])
    return [
        paragraph(
            f"**{inputs:,} damaged files: {read:,} were read, {refused:,} refused with a message, "
            f"{inputs - read - refused} ended otherwise** (a traceback, a warning, too much memory). A number that is "
            "not finite, a long time, code of the file that ran and a file that was left are faults, too."
        ),
        paragraph(
            f"Good files of {len({one['name'] for one in pieces})} kinds are damaged by a seeded generator: bytes, "
            "numbers, words, keys, values, arrays and headers in archives whose checksums are right again. What is "
            "refused at a new place is damaged further. An input may take 5 s of processor time, a command 60 s, both "
            f"2 GiB beyond what they begin with. Slowest: {slowest['name']}, {slowest['slowest_s']:.1f} s."
        ),
    ]
