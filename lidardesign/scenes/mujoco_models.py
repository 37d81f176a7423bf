"""MuJoCo models as bodies: MJCF and URDF files are read safely, and every visible geom becomes a `Body`.

MuJoCo is imported when a model is read. A model may only read files of its own folder.
"""

from __future__ import annotations

import math
import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.errors import BackgroundNote, DataError
from lidardesign.run.inputs import ROBOT_FILES, check_bytes, check_file, read_head
from lidardesign.run.xml import read_xml
from lidardesign.scenes.mesh_files import check_mesh
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Role, Shape, Sphere, rigid
from lidardesign.scenes.surface import grid_faces
from lidardesign.space import FARTHEST_M

if TYPE_CHECKING:
    import mujoco

DIRECTORIES = ("meshdir", "texturedir", "assetdir")
MAX_INCLUDES = MAX_DIRECTORIES = 100
# Limits of a model's size after reading: elements, copies of them, pixels, points of terrain, keyframes and user data.
# MuJoCo's time grows with the square of the elements, and faster with copies.
MOST_ELEMENTS, MOST_COPIES = 20_000, 2000
MOST_PIXELS, MOST_PLACES = 1 << 27, 1 << 21
MOST_NUMBERS = 10_000
REPEATING = ("replicate", "composite", "flexcomp")
FARTHEST_RANGE = 1e18  # of a joint [m or rad]: some models have 1e16 for no limit
PNG_BEGINNING = b"\x89PNG\r\n\x1a\n"
MESH_ENDINGS = (".obj", ".stl", ".msh")  # mesh formats of MuJoCo
# Groups that MuJoCo's viewer shows by default; Menagerie has visual geoms in group 2, collision geoms in group 3.
SHOWN_GROUPS = (0, 1, 2)
PRIMITIVES: dict[str, Callable[[float, float, float], Shape]] = {
    "sphere": lambda radius_m, *_: Sphere(radius_m),
    "box": lambda *half_extents_m: Box(half_extents_m),
    "capsule": lambda radius_m, half_length_m, _: Capsule(radius_m, half_length_m),
    "cylinder": lambda radius_m, half_length_m, _: Cylinder(radius_m, half_length_m),
    "ellipsoid": lambda *semi_axes_m: Ellipsoid(semi_axes_m),
}
ALLOWED = "an MJCF or URDF model that MuJoCo can load"
# What to do about a model that MuJoCo refuses, by words of its reason.
ADVICE = {
    "opening file": "put it there, or correct its name: upper and lower case differ; package:// is looked for in the "
    "model's folder and those above it",
    "area is too small": "leave the mesh out, which is a line or a point",
    "coplanar": "take the flat mesh out of collisions: no <collision> in a URDF, contype and conaffinity 0 in an MJCF",
    "content type": "convert the texture to PNG, or leave it out: rays see no textures",
    "eigenvalues": "correct its inertia, or leave it out",
    "invalid header": "of a pointer of Git LFS: git lfs pull; else write the mesh again",
    "is empty": "write the mesh again",
    "keyframe": "correct the keyframe, or leave it out",
    "plugin": "leave the plugin out: only shapes and joints count",
    "repeated name": "give one of the two another name",
    "top level": "only a root link may float: make it a root, or fix its joint",
    "vertices required": "of a pointer of Git LFS: git lfs pull; else leave out the mesh, which is empty or a line",
}
LEAST_MASS_KG = 1e-6  # and moment of inertia [kg m^2] of bodies whose own MuJoCo refuses
SHAPES, UNREAD = {"visual", "collision"}, "unread"  # of the links of a URDF

FileState = tuple[str, int, int]


@dataclass(frozen=True)
class RobotFile:
    """File of a model, folder of all its files (None: the file's own), and visible geom groups (None: the default)."""

    path: Path
    folder: Path | None = None
    groups: tuple[int, ...] | None = None


@dataclass(frozen=True, eq=False)
class ModelGeom:
    """A visible piece of a model: a geom, or all unnamed meshes of a body.

    Arguments:
        name: Name of the body, with the geom's name or a number where the body has several pieces.
        body_name: Name of its MuJoCo body, `world` for fixed geoms.
        geom_name: Name of the geom, empty where it has none.
        body: Index of its MuJoCo body.
        shape: Its geometry; keep it between scenes, since caches are keyed by the mesh object.
        pose: Pose of the shape in the body's frame, shape (4, 4).
    """

    name: str
    body_name: str
    geom_name: str
    body: int
    shape: Shape
    pose: np.ndarray

    def at(self, poses: np.ndarray, role: Role = "both") -> Body:
        """The piece as a body, at rest where it never moves; `poses` (F, nbody, 4, 4) are those of `body_poses`."""
        own = poses[:, self.body] @ self.pose
        return Body(self.shape, self.name, role, own[0] if (own == own[0]).all() else own)


@dataclass(frozen=True, eq=False)
class ModelBody:
    """A body of a scene, with the names of its MuJoCo body and geom."""

    body: Body
    body_name: str
    geom_name: str


def import_mujoco() -> Any:
    """Import MuJoCo, which takes a second, when it is used."""
    return import_module("mujoco")


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which would otherwise be written to MUJOCO_LOG.TXT in the working folder."""
    mujoco = import_mujoco()
    before, collected = mujoco.get_mju_user_warning(), []
    mujoco.set_mju_user_warning(collected.append)
    try:
        yield collected
    finally:
        mujoco.set_mju_user_warning(before)


def load_model(
    path: str | Path, *, folder: Path | None = None, edit: Callable[[mujoco.MjSpec], None] | None = None
) -> tuple[mujoco.MjModel, tuple[str, ...]]:
    """Load the model of an MJCF or URDF file, with MuJoCo's warnings, one line each.

    Arguments:
        path: The file.
        folder: Folder that must contain all its files; None: the file's own folder.
        edit: Function that changes its specification before it is compiled.

    Raises:
        DataError: A file is missing, unreadable, too large, outside the model's folder, or no model.
    """
    path = Path(path)
    root = _documents(path, folder)[1]
    said = _unread_notes(root, path)
    mujoco = import_mujoco()
    with mujoco_warnings() as collected, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if root.tag == "robot":
                spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
                spec.modelfiledir = str(path.parent)
            else:
                spec = mujoco.MjSpec.from_file(str(path))
            if edit is not None:
                edit(spec)
            model, changed = _compiled(spec, path)
        except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
            reason = " ".join(str(error).split())
            mesh = re.search(r"(?:STL|mesh) file '([^']*)/([^'/]+)'", reason)
            hint = next(
                (hint for words, hint in ADVICE.items() if words in reason), mesh and _conversion(*mesh.groups())
            )
            raise DataError(f"MuJoCo cannot read it: {reason}", where=str(path), allowed=ALLOWED, hint=hint) from error
    _check_places(model, path)
    if spec.compiler.discardvisual:
        collected.append("visual shapes are discarded, so rays meet the collision shapes")
    collected += [
        f"the range of joint {model.joint(number).name!r} ends below its start, so it has no limits"
        for number in np.flatnonzero(model.jnt_range[:, 0] > model.jnt_range[:, 1])
    ]
    lines = dict.fromkeys(" ".join(str(line).split()) for line in (*collected, *(one.message for one in caught)))
    return model, (*said, *changed, *(f"{path.name}: MuJoCo warns: {line}" for line in lines))


def _compiled(spec: mujoco.MjSpec, path: Path) -> tuple[mujoco.MjModel, list[str]]:
    """The compiled model, with other masses and a note where MuJoCo refuses its own, which rays do not meet."""
    try:
        return spec.compile(), []
    except ValueError as error:
        for mesh in spec.meshes:
            mesh.inertia = import_mujoco().mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.compiler.boundmass = spec.compiler.boundinertia = LEAST_MASS_KG
        spec.compiler.balanceinertia = True
        reason = " ".join(str(error).split())
        return spec.compile(), [
            f"{path.name}: MuJoCo refuses its masses ({reason}): meshes weigh as shells and bodies {LEAST_MASS_KG:g} "
            "kg or more, which no ray meets"
        ]


def _conversion(folder: str, pattern: str) -> str:
    """What to do about meshes that MuJoCo cannot read: a command that converts them."""
    code = (
        'import pathlib, trimesh; [trimesh.load_mesh(mesh).export(mesh.with_suffix(".obj")) '
        f'for mesh in pathlib.Path("{folder}").rglob("{pattern}")]'
    )
    return f"python -c {quote(code)} (DAE: after pip install pycollada), and name the OBJ files in the model"


def _check_places(model: mujoco.MjModel, path: Path) -> None:
    """Refuse poses, sizes and ranges that are not finite or too large, and height fields that are too large.

    Raises:
        DataError: Such a value, with its body, geom or joint.
    """
    for name in ("body_pos", "body_quat", "geom_pos", "geom_quat", "geom_size", "jnt_pos", "jnt_range"):
        rows, kind = getattr(model, name), name.partition("_")[0]
        most = FARTHEST_RANGE if name == "jnt_range" else FARTHEST_M
        wrong = ~(np.abs(rows) <= most).all(axis=1)
        if wrong.any():
            number = int(np.argmax(wrong))
            called = (model.joint if kind == "jnt" else getattr(model, kind))(number).name
            raise DataError(
                f"{name} of {called or f'{kind} {number}'!r} is {' '.join(map(str, rows[number].tolist()))}",
                where=str(path),
                allowed=f"numbers up to {most:g}",
            )
    places = int((model.hfield_nrow * model.hfield_ncol).sum())
    if places > MOST_PLACES:
        raise DataError(f"has {places} places of height fields", where=str(path), allowed=f"at most {MOST_PLACES}")


def bodies_from_mujoco(
    model: mujoco.MjModel, qpos: np.ndarray, *, groups: Sequence[int] | None = None, clip_m: float | None = None
) -> list[ModelBody]:
    """Every visible geom of a model as a body that moves with its joints.

    Arguments:
        model: From `load_model` or from MuJoCo itself.
        qpos: Joint configurations, one per frame, shape (F, nq), or one for a scene at rest, shape (nq,).
        groups: Visible groups of geoms; None: 0, 1 and 2, as MuJoCo shows them, without collision shapes of bodies that
            have visual ones in another group.
        clip_m: Largest half size of planes [m]; None: their own size.

    Raises:
        DataError: No geom is visible, or `qpos` does not fit the model.
    """
    poses = body_poses(model, qpos)
    geoms, _ = visible_geoms(model, groups=groups, clip_m=clip_m)
    return [ModelBody(geom.at(poses), geom.body_name, geom.geom_name) for geom in geoms]


def body_poses(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Poses of all bodies of a model, body to world, shape (F, nbody, 4, 4).

    Arguments:
        model: The MuJoCo model.
        qpos: Joint configurations, shape (F, nq) or (nq,).

    Raises:
        DataError: `qpos` has another shape, or is not finite.
    """
    qpos = np.atleast_2d(np.asarray(qpos, dtype=np.float64))
    if qpos.ndim != 2 or qpos.shape[1] != model.nq or not len(qpos) or not np.isfinite(qpos).all():
        raise DataError(f"joint configurations of shape {qpos.shape}", allowed=f"(frames, {model.nq}), finite")
    mujoco = import_mujoco()
    data, poses = mujoco.MjData(model), np.tile(np.eye(4), (len(qpos), model.nbody, 1, 1))
    for frame, configuration in enumerate(qpos):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        poses[frame, :, :3, :3] = data.xmat.reshape(-1, 3, 3)
        poses[frame, :, :3, 3] = data.xpos
    return poses


def visible_geoms(
    model: mujoco.MjModel, *, groups: Sequence[int] | None = None, clip_m: float | None = None
) -> tuple[tuple[ModelGeom, ...], tuple[str, ...]]:
    """Visible pieces of a model, body by body, and notes on repaired and omitted geometry.

    Arguments:
        model, groups, clip_m: As in `bodies_from_mujoco`.

    Raises:
        DataError: No geom is visible, or the mesh of one cannot be used.
    """
    chosen, notes = seen_geoms(model, groups)
    pieces: list[ModelGeom] = []
    for body in np.unique(model.geom_bodyid[chosen]).tolist():
        name = model.body(body).name or f"body {body}"
        geoms = chosen[model.geom_bodyid[chosen] == body].tolist()
        nameless = [geom for geom in geoms if _is_mesh(model, geom) and not model.geom(geom).name]
        parts = [(geom, nameless if geom in nameless else [geom]) for geom in geoms if geom not in nameless[1:]]
        for number, (geom, own) in enumerate(parts, 1):
            label = model.geom(geom).name
            full = name if len(parts) == 1 else f"{name} {label or number}"
            shape, pose = _piece(model, full, own, clip_m)
            pieces.append(ModelGeom(full, name, label, body, shape, pose))
    notes += [
        type(note)(f"{piece.name}: {note}")
        for piece in pieces
        if isinstance(piece.shape, Mesh)
        for note in piece.shape.notes
    ]
    if model.nflex or model.nskin:
        notes.append(f"flexible bodies and skins are left out: {model.nflex + model.nskin}")
    return tuple(pieces), tuple(notes)


def seen_geoms(model: mujoco.MjModel, groups: Sequence[int] | None = None) -> tuple[np.ndarray, list[str]]:
    """Indices of the visible geoms of a model, ascending, and notes on omitted ones.

    Arguments:
        model, groups: As in `bodies_from_mujoco`.

    Raises:
        DataError: There are none.
    """
    shown = np.isin(model.geom_group, SHOWN_GROUPS if groups is None else list(groups))
    # MuJoCo's rays pass through fully transparent geoms, too
    alpha, coated = model.geom_rgba[:, 3].copy(), model.geom_matid >= 0
    alpha[coated] = model.mat_rgba[model.geom_matid[coated], 3]
    chosen = np.flatnonzero(shown & (alpha > 0))
    notes = []
    if groups is None:
        # collision shapes are coarse doubles where their body has visual shapes in another group
        bodies = model.geom_bodyid[chosen]
        places = bodies * import_mujoco().mjNGROUP + model.geom_group[chosen]
        collides = (model.geom_contype[chosen] != 0) | (model.geom_conaffinity[chosen] != 0)
        double = collides & (bodies > 0) & np.isin(bodies, bodies[~collides]) & ~np.isin(places, places[~collides])
        chosen = chosen[~double]
        if double.any():
            notes.append(
                BackgroundNote(f"collision shapes are left out where their body has visual ones: {double.sum()}")
            )
    if not len(chosen):
        used = ", ".join(str(group) for group in np.unique(model.geom_group[alpha > 0]))
        raise DataError(
            "the model has no visible geoms",
            allowed=used and f"groups that it uses: {used}",
            hint=f"--set 'groups=[{used}]' (task mujoco)"
            if used
            else "give the model that includes this part, or shapes with alpha",
        )
    return chosen, notes


def _kind(model: mujoco.MjModel, geom: int) -> str:
    """Type of a geom, as "mesh" or "sphere"."""
    return import_mujoco().mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _is_mesh(model: mujoco.MjModel, geom: int) -> bool:
    return _kind(model, geom) in ("mesh", "sdf")


def _piece(model: mujoco.MjModel, name: str, geoms: list[int], clip_m: float | None) -> tuple[Shape, np.ndarray]:
    """Shape of a geom, or of several meshes as one, and its pose in the body's frame."""
    pose, kind, size = _geom_pose(model, geoms[0]), _kind(model, geoms[0]), model.geom_size[geoms[0]].tolist()
    if _is_mesh(model, geoms[0]):
        return _merged(model, name, geoms), np.eye(4)
    if kind in PRIMITIVES:
        return PRIMITIVES[kind](*size), pose
    if kind == "hfield":
        return _height_field(model, name, int(model.geom_dataid[geoms[0]])), pose
    # a plane, infinite where its size is 0
    x, y = (min(half or np.inf, clip_m or np.inf) for half in size[:2])
    if np.isinf(max(x, y)):
        return Plane(), pose
    return Mesh([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]], [[0, 1, 2], [0, 2, 3]], "unsigned"), pose


def _geom_pose(model: mujoco.MjModel, geom: int) -> np.ndarray:
    matrix = np.zeros(9)
    import_mujoco().mju_quat2Mat(matrix, model.geom_quat[geom])
    return rigid(matrix.reshape(3, 3), model.geom_pos[geom])


def _merged(model: mujoco.MjModel, name: str, geoms: list[int]) -> Mesh:
    """Mesh geoms of a body as one mesh in the body's frame."""
    vertices, faces, count = [], [], 0
    for geom in geoms:
        mesh, pose = int(model.geom_dataid[geom]), _geom_pose(model, geom)
        first, number = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        first_face, face_number = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        points = np.array(model.mesh_vert[first : first + number], dtype=np.float64)
        vertices.append(points @ pose[:3, :3].T + pose[:3, 3])
        faces.append(np.array(model.mesh_face[first_face : first_face + face_number], dtype=np.int64) + count)
        count += len(points)
    return check_mesh(np.concatenate(vertices), np.concatenate(faces), where=name)


def _height_field(model: mujoco.MjModel, name: str, number: int) -> Mesh:
    """Terrain as a closed mesh in the geom's frame: MuJoCo's triangles, sides and a flat bottom."""
    rows, columns, start = (int(column[number]) for column in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    x_m, y_m, highest_m, base_m = model.hfield_size[number].tolist()
    height = highest_m * model.hfield_data[start : start + rows * columns]
    x, y = np.meshgrid(np.linspace(-x_m, x_m, columns), np.linspace(-y_m, y_m, rows))
    top = np.stack([x.ravel(), y.ravel(), height], axis=1)
    index = np.arange(rows * columns).reshape(rows, columns)
    # MuJoCo cuts its cells along the other diagonal than `grid_faces`
    faces = [index[:, ::-1].ravel()[grid_faces(rows, columns)][:, ::-1]]
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    foot, middle = np.arange(len(rim)) + rows * columns, np.full(len(rim), rows * columns + len(rim))
    after, after_foot = np.roll(rim, -1), np.roll(foot, -1)
    sides = ((foot, after_foot, after), (foot, after, rim), (after_foot, foot, middle))
    faces += [np.stack(corners, axis=1) for corners in sides]
    feet = np.concatenate([top[rim, :2], [[0.0, 0.0]]])
    vertices = np.concatenate([top, np.column_stack([feet, np.full(len(feet), -base_m)])])
    return check_mesh(vertices, np.concatenate(faces), where=name)


def model_files(path: Path, folder: Path | None = None) -> tuple[FileState, ...]:
    """Name, modification time [ns] and size of every file of an MJCF or URDF model, the XML files first.

    Raises:
        DataError: A file is missing, unreadable, no model, or lies outside the model's folder.
    """
    return _documents(path, folder)[0]


def _documents(path: Path, folder: Path | None) -> tuple[tuple[FileState, ...], ElementTree.Element]:
    """States as in `model_files`, and the root element of the first file, for a URDF with resolved mesh names."""
    own, allowed = path.resolve().parent, (folder or path.parent).resolve()
    documents, assets, directories, roots = [path.resolve()], [], {""}, []
    if folder is not None and not os.path.isdir(allowed):
        raise DataError("is not a folder", where=str(folder), hint="name the folder that holds all files of the model")

    def inside(directory: str, name: str) -> Path:
        """Resolved path of a file that the model names; raises DataError outside the allowed folder."""
        found = (own / directory / name).resolve()
        if not found.is_relative_to(allowed):
            wider = quote(f"folder={os.path.commonpath([own, found])}")
            raise DataError(
                f"reads {(Path(directory) / name).as_posix()!r}, which is outside the model's folder", where=str(path),
                hint=f"--set {wider} (task mujoco), or copy it into the model's folder" if found.exists() else
                "it is not on this machine: copy it into the model's folder, and correct its name",
            )  # fmt: skip
        return found

    for document in documents:  # grows while included files are found
        if len(documents) > MAX_INCLUDES:
            raise DataError(f"includes more than {MAX_INCLUDES} files", where=str(path))
        root = read_xml(document, ALLOWED, most_elements=MOST_ELEMENTS)
        if document == documents[0] and root.tag not in ("mujoco", "robot"):
            raise DataError(
                f"its root element is <{root.tag}>", where=str(path),
                allowed="<mujoco>, an MJCF model, or <robot>, a URDF model",
                hint="SDF: sdf2mjcf FILE.sdf FILE.xml (pip install sdformat-mjcf); a part: the model that includes it",
            )  # fmt: skip
        roots.append(root)
        if root.tag == "robot":
            parts = [element for part in root if part.tag != "gazebo" for element in part.iter()]
            if any(re.search(r"^xacro:|\$[{(]", " ".join((one.tag, *one.attrib.values()))) for one in parts):
                raise DataError(
                    "is xacro: run xacro first", where=str(path),
                    hint=f"xacro {quote(str(path))} > {quote(str(path.with_suffix('.plain.urdf')))} (pip install "
                    "xacro, or ROS), and give that file",
                )  # fmt: skip
            _settle_urdf(root, own, allowed)
        for element in root.iter():
            directories |= {element.get(name, "") for name in DIRECTORIES if element.tag == "compiler"}
            names = [value for key, value in element.attrib.items() if key == "file" or key.startswith("file")]
            if element.tag in ("include", "model"):
                documents += [found for name in names if (found := inside("", name)) not in documents]
            else:
                # of a URDF MuJoCo reads no textures and plugins
                is_read = root.tag == "mujoco" or element.tag == "mesh"
                assets += [one for one in names if one and (is_read or (own / one).resolve().is_relative_to(allowed))]
    if len(directories) > MAX_DIRECTORIES:
        raise DataError(f"names {len(directories)} folders", where=str(path), allowed=f"at most {MAX_DIRECTORIES}")
    found = {inside(directory, name) for directory in directories for name in ["", *assets]}
    files = [file for file in (*documents, *sorted(found)) if file.exists() and not file.is_dir()]
    states = tuple((str(file), file.stat().st_mtime_ns, check_file(file, ROBOT_FILES)) for file in files)
    check_bytes(sum(size for _, _, size in states), ROBOT_FILES, str(path))
    _check_growth(roots, set(files), path)
    return states, roots[0]


def _check_growth(roots: Sequence[ElementTree.Element], files: Collection[Path], path: Path) -> None:
    """Refuse a model that is small as text, but exceeds the limits once MuJoCo has read it.

    Raises:
        DataError: The quantity that is too large.
    """
    pixels = {file.name: _pixels(file) for file in files if file.suffix.lower() == ".png"}
    elements = [element for root in roots for element in root.iter()]
    copies = sum(map(_expanded, roots)) - len(elements)
    grown = {"elements": len(elements), "copies": copies, "pixels of textures": 0, "places of height fields": 0}
    for element in elements:
        drawn = sum(pixels.get(Path(name).name, 0) for key, name in element.attrib.items() if key.startswith("file"))
        if element.tag == "texture":
            width, height = _whole(element, "width"), _whole(element, "height")
            grown["pixels of textures"] += drawn + (width * height if element.get("type") == "2d" else 6 * width**2)
        elif element.tag == "hfield":
            grown["places of height fields"] += drawn + _whole(element, "nrow") * _whole(element, "ncol")
        elif element.tag == "size":
            for name in element.attrib:
                count = _whole(element, name)
                if (name == "nkey" or name.startswith("nuser_")) and count > MOST_NUMBERS:
                    raise DataError(f"{name} is {count}", where=str(path), allowed=f"at most {MOST_NUMBERS}")
    for (what, count), most in zip(grown.items(), (MOST_ELEMENTS, MOST_COPIES, MOST_PIXELS, MOST_PLACES), strict=True):
        if count > most:
            raise DataError(f"has {count:.4g} {what}", where=str(path), allowed=f"at most {most} in all")


def _expanded(element: ElementTree.Element) -> int:
    """Number of elements that one expands to: itself and its descendants, times its repetitions."""
    counts = element.get("count", "").split() if element.tag in REPEATING else []
    times = math.prod(max(int(count), 1) for count in counts if count.isdecimal() and len(count) < 12)
    return times * (1 + sum(map(_expanded, element)))


def _whole(element: ElementTree.Element, name: str) -> int:
    text = element.get(name, "0").strip()
    return int(text) if text.isdecimal() and len(text) < 12 else 0


def _pixels(path: Path) -> int:
    """Number of pixels by a PNG file's header; 0 for other files."""
    head = read_head(path, ROBOT_FILES)
    width, height = (int.from_bytes(head[begin : begin + 4], "big") for begin in (16, 20))
    return width * height if head.startswith(PNG_BEGINNING) else 0


def _settle_urdf(root: ElementTree.Element, own: Path, folder: Path) -> None:
    """Keep all links of a URDF and the visual shapes that MuJoCo can read, and resolve meshes relative to its folder.

    Where it cannot read a visual shape, those of all links with collision shapes become `UNREAD`: rays meet one kind.
    """
    extension = root.find("mujoco")
    extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    for name in ("discardvisual", "fusestatic", "strippath"):
        compiler.attrib.setdefault(name, "false")
    for mesh in root.iter("mesh"):
        scheme, _, name = mesh.get("filename", "").partition("://")
        package, _, inner = name.partition("/")
        bases = [own, *own.parents] if scheme in ("package", "model") else []
        # in the package, whose folder may have another name
        places = [base / inner for base in bases if base.name == package]
        places += [base / part for part in (name, inner) for base in bases]
        places = sorted(filter(os.path.isfile, places), key=lambda place: not place.is_relative_to(folder))
        if scheme == "file" or places:
            mesh.set("filename", os.path.relpath(places[0], own) if places else name)
    links = list(root.iterfind("link"))
    readable = {shape for link in links for shape in link if all(map(_is_readable, shape.iter("mesh")))}
    blind = not readable.issuperset(root.iterfind("link/visual"))
    solid = {link for link in links if blind and not readable.isdisjoint(link.iterfind("collision"))}
    hidden = {shape for link in solid for shape in link.iterfind("visual")}
    for element in [
        one for link in links for shape in link if shape in hidden or shape not in readable for one in shape.iter()
    ]:
        element.tag = UNREAD


def _is_readable(mesh: ElementTree.Element) -> bool:
    return mesh.get("filename", "").lower().endswith(MESH_ENDINGS)


def _unread_notes(root: ElementTree.Element, path: Path) -> list[str]:
    """Notes on what `_settle_urdf` leaves out of a URDF.

    Raises:
        DataError: No shape is left.
    """
    files = [
        path.resolve().parent / mesh.attrib["filename"]
        for mesh in root.iter(UNREAD)
        if "filename" in mesh.attrib and not _is_readable(mesh)
    ]
    if not files:
        return []
    links = {link.get("name", ""): {shape.tag for shape in link} for link in root.iterfind("link")}
    bare = ", ".join(name for name, tags in links.items() if UNREAD in tags and not tags & SHAPES)
    folders = [file.resolve().parent for file in files if file.is_file()] or [path.resolve().parent]
    what, hint = f"MuJoCo reads no {files[0].suffix}", _conversion(os.path.commonpath(folders), f"*{files[0].suffix}")
    if not any(tags & SHAPES for tags in links.values()):
        raise DataError(f"{what}, and no other shape is left", where=str(path), hint=hint)
    return [
        f"{path.name}: {what}, so rays meet other shapes of links, as those for collisions; links without any: "
        f"{bare or 'none'}; to read them: {hint}"
    ]
