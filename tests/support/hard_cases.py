"""The register of hard cases: one class each, from which `tools/stability_table.py` writes docs/stability.md."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

# Design space and density, fields, rays, flow, mixture, files; MuJoCo; the promises. 28 was of a dropped feature.
KEYS = (
    *map(str, [*range(1, 28), *range(29, 41)]),
    *(f"M{number}" for number in range(1, 5)),
    *(f"P{number}" for number in range(1, 8)),
)


@dataclass(frozen=True)
class HardCase:
    """One case and the class of its tests.

    Arguments:
        key: "1" to "40", "M1" to "M4" or "P1" to "P7".
        title: What comes in.
        done: What the program does then.
        tests: The class.
    """

    key: str
    title: str
    done: str
    tests: type

    @property
    def names(self) -> list[str]:
        """The names of its tests, in the order in which they stand."""
        return [name for name, value in vars(self.tests).items() if name.startswith("test_") and callable(value)]

    @property
    def elsewhere(self) -> dict[str, int]:
        """How many tests stand with what they test, under the mark `hard_case`, by their file in tests/."""
        return marked()[self.key]


@lru_cache
def marked() -> dict[str, Counter[str]]:
    """Files of tests that bear the mark `hard_case(key)`, and how many of them, by key; read from their source."""
    tests, found = Path(__file__).parents[1], {key: Counter() for key in KEYS}
    for path in sorted(tests.rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.hard_case":
                    found[ast.literal_eval(mark.args[0])][path.relative_to(tests).as_posix()] += 1
    return found


CASES: dict[str, HardCase] = {}


def hard_case(key: str, title: str, *, done: str) -> Callable[[type], type]:
    """Register a class of tests as the one of a case.

    Raises:
        ValueError: There is no such case, or another class has it.
    """

    def register(tests: type) -> type:
        if key not in KEYS:
            raise ValueError(f"{tests.__name__}: there is no hard case {key!r}")
        other = CASES.get(key)
        if other is not None and other.tests.__qualname__ != tests.__qualname__:
            raise ValueError(f"{tests.__name__}: hard case {key} is that of {other.tests.__name__}")
        CASES[key] = HardCase(key, title, done, tests)
        return tests

    return register
