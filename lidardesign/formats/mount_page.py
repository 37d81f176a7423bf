"""What the person who builds a design needs, in one folder: a page to print on A4, the same as CSV, and frames of ROS.

Poses are those of each part's own axes: x forward (the optical axis), y to the left, z up, as in REP 103. What no
source says of a part stands there as unknown.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
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
    files = {
        "mounts.html": _page(design, mounted, frame, parent).encode(),
        "mounts.csv": csv_table([rows[0], *(row.values() for row in rows)]).encode(),
        "mounts.urdf": document(robot),
        "static_transforms.sh": "".join(f"{line} &\n" for line in _transforms(mounted, parent)).encode() + b"wait\n",
    }
    notes = write_folder(path, files)
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
WIDTH, HEIGHT, EDGE = 340.0, 270.0, 58.0
ARROW, UPRIGHT = 30.0, 12.0  # lengths of arrows and of marks of what is up
HEAD_ON = 0.25  # the share of an arrow across the view below which it is a ring
APART = 11.0  # of numbers along an edge
SAME_MM = 0.05


def _sketch(mounted: Sequence[MountedPart], title: str, across: int, up: int, depth: int, sign: int) -> str:
    """One view: places with their coordinates along the edges, arrows along the optical axes, marks of what is up."""
    places_mm = MM_PER_M * np.array([one.sensor.origin_m for one in mounted])[:, [across, up]]
    low, high = places_mm.min(axis=0), places_mm.max(axis=0)
    room = np.array([WIDTH, HEIGHT]) - 2 * EDGE - np.array([30.0, 0.0])
    extent = high - low
    scale = float((room[extent > SAME_MM] / extent[extent > SAME_MM]).min()) if (extent > SAME_MM).any() else 1.0
    middle = (low + high) / 2

    def drawn(place_mm: np.ndarray) -> np.ndarray:
        right, top = scale * (place_mm - middle)
        return np.array([WIDTH / 2 + 20 + right, HEIGHT / 2 - 10 - top])

    lines, at = [], {}
    for one, place_mm in zip(mounted, places_mm, strict=True):
        at.setdefault(tuple(np.round(place_mm, 1)), []).append(one)
    for place, here in at.items():
        x, y = drawn(np.array(place))
        for one in here:
            forward, _, top = one.axes
            lines.append(_arrow(x, y, forward[[across, up]], float(sign * forward[depth])))
            mark = UPRIGHT * top[[across, up]]
            lines.append(f'<line class="up" x1="{x:.1f}" y1="{y:.1f}" x2="{x + mark[0]:.1f}" y2="{y - mark[1]:.1f}"/>')
        names = html.escape(", ".join(one.name for one in here))
        lines += [
            f'<rect x="{x - 3:.1f}" y="{y - 3:.1f}" width="6" height="6"/>',
            f'<text class="name" x="{x + 6:.1f}" y="{y - 6:.1f}">{names}</text>',
        ]
    lines += _ordinates(places_mm[:, 0], lambda value: float(drawn(np.array([value, low[1]]))[0]), along=True)
    lines += _ordinates(places_mm[:, 1], lambda value: float(drawn(np.array([low[0], value]))[1]), along=False)
    titles = (
        f'<text x="{WIDTH / 2:.0f}" y="12" text-anchor="middle" class="title">{title}</text>'
        f'<text x="{WIDTH - 4:.0f}" y="{HEIGHT - 4:.0f}" text-anchor="end">{"xyz"[across]} [mm] to the right</text>'
        f'<text x="4" y="24">{"xyz"[up]} [mm] upwards</text>'
    )
    return f'<svg viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" role="img" aria-label="{title}">{titles}{"".join(lines)}</svg>'


def _arrow(x: float, y: float, looks: np.ndarray, nearer: float) -> str:
    """An arrow along the optical axis; a dot where it points at the viewer, a cross where it points away."""
    if np.hypot(*looks) < HEAD_ON:
        ring = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7"/>'
        away = f'<path d="M{x - 5:.1f} {y - 5:.1f}l10 10m-10 0l10 -10"/>'
        return f'<g class="look">{ring}{away if nearer < 0 else ""}</g>'
    tip = np.array([x, y]) + ARROW * looks * (1, -1)
    back = -7 * looks / np.hypot(*looks) * (1, -1)
    side = 0.5 * np.array([-back[1], back[0]])
    ends = [tip + back + side, tip, tip + back - side]
    head = " ".join(f"{px:.1f},{py:.1f}" for px, py in ends)
    shaft = f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{tip[0]:.1f}" y2="{tip[1]:.1f}"/>'
    return f'<g class="look">{shaft}<polyline points="{head}"/></g>'


def _ordinates(values_mm: np.ndarray, place_of: Callable[[float], float], *, along: bool) -> list[str]:
    """The coordinates of places with leaders, along the lower edge or the left one; close ones are drawn apart."""
    lines, distinct_mm = [], sorted(set(np.round(values_mm, 1).tolist()), key=place_of)
    places = np.array([place_of(value) for value in distinct_mm])
    # labels are apart, and keep to the edge as far as there is room
    end = (WIDTH if along else HEIGHT) - EDGE
    apart = min(APART, (end - EDGE / 2) / max(len(places) - 1, 1)) * np.arange(len(places))
    labels = np.maximum.accumulate(places - apart)
    labels = np.minimum(labels, end - apart[-1]) + apart
    for value, at, label in zip(distinct_mm, places, labels, strict=True):
        text = f"{value + 0.0:.1f}"
        if along:
            bottom = HEIGHT - EDGE + 6
            lines.append(f'<path class="leader" d="M{at:.1f} 30V{bottom - 8:.1f}L{label:.1f} {bottom:.1f}"/>')
            turn = f'transform="rotate(-90 {label + 3:.1f} {bottom + 4:.1f})"'
            lines.append(f'<text x="{label + 3:.1f}" y="{bottom + 4:.1f}" text-anchor="end" {turn}>{text}</text>')
        else:
            lines += [
                f'<path class="leader" d="M{WIDTH - 10:.0f} {at:.1f}H{EDGE + 8:.1f}L{EDGE:.1f} {label:.1f}"/>',
                f'<text x="{EDGE - 3:.1f}" y="{label + 3:.1f}" text-anchor="end">{text}</text>',
            ]
    return lines


STYLE = """@page { size: A4; margin: 14mm; }
* { box-sizing: border-box; }
body { font: 10pt/1.4 system-ui, "Segoe UI", Roboto, Arial, sans-serif; color: #1f2933; max-width: 182mm;
  margin: 0 auto; padding: 12px; }
h1 { font-size: 15pt; margin: 0 0 2mm; }
h2 { font-size: 11.5pt; margin: 5mm 0 1.5mm; break-after: avoid; }
p { margin: 0 0 2mm; }
table { border-collapse: collapse; width: 100%; font-size: 8.5pt; font-variant-numeric: tabular-nums;
  margin-bottom: 1mm; }
th, td { border: 0.3mm solid #9aa5b1; padding: 0.8mm 1.4mm; text-align: right; vertical-align: top; }
th { background: #eef1f4; }
.text { text-align: left; }
.unknown { color: #a13d00; }
tr { break-inside: avoid; }
.views { display: grid; grid-template-columns: 1fr 1fr; gap: 3mm; }
svg { border: 0.3mm solid #d9dee4; width: 100%; break-inside: avoid; }
svg text { font-size: 9px; fill: #4a5763; }
svg .name, svg .title { font-size: 10px; fill: #1f2933; font-weight: 600; }
svg .look { stroke: #005a8f; fill: none; stroke-width: 1.6; }
svg .up { stroke: #b36b00; stroke-width: 2; }
svg .leader { stroke: #b8c1cb; fill: none; stroke-width: 0.6; }
pre { font: 7pt/1.35 ui-monospace, Menlo, Consolas, monospace; white-space: pre-wrap; overflow-wrap: anywhere;
  background: #f3f5f8; padding: 2mm; }
@media print { body { padding: 0; max-width: none; } }
"""
POLICY = "default-src 'none'; style-src 'unsafe-inline'"
ANGLES = (
    "Azimuth runs from +x towards +y, elevation from the x-y plane towards +z. Roll turns the part about its optical "
    "axis, right-handed as seen from behind it: at 0 degrees its top points as far up (+z) as it can."
)


def _page(design: DesignSpec, mounted: Sequence[MountedPart], frame: str, parent: str) -> str:
    """The page to print."""
    title = f"Mounting {design.name}"
    of_world = "the <b>world's</b> frame: x forward, y to the left, z up"
    of_robot = f"the frame of <b>{html.escape(frame)}</b>, as the robot's model has it"
    views = "".join(_sketch(mounted, *view) for view in VIEWS)
    commands = html.escape("\n".join(_transforms(mounted, parent)))
    body = [
        f"<p>{len(mounted)} {'sensor' if len(mounted) == 1 else 'sensors'}. Places and directions are in "
        f"{of_world if design.mount is None else of_robot}. Numbers are rounded; "
        "<code>mounts.csv</code> has all digits. No design of this program has been built in hardware yet.</p>",
        "<h2>Where, and which way</h2>", _poses(mounted), f"<p>{ANGLES}</p>",
        '<div class="views">', views, "</div>",
        "<p>Squares: sensors. Blue: the optical axis, as a ring where it points at you, with a cross where it points "
        "away. Orange: the part's top. Each view has its own scale.</p>",
        "<h2>What</h2>", _parts_table(mounted), *_before_drilling(mounted),
        "<h2>In ROS 2</h2>",
        f"<p><code>mounts.urdf</code> has a fixed joint for each; or publish the frames:</p><pre>{commands}</pre>",
    ]  # fmt: skip
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n<style>{STYLE}</style>\n</head>\n<body>\n'
        f"<h1>{html.escape(title)}</h1>\n{''.join(body)}\n</body>\n</html>\n"
    )


def _poses(mounted: Sequence[MountedPart]) -> str:
    """The places, angles, axes and quaternions of all sensors as a table."""
    headings = ("sensor", "x", "y", "z", "azimuth", "elevation", "roll", "axis (x y z)", "top (x y z)", "q (w x y z)")
    rows = []
    for one in mounted:
        place = [f"{value + 0.0:.1f}" for value in np.round(MM_PER_M * one.sensor.origin_m, 1)]
        angles = [f"{round(math.degrees(angle), 2) + 0.0:.2f}" for angle in one.angles_rad]
        vectors = [one.axes[0], one.axes[2], quaternion(*one.roll_pitch_yaw_rad)]
        numbers = [" ".join(f"{value + 0.0:.4f}" for value in np.round(vector, 4)) for vector in vectors]
        rows.append([one.name, *place, *angles, *numbers])
    return _table(headings, rows, "Places in mm, angles in degrees.", text=(0,))


def _parts_table(mounted: Sequence[MountedPart]) -> str:
    """What each sensor is, and what is known of how it is mounted, with the sums of power and price."""
    headings = (
        "sensor", "part", "fires", "field of view [deg]", "gate [m]", "reach in the dark / sun [m]", "which side is up",
        "first zone looks", "rays start at", "power [W]", "price",
    )  # fmt: skip
    rows = []
    for one in mounted:
        ends = one.field_deg
        field = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in ends)
        if all(low == -high for low, high in ends):
            field = " x ".join(f"{high - low:.4g}" for low, high in ends)
        gate = " to ".join(f"{end:.3f}" for end in one.sensor.gate_m)
        reach = UNKNOWN if one.part is None else next(iter(reach_of(one.part).as_text().values()))
        stated = [reach, *(one.stated(name) for name in ("up", "zone_0", "origin"))]
        figures = [f"{value:g}" if (value := one.figure(name)) != "" else UNKNOWN for name in ("power_w", "price")]
        rows.append([one.name, one.sensor.part or "none: programmable", one.pattern, field, gate, *stated, *figures])
    totals = []
    for name, unit in (("power_w", " W"), ("price", "")):
        values = [one.figure(name) for one in mounted]
        known = [value for value in values if value != ""]
        totals.append(
            f"{sum(known):.6g}{unit}" + f", without {len(values) - len(known)}" * (len(known) < len(values))
            if known
            else UNKNOWN
        )
    rows.append(["in all", *[""] * 8, *totals])
    return _table(
        headings,
        rows,
        "Fields of view are about the optical axis: width x height, or right to left and lower to upper end.",
        (0, 1, 2, 6, 7, 8),
    )


def _before_drilling(mounted: Sequence[MountedPart]) -> list[str]:
    """What has to be found out before holes are drilled."""
    questions = [
        ("which side is up", "up"),
        ("where rays start on the part", "origin"),
        ("where the first zone looks", "zone_0"),
    ]
    missing = [text for text, name in questions if any(one.stated(name) == UNKNOWN for one in mounted)]
    found = []
    if missing and any(one.sensor.part is not None for one in mounted):
        found.append(f"<p><b>Before you drill</b>, find out for each part marked unknown: {'; '.join(missing)}.</p>")
    if any("unverified" in one.stated("zone_0") for one in mounted):
        found.append("<p>Confirm the first zone with a hand in one corner of the field.</p>")
    return found


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], caption: str, text: Sequence[int]) -> str:
    def cell(number: int, value: str, tag: str) -> str:
        kinds = [name for name, holds in (("text", number in text), ("unknown", UNKNOWN in value)) if holds]
        return f'<{tag} class="{" ".join(kinds)}">{html.escape(value)}</{tag}>'

    head = "".join(cell(number, value, "th") for number, value in enumerate(headings))
    lines = ["".join(cell(number, value, "td") for number, value in enumerate(row)) for row in rows]
    body = "</tr><tr>".join(lines)
    return f"<table><thead><tr>{head}</tr></thead><tbody><tr>{body}</tr></tbody></table><p>{caption}</p>"
