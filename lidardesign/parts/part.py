"""A real part in one of its modes, as designs use it: its figures, and its pattern in its own frame.

That frame has x forward, y to the left (growing azimuth), z up. The meaning of a field of view's two angles depends on
the part: equal angles from the forward axis (`tangent`: zones behind a wide lens, rosettes), azimuth and elevation
(`sphere`: whatever turns or steps), or angles in the horizontal and the vertical plane (`plane`: a camera whose pixels
are even on its focal plane).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.numerics import COARSE_SLACK, sphere_exp, sphere_log
from lidardesign.parts.statements import (
    TANGENT,
    Even,
    PartFieldOfView,
    PartFile,
    Rings,
    Rosette,
    Source,
    Statement,
    ray_count,
)
from lidardesign.sensors.pattern import grid_rows, low_discrepancy
from lidardesign.space import direction

Projection = Literal["tangent", "sphere", "plane"]
FULL_TURN_DEG = 360.0
BITS_PER_MEGABIT = 1e6
BITS_PER_BYTE = 8
CONDITIONS = ("reflectance_percent", "illuminance_klux", "detection_percent", "at")


def projection_of(pattern: Any, view: PartFieldOfView) -> Projection:
    """The projection of the two angles of a part's field of view: `tangent`, `sphere` or `plane`."""
    if pattern.kind == "pixels":
        return "plane"
    if pattern.kind in TANGENT or (isinstance(pattern, Even) and view.shape == "ellipse"):
        return "tangent"
    return "sphere"


def to_angles(projection: Projection, directions: np.ndarray) -> np.ndarray:
    """The two angles of unit vectors in the part's frame: (N, 3) to (N, 2) [rad]."""
    if projection == "tangent":
        return sphere_log(directions)
    x, y, z = directions.T
    if projection == "sphere":
        return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=1)
    # what is behind a camera has angles beyond a right one, which no field of it has
    return np.stack([np.arctan2(y, x), np.arctan2(z, x)], axis=1)


def to_directions(projection: Projection, angles: np.ndarray) -> np.ndarray:
    """Unit vectors in the part's frame at two angles: (N, 2) [rad] to (N, 3)."""
    if projection == "tangent":
        return sphere_exp(angles)
    if projection == "sphere":
        return direction(angles[:, 0], angles[:, 1])
    plane = np.concatenate([np.ones((len(angles), 1)), np.tan(angles)], axis=1)
    return plane / np.linalg.norm(plane, axis=1, keepdims=True)


def pattern_directions(pattern: Any, view: PartFieldOfView, rate_hz: float) -> np.ndarray:
    """The unit vectors of a frame in the part's frame, in the order in which they fire, shape (M, 3)."""
    (left, right), (bottom, top) = view.azimuth, view.elevation
    if isinstance(pattern, Rosette):
        # thin prisms: each adds a fixed deflection in the direction in which it stands (first order in the wedge)
        time_s = np.arange(ray_count(pattern, rate_hz)) / pattern.points_per_s
        angles_deg = np.zeros((len(time_s), 2))
        for turns_hz, deflection_deg in zip(pattern.rotor_hz, pattern.deflection_deg, strict=True):
            phase = 2 * np.pi * turns_hz * time_s
            angles_deg += deflection_deg * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    elif isinstance(pattern, Even):
        angles_deg = _even_angles(pattern.rays, view)
    elif isinstance(pattern, Rings):
        # column by column, as a head turns; all beams of a column fire at about the same time
        elevations = pattern.elevations_deg or _ends_included(bottom, top, pattern.rings or 1)
        spaced = _cell_centres if right - left >= FULL_TURN_DEG - COARSE_SLACK else _ends_included
        across = spaced(left, right, pattern.columns)
        angles_deg = np.stack([np.repeat(across, len(elevations)), np.tile(elevations, pattern.columns)], axis=1)
    else:
        # row by row; pixels are even on a plane
        spaced = _plane_centres if pattern.kind == "pixels" else _cell_centres
        across, up = spaced(left, right, pattern.columns), spaced(bottom, top, pattern.rows)
        angles_deg = np.stack([np.tile(across, len(up)), np.repeat(up, len(across))], axis=1)
    return to_directions(projection_of(pattern, view), np.radians(angles_deg))


def _cell_centres(low: float, high: float, count: int) -> np.ndarray:
    """Centres of equal cells of an interval: never on its ends, shape (count,)."""
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _plane_centres(low_deg: float, high_deg: float, count: int) -> np.ndarray:
    """Angles of pixels that are even on a plane, shape (count,) [degrees]."""
    low, high = math.tan(math.radians(low_deg)), math.tan(math.radians(high_deg))
    return np.degrees(np.arctan(_cell_centres(low, high, count)))


def _ends_included(low: float, high: float, count: int) -> np.ndarray:
    return np.linspace(low, high, count) if count > 1 else np.array([(low + high) / 2])


def _even_angles(count: int, view: PartFieldOfView) -> np.ndarray:
    """Points that fill the field evenly per solid angle (a disc in its tangent plane), shape (count, 2) [degrees]."""
    unit = low_discrepancy(count, 2)
    (left, right), (bottom, top) = view.azimuth, view.elevation
    if view.shape == "ellipse":
        radius, turn = np.sqrt(unit[:, 0]), 2 * np.pi * unit[:, 1]
        middle = np.array([left + right, bottom + top]) / 2
        half = np.array([right - left, top - bottom]) / 2
        return middle + half * radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    low, high = math.sin(math.radians(bottom)), math.sin(math.radians(top))
    up = np.degrees(np.arcsin(np.clip(low + (high - low) * unit[:, 1], -1.0, 1.0)))
    return np.stack([left + (right - left) * unit[:, 0], up], axis=1)


@dataclass(frozen=True, eq=False)
class Part:
    """One mode of one part.

    Arguments:
        name: Its name in the catalogue, with `:MODE` behind it where that is not the first.
        product: Maker and product.
        kind: `multi-zone`, `spinning`, ...
        summary: One line for people.
        mode: The mode's name; None where the part has one only.
        modes: All modes' names.
        figures: The statements of every field, the one in use first.
        sources: By the key that statements name.
        origin: `lidardesign` for a shipped part, else the path of its file.
    """

    name: str
    product: str
    kind: str
    summary: str
    mode: str | None
    modes: tuple[str, ...]
    figures: Mapping[str, Sequence[Any]]
    sources: Mapping[str, Source] = field(default_factory=dict)
    origin: str = "lidardesign"

    @classmethod
    def of_file(cls, stem: str, file: PartFile, mode: str | None, origin: str) -> Part:
        """One mode of a part file; None is its first."""
        modes = tuple(file.modes)
        first = modes[0] if modes else None
        mode = mode or first
        return cls(
            name=stem if mode == first else f"{stem}:{mode}",
            product=f"{file.maker} {file.product}",
            kind=file.kind,
            summary=file.summary,
            mode=mode,
            modes=modes,
            figures=file.figures(mode),
            sources=file.sources,
            origin=origin,
        )

    def value(self, name: str) -> float | None:
        """The figure in use of a field; None where no source gives one."""
        statements = self.figures.get(name)
        return None if statements is None else statements[0].value

    @property
    def pattern(self) -> Any:
        """Its pattern of rays."""
        return self.figures["pattern"][0]

    @property
    def view(self) -> PartFieldOfView:
        """Its field of view, in degrees from its forward axis."""
        return self.figures["field_of_view_deg"][0]

    @property
    def projection(self) -> Projection:
        """The projection of the two angles of its field of view."""
        return projection_of(self.pattern, self.view)

    @property
    def field_of_view_rad(self) -> tuple[float, float]:
        """Full horizontal and vertical angles."""
        horizontal, vertical = (math.radians(high - low) for low, high in (self.view.azimuth, self.view.elevation))
        return horizontal, vertical

    @property
    def centre_rad(self) -> tuple[float, float]:
        """Azimuth and elevation of its field's centre in its own frame."""
        azimuth, elevation = (math.radians(low + high) / 2 for low, high in (self.view.azimuth, self.view.elevation))
        return azimuth, elevation

    @cached_property
    def directions(self) -> np.ndarray:
        """The unit vectors of one frame in its own frame, in the order in which they fire, shape (rays, 3)."""
        return pattern_directions(self.pattern, self.view, self.rate_hz)

    @property
    def rays(self) -> int:
        """Rays per frame."""
        return ray_count(self.pattern, self.rate_hz)

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of its pattern; of one without a grid, those of as many rays in nearly square cells."""
        pattern = self.pattern
        if hasattr(pattern, "rows"):
            return pattern.columns, pattern.rows
        if hasattr(pattern, "columns"):
            return pattern.columns, self.rays // pattern.columns
        rows = len(grid_rows(*self.field_of_view_rad, self.rays))
        return -(-self.rays // rows), rows

    @property
    def beam_rad(self) -> float:
        """The angle of what one ray sees: a zone's, of rectangular ones the mean, or what is stated; 0: unknown."""
        if self.pattern.kind == "zones":
            return math.sqrt(math.prod(self.field_of_view_rad) / self.rays)
        return (self.value("divergence_mrad") or 0.0) / 1000

    @property
    def range_m(self) -> tuple[float, float]:
        """The range that it measures, from and to, by the first statements [m]; from 0 where none states it."""
        return self.value("near_m") or 0.0, self.figures["far_m"][0].value

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return self.figures["rate_hz"][0].value

    @property
    def histogram_mbps(self) -> float | None:
        """The bandwidth of its histograms: their number x bins x bits x rate [Mbit/s]; None where it has none."""
        bins, bits = self.value("bins"), self.value("bits_per_bin")
        if bins is None or bits is None:
            return None
        return (self.value("histograms") or self.rays) * bins * bits * self.rate_hz / BITS_PER_MEGABIT

    @property
    def processed_mbps(self) -> float | None:
        """The bandwidth of its processed frames [Mbit/s]; None where no source states their size."""
        frame = self.value("frame_bytes")
        return None if frame is None else frame * BITS_PER_BYTE * self.rate_hz / BITS_PER_MEGABIT

    def under(self, *, reflectance_percent: float | None = None, illuminance_klux: float | None = None) -> Part:
        """The part with the largest range that its sources state for given conditions; without any, itself.

        A statement holds for targets at least as bright and ambient light at most as strong as its own. One that lacks
        a given condition is left out.

        Raises:
            ConfigError: No source states a range under such conditions.
        """
        if reflectance_percent is None and illuminance_klux is None:
            return self
        fits = [
            one
            for one in self.figures["far_m"]
            if (
                reflectance_percent is None
                or (one.reflectance_percent is not None and one.reflectance_percent <= reflectance_percent)
            )
            and (
                illuminance_klux is None
                or (one.illuminance_klux is not None and one.illuminance_klux >= illuminance_klux)
            )
        ]
        if not fits:
            asked = _conditions(reflectance_percent, illuminance_klux)
            raise ConfigError(
                f"no source of {self.name} states a range at {asked}",
                where="catalog",
                allowed="; ".join(sorted({conditions_of(one) or "no conditions" for one in self.figures["far_m"]})),
            )
        best = max(fits, key=lambda one: one.value)
        others = [one for one in self.figures["far_m"] if one is not best]
        return replace(self, figures={**self.figures, "far_m": [best, *others]})


def _conditions(reflectance_percent: float | None, illuminance_klux: float | None) -> str:
    parts = [] if reflectance_percent is None else [f"{reflectance_percent:g} % reflectance"]
    if illuminance_klux is not None:
        parts.append("darkness" if illuminance_klux == 0 else f"{illuminance_klux:g} klux")
    return ", ".join(parts)


def conditions_of(statement: Statement) -> str:
    """The conditions of a statement, for people; empty where it states none."""
    parts = [statement.at, _conditions(statement.reflectance_percent, statement.illuminance_klux)]
    if statement.detection_percent is not None:
        parts.append(f"{statement.detection_percent:g} % detected")
    return ", ".join(part for part in parts if part)


def disagreements(part: Part) -> list[str]:
    """Names of fields for which two sources give different figures under the same conditions."""
    names = []
    for name, statements in part.figures.items():
        # source and figure of the statements under the same conditions
        same: dict[tuple[Any, ...], list[tuple[str, Any]]] = {}
        for statement in statements:
            figure = statement.model_dump(exclude={"note"})
            same.setdefault(tuple(figure.pop(key) for key in CONDITIONS), []).append((figure.pop("source"), figure))
        pairs = (pair for found in same.values() for pair in itertools.combinations(found, 2))
        if any(first[0] != second[0] and first[1] != second[1] for first, second in pairs):
            names.append(name)
    return names
