"""The long runs: `python -m soak runs`, `python -m soak seeds`, and `python -m soak one SEED` to look into a run.

With tests/ on PYTHONPATH; `make soak` does that. They end with 1 where anything is not as it should be.
Interrupted and started again they go on behind the runs that are done.
"""

from __future__ import annotations

import argparse
import datetime
import signal
import sys
import tempfile
from pathlib import Path

from support.pieces import Pieces
from support.result_pages import ROOT

from soak.batches import keep, soak
from soak.plans import random_plan
from soak.runs_page import runs_page
from soak.scaled_flatland import offer
from soak.seeds import LIMITS, learn_seeds, seeds_page
from soak.whole_runs import plan_lines, whole_run

TERMINATED = 143
PAGES = ROOT / "docs" / "soak"
TODAY = datetime.datetime.now(datetime.UTC).date().isoformat()


def main(arguments: list[str] | None = None) -> int:
    """Do what the command line says."""
    given = _parser().parse_args(arguments)
    if given.folder is not None:
        return given.do(given, given.folder)
    with tempfile.TemporaryDirectory(prefix="lidardesign-soak-") as folder:
        return given.do(given, Path(folder))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m soak", description=__doc__)
    commands = parser.add_subparsers(required=True)
    runs = commands.add_parser("runs", help="random whole runs")
    runs.add_argument("--whole", type=int, default=200, help="until so many were whole; 0: the page of what is done")
    runs.add_argument("--first", type=int, default=0, help="the first seed")
    runs.add_argument("--repeat-every", type=int, default=1, help="do every n-th run twice; 0: none")
    runs.add_argument("--page", type=Path, default=PAGES / f"runs-{TODAY}.md")
    seeds = commands.add_parser("seeds", help="learn tasks at presets from many seeds")
    every = [f"{task}:{preset}" for task, preset in LIMITS]
    seeds.add_argument("presets", nargs="*", type=_preset, metavar="TASK:PRESET", help=f"of {', '.join(every)}")
    seeds.add_argument("--count", type=int, default=20, help="seeds 0 to N - 1")
    seeds.add_argument("--page", type=Path, default=PAGES / f"seeds-{TODAY}.md")
    one = commands.add_parser("one", help="one random run, with its configuration")
    one.add_argument("seed", type=int)
    one.add_argument("--repeat", action="store_true", help="do it twice")
    for command, do in ((runs, _runs), (seeds, _seeds), (one, _one)):
        command.set_defaults(do=do)
        command.add_argument("--folder", type=Path, help="where runs are made")
        if command is not one:
            command.add_argument("--jobs", type=int, default=1, help="processes at once")
    return parser


def _preset(text: str) -> tuple[str, ...]:
    named = tuple(text.split(":"))
    if named not in LIMITS:
        raise argparse.ArgumentTypeError(f"{text!r} is not one of {', '.join(map(':'.join, LIMITS))}")
    return named


def _runs(given: argparse.Namespace, folder: Path) -> int:
    # the processes that do the runs end with this one
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    choices = {"first": given.first, "jobs": given.jobs, "repeat_every": given.repeat_every}
    records = soak(given.whole, folder, Pieces("soak-runs"), **choices, tell=_tell)
    runs_page(given.page, records, f"python -m soak runs --whole {given.whole} --first {given.first}")
    faults = sum(bool(record["faults"]) for record in records)
    _tell(f"{len(records)} runs, {faults} with faults: {given.page}")
    return int(faults > 0)


def _seeds(given: argparse.Namespace, folder: Path) -> int:
    presets = given.presets or list(LIMITS)
    learned = learn_seeds(presets, range(given.count), folder, Pieces("soak-seeds"), jobs=given.jobs, tell=_tell)
    seeds_page(given.page, learned, f"python -m soak seeds {' '.join(map(':'.join, presets))} --count {given.count}")
    faults = sum(bool(one.fault) for one in learned)
    _tell(f"{len(learned)} densities, {faults} beyond their limits: {given.page}")
    return int(faults > 0)


def _one(given: argparse.Namespace, folder: Path) -> int:
    # a folder of its own: another run may be reading
    sys.path.insert(0, str(offer(folder / f"offered{given.seed}")))
    print("\n".join(plan_lines(given.seed)))
    plan, place = random_plan(given.seed), folder / f"run{given.seed}"
    record = whole_run(plan, place)
    if given.repeat:
        again = record.differences(whole_run(plan, place))
        record.repeated = not again
        record.faults += [f"a second run did not repeat: {', '.join(again)}"] if again else []
    keep(record, folder)
    for command, asked, code, seconds in record.steps:
        print(f"{command} {asked}: exit {code}, {seconds} s of processor time")
    print("\n".join([record.outcome, *record.faults]))
    return int(bool(record.faults))


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
