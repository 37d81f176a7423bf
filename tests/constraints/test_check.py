"""The independent checker sees every violation in a written design."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.designs import sensor

from lidardesign.constraints.check import check_design
from lidardesign.constraints.slack import broken_notes
from lidardesign.sensors.bandwidth import Bandwidth, split_budget
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.pattern import Pattern, even_rays
from lidardesign.space import DesignSpace

SPACE = DesignSpace(
    (-1.0, -1.0, 0.0, 0.0, -1.5, 0.1), (1.0, 1.0, 2.0, 2 * math.pi, 1.5, 4.0), condition=("x_m",)
)  # fmt: skip
RULES = {
    "sensors": {"count": 2},
    "origin": {"low_m": [-0.5, -0.5, 0.5], "high_m": [0.5, 0.5, 1.5], "spread_m": {"max": 0.2}},
    "boresight": {
        "azimuth_deg": {"min": 330, "max": 60},
        "elevation_deg": {"min": -30, "max": 30},
        "roll_deg": {"min": -44, "max": 44},
    },
    "field_of_view": {"horizontal_deg": {"min": 5, "max": 40}, "vertical_deg": {"max": 40}},
    "gate": {"start_m": {"min": 0.5}, "end_m": {"max": 3.5}, "width_m": {"min": 0.1, "max": 1.0}},
    "budget": {"rays": 64, "bandwidth_mbps": 2.0},
}
SENSORS = (
    sensor("s0", 0.5, origin_m=(0.1, -0.2, 1.0), azimuth_rad=0.3, range_m=1.5, origin_covariance_m2=np.eye(3) * 0.01),
    sensor("s1", 0.5, origin_m=(-0.3, 0.2, 0.8), azimuth_rad=6.0, elevation_rad=0.2, range_m=2.0),
)


def written(layout="chosen"):
    """A document that keeps all rules: 64 rays of two sensors."""
    rays = even_rays(SENSORS, (32, 32))
    patterns = () if layout == "even" else (Pattern.of(rays),)
    return design_document(DesignSpec("d", SENSORS, layout, patterns))


def along():
    """The same rays along x, with gates that widen."""
    design = DesignSpec("d", SENSORS, "chosen", (Pattern.of(even_rays(SENSORS, (32, 32))),))
    still, knots = design.patterns[0], (-0.4, 0.1, 0.5)
    gate_m = np.concatenate([still.gate_m + np.array(by) for by in ([0.05, -0.05], [-0.05, 0.0], [0.0, 0.0])])
    origin_m = np.repeat(still.origin_m, 3, axis=0)
    origin_m[..., 0] = np.array(knots)[:, None]
    azimuth, elevation = (np.repeat(column, 3, axis=0) for column in (still.azimuth_rad, still.elevation_rad))
    pattern = Pattern(origin_m, azimuth, elevation, gate_m, still.sensor, "x_m", knots)
    document = design_document(DesignSpec("d", SENSORS, "chosen", (pattern,)))
    for one in document["sensors"]:
        one["gate_m"]["start"] -= 0.05
    return document


def broken(document, rules=RULES, space=SPACE):
    return [check.name for check in check_design(document, rules, space) if not check.satisfied]


@pytest.mark.parametrize("document", [written(), written("even"), written("fixed"), along()])
def test_a_valid_design_passes_every_check(document):
    assert broken(document) == []
    names = {check.name for check in check_design(document, RULES, SPACE)}
    assert {"s0.gate.width_m.max", "s1.origin.spread_m.max", "budget.bandwidth_mbps", "sensors.count"} <= names


# --- sensors


def gate(sensor, start, end):
    sensor["gate_m"] = {"start": start, "end": end}


MUTATIONS = {
    "origin.low_m": lambda s: s["origin_m"]["mean"].__setitem__(0, -0.6),
    "origin.high_m": lambda s: s["origin_m"]["mean"].__setitem__(2, 1.6),
    "origin.spread_m.max": lambda s: s["origin_m"].__setitem__("covariance", np.diag([0, 0.05, 0]).tolist()),
    "space.x_m": lambda s: s["origin_m"]["mean"].__setitem__(0, 1.2),
    "boresight.azimuth_deg": lambda s: s["boresight"].__setitem__("azimuth_rad", math.radians(61)),
    "boresight.elevation_deg.max": lambda s: s["boresight"].__setitem__("elevation_rad", 0.53),
    "boresight.roll_deg.max": lambda s: s["boresight"].__setitem__("roll_rad", 0.78),
    "boresight.roll_deg.min": lambda s: s["boresight"].__setitem__("roll_rad", -0.79),
    "boresight.elevation_deg.min": lambda s: s["boresight"].__setitem__("elevation_rad", -0.53),
    "field_of_view.horizontal_deg.max": lambda s: s["field_of_view_rad"].__setitem__("horizontal", 0.7),
    "field_of_view.horizontal_deg.min": lambda s: s["field_of_view_rad"].__setitem__("horizontal", 0.08),
    "field_of_view.vertical_deg.max": lambda s: s["field_of_view_rad"].__setitem__("vertical", 0.7),
    "gate.width_m.max": lambda s: gate(s, 1.0, 2.01),
    "gate.width_m.min": lambda s: gate(s, 1.0, 1.09),
    "gate.start_m.min": lambda s: gate(s, 0.49, 1.0),
    "gate.end_m.max": lambda s: gate(s, 3.0, 3.51),
    "space.range_m": lambda s: gate(s, 0.09, 1.0),
}


@pytest.mark.parametrize("name", MUTATIONS)
@pytest.mark.parametrize("sensor", [0, 1])
def test_each_violation_of_a_sensor_is_caught_by_name(name, sensor):
    bad = written("even")
    MUTATIONS[name](bad["sensors"][sensor])
    assert f"s{sensor}.{name}" in broken(bad)
    assert not [other for other in broken(bad) if other.startswith(f"s{1 - sensor}.")]


def test_the_number_of_sensors_is_checked():
    bad = written()
    bad["sensors"].append(copy.deepcopy(bad["sensors"][0]))
    assert "sensors.count" in broken(bad)
    assert broken(bad, {"sensors": {"max": 2}}) == ["sensors.max"]


def test_a_pinned_origin_must_be_met_without_any_spread():
    bad = written("even")
    rules = {"each": [{"origin": {"fixed_m": list(bad["sensors"][0]["origin_m"]["mean"])}}]}
    assert broken(bad, rules) == ["s0.origin.fixed_m.spread"]
    del bad["sensors"][0]["origin_m"]["covariance"]
    assert broken(bad, rules) == []


def test_the_spread_of_an_origin_is_that_in_any_direction():
    bad = written()
    root = np.array([[0.1, 0.0, 0.0], [0.1, 0.05, 0.0], [0.05, 0.0, 0.02]])
    covariance = root @ root.T
    bad["sensors"][0]["origin_m"]["covariance"] = covariance.tolist()
    found = next(c for c in check_design(bad, RULES) if c.name == "s0.origin.spread_m.max")
    assert found.value == pytest.approx(math.sqrt(np.linalg.eigvalsh(covariance)[-1]), rel=1e-12)


@pytest.mark.parametrize(("azimuth", "kept"), [(331, True), (0, True), (59, True), (61, False), (329, False)])
def test_intervals_in_azimuth_pass_through_zero(azimuth, kept):
    document = written("even")
    document["sensors"][0]["boresight"]["azimuth_rad"] = math.radians(azimuth)
    assert ("s0.boresight.azimuth_deg" in broken(document)) != kept


# --- rays


def turned(document, sensor, key, angle, ray=0):
    """A ray of a sensor turned out of its field: along the horizontal or the vertical of a sensor without roll."""
    own = document["patterns"][0]["sensor"].index(sensor) + ray
    for row in document["patterns"][0][key]:
        row[own] += angle


@pytest.mark.parametrize("document", [written, along])
@pytest.mark.parametrize("sensor", [0, 1])
@pytest.mark.parametrize("key", ["azimuth_rad", "elevation_rad"])
@pytest.mark.parametrize("angle", [-0.5, 0.5, math.pi])
def test_a_chosen_ray_that_looks_out_of_its_sensors_field_is_caught(document, sensor, key, angle):
    bad = document()
    turned(bad, sensor, key, angle)
    found = broken(bad)
    assert found
    assert set(found) <= {f"s{sensor}.rays.horizontal_rad", f"s{sensor}.rays.vertical_rad"}
    assert broken({**bad, "layout": "spinning"})
    # rays of real parts and rigs are what they are
    assert broken({**bad, "layout": "fixed"}) == []


@pytest.mark.parametrize("document", [written, along])
@pytest.mark.parametrize("axis", ["y", "z"])
@pytest.mark.parametrize(("sensor", "by", "kept"), [(0, 0.25, True), (0, 0.3, False), (1, 0, True), (1, 1e-4, False)])
def test_a_chosen_ray_starts_in_its_sensors_region_or_at_its_place(document, axis, sensor, by, kept):
    bad = document()
    bad["patterns"][0][f"origin_{axis}_m"][-1][40 * sensor] += by
    assert broken(bad, {}) == ([] if kept else [f"s{sensor}.rays.origin_m"])
    assert bool(broken_notes("d", check_design(bad, {}, SPACE))) != kept


@pytest.mark.parametrize("end", ["start", "end"])
@pytest.mark.parametrize("by", [1e-4, 0.2])
def test_a_chosen_ray_that_listens_out_of_its_sensors_gate_is_caught(end, by):
    bad = along()
    bad["patterns"][0][f"gate_{end}_m"][1][40] += by if end == "end" else -by
    assert broken(bad) == ["s1.rays.gate_m"]


@pytest.mark.parametrize("digits", [7, 9])
def test_rays_on_the_edge_of_their_field_are_inside_whatever_digits_a_file_rounds(digits):
    document = written()
    one, pattern = document["sensors"][0], document["patterns"][0]
    tangent = SENSORS[0].tangent_of(Pattern.of(even_rays(SENSORS, (32, 32))).at().direction[:32])
    horizontal, vertical = (2 * np.abs(tangent).max(axis=0)).tolist()
    one["field_of_view_rad"] = {"horizontal": horizontal, "vertical": vertical}
    for key in ("azimuth_rad", "elevation_rad"):
        pattern[key] = np.round(pattern[key], digits).tolist()
    assert broken(document) == []
    one["field_of_view_rad"] = {"horizontal": horizontal - 1e-4, "vertical": vertical}
    assert broken(document) == ["s0.rays.horizontal_rad"]


@pytest.mark.parametrize("turn", [170, 190, 300])
def test_fields_beyond_a_half_turn_hold_what_they_hold_below_it(turn):
    wide = replace(SENSORS[0], field_of_view_rad=(math.radians(turn), 1.9))
    document = design_document(DesignSpec("d", (wide,), "chosen", (Pattern.of(even_rays((wide,), (400,))),)))
    assert broken(document, {}) == []
    document["sensors"][0]["field_of_view_rad"]["horizontal"] -= 0.5
    assert broken(document, {}) == ["s0.rays.horizontal_rad"]


VIOLATIONS = [
    (lambda p: p["gate_start_m"][1].__setitem__(1, 0.49), "ray1.knot1.gate.start_m.min"),
    (lambda p: p["gate_end_m"][1].__setitem__(1, 3.6), "ray1.knot1.gate.end_m.max"),
    (lambda p: p["gate_end_m"][2].__setitem__(0, 2.6), "ray0.knot2.gate.width_m.max"),
    (lambda p: p["gate_start_m"][2].__setitem__(0, p["gate_end_m"][2][0] - 0.05), "ray0.knot2.gate.width_m.min"),
    (lambda p: p["gate_end_m"][2].__setitem__(0, 6.0), "ray0.knot2.space.range_m"),
    (lambda p: p["knots_m"].__setitem__(2, 5.0), "pattern.space.x_m"),
]


@pytest.mark.parametrize(("change", "name"), VIOLATIONS)
def test_the_ray_and_the_knot_that_break_a_bound_are_named(change, name):
    bad = along()
    change(bad["patterns"][0])
    assert name in broken(bad)


def test_rays_keep_the_gate_bounds_of_their_own_sensor():
    own = {**RULES, "each": [{}, {"gate": {"end_m": {"max": 1.9}}}]}
    names = [name for name in broken(written(), own) if name.startswith("ray")]
    assert names == [f"ray{index}.gate.end_m.max" for index in range(32, 64)]


def test_no_ray_starts_in_an_excluded_box_or_passes_through_one_between_knots():
    box = {"low_m": [0.32, -0.3, 0.9], "high_m": [0.4, -0.1, 1.1]}
    rules = {"each": [{"origin": {"exclude": [box]}}]}
    # the box lies between the second knot and the third
    assert broken(along(), rules) == [f"ray{index}.origin.exclude[0]" for index in range(32)]
    starts = written()
    for x_m, kept in ((0.35, False), (0.3201, False), (0.32, True)):
        starts["patterns"][0]["origin_x_m"][0][3] = x_m
        assert broken(starts, rules) == ([] if kept else ["ray3.origin.exclude[0]"])


# --- budgets


@pytest.mark.parametrize("layout", ["chosen", "even", "fixed"])
def test_the_bandwidth_is_recounted_from_gates_and_rays(layout):
    document = written(layout)
    assert "budget.bandwidth_mbps" in broken(document, {"budget": {"rays": 64, "bandwidth_mbps": 1e-3}})
    found = next(c for c in check_design(document, RULES) if c.name == "budget.bandwidth_mbps")
    bin_m = 299792458.0 * 1e-10 / 2
    bins = sum(32 * math.ceil((one.gate_m[1] - one.gate_m[0]) / bin_m) for one in SENSORS)
    assert found.value == pytest.approx(bins * 400 / 1e6)


@given(st.lists(st.floats(0.01, 1), min_size=2, max_size=2), st.integers(1, 200))
def test_even_rays_are_shared_out_as_the_design_fires_them(weights, rays):
    shares = np.array(weights) / sum(weights)
    document = written("even")
    for one, share in zip(document["sensors"], shares, strict=True):
        one["weight"] = float(share)
    checks = check_design(document, {"budget": {"rays": rays, "bandwidth_mbps": 1.0}})
    found = next(c.value for c in checks if c.name == "budget.bandwidth_mbps")
    widths = np.array([one.gate_m[1] - one.gate_m[0] for one in SENSORS])
    assert found == pytest.approx(Bandwidth().mbps_of_widths(widths, split_budget(shares, rays, each=True)))


@pytest.mark.parametrize("rays", [32, 63, 65])
def test_another_number_of_rays_than_asked_for_is_caught(rays):
    assert broken(written(), {"budget": {"rays": rays}}) == ["budget.rays"]


def test_of_several_patterns_the_dearest_counts_and_numbers_are_not_those_of_one():
    document = written()
    few = Pattern.of(even_rays(SENSORS, (2, 2)))
    document["patterns"].insert(0, design_document(DesignSpec("d", SENSORS, "chosen", (few,)))["patterns"][0])
    alone = {check.name: check.value for check in check_design(written(), RULES)}
    checks = {check.name: check for check in check_design(document, RULES)}
    assert checks["budget.bandwidth_mbps"].value == alone["budget.bandwidth_mbps"]
    assert not checks["budget.rays"].satisfied


@given(widths=st.lists(st.lists(st.floats(0.001, 0.3), min_size=3, max_size=3), min_size=2, max_size=4))
def test_the_bandwidth_along_a_condition_is_that_of_the_dearest_position(widths):
    gate_m = np.stack([np.zeros_like(widths), np.array(widths)], axis=-1)
    flat, knots = np.zeros(gate_m.shape[:2]), tuple(np.linspace(0.0, 1.0, len(widths)))
    pattern = Pattern(np.zeros((*flat.shape, 3)), flat, flat, gate_m, np.zeros(3, dtype=int), "x_m", knots)
    document = design_document(DesignSpec("d", SENSORS[:1], "fixed", (pattern,)))
    checks = check_design(document, {"budget": {"bandwidth_mbps": 1.0}})
    found = next(check.value for check in checks if check.name == "budget.bandwidth_mbps")
    assert found >= max(Bandwidth().mbps(pattern.at(x)) for x in np.linspace(0.0, 1.0, 200)) - 1e-9
    # never more than rays that were each the dearest of two neighbouring knots
    worst = np.maximum(gate_m[:-1, :, 1], gate_m[1:, :, 1])
    assert found <= max(Bandwidth().mbps_of_widths(row) for row in worst) + 1e-9
