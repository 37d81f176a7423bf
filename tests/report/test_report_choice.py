"""Chosen rays in the report: certificates as a table, price curves, and the proxy beside the score."""

from __future__ import annotations

import json
import re

import numpy as np
import plotly.graph_objects as go
import pytest
from support.report_pages import NASTY, make_row, make_sensor

from lidardesign.evaluation.results import Evaluation
from lidardesign.report.choice import choice_section, rank_correlation
from lidardesign.report.figures import series
from lidardesign.sensors.design import DesignSpec
from lidardesign.task import Metric

METRICS = {better: Metric("score", "mm", better, worst=200.0, tolerance=0.1) for better in ("lower", "higher")}
LOSSES = {4: 0.9, 9: 0.5, 16: 0.3, 25: 0.2}


def entry(rays, **further):
    same = {"value": 0.8 * LOSSES[rays], "bound": 0.76 * LOSSES[rays], "gap": 0.05, "held_back_value": LOSSES[rays]}
    return {"rays": rays, **same, "candidates": 125, "gates": 5, "scenes": 50, "unit": "m", **further}


def design_of(entries, name="chosen"):
    return DesignSpec(name, (make_sensor(),), certificates=tuple(entries))


def evaluation_of(scores, better="lower", name="chosen"):
    rows = [make_row(name, rays, score) for rays, score in scores.items()]
    return Evaluation(METRICS[better], 1, rows, [], [], [], [])


def section_of(design, evaluation):
    return choice_section([design], evaluation, {curve.name: curve for curve in series(evaluation)})


def figures_of(text):
    found = re.findall(r'<script type="application/json" data-figure="([^"]+)">(.*?)</script>', text)
    return {name: json.loads(document) for name, document in found}


SCORES = {4: 9.0, 9: 6.0, 16: 5.0, 25: 4.0}
CURVE = [[0.1, 0.7], [0.2, 0.4]]


def test_the_table_has_a_line_for_each_number_of_rays():
    entries = [entry(9, curve=CURVE), entry(16)]
    text = section_of(design_of(entries), evaluation_of(SCORES))
    assert text.count('<th scope="row"') == text.count("5.0 %") == 2
    assert "loss [m]" in text


def test_figures_hold_the_price_curve_and_the_proxy_beside_the_score():
    found = figures_of(section_of(design_of([entry(9, curve=CURVE), entry(16)]), evaluation_of(SCORES)))
    assert all(go.Figure(document).data for document in found.values())
    (curve,), (proxy,) = (found[name]["data"] for name in ("choice-curve", "choice-proxy"))
    assert [curve["x"], curve["y"]] == np.transpose(CURVE).tolist()
    assert [proxy["x"], proxy["y"]] == [[0.5, 0.3], [6.0, 5.0]]


@pytest.mark.parametrize(
    ("better", "scores", "correlation"),
    [
        ("lower", (9.0, 6.0, 5.0, 4.0), "1.00"),
        ("higher", (0.1, 0.3, 0.5, 0.9), "1.00"),
        ("lower", (4.0, 5.0, 6.0, 9.0), "-1.00"),
        ("lower", (9.0, 6.0, 4.0, 5.0), "0.80"),
    ],
)
def test_one_is_said_where_proxy_and_score_order_alike(better, scores, correlation):
    evaluation = evaluation_of(dict(zip(LOSSES, scores, strict=True)), better)
    text = section_of(design_of([entry(rays) for rays in LOSSES]), evaluation)
    assert f"(Spearman) of {correlation} over 4 choices" in text


@pytest.mark.parametrize("pairs", [[], [(1, 1), (2, 2), (3, 3)], [(1, 1)] * 4, [(1, n) for n in range(4)]])
def test_of_too_few_or_equal_choices_no_correlation_is_said(pairs):
    assert rank_correlation(pairs, evaluation_of(SCORES)) is None


@pytest.mark.parametrize("curve", [None, "a", [1, 2], [[1.0]], [[1.0, float("nan")]]])
def test_what_a_file_does_not_hold_whole_is_left_out(curve):
    text = section_of(design_of([entry(9, curve=curve)]), evaluation_of(SCORES))
    assert "choice-curve" not in text
    assert "choice-proxy" in text


def test_designs_without_chosen_rays_have_no_section():
    assert section_of(design_of([]), evaluation_of(SCORES)) == ""


def test_no_name_or_unit_becomes_markup():
    text = section_of(design_of([entry(9, curve=CURVE, unit=NASTY)], NASTY), evaluation_of(SCORES, name=NASTY))
    assert "<script>alert" not in text
    assert "<img" not in text
