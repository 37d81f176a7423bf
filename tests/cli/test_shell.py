"""Habits of the shell: no colour where none is wanted, help that works, clear mistakes, CI."""

from __future__ import annotations

import importlib.util
import json
import os
import pty
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer
import yaml
from support.command_line import make_run, program, set_options

from lidardesign.cli.main import EXAMPLES, app

ROOT = Path(__file__).parents[2]
CI = ROOT / "examples" / "ci"
COLOUR = re.compile(r"\x1b\[[0-9;]*(?:3[0-8]|4[0-8]|9[0-7]|10[0-7])[;m]")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run with a design."""
    from lidardesign.cli.main import run

    folder = make_run(tmp_path_factory.mktemp("runs") / "flat")
    with pytest.raises(SystemExit):
        run(["fit", str(folder), "--layout", "even", "--sensors", "2", "--rays", "9", "--quiet", "--json"])
    return folder


@pytest.fixture
def flat(fitted, tmp_path):
    """A copy of it that a test may write to."""
    return shutil.copytree(fitted, tmp_path / "flat")


def test_rays_go_to_a_device_whole(lidardesign, flat):
    design = flat / "designs" / "fit.yaml"
    assert lidardesign("export", design, "--format", "csv", "--out", "rays.csv").code == 0
    command = [sys.executable, "-m", "lidardesign", "export", design, "--format", "csv", "--out", "/dev/stdout"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == Path("rays.csv").read_text()


def on_terminal(*arguments, **environment):
    """What the program shows on a terminal."""
    try:
        ours, theirs = pty.openpty()
    except OSError as error:
        pytest.skip(f"no pseudo-terminal can be opened: {error.strerror}")
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


def test_colours_are_left_out_where_they_are_not_wanted(tmp_path, monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    broken = tmp_path / "broken-1.0.dist-info"  # what is wrong with a plugin is red
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (broken / "entry_points.txt").write_text("[lidardesign.tasks]\nbroken = no_such_module:Task\n")
    assert COLOUR.search(on_terminal("tasks", "list", PYTHONPATH=str(tmp_path)))
    assert not COLOUR.search(on_terminal("tasks", "list", PYTHONPATH=str(tmp_path), NO_COLOR="1"))


@pytest.mark.parametrize(("arguments", "named"), [("help", ""), ("fit", " fit"), ("", "")])
def test_a_command_line_that_lacks_something_names_the_help(lidardesign, arguments, named):
    result = lidardesign(*arguments.split())
    assert (result.code, result.out) == (2, "")
    assert f"lidardesign{named} --help" in result.err


def commands():
    root = typer.main.get_command(app)
    for name, command in root.commands.items():
        for part, inner in getattr(command, "commands", {"": command}).items():
            yield f"{name} {part}".strip(), inner


COMMANDS = dict(commands())
NARROW = 80


@pytest.mark.parametrize("name", ["", "tasks", "catalog", "config", *COMMANDS])
def test_help_fits_80_columns_is_not_cut_and_has_examples_and_pages_that_are_there(lidardesign, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", str(NARROW))
    shown = lidardesign(*name.split(), "--help").out
    assert max(len(line) for line in shown.splitlines() if not line.startswith("    in ")) < NARROW
    assert "..." not in shown.replace("ARGS]...", "").replace("}...", "").replace("in...", "")
    if name in COMMANDS:
        assert all(one.param_type_name == "argument" or one.opts[0] in shown for one in COMMANDS[name].params)
        assert all(example in " ".join(shown.split()) for example in EXAMPLES[name])
        pages, folder = re.search(r"See also: (.*)\n +in (.*)", shown).groups()
        assert all((Path(folder) / page).is_file() for page in pages.split(", "))


def examples():
    for lines in EXAMPLES.values():
        yield from (shlex.split(line)[1:] for line in lines)


@pytest.mark.parametrize("words", list(examples()))
def test_an_example_is_parsed_by_the_program(words):
    command = typer.main.get_command(app)
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    command.make_context(command.name, list(words))


def test_the_command_reference_is_the_program_s(monkeypatch):
    specification = importlib.util.spec_from_file_location("command_reference", ROOT / "tools/command_reference.py")
    tool = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(tool)
    monkeypatch.setattr(sys, "argv", ["command_reference.py", "--check"])
    assert tool.main() == 0, "python tools/command_reference.py writes it anew"


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_the_shell_script_fails_with_a_bad_design_and_says_why(gate, tmp_path):
    done = gate("sh design_gate.sh runs/gate 1e-6 runs/gate/designs/fit.yaml", RAYS="9")
    assert done.returncode == 1
    assert "worse than 1e-6 with 9 rays" in done.stdout
    assert (tmp_path / "gate" / "rows.csv").is_file()
    # the design is no better than itself
    done = gate("sh design_gate.sh runs/gate 1e6 runs/gate/designs/fit.yaml", RAYS="9", BASELINE="fit")
    assert done.returncode == 2
    assert "no other design to compare fit with" in done.stderr
    assert "not scored: exit code 2" in done.stdout


def test_the_files_of_the_gate_are_what_the_program_takes(lidardesign, flat):
    assert lidardesign("learn", "flatland", "--config", CI / "lidar.yaml", "--out", "new", "--dry-run").code == 0
    assert lidardesign("constrain", flat, "--constraints", CI / "constraints.yaml", "--rays", 9).code == 0


def test_json_stands_alone_whatever_a_plugin_starts_prints_and_leaves_behind():
    noisy = """
import atexit, os
from lidardesign import task
kept = task.load_task
def load_task(name):
    os.system("echo from a process")
    print("from Python")
    atexit.register(print, "at the end")
    return kept(name)
task.load_task = load_task
"""
    for name, code in (("flatland", 0), ("no_such_task", 2)):
        process = program("tasks", "show", name, "--json", before=noisy)
        out, err = process.communicate()
        assert process.returncode == code
        assert json.loads(out)["schema_version"] == 1
        told = err.decode()
        assert [words for words in ("from a process", "from Python", "at the end") if words not in told] == [], told


def test_learning_in_silence_prints_the_path_of_its_run_alone(lidardesign):
    small = ("learning.steps=8", "learning.samples=2000", "learning.coverage_proposals=500", "learning.batch=64")
    words = ["learn", "flatland", "--preset", "draft", *set_options(small)]
    told, quiet = lidardesign(*words, "--out", "told", "-v"), lidardesign(*words, "--out", "quiet", "--quiet")
    assert (told.code, quiet.code) == (0, 0)
    assert "note: " in told.err
    assert (quiet.out, quiet.err) == ("quiet\n", "")
