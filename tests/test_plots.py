"""Curves as PNG and rows as CSV: readable without colour, honest about units, whatever the names are."""

import csv
import io
import subprocess
import sys

import numpy as np
import pytest

from lidardesign.evaluate.curves import COLOURS, axis_titles, logarithmic, series
from lidardesign.evaluate.plots import curve_png, write_plots
from lidardesign.evaluate.results import Evaluation, Paired, Row
from lidardesign.evaluate.tables import csv_text, write_csv
from lidardesign.task import Metric

METRIC = Metric("Chamfer distance", "mm", "lower", worst=200.0, tolerance=0.1)


def make_row(name, rays, value, baseline=False, matched_to=None):
    return Row(
        name,
        rays,
        value,
        value * 0.9,
        value * 1.1,
        1,
        rays * 0.01,
        0.5,
        np.array([value]),
        baseline,
        matched_to,
        rays if matched_to else None,
    )


def make_evaluation(names=("first", "second"), rays=(36, 100, 576), value=30.0):
    rows = [make_row(name, n, value / n**0.3 + i) for i, name in enumerate(names) for n in rays]
    baselines = [
        make_row(name, n, 2 * value / n**0.3, True) for name in ("uniform", "bounding") for n in rays
    ]
    paired = [Paired(names[0], "uniform", n, -1.0, -2.0, 0.5) for n in rays]
    matched = [make_row("uniform", n, value, True, names[0]) for n in rays]
    bandwidth = [Paired(names[0], "uniform", n, 1.0, 0.5, 2.0, n) for n in rays]
    return Evaluation(METRIC, 5, [*rows, *baselines], paired, matched, bandwidth, ["a note"])


def test_both_curves_are_written_as_png(tmp_path):
    paths = write_plots(make_evaluation(), tmp_path / "new folder")
    assert [path.name for path in paths] == ["score_against_rays.png", "score_against_bandwidth.png"]
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert sorted(path.name for path in paths[0].parent.iterdir()) == sorted(path.name for path in paths)


def test_the_same_evaluation_gives_the_same_bytes():
    assert curve_png(make_evaluation(), "rays") == curve_png(make_evaluation(), "rays")


@pytest.mark.parametrize("name", ["$x$ and $", "_hidden", "设计", "a" * 300, "<b>", "\\frac"])
def test_any_name_can_be_drawn(name):
    assert curve_png(make_evaluation((name, "other")), "bandwidth")


@pytest.mark.parametrize("value", [0.0, -3.0, 1e-9, 1e9])
def test_any_finite_score_can_be_drawn(value):
    assert curve_png(make_evaluation(value=value), "rays")
    assert curve_png(make_evaluation(rays=(8,), value=value), "rays")


def test_series_differ_in_more_than_colour():
    curves = series(make_evaluation(tuple(f"design {i}" for i in range(2 * len(COLOURS)))))
    looks = [(curve.marker, curve.dash) for curve in curves]
    assert len(set(looks)) == len(looks)
    assert [curve.baseline for curve in curves[-2:]] == [True, True]


def test_axes_name_their_units_and_direction():
    assert axis_titles(make_evaluation(), "bandwidth") == (
        "bandwidth [Mbit/s]",
        "Chamfer distance [mm], lower is better",
    )


def test_logarithmic_axes_need_positive_values_over_a_wide_span():
    assert logarithmic([1.0, 10.0])
    assert not logarithmic([1.0, 2.0])
    assert not logarithmic([0.0, 10.0])
    assert not logarithmic([])


def test_the_table_holds_every_row_with_units_in_its_header(tmp_path):
    evaluation = make_evaluation(("with, comma", "=cmd()"))
    write_csv(evaluation, tmp_path / "rows.csv")
    text = (tmp_path / "rows.csv").read_text(encoding="utf-8")
    assert text == csv_text(evaluation)
    header, *lines = csv.reader(io.StringIO(text))
    assert "Chamfer distance [mm]" in header
    assert "bandwidth [Mbit/s]" in header
    assert len(lines) == len(evaluation.rows) + len(evaluation.equal_bandwidth)
    assert lines[0][0] == "with, comma"
    assert float(lines[0][2]) == evaluation.rows[0].value
    assert lines[3][0] == "'=cmd()"
    assert lines[-1][header.index("matched_to")] == "with, comma"


def test_nothing_draws_before_it_is_asked_to():
    code = (
        "import sys, lidardesign.evaluate.plots, lidardesign.evaluate.report, lidardesign.evaluate.score;"
        "print([m for m in ('matplotlib', 'plotly', 'torch', 'scipy.stats') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
