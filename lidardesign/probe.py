"""What a plugin does when it is imported, found out in a process of its own.

A plugin may hang in compiled code, where no signal reaches Python, or crash: both end that process and not this one.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any

# In the environment of a probing process, so that a plugin that asks for tasks does not start further ones.
PROBING = "LIDARDESIGN_PROBING"
CHILD = (
    "import json, sys; request = json.loads(sys.stdin.readline()); sys.path[:] = request['path']; "
    "from lidardesign.registry import answer_probe; answer_probe(request)"
)
BEGUN = b"begun\n"
# Python and this package are loaded within this time [s], or the probe says nothing.
START_SECONDS = 60.0
# An import that can be interrupted was interrupted by then, and said so [s].
GRACE_SECONDS = 2.0
# The exit code of a probing process that could not say what it found.
UNHEARD = 117


@dataclass(frozen=True)
class Probe:
    """What was found.

    Arguments:
        summary: The task's one-line summary, where it keeps the contract.
        error: Why it cannot be used, or None.
        contained: Whether importing it here would hang or crash this process.
    """

    summary: str = ""
    error: str | None = None
    contained: bool = False


class Apart:
    """A process of its own that runs a plugin's code and answers by lines; to be ended in any case.

    Arguments:
        code: Python that reads the request, one line of JSON, from standard input.
        request: What it is asked.
    """

    def __init__(self, code: str, request: dict[str, Any]) -> None:
        self._lines: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, PROBING: "1"},
            # what the plugin starts is ended with it, and a terminal's Ctrl-C is for this process
            start_new_session=True,
        )
        threading.Thread(target=self._read, daemon=True).start()
        with contextlib.suppress(OSError), self._process.stdin as pipe:  # type: ignore[union-attr]
            pipe.write(json.dumps(request).encode() + b"\n")

    def end(self) -> None:
        """End the process and what it started."""
        if self._process.returncode is None and hasattr(os, "killpg"):
            with contextlib.suppress(OSError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.wait()

    def next_line(self, deadline: float) -> tuple[float, bytes | None]:
        """The next line and when it came: empty at the end, None where none came in time."""
        try:
            return self._lines.get(timeout=max(deadline - time.monotonic(), 0.0))
        except queue.Empty:
            return deadline, None

    def _read(self) -> None:
        with self._process.stdout as pipe:  # type: ignore[union-attr]
            while line := pipe.readline():
                self._lines.put((time.monotonic(), line))
        self._lines.put((time.monotonic(), b""))

    def died_of(self, deadline: float, when: str) -> str | None:
        """How it ended; None where it only closed its pipe and hangs until the deadline and a little longer.

        Arguments:
            deadline: On the monotonic clock [s].
            when: What the plugin did meanwhile, as "while it is imported".
        """
        try:
            code = self._process.wait(max(deadline - time.monotonic(), 0.0) + GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            return None
        if code == UNHEARD:
            return f"closes files that are not its own {when}"
        if code < 0:
            return f"crashes {when} ({signal.strsignal(-code)})"
        return f"ends the program {when} (exit code {code})"


class Probing(Apart):
    """A plugin that is being imported elsewhere.

    Arguments:
        offer: Its entry point.
        seconds: How long the import may take.
    """

    def __init__(self, offer: EntryPoint, seconds: float) -> None:
        self._seconds = seconds
        super().__init__(CHILD, {"name": offer.name, "value": offer.value, "path": sys.path, "seconds": seconds})

    def result(self) -> Probe | None:
        """What came of it, waited for; None where nothing could be found out."""
        begun, line = self.next_line(time.monotonic() + START_SECONDS)
        if line != BEGUN:
            return None
        deadline = begun + self._seconds + GRACE_SECONDS
        _, line = self.next_line(deadline)
        if line:
            return _read(line)
        died_of = None if line is None else self.died_of(deadline, "while it is imported")
        return Probe(error=died_of or f"was not imported within {self._seconds:g} s", contained=True)


def _read(line: bytes) -> Probe:
    """The answer of a line; a plugin may have written it, which knows neither its form nor that it is read."""
    try:
        found = json.loads(line)
        return Probe(summary=str(found.get("summary", "")), error=found.get("error"))
    except (ValueError, AttributeError):
        return Probe(error="writes into what is not its own while it is imported", contained=True)


def probed(offers: list[EntryPoint], seconds: float) -> list[Probe | None]:
    """What each of some plugins does, found out side by side; None where no process could tell.

    Arguments:
        offers: Their entry points.
        seconds: How long each import may take.
    """
    running: list[Probing] = []
    try:
        for offer in offers:
            running.append(Probing(offer, seconds))
        return [one.result() for one in running]
    except OSError:  # no further process may be started
        return [None] * len(offers)
    finally:
        for one in running:
            one.end()


def answer(result: Any, document: dict[str, Any]) -> None:
    """Write a probe's answer and end the probing process: threads and exit handlers of the plugin end with it."""
    try:
        result.write(json.dumps(document).encode() + b"\n")
        result.flush()
    except OSError:
        os._exit(UNHEARD)
    os._exit(0)
