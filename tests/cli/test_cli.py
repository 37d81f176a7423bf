"""The command line: one clear message and the right exit code for each mistake, and nothing half-written."""

from __future__ import annotations

import html
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from support.command_line import FEW_SCENES

import lidardesign as package
from lidardesign import __version__
from lidardesign.api.design import Design
from lidardesign.cli.main import run as run_program
from lidardesign.cli.terminal import output as console_module
from lidardesign.cli.terminal.design_tables import show_fit
from lidardesign.cli.terminal.output import command, plain_json
from lidardesign.errors import InfeasibleError
from lidardesign.parts.catalogue import Pose, find_part, part_design
from lidardesign.report.sections import sensors_section
from lidardesign.run.processes import TerminatedError
from lidardesign.run.yaml import load_yaml
from lidardesign.sensors.compare import difference, paired_sensors
from lidardesign.sensors.design_file import save_design

PART = "vl53l8cx:4x4"


def test_the_versions_that_results_depend_on_are_printed(lidardesign):
    assert lidardesign("--version").out == f"lidardesign {__version__}\n"
    for arguments in (["--version", "--json"], ["--json", "--version"]):
        found = lidardesign(*arguments).json
        assert found["version"] == __version__
        assert {"lidardesign", "python", "numpy", "torch"} <= set(found["versions"])


def test_tasks_alone_lists_them_and_json_is_one_document(lidardesign):
    assert "flatland" in lidardesign("tasks").out
    listed = lidardesign("tasks", "list", "--json").json["tasks"]
    assert {"face", "flatland", "meshes"} <= {entry["name"] for entry in listed}


def test_a_task_shows_what_is_designed_what_is_given_and_how_it_is_fitted(lidardesign):
    arm = lidardesign("tasks", "show", "arm")
    assert "defaults: level 0.99, evaluated at 400, 1000, 1200 rays" in arm.out
    defaults = lidardesign("tasks", "show", "arm", "--json").json["defaults"]
    assert defaults == {"level": 0.99, "rays": [400, 1000, 1200]}
    shelves = lidardesign("tasks", "show", "warehouse").out
    kinds = {row.split()[0]: row for row in shelves.splitlines() if row.split()}
    assert "a condition (--at)" in kinds["x_m"]
    assert "fixed" in kinds["azimuth_rad"]
    assert "designed" in kinds["elevation_rad"]
    assert "follows from the configuration" in lidardesign("tasks", "show", "meshes").out


def test_the_chain_works_from_a_run_to_exported_rays(lidardesign, flat, tmp_path):
    fitted = lidardesign("fit", flat, "--layout", "even", "--sensors", 2, "--json").json
    keys = {"design", "sensors", "log_likelihood", "admissible_mass", "ess", "satisfied", "constraints", "seconds"}
    assert keys <= {*fitted}
    assert Path(fitted["design"]) == flat / "designs" / "fit.yaml"
    assert len(fitted["sensors"]) == 2
    arguments = ("--set", "gate.width_m.max=0.3", "--set", "budget.rays=40", "--name", "tight")
    tight = lidardesign("constrain", flat / "designs" / "fit.yaml", *arguments, "--json").json
    assert tight["satisfied"] is True
    assert {"name", "bound", "value", "satisfied"} == {*tight["constraints"][0]}
    written = load_yaml(Path(tight["design"])).value
    assert all(sensor["gate_m"]["end"] - sensor["gate_m"]["start"] <= 0.3 for sensor in written["sensors"])
    assert (flat / "designs" / written["provenance"]["run"]).resolve() == flat.resolve()
    exported = lidardesign("export", tight["design"], "--format", "csv", "--json").json
    assert exported["rays"] == 40
    assert Path(exported["out"]).is_file()
    assert "tight" in lidardesign("show", tight["design"]).out


def test_evaluate_scores_designs_and_baselines_and_holds_a_threshold(lidardesign, flat):
    lidardesign("fit", flat, "--layout", "even", "--sensors", 2)
    arguments = ("evaluate", flat, "--rays", 16, "--set", "test=3")
    result = lidardesign(*arguments, "--csv", "rows.csv", "--fail-above", 1e-9, "--json")
    assert result.code == 1
    assert "fail-above" in result.err
    rows = result.json["rows"]
    assert {"fit", "uniform", "random", "bounding"} <= {row["design"] for row in rows}
    assert Path("rows.csv").is_file()
    passed = lidardesign(*arguments, "--fail-above", 1e9)
    assert passed.code == 0
    assert "held-out" in passed.out


def test_evaluate_fails_unless_designs_are_better_than_a_baseline(lidardesign, flat):
    for sensors in (1, 2):
        lidardesign("fit", flat, "--layout", "even", "--sensors", sensors, "--rays", 16, "--name", f"s{sensors}")
    both = [flat / "designs" / f"s{sensors}.yaml" for sensors in (1, 2)]
    few = ("--rays", 16, "--set", "test=5", "--baseline", "none")
    for baseline, other, sign in (("s1", "s2", 1), ("s2", "s1", -1)):
        found = lidardesign("evaluate", *both, *few, "--fail-unless-better", baseline, "--json")
        (pair,) = found.json["paired"]
        assert (pair["a"], pair["b"]) == ("s1", "s2")
        assert found.code == int(not min(sign * pair["ci_low"], sign * pair["ci_high"]) > 0)
        if found.code:
            assert re.search(f"{other} is (not significantly different from|worse than) {baseline} ", found.err)
    # a baseline that is not always there stands beside the designs then
    scores = package.open_run(flat).evaluate(both[1:], rays=[16], settings={"test": 3}, fail_unless_better="lloyd")
    assert "lloyd" in [row.design for row in scores.rows]


def test_an_unexpected_error_is_one_line_with_a_hint(capsys, monkeypatch):
    for debug in ("", "1"):
        monkeypatch.setenv("LIDARDESIGN_DEBUG", debug)
        with pytest.raises(console_module.typer.Exit) as ended, command(json=True, quiet=False):
            raise ZeroDivisionError("division by zero")
        captured = capsys.readouterr()
        assert ended.value.exit_code == 70
        assert json.loads(captured.out)["error"]["kind"] == "internal"
        assert "LIDARDESIGN_DEBUG" in captured.err
        assert ("Traceback" in captured.err) == bool(debug)


def test_a_damaged_cache_of_compiled_code_is_named_with_what_to_do(tmp_path, capsys):
    from numba.core.caching import IndexDataCacheFile

    (tmp_path / "kernel.nbi").write_bytes(b"\x80\x04 cut")
    cache = IndexDataCacheFile(str(tmp_path), "kernel", "stamp")
    with pytest.raises(console_module.typer.Exit) as ended, command(json=True, quiet=False):
        cache.load("overload")
    error = json.loads(capsys.readouterr().out)["error"]
    assert (ended.value.exit_code, error["kind"]) == (3, "system")
    assert str(tmp_path) in error["message"]
    assert "*.nbi" in error["hint"]


def test_an_error_after_the_document_adds_no_second_one(capsys):
    def body():
        with command(json=True, quiet=False) as console:
            console.result({"value": 1}, lambda rich: None)
            raise InfeasibleError("late")

    with pytest.raises(console_module.typer.Exit):
        body()
    assert json.loads(capsys.readouterr().out)["value"] == 1


def test_numbers_that_json_lacks_become_null():
    values = {"a": np.nan, "b": [np.inf, np.float64(1.5)], "c": np.arange(2), "d": Path("x"), "e": (None, True)}
    assert plain_json(values) == {"a": None, "b": [None, 1.5], "c": [0, 1], "d": "x", "e": [None, True]}


def test_a_design_fits_a_terminal_of_80_columns(lidardesign, flat, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    design = Path(__file__).parents[2] / "examples" / "hand_written_design.yaml"
    lines = lidardesign("show", design).out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any("nose" in line and "0.250 - 0.400" in line for line in lines)
    assert "all at 0.400 0.000 0.000 m" in "".join(lines)


@pytest.mark.parametrize(("mount", "frame"), [(None, "the world's frame"), ("torso", "the robot's body 'torso'")])
def test_wherever_a_sensor_looks_its_roll_part_and_frame_are_said(lidardesign, tmp_path, mount, frame):
    turned = Pose(np.zeros(3), azimuth_rad=0.5, elevation_rad=0.2, roll_rad=np.pi / 2)
    part = find_part(PART)
    design = replace(part_design(part, turned, name="turned"), mount=mount)
    save_design(design, tmp_path / "turned.yaml")
    console = Console(file=io.StringIO(), width=120)
    show_fit({"error_estimates": {}}, design, [], console, verbose=False)
    shown = lidardesign("show", tmp_path / "turned.yaml").out
    pages = [html.unescape(page) for page in (sensors_section([design]), Design(design)._repr_html_())]
    for text in (shown, console.file.getvalue(), *pages):
        for word in ("roll", "90.00", PART, frame):
            assert word in text
    for found in (lidardesign("show", tmp_path / "turned.yaml", "--json").json, Design(design).as_dict()):
        assert (found["frame"], found["sensors"][0]["part"]) == (mount or "world", PART)
        assert found["sensors"][0]["boresight"]["roll_rad"] == pytest.approx(np.pi / 2)
    upright = replace(design, sensors=(replace(design.sensors[0], roll_rad=0.0),))
    assert difference(*paired_sensors(upright, design)[0])["difference"]["roll_deg"] == pytest.approx(90)


def test_every_pinned_place_gets_a_sensor(lidardesign, flat):
    each = "each=[{}, {}, {gate: {width_m: {max: 0.3}}}]"
    made = lidardesign("constrain", flat, "--layout", "even", "--set", each, "--json").json
    assert len(made["sensors"]) == 3


@pytest.mark.parametrize("decided", ["raycast", "off", None])
def test_a_pinned_origin_is_weighted_with_the_visibility_that_the_run_decided_on(flat, monkeypatch, decided):
    from lidardesign import open_run
    from lidardesign.fitting.request import RunTarget
    from lidardesign.run.manifest import note

    asked = []

    class Flat:
        def log_density(self, points):
            return np.zeros(len(points))

    def prepare(scenes, config, *, visibility=None, compiled=True):
        assert not compiled
        asked.append((len(scenes), visibility))
        return Flat(), []

    monkeypatch.setattr("lidardesign.density.objective.prepare.prepare_target", prepare)
    if decided is not None:
        note(flat, visibility=decided)
    target = RunTarget(open_run(flat))
    assert [target(np.zeros((3, 6))).shape for _ in range(2)] == [(3,), (3,)]
    assert asked == [(FEW_SCENES["train"], decided)]


@pytest.mark.parametrize(("signal", "code"), [(KeyboardInterrupt, 130), (TerminatedError, 143)])
def test_a_signal_before_any_command_has_begun_ends_with_its_code(monkeypatch, capsys, signal, code):
    def interrupted(*_, **__):
        raise signal

    monkeypatch.setattr("lidardesign.cli.main.app", interrupted)
    with pytest.raises(SystemExit) as ended:
        run_program(["show", "run"])
    assert ended.value.code == code
    assert "Traceback" not in capsys.readouterr().err
