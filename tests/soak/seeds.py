"""Learning a task at a preset from many seeds, as a user would: a program each, and how far the densities differ."""

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

# The least ESS and the largest KL [nats] that every seed has to reach, by task and preset.
LIMITS = {
    ("face", "draft"): (0.3, 0.5),
    ("face", "standard"): (0.5, 0.15),
    ("arm", "draft"): (0.2, 2.0),
    ("arm", "standard"): (0.35, 0.8),
}
SHOWN = ("ess", "kl_nats", "log_z", "coverage", "misplaced", "seconds")


@dataclass(frozen=True)
class Learned:
    """What `learn` said of one seed: its document, or the error's."""

    task: str
    preset: str
    seed: int
    code: int
    document: dict[str, Any]

    @property
    def fault(self) -> str:
        """What is wrong with it; empty where nothing is."""
        if self.code:
            return f"exit {self.code}: {self.document.get('error', {}).get('message', 'no document')}"
        least_ess, most_nats = LIMITS[self.task, self.preset]
        if self.document["ess"] <= least_ess:
            return f"ESS {self.document['ess']:.3f}"
        return f"KL {self.document['kl_nats']:.3g} nats" if self.document["kl_nats"] >= most_nats else ""


def learn_seeds(
    presets: Sequence[tuple[str, str]],
    seeds: Sequence[int],
    folder: Path,
    pieces: Pieces,
    *,
    jobs: int,
    tell: Callable[[str], None],
) -> list[Learned]:
    """Learn every task at its preset from every seed that is not done, in this order."""
    lock = threading.Lock()

    def learn(task: str, preset: str, seed: int) -> Learned:
        name = f"{task} {preset} {seed}"
        learned = Learned(**pieces.of(name, lambda: asdict(_learn(task, preset, seed, folder))))
        with lock:
            tell(f"{name}: ESS {learned.document.get('ess', 0):.3f} {learned.fault}")
        return learned

    jobs_of = [(*one, seed) for one in presets for seed in seeds]
    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(learn, *zip(*jobs_of, strict=True)))


def _learn(task: str, preset: str, seed: int, folder: Path) -> Learned:
    run = folder / f"{task}-{preset}-{seed}"
    shutil.rmtree(run, ignore_errors=True)
    command = [sys.executable, "-m", "lidardesign", "learn", task, "--preset", preset, "--seed", str(seed)]
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--out", str(run), "--json", "--quiet"], capture_output=True, env={**os.environ, **one_thread}
    )
    shutil.rmtree(run, ignore_errors=True)
    try:
        document = json.loads(done.stdout)
    except ValueError:
        document = {"error": {"message": done.stderr.decode(errors="replace")[-500:]}}
    return Learned(task, preset, seed, done.returncode, document)


def seeds_page(path: Path, learned: Sequence[Learned], command: str) -> None:
    """Write the page: the spread of every figure by task."""
    parts = [heading("Learning from many seeds", command)]
    for task, preset in dict.fromkeys((one.task, one.preset) for one in learned):
        parts += _task_parts(task, preset, [one for one in learned if (one.task, one.preset) == (task, preset)])
    write_page(path, parts)


def _task_parts(task: str, preset: str, learned: Sequence[Learned]) -> list[str]:
    good = [one for one in learned if not one.code]
    faults = [f"seed {one.seed}: {one.fault}" for one in learned if one.fault]
    enough = len(learned) - len(faults)
    least_ess, most_nats = LIMITS[task, preset]
    said = f"`learn {task} --preset {preset}` from {len(learned)} seeds, one thread each: {enough} of {len(learned)} "
    said += f"end with an ESS above {least_ess:g} and a KL below {most_nats:g} nats. {'; '.join(faults)}"
    if not good:
        return [f"## {task}, {preset}", paragraph(said)]
    figures = {name: np.array([one.document[name] for one in good], dtype=np.float64) for name in SHOWN}
    spread = [
        (name, *(f"{v:.3g}" for v in (x.min(), np.median(x), x.max(), x.std(ddof=1) if len(x) > 1 else 0.0)))
        for name, x in figures.items()
    ]
    return [
        f"## {task}, {preset}",
        paragraph(said),
        table(("figure", "least", "median", "most", "standard deviation"), spread),
    ]
