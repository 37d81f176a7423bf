"""The long run of the fuzzer: every target in processes of its own that may hang, crash or run out of memory.

    PYTHONPATH=tests python -m fuzz.campaign --inputs 100000 --out docs/soak

Interrupted and started again it goes on behind the batches that are done.
A target's inputs go through the program in batches, each in a fresh process with a memory limit. Which input is being
read is on disk before it is read, so that one which ends or stops the process is known, and the batch goes on after it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from support.pieces import FOLDER, Pieces
from support.result_pages import ROOT, heading, paragraph, table, write_page

WORKER = Path(__file__).with_name("fuzz_worker.py")
BATCH = 2500
COMMAND_BATCH = 60
# A process that reads one input for so long hangs: of processor time, as the machine may be busy with other things, or
# by the clock, as it may wait for what never comes [s].
HANG_PROCESSOR_S, HANG_S = 150.0, 1200.0
POLL_S = 0.2
ALL_SHARES = 100_000


@dataclass
class Job:
    """A batch of inputs of one target.

    Arguments:
        name: The target.
        inputs: How many.
        seed: Of the batch.
    """

    name: str
    inputs: int
    seed: int


@dataclass
class Found:
    """What a target's batches found.

    Arguments:
        inputs, read, refused: Counts.
        places: Lines of the program at which inputs were refused.
        slowest_s, seconds: Processor times.
        memory_mib: The most memory that a process needed beyond what it began with.
        faults: Reasons by the place of the saved input.
    """

    inputs: int = 0
    read: int = 0
    refused: int = 0
    places: set[str] = field(default_factory=set)
    slowest_s: float = 0.0
    seconds: float = 0.0
    memory_mib: float = 0.0
    faults: dict[str, str] = field(default_factory=dict)

    def add(self, other: Found) -> None:
        """Count what another found, too."""
        for name in ("inputs", "read", "refused", "seconds"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("slowest_s", "memory_mib"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        self.places |= other.places
        self.faults.update(other.faults)


def done_job(job: Job, kept: Path, pieces: Pieces) -> Found:
    """One batch, if it is not done yet."""

    def work() -> dict[str, object]:
        found = run_job(job, kept)
        return {**asdict(found), "places": sorted(found.places)}

    found = pieces.of(f"{job.name}, {job.inputs} inputs of seed {job.seed}", work)
    return Found(**{**found, "places": set(found["places"])})


def jobs(inputs: int, only: list[str], seed: int) -> Iterator[Job]:
    """Batches of all targets, inputs in the targets' shares."""
    from fuzz.commands import COMMANDS
    from fuzz.fuzz_targets import TARGETS

    chosen = [target for target in (*TARGETS, *COMMANDS) if not only or any(word in target.name for word in only)]
    shares = sum(target.share for target in (*TARGETS, *COMMANDS))
    commands = {target.name for target in COMMANDS}
    for target in chosen:
        left = math.ceil(inputs * target.share / shares)
        batch = COMMAND_BATCH if target.name in commands else BATCH
        for number in range(-(-left // batch)):
            yield Job(target.name, min(batch, left - number * batch), 1000 * seed + number)


def run_job(job: Job, kept: Path) -> Found:
    """One batch: started again behind every input that ended its process."""
    found, first = Found(), 0
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        while first < job.inputs:
            folder = Path(name) / str(first)
            folder.mkdir()
            ended = _process(job, first, folder)
            _merge(found, folder, kept, job)
            if ended is None:
                break
            number, content = _current(folder)
            found.inputs += 1
            _keep(found, kept, job, content, ended)
            # a process that ends before it reads anything would end again
            first = first + number if number else job.inputs
            shutil.rmtree(folder, ignore_errors=True)
    return found


def _current(folder: Path) -> tuple[int, bytes]:
    """Number and content of the input that a process read last; 0 where it read none."""
    path = folder / "current"
    number, _, content = path.read_bytes().partition(b"\n") if path.exists() else (b"0", b"", b"")
    return int(number), content


def _process(job: Job, first: int, folder: Path) -> str | None:
    """Run inputs from the first on; why the process ended before the last, or None."""
    arguments = [job.name, str(job.seed), str(first), str(job.inputs), str(folder)]
    # the program beside this file, wherever another is installed
    places = (ROOT, ROOT / "tasks", ROOT / "tests")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places))}
    with (folder / "output").open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, str(WORKER), *arguments],
            stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, env=environment, cwd=folder,
        )  # fmt: skip
        if _watched(process, folder):
            return "it hangs: one input took more than any may"
    if process.returncode == 0:
        return None
    tail = (folder / "output").read_text(errors="replace")[-2000:]
    return f"the process ended with {process.returncode}\n{tail}"


def _watched(process: subprocess.Popen, folder: Path) -> bool:
    """Wait for a process; whether it had to be ended."""
    seen, since, spent = -1, time.monotonic(), 0.0
    while process.poll() is None:
        time.sleep(POLL_S)
        done, processor_s = _read_json(folder / "tally.json").get("beat", 0), _processor_s(process.pid)
        if done != seen:
            seen, since, spent = done, time.monotonic(), processor_s
        elif time.monotonic() - since > HANG_S or processor_s - spent > HANG_PROCESSOR_S:
            process.kill()
            process.wait()
            return True
    return False


def _processor_s(pid: int) -> float:
    """The processor time of a process so far [s]; 0 once it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _read_json(path: Path) -> dict[str, object]:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return {}


def _merge(found: Found, folder: Path, kept: Path, job: Job) -> None:
    """Add what a process counted."""
    tally = _read_json(folder / "tally.json")
    if not tally:
        return
    inputs = tally["read"] + tally["refused"] + tally.pop("broken")
    del tally["beat"]
    found.add(Found(inputs, **{**tally, "places": set(tally["places"])}))
    for path in sorted((folder / "faults").glob("*.input")):
        _keep(found, kept, job, path.read_bytes(), path.with_suffix(".txt").read_text())


def _keep(found: Found, kept: Path, job: Job, content: bytes, reason: str) -> None:
    """Save an input that found a fault, with the reason."""
    kept.mkdir(parents=True, exist_ok=True)
    stem = "".join(letter if letter.isalnum() else "-" for letter in job.name)
    path = kept / f"{stem}-{hashlib.sha256(content + reason[-200:].encode()).hexdigest()[:12]}.input"
    path.write_bytes(content)
    path.with_suffix(".txt").write_text(reason)
    found.faults[str(path)] = reason


def together(parts: list[tuple[Job, Found]]) -> dict[str, Found]:
    """What was found, by target."""
    result: dict[str, Found] = {}
    for job, part in parts:
        result.setdefault(job.name, Found()).add(part)
    return result


def report(found: dict[str, Found], arguments: argparse.Namespace, seconds: float) -> list[str]:
    """The parts of the result's page."""
    total = {name: sum(getattr(one, name) for one in found.values()) for name in ("inputs", "read", "refused")}
    faults = {path: reason for one in found.values() for path, reason in one.faults.items()}
    rows = [(name, f"{one.inputs:,}", len(one.faults)) for name, one in found.items() if one.faults]
    slowest = max(found, key=lambda name: found[name].slowest_s)
    largest = max(found, key=lambda name: found[name].memory_mib)
    return [
        heading("Damaged files", f"make fuzz, seed {arguments.seed}"),
        paragraph(
            f"**{total['inputs']:,} damaged files in {seconds / 60:.0f} minutes with {arguments.workers} processes at "
            f"a time: {total['read']:,} were read, {total['refused']:,} refused with a message, {len(faults)} ended "
            "otherwise** (a traceback, a warning, a process that crashed or hung, a number that is not finite, too "
            "much memory, code of the file that ran, a file that was left or half-written)."
        ),
        paragraph(
            f"Good files of {len(found)} kinds are damaged by a seeded generator: bytes, numbers, words, keys, "
            "values, arrays and headers in archives whose checksums are right again. What is refused at a new place is "
            "damaged further. An input may take 5 s of processor time, a command 60 s, both 2 GiB beyond "
            f"what they begin with. Slowest: {slowest}, {found[slowest].slowest_s:.1f} s; most memory: {largest}, "
            f"{found[largest].memory_mib:.0f} MiB."
        ),
        table(("file", "inputs", "faults"), rows) if rows else "",
        *(f"`{Path(path).name}`: {_last_line(reason)}" for path, reason in faults.items()),
    ]


def _last_line(reason: str) -> str:
    return (reason.strip().splitlines() or ["no reason"])[-1][:300]


def main() -> int:
    """Run, write the report, and say whether anything was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=ALL_SHARES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", nargs="*", default=[], help="parts of the names of targets")
    parser.add_argument("--out", type=Path, help="a folder for the report")
    parser.add_argument("--kept", type=Path, default=FOLDER / "fuzz-found", help="a folder for what finds a fault")
    arguments = parser.parse_args()
    pieces, parts = Pieces("fuzz"), []
    planned = list(jobs(arguments.inputs, arguments.only, arguments.seed))
    with ThreadPoolExecutor(arguments.workers) as pool:
        done = pool.map(lambda job: done_job(job, arguments.kept, pieces), planned)
        for job, found in zip(planned, done, strict=True):
            parts.append((job, found))
            print(f"{job.name}: {found.inputs} inputs, {len(found.faults)} faults", flush=True)
            for path, reason in found.faults.items():
                print(f"  {path}: {_last_line(reason)}", flush=True)
    found = together(parts)
    parts = report(found, arguments, pieces.seconds)
    print("\n\n".join(parts))
    if arguments.out:
        write_page(arguments.out / f"fuzz-{datetime.now(UTC):%Y-%m-%d}.md", parts)
    return int(any(one.faults for one in found.values()))


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "tasks"), str(ROOT / "tests")]
    sys.exit(main())
