"""Habits of the shell: - for standard streams, no colour where none is wanted, help that works, clear mistakes, CI."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import os
import pty
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import typer
import yaml
from support.command_line import files_under, make_run, program
from support.tables import each_row

from lidardesign.cli.main import app
from lidardesign.cli.manual import MANUALS
from lidardesign.run.files import STDIO, is_input, offered_input
from lidardesign.run.yaml import load_yaml
from lidardesign.workflow.learn import LearnRequest

ROOT = Path(__file__).parents[2]
CI = ROOT / "examples" / "ci"
COLOUR = re.compile(r"\x1b\[[0-9;]*(?:3[0-8]|4[0-8]|9[0-7]|10[0-7])[;m]")


@pytest.fixture
def given(monkeypatch):
    """A function that puts something on standard input."""

    def give(content):
        stream = io.TextIOWrapper(io.BytesIO(content if isinstance(content, bytes) else content.encode()))
        monkeypatch.setattr(sys, "stdin", stream)

    return give


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run with a design."""
    from lidardesign.cli.main import run

    folder = make_run(tmp_path_factory.mktemp("runs") / "flat")
    with pytest.raises(SystemExit):
        run(["fit", str(folder), "--layout", "grid", "--sensors", "2", "--rays", "9", "--quiet", "--json"])
    return folder


@pytest.fixture
def flat(fitted, tmp_path):
    """A copy of it that a test may write to."""
    return shutil.copytree(fitted, tmp_path / "flat")


def test_constraints_come_from_standard_input(lidardesign, given, flat):
    text = "gate: {width_m: {max: 0.3}}\nbudget: {rays: 40}\n"
    (flat.parent / "few.yaml").write_text(text)
    given(text)
    piped = lidardesign("constrain", flat, "--constraints", "-", "--dry-run", "--json").json
    filed = lidardesign("constrain", flat, "--constraints", "few.yaml", "--dry-run", "--json").json
    assert piped["settings"] == filed["settings"]
    assert piped["settings"]["constraints"]["budget"] == {"rays": 40}


def test_a_configuration_comes_from_standard_input_with_its_paths_from_here(lidardesign, given, tmp_path):
    (tmp_path / "scans").mkdir()
    given("preset: draft\ntask: {folder: scans}\n")
    result = lidardesign("learn", "meshes", "--config", "-", "--dry-run")
    assert f"{tmp_path / 'scans'}: no mesh" in result.err or str(tmp_path / "scans") in result.err
    given("preset: draft\ntask: {variation: 3}\n")
    result = lidardesign("learn", "flatland", "--config", "-", "--dry-run")
    assert result.code == 2
    assert "-:2:19: task.variation" in result.err
    given("preset: draft\n")
    planned = lidardesign("learn", "flatland", "--config", "-", "--time-budget", 900, "--dry-run", "--json").json
    assert planned["settings"]["preset"] == "draft"
    assert planned["reads"] == [{"path": "-", "bytes": None}]


@pytest.mark.parametrize("arguments", ["show -", "export - --format csv --out rays.csv", "evaluate flat -"])
def test_a_design_comes_from_standard_input(lidardesign, given, flat, arguments):
    given((flat / "designs" / "fit.yaml").read_bytes())
    words = (*arguments.split(), *(("--dry-run",) if "evaluate" in arguments else ()))
    result = lidardesign(*words)
    assert result.code == 0, result.err
    assert "stdin" in result.out or "rays.csv" in result.out


def test_mistakes_on_standard_input_are_named_by_place(lidardesign, given, flat):
    for text, words in (("sensors: 3\n", "-:1:1:"), ("", "-"), ("schema_version: 1\nsensors: 3\n", "-:2:10:")):
        given(text)
        result = lidardesign("show", "-")
        assert result.code == 2
        assert result.err.startswith(f"config error: {words}")
        assert "/stdin" not in result.err
    given("budget: {rays: 40}\n")
    result = lidardesign("constrain", "-", "--constraints", "-")
    assert result.code == 2
    assert "-: is a YAML file already, and cannot be a design too" in result.err


def test_a_dash_is_a_name_for_those_who_use_the_library(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-").write_text("x: 1\n")
    assert load_yaml(Path(STDIO)).value == {"x": 1}
    assert not is_input(Path(STDIO))
    with offered_input():
        assert is_input(Path(STDIO))
        assert load_yaml(tmp_path / STDIO).value == {"x": 1}


def test_rays_and_rows_go_to_standard_output_and_words_to_stderr(lidardesign, flat):
    design = flat / "designs" / "fit.yaml"
    lidardesign("export", design, "--format", "csv", "--out", "rays.csv")
    result = lidardesign("export", design, "--format", "csv", "--out", "-")
    assert result.out == Path("rays.csv").read_text()
    assert "wrote - (9 rays)" in result.err
    quiet = lidardesign("export", design, "--format", "csv", "--out", "-", "--quiet")
    assert (quiet.out, quiet.err) == (result.out, "")
    scored = lidardesign("evaluate", flat, "--rays", 9, "--csv", "-")
    rows = list(csv.DictReader(io.StringIO(scored.out)))
    assert {"fit", "uniform", "random", "bounding"} <= {row["design"] for row in rows}
    assert "held-out scenes" in scored.err


def test_binary_rays_go_to_standard_output_but_to_no_terminal(lidardesign, flat, monkeypatch):
    words = ("export", flat / "designs" / "fit.yaml", "--format", "npz", "--out", "-", "--quiet")
    out = io.TextIOWrapper(io.BytesIO())
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", out)
        assert lidardesign(*words).code == 0
    with np.load(io.BytesIO(out.buffer.getvalue())) as arrays:
        assert len(arrays["azimuth_rad"]) == 9
    with monkeypatch.context() as patch:
        patch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
        result = lidardesign(*words)
    assert result.code == 2
    assert "a terminal cannot show it" in result.err


@pytest.mark.parametrize(
    "arguments",
    [
        "export flat/designs/fit.yaml --format csv --out - --json",
        "evaluate flat --csv - --report -",
        "evaluate flat --csv - --json",
        "export flat/designs/fit.yaml --format helios --out -",
        "export - --format csv",
    ],
)
def test_what_cannot_go_to_standard_output_is_refused_before_any_work(lidardesign, given, flat, arguments):
    given((flat / "designs" / "fit.yaml").read_bytes())
    before = files_under(flat)
    result = lidardesign(*arguments.split())
    assert result.code == 2
    assert "standard" in result.err or "folder of files" in result.err
    assert files_under(flat) == before


def on_terminal(*arguments, **environment):
    """What the program shows on a terminal."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "lidardesign", *arguments],
        stdin=theirs, stdout=theirs, stderr=theirs, env={**os.environ, "TERM": "xterm-256color", **environment},
    ) as process:  # fmt: skip
        os.close(theirs)
        shown = b""
        try:
            while part := os.read(ours, 65536):
                shown += part
        except OSError:  # Linux says so when nobody writes there any more
            pass
        process.wait()
    os.close(ours)
    return shown.decode()


def test_colours_are_left_out_where_they_are_not_wanted():
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("NO_COLOR", raising=False)
        assert COLOUR.search(on_terminal("fit", "--help"))
    assert not COLOUR.search(on_terminal("fit", "--help", NO_COLOR="1"))


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["tasks --help"], "lidardesign tasks --help"),
        (["fit runs/face --sensors 4"], "lidardesign fit runs/face --sensors 4"),
        (["lern", "face"], "lidardesign learn face"),
        (["tasks", "shwo", "face"], "lidardesign tasks show face"),
        (["help"], "lidardesign --help"),
        (["help", "fit"], "lidardesign fit --help"),
        (["help", "nothing"], "lidardesign --help"),
        (["--json", "tasks", "list"], "lidardesign tasks list --json"),
        (["--seed", "3", "-q", "fit", "runs/face"], "lidardesign fit runs/face --seed 3 -q"),
        (["fit", "run", "--sensor", "3"], "lidardesign fit --help"),
        (["xyzzy"], "lidardesign --help"),
        (["--quiet"], "lidardesign --help"),
    ],
    ids=str,
)
def test_a_command_line_that_is_not_understood_names_one_that_is(lidardesign, arguments, hint):
    result = lidardesign(*arguments)
    assert result.code == 2
    assert result.out == "" or "--json" in arguments
    assert f"  try: {hint}\n" in result.err


def commands():
    root = typer.main.get_command(app)
    for name, command in root.commands.items():
        for part, inner in getattr(command, "commands", {"": command}).items():
            yield f"{name} {part}".strip(), inner


@pytest.mark.parametrize(("name", "command"), list(commands()), ids=lambda one: one if isinstance(one, str) else "")
def test_every_command_has_a_manual_whose_examples_are_understood(lidardesign, name, command):
    manual = MANUALS[name]
    assert manual.examples
    shown = lidardesign(*name.split(), "--help").out
    assert "Exit codes:\n" in shown
    for page in manual.see:
        assert (ROOT / "docs" / page).is_file()


def examples():
    for name, manual in MANUALS.items():
        for example in manual.examples:
            for part in re.split(r"\s[|]\s", example):
                words = shlex.split(re.sub(r"[<>] *\S+", "", part))
                if "lidardesign" in words[:5] and "$(" not in part:
                    yield pytest.param(words[words.index("lidardesign") + 1 :], id=f"{name}: {part}")


@each_row("words", list(examples()))
def test_an_example_is_parsed_by_the_program(words):
    command = typer.main.get_command(app)
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    command.make_context(command.name, list(words))


PLANNED = ("learn", "fit", "constrain", "evaluate", "export")
# These need no plan, or a run that was learned and not only made.
UNPLANNED = ("--list", "--resume", "--accuracy")
RIG = """<sdf version="1.9"><model name="robot"><link name="body">
<sensor name="front" type="gpu_lidar"><pose>0.4 0 0 0 0 3.1</pose><lidar><scan>
<horizontal><samples>8</samples><min_angle>-0.2</min_angle><max_angle>0.2</max_angle></horizontal>
<vertical><samples>8</samples><min_angle>-0.2</min_angle><max_angle>0.2</max_angle></vertical>
</scan><range><min>0.1</min><max>1.0</max></range></lidar></sensor></link></model></sdf>
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the files that examples name: runs with a design each, constraints, a configuration, meshes."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "scans").mkdir()
    cube = trimesh.creation.box((100, 100, 100))
    for name in ("one", "two"):
        cube.export(folder / "scans" / f"{name}.stl")
    for name in ("face", "warehouse", "arm"):
        make_run(folder / "runs" / name, count=1000, task=name)
        (folder / "runs" / name / "designs").mkdir()
        for design in ("free", "track"):
            text = (ROOT / "examples" / "hand_written_design.yaml").read_text(encoding="utf-8")
            text += "\nprovenance: {run: ..}\n"
            (folder / "runs" / name / "designs" / f"{design}.yaml").write_text(text)
    (folder / "buyable.yaml").write_text("gate: {width_m: {max: 0.1}}\n")
    (folder / "robot.sdf").write_text(RIG)
    return folder


def planned_examples():
    return [one for one in examples() if one.values[0][0] in PLANNED and not set(one.values[0]) & set(UNPLANNED)]


@pytest.mark.parametrize("words", planned_examples())
def test_an_example_can_be_done_where_its_files_are(lidardesign, place, monkeypatch, words):
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    text = "budget: {rays: 196}\n" if "--constraints" in words else "{task_name: face, preset: draft}\n"
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    if words[0] == "learn":  # the runs that other examples work on are there already
        words = [*words, "--out", "runs/new"]
        monkeypatch.setattr(LearnRequest, "forecast", lambda *_: None)  # takes real steps
    result = lidardesign(*words, "--dry-run")
    assert result.code == 0, result.err
    assert sorted(place.rglob("*")) == before


def test_the_command_reference_is_the_program_s(monkeypatch):
    specification = importlib.util.spec_from_file_location("command_reference", ROOT / "tools/command_reference.py")
    tool = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(tool)
    monkeypatch.setattr(sys, "argv", ["command_reference.py", "--check"])
    assert tool.main() == 0, "python tools/command_reference.py writes it anew"


def test_every_exit_code_that_a_manual_names_is_explained_in_one_place():
    page = (ROOT / "docs" / "shell.md").read_text(encoding="utf-8")
    explained = {int(code) for code in re.findall(r"^\| (\d+) \|", page, re.MULTILINE)}
    named = {code for manual in MANUALS.values() for code in manual.exits or ()}
    assert named | {0, 2, 3, 70, 130, 141, 143} <= explained


@pytest.fixture
def gate(fitted, tmp_path):
    """A checkout with the files of the CI example and a run that was learned before; its shell."""
    for name in ("design_gate.sh", "lidar.yaml", "constraints.yaml"):
        shutil.copy(CI / name, tmp_path)
    shutil.copytree(fitted, tmp_path / "runs" / "gate")
    (tmp_path / "bin").mkdir()
    script = tmp_path / "bin" / "lidardesign"
    script.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m lidardesign "$@"\n')
    script.chmod(0o755)

    def run(command, **environment):
        path = f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"
        return subprocess.run(
            ["bash", "-eo", "pipefail", "-c", command],
            capture_output=True, text=True, check=False, cwd=tmp_path, env={**os.environ, "PATH": path, **environment},
        )  # fmt: skip

    return run


def test_the_workflow_passes_with_a_good_design_and_keeps_what_can_be_looked_at(gate, tmp_path):
    workflow = yaml.load((CI / "lidar-design.yml").read_text(), Loader=yaml.BaseLoader)
    (job,) = workflow["jobs"].values()
    steps = [step for step in job["steps"] if "run" in step]
    assert [step["name"] for step in steps if "pip install" in step["run"]] == ["Install"]
    for step in steps:
        if step["name"] != "Install":
            done = gate(step["run"], **{**workflow["env"], "RAYS": "9", "LIMIT": "1e6"})
            assert done.returncode == 0, done.stderr + done.stdout
    assert "good enough: at most 1e6 and better than uniform with 9 rays" in done.stdout
    (kept,) = [step["with"]["path"] for step in job["steps"] if "upload-artifact" in step.get("uses", "")]
    assert {path.name for path in (tmp_path / kept).iterdir()} == {"rows.csv", "result.json", "report.html"}
    assert json.loads((tmp_path / kept / "result.json").read_text())["rows"]


def test_the_shell_script_fails_with_a_bad_design_and_says_why(gate, tmp_path):
    done = gate("sh design_gate.sh runs/gate 1e-6 runs/gate/designs/fit.yaml", RAYS="9")
    assert done.returncode == 1
    assert "worse than 1e-6 with 9 rays" in done.stdout
    assert (tmp_path / "gate" / "rows.csv").is_file()
    # the design is no better than itself
    done = gate("sh design_gate.sh runs/gate 1e6 runs/gate/designs/fit.yaml", RAYS="9", RIVAL="fit")
    assert done.returncode == 2
    assert "no other design to compare fit with" in done.stderr
    assert "not scored: exit code 2" in done.stdout


def test_the_files_of_the_gate_are_what_the_program_takes(lidardesign, flat):
    assert lidardesign("learn", "flatland", "--config", CI / "lidar.yaml", "--out", "new", "--dry-run").code == 0
    assert lidardesign("constrain", flat, "--constraints", CI / "constraints.yaml", "--dry-run").code == 0


def test_json_stands_alone_whatever_a_plugin_starts_prints_and_leaves_behind():
    noisy = """
import atexit, os
from lidardesign import registry
kept = registry.load_task
def load_task(name):
    os.system("echo from a process")
    print("from Python")
    atexit.register(print, "at the end")
    return kept(name)
registry.load_task = load_task
"""
    for name, code in (("flatland", 0), ("no_such_task", 2)):
        process = program("tasks", "show", name, "--json", before=noisy)
        out, err = process.communicate()
        assert process.returncode == code
        assert json.loads(out)["schema_version"] == 1
        assert all(words in err.decode() for words in ("from a process", "from Python", "at the end"))


def test_quiet_commands_print_the_path_of_their_result_alone(lidardesign):
    small = ("learning.steps=8", "learning.samples=2000", "learning.coverage_proposals=500", "learning.batch=64")
    words = ["learn", "flatland", "--preset", "draft", *(word for one in small for word in ("--set", one))]
    told, quiet = lidardesign(*words, "--out", "told", "-v"), lidardesign(*words, "--out", "quiet", "--quiet")
    assert (told.code, quiet.code) == (0, 0)
    assert "note: " in told.err
    assert (quiet.out, quiet.err) == ("quiet\n", "")
