"""Runs are started, replaced and looked at by commands that say what to do next, ready to be pasted."""

from __future__ import annotations

import errno
import importlib
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import typer
from support.command_line import files_under, make_run, set_options
from support.plugins import GOOD, install_plugins

from lidardesign.cli.main import app
from lidardesign.rays.pool import FILE_NAME as CACHE
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import note, read_manifest, record, verify, write_manifest

TINY = ("steps=2", "batch=64", "samples=1000", "balance_proposals=256", "coverage_proposals=256", "hidden=4")
SET_TINY = ("train=1", *(f"learning.{one}" for one in TINY))
LEARN_TINY = set_options(SET_TINY)


@pytest.fixture
def flat(tmp_path):
    return make_run(tmp_path / "it's a run; of mine", count=1000, overrides=["test=4"])


def pasted(text):
    """The words of the command line that a message tries."""
    line = text[text.index("lidardesign") :].splitlines()[0]
    return shlex.split(line)[1:]


def test_a_configuration_or_a_run_that_is_resumed_names_its_task(lidardesign, flat, tmp_path):
    (tmp_path / "flat.yaml").write_text("task_name: flatland\n")
    for options in (("--config", "flat.yaml"), ("--resume", "--out", flat)):
        plan = lidardesign("learn", *options, "--dry-run", "--json").json
        assert plan["settings"]["task_name"] == "flatland"
        assert plan["writes"][0].startswith("runs/flatland/" if "--config" in options else str(flat))


def test_a_run_with_a_goal_is_resumed_with_its_own_options_and_refuses_other_values(lidardesign, tmp_path):
    (tmp_path / "set.yaml").write_text("learning: {batch: 64}\n")
    own = ("--config", "set.yaml", "--tolerance", "0.9")
    assert learned(lidardesign, *own).code == 0
    assert learned(lidardesign, *own, "--resume").code == 0
    for key, value in (("misplaced", 0.45), ("steps", 7)):
        refused = learned(lidardesign, "--resume", "--set", f"learning.{key}={value}")
        assert refused.code == 2
        assert f"learning.{key} = " in refused.err


def test_hints_can_be_pasted_whatever_a_folder_is_called(lidardesign, flat):
    result = lidardesign("evaluate", flat)
    assert pasted(result.err) == ["fit", str(flat)]


OTHERS = ("rows.csv", "designs/drawn/by hand.yaml")


def learned(lidardesign, *arguments):
    return lidardesign("learn", "flatland", *set_options(SET_TINY, arguments), "--out", "run", *arguments)


@pytest.fixture
def old(lidardesign, tmp_path):
    """The files of a run that was learned with the seed 0, and has a design; and others that the run did not write."""
    assert learned(lidardesign).code == 0
    (tmp_path / "run" / "designs" / "drawn").mkdir(parents=True)
    (tmp_path / "run" / "designs" / "mine.yaml").write_text("name: mine\n")
    record(tmp_path / "run", ["designs/mine.yaml"])
    for name in OTHERS:
        (tmp_path / "run" / name).write_text(name)
    return files_under(tmp_path)


def test_a_run_is_replaced_only_where_that_is_asked_for(lidardesign, old, tmp_path):
    refused = learned(lidardesign, "--seed", 1)
    assert refused.code == 2
    assert "--overwrite" in refused.err
    assert files_under(tmp_path) == old


def test_a_replaced_run_is_the_one_that_another_folder_would_have_got(lidardesign, old, tmp_path):
    result = learned(lidardesign, "--seed", 1, "--overwrite", "--json")
    assert (result.code, result.json["run"]) == (0, "run")
    assert "note: once it is learned it replaces the run run, with its designs (mine); what is not of the run " in (
        result.err
    )
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert not (tmp_path / "run" / "designs" / "mine.yaml").exists()
    assert [(tmp_path / "run" / name).read_text() for name in OTHERS] == [*OTHERS]
    assert read_manifest(tmp_path / "run")["learn"]["run"] == "run"
    verify(tmp_path / "run", "samples.npz")
    lidardesign("learn", "flatland", *LEARN_TINY, "--out", "other", "--seed", 1)
    for name in ("samples.npz", "flow.safetensors", "config.yaml"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_what_would_be_replaced_is_said_before(lidardesign, old, tmp_path):
    said = learned(lidardesign, "--overwrite", "--dry-run").err
    assert "with its designs (mine); what is not of the run stays: designs/drawn/by hand.yaml, rows.csv" in said
    assert files_under(tmp_path) == old


# Where Ctrl-C comes, and whether anything of the new run is kept then.
@pytest.mark.parametrize(("method", "kept"), [("train", False), ("_advance", True)])
def test_the_old_run_stays_as_it_is_while_the_new_one_is_not_finished(
    lidardesign, old, tmp_path, monkeypatch, method, kept
):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"lidardesign.density.training.trainer.Trainer.{method}", interrupt)
        result = learned(lidardesign, "--seed", 1, "--overwrite")
    assert result.code == 130
    now = files_under(tmp_path)
    assert {name: now[name] for name in old} == old
    assert (tmp_path / "run.new").exists() == kept
    if kept:
        assert "--overwrite --resume" in result.err
        assert learned(lidardesign, "--seed", 1, "--overwrite").code == 2  # it would be lost
        assert learned(lidardesign, "--overwrite", "--resume").code == 0
        assert read_manifest(tmp_path / "run")["seed"] == 1
        assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("which", ["run", "run.new"])
def test_both_runs_are_kept_where_a_folder_cannot_be_renamed(lidardesign, old, tmp_path, monkeypatch, which):
    rename = Path.rename

    def refuse(self, target):
        if self.name == which:
            raise OSError(errno.EACCES, "Permission denied")
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", refuse)
        patch.setattr("lidardesign.api.learn.exchange", lambda *_: False)
        result = learned(lidardesign, "--seed", 1, "--overwrite")
    assert result.code == 3
    assert "run.new: cannot replace run: Permission denied" in result.err
    now = files_under(tmp_path)
    assert {name: now[name] for name in old} == old
    verify(tmp_path / "run.new", "samples.npz")


# A command, and the function before which its run goes.
MEANWHILE = [
    (["fit", "--layout", "even", "--name", "mine"], "design.Design.save"),
    (["constrain", "--set", "gate.width_m.max=0.5", "--layout", "even", "--name", "mine"], "design.Design.save"),
    (["evaluate", "--baseline", "none", "--json"], "scores.Scores.last_scores"),
]


@pytest.mark.parametrize("another", [False, True])
@pytest.mark.parametrize(("arguments", "before"), MEANWHILE)
def test_a_run_that_is_gone_does_not_come_back_and_another_in_its_place_gets_nothing(
    lidardesign, tmp_path, monkeypatch, another, arguments, before
):
    run = make_run(tmp_path / "run", count=1000, overrides=["test=2"])
    assert lidardesign("fit", run, "--sensors", 1, "--rays", 8, "--layout", "even").code == 0
    shutil.copytree(run, tmp_path / "other")
    write_manifest(tmp_path / "other", {**read_manifest(run), "created": "2020-01-01T00:00:00+00:00"})
    expected = files_under(tmp_path / "other") if another else None
    real = getattr(importlib.import_module(f"lidardesign.api.{before.split('.')[0]}"), before.split(".")[1])
    name = before.split(".")[2]
    work = getattr(real, name)

    def strike(*given):
        shutil.rmtree(run)
        if another:
            (tmp_path / "other").rename(run)
        return work(*given)

    monkeypatch.setattr(real, name, strike)
    sensors = [] if arguments[0] == "evaluate" else ["--sensors", 1]
    result = lidardesign(arguments[0], run, *sensors, "--rays", 8, *arguments[1:])
    assert result.code == 3
    assert ("another run has taken its place" if another else "run: no such run") in result.err
    assert (files_under(run) if run.exists() else None) == expected
    if arguments[0] == "evaluate":
        assert result.json["rows"], "what was worked for is given all the same"


@pytest.mark.parametrize("arguments", [["fit", "run"], ["learn", "flatland"], ["tasks", "check", "flatland"]])
def test_a_working_folder_that_is_gone_is_named(lidardesign, tmp_path, monkeypatch, arguments):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    result = lidardesign(*arguments)
    assert result.code == 3
    assert "data error: the working folder no longer exists" in result.err


def test_a_run_that_cannot_be_exchanged_is_not_replaced(lidardesign, old, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path / "run" / "designs")
    refused = lidardesign("learn", "flatland", *LEARN_TINY, "--out", "..", "--overwrite")
    assert refused.code == 2
    assert "holds the working folder: it cannot be replaced" in refused.err


def test_a_run_whose_plugin_is_gone_names_the_package(lidardesign, tmp_path, monkeypatch):
    install_plugins(tmp_path, {"ball": GOOD}, package="balls")
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        assert lidardesign("learn", "ball", *LEARN_TINY[2:], "--out", "run").code == 0
    sys.modules.pop("balls_ball", None)
    for arguments in (["fit", "run"], ["evaluate", "run"], ["learn", "--resume", "--out", "run"]):
        result = lidardesign(*arguments)
        assert result.code == 2
        assert "ball" in result.err
    result = lidardesign("fit", "run")
    assert "run: the task 'ball' of this run is not installed; it came with the package balls 1.0" in result.err
    assert "try: pip install balls==1.0\n" in result.err


FIGURES = {"ess": 0.8, "kl_nats": 0.1, "log_z": -2.0, "coverage": 0.99, "misplaced": 0.1}


@pytest.fixture
def finished(flat):
    note(flat, learn={**FIGURES, "seconds": 33.0, "steps": 350})
    return flat


def follow(lidardesign, shown):
    """The commands that are named as next; learning is planned, all others parsed."""
    lines = shown[shown.index("next:\n") :].splitlines()[1:]
    assert lines
    for line in lines:
        words = shlex.split(line)[1:]
        if words[0] in ("learn", "show"):
            result = lidardesign(*words, *(["--dry-run"] if words[0] == "learn" else []))
            assert result.code == 0, (line, result.err)
        else:
            typer.main.get_command(app).commands[words[0]].make_context(words[0], words[1:])
    return [shlex.split(line)[1] for line in lines]


def test_a_run_that_is_not_finished_is_gone_on_with(lidardesign, flat):
    shown = lidardesign("show", flat)
    assert (shown.code, "learning was not finished" in shown.out) == (0, True)
    assert follow(lidardesign, shown.out) == ["learn"]
    with run_lock(flat):  # somebody is at work
        shown = lidardesign("show", flat).out
    assert "is learning it" in shown
    assert "next:" not in shown


def test_a_run_says_what_it_has_and_what_can_be_done_next(lidardesign, finished):
    shown = lidardesign("show", finished).out
    assert "the density is good: 10 % misplaced, KL 0.1 nats, ESS 0.8" in shown
    assert "no designs yet" in shown
    assert follow(lidardesign, shown) == ["fit"]
    lidardesign("fit", finished, "--layout", "even", "--sensors", 1)
    shown = lidardesign("show", finished).out
    assert "no scores yet" in shown
    assert follow(lidardesign, shown) == ["evaluate"]
    scores = lidardesign("evaluate", finished, "--rays", 9, "--json").json
    shown = lidardesign("show", finished).out
    assert follow(lidardesign, shown) == ["constrain", "export"]
    (row,) = [row for row in scores["rows"] if row["design"] == "fit"]
    baseline = scores["strongest_baseline"]["name"]
    (pair,) = [pair for pair in scores["paired"] if (pair["a"], pair["b"]) == ("fit", baseline)]
    (design,) = lidardesign("show", finished, "--json").json["designs"]
    kept = design["score"]
    assert (design["name"], design["sensors"], kept["rays"], kept["baseline"]) == ("fit", 1, 9, baseline)
    assert {name: kept[name] for name in ("value", "ci_low", "ci_high")} == {
        name: row[name] for name in ("value", "ci_low", "ci_high")
    }
    assert kept["difference"] == pair["difference"]
    assert f"to {baseline}" in shown


def test_a_score_is_of_the_design_as_it_was_scored(lidardesign, finished):
    lidardesign("fit", finished, "--layout", "even", "--sensors", 1)
    lidardesign("evaluate", finished, "--rays", 9, "--quiet")
    assert lidardesign("show", finished, "--json").json["designs"][0]["score"] is not None
    lidardesign("fit", finished, "--layout", "even", "--sensors", 2)
    assert lidardesign("show", finished, "--json").json["designs"][0]["score"] is None


def test_showing_writes_nothing_and_says_how_large_the_cache_of_fits_is(lidardesign, finished):
    lidardesign("fit", finished, "--layout", "even", "--sensors", 1)
    assert lidardesign("show", finished, "--json").json["cache"] is None
    (finished / CACHE).write_bytes(bytes(1_234_567))
    before = files_under(finished)
    assert lidardesign("show", finished, "--json").json["cache"] == {"path": str(finished / CACHE), "bytes": 1_234_567}
    assert f"{finished / CACHE}, 1.2 MB" in lidardesign("show", finished).out
    assert lidardesign("show", finished / "designs" / "fit.yaml").code == 0
    assert files_under(finished) == before


def test_a_rough_density_says_what_would_make_it_better(lidardesign, finished):
    note(finished, learn={"misplaced": 0.6})
    assert "the density is poor" in (shown := lidardesign("show", finished).out)
    assert "--preset standard learns longer" in shown


def test_what_cannot_be_read_is_said_beside_what_can(lidardesign, finished):
    lidardesign("fit", finished, "--layout", "even", "--sensors", 1)
    (finished / "designs" / "cut.yaml").write_text("name: [")
    shown = lidardesign("show", finished)
    assert shown.code == 0
    assert "cut cannot be read: " in shown.out
    note(finished, learn={"seconds": "long", "steps": None}, scores={"fit": {"value": "many"}})
    assert "no scores yet" in lidardesign("show", finished).out
    assert lidardesign("show", finished, "--at", "x_m=1").code == 2
