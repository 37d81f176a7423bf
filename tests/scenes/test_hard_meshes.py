"""Meshes: files that hold none, faces that are none, surfaces without an inside."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from support import references
from support.meshes import BOX_FACES, BOX_VERTICES, write_box

from lidardesign.density.fields.distance import BodyField, TableField, build_field
from lidardesign.errors import DataError
from lidardesign.evaluation.accuracy.fields import exact_distances
from lidardesign.scenes.mesh_files import SUFFIXES, check_mesh, load_mesh, signed_volume_m3
from lidardesign.scenes.scene import Body, Mesh, Scene, Sphere, rigid

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
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


def field_of(*scenes, resolution=32):
    return build_field(scenes, lambda body: body.is_target, resolution=resolution, padding_m=0.1)


def mesh_of(shape):
    return Mesh(np.asarray(shape.vertices), np.asarray(shape.faces))


@pytest.mark.hard_case(
    "11",
    "A mesh file that is empty or garbage",
    done="an error that names the file and why (exit 3), for every format",
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


@pytest.mark.hard_case(
    "12",
    "Vertices that are NaN, infinite or absurdly far; faces out of range, without area, or twice",
    done="what cannot be is refused with the file and the count",
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

    @pytest.mark.parametrize("scale", [1e10, 1e308])
    def test_vertices_and_bodies_that_are_absurdly_far_or_large_are_refused(self, tmp_path, scale):
        with pytest.raises(DataError, match=r"box\.ply"):
            load_mesh(write_box(tmp_path / "box.ply"), scale=scale)
        with pytest.raises(DataError, match="reaches"):
            Mesh(BOX_VERTICES * scale, BOX_FACES)
        with pytest.raises(DataError, match="has the length"):
            Sphere(scale)
        with pytest.raises(DataError, match="body"):
            Body(Sphere(1.0), poses=rigid(translation_m=(0.0, scale, 0.0)))

    def test_bodies_that_are_absurdly_small_are_refused(self):
        with pytest.raises(DataError, match="has the length"):
            Sphere(1e-160)
        with pytest.raises(DataError, match="m in size"):
            Mesh(BOX_VERTICES * 1e-160, BOX_FACES)

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


@pytest.mark.hard_case(
    "13",
    "An open mesh, or one whose faces run against each other, taken for a solid",
    done="`sign: solid` refuses it, with its defects counted",
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
        # the projective plane of six vertices: closed, and no way to wind its faces
        faces = [(0, one, other) for one, other in ((1, 2), (2, 3), (3, 4), (4, 5), (5, 1))]
        faces += [(1, 2, 4), (2, 3, 5), (3, 4, 1), (4, 5, 2), (5, 1, 3)]
        mesh = check_mesh(np.random.default_rng(0).normal(size=(6, 3)), np.array(faces))
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
