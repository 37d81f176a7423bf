"""A process that reads one batch of damaged inputs; started by `campaign.py`, which watches it."""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path

from fuzz.attempts import Fuzzer
from fuzz.commands import COMMANDS
from fuzz.fuzz_targets import TARGETS

MEMORY_BYTES = 2 << 30
MOST_KEPT = 50
# The tally is written each time that so many were read; a process that crashes loses what it counted since.
TALLIED = 10


def main(name: str, seed: int, first: int, inputs: int, folder: Path) -> None:
    """Read so many inputs, without the first ones where those ended a process: other damage comes in their place."""
    target = next(target for target in (*TARGETS, *COMMANDS) if target.name == name)
    fuzzer = Fuzzer(target, folder, seed + 7919 * first)
    # what good files do is known; whole commands would take long to show it again
    for content in fuzzer.seeds[:] if target in TARGETS else []:
        fuzzer.run(content)
    fuzzer.tally.read = fuzzer.tally.refused = 0
    (folder / "faults").mkdir()
    begin = _limit_memory()
    kept = broken = 0
    for number in range(1, inputs - first + 1):
        content = fuzzer.next()
        (folder / "current").write_bytes(b"%d\n" % number + content)
        if (number - 1) % (TALLIED if target in TARGETS else 1) == 0:
            _write(folder, fuzzer, number, broken, begin)
        fault = fuzzer.run(content)
        broken = number - fuzzer.tally.read - fuzzer.tally.refused
        if fault and kept < MOST_KEPT:
            kept += 1
            (folder / "faults" / f"{number:06d}.input").write_bytes(content)
            (folder / "faults" / f"{number:06d}.txt").write_text(fault)
    _write(folder, fuzzer, inputs - first + 1, broken, begin)


def _limit_memory() -> int:
    """Allow so much more than there is by now; the peak so far, in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return _peak_bytes()


def _peak_bytes() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _write(folder: Path, fuzzer: Fuzzer, beat: int, broken: int, begin: int) -> None:
    tally = fuzzer.tally
    document = {
        "beat": beat, "read": tally.read, "refused": tally.refused, "broken": broken, "places": sorted(tally.places),
        "slowest_s": tally.slowest_s, "seconds": tally.seconds, "memory_mib": (_peak_bytes() - begin) / 2**20,
    }  # fmt: skip
    temporary = folder / "tally.tmp"
    temporary.write_text(json.dumps(document))
    os.replace(temporary, folder / "tally.json")


if __name__ == "__main__":
    name, seed, first, inputs, folder = sys.argv[1:]
    main(name, int(seed), int(first), int(inputs), Path(folder))
