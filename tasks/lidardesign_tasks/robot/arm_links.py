"""The shapes of an arm's links as they are seen: primitives as they are, all meshes of a link as one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.errors import DataError
from lidardesign.meshio import check_mesh
from lidardesign.mujoco_model import import_mujoco
from lidardesign.scene import Box, Capsule, Mesh, Shape, Sphere, rigid

if TYPE_CHECKING:
    import mujoco

VISUAL_GROUP = 2  # MuJoCo Menagerie's convention: what is seen is in group 2, what collides in group 3
BALL, TOOL = "lidardesign_ball", "lidardesign_tool"
CYLINDER_SIDES = 24
UNSEEN_KINDS = ("plane", "hfield")  # floors and terrain: no sensor on the ceiling sees the ball through them


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


def seen_links(model: mujoco.MjModel, path: Path) -> tuple[tuple[Link, ...], tuple[str, ...]]:
    """All visible pieces of a model, the tool last, and notes on what was mended or left out.

    Raises:
        DataError: The arm has no visible shapes, or some that cannot be traced.
    """
    seen, notes, links = _seen_geoms(model), [], []
    for body in range(1, model.nbody):
        geoms = [geom for geom in seen if model.geom_bodyid[geom] == body]
        name = model.body(body).name or f"body{body}"
        meshes = [geom for geom in geoms if _kind(model, geom) in ("mesh", "cylinder")]
        if meshes:
            links.append(Link(name, body, _merged(model, f"{path}: link {name}", meshes), np.eye(4)))
        primitives = [geom for geom in geoms if geom not in meshes]
        links += [_primitive(model, path, body, name, geom) for geom in primitives]
    if len(links) < 2:
        raise DataError("the arm has no visible shapes", where=str(path), allowed="geoms of group 2 on its links")
    in_world = int((model.geom_bodyid[seen] == 0).sum())
    if in_world:
        notes.append(f"{path.name}: shapes that stand in the world, not on the arm, are left out: {in_world}")
    shapes = ((link.name, link.shape) for link in links)
    notes += [f"{path.name}: {name}: {note}" for name, shape in shapes for note in getattr(shape, "notes", ())]
    return _numbered([_without_notes(link) for link in links]), tuple(notes)


def _without_notes(link: Link) -> Link:
    """The link whose mesh has handed over its notes."""
    return replace(link, shape=replace(link.shape, notes=())) if isinstance(link.shape, Mesh) else link


def _numbered(links: list[Link]) -> tuple[Link, ...]:
    """Links with several pieces get a number behind their name; the tool comes last."""
    names, used = [link.name for link in links], dict.fromkeys((link.name for link in links), 0)
    numbered = []
    for link in sorted(links, key=lambda link: link.name == "tool"):
        used[link.name] += 1
        name = link.name if names.count(link.name) == 1 else f"{link.name} {used[link.name]}"
        numbered.append(replace(link, name=name))
    return tuple(numbered)


def _kind(model: mujoco.MjModel, geom: int) -> str:
    """The type of a geom, as "mesh" or "sphere"."""
    return import_mujoco().mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def _seen_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the geoms of the visual group, of all where only tool and ball are in it; without the ball."""
    solid = np.array([_kind(model, geom) not in UNSEEN_KINDS for geom in range(model.ngeom)])
    visual = solid & (model.geom_group == VISUAL_GROUP)
    chosen = visual if visual.sum() > len((BALL, TOOL)) else solid
    chosen[model.geom(BALL).id] = False
    return np.flatnonzero(chosen)


def _primitive(model: mujoco.MjModel, path: Path, body: int, name: str, geom: int) -> Link:
    kind, size = _kind(model, geom), model.geom_size[geom].tolist()
    shape: Shape
    if kind == "sphere":
        shape = Sphere(size[0])
    elif kind == "capsule":
        shape = Capsule(size[0], size[1])
    elif kind == "box":
        shape = Box((size[0], size[1], size[2]))
    else:
        allowed = "meshes, spheres, capsules, boxes and cylinders"
        raise DataError(f"link {name} has a shape of type {kind}", where=str(path), allowed=allowed)
    return Link("tool" if model.geom(geom).name == TOOL else name, body, shape, _geom_pose(model, geom))


def _geom_pose(model: mujoco.MjModel, geom: int) -> np.ndarray:
    matrix = np.zeros(9)
    import_mujoco().mju_quat2Mat(matrix, model.geom_quat[geom])
    return rigid(matrix.reshape(3, 3), model.geom_pos[geom])


def _merged(model: mujoco.MjModel, where: str, geoms: list[int]) -> Mesh:
    """Mesh and cylinder geoms of a body as one mesh in the body's frame."""
    vertices, faces, count = [], [], 0
    for geom in geoms:
        points, triangles = _triangles(model, geom)
        pose = _geom_pose(model, geom)
        vertices.append(points @ pose[:3, :3].T + pose[:3, 3])
        faces.append(triangles + count)
        count += len(points)
    return check_mesh(np.concatenate(vertices), np.concatenate(faces), where=where)


def _triangles(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3) of a mesh or cylinder in the geom's frame."""
    if _kind(model, geom) == "cylinder":
        return _cylinder(*model.geom_size[geom][:2].tolist())
    mesh = int(model.geom_dataid[geom])
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first_face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = np.array(model.mesh_vert[first : first + count], dtype=np.float64)
    return vertices, np.array(model.mesh_face[first_face : first_face + faces], dtype=np.int64)


def _cylinder(radius_m: float, half_length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A closed prism with its corners on the cylinder around the z axis."""
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
