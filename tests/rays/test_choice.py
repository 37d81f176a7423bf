"""Choosing rays: greedy with swaps against every choice, and certificates that no choice exceeds."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.coverages import SUMS, relaxed_by_highs, small

from lidardesign.errors import PluginError
from lidardesign.rays.certificate import certify
from lidardesign.rays.choice import RayCounts, choose, choose_within
from lidardesign.rays.coverage import LARGEST, SceneInformation, gather
from lidardesign.rays.information import require_valid
from lidardesign.task import Information

seeds = st.integers(0, 10_000)


def naive_worth(coverage, gate):
    """F of a choice, item by item."""
    total = 0.0
    for item, weight in enumerate(coverage.weight):
        told = [
            float(coverage.worth[entry])
            for ray in np.flatnonzero(gate >= 0)
            for entry in range(coverage.start[ray], coverage.start[ray + 1])
            if coverage.item[entry] == item and coverage.gates[entry] >> gate[ray] & 1
        ]
        known = sum(told) if len(coverage.table) else max(told, default=0.0)
        total += weight * float(coverage.counted(np.float64(known)))
    return total


def every_choice(coverage, counts):
    """All gates of all admissible choices."""
    rays, gates = coverage.shape
    for gate in itertools.product(range(-1, gates), repeat=rays):
        gate = np.array(gate)
        if (np.bincount(counts.group[gate >= 0], minlength=len(counts.most)) <= counts.most).all():
            yield gate


def best_of_all(coverage, choices, price=0.0, budget_mbps=np.inf):
    def objective(gate):
        bits, harm = coverage.charge(gate)
        return coverage.value_of(gate) - harm - price * bits if bits <= min(budget_mbps, 1e9) else -np.inf

    return max(map(objective, choices))


@pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
class TestAChoice:
    @given(seed=seeds)
    def test_counts_what_a_naive_sum_over_items_counts(self, table, seed):
        coverage = small(seed, table=table)
        gate = np.random.default_rng(seed).integers(-1, 2, coverage.shape[0])
        assert coverage.value_of(gate) == pytest.approx(naive_worth(coverage, gate), rel=1e-12)

    @given(seed=seeds)
    def test_gains_are_the_differences_of_worth_and_shrink_as_others_are_taken(self, table, seed):
        coverage = small(seed, table=table)
        rays, gates = coverage.shape
        few, more = np.full((2, rays), -1)
        few[0], more[:2] = 0, (0, 1)
        fewer, further = (coverage.gains(coverage.known(gate)) for gate in (few, more))
        for gate, gains in ((few, fewer), (more, further)):
            for ray, choice in itertools.product(range(2, rays), range(gates)):
                added = np.where(np.arange(rays) == ray, choice, gate)
                gain = coverage.value_of(added) - coverage.value_of(gate)
                assert gains[ray, choice] == pytest.approx(gain, abs=1e-12)
        assert (further[2:] <= fewer[2:] + 1e-12).all()

    @given(
        seed=seeds, price=st.sampled_from([0.0, 0.05, 0.3]), most=st.integers(1, 3),
        share=st.none() | st.floats(0.1, 1.2),
    )  # fmt: skip
    def test_is_not_above_the_best_of_all_and_its_certificate_not_below(self, table, seed, price, most, share):
        coverage, counts = small(seed, table=table, harm=0.05), RayCounts(np.arange(7) % 2, np.array([most, 1]))
        choice, budget = choose(coverage, counts, price=price, full=False), None
        if share is not None:
            price, budget = 0.0, share * choose(coverage, counts).bits
            choice = choose_within(coverage, counts, budget, full=False)
            assert choice.bits <= budget
        best = best_of_all(coverage, every_choice(coverage, counts), price, np.inf if budget is None else budget)
        value, bound = certify(coverage, counts, choice, budget_mbps=budget, full=False)
        bits, harm = coverage.charge(choice.gate)
        assert (choice.worth, choice.bits, choice.harm) == pytest.approx((coverage.value_of(choice.gate), bits, harm))
        assert choice.worth - harm - price * bits <= best + 1e-12
        assert value <= best + 1e-12
        assert bound >= best - 1e-12
        assert (np.bincount(counts.group[choice.rays], minlength=2) <= counts.most).all()

    @settings(max_examples=60)
    @given(
        seed=seeds, harm=st.sampled_from([0.05, 0.5, 3.0]), price=st.sampled_from([0.0, 0.05]),
        share=st.none() | st.floats(0.5, 1.2), owned=st.booleans(), most=st.integers(2, 9), banned=st.booleans(),
    )  # fmt: skip
    def test_that_fills_its_counts_is_bounded_as_all_that_do(
        self, table, seed, harm, price, share, owned, most, banned
    ):
        coverage, owner = small(seed, table=table, harm=harm), np.array([0, 0, 1, 1, 1, 1, 1]) if owned else None
        if banned:
            coverage.bits[3:5] = np.inf
        counts = RayCounts(np.zeros(7, dtype=int), np.array([most]), owner)
        choice, budget = choose(coverage, counts, price=price), None
        if share is not None:
            budget = share * choice.bits
            choice, price = choose_within(coverage, counts, budget), 0.0
        fired = min(most, 7 - 2 * banned)
        others = [gate for gate in every_choice(coverage, counts) if (gate >= 0).sum() == fired]
        if len(choice.rays) < fired:
            others = every_choice(coverage, counts)  # the budget has no room for more, as far as is known
        elif owned and len(set(owner[choice.rays])) == 2:
            others = [gate for gate in others if len(set(owner[gate >= 0])) == 2]
        best = best_of_all(coverage, others, price, np.inf if budget is None else budget)
        value, bound = certify(coverage, counts, choice, budget_mbps=budget)
        assert value <= best + 1e-6
        assert bound >= best - 1e-9

    def test_has_room_in_the_bandwidth_that_its_rays_take_however_bits_are_added_up(self, table):
        coverage = small(0, table=table)
        coverage = replace(coverage, bits=np.full(coverage.shape, 0.1))
        assert 0.1 + 0.1 + 0.1 > 0.3
        assert len(choose_within(coverage, RayCounts.of_one(len(coverage.bits), 3), 0.3).rays) == 3

    @pytest.mark.parametrize(("price", "share"), [(0.0, None), (0.05, None), (0.0, 0.5)])
    def test_loses_little_against_the_best_of_all(self, table, price, share):
        ratios = []
        for seed in range(30):
            coverage, counts = small(seed, table=table), RayCounts.of_one(7, 3)
            budget = np.inf if share is None else share * choose(coverage, counts).bits
            choice = choose(coverage, counts, price=price, full=False)
            choice = choose_within(coverage, counts, budget, full=False) if share else choice
            best = best_of_all(coverage, every_choice(coverage, counts), price, budget)
            ratios.append((choice.worth - price * choice.bits) / best)
        assert np.mean(ratios) >= 0.98
        assert min(ratios) >= 0.8

    @pytest.mark.parametrize(("most", "price"), [(3, 0.0), (3, 0.05), (3, 10.0), (5, 0.0), (5, 10.0)])
    def test_fires_a_ray_of_each_sensor_where_it_has_to_and_is_near_the_best_of_those(self, table, most, price):
        owner, losses = np.array([0, 0, 1, 1, 1, 2, 2]), []
        counts = RayCounts(np.zeros(7, dtype=int), np.array([most]), owner)
        for seed in range(20):
            coverage = small(seed, table=table)
            choice = choose(coverage, counts, price=price)
            assert len(choice.rays) == most
            assert set(owner[choice.rays]) == {0, 1, 2}
            best = max(
                coverage.value_of(gate) - price * coverage.charge(gate)[0]
                for gate in every_choice(coverage, counts)
                if set(owner[gate >= 0]) == {0, 1, 2} and (gate >= 0).sum() == most
            )
            losses.append((best - choice.worth + price * choice.bits) / abs(best))
        assert min(losses) >= -1e-12
        assert np.mean(losses) <= 0.08


@given(seed=seeds)
def test_each_item_has_all_its_entries_from_what_tells_most_of_it(seed):
    coverage = small(seed)
    ordered = coverage.by_item
    for item in range(len(coverage.weight)):
        own = slice(ordered.start[item], ordered.start[item + 1])
        told = coverage.item == item
        assert (np.diff(ordered.worth[own]) <= 0).all()
        found = zip(ordered.ray[own], ordered.worth[own], ordered.gates[own], strict=True)
        entries = zip(coverage.ray[told], coverage.worth[told], coverage.gates[told], strict=True)
        assert sorted(found) == sorted(entries)


@given(seed=seeds)
def test_a_table_with_one_gate_of_each_ray_says_what_the_whole_says_of_these_gates(seed):
    coverage, generator = small(seed), np.random.default_rng(seed)
    gate = generator.integers(0, coverage.shape[1], coverage.shape[0])
    narrowed = coverage.through(gate)
    for kept, anew in zip(narrowed.by_item, replace(narrowed).by_item, strict=True):
        np.testing.assert_array_equal(kept, anew)
    fires = generator.random(len(gate)) < 0.5
    assert narrowed.value_of(np.where(fires, 0, -1)) == coverage.value_of(np.where(fires, gate, -1))


@given(seed=seeds, spare=st.floats(1.0, 1.3))
def test_where_no_ray_tells_anything_as_many_fire_as_fit(seed, spare):
    coverage = small(seed)
    coverage = replace(coverage, worth=np.zeros_like(coverage.worth))
    budget = spare * np.sort(coverage.bits.min(axis=1))[:3].sum()
    assert len(choose_within(coverage, RayCounts.of_one(len(coverage.bits), 3), budget).rays) == 3


@given(seeds, st.integers(1, 6), st.floats(1e-3, 10))
@example(200, 3, 10.0 ** np.random.default_rng(200).uniform(-3, 1))
def test_a_budget_that_is_enough_for_rays_at_some_price_is_enough_for_as_many(seed, count, price):
    coverage = small(seed, rays=20, gates=3, items=4)
    counts = RayCounts(np.random.default_rng(seed).integers(0, 3, 20), np.array([count, 3, 3]))
    known = choose(coverage, counts, price=price, passes=0)
    assert len(choose_within(coverage, counts, known.bits).rays) == len(known.rays)


@pytest.mark.parametrize("price", [0.0, 0.002])
def test_certificates_are_near_the_linear_program_that_they_relax(price):
    coverage, counts = small(3, rays=40, items=30, scenes=4), RayCounts.of_one(40, 8)
    choice = choose(coverage, counts, price=price, full=False)
    value, bound = certify(coverage, counts, choice, full=False, rounds=3000)
    linear, best = (relaxed_by_highs(coverage, 8, price, integral) for integral in (False, True))
    assert value <= best + 1e-6
    assert value >= 0.98 * best
    assert linear - 1e-6 <= bound <= 1.02 * linear


@pytest.mark.parametrize("harm", [0.05, 0.3])
def test_bounds_of_choices_that_fill_their_counts_charge_the_harm_that_rays_cannot_avoid(harm):
    loose = []
    for seed in range(8):
        coverage, counts = small(seed, rays=40, items=30, scenes=4, harm=harm), RayCounts.of_one(40, 16)
        choice = choose(coverage, counts, price=0.01)
        best = relaxed_by_highs(coverage, 16, 0.01, True, full=True)
        bounds = [certify(coverage, counts, choice, full=full)[1] for full in (True, False)]
        assert min(bounds) >= best - 1e-6
        loose.append((np.array(bounds) - best) / (coverage.complete - best))
    exact, unfired = np.median(loose, axis=0)
    assert exact <= 0.01 < 0.1 <= unfired


@given(seed=seeds)
def test_of_what_a_ray_tells_in_several_frames_the_largest_counts_that_a_gate_lets_through(seed):
    generator = np.random.default_rng(seed)
    rays, gates, frames, items = 4, 3, 3, 5
    pair = generator.choice(rays * items * frames, size=40, replace=False)
    ray, item, seen_in = pair // (items * frames), pair // frames % items, pair % frames
    worth = generator.uniform(0, 1, 40)
    returns = [SimpleNamespace(range_m=generator.uniform(1, 2, rays)) for _ in range(frames)]
    gates_m = np.sort(generator.uniform(1, 2, (rays, gates, 2)), axis=2)
    information = Information(ray, item, worth, np.arange(items) % frames, seen_in=seen_in)
    coverage = gather([SceneInformation.of(information, returns)], gates_m, np.zeros((rays, gates)))
    for one, gate in itertools.product(range(rays), range(gates)):
        most = np.zeros(items)
        for e in np.flatnonzero(ray == one):
            low, high = gates_m[one, gate]
            if low <= returns[seen_in[e]].range_m[one] < high:
                most[item[e]] = max(most[item[e]], worth[e])
        chosen = np.full(rays, -1)
        chosen[one] = gate
        np.testing.assert_allclose(np.sort(coverage.known(chosen)), np.sort(most), rtol=1e-6)  # items in any order
        assert coverage.gains(np.zeros(items))[one, gate] == pytest.approx(most.mean(), rel=1e-6)


def test_tables_of_sums_are_concave_but_for_rounding():
    told = Information(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(2, int), sums=np.arange(6) / 5)
    require_valid(told, 1, 1)


@pytest.mark.parametrize("table", [[1.0, 2.0], [0.0, 1.0, 0.5], [0.0, 1.0, 3.0]])
def test_tables_of_sums_that_are_not_concave_are_refused(table):
    told = Information(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(2, int), sums=table, complete=3.0)
    with pytest.raises(PluginError, match="0 at 0, or fall, or rise faster than before"):
        require_valid(told, 1, 1)
