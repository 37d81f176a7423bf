"""Readers and checks of mesh formats: files with indices or counts beyond their content are refused.

OBJ, OFF and STL are read here, with the line of each error in text: trimesh takes index 0 of an OBJ for its last
vertex, drops truncated OFF faces and STL solids, and orders faces by their numbers of corners. PLY and glTF are read by
trimesh after a check of the counts and references in the header: it would allocate memory for any count, and take a
negative index for one from the end.

Readers return the vertices (V, 3), the faces as indices from 0 (F, 3), polygons in fans of triangles, and red, green
and blue of every vertex from 0 to 1 (V, 3), None where it has none.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterator
from itertools import islice, pairwise
from typing import Any

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run.inputs import MESH, check_bytes, parse_json

# In all parts of a file together, each counted as often as it is placed; checking them takes 5 GB.
MOST_TRIANGLES = 10_000_000
# Lines of a text file, each of which is split by itself.
MOST_ROWS = 5_000_000
LONGEST_LINE = LONGEST_HEADER = 100_000
BINARY_HINT = "export it as binary PLY or GLB"
AGAIN_HINT = "open it in a mesh viewer and export it again, as triangles"

Triangles = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def _rows(data: bytes, where: str, joining: bytes | None = None) -> Iterator[tuple[int, list[bytes]]]:
    """Number, from 1, and words of every line with words; comments are left out.

    A line that ends in `joining` continues in the next one.
    """
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if data.count(b"\n") > MOST_ROWS:
        raise DataError("has too many lines", where=where, allowed=f"{MOST_ROWS}", hint=BINARY_HINT)
    lines, begun, before = data.split(b"\n"), 0, b""
    for line, text in enumerate(lines, 1):
        begun, before = begun or line, before + text.rstrip()
        if len(before) > LONGEST_LINE:
            raise DataError(
                f"has a line of {len(before)} characters", where=f"{where}:{begun}", allowed=f"{LONGEST_LINE}"
            )
        if joining and before.endswith(joining) and line < len(lines):
            before = before.removesuffix(joining) + b" "
            continue
        words = before.partition(b"#")[0].split()
        if words:
            yield begun, words
        begun, before = 0, b""


def _point(words: list[bytes], where: str, line: int, most: float = math.inf) -> list[float]:
    """Finite numbers of a vertex in a line: three, or up to `most`."""
    if not 3 <= len(words) <= most:
        raise DataError(f"has {len(words)} values", where=f"{where}:{line}", allowed="3 or more" if most > 3 else "3")
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [math.nan]
    # Python accepts underscores in numbers
    if not all(map(math.isfinite, values)) or b"_" in b"".join(words):
        shown = b" ".join(words)[:60].decode(errors="replace")
        raise DataError(f"the vertex is {shown!r}", where=f"{where}:{line}", allowed="finite numbers")
    return values


def _mesh(points: array[float], triangles: array[int], colours: array[float] | None = None) -> Triangles:
    rgb = np.array(colours).reshape(-1, 3) if colours and len(colours) == len(points) else None
    return np.array(points).reshape(-1, 3), np.array(triangles).reshape(-1, 3), rgb


def _add_fan(triangles: array[int], polygon: list[int]) -> None:
    for second, third in pairwise(polygon[1:]):
        triangles.extend((polygon[0], second, third))


# Lists of an OBJ file in the order of the indices in a face's corner.
OBJ_LISTS = {b"v": "vertex", b"vt": "texture coordinate", b"vn": "normal"}
OBJ_CORNER = re.compile(rb"[-+]?\d{1,18}(?:/(?:[-+]?\d{1,18})?){0,2}")


def read_obj(data: bytes, where: str) -> Triangles:
    """Read all faces of a Wavefront OBJ file; groups, materials and lines are left out.

    Raises:
        DataError: Invalid number, or a face with a missing vertex; with its line.
    """
    text = data.replace(b"\r", b"\n")
    totals = {word: len(re.findall(rb"(?mi)^[ \t]*%b[ \t]" % word, text)) for word in OBJ_LISTS}
    before = dict.fromkeys(OBJ_LISTS, 0)
    points, colours, triangles, known = array("d"), array("d"), array("q"), {}
    for line, (word, *values) in _rows(data, where, b"\\"):
        kind = word.lower()
        if kind in before:
            before[kind] += 1
        if kind == b"v":
            point = _point(values, where, line)
            points.extend(point[:3])
            colours.extend(point[3:6])
        elif kind == b"f":
            if len(values) < 3:
                raise DataError(f"has {len(values)} values", where=f"{where}:{line}", allowed="3 or more")
            for corner in values:
                # negative numbers count back from here
                if corner not in known or b"-" in corner:
                    known[corner] = _named_vertex(corner, totals, before, f"{where}:{line}")
            _add_fan(triangles, [known[corner] for corner in values])
    return _mesh(points, triangles, colours)


def _named_vertex(corner: bytes, totals: dict[bytes, int], before: dict[bytes, int], place: str) -> int:
    """Index of the vertex of a face's corner, from 0, with all of its indices checked."""
    if not OBJ_CORNER.fullmatch(corner):
        raise DataError(
            f"a corner of the face is {corner[:40].decode(errors='replace')!r}",
            where=place,
            allowed="whole numbers, as 1, 1/2, 1//3 or 1/2/3",
        )
    indices = []
    for word, number in zip(OBJ_LISTS, corner.split(b"/"), strict=False):
        named = int(number or 1)
        index = named - 1 if named > 0 else before[word] + named if named else -1
        if number and not 0 <= index < totals[word]:
            raise DataError(
                f"a face names {OBJ_LISTS[word]} {named}",
                where=place,
                allowed=f"1 to {totals[word]}, or as far back from here as there are some before it",
            )
        indices.append(index)
    return indices[0]


WHOLE_NUMBER = re.compile(rb"[-+]?\d{1,18}")


def read_off(data: bytes, where: str) -> Triangles:
    """Read an OFF file; colours and normals are left out.

    Raises:
        DataError: Truncated file, invalid number, or a face with a missing vertex; with its line.
    """
    rows = _rows(data, where)
    line, (word, *counts) = next(rows, (1, [b""]))
    if not re.fullmatch(rb"C?N?OFF", word.upper()) or [one.upper() for one in counts] == [b"BINARY"]:
        raise DataError("is not an OFF text file", where=where, allowed="a first line OFF, COFF, NOFF or CNOFF")
    line, counts = (line, counts) if counts else next(rows, (line, []))
    if len(counts) < 2 or not all(count.isdigit() and len(count) < 19 for count in counts[:2]):
        raise DataError("has no counts of vertices and faces", where=f"{where}:{line}", hint=AGAIN_HINT)
    count, face_count, found = int(counts[0]), int(counts[1]), 0
    points, triangles = array("d"), array("q")
    for found, (row, words) in enumerate(islice(rows, count + face_count), 1):
        if found <= count:
            points.extend(_point(words[:3], where, row))
            continue
        place = f"{where}:{row}"
        size = int(words[0]) if words[0].isdigit() and len(words[0]) < 9 else 0
        corners = words[1 : size + 1]
        if not 3 <= size == len(corners) or not all(map(WHOLE_NUMBER.fullmatch, corners)):
            shown = b" ".join(words)[:40].decode(errors="replace")
            raise DataError(f"the face is {shown!r}", where=place, allowed="3 or more, and so many whole numbers")
        polygon = list(map(int, corners))
        if not 0 <= min(polygon) <= max(polygon) < count:
            wrong = next(index for index in polygon if not 0 <= index < count)
            raise DataError(f"a face names vertex {wrong}", where=place, allowed=f"0 to {count - 1}")
        _add_fan(triangles, polygon)
    if found < count + face_count:
        raise DataError(
            f"promises {count} vertices and {face_count} faces, and has {found} lines of them",
            where=f"{where}:{line}",
            hint="it may be cut short",
        )
    return _mesh(points, triangles)


STL_HEADER, STL_FACET = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(data: bytes, where: str) -> Triangles:
    """Read an STL file, binary or text; every triangle has corners of its own.

    Raises:
        DataError: Wrong number of triangles, or invalid number.
    """
    promised = int.from_bytes(data[80:STL_HEADER], "little") if len(data) >= STL_HEADER else 0
    if len(data) == STL_HEADER + promised * STL_FACET.itemsize:
        points = np.frombuffer(data, STL_FACET, promised, STL_HEADER)["corners"].reshape(-1, 3).astype(np.float64)
        return points, np.arange(len(points)).reshape(-1, 3), None
    if not re.search(rb"(?im)^[ \t]*vertex\b", data):
        raise DataError(
            f"promises {promised} triangles in {STL_HEADER + promised * STL_FACET.itemsize} bytes, and has {len(data)}",
            where=where,
            hint="it may be cut short, or not an STL file",
        )
    corners, is_open, last = array("d"), 0, b""
    for line, words in _rows(data, where):
        word = (b"".join(words[:2]) if words[0].lower() == b"end" else words[0]).lower()
        if word.startswith(b"vertex"):
            corners.extend(_point(words[1:] if word == b"vertex" else words, where, line, most=3))
            is_open += 1
        elif word in (b"facet", b"endfacet", b"endsolid"):
            if is_open != (3 if word == b"endfacet" else 0):
                raise DataError("a facet does not have 3 corners", where=f"{where}:{line}", allowed="3 in each")
            is_open = 0
        else:
            continue
        last = word
    if last != b"endsolid":
        raise DataError("ends early: the last solid is not closed", where=where, hint="it may be cut short")
    return _mesh(corners, array("q", range(len(corners) // 3)))


PLY_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2}


def check_ply(data: bytes, where: str) -> None:
    """Refuse a PLY file with more elements in its header than in its body.

    Raises:
        DataError: The file is truncated, too long, or has no valid header.
    """
    header, found, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not found:
        raise DataError("has no header from `ply` to `end_header`", where=where, hint=AGAIN_HINT)
    if len(header) > LONGEST_HEADER or (body.count(b"\n") > MOST_ROWS and b"ascii" in header):
        raise DataError(
            "has too long a header or too many lines",
            where=where,
            allowed=f"{LONGEST_HEADER} characters of header, and {MOST_ROWS} lines of text",
            hint=BINARY_HINT,
        )
    is_text, name, least, total = b"ascii" in header.partition(b"element")[0], "", 0, 0
    for line, words in enumerate((text.split() for text in header.decode(errors="replace").splitlines()), 1):
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 18:
                raise DataError("is not a count of elements", where=f"{where}:{line}", allowed="element NAME COUNT")
            name, count = words[1], int(words[2])
            if name == "tristrips" and count:
                raise DataError(
                    "has triangle strips",
                    where=f"{where}:{line}",
                    allowed="an element `face`",
                    hint="open it in MeshLab, which reads them, and export it as PLY",
                )
            total += count
        elif words[:1] == ["property"] and name:
            least += count * (PLY_BYTES.get(words[-2], 4) if words[1] != "list" else 1)
    rows = sum(1 for _ in re.finditer(rb"[^\r\n]+", body)) if is_text else 0
    if (total > rows) if is_text else (least > len(body)):
        has = f"{rows} lines" if is_text else f"{len(body)} bytes"
        raise DataError(f"promises {total} elements, and has {has} of them", where=where, hint="it may be cut short")


# Lists of a glTF file by the keys of indices into them.
LISTS = {
    "accessor": "accessors", "attributes": "accessors", "buffer": "buffers", "bufferView": "bufferViews",
    "camera": "cameras", "children": "nodes", "indices": "accessors", "material": "materials", "mesh": "meshes",
    "nodes": "nodes", "scene": "scenes", "skin": "skins", "targets": "accessors",
}  # fmt: skip
COUNTS = ("byteLength", "byteOffset", "byteStride", "count")
# Keys with arbitrary content.
FREE = ("extras", "extensions", "asset")
COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
READ_EXTENSIONS = ("KHR_materials", "KHR_texture", "KHR_lights", "KHR_mesh_quantization", "EXT_texture", "KHR_xmp")
DEEPEST_NODE = 200
MOST_NODES = 100_000


def check_gltf(data: bytes, where: str) -> None:
    """Refuse a GLB or glTF file with invalid references, or that grows beyond the limits when it is read.

    Raises:
        DataError: The file is invalid or too large, or uses unsupported packed or sparse geometry.
    """
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if data.startswith(b"glTF") else data
    try:
        document = parse_json(text)
    except ValueError as error:
        raise DataError(f"its JSON cannot be read: {error}", where=where, hint=AGAIN_HINT) from None
    if not isinstance(document, dict):
        raise DataError("is not a glTF file: its JSON is not an object", where=where, hint=AGAIN_HINT)
    needed = [name for name in document.get("extensionsRequired") or () if not str(name).startswith(READ_EXTENSIONS)]
    if needed:
        raise DataError(f"needs {needed[0]}", where=where, allowed="glTF that is not packed", hint="export it unpacked")
    _check_indices(document, document, "", where)
    _check_accessors(document, where)
    _check_nodes(document, where)


def _check_indices(value: Any, document: dict[str, Any], path: str, where: str) -> None:
    """Refuse indices outside their lists and invalid counts, anywhere below a value."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in entries:
        place = f"{path}.{key}".lstrip(".") if isinstance(value, dict) else f"{path}[{key}]"
        if key in FREE:
            continue
        if key in LISTS:
            held = document.get(LISTS[key])
            _check_references(item, len(held) if isinstance(held, list) else 0, place, where)
        if key in COUNTS and (type(item) is not int or item < 0):
            raise DataError(f"{place} is {str(item)[:40]}", where=where, allowed="a whole number from 0")
        _check_indices(item, document, place, where)


def _check_references(item: Any, count: int, place: str, where: str) -> None:
    inside = item.values() if isinstance(item, dict) else item if isinstance(item, list) else (item,)
    for index in inside:
        if isinstance(index, dict):  # an object that is called so, with keys of its own
            return
        if type(index) is not int or not 0 <= index < count:
            raise DataError(
                f"{place} names {str(index)[:40]}",
                where=where,
                allowed=f"0 to {count - 1}" if count else "nothing: there is no such list",
            )


def _check_accessors(document: dict[str, Any], where: str) -> None:
    copied = sum(
        view["byteLength"]
        for view in document.get("bufferViews") or ()
        if isinstance(view, dict) and "byteLength" in view
    )
    for number, accessor in enumerate(document.get("accessors") or ()):
        place = f"accessors[{number}]"
        if not isinstance(accessor, dict) or accessor.get("type") not in COMPONENTS or "count" not in accessor:
            raise DataError(f"{place} has no type and count", where=where, hint=AGAIN_HINT)
        if "sparse" in accessor:
            raise DataError(f"{place} is sparse", where=where, allowed="full arrays", hint="export it without")
        copied += (
            accessor["count"] * COMPONENTS[accessor["type"]] * COMPONENT_BYTES.get(accessor.get("componentType"), 4)
        )
    check_bytes(copied, MESH, where)


def _check_nodes(document: dict[str, Any], where: str) -> None:
    """Refuse nodes that are no trees of bounded depth, or that place too many triangles."""
    nodes, accessors = document.get("nodes") or [], document.get("accessors") or []
    meshes = [_size(mesh, accessors, f"meshes[{n}]", where) for n, mesh in enumerate(document.get("meshes") or [])]
    if len(nodes) > MOST_NODES:
        raise DataError(f"has {len(nodes)} nodes", where=where, allowed=f"{MOST_NODES}")
    parent: dict[int, int] = {}
    for number, node in enumerate(nodes):
        for child in node.get("children", ()) if isinstance(node, dict) else ():
            if child in parent or child == number:
                raise DataError(f"nodes[{child}] is a child twice", where=where, allowed="trees of nodes")
            parent[child] = number
    for number in range(len(nodes)):
        depth, above = 0, number
        while above in parent and depth <= DEEPEST_NODE:
            depth, above = depth + 1, parent[above]
        if depth > DEEPEST_NODE:
            raise DataError(f"nodes[{number}] is nested too deep", where=where, allowed=f"{DEEPEST_NODE} levels")
    placed = sum(meshes) + sum(meshes[node["mesh"]] for node in nodes if isinstance(node, dict) and "mesh" in node)
    check_count(placed // 2, where)


def _size(mesh: Any, accessors: list[Any], place: str, where: str) -> int:
    """Size of a mesh in triangles, from its vertices or corners, whichever are more."""
    total = 0
    for number, primitive in enumerate(mesh.get("primitives", ()) if isinstance(mesh, dict) else ()):
        attributes = primitive.get("attributes") if isinstance(primitive, dict) else None
        if not isinstance(attributes, dict) or "POSITION" not in attributes:
            raise DataError(f"{place}.primitives[{number}] has no POSITION", where=where, hint=AGAIN_HINT)
        positions = accessors[attributes["POSITION"]]
        if positions.get("normalized"):
            raise DataError(f"{place} has normalized positions", where=where, allowed="metres", hint="export floats")
        corners = accessors[primitive["indices"]]["count"] if "indices" in primitive else 0
        total += max(positions["count"], corners) // 3
    return total


def check_count(count: int, where: str) -> None:
    """Refuse more than `MOST_TRIANGLES` triangles.

    Raises:
        DataError: There are more.
    """
    if count > MOST_TRIANGLES:
        raise DataError(
            f"has {count} triangles", where=where, allowed=f"at most {MOST_TRIANGLES}", hint="simplify the mesh"
        )
