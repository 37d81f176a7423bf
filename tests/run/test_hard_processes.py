"""Kills, full disks, two writers, closed streams and signals."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.command_line import files_under, make_run, program, set_options

from lidardesign.run import files as lock
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import start_manifest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="faults of processes are made with POSIX calls")
# The least that can be learned.
TINY = (
    "train=2", "learning.steps=20", "learning.batch=32", "learning.layers=1", "learning.hidden=8", "learning.bins=8",
    "learning.samples=1000", "learning.balance_proposals=256", "learning.coverage_proposals=256",
)  # fmt: skip
GONE = 2**22 + 1  # beyond the largest process id that Linux gives


@pytest.fixture
def open_folder():
    """A folder that other users may enter, as pytest's may not."""
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, 0o755)
        yield Path(name)


@pytest.mark.hard_case(
    "38",
    "kill -9, a full disk or a read-only folder during a write; two processes in one run folder",
    done="files take their names by a rename when they are whole",
)
class TestKillsFullDisksAndTwoWriters:
    def test_a_run_in_a_read_only_folder_is_not_fitted_and_says_why(self, open_folder, lidardesign, monkeypatch):
        monkeypatch.chdir(open_folder)
        run, fit = make_run(Path("run"), count=1000), ("--layout", "even", "--sensors", 1, "--json")
        assert lidardesign("fit", shutil.copytree(run, "other"), *fit).code == 0  # what is imported is imported
        before, user = files_under(run), os.geteuid()
        run.chmod(0o555)
        if user == 0:  # no permission stops root
            os.seteuid(65534)
        try:
            ended = lidardesign("fit", run, *fit)
        finally:
            os.seteuid(user)
            run.chmod(0o755)
        assert ended.code == 3, ended.err
        assert "cannot be written: " in ended.json["error"]["message"], ended.out
        assert files_under(run) == before

    def test_a_second_writer_is_told_who_writes_and_changes_nothing(self, tmp_path, lidardesign, monkeypatch):
        monkeypatch.setattr("lidardesign.api.design.WAIT_S", 0.05)
        run = make_run(tmp_path / "run", count=1000)
        before = files_under(run)
        with run_lock(run):
            result = lidardesign("fit", run, "--layout", "even", "--sensors", 1, "--json")
            assert result.code == 2
            assert f"process {os.getpid()} on" in result.json["error"]["message"]
            assert "wait for it" in result.json["error"]["hint"]
        assert files_under(run) == before

    @pytest.mark.parametrize("resume", [[], ["--resume"]])
    def test_of_two_starts_at_one_moment_the_slower_takes_nothing_away(self, tmp_path, lidardesign, resume):
        run = tmp_path / "run"
        run.mkdir()
        with run_lock(run):  # the faster one has locked the folder, and its configuration is not there yet
            start_manifest(run, command=["lidardesign", "learn"], seed=3)
            before = files_under(run)
            result = lidardesign("learn", "flatland", "--preset", "draft", "--out", run, *resume)
            assert result.code == 2, result.err
            assert "is writing this run" in result.err
            assert files_under(run) == before

    @pytest.mark.parametrize("left", ["nothing", "lock", "manifest"])
    @pytest.mark.parametrize("resume", [[], ["--resume"]])
    def test_a_start_that_was_killed_before_it_began_is_started_anew(
        self, tmp_path, lidardesign, monkeypatch, left, resume
    ):
        run = tmp_path / "run"
        run.mkdir()
        if left != "nothing":
            (run / f".lock.{GONE}.0a.tmp").write_text("half")
            (run / lock.FILE_NAME).write_text(json.dumps({"pid": GONE, "host": socket.gethostname()}))
        if left == "manifest":
            start_manifest(run, command=["lidardesign", "learn"], seed=99)
        monkeypatch.setattr(FlatlandTask, "scenes", lambda *_: (_ for _ in ()).throw(RuntimeError("as far as this")))
        result = lidardesign("learn", "flatland", "--preset", "draft", "--out", run, *resume, "--json")
        assert (result.code, "as far as this" in result.err) == (6, True), result.err
        assert files_under(run) == {}

    def test_a_disk_that_fills_after_the_last_step_of_learning_keeps_the_checkpoint_and_says_how_to_go_on(
        self, tmp_path, lidardesign, monkeypatch
    ):
        rename, learn = os.replace, ("learn", "flatland", "--preset", "draft", "--out", "run", *set_options(TINY))

        def full(source, target):
            if Path(target).name == "samples.npz":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            rename(source, target)

        with monkeypatch.context() as patched:
            patched.setattr("lidardesign.run.files.os.replace", full)
            result = lidardesign(*learn, "--json")
        assert result.code == 3
        error = result.json["error"]
        assert (error["where"], error["message"]) == ("run/samples.npz", "cannot be written: No space left on device")
        assert "run/checkpoint.safetensors" in error["hint"]
        assert "--resume" in error["hint"]
        # a log that was spoilt as well: its readable lines are kept
        with (tmp_path / "run" / "progress.jsonl").open("ab") as file:
            file.write(bytes(range(256)))
        assert lidardesign(*learn, "--resume").code == 0
        rows = [json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").read_text().splitlines()]
        assert [row["step"] for row in rows] == [10, 20]

    @pytest.mark.parametrize("damage", ["cut between sensors", "cut inside", "one digit"])
    def test_a_design_that_is_not_as_it_was_written_says_so_wherever_it_is_used(self, tmp_path, lidardesign, damage):
        run = make_run(tmp_path / "run", count=1000)
        assert lidardesign("fit", run, "--layout", "even", "--sensors", 2).code == 0
        design = run / "designs" / "fit.yaml"
        text = design.read_text()
        second = text.index("- name", text.index("- name") + 1)
        design.write_text(
            {
                "cut between sensors": text[:second],
                "cut inside": text[: second + 40],
                "one digit": text.replace("weight: 0.", "weight: 0.1", 1),
            }[damage]
        )
        size = design.stat().st_size
        said = "was changed after it was written" if damage == "one digit" else f"is truncated: {size} of"
        evaluate = ("evaluate", run, "--rays", 4, "--set", "test=1", "--baseline", "none")
        for command in (("show", design), evaluate, ("export", design, "--format", "csv", "--rays", 5)):
            result = lidardesign(*command)
            assert result.code == (2 if damage == "cut inside" else 0), result.err
            assert said in result.err

    @pytest.mark.hard_case(
        "P3",
        "The program is killed at any time",
        done="the last complete checkpoint is there and verifies",
    )
    @pytest.mark.slow
    def test_kills_at_steps_spread_over_learn_fit_and_evaluate_are_all_recovered(self, tmp_path):
        environment = {**os.environ, "LONG_RUNS": str(tmp_path)}  # what was done before does not count
        plugins = ("tests.conftest", "tests.support.short_kills", "benchmarks.soak.long_runs", "no:cacheprovider")
        words = [word for plugin in plugins for word in ("-p", plugin)]
        words += ["-m", "long", "-k", "not tolerance", "benchmarks/soak/kills.py", "--amount", "5"]
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *words],
            cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert "4 passed" in ended.stdout


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
# What a library or a plugin makes of an interruption, in the middle of its work.
SWALLOWED = {
    "passes over it": "try: time.sleep(60)\n    except BaseException: pass",
    "keeps it": "try: time.sleep(60)\n    except BaseException as error: kept.append(error)",
    "raises another error": "try: time.sleep(60)\n    except BaseException: raise ValueError from None",
    "is in a finalizer": "type('Odd', (), {'__del__': lambda self: time.sleep(60)})()",
    "goes on for ever": "while True:\n        try: time.sleep(60)\n        except BaseException: pass",
    "is taken down for ever": "try: time.sleep(60)\n    finally: time.sleep(60)",
}
HOSTILE = """
import time
from lidardesign_tasks.flatland import FlatlandTask
kept, scenes = [], FlatlandTask.scenes
def hostile(*given):
    open("working", "w").close()
    {}
    return scenes(*given)
FlatlandTask.scenes = hostile
"""
# What a plugin leaves running, which program is given, and its exit code; the last is an error of ours.
LEFT = {
    "a thread": ("import threading, time; threading.Thread(target=time.sleep, args=(60,)).start()", 0),
    "work at the exit": ("import atexit, time; atexit.register(time.sleep, 60)", 0),
    "a finalizer": ("import time; Odd = type('Odd', (), {'__del__': lambda self: time.sleep(60)}); odd = Odd()", 0),
    "nothing": ("import lidardesign.cli.main as main; main._invoke = lambda *_: 1 / 0", 70),
}
LONG = ("learning.steps=100000", "learning.batch=64", "learning.checkpoint_seconds=0.01")
CLOSED = "import os; os.close({}); os.close({}); "


@pytest.mark.hard_case(
    "40",
    "Stdout closed early, no terminal, NO_COLOR, a locale that is not UTF-8, odd paths, SIGTERM and Ctrl-C",
    done="streams that nobody reads end the program quietly or swallow what is said",
)
class TestStreamsLocalesAndSignals:
    def test_a_closed_pipe_ends_quietly(self, tmp_path):
        (tmp_path / "rays.csv").write_text("azimuth_rad,elevation_rad,gate_end_m\n" + 9000 * "0.1,0.1,1\n")
        export = ["export", "rays.csv", "--format", "csv", "--out", "/dev/stdout", "--quiet"]
        for arguments, read in ((["tasks", "show", "flatland", "--json"], 0), (["--help"], 0), (export, 1)):
            process = program(*arguments, cwd=tmp_path)
            process.stdout.read(read)
            process.stdout.close()
            assert process.wait() == 141
            assert process.stderr.read() == b""
            process.stderr.close()

    def test_notes_that_nobody_reads_any_more_do_not_end_the_work(self, tmp_path):
        make_run(tmp_path / "run", count=1000)
        process = program("fit", "run", "--layout", "even", "--sensors", 2, "--json", cwd=tmp_path)
        process.stderr.close()
        out, _ = process.stdout.read(), process.stdout.close()
        assert process.wait() == 0
        assert json.loads(out)["satisfied"] is True

    def test_an_error_that_nobody_reads_keeps_its_exit_code(self, tmp_path):
        process = program("fit", "absent", cwd=tmp_path)
        process.stderr.close()
        out, _ = process.stdout.read(), process.stdout.close()
        assert (process.wait(), out) == (3, b"")

    @pytest.mark.parametrize("closed", [(0, 1), (1, 2)])
    def test_streams_that_were_never_open_are_no_place_for_files(self, tmp_path, closed):
        make_run(tmp_path / "run", count=1000)
        fit = ("fit", "run", "--layout", "even", "--sensors", 1)
        process = program(*fit, cwd=tmp_path, stdin=subprocess.DEVNULL, before=CLOSED.format(*closed))
        out, err = process.communicate()
        assert process.returncode == 0, err
        assert b"Traceback" not in out + err
        assert (tmp_path / "run" / "designs" / "fit.yaml").read_bytes().startswith(b"schema_version")

    def test_any_output_encoding_works_and_no_colour_is_written_to_a_pipe(self, tmp_path):
        environment = {**os.environ, "PYTHONIOENCODING": "ascii", "NO_COLOR": "1"}
        process = program("tasks", "list", env=environment, cwd=tmp_path)
        out, err = process.communicate()
        assert process.returncode == 0, err
        assert b"flatland" in out
        assert b"\x1b[" not in out

    def test_a_run_in_a_folder_of_any_name_is_fitted_in_a_locale_that_has_no_such_letters(self, tmp_path):
        name = os.fsdecode("with spaces, größe 測 and no UTF-8 ".encode() + b"\xff")
        run = make_run(tmp_path / "made", count=1000).rename(tmp_path / name)
        environment = {**os.environ, "LC_ALL": "C"}
        # an editable installation, in such a locale, is found in a folder of plain letters only
        folders = [str(Path(sys.modules[name].__file__).parents[1]) for name in ("lidardesign", "lidardesign_tasks")]
        environment["PYTHONPATH"] = os.pathsep.join(folders)
        # numba compiles nothing from another folder where Python itself is told to keep to such letters
        if environment["PYTHONPATH"].isascii():
            environment |= {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
        command = [sys.executable, "-m", "lidardesign", "fit", name, "--layout", "even", "--sensors", "1", "--json"]
        ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=False)
        assert ended.returncode == 0, ended.stderr
        assert json.loads(ended.stdout)["design"].endswith("/designs/fit.yaml")
        assert (run / "designs" / "fit.yaml").is_file()

    def test_a_report_of_a_folder_whose_name_is_no_utf_8_is_written(self, tmp_path, lidardesign, monkeypatch):
        name = os.fsdecode(b"no utf-8 \xff")
        make_run(tmp_path / "made", count=1000).rename(tmp_path / name)
        assert lidardesign("fit", name, "--layout", "even", "--sensors", 1).code == 0
        monkeypatch.setattr(sys, "argv", ["lidardesign", "evaluate", name])
        result = lidardesign("evaluate", name, "--rays", 4, "--set", "test=1", "--report", f"{name}/page.html")
        assert result.code == 0, result.err
        assert "\\udcff" in (tmp_path / name / "page.html").read_text(encoding="utf-8")

    def test_a_path_that_no_file_can_hold_is_a_mistake_with_its_key(self, tmp_path, lidardesign):
        folder = tmp_path / os.fsdecode(b"scans \xff")
        folder.mkdir()
        (folder / "tetrahedron.obj").write_text(TETRAHEDRON)
        result = lidardesign("learn", "meshes", "--set", f"folder={folder}", "--out", "run", "--json")
        assert result.code == 2, result.err
        assert "task.folder" in result.json["error"]["where"]
        assert not (tmp_path / "run").exists()

    @pytest.mark.slow
    def test_an_interruption_keeps_the_checkpoint_and_says_how_to_continue(self, tmp_path):
        learn = ("learn", "flatland", "--preset", "draft", "--out", "run", *set_options(LONG), "--json")
        process = program(*learn, cwd=tmp_path)
        while not list((tmp_path / "run").glob("checkpoint*")) and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate()
        assert process.returncode == 143, err
        assert "--resume" in json.loads(out)["error"]["message"]
        assert (tmp_path / "run" / "config.yaml").is_file()
        assert not (tmp_path / "run" / ".lock").exists()
        assert not list((tmp_path / "run").glob(".*.tmp"))

    @pytest.mark.parametrize("case", SWALLOWED)
    def test_a_signal_ends_the_program_whatever_a_plugin_makes_of_it(self, tmp_path, case):
        number, code = ((signal.SIGINT, 130), (signal.SIGTERM, 143))[[*SWALLOWED].index(case) % 2]
        learn = ("learn", "flatland", "--preset", "draft", "--out", "run", "--json")
        process = program(*learn, cwd=tmp_path, before=HOSTILE.format(SWALLOWED[case]))
        while not (tmp_path / "working").exists() and process.poll() is None:
            time.sleep(0.05)
        time.sleep(0.1)
        sent = time.monotonic()
        process.send_signal(number)
        _, err = process.communicate()
        assert process.returncode == code
        assert time.monotonic() - sent < 5
        assert (err.startswith(b"interrupted" if code == 130 else b"terminated"), b"Traceback" in err) == (True, False)

    @pytest.mark.parametrize("case", LEFT)
    def test_the_program_ends_when_all_is_written_whatever_is_left_running(self, tmp_path, case):
        before, code = LEFT[case]
        process = program("tasks", "list", "--json", cwd=tmp_path, before=before)
        out, err = process.communicate(timeout=30)
        assert process.returncode == code, err
        assert code or json.loads(out)["tasks"]
