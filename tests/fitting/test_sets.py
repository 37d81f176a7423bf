"""Small sets of candidates: the best there is where few are possible, and never above the bound."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import SUMS, small

from lidardesign.fitting import part_sets as sets
from lidardesign.fitting.part_sets import SetLimits, choose_set, further_sets
from lidardesign.rays.coverage import LARGEST

seeds = st.integers(0, 10_000)
TABLES = pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])


def candidates(seed, count, table=LARGEST):
    """A random table of candidates with one gate."""
    return small(seed, rays=count, items=12, table=table).through(np.zeros(count, dtype=np.intp))


def random_limits(seed, count):
    """At most three, one of each kind of mount, two of each kind of part, within a budget."""
    generator = np.random.default_rng(seed)
    mounts, parts = generator.integers(0, 4, count), generator.integers(0, 3, count)
    cost = generator.uniform(0, 1, count)
    return SetLimits(3, [(mounts, np.ones(4, dtype=int)), (parts, np.full(3, 2))], [(cost, 1.5)])


def keeps(limits, members):
    members = list(members)
    return (
        len(members) <= limits.count
        and all((np.bincount(kind[members], minlength=len(most)) <= most).all() for kind, most in limits.kinds)
        and all(cost[members].sum() <= limit for cost, limit in limits.budgets)
    )


def value_of(coverage, members):
    gate = np.full(coverage.shape[0], -1)
    gate[list(members)] = 0
    return coverage.value_of(gate)


def best_of_all(coverage, limits):
    every = itertools.chain.from_iterable(
        itertools.combinations(range(coverage.shape[0]), size) for size in range(limits.count + 1)
    )
    return max(value_of(coverage, members) for members in every if keeps(limits, members))


@TABLES
@given(seed=seeds)
def test_of_few_sets_the_best_is_chosen_within_all_limits(table, seed):
    coverage, limits = candidates(seed, 9, table), random_limits(seed, 9)
    chosen = choose_set(coverage, limits)
    assert keeps(limits, chosen.members)
    assert chosen.value == pytest.approx(value_of(coverage, chosen.members), rel=1e-9)
    assert chosen.value == pytest.approx(best_of_all(coverage, limits), rel=1e-9)
    assert chosen.bound == chosen.value


@TABLES
@given(seed=seeds)
def test_of_many_sets_none_exceeds_the_bound(table, seed):
    coverage, limits = candidates(seed, 9, table), random_limits(seed, 9)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sets, "FEW_SETS", 0)
        patched.setattr(sets, "MOST_WORK", 0)
        chosen = choose_set(coverage, limits)
    assert keeps(limits, chosen.members)
    best = best_of_all(coverage, limits)
    assert value_of(coverage, chosen.members) <= best * (1 + 1e-9)
    assert best <= chosen.bound * (1 + 1e-9)


def test_no_candidate_that_tells_nothing_is_taken():
    coverage = candidates(0, 4).grouped([np.array([], dtype=int), np.array([0]), np.array([], dtype=int)])
    assert choose_set(coverage, SetLimits(3)).members == (1,)


@TABLES
@given(seed=seeds, most=st.integers(1, 8))
def test_further_sets_are_distinct_and_keep_the_limits(table, seed, most):
    coverage, limits = candidates(seed, 9, table), random_limits(seed, 9)
    chosen = choose_set(coverage, limits)
    found = further_sets(coverage, limits, chosen.members, most)
    assert found[0] == chosen.members
    assert len({tuple(sorted(members)) for members in found}) == len(found) <= most
    assert all(keeps(limits, members) and value_of(coverage, members) <= chosen.bound * (1 + 1e-9) for members in found)


def test_further_sets_have_those_of_a_kind_alone():
    coverage, kind = candidates(0, 12), np.repeat([0, 1, 2], 4)
    limits = SetLimits(2, [(kind, np.full(3, 2))])
    found = further_sets(coverage, limits, choose_set(coverage, limits).members, 8)
    assert {0, 1, 2} <= {kind[members[0]] for members in map(list, found) if len(set(kind[members])) == 1}
