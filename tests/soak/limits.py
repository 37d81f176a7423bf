"""Random constraint files: bounds that a design keeps already, bounds drawn blindly, and contradictions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

LIGHT_M_PER_S = 299792458.0
AXES = ("x_m", "y_m", "z_m")
Rules = dict[str, Any]


@dataclass(frozen=True)
class Bounds:
    """A design space as plain numbers: `low` and `high` [m, m, m, rad, rad, m], each of length 6."""

    low: Sequence[float]
    high: Sequence[float]

    @classmethod
    def of(cls, space: Mapping[str, Any]) -> Bounds:
        """The bounds of a configuration's section."""
        names = (*AXES, "azimuth_rad", "elevation_rad", "range_m")
        pairs = [space[name] if isinstance(space[name], list) else [space[name]] * 2 for name in names]
        return cls([float(low) for low, _ in pairs], [float(high) for _, high in pairs])

    def is_free(self, index: int) -> bool:
        """Whether a dimension has more than one value."""
        return self.low[index] < self.high[index]

    @property
    def size_m(self) -> float:
        """The reach of the longest ray [m]."""
        return self.high[5]


def kept_already(
    design: Mapping[str, Any], bounds: Bounds, generator: np.random.Generator, *, is_moving: bool = False
) -> Rules:
    """Some bounds that a fitted design keeps with room to spare: a fit under them has to succeed.

    Sensors that follow a condition take no bounds of their places.
    """
    sensors = design["sensors"]
    options: list[Callable[[], Rules]] = [
        lambda: {"gate": _gate_around(sensors, bounds)},
        lambda: {"field_of_view": _field_around(sensors)},
        lambda: {"boresight": _boresight_around(sensors, bounds)},
        lambda: {"sensors": {"max": len(sensors) + int(generator.integers(0, 3))}},
    ]
    if not is_moving:
        options.append(lambda: {"origin": _origin_around(sensors, bounds)})
    return _some(options, generator)


def _some(options: Sequence[Callable[[], Rules]], generator: np.random.Generator) -> Rules:
    count = int(generator.integers(1, len(options) + 1))
    rules: Rules = {}
    for index in sorted(generator.permutation(len(options))[:count]):
        for key, values in options[index]().items():
            rules[key] = {**rules.get(key, {}), **values}
    return rules


def _gate_around(sensors: Sequence[Mapping[str, Any]], bounds: Bounds) -> Rules:
    starts = [sensor["gate_m"]["start"] for sensor in sensors]
    ends = [sensor["gate_m"]["end"] for sensor in sensors]
    width = max(end - start for start, end in zip(starts, ends, strict=True))
    room = 0.1 * bounds.size_m
    rules: Rules = {"start_m": {"min": max(min(starts) - room, 0.0)}, "end_m": {"max": max(ends) + room}}
    return {**rules, "width_m": {"max": 1.3 * width + 0.05 * bounds.size_m}}


def _field_around(sensors: Sequence[Mapping[str, Any]]) -> Rules:
    wide = {a: max(math.degrees(s["field_of_view_rad"][a]) for s in sensors) for a in ("horizontal", "vertical")}
    return {f"{axis}_deg": {"max": min(1.3 * value + 5.0, 360.0)} for axis, value in wide.items()}


def _boresight_around(sensors: Sequence[Mapping[str, Any]], bounds: Bounds) -> Rules:
    up = [math.degrees(sensor["boresight"]["elevation_rad"]) for sensor in sensors]
    rules: Rules = {"elevation_deg": {"min": max(min(up) - 10.0, -90.0), "max": min(max(up) + 10.0, 90.0)}}
    around = [math.degrees(sensor["boresight"]["azimuth_rad"]) for sensor in sensors]
    if max(around) - min(around) < 300:
        rules["azimuth_deg"] = {"min": min(around) - 20.0, "max": max(around) + 20.0}
    return rules


def _origin_around(sensors: Sequence[Mapping[str, Any]], bounds: Bounds) -> Rules:
    means = np.array([sensor["origin_m"]["mean"] for sensor in sensors])
    low, high = np.array(bounds.low[:3]), np.array(bounds.high[:3])
    room = 0.3 * (high - low)
    covariances = [np.array(sensor["origin_m"].get("covariance", np.zeros((3, 3)))) for sensor in sensors]
    spread = max(math.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)) for covariance in covariances)
    return {
        "low_m": np.maximum(means.min(axis=0) - room, low).tolist(),
        "high_m": np.minimum(means.max(axis=0) + room, high).tolist(),
        "spread_m": {"max": 1.3 * spread + 0.05 * bounds.size_m},
    }


def drawn(bounds: Bounds, sensors: int, generator: np.random.Generator) -> Rules:
    """Some bounds drawn without a look at any design: a fit keeps them all, or refuses them."""
    options: list[Callable[[], Rules]] = [
        lambda: {"gate": _drawn_gate(bounds, generator)},
        lambda: {"field_of_view": _drawn_field(bounds, generator)},
        lambda: {"boresight": _drawn_boresight(bounds, generator)},
        lambda: {"origin": _drawn_origin(bounds, sensors, generator)},
        lambda: {"budget": _drawn_budget(bounds, sensors, generator)},
        lambda: {"sensors": {"count": int(generator.integers(1, 13))}},
    ]
    rules = _some(options, generator)
    if generator.random() < 0.25:
        some = int(generator.integers(1, sensors + 1))
        rules["each"] = [{"gate": _drawn_gate(bounds, generator)} for _ in range(some)]
    return rules


def _drawn_gate(bounds: Bounds, generator: np.random.Generator) -> Rules:
    near, far = bounds.low[5], bounds.high[5]
    reach = far - near
    if not reach:
        return {"width_m": {"max": 0.1 * far}}
    choices: list[Rules] = [
        {"width_m": {"max": reach * generator.uniform(0.01, 0.8)}},
        {"start_m": {"min": near + reach * generator.uniform(0, 0.6)}},
        {"end_m": {"max": near + reach * generator.uniform(0.4, 1.1)}},
        {"width_m": {"min": reach * generator.uniform(0.0, 0.3)}, "start_m": {"max": near + 0.8 * reach}},
    ]
    return choices[int(generator.integers(len(choices)))]


def _drawn_field(bounds: Bounds, generator: np.random.Generator) -> Rules:
    axis = "horizontal" if generator.random() < 0.5 else "vertical"
    most = float(generator.uniform(1, 90))
    rules: Rules = {"max": most}
    if bounds.is_free(3 if axis == "horizontal" else 4) and generator.random() < 0.3:
        rules["min"] = most * float(generator.uniform(0, 0.9))
    return {f"{axis}_deg": rules}


def _drawn_boresight(bounds: Bounds, generator: np.random.Generator) -> Rules:
    low, high = (np.degrees(ends[3:5]) for ends in (bounds.low, bounds.high))
    if generator.random() < 0.5:
        cut = float(low[1] + (high[1] - low[1]) * generator.random())
        return {"elevation_deg": {"min" if generator.random() < 0.5 else "max": cut}}
    start = float(low[0] + (high[0] - low[0]) * generator.random())
    return {"azimuth_deg": {"min": start, "max": start + float(generator.uniform(1, 120))}}


def _drawn_origin(bounds: Bounds, sensors: int, generator: np.random.Generator) -> Rules:
    low, high = np.array(bounds.low[:3]), np.array(bounds.high[:3])
    inside = [(low + (high - low) * share).tolist() for share in generator.random((sensors + 1, 3))]
    ends = np.sort(np.array(inside[:2]), axis=0).tolist()
    size = bounds.size_m
    # a taken box may reach out of the space along every axis, so that it also blocks fixed dimensions
    taken = {
        "low_m": (np.array(ends[0]) - size * generator.integers(0, 2, 3) * 0.1).tolist(),
        "high_m": (np.array(ends[1]) + size * generator.integers(0, 2, 3) * 0.1).tolist(),
    }
    choices: list[Rules] = [
        {"low_m": ends[0], "high_m": ends[1]},
        {"spread_m": {"max": size * float(generator.uniform(0.001, 0.3))}},
        {"thickness_m": {"max": size * float(generator.uniform(0.001, 0.3))}},
        {"exclude": [taken]},
        {"fixed_m": inside[0]},
    ]
    if len({tuple(point) for point in inside}) == len(inside):
        choices.append({"mounts_m": inside})
    return choices[int(generator.integers(len(choices)))]


def _drawn_budget(bounds: Bounds, sensors: int, generator: np.random.Generator) -> Rules:
    rays = int(generator.integers(sensors, 80))
    if generator.random() < 0.5:
        return {"rays": rays}
    bin_m = LIGHT_M_PER_S * 100e-12 / 2
    widest = rays * max(bounds.high[5] / bin_m, 1.0) * 400 / 1e6
    return {"rays": rays, "bandwidth_mbps": float(widest * generator.uniform(0.02, 1.0))}


def contradictions(bounds: Bounds, sensors: int) -> dict[str, Rules]:
    """Constraint files that no design keeps, by what is wrong with them."""
    near, far, size = bounds.low[5], bounds.high[5], bounds.size_m
    away = [high + size for high in bounds.high[:3]]
    up, down = math.degrees(bounds.high[4]), math.degrees(bounds.low[4])
    found: dict[str, Rules] = {
        "a gate that starts beyond the range": {"gate": {"start_m": {"min": far + size}}},
        "a gate that ends before it starts": {"gate": {"start_m": {"min": far}, "end_m": {"max": 0.9 * far}}},
        "a gate wider than it may be": {"gate": {"width_m": {"min": 0.2 * size, "max": 0.1 * size}}},
        "a gate wider than the range": {"gate": {"width_m": {"min": (far - near) + size}}},
        "a fixed origin outside the space": {"origin": {"fixed_m": away}},
        "an origin box outside the space": {"origin": {"low_m": away}},
        "a taken box that holds all origins": {
            "origin": {
                "exclude": [
                    {"low_m": [v - size for v in bounds.low[:3]], "high_m": [v + size for v in bounds.high[:3]]}
                ]
            }
        },
        "a field of view of at least 20 and at most 10 degrees": {
            "field_of_view": {"horizontal_deg": {"min": 20.0, "max": 10.0}}
        },
        "a bandwidth below one bin per ray": {"budget": {"rays": 100, "bandwidth_mbps": 0.02}},
        "mounts outside the space": {"origin": {"mounts_m": [[away[0] + i * size, *away[1:]] for i in range(sensors)]}},
        "at least 5 and at most 3 sensors": {"sensors": {"min": 5, "max": 3}},
        "fewer rays than sensors": {"sensors": {"count": 8}, "budget": {"rays": 7}},
    }
    if up < 80:
        found["a boresight above the space"] = {"boresight": {"elevation_deg": {"min": min(up + 5.0, 90.0)}}}
    if down > -80:
        found["a boresight below the space"] = {"boresight": {"elevation_deg": {"max": max(down - 5.0, -90.0)}}}
    return found
