"""Gates of single rays from what the rays themselves meet in training scenes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.tables import each_row

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.constraints.check import check_design
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.files import design_document
from lidardesign.design.layouts.rays import lay_out
from lidardesign.design.sensor import DesignSpec, Sensor, interval_factor
from lidardesign.evaluate.refinement import Gating, has_ray_gates
from lidardesign.geometry.rays import Rays
from lidardesign.scene import Body, Scene, Sphere, rigid
from lidardesign.simulate.simulate import build_casters, simulate
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, -0.6, -0.4, 0.1), (0, 0, 0, 0.6, 0.4, 4.0))
MODEL = Bandwidth()
Z = interval_factor(0.95)


def ball(x, radius=0.4, role="both", name="ball"):
    return Body(Sphere(radius), name, role, rigid(translation_m=np.array([x, 0.0, 0.0])))


def traced(*scenes):
    return [(scene, build_casters(scene)) for scene in scenes]


SCENES = traced(*(Scene((ball(2.0 + 0.1 * shift),)) for shift in (-1, 0, 1)))
GATING = Gating(SCENES, SPACE, 0.01)
ANGLES = np.linspace(-0.35, 0.35, 15)


def beam(index, azimuth, gate, rays=1):
    middle, half = (gate[0] + gate[1]) / 2, (gate[1] - gate[0]) / 2
    return Sensor(
        f"s{index}", 1 / 15, np.zeros(3), np.zeros((3, 3)), azimuth, 0.0, 0.0, 0.0, 0.0, middle, half / Z, rays=rays
    )


def scan(gates, constraints=None):
    sensors = [beam(index, azimuth, gate) for index, (azimuth, gate) in enumerate(zip(ANGLES, gates, strict=True))]
    return DesignSpec("d", tuple(sensors), "scan", rays=15, constraints=constraints or {})


def table(gates, constraints=None):
    sensor = Sensor("s0", 1.0, np.zeros(3), np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.2, 0.1, 2.0, 1.0, rays=15)
    rays = Rays.from_angles(np.zeros((15, 3)), ANGLES, np.zeros(15), np.asarray(gates, float), np.zeros(15, dtype=int))
    return DesignSpec("d", (sensor,), "density", rays=15, ray_table=rays, constraints=constraints or {})


def gates_like(start, end):
    """Gates that differ a little, so that they are gates of single rays."""
    return np.column_stack([np.full(15, start), end + 0.01 * np.arange(15)])


def returns(design, scenes=SCENES):
    rays = lay_out(design)
    found = 0
    for scene, casters in scenes:
        is_target = np.array([body.is_target for body in scene.bodies])
        for frame in simulate(scene, rays, casters=casters):
            found += int(is_target[frame.body[frame.returned]].sum())
    return found


def bins(design):
    gates = lay_out(design).gate_m
    return int(MODEL.bins(gates[:, 1] - gates[:, 0]).sum())


@each_row("kind", [scan, table])
@each_row(("start", "end"), [(1.0, 3.0), (1.4, 1.6), (0.2, 0.4), (0.1, 3.5), (2.5, 2.6)])
def test_never_more_bandwidth_and_never_fewer_returns(kind, start, end):
    design = kind(gates_like(start, end))
    other = GATING(design, lay_out(design))
    assert bins(other) <= bins(design)
    assert returns(other) >= returns(design)


@pytest.mark.parametrize("kind", [scan, table])
def test_gates_that_miss_everything_find_it(kind):
    design = kind(gates_like(2.5, 2.8))
    assert returns(design) == 0
    other = GATING(design, lay_out(design))
    assert returns(other) > 0.9 * returns(kind(gates_like(0.1, 4.0)))


@pytest.mark.parametrize("kind", [scan, table])
def test_only_gates_change(kind):
    design = kind(gates_like(1.0, 3.0))
    other = GATING(design, lay_out(design))
    before, after = lay_out(design), lay_out(other)
    np.testing.assert_allclose(after.direction, before.direction, atol=1e-12)
    np.testing.assert_array_equal(after.origin_m, before.origin_m)
    kept = [(one.name, one.layout, one.rays, len(one.sensors)) for one in (design, other)]
    assert kept[0] == kept[1]
    assert not np.allclose(after.gate_m, before.gate_m)


@pytest.mark.parametrize("kind", [scan, table])
def test_a_ray_without_returns_keeps_its_gate(kind):
    far = Gating(traced(Scene((ball(2.0, 0.2),))), SPACE, 0.01)
    design = kind(gates_like(1.0, 3.0))
    other = far(design, lay_out(design))
    silent = np.abs(np.sin(ANGLES)) * 2.0 > 0.2
    assert silent.any()
    before, after = lay_out(design).gate_m, lay_out(other).gate_m
    np.testing.assert_allclose(after[silent], before[silent], rtol=1e-12)
    assert not np.isclose(after[~silent], before[~silent]).all(axis=1).any()


def test_where_nothing_returns_the_design_stays_as_it_is():
    nothing = Gating(traced(Scene((ball(-2.0),))), SPACE, 0.01)
    design = scan(gates_like(1.0, 3.0))
    assert nothing(design, lay_out(design)) is design


def test_occluders_do_not_count():
    """A pane in front is no reason to listen there."""
    before = ball(0.8, 0.2, role="occluder", name="pane")
    scenes = traced(Scene((before, ball(2.0))))
    design = table(gates_like(1.2, 2.6))
    rays = lay_out(design)
    other = Gating(scenes, SPACE, 0.01)(design, rays)
    hidden = np.abs(np.sin(ANGLES)) * 0.8 < 0.2
    np.testing.assert_array_equal(lay_out(other).gate_m[hidden], rays.gate_m[hidden])
    assert (lay_out(other).gate_m[:, 0] > 1.0).all()


def test_gates_hold_returns_spread_by_as_much_as_is_asked_for():
    design = table(gates_like(0.2, 3.8))
    rays = lay_out(design)
    narrow, wide = (lay_out(GATING(design, rays, spread)).gate_m for spread in (0.0, 0.1))
    middle = 7
    # the middle ray meets the ball 0.4 m before its centre, which is at 1.9, 2.0, 2.1 m
    quantile = 1.2815515655446004
    np.testing.assert_allclose(narrow[middle], [1.5 - 0.01 * quantile, 1.7 + 0.01 * quantile], atol=1e-6)
    np.testing.assert_allclose(wide[middle], [1.5 - 0.1 * quantile, 1.7 + 0.1 * quantile], atol=1e-6)


RULES = {
    "widths": {"gate": {"width_m": {"max": 0.2}}},
    "ends": {"gate": {"end_m": {"max": 1.6}}},
    "starts": {"gate": {"start_m": {"min": 1.6}}},
    "bandwidth": {"budget": {"bandwidth_mbps": 0.06}},
    "no room": {"budget": {"bandwidth_mbps": 0.0001}},
    "bins": {"gate": {"width_m": {"min": 0.05}}, "budget": {"bandwidth_mbps": 0.2, "bin_ps": 50.0, "rate_hz": 20}},
}


@each_row("kind", [scan, table])
@each_row("name", RULES)
def test_constraints_are_kept(kind, name):
    rules = RULES[name]
    low, high = (1.7, 1.75) if name == "starts" else (1.45, 1.55)
    constraints = Constraints.from_mapping(rules, where="test")
    # the document's form has all keys, as a design keeps it
    gates = np.column_stack([np.full(15, low), np.full(15, high)])
    gates[:, 1] += 0.001 * np.arange(15)
    design = kind(gates, constraints.as_document())
    other = GATING(design, lay_out(design))
    failed = (
        [check.name for check in check_design(design_document(one), constraints) if not check.satisfied]
        for one in (other, design)
    )
    # a table's own sensor stands for none of these gates
    broken, before = ({name for name in names if kind is scan or not name.startswith("s0.")} for names in failed)
    assert broken <= before
    if name != "no room":
        assert not broken


def test_a_budget_may_be_used_up():
    rules = Constraints.from_mapping({"budget": {"bandwidth_mbps": 0.5}}, where="test").as_document()
    design = table(gates_like(1.5, 1.51), rules)
    other = GATING(design, lay_out(design))
    assert MODEL.mbps(lay_out(other)) <= 0.5
    assert returns(other) > returns(design)


def test_which_designs_have_gates_of_single_rays():
    per_ray = table(gates_like(1.0, 2.0))
    assert has_ray_gates(per_ray)
    assert has_ray_gates(scan(gates_like(1.0, 2.0)))
    even = np.tile([1.0, 2.0], (15, 1))
    assert not has_ray_gates(table(even))
    assert not has_ray_gates(DesignSpec("d", per_ray.sensors, "grid"))
    two = replace(per_ray.ray_table, sensor=(np.arange(15) > 6).astype(int), gate_m=np.where(
        (np.arange(15) > 6)[:, None], [1.0, 2.0], [2.0, 3.0]))  # fmt: skip
    # two sensors with a gate each
    assert not has_ray_gates(replace(per_ray, sensors=(per_ray.sensors[0],) * 2, ray_table=two))


def test_beams_listen_about_the_middle_of_their_gates():
    design = scan(gates_like(1.0, 3.0))
    other = GATING(design, lay_out(design))
    for sensor, (start, end) in zip(other.sensors, lay_out(other).gate_m, strict=True):
        assert sensor.range_m == pytest.approx((start + end) / 2)
        assert math.isclose(sensor.gate_m[1], end)
