"""Weights that someone painted on a mesh: a number per vertex, or the brightness of vertex colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.errors import DataError
from lidardesign.scene import LARGEST_WEIGHT

if TYPE_CHECKING:
    import trimesh

COLOURS = "colours"
# luma of red, green and blue as they are stored (ITU-R BT.709)
LUMA = np.array([0.2126, 0.7152, 0.0722])
POSITIONS = ("x", "y", "z", "nx", "ny", "nz")


@dataclass(frozen=True)
class Painted:
    """Where a file has its weights.

    Arguments:
        attribute: The name of a property of the vertices whose values are the weights, or `colours`.
        contrast: How many times as much white counts as black; a brightness b between them counts contrast^b.
    """

    attribute: str
    contrast: float = 10.0


def painted_weights(part: trimesh.Trimesh, painted: Painted, where: str) -> np.ndarray:
    """The weight of each vertex of a mesh as it was loaded, unprocessed, shape (V,).

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
    return _checked(values.astype(np.float64), painted.attribute, where)


def brightness(part: trimesh.Trimesh, where: str) -> np.ndarray:
    """How bright the colour of each vertex is, 0 for black to 1 for white, shape (V,).

    Raises:
        DataError: The mesh has no vertex colours.
    """
    kind = part.visual.kind
    if kind != "vertex":
        found = {"face": "colours of faces", "texture": "a texture"}.get(kind or "", "no colours")
        raise DataError(
            f"has {found}, but none of vertices",
            where=where,
            allowed="vertex colours, as PLY, OBJ and glTF files have them",
            hint="paint vertices, or transfer the colours to them, and export these",
        )
    return part.visual.vertex_colors[:, :3] @ LUMA / 255.0


def vertex_properties(part: trimesh.Trimesh) -> dict[str, np.ndarray]:
    """The properties of a mesh's vertices by name, besides positions, normals and colours."""
    found = {name: _alone(values) for name, values in part.vertex_attributes.items()}
    data = part.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(data, "dtype", None), "names", None) or (data if isinstance(data, dict) else ())
    for name in names:
        if name not in POSITIONS:
            found[name] = _alone(data[name])
    return found


def _alone(values: np.ndarray) -> np.ndarray:
    """The values of a property; a column of one number each as a list of numbers."""
    values = np.asarray(values)
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


def _checked(weights: np.ndarray, name: str, where: str) -> np.ndarray:
    wrong = ~((weights >= 1 / LARGEST_WEIGHT) & (weights <= LARGEST_WEIGHT))
    if wrong.any():
        raise DataError(
            f"{name} of {int(wrong.sum())} vertices is not a usable weight, as {weights[wrong][0]:g}",
            where=where,
            allowed=f"{1 / LARGEST_WEIGHT:g} to {LARGEST_WEIGHT:g}",
            hint="a part that hardly matters has a small weight, not 0",
        )
    return weights
