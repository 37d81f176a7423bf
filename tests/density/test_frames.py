"""The target over many moving frames against the full sum over all of them, and the points drawn near its surfaces."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support import references

from lidardesign.config import DensitySettings
from lidardesign.density.fields.bodies import Pairs, occluding_bodies
from lidardesign.density.fields.distance import build_field
from lidardesign.density.objective.proposals import independent_points
from lidardesign.density.objective.surfaces import MovingFrames
from lidardesign.density.objective.target import build_target
from lidardesign.density.objective.visibility import BodyRaycast, RayBatch
from lidardesign.errors import ConfigError
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Body, Box, Capsule, Mesh, Plane, Scene, Sphere, rigid
from lidardesign.space import AZIMUTH, ELEVATION, DesignSpace, direction, observed_point

CEILING = DesignSpace((-0.6, -0.6, 1.0, 0.0, -math.pi / 2, 0.1), (0.6, 0.6, 1.0, 2 * math.pi, -math.pi / 4, 1.5))
SETTINGS = DensitySettings(sigma_m=0.03, attenuation_per_m=40.0, margin_m=0.03)
ALL = SETTINGS.model_copy(update={"surface_tolerance_nats": 1e6})


pytestmark = pytest.mark.usefixtures("own_cache")


def tracks(generator, frames):
    """Poses that wander through the space below the ceiling, (frames, 4, 4)."""
    ends = generator.uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 0.5], (2, 3))
    share = np.linspace(0, 1, frames)[:, None]
    rotation = Rotation.random(random_state=generator).as_matrix()
    return np.stack([rigid(rotation, place) for place in (1 - share) * ends[0] + share * ends[1]])


def cube():
    mesh = trimesh.creation.box((0.1, 0.14, 0.2))
    return Mesh(mesh.vertices, mesh.faces)


def moving_scenes(seed=0, scenes=3, frames=7, with_mesh=True):
    """Balls carried under links of every kind."""
    generator = np.random.default_rng(seed)
    mesh = cube()
    result = []
    for index in range(scenes):
        path = tracks(generator, frames)
        above = path.copy()
        above[:, 2, 3] += 0.2
        shapes = [Capsule(0.05, 0.1), Box((0.05, 0.1, 0.08)), *([mesh] if with_mesh else [])]
        links = [Body(shape, f"link {n}", "occluder", tracks(generator, frames)) for n, shape in enumerate(shapes)]
        hand = Body(Capsule(0.03, 0.05), "hand", "occluder", above)
        floor = Body(Plane(), "floor", "occluder", rigid(translation_m=(0, 0, -0.2)))
        result.append(Scene((Body(Sphere(0.03), "ball", "target", path), hand, floor, *links), f"scene {index}"))
    return result


def near_points(target, count=300, seed=1):
    points, _ = independent_points(target, count, np.random.default_rng(seed))
    return points


def full_sum(scenes, points, optics):
    """log p* of points as it is defined: every frame of every scene, cast by itself. The naive twin."""
    rays = direction(points[:, AZIMUTH], points[:, ELEVATION])
    observed, total = observed_point(points), np.zeros(len(points))
    for scene in scenes:
        ball = scene.bodies[0]
        for frame in range(scene.frames):
            distance = np.linalg.norm(observed - ball.pose(frame)[:3, 3], axis=1) - ball.shape.radius_m
            hits = SceneCaster(scene, frame, only="occluders").first_hit(points[:, :3], rays)
            hidden = np.maximum(points[:, 5] - optics.margin_m - hits.range_m, 0.0)
            surface = np.exp(-np.square(distance / optics.sigma_m) / 2)
            total += surface * np.exp(-optics.attenuation_per_m * hidden) / scene.frames
    return total


def test_the_target_equals_the_full_sum_over_all_frames():
    scenes = moving_scenes()
    target = build_target(scenes, CEILING, ALL, "raycast")
    assert isinstance(target.surfaces, MovingFrames)
    points = near_points(target)
    expected = full_sum(scenes, points, target.optics)
    # embree casts in float32: 1e-6 m times the attenuation of 40 / m
    np.testing.assert_allclose(np.exp(target.log_density(points)), expected, rtol=2e-4, atol=1e-12)
    assert (expected < 0.5 * np.exp(target.log_proximity(points))).mean() > 0.1  # occlusion matters here


@pytest.mark.parametrize("tolerance", [2.0, 6.0, 16.0])
def test_leaving_out_frames_costs_no_more_than_stated(tolerance):
    scenes = moving_scenes(frames=20)
    exact = build_target(scenes, CEILING, ALL, "raycast")
    quick = build_target(scenes, CEILING, SETTINGS.model_copy(update={"surface_tolerance_nats": tolerance}), "raycast")
    points = near_points(exact, 600)
    columns = exact.columns
    observed = observed_point(points)
    balls = np.concatenate([scene.bodies[0].poses[:, :3, 3] for scene in scenes])
    distances = np.linalg.norm(observed[:, None] - balls, axis=2) - 0.03
    largest = np.exp(-np.square(distances / SETTINGS.sigma_m).min(axis=1) / 2) / 20
    error = np.exp(exact.log_density(points)) - np.exp(quick.log_density(points))
    assert (error >= -1e-12).all()
    assert (error <= columns * math.exp(-tolerance) * largest + 1e-12).all()
    if tolerance < 3:
        assert error.max() > 0


def test_gradients_match_differences_of_the_values():
    scenes = moving_scenes(with_mesh=False)
    target = build_target(scenes, CEILING, ALL, "raycast")
    points = near_points(target, 200)
    points = points[points[:, ELEVATION] > -1.4]
    _, gradient = target.log_density_and_gradient(points)
    numerical = references.numerical_gradient(
        lambda chart: target.log_density(CEILING.from_chart(chart)), CEILING.to_chart(points), 1e-6
    )
    error = np.abs(gradient - numerical) / (1 + np.abs(numerical))
    # silhouettes and the ends of margins are kinks
    assert np.quantile(error, 0.9) < 1e-3


def test_parts_of_all_frames_average_to_the_whole():
    scenes = moving_scenes(with_mesh=False)
    target = build_target(scenes, CEILING, ALL, "raycast")
    points = near_points(target)
    order = np.random.default_rng(3).permutation(target.columns)
    parts = [target.subsample(np.sort(part)).log_density(points) for part in np.split(order, 3)]
    np.testing.assert_allclose(np.exp(parts).mean(axis=0), np.exp(target.log_density(points)), rtol=1e-9)


def first_hits_of_one_column(shapes_and_poses, origin, toward, limit_m=10.0):
    """Range and normal of a ray's first hit on occluders."""
    scene = Scene(tuple(Body(shape, f"body {n}", "both", pose) for n, (shape, pose) in enumerate(shapes_and_poses)))
    rays = RayBatch(np.array([origin], float), np.array([toward], float), np.array([limit_m]))
    pairs = Pairs(np.array([0, 1]), np.zeros(1, int), np.zeros(1), np.zeros(1, int))
    hits, normals = BodyRaycast(occluding_bodies([scene])).first_hits(rays, pairs, rays.ranges)
    return float(hits[0]), normals[0]


def test_of_more_meshes_along_a_ray_than_there_is_room_for_the_nearest_is_met():
    mesh = cube()
    row = [(mesh, rigid(translation_m=(0.5 * n, 0, 0))) for n in range(12, 0, -1)]
    range_m, normal = first_hits_of_one_column(row, (0, 0.01, 0.02), (1, 0, 0))
    assert range_m == pytest.approx(0.45, abs=1e-6)
    np.testing.assert_allclose(normal, (-1, 0, 0), atol=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_ray_along_a_face_of_a_box_meets_it(side):
    box = Box((0.1, 0.2, 0.3))
    for axis in (1, 2):
        origin = np.array([-1.0, 0, 0])
        origin[axis] = side * box.half_extents_m[axis]
        range_m, normal = first_hits_of_one_column([(box, np.eye(4))], origin, (1, 0, 0))
        assert range_m == pytest.approx(0.9)
        # on an edge either face is met
        assert np.abs(normal).max() == 1


def test_of_bodies_far_larger_than_the_space_points_are_drawn_where_it_reaches():
    ground = Body(Sphere(1e5), "ground", "target", rigid(translation_m=(0, 0, -1e5)))
    target = build_target([Scene((ground,))], CEILING, SETTINGS, "off")
    points, _ = independent_points(target, 2000, np.random.default_rng(0))
    assert len(points) == 2000
    height_m = observed_point(points)[:, 2]
    assert abs(height_m.mean()) < 4 * 0.03 / math.sqrt(2000)
    assert abs(height_m.std() / 0.03 - 1) < 4 / math.sqrt(2 * 2000)


def test_independent_points_weighted_by_their_density_integrate_the_target():
    scenes = moving_scenes(with_mesh=False)
    target = build_target(scenes, CEILING, SETTINGS.model_copy(update={"sigma_m": 0.1}), "raycast")
    points, log_density = independent_points(target, 40_000, np.random.default_rng(0))
    weights = np.exp(target.log_density(points) - log_density)
    uniform = CEILING.sample(40_000, np.random.default_rng(1))
    values = np.exp(target.log_density(uniform))
    for axis in (0, 1, 5):
        ours = np.average(points[:, axis], weights=weights)
        naive = np.average(uniform[:, axis], weights=values)
        effective = values.sum() ** 2 / np.square(values).sum()
        spread = math.sqrt(np.average(np.square(uniform[:, axis] - naive), weights=values))
        assert abs(ours - naive) < 5 * spread / math.sqrt(effective)


def test_a_quadrature_over_thousands_of_bodies_is_refused():
    with pytest.raises(ConfigError, match="raycast"):
        build_target(moving_scenes(frames=300), CEILING, SETTINGS, "quadrature")


def test_a_frame_costs_a_pose_and_no_grid_even_where_scenes_have_copies_of_a_mesh():
    generator = np.random.default_rng(0)
    scenes = [Scene((Body(cube(), "part", "target", tracks(generator, 250)),)) for _ in range(2)]
    bodies = build_field(scenes, lambda body: True, resolution=16, padding_m=0.05).bodies
    assert bodies.columns == 500
    assert len(bodies.grids.meshes) == 1
