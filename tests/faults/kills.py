"""Kills of learn, fit and evaluate: what is left can be read, and going on gives the bytes of a straight run.

Usage: PYTHONPATH=tests python -m faults.kills [--kills 60] [--terms 20] [--pairs 5] [--out docs/soak/kills.md]

Four ways to end a command: SIGKILL of a process of its own after a random time, or SIGTERM; SIGKILL of a fork before
single steps that change a file, or SIGTERM. After each the folder is examined as it is, the command is given again
(`learn` with --resume), and the folder is compared with the straight one. Last, two commands work in it at once.
Interrupted and started again it goes on behind what is done.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from support.long_runs import heading, kept, write_page

from faults.processes import Ended, Fork, forked, fresh, import_all
from faults.runs import COMMANDS, FINISHED, LEARN, TO_TOLERANCE, Straight, contents, strays, unreadable

# Kills of a command per 10: learning is the longest, and writes the most.
SHARES = {"learn": 5, "fit": 2, "evaluate": 3}
# Commands that are given at once, in a folder as it was before one of them.
RESUME = [*LEARN, "--resume"]
PAIRS = {
    "learn and learn": ("learn", LEARN, LEARN),
    "learn and learn --resume": ("learn", LEARN, RESUME),
    "learn and fit": ("learn", LEARN, COMMANDS["fit"]),
    "learn --resume twice": ("fit", RESUME, RESUME),
    "learn --resume and fit": ("fit", RESUME, COMMANDS["fit"]),
    "fit and fit": ("fit", COMMANDS["fit"], COMMANDS["fit"]),
    "evaluate and evaluate": ("evaluate", COMMANDS["evaluate"], COMMANDS["evaluate"]),
    "evaluate and fit": ("evaluate", COMMANDS["evaluate"], COMMANDS["fit"]),
}
REFUSED = (2, 3)
# Random moments lie behind this share of a command's time: before it, hardly anything but libraries is loaded.
LIBRARIES_LOADED = 0.25
MOST_TRIES = 4
LONGEST_DELAY_S = 2.0
TERMINATED = 143
WAYS = {
    "SIGKILL": "SIGKILL after a random time, a process of its own",
    "step": "SIGKILL before a step that changes a file, a fork",
    "asked": "SIGTERM before a step that changes a file, a fork",
    "SIGTERM": "SIGTERM after a random time, a process of its own",
    "pair": "two commands in one folder at once",
}


RECOVERED = """\
After each: every file that was there could be read, the command given again ended with 0, no temporary file and no lock
was left, and the bytes of flow, samples, snapshots, checkpoint, designs and tables were those of the straight run, but
for the seconds in them. Of two commands at once one worked at least, and the other worked or was told why not."""


@dataclass
class Tally:
    """What was done, by way, how often it met the command at work, and what was not as it must be.

    Arguments:
        seed: Of random moments.
    """

    seed: int
    sent: Counter[str] = field(default_factory=Counter)
    early: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def of(self, way: str, key: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Count what came of one disturbance: as it was kept, or of doing it now."""
        found = kept(f"kills {self.seed}, {way} of {key}", work)
        self.sent[way] += 1
        self.early[way] += found["early"]
        self.faults += found["faults"]
        return found


class Killing:
    """Ends commands in a folder and looks at what is left, beside an undisturbed run."""

    def __init__(self, folder: Path, straight: Straight, tally: Tally) -> None:
        self.folder, self.straight, self.tally = folder, straight, tally

    def end(self, way: str, name: str, number: int, run_it: Callable[[Path], Ended], told: str) -> dict[str, Any]:
        """End one command in a folder of its own, look, give it again, and compare; `told` names the moment."""
        return self.tally.of(way, f"{name}, {number}", lambda: self._end(way, name, run_it, told))

    def _end(self, way: str, name: str, run_it: Callable[[Path], Ended], told: str) -> dict[str, Any]:
        place = self.folder / "killed"
        shutil.copytree(self.straight.before[name], place)
        ended = run_it(place)
        faults = [*self._left(way, ended, place), *self._after(name, place)]
        print(f"{way} of {name}, {told}: {'; '.join(faults) or 'recovered'}", file=sys.stderr, flush=True)
        shutil.rmtree(place)
        faults = [f"{WAYS[way]}, {name}, {told}: {fault}" for fault in faults]
        return {"early": ended.code not in FINISHED, "seconds": ended.seconds, "faults": faults}

    def _left(self, way: str, ended: Ended, place: Path) -> Iterator[str]:
        """What is wrong with the folder as it was left."""
        yield from (f"unreadable: {fault}" for fault in unreadable(place / "run"))
        if way not in ("SIGTERM", "asked"):
            return
        if ended.code not in (0, TERMINATED, -signal.SIGTERM):
            yield f"exit code {ended.code}: {ended.said[-300:]}"
        if "Traceback" in ended.said:
            yield f"a traceback: {ended.said[-300:]}"
        # a step may be that of tidying up itself: then the command given again does it
        if way == "SIGTERM" and strays(place):
            yield f"left {strays(place)}"

    def _after(self, name: str, place: Path) -> Iterator[str]:
        """What is wrong with the folder after the command was given again."""
        arguments = list(self.straight.commands[name])
        if arguments[0] == "learn" and (place / "run").exists():
            arguments.append("--resume")
        ended = forked(arguments, place)
        if ended.code not in FINISHED:
            yield f"given again it ended with {ended.code}: {ended.said[-300:]}"
            return
        if strays(place):
            yield f"given again it left {strays(place)}"
        expected, found = self.straight.after[name], contents(place / "run")
        yield from (f"{file} differs" for file in sorted({*expected, *found}) if expected.get(file) != found.get(file))

    def pair(self, name: str, number: int, delay_s: float) -> None:
        """Two commands at once: each works or is told why not, one works at least, and nothing is spoilt."""
        self.tally.of("pair", f"{name}, {number}", lambda: self._pair(name, delay_s))

    def _pair(self, name: str, delay_s: float) -> dict[str, Any]:
        before, first, second = PAIRS[name]
        place = self.folder / "both"
        shutil.copytree(self.straight.before[before], place)
        one = Fork(first, place)
        time.sleep(delay_s)
        other = Fork(second, place)
        ends = [one.ended(), other.ended()]
        faults = [*_badly_refused(ends), *(f"unreadable: {fault}" for fault in unreadable(place / "run"))]
        faults += [f"left {strays(place)}"] if strays(place) else []
        found, whole = contents(place / "run"), self.straight.after["evaluate"]
        faults += [f"{file} is missing" for file in self.straight.after["learn"] if file not in found]
        faults += [f"{file} differs" for file in found if file in whole and found[file] != whole[file]]
        print(f"{name}, {delay_s:.3f} s apart: {'; '.join(faults) or 'in order'}", file=sys.stderr, flush=True)
        shutil.rmtree(place)
        told = [f"{name}, {delay_s:.3f} s apart: {fault}" for fault in faults]
        return {"early": all(end.code == 0 for end in ends), "faults": told}


def _badly_refused(ends: list[Ended]) -> Iterator[str]:
    """What is wrong with how commands ended that worked in one folder."""
    if all(end.code != 0 for end in ends):
        yield "neither worked"
    for end in ends:
        if end.code not in (0, *REFUSED) or "Traceback" in end.said or "internal error" in end.said:
            yield f"exit code {end.code}: {end.said[-300:]}"


def at_random(killing: Killing, way: str, count: int, seed: int, seconds: dict[str, float]) -> None:
    """End commands in processes of their own after random times, until so many were met at work."""
    sent = signal.SIGTERM if way == "SIGTERM" else signal.SIGKILL
    names = [name for name, share in SHARES.items() for _ in range(share)]
    for number, name in enumerate(itertools.islice(itertools.cycle(names), MOST_TRIES * count)):
        if killing.tally.early[way] >= count:
            return
        # of a sequence of its own: what is done already draws nothing
        share = np.random.default_rng([seed, int(sent), number]).uniform(LIBRARIES_LOADED, 1.0)
        after_s = float(share * seconds[name])
        ends = functools.partial(fresh, killing.straight.commands[name], after_s=after_s, sent=sent)
        ended = killing.end(way, name, number, ends, f"after {after_s:.3f} s")
        if not ended["early"]:  # the computer has less to do than before
            seconds[name] = ended["seconds"]


def at_steps(killing: Killing, most: int, way: str = "step") -> None:
    """Kill forks of all commands before steps, at most so many of each."""
    sent = signal.SIGTERM if way == "asked" else signal.SIGKILL
    for name, whole in killing.straight.forks.items():
        for number in spread(whole.steps, most):
            ends = functools.partial(forked, killing.straight.commands[name], at_step=number, sent=sent)
            killing.end(way, name, number, ends, f"step {number}")


def in_pairs(killing: Killing, count: int, seed: int) -> None:
    """Give every pair of commands so many times, from at once to one after the other."""
    for place, name in enumerate(PAIRS):
        for number in range(count):
            latest_s = LONGEST_DELAY_S * number / max(count - 1, 1)
            killing.pair(name, number, float(np.random.default_rng([seed, place, number]).uniform(0, latest_s)))


def spread(last: int, count: int) -> list[int]:
    """So many of the numbers from 1 to a last one, evenly spread; all of them where there are no more."""
    return sorted({round(number) for number in np.linspace(0, last + 1, min(count, last) + 2)[1:-1]})


def page(tally: Tally, minutes: float) -> list[str]:
    """The parts of the result's page."""
    both, worked = tally.sent["pair"], tally.early["pair"]
    killed, met = tally.sent.total() - both, tally.early.total() - worked
    return [
        heading("Kills", f"python -m faults.kills --seed {tally.seed}"),
        f"- {minutes:.0f} minutes\n- killed or terminated: {killed}, of them while the command was at work: {met}\n"
        f"- two at once: {both}, of them both worked: {worked}\n- not recovered: {len(tally.faults)}",
        "\n".join(tally.faults) or RECOVERED,
    ]


def main() -> None:
    """Kill, look, tell; exit 1 where anything was not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=60, help="processes killed after random times")
    parser.add_argument("--terms", type=int, default=20, help="processes sent SIGTERM after random times")
    parser.add_argument("--pairs", type=int, default=5, help="how often each two commands work at once")
    parser.add_argument("--steps", type=int, default=10_000, help="at most so many steps of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None, help="write the result as Markdown")
    asked = parser.parse_args()
    began, tally = time.monotonic(), Tally(asked.seed)
    import_all()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        killing = Killing(folder, Straight(folder / "straight", COMMANDS), tally)
        at_steps(killing, asked.steps)
        at_steps(killing, asked.steps, "asked")
        in_pairs(killing, asked.pairs, asked.seed)
        if asked.kills + asked.terms:
            to_tolerance = Straight(folder / "tolerance", {"learn --tolerance": TO_TOLERANCE})
            at_steps(Killing(folder, to_tolerance, tally), asked.steps)
            seconds = killing.straight.measure_fresh(folder)
            at_random(killing, "SIGKILL", asked.kills, asked.seed, seconds)
            at_random(killing, "SIGTERM", asked.terms, asked.seed, seconds)
    parts = page(tally, (time.monotonic() - began) / 60)
    print("\n\n".join(parts))
    if asked.out is not None:
        write_page(asked.out, parts)
    sys.exit(1 if tally.faults else 0)


if __name__ == "__main__":
    main()
