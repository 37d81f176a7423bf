"""MuJoCo: a body per sensor, a site per ray whose +z looks along it, and a rangefinder on each.

`sensordata` has the rays in their own order: the distance [m], -1 where nothing is hit, and the gate's end where what
is hit lies beyond (`cutoff`). The start of the gate, the sensor's number and the firing time stand in the rangefinder's
user data, which MuJoCo keeps (`model.sensor_user`) and does not use. The file is a model of its own and may be
included in another one. Rangefinders see neither geoms of their own body nor ones that are fully transparent.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import distinct, element, number, numbers, read_xml, write_xml, xml_text
from lidardesign.export.common.poses import Mount, design_losses, mounts, rays_rounding
from lidardesign.geometry.frames import rotations_of_quaternions
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import SLACK, unit_vectors

WORLD = "world"
# Half of what a site of one ray is drawn as [m].
SITE_SIZE_M = 0.002


def write_mjcf(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the model, atomically; returns notes of what the format cannot hold."""
    mounted = mounts(design, rays)
    bodies = distinct([xml_text(one.sensor.name) for one in mounted], " ", taken=[WORLD])
    site = np.empty(len(rays), dtype=object)
    worldbody = element("worldbody")
    for mount, name in zip(mounted, bodies, strict=True):
        site[mount.ray] = [f"{name}_r{number}" for number in range(len(mount.ray))]
        worldbody.append(_body(mount, name, rays, site[mount.ray]))
    sensor = element("sensor", children=[_rangefinder(str(site[ray]), rays, ray) for ray in range(len(rays))])
    write_xml(path, element("mujoco", {"model": design.name}, [worldbody, sensor]))
    notes = design_losses(design, mounted)
    late = rays.gate_m[rays.gate_m[:, 0] > 0, 0]
    if len(late):
        notes.append(
            f"MuJoCo has no gate start: {len(late)} of {len(rays)} rays also see what is nearer than theirs, of "
            f"{late.min():.3g} to {late.max():.3g} m; it stands in the rangefinders' user data"
        )
    return [*notes, "a reading equal to the cutoff is a hit at or beyond the end of the gate; -1 is no hit"]


def read_mjcf(path: Path) -> Rays:
    """The rays of a file that `write_mjcf` made, in the order of its rangefinders.

    Raises:
        DataError: The file cannot be read, or is no such model.
    """
    root = read_xml(path, "mujoco")
    try:
        frames: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for body in root.iterfind("worldbody/body"):
            frames.update(_sites(body))
        found = list(root.iterfind("sensor/rangefinder"))
        user = np.array([_floats(one, "user") for one in found]).reshape(len(found), -1)
        origin = np.array([frames[one.attrib["site"]][0] for one in found]).reshape(-1, 3)
        looking = np.array([frames[one.attrib["site"]][1] for one in found]).reshape(-1, 3)
        return Rays(origin, unit_vectors(looking), user[:, :2], user[:, 2].astype(np.int64), user[:, 3])
    except (KeyError, ValueError, IndexError) as error:
        raise DataError(f"is no model of rangefinders: {error!r}", where=str(path)) from error


def mjcf_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose."""
    return rays_rounding(rays, read_mjcf(path) if len(rays) else rays, path)


def _body(mount: Mount, name: str, rays: Rays, sites: np.ndarray) -> Element:
    frame = mount.sensor.frame
    places = (rays.origin_m[mount.ray] - mount.origin_m) @ frame.T
    # The shortest rotations of +z to unit vectors (N, 3), as quaternions (w, x, y, z), shape (N, 4)
    x, y, z = (rays.direction[mount.ray] @ frame.T).T
    across = np.hypot(x, y)
    half = np.arctan2(across, z) / 2
    # straight down any axis across will do
    along = np.where(across > 0, across, 1.0)
    axis_x, axis_y = np.where(across > 0, -y / along, 1.0), x / along
    turns = np.stack([np.cos(half), np.sin(half) * axis_x, np.sin(half) * axis_y, np.zeros(len(x))], axis=1)
    made = [
        element(
            "site",
            {"name": str(site), "pos": numbers(place), "quat": numbers(turn), "size": number(SITE_SIZE_M)},
        )
        for site, place, turn in zip(sites, places, turns, strict=True)
    ]
    return element("body", {"name": name, "pos": numbers(mount.origin_m), "quat": numbers(mount.quaternion)}, made)


def _rangefinder(site: str, rays: Rays, ray: int) -> Element:
    start, end = rays.gate_m[ray]
    user = numbers([start, end, rays.sensor[ray], rays.time_s[ray]])
    # a cutoff of 0 would be none
    return element("rangefinder", {"name": site, "site": site, "cutoff": number(max(end, SLACK)), "user": user})


def _sites(body: Element) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Where each site of a body is and where its +z looks, in the world."""
    place, turn = _floats(body, "pos"), rotations_of_quaternions(_floats(body, "quat"))
    sites = list(body.iterfind("site"))
    local = np.array([_floats(one, "pos") for one in sites]).reshape(-1, 3)
    looking = rotations_of_quaternions(np.array([_floats(one, "quat") for one in sites]).reshape(-1, 4))[:, :, 2]
    world = zip(place + local @ turn.T, looking @ turn.T, strict=True)
    return {one.attrib["name"]: pose for one, pose in zip(sites, world, strict=True)}


def _floats(one: Element, name: str) -> np.ndarray:
    return np.array(one.attrib[name].split(), dtype=np.float64)
