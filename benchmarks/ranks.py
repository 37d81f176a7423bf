"""Steps of learning on one rank and on several of this computer, one thread each: throughput, waiting and memory.

Every size is timed in processes of its own, one size after the other in every round; the table has medians. A step's
time is taken with the flow of a finished run (`--run`), or after a short training from the start. What a rank computes
is its processor time; the rest of its wall time it waits, for the others or for a core: on a computer where the ranks
do not have a core each, only the processor time says what more cores would give. The last table times the collectives
alone, with as many numbers as a step sends.

    python benchmarks/ranks.py                          # face, standard, 1 and 2 ranks
    python benchmarks/ranks.py --run runs/arm --sizes 1 2 4
"""

from __future__ import annotations

import json
import os
import resource
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import MEBIBYTE, ROOT, face_settings, model_option, parser, report, verdict

WORKER = "--worker"
COUNTED_FROM = 3  # the first steps of a phase compile and fill caches
COLUMNS = ("phase", "ranks", "ms per step", "CPU ms of a rank", "throughput", "of the work alone", "peak MiB of a rank")
AT_LEAST = 1.5


def start(size: int, job: dict[str, Any]) -> dict[str, Any]:
    """What the first of `size` ranks measured."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    shared = {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(size)}
    words = [sys.executable, str(ROOT / "benchmarks" / "ranks.py"), WORKER, json.dumps(job)]
    ranks = [
        subprocess.Popen(words, env={**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)}, stdout=subprocess.PIPE)
        for rank in range(size)
    ]
    outputs = [rank.communicate()[0] for rank in ranks]
    if any(rank.returncode for rank in ranks):
        sys.exit(f"{size} ranks failed")
    return json.loads(outputs[0])


def work(job: dict[str, Any]) -> None:
    """Be one rank: prepare, train a little, time steps of both phases, and print what was found as the first rank."""
    import torch

    from lidardesign.config import load_run_config, resolve
    from lidardesign.density.learn import FLOW, make_trainer
    from lidardesign.density.rank_processes import join_ranks
    from lidardesign.density.training.checkpoint import load_arrays
    from lidardesign.density.training.training_data import prepare_ground
    from lidardesign.registry import load_task

    ranks = join_ranks()
    if job["run"]:
        task, config = load_run_config(Path(job["run"]))
    else:
        task = load_task(job["task"])
        config = resolve(task, preset=job["preset"], overrides=job["set"])
    if not ranks.first:
        ranks.share(b"")  # the announcement that ranks wait for in `learn`
    ground = prepare_ground(task, config, ranks)
    trainer = make_trainer(ground, config, Path(), torch.device("cpu"))
    if job["run"]:
        weights = load_arrays(Path(job["run"]), FLOW)[0]
        trainer.flow.load_state_dict({name: torch.as_tensor(value) for name, value in weights.items()})
    else:
        for _ in range(job["warm"]):
            trainer._advance()
    found: dict[str, Any] = {}
    for phase, first in (("along paths", trainer.pathwise_steps - 1), ("balancing", trainer.pathwise_steps)):
        if 0 <= first < config.learning.steps:
            found[phase] = steps_of(trainer, first, job["steps"])
    found["collectives"] = collectives(ranks, trainer, config.learning.batch)
    if ranks.first:
        print(json.dumps(found))
    ranks.leave()


def steps_of(trainer: Any, first: int, count: int) -> dict[str, float]:
    """Wall and processor time of one step of a phase [s], and the largest memory, of the rank that has most of each."""
    wall, cpu = [], []
    for _ in range(COUNTED_FROM + count):
        trainer.step = first
        started, spent = time.perf_counter(), time.process_time()
        trainer.find_gradient()
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - spent)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MEBIBYTE
    own = [statistics.median(wall[COUNTED_FROM:]), statistics.median(cpu[COUNTED_FROM:]), peak]
    return dict(zip(("wall", "cpu", "peak"), trainer.target.ranks.max(np.array(own)).tolist(), strict=True))


def collectives(ranks: Any, trainer: Any, batch: int) -> dict[str, float]:
    """What it takes to gather a step's points, to add up its gradient by points and by parameters [s]."""
    rows, values = np.zeros((batch // ranks.size, 6)), np.zeros((batch, 6))
    parameters = list(trainer.flow.parameters())
    calls: dict[str, Callable[[], Any]] = {
        "gather points": lambda: ranks.gather(rows),
        "sum by points": lambda: ranks.sum(values),
        "sum by parameters": lambda: ranks.sum_gradients(parameters, valid=True),
    }
    found = {}
    for name, call in calls.items():
        taken = []
        for _ in range(50):
            started = time.perf_counter()
            call()
            taken.append(time.perf_counter() - started)
        found[name] = statistics.median(taken)
    return found


def rows_of(phase: str, found: dict[int, list[dict[str, Any]]]) -> list[list[object]]:
    """The table's rows of one phase."""
    rows: list[list[object]] = []
    alone = found[min(found)]
    for size, rounds in found.items():
        wall, cpu, peak = (statistics.median(one[phase][key] for one in rounds) for key in ("wall", "cpu", "peak"))
        ratios = [a[phase]["wall"] / b[phase]["wall"] for a, b in zip(alone, rounds, strict=True)]
        work = [a[phase]["cpu"] / b[phase]["cpu"] for a, b in zip(alone, rounds, strict=True)]
        rows.append([phase, size, 1e3 * wall, 1e3 * cpu, statistics.median(ratios), statistics.median(work), peak])
    return rows


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] == [WORKER]:
        work(json.loads(sys.argv[2]))
        return
    made = parser(__doc__, rounds=3)
    model_option(made)
    made.add_argument("--task", default="face", help="what is learned (default %(default)s)")
    made.add_argument("--preset", default="standard")
    made.add_argument("--run", type=Path, help="a finished run whose flow the steps are timed with")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    made.add_argument("--sizes", type=int, nargs="+", default=[1, 2], help="numbers of ranks (default 1 2)")
    made.add_argument("--steps", type=int, default=30, help="steps timed in each phase (default %(default)s)")
    made.add_argument("--warm", type=int, default=100, help="steps before, without --run (default %(default)s)")
    options = made.parse_args()
    model = face_settings(options.model) if options.task == "face" and options.run is None else {}
    settings = [*(f"task.{key}={value}" for key, value in model.items()), *options.set]
    job = {key: getattr(options, key) for key in ("task", "preset", "steps", "warm")}
    job |= {"set": settings, "run": str(options.run) if options.run else None}
    found: dict[int, list[dict[str, Any]]] = {size: [] for size in sorted({1, *options.sizes})}
    for _ in range(options.rounds):
        for size in found:
            found[size].append(start(size, job))
    phases = [phase for phase in ("along paths", "balancing") if phase in found[1][0]]
    rows = [row for phase in phases for row in rows_of(phase, found)]
    calls = list(found[1][0]["collectives"])
    waits = [
        [size, *(1e3 * statistics.median(one["collectives"][name] for one in rounds) for name in calls)]
        for size, rounds in found.items()
        if size > 1
    ]
    claims = {f"{row[0]}, 2 ranks": row[4] >= AT_LEAST for row in rows if row[1] == 2}
    tables: dict[str, tuple[Any, Any]] = {
        f"Steps of {options.run or options.task}": (COLUMNS, rows),
        "Collectives alone, ms": (("ranks", *calls), waits),
    }
    lines = [verdict(f"two ranks do at least {AT_LEAST:g} times the steps of one", claims)]
    report("Learning on several ranks", tables, lines, options.json)


if __name__ == "__main__":
    main()
