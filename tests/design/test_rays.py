"""Rays of a design: exact budgets, even grids, density layouts, gates, and their equivariance."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lidardesign.layouts.gates import log_density, members, seen_from
from lidardesign.layouts.rays import LAYOUTS, gates_of, lay_out, own_count
from support.designs import SPACE, drawn_from, sensor, three_sensors
from support.tables import each_row

from lidardesign.errors import ConfigError
from lidardesign.mixture.fit import rays_at, refitted
from lidardesign.samples import Samples
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.pattern import grid_rows, grid_tangent
from lidardesign.sensors.sensor import MOST_RAYS, DesignSpec, Track, interval_factor, tangent_coordinates
from lidardesign.space import DesignSpace, angles, direction

TURN = 0.7
AHEAD = {"azimuth_rad": 0.0, "elevation_rad": 0.0, "roll_rad": 0.0}


def turned(design, samples, angle):
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    moved = tuple(replace(s, origin_m=turn @ s.origin_m, azimuth_rad=s.azimuth_rad + angle) for s in design.sensors)
    points = samples.points.copy()
    points[:, :3] = points[:, :3] @ turn.T
    points[:, 3] += angle
    return replace(design, sensors=moved), replace_points(samples, points), turn


def evenly(points):
    return Samples(points, np.zeros(len(points)), np.zeros(len(points)), SPACE)


def replace_points(samples, points):
    return Samples(points, samples.log_prob, samples.log_target, samples.space)


def coordinates(design, rays):
    """Tangent coordinates of every ray in its own sensor, shape (N, 2)."""
    found = np.zeros((len(rays), 2))
    for index, component in enumerate(design.sensors):
        mine = rays.sensor == index
        found[mine] = tangent_coordinates(component.frame, rays.direction[mine])
    return found


# --- budgets


@pytest.mark.hard_case("35")
@settings(max_examples=200, deadline=None)
@given(
    weights=st.lists(st.floats(0, 1e6), min_size=1, max_size=20).filter(lambda w: max(w) > 1e-3),
    count=st.integers(0, 5000),
)
def test_a_budget_sums_exactly_and_no_share_is_a_whole_ray_off(weights, count):
    shares = split_budget(np.array(weights), count)
    assert shares.sum() == count
    assert (shares >= 0).all()
    quotas = np.array(weights) / math.fsum(weights) * count
    assert np.abs(shares - quotas).max() < 1 + 1e-6
    assert (shares[np.array(weights) == 0] == 0).all()


@pytest.mark.hard_case("35")
@settings(max_examples=50, deadline=None)
@given(weights=st.lists(st.integers(1, 1000), min_size=1, max_size=10, unique=True), count=st.integers(0, 400))
def test_a_budget_does_not_depend_on_the_scale_of_the_weights(weights, count):
    weights = np.array(weights, float)
    assert (split_budget(weights, count) == split_budget(weights / weights.sum(), count)).all()


@pytest.mark.hard_case("35")
@each_row(
    ("weights", "count", "shares"),
    [
        # equal sensors: the first ones are ahead
        *[(np.full(7, 1 / 7), 100, [15, 15, 14, 14, 14, 14, 14]), (np.ones(7), 100, [15, 15, 14, 14, 14, 14, 14])],
        # fewer rays than sensors, or none at all
        *[([1, 1, 1, 1.0], 2, [1, 1, 0, 0]), ([0.1, 0.2, 0.7], 1, [0, 0, 1]), ([0.1, 0.2, 0.7], 0, [0, 0, 0])],
        # weights of any size, and none
        *[(np.array([3.0, 1.0]) * scale, 100, [75, 25]) for scale in (1e-300, 1e-160, 1e160, 1e300)],
        *[([0.0, 1.0, 0.0], 3, [0, 3, 0]), ([1.0, 3.0], MOST_RAYS, [MOST_RAYS // 4, 3 * MOST_RAYS // 4])],
        # shares that differ in the tenth decimal tie, in the ninth they do not
        *[([0.5 - 1e-10, 0.5 + 1e-10], 1, [1, 0]), ([0.5 - 2e-9, 0.5 + 2e-9], 1, [0, 1])],
    ],
)
def test_a_budget_is_split_by_largest_remainders(weights, count, shares):
    assert split_budget(np.array(weights), count).tolist() == shares


@pytest.mark.hard_case("35")
@each_row(
    ("weights", "count"),
    [
        *[([], 3), ([0.0, 0.0], 3), ([-1.0, 2.0], 3), ([np.nan], 3), ([1.0, np.inf], 3), ([1.0], -1), ([1.0], 2.5)],
        *[([[0.5, 0.5]], 3), (1.0, 3), ([1.0, 1.0], MOST_RAYS + 1)],
    ],
)
def test_a_budget_that_cannot_be_split_is_refused(weights, count):
    with pytest.raises(ConfigError, match="budget"):
        split_budget(np.array(weights), count)


# --- grids


@settings(max_examples=200, deadline=None)
@given(count=st.integers(0, 700), horizontal=st.floats(0, 6.2), vertical=st.floats(0, 3.1))
def test_a_grid_has_exactly_its_rays_spread_over_rows_that_differ_by_one_at_most(count, horizontal, vertical):
    rows = grid_rows(horizontal, vertical, count)
    assert rows.sum() == count
    if count:
        assert rows.min() >= 1
        assert rows.max() - rows.min() <= 1
    tangent = grid_tangent(horizontal, vertical, count)
    assert tangent.shape == (count, 2)
    assert (np.abs(tangent[:, 0]) <= horizontal / 2).all()
    assert (np.abs(tangent[:, 1]) <= vertical / 2).all()
    if count and min(horizontal, vertical) > 1e-3:
        assert len(np.unique(tangent, axis=0)) == count
        np.testing.assert_allclose(tangent.mean(axis=0)[0], 0, atol=1e-9)


@given(across=st.integers(1, 25), up=st.integers(1, 25))
def test_a_budget_in_the_proportion_of_the_field_is_the_regular_grid_with_no_ray_on_the_edge(across, up):
    assert grid_rows(0.03 * across, 0.03 * up, across * up).tolist() == [across] * up
    centres = np.meshgrid((np.arange(across) + 0.5) - across / 2, (np.arange(up) + 0.5) - up / 2)
    expected = 0.03 * np.stack([axis.ravel() for axis in centres], axis=1)
    np.testing.assert_allclose(grid_tangent(0.03 * across, 0.03 * up, across * up), expected, atol=1e-15)


@each_row("elevation", [-math.pi / 2, -1.2, 0.0, 1.0, math.pi / 2])
@each_row("layout", ["grid", "density"])
@each_row("spread", [0.05, 0.4, 1.7])
def test_all_rays_are_inside_the_field_of_view_also_straight_down(elevation, layout, spread):
    looking = sensor(elevation_rad=elevation, spread_horizontal_rad=spread)
    design = DesignSpec("d", (looking,), layout=layout)
    rays = lay_out(design, 137, drawn_from(design))
    tangent = coordinates(design, rays)
    horizontal, vertical = looking.field_of_view_rad
    assert (np.abs(tangent[:, 0]) <= horizontal / 2 + 1e-9).all()
    assert (np.abs(tangent[:, 1]) <= vertical / 2 + 1e-9).all()
    assert len(np.unique(np.round(rays.direction, 9), axis=0)) == 137


def test_a_field_beyond_the_sphere_is_shrunk_so_that_no_ray_goes_round():
    design = DesignSpec("d", (sensor(spread_horizontal_rad=4.0, spread_vertical_rad=2.0),))
    rays = lay_out(design, 50)
    assert len(np.unique(np.round(rays.direction, 9), axis=0)) == 50
    assert len(lay_out(design, 1)) == 1


# --- lists


@pytest.mark.parametrize("layout", ["grid", "density"])
@pytest.mark.parametrize("gates", ["sensor", "ray"])
def test_turning_a_design_about_the_vertical_turns_its_rays(layout, gates):
    design = DesignSpec("d", three_sensors(), layout=layout)
    samples = drawn_from(design)
    rays = lay_out(design, 100, samples, gates=gates)
    moved_design, moved_samples, turn = turned(design, samples, TURN)
    moved = lay_out(moved_design, 100, moved_samples, gates=gates)
    np.testing.assert_allclose(moved.direction, rays.direction @ turn.T, atol=1e-6)
    np.testing.assert_allclose(moved.origin_m, rays.origin_m @ turn.T, atol=1e-12)
    np.testing.assert_allclose(moved.gate_m, rays.gate_m, atol=1e-6)


@pytest.mark.parametrize("layout", ["grid", "density"])
def test_permuting_the_sensors_permutes_their_rays(layout):
    design = DesignSpec("d", three_sensors(), layout=layout)
    samples = drawn_from(design)
    order = [2, 0, 1]
    shuffled = replace(design, sensors=tuple(design.sensors[i] for i in order))
    rays, other = lay_out(design, 101, samples), lay_out(shuffled, 101, samples)
    for new, old in enumerate(order):
        assert (rays.direction[rays.sensor == old] == other.direction[other.sensor == new]).all()


@pytest.mark.hard_case("35")
@each_row("layout", ["grid", "density", "distributed"])
@each_row("count", [0, 1, 2, 3, 50])
def test_rays_are_ordered_by_sensor_and_fire_evenly_over_the_frame(layout, count):
    design = DesignSpec("d", three_sensors(), layout=layout)
    rays = lay_out(design, count, drawn_from(design), rate_hz=20)
    assert len(rays) == count
    assert (np.diff(rays.sensor) >= 0).all()
    np.testing.assert_allclose(rays.time_s, np.arange(count) / (max(count, 1) * 20))
    assert np.bincount(rays.sensor, minlength=3).tolist() == split_budget(design.weights, count).tolist()


@each_row("counts", [[1, 2, 30], [0, 2, 30]])
def test_rays_of_each_sensor_can_be_fixed_by_the_design(counts):
    design = DesignSpec("d", tuple(replace(s, rays=n) for s, n in zip(three_sensors(), counts, strict=True)))
    assert own_count(design) == sum(counts)
    assert np.bincount(lay_out(design).sensor, minlength=3).tolist() == counts
    assert np.bincount(lay_out(design, 10).sensor).tolist() == [5, 3, 2]


def table_of(design, count, samples=None, gates=None):
    """The rays of a design as its file holds them."""
    return lay_out(replace(design, ray_table=None), count, samples, gates=gates).as_angles()


def test_a_design_was_made_for_the_number_that_it_names_then_for_that_of_its_table_then_of_its_sensors():
    own = tuple(replace(s, rays=n) for s, n in zip(three_sensors(), (1, 2, 30), strict=True))
    table = table_of(DesignSpec("d", own), 40)
    assert own_count(DesignSpec("d", own, rays=7, ray_table=table)) == 7
    assert own_count(DesignSpec("d", own, ray_table=table)) == 40
    assert own_count(DesignSpec("d", own, layout="scan")) == 33
    assert own_count(DesignSpec("d", three_sensors(), layout="scan")) == 3


def test_a_design_without_a_number_of_rays_asks_for_one():
    with pytest.raises(ConfigError, match="--rays"):
        lay_out(DesignSpec("d", three_sensors()))


# --- density


def test_a_density_layout_needs_samples_unless_its_table_has_that_many_rays():
    design = DesignSpec("d", three_sensors(), layout="density", rays=40)
    samples = drawn_from(design)
    kept = replace(design, ray_table=table_of(design, 40, samples, "ray"))
    direct, tabled = lay_out(design, 40, samples, gates="ray"), lay_out(kept)
    np.testing.assert_allclose(direct.direction, tabled.direction, atol=1e-15)
    assert (direct.gate_m == tabled.gate_m).all()
    with pytest.raises(ConfigError, match="samples"):
        lay_out(kept, 41)
    assert len(lay_out(kept, 41, samples)) == 41
    assert len(lay_out(design, 0)) == 0


def test_as_many_samples_as_rays_are_the_rays_row_by_row_upwards():
    design = DesignSpec("d", (sensor(),), layout="density")
    samples = drawn_from(design, 40)
    inside = members(design, samples.points, samples.weights)[0].tangent
    exact = coordinates(design, lay_out(design, len(inside), samples))
    np.testing.assert_allclose(exact, inside[np.lexsort((inside[:, 0], inside[:, 1]))], atol=1e-9)
    one_more = coordinates(design, lay_out(design, len(inside) + 1, samples))
    even = coordinates(design, lay_out(replace(design, layout="grid"), len(inside) + 1))
    np.testing.assert_array_equal(one_more, even)


def test_repeated_samples_are_one_place_for_a_ray():
    design = DesignSpec("d", (sensor(),), layout="density")
    samples = drawn_from(design, 40)
    twice = samples.subset(np.r_[np.arange(40), np.arange(40)])
    distinct = len(members(design, samples.points, samples.weights)[0])
    even = lay_out(replace(design, layout="grid"), distinct + 1)
    np.testing.assert_array_equal(lay_out(design, distinct + 1, twice).direction, even.direction)
    assert len(np.unique(coordinates(design, lay_out(design, distinct, twice)).round(9), axis=0)) == distinct


def test_rays_of_one_row_go_from_one_side_to_the_other():
    fan = sensor(azimuth_rad=0.0, elevation_rad=0.0, roll_rad=0.0, spread_vertical_rad=0.0)
    generator = np.random.default_rng(8)
    angle, distance = generator.normal(0, 0.1, 2000), generator.normal(1, 0.1, 2000)
    points = np.column_stack([np.tile(fan.origin_m, (2000, 1)), angle, np.zeros(2000), distance])
    design = DesignSpec("d", (fan,), layout="density")
    tangent = coordinates(design, lay_out(design, 20, evenly(points)))
    assert (tangent[:, 1] == 0).all()
    assert (np.diff(tangent[:, 0]) > 0).all()


def test_rays_of_a_density_layout_follow_the_seed_and_their_order_does_not():
    design = DesignSpec("d", (sensor(),), layout="density")
    samples = drawn_from(design)
    one, other = (coordinates(design, lay_out(design, 30, samples, seed=seed)) for seed in (0, 1))
    assert not np.array_equal(one, other)
    np.testing.assert_array_equal(one, coordinates(design, lay_out(design, 30, samples)))
    for rays in (one, other):
        assert (np.diff(rays[:, 1]) >= -1e-12).all()


def test_what_is_missing_is_said_with_the_number_of_rays_that_the_design_has():
    design = DesignSpec("d", three_sensors(), layout="density", rays=40)
    kept = replace(design, ray_table=table_of(design, 40, drawn_from(design)))
    words = r"41 rays in the layout `density`(.|\n)*40 rays(.|\n)*fit RUN --layout density --rays 41"
    with pytest.raises(ConfigError, match=words):
        lay_out(kept, 41)
    with pytest.raises(ConfigError, match="gates per ray need samples") as caught:
        lay_out(DesignSpec("d", three_sensors()), 41, gates="ray")
    assert caught.value.allowed is None


def test_every_ray_of_a_scan_is_a_component():
    design = DesignSpec("d", three_sensors(), layout="scan")
    rays = lay_out(design)
    assert len(rays) == 3
    np.testing.assert_allclose(rays.direction, [s.boresight for s in design.sensors], atol=1e-15)
    with pytest.raises(ConfigError, match="--layout scan --rays 4"):
        lay_out(design, 4)
    assert len(lay_out(design, 0)) == 0
    for wrong in (1, 100):
        with pytest.raises(ConfigError, match="one ray of each"):
            lay_out(replace(design, rays=wrong))


def test_a_scan_of_another_number_of_rays_is_fitted_anew_and_keeps_its_constraints():
    narrow = {"gate": {"width_m": {"max": 0.15}}, "budget": {"rays": 3}}
    design = DesignSpec("d", three_sensors(), layout="scan", constraints=narrow)
    samples = drawn_from(design)
    rays = rays_at(design, 40, samples)
    assert len(rays) == 40
    assert (np.ptp(rays.gate_m, axis=1) <= 0.15 + 1e-12).all()
    assert (rays.sensor == np.arange(40)).all()
    assert (rays_at(design, 40, samples).direction == rays.direction).all()
    with pytest.raises(ConfigError, match="--layout scan --rays 40"):
        lay_out(design, 40, samples)


def test_a_refit_is_remembered_by_number_and_seed():
    design, samples = DesignSpec("d", three_sensors(), layout="scan"), drawn_from(DesignSpec("d", three_sensors()), 600)
    first = refitted(design, 5, samples)
    assert refitted(design, 5, samples, seed=0) is first
    assert refitted(design, 5, samples, seed=1) is not first
    assert refitted(design, 6, samples) is not first
    assert (first.name, len(first.sensors), first.level) == ("d", 5, design.level)
    with pytest.raises(ConfigError, match="5 rays in the layout `scan`"):
        refitted(design, 5, None)


def test_a_scan_from_a_pinned_origin_is_not_fitted_anew_without_its_target():
    pinned = {"origin": {"fixed_m": [0.1, -0.2, 0.3]}, "budget": {"rays": 3}}
    design = DesignSpec("d", three_sensors(), layout="scan", constraints=pinned)
    with pytest.raises(ConfigError, match=r"pinned origin(.|\n)*4 rays(.|\n)*3 rays(.|\n)*--layout scan --rays 4"):
        rays_at(design, 4, drawn_from(design, 600))


# --- conditions

RAILS = DesignSpace(SPACE.low, SPACE.high, condition=("x_m",))


def along_rails(design, count=4000):
    """Samples of a design whose origins are anywhere along x."""
    samples = drawn_from(design, count)
    points = samples.points.copy()
    points[:, 0] = np.random.default_rng(9).uniform(-5, 5, len(points))
    return Samples(points, samples.log_prob, samples.log_target, RAILS)


def no_target(points):
    return np.zeros(len(points))


def test_even_rays_ask_no_target_density_where_the_samples_have_conditions():
    design = DesignSpec("d", three_sensors(), layout="grid", rays=30)
    samples = along_rails(design)
    np.testing.assert_array_equal(lay_out(design, 40, samples).direction, lay_out(design, 40).direction)
    with pytest.raises(ConfigError, match="x_m"):
        lay_out(design, 40, samples, gates="ray", at={"x_m": 1.0})
    away = lay_out(design, 40, samples, gates="ray", at={"x_m": 1.0}, retarget=no_target)
    assert (away.origin_m[:, 0] == 1.0).all()
    assert len(np.unique(away.gate_m, axis=0)) > 3


def test_a_density_layout_asks_the_target_density_at_its_place_unless_its_table_answers():
    design = DesignSpec("d", three_sensors(), layout="density", rays=30)
    samples = along_rails(design)
    with pytest.raises(ConfigError, match="x_m"):
        lay_out(design, 30, samples, at={"x_m": 1.0})
    assert len(lay_out(design, 0, samples, at={"x_m": 1.0})) == 0
    rays = lay_out(design, 30, samples, at={"x_m": 1.0}, retarget=no_target)
    table = table_of(design, 30, drawn_from(design))
    kept = lay_out(replace(design, ray_table=table), 30, samples, at={"x_m": 1.0})
    assert len(rays) == len(kept) == 30
    np.testing.assert_array_equal(kept.origin_m[:, 0], 1.0)
    np.testing.assert_allclose(angles(kept.direction)[0], table.azimuth_rad)
    # a table of another number of rays does not answer
    with pytest.raises(ConfigError, match="x_m"):
        lay_out(replace(design, ray_table=table), 40, along_rails(design), at={"x_m": 1.0})
    assert len(lay_out(replace(design, ray_table=table), 40, samples, at={"x_m": 1.0}, retarget=no_target)) == 40


def test_distributed_rays_are_laid_out_by_their_sensors_where_no_target_density_is_known():
    spread = np.eye(3) * 0.01
    design = DesignSpec("d", three_sensors(origin_covariance_m2=spread), layout="distributed", rays=30)
    samples = along_rails(design)
    alone, asked = lay_out(design, 30, at={"x_m": 1.0}), lay_out(design, 30, samples, at={"x_m": 1.0})
    np.testing.assert_array_equal(alone.direction, asked.direction)
    with_target = lay_out(design, 30, samples, at={"x_m": 1.0}, retarget=no_target)
    assert not np.array_equal(with_target.direction, alone.direction)


def test_a_scan_asks_the_target_density_for_other_rays_and_for_gates_of_their_own_alone():
    design = DesignSpec("d", three_sensors(), layout="scan")
    samples = along_rails(design)
    assert len(lay_out(design, 3, samples, at={"x_m": 1.0})) == 3
    for changes in ({"count": 5}, {"count": 3, "gates": "ray"}):
        with pytest.raises(ConfigError, match="x_m"):
            lay_out(design, samples=samples, at={"x_m": 1.0}, **changes)
    assert len(rays_at(design, 5, samples, at={"x_m": 1.0}, retarget=no_target)) == 5


def tracked():
    """Three rays of one sensor on a track of two knots."""
    elevation = np.array([[0.0, 0.1, 0.2], [0.2, 0.1, 0.0]])
    gate = np.tile([0.5, 1.5], (2, 3, 1))
    track = Track("x_m", np.array([0.0, 1.0]), np.full((2, 3), 1.0), elevation, gate, np.zeros(3, dtype=np.int64))
    return DesignSpec("t", (sensor(),), layout="scan", rays=3, track=track)


def test_a_design_of_several_tracks_gives_the_rays_of_the_one_with_so_many():
    design = tracked()
    fewer = replace(
        design.track, elevation_rad=design.track.elevation_rad[:, :2] + 0.3,
        azimuth_rad=design.track.azimuth_rad[:, :2], gate_m=design.track.gate_m[:, :2], sensor=np.zeros(2, dtype=int),
    )  # fmt: skip
    both = replace(design, further_tracks=(fewer,))
    for count, alone in ((3, design), (2, replace(design, rays=2, track=fewer))):
        found, wanted = (lay_out(one, count, at={"x_m": 0.25}) for one in (both, alone))
        np.testing.assert_array_equal(found.direction, wanted.direction)
        np.testing.assert_array_equal(found.gate_m, wanted.gate_m)


def test_a_track_gives_its_own_number_of_rays_at_a_place_and_others_by_samples_alone():
    design, at = tracked(), {"x_m": 0.25}
    rays = lay_out(design, at=at)
    np.testing.assert_allclose(angles(rays.direction)[1], [0.05, 0.1, 0.15])
    np.testing.assert_allclose(rays.origin_m, np.tile([0.25, -0.2, 0.3], (3, 1)))
    np.testing.assert_array_equal(lay_out(design, 3, at=at).direction, rays.direction)
    assert len(lay_out(design, 0, at=at)) == 0
    for count in (1, 2, 4):
        with pytest.raises(ConfigError, match=f"{count} rays in the layout `scan` need samples"):
            lay_out(design, count, at=at)


# --- fixed patterns


def fixed_pattern(count=60):
    """A design of a table alone, as real parts fire it."""
    design = DesignSpec("d", three_sensors())
    return replace(design, layout="fixed", rays=count, ray_table=table_of(design, count))


@pytest.mark.parametrize("count", [1, 7, 30, 59, 60])
def test_fewer_rays_of_a_fixed_pattern_are_some_of_its_own_in_each_sensors_proportion(count):
    design = fixed_pattern()
    rays, table = lay_out(design, count), design.ray_table
    own = np.bincount(table.sensor, minlength=3)
    np.testing.assert_array_equal(np.bincount(rays.sensor, minlength=3), split_budget(own, count))
    fired = {(int(s), *d) for s, d in zip(table.sensor, table.direction, strict=True)}
    kept = {(int(s), *d) for s, d in zip(rays.sensor, rays.direction, strict=True)}
    assert len(kept) == count
    assert kept <= fired
    np.testing.assert_allclose(rays.time_s, np.arange(count) / count / 10)


def test_half_of_a_fixed_pattern_is_spread_over_all_of_it():
    design = fixed_pattern()
    rays, table = lay_out(design, 30), design.ray_table
    for index in range(3):
        whole, half = table.direction[table.sensor == index], rays.direction[rays.sensor == index]
        steps = np.linalg.norm(whole[:, None] - whole, axis=2)
        neighbour = np.where(steps > 0, steps, np.inf).min(axis=1).max()
        assert np.linalg.norm(whole[:, None] - half, axis=2).min(axis=1).max() < 2 * neighbour


def test_a_fixed_pattern_has_no_further_rays():
    design = fixed_pattern()
    fixed = LAYOUTS["fixed"]
    assert fixed.most_count(design) == 60
    with pytest.raises(ConfigError, match="61 rays, but the design's fixed pattern has 60") as refused:
        fixed.lay_out(design, 61, None, "sensor", 0)
    assert refused.value.allowed == "at most 60"
    bare = replace(design, ray_table=None)
    assert fixed.most_count(bare) is None
    with pytest.raises(ConfigError, match="1 rays, but the design's fixed pattern has 0") as refused:
        fixed.lay_out(bare, 1, None, "sensor", 0)
    assert refused.value.allowed is None


@pytest.mark.parametrize("gates", ["sensor", "ray"])
def test_chosen_and_fixed_rays_ask_for_no_samples(gates):
    design = fixed_pattern()
    for name in ("selected", "spinning", "fixed"):
        assert not LAYOUTS[name].needs_samples(design, 30, gates)


# --- gates


def test_gates_per_ray_leave_an_even_grid_as_it_is():
    design = DesignSpec("d", three_sensors())
    samples = drawn_from(design)
    own = lay_out(design, 60, samples, gates="ray")
    np.testing.assert_array_equal(own.direction, lay_out(design, 60).direction)
    assert len(np.unique(own.gate_m, axis=0)) > 3


@pytest.mark.parametrize("layout", ["grid", "density"])
def test_rays_share_the_gate_of_their_sensor_unless_they_are_to_have_their_own(layout):
    design = DesignSpec("d", three_sensors(), layout=layout)
    rays = lay_out(design, 60, drawn_from(design))
    for index, component in enumerate(design.sensors):
        assert (rays.gate_m[rays.sensor == index] == component.gate_m).all()


@each_row(
    ("layout", "samples", "wide", "expected"),
    [
        ("grid", True, (), "sensor"),
        ("grid", True, (7,), "ray"),
        ("grid", False, (7,), "sensor"),
        ("distributed", False, (7,), "ray"),
        ("distributed", False, (), "sensor"),
    ],
)
def test_a_table_tells_by_two_rays_of_one_sensor_whose_gates_its_rays_keep(layout, samples, wide, expected):
    design = DesignSpec("d", three_sensors())
    table = table_of(design, 30)
    gate = table.gate_m.copy()
    gate[list(wide), 1] += 0.1
    design = replace(design, layout=layout, ray_table=replace(table, gate_m=gate))
    drawn = drawn_from(design, 60) if samples else None
    by_gates = lay_out(replace(design, ray_table=None), 40, drawn, gates=expected)
    np.testing.assert_array_equal(lay_out(design, 40, drawn).gate_m, by_gates.gate_m)


def test_no_table_and_one_ray_of_each_sensor_tell_nothing_of_gates_but_the_design_may():
    design = DesignSpec("d", three_sensors())
    single = replace(design, ray_table=table_of(replace(design, layout="scan"), 3))
    usual = {"distributed": "ray", "grid": "sensor", "density": "sensor"}
    assert {name: gates_of(replace(single, layout=name)) for name in usual} == usual
    assert {name: gates_of(replace(design, layout=name)) for name in usual} == usual
    assert gates_of(replace(single, gates="ray")) == gates_of(replace(design, gates="ray")) == "ray"
    assert set(LAYOUTS) == {"grid", "density", "scan", "distributed", "selected", "spinning", "fixed"}


def test_distributed_rays_have_gates_of_their_own_or_of_their_sensor():
    design = DesignSpec("d", three_sensors(origin_covariance_m2=np.eye(3) * 0.01), layout="distributed")
    samples = drawn_from(design, 3000)
    samples.points[:, 5] += 0.3 * (samples.points[:, 3] - 1.0)
    own, shared = lay_out(design, 30, samples), lay_out(design, 30, samples, gates="sensor")
    np.testing.assert_array_equal(own.gate_m, lay_out(design, 30, samples, gates="ray").gate_m)
    assert not np.array_equal(own.gate_m, shared.gate_m)
    for index, component in enumerate(design.sensors):
        assert (shared.gate_m[shared.sensor == index] == component.gate_m).all()


@each_row(
    ("distance", "own"),
    [(np.linspace(0.9, 1.1, 19), False), (np.linspace(0.9, 1.1, 20), True), (np.full(50, 1.0), False)],
    ids=["19 samples", "20 samples", "at one range"],
)
def test_a_ray_has_a_gate_of_its_own_from_twenty_samples_of_different_ranges_on(distance, own):
    design = DesignSpec("d", (sensor(),))
    points = np.column_stack([np.tile([0.1, -0.2, 0.3, 1.0, -0.3], (len(distance), 1)), distance])
    rays = lay_out(design, 1, evenly(points), gates="ray")
    assert (rays.gate_m[0] != design.sensors[0].gate_m).any() == own


@pytest.mark.parametrize("layout", ["grid", "density"])
def test_a_gate_per_ray_is_within_its_sensors_gate_and_holds_the_level_of_what_it_sees(layout):
    design = DesignSpec("d", (sensor(),), layout=layout, level=0.9)
    samples = drawn_from(design, 20000)
    rays = lay_out(design, 30, samples, gates="ray")
    start, end = design.sensors[0].gate_m
    assert (rays.gate_m[:, 0] >= start).all()
    assert (rays.gate_m[:, 1] <= end).all()
    assert (rays.gate_m[:, 1] > rays.gate_m[:, 0]).all()
    inside = members(design, samples.points, samples.weights)[0]
    tangent = coordinates(design, rays)
    cell = np.square(inside.tangent[:, None] - tangent[None]).sum(-1).argmin(axis=1)
    gate = rays.gate_m[cell]
    held = (inside.range_m >= gate[:, 0]) & (inside.range_m < gate[:, 1])
    assert np.average(held, weights=inside.weights) == pytest.approx(0.9, abs=0.01)


def test_a_slanted_surface_needs_a_fraction_of_the_gate_per_ray():
    generator = np.random.default_rng(1)
    flat = sensor(azimuth_rad=0.0, elevation_rad=0.0, roll_rad=0.0, spread_horizontal_rad=0.2)
    azimuth = generator.uniform(-0.3, 0.3, 8000)
    distance = 1.0 + 0.5 * azimuth + generator.normal(0, 0.005, 8000)
    elevation = generator.uniform(-0.1, 0.1, 8000)
    samples = evenly(np.column_stack([np.tile(flat.origin_m, (8000, 1)), azimuth, elevation, distance]))
    rays = lay_out(DesignSpec("d", (flat,)), 100, samples, gates="ray")
    seen = np.abs(coordinates(DesignSpec("d", (flat,)), rays)[:, 0]) < 0.25
    assert np.ptp(rays.gate_m[seen], axis=1).mean() < 0.25 * np.ptp(flat.gate_m)


def test_a_gate_that_would_begin_behind_the_sensor_begins_at_it():
    rays = lay_out(DesignSpec("d", (sensor(range_m=0.05, spread_range_m=0.2),)), 4)
    assert (rays.gate_m[:, 0] == 0).all()


# --- membership


def test_the_log_density_is_the_naive_product_of_normals_on_the_sphere():
    component = sensor()
    generator = np.random.default_rng(3)
    looking = direction(generator.normal(1, 0.3, 50), generator.normal(-0.3, 0.2, 50))
    distance = generator.normal(1, 0.1, 50)
    tangent, ranges = seen_from(component, component.origin_m + distance[:, None] * looking)
    np.testing.assert_allclose(ranges, distance)
    naive = []
    for ray, reach in zip(looking, distance, strict=True):
        forward, right, up = component.frame
        angle = math.acos(ray @ forward)
        scale = angle / math.sin(angle)
        u, v = scale * (ray @ right), scale * (ray @ up)
        squares = (u / 0.12) ** 2 + (v / 0.06) ** 2 + ((reach - 1.0) / 0.1) ** 2
        naive.append(-squares / 2 - math.log(0.12 * 0.06 * 0.1) + math.log(scale))
    np.testing.assert_allclose(log_density(component, tangent, ranges, smallest_m=1e-6), naive, rtol=1e-9)


def owners(design, points):
    found = np.full(len(points), -1)
    for index, inside in enumerate(members(design, points, np.ones(len(points)))):
        found[inside.index] = index
    return found.tolist()


def test_a_sample_belongs_to_the_sensor_that_sees_its_scene_point_best():
    left = sensor("l", 0.5, origin_m=np.array([-1.0, 0, 0]))
    right = sensor("r", 0.5, origin_m=np.array([1.0, 0, 0]))
    points = np.array([[-0.99, 0, 0, 1.0, -0.3, 1.0], [0.99, 0, 0, 1.0, -0.3, 1.0], [0, 0, 0, 4.0, -0.3, 1.0]])
    assert owners(DesignSpec("d", (left, right)), points) == [0, 1, -1]
    assert owners(DesignSpec("d", (left, replace(right, weight=0.0))), points) == [0, -1, -1]
    assert owners(DesignSpec("d", (left, replace(left, name="m"))), points) == [0, -1, -1]


def test_samples_of_a_distributed_origin_are_aimed_anew_from_the_mean_origin():
    component = sensor(origin_m=np.zeros(3), origin_covariance_m2=np.eye(3) * 0.01, **AHEAD)
    beside = np.array([[0.0, 0.2, 0.0, -math.atan2(0.2, 1.0), 0.0, math.hypot(0.2, 1.0)]])
    found = members(DesignSpec("d", (component,)), beside, np.ones(1))[0]
    np.testing.assert_allclose(found.tangent, [[0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.range_m, [1.0])


def test_the_share_of_a_sensors_own_samples_inside_is_the_level_to_the_third_power():
    component = sensor(elevation_rad=0.0, roll_rad=0.0, spread_horizontal_rad=0.05, spread_vertical_rad=0.05)
    generator = np.random.default_rng(5)
    count = 40000
    origin = np.tile(component.origin_m, (count, 1))
    drawn = generator.normal([1.0, 0.0, 1.0], [0.05, 0.05, 0.1], (count, 3))
    inside = members(DesignSpec("d", (component,)), np.column_stack([origin, drawn]), np.ones(count))[0]
    assert interval_factor(0.95) == pytest.approx(1.959964, abs=1e-6)
    assert len(inside) / count == pytest.approx(0.95**3, abs=0.006)


def test_a_fan_without_height_keeps_its_samples_and_lays_them_out_in_its_plane():
    fan = sensor(elevation_rad=0.3, roll_rad=0.0, spread_vertical_rad=0.0)
    generator = np.random.default_rng(6)
    drawn = np.column_stack([generator.normal(1.0, 0.1, 4000), np.full(4000, 0.3), generator.normal(1, 0.1, 4000)])
    points = np.column_stack([np.tile(fan.origin_m, (4000, 1)), drawn])
    design = DesignSpec("d", (fan, replace(fan, name="t", azimuth_rad=2.0)), layout="density")
    assert np.mean(np.array(owners(design, points)) == 0) > 0.85
    tangent = coordinates(design, lay_out(design, 20, evenly(points)))[:10]
    np.testing.assert_allclose(tangent[:, 1], 0, atol=1e-12)
    assert not np.allclose(np.diff(np.sort(tangent[:, 0])), np.ptp(tangent[:, 0]) / 9, atol=1e-3)
