"""The verdict on a density: the worst of its figures decides, and what to do next follows from the preset."""

from __future__ import annotations

from itertools import product

import pytest

from lidardesign.samples import BOUNDS, Verdict

PERFECT = (0.0, 0.0, 1.0)
ORDER = ("good", "usable", "poor")


@pytest.mark.parametrize(
    ("figures", "word", "why"),
    [
        (PERFECT, "good", ""),
        (BOUNDS["good"], "good", ""),
        ((0.3, 0.0, 1.0), "usable", "0.3 of its mass is in the wrong place (good: 0.25)"),
        ((0.0, 0.7, 1.0), "usable", "KL is 0.7 nats (good: 0.5)"),
        ((0.0, 0.0, 0.1), "usable", "ESS is 0.1 (good: 0.2)"),
        (BOUNDS["usable"], "usable", "0.5 of its mass"),
        ((0.41, 11.0, 0.3), "poor", "KL is 11 nats (usable: 2)"),
        ((0.8, 0.0, 1.0), "poor", "0.8 of its mass"),
        ((0.0, 0.0, 0.01), "poor", "ESS is 0.01"),
    ],
)
def test_the_worst_figure_decides(figures, word, why):
    found = Verdict.of(*figures)
    assert (found.word, found.why[: len(why)]) == (word, why)


def test_no_figure_that_is_worse_makes_a_verdict_better():
    steps = [0.0, 0.2, 0.4, 0.6, 3.0]
    for misplaced, kl_nats, ess in product(steps, steps, [1.0, 0.3, 0.1, 0.0]):
        here = ORDER.index(Verdict.of(misplaced, kl_nats, ess).word)
        for worse in ((misplaced + 0.1, kl_nats, ess), (misplaced, kl_nats + 0.5, ess), (misplaced, kl_nats, ess / 2)):
            assert ORDER.index(Verdict.of(*worse).word) >= here


@pytest.mark.parametrize(("preset", "advice"), [("draft", "standard"), ("standard", "fine"), ("fine", "steps")])
def test_what_to_do_next_follows_from_the_preset(preset, advice):
    assert Verdict.of(*PERFECT).text(preset) == "good"
    text = Verdict.of(0.9, 0.1, 0.5).text(preset)
    assert text.startswith("poor: ")
    assert advice in text
