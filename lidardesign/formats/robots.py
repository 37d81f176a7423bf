"""Robots and their simulators as XML: MuJoCo, Gazebo and ROS.

MuJoCo: a site per ray whose +z looks along it, and a rangefinder on each that fires at the frame rate. Sites are on the
body that carries the sensors, which rangefinders then do not see, or in the world on a body per sensor.

`sensordata` has the rays in their own order: the distance [m], negative without a hit, the gate's end for hits beyond
it (`cutoff`). The start of the gate, the sensor's number and the firing time are in the rangefinder's user data, which
MuJoCo keeps (`model.sensor_user`) and does not use. The file is a model of its own and may be included in another one,
or a copy of a robot's with the sensors in it. Rangefinders ignore fully transparent geoms.

Gazebo and ROS: a gpu_lidar per sensor, in SDF 1.9, in a URDF, or in a xacro macro.

A gpu_lidar fires an even grid of azimuth and elevation, the first and the last ray on the bounds, and has one range for
all of them. In SDF they are in one link of a static model. Gazebo draws the six faces of a cube around the sensor and
takes each range from the pixel in which the ray lies, that is, along the ray of its middle.

For ROS there is a link per sensor with Gazebo's gpu_lidar on it. Links follow REP 103: x forward, y to the left, z up,
in metres and radians. In the URDF they are fixed to a base link, which is fixed to `world` and has a nominal mass:
Gazebo leaves out links without one, with all that is fixed to them. The macro mounts them on a robot's own link,
`<xacro:include filename="FILE"/>` and `<xacro:NAME parent="base_link" prefix=""/>` in the robot's description; poses
are relative to the parent.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from lidardesign.errors import DataError
from lidardesign.formats import EVERY_STEP, RATE, RAYS, ROBOT, Format, WriteOptions
from lidardesign.formats.mjcf import EXPORTED, USER_VALUES, read_mjcf
from lidardesign.formats.mounts import (
    Mount,
    channel_mounts,
    design_losses,
    grid_of,
    grid_sensor_losses,
    mounts,
)
from lidardesign.formats.names import (
    distinct,
    document,
    element,
    identifier,
    numbers,
    renamed_note,
    xml_text,
)
from lidardesign.numerics import SLACK
from lidardesign.run.files import write_atomic
from lidardesign.scenes.mujoco_models import RobotFile, load_model, mujoco_warnings, seen_geoms
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec

WORLD = "world"
# Drawn radius of a ray's site [m].
SITE_SIZE_M = 0.002
UNSEEN = "lidardesign_unseen"


def write_mjcf(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the model, atomically; returns notes of what the format cannot hold.

    Arguments:
        design: The design; with a robot its sensors are on the body that it is mounted on, else in the world.
        rays: Its rays.
        path: The file.
        options: How often rangefinders fire [Hz], 0: at every step; and a robot's MuJoCo model, MJCF or URDF, of which
            the file is a copy with the sensors added.

    Raises:
        DataError: The robot's model cannot be read, or has no such body.
    """
    mounted = mounts(design, rays)
    place, sensors, notes = element("worldbody"), element("sensor"), design_losses(design, mounted)
    model, taken = element("mujoco", {"model": design.name}, [place, sensors]), [WORLD]
    if options.robot is not None:
        model, place, sensors, said = _robot_with(design.mount, options.robot, path)
        sites = [EXPORTED.fullmatch(one.get("name", "")) for one in model.iter("site")]
        taken += [one.get("name", "") for one in model.iter("body")] + [one.group(1) for one in sites if one]
        notes += [
            *(line.partition(": ")[2] for line in said),
            "geoms of the robot that are not shown are transparent, since MuJoCo's rays pass through no others",
        ]
    names = distinct([xml_text(one.sensor.name) for one in mounted], " ", taken=taken)
    site = np.empty(len(rays), dtype=object)
    for mount, name in zip(mounted, names, strict=True):
        site[mount.ray] = [f"{name}_r{number}" for number in range(len(mount.ray))]
        if place.tag == "body":
            place.extend(_sites(rays.origin_m[mount.ray], rays.direction[mount.ray], site[mount.ray]))
        else:
            place.append(_body(mount, name, rays, site[mount.ray]))
    sensors.extend(_rangefinder(str(site[ray]), rays, ray, options.rate_hz) for ray in range(len(rays)))
    write_atomic(path, document(model))
    late = rays.gate_m[rays.gate_m[:, 0] > 0, 0]
    if len(late):
        notes.append(
            f"MuJoCo has no gate start: {len(late)} of {len(rays)} rays also see what is nearer than theirs, of "
            f"{late.min():.3g} to {late.max():.3g} m; it stands in the rangefinders' user data"
        )
    if place.tag == "body":
        notes.append(f"rays ignore the geoms of {design.mount!r}, the body that carries the sensors")
    return [
        *notes,
        f"rangefinders fire at {options.rate_hz:g} Hz; in between they keep what they read"
        if options.rate_hz
        else "rangefinders fire at every step",
        "a reading equal to the cutoff is a hit at or beyond the end of the gate; a negative one is no hit",
    ]


MJCF = Format(
    "mjcf",
    ".mjcf.xml",
    "a rangefinder site per ray",
    write_mjcf,
    reader="MuJoCo",
    checked="loaded and run in MuJoCo: its distances agree with ours",
    holds=frozenset({RAYS, RATE, EVERY_STEP, ROBOT}),
    read=read_mjcf,
)


def _robot_with(mount: str | None, robot: RobotFile, path: Path) -> tuple[Element, Element, Element, tuple[str, ...]]:
    """A robot's model as MuJoCo writes it to a path, its body that receives the sensors, its <sensor>, and notes."""
    specifications: list[Any] = []
    model, said = load_model(robot.path, folder=robot.folder, edit=specifications.append)
    seen = set(seen_geoms(model, robot.groups)[0].tolist())
    # the class of a geom may have a material, whose transparency counts more than the geom's own colour
    if all(material.name != UNSEEN for material in specifications[0].materials):
        specifications[0].add_material(name=UNSEEN, rgba=(0.5, 0.5, 0.5, 0.0))
    for geom in specifications[0].geoms:
        if geom.id not in seen:
            geom.material = UNSEEN
    with mujoco_warnings(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        root = fromstring(specifications[0].to_xml())
    for tag in ("compiler", "sensor", "size"):
        if root.find(tag) is None:
            root.append(element(tag))
    compiler, sensors, size = (next(root.iter(tag)) for tag in ("compiler", "sensor", "size"))
    for name in ("meshdir", "texturedir"):
        folder = robot.path.resolve().parent / compiler.get(name, "")
        compiler.set(name, os.path.relpath(folder, path.resolve().parent))
    size.set("nuser_sensor", str(max(USER_VALUES, int(size.get("nuser_sensor", "0")))))
    bodies = {body.get("name", ""): body for body in root.iter("body")}
    place = next(root.iter("worldbody")) if mount is None else bodies.get(mount)
    if place is None:
        raise DataError(
            f"has no body {mount!r}, which the design is mounted on",
            where=str(robot.path),
            allowed=", ".join(get_close_matches(str(mount), bodies, 3, 0.0)),
        )
    return root, place, sensors, said


def _body(mount: Mount, name: str, rays: Rays, sites: np.ndarray) -> Element:
    """The body of a sensor in the world, with a site per ray in the sensor's frame."""
    frame = mount.sensor.frame
    places = (rays.origin_m[mount.ray] - mount.origin_m) @ frame.T
    pose = {"pos": numbers(mount.origin_m), "quat": numbers(mount.quaternion)}
    return element("body", {"name": name, **pose}, _sites(places, rays.direction[mount.ray] @ frame.T, sites))


def _sites(places_m: np.ndarray, directions: np.ndarray, names: np.ndarray) -> list[Element]:
    """Sites whose +z looks along directions (N, 3)."""
    # the shortest rotations of +z to unit vectors, as quaternions (w, x, y, z), shape (N, 4)
    x, y, z = directions.T
    across = np.hypot(x, y)
    half = np.arctan2(across, z) / 2
    # straight down any horizontal axis is right
    along = np.where(across > 0, across, 1.0)
    axis_x, axis_y = np.where(across > 0, -y / along, 1.0), x / along
    turns = np.stack([np.cos(half), np.sin(half) * axis_x, np.sin(half) * axis_y, np.zeros(len(x))], axis=1)
    return [
        element(
            "site",
            {"name": str(name), "pos": numbers(place), "quat": numbers(turn), "size": SITE_SIZE_M},
        )
        for name, place, turn in zip(names, places_m, turns, strict=True)
    ]


def _rangefinder(site: str, rays: Rays, ray: int, rate_hz: float) -> Element:
    start, end = rays.gate_m[ray]
    # a cutoff of 0 means none; without a number of samples MuJoCo ignores the interval
    return element(
        "rangefinder",
        {
            "name": site,
            "site": site,
            "cutoff": max(end, SLACK),
            "user": numbers([start, end, rays.sensor[ray], rays.time_s[ray]]),
            **({"nsample": "1", "interval": 1 / rate_hz} if rate_hz else {}),
        },
    )


LINK = "lidar"
# Half the diagonal of a pixel of a face's picture, whose sides have 128 or more.
BESIDE_DEG = 0.64
# Gazebo renders depth images, whose near plane must be in front of the camera.
NEAREST_M = 0.001


def write_sdf(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the model, atomically; returns notes of what the format cannot hold."""
    design, rays, mounted = channel_mounts(design, rays)
    link = element("link", {"name": LINK}, [sensor_element(one, options.rate_hz, posed=True) for one in mounted])
    model = element("model", {"name": identifier(design.name)}, [element("static", text="true"), link])
    write_atomic(path, document(element("sdf", {"version": "1.9"}, [model])))
    return sdf_losses(design, mounted, rays)


SDF = Format(
    "sdf",
    ".sdf",
    "a gpu_lidar per sensor, on even grids",
    write_sdf,
    reader="Gazebo",
    checked="parsed by libsdformat without a warning, all values compared; its pixels in a twin",
    holds=frozenset({RAYS, RATE}),
)


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
    if mounted:
        notes.append(f"Gazebo measures along the pixels of a picture: up to {BESIDE_DEG} deg beside the rays")
    names = [design.name, *(one.sensor.name for one in mounted)]
    return [*notes, *renamed_note(names, [identifier(design.name), *(one.name for one in mounted)])]


def sensor_element(mount: Mount, rate_hz: float, *, posed: bool, name: str | None = None) -> Element:
    """<sensor> element of a mount, with its own pose or at that of its link."""
    grid = grid_of(mount)
    start, end = max(mount.gate_m[0], NEAREST_M), max(mount.gate_m[1], NEAREST_M)
    axes = [_axis("horizontal", grid.columns, grid.azimuth_rad), _axis("vertical", grid.rows, grid.elevation_rad)]
    interval = [element("min", text=start), element("max", text=end)]
    lidar = element("lidar", children=[element("scan", children=axes), element("range", children=interval)])
    return element(
        "sensor",
        {"name": name or mount.name, "type": "gpu_lidar"},
        [
            *([element("pose", text=numbers([*mount.origin_m, *mount.roll_pitch_yaw_rad]))] if posed else []),
            element("topic", text=f"/{name or mount.name}"),
            element("update_rate", text=float(rate_hz)),
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
            element("min_angle", text=bounds_rad[0]),
            element("max_angle", text=bounds_rad[1]),
        ],
    )


# Unlike the name of any sensor's link, which ends in _link, or of its joint.
BASE = "lidar_base"
BASE_MASS_KG, BASE_INERTIA_KG_M2 = 0.1, 0.0001


def write_urdf(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the description, atomically; returns notes of what the format cannot hold."""
    design, rays, mounted = channel_mounts(design, rays)
    parts = [part for one in mounted for part in mounted_parts(one, options.rate_hz, parent=BASE)]
    write_atomic(path, document(element("robot", {"name": identifier(design.name)}, [*_base(), *parts])))
    return [
        *urdf_losses(design, mounted, rays),
        f"{BASE} has a nominal mass of {BASE_MASS_KG:g} kg, without which Gazebo would leave out the sensors",
    ]


URDF = Format(
    "urdf",
    ".urdf",
    "a fixed link per sensor, with Gazebo's gpu_lidar",
    write_urdf,
    reader="ROS, robot_state_publisher",
    checked="parsed by check_urdf; sensors by libsdformat",
    holds=frozenset({RAYS, RATE}),
)


def urdf_losses(design: DesignSpec, mounted: Sequence[Mount], rays: Rays) -> list[str]:
    """Notes of what a description of links and Gazebo sensors cannot hold."""
    return [
        *sdf_losses(design, mounted, rays),
        "URDF has no sensors of its own: rays, gates and rates stand in <gazebo> extensions, which Gazebo reads",
    ]


def _base() -> list[Element]:
    """World link, base link with a mass, and the joint between them."""
    moments = {
        name: numbers([BASE_INERTIA_KG_M2 * (name[1] == name[2])])
        for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    }
    inertial = element(
        "inertial", children=[element("mass", {"value": numbers([BASE_MASS_KG])}), element("inertia", moments)]
    )
    ends = [element("parent", {"link": WORLD}), element("child", {"link": BASE})]
    return [
        element("link", {"name": WORLD}),
        element("link", {"name": BASE}, [inertial]),
        element("joint", {"name": f"{WORLD}_joint", "type": "fixed"}, ends),
    ]


def mounted_parts(mount: Mount, rate_hz: float, *, parent: str, prefix: str = "") -> list[Element]:
    """Link of a sensor, the joint that fixes it to a parent, and Gazebo's sensor on it."""
    name = f"{prefix}{mount.name}"
    link, joint = fixed_link(name, mount.origin_m, mount.roll_pitch_yaw_rad, parent=parent)
    sensor = sensor_element(mount, rate_hz, posed=False, name=name)
    # Gazebo then publishes in the frame of the link, whose name ROS knows
    sensor.append(element("gz_frame_id", text=f"{name}_link"))
    return [link, joint, element("gazebo", {"reference": f"{name}_link"}, [sensor])]


def fixed_link(
    name: str, origin_m: np.ndarray, roll_pitch_yaw_rad: Sequence[float], *, parent: str
) -> tuple[Element, Element]:
    """The link of a sensor, and the joint that fixes it to a parent."""
    ends = [element("parent", {"link": parent}), element("child", {"link": f"{name}_link"})]
    origin = element("origin", {"xyz": numbers(origin_m), "rpy": numbers(roll_pitch_yaw_rad)})
    joint = element("joint", {"name": f"{name}_joint", "type": "fixed"}, [*ends, origin])
    return element("link", {"name": f"{name}_link"}), joint


MACRO = "xacro:macro"


def write_xacro(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the macro, atomically; returns its usage and notes of what the format cannot hold."""
    design, rays, mounted = channel_mounts(design, rays)
    name = identifier(design.name)
    parts = [
        part for one in mounted for part in mounted_parts(one, options.rate_hz, parent="${parent}", prefix="${prefix}")
    ]
    macro = element(MACRO, {"name": name, "params": "parent prefix:=''"}, parts)
    write_atomic(
        path, document(element("robot", {"xmlns:xacro": "http://www.ros.org/wiki/xacro", "name": name}, [macro]))
    )
    return [
        f'include it and call <xacro:{name} parent="base_link"/>: poses are relative to the parent',
        *urdf_losses(design, mounted, rays),
    ]


XACRO = Format(
    "xacro",
    ".urdf.xacro",
    "the same as a macro that mounts it on a robot",
    write_xacro,
    reader="ROS, xacro",
    checked="expanded by xacro and parsed by check_urdf",
    holds=frozenset({RAYS, RATE}),
)
