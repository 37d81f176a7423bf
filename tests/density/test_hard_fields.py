"""Distance fields: signs of all ways to ask, queries at special and far places, very many of them."""

from __future__ import annotations

import functools
import math
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.config import DensitySettings
from lidardesign.density.fields import grids
from lidardesign.density.fields.distance import TableField, build_field
from lidardesign.density.objective.surfaces import SceneTable, near_pairs
from lidardesign.density.objective.target import Target, build_target
from lidardesign.density.objective.visibility import NoVisibility, Optics
from lidardesign.evaluation.accuracy.fields import exact_distances
from lidardesign.scenes.mesh_files import check_mesh, unique_rows
from lidardesign.scenes.scene import Body, Box, Mesh, Scene, Sphere, rigid
from lidardesign.space import DesignSpace

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
FINE_BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
AROUND = DesignSpace((-2, -2, -2, 0, -math.pi / 2, 0), (2, 2, 2, 2 * math.pi, math.pi / 2, 4))


pytestmark = pytest.mark.usefixtures("own_cache")


def field_of(*scenes, resolution=32):
    return build_field(scenes, lambda body: body.is_target, resolution=resolution, padding_m=0.1)


def mesh_of(shape):
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces))


def asked_of(name):
    """A function from points to signed distances of a ball of 0.5 m, for each way that the program has."""
    ball = Scene((Body(mesh_of(FINE_BALL)),))
    if name == "primitive":
        return lambda p: field_of(Scene((Body(Sphere(0.5)),))).distances(p)[:, 0]
    if name == "table":
        field = field_of(ball)
        return lambda p: field.distances(p)[:, 0]
    if name == "table without kernels":
        field = replace(field_of(ball), compiled=False)
        return lambda p: field.distances(p)[:, 0]
    moving = Scene((Body(mesh_of(FINE_BALL), poses=np.stack([np.eye(4)] * 2)),))
    if name == "moving":
        field = field_of(moving)
        return lambda p: field.distances(p)[:, 1]
    if name == "frames":
        bodies = build_field([moving], lambda body: True, resolution=32, padding_m=0.1).bodies
        return lambda p: near_pairs(bodies, p, np.zeros(2), 1.0, 1e9).distances[::2]
    return lambda p: exact_distances([ball], p)[:, 0]


WAYS = ("primitive", "table", "table without kernels", "moving", "frames", "exact")


@pytest.mark.hard_case(
    "14",
    "Libraries whose signed distance is positive inside",
    done="distances are positive outside everywhere: libraries are asked for unsigned ones and the sign is put on once",
)
class TestSignConventions:
    @pytest.mark.parametrize("way", WAYS)
    def test_a_sphere_is_positive_outside_and_negative_inside(self, way):
        generator = np.random.default_rng(3)
        looking = generator.normal(size=(300, 3))
        looking /= np.linalg.norm(looking, axis=1, keepdims=True)
        radius = np.concatenate([generator.uniform(0.02, 0.46, 150), generator.uniform(0.54, 3.0, 150)])
        found = asked_of(way)(radius[:, None] * looking)
        assert (found[:150] < 0).all()
        assert (found[150:] > 0).all()
        # the grid's step is 0.04 m, its answers outside are lower bounds
        near = radius < 0.58
        np.testing.assert_allclose(found[near], radius[near] - 0.5, atol=0.04)

    @pytest.mark.parametrize("way", ["table", "moving"])
    def test_gradients_lead_outwards_on_both_sides(self, way):
        poses = np.stack([np.eye(4)] * 2) if way == "moving" else np.eye(4)
        field = field_of(Scene((Body(mesh_of(FINE_BALL), poses=poses),)))
        looking = np.random.default_rng(4).normal(size=(100, 3))
        looking /= np.linalg.norm(looking, axis=1, keepdims=True)
        weights = np.zeros((100, field.columns))
        weights[:, 0] = 1.0
        # beyond the exact band distances bend; at 1 m, outside the grid, the lower bound grows away from the box
        for radius, least in ((0.3, 0.3), (0.45, 0.8), (0.55, 0.8), (1.0, 0.0)):
            outwards = np.einsum("nk,nk->n", field.gradient(radius * looking, weights), looking)
            assert (outwards > least).all()


@functools.cache
def coarse_field():
    """The field of a ball, built once for all examples of a property."""
    grid = grids.grid_around(mesh_of(BALL).bounds_m, 16, 0.1)
    return TableField(grids.distance_grid(mesh_of(BALL), grid)[:, None], grid, np.zeros(1))


SPECIAL = {
    "vertices": np.asarray(BALL.vertices),
    "middles of edges": np.asarray(BALL.vertices)[BALL.edges_unique].mean(axis=1),
    "centre": np.zeros((1, 3)),
    "far": np.array([[1e3, 0, 0], [0, -1e6, 0], [1e9, 1e9, -1e9]]),
}


@pytest.mark.hard_case(
    "15",
    "A query exactly at a vertex, at the centre of a sphere, on a grid point, or far outside the grid",
    done="values and gradients are finite everywhere",
)
class TestQueriesAtSpecialPlaces:
    @pytest.mark.parametrize("places", SPECIAL)
    @pytest.mark.parametrize("shape", ["sphere", "table", "moving"])
    def test_values_and_gradients_are_finite(self, shape, places):
        body = {
            "sphere": Body(Sphere(0.5)),
            "table": Body(mesh_of(BALL)),
            "moving": Body(mesh_of(BALL), poses=np.stack([np.eye(4)] * 2)),
        }[shape]
        field, points = field_of(Scene((body,))), SPECIAL[places]
        distances = field.distances(points)
        gradient = field.gradient(points, np.ones((len(points), field.columns)))
        assert np.isfinite(distances).all()
        assert np.isfinite(gradient).all()
        expected = np.linalg.norm(points, axis=1) - 0.5
        far = expected > 1
        assert (np.sign(distances[far]) == 1).all()
        # facets lie up to 0.012 m inside the ball, and cells of 0.02 to 0.04 m cut off the kink at its centre
        np.testing.assert_allclose(distances[~far].T, np.tile(expected[~far], (field.columns, 1)), atol=0.045)

    def test_outside_the_grid_it_is_the_closed_form_of_the_nearest_grid_place(self):
        field = field_of(Scene((Body(mesh_of(BALL)),)), resolution=16)
        high = field.grid.low + (field.grid.counts - 1) * field.grid.step
        points = np.random.default_rng(6).normal(scale=3.0, size=(300, 3))
        nearest = np.clip(points, field.grid.low, high)
        outside = (points != nearest).any(axis=1)
        inner = np.maximum(field.distances(nearest)[:, 0], 0)
        expected = np.hypot(np.linalg.norm(points - nearest, axis=1), inner)
        np.testing.assert_allclose(field.distances(points)[outside, 0], expected[outside], rtol=1e-5, atol=1e-6)

    @given(st.lists(st.floats(-1e9, 1e9), min_size=3, max_size=3), st.integers(0, 2**20))
    def test_distances_never_change_by_more_than_the_way_between_two_queries(self, place, seed):
        field = coarse_field()
        first = np.array([place])
        second = first + np.random.default_rng(seed).normal(size=(1, 3)) * 10.0 ** (seed % 12 - 9)
        apart = float(np.linalg.norm(second - first))
        change = abs(float(field.distances(first)[0, 0]) - float(field.distances(second)[0, 0]))
        # float32 rounds a distance to 6e-8 of itself; trilinear slopes reach sqrt(3) where a cell holds a medial axis
        assert change <= math.sqrt(3) * apart + 2.4e-7 * (1 + np.abs(first).max() * math.sqrt(3))

    @pytest.mark.parametrize("reach_m", [0.6, 10.0])
    def test_float32_tables_differ_from_float64_by_their_rounding_alone(self, reach_m):
        field = field_of(Scene((Body(mesh_of(BALL)),)), resolution=16)
        double = replace(field, table=field.table.astype(np.float64))
        points = np.random.default_rng(7).uniform(-reach_m, reach_m, (500, 3))
        single, reference = field.distances(points)[:, 0], double.distances(points)[:, 0]
        # eight products and sums in float32
        np.testing.assert_allclose(single, reference, rtol=1e-6, atol=1e-6 * np.abs(field.table).max())


def many_columns(count=200):
    return [Scene((Body(Sphere(0.3), poses=rigid(translation_m=(1.0 + 0.001 * i, 0, 0))),)) for i in range(count)]


@pytest.mark.hard_case(
    "16",
    "10 million faces, 10 million queries",
    done="points are evaluated in chunks of bounded memory, each by itself: the same bits for any chunk size, order "
    "and number of threads",
)
class TestManyFacesAndManyQueries:
    @pytest.mark.parametrize("way", ["off", "quadrature", "raycast"])
    @pytest.mark.parametrize("kind", ["mesh", "primitives"])
    def test_densities_have_the_same_bits_for_any_chunk_size_and_order(self, monkeypatch, kind, way):
        shape = mesh_of(BALL) if kind == "mesh" else Sphere(0.5)
        before = Body(Box((0.05, 0.1, 0.1)), "before", "occluder", rigid(translation_m=(0.8, 0, 0)))
        settings = DensitySettings(sigma_m=0.05, field_resolution=16, quadrature_points=16)
        target = build_target([Scene((Body(shape), before))], AROUND, settings, way)
        points = AROUND.sample(301, np.random.default_rng(10))
        values, gradient = target.log_density_and_gradient(points)
        assert target.log_density(points).tobytes() == values.tobytes()
        order = np.random.default_rng(11).permutation(301)
        shuffled, turned = target.log_density_and_gradient(points[order])
        assert shuffled.tobytes() == values[order].tobytes()
        assert turned.tobytes() == gradient[order].tobytes()
        for rows in (1, 7, 300):
            monkeypatch.setattr(type(target), "rows_at_once", rows)
            again, slopes = target.log_density_and_gradient(points)
            assert again.tobytes() == values.tobytes()
            assert slopes.tobytes() == gradient.tobytes()

    @pytest.mark.parametrize("way", ["quadrature", "raycast"])
    def test_threads_that_ask_at_the_same_time_get_the_same_bits(self, way):
        settings = DensitySettings(sigma_m=0.05, field_resolution=16, quadrature_points=16)
        target = build_target([Scene((Body(mesh_of(BALL)),))], AROUND, settings, way)
        points = AROUND.sample(200, np.random.default_rng(12))
        expected = target.log_density(points)
        with ThreadPoolExecutor(4) as pool:
            parts = list(pool.map(target.log_density, np.array_split(points, 4)))
        assert np.concatenate(parts).tobytes() == expected.tobytes()

    def test_fields_have_the_same_bytes_with_any_number_of_threads(self, tmp_path, monkeypatch):
        meshes = [Mesh(BALL.vertices * scale, BALL.faces) for scale in (0.8, 0.9, 1.0, 1.1)]
        grid = grids.grid_around(meshes[-1].bounds_m, 16, 0.1)
        found = []
        for workers in (1, 2, 4):
            monkeypatch.setenv("LIDARDESIGN_CACHE", str(tmp_path / str(workers)))
            found.append([one.tobytes() for one in grids.cached_distance_grids(meshes, grid, workers=workers)])
        assert found[0] == found[1] == found[2]

    @pytest.mark.parametrize("gradient", [False, True])
    @pytest.mark.parametrize("kind", ["table", "frames"])
    def test_memory_grows_by_what_is_returned_alone(self, kind, gradient):
        if kind == "table":
            grid = grids.grid_around(np.array([[-1.0, -1, -1], [1, 1, 1]]), 8, 0.0)
            table = np.random.default_rng(13).uniform(-0.1, 0.1, (grid.size, 4000)).astype(np.float32)
            field = TableField(table, grid, np.zeros(4000))
            surfaces = SceneTable(field, np.zeros(4000))
            target = Target((), surfaces, NoVisibility(), Optics(0.05, 1e3, 1e3, 0.05), AROUND)
        else:
            target = build_target(many_columns(4000), AROUND, DensitySettings(sigma_m=0.001), "off")
        ask = target.log_density_and_gradient if gradient else target.log_density
        peaks = []
        for count in (target.rows_at_once, 4 * target.rows_at_once):
            points = AROUND.sample(count, np.random.default_rng(14))
            tracemalloc.start()
            ask(points)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        # the columns of a point would be 32,000 bytes; its order along a curve, copies and the answer are 400
        assert (peaks[1] - peaks[0]) / (3 * target.rows_at_once) < 600
        assert peaks[0] < 600 * 2**20

    def test_a_check_takes_memory_in_proportion_to_the_faces(self):
        peaks = []
        for subdivisions in (4, 5):
            ball = trimesh.creation.icosphere(subdivisions=subdivisions)
            vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
            tracemalloc.start()
            check_mesh(vertices, faces)
            peaks.append(tracemalloc.get_traced_memory()[1] / len(faces))
            tracemalloc.stop()
        # ten million faces in 5 GiB
        assert max(peaks) < 500
        assert peaks[1] < 1.2 * peaks[0]

    @given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(0, 3)), min_size=1, max_size=30))
    def test_rows_are_told_apart_as_numpy_does(self, rows):
        rows = np.array(rows)
        _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        found, group = unique_rows(rows)
        np.testing.assert_array_equal(found, first)
        np.testing.assert_array_equal(group, inverse.reshape(-1))
