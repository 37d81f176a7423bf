"""Candidate rays: weighted draws of samples without replacement, inside the sensors that fire them."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import fits
from support.aisles import SAMPLES as AISLE
from support.designs import from_the_ceiling, three_sensors
from support.sensors import normal_sensor

from lidardesign.constraints.document import Constraints
from lidardesign.rays.proposals import Proposals, draw_order, nearest_samples, owners
from lidardesign.samples import Samples
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.pattern import even_rays
from lidardesign.sensors.sensor import interval_factor, tangent_coordinates
from lidardesign.space import DesignSpace, aim, direction, observed_point

LEVEL = 0.95
seeds = st.integers(0, 10_000)
CEILING = from_the_ceiling(3000)
RULES = {"places": {}, "regions": {"origin": {"spread_m": {"max": 0.3}}}}


def blob(points):
    return -0.5 * np.square((observed_point(points) - [0.1, 0.0, 0.3]) / [0.2, 0.3, 0.1]).sum(axis=1)


SENSORS = {
    name: fits.fitted(CEILING, rules, sensors=3, retarget=blob, em_samples=1500, restarts=1).sensors
    for name, rules in RULES.items()
}


def rules_of(kind):
    return Constraints.from_mapping(RULES[kind]).rules


def proposed(kind, count, seed=0, samples=CEILING, least=None):
    proposals = Proposals(SENSORS[kind], rules_of(kind), LEVEL, samples)
    return proposals.draw(count, {}, np.random.default_rng(seed), least)


def owned_by(kind, samples):
    """Which sensor owns each sample, and what it fires there."""
    return owners(SENSORS[kind], rules_of(kind), LEVEL, samples.points, samples.space)


def rows(rays):
    return {tuple(row) for row in np.column_stack([rays.origin_m, rays.direction, rays.gate_m, rays.sensor])}


class TestADrawByWeight:
    def test_has_the_orders_of_drawing_one_after_the_other_in_their_closed_form(self):
        weights, generator, draws = np.array([0.5, 0.3, 0.15, 0.05]), np.random.default_rng(1), 20_000
        found = np.array([draw_order(weights, generator) for _ in range(draws)])
        assert (np.sort(found, axis=1) == np.arange(4)).all()
        for order in itertools.permutations(range(4)):
            left = np.cumsum(weights[list(order)][::-1])[::-1]
            expected = float(np.prod(weights[list(order)] / left))
            share, error = (found == order).all(axis=1).mean(), math.sqrt(expected * (1 - expected) / draws)
            assert abs(share - expected) < 4.5 * error

    @given(seed=seeds, count=st.integers(1, 30), power=st.integers(-300, 300))
    def test_does_not_depend_on_the_unit_of_weights_and_takes_those_without_any_last(self, seed, count, power):
        weights = np.random.default_rng(seed).uniform(0.1, 1, count) * (np.arange(count) % 3 > 0)
        orders = [draw_order(weights * scale, np.random.default_rng(seed)) for scale in (1.0, 2.0**power)]
        np.testing.assert_array_equal(*orders)
        weightless = weights[orders[0]] == 0
        assert (np.diff(weightless.astype(int)) >= 0).all()


@pytest.mark.parametrize("kind", RULES)
class TestCandidates:
    def test_lie_inside_their_sensors_field_gate_and_place(self, kind):
        rays = proposed(kind, 500)
        for index, sensor in enumerate(SENSORS[kind]):
            own = rays.subset(rays.sensor == index)
            tangent = np.abs(tangent_coordinates(sensor.frame, own.direction))
            assert (tangent <= np.array(sensor.field_of_view_rad) / 2 + 1e-9).all()
            assert (own.gate_m == sensor.gate_m).all()
            if kind == "places":
                np.testing.assert_array_equal(own.origin_m, np.tile(sensor.origin_m, (len(own), 1)))
            else:
                # the ellipse of the level in the plane of the ceiling
                assert squares(own.origin_m, sensor).max() <= -2 * math.log(1 - LEVEL) + 1e-9
                assert len(np.unique(own.origin_m, axis=0)) == len(own)

    def test_look_at_what_samples_look_at_within_their_gates(self, kind):
        rays, seen = proposed(kind, 100), observed_point(CEILING.points)
        offset = seen[None] - rays.origin_m[:, None]
        along = np.einsum("nki,ni->nk", offset, rays.direction)
        off = np.linalg.norm(offset - along[..., None] * rays.direction[:, None], axis=2)
        nearest = off.argmin(axis=1)
        assert off.min(axis=1).max() < 1e-9
        reached = along[np.arange(100), nearest]
        assert ((reached >= rays.gate_m[:, 0]) & (reached < rays.gate_m[:, 1])).all()

    def test_belong_to_the_sensor_whose_component_is_densest_there(self, kind):
        owner, fired = owned_by(kind, CEILING)
        naive = np.array([naive_log_density(sensor, CEILING) for sensor in SENSORS[kind]])
        owned = owner >= 0
        assert owned.mean() > 0.5
        np.testing.assert_array_equal(owner[owned], naive.argmax(axis=0)[owned])
        # what is observed stays
        np.testing.assert_allclose(observed_point(fired[owned]), observed_point(CEILING.points[owned]), atol=1e-9)

    @given(few=st.integers(1, 50), more=st.integers(50, 400), seed=seeds)
    def test_of_a_smaller_number_are_among_those_of_a_larger_one(self, kind, few, more, seed):
        first, every = (rows(proposed(kind, count, seed)) for count in (few, more))
        assert len(first) == few
        assert len(every) == more
        assert first <= every

    @given(seed=seeds)
    def test_do_not_depend_on_the_order_of_samples(self, kind, seed):
        shuffled = CEILING.subset(np.random.default_rng(seed).permutation(len(CEILING)))
        assert rows(proposed(kind, 60, seed, shuffled)) == rows(proposed(kind, 60, seed))

    def test_are_even_only_where_samples_inside_are_too_few(self, kind):
        sensors, few = SENSORS[kind], CEILING.subset(np.arange(80))
        inside = int((owned_by(kind, few)[0] >= 0).sum())
        assert 10 < inside < 80
        exact, more = (proposed(kind, count, samples=few) for count in (inside, inside + 30))
        assert len(rows(exact)) == inside
        np.testing.assert_array_equal(more.direction[:inside], exact.direction)
        even = even_rays(sensors, split_budget(np.array([sensor.weight for sensor in sensors]), 30))
        assert rows(more.subset(np.arange(inside, inside + 30))) == rows(even)

    @given(seed=seeds, count=st.integers(1, 20), least=st.lists(st.integers(0, 60), min_size=3, max_size=3))
    def test_are_as_many_of_each_sensor_as_it_has_to_have_its_own_samples_first(self, kind, seed, count, least):
        least, few = np.array(least), CEILING.subset(np.arange(80))
        plain, rays = (proposed(kind, count, seed, few, one) for one in (None, least))
        assert rows(plain) <= rows(rays)
        own = np.bincount(rays.sensor, minlength=3)
        np.testing.assert_array_equal(own, np.maximum(np.bincount(plain.sensor, minlength=3), least))
        owned = np.bincount(owned_by(kind, few)[0] + 1, minlength=4)[1:]
        even = rows(even_rays(SENSORS[kind], np.maximum(least - owned, 0)))
        assert rows(rays) & even == even
        assert len(rows(rays) - even) == np.minimum(own, owned).sum()

    def test_are_as_frequent_as_samples_weigh_and_none_that_weighs_nothing(self, kind):
        heavy, draws = np.arange(200) % 2 == 0, 150
        samples = replace(CEILING.subset(np.arange(200)), log_target=np.where(heavy, 2.0, 0.0), log_prob=np.zeros(200))
        owner, fired = owned_by(kind, samples)
        weight = np.where(heavy, math.exp(2), 1.0)[owner >= 0]
        number = {tuple(point): index for index, point in enumerate(direction(*fired[owner >= 0, 3:5].T))}
        drawn = np.zeros(len(weight), dtype=int)
        for seed in range(draws):
            drawn[number[tuple(proposed(kind, 1, seed, samples).direction[0])]] += 1
        share = weight[weight > 1].sum() / weight.sum()
        assert abs(drawn[weight > 1].sum() / draws - share) < 4 * math.sqrt(share * (1 - share) / draws)
        alone = replace(samples, log_target=np.where(heavy, 0.0, -np.inf))
        assert rows(proposed(kind, 20, samples=alone)) <= rows(proposed(kind, 200, samples=alone.subset(heavy)))


def naive_log_density(sensor, samples):
    """The log density of a component at what samples observe, per solid angle, up to what all share, (N,)."""
    points, z = samples.points, interval_factor(LEVEL)
    if sensor.origin_covariance_m2 is None:
        points = aim(np.tile(sensor.origin_m, (len(points), 1)), observed_point(points))
    start, end = sensor.gate_m
    tangent = tangent_coordinates(sensor.frame, direction(points[:, 3], points[:, 4]))
    away = np.column_stack([tangent, points[:, 5] - (start + end) / 2])
    spread = np.array([*sensor.field_of_view_rad, end - start]) / (2 * z)
    value = math.log(sensor.weight) - 0.5 * np.square(away / spread).sum(axis=1) - np.log(spread).sum()
    angle = np.hypot(*tangent.T)
    value += np.log(angle / np.sin(angle))
    if sensor.origin_covariance_m2 is not None:
        value -= 0.5 * squares(points, sensor) + 0.5 * np.linalg.slogdet(sensor.origin_covariance_m2[:2, :2])[1]
    return value


def squares(points, sensor):
    """Squared distances from a sensor's origin over the ceiling, in its standard deviations, (N,)."""
    away = points[:, :2] - sensor.origin_m[:2]
    return np.einsum("ni,ni->n", away, np.linalg.solve(sensor.origin_covariance_m2[:2, :2], away.T).T)


def test_the_same_ray_at_another_range_is_the_same_candidate():
    (sensor,) = fits.fitted(fits.FIXED, sensors=1).sensors
    few = fits.FIXED.subset(np.arange(1000))
    near = replace(few, points=few.points * [1, 1, 1, 1, 1, 0.99])
    both = Samples(
        *(np.concatenate([getattr(one, name) for one in (near, few)]) for name in ("points", "log_prob", "log_target")),
        few.space,
    )
    inside = int((owners([sensor], Constraints().rules, LEVEL, few.points, few.space)[0] == 0).sum())
    rays = Proposals((sensor,), Constraints().rules, LEVEL, both).draw(inside, {}, np.random.default_rng(0))
    assert len(np.unique(rays.direction, axis=0)) == inside


@given(st.floats(0.05, 6.2), st.floats(0.05, 3.0), st.floats(-3, 3), st.floats(-1.5, 1.5), st.integers(1, 400), seeds)
def test_candidates_and_even_rays_lie_in_fields_however_wide(horizontal, vertical, roll, elevation, count, seed):
    turn = DesignSpace((0, 0, 0, -math.pi, -math.pi / 2, 0.2), (0, 0, 0, math.pi, math.pi / 2, 3.0))
    points = turn.sample(300, np.random.default_rng(seed))
    samples = Samples(points, np.zeros(300), np.zeros(300), turn)
    z = 2 * interval_factor(LEVEL)
    sensor = normal_sensor("s", 1.0, (0, 0, 0), 0.1, elevation, roll, (horizontal / z, vertical / z), 1.5, 0.6)
    rays = Proposals((sensor,), Constraints().rules, LEVEL, samples).draw(count, {}, np.random.default_rng(seed))
    assert len(rays) == count
    tangent = np.abs(tangent_coordinates(sensor.frame, rays.direction))
    assert (tangent <= np.array(sensor.field_of_view_rad) / 2 + 1e-9).all()


def test_a_sensor_without_weight_owns_nothing():
    idle = replace(three_sensors()[0], weight=0.0)
    owner, _ = owners([idle, three_sensors()[1]], Constraints().rules, LEVEL, CEILING.points, CEILING.space)
    assert set(owner) <= {-1, 1}


class TestAlongACondition:
    @pytest.mark.parametrize("value", [-0.5, 1.3, 4.0])
    def test_the_nearest_samples_propose_as_if_they_were_there(self, value):
        near = nearest_samples(AISLE, {"x_m": value}, share=0.2)
        assert len(near) == math.ceil(0.2 * len(AISLE))
        assert (near.points[:, 0] == value).all()
        away = np.sort(np.abs(AISLE.points[:, 0] - value))
        kept = {tuple(point) for point in near.points[:, 1:]}
        nearest = AISLE.points[np.abs(AISLE.points[:, 0] - value) < away[len(near) - 1], 1:]
        assert {tuple(point) for point in nearest} <= kept
        assert near.space.conditioned == ()
        assert nearest_samples(AISLE, {}) is AISLE

    @pytest.mark.parametrize("value", [-0.5, 2.0])
    def test_rays_start_where_their_sensors_are_then(self, value):
        place = nearest_samples(AISLE, {"x_m": -0.5}, 1.0)
        sensors = fits.fitted(place, sensors=2).sensors
        proposals = Proposals(sensors, Constraints().rules, LEVEL, AISLE)
        assert [sensor.origin_m.tolist() for sensor in proposals.sensors_at({"x_m": value})] == [[value, 0, 0]] * 2
        rays = proposals.draw(50, {"x_m": value}, np.random.default_rng(0))
        np.testing.assert_array_equal(rays.origin_m, np.tile([value, 0, 0], (50, 1)))
