"""Mesh formats whose every index and count is checked: a file that names or promises what it lacks is refused.

OBJ, OFF and STL are read here, with the line of whatever is wrong in text. Of PLY and glTF, which a library reads, the
counts and references in the header are checked before it does: it would make room for what they promise, and take a
negative number for one from the end.
"""

from __future__ import annotations

import copy
import re
import warnings
from typing import Any, NamedTuple

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run.inputs import MESH, check_bytes, parse_json

# Of all parts of a file together, as often as they are placed; checking so many takes 5 GB.
MOST_TRIANGLES = 10_000_000
# Vertices and faces of a text take some hundred bytes each while they are read.
MOST_ROWS = 5_000_000
LONGEST_LINE = LONGEST_HEADER = 100_000
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


class Rows:
    """Rows of a text that are alike: what the last group of a pattern finds; or some of them, changed."""

    def __init__(self, data: bytes, pattern: bytes) -> None:
        self._data, self._pattern, self._first = data, re.compile(b"(?mi)" + pattern), 0
        self.texts: list[bytes] = self._pattern.findall(data)

    def part(self, first: int, texts: list[bytes]) -> Rows:
        """Other texts of the rows from one on."""
        part = copy.copy(self)
        part._first, part.texts = self._first + first, texts
        return part

    def lines(self) -> np.ndarray:
        """The line of each row, from 1; found when it is asked for, as messages do."""
        ends = np.flatnonzero(np.frombuffer(self._data, dtype=np.uint8) == ord("\n"))
        starts = [match.start(1) for match in self._pattern.finditer(self._data)]
        return 1 + np.searchsorted(ends, starts)[self._first : self._first + len(self.texts)]


def read_obj(data: bytes, where: str) -> TextMesh:
    """A Wavefront OBJ file: all its faces, in fans of triangles; groups, materials and lines are left out.

    Raises:
        DataError: A number is none or a face names what is not there; with its line.
    """
    data = _plain(data, where)
    # a line that ends in \ goes on in the next; the lines after it keep their numbers
    data = re.sub(rb"(?:[^\n]*\\[ ]*\n)+[^\n]*", _joined, data) if b"\\" in data else data
    points, places, normals, faces = (
        Rows(data, rb"^[ \t]*%b[ \t]+([^\n#]*)" % name) for name in (b"v", b"vt", b"vn", b"f")
    )
    columns = _column_counts(points, 3, where)
    least = int(columns.min()) if len(columns) else 3
    numbers = _numbers(points, least if (columns == least).all() else None, where)
    corners = _column_counts(faces, 3, where)
    references = _references(faces, where)
    vertices = np.zeros(len(references), dtype=np.int64)
    for column, (what, rows) in enumerate((("vertex", points), ("texture coordinate", places), ("normal", normals))):
        named = references[:, column]
        index = _resolved(named, rows, faces, corners) if (named < 0).any() else named - 1
        wrong = ((index < 0) | (index >= len(rows.texts))) & ((column == 0) | (named != ABSENT))
        if wrong.any():
            first = int(np.argmax(wrong))
            line = faces.lines()[int(np.searchsorted(np.cumsum(corners), first, side="right"))]
            allowed = f"1 to {len(rows.texts)}, or as far back from here as there are some before it"
            raise DataError(f"a face names {what} {named[first]}", where=f"{where}:{line}", allowed=allowed)
        vertices = index if column == 0 else vertices
    colours = numbers[:, 3:6] if numbers.shape[1] >= 6 else None
    return TextMesh(numbers[:, :3], fans(vertices, corners), colours)


def _resolved(named: np.ndarray, rows: Rows, faces: Rows, corners: np.ndarray) -> np.ndarray:
    """Indices from 0 of what faces name: negative numbers count back from the line of the face; -1 where it is 0."""
    before = np.repeat(np.searchsorted(rows.lines(), faces.lines()), corners)
    return np.where(named > 0, named - 1, np.where(named < 0, np.maximum(named, -1 - before) + before, -1))


def _joined(found: re.Match[bytes]) -> bytes:
    parts = re.split(rb"\\[ ]*\n", found[0])
    return b" ".join(parts) + b"\n" * (len(parts) - 1)


def read_off(data: bytes, where: str) -> TextMesh:
    """An OFF file, with colours or normals behind its vertices or without; faces become fans of triangles.

    Raises:
        DataError: It promises more than it has, a number is none, or a face names what is not there; with its line.
    """
    data = _plain(data, where)
    rows = Rows(data, rb"^[ \t]*([^\s#][^\n#]*)")
    word, _, rest = (rows.texts[0] if rows.texts else b"").partition(b" ")
    if not re.fullmatch(rb"C?N?OFF", word.strip().upper()) or rest.strip().upper() == b"BINARY":
        raise DataError("is not an OFF text file", where=where, allowed="a first line OFF, COFF, NOFF or CNOFF")
    begin = 0 if rest.strip() else 1
    counts = (rest if rest.strip() else b" ".join(rows.texts[1:2])).split()
    if len(counts) < 2 or not all(count.isdigit() and len(count) < 19 for count in counts[:2]):
        line = rows.lines()[min(begin, len(rows.texts) - 1)]
        raise DataError("has no counts of vertices and faces", where=f"{where}:{line}", hint=AGAIN_HINT)
    count, face_count = int(counts[0]), int(counts[1])
    texts = rows.texts[begin + 1 :]
    if len(texts) < count + face_count:
        raise DataError(
            f"promises {count} vertices and {face_count} faces, and has {len(texts)} lines of them",
            where=f"{where}:{rows.lines()[begin]}",
            hint="it may be cut short",
        )
    points = rows.part(begin + 1, [b" ".join(text.split()[:3]) for text in texts[:count]])
    _column_counts(points, 3, where)
    faces = rows.part(begin + 1 + count, texts[count : count + face_count])
    found = [_polygon(text) for text in faces.texts]
    if None in found:
        first = found.index(None)
        shown, place = faces.texts[first][:40].decode(errors="replace"), f"{where}:{faces.lines()[first]}"
        raise DataError(f"the face is {shown!r}", where=place, allowed="3 or more, and so many whole numbers")
    corners = np.array([len(polygon) for polygon in found], dtype=np.int64)  # type: ignore[arg-type]
    vertices = np.array([index for polygon in found for index in polygon], dtype=np.int64)  # type: ignore[union-attr]
    wrong = (vertices < 0) | (vertices >= count)
    if wrong.any():
        first = int(np.argmax(wrong))
        line = faces.lines()[int(np.searchsorted(np.cumsum(corners), first, side="right"))]
        raise DataError(f"a face names vertex {vertices[first]}", where=f"{where}:{line}", allowed=f"0 to {count - 1}")
    return TextMesh(_numbers(points, 3, where), fans(vertices, corners))


def _polygon(text: bytes) -> tuple[int, ...] | None:
    """The corners of a face that says first how many they are; None where it has fewer, or one is no number."""
    size, *indices = text.split()
    corners = int(size) if size.isdigit() and len(size) < 9 else 0
    if not 3 <= corners <= len(indices) or not all(WHOLE_NUMBER.fullmatch(index) for index in indices[:corners]):
        return None
    return tuple(map(int, indices[:corners]))


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
    if not re.search(rb"(?im)^[ \t]*vertex\b", data):
        raise DataError(
            f"promises {promised} triangles in {STL_HEADER + promised * STL_FACET.itemsize} bytes, and has {len(data)}",
            where=where,
            hint="it may be cut short, or not an STL file",
        )
    data = _plain(data, where)
    corners, words = (
        Rows(data, rb"^[ \t]*vertex\b([^\n]*)"),
        Rows(data, rb"^[ \t]*(vertex|end ?facet|end ?solid)\b"),
    )
    # the last letters of the words: three of `vertex`, then one of `endfacet`, and so on until `endsolid`
    letters = b"".join(word[-1:].lower() for word in words.texts)
    fitting = re.match(rb"(?:xxxt|d)*", letters)
    assert fitting is not None, "nothing fits as well"
    if fitting.end() < len(letters.rstrip(b"x")):
        line = words.lines()[fitting.end()]
        raise DataError("a facet does not have 3 corners", where=f"{where}:{line}", allowed="3 in each")
    if not letters.endswith(b"d"):
        raise DataError("ends early: the last solid is not closed", where=where, hint="it may be cut short")
    _column_counts(corners, 3, where, most=3)
    return TextMesh(_numbers(corners, 3, where), np.arange(len(corners.texts)).reshape(-1, 3))


def fans(vertices: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The triangles (F, 3) of polygons that have so many corners (P,), whose vertices follow one another (N,)."""
    triangles = corners - 2
    start = np.repeat(np.cumsum(corners) - corners, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return vertices[np.stack([start, start + step + 1, start + step + 2], axis=1)]


def _plain(data: bytes, where: str) -> bytes:
    """A text whose lines end in a line feed alone, without the mark of UTF-8; refuses more than a few million lines."""
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if data.count(b"\n") > MOST_ROWS:
        raise DataError("has too many lines", where=where, allowed=f"{MOST_ROWS}", hint=BINARY_HINT)
    ends = np.flatnonzero(np.frombuffer(data + b"\n", dtype=np.uint8) == ord("\n"))
    longest = int(np.argmax(np.diff(ends, prepend=-1)))
    length = int(np.diff(ends, prepend=-1)[longest])
    if length > LONGEST_LINE:
        raise DataError(f"has a line of {length} characters", where=f"{where}:{longest + 1}", allowed=f"{LONGEST_LINE}")
    data = data.replace(b"\t", b" ")
    # patterns would look at every blank several times
    return re.sub(rb" {2,}", b" ", data) if 8 * data.count(b" " * 4) > len(data) else data


def _column_counts(rows: Rows, least: int, where: str, most: int | None = None) -> np.ndarray:
    """How many numbers each row has; raises for the first that has too few or too many."""
    counts = np.array([len(text.split()) for text in rows.texts], dtype=np.int64)
    wrong = (counts < least) | (counts > (most or np.inf))
    if wrong.any():
        first = int(np.argmax(wrong))
        allowed = f"{least}" if most else f"{least} or more"
        raise DataError(f"has {counts[first]} values", where=f"{where}:{rows.lines()[first]}", allowed=allowed)
    return counts


def _numbers(rows: Rows, columns: int | None, where: str) -> np.ndarray:
    """The finite numbers of rows of so many columns; of the first three where rows differ."""
    texts = rows.texts if columns else [b" ".join(text.split()[:3]) for text in rows.texts]
    found = _parsed(b" ".join(texts), np.float64)
    if found is None or not np.isfinite(found).all():
        for text, line in zip(texts, rows.lines(), strict=True):
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


# No index: of texture coordinates and normals that a face does not name.
ABSENT = np.iinfo(np.int64).min
WHOLE_NUMBER = re.compile(rb"[-+]?\d{1,18}")
# Faces whose corners are taken apart at once; bounds memory.
ROWS_AT_ONCE = 100_000
BLANKS = b" \t\v\f"


def _references(faces: Rows, where: str) -> np.ndarray:
    """The indices of vertex, texture coordinate and normal of every corner as they stand there, shape (N, 3)."""
    found = [np.zeros((0, 3), dtype=np.int64)]
    for begin in range(0, len(faces.texts), ROWS_AT_ONCE):
        texts = faces.texts[begin : begin + ROWS_AT_ONCE]
        part = _indices(b" ".join(texts))
        if part is None:
            row = next(row for row, text in enumerate(texts) if _indices(text) is None)
            wrong = next(corner for corner in texts[row].split() if _indices(corner) is None)
            place, shown = f"{where}:{faces.lines()[begin + row]}", repr(wrong[:40].decode(errors="replace"))
            allowed = "whole numbers, as 1, 1/2, 1//3 or 1/2/3"
            raise DataError(f"a corner of the face is {shown}", where=place, allowed=allowed)
        found.append(part)
    return np.concatenate(found)


def _indices(text: bytes) -> np.ndarray | None:
    """Three indices of each corner, (N, 3); None where something is no corner."""
    letters = np.frombuffer(b" " + text + b" ", dtype=np.uint8)
    digit, slash = (letters >= ord("0")) & (letters <= ord("9")), letters == ord("/")
    blank, sign = np.isin(letters, np.frombuffer(BLANKS, dtype=np.uint8)), (letters == ord("+")) | (letters == ord("-"))
    loose_sign = sign[1:-1] & ~(digit[2:] & (blank | slash)[:-2])
    if loose_sign.any() or not (digit | slash | blank | sign).all():
        return None
    begins = np.flatnonzero(~blank[1:] & blank[:-1]) + 1
    numbers = np.flatnonzero(digit[1:] & ~digit[:-1]) + 1
    corner, passed = np.searchsorted(begins, numbers, side="right") - 1, np.cumsum(slash, dtype=np.int32)
    column = passed[numbers] - passed[begins][corner]
    most = np.append(passed[begins[1:] - 1], passed[-1]) - passed[begins]
    found = _parsed(text.replace(b"/", b" "), np.int64)
    named_first = np.bincount(corner[column == 0], minlength=len(begins)) == 1
    if slash[begins].any() or (most > 2).any() or not named_first.all() or found is None or len(found) != len(numbers):
        return None
    indices = np.full((len(begins), 3), ABSENT)
    indices[corner, column] = found
    return indices


PLY_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2}


def check_ply(data: bytes, where: str) -> None:
    """Refuse a PLY file whose header promises more than follows.

    Raises:
        DataError: So it does, or it has no header.
    """
    header, found, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not found:
        raise DataError("has no header from `ply` to `end_header`", where=where, hint=AGAIN_HINT)
    if len(header) > LONGEST_HEADER or (body.count(b"\n") > MOST_ROWS and b"ascii" in header):
        allowed = f"{LONGEST_HEADER} characters of header, and {MOST_ROWS} lines of text"
        raise DataError("has too long a header or too many lines", where=where, allowed=allowed, hint=BINARY_HINT)
    is_text, name, least, total = b"ascii" in header.partition(b"element")[0], "", 0, 0
    for line, words in enumerate((text.split() for text in header.decode(errors="replace").splitlines()), 1):
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 18:
                raise DataError("is not a count of elements", where=f"{where}:{line}", allowed="element NAME COUNT")
            name, count = words[1], int(words[2])
            total += count
        elif words[:1] == ["property"] and name:
            least += count * (PLY_BYTES.get(words[-2], 4) if words[1] != "list" else 1)
    rows = sum(1 for _ in re.finditer(rb"[^\r\n]+", body)) if is_text else 0
    if (total > rows) if is_text else (least > len(body)):
        has = f"{rows} lines" if is_text else f"{len(body)} bytes"
        raise DataError(f"promises {total} elements, and has {has} of them", where=where, hint="it may be cut short")


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
        raise DataError("is not a glTF file: its JSON is not an object", where=where, hint=AGAIN_HINT)
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
