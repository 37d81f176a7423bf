"""Patterns that follow what they see: the rule, what fires in which frame, and patterns that are better than one."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import LARGEST, SUMS, small
from support.rays import rays_along

from lidardesign.errors import DataError, PluginError
from lidardesign.rays.adaptive import Frames, PatternSearch
from lidardesign.rays.choice import RayCounts, choose, choose_within
from lidardesign.rays.information import features_of
from lidardesign.rays.selection import Selection
from lidardesign.rays.training_scenes import SceneInformation
from lidardesign.scenes.rays import Outcome, Returns
from lidardesign.sensors.adaptive import AdaptiveRays, PatternRule, mapped, mean_mbps, returns_of
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.task import Information

seeds = st.integers(0, 10_000)
NOTHING = float("nan")


class TestARule:
    @given(seed=seeds, patterns=st.integers(1, 5), features=st.integers(1, 3))
    def test_picks_the_nearest_centroid(self, seed, patterns, features):
        generator = np.random.default_rng(seed)
        centroids, found = generator.normal(size=(patterns, features)), generator.normal(size=(20, features))
        away = np.array([[np.linalg.norm(one - centroid) for centroid in centroids] for one in found])
        assert PatternRule(centroids).patterns_of(found).tolist() == (1 + away.argmin(axis=1)).tolist()

    @pytest.mark.parametrize(
        ("feature", "pattern"),
        [([1.0, 0.0], 1), ([0.0, 0.0], 1), ([0.0, 9.0], 1), ([-0.1, 0.0], 3), ([NOTHING, 0.0], 0),
         ([1.0, NOTHING], 0), ([np.inf, 0.0], 0), ([1.0, -np.inf], 0)],
    )  # fmt: skip
    def test_picks_the_first_of_equally_near_ones_and_none_without_numbers(self, feature, pattern):
        rule = PatternRule(np.array([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]]))
        assert rule.pattern_of(np.array(feature)) == pattern

    @pytest.mark.parametrize(
        ("range_m", "features", "pattern"),
        [
            ([1.0, 2.0], [1.0, 2.0], 1),
            ([NOTHING, 2.0], [5.0, 2.0], 1),
            ([1.0, NOTHING], [1.0, 7.0], 2),
            ([NOTHING, NOTHING], [NOTHING, NOTHING], 0),
        ],
    )
    def test_takes_a_miss_for_a_range_unless_all_rays_miss(self, range_m, features, pattern):
        rule = PatternRule(np.array([[1.0, 2.0], [5.0, 7.0]]), 2, np.array([5.0, 7.0]))
        np.testing.assert_array_equal(rule.ranges(np.array([range_m, [3.0, 3.0]])), [features, [3.0, 3.0]])
        assert rule.pattern_of(rule.ranges(np.array(range_m))) == pattern


RAYS = rays_along([[1, 0, 0], [0, 1, 0]])
LISTS = tuple(replace(RAYS, gate_m=np.full((2, 2), [0.0, end_m])) for end_m in (1.0, 2.0, 4.0))


def heard(range_m, rays=RAYS, frame=0):
    """Returns with these ranges; not a number for a miss."""
    range_m = np.array(range_m, dtype=float)
    outcome = np.where(np.isnan(range_m), Outcome.MISS, Outcome.RETURN)
    return Returns(rays, outcome, range_m, np.where(np.isnan(range_m), -1, 0), frame)


def first_range(scene, returns):
    """A feature that is the range of the first ray."""
    return returns.range_m[:1]


class TestWhatFires:
    def test_within_a_frame_follows_the_first_look_of_the_same_frame(self):
        rule = PatternRule(np.array([[1.0], [3.0]]), 1, np.array([9.0]))
        rays = AdaptiveRays(LISTS, rule, np.full(3, 1 / 3))
        looked = [3.0, 0.9, NOTHING, 2.1, 1.9]
        returns = [[heard([one, pattern], frame=f) for f, one in enumerate(looked)] for pattern in range(3)]
        assert rays.fired(None, returns) == [2, 1, 0, 2, 1]
        assert [one.range_m[1] for one in returns_of(rays, None, returns)] == [2, 1, 0, 2, 1]
        assert [one.frame for one in returns_of(rays, None, returns)] == [0, 1, 2, 3, 4]

    @given(seed=seeds, frames=st.integers(1, 8))
    def test_is_what_a_walk_through_the_frames_finds(self, seed, frames):
        generator = np.random.default_rng(seed)
        rule = PatternRule(generator.uniform(0, 4, (2, 1)))
        ranges = np.where(generator.random((3, frames)) < 0.3, np.nan, generator.uniform(0, 4, (3, frames)))
        returns = [[heard([one, 0.0]) for one in own] for own in ranges]
        now, walked = 0, []
        for frame in range(frames):
            walked.append(now)
            seen = ranges[now, frame]
            now = 0 if np.isnan(seen) else 1 + int(np.abs(rule.centroids[:, 0] - seen).argmin())
        assert AdaptiveRays(LISTS, rule, np.ones(3) / 3, first_range).fired(None, returns) == walked
        assert AdaptiveRays(LISTS, rule, np.ones(3) / 3).fired(None, returns) == [0] * frames

    @pytest.mark.parametrize("number", [0, 1, 3])
    def test_refuses_features_that_the_rule_does_not_have(self, number):
        rays = AdaptiveRays(LISTS, PatternRule(np.zeros((2, 2))), np.ones(3) / 3, lambda *_: np.zeros(number))
        with pytest.raises(DataError, match=f"{number} features") as refusal:
            rays.fired(None, [[heard([1.0, 1.0])] * 2] * 3)
        assert "adaptive" in refusal.value.where

    @pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
    def test_is_the_same_in_workers(self, copied):
        rule = PatternRule(np.array([[1.0], [3.0]]), 1, np.array([9.0]))
        rays = copied(AdaptiveRays(LISTS, rule, np.array([0.5, 0.25, 0.25]), first_range))
        assert isinstance(rays, AdaptiveRays)
        assert [one.gate_m.tolist() for one in rays] == [one.gate_m.tolist() for one in LISTS]
        assert (rays.rule.centroids.tolist(), rays.rule.looks, rays.rule.missing_m.tolist()) == ([[1], [3]], 1, [9])
        assert rays.shares.tolist() == [0.5, 0.25, 0.25]
        assert rays.features is first_range

    @given(shares=st.lists(st.floats(0.1, 1), min_size=3, max_size=3))
    def test_takes_the_bandwidth_of_each_pattern_as_often_as_it_fires_also_after_a_change(self, shares):
        shares, bandwidth = np.array(shares) / sum(shares), Bandwidth()
        rays = AdaptiveRays(LISTS, PatternRule(np.zeros((2, 1))), shares, first_range)
        mbps = [bandwidth.mbps(one) for one in LISTS]
        assert mean_mbps(rays, bandwidth) == pytest.approx(sum(s * m for s, m in zip(shares, mbps, strict=True)))
        assert mean_mbps(LISTS, bandwidth) == pytest.approx(np.mean(mbps))
        halved = mapped(rays, lambda one: one.subset(np.array([0])))
        assert isinstance(halved, AdaptiveRays)
        assert (halved.rule, halved.features) == (rays.rule, first_range)
        assert mean_mbps(halved, bandwidth) == pytest.approx(mean_mbps(rays, bandwidth) / 2)
        assert type(mapped(LISTS, lambda one: one)) is tuple


@pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
class TestRaysThatAreKept:
    @given(seed=seeds, number=st.integers(1, 4), share=st.none() | st.floats(0.5, 1.2), price=st.floats(0, 1))
    def test_fire_with_their_gates_among_as_many_as_are_asked_for(self, table, seed, number, share, price):
        coverage, generator = small(seed, table=table, harm=0.2), np.random.default_rng(seed)
        kept = np.full(7, -1)
        kept[generator.permutation(7)[:number]] = generator.integers(0, 2, number)
        counts = RayCounts.of_one(7, 4)
        found = choose(coverage, counts, price=price, kept=kept)
        if share is not None:
            budget = max(share * found.bits, coverage.charge(kept)[0])
            found = choose_within(coverage, counts, budget, kept=kept)
            assert found.bits <= budget * (1 + 1e-8)
        assert (found.gate[kept >= 0] == kept[kept >= 0]).all()
        assert len(found.rays) <= 4
        assert share is not None or len(found.rays) == 4
        assert found.worth == pytest.approx(coverage.value_of(found.gate))

    @given(seed=seeds, share=st.floats(0.3, 1.2))
    def test_change_nothing_where_there_are_none(self, table, seed, share):
        coverage, counts = small(seed, table=table), RayCounts(np.arange(7) % 2, np.array([2, 1]))
        free, none = choose(coverage, counts), np.full(7, -1)
        np.testing.assert_array_equal(choose(coverage, counts, kept=none).gate, free.gate)
        within = [choose_within(coverage, counts, share * free.bits, **one).gate for one in ({}, {"kept": none})]
        np.testing.assert_array_equal(*within)


# Frames of two kinds: rays 0 and 1 look, of which the first tells of which kind it is; 2 to 5 see one kind, 6 to 9 the
# other.
KINDS = {0: (2, 3, 4, 5), 1: (6, 7, 8, 9)}
ONE_GATE_M = np.tile([(1.0, 2.0)], (10, 1, 1))
GATES_M = np.tile([(0.5, 2.5), (1.0, 2.0)], (10, 1, 1))


def frame_of(kind, generator):
    """What the returns of ten candidates tell about a frame, and their ranges."""
    told = np.array([0, 1, *KINDS[kind]])
    range_m = np.full(10, np.nan)
    range_m[told] = generator.uniform(1.2, 1.8, len(told))
    range_m[0] = 1.2 + 0.5 * kind + generator.uniform(0, 0.05)
    information = Information(told, np.arange(6), np.array([2.0, 1.9, 1, 1, 1, 1]), np.zeros(6, int), complete=2.0)
    return SceneInformation.of(information, [SimpleNamespace(range_m=range_m)]), range_m


def frames_of_kinds(kinds, seed, features=None):
    generator = np.random.default_rng(seed)
    informed, ranges = zip(*(frame_of(kind, generator) for kind in kinds), strict=True)
    return Frames(informed, np.array(ranges, dtype=np.float32), features)


def searched(frames, held_back, gates_m=ONE_GATE_M, limit_mbps=np.inf):
    """A search for patterns of four of ten candidates, and the single pattern that it starts from."""
    rays = rays_along(np.eye(3)[np.arange(10) % 3], (0.5, 2.5))
    selection = Selection(rays, [slice(0, 10)], lambda *_: gates_m, Bandwidth(), limit_mbps)
    (fixed,) = selection.choices(selection.coverage(frames.informed, gates_m), 4)
    return PatternSearch(selection, gates_m, fixed, frames, held_back, seed=0), fixed


def mbps_of(search, gate):
    return Bandwidth().mbps_of_widths(np.diff(search.gate_m(gate)[gate >= 0])[:, 0])


class TestASearch:
    @pytest.mark.parametrize("has_looks", [True, False])
    @pytest.mark.parametrize("limit_mbps", [np.inf, 0.12, 0.3])
    @pytest.mark.parametrize("gates_m", [ONE_GATE_M, GATES_M])
    @pytest.mark.parametrize("most", [2, 3])
    def test_finds_patterns_for_two_kinds_of_frames_that_know_more_than_one_for_both(
        self, gates_m, limit_mbps, most, has_looks
    ):
        kinds, others = np.tile([0, 1], 12), np.array([0, 1, 1, 0, 1, 1])
        features = [
            None if has_looks else one[:, None] + np.random.default_rng(1).uniform(0, 0.1, (len(one), 1))
            for one in (kinds, others)
        ]
        frames, held_back = frames_of_kinds(kinds, 0, features[0]), frames_of_kinds(others, 1, features[1])
        search, fixed = searched(frames, held_back, gates_m, limit_mbps)
        found = search.best(most, lambda step: None)
        assert 3 <= len(found.gates) == 1 + len(found.rule.centroids) == 1 + len(found.members) <= 1 + most
        assert [len(set(kinds[own])) for own in found.members] == [1] * len(found.members)
        assert sorted(np.concatenate(found.members)) == list(range(24))
        # every pattern has as many rays, and begins with the look
        assert ((found.gates >= 0).sum(axis=1) == 4).all()
        look = np.flatnonzero(found.look >= 0)
        assert (found.gates[:, look] == found.look[look]).all()
        assert len(look) == found.rule.looks == len(found.rule.missing_m) == has_looks
        # each frame has the pattern of its kind, and together they know more than one for both
        seen = found.rule.ranges(search._seen_m(held_back, found.look)) if has_looks else features[1]
        picked = found.rule.patterns_of(seen)
        assert [kinds[found.members[one - 1][0]] for one in picked] == others.tolist()
        values = [held_back.values(search.gate_m(gate)) for gate in found.gates]
        assert found.value == pytest.approx(np.mean([values[one][frame] for frame, one in enumerate(picked)]))
        assert found.value > held_back.values(search.gate_m(fixed.gate)).mean() + 0.01
        # in no more bandwidth, on average and within a limit
        assert found.shares.tolist() == (np.bincount(picked, minlength=len(found.gates)) / 6).tolist()
        mbps = [mbps_of(search, gate) for gate in found.gates]
        assert max(mbps) <= limit_mbps * (1 + 1e-8)
        assert np.isfinite(limit_mbps) or found.shares @ mbps <= fixed.bits * (1 + 1e-8)

    @pytest.mark.parametrize(
        ("kinds", "features", "most"),
        [
            ([0], None, 2),
            ([0, 1] * 4, np.ones((8, 1)), 2),
            ([0, 1] * 4, np.full((8, 2), np.nan), 2),
            ([0, 1] * 4, np.array([[0.0], [np.nan]] * 4), 2),
        ],
    )
    def test_finds_nothing_in_few_frames_and_in_frames_that_look_alike(self, kinds, features, most):
        search, _ = searched(frames_of_kinds(kinds, 0, features), frames_of_kinds(kinds, 1, features))
        assert search.best(most, lambda step: None) is None

    def test_finds_no_more_patterns_than_there_are_frames(self):
        frames = frames_of_kinds([0, 1, 0], 0)
        found = searched(frames, frames)[0].best(64, lambda step: None)
        assert 3 <= len(found.gates) <= 4


def test_what_a_pattern_knows_of_frames_is_what_the_table_of_each_says():
    frames = frames_of_kinds([0, 1, 0], 3)
    search, _ = searched(frames, frames, GATES_M)
    for seed in range(20):
        gate = np.random.default_rng(seed).integers(-1, 2, 10)
        naive = [search.selection.coverage([one], GATES_M).value_of(gate) for one in frames.informed]
        np.testing.assert_allclose(frames.values(search.gate_m(gate)), naive, rtol=1e-6)


class TestFeaturesOfATask:
    @pytest.mark.parametrize("answer", [[1.0, 2.0], np.array([1, 2]), (1.0, np.nan)])
    def test_are_a_list_of_numbers(self, answer):
        found = features_of(SimpleNamespace(name="seen", features=lambda scene, returns: answer))
        np.testing.assert_array_equal(
            found(SimpleNamespace(name="s"), heard([1.0, 1.0])), np.array(answer, dtype=float)
        )

    @pytest.mark.parametrize("answer", ["far", None, ["far"], 1.0, [], [[1.0, 2.0]], [[1.0], [2.0, 3.0]], ValueError()])
    def test_that_are_something_else_are_refused(self, answer):
        raises = Mock(side_effect=answer) if isinstance(answer, Exception) else Mock(return_value=answer)
        with pytest.raises(PluginError, match=r"features|seen"):
            features_of(SimpleNamespace(name="seen", features=raises))(SimpleNamespace(name="s"), None)

    @pytest.mark.parametrize("task", [SimpleNamespace(name="blind"), SimpleNamespace(name="blind", features=None)])
    def test_may_be_none(self, task):
        assert features_of(task) is None
