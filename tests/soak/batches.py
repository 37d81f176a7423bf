"""Random runs in processes of their own, several at once: one that dies or hangs costs one run."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from support.pieces import Pieces

from soak.plans import random_plan
from soak.whole_runs import WHOLE, Record

# Minutes on a busy machine; a run that takes this long hangs.
LONGEST_RUN_S = 900.0
POLL_S = 0.2


def soak(
    whole: int,
    folder: Path,
    pieces: Pieces,
    *,
    first: int,
    jobs: int,
    repeat_every: int,
    tell: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Runs from one number on until so many of them were whole: learned, fitted, constrained and evaluated.

    What is done counts. Every so many runs one is done twice; 0: none. The records of
    all numbers up to the last of these are given, in order, faults among them; with 0 whole ones all that are done.
    """
    folder.mkdir(parents=True, exist_ok=True)
    records = {record["seed"]: record for record in pieces.done.values()}
    missing = (seed for seed in itertools.count(first) if seed not in records)
    running: dict[int, tuple[subprocess.Popen[bytes], float]] = {}
    try:
        while running or _whole(records.values()) < whole:
            while len(running) < jobs and _whole(records.values()) < whole:
                seed = next(missing)
                running[seed] = _started(seed, folder, repeat_every), time.monotonic()
            time.sleep(POLL_S)
            for seed, (process, began) in list(running.items()):
                record = ended(seed, process, began, folder)
                if record is not None:
                    del running[seed]
                    records[seed] = record
                    pieces.keep(str(seed), record)
                    tell(f"{seed}: {record['outcome']}" + "".join(f"\n    {fault}" for fault in record["faults"]))
    finally:
        for process, _ in running.values():
            process.kill()
    ordered = [records[seed] for seed in sorted(records)]
    numbers = [0, *itertools.accumulate(record["outcome"] == WHOLE for record in ordered)]
    return ordered[: numbers.index(whole)] if whole else ordered


def keep(record: Record, folder: Path) -> None:
    """Write the record of a run into a soak's folder."""
    path = folder / f"record-{record.seed}.json"
    path.with_suffix(".tmp").write_text(json.dumps({**asdict(record), "outcome": record.outcome}))
    path.with_suffix(".tmp").replace(path)


def ended(seed: int, process: subprocess.Popen[bytes], began: float, folder: Path) -> dict[str, Any] | None:
    """The record of a run whose process ended, None while it goes on; to die or to hang is a fault."""
    code = process.poll()
    if code is None and time.monotonic() - began < LONGEST_RUN_S:
        return None
    process.kill()
    process.wait()
    path = folder / f"record-{seed}.json"
    if not path.exists():
        record, log = Record.of(random_plan(seed)), path.with_suffix(".log").read_text()[-2000:]
        hung = f"hung: no end within {LONGEST_RUN_S:g} s"
        record.faults.append(hung if code is None else f"the process ended with {code}: {log}")
        keep(record, folder)
    return json.loads(path.read_text())


def _started(seed: int, folder: Path, repeat_every: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "soak", "one", str(seed), "--folder", str(folder)]
    command += ["--repeat"] if repeat_every and seed % repeat_every == 0 else []
    paths = [str(Path(__file__).resolve().parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    with (folder / f"record-{seed}.log").open("wb") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log)


def _whole(records: Any) -> int:
    return sum(record["outcome"] == WHOLE for record in records)
