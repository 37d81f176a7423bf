"""The design file: one readable YAML document with units in its keys.

Numbers are written with all their digits: what is loaded is bit for bit what was saved.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from lidardesign.errors import ConfigError, page
from lidardesign.limits import LEVELS
from lidardesign.numerics import COARSE_SLACK, SLACK
from lidardesign.run.files import write_atomic
from lidardesign.run.validation import check_model, is_name, placed_at
from lidardesign.run.yaml import dump_yaml
from lidardesign.sensors.adaptive import AdaptivePatterns, PatternRule
from lidardesign.sensors.design import DesignSpec, LayoutName
from lidardesign.sensors.pattern import Pattern
from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor
from lidardesign.space import DIMENSIONS, FARTHEST_M, FULL_TURN, LARGEST_ANGLE_RAD

SCHEMA_VERSION = 2
# Seven numbers of a ray at each knot stay below the number of values that the YAML reader accepts in one file.
MOST_FILE_RAYS = 60_000
# Weights that sum to 1 within this are taken as they stand, so that loading changes no bit.
WEIGHT_SUM_TOLERANCE = SLACK
# How much below zero rounding may push an eigenvalue of a covariance, relative to the largest.
COVARIANCE_ROUNDING = SLACK


def check_name(text: str) -> str:
    """The text, checked to be readable."""
    if not is_name(text):
        raise ValueError("is blank, or has control characters")
    return text


Name = Annotated[str, AfterValidator(check_name)]
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
Distance = Annotated[float, Field(ge=0, le=FARTHEST_M)]
Azimuth = Annotated[float, Field(ge=-LARGEST_ANGLE_RAD, le=LARGEST_ANGLE_RAD)]
Elevation = Annotated[float, Field(ge=-math.pi / 2, le=math.pi / 2)]
Extent = Annotated[float, Field(ge=0, le=FULL_TURN)]
Vector = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Variance = Annotated[float, Field(ge=-(FARTHEST_M**2), le=FARTHEST_M**2)]
Row = Annotated[list[Variance], Field(min_length=3, max_length=3)]


class StrictKeys(BaseModel):
    """Unknown keys are errors; numbers are numbers, not text."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


class OriginEntry(StrictKeys):
    """The origin of a sensor [m], or the mean and covariance of a region in which its rays start [m^2]."""

    mean: Vector
    covariance: Annotated[list[Row], Field(min_length=3, max_length=3)] | None = None

    @model_validator(mode="after")
    def _positive(self) -> OriginEntry:
        if self.covariance is not None:
            matrix = np.array(self.covariance)
            slack = COVARIANCE_ROUNDING * np.abs(matrix).max()
            if np.abs(matrix - matrix.T).max() > slack or np.linalg.eigvalsh(matrix).min() < -slack:
                raise ValueError("the covariance is not symmetric, or has a negative eigenvalue")
        return self


class BoresightEntry(StrictKeys):
    """The boresight of a sensor [rad]: azimuth from +x to +y, elevation up from the xy plane, roll about itself."""

    azimuth_rad: Azimuth
    elevation_rad: Elevation
    roll_rad: Azimuth = 0.0


class FieldEntry(StrictKeys):
    """Full angles in the boresight's own tangent plane."""

    horizontal: Extent
    vertical: Extent


class GateEntry(StrictKeys):
    """The gate of a sensor as one-way distances [m]; the start is included, the end is not."""

    start: Distance
    end: Distance

    @model_validator(mode="after")
    def _has_width(self) -> GateEntry:
        if self.end <= self.start:
            raise ValueError(f"the end {self.end:g} is not beyond the start {self.start:g}")
        return self


class SensorEntry(StrictKeys):
    """A sensor; `weight` is its share of even rays, in proportion to the sum."""

    name: Name | None = None
    part: Name | None = None
    weight: Annotated[float, Field(ge=0)] | None = None
    origin_m: OriginEntry
    boresight: BoresightEntry
    field_of_view_rad: FieldEntry
    gate_m: GateEntry


class PatternEntry(StrictKeys):
    """A pattern: a table for each property of its rays, with a row for each knot of a condition."""

    dimension: Literal["x_m", "y_m", "z_m"] | None = None
    knots_m: list[Coordinate] = []
    origin_x_m: list[list[Coordinate]]
    origin_y_m: list[list[Coordinate]]
    origin_z_m: list[list[Coordinate]]
    azimuth_rad: list[list[Azimuth]]
    elevation_rad: list[list[Elevation]]
    gate_start_m: list[list[Distance]]
    gate_end_m: list[list[Distance]]
    sensor: list[Annotated[int, Field(ge=0)]]

    @model_validator(mode="after")
    def _whole(self) -> PatternEntry:
        if (self.dimension is None) != (len(self.knots_m) < 2):
            raise ValueError("knots_m needs at least two values with a dimension, and none without")
        if any(after <= before for before, after in zip(self.knots_m, self.knots_m[1:], strict=False)):
            raise ValueError("knots_m does not ascend")
        rows, rays = max(len(self.knots_m), 1), len(self.sensor)
        for name in COLUMNS:
            column = getattr(self, name)
            if len(column) != rows or any(len(row) != rays for row in column) or not rays:
                raise ValueError(f"{name} is not {rows} rows of {rays} numbers, as there are knots and rays")
        for starts, ends in zip(self.gate_start_m, self.gate_end_m, strict=True):
            for ray, (start, end) in enumerate(zip(starts, ends, strict=True)):
                if end <= start:
                    raise ValueError(f"the gate of ray {ray} ends at {end:g} m, not beyond its start {start:g} m")
        return self


COLUMNS = (
    "origin_x_m", "origin_y_m", "origin_z_m", "azimuth_rad", "elevation_rad", "gate_start_m", "gate_end_m",
)  # fmt: skip


class MountEntry(StrictKeys):
    """The body of a robot that the sensors are mounted on, the frame of origins and directions."""

    body: Name


class AdaptiveEntry(StrictKeys):
    """Patterns that follow what they see: the first fires where nothing is known, the others near their centroid."""

    looks: Annotated[int, Field(ge=0)] = 0
    missing_m: list[Distance] = []
    centroids: Annotated[list[list[float]], Field(min_length=1)]
    shares: list[Annotated[float, Field(ge=0, le=1)]]
    patterns: list[PatternEntry]

    @model_validator(mode="after")
    def _whole(self) -> AdaptiveEntry:
        count, rays = len(self.centroids), {len(pattern.sensor) for pattern in self.patterns}
        if len(self.patterns) != count + 1 or len(self.shares) != count + 1:
            raise ValueError(
                f"{count} centroids need {count + 1} patterns and shares, the first for when nothing is known"
            )
        if abs(math.fsum(self.shares) - 1) > COARSE_SLACK:
            raise ValueError("shares do not sum to 1")
        if len(rays) > 1 or any(pattern.dimension for pattern in self.patterns):
            raise ValueError("patterns that follow what they see need equal numbers of rays and no dimension")
        sizes = {len(centroid) for centroid in self.centroids}
        if len(sizes) > 1 or 0 in sizes or (self.looks and sizes != {self.looks}):
            raise ValueError("centroids need one number per feature, or with a first look one per ray of it")
        if len(self.missing_m) != self.looks or self.looks > min(rays):
            raise ValueError("missing_m needs a range for each ray of the first look, which every pattern begins with")
        rows = {name: [getattr(pattern, name)[0] for pattern in self.patterns] for name in COLUMNS}
        rows["sensor"] = [pattern.sensor for pattern in self.patterns]
        for name, own in rows.items():
            if any(row[: self.looks] != own[0][: self.looks] for row in own):
                raise ValueError(f"patterns differ in {name} of the first look")
        return self


class DesignFile(StrictKeys):
    """A LiDAR design: sensors, the patterns that they fire, and the constraints that they keep. Metres and radians."""

    schema_version: Literal[2]
    name: Name | None = None
    layout: LayoutName = "even"
    level: Annotated[float, Field(ge=LEVELS[0], le=LEVELS[1])] = DEFAULT_LEVEL
    sensors: Annotated[list[SensorEntry], Field(min_length=1)]
    patterns: list[PatternEntry] = []
    at: dict[Literal[DIMENSIONS], Coordinate] = {}  # type: ignore[valid-type]
    mount: MountEntry | None = None
    adaptive: AdaptiveEntry | None = None
    constraints: dict[str, Any] = {}
    certificates: list[dict[str, Any]] = []
    provenance: dict[str, Any] = {}

    @model_validator(mode="after")
    def _consistent(self) -> DesignFile:
        names = [sensor.name for sensor in self.sensors if sensor.name is not None]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two sensors have the name {twice!r}")
        weights = [sensor.weight for sensor in self.sensors]
        if any(weight is None for weight in weights) and any(weight is not None for weight in weights):
            raise ValueError("some sensors have a weight and others none: give all weights or none")
        if None not in weights and not 0 < sum(weights) < math.inf:
            raise ValueError("the weights of the sensors are all zero, or too large to sum")
        if (self.layout == "even") != (not self.patterns):
            raise ValueError(
                f"the layout {self.layout} has {'no' if self.layout == 'even' else 'at least one'} pattern"
            )
        sizes = [len(pattern.sensor) for pattern in self.patterns]
        if len(sizes) > 1 and (self.layout != "chosen" or sorted(set(sizes)) != sizes):
            raise ValueError("several patterns need the layout chosen and ascending numbers of rays")
        if len({pattern.dimension for pattern in self.patterns}) > 1:
            raise ValueError("patterns follow different conditions")
        every = [*self.patterns, *(self.adaptive.patterns if self.adaptive else [])]
        if any(max(pattern.sensor) >= len(self.sensors) for pattern in every):
            raise ValueError(f"a pattern names a sensor beyond the last of {len(self.sensors)}, counted from 0")
        if self.adaptive is not None and len(self.adaptive.patterns[0].sensor) not in sizes:
            raise ValueError("no pattern has as many rays as the adaptive ones: one is needed to fire without the rule")
        return self


def design_document(design: DesignSpec) -> dict[str, Any]:
    """The plain document of a design, in the order in which it is written."""
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "name": design.name,
        "layout": design.layout,
        "level": float(design.level),
        "sensors": [sensor.as_dict() for sensor in design.sensors],
    }
    if design.patterns:
        document["patterns"] = [pattern_document(pattern) for pattern in design.patterns]
    if design.at:
        document["at"] = {name: float(value) for name, value in design.at.items()}
    if design.mount is not None:
        document["mount"] = {"body": design.mount}
    if design.adaptive is not None:
        document["adaptive"] = _adaptive_document(design.adaptive)
    document["constraints"] = design.constraints
    if design.certificates:
        document["certificates"] = [*design.certificates]
    document["provenance"] = design.provenance
    return document


def _adaptive_document(adaptive: AdaptivePatterns) -> dict[str, Any]:
    rule = adaptive.rule
    look = {"looks": rule.looks, "missing_m": rule.missing_m.tolist()} if rule.looks else {}
    return {
        **look,
        "centroids": rule.centroids.tolist(),
        "shares": adaptive.shares.tolist(),
        "patterns": [pattern_document(pattern) for pattern in adaptive.patterns],
    }


def pattern_document(pattern: Pattern) -> dict[str, Any]:
    """The plain document of a pattern."""
    columns = (
        *np.moveaxis(pattern.origin_m, 2, 0), pattern.azimuth_rad, pattern.elevation_rad,
        *np.moveaxis(pattern.gate_m, 2, 0),
    )  # fmt: skip
    along = {} if pattern.dimension is None else {"dimension": pattern.dimension, "knots_m": [*pattern.knots]}
    return {
        **along,
        **{name: column.tolist() for name, column in zip(COLUMNS, columns, strict=True)},
        "sensor": pattern.sensor.tolist(),
    }


def digested(certificate: Mapping[str, Any], design: DesignSpec) -> dict[str, Any]:
    """A certificate with the digest of its own figures and of the rays, gates and owners that it is for.

    One that has another digest, or none, was changed or is for other rays.
    """
    pattern = design.pattern(certificate.get("rays", 0))
    written = {**certificate, "digest": None if pattern is None else pattern_document(pattern)}
    text = repr(sorted(written.items())).encode(errors="replace")
    return {**certificate, "digest": hashlib.sha256(text).hexdigest()[:16]}


def save_design(design: DesignSpec, path: Path) -> None:
    """Write a design file, atomically.

    Raises:
        DataError: The file cannot be written.
        NumericalError, ConfigError: See `design_text`.
    """
    write_atomic(Path(path), design_text(design, path))


def design_text(design: DesignSpec, path: Path) -> str:
    """The text of a design's file.

    Raises:
        NumericalError: The design holds a number that is not finite.
        ConfigError: More rays than a file can be read back with.
    """
    every = (*design.patterns, *(design.adaptive.patterns if design.adaptive else ()))
    rays = sum(pattern.azimuth_rad.size for pattern in every)
    if rays > MOST_FILE_RAYS:
        raise ConfigError(
            f"{rays} rays in all patterns and at all knots",
            where=str(path),
            allowed=f"at most {MOST_FILE_RAYS}",
            hint="fewer rays; the layout even needs no pattern",
        )
    return dump_yaml(design_document(design))


def design_from_document(document: Any, where: str = "design", locate: Callable[..., str] | None = None) -> DesignSpec:
    """Build a design from its plain document.

    Arguments:
        document: The mapping of a design file.
        where: What to call it in messages.
        locate: Positions of key paths in the file, where there is one.

    Raises:
        ConfigError: A key is missing, unknown, of the wrong kind, or contradicts another.
    """
    locate = locate or placed_at(where)
    if not isinstance(document, dict) or "sensors" not in document:
        raise ConfigError(
            "this is not a design: it has no key `sensors`",
            where=locate(()),
            hint=f"{page('design-file.md')} shows a design written by hand",
        )
    version = document.get("schema_version")
    if type(version) is int and version != SCHEMA_VERSION:
        older = version < SCHEMA_VERSION
        raise ConfigError(
            f"this design was written by {'an earlier' if older else 'a newer'} version of lidardesign",
            where=locate(("schema_version",)),
            allowed=f"schema_version: {SCHEMA_VERSION}",
            hint="fit it again: lidardesign fit RUN" if older else "use that version",
        )
    # an optional key that is null counts as absent
    file = check_model(DesignFile, {key: value for key, value in document.items() if value is not None}, locate)
    return DesignSpec(
        name=file.name or Path(where).stem,
        sensors=tuple(_sensors(file.sensors)),
        layout=file.layout,
        patterns=tuple(map(_pattern, file.patterns)),
        constraints=file.constraints,
        certificates=tuple(file.certificates),
        provenance=file.provenance,
        level=file.level,
        at=file.at,
        mount=None if file.mount is None else file.mount.body,
        adaptive=None if file.adaptive is None else _adaptive(file.adaptive),
    )


def _adaptive(entry: AdaptiveEntry) -> AdaptivePatterns:
    rule = PatternRule(np.array(entry.centroids), entry.looks, np.array(entry.missing_m, dtype=np.float64))
    return AdaptivePatterns(rule, tuple(map(_pattern, entry.patterns)), np.array(entry.shares))


def _sensors(entries: list[SensorEntry]) -> Iterator[Sensor]:
    """Sensors with shares that sum to 1: equal where no sensor has a weight, else in their proportion."""
    weights = [1.0 if entry.weight is None else entry.weight for entry in entries]
    total = math.fsum(weights)
    for index, (entry, weight) in enumerate(zip(entries, weights, strict=True)):
        covariance = entry.origin_m.covariance
        yield Sensor(
            name=entry.name or f"sensor_{index + 1}",
            weight=weight if abs(total - 1) <= WEIGHT_SUM_TOLERANCE else weight / total,
            origin_m=np.array(entry.origin_m.mean),
            azimuth_rad=entry.boresight.azimuth_rad,
            elevation_rad=entry.boresight.elevation_rad,
            roll_rad=entry.boresight.roll_rad,
            field_of_view_rad=(entry.field_of_view_rad.horizontal, entry.field_of_view_rad.vertical),
            gate_m=(entry.gate_m.start, entry.gate_m.end),
            origin_covariance_m2=None if covariance is None or not np.any(covariance) else np.array(covariance),
            part=entry.part,
        )


def _pattern(entry: PatternEntry) -> Pattern:
    columns = {name: np.array(getattr(entry, name), dtype=np.float64) for name in COLUMNS}
    x_m, y_m, z_m, azimuth_rad, elevation_rad, start_m, end_m = columns.values()
    return Pattern(
        np.stack([x_m, y_m, z_m], axis=2),
        azimuth_rad,
        elevation_rad,
        np.stack([start_m, end_m], axis=2),
        np.array(entry.sensor, dtype=np.int64),
        entry.dimension,
        tuple(entry.knots_m),
    )
