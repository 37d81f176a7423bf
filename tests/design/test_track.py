"""Tracks: rays that vary smoothly along a condition and keep their constraints at every position."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lidardesign.layouts.rays import lay_out
from lidardesign.layouts.track import interpolated, placed, track_of, travels
from support.aisles import AISLE, SAMPLES, shelves
from support.tables import each_row

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.mixture.em import lloyd
from lidardesign.mixture.fit import fit, rays_at
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design_file import SCHEMA_FILE, design_document, design_from_document, load_design, save_design
from lidardesign.sensors.sensor import DesignSpec, Sensor, Track
from lidardesign.space import DesignSpace, angles

SCHEMA = json.loads(SCHEMA_FILE.read_text())


RULES = {
    "gate": {"start_m": {"min": 1.0}, "end_m": {"max": 1.9}, "width_m": {"min": 0.05, "max": 0.2}},
    "boresight": {"elevation_deg": {"min": 12, "max": 45}},
    "budget": {"bandwidth_mbps": 0.03},
}


def constrained(**values):
    return Constraints.from_mapping(values)


@pytest.fixture(scope="module")
def free():
    return fit(SAMPLES, layout="scan", rays=8)


@pytest.fixture(scope="module")
def tight():
    return fit(SAMPLES, layout="scan", rays=8, constraints=constrained(**RULES))


positions = st.floats(-0.5, 4.0)


# --- the fit


def test_a_scan_of_a_density_with_a_condition_is_a_track(free):
    track = free.design.track
    assert track.dimension == "x_m"
    assert travels(track) == (-0.5, 4.0)
    assert track.gate_m.shape == (len(track.knots), 8, 2)
    assert free.design.rays == len(free.design.sensors) == 8
    assert free.satisfied
    assert 0.9 < free.ess <= 1
    assert np.isfinite(free.log_likelihood)


def test_knots_lie_a_tenth_of_a_metre_apart_or_as_far_as_the_samples_ask(free):
    # 12,000 samples of equal weight, 40 for each ray of a knot
    assert len(free.design.track.knots) == 12_000 // (8 * 40) + 1
    many = fit(shelves(40_000), layout="scan", rays=4).design.track
    np.testing.assert_allclose(np.diff(many.knots), 0.1)


def test_rays_look_at_the_shelves_wherever_the_robot_is(free):
    for x in np.linspace(-0.5, 4.0, 40):
        rays = lay_out(free.design, at={"x_m": x})
        _, elevation = angles(rays.direction)
        height = (1.2 - 0.05 * x) * np.tan(elevation)
        low = (height > 0.17) & (height < 0.43)
        high = (height > 0.87 + 0.1 * x) & (height < 1.13 + 0.1 * x)
        assert (low | high).all()
        # both levels are as high and as full
        assert low.sum() == high.sum() == 4


def test_gates_hold_the_level_of_what_rays_see_there():
    design = fit(SAMPLES, layout="scan", rays=8).design
    later = shelves(seed=5).points
    inside = []
    for x in np.linspace(-0.4, 3.9, 12):
        rays = lay_out(design, at={"x_m": x})
        near = later[np.abs(later[:, 0] - x) < 0.1]
        ray = np.abs(near[:, 4, None] - angles(rays.direction)[1]).argmin(axis=1)
        start, end = rays.gate_m[ray].T
        inside.append(((near[:, 5] >= start) & (near[:, 5] <= end)).mean())
    assert 0.92 < np.mean(inside) < 0.98


def test_weights_count(free):
    lower = SAMPLES.points[:, 4] < 0.5
    samples = replace(SAMPLES, log_target=np.where(lower, 0.0, -np.inf))
    elevation = fit(samples, layout="scan", rays=6).design.track.elevation_rad
    assert elevation.max() < 0.42


def test_a_track_is_the_same_wherever_the_aisle_points(free):
    """Turn the world by 90 degrees about z: x becomes y, the azimuth -90 degrees becomes 0."""
    turned = DesignSpace(
        (0.0, -0.5, 0.0, 0.0, 0.0, 0.1), (0.0, 4.0, 0.0, 0.0, math.pi / 2, 5.0), condition=("y_m",), measure="angles"
    )
    points = SAMPLES.points.copy()
    points[:, 1], points[:, 0], points[:, 3] = SAMPLES.points[:, 0], 0.0, 0.0
    result = fit(Samples(points, SAMPLES.log_prob, SAMPLES.log_target, turned), layout="scan", rays=8)
    other = result.design.track
    assert other.dimension == "y_m"
    # seeds are drawn in another order of the samples, so cells agree to how well they are known
    assert result.log_likelihood == pytest.approx(free.log_likelihood, abs=0.02)
    np.testing.assert_allclose(other.elevation_rad, free.design.track.elevation_rad, atol=0.02)
    np.testing.assert_array_equal(other.azimuth_rad, 0.0)


DOME = DesignSpace((0.0, 0, 0, 0.0, -0.5, 0.5), (3.0, 0, 0, 2 * math.pi, math.pi / 2, 1.6), condition=("x_m",))


def dome(count=9000):
    """A patch of a room around the sensor that circles it through azimuth 0 while the robot drives."""
    generator = np.random.default_rng(4)
    points = np.zeros((count, 6))
    points[:, 0] = generator.uniform(0, 3, count)
    points[:, 3] = np.mod(0.6 * (points[:, 0] - 1.5) + generator.uniform(-0.5, 0.5, count), 2 * math.pi)
    points[:, 4] = generator.uniform(0.2, 0.9, count)
    points[:, 5] = 1 + 0.05 * generator.standard_normal(count)
    return Samples(points, np.zeros(count), np.zeros(count), DOME)


def test_rays_with_two_angles_cover_what_is_seen_there():
    design = fit(dome(), layout="scan", rays=12).design
    assert np.abs(np.diff(design.track.azimuth_rad, axis=0)).max() < 0.25
    for x in (0.0, 0.7, 1.5, 3.0):
        azimuth, elevation, gate = interpolated(design.track, x)
        away = np.angle(np.exp(1j * (azimuth - 0.6 * (x - 1.5))))
        assert np.abs(away).max() < 0.5
        assert np.ptp(away) > 0.5
        assert np.ptp(elevation) > 0.35
        assert (np.abs(gate.mean(axis=1) - 1) < 0.1).all()


@given(at=st.floats(0.0, 3.0))
def test_azimuths_keep_an_interval_through_north_at_every_position(northern, at):
    azimuth = np.angle(np.exp(1j * interpolated(northern.track, at)[0]))
    assert np.degrees(np.abs(azimuth)).max() <= 20


@pytest.fixture(scope="module")
def northern():
    result = fit(
        dome(), layout="scan", rays=6, constraints=constrained(boresight={"azimuth_deg": {"min": 340, "max": 20}})
    )
    assert result.satisfied
    assert np.ptp(result.design.track.azimuth_rad) > 0.5
    return result.design


def test_places_where_a_ray_sees_nothing_are_bridged():
    generator = np.random.default_rng(2)
    empty = (SAMPLES.points[:, 0] > 1.5) & (SAMPLES.points[:, 0] < 2.4)
    track = fit(SAMPLES.subset(~empty), layout="scan", rays=4).design.track
    assert np.isfinite(track.gate_m).all()
    whole = fit(SAMPLES, layout="scan", rays=4).design.track
    for x in generator.uniform(1.5, 2.4, 5):
        here, there = interpolated(track, x), interpolated(whole, x)
        np.testing.assert_allclose(here[1], there[1], atol=0.03)
        np.testing.assert_allclose(here[2], there[2], atol=0.08)


def test_lloyd_continues_from_where_it_is_told_to_and_keeps_the_order_of_centres():
    generator = np.random.default_rng(0)
    features = np.concatenate([[c] + 0.05 * generator.standard_normal((200, 1)) for c in (0.0, 1.0, 2.0)])
    weights = np.ones(len(features))
    start = np.array([[2.1], [-0.1], [0.9]])
    centres, labels = lloyd(features, weights, 3, generator, start=start)
    np.testing.assert_allclose(centres[:, 0], [2.0, 0.0, 1.0], atol=0.02)
    again, _ = lloyd(features, weights, 3, generator, start=centres)
    np.testing.assert_allclose(again, centres, atol=1e-9)
    np.testing.assert_array_equal(labels[:200], 1)
    for wrong in (start[:2], np.full((3, 1), np.nan), start[:, :0]):
        with pytest.raises(ConfigError, match="start"):
            lloyd(features, weights, 3, generator, start=wrong)


# --- at a position


def test_interpolation_hits_the_knots_exactly(free):
    track = free.design.track
    for index, knot in enumerate(track.knots):
        azimuth, elevation, gate = interpolated(track, float(knot))
        np.testing.assert_array_equal(azimuth, track.azimuth_rad[index])
        np.testing.assert_array_equal(elevation, track.elevation_rad[index])
        np.testing.assert_array_equal(gate, track.gate_m[index])


@given(at=positions)
def test_every_constraint_holds_at_every_position(tight, at):
    assert tight.satisfied
    rays = lay_out(tight.design, at={"x_m": at})
    start, end = rays.gate_m.T
    _, elevation = angles(rays.direction)
    assert start.min() >= 1.0
    assert end.max() <= 1.9
    assert (end - start).max() <= 0.2
    assert (end - start).min() >= 0.05
    assert math.degrees(elevation.min()) >= 12
    assert math.degrees(elevation.max()) <= 45
    assert Bandwidth().mbps(rays) <= 0.03
    np.testing.assert_array_equal(rays.origin_m, np.tile([at, 0.0, 0.0], (8, 1)))


def test_the_bandwidth_budget_is_used(tight):
    check = next(check for check in tight.constraints if check.name == "budget.bandwidth_mbps")
    found = max(Bandwidth().mbps(lay_out(tight.design, at={"x_m": x})) for x in np.linspace(-0.5, 4.0, 4000))
    # the dearest stretch may lie between the places that are tried: 0.0004 Mbit/s is one bin of one ray
    assert check.value - 0.001 <= found <= check.value + 1e-12
    assert 0.02 < check.value <= 0.03


@given(at=positions)
def test_a_placed_track_is_a_scan_whose_sensors_are_its_rays(free, at):
    here = placed(free.design, {"x_m": at})
    assert here.track is None
    assert here.at == {"x_m": at}
    rays = lay_out(free.design, at={"x_m": at})
    for sensor, origin, gate, aim in zip(here.sensors, rays.origin_m, rays.gate_m, rays.direction, strict=True):
        np.testing.assert_allclose(sensor.gate_m, gate, atol=1e-12)
        np.testing.assert_allclose(sensor.boresight, aim, atol=1e-12)
        np.testing.assert_array_equal(sensor.origin_m, origin)
        assert not sensor.origin_covariance_m2.any()
    np.testing.assert_array_equal(lay_out(here).gate_m, rays.gate_m)


def test_sensors_are_the_rays_in_the_middle_and_report_their_travel(free):
    middle = placed(free.design, {"x_m": 1.75})
    for sensor, there in zip(free.design.sensors, middle.sensors, strict=True):
        assert sensor.elevation_rad == there.elevation_rad
        np.testing.assert_allclose(sensor.gate_m, there.gate_m, atol=1e-12)
        length, along = sensor.travel_m
        assert length == pytest.approx(4.5)
        np.testing.assert_array_equal(along, [1.0, 0.0, 0.0])


def test_another_number_of_rays_is_another_track_and_needs_the_samples(free):
    rays = rays_at(free.design, 5, SAMPLES, at={"x_m": 1.0})
    assert len(rays) == 5
    np.testing.assert_array_equal(
        rays.gate_m, lay_out(fit(SAMPLES, layout="scan", rays=5).design, at={"x_m": 1.0}).gate_m
    )


def test_a_refitted_track_keeps_the_constraints(tight):
    rays = rays_at(tight.design, 5, SAMPLES, at={"x_m": 1.0})
    assert np.diff(rays.gate_m, axis=1).max() <= 0.2
    assert Bandwidth().mbps(rays) <= 0.03


@each_row("at", [{}, None, {"x_m": -0.6}, {"x_m": 4.1}, {"x_m": math.nan}, {"y_m": 0.0}])
def test_a_track_needs_a_place_between_its_ends(free, at):
    with pytest.raises(ConfigError, match=r"--at(.|\n)*(-0.5 to 4|x_m)"):
        lay_out(free.design, at=at)


# --- what is bolted onto a robot


def bolted(**changes):
    sensor = Sensor("s", 1.0, np.array([0.37, 0.0, 0.1]), np.diag([0.01, 0.0, 0.0]), 0.3, 0.1, 0.0, 0.1, 0.1, 1.0, 0.1)
    return DesignSpec("bolted", (sensor,), rays=9, **changes)


@given(at=st.floats(-10, 10))
def test_a_design_without_a_track_moves_with_the_robot_and_keeps_its_rays(at):
    for design in (bolted(at={"x_m": 0.37}), bolted()):
        still, away = lay_out(replace(design, at={})), lay_out(design, at={"x_m": at})
        np.testing.assert_array_equal(away.origin_m, np.tile([at, 0.0, 0.1], (9, 1)))
        np.testing.assert_array_equal(away.direction, still.direction)
        np.testing.assert_array_equal(away.gate_m, still.gate_m)


def test_only_origins_move():
    with pytest.raises(ConfigError, match="cannot be moved"):
        lay_out(bolted(), at={"azimuth_rad": 1.0})
    turned = bolted(at={"azimuth_rad": 0.3})
    np.testing.assert_array_equal(lay_out(turned, at={"azimuth_rad": 0.3}).direction, lay_out(bolted()).direction)
    with pytest.raises(ConfigError, match=r"azimuth_rad=0\.3"):
        lay_out(turned, at={"azimuth_rad": 1.0})
    with pytest.raises(ConfigError, match="not a dimension"):
        lay_out(bolted(), at={"speed": 1.0})
    with pytest.raises(ConfigError, match="finite"):
        lay_out(bolted(), at={"x_m": math.inf})


def test_what_is_fitted_at_a_place_is_laid_out_anew_from_samples_of_that_place():
    here = DesignSpace.at(AISLE, {"x_m": 0.37})
    near = SAMPLES.points[np.abs(SAMPLES.points[:, 0] - 0.37) < 0.3].copy()
    near[:, 0] = 0.37
    local = Samples(near, np.zeros(len(near)), np.zeros(len(near)), here)
    design = fit(local, layout="density", sensors=2, rays=6).design
    assert design.at == {"x_m": 0.37}
    asked = []

    def retarget(points):
        asked.append(set(points[:, 0]))
        return np.zeros(len(points))

    first, again = (lay_out(design, 9, SAMPLES, at={"x_m": x}, retarget=retarget) for x in (1.0, 2.0))
    assert asked == [{0.37}]
    np.testing.assert_array_equal(first.direction, again.direction)
    np.testing.assert_array_equal(again.origin_m[:, 0], 2.0)
    with pytest.raises(ConfigError, match="target density"):
        lay_out(design, 9, shelves(500), at={"x_m": 1.0})


# --- refusals


@pytest.mark.parametrize("layout", ["grid", "density", "distributed"])
def test_other_layouts_need_a_value(layout):
    with pytest.raises(ConfigError, match=r"--layout scan, or --at x_m=VALUE"):
        fit(SAMPLES, layout=layout, rays=8, sensors=2)


@each_row(
    ("space", "words"),
    [
        (replace(AISLE, high=(4.0, 1.0, *AISLE.high[2:]), condition=("x_m", "y_m")), "--at x_m=VALUE --at y_m=VALUE"),
        (replace(AISLE, condition=("range_m",)), "coordinate of the origin"),
        (replace(AISLE, high=(4.0, 1.0, *AISLE.high[2:])), r"y_m is free(.|\n)*--at x_m=VALUE"),
    ],
)
def test_a_track_follows_one_coordinate_of_an_origin_that_is_fixed_beside_it(space, words):
    with pytest.raises(ConfigError, match=words):
        fit(replace(SAMPLES, space=space), layout="scan", rays=8)


@pytest.mark.parametrize(
    ("rules", "conflicts"),
    [
        ({"origin": {"fixed_m": [1.0, 0.0, 0.0]}}, ["origin", "--layout scan"]),
        ({"origin": {"spread_m": {"max": 0.1}}}, ["origin.spread_m.max", "space.x_m"]),
        ({"budget": {"bandwidth_mbps": 0.001}}, None),
        ({"gate": {"end_m": {"max": 0.5}}}, None),
    ],
)
def test_constraints_that_no_track_keeps_are_infeasible(rules, conflicts):
    with pytest.raises(InfeasibleError) as caught:
        fit(SAMPLES, layout="scan", rays=8, constraints=constrained(**rules))
    if conflicts:
        assert list(caught.value.conflicts) == conflicts


@pytest.mark.parametrize("index", [4, 5])
def test_a_fixed_elevation_or_range_stays_fixed(index):
    points, low, high = SAMPLES.points.copy(), list(AISLE.low), list(AISLE.high)
    points[:, index] = low[index] = high[index] = 1.0
    space = replace(AISLE, low=tuple(low), high=tuple(high))
    track = fit(Samples(points, SAMPLES.log_prob, SAMPLES.log_target, space), layout="scan", rays=3).design.track
    np.testing.assert_array_equal(track.elevation_rad if index == 4 else track.gate_m, 1.0)


def test_more_rays_than_the_samples_are_worth_are_refused():
    with pytest.raises(InfeasibleError, match=r"count as only [0-9]+, too few for 3000 sensors"):
        fit(SAMPLES, layout="scan", rays=3000)


def test_an_origin_box_shortens_the_travel():
    rules = constrained(origin={"low_m": [1.0, -1, -1], "high_m": [2.0, 1, 1]})
    result = fit(SAMPLES, layout="scan", rays=4, constraints=rules)
    assert travels(result.design.track) == (1.0, 2.0)
    assert result.satisfied
    assert result.admissible_mass == pytest.approx(1 / 4.5, abs=0.02)


def test_a_track_needs_its_number_of_rays():
    with pytest.raises(ConfigError, match="--rays N"):
        fit(SAMPLES, layout="scan")


# --- files


def written(design, tmp_path):
    path = tmp_path / f"{design.name}.yaml"
    save_design(design, path)
    return path


def test_a_track_is_read_back_to_the_last_bit_and_follows_the_schema(tight, tmp_path):
    document = parse_yaml(dump_yaml(design_document(tight.design)), where="design").value
    jsonschema.validate(document, SCHEMA)
    loaded = load_design(written(tight.design, tmp_path))
    assert loaded.track.dimension == "x_m"
    for name in Track.__dataclass_fields__:
        one, other = getattr(loaded.track, name), getattr(tight.design.track, name)
        assert np.array_equal(one, other)
    assert design_document(loaded) == design_document(tight.design)
    rays, other = (lay_out(design, at={"x_m": 0.37}) for design in (loaded, tight.design))
    np.testing.assert_array_equal(rays.gate_m, other.gate_m)
    np.testing.assert_array_equal(rays.direction, other.direction)


def broken(design, change):
    document = parse_yaml(dump_yaml(design_document(design)), where="design").value
    change(document)
    return document


BROKEN = [
    (lambda d: d["track"]["knots_m"].reverse(), r"knots_m are no knots(.|\n)*each above"),
    (lambda d: d["track"]["knots_m"].clear(), "knots_m are no knots"),
    (lambda d: d["track"]["gate_end_m"].pop(), r"gate_end_m has(.|\n)*one per knot"),
    (lambda d: d["track"]["azimuth_rad"][2].pop(), r"azimuth_rad\[2\] has 7 numbers"),
    (lambda d: d["track"]["elevation_rad"][1].__setitem__(3, 2.0), r"elevation_rad\[1\]\[3\](.|\n)*from -1.57"),
    (
        lambda d: d["track"]["gate_end_m"][4].__setitem__(0, 0.2),
        r"gate_end_m\[4\]\[0\] is 0.2, not beyond the gate's start",
    ),
    (lambda d: d["track"].__setitem__("dimension", "range_m"), r"dimension(.|\n)*x_m or y_m or z_m"),
    (lambda d: d["track"].__setitem__("speed", 1), "speed is an unknown key"),
    (lambda d: d["track"]["sensor"].__setitem__(0, 99), r"sensor\[0\](.|\n)*from 0 to 7"),
    (lambda d: d.__setitem__("rays", 3), "contradicts"),
    (lambda d: d.__setitem__("at", {"speed": 1.0}), "speed is an unknown key"),
    (lambda d: d.__setitem__("at", {"x_m": "here"}), "at.x_m is 'here'"),
    (lambda d: d.__setitem__("at", 3), "at is 3"),
]


@each_row(("change", "words"), BROKEN, ids=[words for _, words in BROKEN])
def test_a_broken_track_is_refused_with_its_place(tight, change, words):
    with pytest.raises(ConfigError, match=words):
        design_from_document(broken(tight.design, change))


def test_a_track_beside_a_ray_table_is_refused(tight):
    table = design_document(placed(tight.design, {"x_m": 1.0}))["ray_table"]
    with pytest.raises(ConfigError, match="beside ray_table"):
        design_from_document(broken(tight.design, lambda d: d.__setitem__("ray_table", table)))


def test_more_knots_than_a_file_holds_are_refused_before_anything_is_written(free, tmp_path):
    rows = np.zeros((50_001, 2))
    track = Track("x_m", np.arange(50_001.0), rows, rows, np.zeros((50_001, 2, 2)), np.zeros(2, dtype=int))
    with pytest.raises(ConfigError, match="100002 rays at knots"):
        save_design(replace(free.design, track=track), tmp_path / "d.yaml")
    assert not list(Path(tmp_path).iterdir())


# --- the independent check


def unsatisfied(document):
    return {check.name for check in check_design(document, document["constraints"], AISLE) if not check.satisfied}


VIOLATIONS = [
    (lambda t: t["gate_start_m"][3].__setitem__(1, 0.99), "ray1.knot3.gate.start_m.min"),
    (lambda t: t["gate_end_m"][3].__setitem__(1, 1.95), "ray1.knot3.gate.end_m.max"),
    (lambda t: t["gate_end_m"][-1].__setitem__(0, 6.0), "ray0.knot{last}.space.range_m"),
    (lambda t: t["elevation_rad"][0].__setitem__(2, 0.01), "ray2.knot0.boresight.elevation_deg.min"),
    (lambda t: t["elevation_rad"][0].__setitem__(2, -0.01), "ray2.knot0.space.elevation_rad"),
    (lambda t: t["azimuth_rad"][0].__setitem__(2, 0.5), "ray2.knot0.space.azimuth_rad"),
    (lambda t: t["knots_m"].__setitem__(-1, 5.0), "track.space.x_m"),
]


@each_row(("change", "name"), VIOLATIONS, ids=[name for _, name in VIOLATIONS])
def test_the_check_names_the_ray_and_the_knot_that_break_a_bound(tight, change, name):
    last = len(tight.design.track.knots) - 1
    assert name.format(last=last) in unsatisfied(broken(tight.design, lambda d: change(d["track"])))


@given(widths=st.lists(st.lists(st.floats(0.001, 0.3), min_size=3, max_size=3), min_size=2, max_size=4))
def test_the_checked_bandwidth_is_that_of_the_dearest_position(widths):
    gate = np.stack([np.zeros_like(widths), np.array(widths)], axis=-1)
    rows = np.zeros(gate.shape[:2])
    track = Track("x_m", np.linspace(0.0, 1.0, len(widths)), rows, rows, gate, np.zeros(3, dtype=int))
    document = design_document(replace(bolted(), rays=3, track=track, sensors=(replace(bolted().sensors[0], rays=3),)))
    checks = check_design(document, {"budget": {"bandwidth_mbps": 1.0}})
    found = next(check.value for check in checks if check.name == "budget.bandwidth_mbps")
    dense = [interpolated(track, x)[2] for x in np.linspace(0.0, 1.0, 600)]
    assert found >= max(Bandwidth().mbps_of_widths(gates[:, 1] - gates[:, 0]) for gates in dense) - 1e-9
    # never more than rays that were each the dearest of two neighbouring knots
    worst = np.maximum(gate[:-1, :, 1], gate[1:, :, 1])
    assert found <= max(Bandwidth().mbps_of_widths(row) for row in worst) + 1e-9


def test_the_error_of_a_tracks_likelihood_is_its_spread_over_other_samples(monkeypatch):
    monkeypatch.setattr("lidardesign.layouts.scan.KNOT_SPACING_M", 2.25)
    repeats = 24
    tracks = [fit(shelves(1500, seed), layout="scan", rays=2) for seed in range(repeats)]
    assert {len(one.design.track.knots) for one in tracks} == {3}
    stated = np.mean([one.error_estimates["log_likelihood"].error for one in tracks])
    spread = np.std([one.log_likelihood for one in tracks])
    assert stated == pytest.approx(spread, rel=4 / math.sqrt(2 * repeats))


# --- tracks of rays that are given at knots

KNOTS, SENSOR = [-0.2, 0.5, 1.1, 2.0], np.array([0, 0, 0, 1, 1])


def given_at(x, turn=0.0):
    """Two sensors whose rays are well apart, and turn and listen further the farther the robot is."""
    azimuth = np.array([-1.0, 0.0, 1.0, -0.5, 0.5]) + 0.1 * x + turn
    elevation = np.array([0.1, 0.2, 0.3, 0.4, 0.5]) - 0.05 * x
    start = np.array([1.0, 1.1, 1.2, 1.3, 1.4]) + 0.1 * x
    return Rays.from_angles(np.zeros((5, 3)), azimuth, elevation, np.stack([start, start + 0.3], axis=1), SENSOR)


def permuted(rays, seed):
    """The same rays with those of each sensor in another order."""
    generator = np.random.default_rng(seed)
    return rays.subset(np.concatenate([generator.permutation(np.flatnonzero(index == SENSOR)) for index in (0, 1)]))


def assert_track(track, tables, ends=(-0.5, 4.0)):
    for x, rays in tables:
        azimuth, elevation, gate = interpolated(track, x)
        np.testing.assert_allclose(azimuth, rays.azimuth_rad, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(elevation, rays.elevation_rad)
        np.testing.assert_array_equal(gate, rays.gate_m)
    np.testing.assert_array_equal(track.sensor, SENSOR)
    assert travels(track) == ends


def test_a_track_of_given_rays_passes_through_them_exactly():
    tables = [(x, given_at(x)) for x in KNOTS]
    assert_track(track_of(0, KNOTS, [rays for _, rays in tables], (-0.5, 4.0)), tables)


@given(st.integers(0, 1000), st.permutations(KNOTS))
def test_rays_stay_themselves_in_whatever_order_knots_and_rays_come(seed, knots):
    """The first knot says which ray is which; at the others tables are mixed up."""
    mixed = {x: permuted(given_at(x), seed + number) for number, x in enumerate(knots)}
    mixed[min(KNOTS)] = given_at(min(KNOTS))
    assert_track(track_of(0, knots, [mixed[x] for x in knots], (-0.5, 4.0)), [(x, given_at(x)) for x in KNOTS])


@each_row("ends, constant", [((-0.5, 4.0), True), ((KNOTS[0], KNOTS[-1]), False)])
def test_beyond_the_ends_of_its_knots_rays_stay_as_they_are_there(ends, constant):
    track = track_of(0, KNOTS, [given_at(x) for x in KNOTS], ends)
    assert len(track.knots) == len(KNOTS) + 2 * constant
    for beyond, knot in ((ends[0], KNOTS[0]), (ends[1], KNOTS[-1])):
        for found, kept in zip(interpolated(track, beyond), interpolated(track, knot), strict=True):
            np.testing.assert_array_equal(found, kept)


def test_given_rays_pass_through_south_without_a_jump():
    tables = [given_at(x, turn=math.pi - 0.05) for x in KNOTS]
    wrapped = [Rays.from_angles(t.origin_m, *angles(t.direction), t.gate_m, t.sensor) for t in tables]
    track = track_of(0, KNOTS, wrapped, (-0.5, 4.0))
    assert np.abs(np.diff(track.azimuth_rad, axis=0)).max() < 0.2


def test_a_ray_keeps_to_its_sensor_though_another_sensors_ray_is_nearer():
    """The two sensors' rays change places; each stays one of its own sensor."""
    sensor = np.array([0, 1])

    def pair(first, second):
        gate = np.tile([1.0, 1.2], (2, 1))
        return Rays.from_angles(np.zeros((2, 3)), np.array([first, second]), np.zeros(2), gate, sensor)

    track = track_of(0, [0.0, 1.0], [pair(-0.3, 0.3), pair(0.3, -0.3)], (0.0, 1.0))
    np.testing.assert_allclose(track.azimuth_rad, [[-0.3, 0.3], [0.3, -0.3]], rtol=0, atol=1e-12)
