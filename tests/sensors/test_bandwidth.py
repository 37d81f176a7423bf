"""Bandwidth: the paper's figures, whole bins at exact multiples, and the refusal of impossible gates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.rays import rays_along

from lidardesign.errors import ConfigError
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S
from lidardesign.sensors.bandwidth import Bandwidth


def rays_with_gates(gates):
    return rays_along(np.tile([1.0, 0.0, 0.0], (len(gates), 1)), np.reshape(gates, (-1, 2)))


@pytest.mark.parametrize(("rays", "printed"), [(196, 5.2), (361, 9.5), (576, 15.2)])
def test_the_face_baseline_of_the_paper_is_66_bins_per_ray(rays, printed):
    model = Bandwidth()
    value = model.mbps(rays_with_gates([[0.0, 66 * model.bin_m]] * rays))
    assert value == pytest.approx(printed, abs=0.05)


def test_a_metre_of_gate_is_67_bins_of_100_picoseconds():
    assert Bandwidth().bins(1.0) == 67
    assert Bandwidth().mbps(rays_with_gates([[0.5, 1.5]] * 196)) == pytest.approx(196 * 67 * 40 * 10 / 1e6)


@given(bins=st.integers(1, 100_000), bin_ps=st.floats(0.1, 10_000.0), start=st.floats(0.0, 100.0))
def test_a_gate_of_exactly_k_bins_costs_k_bins_after_a_trip_through_mean_and_spread(bins, bin_ps, start):
    model = Bandwidth(bin_ps=bin_ps)
    width = bins * SPEED_OF_LIGHT_M_S * bin_ps * 1e-12 / 2
    assert model.bins(width) == bins
    mean, half = start + width / 2, width / 2
    if width > 1e-6 * mean:
        assert model.bins((mean + half) - (mean - half)) == bins


@given(width=st.floats(0.0, 1e4), more=st.floats(0.0, 1e4))
def test_bins_cover_the_gate_and_grow_with_it(width, more):
    model = Bandwidth()
    assert model.bins(width) * model.bin_m >= width * (1 - 1e-8)
    assert (model.bins(width) - 1) * model.bin_m <= width
    assert model.bins(width + more) >= model.bins(width)


def test_no_rays_cost_nothing_and_an_empty_gate_costs_one_bin():
    assert Bandwidth().mbps(rays_with_gates([])) == 0.0
    assert Bandwidth().bins(0.0) == 1


def test_counts_of_equal_gates_cost_what_their_rays_cost():
    model = Bandwidth(bin_ps=50, bits_per_bin=16, rate_hz=25)
    widths, counts = np.array([0.1, 0.37]), np.array([3, 5])
    rays = rays_with_gates([[0.2, 0.2 + w] for w, n in zip(widths, counts, strict=True) for _ in range(n)])
    assert model.mbps_of_widths(widths, counts) == model.mbps(rays)


@pytest.mark.parametrize("width", [-0.1, np.nan, np.inf])
def test_an_impossible_width_is_refused(width):
    with pytest.raises(ConfigError, match="width"):
        Bandwidth().bins(width)


@pytest.mark.parametrize("name", ["bin_ps", "bits_per_bin", "rate_hz"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_an_impossible_read_out_is_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=name):
        Bandwidth(**{name: value})
