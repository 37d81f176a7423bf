"""The long runs: `python -m soak runs`, `python -m soak seeds`, and `python -m soak one SEED` to look into a run.

With tests/ on PYTHONPATH; `make soak` does that. They end with 1 where anything is not as it should be.
"""

from __future__ import annotations

import argparse
import datetime
import signal
import sys
import tempfile
from pathlib import Path

from soak.batches import do_batch, records_in, soak
from soak.pages import ROOT
from soak.plans import random_plan
from soak.runs_page import runs_page
from soak.scaled_flatland import offer
from soak.seeds import LEAST_ESS, learn_seeds, seeds_page
from soak.whole_runs import plan_lines, whole_run

TERMINATED = 143
PAGES = ROOT / "docs" / "soak"
TODAY = datetime.datetime.now(datetime.timezone.utc).date().isoformat()


def main(arguments: list[str] | None = None) -> int:
    """Do what the command line says."""
    given = _parser().parse_args(arguments)
    if given.command == "batch":
        do_batch(given.seed, given.lines, given.folder, repeat_every=given.repeat_every)
        return 0
    if given.folder is not None:
        return _DO[given.command](given, given.folder)
    with tempfile.TemporaryDirectory(prefix="lidardesign-soak-") as folder:
        return _DO[given.command](given, Path(folder))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m soak", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("runs", help="random whole runs")
    runs.add_argument("--whole", type=int, default=200, help="until so many were whole")
    runs.add_argument("--first", type=int, default=0, help="the first seed")
    runs.add_argument("--repeat-every", type=int, default=1, help="do every n-th run twice; 0: none")
    runs.add_argument("--page", type=Path, default=PAGES / f"runs-{TODAY}.md")
    seeds = commands.add_parser("seeds", help="learn tasks at draft from many seeds")
    seeds.add_argument("tasks", nargs="*", default=list(LEAST_ESS), metavar="TASK")
    seeds.add_argument("--count", type=int, default=20, help="seeds 0 to N - 1")
    seeds.add_argument("--page", type=Path, default=PAGES / f"seeds-{TODAY}.md")
    page = commands.add_parser(
        "page", help="the page of what `runs --folder` has done until now, or until it was ended"
    )
    page.add_argument("--page", type=Path, default=PAGES / f"runs-{TODAY}.md")
    one = commands.add_parser("one", help="one random run, with its configuration")
    one.add_argument("seed", type=int)
    batch = commands.add_parser("batch", help="runs in this process, as `runs` starts them")
    batch.add_argument("seed", type=int, nargs="+")
    batch.add_argument("--lines", type=Path, required=True)
    batch.add_argument("--repeat-every", type=int, default=0)
    for command in (runs, seeds):
        command.add_argument("--jobs", type=int, default=1, help="processes at once")
    for command in (runs, seeds, one, batch, page):
        command.add_argument("--folder", type=Path, required=command is page, help="where runs are kept")
    return parser


def _runs(given: argparse.Namespace, folder: Path) -> int:
    # the processes that do the runs end with this one
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    choices = {"first": given.first, "jobs": given.jobs, "repeat_every": given.repeat_every}
    records = soak(given.whole, folder, **choices, tell=_tell)
    runs_page(given.page, records, f"python -m soak runs --whole {given.whole} --first {given.first}")
    faults = sum(bool(record["faults"]) for record in records)
    _tell(f"{len(records)} runs, {faults} with faults: {given.page}")
    return int(faults > 0)


def _page(given: argparse.Namespace, folder: Path) -> int:
    records = records_in(folder)
    runs_page(given.page, records, "python -m soak runs")
    return int(any(record["faults"] for record in records))


def _seeds(given: argparse.Namespace, folder: Path) -> int:
    learned = learn_seeds(given.tasks, range(given.count), folder, jobs=given.jobs, tell=_tell)
    seeds_page(given.page, learned, f"python -m soak seeds {' '.join(given.tasks)} --count {given.count}")
    faults = sum(bool(one.fault) for one in learned)
    _tell(f"{len(learned)} densities, {faults} below their ESS: {given.page}")
    return int(faults > 0)


def _one(given: argparse.Namespace, folder: Path) -> int:
    sys.path.insert(0, str(offer(folder / "offered")))
    print("\n".join(plan_lines(given.seed)))
    record = whole_run(random_plan(given.seed), folder / f"run{given.seed}")
    for command, asked, code, seconds in record.steps:
        print(f"{command} {asked}: exit {code}, {seconds} s of processor time")
    print("\n".join([record.outcome, *record.faults]))
    return int(bool(record.faults))


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


_DO = {"runs": _runs, "seeds": _seeds, "one": _one, "page": _page}

if __name__ == "__main__":
    sys.exit(main())
