"""Reading plain documents with errors that say where: a value, its key path, and its position in the file."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.run.kinds import is_name

KeyPath = tuple[str | int, ...]
Locate = Callable[[KeyPath], str]
LONGEST_QUOTE = 40


@dataclass(frozen=True)
class Node:
    """One value of a document.

    Arguments:
        value: Plain values: mappings, lists, text, numbers, booleans, None.
        path: Keys and indices from the document's root.
        locate: The position of a path, as `file:line:column`.
    """

    value: Any
    path: KeyPath
    locate: Locate

    @property
    def name(self) -> str:
        """The key path for people, as `sensors[0].gate_m.end`."""
        text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in self.path)
        return text.lstrip(".") or "the document"

    def error(self, message: str, *, allowed: str | None = None, hint: str | None = None) -> ConfigError:
        """An error about this value."""
        return ConfigError(f"{self.name} {message}", where=self.locate(self.path), allowed=allowed, hint=hint)

    def wrong(self, allowed: str) -> ConfigError:
        """The error that this value is not of the allowed kind."""
        quoted = repr(self.value)
        shown = quoted if len(quoted) <= LONGEST_QUOTE else quoted[: LONGEST_QUOTE - 3] + "..."
        return self.error(f"is {shown}", allowed=allowed)

    def child(self, key: str | int) -> Node:
        """The value under a key or index."""
        return Node(self.value[key], (*self.path, key), self.locate)

    def mapping(self, required: Iterable[str], optional: Iterable[str] = ()) -> dict[str, Node]:
        """The values of a mapping by key; an optional key that is null counts as absent."""
        required, optional = tuple(required), tuple(optional)
        known = (*required, *optional)
        if not isinstance(self.value, dict):
            raise self.wrong(f"a mapping with the keys {', '.join(known)}")
        for key in self.value:
            if key not in known:
                near = difflib.get_close_matches(str(key), known, 1)
                hint = f"{near[0]}" if near else None
                raise self.child(key).error("is an unknown key", allowed=", ".join(known), hint=hint)
        for key in required:
            if key not in self.value:
                raise self.error(f"has no key `{key}`", allowed=", ".join(known))
        return {key: self.child(key) for key in known if self.value.get(key) is not None or key in required}

    def items(self) -> list[Node]:
        """The values of a list."""
        if not isinstance(self.value, list):
            raise self.wrong("a list")
        return [self.child(index) for index in range(len(self.value))]

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number from low to high, both included."""
        value = self.value
        plain = isinstance(value, int | float) and not isinstance(value, bool)
        if not (plain and math.isfinite(value) and low <= value <= high):
            raise self.wrong(f"a number{_between(low, high)}")
        return float(value)

    def integer(self, low: int, high: int | None = None) -> int:
        """A whole number of at least `low`."""
        value = self.value
        top = math.inf if high is None else high
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= top:
            between = f" of at least {low}" if high is None else f" from {low} to {high}"
            raise self.wrong(f"a whole number{between}")
        return value

    def text(self) -> str:
        """Text that is not empty, without characters that steer a terminal."""
        if not is_name(self.value):
            raise self.wrong("text without control characters")
        return self.value

    def choice(self, options: Iterable[str]) -> str:
        """One of several words."""
        options = tuple(options)
        if self.value not in options:
            raise self.wrong(" or ".join(options))
        return self.value

    def numbers(self, count: int | None = None, low: float = -math.inf, high: float = math.inf) -> np.ndarray:
        """A list of finite numbers, shape (count,)."""
        values = [item.number(low, high) for item in self.items()]
        if count is not None and len(values) != count:
            raise self.error(f"has {len(values)} numbers", allowed=f"{count}")
        return np.array(values, dtype=np.float64)

    def plain(self) -> dict[str, Any]:
        """A mapping of anything."""
        if not isinstance(self.value, dict):
            raise self.wrong("a mapping")
        return self.value


def _between(low: float, high: float) -> str:
    if math.isinf(high):
        return "" if math.isinf(low) else f" of at least {low:g}"
    return f" from {low:.6g} to {high:.6g}" if math.isfinite(low) else f" of at most {high:.6g}"
