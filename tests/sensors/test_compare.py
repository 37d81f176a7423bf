"""Two designs beside each other, sensor by sensor, and what a design costs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.command_line import make_run
from support.sensors import normal_sensor

from lidardesign import open_run
from lidardesign.formats.designs import load_design
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.compare import angles_between, difference, paired_sensors, readout_of
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import save_design
from lidardesign.sensors.pattern import Pattern
from lidardesign.space import direction


def sensors(seed, count, named="s"):
    generator = np.random.default_rng(seed)
    return tuple(
        normal_sensor(
            f"{named}{index}", 1 / count, generator.normal(size=3), *generator.uniform(-1, 1, 3),
            generator.uniform(0.01, 0.4, 2), *generator.uniform(0.5, 2, 2),
        )
        for index in range(count)
    )  # fmt: skip


def test_a_design_does_not_differ_from_itself_however_its_sensors_are_ordered_and_named():
    own = sensors(0, 6)
    generator = np.random.default_rng(1)
    for _ in range(5):
        order = generator.permutation(6)
        other = tuple(replace(own[index], name=f"other{place}") for place, index in enumerate(order))
        pairs = paired_sensors(DesignSpec("a", own), DesignSpec("b", other))
        assert [one.name for one, _ in pairs] == [sensor.name for sensor in own]
        for pair in pairs:
            assert all(value in (0, None) for value in difference(*pair)["difference"].values())


def test_sensors_of_the_same_names_are_compared_by_name():
    own = sensors(0, 3)
    swapped = tuple(replace(sensor, name=own[index].name) for index, sensor in enumerate(own[::-1]))
    pairs = paired_sensors(DesignSpec("a", own), DesignSpec("b", swapped[::-1]))
    assert [(one.name, other.name) for one, other in pairs] == [("s0", "s0"), ("s1", "s1"), ("s2", "s2")]


def test_differences_turn_their_sign_with_the_order_and_sensors_left_over_are_named():
    first, second = DesignSpec("a", sensors(2, 2)), DesignSpec("b", sensors(3, 4, "t"))
    there = [difference(*pair) for pair in paired_sensors(first, second)]
    back = {pair["b"]: pair for pair in (difference(*both) for both in paired_sensors(second, first))}
    assert sorted(pair["b"] for pair in there) == ["t0", "t1", "t2", "t3"]
    assert [pair["a"] for pair in there[2:]] == [None, None]
    for pair in there[:2]:
        other = back[pair["a"]]["difference"]
        for key, value in pair["difference"].items():
            if value is not None:
                sign = 1 if key in ("place_m", "boresight_deg") else -1
                assert other[key] == pytest.approx(sign * value)


def test_an_angle_is_exact_for_the_smallest_and_the_largest():
    for angle in (0.0, 1e-9, 1e-4, 1.0, math.pi - 1e-9, math.pi):
        found = angles_between(direction(0.0, 0.0), direction(angle, 0.0))
        assert found == pytest.approx(angle, rel=1e-7, abs=1e-15)


@pytest.mark.parametrize("seed", range(5))
def test_what_a_design_costs_is_what_its_rays_cost(seed):
    even = DesignSpec("d", sensors(seed, 4), constraints={"budget": {"rays": 101}})
    fixed = replace(even, layout="fixed", patterns=(Pattern.of(even.rays(50)),))
    for design in (even, fixed):
        assert readout_of(design).high_mbps == pytest.approx(Bandwidth().mbps(design.rays()))
        assert readout_of(design).rays == len(design.rays())
        slow = replace(design, constraints={"budget": {"rays": 101, "rate_hz": 2.0, "bin_ps": 250.0}})
        model = Bandwidth(bin_ps=250.0, rate_hz=2.0)
        assert readout_of(slow).high_mbps == pytest.approx(model.mbps(design.rays()))
    many, open_cost = 4_000, readout_of(replace(even, constraints={}))
    assert open_cost.rays is None
    assert many * open_cost.low_mbps == pytest.approx(Bandwidth().mbps(even.rays(many)), rel=1e-9)


def test_what_a_design_costs_along_a_condition_is_from_its_cheapest_to_its_dearest_knot():
    lists = [DesignSpec("d", sensors(0, 1)).rays(5), DesignSpec("d", sensors(1, 1)).rays(5)]
    pattern = Pattern.along("x_m", [0.0, 1.0], lists, (0.0, 1.0))
    found = readout_of(DesignSpec("d", sensors(0, 1), "chosen", (pattern,)))
    costs = sorted(Bandwidth().mbps(pattern.at(knot)) for knot in pattern.knots)
    assert (found.low_mbps, found.high_mbps) == tuple(costs)
    assert costs[0] < costs[1]


# ------------------------------------------------------------------- commands


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with a fitted design, one of more rays, and one under constraints."""
    opened = open_run(make_run(tmp_path_factory.mktemp("runs") / "flat", count=2000))
    options = {"sensors": 2, "layout": "even", "rays": 8}
    few = opened.fit(**options, name="few")
    few.save()
    more = replace(few.specification, name="more", constraints={"budget": {"rays": 12}})
    save_design(more, opened.folder / "designs" / "more.yaml")
    tight = {"gate": {"width_m": {"max": 0.2}}, "budget": {"bandwidth_mbps": 900}}
    opened.fit(constraints=tight, **options, name="tight").save()
    return opened.folder


def test_two_designs_differ_in_what_is_shown(call, run):
    few, more, tight = (run / "designs" / f"{name}.yaml" for name in ("few", "more", "tight"))
    found = call("show", few, tight, "--json").json
    assert [design["name"] for design in found["designs"]] == ["few", "tight"]
    assert found["constraints"] == {"budget.bandwidth_mbps": [None, 900], "gate.width_m.max": [None, 0.2]}
    pairs = paired_sensors(*(load_design(path) for path in (few, tight)))
    assert found["sensors"] == [difference(*pair) for pair in pairs]
    assert "gate.width_m.max" in call("show", few, tight).out
    assert [design["bandwidth"]["rays"] for design in call("show", few, more, "--json").json["designs"]] == [8, 12]
    fixed, turned = few.with_name("fixed.yaml"), few.with_name("turned.yaml")
    for one, step in ((fixed, 1), (turned, -1)):
        design = load_design(more)
        pattern = Pattern.of(design.rays().subset(slice(None, None, step)))
        save_design(replace(design, layout="fixed", patterns=(pattern,)), one)
    found = [call("show", fixed, other, "--json").json for other in (fixed, turned)]
    assert [(one["constraints"], one["rays_differ"]) for one in found] == [({}, False), ({}, True)]
    assert call("show", few, run).code == 3


def test_what_rounding_leaves_of_no_difference_is_shown_as_none(call, run, tmp_path):
    """A direction goes through its unit vector, and comes back to the last digit but one."""
    rows = "".join(f"{angle / 7},{angle / 9},2\n" for angle in range(3))
    (tmp_path / "rays.csv").write_text("azimuth_rad,elevation_rad,gate_end_m\n" + rows)
    assert call("export", "rays.csv", "--format", "mjcf", "--out", "rays.xml").code == 0
    result = call("show", "rays.csv", "rays.xml")
    assert result.code == 0, result.err
    assert "e-" not in result.out


def test_a_shown_design_says_how_tight_its_constraints_are(call, run):
    shown = call("show", run / "designs" / "tight.yaml", "--json").json
    checks = {check["name"]: check for check in shown["checks"]}
    budget = checks["budget.bandwidth_mbps"]
    assert budget["room"] == pytest.approx(900 - shown["bandwidth"]["high_mbps"])
    assert not budget["tight"]
    assert any(check["tight"] for name, check in checks.items() if name.endswith("gate.width_m.max"))
    assert all(check["satisfied"] for check in checks.values())
    # the run's design space is checked too, where it is there
    assert any(".space." in name for name in checks)
    assert "yes, tight" in call("show", run / "designs" / "tight.yaml").out
    # nothing was asked of this one but its number of rays
    plain = call("show", run / "designs" / "few.yaml", "--json").json["checks"]
    assert [check["name"] for check in plain if ".space." not in check["name"]] == ["budget.rays"]
