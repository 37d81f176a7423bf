"""The run that is disturbed, in forks of a process that has imported everything; the same one undisturbed.

And what of a run can be read and compared.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from lidardesign.density.training.checkpoint import load_arrays
from lidardesign.errors import LidardesignError
from lidardesign.formats.designs import load_design
from lidardesign.rays.pool import FILE_NAME as POOL
from lidardesign.run.arrays import read_npz
from lidardesign.run.inputs import SAMPLES as LIMITS
from lidardesign.run.manifest import read_manifest, verify
from lidardesign.samples import load_samples

# What learn, fit and evaluate import late; nothing of it may be run here, because threads do not survive a fork.
LATE = (
    "lidardesign.cli.main", "lidardesign.fitting.request", "lidardesign.density.fields.body_kernels",
    "lidardesign.density.fields.table_kernels", "lidardesign.density.training.learn",
    "lidardesign.density.spline_kernels", "lidardesign.mixture.support", "lidardesign.mixture.fit",
    "lidardesign.fitting.chosen", "lidardesign.rays.pool", "lidardesign.scoring.metrics", "lidardesign.report.page",
    "lidardesign.evaluation.score", "lidardesign.evaluation.results", "lidardesign.workers",
    "lidardesign.api.export", "lidardesign.clouds.files", "lidardesign.contract.scaffold",
    "lidardesign.formats.ray_tracers", "lidardesign_tasks.flatland", "plotly.io", "rich.table", "torch._dynamo",
)  # fmt: skip
# Every step by which files come, change their names and go: what is on the disk changes only here.
STEPS = ("fsync", "link", "mkdir", "rename", "replace", "rmdir", "unlink")
# What a fork leaves beside its work.
SAID, COUNTED = "said", "steps"


@dataclass(frozen=True)
class Ended:
    """How a process ended: negative codes are signals, steps are those that changed files."""

    code: int
    seconds: float
    said: str
    steps: int = 0


def import_all() -> None:
    """Import what commands import, so that forks begin with it."""
    from lidardesign.cli.terminal.output import set_defaults

    set_defaults()
    for name in LATE:
        importlib.import_module(name)


class Fork:
    """The program in a fork, in a folder, sent a signal before the step of a number from 1, if one is given."""

    def __init__(self, arguments: Sequence[str], folder: Path, step: int = 0, sent: int = signal.SIGKILL) -> None:
        self._started = time.monotonic()
        self._notes = Path(tempfile.mkdtemp())
        # a signal may come before the fork has written anything
        for name in (SAID, COUNTED):
            (self._notes / name).touch()
        self._pid = os.fork()
        if self._pid == 0:
            _be_the_program(arguments, folder, self._notes, step, sent)

    def ended(self, after_s: float = 0.0, sent: int = signal.SIGKILL) -> Ended:
        """How it ended; with a time, it is sent a signal then unless it has ended before."""
        status = self._status(self._started + after_s if after_s else None, sent)
        said = (self._notes / SAID).read_text(encoding="utf-8")
        steps = int((self._notes / COUNTED).read_text() or 0)
        shutil.rmtree(self._notes)
        return Ended(os.waitstatus_to_exitcode(status), time.monotonic() - self._started, said, steps)

    def _status(self, moment: float | None, sent: int) -> int:
        while moment is not None and time.monotonic() < moment:
            ended, status = os.waitpid(self._pid, os.WNOHANG)
            if ended:
                return status
            time.sleep(0.002)
        if moment is not None:
            os.kill(self._pid, sent)
        return os.waitpid(self._pid, 0)[1]


def _be_the_program(arguments: Sequence[str], folder: Path, notes: Path, step: int, sent: int) -> None:
    """Never returns: whatever happens ends the fork and not what it was forked from."""
    code = 99
    try:
        os.chdir(folder)
        for stream, path in ((1, os.devnull), (2, notes / SAID)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), stream)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _count_steps(notes / COUNTED, step, sent)
        from lidardesign.cli.main import run

        sys.argv[1:] = arguments
        run()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0
    except BaseException:
        os.write(2, traceback.format_exc().encode())
    finally:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(code)


def _count_steps(counted: Path, at_step: int, sent: int) -> None:
    """Count the steps that change files into a file, and send this process a signal before one of them."""
    tally = os.open(counted, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    done = 0

    def counting(real: Callable[..., object]) -> Callable[..., object]:
        def step(*args: object, **options: object) -> object:
            nonlocal done
            done += 1
            os.pwrite(tally, str(done).encode(), 0)
            if done == at_step:
                os.kill(os.getpid(), sent)
            return real(*args, **options)

        return step

    for name in STEPS:
        setattr(os, name, counting(getattr(os, name)))


SETTINGS = (
    "learning.steps=160", "learning.batch=64", "learning.layers=1", "learning.hidden=12", "learning.samples=1000",
    "learning.coverage_proposals=256", "learning.balance_proposals=256", "learning.checkpoint_seconds=0.000001",
    "train=3", "test=2",
)  # fmt: skip
LEARN = ["learn", "flatland", "--preset", "draft", "--out", "run", "--seed", "3", "--quiet"]
LEARN += [word for setting in SETTINGS for word in ("--set", setting)]
FIT = ["fit", "run", "--sensors", "2", "--rays", "8", "--quiet"]
# half of its time it writes
EVALUATE = ["evaluate", "run", "--rays", "8", "--csv", "run/rows.csv", "--report", "run/page.html", "--quiet"]
STATE = "checkpoint.safetensors"
SAMPLES = "samples.npz"
# Of evaluate, what shows how long things took.
TIMES = ("manifest.json", "page.html")


@dataclass(frozen=True)
class Command:
    """What is given, and after which other command."""

    arguments: list[str]
    after: str = "nothing"


COMMANDS = {
    "learn": Command(LEARN),
    "learn --tolerance": Command([*LEARN, "--tolerance", "0.01"]),
    "fit": Command(FIT, "learn"),
    "evaluate": Command(EVALUATE, "fit"),
}
# With a tolerance all steps are not enough: exit 1, with a run that is whole.
FINISHED = (0, 1)


class Straight:
    """The run that nobody disturbed: `run` inside of a folder for each command, and how that ended."""

    def __init__(self, folder: Path) -> None:
        import_all()
        self._folder, self.ends, self.after = folder, {}, {}
        (folder / "nothing").mkdir()
        for name, command in COMMANDS.items():
            ended = Fork(command.arguments, self.before(name, folder / name)).ended()
            if ended.code not in FINISHED:
                raise SystemExit(f"{name} failed undisturbed: {ended.said}")
            self.ends[name], self.after[name] = ended, contents(folder / name / "run")

    def before(self, name: str, place: Path) -> Path:
        """Make a place what the folder was before a command."""
        return shutil.copytree(self._folder / COMMANDS[name].after, place)


def contents(run: Path) -> dict[str, object]:
    """What a run holds, without the times that are in some of its files."""
    found: dict[str, object] = {}
    for path in sorted(run.rglob("*")):
        name = path.relative_to(run).as_posix()
        if path.is_dir() or name in TIMES:
            continue
        found[name] = _plain(path, name)
    return found


def _plain(path: Path, name: str) -> object:
    if name == "progress.jsonl":
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]
    if name == STATE:
        arrays, state = load_arrays(path.parent, name)
        return {key: value.tobytes() for key, value in arrays.items()}, {**state, "seconds": None}
    if name == "rows.csv":
        with path.open(newline="", encoding="utf-8") as file:
            return [{key: value for key, value in row.items() if "seconds" not in key} for row in csv.DictReader(file)]
    return path.read_bytes()


def unreadable(run: Path) -> Iterator[str]:
    """What of a run that was just killed is there but cannot be read, in one line each."""
    if not (run / "config.yaml").exists():
        return  # it had not begun
    manifest = read_manifest(run)
    for name in (*manifest["files"], "config.yaml"):
        if name != "progress.jsonl" and (run / name).exists():
            yield from _refused(name, lambda name=name: verify(run, name))
    for name, read in ((STATE, lambda: load_arrays(run, STATE)), (SAMPLES, lambda: load_samples(run))):
        if (run / name).exists() and name in manifest["files"]:
            yield from _refused(name, read)
    if (run / POOL).exists():
        yield from _refused(POOL, lambda: read_npz(run / POOL, LIMITS))
    for path in (run / "designs").glob("*.yaml"):
        yield from _refused(path.name, lambda path=path: load_design(path))
    page = run / "page.html"
    if page.exists() and not page.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        yield "page.html is cut"


def _refused(name: str, read: Callable[[], object]) -> Iterator[str]:
    try:
        read()
    except LidardesignError as error:
        yield f"{name}: {error.message}"


def strays(folder: Path) -> list[str]:
    """Temporary files and locks."""
    return [path.name for path in folder.rglob(".*") if path.suffix == ".tmp" or path.name == ".lock"]
