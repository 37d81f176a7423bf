"""A broken plugin is listed with its reason and never takes the program down."""

from __future__ import annotations

import errno
import os
import sys
import time
from importlib.metadata import EntryPoint

import pytest

from lidardesign import plugins
from lidardesign.errors import ConfigError, DataError, PluginError
from lidardesign.plugins import plugin_guard
from lidardesign.task import TASKS, load_task

GOOD = """
from lidardesign.task import Defaults, Metric, Score, TaskConfig

class GoodTask:
    name = "good"
    summary = "a task that keeps the contract"
    api_version = 1
    Config = TaskConfig
    metric = Metric("error", "mm", "lower", 100.0, 0.1)
    defaults = Defaults()
    def space(self, config): ...
    def scenes(self, config, split, seed): ...
    def score(self, scene, returns): ...
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install plugin modules by name, in place of the ones of this environment."""
    offers = []
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [o for o in offers if o.group == group])

    def add(name, source, module=None):
        module = module or f"plugin_{name}"
        (tmp_path / f"{module}.py").write_text(source)
        offers.append(EntryPoint(name, f"{module}:GoodTask", TASKS.group))

    yield add
    for name in [name for name in sys.modules if name.startswith("plugin_")]:
        del sys.modules[name]


def test_an_unknown_name_lists_what_there_is(install):
    install("good", GOOD)
    with pytest.raises(ConfigError, match="did you mean 'good'") as caught:
        load_task("god")
    assert caught.value.exit_code == 2
    with pytest.raises(ConfigError, match="tasks list"):
        load_task("zzz")


def test_the_same_entry_point_found_twice_counts_once(install):
    install("good", GOOD)
    install("good", GOOD)
    assert load_task("good").name == "good"


def test_a_plugin_that_prints_on_import_leaves_stdout_alone(install, capsys):
    install("good", "print('hello')\n" + GOOD)
    load_task("good")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "hello" in captured.err


def test_an_import_that_hangs_is_interrupted(install, monkeypatch):
    monkeypatch.setattr(plugins, "IMPORT_SECONDS", 0.05)
    install("good", "import time\ntime.sleep(30)\n" + GOOD)
    started = time.monotonic()
    assert "was not imported within" in TASKS.listings()[0].error
    assert time.monotonic() - started < 10


def test_the_guard_turns_what_a_plugin_raises_into_a_plugin_error():
    with pytest.raises(PluginError, match="ZeroDivisionError"), plugin_guard("good"):
        _ = 1 / 0
    with pytest.raises(ConfigError, match="mine"), plugin_guard("good"):
        raise ConfigError("mine")
    told_by_nothing = type("Odd", (Exception,), {"__str__": lambda self: sys.exit(0)})
    for error in (GeneratorExit, BaseExceptionGroup("all", [KeyboardInterrupt()]), StopIteration, told_by_nothing):
        with (
            pytest.raises(PluginError, match=r"GeneratorExit|Group|StopIteration|Odd: no message"),
            plugin_guard("good"),
        ):
            raise error
    with pytest.raises(KeyboardInterrupt), plugin_guard("good"):
        raise KeyboardInterrupt
    for lost in (MemoryError(), OSError(errno.ENOMEM, "no"), ImportError("lib.so: failed to map segment from object")):
        with pytest.raises(MemoryError), plugin_guard("good"):
            raise lost
    message = r"(?s)cannot be read: File name too long.*the task good reads it"
    with pytest.raises(DataError, match=message), plugin_guard("good"):
        os.stat("x" * 300)
