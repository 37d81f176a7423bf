"""Mesh files of boxes and balls."""

from __future__ import annotations

import numpy as np
import trimesh

from lidardesign.scenes.scene import Mesh

BOX_VERTICES = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])

BOX_SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]

BOX_FACES = np.array([(a, *pair) for a, b, c, d in BOX_SIDES for pair in ((b, c), (c, d))])


def save(mesh, path):
    """A mesh as a file of its suffix's format, with the files beside it that gltf has."""
    content = mesh.export(file_type=path.suffix[1:])
    if isinstance(content, dict):
        for name in content.keys() - {"model.gltf"}:
            path.with_name(name).write_bytes(content[name])
        content = content["model.gltf"]
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def write_box(path, vertices=BOX_VERTICES, faces=BOX_FACES):
    return save(trimesh.Trimesh(vertices, faces, process=False), path)


def icosphere(radius=0.5, centre=(0.0, 0.0, 0.0), sign="solid", subdivisions=5):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh(mesh.vertices + np.asarray(centre), mesh.faces, sign)


def write_ball(path, radii, shift=(0.0, 0.0, 0.0)):
    ball = trimesh.creation.icosphere(3)
    path.parent.mkdir(exist_ok=True)
    save(trimesh.Trimesh(ball.vertices * radii + np.array(shift), ball.faces), path)
