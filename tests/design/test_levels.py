"""The level of intervals: a higher one widens fields and gates in every layout, and is what a design's file says."""

from __future__ import annotations

import json

import numpy as np
import pytest
from lidardesign.layouts.gates import seen_from
from lidardesign.layouts.rays import lay_out
from support.aisles import SAMPLES as AISLE_SAMPLES
from support.command_line import make_run
from support.designs import drawn_from, three_sensors
from support.rings import RING

from lidardesign.constraints.document import Constraints
from lidardesign.errors import InfeasibleError
from lidardesign.formats.designs import load_design
from lidardesign.mixture.fit import fit, rays_at
from lidardesign.sensors.sensor import DesignSpec, interval_factor
from lidardesign.space import observed_point

LEVELS = (0.8, 0.95, 0.99)
STILL = drawn_from(DesignSpec("d", three_sensors()), 12_000)
# samples, and how they are fitted
CASES = {
    "grid": (STILL, {"layout": "grid", "sensors": 3, "rays": 60}),
    "grid with gates per ray": (STILL, {"layout": "grid", "sensors": 3, "rays": 60, "gates": "ray"}),
    "density": (STILL, {"layout": "density", "sensors": 3, "rays": 60}),
    "density with gates per ray": (STILL, {"layout": "density", "sensors": 3, "rays": 60, "gates": "ray"}),
    "scan": (STILL, {"layout": "scan", "rays": 40}),
    "distributed": (RING, {"layout": "distributed", "sensors": 2, "rays": 60}),
    "distributed with gates per sensor": (RING, {"layout": "distributed", "sensors": 2, "rays": 60, "gates": "sensor"}),
    "track": (AISLE_SAMPLES, {"layout": "scan", "rays": 6}),
}


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """Samples, and designs of them by level."""
    samples, choices = CASES[request.param]
    rests = {} if choices["layout"] == "scan" else {"restarts": 2, "em_samples": 4000}
    return samples, {level: fit(samples, level=level, **choices, **rests).design for level in LEVELS}


def widths(samples, design):
    """Mean gate of the design's rays, at a place of it."""
    at = {"x_m": 1.0} if design.track is not None else None
    rays = lay_out(design, None, samples if at is None else None, at=at)
    return np.diff(rays.gate_m, axis=1).mean()


def test_a_higher_level_widens_gates_and_fields(case):
    samples, designs = case
    gates = [widths(samples, designs[level]) for level in LEVELS]
    assert gates[0] * 1.1 < gates[1]
    assert gates[1] * 1.02 < gates[2]
    fields = [np.mean([s.field_of_view_rad for s in designs[level].sensors]) for level in LEVELS]
    assert fields[0] * 1.1 < fields[1]
    assert fields[1] * 1.02 < fields[2]


def test_a_design_keeps_its_level_and_fields_and_gates_of_sensors_are_that_of_their_normal_spreads(case):
    _, designs = case
    for level, design in designs.items():
        factor = interval_factor(level)
        assert design.level == level
        for sensor in design.sensors:
            assert sensor.level == level
            spreads = np.array([sensor.spread_horizontal_rad, sensor.spread_vertical_rad])
            np.testing.assert_allclose(np.array(sensor.field_of_view_rad) / 2, factor * spreads, atol=1e-12)
            start, end = sensor.gate_m
            assert end - sensor.range_m == pytest.approx(factor * sensor.spread_range_m)
            assert start == pytest.approx(max(sensor.range_m - factor * sensor.spread_range_m, 0.0), abs=1e-12)


def test_the_level_is_the_share_of_what_each_ray_of_a_scan_sees_that_its_own_gate_holds():
    for level in LEVELS:
        design = fit(STILL, layout="scan", rays=40, level=level).design
        gates = lay_out(design).gate_m
        assert len(np.unique(gates, axis=0)) == 40
        # two of the three sensors that the samples are of range over a third of what the last one does
        assert level != 0.95 or np.quantile(np.ptp(gates, axis=1), 0.5) < 0.5 * np.ptp(gates, axis=1).max()
        observed = observed_point(STILL.points)
        seen = [seen_from(sensor, observed) for sensor in design.sensors]
        angle = np.stack([np.hypot(*tangent.T) for tangent, _ in seen])
        owner = angle.argmin(axis=0)
        range_m = np.stack([ranges for _, ranges in seen])[owner, np.arange(len(owner))]
        gate = np.array([sensor.gate_m for sensor in design.sensors])[owner]
        held = (range_m >= gate[:, 0]) & (range_m < gate[:, 1])
        assert np.average(held, weights=STILL.weights) == pytest.approx(level, abs=0.02)


def test_another_number_of_rays_of_a_scan_keeps_its_level():
    design, anew = (fit(STILL, layout="scan", rays=rays, level=0.8).design for rays in (20, 30))
    np.testing.assert_array_equal(rays_at(design, 30, STILL).gate_m, lay_out(anew).gate_m)


def test_a_level_and_a_bound_on_gates_hold_together_or_are_refused_by_the_bound():
    bounded = Constraints.from_mapping({"gate": {"width_m": {"max": 0.05}}})
    for level in LEVELS:
        design = fit(STILL, sensors=3, rays=30, level=level, constraints=bounded, em_samples=2000, restarts=1).design
        assert all(np.ptp(sensor.gate_m) <= 0.05 + 1e-9 for sensor in design.sensors)
        assert design.level == level
    beyond = Constraints.from_mapping({"gate": {"width_m": {"min": 0.5, "max": 0.4}}})
    with pytest.raises(InfeasibleError):
        fit(STILL, sensors=3, level=0.99, constraints=beyond)


def gates_in(path):
    design = load_design(path)
    gates = [sensor.gate_m for sensor in design.sensors] if design.ray_table is None else design.ray_table.gate_m
    return design.level, np.diff(np.asarray(gates), axis=1).mean()


@pytest.mark.parametrize(("layout", "gates"), [("grid", "sensor"), ("density", "ray"), ("scan", "ray")])
def test_fit_and_constrain_take_the_level_and_gates_with_every_layout(lidardesign, tmp_path, layout, gates):
    run = make_run(tmp_path / "run", count=4000)
    found = {}
    options = ("--layout", layout, "--rays", 12, "--gates", gates, *(() if layout == "scan" else ("--sensors", 1)))
    for command in ("fit", "constrain"):
        for level in (0.7, 0.97):
            result = lidardesign(command, run, *options, "--level", level, "--json")
            assert result.code == 0, result.err
            found[command, level] = gates_in(json.loads(result.out)["design"])
            assert found[command, level][0] == level
        assert found[command, 0.7][1] < found[command, 0.97][1]
    assert found["fit", 0.7] == found["constrain", 0.7]
    # a design that is constrained keeps its level
    kept = lidardesign("constrain", run / "designs" / "fit.yaml", "--json")
    assert kept.code == 0, kept.err
    assert gates_in(json.loads(kept.out)["design"])[0] == 0.97


@pytest.mark.parametrize("level", ["0", "1", "nan", "0.9999999"])
def test_a_level_that_holds_nothing_or_everything_is_refused(lidardesign, tmp_path, level):
    run = make_run(tmp_path / "run", count=1000)
    for command in ("fit", "constrain"):
        result = lidardesign(command, run, "--level", level)
        assert result.code == 2
        assert "--level" in result.err
