"""What the page shows and what a fit depends on: one record, its changes, and the command line that does the same."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from shlex import join
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic import BaseModel

from lidardesign.api.design import Design
from lidardesign.api.run import Run
from lidardesign.constraints.document import Constraints, SensorConstraints
from lidardesign.constraints.slack import room_of, split_name
from lidardesign.errors import ConfigError, pasted
from lidardesign.run.markup import counted
from lidardesign.run.validation import parse_override
from lidardesign.run_folder import ignore
from lidardesign.sensors.sensor import Sensor, boresight_frame
from lidardesign.task import Split

# What handles are rounded to, so that constraints are numbers that people can read.
PLACE_DIGITS, ANGLE_DIGITS = 4, 2
EVERY, MOUNT = "all sensors", "mount "
PATH = r"[/\\]|\.yaml"  # in what would be the path of a part file
UNIT, UNITS = r"_(m|deg|mbps|ps|hz|w)\b", {"mbps": "Mbit/s", "hz": "Hz", "w": "W"}


@dataclass(frozen=True)
class SensorPose:
    """The place of a sensor [m] and its azimuth, elevation and roll [degrees], rounded."""

    place_m: tuple[float, ...]
    angles_deg: tuple[float, ...]

    @classmethod
    def of(cls, place_m: Sequence[float], angles_deg: Sequence[float] = (0.0, 0.0, 0.0)) -> SensorPose:
        """The rounded pose."""
        azimuth, elevation, roll = map(float, angles_deg)
        turned = [azimuth % 360.0, elevation, math.remainder(roll, 360.0)]
        # adding zero takes the sign from a rounded -0
        place = tuple(round(float(value), PLACE_DIGITS) + 0.0 for value in place_m)
        return cls(place, tuple(round(value, ANGLE_DIGITS) + 0.0 for value in turned))

    @classmethod
    def of_sensor(cls, sensor: Sensor) -> SensorPose:
        """The pose of a sensor."""
        return cls.of(sensor.origin_m, np.degrees([sensor.azimuth_rad, sensor.elevation_rad, sensor.roll_rad]).tolist())

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

    @classmethod
    def of(cls, run: Run, design: Design, shown: Choices | None = None) -> Choices:
        """The choices with a design and its constraints, in the scene that is shown; one of the run is fitted again."""
        is_own = design.path is not None and design.path.resolve() == run.design_path(design.name).resolve()
        base = design if is_own else None
        constraints = Constraints.from_mapping(design.specification.constraints).as_document()
        return replace(shown or cls(run, design, {}), design=design, constraints=constraints, base=base, state="saved")

    @property
    def headline(self) -> str:
        """What the design is, in a line."""
        state = "changed since the fit" if self.state == "changed" else f"as {self.state}"
        sensors = counted(len(self.sensors), "sensor")
        return f"{self.design.name} ({state}): {sensors}, {self.design.usual_count(ignore)} rays"

    @property
    def counts(self) -> tuple[int, int]:
        """The numbers of sensors and of rays that are asked for, else those of the design."""
        asked = self.value(self.count_key), self.value("budget.rays")
        own = len(self.sensors), self.design.specification.count or 1
        return tuple(int(text) if text.isdecimal() else number for text, number in zip(asked, own, strict=True))

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors of the design."""
        return self.design.specification.sensors

    @property
    def names(self) -> list[str]:
        """The names of the sensors."""
        return [sensor.name for sensor in self.sensors]

    @property
    def mounts_m(self) -> list[list[float]]:
        """The places of `origin.mounts_m`."""
        return list(self.constraints.get("origin", {}).get("mounts_m") or ())

    @property
    def poses(self) -> dict[str, SensorPose]:
        """What a handle can be put on: sensors and mounts by name."""
        mounts = {f"{MOUNT}{number}": SensorPose.of(place) for number, place in enumerate(self.mounts_m)}
        return {sensor.name: SensorPose.of_sensor(sensor) for sensor in self.sensors} | mounts

    @property
    def count_key(self) -> str:
        """The key of the number of sensors."""
        return "parts.count" if "parts" in self.constraints else "sensors.count"

    @property
    def key(self) -> tuple[Any, ...]:
        """A key that is equal where a fit gives the same."""
        return json.dumps(self.constraints), self.base and self.base.path, self.detector, self.settings

    def boxes(self, space_m: np.ndarray) -> list[np.ndarray]:
        """The boxes (2, 3) [m] that bound places: the run's, that of the constraints, and those that are excluded."""
        origin = self.constraints.get("origin", {})
        bounds = np.array([origin.get("low_m", space_m[0]), origin.get("high_m", space_m[1])])
        return [space_m, bounds, *(np.array([box["low_m"], box["high_m"]]) for box in origin.get("exclude", ()))]

    def fit(self, name: str, **reports: Any) -> Design:
        """The design that these choices come to; `reports` are `progress` and `notes`."""
        fit = self.run.fit if self.base is None else self.base.constrain
        detector = None if self.detector == "ideal" else self.detector
        return fit(constraints=self.constraints, detector=detector, settings=self.settings, name=name, **reports)

    def command(self, name: str) -> str:
        """The command line that fits the same design."""
        words = []
        bounds = [f"{key}={_text(value)}" for key, value in _sections(self.constraints)]
        for setting in (*bounds, *self.settings):
            words += ["--set", setting]
        words += [*(() if self.detector == "ideal" else ("--detector", self.detector)), "--name", name]
        return f"lidardesign constrain {pasted(self.run.folder if self.base is None else self.base.path)} {join(words)}"

    def constrained(self, key: str, text: str, scope: str = EVERY) -> Choices:
        """The choices with another bound; without text there is none.

        Arguments:
            key: As `gate.width_m.max`.
            text: The value, as after `--set KEY=`.
            scope: `EVERY`, or the name of a sensor.

        Raises:
            ConfigError: A value that the key does not take, or a path: the page opens no files.
        """
        document: dict[str, Any] = deepcopy(dict(self.constraints))
        is_own = scope != EVERY and key.split(".")[0] in SensorConstraints.model_fields
        target = _entry(document, self._number(scope)) if is_own else document
        value = parse_override(f"{key}={text}").value if text.strip() else None
        _set(target, key.split("."), value)
        if key == self.count_key and isinstance(value, int):
            document["each"] = document.get("each", [])[:value]
        return self._with(document)

    def made_of(self, part: str | None) -> Choices:
        """The choices with as many sensors of a part of the catalogue; None: of any shape."""
        document = {key: value for key, value in self.constraints.items() if key not in ("parts", "sensors", "budget")}
        if part is not None:
            document["parts"] = {"names": [part], "count": len(self.sensors)}
        return self._with(document)

    def moved(self, name: str, pose: SensorPose) -> Choices:
        """The choices with a sensor or mount at another pose; what has changed of a sensor is fixed from then on."""
        document: dict[str, Any] = deepcopy(dict(self.constraints))
        if name.startswith(MOUNT):
            document["origin"]["mounts_m"][int(name.removeprefix(MOUNT))] = list(pose.place_m)
            return self._with(document)
        number, before = self._number(name), self.poses[name]
        own, is_placed = self.sensors[number], pose.place_m != before.place_m
        is_turned = pose.angles_deg != before.angles_deg
        # what has not changed is not rounded either
        place, frame = pose.place_m if is_placed else own.origin_m, pose.frame if is_turned else own.frame
        _set(document, self.count_key.split("."), len(self.sensors))
        entry = _entry(document, number)
        if is_placed and self.mounts_m:
            # its mount goes with it
            distances = [math.dist(mount, before.place_m) for mount in self.mounts_m]
            document["origin"]["mounts_m"][int(np.argmin(distances))] = list(pose.place_m)
        elif is_placed:
            entry["origin"] = {"fixed_m": list(pose.place_m)}
        if is_turned:
            azimuth, elevation, roll = pose.angles_deg
            # a fitted field is the same after a quarter turn, with its two angles exchanged
            roll = roll if "parts" in document else round((roll + 45.0) % 90.0 - 45.0, ANGLE_DIGITS)
            named = {"azimuth_deg": azimuth, "elevation_deg": elevation, "roll_deg": roll}
            entry["boresight"] = {key: {"min": value, "max": value} for key, value in named.items()}
        return replace(self._with(document), design=self.design.remounted(number, place, frame))

    def fixed(self, name: str) -> list[str]:
        """What is fixed of a sensor: `origin`, `boresight`."""
        each = self.constraints.get("each") or []
        entry = each[self._number(name)] if self._number(name) < len(each) else {}
        return [key for key in ("origin", "boresight") if key in entry]

    def freed(self, name: str) -> Choices:
        """The choices with the place and boresight of a sensor open again."""
        document: dict[str, Any] = deepcopy(dict(self.constraints))
        entry = _entry(document, self._number(name))
        for key in ("origin.fixed_m", "boresight"):
            _set(entry, key.split("."), None)
        return self._with(document)

    def value(self, key: str, scope: str = EVERY) -> str:
        """The value of a key as text; empty where it has none."""
        each: Any = self.constraints.get("each") or []
        node = self.constraints if scope == EVERY else dict(enumerate(each)).get(self._number(scope))
        for part in key.split("."):
            node = node.get(part) if isinstance(node, Mapping) else None
        return "" if node is None else _text(node)

    def tight(self, scope: str = EVERY) -> set[str]:
        """The keys whose bounds limit the design, or one sensor of it, without what is fixed by hand."""
        checks = () if self.design.result is None else self.design.result.constraints
        owned = [(*split_name(check.name, self.names), check) for check in checks if room_of(check).is_tight]
        return {
            key
            for owner, key, _ in owned
            if scope in (EVERY, owner) and not (owner and key.split(".")[0] in ("space", *self.fixed(owner)))
        }

    def _number(self, name: str) -> int:
        return self.names.index(name)

    def _with(self, document: dict[str, Any]) -> Choices:
        """The choices with a constraint file, checked."""
        if not any(document.get("each", ())):
            document.pop("each", None)
        names = document.get("parts", {}).get("names", ())
        paths = [name for name in names if re.search(PATH, str(name))]
        if paths:
            raise ConfigError(f"{paths[0]!r} is a path", where="parts.names", allowed="names of parts in the catalogue")
        return replace(self, constraints=Constraints.from_mapping(document).as_document(), state="changed")


def constraint_keys(model: type[BaseModel] = Constraints, prefix: str = "") -> Iterator[str]:
    """The keys of a constraint file, without `each`."""
    for name, field in model.model_fields.items():
        kinds = [kind for kind in (field.annotation, *get_args(field.annotation)) if isinstance(kind, type)]
        deeper = next((kind for kind in kinds if issubclass(kind, BaseModel)), None)
        if f"{prefix}{name}" == "each":
            continue
        if deeper is None or get_origin(field.annotation) in (list, dict):
            yield prefix + name
        else:
            yield from constraint_keys(deeper, f"{prefix}{name}.")


def key_label(key: str) -> str:
    """A key without its section, in words, as `width max [m]`."""
    inside = key.split(".", 1)[-1]
    unit = re.search(UNIT, inside)
    words = re.sub(UNIT, "", inside).replace(".", " ").replace("_", " ")
    return words if unit is None else f"{words} [{UNITS.get(unit[1], unit[1])}]"


def _sections(document: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of a constraint file with its value; lists, and numbers of parts by their names, are values."""
    for key, value in document.items():
        if isinstance(value, Mapping) and f"{prefix}{key}" != "parts.each":
            yield from _sections(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _text(value: Any) -> str:
    """A value as it is typed after `--set KEY=`."""
    return value if isinstance(value, str) else json.dumps(value).removesuffix(".0")


def _set(node: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set a value in place, or take it away with the mappings that it leaves empty."""
    first, *rest = path
    inner = node.setdefault(first, {}) if rest else value
    if rest and isinstance(inner, dict):
        _set(inner, rest, value)
    if inner in (None, {}):
        node.pop(first, None)
    elif not rest:
        node[first] = value


def _entry(document: dict[str, Any], number: int) -> dict[str, Any]:
    """The entry of `each` of a sensor, made where it is missing."""
    each = document.setdefault("each", [])
    each += [{} for _ in range(number + 1 - len(each))]
    return each[number]
