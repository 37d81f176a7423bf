"""Mesh files that name or promise what they lack are refused with the place; what is legal is read."""

from __future__ import annotations

import base64
import copy
import json
import struct
import time

import numpy as np
import pytest
from support.meshes import BOX_FACES, BOX_VERTICES, write_box

from lidardesign.errors import DataError
from lidardesign.scenes.mesh_files import load_mesh
from lidardesign.scenes.mesh_formats import read_off

POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
OFF_POINTS = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
PLY = (
    "ply\nformat {format} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)
PLY_FACES = "3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
FACET = "facet normal 0 0 0\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 {z}\nendloop\nendfacet\n"


def ply(vertices=4, faces=4, points=OFF_POINTS, indices=PLY_FACES):
    return PLY.format(format="ascii", vertices=vertices, faces=faces) + points + indices


def binary_ply(indices, vertices=4, faces=None, sizes=None):
    head = PLY.format(format="binary_little_endian", vertices=vertices, faces=len(indices) if faces is None else faces)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4").tobytes()
    sizes = sizes or [3] * len(indices)
    return head.encode() + points + b"".join(
        struct.pack("<B3i", size, *face) for size, face in zip(sizes, indices, strict=True)
    )  # fmt: skip


TEXTS = {
    "obj index 0": ("obj", POINTS + "f 0 1 2\n" + FACES, r"vertex 0.*\n.*1 to 4|:5: a face names vertex 0"),
    "obj index 0 of quads": ("obj", POINTS + FACES + "f 0 1 2 3\n", ":9: a face names vertex 0"),
    "obj index beyond": ("obj", POINTS + FACES + "f 1 2 5\n", ":9: a face names vertex 5"),
    "obj index far beyond": ("obj", POINTS + "f 1 2 99999999999999999999\n", ":5: "),
    "obj negative beyond the start": ("obj", POINTS + "f -1 -2 -5\n", ":5: a face names vertex -5"),
    "obj texture 0": ("obj", POINTS + "vt 0 0\nf 1/0 2/1 3/1\n", ":6: a face names texture coordinate 0"),
    "obj texture beyond": ("obj", POINTS + "vt 0 0\nf 1/1 2/1 3/2\n", ":6: a face names texture coordinate 2"),
    "obj normal beyond": ("obj", POINTS + "vn 0 0 1\nf 1//1 2//1 3//2\n", ":6: a face names normal 2"),
    "obj broken corner": ("obj", POINTS + "f 1 2 3x\n" + FACES, ":5: a corner of the face is '3x'"),
    "obj slash first": ("obj", POINTS + "f /1 2 3\n", ":5: a corner of the face is '/1'"),
    "obj sign behind": ("obj", POINTS + "f 1- 2 3\n", ":5: a corner of the face is '1-'"),
    "obj line ends of printers": ("obj", POINTS + "f 1\v2\f9\n", ":5: a face names vertex 9"),
    "obj two corners": ("obj", POINTS + FACES + "f 1 2\n", ":9: has 2 values"),
    "obj nan": ("obj", POINTS.replace("1 0 0", "nan 0 0") + FACES, ":2: the vertex is 'nan 0 0'"),
    "obj two coordinates": ("obj", POINTS.replace("1 0 0", "1 0") + FACES, ":2: has 2 values"),
    "obj of points": ("obj", POINTS, "has 4 points and no faces: it is a point cloud"),
    "off of points": ("off", "OFF\n4 0 0\n" + OFF_POINTS, "it is a point cloud"),
    "ply of points": ("ply", ply(faces=0, indices=""), "it is a point cloud"),
    "ply of points alone": ("ply", ply(indices="").partition("element f")[0] + "end_header\n" + OFF_POINTS, "cloud"),
    "ply of strips": ("ply", ply(faces=1).replace("element face", "element tristrips"), ":7: has triangle strips"),
    "obj of nothing": ("obj", "# no mesh\n", "has no faces"),
    "a pointer": ("stl", "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "pointer of Git LFS"),
    "obj without vertices": ("obj", FACES, ":1: a face names vertex 1"),
    "obj of a long line": ("obj", POINTS + FACES + "f " + "1 2 3 " * 100_000, ":9: has a line of 600001 characters"),
    "obj of long blanks": ("obj", POINTS + "f 0 1 2" + " " * 200_000, ":5: a face names vertex 0"),
    "obj of blanks": ("obj", POINTS + (" " * 9000 + "x\n") * 1000 + "f 0 1 2\n", ":1005: a face names vertex 0"),
    "obj of backslashes": ("obj", POINTS + "\\" * 200_000, ":5: has a line of"),
    "off of a long line": ("off", "OFF 1 1 0 " + "1 " * 100_000, ":1: has a line of"),
    "stl of a long line": ("stl", "solid\nvertex " + "1 " * 100_000, ":2: has a line of"),
    "ply of many lines": ("ply", ply(indices=PLY_FACES + "\n" * 5_000_001), "too many lines"),
    "ply of many properties": ("ply", ply().replace("element f", "property float p\n" * 9000 + "element f"), "header"),
    "obj of many lines": ("obj", POINTS + "\n" * 5_000_001, "too many lines"),
    "off index beyond": ("off", "OFF\n4 1 0\n" + OFF_POINTS + "3 0 1 4\n", ":7: a face names vertex 4"),
    "off more faces than lines": ("off", "OFF\n4 9 0\n" + OFF_POINTS + "3 0 1 2\n", ":2: promises 4 vertices and 9"),
    "off more vertices than lines": ("off", "OFF\n4000000000 1 0\n" + OFF_POINTS, ":2: promises 4000000000 vertices"),
    "off negative count": ("off", "OFF\n-4 1 0\n" + OFF_POINTS, ":2: has no counts"),
    "off count of many digits": ("off", "OFF\n" + "9" * 5000 + " 1 0\n" + OFF_POINTS, ":2: has no counts"),
    "off face of fewer indices": ("off", "OFF\n4 1 0\n" + OFF_POINTS + "4 0 1 2\n", ":7: the face is '4 0 1 2'"),
    "off nan": ("off", "OFF\n4 1 0\n" + OFF_POINTS.replace("1 0 0", "nan 0 0") + "3 0 1 2\n", ":4: the vertex is"),
    "obj cut short in a line": ("obj", POINTS + FACES + "f 1 \\\n2 3 \\", ":9: a corner of the face is"),
    "off empty": ("off", "OFF\n", "counts|lines"),
    "off of nothing": ("off", "\n\n#\n", "not an OFF text file"),
    "ply index beyond": ("ply", ply(indices="3 0 1 4\n" * 4), "triangle 0 of 4 names the vertices 0, 1, 4"),
    "ply index negative": ("ply", ply(indices="3 0 1 -1\n" * 4), "triangle 0 of 4 names the vertices 0, 1, -1"),
    "ply more vertices than lines": ("ply", ply(vertices=4_000_000_000), "promises 4000000004 elements"),
    "ply more faces than lines": ("ply", ply(faces=5), "promises 9 elements, and has 9 lines|promises 9 elements"),
    "ply negative count": ("ply", ply(vertices=-4), ":3: is not a count of elements"),
    "ply count of many digits": ("ply", ply(vertices="9" * 5000), ":3: is not a count of elements"),
    "ply nan": ("ply", ply(points=OFF_POINTS.replace("1 0 0", "nan 0 0")), "NaN or infinite"),
    "ply without header": ("ply", "ply\nformat ascii 1.0\n", "no header"),
    "binary ply index beyond": ("ply", binary_ply([(0, 1, 4)]), "triangle 0 of 1 names the vertices 0, 1, 4"),
    "binary ply index negative": ("ply", binary_ply([(0, 1, -1)]), "triangle 0 of 1 names the vertices 0, 1, -1"),
    "binary ply of more": ("ply", binary_ply([(0, 1, 2)], vertices=4_000_000_000), "promises 4000000001 elements"),
    "binary ply of mixed faces": ("ply", binary_ply([(0, 1, 2), (0, 1, 3)], sizes=[3, 2]), "faces of several sizes"),
    "stl nan": ("stl", "solid\n" + FACET.format(z="nan") + "endsolid\n", ":6: the vertex is"),
    "stl of two corners": (
        "stl", "solid\n" + FACET.format(z=0).replace("vertex 0 0 0\n", "") + "endsolid\n", ":7: a facet does not",
    ),
    "stl of broken corners": ("stl", "solid\n" + FACET.replace("vertex ", "vertex/") + "endsolid\n", ":4: the vertex"),
    "stl of other words": ("stl", "solid\n" + FACET.replace("vertex 1", "vertexx 1") + "endsolid\n", ":5: "),
    "stl cut short": ("stl", "solid\n" + FACET.format(z=0), "ends early"),
    "stl of four numbers": ("stl", "solid\n" + FACET.format(z="0 1") + "endsolid\n", ":6: has 4 values"),
    "binary stl of more": ("stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(50), "promises 4000000000"),
    "binary stl of fewer": ("stl", bytes(80) + struct.pack("<I", 1) + bytes(500), "promises 1 triangles"),
    "binary stl nan": (
        "stl", bytes(80) + struct.pack("<I", 1) + struct.pack("<12f", *[0] * 11, float("nan")) + bytes(2), "NaN",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("suffix", "content", "message"), list(TEXTS.values()), ids=list(TEXTS))
def test_a_mesh_that_names_or_promises_what_it_lacks_is_refused_with_its_place(tmp_path, suffix, content, message):
    path = tmp_path / f"mesh.{suffix}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    started = time.perf_counter()
    with pytest.raises(DataError, match=message) as refused:
        load_mesh(path)
    assert str(path) in str(refused.value)
    assert time.perf_counter() - started < 5


def gltf():
    """A tetrahedron as a glTF document with its buffer inside."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4").tobytes()
    indices = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], dtype="<u2").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(points + indices).decode()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}, {"children": []}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 24},
        ],
        "buffers": [{"uri": uri, "byteLength": 72}],
    }


def changed(path, value):
    document = copy.deepcopy(gltf())
    *inner, last = path
    place = document
    for key in inner:
        place = place[key]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return document


GLTF = {
    "a scene beyond": (("scene",), 1, "scene names 1"),
    "a node beyond": (("scenes", 0, "nodes"), [2], r"scenes\[0\].nodes names 2"),
    "a node from the end": (("scenes", 0, "nodes"), [-1], r"scenes\[0\].nodes names -1"),
    "a mesh beyond": (("nodes", 0, "mesh"), 1, r"nodes\[0\].mesh names 1"),
    "a mesh of truth": (("nodes", 0, "mesh"), True, r"nodes\[0\].mesh names True"),
    "positions beyond": (("meshes", 0, "primitives", 0, "attributes", "POSITION"), 2, "attributes names 2"),
    "no positions": (("meshes", 0, "primitives", 0, "attributes", "POSITION"), None, "has no POSITION"),
    "indices beyond": (("meshes", 0, "primitives", 0, "indices"), 7, "indices names 7"),
    "a material that is not there": (("meshes", 0, "primitives", 0, "material"), 0, "material names 0"),
    "a view beyond": (("accessors", 0, "bufferView"), 2, r"accessors\[0\].bufferView names 2"),
    "a buffer from the end": (("bufferViews", 0, "buffer"), -1, r"bufferViews\[0\].buffer names -1"),
    "a negative place": (("bufferViews", 1, "byteOffset"), -24, r"bufferViews\[1\].byteOffset is -24"),
    "a place beyond": (("bufferViews", 1, "byteOffset"), 60, "cannot be read as"),
    "a negative count": (("accessors", 1, "count"), -12, r"accessors\[1\].count is -12"),
    "a broken count": (("accessors", 1, "count"), 1.5, r"accessors\[1\].count is 1.5"),
    "points": (("meshes", 0, "primitives", 0, "mode"), 0, "it is a point cloud"),
    "more than its view": (("accessors", 0, "count"), 400, "cannot be read as \\.gltf|names the vertices"),
    "zeros without end": (("accessors", 0), {"componentType": 5126, "count": 10**10, "type": "VEC3"}, "too large"),
    "a fat count": (("accessors", 0, "count"), 10**30, "too large"),
    "a sparse array": (("accessors", 0, "sparse"), {"count": 1}, r"accessors\[0\] is sparse"),
    "an unknown type": (("accessors", 0, "type"), "VEC9", r"accessors\[0\] has no type"),
    "normalized positions": (("accessors", 0, "normalized"), True, "normalized positions"),
    "packed geometry": (("extensionsRequired",), ["KHR_draco_mesh_compression"], "needs KHR_draco"),
    "a node in itself": (("nodes", 0, "children"), [0], r"nodes\[0\] is a child twice"),
    "a circle of nodes": (("nodes",), [{"children": [1], "mesh": 0}, {"children": [0]}], "nested too deep"),
    "two parents": (("nodes",), [{"children": [2]}, {"children": [2]}, {"mesh": 0}], r"nodes\[2\] is a child twice"),
    "a chain of nodes": (("nodes",), [{"children": [n + 1]} for n in range(5000)] + [{"mesh": 0}], "nested too deep"),
    "too many nodes": (("nodes",), [{}] * 200_000, "has 200000 nodes"),
    "views without end": (
        ("bufferViews",), [{"buffer": 0, "byteOffset": 0, "byteLength": 72_000}] * 10_000, "too large",
    ),
    "no object": ((), [], "not an object"),
}  # fmt: skip


@pytest.mark.parametrize(("path", "value", "message"), list(GLTF.values()), ids=list(GLTF))
def test_a_gltf_that_names_or_promises_what_it_lacks_is_refused_with_its_place(tmp_path, path, value, message):
    file = tmp_path / "mesh.gltf"
    file.write_text(json.dumps(changed(path, value) if path else value))
    with pytest.raises(DataError, match=message) as refused:
        load_mesh(file)
    assert str(file) in str(refused.value)


def test_a_mesh_that_is_placed_too_often_is_refused_before_it_is_placed(tmp_path):
    document = gltf()
    document["accessors"][1]["count"] = 12_000
    document["nodes"] = [{"mesh": 0}] * 10_000
    (tmp_path / "mesh.gltf").write_text(json.dumps(document))
    with pytest.raises(DataError, match="triangles"):
        load_mesh(tmp_path / "mesh.gltf")


def test_json_that_is_nested_too_deep_is_refused(tmp_path):
    (tmp_path / "mesh.gltf").write_text('{"asset": ' + "[" * 100_000 + "]" * 100_000 + "}")
    with pytest.raises(DataError, match="nested too deep"):
        load_mesh(tmp_path / "mesh.gltf")


def test_the_tetrahedron_that_the_tables_change_is_read(tmp_path):
    (tmp_path / "mesh.gltf").write_text(json.dumps(gltf()))
    for name, content in {"obj": POINTS + FACES, "ply": ply(), "gltf": None}.items():
        path = tmp_path / f"mesh.{name}"
        if content:
            path.write_text(content)
        mesh = load_mesh(path)
        assert (mesh.sign, len(mesh.faces), len(mesh.vertices)) == ("solid", 4, 4)


OBJ_BOX = "".join(f"v {x} {y} {z}\n" for x, y, z in BOX_VERTICES)
CORNER_STYLES = {
    "plain": lambda index: f"{index}",
    "textures": lambda index: f"{index}/1",
    "normals": lambda index: f"{index}//1",
    "both": lambda index: f"{index}/1/1",
    "plus": lambda index: f"+{index}",
    "from the end": lambda index: f"{index - 9}",
    "mixed": lambda index: f"{index}" if index % 2 else f"{index}/1/-1",
}


@pytest.mark.parametrize("style", list(CORNER_STYLES.values()), ids=list(CORNER_STYLES))
def test_every_way_to_write_a_corner_gives_the_same_mesh(tmp_path, style):
    expected = load_mesh(write_box(tmp_path / "box.ply"))
    faces = "".join("f " + " ".join(style(int(index) + 1) for index in face) + "\n" for face in BOX_FACES)
    text = "# a box\r\no box\nmtllib none.mtl\n" + OBJ_BOX + "vt 0 0\nvn 0 0 1\nusemtl none\n" + faces
    for number, variant in enumerate((text, text.replace("\n", "\r\n"), text.replace(" ", "\t"), "\ufeff" + text)):
        path = tmp_path / f"box{number}.obj"
        path.write_text(variant, encoding="utf-8", newline="")
        found = load_mesh(path)
        np.testing.assert_array_equal(found.vertices, expected.vertices)
        np.testing.assert_array_equal(np.sort(found.faces, axis=0), np.sort(expected.faces, axis=0))


def test_negative_indices_count_back_from_their_own_line(tmp_path):
    second = "".join(f"v {x + 3} {y} {z}\n" for x, y, z in BOX_VERTICES)
    faces = "".join("f " + " ".join(str(int(index) - 8) for index in face) + "\n" for face in BOX_FACES)
    (tmp_path / "two.obj").write_text(OBJ_BOX + faces + second + faces)
    mesh = load_mesh(tmp_path / "two.obj")
    assert (mesh.sign, len(mesh.faces), len(mesh.vertices)) == ("solid", 24, 16)


def test_a_line_may_go_on_in_the_next_and_errors_name_where_it_began(tmp_path):
    (tmp_path / "mesh.obj").write_text(POINTS + "f 1 \\\n 3 \\\n 2\n" + FACES)
    assert len(load_mesh(tmp_path / "mesh.obj").faces) == 4
    (tmp_path / "mesh.obj").write_text(POINTS + "f 1 \\\n 3 \\\n 2\nf 1 \\\n 9 \\\n 2\n")
    with pytest.raises(DataError, match=":8: a face names vertex 9"):
        load_mesh(tmp_path / "mesh.obj")


@pytest.mark.parametrize("begin", ["OFF\n8 6 0\n", "OFF 8 6 0\n", "# made\n\nOFF\n# counts\n8 6 12\n", "NOFF\n8 6 0\n"])
def test_off_of_quads_with_or_without_more_columns_is_the_box(tmp_path, begin):
    more = " 0 0 1" if begin.startswith("N") else ""
    points = "".join(f"{x} {y} {z}{more}\n" for x, y, z in BOX_VERTICES)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = "".join("4 " + " ".join(map(str, side)) + " 255 0 0\n" for side in sides)
    (tmp_path / "box.off").write_text(begin + points + faces)
    mesh = load_mesh(tmp_path / "box.off")
    assert (mesh.sign, len(mesh.faces), len(mesh.vertices)) == ("solid", 12, 8)


def test_fans_of_polygons_are_those_of_a_loop():
    rng = np.random.default_rng(0)
    corners = rng.integers(3, 9, 200)
    vertices = rng.integers(0, 1000, corners.sum())
    expected, start = [], 0
    for count in corners:
        polygon = vertices[start : start + count]
        expected += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, count - 1)]
        start += count
    faces = "".join(
        f"{count} {' '.join(map(str, one))}\n"
        for count, one in zip(corners, np.split(vertices, corners.cumsum()[:-1]), strict=True)
    )
    text = f"OFF\n1000 {len(corners)} 0\n" + 1000 * "0 0 0\n" + faces
    np.testing.assert_array_equal(read_off(text.encode(), "text")[1], expected)
