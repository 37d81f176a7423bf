"""The register of hard cases, read from the source of tests; `tools/stability_table.py` writes its page from it.

`@pytest.mark.hard_case("29", "What comes in", done="What the program does then")` stands once for each case, at the
class of its tests. `@pytest.mark.hard_case("29")` marks further tests of it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

# Design space and density, fields, rays, flow, mixture, files; MuJoCo; the promises. 28 was of a dropped feature.
KEYS = (
    *map(str, [*range(1, 28), *range(29, 41)]),
    *(f"M{number}" for number in range(1, 5)),
    *(f"P{number}" for number in range(1, 8)),
)


@dataclass
class HardCase:
    """One case.

    Arguments:
        title: What comes in.
        done: What the program does then.
        tests: How many tests it has.
    """

    title: str = ""
    done: str = ""
    tests: int = 0


@lru_cache
def hard_cases() -> dict[str, HardCase]:
    """All cases by key.

    Raises:
        ValueError: A mark has a key that no case has, or a case is described twice.
    """
    found = {key: HardCase() for key in KEYS}
    for path in sorted(Path(__file__).parents[1].rglob("test_*.py")):
        for node, mark in _marks(ast.parse(path.read_text(encoding="utf-8"))):
            key, *title = map(ast.literal_eval, mark.args)
            if key not in found:
                raise ValueError(f"{path.name}: {node.name}: there is no hard case {key!r}")
            case, inside = found[key], node.body if isinstance(node, ast.ClassDef) else [node]
            case.tests += sum(isinstance(one, ast.FunctionDef) and one.name.startswith("test_") for one in inside)
            if title and case.title:
                raise ValueError(f"{path.name}: {node.name}: hard case {key} is described elsewhere: {case.title}")
            if title:
                case.title, case.done = title[0], ast.literal_eval(mark.keywords[0].value)
    return found


def _marks(tree: ast.Module) -> Iterator[tuple[ast.ClassDef | ast.FunctionDef, ast.Call]]:
    for node in ast.walk(tree):
        for mark in node.decorator_list if isinstance(node, ast.ClassDef | ast.FunctionDef) else ():
            if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.hard_case":
                yield node, mark
