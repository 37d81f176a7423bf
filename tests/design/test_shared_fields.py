"""Rays of sensors at one place with gates of their own: divided over all their fields together, inside each of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lidardesign.layouts.density import bandwidth_limit, shared_rays
from lidardesign.layouts.rays import lay_out
from support.tables import each_row

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.mixture.fit import fit
from lidardesign.samples import Samples
from lidardesign.sensors.bandwidth import Bandwidth, split_budget
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.sensor import DesignSpec, Sensor, interval_factor, tangent_coordinates
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, -1.2, -0.9, 0.2), (0, 0, 0, 1.2, 0.9, 3.0))
FIELD_SLACK_RAD = 1e-9


def spots(count=6000, seed=0, space=SPACE, even=0.02):
    """Samples of three spots in direction and range, two of which lie behind each other."""
    generator = np.random.default_rng(seed)
    points = space.sample(count, generator)
    centres = np.array([[-0.4, 0.1, 0.8], [0.3, -0.1, 1.0], [0.35, 0.0, 2.0]])
    squares = np.square((points[:, None, 3:] - centres) / [0.3, 0.25, 0.15]).sum(-1)
    log_target = np.log(np.exp(-squares / 2).sum(axis=1) + even)
    return Samples(points, np.full(count, -space.log_volume), log_target, space)


SAMPLES = spots()


def made(rays=60, constraints=None, samples=SAMPLES, sensors=3, seed=0, level=0.95):
    rules = None if constraints is None else Constraints.from_mapping(constraints, where="test")
    return fit(
        samples, sensors=sensors, layout="density", rays=rays, gates="ray", constraints=rules, seed=seed, restarts=2,
        level=level,
    )  # fmt: skip


DESIGN = made().design


def inside_fields(design, directions, sensors):
    for index, sensor in enumerate(design.sensors):
        tangent = np.abs(tangent_coordinates(sensor.frame, directions[sensors == index]))
        assert (tangent <= np.array(sensor.field_of_view_rad) / 2 + FIELD_SLACK_RAD).all()


@each_row("count", [1, 2, 7, 60, 333])
def test_rays_sum_exactly_and_lie_in_the_fields_of_their_sensors(count):
    rays = lay_out(DESIGN, count, SAMPLES, gates="ray")
    assert len(rays) == count
    assert (np.diff(rays.sensor) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=1), 1.0, rtol=1e-12)
    inside_fields(DESIGN, rays.direction, rays.sensor)
    assert (rays.gate_m[:, 0] < rays.gate_m[:, 1]).all()


def wide_sensor(horizontal, vertical, name="s0", weight=1.0, roll=0.0, range_m=1.5):
    across, up = horizontal / 2 / interval_factor(0.95), vertical / 2 / interval_factor(0.95)
    return Sensor(name, weight, np.zeros(3), np.zeros((3, 3)), 0.1, 0.2, roll, across, up, range_m, 0.6)


@given(st.floats(0.05, 3.0), st.floats(0.05, 2.5), st.floats(-3, 3), st.integers(1, 40), st.integers(0, 100))
def test_rays_lie_in_fields_however_wide(horizontal, vertical, roll, count, seed):
    turn = DesignSpace((0, 0, 0, -math.pi, -math.pi / 2, 0.2), (0, 0, 0, math.pi, math.pi / 2, 3.0))
    points = turn.sample(1500, np.random.default_rng(seed))
    samples = Samples(points, np.zeros(1500), np.zeros(1500), turn)
    design = DesignSpec("d", (wide_sensor(horizontal, vertical, roll=roll),), layout="density")
    found = shared_rays(design, np.array([count]), samples, 0)
    if found is not None:
        assert len(found.sensor) == count
        inside_fields(design, found.direction, found.sensor)
        assert np.isfinite(found.gate_m).all()


def test_sensors_fire_as_many_rays_as_the_table_has_of_theirs():
    table = DESIGN.ray_table
    assert [sensor.rays for sensor in DESIGN.sensors] == np.bincount(table.sensor, minlength=3).tolist()
    assert sum(sensor.rays for sensor in DESIGN.sensors) == DESIGN.rays == len(table.sensor) == 60
    assert [sensor["rays"] for sensor in design_document(DESIGN)["sensors"]] == [s.rays for s in DESIGN.sensors]


def test_a_gate_holds_what_its_ray_looks_at_not_what_its_sensor_does():
    sharp = spots(even=1e-4)
    rays = lay_out(made(samples=sharp).design, 60)
    azimuth = np.arctan2(rays.direction[:, 1], rays.direction[:, 0])
    near = rays.gate_m[azimuth < -0.3]
    assert np.median(near[:, 1]) < 1.4
    both = rays.gate_m[(azimuth > 0.2) & (azimuth < 0.5)]
    assert np.median(both[:, 1]) > 1.8


def test_few_samples_with_nearly_all_weight_leave_no_ray_without_direction():
    generator = np.random.default_rng(4)
    points = SPACE.sample(8000, generator)
    log_target = np.where(np.arange(8000) < 5, 12.0, 0.0)
    samples = Samples(points, np.zeros(8000), log_target, SPACE)
    design = DesignSpec("d", (wide_sensor(2.4, 1.8),), layout="density")
    found = shared_rays(design, np.array([30]), samples, 0)
    np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1.0, rtol=1e-12)
    assert len(np.unique(np.round(found.direction, 9), axis=0)) == 30
    inside_fields(design, found.direction, found.sensor)


def test_too_few_samples_are_said_to_be_too_few():
    few = spots(20)
    assert shared_rays(DESIGN, np.array([100, 100, 100]), few, 0) is None


RULES = {
    "none": {},
    "gates": {"gate": {"start_m": {"min": 0.5}, "end_m": {"max": 2.2}, "width_m": {"max": 0.4}}},
    "least widths": {"gate": {"width_m": {"min": 0.05, "max": 1.5}}},
    "fields": {"field_of_view": {"horizontal_deg": {"max": 30}, "vertical_deg": {"max": 40}}},
    "bandwidth": {"budget": {"bandwidth_mbps": 0.6}},
    "tight bandwidth": {"budget": {"bandwidth_mbps": 0.1}},
    "bins": {"budget": {"bandwidth_mbps": 0.5, "bin_ps": 300.0, "bits_per_bin": 16, "rate_hz": 30}},
    "each": {
        "gate": {"end_m": {"max": 2.5}},
        "each": [{"gate": {"end_m": {"max": 1.2}}}, {"gate": {"start_m": {"min": 0.7}}}, {}],
    },
    "all": {
        "gate": {"width_m": {"max": 0.8}},
        "budget": {"bandwidth_mbps": 0.5},
        "each": [{"gate": {"end_m": {"max": 1.3}}}, {}, {}],
    },
}


def assert_kept(design, name):
    checks = check_design(design_document(design), Constraints.from_mapping(RULES[name], where="test"), SPACE)
    assert all(check.satisfied for check in checks), [c.name for c in checks if not c.satisfied]


@each_row("name", RULES)
def test_designs_pass_the_independent_checker(name):
    result = made(constraints=RULES[name])
    assert_kept(result.design, name)
    assert result.satisfied
    rays = lay_out(result.design, 60, SAMPLES)
    np.testing.assert_array_equal(rays.gate_m, result.design.ray_table.gate_m)
    inside_fields(result.design, rays.direction, rays.sensor)


@each_row("name", ["bandwidth", "bins", "all"])
@each_row("count", [15, 60, 151])
def test_a_bandwidth_holds_at_every_number_of_rays(name, count):
    budget = {"bin_ps": 100.0, "bits_per_bin": 40, "rate_hz": 10, **RULES[name]["budget"]}
    model = Bandwidth(budget["bin_ps"], budget["bits_per_bin"], budget["rate_hz"])
    design = made(constraints=RULES[name]).design
    rays = lay_out(design, count, SAMPLES, gates="ray")
    allowed = budget["bandwidth_mbps"]
    assert model.mbps(rays) <= allowed * (1 + 1e-12)
    # and is made use of: fewer gates than the budget pays for would be a waste, unless few rays need no more
    assert model.mbps(rays) > 0.85 * allowed or count < 60


def test_each_ray_keeps_the_bounds_of_its_own_sensor():
    design = made(constraints=RULES["each"]).design
    rays = lay_out(design, 200, SAMPLES, gates="ray")
    assert (rays.gate_m[rays.sensor == 0, 1] <= 1.2 + 1e-9).all()
    assert (rays.gate_m[rays.sensor == 1, 0] >= 0.7 - 1e-9).all()
    assert (rays.gate_m[:, 1] <= 2.5 + 1e-9).all()


def test_one_bin_per_ray_is_the_least():
    rules = Constraints.from_mapping({"budget": {"bandwidth_mbps": 0.001}}, where="test")
    assert bandwidth_limit(rules, 60)[1] == 60


def test_rays_of_several_places_start_at_the_origins_of_their_sensors():
    free = DesignSpace((-0.5, 0, 0, -1.2, -0.9, 0.2), (0.5, 0, 0, 1.2, 0.9, 3.0))
    samples = spots(6000, space=free)
    sensors = [
        replace(wide_sensor(1.6, 1.2, f"s{index}", 0.25), origin_m=np.array(origin, dtype=float))
        for index, origin in enumerate([(-0.4, 0, 0), (0.4, 0, 0), (-0.4, 0, 0), (0.1, 0, 0)])
    ]
    design = DesignSpec("d", tuple(sensors), layout="density")
    shares = split_budget(design.weights, 90)
    rays = lay_out(design, 90, samples, gates="ray")
    assert len(rays) == 90
    origins = np.array([sensor.origin_m for sensor in sensors])
    np.testing.assert_array_equal(rays.origin_m, origins[rays.sensor])
    inside_fields(design, rays.direction, rays.sensor)
    counts = np.bincount(rays.sensor, minlength=4)
    # sensors at one place share theirs out anew, others keep their share
    assert counts[0] + counts[2] == shares[0] + shares[2]
    assert counts[[1, 3]].tolist() == shares[[1, 3]].tolist()


@pytest.mark.parametrize("name", ["none", "bandwidth", "all"])
def test_where_samples_are_too_few_for_so_many_rays_bandwidth_and_bounds_are_kept_all_the_same(name):
    few = spots(900)
    result = made(rays=880, constraints=RULES[name], samples=few)
    assert shared_rays(result.design, np.array([s.rays for s in result.design.sensors]), few, 0) is None
    assert_kept(result.design, name)
    gates = result.design.ray_table.gate_m
    if name == "none":
        assert gates[:, 1].max() <= max(sensor.gate_m[1] for sensor in result.design.sensors)
    else:
        assert Bandwidth().mbps(lay_out(result.design)) > 0.7 * RULES[name]["budget"]["bandwidth_mbps"]
