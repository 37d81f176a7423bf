"""Methods as plugins: the shipped ones keep their contract, and a broken one harms nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.command_line import files_under
from support.plugins import check_entry_points, install_fixture

import lidardesign.methods
from lidardesign.contract import contract_of_plugin
from lidardesign.problem.method import DESIGN, METHODS

ROOT = Path(__file__).parents[2]
# The method of docs/writing-methods.md; broken ones are made of it by replacing words.
GOOD = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "writing-methods.md").read_text(encoding="utf-8"), re.DOTALL)[
    1
]


def test_the_shipped_methods_keep_the_contract(method_law):
    method_law.check()


def test_pyproject_names_every_shipped_method_and_nothing_else():
    def is_method(key, value):
        return hasattr(value, "is_redrawn") and not isinstance(value, type) and key.isupper()

    def begins_afresh(name):
        return DESIGN not in METHODS.load(name).needs

    check_entry_points(METHODS, lidardesign.methods, is_method, begins_afresh)


install = install_fixture("method")


def source_of(name, *changes):
    """A method's source under a name, with words replaced."""
    text = GOOD.replace('"middle"', f'"{name}"').replace("MIDDLE", "Plugin")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def test_a_method_of_another_package_is_listed_a_baseline_a_design_and_checked(install, flat, lidardesign):
    install({"middle": source_of("middle"), "other": "raise RuntimeError('no licence')"})
    listed = {entry["name"]: entry for entry in lidardesign("methods", "list", "--json").json["methods"]}
    assert "no licence" in listed["other"]["error"]
    assert listed["greedy"]["error"] is None
    assert lidardesign("fit", flat, "--method", "middle", "--rays", "9", "--name", "mine").code == 0
    rows = lidardesign("evaluate", flat, "--rays", "9", "--baseline", "middle", "--json").json["rows"]
    mine, middle = ([row["value"] for row in rows if row["design"] == name] for name in ("mine", "middle"))
    assert mine == middle
    checked = lidardesign("methods", "check", "middle", "--json")
    assert checked.code == 0, checked.err
    assert {law["outcome"] for law in checked.json["laws"]} == {"pass"}
    assert "middle" in lidardesign("methods", "show", "middle").out


# What is broken when it is used or imported: words that are replaced, and what is said of it.
DESIGNS = "        world, count = problem.world, problem.rays\n"
BROKEN = {
    "raises": (DESIGNS, DESIGNS + "        1 / 0\n", "ZeroDivisionError"),
    "leaves": (DESIGNS, DESIGNS + "        raise SystemExit(3)\n", "exit 3"),
    "fires_more": (DESIGNS, "        world, count = problem.world, problem.rays + 1\n", "fires 10 rays, not 9"),
    "is_outside": ("(high - low)[3] *", "9 +", "outside the design space"),
    "says_a_word": ("return DesignResult(", "return str(", "is of type NoneType"),
    "crashes": (GOOD.partition("\n")[0], "import ctypes\nctypes.string_at(0)", "crashes while it is imported"),
    "is_of_another_version": ('space", 1', 'space", 7', "version 7 of the method interface"),
    "has_no_design": ("def design(", "def designs(", "no method design()"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_method_exits_6_and_nothing_else_is_lost(install, flat, lidardesign, name):
    old, new, words = BROKEN[name]
    install({name: source_of(name, (old, new))})
    assert lidardesign("fit", flat, "--layout", "even", "--rays", "9", "--name", "own").code == 0
    before = files_under(flat)
    for line in (("evaluate", flat, "--rays", "9", "--baseline", name), ("fit", flat, "--method", name, "--rays", "9")):
        result = lidardesign(*line, "--json")
        assert result.code == 6, result.err
        assert words in result.err
    assert files_under(flat) == before


def test_a_law_names_what_is_wrong_with_a_method():
    scope = {}
    exec(source_of("moody", (DESIGNS, DESIGNS + "        count += np.random.default_rng().integers(2)\n")), scope)
    contract = contract_of_plugin(METHODS, scope["Plugin"])
    found = {finding.law: finding for finding in contract.findings()}
    assert "fail" in {found["designs are made"].outcome, found["designs repeat"].outcome}
