"""Mesh formats whose every index and count is checked: a file that names or promises what it lacks is refused.

OBJ, OFF and STL are read here, with the line of whatever is wrong in text. Of PLY and glTF, which a library reads, the
counts and references in the header are checked before it does: it would make room for what they promise, and take a
negative number for one from the end.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run.inputs import MESH, check_bytes, parse_json

# Of all parts of a file together, as often as they are placed.
MOST_TRIANGLES = 10_000_000
# Vertices and faces of a text take some hundred bytes each while they are read.
MOST_ROWS = 5_000_000
BINARY_HINT = "export it as binary PLY or GLB"
AGAIN_HINT = "open it in a mesh viewer and export it again"


class TextMesh(NamedTuple):
    """What a file holds.

    Arguments:
        vertices: Shape (V, 3).
        faces: Indices from 0, shape (F, 3).
        colours: Red, green and blue from 0 to 1 of every vertex, shape (V, 3); None: it has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None = None


class Rows(NamedTuple):
    """Rows of numbers in a text, with their lines."""

    texts: list[bytes]
    lines: list[int]


def read_obj(data: bytes, where: str) -> TextMesh:
    """A Wavefront OBJ file: all its faces, in fans of triangles; groups, materials and lines are left out.

    Raises:
        DataError: A number is none or a face names what is not there; with its line.
    """
    kinds: dict[bytes, Rows] = {name: Rows([], []) for name in (b"v", b"vt", b"vn", b"f")}
    # vertices, texture places and normals before each face: negative indices count back from there
    before: list[tuple[int, int, int]] = []
    for line, text in _lines(data, where):
        word, _, rest = text.replace(b"\t", b" ").partition(b" ")
        rows = kinds.get(word)
        if rows is None:
            continue
        if word == b"f":
            before.append(tuple(len(kinds[name].texts) for name in (b"v", b"vt", b"vn")))  # type: ignore[arg-type]
        rows.texts.append(rest)
        rows.lines.append(line)
    columns = _column_counts(kinds[b"v"], 3, where)
    least = int(columns.min()) if len(columns) else 3
    points = _numbers(kinds[b"v"], least if (columns == least).all() else None, where)
    faces = kinds[b"f"]
    corners = _column_counts(faces, 3, where)
    before_face = np.array(before, dtype=np.int64).reshape(-1, 3)
    references = _references(faces, where)
    if len(references) != corners.sum():  # a blank beside a slash
        raise DataError("has a face with a broken corner", where=where, allowed="as 1, 1/2, 1//3 or 1/2/3")
    face = np.repeat(np.arange(len(corners)), corners)
    for column, (what, name) in enumerate((("vertex", b"v"), ("texture place", b"vt"), ("normal", b"vn"))):
        index, count = references[:, column], len(kinds[name].texts)
        index = np.where(index > 0, index - 1, np.where(index < 0, before_face[face, column] + index, -1))
        wrong = ((index < 0) | (index >= count)) & ((column == 0) | (references[:, column] != ABSENT))
        if wrong.any():
            first = int(np.argmax(wrong))
            back = int(before_face[face[first], column])
            raise DataError(
                f"a face names {what} {references[first, column]}",
                where=f"{where}:{faces.lines[face[first]]}",
                allowed=f"1 to {count}" + (f", or -1 to -{back} back from here" if back else ""),
            )
        if not column:
            vertices = index
    colours = points[:, 3:6] if points.shape[1] >= 6 else None
    return TextMesh(points[:, :3], fans(vertices, corners), colours)


def read_off(data: bytes, where: str) -> TextMesh:
    """An OFF file, with colours or normals behind its vertices or without; faces become fans of triangles.

    Raises:
        DataError: It promises more than it has, a number is none, or a face names what is not there; with its line.
    """
    lines = [(line, text) for line, text in _lines(data, where) if text]
    word, _, rest = (lines[0][1] if lines else b"").partition(b" ")
    if not re.fullmatch(rb"C?N?OFF", word.upper()) or rest.strip().upper() == b"BINARY":
        raise DataError("is no OFF file in text", where=where, allowed="a first line OFF, COFF, NOFF or CNOFF")
    header, *rows = [(lines[0][0], rest.strip()), *lines[1:]] if rest.strip() else lines[1:] or lines
    counts = header[1].split()
    if len(counts) < 2 or not all(count.isdigit() and len(count) < 19 for count in counts[:2]):
        raise DataError("has no counts of vertices and faces", where=f"{where}:{header[0]}", hint=AGAIN_HINT)
    count, face_count = int(counts[0]), int(counts[1])
    if len(rows) < count + face_count:
        raise DataError(
            f"promises {count} vertices and {face_count} faces, and has {len(rows)} lines of them",
            where=f"{where}:{header[0]}",
            hint="it may be cut short",
        )
    points = Rows([b" ".join(text.split()[:3]) for _, text in rows[:count]], [line for line, _ in rows[:count]])
    _column_counts(points, 3, where)
    polygons = Rows([], [])
    for line, text in rows[count : count + face_count]:
        size, *indices = text.split()
        corners = int(size) if size.isdigit() and len(size) < 9 else 0
        if not 3 <= corners <= len(indices):
            shown = text[:40].decode(errors="replace")
            raise DataError(f"the face is {shown!r}", where=f"{where}:{line}", allowed="3 or more, and so many indices")
        polygons.texts.append(b" ".join(indices[:corners]))
        polygons.lines.append(line)
    sizes = _column_counts(polygons, 3, where)
    vertices = _whole_numbers(polygons, where)
    wrong = (vertices < 0) | (vertices >= count)
    if wrong.any():
        first = int(np.argmax(wrong))
        line = polygons.lines[int(np.repeat(np.arange(len(sizes)), sizes)[first])]
        raise DataError(f"a face names vertex {vertices[first]}", where=f"{where}:{line}", allowed=f"0 to {count - 1}")
    return TextMesh(_numbers(points, 3, where), fans(vertices, sizes))


STL_HEADER, STL_FACET = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(data: bytes, where: str) -> TextMesh:
    """An STL file, binary or text; every triangle has corners of its own.

    Raises:
        DataError: It promises another number of triangles than it has, or a number is none.
    """
    promised = int.from_bytes(data[80:STL_HEADER], "little") if len(data) >= STL_HEADER else 0
    if len(data) == STL_HEADER + promised * STL_FACET.itemsize:
        points = np.frombuffer(data, STL_FACET, promised, STL_HEADER)["corners"].reshape(-1, 3).astype(np.float64)
        wrong = ~np.isfinite(points).all(axis=1)
        if wrong.any():
            raise DataError(f"triangle {int(np.argmax(wrong)) // 3} has a corner that is NaN or infinite", where=where)
        return TextMesh(points, np.arange(len(points)).reshape(-1, 3))
    if not re.search(rb"(?i)\bvertex\s", data):
        raise DataError(
            f"promises {promised} triangles in {STL_HEADER + promised * STL_FACET.itemsize} bytes, and has {len(data)}",
            where=where,
            hint="it may be cut short, or no STL file",
        )
    corners, ends, ended = Rows([], []), 0, False
    for line, text in _lines(data, where, comment=None):
        word = text[:9].lower()
        if word.startswith(b"vertex"):
            corners.texts.append(text[6:])
            corners.lines.append(line)
        elif word.startswith((b"endfacet", b"end facet")):
            ends += 1
            if len(corners.texts) != 3 * ends:
                found = len(corners.texts) - 3 * (ends - 1)
                raise DataError(f"a facet has {found} corners", where=f"{where}:{line}", allowed="3")
        ended = ended or word.startswith((b"endsolid", b"end solid"))
    if not ended or len(corners.texts) != 3 * ends:
        raise DataError("ends early: the last solid is not closed", where=where, hint="it may be cut short")
    _column_counts(corners, 3, where, most=3)
    return TextMesh(_numbers(corners, 3, where), np.arange(len(corners.texts)).reshape(-1, 3))


def fans(vertices: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The triangles (F, 3) of polygons that have so many corners (P,), whose vertices follow one another (N,)."""
    triangles = corners - 2
    start = np.repeat(np.cumsum(corners) - corners, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return vertices[np.stack([start, start + step + 1, start + step + 2], axis=1)]


def _lines(data: bytes, where: str, comment: bytes | None = b"#") -> Iterator[tuple[int, bytes]]:
    """Number and text of every line, without blanks around it and comments; one that ends in \\ goes on in the next."""
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if data.count(b"\n") > MOST_ROWS:
        raise DataError(
            "has too many lines", where=where, allowed=f"{MOST_ROWS}", hint="export it as binary PLY or GLB"
        )
    parts: list[bytes] = []
    for line, whole in enumerate(data.split(b"\n"), 1):
        text = whole.partition(comment)[0] if comment else whole
        parts.append(text.rstrip().removesuffix(b"\\"))
        if not text.rstrip().endswith(b"\\"):
            yield line - len(parts) + 1, b" ".join(parts).strip() if len(parts) > 1 else parts[0].strip()
            parts = []
    yield line, b" ".join(parts).strip()


def _column_counts(rows: Rows, least: int, where: str, most: int | None = None) -> np.ndarray:
    """How many numbers each row has; raises for the first that has too few or too many."""
    counts = np.array([len(text.split()) for text in rows.texts], dtype=np.int64)
    wrong = (counts < least) | (counts > (most or np.inf))
    if wrong.any():
        first = int(np.argmax(wrong))
        allowed = f"{least}" if most else f"{least} or more"
        raise DataError(f"has {counts[first]} values", where=f"{where}:{rows.lines[first]}", allowed=allowed)
    return counts


def _numbers(rows: Rows, columns: int | None, where: str) -> np.ndarray:
    """The finite numbers of rows of so many columns; of the first three where rows differ."""
    texts = rows.texts if columns else [b" ".join(text.split()[:3]) for text in rows.texts]
    found = _parsed(b" ".join(texts), np.float64)
    if found is None or not np.isfinite(found).all():
        for text, line in zip(texts, rows.lines, strict=True):
            one = _parsed(text, np.float64)
            if one is None or not np.isfinite(one).all():
                shown = text[:60].decode(errors="replace").strip()
                raise DataError(f"the vertex is {shown!r}", where=f"{where}:{line}", allowed="finite numbers")
    assert found is not None, "every row is numbers, so all are"
    return found.reshape(-1, columns or 3)


def _parsed(text: bytes, kind: type) -> np.ndarray | None:
    """The numbers of a text that blanks separate; None where something is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, dtype=kind, sep=" ") if text.strip() else np.zeros(0, dtype=kind)
        except (ValueError, DeprecationWarning, OverflowError):
            return None


def _whole_numbers(rows: Rows, where: str) -> np.ndarray:
    found = _parsed(b" ".join(rows.texts), np.int64)
    if found is None:
        for text, line in zip(rows.texts, rows.lines, strict=True):
            if _parsed(text, np.int64) is None:
                shown = text[:60].decode(errors="replace").strip()
                raise DataError(f"the face is {shown!r}", where=f"{where}:{line}", allowed="whole numbers")
    assert found is not None, "every row is numbers, so all are"
    return found


# No index: of texture places and normals that a face does not name.
ABSENT = np.iinfo(np.int64).min
WHOLE = rb"[-+]?\d+"
CORNERS = {
    (0,): WHOLE,
    (0, 1): rb"%b/%b/?" % (WHOLE, WHOLE),
    (0, 2): rb"%b//%b" % (WHOLE, WHOLE),
    (0, 1, 2): rb"%b/%b/%b" % (WHOLE, WHOLE, WHOLE),
}


def _references(faces: Rows, where: str) -> np.ndarray:
    """The indices of vertex, texture place and normal of every corner as they stand there, shape (N, 3)."""
    whole = b" ".join(faces.texts)
    for used, pattern in CORNERS.items():
        if not re.sub(rb"(?<!\S)%b(?!\S)" % pattern, b"", whole).strip():
            found = _parsed(whole.replace(b"/", b" "), np.int64)
            if found is not None:
                return _spread(found.reshape(-1, len(used)), used)
    rows = []
    for text, line in zip(faces.texts, faces.lines, strict=True):
        for corner in text.split():
            fitting = (used for used, pattern in CORNERS.items() if re.fullmatch(pattern, corner))
            used, found = next(fitting, None), _parsed(corner.replace(b"/", b" "), np.int64)
            if used is None or found is None:
                shown = corner[:40].decode(errors="replace")
                allowed = "whole numbers, as 1, 1/2, 1//3 or 1/2/3"
                raise DataError(f"a corner of the face is {shown!r}", where=f"{where}:{line}", allowed=allowed)
            rows.append(_spread(found.reshape(1, -1), used))
    return np.concatenate(rows) if rows else np.zeros((0, 3), dtype=np.int64)


def _spread(found: np.ndarray, used: Sequence[int]) -> np.ndarray:
    spread = np.full((len(found), 3), ABSENT)
    spread[:, list(used)] = found
    return spread


PLY_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2}


def check_ply(data: bytes, where: str) -> None:
    """Refuse a PLY file whose header promises more than follows.

    Raises:
        DataError: So it does, or it has no header.
    """
    header, found, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not found:
        raise DataError("has no header from `ply` to `end_header`", where=where, hint=AGAIN_HINT)
    is_text, name, least, total = b"ascii" in header.partition(b"element")[0], "", 0, 0
    for line, words in enumerate((text.split() for text in header.decode(errors="replace").splitlines()), 1):
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 18:
                raise DataError("is no count of elements", where=f"{where}:{line}", allowed="element NAME COUNT")
            name, count = words[1], int(words[2])
            total += count
        elif words[:1] == ["property"] and name:
            least += count * (PLY_BYTES.get(words[-2], 4) if words[1] != "list" else 1)
    rows = sum(1 for _ in re.finditer(rb"[^\r\n]+", body)) if is_text else 0
    if (total > rows) if is_text else (least > len(body)):
        has = f"{rows} lines" if is_text else f"{len(body)} bytes"
        raise DataError(f"promises {total} elements, and has {has} of them", where=where, hint="it may be cut short")
    if is_text and body.count(b"\n") > MOST_ROWS:
        raise DataError(
            "has too many lines", where=where, allowed=f"{MOST_ROWS}", hint="export it as binary PLY or GLB"
        )


# Lists of a glTF file by the keys that hold indices into them.
LISTS = {
    "accessor": "accessors", "attributes": "accessors", "buffer": "buffers", "bufferView": "bufferViews",
    "camera": "cameras", "children": "nodes", "indices": "accessors", "material": "materials", "mesh": "meshes",
    "nodes": "nodes", "scene": "scenes", "skin": "skins", "targets": "accessors",
}  # fmt: skip
COUNTS = ("byteLength", "byteOffset", "byteStride", "count")
# Anything may stand here.
FREE = ("extras", "extensions", "asset")
COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
READ_EXTENSIONS = ("KHR_materials", "KHR_texture", "KHR_lights", "KHR_mesh_quantization", "EXT_texture", "KHR_xmp")
DEEPEST_NODE = 200
MOST_NODES = 100_000


def check_gltf(data: bytes, where: str) -> None:
    """Refuse a GLB or glTF file with references to what is not there, or that grows beyond measure when it is read.

    Raises:
        DataError: So it does, or it needs what is not read: packed or sparse geometry.
    """
    text = data
    if data.startswith(b"glTF"):
        text = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    try:
        document = parse_json(text)
    except ValueError as error:
        raise DataError(f"its JSON cannot be read: {error}", where=where, hint=AGAIN_HINT) from None
    if not isinstance(document, dict):
        raise DataError("is no glTF file: its JSON is no object", where=where, hint=AGAIN_HINT)
    needed = [name for name in document.get("extensionsRequired") or () if not str(name).startswith(READ_EXTENSIONS)]
    if needed:
        raise DataError(f"needs {needed[0]}", where=where, allowed="glTF that is not packed", hint="export it unpacked")
    _check_indices(document, document, "", where)
    _check_accessors(document, where)
    _check_nodes(document, where)


def _check_indices(value: Any, document: dict[str, Any], path: str, where: str) -> None:
    """Every index below a value lies in its list, and every count is one."""
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
            allowed = f"0 to {count - 1}" if count else "nothing: there is no such list"
            raise DataError(f"{place} names {str(index)[:40]}", where=where, allowed=allowed)


def _check_accessors(document: dict[str, Any], where: str) -> None:
    views = document.get("bufferViews") or ()
    copied = sum(view["byteLength"] for view in views if isinstance(view, dict) and "byteLength" in view)
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
    """Nodes form trees of a bounded depth, and place a bounded number of triangles."""
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
    check_triangles(placed // 2, where)


def _size(mesh: Any, accessors: list[Any], place: str, where: str) -> int:
    """Vertices or corners of a mesh, whichever are more, in triangles."""
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


def check_triangles(count: int, where: str) -> None:
    """Refuse more triangles than a scene can hold.

    Raises:
        DataError: They are more.
    """
    if count > MOST_TRIANGLES:
        raise DataError(
            f"has {count} triangles", where=where, allowed=f"at most {MOST_TRIANGLES}", hint="simplify the mesh"
        )
