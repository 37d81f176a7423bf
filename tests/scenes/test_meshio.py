"""Mesh files: what loads is clean, what cannot be used is refused by name, nothing is mended in silence."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.meshes import BOX_FACES, BOX_VERTICES, write_box

from lidardesign.errors import DataError
from lidardesign.scenes.mesh_files import (
    SUFFIXES,
    check_mesh,
    edge_defects,
    list_mesh_files,
    load_mesh,
    signed_volume_m3,
)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_closed_box_comes_back_from_every_format_as_a_solid(tmp_path, suffix):
    mesh = load_mesh(write_box(tmp_path / f"box{suffix}"))
    assert mesh.sign == "solid"
    assert mesh.notes == ()
    assert len(mesh.vertices) == 8
    assert signed_volume_m3(mesh.vertices, mesh.faces) == pytest.approx(1.0)


def test_the_scale_turns_millimetres_into_metres(tmp_path):
    mesh = load_mesh(write_box(tmp_path / "box.ply"), scale=0.001)
    np.testing.assert_allclose(mesh.bounds_m, [[0, 0, 0], [0.001] * 3])


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_a_scale_that_is_no_factor_is_refused(tmp_path, scale):
    with pytest.raises(DataError, match="scale"):
        load_mesh(write_box(tmp_path / "box.ply"), scale=scale)


def test_a_missing_file_and_an_unknown_suffix_are_refused(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        load_mesh(tmp_path / "nowhere.stl")
    (tmp_path / "box.dat").write_text("v 0 0 0")
    with pytest.raises(DataError, match="suffix"):
        load_mesh(tmp_path / "box.dat")


def test_a_gltf_cannot_reach_outside_its_folder(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    path = write_box(inside / "box.gltf")
    buffer = inside / "gltf_buffer_0.bin"
    buffer.rename(tmp_path / "secret.bin")
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = "../secret.bin"
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match="outside its folder"):
        load_mesh(path)


def test_the_parts_of_a_scene_stay_in_their_places(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.Trimesh(BOX_VERTICES, BOX_FACES, process=False)
    moved = np.eye(4)
    moved[0, 3] = 5.0
    scene = trimesh.Scene([box])
    scene.add_geometry(box.copy(), transform=moved)
    (tmp_path / "two.glb").write_bytes(scene.export(file_type="glb"))
    mesh = load_mesh(tmp_path / "two.glb")
    np.testing.assert_allclose(mesh.bounds_m, [[0, 0, 0], [6, 1, 1]], atol=1e-6)
    assert len(mesh.faces) == 24


def test_two_boxes_that_share_an_edge_are_closed():
    faces = np.vstack([BOX_FACES, BOX_FACES + 8])
    mesh = check_mesh(np.vstack([BOX_VERTICES, BOX_VERTICES + np.array([1.0, 1.0, 0.0])]), faces)
    assert mesh.sign == "solid"
    assert edge_defects(mesh.faces) == (0, 0)


OTHERS = {
    "a scan": (("readme.txt", "scan.LAS"), "scan.LAS is a point cloud", "Poisson surface reconstruction"),
    "a table": (("points.csv", "._mesh.ply"), "points.csv is at most a point cloud", "Poisson"),
    "a scene": (("model.fbx", "z.npz"), "model.fbx is a 3D scene", "GLB"),
    "an archive": (("mesh.stl.gz",), "mesh.stl.gz is an archive", "unpack"),
    "meshes further in": (("inside/box.stl",), "inside/box.stl is in a folder inside", "name that folder"),
    "nothing": ((".DS_Store", "Thumbs.db"), "holds no mesh file", ""),
}


@pytest.mark.parametrize(("names", "found", "hint"), OTHERS.values(), ids=OTHERS)
def test_a_folder_without_meshes_says_what_it_holds_instead_and_what_to_do(tmp_path, names, found, hint):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    with pytest.raises(DataError) as refused:
        list_mesh_files(tmp_path)
    assert found in refused.value.message
    assert hint in (refused.value.hint or "")


def test_a_folder_lists_its_meshes_by_name_and_an_empty_one_is_refused(tmp_path):
    with pytest.raises(DataError, match="holds no mesh file"):
        list_mesh_files(tmp_path)
    for name in ("b.stl", "a.PLY", ".hidden.stl", "notes.txt"):
        (tmp_path / name).write_text("x")
    assert [path.name for path in list_mesh_files(tmp_path)] == ["a.PLY", "b.stl"]
    with pytest.raises(DataError, match="is not a folder"):
        list_mesh_files(tmp_path / "a.PLY")
