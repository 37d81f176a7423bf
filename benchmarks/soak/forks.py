"""The program in processes that are killed: forks of this one, which has imported everything."""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

# What learn, fit and evaluate import late; nothing of it may be run here, because threads do not survive a fork.
LATE = (
    "lidardesign.cli.main", "lidardesign.fitting.request", "lidardesign.density.fields.body_kernels",
    "lidardesign.density.fields.table_kernels", "lidardesign.density.training.learn",
    "lidardesign.density.spline_kernels", "lidardesign.mixture.support", "lidardesign.mixture.fit",
    "lidardesign.fitting.chosen", "lidardesign.rays.pool", "lidardesign.scoring.metrics", "lidardesign.report.page",
    "lidardesign.scoring.evaluation.score", "lidardesign.scoring.evaluation.results", "lidardesign.workers",
    "lidardesign_tasks.flatland", "plotly.io", "rich.table", "torch._dynamo",
)  # fmt: skip
# Every step by which files come, change their names and go: what is on the disk changes only here.
STEPS = ("fsync", "link", "mkdir", "replace", "rmdir", "unlink")
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
    from lidardesign.cli.terminal.output import set_thread_defaults

    set_thread_defaults()
    for name in LATE:
        importlib.import_module(name)


class Fork:
    """The program in a fork, in a folder, sent a signal before the step of a number from 1, if one is given."""

    def __init__(self, arguments: Sequence[str], folder: Path, step: int = 0, sent: int = signal.SIGKILL) -> None:
        self._started = time.monotonic()
        self._notes = Path(tempfile.mkdtemp())
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

        run(list(arguments))
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
