"""Scenes: what bodies, shapes and poses must keep to, and points sampled on them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support import references

from lidardesign.errors import DataError
from lidardesign.scenes.scene import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Mesh,
    Plane,
    Scene,
    Sphere,
    inverse_rigid,
    rigid,
)
from lidardesign.scenes.surface import sample_body, sample_triangles, surface_area_m2
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, 0, -1, 0), (0, 0, 0, 1, 1, 3))
TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


def test_an_inverse_pose_undoes_the_pose():
    poses = np.stack([rigid(r, (1.0, -2.0, 3.0)) for r in Rotation.random(5, random_state=0).as_matrix()])
    np.testing.assert_allclose(inverse_rigid(poses) @ poses, np.tile(np.eye(4), (5, 1, 1)), atol=1e-14)


BAD_BODIES = {
    "scaled": (2 * np.eye(4), "not rigid"),
    "mirrored": (MIRROR, "not rigid"),
    "projective": (np.eye(4) + np.eye(4)[[3]].T @ np.array([[0.1, 0, 0, 0]]), "not rigid"),
    "not finite": (np.full((4, 4), np.nan), "not finite"),
    "flat": (np.eye(3), r"shape \(3, 3\)"),
    "no frames": (np.zeros((0, 4, 4)), r"shape \(0, 4, 4\)"),
}


@pytest.mark.parametrize("case", BAD_BODIES)
def test_poses_that_are_not_rigid_are_refused_with_the_body(case):
    poses, message = BAD_BODIES[case]
    with pytest.raises(DataError, match=f"(?s)'lamp'.*{message}"):
        Body(Sphere(1.0), "lamp", poses=poses)


def test_an_unknown_role_is_refused():
    with pytest.raises(DataError, match="unknown role 'targets'"):
        Body(Sphere(1.0), role="targets")


@pytest.mark.parametrize("length", [0.0, -1.0, math.nan, math.inf])
def test_primitives_have_positive_finite_sizes(length):
    for build in (
        Sphere,
        lambda a: Box((1.0, a, 1.0)),
        lambda a: Capsule(a, 1.0),
        lambda a: Cylinder(1.0, a),
        lambda a: Ellipsoid((1.0, 1.0, a)),
    ):
        with pytest.raises(DataError, match="length"):
            build(length)


def test_a_capsule_without_length_is_a_sphere_but_never_negative():
    assert Capsule(1.0, 0.0).half_length_m == 0.0
    with pytest.raises(DataError, match="length"):
        Capsule(1.0, -0.1)


def test_a_scene_needs_a_target_and_one_number_of_frames():
    with pytest.raises(DataError, match="no target"):
        Scene((Body(Sphere(1.0), role="occluder"),))
    two, three = np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(DataError, match=r"\[2, 3\]"):
        Scene((Body(Sphere(1.0), poses=two), Body(Sphere(1.0), poses=three)))
    assert Scene((Body(Sphere(1.0), poses=two), Body(Sphere(1.0)))).frames == 2


def test_the_content_hash_sees_vertices_faces_and_sign():
    first = Mesh(TRIANGLE, [[0, 1, 2]])
    assert first.content_hash == Mesh(TRIANGLE.copy(), [[0, 1, 2]]).content_hash
    others = [Mesh(TRIANGLE * 2, [[0, 1, 2]]), Mesh(TRIANGLE, [[0, 2, 1]]), Mesh(TRIANGLE, [[0, 1, 2]], "unsigned")]
    assert len({first.content_hash, *(mesh.content_hash for mesh in others)}) == 4


SHAPES = {
    "sphere": (Sphere(0.7), 4 * math.pi * 0.49),
    "box": (Box((0.2, 0.5, 1.0)), 8 * (0.1 + 0.5 + 0.2)),
    "capsule": (Capsule(0.3, 0.8), 4 * math.pi * 0.3 * 1.1),
    "cylinder": (Cylinder(0.3, 0.8), 2 * math.pi * 0.3 * 1.9),
    "ellipsoid": (Ellipsoid((0.7, 0.7, 0.7)), 4 * math.pi * 0.49),
    "spheroid": (Ellipsoid((0.5, 0.5, 1.0)), 2 * math.pi * 0.5 * (0.5 + math.asin(0.75**0.5) / 0.75**0.5)),
    "plane": (Plane(), 36.0),
    "mesh": (Mesh(TRIANGLE, [[0, 1, 2]]), 0.5),
}


@pytest.mark.parametrize("name", SHAPES)
def test_surface_points_lie_on_the_surface_and_areas_are_right(name):
    shape, area = SHAPES[name]
    body = Body(shape, poses=rigid(Rotation.from_rotvec([0.4, 1.0, -0.2]).as_matrix(), (0.1, 0.2, 0.3)))
    assert surface_area_m2(body, SPACE) == pytest.approx(area)
    points = sample_body([body], SPACE, 500, np.random.default_rng(0)).points
    local = points @ inverse_rigid(body.pose())[:3, :3].T + inverse_rigid(body.pose())[:3, 3]
    assert np.abs(references.shape_distance(shape)(local)).max() < 1e-12


# Of the band |z| < height, away from caps and lids: its half height and its area by perimeter, of the spheroid by
# integrating its perimeter along its profile.
BANDS = {
    "box": (0.5, 4 * (0.2 + 0.5)),
    "capsule": (0.4, 0.8 * 2 * math.pi * 0.3),
    "cylinder": (0.4, 0.8 * 2 * math.pi * 0.3),
    "sphere": (0.35, 0.7 * 2 * math.pi * 0.7),
    "spheroid": (0.5, 2 * math.pi * 0.5 * (0.5 * (1 - 0.75 / 4) ** 0.5 + math.asin(0.75**0.5 / 2) / 0.75**0.5)),
}


@pytest.mark.parametrize("name", BANDS)
def test_surface_points_are_even_in_area(name):
    (shape, area), (height, band) = SHAPES[name], BANDS[name]
    z = sample_body([Body(shape)], SPACE, 20_000, np.random.default_rng(1)).points[:, 2]
    expected = band / area
    error = math.sqrt(expected * (1 - expected) / 20_000)
    assert abs((np.abs(z) < height).mean() - expected) < references.STANDARD_ERRORS * error


def test_bodies_share_points_by_their_area():
    bodies = [Body(Sphere(1.0)), Body(Sphere(0.5), poses=rigid(translation_m=(5, 0, 0)))]
    points = sample_body(bodies, SPACE, 20_000, np.random.default_rng(2)).points
    assert abs((points[:, 0] < 2).mean() - 0.8) < references.STANDARD_ERRORS * 0.4 / math.sqrt(20_000)


def test_triangles_are_sampled_by_area_in_order_and_a_flat_one_does_not_harm():
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 2]])
    faces = np.array([[0, 1, 2], [0, 3, 4], [0, 2, 3]])
    _, chosen = sample_triangles(vertices, faces, 4000, np.random.default_rng(3))
    assert (np.diff(chosen) >= 0).all()
    shares = np.bincount(chosen, minlength=3) / 4000
    # stratified along the cumulated area: off by at most one point
    np.testing.assert_allclose(shares, [0.75, 0.0, 0.25], atol=1 / 4000)


def test_a_moved_mesh_keeps_its_area_and_its_bounds_move():
    mesh = Mesh(*(lambda m: (m.vertices, m.faces))(trimesh.creation.box((1, 2, 3))))
    moved = mesh.transformed(rigid(translation_m=(1, 1, 1)))
    np.testing.assert_allclose(moved.bounds_m, mesh.bounds_m + 1)
    assert surface_area_m2(Body(moved), SPACE) == pytest.approx(22.0)
