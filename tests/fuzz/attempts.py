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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fuzz.mutators import Mutator, mutate_bytes
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
    """

    name: str
    share: int
    seeds: Callable[[Path], list[bytes]]
    mutate: Mutator
    opened: Callable[[Path], Read]
    slow_s: float = 5.0


def of_file(suffix: str, read: Callable[[Path], object]) -> Callable[[Path], Read]:
    """A reader of contents that are written to a file first."""

    def opened(folder: Path) -> Read:
        path = folder / f"input{suffix}"

        def run(content: bytes) -> object:
            path.write_bytes(content)
            return read(path)

        return run

    return opened


@dataclass
class Tally:
    """What came of a target's inputs.

    Arguments:
        read, refused: How many were taken, and how many refused.
        slowest_s: The longest processor time of one.
    """

    read: int = 0
    refused: int = 0
    slowest_s: float = 0.0


def attempt(read: Read, content: bytes, tally: Tally, slow_s: float) -> tuple[str, str | None]:
    """Read one content; the line at which it ended, and what fault it found, if it did."""
    before = time.process_time()
    fault = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", DeprecationWarning)
            result = read(content)
        place, fault = "read", not_finite(result)
        tally.read += 1
    except LidardesignError as error:
        place = _place(error)
        tally.refused += 1
        fault = _hidden_fault(error)
    # what is no error of the program is a fault of it, whatever it is
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        place, fault = _place(error), "".join(traceback.format_exception(error))
    seconds = time.process_time() - before
    tally.slowest_s = max(tally.slowest_s, seconds)
    if fault is None and seconds > slow_s:
        fault = f"took {seconds:.1f} s of processor time"
    return place, fault


def _place(error: BaseException) -> str:
    """The last lines of the program that an error passed through; a command says its own."""
    if hasattr(error, "place"):
        return error.place
    frames = [
        f"{Path(frame.filename).name}:{frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if "lidardesign" in frame.filename
    ]
    return " ".join(frames[-3:])


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
        self.seeds = target.seeds(_made(folder / "seeds"))
        self._good, self._places = list(self.seeds), set()
        self.tally = Tally()
        self.work = _made(folder / "work")
        with contextlib.chdir(self.work):
            self.read = target.opened(self.work)
        self.present = _names(self.work)

    def next(self) -> bytes:
        """The next damaged content; damage that a mutator cannot do to a damaged file is done to its bytes."""
        content = self.source.choice(self._good if self.source.random() < GOOD_SHARE else self.seeds)
        try:
            return self.target.mutate(content, self.source, self._good)
        # mutators parse what they change; a damaged file may not be what they parse
        except Exception:
            return mutate_bytes(content, self.source, self._good)

    def run(self, content: bytes) -> str | None:
        """Read a content, in a folder of its own; what fault it found."""
        with contextlib.chdir(self.work):
            place, fault = attempt(self.read, content, self.tally, self.target.slow_s)
        fault = fault or self._left_behind()
        new = place not in self._places or (place == "read" and self.source.random() < KEPT_SHARE)
        if new and len(self.seeds) < MOST_SEEDS:
            self._places.add(place)
            self.seeds.append(content)
        return fault

    def _left_behind(self) -> str | None:
        """Files that only reading has made: whatever they are, reading must make none."""
        made = {name for name in _names(self.work) - self.present if not name.startswith("input")}
        for name in made:
            with contextlib.suppress(OSError):
                (self.work / name).unlink()
        return f"reading made {', '.join(sorted(made))}" if made else None


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _names(folder: Path) -> set[str]:
    return {entry.name for entry in os.scandir(folder)}
