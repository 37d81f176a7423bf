"""Ray patterns for Robotec GPU Lidar and its Gazebo plugin: a pattern file per sensor, and the model that uses them.

A pattern is one row-major 3 x 4 float32 matrix per ray, its pose in the sensor's frame (x forward, y left, z up); the
ray looks along the third axis of its pose. The plugin has one range for all rays of a sensor. The library's own call
takes one per ray, which is what the `.range2f` files are: pairs of float32.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.design.sensor import Design
from lidardesign.errors import DataError
from lidardesign.export.folders import write_folder
from lidardesign.export.names import identifier, renamed_note
from lidardesign.export.places import rays_of_parts, require_rays
from lidardesign.export.poses import Mount, design_losses, gate_losses, mounts, quaternion, rotation
from lidardesign.export.read_back import rays_rounding
from lidardesign.export.xml import child, document, element, numbers, read_xml
from lidardesign.numerics import unit_vectors
from lidardesign.simulate.returns import Rays
from lidardesign.space import angles

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from lidardesign.estimates import Estimate
    from lidardesign.export.places import Part

MODEL, PATTERN, RANGES = "model.sdf", ".mat3x4f", ".range2f"
SDF_VERSION = "1.9"


def write(design: Design, rays: Rays, path: Path, rate_hz: float) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the folder cannot be written.
    """
    require_rays(design, rays, "a ray pattern")
    path = Path(path)
    mounted = mounts(design, rays)
    root = element("sdf", {"version": SDF_VERSION})
    model = child(root, "model", name=identifier(design.name))
    child(model, "static", text=True)
    link = child(model, "link", name="lidar")
    files = {}
    for mount in mounted:
        files[f"{mount.name}{PATTERN}"] = _matrices(mount, rays.subset(mount.ray)).astype("<f4").tobytes()
        files[f"{mount.name}{RANGES}"] = rays.gate_m[mount.ray].astype("<f4").tobytes()
        _add_sensor(link, mount, rays, path.resolve() / f"{mount.name}{PATTERN}", rate_hz)
    notes = write_folder(path, {MODEL: document(root), **files})
    return [*notes, *_notes(design, mounted, path)]


def _notes(design: Design, mounted: list[Mount], path: Path) -> list[str]:
    notes = [
        f"{MODEL} names the patterns by their absolute paths in {path.resolve()}: export again where they move",
        "all rays of a frame fire at once: their times within the frame are not held",
    ]
    for lost in gate_losses(mounted):
        notes += [lost, f"the {RANGES} files hold each ray's own gate, for rgl_node_rays_set_range of the library"]
    names = [design.name, *(mount.sensor.name for mount in mounted)]
    written = [identifier(design.name), *(mount.name for mount in mounted)]
    return [*notes, *renamed_note(names, written), *design_losses(design, mounted)]


def _matrices(mount: Mount, rays: Rays) -> np.ndarray:
    """Poses of rays in their sensor's frame, which stands where the first of them starts, shape (K, 3, 4)."""
    looking = rays.direction @ mount.sensor.frame.T
    azimuth, _ = angles(looking)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(rays))], axis=1)
    offset = (rays.origin_m - rays.origin_m[0]) @ mount.sensor.frame.T
    return np.stack([np.cross(across, looking), across, looking, offset], axis=2)


def _add_sensor(link: Element, mount: Mount, rays: Rays, pattern: Path, rate_hz: float) -> None:
    """A sensor with the plugin that fires its pattern."""
    sensor = child(link, "sensor", name=mount.name, type="custom")
    child(sensor, "pose", text=numbers([*rays.origin_m[mount.ray[0]], *mount.roll_pitch_yaw_rad]))
    plugin = child(sensor, "plugin", filename="RGLServerPluginInstance", name="rgl::RGLServerPluginInstance")
    start, end = mount.gate_m
    limits = child(plugin, "range")
    child(limits, "min", text=start)
    child(limits, "max", text=end)
    child(plugin, "update_rate", text=float(rate_hz))
    child(plugin, "update_on_paused_sim", text=False)
    child(plugin, "topic", text=f"rgl/{mount.name}")
    child(plugin, "frame", text=mount.name)
    child(plugin, "pattern_preset_path", text=pattern)


def read(path: Path, design: Design, rays: Rays) -> Rays:
    """The rays of a folder that `write` made of a design and its rays, with their sensors and times.

    Raises:
        DataError: The folder cannot be read, or holds something else.
    """
    path = Path(path)
    sensors = read_xml(path / MODEL, "sdf").findall("model/link/sensor")
    found = {sensor.get("name"): sensor.findtext("pose", "") for sensor in sensors}
    parts = [_part(mount, path, found.get(mount.name, "")) for mount in mounts(design, rays)]
    return rays_of_parts(rays, parts, str(path))


def _part(mount: Mount, path: Path, pose: str) -> Part:
    """The rays of one sensor: its pose, and its pattern in the frame of that."""
    matrices = _floats(path / f"{mount.name}{PATTERN}", (3, 4))
    gate = _floats(path / f"{mount.name}{RANGES}", (2,))
    try:
        x, y, z, roll, pitch, yaw = (float(number) for number in pose.split())
    except ValueError as error:
        raise DataError(f"holds no pose of {mount.name}", where=str(path / MODEL), hint="export it again") from error
    turn = rotation(np.array(quaternion(roll, pitch, yaw)))
    return mount.ray, (x, y, z) + matrices[:, :, 3] @ turn.T, unit_vectors(matrices[:, :, 2] @ turn.T), gate


def _floats(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """The float32 records of a file as float64, shape (K, *shape)."""
    try:
        return np.fromfile(path, dtype="<f4").astype(np.float64).reshape(-1, *shape)
    except (OSError, ValueError) as error:
        raise DataError(f"cannot be read as a pattern: {error}", where=str(path), hint="export it again") from error


def rounding(design: Design, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose: patterns are float32."""
    return rays_rounding(rays, read(path, design, rays), path, times=False)
