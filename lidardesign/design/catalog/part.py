"""A real part in one of its modes, as designs use it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from lidardesign.design.catalog.pattern import Projection, inside, pattern_directions, projection_of
from lidardesign.design.catalog.statements import FieldOfView, PartFile, Source, Statement, ray_count
from lidardesign.design.grid import grid_rows
from lidardesign.errors import ConfigError

BITS_PER_MEGABIT = 1e6
BITS_PER_BYTE = 8
CONDITIONS = ("reflectance_percent", "illuminance_klux", "detection_percent", "at")


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
        figures: The statements of every field, the one that counts first.
        sources: By the key that statements name.
        origin: Where the part file is: `lidardesign`, or a path.
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
        name = stem if mode == first else f"{stem}:{mode}"
        return cls(
            name=name,
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
        """The figure of a field that counts; None where no source gives one."""
        statements = self.figures.get(name)
        return None if statements is None else statements[0].value

    @property
    def pattern(self) -> Any:
        """Where its rays go."""
        return self.figures["pattern"][0]

    @property
    def view(self) -> FieldOfView:
        """Its field of view, in degrees from its forward axis."""
        return self.figures["field_of_view_deg"][0]

    @property
    def projection(self) -> Projection:
        """What the two angles of its field of view are."""
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
        """Columns and rows of its pattern; of one that has none, those of as many rays in square cells."""
        pattern = self.pattern
        if hasattr(pattern, "rows"):
            return pattern.columns, pattern.rows
        if hasattr(pattern, "columns"):
            return pattern.columns, self.rays // pattern.columns
        rows = len(grid_rows(*self.field_of_view_rad, self.rays))
        return -(-self.rays // rows), rows

    @property
    def range_m(self) -> tuple[float, float]:
        """From where to where it measures, under the conditions of the first statements; from 0 where none says."""
        return self.value("near_m") or 0.0, self.figures["far_m"][0].value

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return self.figures["rate_hz"][0].value

    @property
    def histogram_mbps(self) -> float | None:
        """What its histograms cost to read: their number x bins x bits x rate [Mbit/s]; None where it gives none."""
        bins, bits = self.value("bins"), self.value("bits_per_bin")
        if bins is None or bits is None:
            return None
        return (self.value("histograms") or self.rays) * bins * bits * self.rate_hz / BITS_PER_MEGABIT

    @property
    def processed_mbps(self) -> float | None:
        """What its own results cost to read [Mbit/s]; None where no source says how long a frame is."""
        frame = self.value("frame_bytes")
        return None if frame is None else frame * BITS_PER_BYTE * self.rate_hz / BITS_PER_MEGABIT

    def inside(self, directions: np.ndarray) -> np.ndarray:
        """Which unit vectors in its own frame it sees: (N, 3) to bool (N,)."""
        return inside(self.view, self.projection, directions)

    def under(self, *, reflectance_percent: float | None = None, illuminance_klux: float | None = None) -> Part:
        """The same part with the range that its sources vouch for under conditions.

        A statement vouches for targets at least as bright and light at most as strong as its own; of those that do,
        the farthest counts. One that states no such condition says nothing about it.

        Raises:
            ConfigError: No source states a range under such conditions.
        """
        fits = [
            one
            for one in self.figures["far_m"]
            if _at_most(one.reflectance_percent, reflectance_percent)
            and _at_least(one.illuminance_klux, illuminance_klux)
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


def _at_most(stated: float | None, asked: float | None) -> bool:
    return asked is None or (stated is not None and stated <= asked)


def _at_least(stated: float | None, asked: float | None) -> bool:
    return asked is None or (stated is not None and stated >= asked)


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
    """Fields of which two sources give different figures for the same conditions."""
    return [name for name, statements in part.figures.items() if _disagree(statements)]


def _disagree(statements: Sequence[Statement]) -> bool:
    """Whether two statements differ in what they say, but neither in conditions nor by having one source."""
    told: dict[tuple[Any, ...], list[tuple[str, Any]]] = {}
    for one in statements:
        given = one.model_dump()
        conditions = tuple(given.pop(name) for name in CONDITIONS)
        source = given.pop("source")
        given.pop("note")
        told.setdefault(conditions, []).append((source, given))
    return any(
        first[0] != second[0] and first[1] != second[1]
        for same in told.values()
        for index, first in enumerate(same)
        for second in same[index + 1 :]
    )
