"""Learning faces on several ranks of this machine, one thread each, against one process: steps per second and results.

Numbers of ranks take turns, as whole processes with the fields in the cache; one rank is started without a launcher.
What counts is the phase `learning`; the whole process also shows what does not shrink with ranks.

    python benchmarks/ranks.py [--ranks 1 2]
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from common import (
    ProcessResult,
    face_settings,
    lidardesign,
    median_ratio,
    model_option,
    parser,
    report,
    run_process,
    verdict,
)

TIMES_AS_FAST = 1.5


def command(ranks: int, *words: str | Path) -> list[str]:
    """`lidardesign` with words, on so many ranks."""
    if ranks == 1:
        return lidardesign(*words)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)]
    return [*launcher, "-m", "lidardesign", *map(str, words)]


def learn(ranks: int, options: Any, cache: Path) -> ProcessResult:
    """Learn once, into a folder that goes away."""
    settings = [f"learning.steps={options.steps}", *options.set]
    settings += [f"{key}={value}" for key, value in face_settings(options.model).items()]
    with tempfile.TemporaryDirectory() as folder:
        words = ["learn", "face", "--preset", options.preset, "--out", Path(folder) / "run", "--json"]
        for setting in settings:
            words += ["--set", setting]
        return run_process(command(ranks, *words), {"LIDARDESIGN_CACHE": str(cache)})


def measured(options: Any) -> dict[int, list[ProcessResult]]:
    """Every number of ranks in every round, after one run that fills the cache."""
    results: dict[int, list[ProcessResult]] = {ranks: [] for ranks in options.ranks}
    with tempfile.TemporaryDirectory() as folder:
        learn(1, options, Path(folder)).document()
        for _ in range(options.rounds):
            for ranks, done in results.items():
                done.append(learn(ranks, options, Path(folder)))
    return results


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    model_option(made)
    made.add_argument("--ranks", type=int, nargs="+", default=[1, 2], help="(default 1 2)")
    made.add_argument("--steps", type=int, default=100, help="of learning (default %(default)s)")
    made.add_argument("--preset", default="standard", help="what is learned (default %(default)s)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed on; repeatable")
    options = made.parse_args()
    results = measured(options)
    learning = {ranks: [one.document()["timings"]["learning"] for one in found] for ranks, found in results.items()}
    first, rows, faster = options.ranks[0], [], {}
    for ranks, found in results.items():
        document, seconds = found[0].document(), statistics.median(learning[ranks])
        faster[ranks] = median_ratio(learning[first], learning[ranks])
        wall, cpu = (statistics.median(column) for column in zip(*((one.wall, one.cpu) for one in found), strict=True))
        figures = (document["ess"], document["kl_nats"], document["coverage"])
        rows.append([ranks, wall, cpu, seconds, options.steps / seconds, faster[ranks], *figures])
    columns = ["ranks", "wall s", "CPU s", "learning s", "steps per s", "times as fast", "ESS", "KL nats", "coverage"]
    claims = {f"{ranks} ranks": ratio >= TIMES_AS_FAST for ranks, ratio in faster.items() if ranks != first}
    report(
        f"Learning on ranks: {options.steps} steps, preset {options.preset}",
        {"Medians; ratios are medians within rounds": (columns, rows)},
        [verdict(f"at least {TIMES_AS_FAST} times as fast as {first} rank", claims)] if claims else [],
        options.json,
    )


if __name__ == "__main__":
    main()
