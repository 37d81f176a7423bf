"""The examples run from beginning to end."""

from __future__ import annotations

import csv
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from support.docs_session import in_process
from support.small_runs import shifted

from lidardesign.formats.galvo import is_galvo_file

EXAMPLES = Path(__file__).parents[2] / "examples"
QUICK = ("learning.samples=10000", "learning.coverage_proposals=1024")
# What is blurred is learned at once, and well enough on any processor: see `small_runs`.
SETTINGS = {
    "arm": (*QUICK, "learning.steps=80", "density.sigma_m=0.15", "train=4", "test=2", "frames=6"),
    # a hundredth of the density lies where the flood may be: with few samples nothing could be fitted there
    "emitter": (
        "learning.samples=80000", QUICK[1], "learning.steps=80", "density.sigma_m=0.04",
        "train=4", "test=2", "truth_points=1000",
    ),
    "warehouse": (
        "learning.samples=5000", QUICK[1], "learning.steps=80", "density.sigma_m=0.2",
        "train=4", "test=2", "positions=0", "bays=1", "box_width_m=[0.5, 0.6]",
    ),
    "capture": (*QUICK, "learning.steps=80", "density.sigma_m=0.02", "train=8", "test=4"),
}  # fmt: skip


@pytest.fixture
def run_example(monkeypatch, capsys):
    """Runs an example and the program that it calls in this process, as their starts take longest; what it prints."""
    monkeypatch.syspath_prepend(EXAMPLES)
    elsewhere = subprocess.run

    def here(words, **options):
        if Path(words[0]).name != "lidardesign":
            return elsewhere(words, **options)
        ran = in_process([*words[1:], *(("--seed", shifted()) if words[1] == "learn" else ())])
        assert ran.code == 0, ran.err + ran.out
        return subprocess.CompletedProcess(words, ran.code, ran.out)

    def run(name, folder, *further):
        words = [word for setting in SETTINGS[name] for word in ("--set", setting)]
        monkeypatch.setattr(subprocess, "run", here)
        monkeypatch.setattr(sys, "argv", [name, "--out", str(folder), *words, *further])
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        printed = capsys.readouterr().out
        assert "Done in" in printed
        return printed

    yield run
    sys.modules.pop("demo", None)


@pytest.mark.slow
def test_the_arm_is_designed_with_free_mounted_and_railed_sensors(run_example, tmp_path):
    run_example("arm", tmp_path / "arm")
    written = {path.stem for path in (tmp_path / "arm" / "run" / "designs").iterdir()}
    assert written == {"free", "mounted", "rails"}
    assert "no-visibility" in (tmp_path / "arm" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_warehouse_is_designed_for_every_position(run_example, tmp_path):
    run_example("warehouse", tmp_path / "aisle")
    for x_m in ("0.37", "3.91"):
        with open(tmp_path / "aisle" / f"rays_{x_m}.csv", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == 12
        assert {row["origin_x_m"] for row in rows} == {x_m}


@pytest.mark.slow
def test_emitters_are_designed_beside_a_laser_at_the_detector(run_example, tmp_path):
    out = run_example("emitter", tmp_path / "phone")
    for name in ("laser", "flood", "floods", "bistatic"):
        assert (tmp_path / "phone" / "run" / "designs" / f"{name}.yaml").exists()
        assert any(line.startswith(name) and line.endswith("%") for line in out.splitlines())


@pytest.mark.slow
def test_a_simulated_laboratory_captures_a_head_and_gates_remove_outliers(run_example, tmp_path):
    # sensors of a short training may look past the mirrors' reach of 20 degrees, where their space goes further
    run_example("capture", tmp_path / "lab", "--side", "48", "--set", "half_angle_deg=18")
    assert is_galvo_file(tmp_path / "lab" / "sensors-10.galvo.csv")
    with open(tmp_path / "lab" / "scan.points.csv", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["range_m"] and row["design"] == "sensors-10"]
    shares = {}
    for gate in ("own", "whole"):
        outliers = [int(row["outlier"]) for row in rows if row["gate"] == gate]
        shares[gate] = sum(outliers) / len(outliers)
    assert shares["own"] < 0.3 * shares["whole"]
    assert (tmp_path / "lab" / "capture.png").stat().st_size > 10_000
