"""Designs as PLY and STL files, for CloudCompare, Blender, MeshLab and CAD; metres in the task's own frame.

`rays.ply` has a point per ray: its origin, its direction as the normal, its gate, time and sensor as properties.
`beams.ply` has the part of each ray inside its gate as an edge, `frusta.ply` the fields of view between start and end
of their gates as surfaces. Numbers are float64, colours distinguish sensors.

Mounting positions as STL: per sensor a small solid with its tip at the sensor's origin, widening along the boresight.

STL has no units and CAD programs take its numbers as millimetres, so the file is in millimetres. The solid is a pyramid
of 20 mm along the boresight; its far face is 16 mm wide at the bottom and 8 mm at the top, so the roll can be seen.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidardesign.formats import Format
from lidardesign.formats.names import identifier, numbers
from lidardesign.numerics import unit_vectors
from lidardesign.run.files import write_atomic, write_folder
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import field_on_sphere
from lidardesign.sensors.sensor import Sensor, tangent_directions

RAYS, BEAMS, FRUSTA = "rays.ply", "beams.ply", "frusta.ply"
PLACE = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
COLOUR = [("red", "u1"), ("green", "u1"), ("blue", "u1")]
NORMAL = [("nx", "<f8"), ("ny", "<f8"), ("nz", "<f8")]
# CloudCompare reads properties with this prefix as scalar fields, named without it.
RAY = [
    (f"scalar_{name}", kind)
    for name, kind in (("gate_start", "<f8"), ("gate_end", "<f8"), ("time", "<f8"), ("sensor", "<i4"))
]
FACE = [("corners", "u1"), ("vertex_indices", "<i4", (4,))]
FACES = [("corners", "u1"), ("vertex_indices", "<i4", (3,))]  # triangles
EDGE = [("vertex1", "<i4"), ("vertex2", "<i4")]
TYPES = {"f8": "double", "f4": "float", "u1": "uchar", "u2": "ushort", "i4": "int", "u4": "uint"}
# Distinguishable with every kind of colour vision (Okabe and Ito 2008).
COLOURS = np.array(
    [(0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0), (240, 228, 66)]
)
# Parts of each side of a shell: a field of 90 degrees bulges by 0.2 % of its range less than the sphere does.
PARTS = 12
# Common readers take lines of up to 1023 characters; a letter may be escaped to twelve.
LONGEST_NAME = 60


def write_ply(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold."""
    comments = [
        f"comment sensor {index} {json.dumps(one.name[:LONGEST_NAME])}" for index, one in enumerate(design.sensors)
    ]
    seen = [(index, one) for index, one in enumerate(design.sensors) if min(one.field_of_view_rad) > 0]
    files = {RAYS: ply_file(comments, vertex=_ray_points(rays)), BEAMS: _beams(rays, comments)}
    if seen:
        files[FRUSTA] = _frusta(seen, comments)
    notes = [*write_folder(path, files), "weights and origin covariances of the sensors are lost"]
    if len(seen) < len(design.sensors):
        notes.append(f"{len(design.sensors) - len(seen)} of {len(design.sensors)} sensors have no width, so no frustum")
    return [*notes, *_region_notes([sensor for _, sensor in seen], "frusta")]


PLY = Format(
    "ply",
    ".ply.d",
    "rays as points, beams as edges, fields of view as surfaces",
    write_ply,
    reader="CloudCompare, Blender, MeshLab",
    checked="loaded by trimesh; names as CloudCompare and Blender know them",
    is_folder=True,
)


def _region_notes(sensors: Sequence[Sensor], drawn: str) -> list[str]:
    """A note of the sensors that are regions, of which only the middles are drawn."""
    regions = [sensor.region_m for sensor in sensors if sensor.region_m > 0]
    wide = f"regions with a standard deviation of up to {max(regions, default=0.0):.3g} m"
    return [f"{len(regions)} sensors are {wide}: {drawn} stand in their middles"] if regions else []


def ply_file(comments: list[str], **elements: np.ndarray) -> bytes:
    """A PLY file of tables by the names of its elements, with comments."""
    header = ["ply", "format binary_little_endian 1.0", "comment lidardesign, metres, z up", *comments]
    for name, table in elements.items():
        names = table.dtype.names or ()
        header.append(f"element {name} {len(table)}")
        if "vertex_indices" in names:
            header.append("property list uchar int vertex_indices")
        else:
            header += [f"property {TYPES[table.dtype[name].str[1:]]} {name}" for name in names]
    return "\n".join([*header, "end_header", ""]).encode("ascii") + b"".join(
        table.tobytes() for table in elements.values()
    )


def _points(places: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Table of points with the colours of their sensors."""
    return np.rec.fromarrays([*places.T, *COLOURS[sensor % len(COLOURS)].T], dtype=PLACE + COLOUR)


def _ray_points(rays: Rays) -> np.ndarray:
    colour = COLOURS[rays.sensor % len(COLOURS)]
    columns = [*rays.origin_m.T, *rays.direction.T, *colour.T, *rays.gate_m.T, rays.time_s, rays.sensor]
    return np.rec.fromarrays(columns, dtype=PLACE + NORMAL + COLOUR + RAY)


def _beams(rays: Rays, comments: list[str]) -> bytes:
    """PLY file with two points per ray, at the start and end of its gate, and the edge between them."""
    places = rays.origin_m[:, None] + rays.gate_m[:, :, None] * rays.direction[:, None]
    edges = np.rec.fromarrays(np.arange(2 * len(rays)).reshape(-1, 2).T, dtype=EDGE)
    return ply_file(comments, vertex=_points(places.reshape(-1, 3), np.repeat(rays.sensor, 2)), edge=edges)


def _frusta(sensors: list[tuple[int, Sensor]], comments: list[str]) -> bytes:
    """PLY file of fields of view between the gates' ends: two shells and four sides each, as quadrilaterals."""
    # Corners of the faces of `_frustum`, seen from outside against the clock, shape (F, 4)
    side = PARTS + 1
    near = np.arange(side * side).reshape(side, side)
    far = near + side * side
    inner = np.stack([near[:-1, :-1], near[1:, :-1], near[1:, 1:], near[:-1, 1:]], axis=-1).reshape(-1, 4)
    outer = np.stack([far[:-1, :-1], far[:-1, 1:], far[1:, 1:], far[1:, :-1]], axis=-1).reshape(-1, 4)
    rim = [near[0], near[:, -1], near[-1, ::-1], near[::-1, 0]]
    walls = [np.stack([one[:-1], one[1:], one[1:] + side * side, one[:-1] + side * side], axis=-1) for one in rim]
    corners = np.concatenate([inner, outer, *walls])
    points, faces = [], []
    for number, (index, sensor) in enumerate(sensors):
        places = _frustum(sensor)
        points.append(_points(places, np.full(len(places), index)))
        faces.append(corners + number * len(places))
    table = np.zeros(len(faces) * len(corners), dtype=FACE)
    table["corners"], table["vertex_indices"] = 4, np.concatenate(faces)
    return ply_file(comments, vertex=np.concatenate(points), face=table)


def _frustum(sensor: Sensor) -> np.ndarray:
    """Points of the shell at the gate's start, then of that at its end, row by row upwards, (2 (PARTS + 1)^2, 3)."""
    across, up = (np.linspace(-extent / 2, extent / 2, PARTS + 1) for extent in field_on_sphere(sensor))
    looking = tangent_directions(sensor.frame, np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2))
    return np.concatenate([np.asarray(sensor.origin_m) + end * looking for end in sensor.gate_m])


MM_PER_M = 1000.0
# Forward, to the left and up from the tip [mm]: the tip, then the far face from its bottom right against the clock.
CORNERS_MM = np.array([(0, 0, 0), (20, -8, -6), (20, -4, 6), (20, 4, 6), (20, 8, -6)], dtype=np.float64)
# Seen from outside against the clock.
FACETS = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (1, 4, 3), (1, 3, 2)])
KEYWORDS = ("solid", "facet", "loop", "vertex")


def write_stl(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold."""
    write_atomic(path, "".join(_solid(index, sensor) for index, sensor in enumerate(design.sensors)))
    return [
        "numbers are millimetres: STL has no units, and CAD programs take that one",
        "sensors only: rays, fields of view, gates and weights are lost",
        *_region_notes(design.sensors, "solids"),
    ]


STL = Format(
    "stl",
    ".stl",
    "mounting positions as small solids, in millimetres",
    write_stl,
    reader="CAD programs",
    checked="loaded by trimesh as closed solids",
    holds=frozenset(),
)


def _solid(index: int, sensor: Sensor) -> str:
    # a name that contains no keyword of the format
    word = identifier(sensor.name)
    name = f"sensor_{index}" if any(key in word.lower() for key in KEYWORDS) else f"sensor_{index}_{word}"
    corners = MM_PER_M * np.asarray(sensor.origin_m) + CORNERS_MM @ sensor.frame
    facets = []
    for triangle in corners[FACETS]:
        normal = unit_vectors(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0]))
        vertices = "".join(f"   vertex {numbers(corner)}\n" for corner in triangle)
        facets.append(f" facet normal {numbers(normal)}\n  outer loop\n{vertices}  endloop\n endfacet\n")
    return f"solid {name}\n{''.join(facets)}endsolid {name}\n"
