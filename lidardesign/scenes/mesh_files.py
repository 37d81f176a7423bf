"""Mesh files, read through trimesh and checked: refused, or repaired with a note.

Consistent orientation of faces is found from edges alone. Painted weights of a mesh are a number per vertex, or the
brightness of vertex colours.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from lidardesign.errors import BackgroundNote, DataError
from lidardesign.numerics import ROUNDING
from lidardesign.run.arrays import guarded
from lidardesign.run.inputs import MESH, check_bytes, read_file
from lidardesign.scenes.mesh_formats import AGAIN_HINT, check_count, check_gltf, check_ply, read_obj, read_off, read_stl
from lidardesign.scenes.scene import CLOUD_HINT, LARGEST_WEIGHT, Mesh, Sign, check_triangles
from lidardesign.scenes.surface import doubled_areas

if TYPE_CHECKING:
    import trimesh


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the first of each distinct row (N, K), sorted by row, and each row's index into them, (U,) and (N,).

    As `numpy.unique` along an axis, which takes minutes for the faces of a large scan.
    """
    order = np.lexsort(rows.T[::-1])
    is_new = np.ones(len(rows), dtype=bool)
    is_new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    group = np.empty(len(rows), dtype=np.int64)
    group[order] = np.cumsum(is_new) - 1
    return order[is_new], group


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index and ascending direction of each side of faces (F, 3), shapes (3 F,), and the faces per edge (E,)."""
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    # one number per edge: pairs of int32 fit into an int64
    number = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    _, edge, count = np.unique(number, return_inverse=True, return_counts=True)
    return edge.reshape(-1), start < end, count


def edge_defects(faces: np.ndarray) -> tuple[int, int]:
    """Number of open edges, and of edges between faces of opposite winding.

    An edge is open when an odd number of faces meets there. Where closed parts touch, four faces share an
    edge, two in each direction: that is no defect.
    """
    edge, upwards, count = _edges(faces)
    balance = np.bincount(edge, weights=np.where(upwards, 1.0, -1.0))
    is_open = count % 2 == 1
    return int(is_open.sum()), int((~is_open & (balance != 0)).sum())


def turned_to_agree(faces: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces (F, 3) wound consistently with their neighbours, and the number of flipped ones.

    Two faces that alone share an edge agree when they run along it in opposite directions. Within a part connected by
    such edges, the orientation of the larger area is kept; a part that cannot be oriented, as a Moebius strip, is left
    unchanged.

    Arguments:
        faces: Vertex indices, shape (F, 3).
        areas: Areas of the faces, in any unit, shape (F,).
    """
    # Pairs of faces that alone share an edge, shapes (P,)
    edge, upwards, count = _edges(faces)
    order = np.argsort(edge, kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])[count == 2]
    one, other = order[starts], order[starts + 1]
    part, flipped = _sides(len(faces), one // 3, other // 3, upwards[one] != upwards[other])
    # the orientation of the smaller area is flipped
    share = np.bincount(part, weights=np.where(flipped, areas, -areas))
    turn = flipped ^ (share[part] > 0)
    return np.where(turn[:, None], faces[:, ::-1], faces), int(turn.sum())


def _sides(count: int, first: np.ndarray, second: np.ndarray, agree: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Part of each face, and mask of the faces oriented against its first one.

    Every face is twice in a graph, once as it is and once flipped (the orientation double cover): a part whose two
    copies are connected cannot be oriented, and keeps its faces.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    across = np.where(agree, 0, count)
    rows = np.concatenate([first, first + count])
    columns = np.concatenate([second + across, (second + count) - across])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    sheet = connected_components(graph, directed=False)[1]
    part = np.minimum(sheet[:count], sheet[count:])
    return part, (sheet[:count] != part) & (sheet[:count] != sheet[count:])


COLOURS = "colours"
# luma of red, green and blue as they are stored (ITU-R BT.709)
LUMA = np.array([0.2126, 0.7152, 0.0722])
POSITIONS = ("x", "y", "z", "nx", "ny", "nz")


@dataclass(frozen=True)
class Painted:
    """Source of the painted weights in a mesh file.

    Arguments:
        attribute: Name of the vertex property with the weights, or `colours`.
        contrast: Weight of white over that of black; a brightness b between them has the weight contrast^b.
    """

    attribute: str
    contrast: float = 10.0


def painted_weights(part: trimesh.Trimesh, painted: Painted, where: str) -> np.ndarray:
    """Painted weight of each vertex of a mesh as loaded, shape (V,).

    Raises:
        DataError: It has no such property or no colours, or a weight is not a positive number.
    """
    if painted.attribute == COLOURS:
        return painted.contrast ** brightness(part, where)
    named = vertex_properties(part)
    if painted.attribute not in named:
        raise DataError(
            f"has no vertex property {painted.attribute!r}",
            where=where,
            allowed=", ".join([*sorted(named), COLOURS]),
            hint="PLY and glTF files keep properties of vertices; name one of these",
        )
    values = named[painted.attribute]
    if len(values) != len(part.vertices):
        raise DataError(
            f"has {len(values)} values of {painted.attribute!r} for {len(part.vertices)} vertices",
            where=where,
            hint="export the mesh without texture coordinates",
        )
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        raise DataError(f"vertex property {painted.attribute!r} is not one number per vertex", where=where)
    weights = values.astype(np.float64)
    wrong = ~((weights >= 1 / LARGEST_WEIGHT) & (weights <= LARGEST_WEIGHT))
    if wrong.any():
        raise DataError(
            f"{painted.attribute} of {int(wrong.sum())} vertices is not a usable weight, such as {weights[wrong][0]:g}",
            where=where,
            allowed=f"{1 / LARGEST_WEIGHT:g} to {LARGEST_WEIGHT:g}",
            hint="give a part that hardly matters a small weight, not 0",
        )
    return weights


def brightness(part: trimesh.Trimesh, where: str) -> np.ndarray:
    """Brightness of each vertex colour, 0 for black to 1 for white, shape (V,).

    Raises:
        DataError: The mesh has no vertex colours.
    """
    if part.visual.kind != "vertex":
        found = {"face": "colours of faces", "texture": "a texture"}.get(part.visual.kind or "", "no colours")
        raise DataError(
            f"has {found}, but none of vertices",
            where=where,
            allowed="vertex colours, as PLY, OBJ and glTF files have them",
            hint="paint vertices, or transfer the colours to them, and export these",
        )
    return part.visual.vertex_colors[:, :3] @ LUMA / 255.0


def vertex_properties(part: trimesh.Trimesh) -> dict[str, np.ndarray]:
    """Properties of a mesh's vertices by name, besides positions, normals and colours."""
    found = {name: _alone(values) for name, values in part.vertex_attributes.items()}
    data = part.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(data, "dtype", None), "names", None) or (data if isinstance(data, dict) else ())
    return found | {name: _alone(data[name]) for name in names if name not in POSITIONS}


def _alone(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values)
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
Y_UP = (".glb", ".gltf")  # by their format; the others do not say which axis points up
READERS = {".obj": read_obj, ".off": read_off, ".stl": read_stl}
TABLES = (".csv", ".npy", ".npz", ".txt")
# files of other formats by suffix: what they are, and what to do
OTHER_FORMATS = {
    **dict.fromkeys(TABLES, ("is at most a point cloud, not a mesh", CLOUD_HINT)),
    **dict.fromkeys(
        (".asc", ".e57", ".las", ".laz", ".pcd", ".pts", ".ptx", ".xyz"), ("is a point cloud, not a mesh", CLOUD_HINT)
    ),
    **dict.fromkeys(
        (".3ds", ".3mf", ".dae", ".wrl", ".x3d"),
        ("is a 3D model in a format that is not read", "open it in MeshLab and export it as PLY"),
    ),
    **dict.fromkeys(
        (".blend", ".fbx", ".usd", ".usda", ".usdc", ".usdz"),
        ("is a 3D scene in a format that is not read", "open it in Blender and export it as GLB"),
    ),
    **dict.fromkeys(
        (".brep", ".iges", ".igs", ".step", ".stp"), ("is a CAD model", "open it in FreeCAD and export it as STL")
    ),
    **dict.fromkeys(
        (".7z", ".bz2", ".gz", ".rar", ".tar", ".tgz", ".xz", ".zip", ".zst"), ("is an archive", "unpack it")
    ),
}
# a triangle is degenerate if its double area is a smaller share of its longest edge squared
FLATTEST_TRIANGLE = ROUNDING


def list_mesh_files(folder: str | Path) -> list[Path]:
    """Paths of the mesh files directly inside a folder, sorted by name.

    Raises:
        DataError: No such folder, or no mesh file in it; what is there instead.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError("is not a folder", where=str(folder), hint="name a folder that holds mesh files")
    entries = sorted(folder.iterdir())
    files = [p for p in entries if p.suffix.lower() in SUFFIXES and not (p.is_dir() or p.name.startswith("."))]
    if not files:
        known = {**dict.fromkeys(SUFFIXES, ("is in a folder inside it", "name that folder")), **OTHER_FORMATS}
        others = [p for p in (*folder.glob("*/*"), *entries) if p.suffix.lower() in known and p.name[0] != "."]
        # the last one is the most telling
        others.sort(key=lambda path: path.suffix.lower() not in TABLES)
        found, hint = known[others[-1].suffix.lower()] if others else ("", None)
        found = f"holds no mesh file; {others[-1].relative_to(folder)} {found}" if others else "holds no mesh file"
        raise DataError(found, where=str(folder), allowed=", ".join(SUFFIXES), hint=hint)
    return files


def load_mesh(path: str | Path, *, sign: Sign = "auto", scale: float = 1.0, painted: Painted | None = None) -> Mesh:
    """Load a checked mesh from a file; all geometry in it becomes one mesh.

    Arguments:
        path: A file of one of the formats `SUFFIXES`.
        sign: Rule of the sign of distances, see `check_mesh`.
        scale: Factor from the file's unit to metres (0.001 for millimetres).
        painted: Source of the importance in the file; None: importance 1 everywhere.

    Raises:
        DataError: The file is missing, unreadable, empty, or its mesh cannot be used, or it has no such importance; the
            message names it.
    """
    path = Path(path)
    if not (np.isfinite(scale) and scale > 0):
        raise DataError(f"the scale {scale} is not a factor to metres", where=str(path), allowed="a positive number")
    if path.suffix.lower() not in SUFFIXES:
        found, hint = OTHER_FORMATS.get(path.suffix.lower(), (f"has the suffix {path.suffix!r}", None))
        raise DataError(found, where=str(path), allowed=", ".join(SUFFIXES), hint=hint)
    data = read_file(path, MESH, hint="check the path")
    if not data.strip():
        raise DataError("is an empty file", where=str(path))
    # any failure to read it becomes a `DataError`
    vertices, faces, importance = guarded(lambda: _geometry(path, data, painted), path, AGAIN_HINT)
    with np.errstate(over="ignore", invalid="ignore"):  # too large values are refused below
        vertices = vertices * scale
    return check_mesh(vertices, faces, sign=sign, where=str(path), importance=importance)


def check_mesh(
    vertices: Any, faces: Any, *, sign: Sign = "auto", where: str = "mesh", importance: np.ndarray | None = None
) -> Mesh:
    """Build a mesh without degenerate faces, duplicate faces or unused vertices, with a valid sign rule.

    `auto` takes `solid` for a closed mesh, after flipping faces that disagree with their neighbours, and `unsigned` for
    an open one or one that has no outside (a Klein bottle), each with a note. Only an explicit `solid` refuses. A mesh
    that is inside out is flipped, with a note.

    Arguments:
        vertices: Positions [m], shape (V, 3).
        faces: Vertex indices, shape (F, 3).
        sign: Rule of the sign of distances, see `Mesh`.
        where: Name of the file or object in messages.
        importance: Weight of the surface at each vertex, shape (V,). Merged vertices get the geometric mean.

    Raises:
        DataError: Nothing usable is left, values are not finite, indices are wrong, or `sign` does not fit.
    """
    try:
        vertices = np.asarray(vertices, dtype=np.float64)
        faces = np.asarray(faces)
    except (TypeError, ValueError) as error:
        raise DataError(f"vertices or faces are not numbers ({error})", where=where) from error
    check_triangles(vertices, faces, where)
    if importance is not None and np.shape(importance) != vertices.shape[:1]:
        raise DataError(f"has {np.shape(importance)} weights for {len(vertices)} vertices", where=where)
    notes: list[str] = []
    # vertices at exactly the same place become one, as formats without shared vertices (STL) need; -0.0 is 0.0
    first, place = unique_rows(vertices + 0.0)
    vertices = vertices[first] + 0.0
    faces = usable_faces(vertices, place[faces.astype(np.int64)], notes)
    if not len(faces):
        raise DataError(f"no usable face is left ({'; '.join(notes)})", where=where)
    used, faces = np.unique(faces, return_inverse=True)
    if importance is not None:
        log_sums = np.bincount(place, np.log(importance), minlength=len(vertices))
        importance = np.exp(log_sums / np.bincount(place, minlength=len(vertices)))[used]
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    faces, rule = _oriented(vertices, faces, sign, notes, where)
    return Mesh(vertices, faces, rule, tuple(notes), importance)


def usable_faces(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    """Faces without degenerate and duplicate ones, each with a line in `notes` where any are dropped."""
    edges = np.roll(vertices[faces], -1, axis=1) - vertices[faces]
    longest = np.einsum("fek,fek->fe", edges, edges).max(axis=1)
    degenerate = doubled_areas(vertices[faces]) <= FLATTEST_TRIANGLE * longest
    if degenerate.any():
        notes.append(BackgroundNote(f"dropped {int(degenerate.sum())} degenerate faces (without area)"))
        faces = faces[~degenerate]
    first, _ = unique_rows(np.sort(faces, axis=1))
    if len(first) < len(faces):
        notes.append(BackgroundNote(f"dropped {len(faces) - len(first)} duplicate faces"))
    return faces[np.sort(first)]


def _oriented(
    vertices: np.ndarray, faces: np.ndarray, sign: Sign, notes: list[str], where: str
) -> tuple[np.ndarray, Literal["solid", "winding", "unsigned"]]:
    open_edges, mixed_edges = edge_defects(faces)
    if mixed_edges and sign in ("auto", "winding"):
        faces, turned = turned_to_agree(faces, doubled_areas(vertices[faces]))
        mixed_edges = edge_defects(faces)[1]
        if turned:
            notes.append(BackgroundNote(f"flipped {turned} faces that were wound against their neighbours"))
    if not open_edges and not mixed_edges and signed_volume_m3(vertices, faces) < 0:
        faces = faces[:, ::-1]
        notes.append(BackgroundNote("the mesh was inside out: all faces were flipped"))
    defects = [f"{open_edges} open edges"] * bool(open_edges)
    defects += [f"{mixed_edges} edges between faces of opposite winding"] * bool(mixed_edges)
    found = " and ".join(defects)
    if sign == "solid" and found:
        raise DataError(
            f"is not a solid: it has {found}",
            where=where,
            allowed="a closed, consistently wound mesh",
            hint="sign: auto, winding or unsigned, or close the mesh",
        )
    if sign != "auto":
        return faces, sign
    if not found:
        return faces, "solid"
    notes.append(
        BackgroundNote(
            f"open mesh ({found}): unsigned distances, no inside"
            if open_edges
            else f"closed mesh with {found}: it has no outside: unsigned distances"
        )
    )
    return faces, "unsigned"


def signed_volume_m3(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Enclosed volume of a closed mesh, negative when its normals point inwards [m^3]."""
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    return float(np.einsum("fk,fk->f", a, np.cross(b, c)).sum() / 6)


@contextmanager
def _quiet_trimesh() -> Iterator[None]:
    """Silence the log of loaders; a warning that means data loss becomes an error, where warnings are caught."""
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        # numpy stops at text that is no number and would drop the rest silently
        warnings.filterwarnings("error", "string or file could not be read")
        yield
    finally:
        log.setLevel(level)


@_quiet_trimesh()
def _geometry(path: Path, data: bytes, painted: Painted | None) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """All triangles of a file as one mesh, each part with its transform; weights if `painted` is given."""
    vertices, faces, weights, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0)], 0
    for part, transform in _parts(path, data):
        own = np.asarray(part.faces, dtype=np.int64)
        wrong = ((own < 0) | (own >= len(part.vertices))).any(axis=1)
        if wrong.any():
            first = int(np.argmax(wrong))
            raise DataError(
                f"triangle {first} of {len(own)} names the vertices {', '.join(map(str, own[first]))}",
                where=str(path),
                allowed=f"0 to {len(part.vertices) - 1}",
            )
        vertices.append(part.vertices @ transform[:3, :3].T + transform[:3, 3])
        faces.append(own + count)
        count += len(part.vertices)
        if painted is not None:
            weights.append(painted_weights(part, painted, str(path)))
    check_count(sum(map(len, faces)), str(path))
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(weights) if painted else None


def _parts(path: Path, data: bytes) -> Iterator[tuple[trimesh.Trimesh, np.ndarray]]:
    """Meshes of a file, each with its transform (4, 4)."""
    import trimesh

    suffix = path.suffix.lower()
    if suffix in READERS:
        vertices, faces, colours = READERS[suffix](data, str(path))
        yield trimesh.Trimesh(vertices, faces, process=False, vertex_colors=colours), np.eye(4)
        return
    if suffix == ".ply":
        check_ply(data, str(path))
        options = {"skip_materials": True, "fix_texture": False}
    else:
        check_gltf(data, str(path))
        options = {"skip_materials": True}
    scene = trimesh.load_scene(
        io.BytesIO(data), file_type=suffix[1:], resolver=_SameFolder(path), process=False, **options
    )
    points = [part.vertices for part in scene.geometry.values() if not isinstance(part, trimesh.Trimesh)]
    if len(points) == len(scene.geometry):  # refused as a point cloud
        yield trimesh.Trimesh(np.concatenate([np.zeros((0, 3)), *points]), process=False), np.eye(4)
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name]
        if isinstance(part, trimesh.Trimesh):
            _check_polygons(part, str(path))
            yield part, transform


def _check_polygons(part: trimesh.Trimesh, where: str) -> None:
    """Refuse a binary PLY whose faces have other numbers of corners than its first: their indices would be misread."""
    faces = part.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    for name in getattr(getattr(faces, "dtype", None), "names", None) or ():
        sizes = faces[name]["f0"] if faces[name].dtype.names else np.zeros(0)
        if sizes.size and (sizes != sizes[0]).any():
            raise DataError("has faces of several sizes", where=where, allowed="one size", hint="export triangles")


class _SameFolder:
    """Resolver that gives loaders files of a mesh's own folder only (the .bin buffers of a .gltf)."""

    def __init__(self, path: Path) -> None:
        self._folder = path.resolve().parent
        self._bytes = 0

    def get(self, name: str) -> bytes:
        """Content of a file of the same folder."""
        path = (self._folder / name).resolve()
        if path.parent != self._folder:
            raise DataError(f"refers to {name!r}, which is outside its folder", where=str(self._folder))
        content = read_file(path, MESH)
        self._bytes += len(content)
        check_bytes(self._bytes, MESH, str(path))
        return content

    __getitem__ = get
