"""Every hard case has one class of tests, and docs/stability.md says what they say."""

from __future__ import annotations

import ast
import importlib
import re
import sys
from pathlib import Path

import pytest
from support.hard_cases import CASES, KEYS

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
MODULES = sorted(path.stem for path in FOLDER.glob("test_*.py") if path != Path(__file__))


@pytest.fixture(scope="module", autouse=True)
def every_case():
    for name in MODULES:
        importlib.import_module(f"hard_cases.{name}")
    return CASES


def decorated_classes() -> list[tuple[str, str, str]]:
    """Key, class and module of every `@hard_case` in the folder, read from the source."""
    found = []
    for name in MODULES:
        for node in ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.ClassDef):
                continue
            for call in node.decorator_list:
                if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "hard_case":
                    found.append((ast.literal_eval(call.args[0]), node.name, name))
    return found


def test_cases_and_classes_map_one_to_one():
    keys = [key for key, _, _ in decorated_classes()]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    assert sorted(keys) == sorted(KEYS), f"without a class: {sorted(set(KEYS) - set(keys))}; twice: {twice}"


def test_every_class_of_the_folder_is_a_case():
    named = {(name, module) for _, name, module in decorated_classes()}
    for module in MODULES:
        for node in ast.parse((FOLDER / f"{module}.py").read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
                assert (node.name, module) in named, f"{module}.{node.name} belongs to no case"


@pytest.mark.parametrize("key", KEYS)
def test_a_case_has_tests_and_says_what_is_done(key):
    case = CASES[key]
    assert case.names or case.elsewhere, f"{case.tests.__name__} has no tests"
    assert len(case.title) > 10
    assert len(case.done) > 10


def test_the_table_in_the_documentation_is_the_one_of_the_tests():
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        table = importlib.import_module("stability_table").table(CASES)
    finally:
        sys.path.remove(str(ROOT / "tools"))
    written = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    assert _without_figures(table) in _without_figures(written), "run tools/stability_table.py"


def _without_figures(text: str) -> str:
    """The last digits of what is measured differ from machine to machine."""
    return re.sub(r"[-+]?\d[\d.,]*(e[-+]?\d+)?|\b(inf|nan)\b", "#", text)
