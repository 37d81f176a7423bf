"""A fitted ensemble of sensors as a design of real parts, and what every sensor lost by becoming one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import split_budget
from lidardesign.design.catalog.placing import Pose, interleaved, part_sensor
from lidardesign.design.constraints.budget import BandwidthBudget
from lidardesign.design.constraints.document import Constraints, SensorRules, rules_of
from lidardesign.design.constraints.origins import fix_origins
from lidardesign.design.files import MOST_TABLE_RAYS
from lidardesign.design.mixture.ensemble import Ensemble, sensors_of
from lidardesign.design.mixture.features import Features
from lidardesign.design.sensor import DesignSpec, Sensor, interval_factor
from lidardesign.design.snap.parts import PartChoice, PartOptions, fit_part_poses, nearest_parts, part_options
from lidardesign.design.snap.rays import (
    afford_rays,
    count_rays,
    count_useful_rays,
    fire_rays,
    gate_widths,
    useful_split,
)
from lidardesign.errors import ConfigError
from lidardesign.geometry.rays import Rays
from lidardesign.space import DesignSpace, angles


@dataclass(frozen=True, eq=False)
class SnappedDesign:
    """A design of parts.

    Arguments:
        design: Its sensors are parts, or stayed as they were, with explicit rays.
        ensemble: The mixture of the parts' components.
        report: What the sensors lost, as plain values.
        notes: One line each.
    """

    design: DesignSpec
    ensemble: Ensemble
    report: dict[str, Any]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _PlacedPart:
    """One sensor as it was fitted and as the part that it becomes."""

    fitted: Sensor
    sensor: Sensor
    choice: PartChoice
    pose: Pose | None
    seen: Features


def fix_part_origins(
    rules: Sequence[SensorRules], sensors: Sequence[Sensor]
) -> tuple[SensorRules, ...] | None:
    """The rules with sensors that become parts fixed at their mean origins; None where they are already."""
    spread = [
        bool(np.any(sensor.origin_covariance_m2)) and rules_of(rules, index).snap is not None
        for index, sensor in enumerate(sensors)
    ]
    if not any(spread):
        return None
    places = [
        (float(x), float(y), float(z)) if moves else None
        for (x, y, z), moves in zip((sensor.origin_m for sensor in sensors), spread, strict=True)
    ]
    return fix_origins(rules, places)


def snap_design(
    ensemble: Ensemble,
    constraints: Constraints,
    space: DesignSpace,
    budget: BandwidthBudget,
    *,
    level: float,
    seed: int,
    name: str,
) -> SnappedDesign:
    """The sensors of an ensemble replaced by parts of the catalogue.

    Arguments:
        ensemble: The fit, its origins without spread where a sensor becomes a part.
        constraints: What the fit and the parts keep.
        space: The design space.
        budget: Rays and bandwidth.
        level: The share that intervals hold.
        seed: Root of the random streams.
        name: The design's name.

    Raises:
        InfeasibleError: Constraints that no part, or no choice of parts, keeps.
        ConfigError: A part that is not there; more rays than a design file holds.
    """
    rules, before = constraints.rules, sensors_of(ensemble, space, level)
    options = part_options(rules, space, [sensor.range_m for sensor in before])
    if (budget.rays or 0) > MOST_TABLE_RAYS:
        raise ConfigError(f"{budget.rays} rays of parts", where="--rays", allowed=f"at most {MOST_TABLE_RAYS}")
    choices = nearest_parts(ensemble, options, budget.rays, seed)
    fitted_widths = np.array([sensor.gate_m[1] - sensor.gate_m[0] for sensor in before])
    choices = afford_rays(choices, options, ensemble.weights, fitted_widths, budget)
    snaps = [rules_of(rules, index).snap for index in range(len(before))]
    refitted = fit_part_poses(ensemble, choices, [snap is not None and snap.pose == "fitted" for snap in snaps])
    # every sensor with its part at the pose that its component has
    features = {sensor: part.features for part in ensemble.parts for sensor in part.group.sensors}
    placed = []
    for index, (fitted, sensor, choice) in enumerate(
        zip(before, sensors_of(refitted, space, level), choices, strict=True)
    ):
        one = _PlacedPart(fitted, sensor, choice, None, features[index])
        if choice.shape is not None:
            aimed = (sensor.origin_m, sensor.azimuth_rad, sensor.elevation_rad, sensor.roll_rad)
            one = _move_to(one, choice.shape.pose(*aimed, features[index].axes))
        placed.append(one)
    if not constraints.each:
        order = sorted(range(len(placed)), key=lambda i: -round(placed[i].sensor.weight, 9))
        placed = [
            replace(placed[old], sensor=replace(placed[old].sensor, name=f"s{new}")) for new, old in enumerate(order)
        ]
        options = [options[old] for old in order]
    placed = _interleave_alike(placed, rules)
    counts = _ray_counts(placed, budget)
    design = _design(placed, counts, constraints, level, name)
    notes = []
    for sensor, option in zip(design.sensors, options, strict=True):
        if option.lacking:
            notes.append(f"{sensor.name} stays a sensor of its own: no part keeps {', '.join(option.lacking)}")
        if sensor.rays == 0:
            notes.append(f"{sensor.name} sees too little of the density to have one of {design.rays} rays")
    report = {
        "log_likelihood": {"fitted": ensemble.log_likelihood, "parts": refitted.log_likelihood},
        "sensors": _report_rows(placed, options, counts, budget),
    }
    return SnappedDesign(design, refitted, report, tuple(notes))


def _move_to(one: _PlacedPart, pose: Pose) -> _PlacedPart:
    """A part at a pose, as a sensor."""
    shape, old = one.choice.shape, one.sensor
    if shape is None:
        return one
    start, end = shape.gate_m
    sensor = replace(
        part_sensor(shape.part, pose, name=old.name, weight=old.weight, level=old.level),
        range_m=(start + end) / 2,
        spread_range_m=(end - start) / (2 * interval_factor(old.level)),
    )
    return replace(one, sensor=sensor, pose=pose)


def _interleave_alike(placed: Sequence[_PlacedPart], rules: Sequence[SensorRules]) -> list[_PlacedPart]:
    """Parts of a kind that stand and look alike fire between each other's rays, where they may turn that far."""
    found = list(placed)
    alike: list[list[int]] = []
    for index, one in enumerate(placed):
        own = rules_of(rules, index)
        aims = own.boresight
        bounded = (own.snap is not None and own.snap.pose == "fitted") or any(
            value is not None for end in (aims.azimuth_deg, aims.elevation_deg) for value in (end.min, end.max)
        )
        if one.pose is None or bounded or one.seen.axes.angular < 2:
            continue
        group = next((group for group in alike if _look_alike(placed[group[0]], one)), None)
        if group is None:
            alike.append([index])
        else:
            group.append(index)
    for group in alike:
        first = placed[group[0]]
        if len(group) > 1 and first.choice.shape is not None and first.pose is not None:
            poses = interleaved(first.choice.shape.part, first.pose, len(group))
            for index, pose in zip(group, poses, strict=True):
                found[index] = _move_to(placed[index], pose)
    return found


def _look_alike(one: _PlacedPart, other: _PlacedPart) -> bool:
    """Whether two parts are of one kind, at one place, and look less than half a cell apart."""
    shape, poses = one.choice.shape, (one.pose, other.pose)
    if shape is None or other.choice.shape is None or poses[0] is None or poses[1] is None:
        return False
    if (shape.part.name, shape.turned) != (other.choice.shape.part.name, other.choice.shape.turned):
        return False
    columns, rows = shape.part.grid
    cell = min(shape.part.field_of_view_rad[0] / columns, shape.part.field_of_view_rad[1] / rows)
    cosine = min(float(a @ b) for a, b in zip(poses[0].frame, poses[1].frame, strict=True))
    return bool(np.array_equal(poses[0].origin_m, poses[1].origin_m)) and cosine >= math.cos(cell / 2)


def _ray_counts(placed: Sequence[_PlacedPart], budget: BandwidthBudget) -> np.ndarray:
    """Rays of every sensor, shape (G,)."""
    weights = np.array([one.sensor.weight for one in placed])
    choices = [one.choice for one in placed]
    widths = np.array(gate_widths(choices, np.array([np.diff(one.sensor.gate_m)[0] for one in placed])))
    useful = np.array(
        [0 if one.pose is None else count_useful_rays(one.choice, one.pose, one.seen) for one in placed], dtype=np.int64
    )
    if budget.rays is None:
        return count_rays(useful, weights, widths, budget)
    most = np.array([budget.rays if c.shape is None else min(c.shape.part.rays, budget.rays) for c in choices])
    first = np.where(useful > 0, np.minimum(useful, most), most)
    counts = useful_split(weights, budget.rays, first, most)
    if budget.limit_mbps is not None and budget.model.mbps_of_widths(widths, counts) > budget.limit_mbps:
        # so the parts were found affordable
        counts = useful_split(weights, budget.rays, most, most)
    return counts


def _design(
    placed: Sequence[_PlacedPart], counts: np.ndarray, constraints: Constraints, level: float, name: str
) -> DesignSpec:
    # what a part weighs is what it fires
    total = int(counts.sum())
    sensors = tuple(
        replace(one.sensor, rays=int(n), weight=int(n) / total) for one, n in zip(placed, counts, strict=True)
    )
    looking = np.concatenate(
        [fire_rays((one.choice, one.pose), one.sensor, int(n), one.seen) for one, n in zip(placed, counts, strict=True)]
    )
    azimuth, elevation = angles(looking)
    owner = np.repeat(np.arange(len(placed)), counts)
    gates = [one.sensor.gate_m if one.choice.shape is None else one.choice.shape.gate_m for one in placed]
    origins = np.array([sensor.origin_m for sensor in sensors], dtype=np.float64)
    return DesignSpec(
        name=name,
        sensors=sensors,
        layout="fixed",
        rays=total,
        ray_table=Rays.from_angles(origins[owner], azimuth, elevation, np.array(gates)[owner], owner),
        constraints=constraints.as_document(),
        level=level,
    )


def _report_rows(
    placed: Sequence[_PlacedPart], options: Sequence[PartOptions], counts: np.ndarray, budget: BandwidthBudget
) -> list[dict[str, Any]]:
    """What every sensor was, what it became, and what that costs alone; in the order of the design."""
    weights = np.array([one.fitted.weight for one in placed])
    shares = split_budget(weights, int(counts.sum()))
    rows = []
    for one, option, n, share in zip(placed, options, counts, shares, strict=True):
        shape = one.choice.shape
        loss = 0.0
        if shape is not None:
            loss = one.choice.losses[option.shapes.index(shape)]
        mbps = [
            budget.model.mbps_of_widths(np.diff(sensor.gate_m), int(rays))
            for sensor, rays in ((one.fitted, share), (one.sensor, n))
        ]
        rows.append(
            {
                "sensor": one.sensor.name,
                "part": None if shape is None else shape.part.name,
                "product": None if shape is None else shape.part.product,
                "turned": shape is not None and shape.turned,
                "loss_nats": loss,
                "field_of_view_rad": {
                    "fitted": [float(angle) for angle in one.fitted.field_of_view_rad],
                    "part": [float(angle) for angle in one.sensor.field_of_view_rad],
                },
                "gate_m": {"fitted": list(one.fitted.gate_m), "part": list(one.sensor.gate_m)},
                "rays": {
                    "fitted": int(share), "part": int(n), "pattern": None if shape is None else shape.part.rays
                },
                "bandwidth_mbps": {"fitted": mbps[0], "part": mbps[1]},
            }
        )  # fmt: skip
    return rows
