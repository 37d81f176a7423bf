"""ROS: a link per sensor with Gazebo's gpu_lidar on it, as a URDF or as a xacro macro.

Links follow REP 103: x forward, y to the left, z up, in metres and radians. In the URDF they are fixed to a base link,
which is fixed to `world` and has a nominal mass: Gazebo leaves out links without one, with all that is fixed to them.
The macro mounts them on a robot's own link, `<xacro:include filename="FILE"/>` and
`<xacro:NAME parent="base_link" prefix=""/>` in the robot's description; poses are relative to the parent.
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
from lidardesign.export.common.names import element, identifier, numbers, read_xml, write_xml
from lidardesign.export.common.poses import Mount, ReadMount, mounts, mounts_rounding
from lidardesign.export.sdf import read_sensor, sdf_losses, sensor_element
from lidardesign.geometry.rays import Rays

# No sensor's link is called so: those end in _link. Nor its joint, for none has the name of the world.
WORLD, BASE = "world", "lidar_base"
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
BASE_MASS_KG, BASE_INERTIA_KG_M2 = 0.1, 0.0001


def write_urdf(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the description, atomically; returns notes of what the format cannot hold."""
    mounted = mounts(design, rays)
    parts = [part for one in mounted for part in mounted_parts(one, rate_hz, parent=BASE)]
    write_xml(path, element("robot", {"name": identifier(design.name)}, [*_base(), *parts]))
    mass = f"{BASE} has a nominal mass of {BASE_MASS_KG:g} kg, without which Gazebo would leave the sensors out"
    return [*urdf_losses(design, mounted, rays), mass]


def urdf_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """How far the rays of the described sensors are from the design's."""
    mounted = mounts(design, rays)
    found = read_sensors(read_xml(path, "robot"), path)
    return mounts_rounding(rays, mounted, found, path)


def urdf_losses(design: DesignSpec, mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Notes of what a description of links and Gazebo sensors cannot hold."""
    return [
        *sdf_losses(design, mounted, rays),
        "URDF has no sensors of its own: rays, gates and rates stand in <gazebo> extensions, which Gazebo reads",
    ]


def _base() -> list[Element]:
    """The base link, which has a mass, and what fixes it to the world."""
    moments = {name: numbers([BASE_INERTIA_KG_M2 * (name[1] == name[2])]) for name in _MOMENTS}
    mass = element("mass", {"value": numbers([BASE_MASS_KG])})
    inertial = element("inertial", children=[mass, element("inertia", moments)])
    ends = [element("parent", {"link": WORLD}), element("child", {"link": BASE})]
    joint = element("joint", {"name": f"{WORLD}_joint", "type": "fixed"}, ends)
    return [element("link", {"name": WORLD}), element("link", {"name": BASE}, [inertial]), joint]


def mounted_parts(mount: Mount, rate_hz: float, *, parent: str, prefix: str = "") -> list[Element]:
    """The link of a sensor, the joint that fixes it to a parent, and what Gazebo simulates on it."""
    name = f"{prefix}{mount.name}_link"
    origin = {"xyz": numbers(mount.origin_m), "rpy": numbers(mount.roll_pitch_yaw_rad)}
    joint = element(
        "joint",
        {"name": f"{prefix}{mount.name}_joint", "type": "fixed"},
        [
            element("parent", {"link": parent}),
            element("child", {"link": name}),
            element("origin", origin),
        ],
    )
    sensor = sensor_element(mount, rate_hz, posed=False, name=f"{prefix}{mount.name}")
    # what Gazebo publishes is then in the frame of the link, whose name ROS knows
    sensor.append(element("gz_frame_id", text=name))
    return [element("link", {"name": name}), joint, element("gazebo", {"reference": name}, [sensor])]


def read_sensors(root: Element, path: Path) -> list[ReadMount]:
    """What the joints and Gazebo sensors below an element hold, in their order.

    Raises:
        DataError: A joint is missing, or has no origin.
    """
    joints = {}
    for joint in root.iterfind("joint"):
        child = joint.find("child")
        if child is not None:
            joints[child.attrib.get("link", "")] = joint
    found = []
    for extension in root.iterfind("gazebo"):
        try:
            origin = next(joints[extension.attrib["reference"]].iterfind("origin"))
            values = f"{origin.attrib['xyz']} {origin.attrib['rpy']}".split()
            found.append(read_sensor(extension[0], path, np.array(values, dtype=np.float64)))
        except (KeyError, StopIteration, IndexError, ValueError) as error:
            raise DataError(f"holds no joint for a sensor: {error!r}", where=str(path)) from error
    return found


NAMESPACE = "http://www.ros.org/wiki/xacro"
MACRO = "xacro:macro"


def write_xacro(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the macro, atomically; returns how to use it and notes of what the format cannot hold."""
    name, mounted = identifier(design.name), mounts(design, rays)
    parts = [part for one in mounted for part in mounted_parts(one, rate_hz, parent="${parent}", prefix="${prefix}")]
    macro = element(MACRO, {"name": name, "params": "parent prefix:=''"}, parts)
    write_xml(path, element("robot", {"xmlns:xacro": NAMESPACE, "name": name}, [macro]))
    usage = f'include it and call <xacro:{name} parent="base_link"/>: poses are relative to the parent'
    return [usage, *urdf_losses(design, mounted, rays)]


def xacro_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """How far the rays of the described sensors are from the design's.

    Raises:
        DataError: The file holds no such macro.
    """
    mounted = mounts(design, rays)
    macro = next((part for part in read_xml(path, "robot") if part.tag == MACRO), None)
    if macro is None:
        raise DataError("holds no macro", where=str(path))
    return mounts_rounding(rays, mounted, read_sensors(macro, path), path)
