"""Random constraint files: bounds around a design, loose or tight, and contradictions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lidardesign.space import DesignSpace

LIGHT_M_PER_S = 299792458.0
Rules = dict[str, Any]
Sensors = Sequence[Mapping[str, Any]]


def bounds_around(
    design: Mapping[str, Any], space: DesignSpace, generator: np.random.Generator, room: float, *, is_moving: bool
) -> Rules:
    """Some bounds around a fitted design.

    Arguments:
        design: The design as plain values.
        space: Its design space.
        generator: Draws which bounds there are.
        room: With 1 the design keeps them with room to spare, and a fit under them has to succeed; with less, down to
            -1, they are the tighter, also of other kinds, and a fit keeps them all or refuses them.
        is_moving: Whether its sensors follow a condition: then their places take no bounds.
    """
    sensors, is_tight = design["sensors"], room < 1
    options: list[Callable[[], Rules]] = [
        lambda: {"gate": _gate(sensors, space, room)},
        lambda: {"field_of_view": _field(sensors, room)},
        lambda: {"boresight": _boresight(sensors, room)},
        lambda: {"sensors": {"max": max(len(sensors) + int(generator.integers(0, 3) + 2 * room - 2), 1)}},
        *([] if is_moving else [lambda: {"origin": _origin(sensors, space, room)}]),
        *([lambda: {"origin": _place(space, len(sensors), generator)}] if is_tight else []),
        *([lambda: {"budget": _budget(space, len(sensors), generator)}] if is_tight else []),
    ]
    rules: Rules = {}
    for index in sorted(generator.permutation(len(options))[: generator.integers(1, len(options) + 1)]):
        for key, values in options[index]().items():
            rules[key] = {**rules.get(key, {}), **values}
    if is_tight and generator.random() < 0.25:
        rules["each"] = [{"gate": _gate([one], space, room)} for one in sensors]
    return rules


def _gate(sensors: Sensors, space: DesignSpace, room: float) -> Rules:
    starts, ends = ([sensor["gate_m"][end] for sensor in sensors] for end in ("start", "end"))
    width = max(end - start for start, end in zip(starts, ends, strict=True))
    beyond = 0.1 * room * space.high[5]
    most = (1 + 0.3 * room) * width + max(0.5 * beyond, 0.0)
    return {
        "start_m": {"min": max(min(starts) - beyond, 0.0)},
        "end_m": {"max": max(ends) + beyond},
        "width_m": {"max": most or 0.01 * space.high[5]},
    }


def _field(sensors: Sensors, room: float) -> Rules:
    wide = {a: max(math.degrees(s["field_of_view_rad"][a]) for s in sensors) for a in ("horizontal", "vertical")}
    return {f"{a}_deg": {"max": float(np.clip((1 + 0.3 * room) * wide[a] + 5 * room, 0.1, 360))} for a in wide}


def _boresight(sensors: Sensors, room: float) -> Rules:
    up, around = (
        np.degrees([sensor["boresight"][f"{angle}_rad"] for sensor in sensors]) for angle in ("elevation", "azimuth")
    )
    rules: Rules = {
        "elevation_deg": {
            "min": float(np.clip(up.min() - 10 * room, -90, 90)),
            "max": float(np.clip(up.max() + 10 * room, -90, 90)),
        }
    }
    if np.ptp(around) < 300:
        rules["azimuth_deg"] = {"min": float(around.min() - 20 * room), "max": float(around.max() + 20 * room)}
    return rules


def _origin(sensors: Sensors, space: DesignSpace, room: float) -> Rules:
    means = np.array([sensor["origin_m"]["mean"] for sensor in sensors])
    low, high = np.array(space.low[:3]), np.array(space.high[:3])
    covariances = [np.array(sensor["origin_m"].get("covariance", np.zeros((3, 3)))) for sensor in sensors]
    spread = max(math.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)) for covariance in covariances)
    beyond = 0.3 * room * (high - low)
    return {
        "low_m": np.maximum(means.min(axis=0) - beyond, low).tolist(),
        "high_m": np.minimum(means.max(axis=0) + beyond, high).tolist(),
        "spread_m": {"max": (1 + 0.3 * room) * spread + 0.05 * max(room, 0.02) * space.high[5]},
    }


def _place(space: DesignSpace, sensors: int, generator: np.random.Generator) -> Rules:
    low, high = np.array(space.low[:3]), np.array(space.high[:3])
    inside = [(low + (high - low) * share).tolist() for share in generator.random((sensors + 1, 3))]
    ends = np.sort(np.array(inside[:2]), axis=0)
    # a taken box may reach out of the space along every axis, so that it also blocks fixed dimensions
    further = 0.1 * space.high[5] * generator.integers(0, 2, (2, 3))
    taken = {"low_m": (ends[0] - further[0]).tolist(), "high_m": (ends[1] + further[1]).tolist()}
    choices: list[Rules] = [{"exclude": [taken]}, {"fixed_m": inside[0]}]
    if len({tuple(point) for point in inside}) == len(inside):
        choices.append({"mounts_m": inside})
    return choices[int(generator.integers(len(choices)))]


def _budget(space: DesignSpace, sensors: int, generator: np.random.Generator) -> Rules:
    rays = int(generator.integers(sensors, 80))
    bins = max(space.high[5] / (LIGHT_M_PER_S * 100e-12 / 2), 1.0)
    return {"rays": rays, "bandwidth_mbps": float(rays * bins * 400 / 1e6 * generator.uniform(0.02, 1.0))}


def contradictions(space: DesignSpace, sensors: int) -> dict[str, Rules]:
    """Constraint files that no design keeps in a space of any size, by what is wrong with them."""
    far = space.high[5]
    away = [high + far for high in space.high[:3]]
    around = {"low_m": [low - far for low in space.low[:3]], "high_m": away}
    return {
        "a gate that starts beyond the range": {"gate": {"start_m": {"min": 2 * far}}},
        "a gate that ends before it starts": {"gate": {"start_m": {"min": far}, "end_m": {"max": 0.9 * far}}},
        "a gate wider than the range": {"gate": {"width_m": {"min": 2 * far}}},
        "a fixed origin outside the space": {"origin": {"fixed_m": away}},
        "a taken box that holds all origins": {"origin": {"exclude": [around]}},
        "a bandwidth below one bin per ray": {"budget": {"rays": 100, "bandwidth_mbps": 0.02}},
        "mounts outside the space": {"origin": {"mounts_m": [[away[0] + i * far, *away[1:]] for i in range(sensors)]}},
    }
