"""Methods as plugins: the shipped ones keep their contract, and a broken one harms nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command_line import files_under
from support.plugins import check_entry_points, install_fixture

import lidardesign.methods
from lidardesign.contract import contract_of_plugin
from lidardesign.problem.method import DESIGN, METHODS

# The method of the example package; broken ones are made of it by replacing words.
EXAMPLE = Path(__file__).parents[2] / "examples" / "third_party" / "lidardesign_landing"
GOOD = (EXAMPLE / "fibonacci.py").read_text(encoding="utf-8")


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
    text = GOOD.replace('"fibonacci"', f'"{name}"').replace("FIBONACCI", "Plugin")
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
    scored = lidardesign("evaluate", flat, "--rays", "9", "--baseline", "middle", "--json")
    found = [[row["value"] for row in scored.json["rows"] if row["design"] == name] for name in ("mine", "middle")]
    assert found[0] == found[1]
    assert "middle is left out at equal bandwidth: only for a number of rays" in scored.json["notes"]
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
    "is_outside": ("azimuth = right", "azimuth = 9", "outside the design space"),
    "is_not_a_number": ("azimuth = right", "azimuth = np.nan", "NaN"),
    "says_nothing": ("return DesignResult(", "DesignResult(", "is of type NoneType"),
    "crashes": (GOOD.partition("\n")[0], "import ctypes\nctypes.string_at(0)", "crashes while it is imported"),
    "is_of_another_version": ('middle", 1', 'middle", 7', "version 7 of the method interface"),
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
    silent = DESIGNS + "        if count > 1:\n            return None\n"
    for old, new, law, words in (
        (DESIGNS, silent, "designs are made", "neither makes nor refuses 12 rays"),
        ("index / GOLDEN", "index * np.random.default_rng().random()", "designs repeat", "the second time"),
    ):
        scope = {}
        exec(source_of("moody", (old, new)), scope)
        finding = contract_of_plugin(METHODS, scope["Plugin"]).finding(law)
        assert finding.outcome == "fail"
        assert words in finding.detail
