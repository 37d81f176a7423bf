"""Plugins that break when they are imported, asked or score, and all that still works beside them."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.command_line import files_under, make_run
from support.plugins import GOOD, install_plugins

from lidardesign import plugins
from lidardesign.errors import PluginError
from lidardesign.run import processes
from lidardesign.task import TASKS, Score, load_task

# How a plugin breaks when it is imported, and what is said of it.
BROKEN = {
    "lacks_a_library": ("import a_module_that_is_not_there", "ModuleNotFoundError"),
    "raises": ("raise RuntimeError('no licence')", "no licence"),
    "raises_no_exception": ("class Odd(BaseException): pass\nraise Odd('odd')", "Odd: odd"),
    "leaves": ("raise SystemExit(3)", "exit 3"),
    "is_of_another_version": (GOOD.replace("api_version = 1", "api_version = 99"), "version 99"),
    "exits_hard": ("import os\nos._exit(7)", "tried to end the program (exit 7)"),
    "raises_when_asked": (GOOD.replace("metric = Metric", "metric = property(lambda self: 1 / 0)\n    was = Metric"),
                          "ZeroDivisionError"),
    # beyond what Python itself can end: only another process can
    "sleeps": ("import time\ntime.sleep(600)", "was not imported within 0.3 s"),
    "swallows": ("import time\nwhile True:\n    try: time.sleep(600)\n    except BaseException: pass",
                 "was not imported within 0.3 s"),
    # compiled code that never comes back and lets nobody else run
    "hangs_in_c": ("import ctypes\nctypes.PyDLL(None).pause()", "was not imported within 0.3 s"),
    "locks": ("import threading\nlock = threading.Lock()\nlock.acquire()\nlock.acquire()",
              "was not imported within 0.3 s"),
    "crashes": ("import ctypes\nctypes.string_at(0)", "crashes while it is imported (Segmentation fault)"),
    "aborts": ("import os\nos.abort()", "crashes while it is imported (Aborted)"),
    "writes_anywhere": ("import os\nfor number in range(3, 64):\n    try: os.write(number, b'hello\\n')\n"
                        "    except OSError: pass", "writes to a stream that is not its own"),
    "closes_all": ("import os\nos.closerange(0, 100)", "closes files that it did not open while it is imported"),
    "closes_and_hangs": ("import os, time\nos.closerange(0, 100)\nwhile True:\n    try: time.sleep(600)\n"
                         "    except BaseException: pass", "was not imported within 0.3 s"),
}  # fmt: skip


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install plugins by name into a folder on the path, as a package that is not this one's."""
    monkeypatch.setattr(plugins, "IMPORT_SECONDS", 0.3)
    monkeypatch.setattr(processes, "GRACE_SECONDS", 0.3)
    place = tmp_path / "installed"
    monkeypatch.syspath_prepend(place)
    yield lambda sources, package="plugins": install_plugins(place, sources, package, module=f"hard_{package}")
    for name in [name for name in sys.modules if name.startswith("hard_")]:
        del sys.modules[name]


@pytest.mark.hard_case(
    "39",
    "A plugin that raises, leaves, hangs or crashes when it is imported, has another's name or version, or scores NaN",
    done="plugins of other packages are imported in a process of their own first, within a time limit",
)
class TestBrokenPlugins:
    @pytest.mark.hard_case(
        "P5",
        "An installed plugin is broken",
        done="it is listed with the reason and using it exits 6",
    )
    def test_all_are_listed_with_their_reasons_and_the_others_still_list_and_run(self, install, lidardesign):
        install({"good": GOOD, **{name: source for name, (source, _) in BROKEN.items()}})
        listed = {entry["name"]: entry for entry in lidardesign("tasks", "list", "--json").json["tasks"]}
        for name, (_, words) in BROKEN.items():
            assert words in listed[name]["error"], name
            assert listed[name]["distribution"] == "plugins 1.0"
        assert listed["good"]["summary"] == "how much of a ball is seen"
        assert listed["good"]["error"] is listed["flatland"]["error"] is None
        assert lidardesign("tasks", "show", "flatland").code == 0
        assert load_task("good").name == "good"

    @pytest.mark.hard_case("P5")
    @pytest.mark.parametrize("name", ["is_of_another_version", "crashes"])
    def test_using_it_names_it_and_exits_6(self, install, lidardesign, tmp_path, name):
        source, words = BROKEN[name]
        install({name: source})
        result = lidardesign("learn", name, "--out", "run", "--json")
        assert result.code == 6, result.err
        assert result.json["error"]["kind"] == "plugin"
        assert words in result.json["error"]["message"]
        assert result.json["error"]["where"] == f"task {name}"
        assert not (tmp_path / "run").exists()

    def test_a_name_that_two_packages_offer_is_refused_by_both_their_names(self, install, lidardesign):
        install({"twin": GOOD}, package="first")
        install({"twin": GOOD}, package="second")
        result = lidardesign("tasks", "show", "twin", "--json")
        assert result.code == 6
        assert "first 1.0" in result.err
        assert "second 1.0" in result.err
        assert lidardesign("tasks", "list").code == 0

    def test_a_package_whose_list_of_plugins_is_damaged_hides_only_its_own(self, install, lidardesign, tmp_path):
        install({"good": GOOD})
        install({"bad": GOOD}, package="damaged")
        damaged = tmp_path / "installed" / "damaged-1.0.dist-info" / "entry_points.txt"
        damaged.write_text("[lidardesign.tasks]\nno sign\n")
        names = {entry["name"] for entry in lidardesign("tasks", "list", "--json").json["tasks"]}
        assert {"good", "flatland"} <= names
        assert "bad" not in names

    def test_a_plugin_is_imported_only_when_it_is_used_and_listed_only_elsewhere(self, install, lidardesign, tmp_path):
        note = f"import pathlib\npathlib.Path({str(tmp_path / 'imported')!r}).touch()\nprint('hello')\n"
        install({"noted": note + GOOD})
        assert lidardesign("tasks", "show", "flatland").code == 0
        assert not (tmp_path / "imported").exists()
        listed = lidardesign("tasks", "list", "--json")
        assert "noted" in {entry["name"] for entry in listed.json["tasks"]}
        assert "hard_plugins_noted" not in sys.modules
        load_task("noted")
        assert "hard_plugins_noted" in sys.modules

    def test_a_plugin_that_asks_for_all_tasks_while_it_is_imported_starts_no_chain_of_processes(self, install):
        install({"curious": "from lidardesign.task import load_task\nload_task('good')\n" + GOOD, "good": GOOD})
        listed = {listing.name: listing.error for listing in TASKS.listings()}
        assert listed["curious"] is None

    def test_where_no_process_can_be_started_plugins_are_imported_here(self, install, monkeypatch):
        install({"good": GOOD, "raises": BROKEN["raises"][0]})

        def refuse(*_, **__):
            raise OSError("no more processes")

        monkeypatch.setattr(processes.subprocess, "Popen", refuse)
        listed = {listing.name: listing for listing in TASKS.listings()}
        assert listed["good"].error is None
        assert "no licence" in listed["raises"].error

    @pytest.mark.parametrize("value", [None, 3.0, Score(float("nan")), Score("far")])
    def test_a_metric_that_is_no_number_exits_6_and_writes_nothing(self, lidardesign, tmp_path, monkeypatch, value):
        make_run(tmp_path / "run", count=1000)
        design = tmp_path / "run" / "designs" / "by_hand.yaml"
        design.parent.mkdir()
        shutil.copy(Path(__file__).parents[1] / "examples" / "hand_written_design.yaml", design)
        monkeypatch.setattr(FlatlandTask, "score", lambda *_: value)
        before = files_under(tmp_path)
        options = ("--rays", 4, "--set", "test=1", "--baseline", "none", "--csv", "rows.csv", "--json")
        result = lidardesign("evaluate", "run", *options)
        assert result.code == 6, result.err
        assert "metric Chamfer distance" in result.json["error"]["where"]
        assert files_under(tmp_path) == before

    def test_a_plugin_that_raises_something_that_cannot_be_printed_is_still_named(self):
        class Mute(Exception):  # noqa: N818
            def __str__(self):
                raise RuntimeError

        with pytest.raises(PluginError, match="Mute: no message"), plugins.plugin_guard("mute"):
            raise Mute
