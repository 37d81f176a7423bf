"""Rays chosen for several numbers of rays, at values of a condition, within counts of sensors and a bandwidth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import scene_of
from support.rays import random_fan, rays_along

from lidardesign.errors import InfeasibleError
from lidardesign.rays.coverage import LARGEST
from lidardesign.rays.selection import Selection, select, silent_share
from lidardesign.sensors.bandwidth import Bandwidth, split_budget

seeds = st.integers(0, 10_000)
OPEN_M = (0.5, 2.5)
SENSOR = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2, 2])


def gates_of(rays, visits, informed):
    """The open gate, and two that are narrower."""
    return np.tile([OPEN_M, (1.0, 2.0), (1.2, 1.6)], (len(rays), 1, 1))


def subject(seed, visits=1, **options):
    """Candidates of three sensors at values of a condition, and scenes that they are chosen on and judged by."""
    generator, count = np.random.default_rng(seed), 10 * visits
    rays = replace(rays_along(random_fan(count, 1.0, seed), OPEN_M), sensor=np.tile(SENSOR, visits))
    slices = [slice(10 * number, 10 * number + 10) for number in range(visits)]
    scenes = [scene_of(generator, count, 12 * visits, 50 * visits, LARGEST) for _ in range(5)]
    return Selection(rays, slices, gates_of, Bandwidth(), **options), scenes[:3], scenes[3:]


def fired(rays):
    return {tuple(row) for row in np.column_stack([rays.origin_m, rays.direction, rays.gate_m, rays.sensor])}


@given(seed=seeds, is_shared=st.booleans(), each_fires=st.booleans())
def test_every_number_of_rays_is_fired_by_sensors_in_order_through_gates_that_there_are(seed, is_shared, each_fires):
    selection, informed, held_back = subject(seed, is_shared=is_shared, each_fires=each_fires)
    found = select(selection, informed, held_back, [3, 5, 9])
    for count, one in zip((3, 5, 9), found, strict=True):
        (rays,) = one.rays
        assert len(fired(rays)) == len(rays) == count
        assert (np.diff(rays.sensor) >= 0).all()
        assert not each_fires or set(rays.sensor) == {0, 1, 2}
        assert {tuple(gate) for gate in rays.gate_m} <= {OPEN_M, (1.0, 2.0), (1.2, 1.6)}
        own = [{tuple(gate) for gate in rays.gate_m[rays.sensor == sensor]} for sensor in range(3)]
        assert not is_shared or max(map(len, own)) == 1
        aimed = selection.rays.direction @ rays.direction.T
        assert (selection.rays.sensor[aimed.argmax(axis=0)] == rays.sensor).all()
        assert aimed.max(axis=0).min() > 1 - 1e-12


@given(seed=seeds, limit=st.sampled_from([np.inf, 0.08]))
def test_with_gates_per_ray_a_number_of_rays_does_not_depend_on_what_was_asked_beside_it(seed, limit):
    selection, informed, held_back = subject(seed, limit_mbps=limit)
    (alone,) = select(selection, informed, held_back, [4])
    beside = select(selection, informed, held_back, [2, 4, 5], certified=[2, 5])
    assert fired(alone.rays[0]) == fired(beside[1].rays[0])
    assert alone.silent == beside[1].silent
    assert [one.certificate is not None for one in beside] == [True, False, True]


@pytest.mark.parametrize("each_fires", [False, True])
@pytest.mark.parametrize("count", [3, 4, 7])
@given(seed=seeds)
def test_along_a_condition_each_sensor_fires_its_share_at_every_value(seed, count, each_fires):
    shares = np.array([0.9, 0.06, 0.04]) if each_fires else np.array([0.4, 0.3, 0.3])
    selection, informed, held_back = subject(seed, visits=3, shares=shares, each_fires=each_fires)
    (one,) = select(selection, informed, held_back, [min(count, 6) if each_fires else count])
    counts = [np.bincount(rays.sensor, minlength=3).tolist() for rays in one.rays]
    assert counts == [split_budget(shares, len(one.rays[0]), each=each_fires).tolist()] * 3
    assert min(counts[0]) > 0


@given(seed=seeds, visits=st.integers(1, 2), limit=st.floats(0.025, 0.2), is_shared=st.booleans())
def test_a_bandwidth_holds_at_every_value_or_so_many_rays_are_refused(seed, visits, limit, is_shared):
    shares = np.array([0.4, 0.3, 0.3]) if visits > 1 else None
    selection, informed, held_back = subject(seed, visits, limit_mbps=limit, is_shared=is_shared, shares=shares)
    # the narrowest gate of 0.4 m has 27 bins of 40 bits, ten times a second
    narrowest = 5 * Bandwidth().mbps_of_widths(np.array([0.4]))
    try:
        (one,) = select(selection, informed, held_back, [5])
    except InfeasibleError:
        # of rays along a condition each may cost a bin more between its values
        assert limit < 1.1 * narrowest + 0.005 * (visits > 1)
    else:
        assert max(Bandwidth().mbps(rays) for rays in one.rays) <= limit * (1 + 1e-9)


@given(seed=seeds, count=st.integers(1, 6), limit=st.sampled_from([np.inf, 0.1]))
def test_a_certificate_says_what_the_choice_loses_and_what_any_loses_at_least(seed, count, limit):
    selection, informed, held_back = subject(seed, limit_mbps=limit)
    (one,) = select(selection, informed, held_back, [count], certified=[count])
    document = one.certificate
    assert (document["rays"], document["candidates"], document["gates"], document["scenes"]) == (count, 10, 3, 3)
    assert 0 <= document["bound"] <= document["value"] <= 1
    assert document["gap"] == pytest.approx(1 - document["bound"] / document["value"])
    assert document["held_back_value"] >= 0
    points = np.array(document["curve"])
    assert (np.diff(points, axis=0) * [1, -1] > 0).all()


@given(seed=seeds)
def test_scenes_about_which_no_return_in_a_gate_tells_anything_are_silent(seed):
    generator = np.random.default_rng(seed)
    scenes = [scene_of(generator, 6, 4, 5, LARGEST) for _ in range(7)]
    start = generator.uniform(1, 2, 6)
    gate_m = np.stack([start, start + generator.uniform(0, 0.4, 6) * (generator.random(6) < 0.5)], axis=1)
    told = [(one.range_m >= gate_m[one.ray, 0]) & (one.range_m < gate_m[one.ray, 1]) for one in scenes]
    assert silent_share(scenes, gate_m) == pytest.approx(1 - np.mean([one.any() for one in told]))
    assert silent_share([], gate_m) == 0


def test_candidates_that_tell_nothing_are_refused():
    selection, informed, held_back = subject(0)
    none = [one.of_rays(np.full(10, -1)) for one in informed]
    with pytest.raises(InfeasibleError, match="none of 10 candidate rays"):
        select(selection, none, held_back, [3])
