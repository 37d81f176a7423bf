"""Gates of single rays: intervals against a naive twin, and gates moved into their bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.sensors import normal_sensor

from lidardesign.mixture.bounds import Bounds
from lidardesign.rays.gates import admitted_gates, bounded_gates, central_intervals
from lidardesign.sensors.sensor import DEFAULT_LEVEL, interval_factor

LEVEL_FACTOR = 1.96


@given(st.integers(0, 1000), st.integers(0, 40))
def test_intervals_are_the_naive_quantiles_of_each_cell(seed, count):
    generator, levels = np.random.default_rng(seed), (1.0, 0.8, 0.5)
    values, cell = generator.normal(size=count), generator.integers(0, 5, count)
    ends = central_intervals(values, cell, 6, levels)
    for index in range(6):
        own = values[cell == index]
        if len(own):
            shares = [[(1 - level) / 2, (1 + level) / 2] for level in levels]
            np.testing.assert_allclose(ends[index], np.quantile(own, shares, method="hazen"))
        else:
            assert np.isnan(ends[index]).all()


def test_a_gate_that_keeps_its_bounds_stays_as_it_is():
    wanted = np.array([[0.3, 0.5], [0.4, 0.45]])
    np.testing.assert_allclose(admitted_gates(wanted, Bounds.unbounded(2, LEVEL_FACTOR)), wanted, rtol=1e-12)


@given(st.floats(0.1, 1.0), st.floats(0, 0.5), st.floats(0.05, 0.6), st.floats(0, 0.3), st.floats(0, 0.6))
def test_any_gate_is_moved_inside_its_bounds(start, width, start_high, width_low, width_more):
    limits = {"start_low": 0.05, "start_high": start_high, "end_high": 1.5, "width_low": width_low}
    limits["width_high"] = width_low + width_more + 1e-3
    bounds = replace(Bounds.unbounded(1, LEVEL_FACTOR), **{name: np.array([value]) for name, value in limits.items()})
    ((begin, end),) = admitted_gates(np.array([[start, start + width]]), bounds)
    assert 0.05 - 1e-9 <= begin <= start_high + 1e-9
    assert end <= 1.5 + 1e-9
    assert width_low - 1e-9 <= end - begin <= width_low + width_more + 1e-3 + 1e-9


@given(st.floats(0.1, 1.0), st.floats(0.05, 0.5), st.floats(0.1, 1.2), st.floats(0.0, 0.25))
def test_gates_that_break_a_bound_are_replaced_inside_their_sensors_and_others_stay(start, width, start_high, least):
    one = normal_sensor(range_m=0.8, spread_range_m=0.7 / interval_factor(DEFAULT_LEVEL))
    bounds = replace(Bounds.unbounded(2, LEVEL_FACTOR), start_high=np.full(2, start_high), width_low=np.full(2, least))
    wanted = np.array([[start, start + width], [0.1, 0.4]])
    found = bounded_gates(wanted, one, bounds)
    np.testing.assert_array_equal(found[1], wanted[1])
    if start <= start_high and np.ptp(wanted[0]) >= least:
        np.testing.assert_array_equal(found[0], wanted[0])
    assert (found >= one.gate_m[0] - 1e-9).all()
    assert (found <= one.gate_m[1] + 1e-9).all()
    assert found[0, 0] <= start_high + 1e-9
    assert np.ptp(found[0]) >= least - 1e-9
