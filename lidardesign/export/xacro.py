"""ROS: the same links and sensors as `urdf`, as a xacro macro that mounts them on a robot's own link.

`<xacro:include filename="FILE"/>` and `<xacro:NAME parent="base_link" prefix=""/>` in the robot's description; poses
are relative to the parent.
"""

from __future__ import annotations

from pathlib import Path

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import identifier
from lidardesign.export.common.poses import held_rounding, mounts
from lidardesign.export.common.xml import element, read_xml, write_xml
from lidardesign.export.sdf import matched
from lidardesign.export.urdf import held_sensors, mounted_parts, notes
from lidardesign.geometry.rays import Rays

NAMESPACE = "http://www.ros.org/wiki/xacro"
MACRO = "xacro:macro"


def write(design: DesignSpec, rays: Rays, path: Path, rate_hz: float = Bandwidth().rate_hz) -> list[str]:
    """Write the macro, atomically; returns how to use it and notes of what the format cannot hold."""
    name, mounted = identifier(design.name), mounts(design, rays)
    parts = [part for one in mounted for part in mounted_parts(one, rate_hz, parent="${parent}", prefix="${prefix}")]
    macro = element(MACRO, {"name": name, "params": "parent prefix:=''"}, parts)
    write_xml(path, element("robot", {"xmlns:xacro": NAMESPACE, "name": name}, [macro]))
    usage = f'include it and call <xacro:{name} parent="base_link"/>: poses are relative to the parent'
    return [usage, *notes(design, mounted, rays)]


def rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """How far the rays of the described sensors are from the design's.

    Raises:
        DataError: The file holds no such macro.
    """
    mounted = mounts(design, rays)
    macro = read_xml(path, "robot").find(f"{{{NAMESPACE}}}macro")
    if macro is None:
        raise DataError("holds no macro", where=str(path))
    return held_rounding(rays, mounted, matched(held_sensors(macro, path), mounted, path))
