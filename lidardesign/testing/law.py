"""Laws of the task contract, and what became of one: it holds, it does not, or it does not apply.

What the code of a task may take while it is checked.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from lidardesign.errors import LidardesignError, PluginError
from lidardesign.registry import AUTHOR_HINT

if TYPE_CHECKING:
    from lidardesign.testing.subject import Subject


PACKAGE = Path(__file__).parents[1]
# Libraries that tasks call, and that errors are raised in when they are called wrongly.
LIBRARIES = ("numpy", "scipy", "trimesh", "pydantic", "mujoco")
Outcome = Literal["pass", "fail", "skip"]
# What comes before all laws: name, group and statement.
LOADS = (
    "plugin loads",
    "interface",
    "it is imported, has all members of the interface, and its configuration resolves",
)


class BrokenLawError(PluginError):
    """A law of the contract that a task does not keep; the message says how, with figures (exit 6)."""


class Held(NamedTuple):
    """A law that holds: what was measured, in words, and the same as numbers by name with their unit."""

    words: str
    figures: Mapping[str, float] = {}


class NotApplicable(NamedTuple):
    """A law that says nothing about this task, and why."""

    reason: str


@dataclass(frozen=True)
class Law:
    """One law of the contract.

    Arguments:
        name: Short and unique, for tables and test names.
        group: The part of the contract that it belongs to.
        statement: What a task keeps to, in one sentence.
        check: Tries it on a task; raises BrokenLawError where it does not hold.
        needs: Names of laws without which it cannot be tried.
        after: Names of laws that are tried before it, whatever comes of them: it looks at what they did.
    """

    name: str
    group: str
    statement: str
    check: Callable[[Subject], Held | NotApplicable]
    needs: tuple[str, ...] = ()
    after: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """What became of a law.

    Arguments:
        law: Its name.
        group: Its group.
        statement: What it says.
        outcome: Whether it holds.
        detail: What was measured where it holds; else why it does not, or was not tried.
        seconds: How long that took [s].
        figures: Numbers by name.
    """

    law: str
    group: str
    statement: str
    outcome: Outcome
    detail: str
    seconds: float = 0.0
    figures: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """The form that it has in JSON."""
        return {
            "law": self.law,
            "group": self.group,
            "statement": self.statement,
            "outcome": self.outcome,
            "detail": self.detail,
            "seconds": round(self.seconds, 3),
            "figures": {name: float(value) for name, value in self.figures.items()},
        }


def said(error: LidardesignError) -> str:
    """A finding's words for an error: what was found, what is allowed, what to do."""
    parts = [error.message]
    if error.allowed:
        parts.append(f"allowed: {error.allowed}")
    # whoever checks a plugin is its author
    if error.hint and AUTHOR_HINT not in error.hint:
        parts.append(f"try: {error.hint}")
    return "; ".join(parts)


def place_of(error: BaseException) -> str:
    """Where in other code than this package's an error comes from, as " (task.py:52)"; empty where that is unknown.

    Of several places the last one counts that is in no installed library, unless there is none but in libraries.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_of_program(frame.filename)]
    own = [frame for frame in frames if not _is_library(frame.filename)] or frames
    return f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""


def _is_of_program(file: str) -> bool:
    return file.startswith("<") or Path(file).is_relative_to(PACKAGE)


def _is_library(file: str) -> bool:
    return any(name in Path(file).parts for name in (*LIBRARIES, "importlib", "contextlib.py"))


GIBIBYTE = 2**30


@dataclass(frozen=True)
class Limits:
    """What a task's code may take.

    Arguments:
        seconds: One call of it [s].
        memory_bytes: The process that runs it.
    """

    seconds: float = 60.0
    memory_bytes: int = 4 * GIBIBYTE
