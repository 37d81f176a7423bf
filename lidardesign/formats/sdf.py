"""The lidars of an SDF file (Gazebo): sensors of the types gpu_lidar, lidar, gpu_ray and ray, read without Gazebo.

A scan fires `samples` rays from `min_angle` to `max_angle`, both ends included, in every of its rows from the lowest
up; sensors look along their own +x.

Poses of links may be relative to frames, joints, links and nested models. A model is a scope of names. Within it a pose
is relative to the model's own frame unless `relative_to` names another; a joint's pose is relative to its child link,
and a frame's to the element that it is attached to.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from lidardesign.errors import DataError
from lidardesign.formats.rig import MOST_SENSORS, Aim, Rig, RigSensor
from lidardesign.limits import MOST_RAYS
from lidardesign.run.xml import Element, numbers_of, read_xml
from lidardesign.scenes.rays import rotation_of_quaternion, rotation_of_rpy
from lidardesign.scenes.scene import inverse_rigid, rigid
from lidardesign.sensors.sensor import boresight_frame, boresight_of
from lidardesign.space import FULL_TURN, angles, direction

MODEL_FRAME, WORLD_FRAME = "__model__", "world"
SEPARATOR = "::"
FORMATS = ("euler_rpy", "quat_xyzw")
NAMED = ("link", "model", "frame", "joint")
# Longest chain of relative poses, which are resolved recursively.
LONGEST_CHAIN = 100


@dataclass(eq=False)
class Scope:
    """A model or a world as a scope of names with poses.

    Arguments:
        element: Its element.
        path: The file.
        parent: The enclosing scope; None for the file's topmost.
        found: Resolved poses by name.
        waiting: Names whose poses are being resolved, in all scopes of the file.
    """

    element: ElementTree.Element
    path: Path
    parent: Scope | None = None
    found: dict[str, np.ndarray] = field(default_factory=dict)
    waiting: list[str] = field(default_factory=list)
    _nested: dict[int, Scope] = field(default_factory=dict)

    @cached_property
    def _named(self) -> dict[tuple[str, str], ElementTree.Element]:
        """Elements with a pose, by tag and name.

        Raises:
            DataError: A missing or repeated name.
        """
        named: dict[tuple[str, str], ElementTree.Element] = {}
        for one in self.element:
            if one.tag not in NAMED:
                continue
            name = one.get("name", "")
            if not name:
                raise DataError(f"a {one.tag} has no name", where=self.where(one))
            if (one.tag, name) in named:
                raise DataError(
                    f"a second {one.tag} is called {name!r}", where=self.where(one), allowed="names that differ"
                )
            named[one.tag, name] = one
        return named

    def children(self, tag: str) -> list[ElementTree.Element]:
        """Its links, models, frames or joints, with distinct names."""
        return [one for (its, _), one in self._named.items() if its == tag]

    def within(self, model: ElementTree.Element) -> Scope:
        """Scope of a nested model, always the same object."""
        return self._nested.setdefault(id(model), Scope(model, self.path, self, waiting=self.waiting))

    def where(self, element: ElementTree.Element | None = None) -> str:
        """Location of an element in the file, as `file:line`."""
        chosen = self.element if element is None else element
        return f"{self.path}:{chosen.line if isinstance(chosen, Element) else 1}"

    def pose_of(self, name: str, asking: ElementTree.Element) -> np.ndarray:
        """Pose of a named element in this scope's frame, shape (4, 4).

        Raises:
            DataError: Nothing has that name, or poses are relative to each other in a circle or a long chain.
        """
        if name in ("", MODEL_FRAME) or (name == WORLD_FRAME and self.element.tag == WORLD_FRAME):
            return np.eye(4)
        if name in self.found:
            return self.found[name]
        if len(self.waiting) >= LONGEST_CHAIN:
            raise DataError(
                f"the pose of {self.waiting[0]!r} is relative to itself, or to too many others, one after the other",
                where=self.where(asking),
                allowed=f"at most {LONGEST_CHAIN}",
            )
        self.waiting.append(name)
        outer, _, inner = name.partition(SEPARATOR)
        model = self._named.get(("model", outer)) if inner else None
        element = next((self._named[tag, name] for tag in NAMED if (tag, name) in self._named), None)
        if model is not None:
            pose = self.pose_of(outer, asking) @ self.within(model).pose_of(inner, asking)
        elif element is not None:
            pose = self._pose_of_element(element)
        else:
            raise DataError(
                f"nothing is called {name!r}", where=self.where(asking), allowed="a link, frame, joint or model"
            )
        self.waiting.pop()
        self.found[name] = pose
        return pose

    def _pose_of_element(self, element: ElementTree.Element) -> np.ndarray:
        usual = {"frame": element.get("attached_to", ""), "joint": (element.findtext("child") or "").strip()}
        pose = self.placed(element, usual.get(element.tag, ""))
        placement = element.get("placement_frame") if element.tag == "model" else None
        if placement:
            own = self if element is self.element else self.within(element)
            pose = pose @ inverse_rigid(own.pose_of(placement, element))
        return pose

    def placed(self, element: ElementTree.Element, usual: str) -> np.ndarray:
        """Pose (4, 4) of an element in this scope's frame, relative to `usual` unless its <pose> names another."""
        pose = element.find("pose")
        if pose is None:
            return self.pose_of(usual, element)
        return self.pose_of(pose.get("relative_to") or usual, pose) @ pose_matrix(pose, self.where(pose))

    def in_world(self) -> np.ndarray:
        """Pose of this scope's frame in the file's topmost one, shape (4, 4)."""
        if self.element.tag == "world":
            return np.eye(4)
        if self.parent is None:
            return self._pose_of_element(self.element)
        return self.parent.in_world() @ self.parent.pose_of(self.element.get("name", ""), self.element)


def pose_matrix(pose: ElementTree.Element, where: str) -> np.ndarray:
    """Rigid transform of a <pose>, shape (4, 4): x y z roll pitch yaw, or x y z and a quaternion x y z w.

    Raises:
        DataError: Wrong numbers, format or quaternion.
    """
    if not (pose.text or "").strip():
        return np.eye(4)
    form = pose.get("rotation_format", FORMATS[0])
    if form not in FORMATS:
        raise DataError(f"rotation_format is {form!r}", where=where, allowed=", ".join(FORMATS))
    if form == "quat_xyzw":
        x, y, z, *imaginary, real = numbers_of(pose.text, 7, where, "pose")
        try:
            return rigid(rotation_of_quaternion(real, *imaginary), (x, y, z))
        except ValueError as error:
            raise DataError(str(error), where=where, allowed="x y z and a rotation x y z w") from None
    values = numbers_of(pose.text, 6, where, "pose")
    scale = math.pi / 180 if pose.get("degrees", "false").strip() in ("true", "1") else 1.0
    return rigid(rotation_of_rpy(*(scale * value for value in values[3:])), values[:3])


TYPES = ("gpu_lidar", "lidar", "gpu_ray", "ray")
# Widest scan [rad]: a turn and a little more for rounding.
WIDEST = 1.001 * FULL_TURN
INFINITE = ("inf", "infinity")


def read_sdf(path: Path) -> Rig:
    """Read the lidars of an SDF file.

    Raises:
        DataError: The file is no SDF, has no lidar, or an element of one cannot be used; with file and line.
    """
    root = read_xml(path, "an SDF file")
    version = [int(part) for part in root.get("version", "").split(".") if part.isdecimal()]
    if version and version < [1, 7]:
        # poses of these versions are relative to `frame`, renamed `relative_to` since
        for pose in root.iterfind(".//pose[@frame]"):
            pose.attrib.setdefault("relative_to", pose.attrib["frame"])
    notes: dict[str, None] = {}
    sensors: list[RigSensor] = []
    longer: list[str] = []
    rays = 0
    for scope, link, element in _lidars(root, path):
        sensor = _sensor(scope, link, element, notes)
        sensors.append(sensor)
        longer.append("::".join((scope.element.get("name", ""), link.get("name", ""), sensor.name)))
        rays += len(sensor.azimuth_rad)
        if rays > MOST_RAYS or len(sensors) > MOST_SENSORS:
            raise DataError(
                "has more rays or sensors than a design",
                where=scope.where(element),
                allowed=f"at most {MOST_RAYS} rays of {MOST_SENSORS} sensors",
            )
    if root.find(".//include") is not None:
        notes["models that the file includes are not read; copy their lidars into it"] = None
    if not sensors:
        raise DataError(
            "has no lidar" + (": models that it includes are not read" if notes else ""),
            where=str(path),
            allowed=f"<sensor> of type {', '.join(TYPES)}",
        )
    often = Counter(sensor.name for sensor in sensors)
    named = [
        replace(sensor, name=full) if often[sensor.name] > 1 else sensor
        for sensor, full in zip(sensors, longer, strict=True)
    ]
    return Rig("SDF file", named, list(notes), "give <range> a <max>")


def _lidars(root: ElementTree.Element, path: Path) -> Iterator[tuple[Scope, ElementTree.Element, ElementTree.Element]]:
    """Scope, link and sensor of every lidar, in the order of the file."""
    open_scopes = []
    for child in root:
        if child.tag == "world":
            world = Scope(child, path)
            open_scopes += [world.within(model) for model in world.children("model")]
        elif child.tag == "model":
            open_scopes.append(Scope(child, path))
    while open_scopes:
        scope = open_scopes.pop(0)
        for link in scope.children("link"):
            for sensor in link.findall("sensor"):
                if sensor.get("type") in TYPES:
                    yield scope, link, sensor
        open_scopes[:0] = [scope.within(model) for model in scope.children("model")]


def _sensor(scope: Scope, link: ElementTree.Element, element: ElementTree.Element, notes: dict[str, None]) -> RigSensor:
    """One lidar as a sensor of a rig; notes of what a design cannot hold are added to `notes`."""
    where = scope.where(element)
    lidar = element.find("lidar") if element.find("lidar") is not None else element.find("ray")
    if lidar is None:
        raise DataError("a lidar has neither <lidar> nor <ray>", where=where)
    scan = _needed(lidar, "scan", scope)
    across = _axis(_needed(scan, "horizontal", scope), scope, notes, WIDEST)
    rows = scan.find("vertical")
    up = np.zeros(1) if rows is None else _axis(rows, scope, notes, math.pi)
    if len(across) * len(up) > MOST_RAYS:
        raise DataError(f"{len(across)} x {len(up)} rays", where=scope.where(scan), allowed=f"at most {MOST_RAYS}")
    pose = scope.in_world() @ scope.placed(element, link.get("name", ""))
    azimuth, elevation = (values.reshape(-1) for values in np.meshgrid(across, up))
    world = angles(direction(azimuth, elevation) @ pose[:3, :3].T)
    gate = np.tile(_gate(_needed(lidar, "range", scope), scope, notes), (len(azimuth), 1))
    for tag, note in (
        ("noise", "noise is ignored: --detector says how well ranges are measured"),
        ("visibility_mask", "visibility_mask is ignored: rays see every body"),
    ):
        if lidar.find(tag) is not None:
            notes[note] = None
    origin = np.tile(pose[:3, 3], (len(azimuth), 1))
    # the boresight is in the middle of the scan, upright as the sensor is
    middles = [float(axis[0] + axis[-1]) / 2 for axis in (across, up)]
    widths = [float(axis[-1] - axis[0]) for axis in (across, up)]
    boresight = boresight_of(boresight_frame(*middles) @ pose[:3, :3].T)
    aim = Aim(*boresight, (math.cos(middles[1]) * widths[0], widths[1]))
    return RigSensor(element.get("name", ""), origin, *world, gate, aim=aim)


def _needed(element: ElementTree.Element, tag: str, scope: Scope) -> ElementTree.Element:
    found = element.find(tag)
    if found is None:
        raise DataError(f"<{element.tag}> has no <{tag}>", where=scope.where(element))
    return found


def _number(element: ElementTree.Element, tag: str, scope: Scope) -> float:
    child = _needed(element, tag, scope)
    return numbers_of(child.text, 1, scope.where(child), tag)[0]


def _axis(element: ElementTree.Element, scope: Scope, notes: dict[str, None], widest: float) -> np.ndarray:
    """Angles of one axis of a scan, shape (samples,) [rad]; a single sample is at `min_angle`."""
    samples = _number(element, "samples", scope)
    if not (1 <= samples <= MOST_RAYS and samples % 1 == 0):
        raise DataError(f"samples is {samples:g}", where=scope.where(element), allowed=f"1 to {MOST_RAYS}")
    low, high = _number(element, "min_angle", scope), _number(element, "max_angle", scope)
    if not (low <= high and high - low <= widest and max(-low, high) <= widest):
        raise DataError(
            f"min_angle {low:g}, max_angle {high:g}",
            where=scope.where(element),
            allowed=f"radians, ascending, at most {widest:.4g} wide",
        )
    if element.tag == "vertical" and max(-low, high) > math.pi / 2:
        raise DataError(
            f"vertical angles from {low:g} to {high:g}", where=scope.where(element), allowed="-pi/2 to pi/2 rad"
        )
    resolution = element.find("resolution")
    if resolution is not None and numbers_of(resolution.text, 1, scope.where(resolution), "resolution")[0] != 1:
        notes["resolution is ignored: Gazebo interpolates between the rays that are fired, `samples` of them"] = None
    return np.linspace(low, high, int(samples))


def _gate(element: ElementTree.Element, scope: Scope, notes: dict[str, None]) -> np.ndarray:
    """Start and end of the gate, shape (2,) [m]; an end missing in the file is infinite."""
    bounds = {"min": 0.0, "max": math.inf}
    for tag in bounds:
        child = element.find(tag)
        infinite = tag == "max" and child is not None and (child.text or "").strip().lower().lstrip("+") in INFINITE
        if child is not None and not infinite:
            bounds[tag] = numbers_of(child.text, 1, scope.where(child), tag)[0]
    if element.find("min") is None:
        notes["the file does not say where gates start: rays listen from 0 m"] = None
    if not 0 <= bounds["min"] <= bounds["max"]:
        raise DataError(
            f"range from {bounds['min']:g} to {bounds['max']:g} m",
            where=scope.where(element),
            allowed="0 <= min <= max",
        )
    return np.array([bounds["min"], bounds["max"]])
