"""What a certificate says of losses: how little any choice of no more bandwidth can lose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import small
from support.rays import random_fan, rays_along

from lidardesign.rays.choice import RayCounts, choose
from lidardesign.rays.selection import Selection
from lidardesign.rays.training_scenes import are_enough
from lidardesign.sensors.bandwidth import Bandwidth

SELECTION = Selection(rays_along(random_fan(7, 1.0)), [slice(0, 7)], gates=None, bandwidth=Bandwidth())


@given(st.integers(0, 1000), st.floats(0, 1), st.floats(0, 0.05))
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


@given(st.integers(0, 1000), st.floats(1, 1e6), st.booleans())
def test_the_price_of_bandwidth_leaves_what_little_can_be_known(seed, unknown, one_gate):
    coverage = small(seed, gates=3)
    if one_gate:
        coverage = coverage.through(np.zeros(7, dtype=np.intp))
    free = choose(coverage, RayCounts.of_one(7, 3))
    (choice,) = SELECTION.choices(replace(coverage, complete=unknown * free.worth), 3)
    assert choice.worth >= 0.8 * free.worth - 1e-9


@given(st.integers(0, 1000), st.floats(0, 0.4))
def test_the_price_of_bandwidth_follows_the_loss_where_little_is_left(seed, left):
    coverage = small(seed, gates=3)
    free = choose(coverage, RayCounts.of_one(7, 3), passes=0)
    (choice,) = SELECTION.choices(replace(coverage, complete=free.worth * (1 + left)), 3)
    assert choice.price == pytest.approx(0.2 * left * free.worth / free.bits)
