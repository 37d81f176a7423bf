"""Where the links of an SDF file are: poses relative to frames, joints, links and nested models.

A model is a scope of names. Within it a pose counts from the model's own frame unless `relative_to` names another;
a joint's pose counts from its child link, and a frame's from what it is attached to.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from lidardesign.design.readers.xml_text import Element, numbers_of
from lidardesign.errors import DataError
from lidardesign.rotations import rotation_of_quaternion, rotation_of_rpy
from lidardesign.scene import inverse_rigid, rigid

MODEL_FRAME, WORLD_FRAME = "__model__", "world"
SEPARATOR = "::"
FORMATS = ("euler_rpy", "quat_xyzw")
NAMED = ("link", "model", "frame", "joint")
# Poses count from one another through a few frames; a file may not make of them more than the program can follow.
LONGEST_CHAIN = 100


@dataclass(eq=False)
class Scope:
    """A model or a world: what its names stand for.

    Arguments:
        element: Its element.
        path: The file.
        parent: The scope that it stands in; None for the file's topmost.
        found: Poses that are known already; None marks one that is being worked out.
        waiting: Names whose poses are being worked out, in all scopes of the file.
    """

    element: ElementTree.Element
    path: Path
    parent: Scope | None = None
    found: dict[str, np.ndarray | None] = field(default_factory=dict)
    waiting: list[str] = field(default_factory=list)
    _nested: dict[int, Scope] = field(default_factory=dict)

    @cached_property
    def _named(self) -> dict[tuple[str, str], ElementTree.Element]:
        """What has a pose, by tag and name.

        Raises:
            DataError: One has no name, or that of another.
        """
        named: dict[tuple[str, str], ElementTree.Element] = {}
        for one in self.element:
            if one.tag not in NAMED:
                continue
            name = one.get("name", "")
            if not name:
                raise DataError(f"a {one.tag} has no name", where=self.where(one))
            if (one.tag, name) in named:
                found = f"a second {one.tag} is called {name!r}"
                raise DataError(found, where=self.where(one), allowed="names that differ")
            named[one.tag, name] = one
        return named

    def children(self, tag: str) -> list[ElementTree.Element]:
        """Its links, models, frames or joints, which have names that differ."""
        return [one for (its, _), one in self._named.items() if its == tag]

    def within(self, model: ElementTree.Element) -> Scope:
        """The scope of a model that stands in this one, always the same."""
        return self._nested.setdefault(id(model), Scope(model, self.path, self, waiting=self.waiting))

    def where(self, element: ElementTree.Element | None = None) -> str:
        """The position of an element, as `file:line`."""
        chosen = self.element if element is None else element
        return f"{self.path}:{chosen.line if isinstance(chosen, Element) else 1}"

    def pose_of(self, name: str, asking: ElementTree.Element) -> np.ndarray:
        """The pose of what a name stands for in this scope's frame, shape (4, 4).

        Raises:
            DataError: Nothing has that name, or poses count from each other in a circle or in a long chain.
        """
        if name in ("", MODEL_FRAME) or (name == WORLD_FRAME and self.element.tag == WORLD_FRAME):
            return np.eye(4)
        if name in self.found:
            known = self.found[name]
            if known is None:
                raise DataError(f"the pose of {name!r} counts from itself", where=self.where(asking))
            return known
        if len(self.waiting) >= LONGEST_CHAIN:
            message = f"the pose of {self.waiting[0]!r} counts from too many others, one after the other"
            raise DataError(message, where=self.where(asking), allowed=f"at most {LONGEST_CHAIN}")
        self.found[name] = None
        self.waiting.append(name)
        pose = self._looked_up(name, asking)
        self.waiting.pop()
        self.found[name] = pose
        return pose

    def _looked_up(self, name: str, asking: ElementTree.Element) -> np.ndarray:
        outer, _, inner = name.partition(SEPARATOR)
        if inner:
            model = self._named.get(("model", outer))
            if model is not None:
                return self.pose_of(outer, asking) @ self.within(model).pose_of(inner, asking)
        for tag, base in zip(NAMED, (None, None, "attached_to", "child"), strict=True):
            element = self._named.get((tag, name))
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
            own = self if element is self.element else self.within(element)
            inner = own.pose_of(placement, element)
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
