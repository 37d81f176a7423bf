"""What the person who builds a design needs, in one folder: a page to print on A4, the same as CSV, and frames of ROS.

Poses are those of each part's own axes: x forward (the optical axis), y to the left, z up, as in REP 103. What no
source says of a part stands there as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.formats import Format
from lidardesign.formats.mounts import quaternion
from lidardesign.formats.names import distinct, document, element, identifier
from lidardesign.formats.robots import WORLD, fixed_link
from lidardesign.numerics import EPSILON
from lidardesign.parts.catalogue import parts_of
from lidardesign.parts.part import Part
from lidardesign.run.arrays import csv_table
from lidardesign.run.files import write_folder
from lidardesign.run.markup import fixed, rendered
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import Sensor, boresight_frame, boresight_of
from lidardesign.simulate.calibration import reach_of

MM_PER_M = 1000.0
UNKNOWN = "unknown"
ROUNDING = 8 * EPSILON  # of angles [rad]
FREE_RAYS = "any rays: --format csv lists them"


@dataclass(frozen=True, eq=False)
class MountedPart:
    """A sensor as it is mounted.

    Arguments:
        name: An identifier, unique in the design.
        sensor: The sensor.
        part: Its part; None where it is none, or its file is not at hand.
    """

    name: str
    sensor: Sensor
    part: Part | None

    @cached_property
    def axes(self) -> np.ndarray:
        """Its x (forward), y (left) and z (up) axes, as rows, shape (3, 3)."""
        # the boresight of a sensor is the middle of its field, which may be off the part's own axis
        return self.sensor.frame if self.part is None else boresight_frame(*self.part.centre_rad).T @ self.sensor.frame

    @cached_property
    def angles_rad(self) -> tuple[float, float, float]:
        """Azimuth, elevation and roll of its axes, the roll from -pi to pi; what rounding leaves of 0 is 0."""
        azimuth, elevation, roll = (angle if abs(angle) > ROUNDING else 0.0 for angle in boresight_of(self.axes))
        return azimuth, elevation, roll

    @property
    def roll_pitch_yaw_rad(self) -> tuple[float, float, float]:
        """Rotations about the fixed axes x, y and z, in this order."""
        azimuth, elevation, roll = self.angles_rad
        return roll, -elevation, azimuth

    @property
    def field_deg(self) -> tuple[Sequence[float], Sequence[float]]:
        """Its field of view from its own axis: right and left end, lower and upper end."""
        if self.part is not None:
            return self.part.view.azimuth, self.part.view.elevation
        half = [math.degrees(angle) / 2 for angle in self.sensor.field_of_view_rad]
        return (-half[0], half[0]), (-half[1], half[1])

    @property
    def pattern(self) -> str:
        """What it fires, in words."""
        if self.part is None:
            return FREE_RAYS if self.sensor.part is None else UNKNOWN
        columns, rows = self.part.grid
        return f"{self.part.pattern.kind} {columns} x {rows}"

    def stated(self, name: str) -> str:
        """What a source says of how the part is mounted, or that none does."""
        statements = () if self.part is None else self.part.figures.get("mounting", ())
        return next((text for one in statements if (text := getattr(one, name))), UNKNOWN)

    def figure(self, name: str) -> float | str:
        """A figure of the part; empty where no source gives one."""
        value = None if self.part is None else self.part.value(name)
        return "" if value is None else value

    def row(self, frame: str) -> dict[str, Any]:
        """All that is known of it, with all digits, by name."""
        azimuth, elevation, roll = map(math.degrees, self.angles_rad)
        forward, _, up = self.axes
        across, upright = self.field_deg
        columns, rows = ("", "") if self.part is None else self.part.grid
        return {
            "sensor": self.name, "part": self.sensor.part or "", "frame": frame,
            **_by_axis("{}_mm", MM_PER_M * self.sensor.origin_m),
            **_by_axis("forward_{}", forward), **_by_axis("up_{}", up),
            "azimuth_deg": azimuth, "elevation_deg": elevation, "roll_deg": roll,
            **dict(zip(("qw", "qx", "qy", "qz"), quaternion(*self.roll_pitch_yaw_rad), strict=True)),
            "field_right_deg": across[0], "field_left_deg": across[1],
            "field_bottom_deg": upright[0], "field_top_deg": upright[1],
            "angles": "tangent" if self.part is None else self.part.projection,
            "pattern": self.pattern, "columns": columns, "rows": rows,
            "gate_start_m": self.sensor.gate_m[0], "gate_end_m": self.sensor.gate_m[1],
            "up_side": self.stated("up"), "zone_0": self.stated("zone_0"), "origin_point": self.stated("origin"),
            "power_w": self.figure("power_w"), "price": self.figure("price"),
        }  # fmt: skip


def _by_axis(name: str, vector: np.ndarray) -> dict[str, float]:
    return {name.format(axis): float(value) for axis, value in zip("xyz", vector, strict=True)}


def mounted_parts(design: DesignSpec) -> list[MountedPart]:
    """The sensors of a design as they are mounted, in their order."""
    # a sensor's link is not the one that it is mounted on
    taken = [(design.mount or "").removesuffix("_link")]
    names = distinct([identifier(sensor.name) for sensor in design.sensors], "_", taken=taken)
    return [MountedPart(*one) for one in zip(names, design.sensors, parts_of(design), strict=True)]


def write_mounts(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write the folder, each file atomically; returns notes of what the format cannot hold."""
    mounted = mounted_parts(design)
    parent = WORLD if design.mount is None else design.mount
    frame = "world" if design.mount is None else f"body {design.mount}"
    rows = [one.row(frame) for one in mounted]
    # a link per sensor, fixed to the link that it is mounted on
    poses = [(one.name, one.sensor.origin_m, one.roll_pitch_yaw_rad) for one in mounted]
    links = [part for pose in poses for part in fixed_link(*pose, parent=parent)]
    robot = element("robot", {"name": identifier(design.name)}, [element("link", {"name": parent}), *links])
    commands = _transforms(mounted, parent)
    notes = write_folder(
        path,
        {
            "mounts.html": _page(design, mounted, commands).encode(),
            "mounts.csv": csv_table([rows[0], *(row.values() for row in rows)]).encode(),
            "mounts.urdf": document(robot),
            "static_transforms.sh": "".join(f"{line} &\n" for line in commands).encode() + b"wait\n",
        },
    )
    regions = [one.sensor.region_m for one in mounted if one.sensor.region_m > 0]
    if regions:
        notes.append(f"rays of {len(regions)} sensors start anywhere in a region: the page gives its middle")
    beside = [one.name for one in mounted if one.part is not None and any(one.part.centre_rad)]
    if beside:
        notes.append(
            f"fields of view of {', '.join(beside)} are not about their axes: here are axes, `show` has the middles"
        )
    missing = [one.name for one in mounted if one.part is None and one.sensor.part is not None]
    if missing:
        notes.append(
            f"the part files of {', '.join(missing)} are not available: poses are those of the middles of their fields"
        )
    return [*notes, "sensors only: rays are lost; --format csv lists them"]


MOUNTS = Format(
    "mounts",
    ".mounts",
    "a page to mount from, the same as CSV, and ROS frames",
    write_mounts,
    reader="people who build it; ROS",
    checked="a design is built from the CSV in MuJoCo: all ranges agree",
    holds=frozenset(),
    is_folder=True,
)


def _transforms(mounted: Sequence[MountedPart], parent: str) -> list[str]:
    """A command of ROS 2 for each sensor that publishes its frame."""
    import shlex

    names = ("--x", "--y", "--z", "--roll", "--pitch", "--yaw")
    found = []
    for one in mounted:
        values = (*one.sensor.origin_m, *one.roll_pitch_yaw_rad)
        words = [word for name, value in zip(names, values, strict=True) for word in (name, repr(float(value)))]
        ends = ("--frame-id", shlex.quote(parent), "--child-frame-id", f"{one.name}_link")
        found.append(" ".join(("ros2 run tf2_ros static_transform_publisher", *words, *ends)))
    return found


# Views from three sides: their name, the axes to the right and upwards, and the axis and sign towards the viewer.
VIEWS = (("from the front (+x)", 1, 2, 0, 1), ("from the right (-y)", 0, 2, 1, -1), ("from above (+z)", 0, 1, 2, 1))
WIDTH, HEIGHT, EDGE = 340, 270, 58
ARROW, UPRIGHT = 30.0, 12.0  # lengths of arrows and of marks of what is up
HEAD_ON = 0.25  # the share of an arrow across the view below which it is a ring
APART = 11.0  # of numbers along an edge
SAME_MM = 0.05
QUESTIONS = {
    "up": "which side is up",
    "origin": "where rays start on the part",
    "zone_0": "where the first zone looks",
}


def _page(design: DesignSpec, mounted: Sequence[MountedPart], commands: Sequence[str]) -> str:
    """The page to print."""
    open_questions = [text for name, text in QUESTIONS.items() if any(one.stated(name) == UNKNOWN for one in mounted)]
    return rendered(
        "formats/templates/mounts.html",
        design=design,
        mounted=mounted,
        unknown=UNKNOWN,
        poses=[_pose(one) for one in mounted],
        views=[_view(mounted, *view) for view in VIEWS],
        width=WIDTH,
        height=HEIGHT,
        edge=EDGE,
        parts=[*map(_part, mounted), ["in all", *[""] * 8, _total(mounted, "power_w", " W"), _total(mounted, "price")]],
        missing=open_questions if any(one.sensor.part is not None for one in mounted) else [],
        is_unverified=any("unverified" in one.stated("zone_0") for one in mounted),
        commands=commands,
    )


def _view(mounted: Sequence[MountedPart], title: str, across: int, up: int, depth: int, sign: int) -> dict[str, Any]:
    """One view: places with their coordinates along the edges, arrows along the optical axes, marks of what is up."""
    places_mm = np.round(MM_PER_M * np.array([one.sensor.origin_m for one in mounted])[:, [across, up]], 1)
    low, high = places_mm.min(axis=0), places_mm.max(axis=0)
    room = np.array([WIDTH, HEIGHT]) - 2 * EDGE - np.array([30.0, 0.0])
    extent = high - low
    scale = float((room[extent > SAME_MM] / extent[extent > SAME_MM]).min()) if (extent > SAME_MM).any() else 1.0
    drawn = (places_mm - (low + high) / 2) * (scale, -scale) + (WIDTH / 2 + 20, HEIGHT / 2 - 10)
    parts: dict[tuple[float, ...], list[dict[str, Any]]] = {}
    for one, place in zip(mounted, drawn.tolist(), strict=True):
        forward, _, top = one.axes
        right, upwards = forward[[across, up]]
        share = math.hypot(right, upwards)
        parts.setdefault(tuple(place), []).append(
            {
                "name": one.name,
                "is_head_on": share < HEAD_ON,
                "is_away": sign * forward[depth] < 0,
                "length": ARROW * share,
                "turn_deg": math.degrees(math.atan2(-upwards, right)),
                "top": UPRIGHT * top[[across, up]] * (1, -1),
            }
        )
    return {
        "title": title,
        "across": "xyz"[across],
        "up": "xyz"[up],
        "places": list(parts.items()),
        "columns": _labels(places_mm[:, 0], drawn[:, 0], WIDTH - EDGE),
        "rows": _labels(places_mm[:, 1], drawn[:, 1], HEIGHT - EDGE),
    }


def _labels(values_mm: np.ndarray, drawn: np.ndarray, end: float) -> list[tuple[float, float, float]]:
    """Each coordinate once with its place along an edge and that of its label; close labels are apart."""
    places, first = np.unique(drawn, return_index=True)
    # labels keep to the edge as far as there is room
    apart = min(APART, (end - EDGE / 2) / max(len(places) - 1, 1)) * np.arange(len(places))
    labels = np.minimum(np.maximum.accumulate(places - apart), end - apart[-1]) + apart
    return list(zip(values_mm[first].tolist(), places.tolist(), labels.tolist(), strict=True))


def _pose(one: MountedPart) -> list[str]:
    """The place, angles, axes and quaternion of a sensor."""
    place = [fixed(value, 1) for value in MM_PER_M * one.sensor.origin_m]
    angles = [fixed(math.degrees(angle), 2) for angle in one.angles_rad]
    vectors = (one.axes[0], one.axes[2], quaternion(*one.roll_pitch_yaw_rad))
    return [one.name, *place, *angles, *(" ".join(fixed(value, 4) for value in vector) for vector in vectors)]


def _part(one: MountedPart) -> list[str]:
    """What a sensor is, and what is known of how it is mounted."""
    ends = one.field_deg
    field = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in ends)
    if all(low == -high for low, high in ends):
        field = " x ".join(f"{high - low:.4g}" for low, high in ends)
    gate = " to ".join(f"{end:.3f}" for end in one.sensor.gate_m)
    reach = UNKNOWN if one.part is None else next(iter(reach_of(one.part).as_text().values()))
    stated = [reach, *(one.stated(name) for name in ("up", "zone_0", "origin"))]
    figures = [f"{value:g}" if (value := one.figure(name)) != "" else UNKNOWN for name in ("power_w", "price")]
    return [one.name, one.sensor.part or "none: programmable", one.pattern, field, gate, *stated, *figures]


def _total(mounted: Sequence[MountedPart], name: str, unit: str = "") -> str:
    """The sum of a figure over all sensors, and how many have none."""
    known = [value for one in mounted if (value := one.figure(name)) != ""]
    left_out = f", without {len(mounted) - len(known)}" if len(known) < len(mounted) else ""
    return f"{sum(known):.6g}{unit}{left_out}" if known else UNKNOWN
