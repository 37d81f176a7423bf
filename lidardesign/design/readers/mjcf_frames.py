"""The part of a MuJoCo model that says where its rangefinders are: a model of its own, without any other file.

Bodies, frames, sites and their defaults are kept; shapes, joints, meshes, actuators and plugins are left out, so that
MuJoCo compiles what is left from text alone, reads nothing from disk and runs nothing. Without joints bodies stand
where the model puts them, which is where they are when a simulation begins.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from lidardesign.design.readers.xml_text import DEEPEST, Element, read_xml
from lidardesign.errors import DataError

ALLOWED = "an MJCF model"
PLACE = ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler")
KEPT = {
    "compiler": ("angle", "eulerseq"),
    "default": ("class",),
    "worldbody": ("childclass",),
    "body": ("name", "childclass", *PLACE),
    "frame": ("name", "childclass", *PLACE),
    "replicate": ("count", "sep", "offset", "euler"),
    "site": ("name", "class", "size", "type", "fromto", *PLACE),
    "sensor": (),
    "rangefinder": ("name", "site", "cutoff", "user"),
}
CAMERA = "camera"
MOST_INCLUDES = 100
# MuJoCo takes seconds for a thousand copies with sensors, and four times as long for twice as many.
MOST_COPIES = 1000


def stripped_model(path: Path) -> ElementTree.Element:
    """The model of a file as it is left, with what it includes from its own folder.

    Raises:
        DataError: A file is no XML, lies outside the model's folder, or the model is one that cannot be read so.
    """
    root = read_xml(path, ALLOWED)
    model = ElementTree.Element("mujoco", {"model": "rig"})
    _Copier([path.resolve()]).copy_children(root, model, path, depth=1)
    return model


@dataclass
class _Copier:
    """Copies what is kept of a model and of what it includes.

    Arguments:
        seen: The files that were read, the model's own first.
        copies: How many elements `replicate` makes.
    """

    seen: list[Path]
    copies: int = 0

    def copy_children(
        self, source: ElementTree.Element, target: ElementTree.Element, path: Path, *, depth: int, times: int = 1
    ) -> None:
        """Append what is kept of an element's children; `times` is how often it is replicated."""
        for child in source:
            where = f"{path}:{child.line if isinstance(child, Element) else 1}"
            if depth >= DEEPEST:
                raise DataError("is nested too deep, with what it includes", where=where, allowed=f"{DEEPEST} levels")
            if child.tag == "include":
                included, file = _included(child, path, self.seen)
                self.copy_children(included, target, file, depth=depth + 1, times=times)
                continue
            if child.tag == "attach":
                raise DataError("attaches another model", where=where, allowed="one model, or <include>")
            if child.tag == "rangefinder" and CAMERA in child.attrib:
                allowed = "rangefinders of sites: one ray each"
                raise DataError("has a rangefinder of a camera", where=where, allowed=allowed)
            if child.tag not in KEPT:
                continue
            kept = ElementTree.SubElement(
                target, child.tag, {name: child.attrib[name] for name in KEPT[child.tag] if name in child.attrib}
            )
            inner = times * _count(child, where) if child.tag == "replicate" else times
            self.copies += inner if inner > 1 else 0
            if self.copies > MOST_COPIES:
                raise DataError("replicates too much", where=where, allowed=f"at most {MOST_COPIES} copies")
            self.copy_children(child, kept, path, depth=depth + 1, times=inner)


def _count(element: ElementTree.Element, where: str) -> int:
    text = element.attrib.get("count", "")
    if not text.strip().isdecimal() or len(text) > len(str(MOST_COPIES)):
        raise DataError(f"count is {text[:40]!r}", where=where, allowed=f"a whole number up to {MOST_COPIES}")
    return int(text)


def _included(element: ElementTree.Element, path: Path, seen: list[Path]) -> tuple[Element, Path]:
    """The root of an included file, which lies in the first file's folder, links followed, and is included once."""
    where = f"{path}:{element.line if isinstance(element, Element) else 1}"
    name = element.attrib.get("file", "")
    folder = seen[0].parent
    found = (folder / name).resolve()
    if not name or not found.is_relative_to(folder):
        raise DataError(
            f"includes {name!r}, which is outside the model's folder", where=where,
            hint="copy the file into the model's folder and name it from there",
        )  # fmt: skip
    if found in seen or len(seen) > MOST_INCLUDES:
        raise DataError(f"includes {name!r} again", where=where, allowed=f"each file once, at most {MOST_INCLUDES}")
    seen.append(found)
    return read_xml(found, ALLOWED), found
