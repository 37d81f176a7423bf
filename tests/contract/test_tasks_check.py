"""`tasks check` names what is broken in a plugin, law by law, and no plugin harms anything but its own check."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.command_line import caller, files_under
from support.plugins import GOOD, install_plugins

from lidardesign.contract.contract import LAWS
from lidardesign.contract.process import CheckRequest, check_in_process
from lidardesign.errors import ConfigError
from lidardesign.task import load_task

SCENES = "    def scenes(self, config, split, seed):\n"


def in_scenes(code):
    """A good task whose scenes begin with some code."""
    return GOOD.replace(SCENES, f"{SCENES}        {code}\n")


# How a plugin is broken: its source, the law that names it, and words of what is said.
BROKEN = {
    "import_error": ("import a_module_that_is_not_there\n" + GOOD, "plugin loads", "a_module_that_is_not_there"),
    "system_exit": ("raise SystemExit(3)\n" + GOOD, "plugin loads", "tried to end the program (exit 3)"),
    "hang": (in_scenes("import time\n        while True: time.sleep(1)"), "scenes are made", "did not end within"),
    "wrong_version": (GOOD.replace("api_version = 1", "api_version = 7"), "plugin loads", "version 7 of the task"),
    "duplicate": (GOOD, "plugin loads", "is offered by first 1.0 (first_duplicate:Task) and second 1.0"),
    "wrong_types": (in_scenes("return ['a scene', 'another']"), "scenes are made", "scenes() returned a str"),
    # what only a process of its own can contain
    "crash": (in_scenes("import ctypes; ctypes.string_at(0)"), "scenes are made", "crashes while this is tried (Segm"),
}  # fmt: skip
# What is unusual and keeps the contract: it says much, never ends by itself, holds a library that sets variables of its
# own, and has scenes that differ in their fog alone.
UNUSUAL = (
    "import atexit, os, threading\natexit.register(print, 'bye')\nos.environ.setdefault('KMP_INIT_AT_FORK', 'FALSE')\n"
    "threading.Thread(target=threading.Event().wait).start()\n"
    + GOOD.replace(SCENES, SCENES + "        os.system('echo one more')\n")
    .replace("generator.uniform(2.0, 3.0), generator.uniform(-0.5, 0.5), 0.0", "2.5, 0.0, 0.0")
    .replace('{"at": centre})', '{"at": centre}, medium=Medium(generator.uniform(0.01, 0.1), 0.001))')
    .replace("import Body,", "import Body, Medium,")
)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder on the path with all the plugins."""
    root = tmp_path_factory.mktemp("check")
    sources = {name: source for name, (source, *_) in BROKEN.items()}
    twin = sources.pop("duplicate")
    install_plugins(root / "installed", {"good": GOOD, "unusual": UNUSUAL, **sources})
    for package in ("first", "second"):
        install_plugins(root / "installed", {"duplicate": twin}, package=package)
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(root / "installed")
        yield root


@pytest.fixture(scope="module")
def findings(place):
    """What `tasks check` found of every plugin, by name: all at once, as they are processes of their own."""

    def checked(name):
        return name, list(check_in_process(CheckRequest(name, limit_s=1.0 if name == "hang" else 60.0)))

    before = files_under(place)
    with ThreadPoolExecutor(4) as pool:
        found = dict(pool.map(checked, [*BROKEN, "unusual"]))
    assert files_under(place) == before
    return found


@pytest.mark.parametrize("name", BROKEN)
def test_each_broken_plugin_is_named_by_the_one_law_that_it_breaks(findings, name):
    _, law, words = BROKEN[name]
    failed = {finding.law: finding.detail for finding in findings[name] if finding.outcome == "fail"}
    assert law in failed, findings[name]
    assert words in failed[law]
    assert len(failed) == 1, failed
    assert [finding.law for finding in findings[name]] == ["plugin loads", *(law.name for law in LAWS)]
    assert all(finding.detail for finding in findings[name])


def test_an_unusual_plugin_keeps_every_law_that_applies(findings):
    assert [finding for finding in findings["unusual"] if finding.outcome == "fail"] == []
    kept = {finding.law for finding in findings["unusual"] if finding.outcome == "pass"}
    assert kept >= {"scenes repeat elsewhere", "splits are disjoint"}


def test_none_of_them_is_imported_here_or_spoils_the_others(findings, place, tmp_path, monkeypatch, capsys):
    own = {f"{package}_{name}" for package in ("plugins", "first", "second") for name in findings}
    assert not own & {*sys.modules}
    assert load_task("flatland").name == "flatland"
    result = caller(capsys, tmp_path, monkeypatch)("tasks", "check", "wrong_types", "--json")
    assert result.code == 6
    assert (result.json["keeps"], result.json["task"]) == (False, "wrong_types")
    assert f"broken laws: 1 of {len(LAWS) + 1}: scenes are made" in result.err
    assert [law["group"] for law in result.json["laws"] if law["outcome"] == "fail"] == ["scenes"]


def test_an_unknown_task_and_a_refused_configuration_are_the_users_errors(place, tmp_path, monkeypatch, capsys):
    with pytest.raises(ConfigError, match="did you mean 'good'"):
        list(check_in_process(CheckRequest("god")))
    result = caller(capsys, tmp_path, monkeypatch)("tasks", "check", "good", "--set", "no_such_key=1", "--json")
    assert result.code == 2
    assert result.json["error"]["where"] == "--set no_such_key=1"
