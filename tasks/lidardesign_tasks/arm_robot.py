"""A robot arm read from MJCF: its kinematics in MuJoCo, and the shapes of its links as they are seen."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.errors import ConfigError, DataError
from lidardesign.meshio import check_mesh
from lidardesign.scene import Box, Capsule, Mesh, Shape, Sphere, rigid
from lidardesign_tasks.arm_files import model_files

if TYPE_CHECKING:
    import mujoco

JOINTS = 7
VISUAL_GROUP = 2  # MuJoCo Menagerie's convention: what is seen is in group 2, what collides in group 3
BALL_RADIUS_M = 0.02
TOOL_RADIUS_M = 0.015
FLANGE_SITE = "attachment_site"
BALL, TOOL = "lidardesign_ball", "lidardesign_tool"
CYLINDER_SIDES = 24
HOME_RAD = (0.0, np.pi / 4, 0.0, -np.pi / 2, 0.0, np.pi / 4, 0.0)


@dataclass(frozen=True, eq=False)
class Link:
    """One rigid piece of the arm as it is seen.

    Arguments:
        name: Of the link, with a number where it has several pieces.
        body: The index of its body in the MuJoCo model.
        shape: Its geometry; one `Mesh` object per link, shared by all scenes.
        pose: Of the shape in the body's frame, shape (4, 4).
    """

    name: str
    body: int
    shape: Shape
    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm of seven hinges with a tool along its flange's axis that holds a ball.

    Arguments:
        model: The MuJoCo model, with the tool, the ball and a site `BALL` at the ball's centre.
        links: What is seen of it, the tool last.
        home_rad: A comfortable posture, shape (7,).
        notes: What reading it left out or mended, one line each.
    """

    model: mujoco.MjModel
    links: tuple[Link, ...]
    home_rad: np.ndarray
    notes: tuple[str, ...]


def load_robot(path: Path | None, tool_m: float) -> Robot:
    """The arm of an MJCF file, or the embedded one, read once per process while its files stay the same.

    Arguments:
        path: The file; None takes the embedded arm of primitive links.
        tool_m: From the flange to the ball's centre [m].

    Raises:
        DataError: The file cannot be used: missing, no MJCF, files outside its folder, no chain of 7 hinges.
        ConfigError: MuJoCo is not installed.
    """
    if path is not None:
        return _read_once(str(path), model_files(path), tool_m)
    with as_file(files("lidardesign_tasks") / "data" / "iiwa14.xml") as embedded:
        return _read_once(str(embedded), (), tool_m)


@lru_cache(maxsize=4)
def _read_once(path: str, states: tuple[tuple[str, int, int], ...], tool_m: float) -> Robot:
    """`states` (name, time, size of all files) only tells a changed model from the one in memory."""
    mujoco = import_mujoco()
    with mujoco_warnings() as warnings:
        try:
            spec = mujoco.MjSpec.from_file(path)
            flange = _chain_end(spec, path)
            _add_tool(mujoco, spec, flange, tool_m)
            model = spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            reason = " ".join(str(error).split())
            raise DataError(
                f"MuJoCo cannot read it: {reason}", where=path, allowed="an MJCF model of one arm"
            ) from error
    _check_chain(mujoco, model, path)
    notes = [f"{Path(path).name}: MuJoCo warns: {' '.join(line.split())}" for line in warnings]
    links = _links(mujoco, model, path, notes)
    return Robot(model, links, _home(mujoco, model), tuple(notes))


def import_mujoco() -> Any:
    """MuJoCo, which takes a while to import and only this task needs; raises ConfigError where it is missing."""
    return _imported("mujoco")


def import_mink() -> Any:
    """mink, which solves inverse kinematics for MuJoCo; raises ConfigError where it is missing."""
    return _imported("mink")


def _imported(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"the arm task needs {name}, which cannot be imported ({error})",
            where="task arm",
            hint="pip install mujoco mink",
        ) from error


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collects MuJoCo's warnings, which would otherwise be written to MUJOCO_LOG.TXT in the working folder."""
    mujoco = import_mujoco()
    before, warnings = mujoco.get_mju_user_warning(), []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        mujoco.set_mju_user_warning(before)


def _chain_end(spec: Any, path: str) -> Any:
    """The body of the last joint."""
    joints = list(spec.joints)
    if len(joints) != JOINTS:
        raise DataError(
            f"has {len(joints)} joints", where=path, allowed=f"a chain of {JOINTS} hinge joints and no others"
        )
    return joints[-1].parent


def _add_tool(mujoco: Any, spec: Any, flange: Any, tool_m: float) -> None:
    """Fix the tool and the ball to the flange: the site `FLANGE_SITE` of the last link, or the link's frame."""
    site = next((site for site in flange.sites if site.name == FLANGE_SITE), None)
    start = np.zeros(3) if site is None else np.array(site.pos)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0]) if site is None else np.array(site.quat)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion / np.linalg.norm(quaternion))
    axis = matrix.reshape(3, 3)[:, 2]
    end = tool_m - BALL_RADIUS_M - TOOL_RADIUS_M  # its round end touches the ball
    flange.add_site(name=BALL, pos=start + tool_m * axis, quat=quaternion)
    fromto = np.concatenate([start, start + end * axis])
    shared = {"group": VISUAL_GROUP, "mass": 0.1}
    capsule, sphere = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE
    flange.add_geom(name=TOOL, type=capsule, size=[TOOL_RADIUS_M, 0, 0], fromto=fromto, **shared)
    flange.add_geom(name=BALL, type=sphere, size=[BALL_RADIUS_M, 0, 0], pos=start + tool_m * axis, **shared)


def _check_chain(mujoco: Any, model: Any, path: str) -> None:
    hinges = int((model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).sum())
    if model.njnt != JOINTS or hinges != JOINTS:
        found = f"has {model.njnt} joints, {hinges} of them hinges"
        raise DataError(found, where=path, allowed=f"a chain of {JOINTS} hinge joints and no others")
    ancestors = _ancestors(model, int(model.jnt_bodyid[-1]))
    if not set(model.jnt_bodyid.tolist()) <= ancestors:
        raise DataError(
            "its joints are not one chain", where=path, allowed=f"{JOINTS} hinges, each carrying the next"
        )


def _ancestors(model: Any, body: int) -> set[int]:
    """A body and all that carry it, without the world."""
    found = set()
    while body:
        found.add(body)
        body = int(model.body_parentid[body])
    return found


def _home(mujoco: Any, model: Any) -> np.ndarray:
    """The keyframe `home`, else the first one, else the posture of the embedded arm; within the joints' limits."""
    home = np.array(HOME_RAD)
    if model.nkey:
        key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
        home = np.array(model.key_qpos[max(key, 0)])
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.inf, np.inf]).T
    return np.clip(home, low, high)


def _links(mujoco: Any, model: Any, path: str, notes: list[str]) -> tuple[Link, ...]:
    """What is seen of every body: primitives as they are, all meshes of a body as one."""
    pieces: list[tuple[int, str, list[int]]] = []
    seen = _seen_geoms(mujoco, model)
    for body in range(1, model.nbody):
        geoms = [geom for geom in seen if model.geom_bodyid[geom] == body]
        meshes = [geom for geom in geoms if _is_mesh(mujoco, model, geom)]
        name = model.body(body).name or f"body{body}"
        if meshes:
            pieces.append((body, name, meshes))
        pieces += [(body, name, [geom]) for geom in geoms if geom not in meshes]
    left_out = int((model.geom_bodyid[seen] == 0).sum())
    if left_out:
        notes.append(f"{Path(path).name}: {left_out} shapes that stand in the world, not on the arm, are left out")
    links = [_link(mujoco, model, path, *piece, notes) for piece in pieces]
    if len(links) < 2:
        raise DataError("the arm has no visible shapes", where=path, allowed="geoms of group 2 on its links")
    return _numbered(sorted(links, key=lambda link: link.name == "tool"))


def _numbered(links: list[Link]) -> tuple[Link, ...]:
    """Links with several pieces get a number behind their name."""
    names = [link.name for link in links]
    seen: dict[str, int] = {}
    numbered = []
    for link in links:
        number = seen[link.name] = seen.get(link.name, 0) + 1
        name = link.name if names.count(link.name) == 1 else f"{link.name} {number}"
        numbered.append(Link(name, link.body, link.shape, link.pose))
    return tuple(numbered)


def _seen_geoms(mujoco: Any, model: Any) -> np.ndarray:
    """Indices of the geoms of the visual group, of all where only the tool is in it; without the ball."""
    solid = np.array([_kind(mujoco, model, geom) not in ("plane", "hfield") for geom in range(model.ngeom)])
    visual = solid & (model.geom_group == VISUAL_GROUP)
    added = [model.geom(BALL).id, model.geom(TOOL).id]
    chosen = visual if visual.sum() > len(added) else solid
    chosen[model.geom(BALL).id] = False
    return np.flatnonzero(chosen)


def _kind(mujoco: Any, model: Any, geom: int) -> str:
    """The type of a geom, as "mesh" or "sphere"."""
    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _is_mesh(mujoco: Any, model: Any, geom: int) -> bool:
    return _kind(mujoco, model, geom) in ("mesh", "cylinder")


def _link(
    mujoco: Any, model: Any, path: str, body: int, name: str, geoms: list[int], notes: list[str]
) -> Link:
    if _is_mesh(mujoco, model, geoms[0]):
        return Link(name, body, _merged(mujoco, model, path, name, geoms, notes), np.eye(4))
    kind, size = _kind(mujoco, model, geoms[0]), model.geom_size[geoms[0]].tolist()
    shape: Shape
    if kind == "sphere":
        shape = Sphere(size[0])
    elif kind == "capsule":
        shape = Capsule(size[0], size[1])
    elif kind == "box":
        shape = Box((size[0], size[1], size[2]))
    else:
        allowed = "meshes, spheres, capsules, boxes and cylinders"
        raise DataError(f"link {name} has a shape of type {kind}", where=path, allowed=allowed)
    is_tool = model.geom(geoms[0]).name == TOOL
    return Link("tool" if is_tool else name, body, shape, _geom_pose(mujoco, model, geoms[0]))


def _geom_pose(mujoco: Any, model: Any, geom: int) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
    return rigid(matrix.reshape(3, 3), model.geom_pos[geom])


def _merged(mujoco: Any, model: Any, path: str, name: str, geoms: list[int], notes: list[str]) -> Mesh:
    """All mesh geoms of a body as one mesh in the body's frame."""
    vertices, faces, count = [], [], 0
    for geom in geoms:
        points, triangles = _triangles(mujoco, model, geom)
        pose = _geom_pose(mujoco, model, geom)
        vertices.append(points @ pose[:3, :3].T + pose[:3, 3])
        faces.append(triangles + count)
        count += len(points)
    mesh = check_mesh(np.concatenate(vertices), np.concatenate(faces), where=f"{path}: link {name}")
    notes += [f"{Path(path).name}: link {name}: {note}" for note in mesh.notes]
    return Mesh(mesh.vertices, mesh.faces, mesh.sign)


def _triangles(mujoco: Any, model: Any, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3) of a mesh or cylinder in the geom's frame."""
    if _kind(mujoco, model, geom) == "cylinder":
        return _cylinder(*model.geom_size[geom][:2].tolist())
    mesh = int(model.geom_dataid[geom])
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first_face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
    return vertices, np.array(model.mesh_face[first_face : first_face + faces], dtype=np.int64)


def _cylinder(radius_m: float, half_length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A closed prism around the z axis with the volume's outline at its corners."""
    turn = 2 * np.pi * np.arange(CYLINDER_SIDES) / CYLINDER_SIDES
    ring = np.stack([radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1)
    low, high = (np.column_stack([ring, np.full(CYLINDER_SIDES, z)]) for z in (-half_length_m, half_length_m))
    centres = np.array([[0, 0, -half_length_m], [0, 0, half_length_m]])
    here = np.arange(CYLINDER_SIDES)
    after, up = np.roll(here, -1), CYLINDER_SIDES
    bottom, top = np.full(CYLINDER_SIDES, 2 * up), np.full(CYLINDER_SIDES, 2 * up + 1)
    faces = [(here, after, after + up), (here, after + up, here + up), (after, here, bottom)]
    faces.append((here + up, after + up, top))
    return np.concatenate([low, high, centres]), np.concatenate([np.stack(face, axis=1) for face in faces])
