"""A kind of file that is fuzzed, and how its contents reach the program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fuzz.mutators import Mutator

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
