"""Gazebo: a gpu_lidar per sensor in one link of a static model, SDF 1.9.

A gpu_lidar fires an even grid of azimuth and elevation, the first and the last ray on the bounds, and has one range for
all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.even_grid import EvenGrid, grid_of, grid_sensor_losses
from lidardesign.export.common.names import element, identifier, number, numbers, read_xml, renamed_note, write_xml
from lidardesign.export.common.poses import Mount, ReadMount, mounts, mounts_rounding, quaternion
from lidardesign.geometry.frames import rotations_of_quaternions
from lidardesign.geometry.rays import Rays

VERSION = "1.9"
LINK = "lidar"
# Gazebo renders depth images, whose near plane must be in front of the camera.
NEAREST_M = 0.001


def write_sdf(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the model, atomically; returns notes of what the format cannot hold."""
    mounted = mounts(design, rays)
    sensors = [sensor_element(one, rate_hz, posed=True) for one in mounted]
    link = element("link", {"name": LINK}, sensors)
    model = element("model", {"name": identifier(design.name)}, [element("static", text="true"), link])
    write_xml(path, element("sdf", {"version": VERSION}, [model]))
    return sdf_losses(design, mounted, rays)


def sdf_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """How far the rays that Gazebo fires are from the design's."""
    mounted = mounts(design, rays)
    found = read_xml(path, "sdf").findall(f"model/link[@name='{LINK}']/sensor")
    return mounts_rounding(rays, mounted, [read_sensor(one, path) for one in found], path)


def sdf_losses(design: DesignSpec, mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Notes of what gpu_lidar sensors cannot hold."""
    near = [one for one in mounted if one.gate_m[0] < NEAREST_M]
    late = [one.gate_m[0] for one in mounted if one.gate_m[0] >= NEAREST_M]
    notes = grid_sensor_losses(design, mounted, rays)
    if late:
        notes.append(
            f"Gazebo does not draw what is nearer than a gate's start: {len(late)} of {len(mounted)} sensors look "
            f"through it, up to {max(late):.3g} m away, where this design's are blind behind it"
        )
    if near:
        notes.append(
            f"gates of {len(near)} of {len(mounted)} sensors start below {NEAREST_M:g} m, where Gazebo's depth camera "
            f"cannot: they start at {NEAREST_M:g} m"
        )
    names = [design.name, *(one.sensor.name for one in mounted)]
    return [*notes, *renamed_note(names, [identifier(design.name), *(one.name for one in mounted)])]


def sensor_element(mount: Mount, rate_hz: float, *, posed: bool, name: str | None = None) -> Element:
    """The <sensor> of a mount: at its pose, or at that of the link that holds it."""
    grid = grid_of(mount)
    start, end = max(mount.gate_m[0], NEAREST_M), max(mount.gate_m[1], NEAREST_M)
    axes = [
        _axis("horizontal", grid.columns, grid.azimuth_rad),
        _axis("vertical", grid.rows, grid.elevation_rad),
    ]
    interval = [element("min", text=number(start)), element("max", text=number(end))]
    lidar = element("lidar", children=[element("scan", children=axes), element("range", children=interval)])
    pose = numbers([*mount.origin_m, *mount.roll_pitch_yaw_rad])
    return element(
        "sensor",
        {"name": name or mount.name, "type": "gpu_lidar"},
        [
            *([element("pose", text=pose)] if posed else []),
            element("topic", text=f"/{name or mount.name}"),
            element("update_rate", text=number(rate_hz)),
            element("always_on", text="true"),
            element("visualize", text="true"),
            lidar,
        ],
    )


def _axis(name: str, samples: int, bounds_rad: tuple[float, float]) -> Element:
    return element(
        name,
        children=[
            element("samples", text=str(samples)),
            element("resolution", text="1"),
            element("min_angle", text=number(bounds_rad[0])),
            element("max_angle", text=number(bounds_rad[1])),
        ],
    )


def read_sensor(sensor: Element, path: Path, pose: np.ndarray | None = None) -> ReadMount:
    """What a <sensor> that `sensor_element` made holds, at its own pose or at a given one (6,).

    Raises:
        DataError: An element is missing, or is no number.
    """
    try:
        if pose is None:
            pose = np.array(str(sensor.findtext("pose")).split(), dtype=np.float64)
        start, end = (float(str(sensor.findtext(f"lidar/range/{name}"))) for name in ("min", "max"))
        columns, rows = (int(str(sensor.findtext(f"lidar/scan/{axis}/samples"))) for axis in ("horizontal", "vertical"))
        azimuth, elevation = (
            tuple(float(str(sensor.findtext(f"lidar/scan/{axis}/{name}_angle"))) for name in ("min", "max"))
            for axis in ("horizontal", "vertical")
        )
        turn = rotations_of_quaternions(np.array(quaternion(*pose[3:])))
    except (ValueError, TypeError) as error:
        raise DataError(f"holds no such lidar: {error}", where=str(path)) from error
    grid = EvenGrid(columns, rows, (azimuth[0], azimuth[1]), (elevation[0], elevation[1]))
    return ReadMount(pose[:3], grid.directions() @ turn.T, (start, end))
