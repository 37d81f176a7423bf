"""What a certificate says of losses, and the price curve: what choices lose, by what they cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.coverages import SUMS, small
from support.rays import random_fan, rays_along

from lidardesign.rays.certificate import certify, price_curve
from lidardesign.rays.choice import RayCounts, choose, choose_within
from lidardesign.rays.coverage import LARGEST
from lidardesign.rays.selection import Selection
from lidardesign.rays.training_scenes import are_enough
from lidardesign.sensors.bandwidth import Bandwidth

seeds = st.integers(0, 10_000)
SELECTION = Selection(rays_along(random_fan(7, 1.0)), [slice(0, 7)], gates=None, bandwidth=Bandwidth())


@given(seeds, st.floats(0, 1), st.floats(0, 0.05))
def test_no_choice_loses_less_than_nothing_however_dear_bandwidth_is(seed, price, left):
    coverage = small(seed, gates=3)
    choice = choose(coverage, RayCounts.of_one(7, 3), price=price)
    # next to nothing is left to know
    coverage = replace(coverage, complete=choice.worth - choice.harm + left)
    loss, bound = SELECTION.certified(coverage, [choice])
    assert 0 <= bound <= loss + 1e-12


@pytest.mark.parametrize(
    ("before", "loss", "own", "enough"),
    [
        (np.inf, 1.00, 0.97, False),  # the first choice
        (1.01, 1.00, 0.97, True),
        (1.01, 1.00, 0.90, False),
        (1.05, 1.00, 0.97, False),
        (0.90, 1.00, 0.97, True),  # held-back scenes scatter
        (1.01, 1.00, 1.20, True),
        (0.0, 0.0, 0.0, True),
    ],
)
def test_scenes_are_enough_where_twice_as_many_gained_little_and_others_lose_as_little(before, loss, own, enough):
    assert are_enough(before, loss, own) is enough


@given(seeds, st.floats(1, 1e6), st.booleans())
def test_the_price_of_bandwidth_leaves_what_little_can_be_known(seed, unknown, one_gate):
    coverage = small(seed, gates=3)
    if one_gate:
        coverage = coverage.through(np.zeros(7, dtype=np.intp))
    free = choose(coverage, RayCounts.of_one(7, 3))
    (choice,) = SELECTION.choices(replace(coverage, complete=unknown * free.worth), 3)
    assert choice.worth >= 0.8 * free.worth - 1e-9


@given(seeds, st.floats(0, 0.4))
def test_the_price_of_bandwidth_follows_the_loss_where_little_is_left(seed, left):
    coverage = small(seed, gates=3)
    free = choose(coverage, RayCounts.of_one(7, 3), passes=0)
    (choice,) = SELECTION.choices(replace(coverage, complete=free.worth * (1 + left)), 3)
    assert choice.price == pytest.approx(0.2 * left * free.worth / free.bits)


@pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
class TestThePriceCurve:
    @given(seed=seeds)
    def test_loses_less_with_more_bandwidth_down_to_what_a_free_choice_loses(self, table, seed):
        coverage, counts = small(seed, gates=4, table=table, harm=0.01), RayCounts.of_one(7, 3)
        mbps, loss = np.array(price_curve(coverage, counts)).T
        assert (np.diff(mbps) > 0).all()
        assert (np.diff(loss) < 0).all()
        free = choose(coverage, counts, passes=0)
        assert loss[-1] <= coverage.complete - (free.worth - free.harm)

    @settings(max_examples=10)
    @given(seed=seeds)
    def test_no_point_is_better_than_what_a_choice_within_its_bandwidth_could_be(self, table, seed):
        coverage, counts = small(seed, gates=4, table=table), RayCounts.of_one(7, 3)
        for mbps, loss in price_curve(coverage, counts):
            choice = choose_within(coverage, counts, mbps)
            bound = certify(coverage, counts, choice, budget_mbps=mbps)[1]
            assert loss >= coverage.complete - bound - 1e-9


def test_bandwidth_falls_to_half_on_the_curve_where_narrow_gates_cost_next_to_nothing():
    coverage, counts = small(4, rays=40, gates=4, items=30), RayCounts.of_one(40, 8)
    points = price_curve(coverage, counts)
    assert points[0][0] < 0.5 * points[-1][0]


def test_gates_that_cost_nothing_have_one_point():
    coverage = small(0)
    coverage.bits[:] = 0.0
    assert len(price_curve(coverage, RayCounts.of_one(7, 3))) == 1
