"""Distances of many scenes: exact for primitives, within the grid's error for meshes, a lower bound outside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support import references
from support.meshes import icosphere

from lidardesign.density.fields import grids
from lidardesign.density.fields.distance import BodyField, UnionField, build_field
from lidardesign.errors import ConfigError
from lidardesign.scenes.distances import TriangleTree
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Plane, Scene, Sphere, rigid

pytestmark = pytest.mark.usefixtures("own_cache")


def field_of(*scenes, resolution=48):
    return build_field(scenes, lambda body: body.is_target, resolution=resolution, padding_m=0.1)


def random_pose(generator):
    rotation = Rotation.random(random_state=int(generator.integers(2**31))).as_matrix()
    return rigid(rotation, generator.normal(size=3))


PRIMITIVES = {
    "sphere": Sphere(0.7),
    "plane": Plane(),
    "capsule": Capsule(0.3, 0.8),
    "box": Box((0.3, 0.5, 0.9)),
    "cylinder": Cylinder(0.3, 0.8),
    "ellipsoid": Ellipsoid((0.3, 0.5, 0.9)),
    "disc": Ellipsoid((0.7, 0.7, 0.02)),
    "needle": Ellipsoid((1.5, 0.01, 0.01)),
    "ball": Ellipsoid((0.5, 0.5, 0.5)),
}


@pytest.mark.hard_case("14")
@pytest.mark.parametrize("name", PRIMITIVES)
def test_posed_primitives_have_their_closed_form_distance(name):
    generator = np.random.default_rng(1)
    shape = PRIMITIVES[name]
    pose = random_pose(generator)
    points = generator.normal(scale=1.5, size=(500, 3))
    field = field_of(Scene((Body(shape, poses=pose),)))
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(field.distances(points)[:, 0], references.shape_distance(shape)(local), atol=1e-12)


@pytest.mark.parametrize("name", PRIMITIVES)
def test_gradients_of_primitives_have_unit_length_and_match_differences(name):
    generator = np.random.default_rng(2)
    shape = PRIMITIVES[name]
    field = field_of(Scene((Body(shape, poses=random_pose(generator)),)))
    points = generator.normal(scale=1.5, size=(300, 3))
    gradient = field.gradient(points, np.ones((300, 1)))
    numerical = references.numerical_gradient(lambda p: field.distances(p)[:, 0], points, 1e-6)
    smooth = np.abs(np.linalg.norm(numerical, axis=1) - 1) < 1e-5
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(gradient[smooth], numerical[smooth], atol=1e-5)


@pytest.mark.parametrize("axes", [(0.3, 0.5, 0.9), (0.7, 0.7, 0.02), (1e3, 1e-3, 1.0), (0.5, 0.5, 0.5)])
def test_an_ellipsoid_is_zero_on_itself_and_as_deep_as_its_least_semi_axis(axes):
    turned = np.random.default_rng(5).normal(size=(400, 3))
    on = np.array(axes) * turned / np.linalg.norm(turned, axis=1, keepdims=True)
    field = field_of(Scene((Body(Ellipsoid(axes)),)))
    np.testing.assert_allclose(field.distances(on)[:, 0], 0.0, atol=1e-12 * max(*axes, 1))
    # on the planes and axes of symmetry two or more points are nearest
    assert field.distances(np.zeros((1, 3)))[0, 0] == pytest.approx(-min(axes), rel=1e-12)
    assert np.isfinite(field.gradient(np.eye(3) * axes, np.ones((3, 1)))).all()


@pytest.mark.parametrize("resolution", [24, 96])
def test_a_mesh_field_is_within_the_interpolation_error_of_the_sphere(resolution):
    field = field_of(Scene((Body(icosphere()),)), resolution=resolution)
    points = np.random.default_rng(3).uniform(-0.59, 0.59, (4000, 3))
    exact = np.linalg.norm(points, axis=1) - 0.5
    step = field.grid.step
    near = np.abs(exact) < 1.2 * step  # all corners lie in the exact band
    faceting = 0.5 * (1 - np.cos(np.radians(1.3)))
    tolerance = references.GRID_ERROR_PER_STEP_SQUARED * step**2 / 0.3 + faceting
    assert np.abs(field.distances(points)[near, 0] - exact[near]).max() < tolerance
    far = np.abs(field.distances(points)[~near, 0] - exact[~near])
    assert far.max() < step / 2  # the kink at the centre
    assert (np.sign(field.distances(points)[~near, 0]) == np.sign(exact[~near])).all()


def test_contracted_gradients_match_differences_inside_and_outside():
    generator = np.random.default_rng(6)
    scenes = [Scene((Body(icosphere(0.5 - 0.02 * i, (0.03 * i, 0, 0))),)) for i in range(5)]
    field = field_of(*scenes)
    points = generator.uniform(-1.0, 1.0, (400, 3))
    weights = generator.normal(size=(400, 5))
    gradient = field.gradient(points, weights)
    numerical = references.numerical_gradient(
        lambda p: (field.distances(p).astype(np.float64) * weights).sum(axis=1), points, 1e-4
    )
    error = np.abs(gradient - numerical).max(axis=1)
    # cells change inside some difference intervals
    assert np.quantile(error, 0.9) < references.TABLE_GRADIENT * np.abs(weights).sum(axis=1).max()


def test_a_moving_mesh_equals_the_mesh_at_rest_in_every_frame():
    generator = np.random.default_rng(7)
    poses = np.stack([random_pose(generator) for _ in range(3)])
    moving = field_of(Scene((Body(icosphere(0.5, (0.2, 0.1, 0.0)), poses=poses),)))
    assert isinstance(moving, BodyField)
    assert moving.columns == 3
    points = generator.normal(size=(300, 3))
    centres = poses[:, :3, :3] @ np.array([0.2, 0.1, 0.0]) + poses[:, :3, 3]
    exact = np.linalg.norm(points[:, None] - centres, axis=2) - 0.5
    near = np.abs(exact) < 0.08
    assert np.abs(moving.distances(points) - exact)[near].max() < 2e-3


def test_meshes_and_primitives_of_one_scene_are_united():
    scene = Scene((Body(icosphere()), Body(Sphere(0.2), poses=rigid(translation_m=(2.0, 0, 0)))))
    field = field_of(scene)
    assert isinstance(field, UnionField)
    np.testing.assert_allclose(field.distances(np.array([[2.0, 0.0, 0.5]]))[:, 0], 0.3, atol=1e-6)
    gradient = field.gradient(np.array([[2.0, 0.0, 0.5]]), np.ones((1, 1)))
    np.testing.assert_allclose(gradient, [[0.0, 0.0, 1.0]], atol=1e-6)


def ball(x_m=0.0, radius_m=0.3, *, inwards=False):
    made = trimesh.creation.icosphere(2, radius_m)
    made.apply_translation([x_m, 0.0, 0.0])
    if inwards:
        made.invert()
    return made


SOLIDS = {
    "a ball": [ball()],
    "a ball whose faces point inwards": [ball(inwards=True)],
    "a ball with a cavity": [ball(), ball(radius_m=0.2, inwards=True)],
    "two balls that overlap": [ball(), ball(0.2)],
    "a plate thinner than a cell": [trimesh.creation.box((0.6, 0.6, 0.004))],
    "a box on the grid's points": [trimesh.creation.box((0.4, 0.4, 0.4))],
}


@pytest.mark.parametrize("name", SOLIDS)
def test_the_inside_of_a_solid_is_where_its_winding_number_says(name):
    solid = trimesh.util.concatenate(SOLIDS[name])
    grid = grids.Grid(np.full(3, -0.52), 0.08, np.array([14, 14, 14]))
    vertices, faces, points = solid.vertices, solid.faces.astype(np.int64), grid.points()
    distance = TriangleTree(solid.triangles).distance_m(points)
    inside = grids.is_inside(points, distance, vertices, faces, grid)
    # on the surface itself the number may be anything
    off = distance > 1e-9
    np.testing.assert_array_equal(inside[off], grids.is_wound(points, vertices, faces)[off])
    assert inside.any() or name == "a plate thinner than a cell"


def test_a_cached_grid_has_the_same_bytes_and_a_damaged_one_is_built_again(tmp_path):
    grid = grids.grid_around(icosphere().bounds_m, 24, 0.1)
    first = grids.cached_distance_grids([icosphere()], grid)[0]
    (cached,) = (tmp_path / "cache" / "fields").iterdir()
    assert grids.cached_distance_grids([icosphere()], grid)[0].tobytes() == first.tobytes()
    whole = cached.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1  # still a finite number
    older = whole[: -grids.DIGEST_BYTES]  # a version before wrote no hash
    for damaged in (b"\x93NUMPY damaged", b"", whole[: len(whole) // 2], bytes(flipped), older):
        cached.write_bytes(damaged)
        assert grids.cached_distance_grids([icosphere()], grid)[0].tobytes() == first.tobytes()
        assert cached.read_bytes() == whole


def test_a_field_that_would_not_fit_is_refused_with_what_is_allowed():
    with pytest.raises(ConfigError, match="field_resolution"):
        grids.grid_around(np.array([[0.0, 0, 0], [1, 1, 1]]), 512, 0.1)


def test_plain_and_compiled_interpolation_agree_inside_and_outside():
    scenes = [Scene((Body(icosphere(0.5 - 0.02 * i, (0.03 * i, 0, 0))),)) for i in range(5)]
    compiled = field_of(*scenes)
    points = np.random.default_rng(10).uniform(-1.0, 1.0, (5000, 3))
    plain = replace(compiled, compiled=False)
    np.testing.assert_allclose(plain.distances(points), compiled.distances(points), rtol=1e-5, atol=1e-6)
