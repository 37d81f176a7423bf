"""What people are told: a few lines, all tables with --verbose, the path of the result alone with --quiet."""

from __future__ import annotations

import json
import shlex
import subprocess
from types import SimpleNamespace

import pytest

from lidardesign.cli.terminal import grids as progress
from lidardesign.cli.terminal.grids import ProgressDisplay
from lidardesign.cli.terminal.output import Output
from lidardesign.errors import LONGEST_TEXT, BackgroundNote, DataError, pasted, text_of


@pytest.fixture
def lidardesign(call):
    """The program with its first words as one line."""
    return lambda line, *more: call(*line.split(), *more)


@pytest.mark.parametrize(
    ("quiet", "verbose", "said"),
    [(False, False, ["note: act"]), (False, True, ["note: act", "note: decided"]), (True, False, [])],
)
def test_what_nobody_can_act_on_is_said_to_those_who_ask(quiet, verbose, said, capsys):
    output = Output(quiet=quiet, verbose=verbose)
    for note in ("act", BackgroundNote("decided")):
        output.remark(note)
    assert capsys.readouterr().err.splitlines() == said


def test_a_fit_prints_a_line_per_sensor_and_what_limits_it(lidardesign, flat):
    fit = "constrain run --layout even --sensors 3 --rays 30 --set gate.width_m.max=0.2 --name thin"
    lines = lidardesign(fit).out.splitlines()
    assert lines[0] == "thin: 3 sensors, 30 rays per frame (layout even)"
    assert lines[1] == "in the world's frame"
    assert lines[2].split()[0] == "sensor"
    assert [line.split()[0] for line in lines[3:6]] == ["s0", "s1", "s2"]
    assert any(line.startswith("tight: gate.width_m.max") for line in lines[6:])
    assert lines[-2].startswith("took ")
    assert lines[-1] == "design: run/designs/thin.yaml"
    assert len(lines) <= 7 + 3
    assert lidardesign(f"{fit} --quiet").out == "run/designs/thin.yaml\n"
    loud = lidardesign(f"{fit} -v").out
    assert all(words in loud for words in ("bound", "log-likelihood", "where the time went"))
    assert json.loads(lidardesign(f"{fit} --json").out)["design"] == "run/designs/thin.yaml"


def lines_of_work(monkeypatch, seconds, steps=5000):
    """What is said of work of so many seconds away from a terminal."""
    clock, said = SimpleNamespace(now_s=0.0), []
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    with ProgressDisplay("working", said.append, None) as display:
        for step in range(steps):
            clock.now_s = seconds * step / steps
            display.show(step, steps)
    return said


@pytest.mark.parametrize(("seconds", "least", "most"), [(9, 0, 0), (35, 2, 3), (3600, 4, 6), (86400, 100, 150)])
def test_away_from_a_terminal_a_line_comes_now_and_then_with_the_time_that_remains(seconds, least, most, monkeypatch):
    said = lines_of_work(monkeypatch, seconds)
    assert least <= len(said) <= most
    assert all(line.startswith("working: ") and line.endswith(" left") for line in said)


def test_quiet_work_says_nothing(capsys):
    with Output(quiet=True).progress("working") as display:
        display.said_s -= 1e6
        display.show(1, 2)
    assert capsys.readouterr().err == ""


def test_an_export_says_in_one_line_what_the_format_cannot_hold(lidardesign, flat):
    lidardesign("fit run --layout even --sensors 2 --rays 12 --name one")
    export = "export run/designs/one.yaml --format sdf --out one.sdf"
    notes = json.loads(lidardesign(f"{export} --json").out)["notes"]
    short, loud = lidardesign(export), lidardesign(f"{export} -v")
    assert len(notes) > 2
    assert [line.removeprefix("note: ") for line in loud.err.splitlines()] == notes
    assert short.err.startswith("note: ")
    assert short.err.count("\n") == short.out.count("\n") == 1
    assert short.out.startswith("wrote one.sdf (12 rays")
    assert lidardesign(f"{export} --quiet").out == "one.sdf\n"
    assert "sdf" in lidardesign("export --list").out


HOSTILE = "\x1b[31mred\x1b]0;title\x07\r\u202e\x9b"


def test_what_others_wrote_neither_moves_the_terminal_nor_fills_it(capsys):
    output, shown = Output(), r"\x1b[31mred\x1b]0;title\x07\r\u202e\x9b"
    output.note(f"{HOSTILE}\n{'x' * 10**6}")
    output.rich().print(HOSTILE)
    captured = capsys.readouterr()
    assert captured.out == f"{shown}\n"
    assert captured.err.startswith(f"{shown}\nxxx")
    assert len(captured.err) < LONGEST_TEXT + 100
    assert str(DataError(HOSTILE, where=f"{HOSTILE}\nb")) == rf"{shown}\nb: {shown}"
    assert len(text_of(ValueError("x" * 10**7))) < 2000


@pytest.mark.parametrize("name", ["-dash", "--help", "a b", "it's", "$HOME", "`id`", "two\nlines", "~", "ü*", "a;b"])
def test_a_path_in_a_message_can_be_pasted(name):
    echo = subprocess.run(f"printf %s {pasted(name)}", shell=True, capture_output=True, check=True, text=True).stdout
    assert echo == (f"./{name}" if name.startswith("-") else name)
    assert shlex.split(pasted(name)) == [echo]


@pytest.mark.parametrize("text", ["0", "1", "-5", "x", "", "²", "9" * 5000, "1000000000"])
def test_a_width_of_the_environment_that_is_none_is_unknown(lidardesign, monkeypatch, text):
    for name in ("COLUMNS", "LINES", "NUMBA_NUM_THREADS"):
        monkeypatch.setenv(name, text)
    assert "2D scenes in a 3D design space" in lidardesign("tasks list").out
