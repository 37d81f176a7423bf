"""Formats as plugins: the shipped ones keep their contract, and a broken one harms nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.command_line import files_under
from support.exports import write_as
from support.plugins import check_entry_points, install_fixture
from support.rigs import rig

import lidardesign.formats
from lidardesign.contract import contract_of_plugin
from lidardesign.errors import DataError, PluginError
from lidardesign.formats import FORMATS, Format, write_design
from lidardesign.formats.designs import load_design
from lidardesign.sensors.design_file import save_design

# The format of the example package, under a name; broken ones are made of it by replacing words.
EXAMPLE = Path(__file__).parents[2] / "examples" / "third_party" / "lidardesign_landing"
GOOD = (EXAMPLE / "vtk.py").read_text(encoding="utf-8").replace('vtk"', 'NAME"').replace("VTK = ", "Plugin = ")
WRITE, MADE = "    gate = [", "read=read)"


def test_the_shipped_formats_keep_the_contract(format_law):
    format_law.check()


def test_pyproject_names_every_shipped_format_and_nothing_else():
    check_entry_points(FORMATS, lidardesign.formats, lambda _, value: isinstance(value, Format))


def test_loading_a_format_imports_no_other_module_of_formats():
    code = (
        "import sys; from lidardesign.formats import FORMATS; FORMATS.load('csv'); "
        "print(*(name for name in sys.modules if name.startswith('lidardesign.formats.')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {"lidardesign.formats.ray_lists", "lidardesign.formats.rig"}


install = install_fixture("format")


@pytest.fixture
def design(tmp_path):
    """A design file that fires rays of its own."""
    path = tmp_path / "rig.yaml"
    save_design(rig()[0], path)
    return path


def test_a_format_of_another_package_is_listed_written_read_and_checked(install, design, lidardesign, tmp_path):
    install({"points": GOOD, "other": "raise RuntimeError('no licence')"})
    listed = {entry["name"]: entry for entry in lidardesign("formats", "list", "--json").json["formats"]}
    assert listed["points"]["suffix"] == ".points"
    assert listed["points"]["distribution"] == "plugins 1.0"
    assert "no licence" in listed["other"]["error"]
    assert listed["csv"]["error"] is None
    assert lidardesign("export", "--list", "--json").json["formats"] == [*listed.values()]
    assert lidardesign("export", design, "--format", "points").code == 0
    assert "hard_formats_other" not in sys.modules
    found, expected = load_design(tmp_path / "rig.points").rays(), load_design(design).rays()
    for name in ("origin_m", "direction", "gate_m"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-12)
    checked = lidardesign("formats", "check", "points", "--json")
    assert checked.code == 0, checked.err
    assert checked.json["format"] == "points"
    assert {law["outcome"] for law in checked.json["laws"]} == {"pass"}
    assert "points" in lidardesign("formats", "show", "points").out


# What is broken when it is used or imported: words that are replaced, and what is said of it.
BROKEN = {
    "raises": (WRITE, "    1 / 0\n" + WRITE, "ZeroDivisionError"),
    "stops": (WRITE, "    path.write_text('half')\n    raise RuntimeError('half-way')\n" + WRITE, "half-way"),
    "writes_nothing": ("    path.write_text(", "    str(", "wrote no file"),
    "is_a_folder": (MADE, "read=read, is_folder=True)", "wrote no folder"),
    "says_no_notes": ("return [", "return None and [", "TypeError"),
    "leaves": (WRITE, "    raise SystemExit(3)\n" + WRITE, "exit 3"),
    "crashes": (GOOD, "import ctypes\nctypes.string_at(0)", "crashes while it is imported"),
    "is_of_another_version": (MADE, "read=read, api_version=7)", "version 7 of the format interface"),
    "holds_everything": (MADE, 'read=read, holds=frozenset({"rays", "colour"}))', "holds colour"),
    "has_no_dot": ('".NAME"', '"NAME"', "its suffix is 'has_no_dot'"),
    "has_no_write": (", write,", ", None,", "no method write()"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_format_exits_6_and_leaves_what_was_there(install, design, lidardesign, tmp_path, name):
    old, new, words = BROKEN[name]
    assert old in GOOD
    install({name: GOOD.replace(old, new)})
    out = tmp_path / "out"
    out.mkdir() if name == "is_a_folder" else out.write_text("mine", encoding="utf-8")
    before = files_under(tmp_path)
    result = lidardesign("export", design, "--format", name, "--out", "out", "--json")
    assert result.code == 6, result.err
    assert words in result.err
    assert result.json["error"]["where"] == f"format {name}"
    assert files_under(tmp_path) == before
    assert lidardesign("export", design, "--format", "csv").code == 0


def test_a_file_is_never_written_over_a_folder_nor_a_folder_over_a_file(install, tmp_path):
    folder = '    path.mkdir()\n    (path / "a").write_text("a")\n    return []\n'
    many = GOOD.replace(MADE, "is_folder=True)").replace(WRITE, folder + WRITE)
    install({"one": GOOD, "many": many})
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    for name, taken in (("one", "folder"), ("many", "file")):
        with pytest.raises(DataError, match=taken):
            write_as(name, *rig(), tmp_path / taken)
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"
    write_as("many", *rig(), tmp_path / "new")
    assert (tmp_path / "new" / "a").read_text(encoding="utf-8") == "a"


def test_a_foreign_reader_is_asked_only_for_what_no_shipped_one_knows_and_contained(install, tmp_path):
    install({"sdf2": GOOD.replace("path.read_text()", "1 / 0"), "xml": "1 / 0"})
    for path in (tmp_path / "rig.sdf2", tmp_path / "rig.xml"):
        path.write_text("<mujoco/>", encoding="utf-8")
    with pytest.raises(PluginError, match="ZeroDivisionError"):
        load_design(tmp_path / "rig.sdf2")
    with pytest.raises(DataError, match="has no rangefinder"):
        load_design(tmp_path / "rig.xml")
    assert "hard_formats_xml" not in sys.modules


# What a format is changed into, by the law that it then breaks: words that are replaced, and what is said of it.
TWICE = "    write.n = getattr(write, 'n', 0) + 1\n    path.write_text(str(write.n))\n    return []\n"
HALF = "    path.write_text('')\n    [design.sensors[one] for one in rays.sensor]\n"
LAWLESS = {
    "designs are written": [
        (WRITE, TWICE + WRITE, "other bytes or notes the second time"),
        (WRITE, "    rays.gate_m[:] = 1.0\n" + WRITE, "writing changed the design"),
        (WRITE, "    (path.parent / 'more').touch()\n" + WRITE, "design.points, more"),
        (WRITE, "    raise ValueError('never')\n" + WRITE, "write failed: ValueError: never"),
        ('return ["sensors and firing times are lost"]', 'return ("lost",)', "a list of notes"),
    ],
    "says what it holds": [
        (MADE, 'holds=frozenset({"rate"}))', "says that it holds rate, but writes the same without"),
        (MADE, 'holds=frozenset({"adaptive"}))', "says that it holds adaptive"),
    ],
    "files are whole": [
        (WRITE, HALF + WRITE, "half-written"),
        (WRITE, "    import shutil\n    shutil.rmtree(path, ignore_errors=True)\n" + WRITE, "in its place"),
    ],
    "rays come back": [
        ("np.arctan2(z, np.hypot(x, y)), gate", "z, 2 + gate", "direction, gate_m came back changed, and 1 notes"),
        ("    x, y, z", "    points = points[:1]\n    x, y, z", "1 rays were read of 6"),
    ],
    "no global random state": [(WRITE, "    np.random.uniform()\n" + WRITE, "numpy's random in write")],
}


@pytest.mark.parametrize("law", LAWLESS)
def test_a_law_names_what_is_wrong(law):
    for old, new, words in LAWLESS[law]:
        assert old in GOOD
        namespace: dict = {}
        exec(GOOD.replace(old, new).replace("NAME", "points"), namespace)
        finding = contract_of_plugin(FORMATS, namespace["Plugin"]).finding(law)
        assert finding.outcome == "fail", (law, new)
        assert words in finding.detail


def test_a_format_that_is_not_installed_is_contained_too(tmp_path):
    def write(design, rays, path, options):
        path.write_text("half", encoding="utf-8")
        raise RuntimeError("half-way")

    form = Format("mine", ".mine", "mine", write, "me", "not at all")
    with pytest.raises(PluginError, match="half-way"):
        write_design(form, *rig(), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_metadata_of_before_there_were_formats_says_what_to_do(monkeypatch, lidardesign, design):
    monkeypatch.setattr(type(FORMATS), "_offers", lambda self: {})
    result = lidardesign("export", design, "--format", "csv")
    assert result.code == 2
    assert "install lidardesign again" in result.err
