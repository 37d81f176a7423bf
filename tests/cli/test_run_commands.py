"""Runs are started, replaced and looked at by commands that say what to do next, ready to be pasted."""

from __future__ import annotations

import shlex

import pytest
from support.command_line import make_run

TINY = ("steps=2", "batch=64", "samples=1000", "balance_proposals=256", "coverage_proposals=256", "hidden=4")
LEARN_TINY = [word for value in ("train=1", *(f"learning.{one}" for one in TINY)) for word in ("--set", value)]


@pytest.fixture
def flat(tmp_path):
    return make_run(tmp_path / "it's a run; of mine")


def pasted(text):
    """The words of the command line that a message tries."""
    line = text[text.index("lidardesign") :].splitlines()[0]
    return shlex.split(line)[1:]


def test_a_configuration_names_its_task(lidardesign, tmp_path):
    (tmp_path / "flat.yaml").write_text("task_name: flatland\n")
    plan = lidardesign("learn", "--config", "flat.yaml", "--dry-run", "--json").json
    assert plan["settings"]["task_name"] == "flatland"
    assert plan["writes"][0]["path"].startswith("runs/flatland/")


def test_without_any_name_of_a_task_there_is_nothing_to_learn(lidardesign, tmp_path):
    (tmp_path / "empty.yaml").write_text("preset: draft\n")
    for arguments in (["learn"], ["learn", "--config", "empty.yaml"], ["learn", "--resume", "--out", "absent"]):
        result = lidardesign(*arguments)
        assert result.code == 2
        assert "no task was named" in result.err
        assert "flatland" in result.err


def test_a_run_that_is_resumed_knows_its_task(lidardesign, flat):
    plan = lidardesign("learn", "--resume", "--out", flat, "--dry-run", "--json")
    assert plan.json["settings"]["task_name"] == "flatland"


def test_hints_can_be_pasted_whatever_a_folder_is_called(lidardesign, flat):
    result = lidardesign("evaluate", flat)
    assert pasted(result.err) == ["fit", str(flat)]
