"""The report's first section: designs against the strongest baseline at the middle number of rays."""

import re
from dataclasses import replace

import pytest
from support.report_pages import NASTY, make_evaluation, make_row, make_sensor

from lidardesign.evaluation.entries import StrongestBaseline
from lidardesign.evaluation.results import Evaluation, Paired
from lidardesign.report.page import result_section
from lidardesign.sensors.design import DesignSpec
from lidardesign.task import Metric

BASELINE = StrongestBaseline("greedy", 25, 20, {"greedy": 5.5, "uniform": 20.0})


def evaluation_of(*pairs, better="lower", baseline=BASELINE, notes=()):
    names = list(dict.fromkeys(pair.a for pair in pairs)) or ["f"]
    rows = [make_row(name, rays, value) for name in names for rays, value in ((9, 10.0), (25, 5.0), (64, 2.0))]
    rows += [make_row(name, rays, 5.5, True) for name in ("greedy", "uniform") for rays in (9, 25, 64)]
    metric = Metric("score", "mm", better, worst=200.0, tolerance=0.1)
    return Evaluation(metric, 8, rows, pairs, notes=notes, strongest_baseline=baseline)


def pair(difference, low, high, rays=25, name="f"):
    return Paired(name, "greedy", rays, difference, low, high)


def test_only_pairs_at_the_number_of_rays_of_its_row_are_told():
    told = pair(-0.6, -0.9, -0.3)
    evaluation = evaluation_of(pair(1.0, 0.5, 1.5, rays=9), told, Paired("f", "uniform", 25, -9.0, -9.0, -9.0))
    assert evaluation.headline_pairs == {"f": told}
    text = result_section(evaluation, [])
    assert text.count('class="verdict"') == 2
    assert "the best of 2 on 20 training scenes" in text


def test_a_design_without_the_middle_number_of_rays_is_shown_at_the_closest():
    evaluation = evaluation_of(pair(-0.6, -0.9, -0.3), pair(-0.6, -0.9, -0.3, name="g"))
    rows = [row for row in evaluation.rows if row.design != "g"]
    fewer = replace(evaluation, rows=[*rows, make_row("g", 30, 2.5)])
    assert {name: row.rays for name, row in fewer.headline_rows.items()} == {"f": 25, "g": 30}


def test_without_baselines_every_design_has_its_score():
    text = result_section(evaluation_of(baseline=None), [])
    assert "f: 5.00 mm at 25 rays." in text
    assert "difference" not in text


def test_of_many_designs_the_best_is_told_about_and_many_notes_are_folded():
    pairs = [pair(-0.6, -0.9, -0.3, name=f"f{number}") for number in range(5)]
    text = result_section(evaluation_of(*pairs, notes=[f"note {number}" for number in range(5)]), [])
    assert len(re.findall("<td class=.better.>better", text)) == 5
    assert "Further notes (3 rows)" in text


@pytest.mark.parametrize("rays", [25, 9])
def test_the_certificate_of_the_rays_that_are_told_about_is_told(rays):
    entry = {"value": 0.8, "bound": 0.76, "gap": 0.05, "held_back_value": 0.9, "candidates": 125, "gates": 5}
    design = DesignSpec("f", (make_sensor(),), certificates=({**entry, "rays": rays, "scenes": 50},))
    text = result_section(evaluation_of(pair(-0.6, -0.9, -0.3)), [design])
    assert ("by more than 5.0 % (f)." in text) == (rays == 25)


def test_no_name_becomes_markup():
    evaluation = make_evaluation(NASTY)
    baseline = StrongestBaseline("uniform", 9, 1, {"uniform": 20.0})
    assert "<img" not in result_section(replace(evaluation, strongest_baseline=baseline, notes=[NASTY] * 4), [])
