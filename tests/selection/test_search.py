"""The search for rays: what greedy takes, what swaps leave, where layers begin, and the price of a bandwidth."""

from __future__ import annotations

import itertools
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.coverages import SUMS, small

from lidardesign.rays.choice import RayCounts, choose, choose_within
from lidardesign.rays.coverage import LARGEST, Coverage

seeds = st.integers(0, 10_000)
UNITS = [(1.0, 1.0), (1e-6, 1e3), (1e6, 1e-3)]  # of worth and of bandwidth
SENSOR = np.arange(12) % 3


def telling(worth, weight=1.0, bits=1.0, harm=0.0):
    """A table of what rays with one gate tell about items, (N, U)."""
    rays, items = np.shape(worth)
    ray, item = np.nonzero(worth)
    bits, harm = (np.array(np.broadcast_to(one, rays), dtype=float)[:, None] for one in (bits, harm))
    return Coverage(
        np.searchsorted(ray, np.arange(rays + 1)), item.astype(np.int32), np.float32(worth)[ray, item],
        np.ones(len(ray), dtype=np.uint8), np.array(np.broadcast_to(weight, items), dtype=float), bits, harm,
    )  # fmt: skip


def in_units(coverage, worth, mbps):
    return replace(coverage, weight=worth * coverage.weight, harm=worth * coverage.harm, bits=mbps * coverage.bits)


def net(coverage, gate, price):
    bits, harm = coverage.charge(gate)
    return coverage.value_of(gate) - harm - price * bits


def with_one_more(gate):
    """Choices of one more ray through either gate."""
    for ray, one in itertools.product(np.flatnonzero(gate < 0), range(2)):
        yield np.where(np.arange(len(gate)) == ray, one, gate)


@pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
@given(
    seed=seeds, units=st.sampled_from(UNITS), price=st.sampled_from([0.0, 0.05]), full=st.booleans(),
    kept=st.none() | st.integers(0, 11), owned=st.booleans(), share=st.none() | st.floats(0.4, 1.0),
)  # fmt: skip
def test_no_other_ray_in_the_place_of_one_is_better(table, seed, units, price, full, kept, owned, share):
    coverage, rays = in_units(small(seed, 12, items=6, table=table, harm=0.1 * (not full)), *units), np.arange(12)
    counts = RayCounts(rays % 2, np.array([2, 2]))
    counts = RayCounts(np.zeros(12, dtype=int), np.array([4]), rays % 3) if owned else counts
    options = {"full": full, "kept": None if kept is None else np.where(rays == kept, seed % 2, -1)}
    budget, price = np.inf, price * (not full) * units[0] / units[1]
    choice = choose(coverage, counts, price=price, **options)
    if share is not None and not full:
        budget, price = share * choice.bits, 0.0
        assume(kept is None or budget >= coverage.bits[kept].max())
        choice = choose_within(coverage, counts, budget, **options)
    gate = choice.gate
    loyal = (rays == kept) | owned & (np.bincount(rays[gate >= 0] % 3, minlength=3)[rays % 3] == 1)
    without = [np.where(rays == ray, -1, gate) for ray in np.flatnonzero((gate >= 0) & ~loyal)]
    others = [one for few in without for one in with_one_more(few)]
    others += [] if full else [*without, *with_one_more(gate)]
    fired = [np.bincount(counts.group[one >= 0], minlength=len(counts.most)) for one in others]
    nets = [
        net(coverage, one, price)
        for one, number in zip(others, fired, strict=True)
        if (number <= counts.most).all() and coverage.charge(one)[0] <= budget
    ]
    assert max(nets, default=-np.inf) <= net(coverage, gate, price) + 1e-8 * choice.worth
    assert kept is None or gate[kept] == seed % 2


class TestLayers:
    @pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
    @pytest.mark.parametrize(("share", "fires"), [(0.009, False), (0.01, False), (0.011, True)])
    @pytest.mark.parametrize("heavy", [1, 2])
    @pytest.mark.parametrize("kept", [-1, 0])
    def test_begin_where_no_ray_adds_over_a_hundredth_of_the_mean(self, scale, share, fires, heavy, kept):
        item = np.eye(heavy + 1)
        coverage = telling([*item, *item[:heavy]], np.append(np.ones(heavy), share) * scale)
        gate = np.append(kept, np.full(2 * heavy, -1))
        choice = choose(coverage, RayCounts.of_one(2 * heavy + 1, heavy + 1), kept=gate)
        assert choice.rays.tolist() == [*range(heavy), heavy if fires else heavy + 1]

    @pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
    @pytest.mark.parametrize("count", range(1, 12))
    def test_follow_each_other_and_idle_rays_fire_last(self, count, scale):
        # two idle rays, then three of each item, which are worth 1, 3 and 2
        coverage = telling([[0, 0, 0], [0, 0, 0], *3 * np.eye(3).tolist()], weight=np.array([0.2, 0.6, 0.4]) * scale)
        order = [3, 4, 2, 6, 7, 5, 9, 10, 8, 0, 1]
        counts = RayCounts.of_one(11, count)
        assert choose(coverage, counts).rays.tolist() == sorted(order[:count])
        assert choose(coverage, counts, full=False).rays.tolist() == sorted(order[: min(count, 3)])

    def test_are_as_cheap_as_the_first_where_a_bandwidth_has_to_last_for_all(self):
        # of each item two dear rays tell all and two cheap ones hardly less; eight idle rays are as cheap
        worth = np.concatenate([np.zeros((8, 4)), *2 * [np.eye(4), 0.995 * np.eye(4)]])
        coverage = telling(worth, bits=np.array([1] * 8 + 2 * ([3] * 4 + [1] * 4)))
        choice = choose_within(coverage, RayCounts.of_one(24, 8), 8.0)
        assert choice.rays.tolist() == [12, 13, 14, 15, 20, 21, 22, 23]
        assert choice.bits == 8.0


class TestASwap:
    @pytest.mark.parametrize("passes", range(6))
    def test_happens_once_in_a_pass(self, passes):
        # the first of each pair fires; the last ray makes one of these useless, and each second makes the next one so
        item, gate = np.eye(9), np.full(9, -1)
        seconds = item[4:8] + np.pad(item[1:4], ((0, 1), (0, 0)))
        worth = [*item[3::-1], *seconds, item[0] + item[8]]
        coverage = telling(worth, [8, 6, 4, 2, 1, 1, 1, 1, 0.5], 1, 8 * [0] + [0.75])
        counts = RayCounts(np.array([3, 2, 1, 0, 0, 1, 2, 3, 4]), np.ones(5, dtype=int))
        swapped = min(passes, 4)
        gate[[*range(4 - swapped), *range(4, 4 + swapped), 8]] = 0
        assert choose(coverage, counts, passes=passes).gate.tolist() == gate.tolist()

    @pytest.mark.parametrize(("harm", "fired"), [(0.0, [0, 1, 2]), (0.25, [0, 1, 2]), (0.2501, [1, 3])])
    @pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
    def test_lets_a_ray_go_that_costs_more_than_it_adds_to_later_ones_and_others_follow(self, scale, harm, fired):
        worth = [[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [1, 1, 0, 0, 1], [1, 0, 0, 0, 1]]
        coverage = in_units(telling(worth, [2, 2, 0.125, 0.125, 0.25], 1, [0, 0, harm, 0]), scale, 1)
        counts = RayCounts(np.array([0, 1, 2, 0]), np.ones(3, dtype=int))
        assert choose(coverage, counts, full=False).rays.tolist() == fired

    def test_brings_no_ray_that_adds_as_much(self):
        coverage = telling([[1, 0, 0], [0, 0.5, 0.75], [1, 0.5, 0]])
        assert choose(coverage, RayCounts.of_one(3, 2)).rays.tolist() == [1, 2]

    @pytest.mark.parametrize("count", [2, 3])
    def test_never_brings_what_is_not_allowed_however_much_it_tells(self, count):
        coverage = telling(np.eye(3), bits=[np.inf, 1.0, 1.0])
        for owner in (None, np.array([0, 1, 1])):
            found = choose(coverage, RayCounts(np.zeros(3, dtype=int), np.array([count]), owner), price=0.1)
            assert found.rays.tolist() == [1, 2]

    def test_leaves_a_ray_to_every_sensor_beside_those_that_fire_in_any_case(self):
        coverage = telling(np.eye(6), weight=np.arange(6, 0, -1.0))
        counts = RayCounts(np.zeros(6, dtype=int), np.array([3]), np.arange(6) // 2)
        assert choose(coverage, counts, kept=np.array([-1, 0, -1, -1, -1, -1])).rays.tolist() == [1, 2, 4]


class TestThePriceOfABandwidth:
    @given(seed=seeds, units=st.sampled_from(UNITS), share=st.floats(0.02, 0.95))
    def test_is_what_rays_that_tell_of_different_items_must_be_worth_a_bit(self, units, seed, share):
        generator = np.random.default_rng(seed)
        bits = generator.uniform(0.2, 1.0, 30)
        coverage = in_units(telling(np.eye(30), generator.uniform(0, 1, 30), bits), *units)
        counts, budget = RayCounts.of_one(30, 30), share * bits.sum() * units[1]
        found = choose_within(coverage, counts, budget, full=False)
        ratio, bits = coverage.weight / coverage.bits[:, 0], coverage.bits[:, 0]
        spent, with_more = (bits[ratio > price].sum() for price in (found.price, 0.99 * found.price))
        assert spent <= budget * (1 + 1e-8)
        assert spent >= 0.98 * budget or with_more > budget

    @pytest.mark.parametrize(("budget", "price"), [(0.99, 2.0), (1.0, 1.25), (1.02, 1.25), (1.03, 0.5), (1.99, 0.5)])
    def test_is_the_mean_of_all_rays_where_that_nearly_spends_it(self, budget, price):
        coverage = telling(np.eye(4), [1.0, 1.0, 0.25, 0.25], 0.5)
        found = choose_within(coverage, RayCounts.of_one(4, 4), budget, full=False)
        assert found.price == pytest.approx(price, rel=5e-3)

    @pytest.mark.parametrize("full", [True, False])
    def test_leaves_room_that_swaps_spend(self, full):
        # at any price both items have their dear rays or both their cheap ones
        coverage = telling([*np.eye(2), *0.875 * np.eye(2)], 1, [2, 2, 1, 1])
        found = choose_within(coverage, RayCounts.of_one(4, 2), 3.0, full=full)
        assert (found.worth, found.bits, len(found.rays)) == (1.875, 3, 2)

    @pytest.mark.parametrize("full", [True, False])
    def test_is_nothing_where_bandwidth_costs_nothing(self, full):
        found = choose_within(telling(np.eye(2), bits=0.0), RayCounts.of_one(2, 2), 0.0, full=full)
        assert (found.price, found.rays.tolist()) == (0.0, [0, 1])


def test_what_was_chosen_is_itself_alone_and_stays_as_it_is():
    counts = RayCounts.of_one(2, 1)
    for one, field in ((counts, "most"), (choose(telling(np.eye(2)), counts), "gate")):
        assert len({one, replace(one)}) == 2
        with pytest.raises(FrozenInstanceError):
            setattr(one, field, None)
