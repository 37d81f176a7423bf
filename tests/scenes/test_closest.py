"""Distances to the nearest triangle against all pairs, on triangles and places of every kind."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from support.triangles import naive_triangle_distance_m

from lidardesign.scenes.distances import TriangleTree

NANOMETRE = 1e-9


def generator(seed=0):
    return np.random.default_rng(seed)


def corners(count, size_m=1.0, seed=0):
    """Triangles of one size at random places of the unit cube."""
    random = generator(seed)
    return random.uniform(size=(count, 1, 3)) + size_m * random.normal(size=(count, 3, 3))


def flattened(share):
    """Triangles whose third corner is so many of their lengths off the line through the others."""
    a, b, c = np.moveaxis(corners(60, 0.3, seed=4), 1, 0)
    along = a + generator(5).uniform(-0.5, 1.5, (60, 1)) * (b - a)
    return np.stack([a, b, along + share * (c - along)], axis=1)


def diagonal_segments():
    """Three corners on one line, along which what is left of a height is rounding that points along it."""
    lines = np.repeat([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [1.0, 2.0, 0.0], [1.0, 2.0, 4.0]], 40, axis=0)
    return lines[:, None] * np.round(generator(7).uniform(size=(160, 3, 1)), 2)


SUBJECTS = {
    "one": corners(1),
    "two": corners(2),
    "many": corners(150, 0.2),
    "small": corners(150, 1e-4),
    "smallest": corners(150, 1e-9),
    "huge and tiny": np.concatenate([corners(40, 10.0**power, seed=6 + power) for power in range(-6, 2)]),
    "a ball": trimesh.creation.icosphere(2).triangles,  # of shared corners and edges
    "the same twice": np.repeat(corners(60, 0.2), 2, axis=0),
    "the same many times": np.repeat(corners(1), 100, axis=0),
    "points": np.repeat(generator(1).uniform(size=(100, 1, 3)), 3, axis=1),
    "segments": corners(60, 0.3)[:, [0, 1, 1]],
    "segments of three corners": flattened(0.0),
    "segments along diagonals": diagonal_segments(),
    "needles": flattened(1e-6),
    "needles of a nanometre": flattened(1e-9),
    "needles below rounding": flattened(1e-13),
    "far from the origin": corners(100, 0.2) + np.array([1000.0, -2000.0, 500.0]),
    "in one plane": corners(100, 0.2) * np.array([1.0, 1.0, 0.0]),
}


def places(triangles):
    """Points around triangles, on their corners, edges and insides, beside those by little, and far away."""
    random = generator(2)
    chosen = triangles[random.integers(len(triangles), size=30)]
    weights = random.dirichlet([1, 1, 1], size=30)
    edge = np.where(np.arange(3) == random.integers(3, size=(30, 1)), 0.0, weights)
    edge /= edge.sum(axis=1, keepdims=True)
    inside, on_edges = (np.einsum("nk,nkd->nd", share, chosen) for share in (weights, edge))
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    around = random.uniform(low - 0.3 * (high - low), high + 0.3 * (high - low), (60, 3))
    beside = [inside + step * random.normal(size=(30, 3)) for step in (1e-10, 1e-6, 1e-2)]
    far = high + 100 * random.normal(size=(10, 3))
    return np.concatenate([around, chosen[:, 0], chosen[:, 2], on_edges, inside, *beside, far])


@pytest.mark.parametrize("name", SUBJECTS)
def test_the_distance_is_that_of_the_nearest_of_all_pairs(name):
    triangles = SUBJECTS[name]
    points = places(triangles)
    found = TriangleTree(triangles).distance_m(points)
    np.testing.assert_allclose(found, naive_triangle_distance_m(points, triangles), rtol=0, atol=NANOMETRE)


@pytest.mark.parametrize("name", SUBJECTS)
def test_the_nearest_place_is_on_its_triangle_and_as_far_away_as_is_said(name):
    triangles = SUBJECTS[name]
    points = places(triangles)
    tree = TriangleTree(triangles)
    distance, nearest, place = tree.closest(points)
    np.testing.assert_array_equal(distance, tree.distance_m(points))
    np.testing.assert_allclose(np.linalg.norm(points - place, axis=1), distance, rtol=0, atol=NANOMETRE)
    for one, own in zip(place, triangles[nearest], strict=True):
        assert naive_triangle_distance_m(one[None], own[None]) <= NANOMETRE


@pytest.mark.parametrize("name", SUBJECTS)
def test_what_is_further_than_the_limit_is_not_found_and_the_rest_is_as_without(name):
    triangles = SUBJECTS[name]
    points = places(triangles)
    tree = TriangleTree(triangles)
    whole = tree.closest(points)
    limit_m = float(np.median(whole[0]))
    found = tree.closest(points, limit_m)
    within = whole[0] < limit_m
    for part, one, missing in zip(found, whole, (np.inf, -1, np.nan), strict=True):
        np.testing.assert_array_equal(part[within], one[within])
        np.testing.assert_array_equal(part[~within], np.full_like(part[~within], missing))


@pytest.mark.parametrize("name", SUBJECTS)
def test_neither_the_order_of_triangles_corners_and_points_nor_rigid_motion_changes_a_distance(name):
    triangles, random = SUBJECTS[name], generator(3)
    points = places(triangles)
    found = TriangleTree(triangles).distance_m(points)
    order = random.permutation(len(points))
    np.testing.assert_array_equal(TriangleTree(triangles).distance_m(points[order]), found[order])
    shuffled = random.permutation(triangles)[:, random.permutation(3)]
    np.testing.assert_allclose(TriangleTree(shuffled).distance_m(points), found, rtol=0, atol=NANOMETRE)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    moved = TriangleTree(triangles @ turn + 0.5).distance_m(points @ turn + 0.5)
    np.testing.assert_allclose(moved, found, rtol=0, atol=NANOMETRE)


def test_no_point_has_no_distance():
    assert TriangleTree(SUBJECTS["many"]).distance_m(np.zeros((0, 3))).shape == (0,)
