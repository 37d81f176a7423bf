"""The search for rays: what greedy takes, what swaps leave, where layers begin, and the price of a bandwidth."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.coverages import SUMS, small

from lidardesign.rays.choice import RayCounts, choose, choose_within
from lidardesign.rays.coverage import LARGEST, Coverage

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


def in_units(coverage, worth, mbps=1.0):
    return replace(coverage, weight=worth * coverage.weight, harm=worth * coverage.harm, bits=mbps * coverage.bits)


@pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
@given(
    seed=st.integers(0, 10_000), units=st.sampled_from(UNITS), price=st.sampled_from([0.0, 0.05]), full=st.booleans(),
    kept=st.none() | st.integers(0, 11), owned=st.booleans(), share=st.none() | st.floats(0.4, 1.0),
)  # fmt: skip
def test_no_other_ray_in_the_place_of_one_is_better(table, seed, units, price, full, kept, owned, share):
    coverage, rays = in_units(small(seed, 12, items=6, table=table, harm=0.1 * (not full)), *units), np.arange(12)
    counts = RayCounts(0 * rays, np.array([4]), rays % 3) if owned else RayCounts(rays % 2, np.array([2, 2]))
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
    begun = without if full else [*without, gate]
    more = [np.where(rays == ray, one, few) for few in begun for ray in np.flatnonzero(few < 0) for one in range(2)]
    others = more if full else more + without

    def net(one):
        bits, harm = coverage.charge(one)
        fits = bits <= budget * (1 + 1e-8) and (np.bincount(counts.group[one >= 0], minlength=2) <= counts.most).all()
        return coverage.value_of(one) - harm - price * bits if fits else -np.inf

    assert max(map(net, others), default=-np.inf) <= net(gate) + 1e-8 * choice.worth


class TestLayers:
    @pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
    @pytest.mark.parametrize(("share", "fires"), [(0.009, False), (0.01, False), (0.011, True)])
    @pytest.mark.parametrize("heavy", [1, 2])
    def test_begin_where_no_ray_adds_over_a_hundredth_of_the_mean(self, scale, share, fires, heavy):
        item, counts = np.eye(heavy + 1), RayCounts.of_one(2 * heavy + 1, heavy + 1)
        choice = choose(telling([*item, *item[:heavy]], np.append(np.ones(heavy), share) * scale), counts)
        assert choice.rays.tolist() == [*range(heavy), heavy if fires else heavy + 1]

    @pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
    @pytest.mark.parametrize("count", range(1, 12))
    def test_follow_each_other_however_dear_they_are_and_idle_rays_fire_last(self, count, scale):
        # two idle rays, then three of each item, which are worth 1, 3 and 2
        coverage = telling([[0, 0, 0], [0, 0, 0], *3 * np.eye(3).tolist()], weight=np.array([0.2, 0.6, 0.4]) * scale)
        order = [3, 4, 2, 6, 7, 5, 9, 10, 8, 0, 1]
        for full, most in ((True, count), (False, min(count, 3))):
            found = choose(coverage, RayCounts.of_one(11, count), full=full, price=scale * full)
            assert found.rays.tolist() == sorted(order[:most])

    def test_are_as_cheap_as_the_first_where_a_bandwidth_has_to_last_for_all(self):
        # of each item two dear rays tell all and two cheap ones hardly less; eight idle rays are as cheap
        worth = np.concatenate([np.zeros((8, 4)), *2 * [np.eye(4), 0.995 * np.eye(4)]])
        coverage = telling(worth, 1, [1] * 8 + 2 * (4 * [3] + 4 * [1]))
        found = choose_within(coverage, RayCounts.of_one(24, 8), 8.0)
        assert found.rays.tolist() == [*range(12, 16), *range(20, 24)]


class TestASwap:
    @pytest.mark.parametrize("passes", range(5))
    def test_happens_once_in_a_pass(self, passes):
        # the first of each pair fires; the last ray makes one of these useless, and each second makes the next one so
        item, gate = np.eye(9), np.full(9, -1)
        seconds = item[4:8] + np.pad(item[1:4], ((0, 1), (0, 0)))
        worth = [*item[3::-1], *seconds, item[0] + item[8]]
        coverage = telling(worth, [8, 6, 4, 2, 1, 1, 1, 1, 0.5], 1, 8 * [0] + [0.75])
        counts = RayCounts(np.array([3, 2, 1, 0, 0, 1, 2, 3, 4]), np.ones(5, dtype=int))
        gate[[*range(4 - passes), *range(4, 4 + passes), 8]] = 0
        assert choose(coverage, counts, passes=passes).gate.tolist() == gate.tolist()

    @pytest.mark.parametrize(("harm", "fired"), [(0.0, [0, 1, 2]), (0.25, [0, 1, 2]), (0.2501, [1, 3])])
    @pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
    def test_lets_a_ray_go_that_costs_more_than_it_adds_to_later_ones_and_others_follow(self, scale, harm, fired):
        worth = [[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [1, 1, 0, 0, 1], [1, 0, 0, 0, 1]]
        coverage = in_units(telling(worth, [2, 2, 0.125, 0.125, 0.25], 1, [0, 0, harm, 0]), scale)
        counts = RayCounts(np.array([0, 1, 2, 0]), np.ones(3, dtype=int))
        assert choose(coverage, counts, full=False).rays.tolist() == fired

    def test_brings_no_ray_that_adds_as_much(self):
        worth = [[1, 0, 0], [0, 0.5, 0.75], [1, 0.5, 0]]
        assert choose(telling(worth), RayCounts.of_one(3, 2)).rays.tolist() == [1, 2]

    @pytest.mark.parametrize("owner", [None, np.array([0, 1, 1])])
    def test_never_brings_what_is_not_allowed_however_much_it_tells(self, owner):
        counts = RayCounts(np.zeros(3, dtype=int), np.array([3]), owner)
        assert choose(telling(np.eye(3), 1, [np.inf, 1, 1]), counts, price=0.1).rays.tolist() == [1, 2]

    def test_takes_no_sensor_its_only_ray(self):
        worth = [[0, 0, 0, 0, 0.1], [1, 1, 0, 0, 0], [1, 0, 0.5, 0, 0], [0, 1, 0, 0.5, 0], [0, 0, 0, 0, 0.25]]
        counts = RayCounts(np.zeros(5, dtype=int), np.array([4]), np.array([0, 1, 1, 1, 1]))
        assert choose(telling(worth), counts).rays.tolist() == [0, 2, 3, 4]

    def test_leaves_a_ray_to_every_sensor_beside_those_that_fire_in_any_case(self):
        counts = RayCounts(np.zeros(6, dtype=int), np.array([3]), np.arange(6) // 2)
        found = choose(telling(np.eye(6), np.arange(6, 0, -1.0)), counts, kept=np.where(np.arange(6) == 1, 0, -1))
        assert found.rays.tolist() == [1, 2, 4]


class TestTheBandwidth:
    @pytest.mark.parametrize("units", UNITS)
    @pytest.mark.parametrize(
        ("mbps", "budget", "price"),
        [(1, 1.98, 2), (1, 2.04, 1.25), (1, 2.06, 0.5), (0, 0, 0), ([0, 0, 1, 1], 0, 2.5)],
    )
    def test_has_the_mean_price_of_all_rays_where_that_nearly_spends_it(self, units, mbps, budget, price):
        coverage = in_units(telling(np.eye(4), [2.0, 2.0, 0.5, 0.5], mbps), *units)
        found = choose_within(coverage, RayCounts.of_one(4, 4), budget * units[1], full=False)
        assert found.price == pytest.approx(price * units[0] / units[1], rel=5e-3)

    def test_is_spent_by_swaps_where_no_price_does(self):
        # at any price both items have their dear rays or both their cheap ones
        coverage = telling([*np.eye(2), *0.875 * np.eye(2)], 1, [2, 2, 1, 1])
        found = choose_within(coverage, RayCounts.of_one(4, 2), 3.0)
        assert (found.worth, found.bits, len(found.rays)) == (1.875, 3, 2)

    def test_goes_to_as_many_rays_as_asked_before_it_goes_to_better_ones(self):
        # swapped for the second ray, the first would leave no room for one of the last three
        worth = np.zeros((7, 6))
        worth[[0, 1, 1, 2, 2, 3, 3, 5], [2, 0, 1, 0, 3, 1, 4, 5]] = 1
        coverage = telling(worth, [2, 2, 3, 1, 1, 0.005], [2, 1, 1, 1, 1, 1.04, 1.05])
        counts = RayCounts(np.array([0, 0, 1, 2, 3, 3, 3]), np.ones(4, dtype=int))
        assert choose_within(coverage, counts, 4.05).rays.tolist() == [1, 2, 3, 5]


def test_what_was_chosen_is_itself_alone_and_stays_as_it_is():
    counts = RayCounts.of_one(2, 1)
    for one, field in ((counts, "most"), (choose(telling(np.eye(2)), counts), "gate")):
        assert len({one, replace(one)}) == 2
        with pytest.raises(FrozenInstanceError):
            setattr(one, field, None)
