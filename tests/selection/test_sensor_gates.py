"""One gate for all rays of a sensor: which there are to choose from, and which of them all rays then have."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.rays import random_fan, rays_along

from lidardesign.selection.candidates import SENSOR_LEVELS, gate_choices, sensor_gates
from lidardesign.selection.coverage import InformedScene
from lidardesign.selection.select import _shared_gates
from lidardesign.task import Information

seeds = st.integers(0, 10_000)
VISITS = [slice(0, 12)]


def cast(seed, silent=()):
    """Rays of three sensors, and what scenes tell through them; those of silent sensors tell nothing."""
    generator = np.random.default_rng(seed)
    rays = rays_along(random_fan(12, 1.0, seed), gate_m=(0.2, 3.0))
    rays = type(rays)(*{**vars(rays), "sensor": np.repeat([0, 1, 2], 4)}.values())
    informed = []
    for _ in range(4):
        range_m = generator.uniform(0.5, 1.5, 12) + 0.6 * rays.sensor
        ray = np.flatnonzero((generator.uniform(size=12) < 0.8) & ~np.isin(rays.sensor, silent))
        told = Information(ray, np.arange(len(ray)), np.ones(len(ray)), np.zeros(12, dtype=int))
        informed.append(InformedScene.of(told, [SimpleNamespace(range_m=range_m)]))
    return rays, informed


class TestGatesOfASensor:
    @given(seeds, st.floats(0, 0.5))
    def test_are_the_same_for_all_its_rays_and_each_narrower_than_the_one_before(self, seed, margin_m):
        rays, informed = cast(seed)
        gates_m = sensor_gates(rays, VISITS, informed, margin_m)
        assert gates_m.shape == (12, 1 + len(SENSOR_LEVELS), 2)
        for sensor in range(3):
            own = gates_m[rays.sensor == sensor]
            assert (own == own[0]).all()
        assert (np.diff(gates_m[..., 0], axis=1) >= 0).all()
        assert (np.diff(gates_m[..., 1], axis=1) <= 0).all()
        assert (gates_m[:, 0] == rays.gate_m).all()

    @given(seeds)
    def test_hold_their_share_of_what_its_rays_return(self, seed):
        rays, informed = cast(seed)
        gates_m = sensor_gates(rays, VISITS, informed, 0.0)
        for sensor in range(3):
            own = np.flatnonzero(rays.sensor == sensor)
            told = np.concatenate([one.range_m[np.isin(one.ray, own)] for one in informed])
            for (start, end), level in zip(gates_m[own[0], 1:], SENSOR_LEVELS, strict=True):
                # an end may lie between two returns
                assert abs(((told >= start) & (told <= end)).sum() - level * len(told)) <= 2

    @given(seeds)
    def test_are_longer_by_the_margin_where_they_hold_everything(self, seed):
        rays, informed = cast(seed)
        bare, longer = (sensor_gates(rays, VISITS, informed, margin_m) for margin_m in (0.0, 0.1))
        ends = bare[:, 1] + np.array([-0.1, 0.1])
        np.testing.assert_allclose(longer[:, 1], np.clip(ends, rays.gate_m[:, :1], rays.gate_m[:, 1:]))
        np.testing.assert_array_equal(longer[:, 2:], bare[:, 2:])

    @pytest.mark.parametrize("choices", [sensor_gates, gate_choices])
    def test_that_tells_nothing_are_its_own(self, choices):
        rays, informed = cast(0, silent=(0, 1, 2))
        gates_m = choices(rays, VISITS, informed, 0.1)
        assert (gates_m == rays.gate_m[:, None]).all()

    def test_of_one_sensor_do_not_follow_from_those_of_another(self):
        rays, informed = cast(3)
        _, without = cast(3, silent=(1,))
        gates_m, fewer = (sensor_gates(rays, VISITS, told, 0.1) for told in (informed, without))
        np.testing.assert_array_equal(gates_m[rays.sensor != 1], fewer[rays.sensor != 1])
        assert (fewer[rays.sensor == 1] == rays.gate_m[rays.sensor == 1][:, None]).all()


def chosen(seed):
    """What rays of three sensors chose for themselves, and what gates cost, from wide to narrow."""
    generator = np.random.default_rng(seed)
    sensor = np.repeat([0, 1, 2], 5)
    bits = np.sort(generator.uniform(0.1, 1, (3, 4)), axis=1)[:, ::-1][sensor]
    return generator.integers(-1, 4, 15), sensor, bits


def cost(shared, gate, sensor, bits):
    return bits[np.arange(len(gate)), shared[sensor]][gate >= 0].sum()


class TestTheGateThatRaysShare:
    @given(seeds)
    def test_is_what_most_rays_of_the_sensor_chose(self, seed):
        gate, sensor, bits = chosen(seed)
        for index, shared in enumerate(_shared_gates(gate, sensor, bits, np.inf)):
            votes = np.bincount(gate[(sensor == index) & (gate >= 0)], minlength=4)
            assert votes[shared] == votes.max()

    @given(seeds, st.floats(0, 1.2))
    def test_is_narrower_only_where_rays_cost_too_much(self, seed, share):
        gate, sensor, bits = chosen(seed)
        free = _shared_gates(gate, sensor, bits, np.inf)
        limit = share * cost(free, gate, sensor, bits)
        shared = _shared_gates(gate, sensor, bits, limit)
        narrowest = cost(np.full(3, 3), gate, sensor, bits)
        assert (shared >= free).all()
        assert cost(shared, gate, sensor, bits) <= max(limit, narrowest) * (1 + 1e-8)
        if share >= 1:
            np.testing.assert_array_equal(shared, free)

    def test_of_a_sensor_that_fires_no_ray_costs_nothing_and_stays_as_it_is(self):
        sensor = np.array([0, 0, 2])
        shared = _shared_gates(np.array([0, 0, -1]), sensor, np.array([[2.0, 1.0]] * 3), 2.5)
        np.testing.assert_array_equal(shared, [1, 0, 0])
