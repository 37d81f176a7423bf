"""Tests of mutants in forked processes: the changed code meets the tests that reach it, and dies of the first failure.

A change inside a function is put in place of the loaded function after the tests were collected, and meets the tests
that call the function, the quickest first. Any other change (a constant, a decorator, a field of a model) needs the
project imported anew, so it forks from a process that has imported everything but the project.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import itertools
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from pathlib import Path
from types import FrameType, FunctionType, ModuleType
from typing import Any

import pytest
from mutants import Mutant, function_bodies, function_code

# Changed code may loop for ever: this many times what the unchanged code takes, and some seconds, end it.
PATIENCE = 3
PATIENCE_S = 5
# Tests of a function take this long together at most, the quickest ones first [s].
ENOUGH_S = 3.0
ANEW_LIMIT_S = 60
MEMORY_BYTES = 8 << 30
# Exit code of a process whose work raised, which pytest never lets a test do.
BROKEN = 99
# plain asserts: what rewrites them would import the project's own source before the changed one
OPTIONS = [
    "-x", "-q", "--assert=plain", "--capture=sys", "-p", "no:cacheprovider",
    "-W", "ignore::pytest.PytestAssertRewriteWarning",
]  # fmt: skip


class Children:
    """At most `jobs` forked processes at a time; tells what became of each mutant."""

    def __init__(self, jobs: int, tell: Callable[[Mutant, str], None]) -> None:
        self.jobs, self.tell = jobs, tell
        self.running: dict[int, Mutant] = {}

    def start(self, mutant: Mutant, work: Callable[[], int], limit_s: int) -> None:
        """Do `work` in a process; what it returns, 0 for no failure, is its exit code."""
        if len(self.running) >= self.jobs:
            self._end_one()
        self.running[forked(work, limit_s)] = mutant

    def finish(self) -> None:
        """Wait for all."""
        while self.running:
            self._end_one()

    def _end_one(self) -> None:
        child, status = os.wait()
        if os.WIFEXITED(status) and os.WEXITSTATUS(status) == BROKEN:
            raise SystemExit(f"this mutant could not be tested: {self.running[child]}")
        over = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL)
        self.tell(self.running.pop(child), "survived" if status == 0 else "timeout" if over else "killed")


def try_mutants(
    path: Path, name: str, files: list[str], mutants: list[Mutant], children: Children, ours: set[str]
) -> int:
    """Let mutants of the module `name` at `path` meet tests, in this process, which imports for it: pytest's exit code.

    Arguments:
        path, name: The module.
        files: Its test files; a change outside of functions meets the first one alone, whole.
        mutants: Its changed sources.
        children: Runs them, and tells what became of each.
        ours: Packages and modules that a mutant is to meet anew.
    """
    bodies = function_bodies(path.read_text())
    preload(path, name, files, ours)
    for mutant in mutants:
        if function_at(bodies, mutant.line) is None:
            children.start(mutant, lambda m=mutant: run_anew(path, name, m.code, files[:1]), ANEW_LIMIT_S)
    children.finish()
    inside = [mutant for mutant in mutants if function_at(bodies, mutant.line) is not None]
    return int(pytest.main([*OPTIONS, *files], plugins=[InPlace(path, name, inside, children)]))


def forked(work: Callable[[], int], limit_s: int) -> int:
    """Process number of a silent child whose exit code is what `work` returns."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    status = BROKEN
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        status = work()
    finally:
        os._exit(status)


class _Instead(MetaPathFinder, Loader):
    """Imports one module from changed source."""

    def __init__(self, path: Path, name: str, code: str) -> None:
        self.path, self.name, self.code = path, name, code

    def find_spec(self, name: str, path: object, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != self.name:
            return None
        spec = spec_from_loader(name, self, origin=str(self.path))
        if spec is not None:
            spec.has_location = True
        return spec

    def exec_module(self, module: ModuleType) -> None:
        exec(compile(self.code, str(self.path), "exec"), module.__dict__)


def run_anew(path: Path, name: str, code: str, files: list[str], *options: str) -> int:
    """Exit code of pytest in this process, which imports `code` in the place of the module at `path`."""
    sys.meta_path.insert(0, _Instead(path, name, code))
    return int(pytest.main([*OPTIONS, *options, *files]))


def preload(path: Path, name: str, files: list[str], ours: set[str]) -> None:
    """Import here what the tests import, but for packages and modules that are `ours`."""
    read, write = os.pipe()

    def collect() -> int:
        status = run_anew(path, name, path.read_text(), files, "--collect-only")
        os.write(write, json.dumps(list(sys.modules)).encode())
        return status

    child = forked(collect, 600)
    os.close(write)
    with os.fdopen(read) as pipe:
        names = json.loads(pipe.read() or "[]")
    if os.waitpid(child, 0)[1]:
        raise SystemExit(f"the tests of {name} cannot be collected: pytest --collect-only {' '.join(files)}")
    for module in names:
        if module.partition(".")[0] not in ours:
            with contextlib.suppress(ImportError, AttributeError):
                importlib.import_module(module)


class InPlace:
    """A plugin of pytest that, instead of running the tests once, runs them on every mutant of functions."""

    def __init__(self, path: Path, name: str, mutants: list[Mutant], children: Children) -> None:
        self.path, self.name, self.mutants, self.children = path, name, mutants, children
        self.bodies = function_bodies(path.read_text())

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Every mutant meets the tests of its function, each in a process of its own."""
        costs = self._costs(session)
        for mutant in self.mutants:
            function = function_at(self.bodies, mutant.line)
            chosen = self._chosen(costs, function)
            items = [session.items[i] for i, _ in chosen]
            limit_s = int(PATIENCE * sum(cost for _, cost in chosen)) + PATIENCE_S
            self.children.start(mutant, lambda m=mutant, f=function, t=items: self._test(session, m, f, t), limit_s)
        self.children.finish()
        return True

    def _costs(self, session: pytest.Session) -> list[tuple[float, list[str]]]:
        """Processor time of each test [s] and the functions that it calls, found in a process of their own."""
        read, write = os.pipe()

        def measure() -> int:
            found = [self._traced(session, item) for item in session.items]
            os.write(write, json.dumps(found).encode())
            return int(session.testsfailed > 0)

        child = forked(measure, 3600)
        os.close(write)
        with os.fdopen(read) as pipe:
            found = json.loads(pipe.read() or "[]")
        if os.waitpid(child, 0)[1]:
            raise SystemExit(f"the tests of {self.name} fail on the unchanged code")
        return found

    def _traced(self, session: pytest.Session, item: pytest.Item) -> tuple[float, list[str]]:
        seen, path = set(), str(self.path)

        def trace(frame: FrameType, event: str, argument: object) -> None:
            if frame.f_code.co_filename == path:
                seen.add(frame.f_code.co_firstlineno)

        began = time.process_time()
        sys.settrace(trace)
        run_items([item])
        sys.settrace(None)
        # a function's code begins at its first line, above its body; a nested one's inside a body
        names = {name for name, code in self._codes() if code in seen}
        inside = {function_at(self.bodies, line) for line in seen} - {None}
        return time.process_time() - began, sorted(names | inside)

    def _codes(self) -> Iterator[tuple[str, int]]:
        whole = compile(self.path.read_text(), str(self.path), "exec")
        for name in self.bodies:
            yield name, function_code(whole, name).co_firstlineno

    @staticmethod
    def _chosen(costs: list[tuple[float, list[str]]], function: str) -> list[tuple[int, float]]:
        calling = sorted((cost, i) for i, (cost, names) in enumerate(costs) if function in names)
        chosen, total = [], 0.0
        for cost, i in calling:
            total += cost
            if chosen and total > ENOUGH_S:
                break
            chosen.append((i, cost))
        return chosen

    def _test(self, session: pytest.Session, mutant: Mutant, function: str, items: list[pytest.Item]) -> int:
        live = live_function(sys.modules[self.name], function)
        live.__code__ = function_code(compile(mutant.code, str(self.path), "exec"), function)
        run_items(items)
        return int(session.testsfailed > 0)


def run_items(items: list[pytest.Item]) -> None:
    """Run collected tests as pytest does, up to the first failure."""
    for item, following in itertools.zip_longest(items, items[1:]):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if item.session.testsfailed:
            return


def function_at(bodies: dict[str, tuple[int, int]], line: int) -> str | None:
    """The function whose body holds a line; None outside of functions."""
    return next((name for name, (first, last) in bodies.items() if first <= line <= last), None)


def live_function(module: ModuleType, name: str) -> FunctionType:
    """The function of a dotted name in a loaded module; raises AttributeError where it is something else."""
    found: Any = module
    for part in name.split("."):
        found = inspect.getattr_static(found, part)
    found = getattr(found, "__func__", None) or getattr(found, "fget", None) or found
    if not isinstance(found, FunctionType):
        raise AttributeError(f"{name} is no plain function")
    return found
