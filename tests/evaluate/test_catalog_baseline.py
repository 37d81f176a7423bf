"""Real parts as rivals: their own patterns and ranges, where they see most, at any number of rays."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.command_line import caller, make_run
from support.rivals import Rivals
from support.tables import each_row

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.catalog.library import Pose, find_part, part_rays
from lidardesign.design.catalog.shapes import PartShape, gate_inside, in_part_view, shapes_of, useful_ray_filter
from lidardesign.design.sensor import boresight_frame
from lidardesign.errors import ConfigError
from lidardesign.evaluate.baselines.catalog import (
    CLUTTER,
    Density,
    PosedPart,
    ScenePoints,
    part_notes,
    places,
    split_argument,
)
from lidardesign.evaluate.baselines.simple import baseline_of
from lidardesign.numerics import effective_count
from lidardesign.samples import Samples
from lidardesign.scene import Body, Box, Scene, Sphere, rigid
from lidardesign.simulate.simulate import simulate
from lidardesign.space import DesignSpace, aim, direction, observed_point

FIXED = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
TURN = DesignSpace((0, 0, 0, 0, -0.5, 0.05), (0, 0, 0, 2 * math.pi, 0.5, 4.0))
CEILING = DesignSpace((-1, -1, 1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, 0, 2.0))
AISLE = DesignSpace((-1, 0, 0, -math.pi / 2, 0, 0.1), (1, 0, 0, -math.pi / 2, 1.2, 5.0), condition=("x_m",))
PAIRS = (
    ("fixed origin", "vl53l5cx"),
    ("fixed origin", "rplidar-c1"),
    ("full turn", "vl53l5cx:4x4"),
    ("full turn", "mid-360"),
    ("ceiling", "tmf8828"),
    ("ceiling", "vl53l1x"),
    ("aisle", "vl53l1x"),
    ("flatland", "rplidar-c1"),
    ("aisle", "tmf8821:3x6"),
)


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    """Poses are judged by fewer scene points than usual, which is quick."""
    monkeypatch.setattr("lidardesign.evaluate.baselines.catalog.POINTS", 500)


def ball(centre, radius=0.4):
    return Scene((Body(Sphere(radius), "ball", "both", rigid(translation_m=np.array(centre, float))),))


def shelf(x_m):
    pose = rigid(translation_m=np.array([x_m, -1.5, 0.8]))
    return Scene((Body(Box((3.0, 0.2, 0.3)), "shelf", "both", pose),))


FLAT = DesignSpace((0, 0, 0, math.pi / 4, 0, 0), (1, 0, 0, 3 * math.pi / 4, 0, 1.2))
FROZEN = DesignSpace((0, 0, 0, 0, 0, 3), (0, 0, 0, 0, 0, 3))

CASES = {
    "flatland": (FLAT, [ball([0.5, 0.8, 0.0], 0.15)]),
    "fixed origin": (FIXED, [ball([2.0, 0.1, 0.2]), ball([2.0, -0.1, 0.2])]),
    "full turn": (TURN, [ball([-1.5, 0.6, 0.0])]),
    "ceiling": (CEILING, [ball([0.3, 0.2, 0.0], 0.2)]),
    "aisle": (AISLE, [shelf(0.0)]),
}


def spots(space, points, retarget=None):
    """Scene points as a density that was learned in a space would have them."""
    return ScenePoints(np.asarray(points, float), np.zeros(len(points)), space, retarget)


def cloud(centre, space, count=400, spread=0.1):
    generator = np.random.default_rng(5)
    origins = np.array(space.low[:3]) + generator.uniform(size=(count, 3)) * (
        np.array(space.high[:3]) - np.array(space.low[:3])
    )
    return space.wrap(aim(origins, np.array(centre) + generator.normal(0, spread, (count, 3))))


@each_row(("case", "name"), PAIRS)
def test_any_number_of_rays_is_met_exactly_with_the_parts_range_and_repeats(case, name):
    space, train = CASES[case]
    source, same = (Rivals(space, train, seed=4) for _ in range(2))
    start, end = gate_inside(find_part(name), space)
    for count in (0, 1, 7) if name == "vl53l1x" or case == "ceiling" else (0, 1, 7, 70):
        (rays,) = source.positions(f"catalog:{name}", count)
        (again,) = same.positions(f"catalog:{name}", count)
        assert len(rays) == count
        np.testing.assert_allclose(rays.gate_m, np.tile([start, end], (count, 1)), rtol=1e-12)
        assert np.array_equal(rays.direction, again.direction)
        assert np.array_equal(rays.origin_m, again.origin_m)
        low, high = np.array(space.low[:3]), np.array(space.high[:3])
        assert ((rays.origin_m >= low) & (rays.origin_m <= high)).all()


@pytest.mark.parametrize("name", ["vl53l5cx", "tmf8828", "tmf8821:3x6"])
def test_rays_are_a_turned_pattern_of_the_part_and_at_its_own_number_all_of_it(name):
    space, train = CASES["fixed origin"]
    part = find_part(name)
    cosines = np.unique(np.round(part.directions @ part.directions.T, 9))
    for count in (part.rays // 2, part.rays):
        (rays,) = Rivals(space, train, seed=1).positions(f"catalog:{name}", count)
        found = np.round(rays.direction @ rays.direction.T, 9)
        # no two rays stand at an angle that no two of the part's do
        assert cKDTree(cosines[:, None]).query(found.reshape(-1, 1))[0].max() < 1e-8
    whole = np.sort((rays.direction @ rays.direction.T).ravel())
    np.testing.assert_allclose(whole, np.sort((part.directions @ part.directions.T).ravel()), atol=1e-9)


def test_more_rays_than_a_part_has_come_from_several_that_no_one_overtaxes():
    space, train = CASES["fixed origin"]
    (rays,) = Rivals(space, train, seed=1).positions("catalog:vl53l5cx", 150)
    shares = np.bincount(rays.sensor)
    assert shares.tolist() == [50, 50, 50]
    for sensor in range(3):
        own = rays.direction[rays.sensor == sensor]
        assert len(np.unique(np.round(own, 9), axis=0)) == 50
    # parts that see the same fire between each other's rays
    assert len(np.unique(np.round(rays.direction, 6), axis=0)) == 150


@each_row("case", CASES)
def test_a_part_looks_where_the_target_is(case):
    space, train = CASES[case]
    source = Rivals(space, train, seed=0)
    count = 8
    rays = source.positions("catalog:vl53l5cx", count)[0]
    uniform = source.positions("uniform", count)[0]
    returned = [np.mean([simulate(scene, one)[0].returned.mean() for scene in train]) for one in (rays, uniform)]
    assert returned[0] >= 0.5
    assert returned[0] >= returned[1]


def test_a_turned_world_turns_the_pose():
    narrow = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
    turned = DesignSpace((0, 0, 0, 0.5, -0.5, 0.05), (0, 0, 0, 1.5, 0.5, 4.0))
    points = cloud([2.0, 0.3, -0.2], narrow)
    moved = points.copy()
    moved[:, 3] += 1.0
    part = find_part("tmf8828")
    (one,) = PosedPart(part, spots(narrow, points), 3).best(1)
    (other,) = PosedPart(part, spots(turned, moved), 3).best(1)
    turn = boresight_frame(1.0, 0.0).T
    np.testing.assert_allclose(other.frame, one.frame @ turn.T, atol=1e-4)


def test_the_boresight_of_a_part_that_sees_everything_is_the_middle_of_what_there_is():
    points = cloud([2.0, 0.3, -0.2], FIXED, spread=0.05)
    (pose,) = PosedPart(find_part("vl53l5cx"), spots(FIXED, points), 3).best(1)
    middle = direction(points[:, 3], points[:, 4]).mean(axis=0)
    assert pose.frame[0] @ middle / np.linalg.norm(middle) > math.cos(math.radians(0.2))


def naive_worth(part, poses, points, space, visible=None):
    """Mean log density of rays over scene points, one point after the other."""
    total, middle = 0.0, (space.low[5] + space.high[5]) / 2
    for number, spot in enumerate(observed_point(points)):
        density = 0.0
        for index, pose in enumerate(poses):
            offset = spot - pose.origin_m
            range_m = math.dist(spot, pose.origin_m)
            near, far = max(part.range_m[0], space.low[5]), min(part.range_m[1], space.high[5])
            seen = near <= range_m <= far and in_part_view(part, (pose.frame @ offset / range_m)[None])[0]
            share = 1.0 if visible is None else visible[index][number]
            density += share * seen / range_m**2 / len(poses)
        total += math.log((1 - CLUTTER) * density + CLUTTER / middle**2)
    return total / len(points)


def test_no_place_that_was_tried_is_likelier_than_the_one_taken():
    points = cloud([0.3, -0.4, 0.1], CEILING, count=150, spread=0.2)
    posed = PosedPart(find_part("vl53l5cx"), spots(CEILING, points), 1)
    (best,) = posed.best(1)
    found = naive_worth(posed.part, [best], points, CEILING)
    tried = [pose for place in posed._closer for pose in posed._fitted(place, 1)]
    assert len(tried) > 5
    assert found >= max(naive_worth(posed.part, [pose], points, CEILING) for pose in tried) - 1e-9


def test_two_parts_see_what_one_cannot():
    two = np.concatenate([cloud([2.0, -0.9, 0.0], FIXED, 200, 0.03), cloud([2.0, 0.9, 0.0], FIXED, 200, 0.03)])
    posed = PosedPart(find_part("tmf8820"), spots(FIXED, two), 1)
    looking = direction(two[:, 3], two[:, 4])
    seen = [
        np.mean([in_part_view(posed.part, looking @ pose.frame.T) for pose in posed.best(number)], 0)
        for number in (1, 2)
    ]
    assert (seen[0] > 0).mean() < 0.8
    assert (seen[1] > 0).mean() > 0.95


def test_a_part_does_not_stand_where_the_density_says_that_nothing_is_visible():
    points = cloud([0.0, 0.0, 0.0], CEILING, count=300)

    def only_from_the_left(aimed):
        return np.where(aimed[:, 0] < 0, 0.0, -np.inf)

    free = PosedPart(find_part("vl53l5cx"), spots(CEILING, points), 1).best(1)[0]
    kept = PosedPart(find_part("vl53l5cx"), spots(CEILING, points, only_from_the_left), 1).best(1)[0]
    assert free.origin_m[0] > -0.5
    assert kept.origin_m[0] < 0


def test_scene_points_are_no_more_visible_from_elsewhere_than_they_can_be():
    points = cloud([0.0, 0.0, 0.0], CEILING, count=50)
    gains = np.random.default_rng(0).normal(0, 2, 50)
    scene = spots(CEILING, points, lambda aimed: gains)
    visible = scene.visible(np.array([0.2, 0.1, 1.0]))
    np.testing.assert_allclose(visible, np.minimum(np.exp(gains), 1.0))
    nothing = spots(CEILING, points, lambda aimed: np.full(len(aimed), np.nan)).visible(np.array([0.2, 0.1, 1.0]))
    assert not nothing.any()


def test_what_carries_a_part_takes_it_along():
    space, train = CASES["aisle"]
    values = [{"x_m": -1.0}, {"x_m": 0.25}, {"x_m": 1.0}]
    positions = Rivals(space, train, seed=2, conditions=values).positions("catalog:vl53l5cx", 20)
    for rays, value in zip(positions, values, strict=True):
        np.testing.assert_allclose(rays.origin_m, np.tile([value["x_m"], 0, 0], (20, 1)))
        assert np.array_equal(rays.direction, positions[0].direction)


def test_a_row_of_a_part_lies_in_the_plane_that_the_space_holds_all_rays_in():
    (rays,) = Rivals(*CASES["aisle"], seed=2, conditions=[{"x_m": 0.0}]).positions("catalog:vl53l5cx", 4)
    # the zones of a column are even in the tangent plane: they leave the vertical one by a tenth of a degree
    assert np.abs(rays.direction[:, 0]).max() < math.radians(0.15)
    assert np.ptp(rays.direction[:, 2]) > 0.15


@each_row("name", ["vl53l5cx", "vlp-16", "rplidar-c1"])
@each_row("limit", [0.0, 0.05, 3.0])
def test_as_many_rays_as_fit_in_a_bandwidth_fit_and_one_more_does_not(name, limit):
    bandwidth = Bandwidth()
    source = Rivals(*CASES["fixed origin"], seed=0)
    (rays,) = source.positions_within(f"catalog:{name}", limit, bandwidth)
    assert bandwidth.mbps(rays) <= limit
    assert bandwidth.mbps(source.positions(f"catalog:{name}", len(rays) + 1)[0]) > limit


def test_a_bandwidth_of_more_rays_than_any_sensor_has_gives_no_option():
    assert Rivals(*CASES["fixed origin"], seed=0).options_within("catalog:vl53l5cx", 1e9, Bandwidth()) == []


def test_a_pose_may_be_given():
    (rays,) = Rivals(*CASES["fixed origin"], seed=0).positions("catalog:vl53l5cx@0.1,0.2,-0.3,20,-10,90", 64)
    pose = Pose(np.array([0.1, 0.2, -0.3]), *np.radians([20.0, -10.0, 90.0]))
    expected = part_rays(find_part("vl53l5cx"), pose)
    np.testing.assert_allclose(rays.direction, expected.direction, atol=1e-12)
    np.testing.assert_allclose(rays.origin_m, expected.origin_m)
    (three,) = Rivals(*CASES["fixed origin"], seed=0).positions("catalog:vl53l5cx@0,0,0,20,-10", 150)
    assert np.bincount(three.sensor).tolist() == [50, 50, 50]


@each_row(
    ("name", "message"),
    [
        ("catalog", "needs a value after its name"),
        ("catalog:vl53l5xc", "vl53l5cx"),
        ("catalog:vl53l5cx:9x9", "no mode '9x9'"),
        ("catalog:missing.yaml", "missing.yaml"),
        ("catalog:vl53l5cx@1,2,3", "is not a pose"),
        ("catalog:vl53l5cx@a,b,c,d,e", "is not a pose"),
        ("catalog:vl53l5cx@0,0,0,0,91", "is not a pose"),
        ("catalog:vl53l5cx@0,0,0,nan,0", "is not a pose"),
        ("catalog:vl53l5cx@0,-1e300,0,0,0", "is too far away"),
        ("catalog:vl53l5cx@0,0,0,0,0,0,0", "is not a pose"),
    ],
)
def test_what_is_no_part_or_pose_is_refused_before_anything_is_built(name, message):
    with pytest.raises(ConfigError, match=message):
        baseline_of(name)


def test_a_space_of_one_ray_has_a_part_look_along_it():
    (rays,) = Rivals(FROZEN, [ball([3.4, 0, 0])], seed=0).positions("catalog:vl53l5cx", 1)
    np.testing.assert_allclose(rays.direction, [[1, 0, 0]], atol=1e-12)
    assert rays.gate_m[0, 0] < 3.0 < rays.gate_m[0, 1]


def test_a_part_that_measures_elsewhere_says_so():
    near = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 0.5))
    with pytest.raises(ConfigError, match=r"measures from 0.9 to 100 m.*0.05 to 0.5 m"):
        Rivals(near, [ball([0.3, 0, 0], 0.1)], seed=0).positions("catalog:vlp-16", 5)


def test_without_returns_and_samples_no_pose_is_better_than_another():
    with pytest.raises(ConfigError, match="no pose is better"):
        Rivals(FIXED, [ball([-3.0, 0, 0])], seed=0).positions("catalog:vl53l5cx", 5)


def test_a_learned_density_stands_before_training_returns():
    generator = np.random.default_rng(2)
    points = FIXED.sample(3000, generator)
    away = np.square(points[:, 3] - 0.35) + np.square(points[:, 4] + 0.3)
    samples = Samples(points, np.full(3000, -FIXED.log_volume), -away / (2 * 0.02**2), FIXED)
    source = Rivals(*CASES["fixed origin"], seed=0, density=lambda: Density(samples))
    (rays,) = source.positions("catalog:vl53l5cx", 4)
    assert (rays.direction @ direction(0.35, -0.3)).min() > math.cos(math.radians(10))


def test_rows_of_several_parts_say_how_many():
    source = Rivals(*CASES["fixed origin"], seed=0)
    rows = [(name, source.positions(name, count)) for count in (10, 150) for name in ("catalog:vl53l5cx", "uniform")]
    assert part_notes(rows) == ["catalog:vl53l5cx is 3 parts at 150 rays"]
    assert part_notes(rows[:2]) == []


# views and shapes


@each_row("name", ["vl53l5cx", "rplidar-c1", "mid-360", "azure-kinect", "tmf8821:3x6"])
def test_a_part_has_all_its_rays_in_view(name):
    part = find_part(name)
    assert in_part_view(part, part.directions).all()


def test_rays_worth_firing_are_those_nearest_to_what_there_is():
    part, pose = find_part("vl53l5cx"), Pose()
    rays = part.directions
    points = aim(np.zeros((60, 3)), rays[:3].repeat(20, axis=0) * 2.0)
    kept = useful_ray_filter(part, pose, points, np.ones(60))(rays)
    assert np.flatnonzero(kept).tolist() == [0, 1, 2]
    # one stray in a thousand is none that a ray is spent on
    weights = np.concatenate([np.full(40, 1.0), np.full(20, 1e-3)])
    assert np.flatnonzero(useful_ray_filter(part, pose, points, weights)(rays)).tolist() == [0, 1]
    assert not useful_ray_filter(part, pose, points, np.zeros(60))(rays).any()
    # asked for more, the rays beside them: of an 8 by 8 pattern the neighbours in its row and the next
    more = useful_ray_filter(part, pose, points, np.ones(60), least=7)(rays)
    assert np.flatnonzero(more).tolist() == [0, 1, 2, 3, 8, 9, 10]
    assert useful_ray_filter(part, pose, points, np.ones(60), least=1000)(rays).all()


def test_a_shape_is_where_its_component_looks_upright_and_turned():
    space = FIXED
    part = find_part("tmf8828")
    upright, turned = shapes_of(part, space)
    assert upright.field_of_view_rad == part.field_of_view_rad
    assert turned.field_of_view_rad == part.field_of_view_rad[::-1]
    from lidardesign.design.mixture.features import Axes

    axes = Axes.of(space)
    for shape in (upright, turned):
        pose = shape.pose(np.zeros(3), 0.3, 0.2, 0.1, axes)
        np.testing.assert_allclose(pose.frame[0], direction(0.3, 0.2), atol=1e-12)
    across = turned.pose(np.zeros(3), 0.0, 0.0, 0.0, axes)
    np.testing.assert_allclose(across.frame[1], [0, 0, 1], atol=1e-12)


def test_a_part_whose_range_does_not_meet_the_spaces_has_no_shape():
    near = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 0.5))
    assert shapes_of(find_part("vlp-16"), near) == []
    assert isinstance(shapes_of(find_part("vl53l5cx"), near)[0], PartShape)
    held = DesignSpace((0, 0, 0, -0.5, -0.5, 0.3), (0, 0, 0, 0.5, 0.5, 0.3))
    assert gate_inside(find_part("vl53l5cx"), held) == find_part("vl53l5cx").range_m
    assert gate_inside(find_part("vlp-16"), held) is None


def test_places_are_even_inside_the_box_and_one_where_nothing_is_free():
    tried = places(CEILING)
    assert ((tried >= CEILING.low[:3]) & (tried <= CEILING.high[:3])).all()
    np.testing.assert_allclose(tried[0], [0, 0, 1])
    assert len(np.unique(tried, axis=0)) == len(tried) > 20
    assert places(FIXED).tolist() == [[0, 0, 0]]


def test_a_pose_is_found_where_next_to_nothing_is_visible():
    points = cloud([0.0, 0.0, 0.0], CEILING, count=30)
    posed = PosedPart(find_part("vl53l5cx"), spots(CEILING, points, lambda aimed: np.full(len(aimed), -np.inf)), 1)
    assert effective_count(posed.scene.visible(np.zeros(3))) == 0
    (pose,) = posed.best(1)
    assert np.isfinite(pose.frame).all()


def test_arguments_are_read_as_they_are_written():
    part, pose = split_argument("vl53l5cx:4x4@1,2,3,90,-45")
    assert part.name == "vl53l5cx:4x4"
    np.testing.assert_allclose(pose.origin_m, [1, 2, 3])
    np.testing.assert_allclose([pose.azimuth_rad, pose.elevation_rad, pose.roll_rad], [math.pi / 2, -math.pi / 4, 0])
    assert split_argument("tmf8828")[1] is None


# the command line


@pytest.fixture
def call(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return caller(capsys, tmp_path, monkeypatch)


def test_evaluate_compares_with_a_part_and_refuses_what_is_none(call, tmp_path):
    run = make_run(tmp_path / "run", count=2000)
    assert call("fit", run, "--layout", "grid", "--sensors", 2).code == 0
    found = call("evaluate", run, "--rays", 9, "--baseline", "catalog:vl53l5cx", "--set", "test=2", "--json")
    assert found.code == 0, found.err
    document = json.loads(found.out)
    assert "catalog:vl53l5cx" in {row["design"] for row in document["rows"]}
    assert "catalog:vl53l5cx" in {row["design"] for row in document["equal_bandwidth"]}
    refused = call("evaluate", run, "--baseline", "catalog:vl53")
    assert refused.code == 2
    assert "there is no part 'vl53'" in refused.err
