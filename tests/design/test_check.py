"""The independent checker sees every violation in a written design."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from support.tables import each_row

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.mixture.fit import fit
from lidardesign.samples import Samples
from lidardesign.sensors.design_file import design_document
from lidardesign.space import DesignSpace

SPACE = DesignSpace((-1.0, -1.0, 0.0, 0.0, -1.5, 0.1), (1.0, 1.0, 2.0, 2 * math.pi, 1.5, 4.0))
RULES = {
    "sensors": {"count": 2},
    "origin": {"low_m": [-0.5, -0.5, 0.5], "high_m": [0.5, 0.5, 1.5], "spread_m": {"max": 0.2}},
    "boresight": {"azimuth_deg": {"min": 330, "max": 60}, "elevation_deg": {"min": -30, "max": 30}},
    "field_of_view": {"horizontal_deg": {"min": 5, "max": 40}, "vertical_deg": {"max": 40}},
    "gate": {"start_m": {"min": 0.5}, "end_m": {"max": 3.5}, "width_m": {"max": 1.0}},
    "budget": {"rays": 64, "bandwidth_mbps": 1.0},
}


@pytest.fixture(scope="module")
def document():
    generator = np.random.default_rng(0)
    points = SPACE.sample(20_000, generator)
    samples = Samples(points, np.zeros(len(points)), np.zeros(len(points)), SPACE)
    result = fit(samples, constraints=Constraints.from_mapping(RULES), em_samples=3000, restarts=1)
    assert result.satisfied
    return design_document(result.design)


def broken(document, rules=RULES, space=SPACE):
    return [check.name for check in check_design(document, rules, space) if not check.satisfied]


def test_a_valid_design_passes_every_check(document):
    assert broken(document) == []
    names = {check.name for check in check_design(document, RULES, SPACE)}
    assert {"s0.gate.width_m.max", "s1.origin.spread_m.max", "budget.bandwidth_mbps", "sensors.count"} <= names


def wider(sensor, key, factor):
    """A spread and its reported interval grow together, so that only the bound is broken."""
    if key == "range_m":
        mean, half = sensor["range_m"], factor * (sensor["gate_m"]["end"] - sensor["range_m"])
        sensor["gate_m"] = {"start": max(mean - half, 0.0), "end": mean + half}
        sensor["spread"]["range_m"] *= factor
    else:
        sensor["field_of_view_rad"][key] *= factor
        sensor["spread"][f"{key}_rad"] *= factor


MUTATIONS = {
    "origin.low_m": lambda s: s["origin_m"]["mean"].__setitem__(0, -0.6),
    "origin.high_m": lambda s: s["origin_m"]["mean"].__setitem__(2, 1.6),
    "origin.spread_m.max": lambda s: s["origin_m"]["covariance"][1].__setitem__(1, 0.05),
    "boresight.azimuth_deg": lambda s: s["boresight"].__setitem__("azimuth_rad", math.radians(61)),
    "boresight.elevation_deg.max": lambda s: s["boresight"].__setitem__("elevation_rad", 0.53),
    "boresight.elevation_deg.min": lambda s: s["boresight"].__setitem__("elevation_rad", -0.53),
    "field_of_view.horizontal_deg.max": lambda s: wider(s, "horizontal", 30),
    "field_of_view.horizontal_deg.min": lambda s: wider(s, "horizontal", 0.001),
    "field_of_view.vertical_deg.max": lambda s: wider(s, "vertical", 30),
    "gate.width_m.max": lambda s: wider(s, "range_m", 2),
    "gate.start_m.min": lambda s: wider(s, "range_m", 20),
    "gate.end_m.max": lambda s: wider(s, "range_m", 20),
    "space.range_m": lambda s: wider(s, "range_m", 20),
    "field_of_view_rad.vertical": lambda s: s["field_of_view_rad"].__setitem__("vertical", 0.01),
    "gate_m.end": lambda s: s["gate_m"].__setitem__("end", s["gate_m"]["end"] - 0.01),
    "field_of_view.horizontal_deg.max ": lambda s: s["spread"].__setitem__("horizontal_rad", 2.0),
}


@each_row("name", MUTATIONS)
@each_row("sensor", [0, 1])
def test_each_violation_of_a_sensor_is_caught_by_name(document, name, sensor):
    bad = copy.deepcopy(document)
    MUTATIONS[name](bad["sensors"][sensor])
    assert f"s{sensor}.{name.strip()}" in broken(bad)


def test_a_negative_or_unlike_ray_count_is_caught(document):
    bad = copy.deepcopy(document)
    bad["sensors"][0]["rays"] += 1
    assert {"rays", "budget.rays"} <= set(broken(bad))


def test_the_bandwidth_is_recounted_from_gates_and_rays(document):
    assert "budget.bandwidth_mbps" in broken(document, {**RULES, "budget": {"bandwidth_mbps": 1e-3}})
    found = next(c for c in check_design(document, RULES) if c.name == "budget.bandwidth_mbps")
    bin_m = 299792458.0 * 1e-10 / 2
    bins = sum(s["rays"] * math.ceil((s["gate_m"]["end"] - s["gate_m"]["start"]) / bin_m) for s in document["sensors"])
    assert found.value == pytest.approx(bins * 400 / 1e6)


def test_the_number_of_sensors_is_checked(document):
    bad = copy.deepcopy(document)
    bad["sensors"].append(copy.deepcopy(bad["sensors"][0]))
    assert "sensors.count" in broken(bad)
    assert "sensors.max" in broken(bad, {"sensors": {"max": 2}})


def test_a_pinned_origin_must_be_met_without_any_spread(document):
    bad = copy.deepcopy(document)
    mean = bad["sensors"][0]["origin_m"]["mean"]
    names = broken(bad, {"each": [{"origin": {"fixed_m": list(mean)}}]})
    assert names == ["s0.origin.fixed_m.spread"]
    bad["sensors"][0]["origin_m"]["covariance"] = [[0.0] * 3] * 3
    assert broken(bad, {"each": [{"origin": {"fixed_m": list(mean)}}]}) == []


def test_the_largest_spread_is_found_in_any_direction(document):
    bad = copy.deepcopy(document)
    root = np.array([[0.1, 0.0, 0.0], [0.1, 0.05, 0.0], [0.05, 0.0, 0.02]])
    covariance = root @ root.T
    bad["sensors"][0]["origin_m"]["covariance"] = covariance.tolist()
    found = next(c for c in check_design(bad, RULES) if c.name == "s0.origin.spread_m.max")
    assert found.value == pytest.approx(math.sqrt(np.linalg.eigvalsh(covariance)[-1]), rel=1e-12)


def test_explicit_rays_keep_their_sensors_gate_bounds(document):
    bad = copy.deepcopy(document)
    bad["ray_table"] = {"gate_start_m": [0.6] * 64, "gate_end_m": [1.7] * 64, "sensor": [0] * 64}
    assert "ray0.gate.width_m.max" in broken(bad)


def test_intervals_in_azimuth_pass_through_zero(document):
    good = copy.deepcopy(document)
    for azimuth, kept in ((331, True), (0, True), (59, True), (61, False), (329, False)):
        good["sensors"][0]["boresight"]["azimuth_rad"] = math.radians(azimuth)
        assert ("s0.boresight.azimuth_deg" in broken(good)) != kept
