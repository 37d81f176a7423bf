"""The end of this process, by signals too, and work in child processes, which may crash, hang, print or close files.

A child process calls a function, named as `module:function`, with a request and the stream of its answers; the function
returns the last one. Requests and answers are lines of JSON. Prints are kept apart from answers.
"""

from __future__ import annotations

import _thread
import atexit
import contextlib
import importlib
import io
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, BinaryIO, Literal, NoReturn

from lidardesign.errors import text_of
from lidardesign.run.files import write_atomic

EXIT_WORDS = {130: "interrupted", 143: "terminated"}
EXIT_CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
EXIT_INTERNAL = 70
# Between a signal that was swallowed and its repetition; for tidying up after it, or for what a plugin left behind; and
# for a file that is being written then [s].
AGAIN_S, END_S, WRITING_S = 0.25, 3.0, 60.0
# Where this is set in the environment, errors show their tracebacks.
DEBUG = "LIDARDESIGN_DEBUG"
PROGRAM = (
    "import json, sys; path, *work = json.loads(sys.stdin.readline()); sys.path[:] = path; "
    "from lidardesign.run.processes import serve; serve(*work)"
)
BEGUN = b"begun\n"
# Python and this package are loaded within this time [s].
START_SECONDS = 60.0
# Time for work that limits its own time to end and answer [s].
GRACE_SECONDS = 2.0
# The exit code of a process whose stream of answers was closed.
UNANSWERED = 117
# Of what the work printed last [bytes].
MOST_PRINTED = 20_000


class TerminatedError(KeyboardInterrupt):
    """SIGTERM, treated like an interruption where things are tidied up."""


class Ending:
    """The end of the program: after a signal, whoever swallows its exception; after the work, whatever a plugin left.

    The exception is raised again until it arrives where errors are reported. A process that goes on is ended.
    """

    def __init__(self) -> None:
        self.code, self.signalled, self.arrived, self._listens = EXIT_INTERNAL, 0, False, False
        self._exit, self._tell = os._exit, print

    def begin(self, tell: Callable[[str], None]) -> None:
        """Listen to SIGTERM, and to SIGINT if it is not ignored.

        Arguments:
            tell: Prints a message.
        """
        self._listens, self._tell = True, tell
        for number in EXIT_CODES:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._interrupt)
        # last, after what is printed at the exit: what libraries take down then is the system's anyway
        atexit.register(self._leave)
        atexit.register(print, end="", flush=True)
        if not os.environ.get(DEBUG):
            sys.unraisablehook = threading.excepthook = self._tell_ignored

    def end(self, code: int) -> NoReturn:
        """End the process, and what a plugin left running after a while."""
        if self.signalled and not self.arrived:
            self._tell(EXIT_WORDS[self.signalled])
        self.code, self.arrived = code, True
        if self._listens:
            _thread.start_new_thread(self._leave, (END_S,))
        sys.exit(self.signalled or code)

    def _interrupt(self, number: int, _: object) -> None:
        if not self.signalled:
            self.signalled = EXIT_CODES[number]
            # threading has locks, and the main thread may hold them
            _thread.start_new_thread(self._insist, (number,))
        if not self.arrived and not code_of_interruption(sys.exception()):
            raise TerminatedError if number == signal.SIGTERM else KeyboardInterrupt

    def _insist(self, number: int) -> None:
        for _ in range(int(END_S / AGAIN_S)):
            time.sleep(AGAIN_S)
            signal.pthread_kill(threading.main_thread().ident, number)
        if not self.arrived:  # in a thread, as the message may not be read
            _thread.start_new_thread(self._tell, (EXIT_WORDS[self.signalled],))
        self._leave(AGAIN_S)

    def _leave(self, after_s: float = 0.0) -> None:
        """End the process after a while, unless it has ended by then; a file is written to its end before."""
        time.sleep(after_s)
        last = time.monotonic() + WRITING_S
        while time.monotonic() < last and any(
            frame.f_code is write_atomic.__code__
            for innermost in sys._current_frames().values()
            for frame, _ in traceback.walk_stack(innermost)
        ):
            time.sleep(AGAIN_S)
        self._exit(self.signalled or self.code)

    def _tell_ignored(self, lost: Any) -> None:
        """Tell in a line what threads and finalizers raise, where nothing can be done about it."""
        if not issubclass(lost.exc_type, KeyboardInterrupt | SystemExit):
            self._tell(f"note: ignored: {lost.exc_type.__name__}: {text_of(lost.exc_value)}")


ENDING = Ending()


def code_of_interruption(error: BaseException | None) -> int:
    """The exit code of the interruption that an error is, comes from or was raised in; 0 without one."""
    met: set[int] = set()
    while error is not None and id(error) not in met:
        if isinstance(error, KeyboardInterrupt):
            return EXIT_CODES[signal.SIGTERM if isinstance(error, TerminatedError) else signal.SIGINT]
        met.add(id(error))
        error = error.__cause__ or error.__context__
    return 0


class ChildError(Exception):
    """A process that gave no answer, as a sentence without its subject.

    Arguments:
        message: The sentence.
        reason: The cause: not started, too late, died, or foreign output among its answers.
    """

    def __init__(self, message: str, reason: Literal["unstarted", "late", "died", "foreign"]) -> None:
        super().__init__(message)
        self.reason = reason


class Child:
    """A child process that works on a request; `end` must be called in any case.

    Arguments:
        function: The function that it calls with the request and the stream of its answers, as `module:function`.
        request: A JSON value.
        environment: Variables beside those of this process.

    Raises:
        OSError: No further process may be started.
    """

    def __init__(self, function: str, request: Any, environment: Mapping[str, str] | None = None) -> None:
        self._lines: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        self._begun, self._printed, self.owner = False, b"", os.getpid()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            # unbuffered, so that nothing remains to be flushed to a process that died
            bufsize=0,
            env={**os.environ, **(environment or {})},
            # what the work starts is ended with it, and a terminal's Ctrl-C is for this process
            start_new_session=True,
        )
        self._printing = threading.Thread(target=self._read_printed, daemon=True)
        for reader in (threading.Thread(target=self._read_answers, daemon=True), self._printing):
            reader.start()
        self.send([sys.path, function, request])

    @property
    def alive(self) -> bool:
        """True while it runs; False in other processes than the one that started it."""
        return self.owner == os.getpid() and self._process.poll() is None

    @property
    def printed(self) -> list[str]:
        """The last lines that the work printed."""
        return self._printed.decode(errors="replace").splitlines()

    def send(self, document: Any) -> None:
        """Write a line to its standard input; a failure is reported by the next answer."""
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps(document).encode() + b"\n")  # type: ignore[union-attr]

    def answer(self, seconds: float, when: str) -> dict[str, Any]:
        """The next answer; the time limit starts with the work for the first one, with this call for later ones.

        Arguments:
            seconds: The time limit [s].
            when: Its present work, as "while it is imported".

        Raises:
            ChildError: There is none.
        """
        since = time.monotonic()
        if not self._begun:
            since, line = self._next_line(since + START_SECONDS)
            if line != BEGUN:
                raise ChildError("could not be started", "unstarted")
            self._begun = True
        deadline = since + seconds + GRACE_SECONDS
        _, line = self._next_line(deadline)
        if not line:
            died_of = None if line is None else self._died_of(deadline, when)
            raise ChildError(died_of or f"gave no answer within {seconds:g} s", "died" if died_of else "late")
        with contextlib.suppress(ValueError):
            found = json.loads(line)
            if isinstance(found, dict):
                return found
        raise ChildError(f"writes to a stream that is not its own {when}", "foreign")

    def _next_line(self, deadline: float) -> tuple[float, bytes | None]:
        """The time of arrival and the next line: empty at the end of the stream, None after the deadline."""
        try:
            found = self._lines.get(timeout=max(deadline - time.monotonic(), 0.0))
        except queue.Empty:
            return deadline, None
        if not found[1]:
            # the end stays in the queue for further calls
            self._lines.put(found)
        return found

    def _died_of(self, deadline: float, when: str) -> str | None:
        """The end of the process in words; None where it still runs `GRACE_SECONDS` after the deadline."""
        try:
            code = self._process.wait(max(deadline - time.monotonic(), 0.0) + GRACE_SECONDS)
        except subprocess.TimeoutExpired:
            return None
        if code == UNANSWERED:
            return f"closes files that it did not open {when}"
        if code < 0:
            return f"crashes {when} ({signal.strsignal(-code)})"
        return f"ends the program {when} (exit code {code})"

    def end(self) -> None:
        """End the process and what it started."""
        if self._process.returncode is None and hasattr(os, "killpg"):
            with contextlib.suppress(OSError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        self._process.stdin.close()  # type: ignore[union-attr]
        # what it printed last is on its way; a process that left its group may hold the pipe for ever
        self._printing.join(GRACE_SECONDS)

    def _read_answers(self) -> None:
        with io.BufferedReader(self._process.stdout) as pipe:  # type: ignore[arg-type]
            while line := pipe.readline():
                self._lines.put((time.monotonic(), line))
        self._lines.put((time.monotonic(), b""))

    def _read_printed(self) -> None:
        with self._process.stderr as pipe:  # type: ignore[union-attr]
            while some := pipe.read(MOST_PRINTED):
                self._printed = (self._printed + some)[-MOST_PRINTED:]


def ask(
    function: str, request: Any, seconds: float, when: str, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """The single answer of a child process, which is then ended; arguments as of `Child` and its `answer`.

    Raises:
        ChildError: There is none.
    """
    child = Child(function, request, environment)
    try:
        return child.answer(seconds, when)
    finally:
        child.end()


def serve(function: str, request: Any) -> None:
    """In the child: call the function, write its last answer, and exit at once, without exit handlers."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    module, _, name = function.partition(":")
    work = attrgetter(name)(importlib.import_module(module))
    answers.write(BEGUN)
    answers.flush()
    write_line(answers, work(request, answers))
    os._exit(0)


def write_line(answers: BinaryIO, document: dict[str, Any]) -> None:
    """Write an answer; a process that cannot is ended."""
    try:
        answers.write(json.dumps(document).encode() + b"\n")
        answers.flush()
    except OSError:
        os._exit(UNANSWERED)
