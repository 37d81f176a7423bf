"""`learn --dry-run` writes nothing, refuses what learning would, and says what it writes and how long it takes."""

from __future__ import annotations

import time

import pytest
from support.command_line import files_under

from lidardesign.density.training.trainer import Trainer

TINY = ("steps=2", "batch=64", "samples=1000", "balance_proposals=256", "coverage_proposals=256", "hidden=4")
SETTINGS = [word for value in ("train=1", *(f"learning.{one}" for one in TINY)) for word in ("--set", value)]


def test_learning_writes_what_was_said_and_before_that_nothing(lidardesign, tmp_path):
    (tmp_path / "flat.yaml").write_text("task_name: flatland\n")
    arguments = ("learn", "--config", "flat.yaml", *SETTINGS, "--out", "new/run")
    before = files_under(tmp_path)
    plan = lidardesign(*arguments, "--dry-run", "--json").json
    assert files_under(tmp_path) == before
    assert plan["reads"] == ["flat.yaml"]
    assert plan["settings"]["learning"]["steps"] == plan["forecast"]["steps"] == 2
    shown = lidardesign(*arguments, "--dry-run").out
    for words in ("reads  flat.yaml", "writes  new/run/samples.npz", "at most 2 steps", "memory about"):
        assert words in shown
    assert lidardesign(*arguments).code == 0
    for name in files_under(tmp_path).keys() - before.keys():
        assert any(name.startswith(said) for said in plan["writes"]) or name.endswith(".lock"), name
    for name in plan["writes"]:
        assert (tmp_path / name).exists(), name


SLOW_S = 0.02


@pytest.mark.parametrize("further", [(), ("--set", "learning.pathwise=0"), ("--time-budget", 60)])
def test_learning_foresees_its_time_from_real_steps(lidardesign, monkeypatch, further):
    whole = Trainer.find_gradient

    def slowly(self):
        time.sleep(SLOW_S)
        return whole(self)

    monkeypatch.setattr(Trainer, "find_gradient", slowly)
    steps = ("--set", "learning.steps=40") if further[:1] != ("--time-budget",) else ()
    settings = [word for value in TINY[1:] for word in ("--set", f"learning.{value}")]
    plan = lidardesign("learn", "flatland", "--set", "train=1", *settings, *steps, *further, "--dry-run", "--json").json
    found, pathwise = plan["forecast"], min(plan["settings"]["learning"]["pathwise"], plan["forecast"]["steps"] // 2)
    assert found["balancing_s"] > SLOW_S
    assert found["pathwise_s"] > SLOW_S or pathwise == 0
    all_s = pathwise * found["pathwise_s"] + (found["steps"] - pathwise) * found["balancing_s"]
    assert found["seconds"] == pytest.approx(min(all_s, 60.0), abs=1.0)
    assert found["steps"] < 60.0 / SLOW_S
    assert found["peak_memory_bytes"] > 0
