"""Random runs in processes of their own, some after the other in each: one that dies or hangs costs one run."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from soak.plans import random_plan
from soak.scaled_flatland import offer
from soak.whole_runs import WHOLE, Record, whole_run

# A process imports and compiles once for so many runs.
RUNS_AT_ONCE = 10
# Minutes on a busy machine; a run that takes this long hangs.
LONGEST_RUN_S = 900.0
POLL_S = 0.2


@dataclass
class Batch:
    """A process that does some runs; it writes a line when it starts one and a line when that is done.

    Arguments:
        seeds: Their numbers, in order.
        path: The file of the lines.
        process: The process.
        changed: When the file last grew.
    """

    seeds: list[int]
    path: Path
    process: subprocess.Popen[bytes]
    changed: float = field(default_factory=time.monotonic)
    length: int = 0

    def lines(self) -> list[dict[str, Any]]:
        """The whole lines of the file."""
        if not self.path.exists():
            return []
        return [json.loads(line) for line in self.path.read_text().splitlines(keepends=True) if line.endswith("\n")]

    def hangs(self) -> bool:
        """Whether the run in hand has taken too long."""
        length = self.path.stat().st_size if self.path.exists() else 0
        if length != self.length:
            self.length, self.changed = length, time.monotonic()
        return time.monotonic() - self.changed > LONGEST_RUN_S


def do_batch(seeds: list[int], path: Path, folder: Path, *, repeat_every: int) -> None:
    """Do runs one after the other, in this process.

    Arguments:
        seeds: Their numbers.
        path: Where lines are added.
        folder: Where runs have their folders while they last.
        repeat_every: Runs whose number is a multiple of it are done twice, and have to do the same; 0 does none twice.
    """
    # a folder of its own: another batch may be reading
    sys.path.insert(0, str(offer(folder / f"offered{seeds[0]}")))
    with path.open("a", encoding="utf-8") as file:
        for seed in seeds:
            print(json.dumps({"started": seed}), file=file, flush=True)
            plan = random_plan(seed)
            record = whole_run(plan, folder / f"run{seed}")
            if repeat_every and seed % repeat_every == 0:
                again = record.differences(whole_run(plan, folder / f"run{seed}"))
                record.repeated = not again
                if again:
                    record.faults.append(f"a second run did not repeat: {', '.join(again)}")
            print(json.dumps({**record.as_dict(), "outcome": record.outcome}), file=file, flush=True)


def soak(
    whole: int,
    folder: Path,
    *,
    first: int = 0,
    jobs: int = 1,
    repeat_every: int = 1,
    tell: Callable[[str], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Runs from one number on until so many of them were whole: learned, fitted, constrained and evaluated.

    What an earlier soak did in the same folder counts.

    Returns:
        The records of all numbers up to the last of these, in order, refused ones and faults among them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = _done(folder)
    waiting: list[list[int]] = []
    running: list[Batch] = []
    missing = (seed for seed in itertools.count(first) if seed not in found)
    try:
        while True:
            while len(running) < jobs and (waiting or _whole(found) < whole):
                if not waiting:
                    waiting.append(list(itertools.islice(missing, RUNS_AT_ONCE)))
                running.append(_started(waiting.pop(0), folder, repeat_every))
            if not running:
                return _first_whole([found[seed] for seed in sorted(found)], whole)
            time.sleep(POLL_S)
            for batch in list(running):
                rest = collected(batch, found, tell)
                if rest is not None:
                    running.remove(batch)
                    waiting += [rest] if rest else []
    finally:
        for batch in running:
            batch.process.kill()


def records_in(folder: Path) -> list[dict[str, Any]]:
    """What is done of a soak that goes on or was ended, in order; numbers in between may be missing."""
    found = _done(folder)
    return [found[seed] for seed in sorted(found)]


def _done(folder: Path) -> dict[int, dict[str, Any]]:
    """What batches in a folder have done, by number."""
    texts = [path.read_text().splitlines(keepends=True) for path in sorted(folder.glob("batch-*.jsonl"))]
    lines = [json.loads(line) for text in texts for line in text if line.endswith("\n")]
    return {line["seed"]: line for line in lines if "outcome" in line}


def _whole(found: dict[int, dict[str, Any]]) -> int:
    return sum(record["outcome"] == WHOLE for record in found.values())


def _started(seeds: list[int], folder: Path, repeat_every: int) -> Batch:
    path = folder / f"batch-{seeds[0]}-{time.time_ns()}.jsonl"
    tests = Path(__file__).resolve().parents[1]
    command = [sys.executable, "-m", "soak", "batch", *map(str, seeds), "--lines", str(path)]
    command += ["--folder", str(folder), "--repeat-every", str(repeat_every)]
    paths = [str(tests), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    with path.with_suffix(".log").open("wb") as log:
        return Batch(seeds, path, subprocess.Popen(command, env=environment, stdout=log, stderr=log))


def collected(batch: Batch, found: dict[int, dict[str, Any]], tell: Callable[[str], None]) -> list[int] | None:
    """Enter what a batch did, and give what it left undone when it ended, or None while it goes on.

    The run that it died in, or that hangs, is a fault.
    """
    code, why = batch.process.poll(), ""
    if code is None and batch.hangs():
        batch.process.kill()
        code, why = batch.process.wait(), f"hung: no end within {LONGEST_RUN_S:g} s"
    for line in batch.lines():
        if "outcome" in line and line["seed"] not in found:
            found[line["seed"]] = line
            tell(f"{line['seed']}: {line['outcome']}" + "".join(f"\n    {fault}" for fault in line["faults"]))
    left = [seed for seed in batch.seeds if seed not in found]
    if code is None or not left:
        return None if code is None else []
    plan = random_plan(left[0])
    record = Record(plan.seed, plan.size_m, plan.sigma_share, len(plan.free), plan.sensors, "")
    record.faults.append(why or f"the process ended with {code}: {batch.path.with_suffix('.log').read_text()[-2000:]}")
    found[left[0]] = {**record.as_dict(), "outcome": record.outcome}
    tell(f"{left[0]}: {record.faults[0]}")
    return left[1:]


def _first_whole(records: list[dict[str, Any]], whole: int) -> list[dict[str, Any]]:
    """The records up to the one that completes the number."""
    kept, count = [], 0
    for record in records:
        kept.append(record)
        count += record["outcome"] == WHOLE
        if count == whole:
            break
    return kept
