"""Statements of part files: every figure with its source and the conditions that it was measured under.

A field is a list of statements. The first is the one that designs use; the others are kept so that sources which
disagree, and ranges under other conditions, stay visible.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from lidardesign.limits import MOST_RAYS
from lidardesign.sensors.design_file import StrictKeys, check_name

# In whatever unit a figure has: what is beyond is a slip.
LARGEST = 1e12
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Percent = Annotated[float, Field(gt=0, le=100)]
Count = Annotated[int, Field(ge=1, le=MOST_RAYS)]
Text = Annotated[str, Field(max_length=500), AfterValidator(check_name)]
Angle = Annotated[float, Field(ge=-180, le=180)]
Elevation = Annotated[float, Field(ge=-90, le=90)]
Pair = Annotated[list[Annotated[float, Field(ge=-LARGEST, le=LARGEST)]], Field(min_length=2, max_length=2)]


class Source(StrictKeys):
    """A source of figures."""

    title: Text
    kind: Literal["datasheet", "manual", "product page", "simulator file", "driver", "list", "paper", "measurement"]
    publisher: Text | None = None
    revision: Text | None = None


class Statement(StrictKeys):
    """One source's figure and the conditions that it holds under.

    Arguments:
        source: Key of the source in the file's `sources`.
        reflectance_percent: Of the target that a range was measured on.
        illuminance_klux: Ambient light at the target; 0 is darkness.
        detection_percent: Detection rate of the target.
        at: Zone, channel, mode or echo, in words.
        note: Further remarks.
    """

    source: Text
    reflectance_percent: Percent | None = None
    illuminance_klux: NotNegative | None = None
    detection_percent: Percent | None = None
    at: Text | None = None
    note: Text | None = None


class Value(Statement):
    """A number above 0, in the unit of its field's key."""

    value: Positive


class Limit(Statement):
    """A number of at least 0, in the unit of its field's key."""

    value: NotNegative


class Whole(Statement):
    """A count."""

    value: Count


class PartFieldOfView(Statement):
    """Intervals of a part's field of view, relative to its forward axis [degrees].

    An `ellipse` touches its intervals in the middle; a `rectangle` fills them.
    """

    azimuth: Annotated[list[Angle], Field(min_length=2, max_length=2)]
    elevation: Annotated[list[Elevation], Field(min_length=2, max_length=2)]
    shape: Literal["rectangle", "ellipse"] = "rectangle"

    @model_validator(mode="after")
    def _ordered(self) -> PartFieldOfView:
        for name, (low, high) in (("azimuth", self.azimuth), ("elevation", self.elevation)):
            if low > high:
                raise ValueError(f"{name} runs from {low:g} down to {high:g}")
        return self


class MountingStatement(Statement):
    """How a part is mounted; what no source says is left out.

    Arguments:
        up: Which side of it points up where its pattern is upright.
        zone_0: Where its first zone looks, as seen along its axis.
        origin: The point of it that rays start from.
    """

    up: Text | None = None
    zone_0: Text | None = None
    origin: Text | None = None


class Cells(Statement):
    """Rows and columns of rays.

    Arguments:
        kind: `zones` of equal angles, as of a multi-zone ranger: one ray at each zone's centre; `pixels` of a camera
            behind a lens without distortion: even on its focal plane; `raster`, the steps of a two-dimensional scan,
            even in azimuth and elevation, at the centres of their cells.
        columns, rows: How many there are.
    """

    kind: Literal["zones", "pixels", "raster"]
    columns: Count
    rows: Count


class Rings(Statement):
    """Beams of fixed elevations that turn: every one fires at `columns` azimuths.

    Arguments:
        columns: Azimuths per turn or sweep. A sweep of less than a full turn has its first and last on its ends.
        rings: Number of beams, even from the lowest to the highest elevation of the field.
        elevations_deg: The beams' elevations, where they are not even.
    """

    kind: Literal["rings"]
    columns: Count
    rings: Count | None = None
    elevations_deg: Annotated[list[Elevation], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Rings:
        if (self.rings is None) == (self.elevations_deg is None):
            raise ValueError("give either rings or elevations_deg")
        return self


class Rosette(Statement):
    """The path of two turning prisms that each deflect the beam by a fixed angle; successive frames differ.

    Arguments:
        rotor_hz: Turns per second of each prism; opposite signs turn opposite ways.
        deflection_deg: By how much each prism turns the beam.
        points_per_s: Pulses per second.
    """

    kind: Literal["rosette"]
    rotor_hz: Pair
    deflection_deg: Annotated[list[Annotated[float, Field(gt=0, le=90)]], Field(min_length=2, max_length=2)]
    points_per_s: Positive


class Even(Statement):
    """Rays spread evenly over the field, for a pattern that the maker does not publish."""

    kind: Literal["even"]
    rays: Count


Pattern = Annotated[Cells | Rings | Rosette | Even, Field(discriminator="kind")]
Values = Annotated[list[Value], Field(min_length=1)]
Limits = Annotated[list[Limit], Field(min_length=1)]
Wholes = Annotated[list[Whole], Field(min_length=1)]


class Figures(StrictKeys):
    """Fields of a part, or of one of its modes; each is a list of statements.

    Arguments:
        pattern: Its pattern of rays.
        field_of_view_deg: Its field of view.
        near_m, far_m: The ranges that it measures; the gate of its rays.
        rate_hz: Frames per second.
        returns: Echoes per ray at most.
        wavelength_nm, divergence_mrad, power_w: Of its light; power is what the part consumes.
        price: In the currency of whoever compares prices.
        mounting: How it is mounted.
        noise_m: Standard deviation of a range.
        accuracy_m, accuracy_percent: The largest error of a range, or its share.
        bins, bin_ps, bits_per_bin: The histogram that it gives per ray, where it gives one.
        histograms: Histograms per frame, where they are not one per ray.
        frame_bytes: Bytes per frame when it processes histograms itself.
        points_per_s: Points that it sends per second.
    """

    pattern: Annotated[list[Pattern], Field(min_length=1)] | None = None
    field_of_view_deg: Annotated[list[PartFieldOfView], Field(min_length=1)] | None = None
    near_m: Limits | None = None
    far_m: Values | None = None
    rate_hz: Values | None = None
    returns: Wholes | None = None
    wavelength_nm: Values | None = None
    divergence_mrad: Values | None = None
    noise_m: Values | None = None
    accuracy_m: Values | None = None
    accuracy_percent: Values | None = None
    bins: Wholes | None = None
    bin_ps: Values | None = None
    bits_per_bin: Wholes | None = None
    histograms: Wholes | None = None
    frame_bytes: Wholes | None = None
    points_per_s: Values | None = None
    power_w: Values | None = None
    price: Values | None = None
    mounting: Annotated[list[MountingStatement], Field(min_length=1)] | None = None


FIELDS = tuple(Figures.model_fields)
REQUIRED = ("pattern", "field_of_view_deg", "far_m", "rate_hz")
# Patterns whose field of view is in angles from the forward axis.
TANGENT = ("zones", "rosette")
STRAIGHT_DEG = 180.0
RIGHT_DEG = 90.0
MODE_NAME = r"^[a-z0-9][a-z0-9.-]{0,30}$"


def ray_count(pattern: Any, rate_hz: float) -> int:
    """Rays of one frame of a pattern."""
    if isinstance(pattern, Even):
        return pattern.rays
    if isinstance(pattern, Rosette):
        return round(pattern.points_per_s / rate_hz)
    if isinstance(pattern, Rings):
        return pattern.columns * (pattern.rings or len(pattern.elevations_deg or ()))
    return pattern.columns * pattern.rows


def check_pattern(pattern: Any, view: PartFieldOfView, rate_hz: float, of_mode: str) -> None:
    """Refuse a pattern that its field of view cannot hold.

    Raises:
        ValueError: Too many rays, several in a field without width, rays outside of the field, or a field that its kind
            of pattern cannot have.
    """
    count = ray_count(pattern, rate_hz)
    if not 1 <= count <= MOST_RAYS:
        raise ValueError(f"pattern{of_mode} has {count} rays a frame, allowed are 1 to {MOST_RAYS:,}")
    widest = [max(map(abs, interval)) for interval in (view.azimuth, view.elevation)]
    if pattern.kind in TANGENT and math.hypot(*widest) > STRAIGHT_DEG:
        raise ValueError(f"field_of_view_deg{of_mode} reaches beyond {STRAIGHT_DEG:g} degrees from the forward axis")
    if pattern.kind == "pixels" and max(widest) >= RIGHT_DEG:
        raise ValueError(f"field_of_view_deg{of_mode} reaches {RIGHT_DEG:g} degrees, which no flat sensor sees")
    if isinstance(pattern, Rosette):
        reach = sum(pattern.deflection_deg)
        if any(low > -reach or high < reach for low, high in (view.azimuth, view.elevation)):
            raise ValueError(f"pattern{of_mode} reaches {reach:g} degrees, outside of field_of_view_deg")
    if isinstance(pattern, Rosette | Even):
        return
    rows = pattern.rings or 1 if isinstance(pattern, Rings) else pattern.rows
    for name, number, (low, high) in (("azimuth", pattern.columns, view.azimuth), ("elevation", rows, view.elevation)):
        if number > 1 and low == high:
            raise ValueError(f"pattern{of_mode} has {number} rays across an {name} without width")
    if view.shape == "ellipse" and pattern.columns * rows > 1:
        raise ValueError(f"field_of_view_deg{of_mode} is an ellipse, but its pattern has corners")
    bottom, top = view.elevation
    beams = (pattern.elevations_deg or []) if isinstance(pattern, Rings) else []
    outside = [elevation for elevation in beams if not bottom <= elevation <= top]
    if outside:
        raise ValueError(f"pattern{of_mode} has a beam at {outside[0]:g} degrees, outside of field_of_view_deg")


class PartFile(Figures):
    """A whole part file.

    Arguments:
        maker, product: Its names on the market.
        kind: What sort of part it is.
        summary: One line for people.
        sources: Sources of the figures, by the key that statements name.
        modes: Its settings, as 4x4 and 8x8, by name; their fields stand in for those of the part. The first is the
            one meant where none is named.
    """

    schema_version: Literal[1]
    maker: Text
    product: Text
    kind: Literal["single zone", "multi-zone", "flash", "spinning", "scanner", "line scanner", "rosette"]
    summary: Text
    sources: dict[Text, Source]
    modes: dict[Annotated[str, Field(pattern=MODE_NAME)], Figures] = Field({})

    def figures(self, mode: str | None) -> dict[str, list[Any]]:
        """The statements of every field that one mode has."""
        found = {name: getattr(self, name) for name in FIELDS}
        if mode is not None:
            found |= {name: one for name in FIELDS if (one := getattr(self.modes[mode], name)) is not None}
        return {name: statements for name, statements in found.items() if statements is not None}

    @model_validator(mode="after")
    def _complete(self) -> PartFile:
        for mode in self.modes or [None]:
            figures, of_mode = self.figures(mode), "" if mode is None else f" of mode {mode}"
            missing = [name for name in REQUIRED if name not in figures]
            if missing:
                raise ValueError(f"{missing[0]}{of_mode} is missing")
            for name, statements in figures.items():
                for statement in statements:
                    if statement.source not in self.sources:
                        known = ", ".join(self.sources)
                        raise ValueError(f"{name}{of_mode} names the source {statement.source!r}, known are {known}")
            check_pattern(figures["pattern"][0], figures["field_of_view_deg"][0], figures["rate_hz"][0].value, of_mode)
            if (figures["near_m"][0].value if "near_m" in figures else 0.0) >= figures["far_m"][0].value:
                raise ValueError(f"near_m{of_mode} is not below far_m")
        return self
