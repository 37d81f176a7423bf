"""Kinds of files that are fuzzed, and one damaged input: it is read, or refused with a message, or it found a fault."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import random
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.soak.mutators import Mutator, damaged
from lidardesign.errors import LidardesignError

MOST_SEEDS = 2000
# Of the inputs so many are damaged good files; the others are files that were damaged before.
GOOD_SHARE = 0.6
# Of damaged files that are read, so many are damaged further.
KEPT_SHARE = 0.2
DEEPEST = 6


Read = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """One kind of file.

    Arguments:
        name: What it is.
        share: Inputs out of 100,000.
        seeds: Good files of this kind; may write into a folder.
        mutate: How they are damaged.
        opened: In an empty folder, a function that reads a content as the program would.
        slow_s: Processor time that reading one may take [s].
        batch: How many are one piece of a long run.
    """

    name: str
    share: int
    seeds: Callable[[Path], list[bytes]]
    mutate: Mutator
    opened: Callable[[Path], Read]
    slow_s: float = 5.0
    batch: int = 1000

    @property
    def folder(self) -> str:
        """Its name for files."""
        return "".join(letter if letter.isalnum() else "-" for letter in self.name).strip("-")


def of_file(suffix: str, read: Callable[[Path], object]) -> Callable[[Path], Read]:
    """A reader of contents that are written to a file first."""

    def opened(folder: Path) -> Read:
        path = folder / f"input{suffix}"

        def run(content: bytes) -> object:
            path.write_bytes(content)
            return read(path)

        return run

    return opened


def attempt(read: Read, content: bytes, slow_s: float) -> tuple[str, str, str | None]:
    """Read one content in so much processor time [s]: whether it was `read` or `refused`, the line, and a fault."""
    before, how = time.process_time(), "ended otherwise"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", DeprecationWarning)
            result = read(content)
        how, place, fault = "read", "read", not_finite(result)
    except LidardesignError as error:
        how, place, fault = "refused", _place(error), _hidden_fault(error)
    # what is no error of the program is a fault of it, whatever it is
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        place, fault = _place(error), "".join(traceback.format_exception(error))
    seconds = time.process_time() - before
    if fault is None and seconds > slow_s:
        fault = f"took {seconds:.1f} s of processor time"
    return how, place, fault


def _place(error: BaseException) -> str:
    """The last lines of the program that an error passed through; a command says its own."""
    if hasattr(error, "place"):
        return error.place
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "lidardesign" in frame.filename]
    return " ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames[-3:])


def _hidden_fault(error: LidardesignError) -> str | None:
    """A refusal that says nothing, or that hides how the computer's memory ran out."""
    if not error.message.strip() or len(str(error)) > 5000:
        return f"a message of {len(str(error))} characters: {str(error)[:200]!r}"
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return "ran out of memory: " + "".join(traceback.format_exception(error))
        cause = cause.__cause__ or cause.__context__
    return None


def not_finite(value: object, name: str = "result", depth: int = 0) -> str | None:
    """The first number in a result that is NaN or infinite, by the path to it."""
    if isinstance(value, np.ndarray):
        bad = value.dtype.kind in "fc" and not np.isfinite(value).all()
        return f"{name} is not finite" if bad else None
    if isinstance(value, float):
        return None if math.isfinite(value) else f"{name} is {value}"
    if depth > DEEPEST:
        return None
    if isinstance(value, list | tuple):
        items = ((f"{name}[{index}]", item) for index, item in enumerate(value))
    elif isinstance(value, dict):
        items = ((f"{name}[{key!r}]", item) for key, item in value.items())
    elif dataclasses.is_dataclass(value):
        items = ((f"{name}.{part.name}", getattr(value, part.name)) for part in dataclasses.fields(value))
    elif hasattr(value, "model_dump"):
        items = iter([(name, value.model_dump())])
    else:
        return None
    return next((found for path, item in items if (found := not_finite(item, path, depth + 1))), None)


class Fuzzer:
    """A target's good files, what was learned of them, and damage that repeats for a seed.

    An input that ends at a line of the program where none ended before becomes one more file to damage.
    """

    def __init__(self, target: Target, folder: Path, seed: int) -> None:
        self.target = target
        self.source = random.Random(f"{target.name} {seed}")
        self.work = folder / "work"
        for part in (folder / "seeds", self.work):
            part.mkdir(parents=True)
        self.seeds = target.seeds(folder / "seeds")
        self._good, self._places = list(self.seeds), set()
        self.ends: Counter[str] = Counter()
        with contextlib.chdir(self.work):
            self.read = target.opened(self.work)
        self.present = set(os.listdir(self.work))

    def next(self) -> bytes:
        """The next damaged content."""
        content = self.source.choice(self._good if self.source.random() < GOOD_SHARE else self.seeds)
        return damaged(self.target.mutate, content, self.source, self._good)

    def run(self, content: bytes) -> str | None:
        """Read a content, in a folder of its own; what fault it found."""
        with contextlib.chdir(self.work):
            how, place, fault = attempt(self.read, content, self.target.slow_s)
        self.ends[how] += 1
        new = place not in self._places or (how == "read" and self.source.random() < KEPT_SHARE)
        if new and len(self.seeds) < MOST_SEEDS:
            self._places.add(place)
            self.seeds.append(content)
        return fault or self._left_behind()

    def _left_behind(self) -> str | None:
        """Files that only reading has made: whatever they are, reading must make none."""
        made = {name for name in set(os.listdir(self.work)) - self.present if not name.startswith("input")}
        for name in made:
            with contextlib.suppress(OSError):
                (self.work / name).unlink()
        return f"reading made {', '.join(sorted(made))}" if made else None
