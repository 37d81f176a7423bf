"""Curves and rows as CSV: readable without colour, honest about units, whatever the names are."""

import csv
import io
from dataclasses import replace

import pytest
from support.evaluations import make_evaluation
from support.sensors import normal_sensor

from lidardesign.evaluation.results import csv_text, write_csv
from lidardesign.report.figures import COLOURS, curve_figure, log_ticks, logarithmic, series
from lidardesign.report.scene_figure import constraint_slack_of
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, -0.3, -0.3, 1.0), (0, 0, 0, 0.3, 0.3, 5.0))


def test_a_design_without_constraints_has_no_bounds_but_those_of_its_space():
    free = DesignSpec("free", (normal_sensor(range_m=3.0, spread_range_m=0.2),))
    assert {one.name.split(".")[0] for one in constraint_slack_of(free, SPACE)} == {"space"}
    bound = replace(free, constraints={"gate": {"width_m": {"max": 1.0}}})
    (row,) = [one for one in constraint_slack_of(bound, SPACE) if one.name == "gate.width_m.max"]
    assert row.room == pytest.approx(1.0 - 2 * 1.959964 * 0.2, abs=1e-5)


def test_series_differ_in_more_than_colour():
    curves = series(make_evaluation(tuple(f"design {i}" for i in range(2 * len(COLOURS)))))
    looks = [(curve.marker, curve.dash) for curve in curves]
    assert len(set(looks)) == len(looks)
    assert [curve.baseline for curve in curves[-2:]] == [True, True]


def test_axes_name_their_units_and_direction():
    layout = curve_figure(make_evaluation(), "bandwidth")["layout"]
    assert layout["xaxis"]["title"]["text"] == "bandwidth [Mbit/s]"
    assert layout["yaxis"]["title"]["text"] == "Chamfer distance [mm]<br>lower is better"


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
    assert {"Chamfer distance [mm]", "bandwidth [Mbit/s]"} <= set(header)
    assert len(lines) == len(evaluation.rows) + len(evaluation.equal_bandwidth)
    assert lines[0][0] == "with, comma"
    assert float(lines[0][2]) == evaluation.rows[0].value
    assert lines[3][0] == "'=cmd()"
    assert lines[-1][header.index("matched_to")] == "with, comma"


@pytest.mark.parametrize("span", [4.1, 20.0, 29.0, 31.0, 1e5])
@pytest.mark.parametrize("low", [0.037, 1.0, 5.7])
def test_a_logarithmic_axis_has_at_least_three_labels_at_round_places_inside_it(low, span):
    ticks = log_ticks([low * span, low])
    assert ticks == sorted(set(ticks))
    assert 3 <= len(ticks) <= 18
    assert low / 1.21 <= ticks[0] < ticks[-1] <= low * span * 1.21
    assert all(f"{tick:.1e}"[:3] in ("1.0", "1.5", "2.0", "3.0", "4.0", "5.0", "6.0", "8.0") for tick in ticks)
