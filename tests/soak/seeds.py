"""Learning a task at draft from many seeds, as a user would: a program each, and how far the densities differ."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from support.pieces import Pieces
from support.result_pages import heading, paragraph, table, write_page

# The least effective sample size that every seed has to reach.
LEAST_ESS = {"face": 0.3, "arm": 0.15}
SHOWN = ("ess", "kl_nats", "log_z", "coverage", "misplaced", "seconds")


@dataclass(frozen=True)
class Learned:
    """What `learn` said of one seed: its document, or the error's."""

    task: str
    seed: int
    code: int
    document: dict[str, Any]

    @property
    def fault(self) -> str:
        """What is wrong with it; empty where nothing is."""
        if self.code:
            return f"exit {self.code}: {self.document.get('error', {}).get('message', 'no document')}"
        return "" if self.document["ess"] > LEAST_ESS[self.task] else f"ESS {self.document['ess']:.3f}"


def learn_seeds(
    tasks: Sequence[str], seeds: Sequence[int], folder: Path, pieces: Pieces, *, jobs: int, tell: Callable[[str], None]
) -> list[Learned]:
    """Learn every task from every seed that is not done, by task and seed."""
    lock = threading.Lock()

    def learn(task: str, seed: int) -> Learned:
        learned = Learned(**pieces.of(f"{task} {seed}", lambda: asdict(_learn(task, seed, folder))))
        with lock:
            tell(f"{task} {seed}: ESS {learned.document.get('ess', 0):.3f} {learned.fault}")
        return learned

    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(learn, [t for t in tasks for _ in seeds], [s for _ in tasks for s in seeds]))


def _learn(task: str, seed: int, folder: Path) -> Learned:
    run = folder / f"{task}{seed}"
    shutil.rmtree(run, ignore_errors=True)
    command = [sys.executable, "-m", "lidardesign", "learn", task, "--preset", "draft", "--seed", str(seed)]
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--out", str(run), "--json", "--quiet"], capture_output=True, env={**os.environ, **one_thread}
    )
    shutil.rmtree(run, ignore_errors=True)
    try:
        document = json.loads(done.stdout)
    except ValueError:
        document = {"error": {"message": done.stderr.decode(errors="replace")[-500:]}}
    return Learned(task, seed, done.returncode, document)


def seeds_page(path: Path, learned: Sequence[Learned], command: str) -> None:
    """Write the page: the spread of every figure by task, then every seed."""
    parts = [heading("Learning from many seeds", command)]
    for task in dict.fromkeys(one.task for one in learned):
        parts += _task_parts(task, [one for one in learned if one.task == task])
    write_page(path, parts)


def _task_parts(task: str, learned: Sequence[Learned]) -> list[str]:
    good = [one for one in learned if not one.code]
    faults = [f"seed {one.seed}: {one.fault}" for one in learned if one.fault]
    enough = len(learned) - len(faults)
    said = f"`learn {task} --preset draft` from {len(learned)} seeds, one thread each: {enough} of {len(learned)} end "
    said += f"with an ESS above {LEAST_ESS[task]:g}. {'; '.join(faults)}"
    if not good:
        return [f"## {task}", paragraph(said)]
    figures = {name: np.array([one.document[name] for one in good], dtype=np.float64) for name in SHOWN}
    spread = [
        (name, *(f"{v:.3g}" for v in (x.min(), np.median(x), x.max(), x.std(ddof=1) if len(x) > 1 else 0.0)))
        for name, x in figures.items()
    ]
    each = [(one.seed, *(f"{one.document[name]:.3g}" for name in SHOWN)) for one in good]
    return [
        f"## {task}",
        paragraph(said),
        table(("figure", "least", "median", "most", "standard deviation"), spread),
        table(("seed", *SHOWN), each),
    ]
