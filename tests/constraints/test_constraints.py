"""Constraint files: what they may say, which contradict themselves, and that fits keep them exactly."""

from __future__ import annotations

import math
import re
from operator import attrgetter
from types import SimpleNamespace

import pytest
from support.constraints import FACE

from lidardesign.constraints.document import Constraints, Gate, load_constraints, rules_of, split_settings
from lidardesign.constraints.feasibility import check_feasible, unit_notes
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.limits import MOST_RAYS
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import DesignSpace


def test_a_fixed_angle_admits_no_field_of_view_along_it():
    flat = DesignSpace((0.0, 0.0, 0.0, 0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0, 0.0, 2.0))
    with pytest.raises(InfeasibleError) as caught:
        check_feasible(Constraints.from_mapping({"field_of_view": {"vertical_deg": {"min": 5}}}), flat)
    assert "space.elevation_rad" in caught.value.conflicts


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"gates": {}}, "unknown key 'gates'"),
        ({"gate": {"width": {"max": 1}}}, "unknown key 'gate.width'"),
        ({"origin": {"mounts_m": [[0, 0, 0], [0, 0, 0]]}}, "the mounts must differ"),
        ({"origin": {"thickness_m": {"max": 0}}}, "origin.thickness_m.max"),
        ({"gate": {"width_m": {"max": -1}}}, "greater than or equal to 0.000000001"),
        ({"gate": 3}, "gate"),
        ({"gate": {"end_m": {"max": math.inf}}}, "a finite number"),
        *[({"sensors": {"count": 2, other: 2}}, "either count, or min and max") for other in ("min", "max")],
        *[(values, f"found one {type(values).__name__}") for values in ([], "gate", 3, False, ())],
    ],
)
def test_what_a_file_may_not_say_is_a_config_error_with_its_key_and_place(values, text):
    with pytest.raises(ConfigError, match=text) as caught:
        Constraints.from_mapping(values, where="--constraints")
    assert caught.value.exit_code == 2
    assert "--constraints" in str(caught.value)


BOX = {"low_m": [0, 0, 0], "high_m": [1, 1, 1]}
# key, what it takes, what it does not: the last accepted and the first refused on each side
LIMITS = {
    "sensors.count": ([1, 2, 1000], [0, -1, 1.5, 2.0, "2", 1001]),
    "sensors.min": ([1, 2, 1000], [0, 1.5, 1001]),
    "sensors.max": ([1, 2, 1000], [0, 1.5, 1001]),
    "budget.rays": ([1, 2, MOST_RAYS], [0, 10.0, MOST_RAYS + 1]),
    "budget.bandwidth_mbps": ([1e-9, 0.5, 1e9], [0, -0.5, 1e-10, 1.1e9]),
    "budget.bin_ps": ([0.001, 1e9], [0, 0.0009, 1e9 + 0.5]),
    "budget.bits_per_bin": ([0.001, 1e9], [0, 0.0009, 1e9 + 0.5]),
    "budget.rate_hz": ([0.001, 1e12], [0, 0.0009, 1e12 + 0.5]),
    "boresight.azimuth_deg.min": ([-36000.0, 0, 36000.0], [math.inf, math.nan, "0", -36001.0, 36001.0, 1e300]),
    "boresight.elevation_deg.min": ([-90, 0.5, 90], [-90.5, 90.5]),
    "boresight.roll_deg.min": ([-180, 0.5, 180], [-180.5, 180.5]),
    "boresight.roll_deg.max": ([-180, 0.5, 180], [-180.5, 180.5]),
    "boresight.elevation_deg.max": ([-90, 0.5, 90], [-90.5, 90.5]),
    "field_of_view.horizontal_deg.min": ([0, 0.5, 360], [-0.5, 360.5]),
    "field_of_view.vertical_deg.min": ([0, 0.5, 360], [-0.5, 360.5]),
    "field_of_view.horizontal_deg.max": ([1e-9, 0.5, 360], [0, 1e-300, -0.5, 360.5]),
    "field_of_view.vertical_deg.max": ([0.5, 360], [0, -0.5, 360.5]),
    "gate.start_m.min": ([0, 0.5, 1e9], [-0.5, 1.1e9]),
    "gate.start_m.max": ([1e-9, 0.5], [0, -0.5, 1e-10, 1e300]),
    "gate.width_m.min": ([0, 0.5], [-0.5]),
    "origin.spread_m.max": ([1e-9, 0.5], [0, -0.5, 1e-300]),
    "origin.low_m": ([[0, 0, 0], [-1e9, 0, 1e9]], [[0, 0], [0, 0, 0, 0], [0, 0, "0"], [0, 0, 1e300]]),
    "origin.mounts_m": ([[[0, 0, 0]], [[0, 0, 0], [0, 0, 1]]], [[], [[0, 0]]]),
    "parts.price.max": ([0.5, 40, 1e9], [0, -1, "40"]),
    "parts.names": ([["a"], ["a", "b"], "catalog"], [[], [""], "a"]),
    "survive": ([0, 1], [-1, 2, 0.5, True]),
    "origin.exclude": ([[], [BOX] * 32], [[BOX] * 33, [{"low_m": [0, 0, 0]}]]),
}


@pytest.mark.parametrize("key", LIMITS)
def test_every_number_is_taken_up_to_its_limit_and_not_beyond(key):
    taken, refused = LIMITS[key]

    def read(value):
        for part in reversed(key.split(".")):
            value = {part: value}
        return Constraints.from_mapping(value)

    for value in taken:
        found = read(value)
        for part in key.split("."):
            found = getattr(found, part)
        assert (len(found) == len(value)) if key == "origin.exclude" else (found == value)
    for value in refused:
        with pytest.raises(ConfigError, match=key.replace(".", r"\.")):
            read(value)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_excluded_box_is_given_from_low_to_high_and_may_be_flat(axis):
    low, high = [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
    low[axis] = 1.0
    read = Constraints.from_mapping({"origin": {"exclude": [{"low_m": low, "high_m": high}]}})
    assert read.origin.exclude[0].low_m == low
    low[axis] = 1.5
    with pytest.raises(ConfigError, match=f"above high_m along {'xyz'[axis]}"):
        Constraints.from_mapping({"origin": {"exclude": [{"low_m": low, "high_m": high}]}})


def test_entries_of_each_lie_over_the_common_keys():
    values = {"gate": {"width_m": {"min": 0.1, "max": 0.5}}, "each": [{}, {"gate": {"width_m": {"max": 0.2}}}]}
    constraints = Constraints.from_mapping(values)
    assert rules_of(constraints.rules, 1).gate.width_m.min == 0.1
    assert [rules_of(constraints.rules, sensor).gate.width_m.max for sensor in (0, 1, 2, 7)] == [0.5, 0.2, 0.5, 0.5]
    assert constraints.as_document() == values


def test_an_entry_of_each_is_named_where_a_key_stands_in_it():
    values = {"gate": {"width_m": {"min": 0.1}}, "each": [{"gate": {"width_m": {"max": 0.2}}}, {}]}
    first, *others = (rules_of(Constraints.from_mapping(values).rules, sensor) for sensor in range(3))
    assert first.path("gate.width_m.max") == "each[0].gate.width_m.max"
    assert first.path("gate") == "each[0].gate"
    for key in ("gate.width_m.min", "gate.width_m.max.deeper", "origin", "boresight.roll_deg"):
        assert first.path(key) == key
    for key in ("gate.width_m.max", "gate", "origin"):
        assert {one.path(key) for one in others} == {key}


def test_a_document_holds_what_was_given_and_no_more():
    gate = Gate(width_m={"min": None, "max": 0.5})
    assert Constraints(gate=gate).as_document() == {"gate": {"width_m": {"max": 0.5}}}
    assert [Constraints(survive=number).as_document() for number in (0, 1)] == [{}, {"survive": 1}]


@pytest.mark.parametrize("part", [lambda read: read, lambda read: read.gate, lambda read: read.rules[0]])
def test_what_was_read_stays_as_it_is(part):
    with pytest.raises((ValueError, AttributeError), match=r"frozen|cannot assign"):
        part(Constraints()).gate = Gate()


@pytest.mark.parametrize(
    ("values", "name", "value"),
    [
        *[({}, "survive", 0), ({}, "budget.readout", Bandwidth(100, 40, 10))],
        *[({}, "least_sensors", 1), ({"survive": 1}, "least_sensors", 2), ({"each": [{}] * 3}, "least_sensors", 3)],
        *[({"sensors": {"min": number}, "survive": 1}, "least_sensors", max(number, 2)) for number in (1, 2, 3)],
        ({"parts": {}}, "parts.sums", {}),
        ({"parts": {"power_w": 2}}, "parts.sums", {"parts.power_w": ("power_w", 2)}),
        ({"parts": {"price": {"max": 40}}}, "parts.sums", {"parts.price.max": ("price", 40)}),
    ],
)
def test_what_follows_from_keys_and_from_those_left_out(values, name, value):
    assert attrgetter(name)(Constraints.from_mapping(values)) == value


@pytest.mark.parametrize(
    ("text", "overrides", "where"),
    [
        # of the file: its line and column, whatever options say of other keys
        *[("budget:\n  rays: 0", options, r"yaml:2:9\b") for options in ((), ["survive=1"], ["budget.bin_ps=1"])],
        *[("gate: {end_m: null}", (), r"yaml:1:15\b"), ("gate: {end: 1}", (), r"yaml:1:8\b")],
        # of an option: the error may be at its key, in its value, or where the file and it contradict each other
        ("budget: {rays: 0}", ["budget.rays=-1"], r"--set budget\.rays=-1"),
        ("", ["survive=1", "budget={rays: 0}"], r"--set budget=\{rays: 0\}"),
        ("sensors: {count: 2}", ["survive=1", "sensors.min=1"], r"--set sensors\.min=1"),
    ],
)
def test_an_error_is_placed_where_its_value_was_given(tmp_path, text, overrides, where):
    path = tmp_path / "rules.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=where):
        load_constraints(path, overrides)


@pytest.mark.parametrize(
    ("text", "notes"), [("", 1), ("gate: {}", 1), ("each: []", 1), ("survive: 0", 0), ("gate: {end_m: {max: 2}}", 0)]
)
def test_constraints_are_given_as_a_file_that_may_say_nothing_as_values_or_not_at_all(tmp_path, text, notes):
    path, found = tmp_path / "rules.yaml", []
    path.write_text(text)
    read = load_constraints(path, notes=found.append)
    assert load_constraints(read) is read
    for one in (read.as_document(), str(path)):
        assert load_constraints(one).as_document() == read.as_document()
    assert load_constraints(None) is None
    assert load_constraints(None, ["gate={}"], found.append).as_document() == {"gate": {}}
    assert found == [f"{path} holds no constraints"] * notes


def test_settings_of_a_task_are_told_from_constraints_by_their_first_key():
    task = SimpleNamespace(Config=SimpleNamespace(model_fields={"depth": None, "gate": None}))
    bounds, settings = ["gate.end_m.max=1", "budget.depth=1", "unknown=1"], ["depth.gate=1", "depth=2"]
    assert split_settings([*settings, *bounds], task) == (bounds, settings)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"gate": None}, "gate"),
        ({"gate": {"width_m": {"max": None}}}, "gate.width_m.max"),
        ({"sensors": {"count": None}}, "sensors.count"),
        ({"parts": None}, "parts"),
        ({"parts": {"each": None}}, "parts.each"),
        ({"parts": {"each": {"vl53l8cx": None}}}, "parts.each.vl53l8cx"),
        ({"each": [None]}, "each.0"),
        ({"each": [{"origin": {"fixed_m": [0, None, 0]}}]}, "each.0.origin.fixed_m.1"),
        ({"origin": {"exclude": None}}, "origin.exclude"),
        ({"budget": {"rays": None}}, "budget.rays"),
    ],
)
def test_a_key_without_a_value_drops_no_constraint(values, name):
    with pytest.raises(ConfigError, match=f"{name} has no value"):
        Constraints.from_mapping(values)


@pytest.mark.parametrize("roll", [{"min": 45.5}, {"max": -45.5}, {"min": 90, "max": 90}])
def test_only_parts_are_rolled_beyond_an_eighth_of_a_turn(roll):
    check_feasible(Constraints.from_mapping({"boresight": {"roll_deg": {"min": 45, "max": 45}}}), FACE)
    rules = {"boresight": {"roll_deg": roll}}
    with pytest.raises(InfeasibleError, match="exchanged"):
        check_feasible(Constraints.from_mapping(rules), FACE)
    check_feasible(Constraints.from_mapping({**rules, "parts": {"count": 1}}), FACE, sensors=1)


NEAR = DesignSpace((0.4, 0.0, 0.0, 2.6, -0.5, 0.05), (0.4, 0.0, 0.0, 3.7, 0.5, 1.05))


@pytest.mark.parametrize(
    ("override", "question"),
    [
        ("gate.end_m.max=500", "gate.end_m.max=500 .* design space: in millimetres"),
        ("gate.width_m.max=100", "millimetres"),
        ("origin.low_m=[-1000, -1, -1]", "origin.low_m.0=-1000 .*millimetres"),
        ("each=[{gate: {end_m: {max: 500}}}]", "each.0.gate.end_m.max=500"),
        ("field_of_view.vertical_deg.max=0.35", "field_of_view.vertical_deg.max=0.35 .*radians"),
        ("boresight.azimuth_deg.max=1.57", "azimuth_deg.max=1.57 .*radians"),
        ("boresight.roll_deg.min=-0.1", "radians"),
        ("boresight.elevation_deg.min=-2.5", None),
        ("boresight.azimuth_deg.max=90.3", None),
        ("gate.end_m.max=5", None),
        ("field_of_view={}", None),
        ("field_of_view.vertical_deg={min: 0, max: 35}", None),
        ("origin.exclude=[{low_m: [-1000, -1000, 1], high_m: [1000, 1000, 1000]}]", None),
        ("budget.bandwidth_mbps=1000", None),
        ("parts.names=catalog", None),
    ],
)
def test_bounds_that_are_probably_in_another_unit_are_questioned(override, question):
    notes = unit_notes(load_constraints(None, [override]), NEAR)
    assert len(notes) == (question is not None)
    assert all(re.search(question, note) for note in notes)
