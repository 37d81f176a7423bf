"""Every hard case is described once and has tests, and docs/stability.md says what they say."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from support.hard_cases import KEYS, hard_cases

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("key", KEYS)
def test_a_case_has_tests_and_says_what_comes_in_and_what_is_done(key):
    case = hard_cases()[key]
    assert case.tests
    assert min(len(case.title), len(case.done)) > 10


def test_the_table_in_the_documentation_is_the_one_of_the_tests(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    table = importlib.import_module("stability_table").table(hard_cases())
    assert table in (ROOT / "docs" / "stability.md").read_text(encoding="utf-8"), "run tools/stability_table.py"
