"""One gate for all rays of a sensor: which there are to choose from, and which of them all rays then have."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import scene_of
from support.rays import random_fan, rays_along

from lidardesign.rays.coverage import LARGEST, SceneInformation, gather
from lidardesign.rays.gates import SENSOR_LEVELS, gate_choices, sensor_gates
from lidardesign.rays.selection import _shared_gates
from lidardesign.task import Information

seeds = st.integers(0, 10_000)
VISITS = [slice(0, 12)]
SENSOR = np.repeat([0, 1, 2], 4)


def cast(seed, silent=()):
    """Rays of three sensors, and what scenes tell through them; those of silent sensors tell nothing."""
    generator = np.random.default_rng(seed)
    rays = replace(rays_along(random_fan(12, 1.0, seed), gate_m=(0.2, 3.0)), sensor=SENSOR)
    informed = []
    for _ in range(4):
        range_m = generator.uniform(0.5, 1.5, 12) + 0.6 * rays.sensor
        ray = np.flatnonzero((generator.uniform(size=12) < 0.8) & ~np.isin(rays.sensor, silent))
        told = Information(ray, np.arange(len(ray)), np.ones(len(ray)), np.zeros(12, dtype=int))
        informed.append(SceneInformation.of(told, [SimpleNamespace(range_m=range_m)]))
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


GATES_M = np.array([[[0.0, 3.0], [1.0, 2.0], [1.2, 1.8], [1.4, 1.6]], [[0.5, 2.5], [1.0, 1.9], [1.3, 1.7], [1.5, 1.6]]])


def chosen(seed, price):
    """What rays of three sensors tell through their sensors' gates, and a choice of some of them."""
    generator = np.random.default_rng(seed)
    gates_m = GATES_M[[0, 1, 0]][SENSOR]
    scenes = [scene_of(generator, 12, 15, 60, LARGEST) for _ in range(3)]
    coverage = gather(scenes, gates_m, gates_m[..., 1] - gates_m[..., 0])
    gate = generator.integers(-1, 4, 12)
    return coverage, SimpleNamespace(gate=gate, price=price)


def worth(coverage, choice, shared):
    """What chosen rays are worth through shared gates, and what they cost."""
    gate = np.where(choice.gate >= 0, shared[SENSOR], -1)
    bits, _ = coverage.charge(gate)
    return coverage.value_of(gate) - choice.price * bits, bits


@pytest.mark.parametrize("price", [0.0, 0.003, 1.0])
class TestTheGateThatRaysShare:
    @given(seed=seeds)
    def test_is_such_that_no_other_gate_of_one_sensor_gains(self, seed, price):
        coverage, choice = chosen(seed, price)
        shared = _shared_gates(coverage, choice, SENSOR, np.inf)
        best, _ = worth(coverage, choice, shared)
        for index, gate in itertools.product(range(3), range(4)):
            other = shared.copy()
            other[index] = gate
            assert worth(coverage, choice, other)[0] <= best + 1e-6
        assert price > 0 or (shared == 0).all()

    @given(seed=seeds, share=st.floats(0, 1.2))
    def test_is_narrower_only_where_rays_cost_too_much(self, seed, share, price):
        coverage, choice = chosen(seed, price)
        free = _shared_gates(coverage, choice, SENSOR, np.inf)
        limit = share * worth(coverage, choice, free)[1]
        shared = _shared_gates(coverage, choice, SENSOR, limit)
        narrowest = worth(coverage, choice, np.full(3, 3))[1]
        assert (shared >= free).all()
        assert worth(coverage, choice, shared)[1] <= max(limit, narrowest) * (1 + 1e-8)
        if share > 1 + 1e-9:
            np.testing.assert_array_equal(shared, free)
