"""Cases 38 to 40: kills, full disks, two writers, broken plugins, closed streams and signals."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pty
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.command_line import files_under, make_run, program
from support.hard_cases import hard_case

from lidardesign import registry
from lidardesign.config import load_run_config, save_run_config
from lidardesign.errors import PluginError
from lidardesign.run import child
from lidardesign.run import files as lock
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import start_manifest
from lidardesign.task import Score

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="faults of processes are made with POSIX calls")
OLD = b"old " * 2000
# The least that can be learned.
TINY = (
    "train=2", "learning.steps=20", "learning.batch=32", "learning.layers=1", "learning.hidden=8", "learning.bins=8",
    "learning.samples=1000", "learning.balance_proposals=256", "learning.coverage_proposals=256",
)  # fmt: skip
GONE = 2**22 + 1  # beyond the largest process id that Linux gives
# Python that has imported what it needs before anything is limited, as it writes files of its own
QUIET = "import sys; sys.dont_write_bytecode = True; "


def script(text: str, *arguments: object, **options) -> subprocess.CompletedProcess:
    """A Python process of its own."""
    command = [sys.executable, "-c", QUIET + text, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False, **options)


FULL_DISK = """
import resource
from pathlib import Path
from lidardesign.errors import DataError
from lidardesign.run.files import write_atomic
resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
try:
    write_atomic(Path(sys.argv[1]), b"new " * 3000)
except DataError as error:
    print(error)
"""
# Fits one run to have everything imported; then another as nobody in particular: no permission stops root.
READ_ONLY = """
import contextlib, os
from lidardesign.cli.main import run
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(sys.stderr):
    run(["fit", sys.argv[1], "--layout", "even", "--sensors", "1", "--json"])
if os.geteuid() == 0:
    os.setuid(65534)
run(["fit", sys.argv[2], "--layout", "even", "--sensors", "1", "--json"])
"""


@pytest.fixture
def open_folder():
    """A folder that other users may enter, as pytest's may not."""
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, 0o755)
        yield Path(name)


@hard_case(
    "38",
    "kill -9, a full disk or a read-only folder during a write; two processes in one run folder",
    done="files take their names by a rename when they are whole; one writer per run, whose lock outlives no kill; "
    "what a kill left is removed by the next writer",
)
class TestKillsFullDisksAndTwoWriters:
    def test_a_disk_that_fills_during_a_write_leaves_the_old_file_and_a_message(self, tmp_path):
        (tmp_path / "file").write_bytes(OLD)
        ended = script(FULL_DISK, tmp_path / "file")
        assert f"{tmp_path / 'file'}: cannot be written: File too large" in ended.stdout
        assert "space left" in ended.stdout
        assert files_under(tmp_path) == {"file": OLD}

    def test_a_run_in_a_read_only_folder_is_not_fitted_and_says_why(self, open_folder, tmp_path):
        run = make_run(open_folder / "run", count=1000)
        run.chmod(0o555)
        before = files_under(run)
        ended = script(READ_ONLY, shutil.copytree(run, tmp_path / "other"), run)
        run.chmod(0o755)
        assert ended.returncode == 3, ended.stderr
        assert json.loads(ended.stdout)["error"]["message"] in (
            "cannot be written: Permission denied", "cannot be written: Read-only file system",
        )  # fmt: skip
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

    def test_a_run_to_a_tolerance_is_resumed_by_the_command_that_started_it(self, tmp_path, lidardesign, monkeypatch):
        run = make_run(tmp_path / "run", count=1000)
        task, config = load_run_config(run)
        learning = config.learning.model_copy(update={"misplaced": 0.1, "steps": 400})
        save_run_config(replace(config, learning=learning), run)
        monkeypatch.setattr(FlatlandTask, "scenes", lambda *_: (_ for _ in ()).throw(RuntimeError("as far as this")))
        again = ("learn", task.name, "--preset", "draft", "--out", run, "--tolerance", 0.1, "--resume", "--set")
        assert "as far as this" in lidardesign(*again, "learning.steps=400").err
        other = lidardesign(*again, "learning.steps=500")
        assert (other.code, "learning.steps = 400, not 500" in other.err) == (2, True)

    def test_a_run_that_was_only_started_is_no_density_yet_and_says_who_is_at_it(self, tmp_path, lidardesign):
        run = make_run(tmp_path / "run", count=1000)
        manifest = json.loads((run / "manifest.json").read_text())
        del manifest["files"]["samples.npz"]
        (run / "manifest.json").write_text(json.dumps(manifest))
        (run / "samples.npz").unlink()
        assert "--resume" in lidardesign("fit", run).err
        with run_lock(run):
            assert f"process {os.getpid()}" in lidardesign("fit", run).err

    def test_a_disk_that_fills_after_the_last_step_of_learning_keeps_the_checkpoint_and_says_how_to_go_on(
        self, tmp_path, lidardesign, monkeypatch
    ):
        rename, options = os.replace, [word for setting in TINY for word in ("--set", setting)]

        def full(source, target):
            if Path(target).name == "samples.npz":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            rename(source, target)

        learn = ("learn", "flatland", "--preset", "draft", "--out", "run", *options)
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
        export = ("export", design, "--format", "csv", "--rays", 5)
        for command in (("show", design), ("evaluate", run, "--rays", 4, "--set", "test=1"), export):
            result = lidardesign(*command)
            assert result.code == (2 if damage == "cut inside" else 0), result.err
            assert said in result.err

    @pytest.mark.slow
    def test_kills_at_steps_spread_over_learn_fit_and_evaluate_are_all_recovered(self, tmp_path):
        environment = {**os.environ, "LONG_RUNS": str(tmp_path)}  # what was done before does not count
        options = "-p benchmarks.soak.long_runs -p no:cacheprovider -m long benchmarks/soak/kills.py --amount 8"
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *options.split()],
            cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert "8 passed" in ended.stdout


GOOD = """
from lidardesign.task import Defaults, Metric, Score, TaskConfig

class Task:
    name = "NAME"
    summary = "a task that keeps the contract"
    api_version = 1
    Config = TaskConfig
    metric = Metric("error", "mm", "lower", 100.0, 0.1)
    defaults = Defaults()
    def space(self, config): ...
    def scenes(self, config, split, seed): ...
    def score(self, scene, returns): ...
"""
# How a plugin breaks when it is imported, and what is said of it.
BROKEN = {
    "lacks_a_library": ("import a_module_that_is_not_there", "ModuleNotFoundError"),
    "raises": ("raise RuntimeError('no licence')", "no licence"),
    "raises_no_exception": ("class Odd(BaseException): pass\nraise Odd('odd')", "Odd: odd"),
    "leaves": ("raise SystemExit(3)", "exit 3"),
    "is_of_another_version": (GOOD.replace("api_version = 1", "api_version = 99"), "version 99"),
    "exits_hard": ("import os\nos._exit(7)", "tried to end the program (exit 7)"),
    "raises_when_asked": (GOOD.replace("metric = Metric", "metric = property(lambda self: 1 / 0)\n    was = Metric"),
                          "ZeroDivisionError"),
}  # fmt: skip
# Beyond what Python itself can end: only another process can.
FATAL = {
    "sleeps": ("import time\ntime.sleep(600)", "was not imported within 0.3 s"),
    "swallows": ("import time\nwhile True:\n    try: time.sleep(600)\n    except BaseException: pass",
                 "was not imported within 0.3 s"),
    # compiled code that never comes back and lets nobody else run
    "hangs_in_c": ("import ctypes\nctypes.PyDLL(None).pause()", "was not imported within 0.3 s"),
    "locks": ("import threading\nlock = threading.Lock()\nlock.acquire()\nlock.acquire()",
              "was not imported within 0.3 s"),
    "crashes": ("import ctypes\nctypes.string_at(0)", "crashes while it is imported (Segmentation fault)"),
    "aborts": ("import os\nos.abort()", "crashes while it is imported (Aborted)"),
    "writes_anywhere": ("import os\nfor number in range(3, 64):\n    try: os.write(number, b'hello\\n')\n"
                        "    except OSError: pass", "writes to a stream that is not its own"),
    "closes_all": ("import os\nos.closerange(0, 100)", "closes files that it did not open while it is imported"),
    "closes_and_sleeps": ("import os, time\nos.closerange(0, 100)\ntime.sleep(600)",
                          "closes files that it did not open while it is imported"),
    "closes_and_hangs": ("import os, time\nos.closerange(0, 100)\nwhile True:\n    try: time.sleep(600)\n"
                         "    except BaseException: pass", "was not imported within 0.3 s"),
}  # fmt: skip


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install plugins by name into a folder on the path, as a package that is not this one's."""
    monkeypatch.setattr(registry, "IMPORT_SECONDS", 0.3)
    monkeypatch.setattr(child, "GRACE_SECONDS", 0.3)
    place = tmp_path / "installed"
    monkeypatch.syspath_prepend(place)

    def add(sources: dict[str, str], package: str = "plugins") -> None:
        made = place / f"{package}-1.0.dist-info"
        made.mkdir(parents=True)
        (made / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"{name} = hard_{package}_{name}:Task" for name in sources]
        (made / "entry_points.txt").write_text("\n".join(["[lidardesign.tasks]", *lines, ""]))
        for name, source in sources.items():
            (place / f"hard_{package}_{name}.py").write_text(source.replace("NAME", name))

    yield add
    for name in [name for name in sys.modules if name.startswith("hard_")]:
        del sys.modules[name]


@hard_case(
    "39",
    "A plugin that raises, leaves, hangs or crashes when it is imported, has another's name or version, or scores NaN",
    done="plugins of other packages are imported in a process of their own first, within a time limit; each is listed "
    "with its reason, the others work, and using it exits 6",
)
class TestBrokenPlugins:
    @pytest.mark.hard_case("P5")
    def test_all_are_listed_with_their_reasons_and_the_others_still_list_and_run(self, install, lidardesign):
        install({"good": GOOD, **{name: source for name, (source, _) in {**BROKEN, **FATAL}.items()}})
        listed = {entry["name"]: entry for entry in lidardesign("tasks", "list", "--json").json["tasks"]}
        for name, (_, words) in {**BROKEN, **FATAL}.items():
            assert words in listed[name]["error"], name
            assert listed[name]["distribution"] == "plugins 1.0"
        assert listed["good"]["summary"] == "a task that keeps the contract"
        assert listed["good"]["error"] is listed["flatland"]["error"] is None
        assert lidardesign("tasks", "show", "flatland").code == 0
        assert registry.load_task("good").name == "good"

    @pytest.mark.hard_case("P5")
    @pytest.mark.parametrize("name", ["raises", "is_of_another_version", "sleeps", "crashes", "closes_and_hangs"])
    def test_using_it_names_it_and_exits_6(self, install, lidardesign, tmp_path, name):
        source, words = {**BROKEN, **FATAL}[name]
        install({name: source})
        result = lidardesign("learn", name, "--out", "run", "--json")
        assert result.code == 6, result.err
        assert result.json["error"]["kind"] == "plugin"
        assert words in result.json["error"]["message"]
        assert result.json["error"]["where"] == f"task {name}"
        assert not (tmp_path / "run").exists()

    def test_a_name_that_two_packages_offer_is_refused_by_both_their_names(self, install, lidardesign):
        install({"twin": GOOD}, package="first")
        install({"twin": GOOD}, package="second")
        result = lidardesign("tasks", "show", "twin", "--json")
        assert result.code == 6
        assert "first 1.0" in result.err
        assert "second 1.0" in result.err
        assert lidardesign("tasks", "list").code == 0

    def test_a_package_whose_list_of_plugins_is_damaged_hides_only_its_own(self, install, lidardesign, tmp_path):
        install({"good": GOOD})
        install({"bad": GOOD}, package="damaged")
        damaged = tmp_path / "installed" / "damaged-1.0.dist-info" / "entry_points.txt"
        damaged.write_text("[lidardesign.tasks]\nno sign\n")
        names = {entry["name"] for entry in lidardesign("tasks", "list", "--json").json["tasks"]}
        assert {"good", "flatland"} <= names
        assert "bad" not in names

    def test_a_plugin_is_imported_only_when_it_is_used_and_listed_only_elsewhere(self, install, lidardesign, tmp_path):
        note = f"import pathlib\npathlib.Path({str(tmp_path / 'imported')!r}).touch()\nprint('hello')\n"
        install({"noted": note + GOOD})
        assert lidardesign("tasks", "show", "flatland").code == 0
        assert not (tmp_path / "imported").exists()
        listed = lidardesign("tasks", "list", "--json")
        assert "noted" in {entry["name"] for entry in listed.json["tasks"]}
        assert "hard_plugins_noted" not in sys.modules
        registry.load_task("noted")
        assert "hard_plugins_noted" in sys.modules

    def test_a_plugin_that_asks_for_all_tasks_while_it_is_imported_starts_no_chain_of_processes(self, install):
        install({"curious": "from lidardesign.registry import load_task\nload_task('good')\n" + GOOD, "good": GOOD})
        listed = {listing.name: listing.error for listing in registry.list_tasks()}
        assert listed["curious"] is None

    def test_where_no_process_can_be_started_plugins_are_imported_here(self, install, monkeypatch):
        install({"good": GOOD, "raises": BROKEN["raises"][0]})

        def refuse(*_, **__):
            raise OSError("no more processes")

        monkeypatch.setattr(child.subprocess, "Popen", refuse)
        listed = {listing.name: listing for listing in registry.list_tasks()}
        assert listed["good"].error is None
        assert "no licence" in listed["raises"].error

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), "far", None, 3.0, Score(float("nan")), Score("far")])
    def test_a_metric_that_is_no_number_exits_6_and_writes_nothing(self, lidardesign, tmp_path, monkeypatch, value):
        make_run(tmp_path / "run", count=1000)
        design = tmp_path / "run" / "designs" / "by_hand.yaml"
        design.parent.mkdir()
        shutil.copy(Path(__file__).parents[2] / "examples" / "hand_written_design.yaml", design)
        monkeypatch.setattr(FlatlandTask, "score", lambda *_: value)
        before = files_under(tmp_path)
        result = lidardesign("evaluate", "run", "--rays", 4, "--set", "test=1", "--csv", "rows.csv", "--json")
        assert result.code == 6, result.err
        assert "metric Chamfer distance" in result.json["error"]["where"]
        assert files_under(tmp_path) == before

    def test_a_plugin_that_raises_something_that_cannot_be_printed_is_still_named(self):
        class Mute(Exception):  # noqa: N818
            def __str__(self):
                raise RuntimeError

        with pytest.raises(PluginError, match="Mute: no message"), registry.plugin_guard("mute"):
            raise Mute


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
LONG = ["learning.steps=100000", "learning.batch=64", "learning.checkpoint_seconds=0.2"]
# Select Graphic Rendition: 30 to 49 and 90 to 107 are colours; bold and italic are none.
COLOUR = re.compile(rb"\x1b\[(?:\d+;)*(?:3\d|4\d|9\d|10\d)(?:;\d+)*m")
CLOSED = "import os; os.close({}); os.close({}); "


def wait_for(path_exists, seconds=120.0):
    deadline = time.monotonic() + seconds
    while not path_exists() and time.monotonic() < deadline:
        time.sleep(0.05)


def on_a_terminal(*arguments, **environment) -> bytes:
    """What the program prints on a terminal of its own."""
    leader, follower = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "lidardesign", *arguments], stdin=follower, stdout=follower, stderr=follower,
        env={**{k: v for k, v in os.environ.items() if k != "NO_COLOR"}, "TERM": "xterm-256color", **environment},
    )  # fmt: skip
    os.close(follower)
    shown = b""
    with contextlib.suppress(OSError):  # the terminal is gone once nobody holds its other end
        while part := os.read(leader, 65536):
            shown += part
    os.close(leader)
    assert process.wait() == 0
    return shown


@hard_case(
    "40",
    "Stdout closed early, no terminal, NO_COLOR, a locale that is not UTF-8, odd paths, SIGTERM and Ctrl-C",
    done="streams that nobody reads end the program quietly or swallow what is said; names are escaped where they "
    "cannot be shown, signals leave a checkpoint, one JSON document and exit 130 or 143",
)
class TestStreamsLocalesAndSignals:
    def test_a_closed_pipe_ends_quietly(self, tmp_path):
        for arguments in (["tasks", "show", "flatland", "--json"], ["tasks", "show", "flatland"], ["--help"]):
            process = program(*arguments, cwd=tmp_path)
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

    def test_a_terminal_shows_colours_unless_no_color_is_set(self, tmp_path):
        made = tmp_path / "odd-1.0.dist-info"
        made.mkdir()
        (made / "METADATA").write_text("Metadata-Version: 2.1\nName: odd\nVersion: 1.0\n")
        (made / "entry_points.txt").write_text("[lidardesign.tasks]\nodd = a_module_that_is_not_there:Task\n")
        path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
        red, plain = (on_a_terminal("tasks", "list", PYTHONPATH=path, **more) for more in ({}, {"NO_COLOR": "1"}))
        for shown in (red, plain):
            assert b"broken:" in shown
            assert b"flatland" in shown
        assert COLOUR.search(red)
        assert not COLOUR.search(plain)

    def test_a_run_in_a_folder_of_any_name_is_fitted_in_a_locale_that_has_no_such_letters(self, tmp_path):
        name = os.fsdecode("with spaces, größe 測 and no UTF-8 ".encode() + b"\xff")
        run = make_run(tmp_path / "made", count=1000).rename(tmp_path / name)
        environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
        # an editable installation, in such a locale, is found in a folder of plain letters only
        folders = [str(Path(sys.modules[name].__file__).parents[1]) for name in ("lidardesign", "lidardesign_tasks")]
        environment["PYTHONPATH"] = os.pathsep.join(folders)
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
        options = [word for setting in LONG for word in ("--set", setting)]
        process = program("learn", "flatland", "--preset", "draft", "--out", "run", *options, "--json", cwd=tmp_path)
        wait_for(lambda: list((tmp_path / "run").glob("checkpoint*")))
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate()
        assert process.returncode == 143, err
        assert "--resume" in json.loads(out)["error"]["message"]
        assert (tmp_path / "run" / "config.yaml").is_file()
        assert not (tmp_path / "run" / ".lock").exists()
        assert not list((tmp_path / "run").glob(".*.tmp"))
