"""Every command says where its time went and how far its figures may be off: in tables, in JSON, in the manifest."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import pytest
from rich.console import Console
from support.command_line import files_under

from lidardesign.cli.terminal.score_tables import show_times
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import read_manifest

LEARN = (
    "learn flatland --preset draft --set learning.steps=20 --set learning.samples=1000 --set learning.batch=64 "
    "--set learning.layers=1 --set learning.hidden=12 --set train=2 --set learning.coverage_proposals=256"
)


@pytest.fixture
def lidardesign(call):
    """The program with its first words as one line."""
    return lambda line, *more: call(*line.split(), *more)


def adds_up(document):
    """Whether the outer phases of a document make a plausible whole."""
    timings = document["timings"]
    assert list(timings)[-1] == "other"
    assert all(seconds >= 0 for seconds in timings.values())
    for name in timings:
        inside = sum(seconds for key, seconds in timings.items() if key.rpartition("/")[0] == name)
        # each is rounded to a millisecond
        assert inside <= timings[name] + 0.0005 * (1 + len(timings))
    return sum(seconds for name, seconds in timings.items() if "/" not in name)


def test_learning_says_what_it_cost_and_how_far_its_figures_may_be_off(lidardesign, tmp_path):
    done = lidardesign(LEARN, "--out", tmp_path / "run", "--json", "--quiet")
    assert done.code == 0, done.err
    document = done.json
    assert adds_up(document) >= document["seconds"] - 0.01
    assert {"libraries", "scenes", "fields", "proposals", "learning", "learning/target", "measuring", "writing"} <= set(
        document["timings"]
    )
    for name in ("ess", "kl_nats", "log_z", "coverage"):
        estimate = document["error_estimates"][name]
        assert estimate["value"] == document[name]
        assert estimate["error"] >= 0
        assert estimate["kind"] == "standard error"
    kept = read_manifest(tmp_path / "run")["timings"]["learn"]
    assert set(kept) == {"when", "seconds", "phases", "peak_memory_bytes"}
    # numpy and torch alone take some 100 MB
    assert 5e7 < kept["peak_memory_bytes"] <= document["peak_memory_bytes"] < 1e11
    assert kept["phases"]["learning"] == document["timings"]["learning"]


def test_fits_say_what_they_cost_and_write_the_same_bytes_whatever_the_time(lidardesign, flat):
    designs = []
    for _ in range(2):
        document = lidardesign("fit run --layout even --sensors 2 --rays 30 --name one --json").json
        designs.append((flat / "designs" / "one.yaml").read_bytes())
        assert adds_up(document) >= document["seconds"] - 0.01
        assert {"samples", "fitting", "fitting/mixture", "writing"} <= set(document["timings"])
    assert designs[0] == designs[1]
    assert b"seconds" not in designs[0]
    estimates = document["error_estimates"]
    for name in ("log_likelihood", "ess"):
        assert estimates[name]["value"] == pytest.approx(document[name])
    lidardesign("constrain run --layout even --sensors 2 --set gate.width_m.max=0.4 --name two")
    assert set(read_manifest(flat)["timings"]) == {"fit", "constrain"}


def test_reading_commands_keep_their_times_in_the_run_and_change_nothing_else_there(lidardesign, flat, tmp_path):
    lidardesign("fit run --layout even --sensors 2 --rays 20 --name one")
    before = files_under(flat)
    evaluated = lidardesign("evaluate run --rays 20 --set test=3 --json").json
    adds_up(evaluated)
    assert {"designs", "scenes", "rays", "held-out scenes", "held-out scenes/metric"} <= set(evaluated["timings"])
    exported = lidardesign("export run/designs/one.yaml --format npz --out rays.npz --json").json
    adds_up(exported)
    shown = lidardesign("show run/designs/one.yaml --json").json
    adds_up(shown)
    after = files_under(flat)
    assert {name for name in after if after[name] != before.get(name)} == {"manifest.json"}
    assert set(read_manifest(flat)["timings"]) == {"fit", "evaluate", "export"}
    old, new = (json.loads(files["manifest.json"]) for files in (before, after))
    assert new.pop("scores").keys() == {"one"}
    assert {**new, "timings": None} == {**old, "timings": None}


def test_a_run_that_cannot_be_written_is_still_read(lidardesign, flat, tmp_path):
    lidardesign("fit run --layout even --sensors 2 --rays 20 --name one")
    with run_lock(flat):
        done = lidardesign("export run/designs/one.yaml --format csv --out rays.csv")
    assert done.code == 0
    assert "the times of export are not kept" in done.err
    assert "writing this run" in done.err
    assert (tmp_path / "rays.csv").is_file()


def test_the_table_of_times_indents_what_is_inside_and_leaves_out_what_is_next_to_nothing():
    console = Console(file=io.StringIO(), width=80)
    show_times({"learning": 8.0, "learning/target": 6.0, "writing": 0.01, "other": 1.99}, None, console)
    lines = [line for line in console.file.getvalue().splitlines() if "%" in line]
    assert [re.findall(r"[\w.%]+", line) for line in lines] == [
        ["learning", "8.00", "80", "%"], ["target", "6.00", "60", "%"], ["other", "2.00", "20", "%"]
    ]  # fmt: skip
    assert lines[1].index("target") > lines[0].index("learning")


def test_every_phase_is_explained():
    root = Path(__file__).parents[2]
    page = (root / "docs" / "accuracy.md").read_text(encoding="utf-8").partition("| phase |")[2]
    explained = set(re.findall(r"`([a-z -]+)`", "".join(re.findall(r"^\| (.*?) \|", page, re.MULTILINE))))
    sources = [path.read_text(encoding="utf-8") for path in (root / "lidardesign").rglob("*.py")]
    used = {name for text in sources for name in re.findall(r'phase\("([^"]+)"\)', text)}
    assert used <= explained, f"docs/accuracy.md does not explain {used - explained}"
    assert explained <= used, explained - used
