"""The error tree of lidardesign: every error has a location, a finding, the allowed values and a hint.

Exit codes (design contract): 0 ok, 1 threshold missed, 2 usage or config, 3 bad input data,
4 infeasible constraints, 5 numerical failure, 6 plugin failure, 130 interrupted.
"""

from __future__ import annotations

import errno
import functools
import re
import site
import sys
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from pathlib import Path
from shlex import quote
from typing import ParamSpec, TypeVar

# Longest part of a message, which may quote files and options; and of what is printed at once.
LONGEST_PART, LONGEST_TEXT = 1500, 20_000
# What a terminal does not show but obeys: control characters but tabs and line feeds, and directions of writing.
OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
Text = TypeVar("Text", str, None)
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
# Options in messages, and arguments with other names than their options.
OPTION = re.compile(r"(?<!\S)--([a-z][a-z-]*)")
ARGUMENTS = {
    "baseline": "baselines",
    "set": "settings",
    "time-budget": "time_budget_s",
    "weight": "weights",
}
# Words of libraries that have no memory left.
NO_MEMORY = ("allocate memory", "failed to map segment", "bad_alloc")
# Hint for an option or a key without a value.
UNSET_HINT = "a shell variable that is not set expands to nothing: give a value, or leave it out"
# Folders of the documentation: of a checkout, or of an installation (pyproject.toml, data-files).
_ROOT = Path(__file__).parents[1]
_SHARED = Path("share", "doc", "lidardesign")
DOCS_FOLDERS = (_ROOT / "docs", _ROOT, _ROOT / _SHARED, sys.prefix / _SHARED, site.getuserbase() / _SHARED)


class BackgroundNote(str):
    """A note that requires no action, which commands print only with --verbose."""

    __slots__ = ()


class LidardesignError(Exception):
    """The root of every error that a user can meet.

    Arguments:
        message: The finding, in one sentence.
        where: File, line, field or option that it concerns.
        allowed: The accepted values.
        hint: The next step.
    """

    exit_code = 2
    kind = "error"

    def __init__(
        self, message: str, *, where: str | None = None, allowed: str | None = None, hint: str | None = None
    ) -> None:
        self.message, self.allowed, self.hint = escaped(message), escaped(allowed), escaped(hint)
        # names of files may have line feeds
        self.where = escaped(where and where.replace("\n", "\\n"))
        super().__init__(message)

    def __str__(self) -> str:
        """The whole message: location, finding, allowed values, next step."""
        text = f"{self.where}: {self.message}" if self.where else self.message
        if self.allowed:
            text += f"\n  allowed: {self.allowed}"
        if self.hint:
            text += f"\n  try: {self.hint}"
        return text

    def name_arguments(self) -> None:
        """Replace names of command options in the message by names of function arguments."""
        texts = (self.message, self.where, self.allowed, self.hint)
        self.message, self.where, self.allowed, self.hint = map(with_arguments, texts)

    def as_dict(self) -> dict[str, object]:
        """Content of the error for `--json`."""
        fields = {"where": self.where, "allowed": self.allowed, "hint": self.hint}
        return {"kind": self.kind, "message": self.message, **{k: v for k, v in fields.items() if v}}


def escaped(text: Text, longest: int = LONGEST_PART) -> Text:
    """Text of others as it is shown: what terminals obey is escaped, and the middle of a long one left out."""
    if text is None:
        return None
    half = longest // 2
    text = text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"
    return OBEYED.sub(lambda found: ascii(found[0])[1:-1], text)


def with_arguments(text: Text) -> Text:
    """A text with names of function arguments for those of command options."""
    if text is None or "lidardesign " in text:
        # command lines are left as they are
        return text
    return OPTION.sub(lambda option: ARGUMENTS.get(option[1], option[1].replace("-", "_")), text)


def names_arguments(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a function of the Python interface so that its errors name arguments instead of options."""

    @functools.wraps(function)
    def called(*arguments: Parameters.args, **options: Parameters.kwargs) -> Result:
        try:
            return function(*arguments, **options)
        except LidardesignError as error:
            error.name_arguments()
            raise

    return called


class ConfigError(LidardesignError):
    """A usage, configuration or constraint file error (exit 2)."""

    exit_code, kind = 2, "config"


class DataError(LidardesignError):
    """An input file or mesh that cannot be used (exit 3)."""

    exit_code, kind = 3, "data"


class InfeasibleError(LidardesignError):
    """Constraints that no design can satisfy, or that leave too little of the density (exit 4).

    Arguments:
        conflicts: Names of the constraints that contradict each other.
        admissible_mass: The share of the density inside the constraints, where it was measured.
    """

    exit_code, kind = 4, "infeasible"

    def __init__(
        self,
        message: str,
        *,
        conflicts: Sequence[str] = (),
        admissible_mass: float | None = None,
        where: str | None = None,
        allowed: str | None = None,
        hint: str | None = None,
    ) -> None:
        self.conflicts, self.admissible_mass = tuple(conflicts), admissible_mass
        super().__init__(message, where=where, allowed=allowed, hint=hint)

    def name_arguments(self) -> None:
        """Replace names of command options by names of function arguments, in conflicts too."""
        self.conflicts = tuple(map(with_arguments, self.conflicts))
        super().name_arguments()

    def as_dict(self) -> dict[str, object]:
        """Content of the error for `--json`, with the conflicting names and the measured mass."""
        fields: dict[str, object] = {**super().as_dict(), "conflicts": list(self.conflicts)}
        if self.admissible_mass is not None:
            fields["admissible_mass"] = self.admissible_mass
        return fields


class NumericalError(LidardesignError):
    """A numerical failure of a computation (exit 5)."""

    exit_code, kind = 5, "numerical"


class DivergenceError(NumericalError):
    """Learning that diverged; the message names the last good checkpoint (exit 5)."""


class PluginError(LidardesignError):
    """A task plugin that failed to load or broke its contract (exit 6)."""

    exit_code, kind = 6, "plugin"


class ThresholdError(LidardesignError):
    """A threshold that the user set was missed (exit 1)."""

    exit_code, kind = 1, "threshold"


def pasted(value: object) -> str:
    """A path or a value as a command line in a message has it: quoted for the shell, and never an option."""
    text = str(value)
    return quote(f"./{text}" if text.startswith("-") else text)


def text_of(error: BaseException) -> str:
    """Message of an error in one line, even if its class fails to make one."""
    try:
        return " ".join(escaped(str(error)).split()) or "no message"
    except BaseException:  # whatever it does there
        return "no message"


def lacks_memory(error: BaseException) -> bool:
    """True for errors that say so by their class, number or text, as those of torch and of compiled libraries do."""
    return (
        isinstance(error, MemoryError)
        or type(error).__name__ == "OutOfMemoryError"
        or getattr(error, "errno", None) == errno.ENOMEM
        or any(words in text_of(error).lower() for words in NO_MEMORY)
    )


def check_number(value: float, where: str, low: float, high: float, *, whole: bool = False) -> None:
    """Refuse a value that is no number, or outside of its limits, both of which are allowed.

    Raises:
        ConfigError: Such a value.
    """
    kinds = Integral if whole else Real
    if isinstance(value, bool) or not isinstance(value, kinds) or not low <= value <= high:
        allowed = f"a whole number from {low} to {high}" if whole else f"a number from {low:.9g} to {high:.9g}"
        raise ConfigError(f"{value!r}", where=where, allowed=allowed)


def check_choice(value: str, where: str, allowed: Sequence[str]) -> str:
    """The value, which must be one of a few words.

    Raises:
        ConfigError: It is none of them.
    """
    if value not in allowed:
        raise ConfigError(f"{value!r}", where=where, allowed=", ".join(allowed))
    return value


def page(name: str) -> Path:
    """Path of a page of the documentation on this machine, or its path in a checkout if it is not installed.

    Arguments:
        name: File name, as `constraints.md`, or `constraints.txt` for the tested versions of dependencies.
    """
    return next((folder / name for folder in DOCS_FOLDERS if (folder / name).is_file()), Path("docs", name))
