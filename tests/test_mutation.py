"""Mutation runs: changes are made, and tests notice those that they can."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="cosmic-ray is part of the development extra")
TOOLS = Path(__file__).resolve().parent.parent / "tools"
SOURCE = textwrap.dedent(
    """
    LEAST = 2

    def share(part: int | None, whole: int, *, more: float = 1.0) -> float:
        if part is None or whole < LEAST:
            return 0.0
        def scaled():
            return part / whole
        return scaled() * more

    class Pair:
        @staticmethod
        def larger(one, other):
            return one if one > other else other

        @property
        def size(self):
            return 2

    def unused(value):
        return -value
    """
)
TESTS = textwrap.dedent(
    """
    from toy import Pair, share

    def test_shares():
        assert share(1, 4, more=2.0) == 0.5
        assert share(None, 4) == 0.0

    def test_limit():
        assert share(1, 1) == 0.0
        assert share(1, 2) == 0.5

    def test_pairs():
        assert Pair.larger(1, 2) == Pair.larger(2, 1) == 2
        assert Pair().size == 2
    """
)
RUN = textwrap.dedent(
    """
    import json, sys
    from pathlib import Path

    folder, tools = map(Path, sys.argv[1:])
    sys.path[:0] = [str(tools), str(folder)]
    from mutant_tests import Children, try_mutants
    from mutants import mutants_of

    path, found = folder / "toy.py", []
    mutants = mutants_of(path.read_text())
    tell = lambda mutant, outcome: found.append((mutant.line, mutant.operator, mutant.after, outcome))
    status = try_mutants(path, "toy", [str(folder / "test_toy.py")], mutants, Children(2, tell), {"toy", "test_toy"})
    (folder / "found.json").write_text(json.dumps(found))
    sys.exit(status)
    """
)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What became of every mutant of a small module: line, operator, changed line, outcome."""
    folder = tmp_path_factory.mktemp("toy")
    (folder / "toy.py").write_text(SOURCE)
    (folder / "test_toy.py").write_text(TESTS)
    command = [sys.executable, "-c", RUN, str(folder), str(TOOLS)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": ""})
    assert done.returncode == 0, done.stdout + done.stderr
    assert (folder / "toy.py").read_text() == SOURCE
    return [tuple(one) for one in json.loads((folder / "found.json").read_text())]


def test_changes_that_tests_can_see_are_killed_inside_and_outside_of_functions(found):
    alive = {after for _, _, after, outcome in found if outcome == "survived"}
    # equal values have one larger, a static method is one without its decorator too, nothing calls the last function
    assert alive == {"return one if one >= other else other", "", "return value"}
    killed = {after for _, _, after, outcome in found if outcome == "killed"}
    assert {"LEAST = 3", "return part * whole", "if part is None or whole <= LEAST:"} <= killed
