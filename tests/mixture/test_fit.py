"""From samples to sensors: places, regions, mounts, entries of each, budgets, and how far figures may be off."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.fits import CENTRE, FACE, FIXED, FREE, MOVING, blob, broken, checks, fitted, log_target

from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.mixture.em import LEAST_SAMPLES
from lidardesign.sensors.sensor import interval_factor, tangent_coordinates
from lidardesign.space import aim, direction, observed_point

PLACE = [0.04, -0.03, 0.02]


def test_sensors_are_ordered_by_weight():
    weights = [sensor.weight for sensor in fitted(FIXED, sensors=4).sensors]
    assert weights == sorted(weights, reverse=True)
    assert sum(weights) == pytest.approx(1.0)


@pytest.mark.parametrize("sensors", [1, 2, 3])
def test_a_sensor_with_a_free_origin_stands_at_one_place(sensors):
    found = fitted(MOVING, sensors=sensors, retarget=log_target)
    assert broken(found, {}, FREE) == []
    assert found.admissible_mass is None
    for sensor in found.sensors:
        assert sensor.origin_covariance_m2 is None
        assert (np.abs(sensor.origin_m) < 0.05).all()


def test_from_its_place_a_single_sensor_sees_all_that_the_density_sees():
    (sensor,) = fitted(MOVING, sensors=1, retarget=log_target).sensors
    seen = observed_point(MOVING.points)
    ray = aim(np.tile(sensor.origin_m, (len(seen), 1)), seen)
    tangent = sensor.tangent_of((seen - sensor.origin_m) / ray[:, 5:])
    inside = (np.abs(tangent) <= np.array(sensor.field_of_view_rad) / 2).all(axis=1)
    inside &= (ray[:, 5] >= sensor.gate_m[0]) & (ray[:, 5] < sensor.gate_m[1])
    # three intervals of 95 % each
    assert MOVING.weights[inside].sum() > 0.95**3 - 0.02
    assert math.acos(sensor.boresight @ (CENTRE - sensor.origin_m) / np.linalg.norm(CENTRE - sensor.origin_m)) < 0.01


@pytest.mark.parametrize("spread_m", [0.01, 0.03])
def test_rays_start_all_over_a_region_where_constraints_allow_its_spread(spread_m):
    rules = {"origin": {"spread_m": {"max": spread_m}}}
    found = fitted(MOVING, rules, sensors=2)
    assert broken(found, rules, FREE) == []
    assert found.admissible_mass == pytest.approx(1.0)
    # origins are uniform over a box of 0.1 m, so the bound binds; at 0.03 m hardly
    assert all(0.8 * min(spread_m, 0.1 / math.sqrt(12)) < sensor.region_m <= spread_m for sensor in found.sensors)


def test_of_several_sensors_one_may_have_a_region_and_another_a_place():
    rules = {"each": [{"origin": {"spread_m": {"max": 0.02}}}, {}]}
    found = fitted(MOVING, rules, retarget=log_target)
    assert broken(found, rules, FREE) == []
    assert [sensor.region_m > 0 for sensor in found.sensors] == [True, False]


def test_a_box_keeps_mean_origins_inside_and_reports_its_mass():
    box = {"low_m": [0.0, -0.05, -0.05], "high_m": [0.05, 0.05, 0.05]}
    found = fitted(MOVING, {"origin": {**box, "spread_m": {"max": 0.01}}}, sensors=2)
    # nearer origins see the scene over more solid angle: the shares are as the squared inverse distances
    near, far = 0.575**-2, 0.625**-2
    assert found.admissible_mass == pytest.approx(near / (near + far), abs=0.03)
    for one in (found, fitted(MOVING, {"origin": box}, sensors=2, retarget=log_target)):
        assert all(0 <= sensor.origin_m[0] <= 0.05 for sensor in one.sensors)


def test_pinned_sensors_stand_exactly_where_they_were_pinned_if_the_target_is_known():
    rules = {"origin": {"fixed_m": PLACE}}
    with pytest.raises(ConfigError, match="target density"):
        fitted(MOVING, rules, sensors=2)
    found = fitted(MOVING, rules, sensors=2, retarget=log_target)
    assert broken(found, rules, FREE) == []
    assert found.admissible_mass is None
    for sensor in found.sensors:
        np.testing.assert_array_equal(sensor.origin_m, PLACE)
        assert sensor.origin_covariance_m2 is None


def test_sensors_may_be_pinned_to_different_origins():
    places = [[0.04, 0.0, 0.0], [-0.04, 0.0, 0.0]]
    rules = {"each": [{"origin": {"fixed_m": place}} for place in places]}
    found = fitted(MOVING, rules, retarget=log_target)
    assert broken(found, rules, FREE) == []
    assert [list(sensor.origin_m) for sensor in found.sensors] == places
    # nearer sensors see the same scene over more solid angle
    assert found.sensors[0].weight > found.sensors[1].weight


def test_a_thin_box_pins_one_coordinate_of_a_region():
    box = {"low_m": [-0.05, -0.05, 0.01], "high_m": [0.05, 0.05, 0.01]}
    rules = {"origin": {**box, "spread_m": {"max": 0.05}}}
    found = fitted(MOVING, rules, sensors=1, retarget=log_target)
    (sensor,) = found.sensors
    assert broken(found, rules, FREE) == []
    assert sensor.origin_m[2] == 0.01
    assert sensor.origin_covariance_m2[0, 0] > 1e-5
    np.testing.assert_array_equal(sensor.origin_covariance_m2[2], 0.0)


def test_a_field_of_view_that_may_not_hold_everything_is_that_of_the_sensors_own_share():
    rules = {"field_of_view": {"horizontal_deg": {"max": 8}, "vertical_deg": {"max": 8}}}
    found = fitted(MOVING, rules, sensors=4, retarget=log_target)
    assert broken(found, rules, FREE) == []
    # fields of 8 degrees around 24 that are seen: alike sensors would all look at the middle
    looking = np.array([sensor.boresight for sensor in found.sensors])
    apart = np.degrees(np.arccos(np.clip(looking @ looking.T, -1, 1)))
    assert apart[np.triu_indices(4, 1)].max() > 4


def test_a_bandwidth_budget_narrows_the_gates_until_it_holds():
    free = fitted(FIXED, sensors=3, rays=100)
    limit = 0.04 * 4
    rules = {"budget": {"bandwidth_mbps": limit}}
    tight = fitted(FIXED, rules, sensors=3, rays=100)
    check = next(check for check in checks(tight, rules, FACE) if check.name == "budget.bandwidth_mbps")
    assert 0.5 * limit < check.value <= limit
    assert tight.log_likelihood.value <= free.log_likelihood.value + 1e-9
    # chosen rays keep it by themselves
    loose = fitted(FIXED, rules, sensors=3, rays=100, keeps_bandwidth=False)
    assert [sensor.gate_m for sensor in loose.sensors] == [sensor.gate_m for sensor in free.sensors]


def test_without_a_ray_count_the_bandwidth_chooses_one():
    rules = {"budget": {"bandwidth_mbps": 0.5}}
    found = fitted(FIXED, rules, sensors=2)
    value = next(check.value for check in checks(found, rules, FACE) if check.name == "budget.bandwidth_mbps")
    assert found.rays > 2
    assert 0.45 < value <= 0.5


@pytest.mark.parametrize("sensors", [0, 1001])
def test_numbers_of_sensors_that_nobody_fits_are_config_errors(sensors):
    with pytest.raises(ConfigError):
        fitted(FIXED, sensors=sensors)


def effective_samples(sensors, samples):
    """How many equal weights the share of the samples is worth that belongs to each sensor, by the naive sum."""
    logs, z = [], interval_factor(0.95)
    for sensor in sensors:
        start, end = sensor.gate_m
        tangent = tangent_coordinates(sensor.frame, direction(samples.points[:, 3], samples.points[:, 4]))
        away = np.column_stack([tangent, samples.points[:, 5] - (start + end) / 2])
        spread = np.array([*sensor.field_of_view_rad, end - start]) / (2 * z)
        angle = np.hypot(*tangent.T)
        logs.append(math.log(sensor.weight) - 0.5 * np.square(away / spread).sum(axis=1) - np.log(spread).sum())
        logs[-1] += np.log(angle / np.sin(angle))
    shares = np.exp(np.array(logs) - np.logaddexp.reduce(logs)) * samples.weights
    return np.square(shares.sum(axis=1)) / np.square(shares).sum(axis=1)


@pytest.mark.parametrize("effective", [60, 120, 250])
@pytest.mark.parametrize("sensors", [1, 2, 4])
def test_every_sensor_rests_on_enough_effective_samples_or_the_fit_is_refused(effective, sensors):
    # a few of the samples count, the others next to nothing
    few = FIXED.subset(np.arange(1000))
    few = replace(few, log_target=few.log_prob + np.where(np.arange(1000) < effective, 0.0, -50.0))
    try:
        found = fitted(few, sensors=sensors)
    except InfeasibleError:
        # an equal share of the samples is not far from too few
        assert effective < 2.5 * sensors * LEAST_SAMPLES
    else:
        assert effective_samples(found.sensors, few).min() >= LEAST_SAMPLES


def test_a_sensor_that_would_rest_on_too_few_samples_is_named_with_how_many_there_are():
    with pytest.raises(InfeasibleError, match=r"sensor \d+ of 12 would rest on 1?\d effective samples") as refused:
        fitted(FIXED.subset(np.arange(150)), sensors=12)
    assert refused.value.conflicts == ("--sensors",)
    assert refused.value.allowed == f"at least {LEAST_SAMPLES:g}"


def test_errors_of_a_fit_are_its_spread_over_other_samples():
    rules, repeats = {"gate": {"end_m": {"max": 0.65}}}, 60
    fits = [
        one.estimates(samples)
        for samples in (blob(FACE, 1500, seed) for seed in range(repeats))
        for one in [fitted(samples, rules, sensors=1, restarts=1)]
    ]
    for name in ("log_likelihood", "ess", "admissible_mass"):
        spread = np.std([one[name].value for one in fits])
        stated = np.mean([one[name].error for one in fits])
        # a standard deviation of so many values is known to 9 %
        assert stated == pytest.approx(spread, rel=4 / math.sqrt(2 * repeats)), name
