"""What will go: announced while it still works, with what takes its place and the version that is without it.

Python callers meet a `DeprecatedUse` warning; commands tell it once on stderr, see `cli.deprecations`.
"""

from __future__ import annotations

import warnings


class DeprecatedUse(FutureWarning):
    """Something was used that a later version is without.

    Arguments:
        what: What was used, as the user wrote it.
        instead: What takes its place.
        removed_in: The first version without it.
    """

    def __init__(self, what: str, instead: str, removed_in: str) -> None:
        self.what, self.instead, self.removed_in = what, instead, removed_in
        super().__init__(f"{what} is deprecated and goes in {removed_in}; use {instead}")

    def as_dict(self) -> dict[str, str]:
        """For `--json`."""
        return {"what": self.what, "instead": self.instead, "removed_in": self.removed_in}


def announce(what: str, *, instead: str, removed_in: str, stacklevel: int = 3) -> None:
    """Say that something is deprecated, to whoever called the caller."""
    warnings.warn(DeprecatedUse(what, instead, removed_in), stacklevel=stacklevel)
