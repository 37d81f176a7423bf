"""Sweeps: which measurement is chosen, what the verdict says, and pictures of error against seconds."""

import itertools
import math
import mmap

import plotly.graph_objects as go
import pytest

from lidardesign.evaluation.sweep import Measurement, Sweep, timed
from lidardesign.report.pareto import (
    ABOVE_PX,
    BELOW_PX,
    LINE_PX,
    PANEL_PX,
    accuracy_section,
    label_places,
    panels,
    pareto_figures,
)

NASTY = "</script><img src=x onerror=alert(1)>$x^2"


def make_sweep(measurements=None, knob="density.points", tolerance=0.02, unit="", note=""):
    measurements = measurements or [
        Measurement("16", 0.2, 0.02, 0.01),
        Measurement("slow", 0.25, 0.02, 0.05),
        Measurement("64", 0.015, 0.002, 0.04, 2_000_000, default=True),
        Measurement("256", 0.0, 0.0, 0.2, reference=True),
    ]
    return Sweep(knob, "what is wrong", unit, "the finest", tolerance, "a reason", "one step", measurements, note)


def test_every_rung_stands_inside_its_panel():
    (panel,) = panels([make_sweep()])
    for mark in panel.marks:
        assert panel.seconds[0] < mark.x < panel.seconds[1]
        assert panel.errors[0] <= mark.low <= mark.y <= mark.high <= panel.errors[1]
    assert panel.errors[0] < panel.sweep.tolerance < panel.errors[1]
    assert [mark.on_edge for mark in panel.marks] == [False, False, False, True]
    assert [mark.chosen for mark in panel.marks] == [False, False, True, False]


def test_the_front_is_what_no_other_rung_beats():
    (panel,) = panels([make_sweep()])
    assert [mark.measurement.setting for mark in panel.front] == ["16", "64", "256"]
    assert [mark.beaten for mark in panel.marks] == [False, True, False, False]
    twins = make_sweep([Measurement("a", 0.1, 0, 1.0), Measurement("b", 0.1, 0, 1.0)])
    assert [mark.beaten for mark in panels([twins])[0].marks] == [False, False]


@pytest.mark.parametrize(
    "measurements",
    [
        [Measurement("a", 0.0, 0.0, 0.0), Measurement("b", 0.0, 0.0, 0.0)],
        [Measurement("a", 1e-30, 0.0, 1e-9), Measurement("b", 1e9, 1e9, 1e6)],
        [Measurement("a", 0.5, 5.0, 1.0), Measurement("b", 0.5, 0.0, 1.0)],
        [Measurement("a", math.inf, math.nan, 1.0), Measurement("b", 0.5, 0.0, 1.0)],
    ],
)
@pytest.mark.parametrize("tolerance", [0.0, math.inf])
def test_figures_without_a_logarithm_are_drawn_too(measurements, tolerance):
    sweep = make_sweep(measurements, tolerance=tolerance)
    (panel,) = panels([sweep])
    ends = (*panel.seconds, *panel.errors, *(value for mark in panel.marks for value in (mark.x, mark.y, mark.low)))
    assert all(math.isfinite(value) and value > 0 for value in ends)
    assert go.Figure(pareto_figures([sweep])[0]).data


def test_settings_that_would_meet_are_written_above_each_other():
    measurements = [Measurement(f"without effect {i}", 0.1 * (1 + i / 100), 0.0, 1.0 + i / 100) for i in range(6)]
    (panel,) = panels([make_sweep(measurements)])
    height = PANEL_PX - ABOVE_PX - BELOW_PX
    spread = math.log(panel.errors[1] / panel.errors[0])
    places = [
        height * math.log(mark.y / panel.errors[0]) / spread + up
        for mark, (_, up, _) in zip(panel.marks, label_places(panel), strict=True)
    ]
    assert min(b - a for a, b in itertools.pairwise(sorted(places))) >= LINE_PX * (1 - 1e-9)


def test_ladders_of_one_rung_have_tables_and_no_panel():
    single = make_sweep([Measurement("40", 0.3, 0.1, 2.0, default=True)])
    assert panels([single]) == []
    assert pareto_figures([single]) == []
    assert "40 (run)" in accuracy_section([single])


def test_every_ladder_has_a_figure_with_all_its_rungs():
    # plotly raises on properties that it does not know
    figures = [go.Figure(figure) for figure in pareto_figures([make_sweep(), make_sweep(knob="second", unit="mm")])]
    marks = [trace for figure in figures for trace in figure.data if trace.mode == "markers"]
    assert [len(trace.x) for trace in marks] == [4, 4]


def test_no_name_becomes_markup():
    measurements = [Measurement(NASTY, 0.1, 0.0, 1.0), Measurement("b", 0.01, 0.0, 2.0)]
    sweep = make_sweep(measurements, knob=NASTY, unit=NASTY, note=NASTY)
    assert "<img" not in accuracy_section([sweep])
    assert "<img" not in str(pareto_figures([sweep]))


def test_tables_name_what_to_choose_and_what_the_run_does():
    text = accuracy_section([make_sweep(note="in 3 scenes")])
    assert "64 (run)" in text
    assert text.count("to choose</td>") == 1
    assert "Note: in 3 scenes." in text
    assert "reference" in text


def sweep(*measurements, tolerance=0.1):
    return Sweep("knob", "the error", "mm", "the finest", tolerance, "a reason", "some work", measurements)


def measure(setting, error, seconds, **changes):
    return Measurement(setting, error, changes.pop("uncertainty", 0.0), seconds, **changes)


OWN = {"default": True}


@pytest.mark.parametrize(
    ("errors_and_seconds", "verdict"),
    [
        # the cheapest inside the tolerance; of those that cost the same, the most accurate
        ([(0.5, 1.0), (0.05, 2.0), (0.01, 4.0, OWN)], "b suffices, 2 times cheaper than c"),
        ([(0.05, 1.0), (0.01, 1.1), (0.0, 2.0)], "b suffices"),
        # what the run does stays where it is inside and nothing is cheaper by more than can be told
        ([(0.05, 1.0, OWN), (0.02, 1.1)], "a, the setting of this run, is the one to choose"),
        ([(0.15, 1.0, OWN), (0.02, 1.1)], "b is needed"),
        ([(0.08, 1.0), (0.05, 1.1), (0.01, 1.25, OWN)], "c, the setting of this run, is the one to choose"),
        ([(0.08, 1.0), (0.05, 1.1), (0.01, 1.4, OWN)], "b suffices, 1.3 times cheaper than c"),
        # an error that is not known to be inside is not
        ([(0.05, 1.0, {"uncertainty": 0.2}), (0.05, 2.0, {"uncertainty": 0.01})], "b suffices"),
        ([(0.05, 1.0, {"uncertainty": 0.2, **OWN}), (0.05, 2.0)], "b is needed"),
        # outside the tolerance the most accurate is closest
        ([(0.5, 1.0), (0.3, 2.0, OWN)], "b is closest"),
        ([(0.3, 1.0), (0.5, 2.0), (0.05, 3.0)], "c suffices; but errors do not fall here"),
    ],
)
def test_the_cheapest_measurement_that_is_surely_inside_the_tolerance_is_chosen(errors_and_seconds, verdict):
    rows = zip("abc", errors_and_seconds, strict=False)
    found = sweep(*(measure(name, *row[:2], **dict(*row[2:])) for name, row in rows))
    assert found.chosen.setting == verdict[0]
    assert verdict in found.verdict


def test_errors_fall_within_their_uncertainty():
    assert sweep(measure("a", 0.5, 1.0), measure("b", 0.3, 1.0)).falls
    assert not sweep(measure("a", 0.3, 1.0), measure("b", 0.5, 1.0)).falls
    assert sweep(measure("a", 0.3, 1.0, uncertainty=0.1), measure("b", 0.5, 1.0, uncertainty=0.1)).falls


def test_a_row_has_the_keys_of_the_contract():
    (row,) = sweep(measure("a", 0.05, 1.0, values={"worst_mm": 1.0})).as_rows()
    assert {"knob", "setting", "error", "unit", "seconds", "chosen"} <= set(row)
    assert row["chosen"] is True
    assert row["values"] == {"worst_mm": 1.0}


def touched(size):
    """Fresh pages of the system: what the process freed before may be handed out again without growing it."""
    with mmap.mmap(-1, size) as fresh:
        for page in range(0, size, mmap.PAGESIZE):
            fresh[page] = 1
    return size


def test_a_timed_call_gives_its_value_and_the_memory_of_what_it_held():
    size = 50_000_000
    value, seconds, memory = timed(lambda: touched(size))
    assert value == size
    assert seconds > 0
    assert memory is None or memory > 0.8 * size
