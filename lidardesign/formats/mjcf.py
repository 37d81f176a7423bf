"""The rangefinders of a MuJoCo model (MJCF): each is one ray along the +z axis of its site.

Rangefinders of one body with the same origin are one sensor, and so are those on sites NAME_r0, NAME_r1, ... with the
user data of rays, as `export --format mjcf` writes them with the starts of gates. Rays are at the initial poses of the
model's bodies.

MuJoCo compiles only the elements that define poses of rangefinders, as a model of its own that reads nothing from disk
and runs nothing: bodies, frames, sites and their defaults are kept; shapes, joints, meshes, actuators and plugins are
left out. Without joints bodies have the initial poses of a simulation.
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidardesign.errors import DataError
from lidardesign.formats.rig import Rig, RigSensor
from lidardesign.run.xml import DEEPEST, Element, read_xml
from lidardesign.space import FARTHEST_M, angles

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
MOST_INCLUDES = 100
# MuJoCo takes seconds for a thousand copies with sensors, and four times as long for twice as many.
MOST_COPIES = 1000
# MuJoCo takes ten seconds for so many sites and sensors, and four times as long for twice as many.
MOST_KEPT = 120_000


@dataclass
class _Copier:
    """Copies the kept elements of a model and of its includes.

    Arguments:
        seen: The files that were read, the model's own first.
        copies: Number of elements that `replicate` makes.
        kept: Number of kept elements.
    """

    seen: list[Path]
    copies: int = 0
    kept: int = 0

    def copy_children(
        self, source: ElementTree.Element, target: ElementTree.Element, path: Path, *, depth: int, times: int = 1
    ) -> None:
        """Append the kept children of an element, which is replicated `times` times."""
        for child in source:
            where = f"{path}:{child.line if isinstance(child, Element) else 1}"
            if depth >= DEEPEST:
                raise DataError("is nested too deep, with what it includes", where=where, allowed=f"{DEEPEST} levels")
            if child.tag == "include":
                file = self.included_file(child.attrib.get("file", ""), where)
                self.copy_children(read_xml(file, ALLOWED), target, file, depth=depth + 1, times=times)
                continue
            if child.tag == "attach":
                raise DataError("attaches another model", where=where, allowed="one model, or <include>")
            if child.tag == "rangefinder" and "camera" in child.attrib:
                raise DataError(
                    "has a rangefinder on a camera", where=where, allowed="rangefinders on sites: one ray each"
                )
            if child.tag not in KEPT:
                continue
            self.kept += 1
            if self.kept > MOST_KEPT:
                raise DataError("has too many bodies, sites and sensors", where=where, allowed=f"at most {MOST_KEPT}")
            kept = {name: child.attrib[name] for name in KEPT[child.tag] if name in child.attrib}
            inner = times
            if child.tag == "replicate":
                count = child.attrib.get("count", "")
                if not count.strip().isdecimal() or len(count) > len(str(MOST_COPIES)):
                    raise DataError(
                        f"count is {count[:40]!r}", where=where, allowed=f"a whole number up to {MOST_COPIES}"
                    )
                inner *= int(count)
            self.copies += inner if inner > 1 else 0
            if self.copies > MOST_COPIES:
                raise DataError("replicates too much", where=where, allowed=f"at most {MOST_COPIES} copies")
            self.copy_children(
                child, ElementTree.SubElement(target, child.tag, kept), path, depth=depth + 1, times=inner
            )

    def included_file(self, name: str, where: str) -> Path:
        """Resolved path of an included file; refuses one outside the first file's folder, or included before."""
        folder = self.seen[0].parent
        file = (folder / name).resolve()
        if not name or not file.is_relative_to(folder):
            raise DataError(
                f"includes {name!r}, which is outside the model's folder", where=where,
                hint="copy the file into the model's folder and name it from there",
            )  # fmt: skip
        if file in self.seen or len(self.seen) > MOST_INCLUDES:
            raise DataError(f"includes {name!r} again", where=where, allowed=f"each file once, at most {MOST_INCLUDES}")
        self.seen.append(file)
        return file


# Largest distance between origins of one sensor's rays in files of few digits [m].
SAME_PLACE_M = 1e-4
# Suffixes of the names of a sensor's rays: `front_r12` and `front_r13` are of `front`.
EXPORTED = re.compile(r"(.+)_r\d+")
USER_VALUES = 4  # of an exported rangefinder: gate start and end, sensor, time
COUNTED = re.compile(r"[\s_.-]+(r|ray)?[\s_.-]*\d*$|\d+$")


@dataclass(frozen=True)
class _Ray:
    """One rangefinder of the compiled model, in the world's frame.

    Arguments:
        name: Name of the rangefinder, or of its site.
        site_name: Name of its site.
        body: Index of its body; 0 is the world.
        body_name: Name of its body.
        origin_m, direction: Origin and direction, shape (3,).
        cutoff_m: End of its gate; infinite if missing.
        user: User data.
    """

    name: str
    site_name: str
    body: int
    body_name: str
    origin_m: np.ndarray
    direction: np.ndarray
    cutoff_m: float
    user: tuple[float, ...]

    @property
    def exported(self) -> str | None:
        """The name of its sensor where its site and user data are those of a ray that `export` wrote."""
        found = EXPORTED.fullmatch(self.site_name)
        return found.group(1) if found and self.body > 0 and self.start_m is not None else None

    @property
    def start_m(self) -> float | None:
        """Start of its gate in an export's user data [m], or None."""
        start, end = (*self.user, 0.0, 0.0)[:2]
        return start if len(self.user) >= USER_VALUES and 0 <= start <= end == self.cutoff_m else None


def read_mjcf(path: Path) -> Rig:
    """Read the rangefinders of a model, with includes from its own folder, as a rig.

    Raises:
        DataError: A file is no model or outside the model's folder, the model has unsupported or too many elements,
            MuJoCo refuses it, or it has no rangefinder.
    """
    model = ElementTree.Element("mujoco", {"model": "rig"})
    _Copier([path.resolve()]).copy_children(read_xml(path, ALLOWED), model, path, depth=1)
    rays = _rays(model, path)
    if not rays:
        raise DataError(
            "has no rangefinder", where=str(path), allowed="<sensor> with <rangefinder site=...>, one per ray"
        )
    for ray in rays:
        if not (np.abs(ray.origin_m) <= FARTHEST_M).all():
            raise DataError(
                f"the rangefinder {ray.name!r} has the place {np.abs(ray.origin_m).max():g} m",
                where=str(path),
                allowed=f"at most {FARTHEST_M:g} m along each axis",
            )
    groups = _groups(rays)
    notes = []
    if any(ray.start_m is None for ray in rays):
        notes.append("the file does not say where gates start: rangefinders listen from 0 m")
    sensors_of_body = Counter(rays[group[0]].body for group in groups)
    sensors = []
    for group in groups:
        own = [rays[index] for index in group]
        azimuth, elevation = angles(np.array([ray.direction for ray in own]))
        gates = np.array([[ray.start_m or 0.0, ray.cutoff_m] for ray in own])
        name = _name(own, alone=sensors_of_body[own[0].body] == 1)
        sensors.append(
            RigSensor(name, np.array([ray.origin_m for ray in own]), azimuth, elevation, gates, order=np.array(group))
        )
    return Rig("MuJoCo model", sensors, notes, "give the rangefinders a cutoff")


def _rays(stripped: ElementTree.Element, path: Path) -> list[_Ray]:
    from lidardesign.scenes.mujoco_models import import_mujoco, mujoco_warnings

    mujoco = import_mujoco()
    try:
        with mujoco_warnings():
            model = mujoco.MjModel.from_xml_string(ElementTree.tostring(stripped, encoding="unicode"))
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
    except ValueError as error:
        raise DataError(
            f"MuJoCo cannot read it: {' '.join(str(error).split()) or 'no reason given'}",
            where=str(path),
            allowed=ALLOWED,
        ) from None
    index = np.flatnonzero(model.sensor_type == int(mujoco.mjtSensor.mjSENS_RANGEFINDER))
    sites = model.sensor_objid[index]
    return [
        _Ray(
            name=model.sensor(sensor).name or model.site(site).name,
            site_name=model.site(site).name,
            body=body,
            body_name=model.body(body).name,
            origin_m=np.array(data.site_xpos[site]),
            direction=np.array(data.site_xmat[site]).reshape(3, 3)[:, 2],
            cutoff_m=float(model.sensor_cutoff[sensor]) or np.inf,
            user=tuple(float(value) for value in model.sensor_user[sensor]),
        )
        for sensor, site, body in zip(index.tolist(), sites.tolist(), model.site_bodyid[sites].tolist(), strict=True)
    ]


def _groups(rays: Sequence[_Ray]) -> list[list[int]]:
    """Indices of the rays of each sensor, grouped by body and origin, in order of appearance."""
    groups: list[list[int]] = []
    # groups by body and cell of their first ray, or name in an export
    near: dict[tuple[int, str | tuple[int, ...]], list[list[int]]] = {}
    for index, ray in enumerate(rays):
        cell = np.floor(ray.origin_m / SAME_PLACE_M).astype(np.int64)
        home = ray.exported or tuple((cell + 1).tolist())
        places = [home] if ray.exported else [tuple((cell + step).tolist()) for step in np.ndindex(3, 3, 3)]
        candidates = (group for place in places for group in near.get((ray.body, place), []))
        apart_m = ((group, np.linalg.norm(rays[group[0]].origin_m - ray.origin_m)) for group in candidates)
        group = next((group for group, way_m in apart_m if ray.exported or way_m <= SAME_PLACE_M), None)
        if group is None:
            group = []
            groups.append(group)
            near.setdefault((ray.body, home), []).append(group)
        group.append(index)
    return groups


def _name(own: Sequence[_Ray], *, alone: bool) -> str:
    """Common prefix of the names of a sensor's rays, or the name of its body if it has no other sensor."""
    if own[0].exported is not None:
        return own[0].exported
    if len(own) == 1 and own[0].name:
        return own[0].name
    common = COUNTED.sub("", os.path.commonprefix([ray.name for ray in own]))  # noqa: RUF071 (of letters)
    return common or (own[0].body_name if alone and own[0].body else "")
