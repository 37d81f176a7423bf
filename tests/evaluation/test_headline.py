"""Gates: what designs are held against, and in which words a miss is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.evaluations import METRIC, make_row
from support.scoring import HitTask, MissTask, design, make_request

from lidardesign.errors import ThresholdError
from lidardesign.estimates import paired_difference
from lidardesign.evaluation.entries import StrongestBaseline
from lidardesign.evaluation.headline import check_better, check_limit, difference_text, headline_texts
from lidardesign.evaluation.results import Evaluation, Paired, verdict
from lidardesign.evaluation.score import evaluate


@pytest.mark.parametrize(
    ("better", "difference", "told"),
    [
        ("lower", (-0.6, -0.9, -0.3), "f3 is better than greedy by 0.60 mm (0.30 to 0.90)"),
        ("higher", (-0.6, -0.9, -0.3), "f3 is worse than greedy by 0.60 mm (0.30 to 0.90)"),
        ("lower", (0.05, -0.07, 0.16), "f3 is not significantly different from greedy (0.05 mm worse, -0.07 to 0.16)"),
        (
            "higher",
            (0.05, -0.07, 0.16),
            "f3 is not significantly different from greedy (0.05 mm better, -0.07 to 0.16)",
        ),
        ("lower", (-0.5, None, None), "f3 is not significantly different from greedy (0.5 mm better)"),
    ],
)
def test_a_difference_is_told_in_one_sentence(better, difference, told):
    assert difference_text(Paired("f3", "greedy", 361, *difference), better, "mm") == f"{told} at 361 rays"


def test_designs_with_the_same_scores_are_the_same_and_rounding_is_no_difference():
    scores = np.array([3.0, 5.0, 7.0, 9.0])
    apart = paired_difference(scores, scores * (1 + 1e-14))
    assert apart == (0.0, 0.0, 0.0)
    assert difference_text(Paired("f", "g", 9, *apart), "lower", "mm") == "f is the same as g in every scene at 9 rays"


def headlines(better, values, gates=9, strongest="greedy"):
    """Headlines of designs with such scores; differences to baselines are exact."""
    scores = {"uniform": 20.0, "bounding": 7.0, "greedy": 5.0}
    rows = [make_row(name, 36, value) for name, value in values.items()]
    rows += [replace(make_row(name, 36, value, True), gates=gates) for name, value in scores.items()]
    pairs = [
        Paired(name, other, 36, value - worth, value - worth - 0.5, value - worth + 0.5)
        for name, value in values.items()
        for other, worth in scores.items()
    ]
    best = StrongestBaseline(strongest, 36, 20, scores)
    return headline_texts(Evaluation(replace(METRIC, better=better), 5, rows, pairs, strongest_baseline=best))


def test_the_best_design_comes_first_beside_what_one_would_place_by_hand():
    placed, strongest = headlines("lower", {"f": 6.0})
    assert "better than uniform by 14.00 mm (13.50 to 14.50) and better than bounding by 1.00 mm" in placed
    assert "9 gates for the 1 of f" in strongest
    assert "f is worse than greedy by 1.00 mm (0.50 to 1.50)" in strongest
    several = headlines("lower", {"f": 6.0, "g": 5.2, "h": 4.0}, gates=1)
    assert several[0].startswith("h, the best design, is better than uniform by 16.00 mm")
    assert "greedy (with no more gates): h is better" in several[1]
    assert several[2:] == ["Against greedy: h is better; f is worse; g: no significant difference"]
    assert headlines("higher", {"f": 6.0, "g": 8.0})[0].startswith("g, the best design, is worse than uniform")
    # a strongest baseline that was compared with is not told again
    assert len(headlines("lower", {"f": 6.0}, strongest="bounding")) == 1


def evaluation_of(pairs, better="lower", names=("f3", "f4"), rays=(196, 361)):
    rows = [make_row(name, count, 5.0) for name in names for count in rays]
    rows += [make_row("greedy", count, 5.0, True) for count in rays]
    return Evaluation(replace(METRIC, better=better), 5, rows, pairs)


BETTER, WORSE, OPEN = (-0.6, -0.9, -0.3), (0.6, 0.3, 0.9), (-0.1, -0.3, 0.1)


@pytest.mark.parametrize("better", ["lower", "higher"])
@pytest.mark.parametrize("kinds", [(BETTER, BETTER), (BETTER, OPEN), (WORSE, BETTER), (BETTER, None)])
def test_designs_must_be_better_at_every_number_of_rays(kinds, better):
    sign = 1.0 if better == "lower" else -1.0

    def pair(rays, kind):
        return Paired("f3", "greedy", rays, sign * kind[0], *sorted(sign * end for end in kind[1:]))

    pairs = [pair(rays, kind) for rays, kind in zip((196, 361), kinds, strict=True) if kind is not None]
    evaluation = evaluation_of(pairs, better, names=("f3",))
    if kinds == (BETTER, BETTER):
        return check_better(evaluation, "greedy")
    with pytest.raises(ThresholdError) as refused:
        check_better(evaluation, "greedy")
    said = {OPEN: "not significantly different", WORSE: "f3 is worse than greedy by 0.60 mm", None: "no score at 361"}
    (missed,) = [kind for kind in kinds if kind != BETTER]
    assert said[missed] in refused.value.message
    assert refused.value.exit_code == 1


def test_a_design_is_held_against_a_design_on_either_side_of_the_pair():
    first, second = Paired("f3", "f4", 196, *BETTER), Paired("f3", "f4", 361, *BETTER)
    check_better(evaluation_of([first, second]), "f4")
    with pytest.raises(ThresholdError, match="f4 is worse than f3 by 0"):
        check_better(evaluation_of([first, second]), "f3")


@pytest.mark.parametrize("task", [MissTask(), HitTask()])
def test_the_gate_is_the_verdict_of_every_pair(task):
    for azimuth in np.random.default_rng(2).uniform(0.0, 0.4, 4):
        evaluation = evaluate(make_request([design("own", azimuth=azimuth)], task=task, equal_bandwidth=False))
        for name in ("uniform", "bounding"):
            verdicts = {verdict(evaluation, pair) for pair in evaluation.paired if pair.b == name}
            try:
                check_better(evaluation, name)
            except ThresholdError:
                assert verdicts != {"better"}
            else:
                assert verdicts == {"better"}


def test_a_limit_is_told_with_its_unit():
    with pytest.raises(ThresholdError, match="f3 at 196 rays: 5 mm") as refused:
        check_limit(evaluation_of([], names=("f3",)), 4.5)
    assert refused.value.allowed == "at most 4.5 mm"
    check_limit(evaluation_of([], names=("f3",)), 5.0)
    check_limit(evaluation_of([], "higher", names=("f3",)), 4.5)
    with pytest.raises(ThresholdError, match="f3 at 196 rays"):
        check_limit(evaluation_of([], "higher", names=("f3",)), 5.5)
