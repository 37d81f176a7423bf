"""Files of what designs see: a folder of PLY or PCD clouds with the unseen surface beside them, or one MCAP file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidardesign.clouds.ros import NANOSECONDS, cloud_message, mcap_content, transforms_message
from lidardesign.clouds.seen import COLUMNS, SeenScene
from lidardesign.formats.meshes import FACES, ply_file
from lidardesign.formats.mount_page import mounted_parts
from lidardesign.formats.mounts import quaternion
from lidardesign.formats.names import identifier
from lidardesign.formats.robots import WORLD
from lidardesign.run.files import write_atomic, write_folder
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Outcome

FORMATS = ("ply", "pcd", "mcap")
PCD_KINDS = {"f": "F", "u": "U"}
OUTCOMES = " ".join(f"{outcome.value}={outcome.name.lower()}" for outcome in Outcome)


def write_clouds(seen: Sequence[SeenScene], path: Path, form: str) -> list[str]:
    """Write what a design sees; returns notes.

    Arguments:
        seen: Scene by scene.
        path: A folder, for mcap a file.
        form: ply, pcd or mcap.

    Raises:
        ConfigError: The library mcap is missing.
        DataError: It cannot be written.
    """
    if form == "mcap":
        write_atomic(path, _mcap(seen))
        name = seen[0].design.condition
        return [] if name is None else [f"/tf_static has the sensors at one {name}; clouds follow them"]
    files = {}
    for number, one in enumerate(seen):
        scene = f"{number:03d}_{identifier(one.scene.name)}"
        for entry in range(len(one.returns)):
            cloud = one.cloud(entry)
            files[f"{scene}_{entry:03d}.{form}"] = _ply(cloud) if form == "ply" else _pcd(cloud)
        vertices, faces = one.unseen()
        files[f"{scene}_unseen.ply"] = _surface(vertices, faces)
    return write_folder(path, files)


def _ply(cloud: np.ndarray) -> bytes:
    # CloudCompare reads properties with this prefix as scalar fields, named without it
    kinds = [(name if name in "xyz" else f"scalar_{name}", kind) for name, kind in COLUMNS]
    return ply_file([f"comment outcome {OUTCOMES}"], vertex=cloud.view(kinds))


def _pcd(cloud: np.ndarray) -> bytes:
    """A binary PCD file, version 0.7."""
    kinds = [cloud.dtype[name] for name in cloud.dtype.names or ()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {' '.join(cloud.dtype.names or ())}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(PCD_KINDS[kind.kind] for kind in kinds)}", f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(cloud)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(cloud)}", "DATA binary", "",
    ]  # fmt: skip
    return "\n".join(header).encode() + cloud.tobytes()


def _surface(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    points = np.rec.fromarrays(vertices.T, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    table = np.zeros(len(faces), dtype=FACES)
    table["corners"], table["vertex_indices"] = 3, faces
    return ply_file(["comment target surface that no sensor sees"], vertex=points, face=table)


def _mcap(seen: Sequence[SeenScene]) -> bytes:
    """All frames one after the other, each a frame's time after the one before."""
    design = seen[0].design
    parent = design.mount or WORLD
    frames = [
        (f"{one.name}_link", one.sensor.origin_m, quaternion(*one.roll_pitch_yaw_rad)) for one in mounted_parts(design)
    ]
    clouds, time_ns = [], 0
    for one in seen:
        for entry in range(len(one.returns)):
            clouds.append((time_ns, cloud_message(one.cloud(entry), time_ns, parent)))
            # clouds do not overlap in time
            time_ns += round(NANOSECONDS / min(one.scene.frame_rate_hz, DEFAULT_RATE_HZ))
    return mcap_content(clouds, transforms_message(parent, frames))
