"""Pictures of error against seconds: every measurement has its place, whatever its figures and its name are."""

import itertools
import math

import plotly.graph_objects as go
import pytest

from lidardesign.report.pareto import (
    ABOVE_PX,
    BELOW_PX,
    LINE_PX,
    PANEL_PX,
    accuracy_tables,
    label_places,
    panels,
    pareto_figures,
)
from lidardesign.scoring.sweep import Measurement, Sweep

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
    assert "40 (run)" in accuracy_tables([single])


def test_every_ladder_has_a_figure_with_all_its_rungs():
    # plotly raises on properties that it does not know
    figures = [go.Figure(figure) for figure in pareto_figures([make_sweep(), make_sweep(knob="second", unit="mm")])]
    marks = [trace for figure in figures for trace in figure.data if trace.mode == "markers"]
    assert [len(trace.x) for trace in marks] == [4, 4]


def test_no_name_becomes_markup():
    measurements = [Measurement(NASTY, 0.1, 0.0, 1.0), Measurement("b", 0.01, 0.0, 2.0)]
    sweep = make_sweep(measurements, knob=NASTY, unit=NASTY, note=NASTY)
    assert "<img" not in accuracy_tables([sweep])
    assert "<img" not in str(pareto_figures([sweep]))


def test_tables_name_what_to_choose_and_what_the_run_does():
    text = accuracy_tables([make_sweep(note="in 3 scenes")])
    assert "64 (run)" in text
    assert text.count("to choose</td>") == 1
    assert "Note: in 3 scenes." in text
    assert "reference" in text
