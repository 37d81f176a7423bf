"""The price curve: what choices lose, by what they cost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.coverages import SUMS, small

from lidardesign.rays.certificate import certify, price_curve
from lidardesign.rays.choice import RayCounts, choose, choose_within
from lidardesign.rays.coverage import LARGEST

seeds = st.integers(0, 10_000)
TABLES = pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])


@TABLES
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
