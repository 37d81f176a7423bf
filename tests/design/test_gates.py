"""Gates of single rays: weighted intervals against a naive twin, and gates moved into their bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.mixture.bounds import Bounds
from lidardesign.rays.gates import admissible_gates, central_intervals

LEVEL_FACTOR = 1.96


def test_intervals_are_the_naive_weighted_quantiles_of_each_cell():
    generator = np.random.default_rng(0)
    values, labels = generator.normal(size=500), generator.integers(0, 7, 500)
    weights = generator.uniform(0, 2, 500)
    ends, effective = central_intervals(values, weights, labels, 9, 0.8)
    for cell in range(7):
        inside, w = values[labels == cell], weights[labels == cell]
        order = inside.argsort()
        share = (w[order].cumsum() - w[order] / 2) / w.sum()
        np.testing.assert_allclose(ends[cell], np.interp([0.1, 0.9], share, inside[order]))
        assert effective[cell] == pytest.approx(w.sum() ** 2 / (w**2).sum())
    assert np.isnan(ends[7:]).all()
    assert (effective[7:] == 0).all()


@pytest.mark.parametrize("scale", [1e-300, 1e-200, 1e150])
def test_intervals_of_vanishing_weights_rest_on_as_many_as_of_large_ones(scale):
    ends, effective = central_intervals(np.arange(12.0), np.full(12, scale), np.zeros(12, dtype=int), 1, 0.9)
    np.testing.assert_allclose(effective, [12.0], rtol=1e-12)
    assert np.isfinite(ends).all()


def test_a_gate_that_keeps_its_bounds_stays_as_it_is():
    wanted = np.array([[0.3, 0.5], [0.4, 0.45]])
    centre, spread = admissible_gates(wanted, Bounds.unbounded(2, LEVEL_FACTOR))
    half = LEVEL_FACTOR * spread
    np.testing.assert_allclose(np.stack([centre - half, centre + half], 1), wanted, rtol=1e-12)


@given(st.floats(0.1, 1.0), st.floats(0, 0.5), st.floats(0.05, 0.6), st.floats(0, 0.3), st.floats(0, 0.6))
def test_any_gate_is_moved_inside_its_bounds(start, width, start_high, width_low, width_more):
    bounds = replace(
        Bounds.unbounded(1, LEVEL_FACTOR),
        start_low=np.array([0.05]),
        start_high=np.array([start_high]),
        end_high=np.array([1.5]),
        width_low=np.array([width_low]),
        width_high=np.array([width_low + width_more + 1e-3]),
    )
    centre, spread = admissible_gates(np.array([[start, start + width]]), bounds)
    half = LEVEL_FACTOR * spread[0]
    assert 0.05 - 1e-9 <= centre[0] - half <= start_high + 1e-9
    assert centre[0] + half <= 1.5 + 1e-9
    assert width_low - 1e-9 <= 2 * half <= width_low + width_more + 1e-3 + 1e-9
