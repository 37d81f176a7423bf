"""Packages of plugins that are broken in every way."""

from __future__ import annotations

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

BROKEN = {
    "missing_import": ("import a_module_that_is_not_there", "ModuleNotFoundError"),
    "leaves": ("raise SystemExit(3)", "exit 3"),
    "syntax": ("def (", "SyntaxError"),
    "no_class": ("", "AttributeError"),
    "raises_base": ("raise RuntimeError('no\\nlicence')", "no licence"),
    "old": (GOOD.replace("api_version = 1", "api_version = 99"), "version 99"),
    "unversioned": (GOOD.replace("api_version = 1", ""), "version None"),
    "no_metric": (GOOD.replace('Metric("error", "mm", "lower", 100.0, 0.1)', "'mm'"), "metric is no Metric"),
    "no_config": (GOOD.replace("Config = TaskConfig", "Config = dict"), "TaskConfig"),
    "no_score": (GOOD.replace("def score(self, scene, returns): ...", ""), "no method score"),
    "other_name": (GOOD, "calls itself 'good'"),
    "fails_to_start": (
        GOOD.replace("def space", "def __init__(self): raise ValueError('x')\n    def space"),
        "ValueError",
    ),
}
