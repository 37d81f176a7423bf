"""Meshes and distance fields: files that hold none, faces that are none, surfaces without an inside, far queries."""

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
from support import references
from support.hard_cases import hard_case
from support.meshes import BOX_FACES, BOX_VERTICES, write_box

from lidardesign.config import DensitySettings
from lidardesign.density.fields import grids
from lidardesign.density.fields.distance import BodyField, TableField, build_field
from lidardesign.density.objective.surfaces import SceneTable, near_pairs
from lidardesign.density.objective.target import Target, build_target
from lidardesign.density.objective.visibility import NoVisibility, Optics
from lidardesign.errors import DataError
from lidardesign.scenes.mesh_files import SUFFIXES, check_mesh, load_mesh, signed_volume_m3, unique_rows
from lidardesign.scenes.scene import Body, Box, Capsule, Mesh, Scene, Sphere, rigid
from lidardesign.scoring.accuracy.fields import exact_distances
from lidardesign.space import DesignSpace

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
FINE_BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
RING = trimesh.creation.torus(0.4, 0.15, major_sections=24, minor_sections=12)
SOLIDS = {"box": (BOX_VERTICES, BOX_FACES), "ball": (BALL.vertices, BALL.faces), "ring": (RING.vertices, RING.faces)}
GARBAGE = {
    "empty": b"",
    "blank": b"  \n",
    "text": b"hello\nworld",
    "bytes": bytes(range(256)) * 20,
    "json": b"{}",
    "no facets": b"solid nothing\nendsolid nothing\n",
    "no triangles": bytes(84),
}
NOT_FINITE = (np.nan, np.inf, -np.inf)
AROUND = DesignSpace((-2, -2, -2, 0, -math.pi / 2, 0), (2, 2, 2, 2 * math.pi, math.pi / 2, 4))


pytestmark = pytest.mark.usefixtures("own_cache")


def field_of(*scenes, resolution=32):
    return build_field(scenes, lambda body: body.is_target, resolution=resolution, padding_m=0.1)


def mesh_of(shape):
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces))


@hard_case(
    "11",
    "A mesh file that is empty or garbage",
    done="an error that names the file and why (exit 3), for every format; a file that loads as no faces is one",
)
class TestFilesWithoutAMesh:
    @pytest.mark.parametrize("suffix", SUFFIXES)
    @pytest.mark.parametrize("content", GARBAGE.values(), ids=GARBAGE)
    def test_garbage_is_refused_with_the_name_of_the_file(self, tmp_path, suffix, content):
        write_box(tmp_path / "model.gltf")  # a good neighbour must not be read in its place
        path = tmp_path / f"bad{suffix}"
        path.write_bytes(content)
        with pytest.raises(DataError, match=f"bad\\{suffix}"):
            load_mesh(path)

    @pytest.mark.parametrize("suffix", [".glb", ".ply", ".stl"])
    def test_a_truncated_file_is_refused(self, tmp_path, suffix):
        path = write_box(tmp_path / f"cut{suffix}")
        path.write_bytes(path.read_bytes()[:-40])
        with pytest.raises(DataError, match="cut"):
            load_mesh(path)

    @pytest.mark.parametrize("name", GARBAGE)
    def test_the_program_ends_with_3_and_names_the_file(self, lidardesign, tmp_path, name):
        (tmp_path / "heads").mkdir()
        (tmp_path / "heads" / "head.stl").write_bytes(GARBAGE[name])
        result = lidardesign("learn", "meshes", "--set", "folder=heads", "--json")
        assert result.code == 3
        assert "head.stl" in result.json["error"]["where"]
        assert not (tmp_path / "runs").exists()


@hard_case(
    "12",
    "Vertices that are NaN, infinite or absurdly far; faces out of range, without area, or twice",
    done="what cannot be is refused with the file and the count; faces without area and duplicates are dropped with "
    "their counts, and what is left is the mesh without them",
)
class TestPartsOfMeshesThatAreNone:
    @pytest.mark.parametrize(
        ("vertices", "faces", "words"),
        [
            *((np.vstack([BOX_VERTICES[:7], [1, x, 1]]), BOX_FACES, "part: 1 of 8 vertices") for x in NOT_FINITE),
            *((BOX_VERTICES, np.vstack([BOX_FACES, [0, 1, x]]), "part: 1 faces name vertices that do not exist")
              for x in (-1, 8)),
            (np.zeros((0, 3)), np.zeros((0, 3), int), "part"),
            (BOX_VERTICES, np.zeros((0, 3), int), "part"),
            (BOX_VERTICES[:, :2], BOX_FACES, "part"),
            (BOX_VERTICES, BOX_FACES[:, :2], "part"),
            (BOX_VERTICES, BOX_FACES.astype(float), "part"),
            ([["a"] * 3] * 3, [[0, 1, 2]], "part"),
            (BOX_VERTICES * 0, BOX_FACES, "part"),
            (BOX_VERTICES * 1e-200, BOX_FACES, "part"),
        ],
        ids=[*map(str, NOT_FINITE), "face to -1", "face to 8",
             "nothing", "no faces", "2D", "edges", "float faces", "text", "one point", "no size"],
    )  # fmt: skip
    def test_what_is_no_mesh_is_refused_and_its_wrong_parts_are_counted(self, vertices, faces, words):
        with pytest.raises(DataError, match=words):
            check_mesh(vertices, faces, where="part")

    @pytest.mark.parametrize("scale", [1e10, 1e150, 1e308])
    def test_vertices_that_are_absurdly_far_are_refused(self, tmp_path, scale):
        with pytest.raises(DataError, match=r"box\.ply"):
            load_mesh(write_box(tmp_path / "box.ply"), scale=scale)
        with pytest.raises(DataError, match="reaches"):
            Mesh(BOX_VERTICES * scale, BOX_FACES)

    @pytest.mark.parametrize("length", [0.0, -1.0, 1e-160, 1e10, 1e300, math.nan, math.inf])
    def test_bodies_of_absurd_sizes_are_refused_by_name(self, length):
        for make in (Sphere, lambda one: Box((1.0, one, 1.0)), lambda one: Capsule(one, 1.0)):
            with pytest.raises(DataError, match="has the length"):
                make(length)
        if math.isfinite(length) and abs(length) < 1:
            with pytest.raises(DataError, match="m in size"):
                Mesh(BOX_VERTICES * min(abs(length), 1e-160), BOX_FACES)
        if not math.isfinite(length) or abs(length) > 1:
            with pytest.raises(DataError, match="body"):
                Body(Sphere(1.0), poses=rigid(translation_m=(0.0, length, 0.0)))

    def test_degenerate_and_duplicate_faces_are_dropped_with_a_count(self):
        line = len(BOX_VERTICES)
        vertices = np.vstack([BOX_VERTICES, [[0.5, 0.0, 0.0]]])
        faces = np.vstack([BOX_FACES, [(0, line, 4), (0, 0, 1)], BOX_FACES[:3, ::-1]])
        mesh = check_mesh(vertices, faces)
        assert mesh.notes == ("dropped 2 degenerate faces (without area)", "dropped 3 duplicate faces")
        assert len(mesh.faces) == len(BOX_FACES)
        assert len(mesh.vertices) == 8
        assert mesh.sign == "solid"

    @given(st.integers(0, 2**20), st.integers(0, 5), st.integers(0, 5), st.sampled_from(sorted(SOLIDS)))
    def test_what_is_left_is_the_mesh_without_them(self, seed, degenerate, twice, name):
        generator = np.random.default_rng(seed)
        vertices, faces = SOLIDS[name]
        repeated = generator.integers(len(vertices), size=(degenerate, 2))
        lines = np.column_stack([repeated, repeated[:, :1]])
        copies = np.roll(faces[generator.choice(len(faces), twice, replace=False)], generator.integers(3), axis=1)
        shuffled = generator.permutation(np.vstack([faces, lines, copies]))
        mesh, plain = check_mesh(vertices, shuffled), check_mesh(vertices, faces)
        assert len(mesh.faces) == len(plain.faces)
        assert mesh.sign == "solid"
        assert signed_volume_m3(mesh.vertices, mesh.faces) == pytest.approx(
            signed_volume_m3(plain.vertices, plain.faces), rel=1e-12
        )
        counts = {note.split()[2]: int(note.split()[1]) for note in mesh.notes}
        assert counts.get("degenerate", 0) == degenerate
        assert counts.get("duplicate", 0) == twice


def inside_by_rays(vertices, faces, points):
    """By the parity of crossings along three directions that no face of the test meshes is parallel to; they agree."""
    votes = [
        references.naive_crossings(vertices, faces, points, np.array(looking)) % 2 == 1
        for looking in ((0.3411, 0.8137, 0.4703), (-0.7213, 0.1127, 0.6833), (0.2311, -0.4177, -0.8787))
    ]
    agreed = (votes[0] == votes[1]) & (votes[1] == votes[2])
    assert agreed.mean() > 0.98
    return votes[0], agreed


def probes_of(vertices, seed=0, count=150):
    low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
    size = high - low
    return np.random.default_rng(seed).uniform(low - 0.1 * size, high + 0.1 * size, (count, 3))


@hard_case(
    "13",
    "An open mesh, or one whose faces run against each other, taken for a solid",
    done="`sign: solid` refuses it, with its defects counted; `auto` turns faces that run against their neighbours, "
    "takes the inside of a closed mesh from the absolute winding number and unsigned distances for an open one, each "
    "with a note; signs agree with the parity of ray crossings",
)
class TestMeshesWithoutAnInside:
    def test_an_open_mesh_is_unsigned_with_a_note_and_no_solid(self):
        mesh = check_mesh(BOX_VERTICES, BOX_FACES[:-2])
        assert mesh.sign == "unsigned"
        assert "4 open edges" in mesh.notes[0]
        with pytest.raises(DataError, match="cup: is not a solid: it has 4 open edges"):
            check_mesh(BOX_VERTICES, BOX_FACES[:-2], sign="solid", where="cup")

    def test_mixed_winding_is_no_solid_and_is_mended_with_a_note_otherwise(self):
        mixed = BOX_FACES.copy()
        mixed[0] = mixed[0, ::-1]
        with pytest.raises(DataError, match="tin: is not a solid: it has 3 edges between faces of opposite winding"):
            check_mesh(BOX_VERTICES, mixed, sign="solid", where="tin")
        for sign, rule in (("auto", "solid"), ("winding", "winding")):
            mesh = check_mesh(BOX_VERTICES, mixed, sign=sign)
            assert mesh.sign == rule
            assert mesh.notes == ("flipped 1 faces that were wound against their neighbours",)
            assert signed_volume_m3(mesh.vertices, mesh.faces) == pytest.approx(1.0)

    def test_a_mesh_inside_out_is_turned_with_a_note(self):
        mesh = check_mesh(BOX_VERTICES, BOX_FACES[:, ::-1], sign="solid")
        assert signed_volume_m3(mesh.vertices, mesh.faces) == pytest.approx(1.0)
        assert mesh.notes == ("the mesh was inside out: all faces were flipped",)

    @pytest.mark.parametrize("sign", ["winding", "unsigned"])
    def test_an_explicit_rule_without_an_inside_is_taken_as_it_is(self, sign):
        assert check_mesh(BOX_VERTICES, BOX_FACES[:-2], sign=sign).sign == sign

    @given(st.sampled_from(sorted(SOLIDS)), st.floats(0, 1), st.integers(0, 2**20))
    def test_faces_turned_at_random_are_turned_back(self, name, share, seed):
        vertices, faces = SOLIDS[name]
        faces = np.array(faces)
        turned = np.random.default_rng(seed).random(len(faces)) < share
        faces[turned] = faces[turned, ::-1]
        mesh, plain = check_mesh(vertices, faces), check_mesh(*SOLIDS[name])
        assert mesh.sign == "solid"
        np.testing.assert_array_equal(mesh.vertices, plain.vertices)
        # corners may begin elsewhere in a face, in the same order around it
        first = [np.roll(face, -face.argmin()).tolist() for face in mesh.faces]
        assert first == [np.roll(face, -face.argmin()).tolist() for face in plain.faces]

    @pytest.mark.parametrize("name", SOLIDS)
    @pytest.mark.parametrize("made", ["as it is", "flipped at random", "inside out"])
    def test_signs_agree_with_the_parity_of_ray_crossings(self, name, made):
        vertices, faces = SOLIDS[name]
        faces = np.array(faces)
        turned = {"as it is": 0.0, "flipped at random": 0.3, "inside out": 1.0}[made]
        chosen = np.random.default_rng(1).random(len(faces)) < turned
        faces[chosen] = faces[chosen, ::-1]
        points = probes_of(vertices)
        inside, agreed = inside_by_rays(vertices, faces, points)
        found = exact_distances([Scene((Body(check_mesh(vertices, faces)),))], points)[:, 0]
        np.testing.assert_array_equal((found < 0)[agreed], inside[agreed])

    def test_of_two_parts_one_inside_out_both_have_their_inside(self):
        vertices = np.vstack([BOX_VERTICES, BOX_VERTICES + np.array([3.0, 0, 0])])
        faces = np.vstack([BOX_FACES, BOX_FACES[:, ::-1] + 8])
        mesh = check_mesh(vertices, faces, sign="winding")
        points = probes_of(vertices, count=300)
        expected = ((points % 3 < 1) & (points > 0)).all(axis=1) & (points[:, 0] < 4) & (points[:, 1:] < 1).all(axis=1)
        found = exact_distances([Scene((Body(mesh),))], points)[:, 0] < 0
        np.testing.assert_array_equal(found, expected)
        assert expected.mean() > 0.1

    def test_a_hollow_ball_is_solid_between_its_shells(self):
        vertices = np.vstack([BALL.vertices, 0.5 * BALL.vertices])
        faces = np.vstack([BALL.faces, BALL.faces[:, ::-1] + len(BALL.vertices)])
        mesh = check_mesh(vertices, faces)
        radii = np.array([0.05, 0.2, 0.3, 0.4, 0.6])
        found = exact_distances([Scene((Body(mesh),))], radii[:, None] * [[1.0, 0, 0]])
        np.testing.assert_array_equal(found[:, 0] < 0, [False, False, True, True, False])

    def test_a_surface_with_one_side_is_unsigned_with_a_note(self):
        count = 12
        turn = np.linspace(0, 2 * math.pi, count, endpoint=False)
        # a Klein bottle as a figure eight that makes half a turn around the ring
        eight = np.linspace(0, 2 * math.pi, count, endpoint=False)
        u, v = np.meshgrid(turn, eight, indexing="ij")
        wide = 2 + np.cos(u / 2) * np.sin(v) - np.sin(u / 2) * np.sin(2 * v)
        high = np.sin(u / 2) * np.sin(v) + np.cos(u / 2) * np.sin(2 * v)
        vertices = np.stack([wide * np.cos(u), wide * np.sin(u), high], axis=-1).reshape(-1, 3)

        def at(i, j):
            # after a whole turn the figure is upside down
            return (i % count) * count + ((j if i < count else -j) % count)

        cells = [(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)) for i in range(count) for j in range(count)]
        faces = np.array([face for a, b, c, d in cells for face in ((a, b, c), (a, c, d))])
        mesh = check_mesh(vertices + 1e-3 * np.random.default_rng(0).normal(size=vertices.shape), faces)
        assert mesh.sign == "unsigned"
        assert "no outside" in mesh.notes[-1]

    @pytest.mark.parametrize("kind", ["table", "moving"])
    def test_an_open_mesh_has_no_negative_distances(self, kind):
        half = check_mesh(BALL.vertices, BALL.faces[BALL.triangles_center[:, 2] > 0])
        poses = np.stack([np.eye(4)] * 2) if kind == "moving" else np.eye(4)
        field = field_of(Scene((Body(half, poses=poses),)))
        assert isinstance(field, TableField if kind == "table" else BodyField)
        assert field.distances(np.random.default_rng(2).uniform(-0.6, 0.6, (500, 3))).min() >= 0
        assert field.shell_m[0] > 0


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


@hard_case(
    "14",
    "Libraries whose signed distance is positive inside",
    done="distances are positive outside everywhere: libraries are asked for unsigned ones and the sign is put on "
    "once; every way to ask is held to a sphere, on both sides",
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

    def test_a_mesh_that_is_wound_inwards_has_the_same_field(self):
        fields = [
            field_of(Scene((Body(check_mesh(BALL.vertices, faces)),))) for faces in (BALL.faces, BALL.faces[:, ::-1])
        ]
        np.testing.assert_array_equal(fields[0].table, fields[1].table)


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


@hard_case(
    "15",
    "A query exactly at a vertex, at the centre of a sphere, on a grid point, or far outside the grid",
    done="values and gradients are finite everywhere; outside the grid the distance is the lower bound "
    "sqrt(|p - q|^2 + d(q)^2) from the nearest grid point q, continuous at the faces and growing without end",
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

    def test_the_centre_of_a_sphere_is_its_radius_deep(self):
        field = field_of(Scene((Body(Sphere(1.0)),)))
        assert field.distances(np.zeros((1, 3)))[0, 0] == -1.0
        np.testing.assert_array_equal(field.gradient(np.zeros((1, 3)), np.ones((1, 1))), 0.0)

    def test_on_grid_points_the_value_is_the_table_s(self):
        field = field_of(Scene((Body(mesh_of(BALL)),)), resolution=16)
        found = field.distances(field.grid.points())[:, 0]
        # a point of the grid is found a rounding beside itself
        np.testing.assert_allclose(found, field.table[:, 0], atol=1e-6)
        gradient = field.gradient(field.grid.points(), np.ones((field.grid.size, 1)))
        assert np.isfinite(gradient).all()

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


@hard_case(
    "16",
    "10 million faces, 10 million queries",
    done="points are evaluated in chunks of bounded memory, each by itself: the same bits for any chunk size, order "
    "and number of threads; faces and edges are told apart by sorting numbers (10 million faces checked, cast at, made "
    "a field of and asked 10 million times: 5.0 GiB at most)",
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

    def test_a_target_of_many_columns_keeps_its_chunks_small(self):
        for count in (10, 200):
            target = build_target(many_columns(count), AROUND, DensitySettings(quadrature_points=64), "quadrature")
            assert isinstance(target, Target)
            assert target.rows_at_once * 64 * count * 4 <= 64 * 2**20
