"""Distances, reconstructions and visible surfaces, against closed forms and naive twins."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from support.triangles import naive_triangle_distance_m

from lidardesign.errors import DataError
from lidardesign.scenes.scene import Body, Box, Mesh, Scene, Sphere, rigid
from lidardesign.scoring.metrics import (
    chamfer_m,
    delaunay_surface,
    nearest_m,
    ray_spacing,
    surface_cloud,
    visible_surface,
)
from lidardesign.space import DesignSpace, angles

STANDARD_ERRORS = 4  # the tolerance of every sampled mean below
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])


def generator(seed=0):
    return np.random.default_rng(seed)


def looking_along_minus_x(distance=2.0, half_angle=0.6, reach=5.0, box=0.0):
    return DesignSpace(
        (distance - box, -box, -box, math.pi - half_angle, -half_angle, 0.0),
        (distance + box, box, box, math.pi + half_angle, half_angle, reach),
    )


def naive_chamfer(first, second):
    pairs = np.linalg.norm(first[:, None] - second[None], axis=2)
    return pairs.min(axis=1).mean() + pairs.min(axis=0).mean()


@pytest.mark.parametrize("dimension", [2, 3])
def test_chamfer_equals_all_pairs_and_is_symmetric(dimension):
    first, second = generator(1).normal(size=(40, dimension)), generator(2).normal(size=(70, dimension))
    assert chamfer_m(first, second) == pytest.approx(naive_chamfer(first, second), rel=1e-12)
    assert chamfer_m(first, second) == pytest.approx(chamfer_m(second, first), rel=1e-12)
    assert chamfer_m(first, first) == 0
    assert chamfer_m(1000 * first, 1000 * second) == pytest.approx(1000 * chamfer_m(first, second), rel=1e-12)


def test_a_surface_is_all_of_its_triangles_not_only_those_that_points_lie_on():
    corners = generator(3).normal(size=(40, 3, 3))
    cloud = surface_cloud(corners.reshape(-1, 3), np.arange(120).reshape(-1, 3), 10, generator())
    assert cloud.triangles.shape == (40, 3, 3)
    queries = 2 * generator(4).normal(size=(200, 3))
    np.testing.assert_allclose(cloud.distance_m(queries), naive_triangle_distance_m(queries, corners), atol=1e-12)


def test_a_visible_surface_has_each_triangle_with_a_visible_point_once():
    steps = np.linspace(-0.5, 0.5, 5)
    y, z = (values.ravel() for values in np.meshgrid(steps, steps, indexing="ij"))
    first = (np.arange(4)[:, None] * 5 + np.arange(4)).ravel()
    faces = np.concatenate([first[:, None] + [0, 5, 1], first[:, None] + [6, 1, 5]])
    wall = Mesh(np.column_stack([np.zeros(25), y, z]), faces, "unsigned")
    half = Body(Box((0.01, 0.5, 1.0)), "plate", "occluder", rigid(translation_m=(1.0, 0.5, 0.0)))
    seen = visible_surface(Scene((Body(wall), half)), looking_along_minus_x(), 2000, generator())
    assert len(np.unique(seen.triangles.reshape(-1, 9), axis=0)) == len(seen.triangles) == 16
    assert seen.triangles[:, :, 1].max() == pytest.approx(0.0)
    np.testing.assert_allclose(seen.distance_m(seen.points), 0.0, atol=1e-12)


def test_two_samplings_of_one_surface_have_no_distance():
    first, second = (surface_cloud(*SQUARE, 300, generator(seed)) for seed in (1, 2))
    np.testing.assert_allclose(first.distance_m(second.points), 0.0, atol=1e-12)
    np.testing.assert_allclose(first.distance_m(second.points + np.array([0, 0, 0.1])), 0.1, atol=1e-12)


def test_one_place_in_a_thousand_is_further_from_all_points_than_their_gap():
    corners, faces = SQUARE
    cloud = surface_cloud(2 * corners, faces, 5000, generator(3))
    places = np.column_stack([generator(4).uniform(0.2, 1.8, (40_000, 2)), np.zeros(40_000)])
    beyond = (nearest_m(cloud.points, places) > cloud.gap_m).mean()
    # some 20 places of one gap are beyond together, so that the share has a standard error of about 0.0003
    assert beyond == pytest.approx(0.001, abs=0.001)


def test_the_reconstruction_does_not_depend_on_the_order_of_returns():
    _, points = plane_of_rays(7)
    vertices, faces = delaunay_surface(points, np.zeros(3))
    for seed in range(3):
        again_vertices, again_faces = delaunay_surface(generator(seed).permutation(points), np.zeros(3))
        np.testing.assert_array_equal(vertices, again_vertices)
        np.testing.assert_array_equal(faces, again_faces)


def test_the_triangles_of_returns_tile_what_was_seen():
    inside = generator(4).uniform(-0.5, 0.5, (60, 2))
    places = np.vstack([inside, list(itertools.product((-0.6, 0.6), repeat=2))])
    # all on the plane x = 1, whose outermost returns are the corners of a square
    assert area_through(np.column_stack([np.ones(64), places]), None) == pytest.approx(1.44)


def test_every_triangle_is_delaunay_on_the_sphere_even_over_more_than_half_a_turn():
    directions = generator(5).normal(size=(60, 3)) + np.array([0.8, 0.0, 0.0])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    vertices, faces = delaunay_surface(directions, np.zeros(3))
    for a, b, c in vertices[faces]:
        normal = np.cross(b - a, c - a)
        side = (vertices - a) @ normal / np.linalg.norm(normal)
        inside = (side > 1e-9).any() and (side < -1e-9).any()
        assert not inside, "a return lies inside the circle of three others"


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.array([[1.0, 0, 0], [1, 1, 0]]),
        np.array([[1.0, 0, 0]] * 5),
        np.array([[1.0, y, 0] for y in (-0.2, 0.0, 0.1, 0.3)]),
        np.array([[r, 0.0, 0.0] for r in (1.0, 2.0, 3.0, 4.0)]),
        np.zeros((4, 3)),
    ],
    ids=["none", "two", "one place", "a line", "one direction", "at the viewpoint"],
)
def test_returns_that_span_no_surface_give_none(points):
    assert delaunay_surface(points, np.zeros(3)) is None


def test_triangles_that_bridge_a_depth_step_can_be_left_out():
    _, points = plane_of_rays()
    points = points * np.where(points[:, 1:2] < 0.01, 1.0, 2.0)
    vertices, faces = delaunay_surface(points, np.zeros(3), steepest_deg=80)
    spans = np.ptp(vertices[faces][:, :, 0], axis=1)
    assert spans.max() == 0
    everything, all_faces = delaunay_surface(points, np.zeros(3))
    assert len(all_faces) > len(faces)
    assert np.ptp(everything[all_faces][:, :, 0], axis=1).max() == 1


def plane_of_rays(side=13):
    """Rays on a grid of slopes, and what each meets on the plane x = 1."""
    y, z = np.meshgrid(np.linspace(-0.3, 0.3, side), np.linspace(-0.3, 0.3, side))
    points = np.column_stack([np.ones(side**2), y.ravel(), z.ravel()])
    return points / np.linalg.norm(points, axis=1, keepdims=True), points


def area_through(points, spacing):
    vertices, faces = delaunay_surface(points, np.zeros(3), spacing=spacing)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def test_where_rays_side_by_side_saw_nothing_there_is_no_surface():
    directions, points = plane_of_rays()
    seen = np.abs(points[:, 1]) > 0.12  # five columns of rays in the middle pass through
    beside = 2 * 0.15 * 0.6
    assert area_through(points[seen], ray_spacing(directions)[seen]) == pytest.approx(beside)
    assert area_through(points[seen], None) == pytest.approx(0.36), "without the rays that saw nothing it is bridged"


@pytest.mark.parametrize("aspect", [1, 6, 10, 16])
def test_a_plane_seen_by_rings_of_rays_is_whole_although_rings_are_far_apart(aspect):
    azimuth, elevation = np.meshgrid(np.arange(12 * aspect) * 0.004, np.arange(8) * 0.004 * aspect)
    rays = np.stack([np.ones(azimuth.size), np.tan(azimuth.ravel() - 0.1), np.tan(elevation.ravel() - 0.1)], axis=1)
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    whole = area_through(rays, None)
    assert area_through(rays, ray_spacing(directions)) > 0.95 * whole


def test_rays_that_look_at_nearly_the_same_points_do_not_cut_the_surface():
    _, points = plane_of_rays()
    steps = np.pad(generator(1).normal(0, 1e-6, (8, 2)), ((0, 0), (1, 0)))
    moved = (points[None] + steps[:, None]).reshape(-1, 3)
    seen = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    assert area_through(moved, ray_spacing(seen)) == pytest.approx(0.36, rel=0.01)


def test_a_single_lost_ray_leaves_no_hole():
    directions, points = plane_of_rays()
    seen = np.ones(169, dtype=bool)
    seen[[84, 30, 100]] = False
    assert area_through(points[seen], ray_spacing(directions)[seen]) == pytest.approx(0.36)


def test_the_spacing_of_rays_is_that_of_their_grid_and_of_different_directions_alone():
    steps = np.linspace(-0.1, 0.1, 21)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    directions = np.column_stack([np.sqrt(1 - (grid**2).sum(axis=1)), grid])
    inside = (np.abs(grid) < 0.06).all(axis=1)
    # four at one step and up to four at its diagonal, two on average
    spacing = ray_spacing(directions)[inside]
    assert ((spacing > 0.0099) & (spacing < 0.01 * (1 + math.sqrt(2)) / 2 * 1.02)).all()
    assert spacing.mean() == pytest.approx(0.01 * (4 + 2 * math.sqrt(2)) / 6, rel=0.03)
    twice = np.concatenate([directions, directions])
    np.testing.assert_array_equal(ray_spacing(twice)[:441], ray_spacing(directions))
    assert np.isinf(ray_spacing(directions[:1])).all()


def test_the_visible_part_of_a_sphere_is_the_cap_that_faces_the_sensor():
    scene = Scene((Body(Sphere(0.5)),))
    points = visible_surface(scene, looking_along_minus_x(), 2000, generator()).points
    lowest = 0.5**2 / 2.0  # x of the horizon seen from 2 m
    assert points.shape == (2000, 3)
    assert points[:, 0].min() >= lowest - 1e-3
    # area on a sphere is uniform in x (Archimedes)
    error = STANDARD_ERRORS * (0.5 - lowest) / math.sqrt(12 * 2000)
    assert abs(points[:, 0].mean() - (lowest + 0.5) / 2) < error
    # a free origin sees more than a fixed one
    wide = visible_surface(scene, looking_along_minus_x(box=1.0, half_angle=1.2), 3000, generator()).points
    assert wide[:, 0].min() < 0.0


def test_angles_and_range_of_the_space_bound_what_counts_as_visible():
    scene = Scene((Body(Box((0.1, 2.0, 2.0))),))
    points = visible_surface(scene, looking_along_minus_x(half_angle=0.3), 500, generator()).points
    azimuth, elevation = angles(points - np.array([2.0, 0.0, 0.0]))
    assert np.abs(azimuth - math.pi).max() <= 0.3
    assert np.abs(elevation).max() <= 0.3
    with pytest.raises(DataError, match="no ray of the design space sees"):
        visible_surface(scene, looking_along_minus_x(reach=1.8), 100, generator())


def test_what_an_occluder_hides_is_not_visible():
    plate = Body(Box((0.01, 0.5, 1.0)), "plate", "occluder", rigid(translation_m=(1.0, 0.5, 0.0)))
    points = visible_surface(Scene((Body(Sphere(0.5)), plate)), looking_along_minus_x(), 500, generator()).points
    assert points[:, 1].max() < 0.01
    hidden = Body(Box((0.01, 2.0, 2.0)), "wall", "occluder", rigid(translation_m=(1.0, 0.0, 0.0)))
    with pytest.raises(DataError, match="no ray of the design space sees"):
        visible_surface(Scene((Body(Sphere(0.5)), hidden)), looking_along_minus_x(), 100, generator())


def test_a_mesh_in_a_pose_is_seen_where_the_pose_puts_it():
    square = Mesh(np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2]]), "unsigned")
    scene = Scene((Body(square, poses=rigid(translation_m=(0.5, -0.2, 0.1))),))
    points = visible_surface(scene, looking_along_minus_x(half_angle=1.0), 400, generator()).points
    np.testing.assert_allclose(points[:, 0], 0.5, atol=1e-12)
    assert points[:, 1].min() >= -0.2
    assert points[:, 2].min() >= 0.1
