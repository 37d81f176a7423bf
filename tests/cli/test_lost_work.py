"""What was worked for is not lost where it cannot be written, nor to what a plugin does: results are shown anyway."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.command_line import caller, make_run

EVALUATE = ("evaluate", "mine.yaml", "--in", "run", "--rays", 9, "--set", "test=2", "--baseline", "none")
EXPORT = ("export", "mine.yaml", "--format", "csv", "--rays", 9)
needs_full_device = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device /dev/full")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture
def call(capsys, work, monkeypatch):
    call = caller(capsys, work, monkeypatch)
    if not (work / "run").exists():
        make_run(work / "run", count=1000)
        assert call("fit", "run", "--layout", "even", "--sensors", 1).code == 0
        (work / "folder").mkdir()
        (work / "mine.yaml").write_bytes((work / "run/designs/fit.yaml").read_bytes())
    return call


def test_devices_pages_and_places_beside_a_runs_files_may_be_written(call):
    for options in (
        ("--csv", "/dev/null", "--report", "/dev/null"),
        ("--csv", "run/scores.csv"),
        ("--report", "a.HTM"),
    ):
        assert call(*EVALUATE, *options).code == 0
    for command in (("init", "flatland"), ("schema", "config")):
        assert call("config", *command, "--out", "/dev/null").code == 0


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_the_file_that_a_stream_goes_to_is_no_output(call, work, stream):
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


@needs_full_device
@pytest.mark.parametrize("case", FAILING)
def test_scores_are_shown_and_other_files_written_where_one_file_cannot(call, work, case):
    result = call(*EVALUATE, *FAILING[case], "--json")
    assert result.code == 3
    assert [row["design"] for row in result.json["rows"]] == ["mine"]
    assert "/dev/full: cannot be written: No space left on device" in result.err
    (written,) = (name for name in FAILING[case] if name.startswith("scores."))
    assert result.json["files"] == [written]
    assert "mine" in (work / written).read_text()


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt, 130), (MemoryError, 5), (RuntimeError, 70)])
def test_scores_are_shown_where_a_page_is_interrupted(call, monkeypatch, error, code):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr("lidardesign.api.scores.Scores.report", refuse)
    result = call(*EVALUATE, "--report", "page.html")
    assert result.code == code
    assert "held-out" in result.out


@pytest.mark.parametrize("gone", ["run", "."])
def test_scores_are_shown_where_the_run_or_the_working_folder_goes_meanwhile(call, work, tmp_path, monkeypatch, gone):
    import lidardesign.api.scores as workflow

    shutil.copytree(work, tmp_path / "moved")
    monkeypatch.chdir(tmp_path / "moved")
    score = workflow.score_designs

    def scored(*arguments, **options):
        shutil.rmtree(tmp_path / "moved" / gone)
        return score(*arguments, **options)

    monkeypatch.setattr(workflow, "score_designs", scored)
    result = call(*EVALUATE, "--csv", "folder/scores.csv", "--json")
    assert len(result.json["rows"]) == 1
    assert result.code == 3
    assert (tmp_path / "moved" / "folder" / "scores.csv").exists() == (gone == "run")


@needs_full_device
@pytest.mark.parametrize(("form", "closed"), [([], True), (["--json"], False)])
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
    assert len(json.loads(kept.read_text())["rows"]) == 1
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


def test_a_link_is_written_through(call, work, tmp_path):
    (tmp_path / "far.csv").write_text("old")
    (work / "near.csv").symlink_to(tmp_path / "far.csv")
    assert call(*EXPORT, "--out", "near.csv").code == 0
    assert (work / "near.csv").is_symlink()
    assert (tmp_path / "far.csv").read_text() != "old"


def fork():
    if child := os.fork():
        os.waitpid(child, 0)


@pytest.mark.parametrize(
    ("does", "code"), [(lambda: os._exit(0), 6), (lambda: os.chdir("/"), 0), (lambda: os.umask(0o777), 0), (fork, 0)]
)
def test_scoring_neither_ends_nor_moves_nor_multiplies_the_program(call, work, monkeypatch, tmp_path, does, code):
    scores = FlatlandTask.score
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(FlatlandTask, "score", lambda *given: (does(), scores(*given))[1])
    result = call("evaluate", work / "run", "--rays", 3, "--baseline", "none", "--set", "test=2", "--csv", "scores.csv")
    with open("ends", "a") as ends:
        ends.write(f"{os.getpid()}\n")
    assert (tmp_path / "ends").read_text() == f"{os.getpid()}\n"
    assert result.code == code, result.err
    assert [path.stat().st_mode & 0o600 for path in tmp_path.glob("*.csv")] == [0o600] * (code == 0)


@pytest.mark.parametrize(
    "arguments",
    [
        (*EVALUATE, "--csv", "{}/deep/rows.csv"),
        ("export", "mine.yaml", "--format", "csv", "--rays", 9, "--out", "{}/rays.csv"),
        ("config", "init", "flatland", "--out", "{}/flat.yaml"),
    ],
)
def test_a_folder_that_is_made_for_a_file_is_told_once(call, arguments):
    name = f"made-{arguments[0]}"
    words = [str(word).format(name) for word in arguments]
    result, again = call(*words), call(*words[:-1], words[-1].replace("flat", "two"))
    assert result.code == 0, result.err
    (note,) = (line for line in result.err.splitlines() if "does not exist yet" in line)
    assert f"the folder {name} does not exist yet" in note
    assert "does not exist yet" not in again.err
