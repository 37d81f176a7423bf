"""What was worked for is not lost where it cannot be written: outputs are tried first, results shown anyway."""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from support.command_line import caller, files_under, make_run

from lidardesign.run.outputs import CACHE

EVALUATE = ("evaluate", "mine.yaml", "--in", "run", "--rays", 9)
EXPORT = ("export", "mine.yaml", "--format", "csv", "--rays", 9)
LONG = 300 * "x"


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture
def call(capsys, work, monkeypatch):
    call = caller(capsys, work, monkeypatch)
    if not (work / "run").exists():
        make_run(work / "run", count=1000)
        assert call("fit", "run", "--layout", "even", "--sensors", 1).code == 0
        (work / "run" / CACHE).touch()
        (work / "folder").mkdir()
        (work / "file").touch()
        (work / "mine.yaml").write_bytes((work / "run/designs/fit.yaml").read_bytes())
        (work / "link.csv").symlink_to(work / "run" / "config.yaml")
        (work / "twin.csv").hardlink_to(work / "mine.yaml")
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind("socket")
    return call


@pytest.fixture
def idle(monkeypatch):
    """Nothing is worked for."""

    def refuse(*_, **__):
        raise AssertionError("the work has begun")

    monkeypatch.setattr("lidardesign.api.scores.ScoreRequest.score", refuse)
    monkeypatch.setattr("lidardesign.api.export.ExportRequest.write", refuse)
    monkeypatch.setattr("lidardesign.scoring.captures.capture.load_capture", refuse)
    monkeypatch.setattr("lidardesign.api.design.Design.fitted", refuse)


UNWRITABLE = [
    ("folder", "is a folder"),
    (".", "is a folder"),
    ("file/new.csv", "file is a file"),
    ("folder/../file/a/b.csv", "file is a file"),
    (f"{LONG}.csv", "name too long"),
    (f"new/{LONG}/a.csv", "name too long"),
    ("/proc/new.csv", "cannot be written"),
    ("socket", "cannot be written"),
]
TAKEN = [
    ("run/config.yaml", "a file of the run"),
    ("run/manifest.json", "a file of the run"),
    ("run/samples.npz", "a file of the run"),
    (f"run/{CACHE}", "a file of the run"),
    ("run/designs/fit.yaml", "a file of the run"),
    ("folder/../run/config.yaml", "a file of the run"),
    ("link.csv", "a file of the run"),
    ("mine.yaml", "is an input|the design itself"),
    ("twin.csv", "is an input|the design itself"),
]


@pytest.mark.parametrize(
    "command", [(*EVALUATE, "--csv"), (*EXPORT, "--out"), ("capture", "c.npz", "mine.yaml", "--csv")]
)
@pytest.mark.parametrize(("path", "words"), UNWRITABLE + TAKEN)
def test_an_output_that_cannot_be_written_or_is_needed_is_refused_before_the_work(
    call, work, idle, command, path, words
):
    before = files_under(work)
    result = call(*command, path)
    assert result.code == (3 if (path, words) in UNWRITABLE else 2), result.err
    assert any(word in result.err.lower() for word in words.split("|")), result.err
    assert len(result.err.splitlines()) <= 3
    assert files_under(work) == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--csv", "a", "--report", "a"), "--csv and --report: a is the same file"),
        (("--csv", "a", "--report", "folder/../a"), "a is the same file"),
        (("--csv", "a", "--report", "a/b.html"), "a is a folder of --report too"),
        (("--detector", "file", "--csv", "file"), ""),
    ],
)
def test_outputs_that_are_in_each_others_way_are_refused_before_the_work(call, work, idle, options, words):
    before = files_under(work)
    result = call(*EVALUATE, *options)
    assert result.code in (2, 3)
    assert words in result.err
    assert files_under(work) == before


def test_devices_and_places_beside_a_runs_files_may_be_written(call):
    for options in (("--csv", "/dev/null", "--report", "/dev/null"), ("--csv", "run/scores.csv")):
        assert call(*EVALUATE, *options).code == 0


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_the_file_that_a_stream_goes_to_is_no_output(call, work, stream):
    call("tasks", "list")  # makes the run
    with open(work / "both.csv", "w") as file:
        ended = program_ended(*EVALUATE, "--csv", "both.csv", folder=work, **{stream: file})
    text = ended.stderr or (work / "both.csv").read_text()
    assert ended.returncode == 2
    assert f"both.csv is where standard {'output' if stream == 'stdout' else 'error'} goes" in text


def program_ended(*arguments, folder, **streams):
    code = f"from lidardesign.cli.main import run; run({[str(argument) for argument in arguments]!r})"
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    places = [Path(__file__).parents[2], Path(__file__).parents[2] / "tasks"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places))}
    return subprocess.run([sys.executable, "-c", code], text=True, check=False, cwd=folder, env=environment, **streams)


FAILING = {
    "a full page beside a CSV file": ("--csv", "scores.csv", "--report", "/dev/full"),
    "a full CSV file beside a page": ("--csv", "/dev/full", "--report", "scores.html"),
}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device /dev/full")
@pytest.mark.parametrize("case", FAILING)
def test_scores_are_shown_and_other_files_written_where_one_file_cannot(call, work, case):
    result = call(*EVALUATE, *FAILING[case], "--json")
    assert result.code == 3
    assert len(result.json["rows"]) > 5
    assert "/dev/full: cannot be written: No space left on device" in result.err
    written = [name for name in FAILING[case] if name.startswith("scores.")]
    assert result.json["files"] == written
    for name in written:
        assert "bounding" in (work / name).read_text()
        (work / name).unlink()
    assert "bounding" in call(*EVALUATE, *FAILING[case]).out


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError, RuntimeError])
def test_scores_are_shown_where_a_page_is_interrupted(call, monkeypatch, error):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr("lidardesign.api.scores.Scores.report", refuse)
    result = call(*EVALUATE, "--report", "page.html")
    assert result.code == (130 if error is KeyboardInterrupt else 70)
    assert "bounding" in result.out


@pytest.mark.parametrize("gone", ["run", "."])
def test_scores_are_shown_where_the_run_or_the_working_folder_goes_meanwhile(call, work, tmp_path, monkeypatch, gone):
    import lidardesign.api.scores as workflow

    shutil.copytree(work, tmp_path / "moved", ignore=shutil.ignore_patterns("socket"))
    monkeypatch.chdir(tmp_path / "moved")
    score = workflow.score_designs

    def scored(*arguments, **options):
        shutil.rmtree(tmp_path / "moved" / gone)
        return score(*arguments, **options)

    monkeypatch.setattr(workflow, "score_designs", scored)
    result = call(*EVALUATE, "--csv", "folder/scores.csv", "--json")
    assert len(result.json["rows"]) > 5
    assert result.code == (3 if gone == "." else 0)
    assert (tmp_path / "moved" / "folder" / "scores.csv").exists() == (gone == "run")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device /dev/full")
@pytest.mark.parametrize("form", [[], ["--json"]])
@pytest.mark.parametrize("closed", [False, True])
def test_scores_that_standard_output_does_not_take_are_kept(call, work, tmp_path, monkeypatch, form, closed):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    if closed:
        read, write = os.pipe()
        os.close(read)
    else:
        write = os.open("/dev/full", os.O_WRONLY)
    ended = program_ended(*EVALUATE, *form, folder=work, stdout=write)
    os.close(write)
    assert ended.returncode == (141 if closed else 3)
    (kept,) = tmp_path.glob("lidardesign-*.json")
    assert len(json.loads(kept.read_text())["rows"]) > 5
    assert str(kept) in ended.stderr


def test_a_design_that_its_run_does_not_take_is_kept(call, work, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    fitting = ("fit", "run", "--layout", "even", "--sensors", 1, "--name", "other")
    with monkeypatch.context() as broken:
        broken.setattr("lidardesign.run.files.os.replace", refuse)
        result = call(*fitting)
    assert result.code == 3
    (kept,) = tmp_path.glob("lidardesign-*.yaml")
    assert str(kept) in result.err
    assert call(*fitting).code == 0
    assert kept.read_bytes() == (work / "run" / "designs" / "other.yaml").read_bytes()


def test_a_fit_is_refused_before_it_begins_where_its_run_takes_nothing(call, work, idle):
    (work / "run" / "designs" / "taken.yaml").mkdir()
    result = call("fit", "run", "--layout", "even", "--name", "taken")
    (work / "run" / "designs" / "taken.yaml").rmdir()
    assert result.code == 3
    assert "is a folder" in result.err


def test_a_link_is_written_through(call, work, tmp_path):
    (tmp_path / "far.csv").write_text("old")
    (work / "near.csv").symlink_to(tmp_path / "far.csv")
    assert call(*EXPORT, "--out", "near.csv").code == 0
    assert (work / "near.csv").is_symlink()
    assert (tmp_path / "far.csv").read_text() != "old"


@pytest.mark.parametrize("command", [("init", "flatland"), ("schema", "config")])
@pytest.mark.parametrize(
    ("path", "code", "words"), [*((path, 3, words) for path, words in UNWRITABLE), ("file", 2, "already exists")]
)
def test_a_configuration_goes_to_a_new_file_that_can_be_written(call, work, command, path, code, words):
    result = call("config", *command, "--out", path)
    assert result.code == code
    assert words in result.err.lower()
    assert call("config", *command, "--out", "/dev/null").code == 0
