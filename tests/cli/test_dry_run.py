"""`--dry-run` writes nothing, refuses what the command would refuse, and says what the command then does."""

from __future__ import annotations

import json
import math
import re
import time
from pathlib import Path

import pytest
from support.command_line import caller, files_under, make_run
from support.tables import each_row

from lidardesign.config import LearningSettings
from lidardesign.density.training.training import STRETCH, Trainer, least_balancing_steps
from lidardesign.run.manifest import read_manifest, write_manifest

TINY = ("steps=2", "batch=64", "samples=1000", "balance_proposals=256", "coverage_proposals=256", "hidden=4")


@pytest.fixture
def flat(tmp_path):
    return make_run(tmp_path / "run")


@pytest.fixture
def given_files(lidardesign, flat, tmp_path):
    """A design of two sensors, constraints and a configuration."""
    lidardesign("fit", flat, "--layout", "grid", "--sensors", 2)
    (tmp_path / "few.yaml").write_text("budget: {rays: 40}\n")
    (tmp_path / "flat.yaml").write_text("task: {variation: 0.5}\n")


def dry(lidardesign, tmp_path, *arguments):
    """The plan of a command, which must leave everything as it is."""
    before = files_under(tmp_path)
    plan = lidardesign(*arguments, "--dry-run", "--json")
    assert plan.code == 0, plan.err
    assert files_under(tmp_path) == before
    return plan.json


def changed(before, tmp_path):
    """The files that are new or have another content."""
    return {name for name, content in files_under(tmp_path).items() if before.get(name) != content}


def announced(plan, tmp_path):
    return {str(Path(entry["path"]).absolute().relative_to(tmp_path)) for entry in plan["writes"]}


COMMANDS = [
    ("fit run --layout grid --sensors 2 --name two", None),
    ("constrain run --layout grid --set gate.width_m.max=0.3 --name tight", None),
    ("evaluate run --rays 9 --csv rows.csv", "fit run --layout grid --sensors 1"),
    ("export run/designs/fit.yaml --format csv --rays 9", "fit run --layout grid --sensors 1"),
    ("export run/designs/fit.yaml --format sensors-csv --out out/table.csv", "fit run --layout grid --sensors 1"),
]


@pytest.mark.parametrize(("arguments", "first"), COMMANDS, ids=[one[0] for one in COMMANDS])
def test_what_would_be_written_is_what_is_written_then(lidardesign, flat, tmp_path, arguments, first):
    if first:
        lidardesign(*first.split())
    before = files_under(tmp_path)
    plan = dry(lidardesign, tmp_path, *arguments.split())
    assert lidardesign(*arguments.split()).code == 0
    written = changed(before, tmp_path)
    # an export keeps its times in the run too
    kept = {"run/manifest.json"} if arguments.startswith("export") else set()
    assert written - kept == announced(plan, tmp_path) - kept
    for entry in plan["reads"]:
        assert entry["bytes"] == len(before[str(Path(entry["path"]).absolute().relative_to(tmp_path))])


def test_learning_writes_what_was_said(lidardesign, tmp_path):
    settings = [word for value in TINY for word in ("--set", f"learning.{value}")]
    arguments = ("learn", "flatland", "--set", "train=1", *settings, "--out", "new/run")
    plan = dry(lidardesign, tmp_path, *arguments)
    assert plan["settings"]["learning"]["steps"] == 2
    assert any("at most 2 steps of 64 points" in step for step in plan["steps"])
    assert lidardesign(*arguments).code == 0
    folders = [name for name in announced(plan, tmp_path) if (tmp_path / name).is_dir()]
    for name in files_under(tmp_path):
        held = name in announced(plan, tmp_path) or any(name.startswith(f"{folder}/") for folder in folders)
        assert held or name.endswith(".lock"), name
    for name in announced(plan, tmp_path):
        assert (tmp_path / name).exists(), name
    # the same once more knows how long it takes
    again = dry(lidardesign, tmp_path, *arguments[:-1], "new/other")
    assert again["before"]["seconds"] == read_manifest(tmp_path / "new/run")["timings"]["learn"]["seconds"]
    assert "run" in again["before"]["of"]
    longer = dry(lidardesign, tmp_path, *arguments[:-1], "new/longer", "--set", "learning.steps=3")
    assert longer["before"] is None


REFUSED = [
    ("learn nothing", 2),
    ("learn flatland --out run", 2),
    ("learn flatland --out notes.txt/run", 3),
    ("learn flatland --set density.sigma_m=-1", 2),
    ("learn flatland --tolerance 2", 2),
    ("learn flatland --resume --out absent", 3),
    ("fit absent", 3),
    ("fit run --layout spiral", 2),
    ("fit run --name ../elsewhere", 2),
    ("constrain run --set gate.width_m.most=1", 2),
    ("constrain run --set gate.start_m.min=0.8 --set gate.end_m.max=0.5", 4),
    ("evaluate run", 3),
    ("evaluate run --baseline best", 2),
    ("evaluate fitted --set range=1", 2),
    ("evaluate fitted --csv notes.txt/rows.csv", 3),
    ("evaluate fitted --report fitted", 3),
    ("export absent.yaml --format csv", 3),
    ("evaluate fitted/designs/chosen.yaml --rays 9", 2),
    ("export fitted/designs/chosen.yaml --format csv --rays 9", 2),
    ("export fitted/designs/fit.yaml --format jpeg", 2),
    ("export fitted/designs/fit.yaml --format csv --at hue=1", 2),
    ("export fitted/designs/fit.yaml --format csv --out fitted/designs/fit.yaml", 2),
]


@pytest.fixture(scope="module")
def refusing(tmp_path_factory):
    """A folder with a run without designs, one with a design, and a file."""
    folder = tmp_path_factory.mktemp("refusing")
    make_run(folder / "run", count=1000)
    make_run(folder / "fitted", count=1000)
    (folder / "notes.txt").write_text("keep me")
    return folder


@each_row(("arguments", "code"), REFUSED, ids=[one[0] for one in REFUSED])
def test_what_the_command_would_refuse_is_refused(capsys, monkeypatch, refusing, arguments, code):
    call = caller(capsys, refusing, monkeypatch)
    if not (refusing / "fitted" / "designs").exists():
        call("fit", "fitted", "--layout", "grid", "--sensors", 1)
        call("fit", "fitted", "--sensors", 1, "--rays", 8, "--name", "chosen")
    before = files_under(refusing)
    result = call(*arguments.split(), "--dry-run", "--json")
    assert result.code == code, result.out + result.err
    assert result.json["exit_code"] == code
    assert files_under(refusing) == before


def test_samples_that_were_changed_are_refused_before_anything_is_fitted(lidardesign, flat, tmp_path):
    samples = flat / "samples.npz"
    samples.write_bytes(samples.read_bytes()[:-10])
    result = lidardesign("fit", flat, "--dry-run")
    assert result.code == 3
    assert "truncated" in result.err


def test_people_are_told_in_words(lidardesign, flat, tmp_path):
    lidardesign("fit", flat, "--layout", "grid", "--sensors", 2)
    result = lidardesign("fit", flat, "--sensors", 2, "--weight", "variation=1.5", "--dry-run")
    lines = result.out.splitlines()
    assert lines[0] == "fit would"
    assert "  fit 2 sensors, layout grid, rays left open, level 0.95, seed 3" in lines
    assert "  weight the density with variation=1.5" in lines
    assert f"write  {flat}/designs/fit.yaml (replaced)" in lines
    assert any(line.startswith(f"time   the last fit of {flat} took") for line in lines)
    assert lines[-1] == "nothing was done: leave out --dry-run to do it"
    chosen = "fit as many sensors as score best on training scenes, layout selected, rays left open, level 0.999"
    assert chosen in lidardesign("fit", flat, "--dry-run").out
    told = lidardesign("evaluate", flat, "--rays", 9, "--rays", 16, "--baseline", "occupancy", "--dry-run").out
    assert "against uniform, random, bounding, silhouette, greedy, occupancy: 14 rows at equal rays" in told
    assert "up to 12 at equal bandwidth" in told


def test_a_manifest_without_times_or_with_odd_ones_promises_nothing(lidardesign, flat, tmp_path):
    for times in ({}, {"fit": {"seconds": "long"}}, {"fit": 3}):
        write_manifest(flat, {**read_manifest(flat), "timings": times})
        assert dry(lidardesign, tmp_path, "fit", flat)["before"] is None


def test_another_run_whose_files_are_damaged_is_no_example(lidardesign, tmp_path):
    broken = tmp_path / "runs" / "broken"
    broken.mkdir(parents=True)
    (broken / "manifest.json").write_text(json.dumps([]))
    (broken / "config.yaml").write_text("{")
    assert dry(lidardesign, tmp_path, "learn", "flatland")["before"] is None


def test_files_that_were_given_are_among_those_that_are_read(lidardesign, given_files, tmp_path):
    plan = dry(lidardesign, tmp_path, "constrain", "run/designs/fit.yaml", "--constraints", "few.yaml")
    assert [entry["path"] for entry in plan["reads"]][:2] == ["run/designs/fit.yaml", "few.yaml"]
    plan = dry(lidardesign, tmp_path, "learn", "flatland", "--config", "flat.yaml")
    assert [entry["path"] for entry in plan["reads"]] == ["flat.yaml"]
    plan = dry(lidardesign, tmp_path, "fit", "run", "--like", "run/designs/fit.yaml")
    assert plan["reads"][0]["path"] == "run/designs/fit.yaml"
    assert plan["settings"]["sensors"] == 2


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("export run/designs/fit.yaml --format csv --rate-hz 5", "csv cannot hold a frame rate"),
        ("fit run --at y_m=1", "--at"),
    ],
)
def test_what_would_be_refused_is_refused_at_once(lidardesign, given_files, line, words):
    result = lidardesign(*line.split(), "--dry-run")
    assert result.code in (2, 3), result.out
    assert words in result.err


SLOW_S = 0.02
FORECASTS = {
    "all steps": "--set learning.steps=40 --set learning.misplaced=0",
    "steps that all balance": "--set learning.steps=40 --set learning.misplaced=0 --set learning.pathwise=0",
    "a goal": "--set learning.steps=200",
    "a goal that is measured too late": "--set learning.steps=70",
    "a tolerance": "--tolerance 0.5",
    "a tolerance and steps": "--set learning.steps=90 --set learning.pathwise=20 --tolerance 0.5",
}


@pytest.fixture
def foreseen(lidardesign, monkeypatch):
    """What `learn --dry-run` foresees on a machine whose steps take SLOW_S longer."""
    whole = Trainer.find_gradient

    def slowly(self):
        time.sleep(SLOW_S)
        return whole(self)

    monkeypatch.setattr(Trainer, "find_gradient", slowly)
    settings = [word for value in TINY[1:] for word in ("--set", f"learning.{value}")]

    def call(*arguments):
        return lidardesign("learn", "flatland", "--set", "train=1", *settings, *arguments, "--dry-run", "--json")

    return call


@each_row("name", FORECASTS)
def test_learning_foresees_its_time_from_real_steps(foreseen, name):
    plan = foreseen(*FORECASTS[name].split()).json
    found, learning = plan["forecast"], LearningSettings(**plan["settings"]["learning"])
    most, pathwise = learning.steps, learning.pathwise_steps
    least = pathwise + STRETCH * math.ceil(least_balancing_steps(pathwise) / STRETCH)
    first = min(least, most) if learning.misplaced else most
    assert found["pathwise_s"] > SLOW_S or pathwise == 0
    assert found["balancing_s"] > SLOW_S
    for steps, seconds in ((first, found["seconds"]), (most, found["longest_seconds"])):
        taken = pathwise * found["pathwise_s"] + (steps - pathwise) * found["balancing_s"] + found["finishing_s"]
        assert seconds == pytest.approx(found["preparing_s"] + taken, rel=0.01, abs=0.1)
    assert found["steps"] == most
    assert found["peak_memory_bytes"] > 0
    assert any("good enough" in what for what in found["unknown"]) == (first < most)
    assert any("finer distance fields" in what for what in found["unknown"]) == ("--tolerance" in FORECASTS[name])


def test_a_time_budget_is_foreseen_to_be_kept_or_refused_as_learning_would(foreseen):
    found = foreseen("--time-budget", 60).json["forecast"]
    assert found["steps"] * SLOW_S < found["seconds"] == found["longest_seconds"] <= 60
    refused = foreseen("--time-budget", 3)
    assert (refused.code, refused.json["error"]["where"]) == (2, "--time-budget")


def test_of_a_run_that_is_resumed_only_the_rest_is_foreseen(foreseen, lidardesign, tmp_path, monkeypatch):
    settings = [word for value in ("train=1", *(f"learning.{one}" for one in TINY)) for word in ("--set", value)]
    lidardesign("learn", "flatland", *settings, "--out", "run")
    before = files_under(tmp_path)
    assert foreseen("--set", "learning.steps=2", "--out", "run", "--resume").json["forecast"]["steps"] == 0
    assert files_under(tmp_path) == before


def test_people_are_told_how_long_it_takes_and_what_is_read(lidardesign, tmp_path):
    (tmp_path / "flat.yaml").write_text("task_name: flatland\n")
    settings = [word for value in TINY for word in ("--set", f"learning.{value}")]
    shown = lidardesign("learn", "--config", "flat.yaml", "--set", "train=1", *settings, "--dry-run").out
    assert "read   flat.yaml (20 bytes)" in shown
    assert re.search(
        r"^time   about .* s: preparing .*, 2 steps of [0-9]+ and [0-9]+ ms, measuring", shown, re.MULTILINE
    )
    assert re.search(r"^memory about [0-9,]+ MB$", shown, re.MULTILINE)
    assert "not known: how long balancing steps" in shown
