"""Groups of rays that fire together: they tell what their rays tell, and cost what these cost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import SUMS, small

from lidardesign.rays.certificate import certify
from lidardesign.rays.choice import RayCounts, choose
from lidardesign.rays.coverage import LARGEST

seeds = st.integers(0, 10_000)


@pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
class TestGroups:
    @given(seed=seeds)
    def test_of_rays_are_worth_and_cost_what_their_rays_do(self, table, seed):
        rays = small(seed, table=table, harm=0.1)
        generator = np.random.default_rng(seed)
        group = generator.integers(0, 3, rays.shape[0])
        groups = rays.grouped([np.flatnonzero(group == index) for index in range(3)])
        chosen = generator.integers(-1, 2, 3)
        assert groups.value_of(chosen) == pytest.approx(rays.value_of(chosen[group]), rel=1e-6)
        assert groups.charge(chosen) == pytest.approx(rays.charge(chosen[group]), rel=1e-12)

    @given(seed=seeds)
    def test_may_share_rays_and_count_some_twice(self, table, seed):
        rays = small(seed, table=table)
        groups = rays.grouped([np.array([0, 1]), np.array([1, 1, 2]), np.array([], dtype=int)])
        alone = [rays.known(np.where(np.arange(7) == ray, 1, -1)) for ray in range(3)]
        known = groups.known(np.array([-1, 1, -1]))
        twice = 2 * alone[1] + alone[2] if len(table) else np.maximum(alone[1], alone[2])
        np.testing.assert_allclose(known, twice, rtol=1e-6)
        assert groups.bits[1] == pytest.approx(2 * rays.bits[1] + rays.bits[2])
        assert groups.value_of(np.array([-1, -1, 0])) == 0

    @given(seed=seeds)
    def test_have_gains_that_are_differences_of_worth_and_a_bound(self, table, seed):
        groups = small(seed, rays=9, table=table).grouped(np.arange(9).reshape(3, 3))
        choice = choose(groups, RayCounts.of_one(3, 2))
        gains = groups.gains(groups.known(choice.gate))
        for index in np.flatnonzero(choice.gate < 0):
            for gate in range(2):
                added = choice.gate.copy()
                added[index] = gate
                assert gains[index, gate] == pytest.approx(groups.value_of(added) - choice.worth, abs=1e-9)
        assert certify(groups, RayCounts.of_one(3, 2), choice)[1] >= choice.worth
