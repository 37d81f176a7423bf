"""Where the links of an SDF file are: poses relative to frames, joints, links and nested models.

A model is a scope of names. Within it a pose counts from the model's own frame unless `relative_to` names another;
a joint's pose counts from its child link, and a frame's from what it is attached to.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lidardesign.design.readers.xml_text import Element, numbers_of
from lidardesign.errors import DataError
from lidardesign.rotations import rotation_of_quaternion, rotation_of_rpy
from lidardesign.scene import inverse_rigid, rigid

MODEL_FRAME, WORLD_FRAME = "__model__", "world"
SEPARATOR = "::"
FORMATS = ("euler_rpy", "quat_xyzw")


@dataclass(eq=False)
class Scope:
    """A model or a world: what its names stand for.

    Arguments:
        element: Its element.
        path: The file.
        parent: The scope that it stands in; None for the file's topmost.
        found: Poses that are known already; None marks one that is being worked out.
    """

    element: ElementTree.Element
    path: Path
    parent: Scope | None = None
    found: dict[str, np.ndarray | None] = field(default_factory=dict)

    def where(self, element: ElementTree.Element | None = None) -> str:
        """The position of an element, as `file:line`."""
        chosen = self.element if element is None else element
        return f"{self.path}:{chosen.line if isinstance(chosen, Element) else 1}"

    def child(self, tag: str, name: str) -> ElementTree.Element | None:
        """The child of a tag and a name."""
        return next((one for one in self.element.findall(tag) if one.get("name") == name), None)

    def pose_of(self, name: str, asking: ElementTree.Element) -> np.ndarray:
        """The pose of what a name stands for in this scope's frame, shape (4, 4).

        Raises:
            DataError: Nothing has that name, or poses count from each other in a circle.
        """
        if name in ("", MODEL_FRAME, WORLD_FRAME):
            return np.eye(4)
        if name in self.found:
            known = self.found[name]
            if known is None:
                raise DataError(f"the pose of {name!r} counts from itself", where=self.where(asking))
            return known
        self.found[name] = None
        pose = self._looked_up(name, asking)
        self.found[name] = pose
        return pose

    def _looked_up(self, name: str, asking: ElementTree.Element) -> np.ndarray:
        outer, _, inner = name.partition(SEPARATOR)
        if inner:
            model = self.child("model", outer)
            if model is not None:
                nested = Scope(model, self.path, self)
                return self.pose_of(outer, asking) @ nested.pose_of(inner, asking)
        for tag, base in (("link", None), ("model", None), ("frame", "attached_to"), ("joint", "child")):
            element = self.child(tag, name)
            if element is not None:
                return self._pose_of_element(element, base)
        raise DataError(
            f"nothing is called {name!r}", where=self.where(asking), allowed="a link, frame, joint or model"
        )

    def _pose_of_element(self, element: ElementTree.Element, base: str | None) -> np.ndarray:
        """The pose of a link, model, frame or joint in this scope's frame."""
        usual = ""
        if base == "attached_to":
            usual = element.get(base, "")
        elif base == "child":
            usual = (element.findtext(base) or "").strip()
        pose = self.placed(element, usual)
        placement = element.get("placement_frame") if element.tag == "model" else None
        if placement:
            inner = Scope(element, self.path, self).pose_of(placement, element)
            pose = pose @ inverse_rigid(inner)
        return pose

    def placed(self, element: ElementTree.Element, usual: str) -> np.ndarray:
        """The pose of an element in this scope's frame, counted from `usual` unless its <pose> names another."""
        pose = element.find("pose")
        if pose is None:
            return self.pose_of(usual, element)
        return self.pose_of(pose.get("relative_to") or usual, pose) @ pose_matrix(pose, self.where(pose))

    def in_world(self) -> np.ndarray:
        """The pose of this scope's frame in the file's topmost one, shape (4, 4)."""
        if self.element.tag == "world":
            return np.eye(4)
        if self.parent is None:
            return self._pose_of_element(self.element, None)
        return self.parent.in_world() @ self.parent.pose_of(self.element.get("name", ""), self.element)


def pose_matrix(pose: ElementTree.Element, where: str) -> np.ndarray:
    """The rigid transform of a <pose>, shape (4, 4): x y z roll pitch yaw, or x y z and a quaternion x y z w.

    Raises:
        DataError: It has other numbers, or a rotation that is none.
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
