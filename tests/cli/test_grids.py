"""Tables of figures stay whole at any width: brackets go below where they are too wide."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from lidardesign.cli.terminal.grids import duration, print_table
from lidardesign.run.markup import readable_number

HEADINGS = ("design", "rays", "difference (95 % interval)", "seconds")
LINES = (["free", "196", "-0.013 (-0.021 to -0.004)", "1.4, 2.6"], ["(own)", "36", "0.002 (-0.010 to 0.012)", "3, 3"])


def printed(width):
    console = Console(file=io.StringIO(), width=width, highlight=False)
    print_table("scores", HEADINGS, LINES, console)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [30, 46, 56, 120])
def test_no_figure_is_broken_and_no_line_is_too_wide(width):
    text = printed(width)
    assert all(len(line) <= width for line in text.splitlines())
    for piece in ("-0.013", "(-0.021 to -0.004)", "(95 % interval)", "1.4, 2.6", "(own)"):
        assert piece in text


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(0.04, "0.0 s"), (3.21, "3.2 s"), (9.97, "10 s"), (33.4, "33 s"), (59.7, "1 min 0 s"), (200.0, "3 min 20 s"),
     (7_500.0, "2 h 5 min")],
)  # fmt: skip
def test_times_are_said_as_people_say_them(seconds, shown):
    assert duration(seconds) == shown


def test_very_narrow_terminals_get_columns_in_parts_with_the_names_in_each():
    text = printed(30)
    assert text.count("free") == text.count("(own)") == text.count("design") == 3


def test_sentences_wrap_instead():
    console = Console(file=io.StringIO(), width=40, highlight=False)
    print_table(None, ("effect", "reason"), [["jitter", "photons are timed to 16.6 ps " * 3]], console, wraps=True)
    assert console.file.getvalue().count("jitter") == 1


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [(0.0, 2, "0"), (1300.0, 2, "1,300"), (99.9, 2, "100"), (14.71, 3, "14.7"), (0.0036, 2, "0.0036"),
     (1.7e-7, 2, "<0.0001"), (1.0, 2, "1"), (1.5, 2, "1.5")],
)  # fmt: skip
def test_figures_have_no_exponents(value, digits, shown):
    assert readable_number(value, digits) == shown
