"""Ray patterns for Robotec GPU Lidar and its Gazebo plugin: a pattern file per sensor, and the model that uses them.

A pattern is one row-major 3 x 4 float32 matrix per ray, its pose in the sensor's frame (x forward, y left, z up); the
ray looks along the third axis of its pose. The plugin has one range for all rays of a sensor and fires them at once;
the library's own calls take a range and a time per ray, which is what the `.range2f` files (pairs of float32, metres)
and the `.time1f` files (float32, milliseconds) are.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import (
    child,
    document,
    element,
    identifier,
    numbers,
    read_xml,
    renamed_note,
    write_folder,
)
from lidardesign.export.common.poses import (
    Mount,
    design_losses,
    fire_times_s,
    gate_losses,
    mounts,
    quaternion,
    rays_of_parts,
    rays_rounding,
    require_rays,
)
from lidardesign.geometry.frames import rotations_of_quaternions
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import unit_vectors
from lidardesign.space import angles

MODEL, PATTERN, RANGES, TIMES = "model.sdf", ".mat3x4f", ".range2f", ".time1f"
MS_PER_S = 1000.0
POSE_NUMBERS = 6


def write_rgl(design: DesignSpec, rays: Rays, path: Path, rate_hz: float) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the folder cannot be written.
    """
    require_rays(design, rays, "a ray pattern")
    path = Path(path)
    mounted = mounts(design, rays)
    root = element("sdf", {"version": "1.9"})
    model = child(root, "model", name=identifier(design.name))
    child(model, "static", text=True)
    link = child(model, "link", name="lidar")
    files = {}
    times_ms = MS_PER_S * fire_times_s(rays, rate_hz)
    for mount in mounted:
        files[f"{mount.name}{TIMES}"] = times_ms[mount.ray].astype("<f4").tobytes()
        files[f"{mount.name}{PATTERN}"] = _matrices(mount, rays.subset(mount.ray)).astype("<f4").tobytes()
        files[f"{mount.name}{RANGES}"] = rays.gate_m[mount.ray].astype("<f4").tobytes()
        # A sensor with the plugin that fires its pattern
        sensor = child(link, "sensor", name=mount.name, type="custom")
        child(sensor, "pose", text=numbers([*rays.origin_m[mount.ray[0]], *mount.roll_pitch_yaw_rad]))
        plugin = child(sensor, "plugin", filename="RGLServerPluginInstance", name="rgl::RGLServerPluginInstance")
        start, end = mount.gate_m
        limits = child(plugin, "range")
        child(limits, "min", text=start)
        child(limits, "max", text=end)
        settings = {
            "update_rate": float(rate_hz),
            "update_on_paused_sim": False,
            "topic": f"rgl/{mount.name}",
            "frame": mount.name,
            "pattern_preset_path": path.resolve() / f"{mount.name}{PATTERN}",
        }
        for tag, value in settings.items():
            child(plugin, tag, text=value)
    notes = [
        *write_folder(path, {MODEL: document(root), **files}),
        f"{MODEL} names the patterns by their absolute paths in {path.resolve()}: export again where they move",
        f"the plugin fires all rays of a frame at once; the {TIMES} files hold when each fires, for "
        "rgl_node_rays_set_time_offsets of the library",
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


def read_rgl(path: Path, design: DesignSpec, rays: Rays) -> tuple[Rays, float]:
    """The rays of a folder that `write_rgl` made of a design and its rays, with their sensors, and the frame rate [Hz].

    Raises:
        DataError: The folder cannot be read, or holds something else.
    """
    path = Path(path)
    found = {sensor.get("name"): sensor for sensor in read_xml(path / MODEL, "sdf").findall("model/link/sensor")}
    times_s, rates_hz, parts = np.zeros(len(rays)), [], []
    for mount in mounts(design, rays):
        pose, rate_hz = _pose_and_rate(found.get(mount.name), mount, path)
        # The rays of one sensor: its pose, and its pattern in the frame of that
        matrices = _floats(path / f"{mount.name}{PATTERN}", (3, 4))
        gate = _floats(path / f"{mount.name}{RANGES}", (2,))
        turn = rotations_of_quaternions(np.array(quaternion(*pose[3:])))
        looking = unit_vectors(matrices[:, :, 2] @ turn.T)
        parts.append((mount.ray, pose[:3] + matrices[:, :, 3] @ turn.T, looking, gate))
        rates_hz.append(rate_hz)
        times = _floats(path / f"{mount.name}{TIMES}", ()) / MS_PER_S
        if len(times) != len(mount.ray):
            raise DataError(f"holds {len(times)} times of {len(mount.ray)} rays", where=str(path / mount.name))
        times_s[mount.ray] = times
    held = rays_of_parts(rays, parts, str(path))
    return Rays(held.origin_m, held.direction, held.gate_m, held.sensor, times_s), max(rates_hz)


def _pose_and_rate(sensor: Element | None, mount: Mount, path: Path) -> tuple[list[float], float]:
    try:
        pose = [float(number) for number in ("" if sensor is None else sensor.findtext("pose", "")).split()]
        rate_hz = float("" if sensor is None else sensor.findtext("plugin/update_rate", ""))
    except ValueError as error:
        raise DataError(f"holds no {mount.name}: {error}", where=str(path / MODEL), hint="export it again") from error
    if len(pose) != POSE_NUMBERS:
        raise DataError(f"holds no pose of {mount.name}", where=str(path / MODEL), hint="export it again")
    return pose, rate_hz


def _floats(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """The float32 records of a file as float64, shape (K, *shape)."""
    try:
        return np.fromfile(path, dtype="<f4").astype(np.float64).reshape(-1, *shape)
    except (OSError, ValueError) as error:
        raise DataError(f"cannot be read as a pattern: {error}", where=str(path), hint="export it again") from error


def rgl_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose: patterns are float32."""
    found, rate_hz = read_rgl(path, design, rays)
    return rays_rounding(replace(rays, time_s=fire_times_s(rays, rate_hz)), found, path)
