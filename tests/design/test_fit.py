"""From samples to designs: budgets, counts, groups, pinned origins and scans."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from support.fits import FACE, FIXED, MOVING, blob, log_target
from support.tables import each_row

from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError
from lidardesign.mixture.fit import fit


def constrained(**values):
    return Constraints.from_mapping(values)


def test_results_have_the_contract_keys_and_survive_json():
    result = fit(FIXED, sensors=3, rays=50, em_samples=2000, restarts=2)
    document = json.loads(json.dumps(result.as_dict()))
    keys = {"design", "sensors", "log_likelihood", "admissible_mass", "ess", "satisfied", "constraints", "seconds"}
    assert keys <= set(document)
    assert document["satisfied"] is True
    assert document["admissible_mass"] == pytest.approx(1.0)
    assert 0 < document["ess"] <= 1
    assert [s["name"] for s in document["sensors"]] == ["s0", "s1", "s2"]


def test_sensors_are_ordered_by_weight():
    weights = [sensor.weight for sensor in fit(FIXED, sensors=4, em_samples=2000).design.sensors]
    assert weights == sorted(weights, reverse=True)
    assert sum(weights) == pytest.approx(1.0)


@pytest.mark.parametrize("layout", ["grid", "density", "scan"])
def test_rays_sum_to_the_budget_in_every_layout(layout):
    result = fit(FIXED, sensors=3, layout=layout, rays=37, em_samples=2000, restarts=1)
    design = result.design
    assert design.rays == 37
    assert sum(sensor.rays for sensor in design.sensors) == 37
    assert result.satisfied
    assert (layout == "density") == (design.ray_table is not None)


@pytest.mark.parametrize("layout", ["grid", "scan"])
def test_a_bandwidth_budget_narrows_the_gates_until_it_holds(layout):
    free = fit(FIXED, sensors=3, rays=100, layout=layout, em_samples=2000)
    limit = 0.04 * 4
    tight = fit(
        FIXED,
        sensors=None if layout == "scan" else 3,
        rays=100,
        layout=layout,
        em_samples=2000,
        constraints=constrained(budget={"bandwidth_mbps": limit}),
    )
    check = next(c for c in tight.constraints if c.name == "budget.bandwidth_mbps")
    assert check.value <= limit
    assert tight.satisfied
    assert tight.log_likelihood <= free.log_likelihood + 1e-9
    assert check.value > 0.5 * limit


def test_without_a_ray_count_the_bandwidth_chooses_one():
    result = fit(FIXED, sensors=2, em_samples=2000, constraints=constrained(budget={"bandwidth_mbps": 0.5}))
    value = next(c for c in result.constraints if c.name == "budget.bandwidth_mbps").value
    assert result.design.rays > 2
    assert 0.45 < value <= 0.5


def test_each_entry_rules_its_own_sensor():
    rules = constrained(each=[{"boresight": {"azimuth_deg": {"max": -2}}}, {"boresight": {"azimuth_deg": {"min": 2}}}])
    result = fit(FIXED, em_samples=2000, constraints=rules)
    assert result.satisfied
    turned = [math.degrees(math.remainder(s.azimuth_rad, 2 * math.pi)) for s in result.design.sensors]
    assert turned[0] <= -2
    assert turned[1] >= 2


def test_a_box_keeps_mean_origins_inside_and_reports_its_mass():
    rules = constrained(origin={"low_m": [0.0, -0.05, -0.05], "high_m": [0.05, 0.05, 0.05], "spread_m": {"max": 0.01}})
    result = fit(MOVING, sensors=2, em_samples=2000, constraints=rules)
    assert result.satisfied
    # nearer origins see the scene over more solid angle: the shares are as the squared inverse distances
    near, far = 0.575**-2, 0.625**-2
    assert result.admissible_mass == pytest.approx(near / (near + far), abs=0.03)
    for sensor in result.design.sensors:
        assert 0 <= sensor.origin_m[0] <= 0.05
        assert np.linalg.eigvalsh(sensor.origin_covariance_m2)[-1] <= 0.01**2


def test_pinned_designs_sit_exactly_where_they_were_pinned_if_the_target_is_known():
    where = [0.04, -0.03, 0.02]
    rules = constrained(origin={"fixed_m": where})
    with pytest.raises(ConfigError, match="target density"):
        fit(MOVING, sensors=2, constraints=rules)
    result = fit(MOVING, sensors=2, em_samples=3000, constraints=rules, retarget=log_target)
    assert result.satisfied
    assert result.admissible_mass is None
    for sensor in result.design.sensors:
        np.testing.assert_array_equal(sensor.origin_m, where)
        np.testing.assert_array_equal(sensor.origin_covariance_m2, 0.0)


def test_sensors_may_be_pinned_to_different_origins():
    places = [[0.04, 0.0, 0.0], [-0.04, 0.0, 0.0]]
    rules = constrained(each=[{"origin": {"fixed_m": place}} for place in places])
    result = fit(MOVING, em_samples=3000, constraints=rules, retarget=log_target)
    assert result.satisfied
    assert [list(s.origin_m) for s in result.design.sensors] == places
    # nearer sensors see the same scene over more solid angle
    assert result.design.sensors[0].weight > result.design.sensors[1].weight


def test_a_thin_box_pins_one_coordinate():
    rules = constrained(origin={"low_m": [-0.05, -0.05, 0.01], "high_m": [0.05, 0.05, 0.01]})
    result = fit(MOVING, sensors=1, em_samples=3000, constraints=rules, retarget=log_target)
    sensor = result.design.sensors[0]
    assert result.satisfied
    assert sensor.origin_m[2] == 0.01
    assert sensor.origin_covariance_m2[0, 0] > 1e-5
    np.testing.assert_array_equal(sensor.origin_covariance_m2[2], 0.0)


@each_row("options", [{"sensors": 0}, {"sensors": "many"}, {"rays": 0}, {"layout": "scan"}])
def test_options_that_make_no_sense_are_config_errors(options):
    with pytest.raises(ConfigError):
        fit(FIXED, **options)


def test_errors_of_a_fit_are_its_spread_over_other_samples():
    rules = constrained(gate={"end_m": {"max": 0.65}})
    repeats = 60
    fits = [fit(blob(FACE, 1500, seed), sensors=1, restarts=1, constraints=rules) for seed in range(repeats)]
    for name in ("log_likelihood", "ess", "admissible_mass"):
        spread = np.std([one.error_estimates[name].value for one in fits])
        stated = np.mean([one.error_estimates[name].error for one in fits])
        # a standard deviation of so many values is known to 9 %
        assert stated == pytest.approx(spread, rel=4 / math.sqrt(2 * repeats)), name


@pytest.mark.parametrize("rays", [7, 100])
def test_whole_rays_are_off_by_less_than_half_a_ray_per_sensor(rays):
    result = fit(FIXED, sensors=3, rays=rays, em_samples=2000, restarts=1)
    estimate = result.error_estimates["rays"]
    assert estimate.value == rays
    counts = np.array([sensor.rays for sensor in result.design.sensors])
    weights = np.array([sensor.weight for sensor in result.design.sensors])
    assert estimate.error == pytest.approx(np.maximum(counts - rays * weights, 0).sum())
    assert estimate.error <= 3 / 2
    assert fit(FIXED, sensors=3, em_samples=2000, restarts=1).error_estimates.keys().isdisjoint({"rays"})


@pytest.mark.parametrize("layout", ["scan", "density"])
def test_every_layout_states_the_error_of_its_likelihood(layout):
    estimates = fit(FIXED, layout=layout, rays=20, em_samples=2000, restarts=1).error_estimates
    assert 0 < estimates["log_likelihood"].error < 0.1
    if layout == "scan":
        assert estimates["rays"].error == pytest.approx(0.0, abs=1e-9)
