"""Gates of single rays under a bandwidth: one price per metre holds the most returns for the bins that it takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lidardesign.layouts.gates import RayRanges, _Prices, central_intervals, gates_within
from support.tables import each_row

from lidardesign.mixture.bounds import Bounds
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.sensor import interval_factor

Z = interval_factor(0.95)
MODEL = Bandwidth()  # bins of 1.5 cm
ROUNDING_M = 1e-9


def hearing(seed, rays, per_ray=12, *, weighted=True):
    """What rays hear: returns around one or two ranges each, of every ray something."""
    generator = np.random.default_rng(seed)
    ray = np.concatenate([np.arange(rays), generator.integers(rays, size=rays * (per_ray - 1))])
    centre = generator.uniform(0.5, 3, (rays, 2))
    ranges = centre[ray, generator.integers(2, size=len(ray))] + generator.normal(0, 0.1, len(ray))
    weights = generator.uniform(0.01, 1, len(ray)) if weighted else np.ones(len(ray))
    return RayRanges(np.abs(ranges), weights, ray, rays)


def free(rays):
    return Bounds.unbounded(rays, Z)


def bins(gates, model=MODEL):
    return int(model.bins(gates[:, 1] - gates[:, 0]).sum())


def held_by(heard, gates):
    """The weight of what gates hold."""
    start, end = gates[heard.ray].T
    return heard.weights[(heard.range_m >= start - ROUNDING_M) & (heard.range_m <= end + ROUNDING_M)].sum()


@given(st.integers(0, 1000), st.integers(1, 30), st.floats(0, 1))
def test_never_more_bins_than_allowed(seed, rays, share):
    heard = hearing(seed, rays)
    wide = bins(gates_within(heard, free(rays), 0.95, MODEL, None))
    limit = rays + int(share * (wide - rays))
    gates = gates_within(heard, free(rays), 0.95, MODEL, limit)
    assert bins(gates) <= limit
    assert (gates[:, 1] >= gates[:, 0]).all()
    assert (gates[:, 0] >= 0).all()


@each_row("bin_ps", [1.0, 100.0, 10_000.0])
@each_row("heaviest", [1.0, 1e9])
def test_one_bin_per_ray_is_always_enough(bin_ps, heaviest):
    heard, model = hearing(0, 200), Bandwidth(bin_ps=bin_ps)
    heard = replace(heard, weights=np.where(heard.ray == 0, heaviest, heard.weights))
    gates = gates_within(heard, free(200), 0.95, model, 200)
    assert bins(gates, model) == 200
    assert held_by(heard, gates) > 0


@given(st.integers(0, 1000), st.integers(1, 20), st.sampled_from([0.5, 0.95, 1.0]))
def test_where_bandwidth_is_no_limit_gates_are_central_intervals(seed, rays, level):
    heard = hearing(seed, rays)
    expected, _ = central_intervals(heard.range_m, heard.weights, heard.ray, rays, level)
    for limit in (None, bins(expected)):
        gates = gates_within(heard, free(rays), level, MODEL, limit)
        wide = np.diff(expected, axis=1)[:, 0] > 1e-4
        np.testing.assert_allclose(gates[wide], expected[wide], rtol=1e-9, atol=ROUNDING_M)


def best_by_hand(ranges, weights, price):
    """The largest sum of weights less the price of the way, over all intervals that begin and end at a return."""
    order = np.argsort(ranges, kind="stable")
    ranges, weights = ranges[order], weights[order]
    return max(
        weights[first : last + 1].sum() - price * (ranges[last] - ranges[first])
        for first in range(len(ranges))
        for last in range(first, len(ranges))
    )


@given(st.integers(0, 10_000), st.integers(1, 6), st.floats(-4, 4))
def test_no_interval_is_worth_more_at_its_price(seed, rays, log_price):
    heard = hearing(seed, rays, per_ray=8)
    price = 10**log_price
    wide, _ = central_intervals(heard.range_m, heard.weights, heard.ray, rays, 1.0)
    gates = _Prices.of(heard, wide).gates(price)
    mean = heard.weights.sum() / rays
    for ray, (start, end) in enumerate(gates):
        own = heard.ray == ray
        ranges, weights = heard.range_m[own], heard.weights[own] / mean
        held = weights[(ranges >= start) & (ranges <= end)].sum() - price * (end - start)
        assert held >= best_by_hand(ranges, weights, price) - 1e-9 * (1 + price)


@given(st.integers(0, 1000), st.integers(1, 12))
def test_more_bandwidth_never_holds_fewer_returns(seed, rays):
    heard = hearing(seed, rays)
    wide = bins(gates_within(heard, free(rays), 1.0, MODEL, None))
    limits = np.unique(np.linspace(rays, wide, 12).astype(int))
    held = [held_by(heard, gates_within(heard, free(rays), 1.0, MODEL, int(limit))) for limit in limits]
    assert (np.diff(held) >= -1e-6 * held[-1]).all()
    assert held[-1] == pytest.approx(heard.weights.sum(), rel=1e-6)


@given(st.integers(0, 1000), st.sampled_from([1e-6, 3.0, 1e6]))
def test_the_unit_of_weights_does_not_matter(seed, factor):
    heard = hearing(seed, 8)
    limit = bins(gates_within(heard, free(8), 0.95, MODEL, None)) // 2
    one = gates_within(heard, free(8), 0.95, MODEL, limit)
    other = gates_within(replace(heard, weights=factor * heard.weights), free(8), 0.95, MODEL, limit)
    np.testing.assert_allclose(other, one, atol=1e-6)


@given(
    st.integers(0, 1000),
    st.floats(0, 2.0),
    st.floats(0.02, 1.0),
    st.sampled_from(["start", "end", "width", "least width", "all"]),
    st.sampled_from([None, 40, 100]),
)
def test_bounds_on_gates_are_kept(seed, edge, width, kind, limit):
    rays = 8
    heard, bounds = hearing(seed, rays), free(rays)
    full = np.full(rays, 1.0)
    if kind in ("start", "all"):
        bounds = replace(bounds, start_low=edge * full)
    if kind in ("end", "all"):
        bounds = replace(bounds, end_high=(edge + 1.2) * full)
    if kind in ("width", "all"):
        bounds = replace(bounds, width_high=width * full)
    if kind == "least width":
        bounds = replace(bounds, width_low=width * full)
    gates = gates_within(heard, bounds, 0.95, MODEL, limit)
    start, end = gates.T
    assert (start >= bounds.start_low - ROUNDING_M).all()
    assert (end <= bounds.end_high + ROUNDING_M).all()
    assert (end - start <= bounds.width_high + ROUNDING_M).all()
    assert (end - start >= bounds.width_low - ROUNDING_M).all()
    if kind != "least width" and limit is not None:
        assert bins(gates) <= limit


@given(st.integers(0, 1000))
def test_the_order_of_returns_and_rays_does_not_matter(seed):
    heard, generator = hearing(seed, 9), np.random.default_rng(seed)
    order, turn = generator.permutation(len(heard.ray)), generator.permutation(9)
    place = np.argsort(turn)
    other = RayRanges(heard.range_m[order], heard.weights[order], place[heard.ray[order]], 9)
    one = gates_within(heard, free(9), 0.9, MODEL, 45)
    np.testing.assert_allclose(gates_within(other, free(9), 0.9, MODEL, 45), one[turn], atol=1e-6)


def test_returns_without_weight_are_nothing():
    heard = hearing(1, 10)
    more = RayRanges(
        np.append(heard.range_m, [9.0, 0.01]), np.append(heard.weights, [0, 0]), np.append(heard.ray, [0, 1]), 10
    )
    for limit in (None, 30):
        np.testing.assert_allclose(
            gates_within(more, free(10), 0.95, MODEL, limit), gates_within(heard, free(10), 0.95, MODEL, limit),
            atol=1e-6,
        )  # fmt: skip
