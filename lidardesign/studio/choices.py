"""What the page shows and what a fit depends on: one record, its changes, and the command line that does the same."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from shlex import join
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel

from lidardesign.api.design import Design
from lidardesign.constraints.document import Constraints, SensorConstraints
from lidardesign.constraints.slack import split_name
from lidardesign.errors import ConfigError
from lidardesign.run.validation import parse_override
from lidardesign.sensors.sensor import Sensor, boresight_frame

if TYPE_CHECKING:
    from lidardesign.api.run import Run
    from lidardesign.task import Split

# What handles are rounded to, so that constraints are numbers that people can read.
PLACE_DIGITS, ANGLE_DIGITS = 4, 2
EVERY = "all sensors"
UNITS = {"_m": "m", "_deg": "deg", "_mbps": "Mbit/s", "_ps": "ps", "_hz": "Hz", "_w": "W"}


@dataclass(frozen=True)
class Pose:
    """The place of a sensor [m] and its azimuth, elevation and roll [degrees], rounded."""

    place_m: tuple[float, float, float]
    angles_deg: tuple[float, float, float]

    @classmethod
    def of(cls, place_m: Sequence[float], angles_deg: Sequence[float]) -> Pose:
        """The rounded pose."""
        place, angles = (
            # adding zero takes the sign from a rounded -0
            tuple(round(float(value), digits) + 0.0 for value in values)
            for values, digits in ((place_m, PLACE_DIGITS), (angles_deg, ANGLE_DIGITS))
        )
        return cls(place, angles)

    @classmethod
    def of_sensor(cls, sensor: Sensor) -> Pose:
        """The pose of a sensor."""
        angles = (sensor.azimuth_rad, sensor.elevation_rad, sensor.roll_rad)
        return cls.of(sensor.origin_m, [math.degrees(angle) for angle in angles])

    @property
    def frame(self) -> np.ndarray:
        """Rows forward, horizontal, vertical, shape (3, 3)."""
        return boresight_frame(*map(math.radians, self.angles_deg))


@dataclass(frozen=True)
class Choices:
    """What the page shows and what a fit depends on; every change makes a new record.

    Arguments:
        run: The run.
        design: The design as it stands: loaded, fitted, or moved by hand since.
        constraints: Plain values of a constraint file.
        base: The saved design that is fitted again; None: the run is fitted to.
        state: `saved`, `fitted` where a fit of these choices has given the design, or `changed` since.
        detector: The name of a detector.
        settings: Settings of the task, as KEY=VALUE.
        split: The split of the scene that is shown.
        scene, frame: The numbers of the scene in its split, and of its frame.
    """

    run: Run
    design: Design
    constraints: Mapping[str, Any]
    base: Design | None = None
    state: Literal["saved", "fitted", "changed"] = "saved"
    detector: str = "ideal"
    settings: tuple[str, ...] = ()
    split: Split = "train"
    scene: int = 0
    frame: int = 0

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors of the design."""
        return self.design.specification.sensors

    @property
    def key(self) -> tuple[Any, ...]:
        """A key that is equal where a fit gives the same."""
        base = None if self.base is None else self.base.path
        return json.dumps(self.constraints), base, self.detector, self.settings

    def fit_arguments(self, name: str) -> dict[str, Any]:
        """What `run.fit`, or the base's `constrain`, takes for these choices."""
        detector = None if self.detector == "ideal" else self.detector
        return {"constraints": self.constraints, "detector": detector, "settings": self.settings, "name": name}

    def command(self, name: str) -> str:
        """The command line that fits the same design."""
        words = ["lidardesign", "constrain", str(self.run.folder if self.base is None else self.base.path)]
        for key, value in _shallow(self.constraints):
            words += ["--set", f"{key}={_text(value)}"]
        for setting in self.settings:
            words += ["--set", setting]
        return join([*words, *(() if self.detector == "ideal" else ("--detector", self.detector)), "--name", name])

    def constrained(self, key: str, text: str, scope: str = EVERY) -> Choices:
        """The choices with another bound; without text there is none.

        Arguments:
            key: As `gate.width_m.max`.
            text: The value, as after `--set KEY=`.
            scope: `EVERY`, or the name of a sensor.

        Raises:
            ConfigError: A value that the key does not take.
        """
        document: dict[str, Any] = deepcopy(dict(self.constraints))
        target = document if scope == EVERY else _entry(document, self._number(scope), len(self.sensors))
        value = parse_override(f"{key}={text}").value if text.strip() else None
        _set(target, key.split("."), value)
        return self._with(document)

    def moved(self, sensor: int, pose: Pose) -> Choices:
        """The choices with a sensor at another pose; what has changed of it is fixed from then on."""
        own, document = self.sensors[sensor], deepcopy(dict(self.constraints))
        before = Pose.of_sensor(own)
        # what has not changed is not rounded either
        place = own.origin_m if pose.place_m == before.place_m else pose.place_m
        frame = own.frame if pose.angles_deg == before.angles_deg else pose.frame
        design = self.design.remounted(sensor, place, frame)
        count = "parts" if "parts" in document else "sensors"
        _set(document, [count, "count"], len(self.sensors))
        entry = _entry(document, sensor, len(self.sensors))
        mounts = document.get("origin", {}).get("mounts_m")
        if pose.place_m != before.place_m and mounts:
            # its mount goes with it
            distances = [math.dist(mount, before.place_m) for mount in mounts]
            mounts[int(np.argmin(distances))] = list(pose.place_m)
        elif pose.place_m != before.place_m:
            _set(entry, ["origin"], {"fixed_m": list(pose.place_m)})
        if pose.angles_deg != before.angles_deg:
            azimuth, elevation, roll = pose.angles_deg
            # a fitted field is the same after a quarter turn, with its two angles exchanged
            roll = roll if "parts" in document else round((roll + 45.0) % 90.0 - 45.0, ANGLE_DIGITS)
            named = {"azimuth_deg": azimuth, "elevation_deg": elevation, "roll_deg": roll}
            _set(entry, ["boresight"], {name: {"min": value, "max": value} for name, value in named.items()})
        return replace(self._with(document), design=design)

    def freed(self, sensor: int) -> Choices:
        """The choices with the place and boresight of a sensor open again."""
        document: dict[str, Any] = deepcopy(dict(self.constraints))
        entry = _entry(document, sensor, len(self.sensors))
        for key in ("origin.fixed_m", "boresight"):
            _set(entry, key.split("."), None)
        if not any(document["each"]):
            del document["each"]
        return self._with(document)

    def mount_moved(self, mount: int, place_m: Sequence[float]) -> Choices:
        """The choices with a mount at another place."""
        document: dict[str, Any] = deepcopy(dict(self.constraints))
        document["origin"]["mounts_m"][mount] = list(Pose.of(place_m, ()).place_m)
        return self._with(document)

    @property
    def mounts_m(self) -> list[list[float]]:
        """The places of `origin.mounts_m`."""
        return list(self.constraints.get("origin", {}).get("mounts_m") or ())

    def value(self, key: str, scope: str = EVERY) -> str:
        """The value of a key as text; empty where it has none."""
        node: Any = self.constraints
        if scope != EVERY:
            entries, number = self.constraints.get("each") or [], self._number(scope)
            node = entries[number] if number < len(entries) else {}
        for part in key.split("."):
            node = node.get(part) if isinstance(node, Mapping) else None
        return "" if node is None else _text(node)

    def tight(self, scope: str = EVERY) -> set[str]:
        """The keys whose bounds limit the design, or one sensor of it."""
        checks = () if self.design.result is None else self.design.result.constraints
        from lidardesign.constraints.slack import room_of

        names = [sensor.name for sensor in self.sensors]
        owned = [(*split_name(check.name, names), check) for check in checks]
        return {key for owner, key, check in owned if room_of(check).is_tight and scope in (EVERY, owner)}

    def _number(self, scope: str) -> int:
        return [sensor.name for sensor in self.sensors].index(scope)

    def _with(self, document: Mapping[str, Any]) -> Choices:
        """The choices with a constraint file, checked."""
        checked = Constraints.from_mapping(document).as_document()
        return replace(self, constraints=checked, state="changed")


def constraint_keys(model: type[BaseModel] = Constraints, prefix: str = "") -> Iterator[str]:
    """The keys of a constraint file, without `each`."""
    for name, field in model.model_fields.items():
        inside = [kind for kind in (field.annotation, *get_args(field.annotation)) if isinstance(kind, type)]
        deeper = next((kind for kind in inside if issubclass(kind, BaseModel)), None)
        if deeper is not None and "list" not in str(field.annotation) and "dict" not in str(field.annotation):
            yield from constraint_keys(deeper, f"{prefix}{name}.")
        elif prefix or name != "each":
            yield prefix + name


def is_per_sensor(key: str) -> bool:
    """True for keys that may stand under `each`."""
    return key.split(".")[0] in SensorConstraints.model_fields


def key_label(key: str) -> str:
    """A key without its section, in words, as `width max [m]`."""
    words = key.split(".")[1:] or [key]
    unit = next((unit for word in words for end, unit in UNITS.items() if word.endswith(end)), None)
    plain = " ".join(next((word.removesuffix(end) for end in UNITS if word.endswith(end)), word) for word in words)
    return plain.replace("_", " ") + (f" [{unit}]" if unit else "")


def _shallow(document: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of a constraint file with its value; lists and mappings by name are values."""
    for key, value in document.items():
        if isinstance(value, Mapping) and f"{prefix}{key}" != "parts.each":
            yield from _shallow(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _text(value: Any) -> str:
    """A value as it is typed after `--set KEY=`."""
    return value if isinstance(value, str) else json.dumps(value).removesuffix(".0")


def _set(node: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set a value in place, or take it away with the mappings that it leaves empty."""
    first, *rest = path
    if rest:
        inner = node.setdefault(first, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{first} holds {inner!r}", where=".".join(path))
        _set(inner, rest, value)
        if not inner:
            del node[first]
    elif value is None:
        node.pop(first, None)
    else:
        node[first] = value


def _entry(document: dict[str, Any], number: int, count: int) -> dict[str, Any]:
    """The entry of `each` of a sensor, made where it is missing."""
    each = document.setdefault("each", [])
    each += [{} for _ in range(min(number + 1, count) - len(each))]
    return each[number]
