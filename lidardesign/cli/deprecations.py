"""What is deprecated is told on stderr, once per command, also with --quiet: scripts are quiet, and break first."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from lidardesign.cli.output import tell
from lidardesign.deprecation import DeprecatedUse, announce


@dataclass(frozen=True)
class RenamedOption:
    """An option that has another name now.

    Arguments:
        command: The command that has it, as `evaluate` or `catalog show`.
        old: The name that goes, as `--plot-folder`.
        new: The name that it has.
        removed_in: The first version without the old one.
    """

    command: str
    old: str
    new: str
    removed_in: str


# An entry stays here for one minor version, and in the CHANGELOG under Deprecated.
RENAMED: tuple[RenamedOption, ...] = ()


def with_new_names(arguments: Sequence[str], renamed: Sequence[RenamedOption] | None = None) -> list[str]:
    """Command line arguments with options by the names that they have now; those that had another are announced.

    Arguments:
        arguments: As they were given; what follows `--` is left as it is.
        renamed: The table, `RENAMED` by default.
    """
    words = list(arguments)
    end = words.index("--") if "--" in words else len(words)
    for entry in RENAMED if renamed is None else renamed:
        parts = entry.command.split()
        if words[: len(parts)] != parts:
            continue
        for index in range(len(parts), end):
            name, equals, value = words[index].partition("=")
            if name == entry.old:
                announce(f"{entry.command} {entry.old}", instead=entry.new, removed_in=entry.removed_in)
                words[index] = f"{entry.new}{equals}{value}"
    return words


@contextlib.contextmanager
def deprecations_told() -> Iterator[None]:
    """Tell every deprecated use inside once."""
    seen: set[str] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("always", DeprecatedUse)
        show = warnings.showwarning

        def told(message: Warning | str, category: type[Warning], *where: Any, **further: Any) -> None:
            if not issubclass(category, DeprecatedUse):
                show(message, category, *where, **further)
            elif str(message) not in seen:
                seen.add(str(message))
                tell(f"deprecated: {message}")

        warnings.showwarning = told  # type: ignore[assignment]
        yield
