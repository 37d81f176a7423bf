"""Parts of a surface that count more get more of the density, by exactly as much as they count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from lidardesign_tasks.face import FaceConfig, FaceTask

from lidardesign.config import DensitySettings
from lidardesign.density.fields.importance import (
    BodyWeights,
    TableWeights,
    UnionWeights,
    importance_notes,
    is_weighted,
)
from lidardesign.density.objective.proposals import independent_points
from lidardesign.density.objective.surfaces import log_peak
from lidardesign.density.objective.target import build_target
from lidardesign.errors import DataError
from lidardesign.numerics import logsumexp
from lidardesign.scenes.scene import LARGEST_WEIGHT, Body, Box, Capsule, Mesh, Receiver, Scene, Sphere, rigid
from lidardesign.space import DesignSpace, observed_point
from lidardesign.task import scoring_settings

SPACE = DesignSpace((0, -0.1, -0.1, -0.5, -0.4, 0.3), (0, 0.1, 0.1, 0.5, 0.4, 2.2))
SETTINGS = DensitySettings(sigma_m=0.05, field_resolution=24, quadrature_points=24)
SCREEN = Body(Box((0.02, 0.2, 0.2)), "screen", "occluder", rigid(translation_m=(0.7, 0.25, 0)))
RECEIVER = Receiver((0.0, 0.3, 0.0), 0.0, 0.0, 1.5, 1.5, (0.1, 3.0))


def ball(weights=None, radius=0.3):
    """A ball as a mesh; weights is a function of its vertices."""
    made = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    vertices = np.asarray(made.vertices)
    return Mesh(vertices, made.faces, importance=None if weights is None else weights(vertices))


def sideways(vertices):
    """Weights that grow twentyfold from right to left, 1 in the middle."""
    return np.exp(5.0 * vertices[:, 1])


def places(count):
    return [np.array([1.3 + 0.1 * i, 0.15 * (i - 1), 0.05 * i]) for i in range(count)]


def at_rest(shape, factor=1.0, count=3, receiver=None):
    body = Body(shape, importance=factor)
    return [
        Scene((replace(body, poses=rigid(translation_m=p)), SCREEN), f"scene {i}", receiver=receiver)
        for i, p in enumerate(places(count))
    ]


def moving(shape, factor=1.0, count=3):
    """Each scene has one frame more than the one before."""
    made = []
    for i, place in enumerate(places(count)):
        poses = np.stack([rigid(translation_m=place + np.array([0, 0.03 * k, 0])) for k in range(i + 2)])
        made.append(Scene((Body(shape, poses=poses, importance=factor), SCREEN)))
    return made


def mixed(shape, factor=1.0, count=3):
    """A mesh beside a primitive, both targets at rest."""
    post = Body(Capsule(0.1, 0.4), "post", importance=factor)
    return [
        Scene(
            (
                Body(shape, poses=rigid(translation_m=p), importance=factor),
                replace(post, poses=rigid(translation_m=p + np.array([0.1, -0.4, 0]))),
                SCREEN,
            )
        )
        for p in places(count)
    ]


def heard(shape, factor=1.0, count=3):
    return at_rest(shape, factor, count, RECEIVER)


CASES = {
    "meshes, off": (at_rest, "off", TableWeights),
    "meshes, raycast": (at_rest, "raycast", TableWeights),
    "meshes, quadrature": (at_rest, "quadrature", TableWeights),
    "meshes, fixed receiver": (heard, "raycast", TableWeights),
    "moving meshes, off": (moving, "off", BodyWeights),
    "moving meshes, raycast": (moving, "raycast", BodyWeights),
    "moving meshes, quadrature": (moving, "quadrature", BodyWeights),
    "mesh beside a primitive": (mixed, "raycast", UnionWeights),
}


def built(make, visibility, shape, factor=1.0):
    return build_target(make(shape, factor), SPACE, SETTINGS, visibility)


def test_weights_of_one_are_none():
    ones = ball(lambda vertices: np.ones(len(vertices)))
    assert all(built(make, "off", ones).surfaces.importance is None for make in (at_rest, moving, mixed))
    assert importance_notes(at_rest(ones)) == []


# a primitive has no vertices
CONSTANTS = [(case, of) for case in CASES for of in ("vertices", "body") if of == "body" or CASES[case][0] is not mixed]


@pytest.mark.parametrize(("case", "of"), CONSTANTS)
def test_a_constant_weight_moves_log_density_by_its_log_and_nothing_else(case, of):
    make, visibility, kind = CASES[case]
    points = SPACE.sample(300, np.random.default_rng(1))
    plain = built(make, visibility, ball())
    if of == "body":
        weighted = built(make, visibility, ball(), factor=7.0)
    else:
        weighted = built(make, visibility, ball(lambda vertices: np.full(len(vertices), 7.0)))
    assert isinstance(weighted.surfaces.importance, kind)
    value, gradient = weighted.log_density_and_gradient(points, 0.1)
    expected, slope = plain.log_density_and_gradient(points, 0.1)
    assert np.allclose(value - expected, np.log(7.0), atol=1e-6)
    assert np.allclose(gradient, slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
    assert np.allclose(weighted.log_proximity(points) - plain.log_proximity(points), np.log(7.0), atol=1e-6)
    assert log_peak(weighted.surfaces) - log_peak(plain.surfaces) == pytest.approx(np.log(7.0), abs=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_the_gradient_is_that_of_finite_differences(case):
    make, visibility, _ = CASES[case]
    target = built(make, visibility, ball(sideways))
    assert is_weighted(make(ball(sideways)))
    points = SPACE.sample(400, np.random.default_rng(2))
    points = points[target.log_density(points, 0.1) > -30]
    _, gradient = target.log_density_and_gradient(points, 0.1)
    unweighted = replace(target, surfaces=replace(target.surfaces, importance=None))
    _, plain = unweighted.log_density_and_gradient(points, 0.1)
    step = 1e-4
    for dimension in (1, 3, 5):  # the elevation is in the chart as its sine
        moved = np.zeros(6)
        moved[dimension] = step
        sides = [t.log_density(points + sign * moved, 0.1) for sign in (1, -1) for t in (target, unweighted)]
        # of the weights alone: silhouettes, which visibility's gradient leaves out, are in both
        slope = (sides[0] - sides[2]) / (2 * step) - (sides[1] - sides[3]) / (2 * step)
        apart = np.abs(slope - (gradient - plain)[:, dimension])
        assert np.median(apart) < 0.02
        assert np.quantile(apart, 0.9) < 0.15  # kinks between cells


@pytest.mark.parametrize("visibility", ["off", "raycast", "quadrature"])
def test_where_one_scene_is_all_there_is_the_density_grows_by_the_weight_of_the_nearest_point(visibility):
    # linear on a flat plate, so trilinear values are exact
    plate = trimesh.creation.box((0.1, 1.0, 1.0)).subdivide_loop(0)
    vertices = np.asarray(plate.vertices)
    weights = np.exp(2.0 * vertices[:, 1] - vertices[:, 2])
    pose = rigid(translation_m=(1.5, 0, 0))
    scenes = [Scene((Body(Mesh(vertices, plate.faces, importance=w), poses=pose),)) for w in (None, weights)]
    plain, weighted = (build_target([scene], SPACE, SETTINGS, visibility) for scene in scenes)
    points = SPACE.sample(2000, np.random.default_rng(3))
    observed = observed_point(points)
    in_front = (np.abs(observed[:, 1:]) < 0.4).all(axis=1) & (observed[:, 0] > 1.2) & (observed[:, 0] < 1.45)
    assert in_front.sum() > 50
    found = (weighted.log_density(points) - plain.log_density(points))[in_front]
    assert np.allclose(found, 2.0 * observed[in_front, 1] - observed[in_front, 2], atol=1e-5)


def test_moving_frames_count_as_a_naive_sum_over_all_of_them_does():
    scenes = moving(ball(sideways), count=4)
    target = build_target(scenes, SPACE, SETTINGS, "off")
    points = SPACE.sample(300, np.random.default_rng(5))
    terms = []
    for scene in scenes:
        for frame in range(scene.frames):
            alone = Scene((replace(scene.bodies[0], poses=scene.bodies[0].pose(frame)[None].repeat(2, axis=0)),))
            one = build_target([alone], SPACE, SETTINGS, "off")
            assert one.columns == 2
            terms.append(one.log_density(points) - np.log(scene.frames))
    naive = logsumexp(np.stack(terms, axis=1), axis=1)
    near = naive > -12
    assert near.sum() > 50
    assert np.allclose(target.log_density(points)[near], naive[near], atol=1e-5)


def test_a_scene_far_off_that_counts_a_million_times_is_not_left_out():
    near = Scene((Body(Sphere(0.2), poses=rigid(translation_m=(1.0, 0, 0)), importance=1 / LARGEST_WEIGHT),))
    far = Scene((Body(Sphere(0.2), poses=rigid(translation_m=(1.4, 0, 0)), importance=LARGEST_WEIGHT),))
    both = build_target([near, far], SPACE, SETTINGS, "off")
    parts = [build_target([scene], SPACE, SETTINGS, "off") for scene in (near, far)]
    points = SPACE.sample(2000, np.random.default_rng(6))
    naive = np.logaddexp(*(part.log_density(points) for part in parts))
    assert np.allclose(both.log_density(points), naive, atol=1e-6)
    assert (naive > parts[0].log_density(points) + 5).sum() > 100


def test_plain_interpolation_and_compiled_loops_give_the_same_weights():
    scenes = at_rest(ball(sideways))
    compiled, plain = (
        build_target(scenes, SPACE, SETTINGS, "off", compiled=choice).surfaces.importance for choice in (True, False)
    )
    points = np.random.default_rng(8).uniform(-1, 3, (500, 3))
    assert np.allclose(compiled.values(points), plain.values(points), atol=1e-5)


def test_weights_beyond_their_grid_are_those_at_its_faces_and_have_no_slope_across():
    weights = build_target(at_rest(ball(sideways), count=1), SPACE, SETTINGS, "off").surfaces.importance
    high = weights.grid.low + weights.grid.step * (weights.grid.counts - 1)
    inside = np.array([[high[0], 0.1, 0.1]])
    beyond = inside + np.array([5.0, 0, 0])
    assert np.array_equal(weights.values(inside), weights.values(beyond))
    assert weights.gradient(beyond, np.ones((1, 1)))[0, 0] == 0.0


def test_two_weights_on_one_geometry_are_two_grids(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARDESIGN_CACHE", str(tmp_path))
    shapes = [ball(), ball(sideways), ball(lambda v: 2 * sideways(v))]
    assert len({shape.content_hash for shape in shapes}) == 1
    points = SPACE.sample(200, np.random.default_rng(9))
    for make in (at_rest, moving):
        first = [build_target(make(shape), SPACE, SETTINGS, "off").log_density(points) for shape in shapes]
        again = [build_target(make(shape), SPACE, SETTINGS, "off").log_density(points) for shape in shapes]
        assert np.array_equal(first, again)
        assert np.allclose(first[2] - first[1], np.log(2), atol=1e-5)
        assert np.abs(first[1] - first[0]).max() > 0.5
        two = moving(shapes[1], count=1)[0].bodies[0], moving(shapes[2], count=1)[0].bodies[0]
        both = build_target([Scene((two[0],)), Scene((two[1],))], SPACE, SETTINGS, "off").log_density(points)
        alone = build_target([Scene((two[0],))], SPACE, SETTINGS, "off").log_density(points)
        assert np.allclose(both - alone, np.log(3), atol=1e-5)


@pytest.mark.parametrize("make", [at_rest, moving])
@pytest.mark.parametrize("factor", [1e-5, 1e5])
def test_independent_proposals_find_surfaces_however_little_they_count(make, factor):
    space = DesignSpace((0, 0, 0, -0.5, 0, 0.3), (0, 0, 0, 0.5, 0, 2.2))
    scenes = make(Sphere(0.3) if make is moving else ball(), factor)
    target = build_target(scenes, space, SETTINGS, "off")
    points, log_density = independent_points(target, 500, np.random.default_rng(10))
    assert len(points) == 500
    assert np.isfinite(log_density).all()


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        (np.ones(5), "shape"),
        (np.zeros(162), "importance is 0"),
        (np.full(162, -1.0), "importance is -1"),
        (np.full(162, np.nan), "importance is nan"),
        (np.full(162, 1e9), "1e-06 to 1e"),
    ],
)
def test_weights_that_are_none_are_refused_with_what_is_allowed(weights, words):
    with pytest.raises(DataError) as refused:
        ball(lambda _: weights)
    assert words in str(refused.value)


@pytest.mark.parametrize("importance", [0.0, -1.0, float("nan"), float("inf")])
def test_a_body_that_counts_nothing_is_refused(importance):
    with pytest.raises(DataError, match="importance"):
        Body(Sphere(1.0), importance=importance)


def test_a_mesh_in_another_pose_counts_as_before():
    mesh = ball(sideways)
    moved = mesh.transformed(rigid(translation_m=(1, 2, 3)))
    assert np.array_equal(moved.importance, mesh.importance)
    assert moved.importance_hash == mesh.importance_hash != ball().importance_hash == ""


def test_a_patch_that_counts_three_times_has_three_times_the_mass():
    space = DesignSpace((0, 0, 0, -0.5, -0.2, 0.6), (0, 0, 0, 0.5, 0.2, 1.4))
    patch = trimesh.creation.box((0.02, 0.3, 0.3))
    meshes = [Mesh(patch.vertices, patch.faces, importance=weights) for weights in (np.full(8, 3.0), None)]
    poses = [rigid(translation_m=(1.0, y, 0)) for y in (0.25, -0.25)]
    scene = Scene(tuple(Body(mesh, poses=pose) for mesh, pose in zip(meshes, poses, strict=True)))
    points = space.sample(100_000, np.random.default_rng(12))
    density = np.exp(build_target([scene], space, SETTINGS, "off").log_density(points))
    left = points[:, 3] > 0
    share = density[left].sum() / density.sum()
    error = np.sqrt(np.square(density * (left - share)).sum()) / density.sum()
    assert abs(share - 0.75) < 4 * error < 0.02
    assert "from 1 to 3" in importance_notes([scene])[0]


def test_settings_that_only_weigh_do_not_keep_designs_from_being_judged_together():
    task = FaceTask()
    plain, weighed, elsewhere = (FaceConfig(**keys) for keys in ({}, {"area_exponent": 0.5}, {"distance_m": 0.5}))
    assert scoring_settings(task, plain) == scoring_settings(task, weighed)
    assert scoring_settings(task, plain) != scoring_settings(task, elsewhere)
    assert set(task.weighing_keys) < set(FaceConfig.model_fields)
