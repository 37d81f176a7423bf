"""The constraint file (design contract, section 6): its keys, its checks, and the rules of each sensor.

The meaning of the bounds, here and in `check`, which verifies them on the finished file:

- `gate` and `field_of_view` bound the reported intervals, mean -+ z spread;
- `origin.low_m`, `high_m` bound the sensor's mean origin; samples are taken from inside the box too;
- `origin.spread_m.max` bounds the standard deviation of the origin along every direction, `thickness_m.max` that
  along its thinnest principal direction, so that sensors spread over lines or sheets of any tilt;
- `origin.mounts_m` lists the points where sensors can be fixed, one sensor at each at most (see `mounts`);
- `origin.exclude` lists boxes whose interior holds no mean origin, no part of its interval, mean -+ z spread along
  each axis, and no start of a ray; samples are taken from outside them, and where one takes part of the origin box
  the intervals keep to that box too (see `origins`);
- `boresight.azimuth_deg` is an interval on the circle: with `min` above `max` it passes through 0;
- `parts` names real parts that the design is made of, whose fields of view and gates then keep these bounds;
- `survive: 1` chooses rays for the loss of any one sensor, too;
- every gate stays inside the range bounds of the design space, whatever the file says.

Entries of `each` apply to the first, second, ... sensor over the common keys.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from lidardesign.errors import UNSET_HINT, ConfigError
from lidardesign.limits import MOST_FITTED, MOST_RAYS
from lidardesign.run.validation import (
    apply_override,
    check_model,
    parse_override,
    parse_overrides,
    placed_at,
)
from lidardesign.run.yaml import Document, KeyPath, leaves, load_yaml, merged
from lidardesign.run_folder import Notes, log_note
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design_file import Distance, StrictKeys, Vector
from lidardesign.space import FARTHEST_M, MOST_TURNS, SHORTEST_M
from lidardesign.task import Task

# Between these products of constraints are numbers, whatever is narrowed to them.
Positive = Annotated[float, Field(ge=SHORTEST_M, le=FARTHEST_M)]
Angle = Annotated[float, Field(ge=-360 * MOST_TURNS, le=360 * MOST_TURNS)]
# The boxes between excluded ones grow faster than their number: with so many a fit still takes seconds.
MOST_EXCLUDED = 32
MOST_ROLL_DEG = 45.0  # of a fitted field of view: beyond it is the same with its two angles exchanged
Count = Annotated[int, Field(ge=1, le=MOST_FITTED)]


class SensorCount(StrictKeys):
    """`{count: 4}` or `{min: 1, max: 8}`."""

    count: Count | None = None
    min: Count | None = None
    max: Count | None = None

    @model_validator(mode="after")
    def _one_form(self) -> SensorCount:
        if self.count is not None and (self.min is not None or self.max is not None):
            raise ValueError("give either count, or min and max")
        return self


class DistanceRange(StrictKeys):
    """Bounds on a distance [m]."""

    min: Distance | None = None
    max: Positive | None = None


class AngleRange(StrictKeys):
    """Bounds on an azimuth [degrees], any number of turns."""

    min: Angle | None = None
    max: Angle | None = None


class ElevationRange(StrictKeys):
    """Bounds on an elevation [degrees]."""

    min: Annotated[float, Field(ge=-90, le=90)] | None = None
    max: Annotated[float, Field(ge=-90, le=90)] | None = None


class FieldRange(StrictKeys):
    """Bounds on a full angle of view [degrees]."""

    min: Annotated[float, Field(ge=0, le=360)] | None = None
    max: Annotated[float, Field(ge=SHORTEST_M, le=360)] | None = None


class SpreadLimit(StrictKeys):
    """The largest standard deviation of the origin, along any or along its thinnest direction [m]."""

    max: Positive | None = None


class ExcludedBox(StrictKeys):
    """A box in whose interior no sensor may be [m]; one without volume excludes nothing."""

    low_m: Vector
    high_m: Vector

    @model_validator(mode="after")
    def _ordered(self) -> ExcludedBox:
        for axis, low, high in zip("xyz", self.low_m, self.high_m, strict=True):
            if low > high:
                raise ValueError(f"low_m is above high_m along {axis}")
        return self


class Origin(StrictKeys):
    """Bounds on the origin of a sensor [m]."""

    low_m: Vector | None = None
    high_m: Vector | None = None
    fixed_m: Vector | None = None
    spread_m: SpreadLimit = SpreadLimit()
    thickness_m: SpreadLimit = SpreadLimit()
    mounts_m: Annotated[list[Vector], Field(min_length=1)] | None = None
    exclude: Annotated[list[ExcludedBox], Field(max_length=MOST_EXCLUDED)] | None = None

    @model_validator(mode="after")
    def _distinct_mounts(self) -> Origin:
        if len({tuple(mount) for mount in self.mounts_m or []}) < len(self.mounts_m or []):
            raise ValueError("the mounts must differ")
        return self


class RollRange(StrictKeys):
    """Bounds on a roll about the boresight [degrees].

    Beyond 45 degrees for parts alone: a fitted field is the same with its two angles exchanged.
    """

    min: Annotated[float, Field(ge=-180, le=180)] | None = None
    max: Annotated[float, Field(ge=-180, le=180)] | None = None


class Boresight(StrictKeys):
    """Bounds on the boresight of a sensor and its roll [degrees]."""

    azimuth_deg: AngleRange = AngleRange()
    elevation_deg: ElevationRange = ElevationRange()
    roll_deg: RollRange = RollRange()


class FieldOfView(StrictKeys):
    """Bounds on the full angles of a field of view, horizontal and vertical in the sensor's frame [degrees]."""

    horizontal_deg: FieldRange = FieldRange()
    vertical_deg: FieldRange = FieldRange()


class Gate(StrictKeys):
    """Bounds on the start, end and width of a gate, as one-way distances [m]."""

    start_m: DistanceRange = DistanceRange()
    end_m: DistanceRange = DistanceRange()
    width_m: DistanceRange = DistanceRange()


class Budget(StrictKeys):
    """Rays per frame and the read-out of the whole design."""

    rays: Annotated[int, Field(ge=1, le=MOST_RAYS)] | None = None
    bandwidth_mbps: Positive | None = None
    # wider than any part's; beyond them products under- and overflow
    bin_ps: Annotated[float, Field(ge=0.001, le=1e9)] = 100.0
    bits_per_bin: Annotated[float, Field(ge=0.001, le=1e9)] = 40.0
    rate_hz: Annotated[float, Field(ge=0.001, le=1e12)] = 10.0

    @property
    def readout(self) -> Bandwidth:
        """The read-out model."""
        return Bandwidth(self.bin_ps, self.bits_per_bin, self.rate_hz)


class MostOfPart(StrictKeys):
    """The largest number of a part in a design, as `{max: 1}`."""

    max: Count


class PartPrice(StrictKeys):
    """The largest price of all parts together, as `{max: 40}`."""

    max: Positive


class Parts(StrictKeys):
    """Real parts that the design is made of, chosen with their poses.

    Arguments:
        names: Names, `NAME:MODE`, or paths of part files and folders; `catalog` is all that are shipped.
        count: Number of parts; `--sensors` takes precedence.
        each: The largest number of a part, by its name; without a mode in all its modes.
        power_w: Largest power of all parts [W]; parts without a stated power are left out.
        price: Largest price of all parts, as `{max: 40}`; parts without a price are left out.
    """

    names: Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1)] | Literal["catalog"] = "catalog"
    count: Count | None = None
    each: dict[str, MostOfPart] = Field({})
    power_w: Positive | None = None
    price: PartPrice | None = None

    @property
    def sums(self) -> dict[str, tuple[str, float]]:
        """The bounds on sums over all parts: the figure of a part and the bound, by key."""
        price = None if self.price is None else self.price.max
        bounds = {"parts.power_w": ("power_w", self.power_w), "parts.price.max": ("price", price)}
        return {key: (name, bound) for key, (name, bound) in bounds.items() if bound is not None}


class SensorConstraints(StrictKeys):
    """The keys that may also stand under `each`."""

    origin: Origin = Origin()
    boresight: Boresight = Boresight()
    field_of_view: FieldOfView = FieldOfView()
    gate: Gate = Gate()


@dataclass(frozen=True)
class SensorRules:
    """The rules of one sensor: the common keys overridden by its entry of `each`.

    Arguments:
        origin, boresight, field_of_view, gate: The bounds.
        index: The sensor's place in the design; of the last rules, that of the first sensor beyond `each`.
        own_keys: The keys, as `gate.width_m.max`, that its own entry has.
    """

    origin: Origin
    boresight: Boresight
    field_of_view: FieldOfView
    gate: Gate
    index: int
    own_keys: frozenset[str]

    def path(self, key: str) -> str:
        """The path of a key in the constraint file, as `each[1].gate.width_m.max`."""
        return f"each[{self.index}].{key}" if key in self.own_keys else key


def rules_of(rules: Sequence[SensorRules], sensor: int) -> SensorRules:
    """The rules of one sensor; all sensors beyond the entries of `each` have the last ones."""
    return rules[min(sensor, len(rules) - 1)]


class Constraints(SensorConstraints):
    """Constraints on a design: fields of view, gates, origins, rays and bandwidth; every key is optional.

    Keys and units are those of a constraint file (docs/constraints.md): for all sensors, or by sensor in `each`.

    Example:
        >>> narrow = Constraints.from_mapping({"gate": {"width_m": {"max": 0.1}}, "budget": {"rays": 64}})
        >>> narrow.budget.rays
        64
        >>> narrow.as_document()["gate"]
        {'width_m': {'max': 0.1}}
    """

    model_config = ConfigDict(json_schema_extra={"description": "A whole constraint file; every key is optional."})

    sensors: SensorCount = SensorCount()
    budget: Budget = Budget()
    parts: Parts | None = None
    survive: int = Field(0, ge=0, le=1)
    each: list[SensorConstraints] = Field([])

    @classmethod
    def from_mapping(
        cls,
        values: Mapping[str, Any] | None,
        *,
        where: str = "constraints",
        locate: Callable[..., str] | None = None,
    ) -> Constraints:
        """Constraints of plain values, as read from YAML.

        Arguments:
            values: The mapping; None is an empty one.
            where: Name of the file or option, for messages.
            locate: The position `file:line:column` of a key path.

        Raises:
            ConfigError: Unknown keys, wrong types, numbers outside their physical range.
        """
        if values is not None and not isinstance(values, Mapping):
            raise ConfigError(f"found one {type(values).__name__}", where=where, allowed="a mapping, as `gate: {...}`")
        values, locate = dict(values or {}), locate or placed_at(where)
        for path, value in leaves(values):
            if value is None:
                name = ".".join(map(str, path))
                raise ConfigError(f"{name} has no value", where=locate(path), allowed="a value", hint=UNSET_HINT)
        return check_model(cls, values, locate)

    @property
    def least_sensors(self) -> int:
        """The least number of sensors."""
        return max(self.sensors.min or 1, len(self.each), 1 + self.survive)

    @cached_property
    def rules(self) -> tuple[SensorRules, ...]:
        """The rules of the sensor of each entry of `each`, and last those of every further sensor."""
        common = self.model_dump(include=set(SensorConstraints.model_fields))
        rules = []
        for index, entry in enumerate([*self.each, SensorConstraints()]):
            own = entry.model_dump(exclude_defaults=True)
            resolved = SensorConstraints.model_validate(merged(common, own))
            # the keys at every depth, joined by dots
            keys = {key for path, _ in leaves(own) for key in accumulate(map(str, path), "{}.{}".format)}
            rules.append(SensorRules(**dict(resolved), index=index, own_keys=frozenset(keys)))
        return tuple(rules)

    def as_document(self) -> dict[str, Any]:
        """The plain values that were given, for the design file."""
        return self.model_dump(exclude_none=True, exclude_unset=True, exclude=None if self.survive else {"survive"})


def split_settings(overrides: Sequence[str], task: Task) -> tuple[list[str], list[str]]:
    """Texts KEY=VALUE that are constraints, and those whose first key is no section of these but a task's own."""
    keys = task.Config.model_fields.keys() - Constraints.model_fields.keys()
    own = [text for text in overrides if parse_override(text).path[0] in keys]
    return [text for text in overrides if text not in own], own


def load_constraints(
    given: Constraints | Mapping[str, Any] | Path | str | None, overrides: Sequence[str] = (), notes: Notes = log_note
) -> Constraints | None:
    """Constraints of a mapping or a YAML file, with `--set` laid over them; None where nothing is given.

    Raises:
        ConfigError: At file:line:column, or at the `--set` option; also for unknown parts.
    """
    if isinstance(given, Constraints) or (given is None and not overrides):
        return given
    if isinstance(given, Mapping):
        return Constraints.from_mapping(given)
    document = load_yaml(Path(given)) if given else Document({}, "constraints")
    values: dict[str, Any] = document.mapping
    if given and all(value in (None, {}, []) for _, value in leaves(values)):
        notes(f"{document.where} holds no constraints")
    origins: dict[KeyPath, str] = {}
    for override in parse_overrides(overrides):
        origins[apply_override(values, override)] = override.where

    def locate(path: KeyPath, *, key: bool = False) -> str:
        for origin, where in origins.items():
            if path[: len(origin)] == origin or origin[: len(path)] == path:
                return where
        return document.locate(path, key=key)

    return Constraints.from_mapping(values, where=document.where, locate=locate)
