"""What a certificate says of losses: how little any choice of no more bandwidth can lose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import small

from lidardesign.selection.choice import RayCounts, choose
from lidardesign.selection.select import SelectionProblem

fields = ("rays", "gates", "informs", "scenes", "bandwidth", "one_gate", "most_scenes")
PROBLEM = SelectionProblem(**dict.fromkeys(fields), visits=[slice(0, 7)], shares=None, limit_mbps=np.inf, name="small")


@given(st.integers(0, 1000), st.floats(0, 1), st.floats(0, 0.05))
def test_no_choice_loses_less_than_nothing_however_dear_bandwidth_is(seed, price, left):
    coverage = small(seed, gates=3)
    choice = choose(coverage, RayCounts.of_one(7, 3), price=price)
    # next to nothing is left to know
    coverage = replace(coverage, complete=choice.worth - choice.harm + left)
    loss, bound = PROBLEM.certified(coverage, [choice])
    assert 0 <= bound <= loss + 1e-12
