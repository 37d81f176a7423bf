"""A fitted ensemble of sensors as a design of real parts: what each loses by becoming one, and which rays it fires.

A part fires its own pattern, no more rays than it has: rays that look at nothing of the density are not read out, and
of the others it fires as many as are asked for, evenly spread. A part with fewer rays than its sensor's share of them
has only as much weight as it has rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import split_budget
from lidardesign.design.catalog.library import Pose, interleaved, part_rays, part_sensor
from lidardesign.design.constraints.document import Constraints, SensorRules, rules_of
from lidardesign.design.constraints.feasibility import BandwidthBudget
from lidardesign.design.constraints.origins import fix_origins
from lidardesign.design.files import MOST_TABLE_RAYS
from lidardesign.design.layouts.grid import field_on_sphere, grid_tangent
from lidardesign.design.mixture.ensemble import Ensemble, sensors_of
from lidardesign.design.mixture.features import Features
from lidardesign.design.sensor import DesignSpec, Sensor, interval_factor, tangent_directions
from lidardesign.design.snap.parts import (
    PartChoice,
    PartOptions,
    fit_part_poses,
    nearest_parts,
    part_options,
    useful_ray_filter,
)
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.geometry.rays import Rays
from lidardesign.space import DesignSpace, angles

# A sensor that stays as it was has as many rays as it is given.
ANY = np.iinfo(np.int64).max
BANDWIDTH = "budget.bandwidth_mbps"
# Where parts have a smaller share of the density than this, the others do not follow from it.
SMALLEST_SHARE = 0.01


def capped_split(weights: np.ndarray, count: int, most: np.ndarray) -> np.ndarray | None:
    """Whole rays in proportion to weights, none above its cap: (G,), (G,) to int64 (G,) with the sum `count`.

    None where all caps together are too few.
    """
    if np.minimum(most, count).sum() < count:
        return None
    shares, free = np.zeros(len(weights), dtype=np.int64), np.ones(len(weights), dtype=bool)
    while True:
        left = count - int(shares[~free].sum())
        # sensors without any weight share evenly what the others cannot fire
        own = weights[free] if weights[free].max(initial=0.0) > 0 else np.ones(int(free.sum()))
        shares[free] = split_budget(own, left) if free.any() else 0
        over = free & (shares > most)
        if not over.any():
            return shares
        shares[over] = most[over]
        free &= ~over


def useful_split(weights: np.ndarray, count: int, useful: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Whole rays in proportion to weights, first of those that look at something, shape (G,) int64.

    Arguments:
        weights: Shares of the rays, shape (G,).
        count: How many in all; no more than `most` sums to.
        useful: Rays that look at something, shape (G,).
        most: Rays that there are, at least the useful ones, shape (G,).
    """
    first = capped_split(weights, count, useful)
    if first is not None:
        return first
    return useful + capped_split(weights, count - int(useful.sum()), most - useful)


def afford_rays(
    choices: Sequence[PartChoice],
    options: Sequence[PartOptions],
    weights: np.ndarray,
    widths_m: np.ndarray,
    budget: BandwidthBudget,
) -> list[PartChoice]:
    """Choices whose parts have the rays that are asked for, inside the bandwidth that there is.

    Sensors change to parts that help, each time the one that loses least per ray or per bin gained.

    Arguments:
        choices: The nearest part of each sensor.
        options: What each may become.
        weights: Shares of the rays, shape (G,).
        widths_m: Gates of the fitted sensors, for those that stay as they are, shape (G,).
        budget: Number of rays and bandwidth.

    Raises:
        InfeasibleError: No change helps any more.
    """
    chosen = list(choices)
    while (lack := _lack(chosen, weights, widths_m, budget)) > (0, 0):
        changes = []
        for sensor, one in enumerate(options):
            for index, shape in enumerate(one.shapes):
                other = [*chosen[:sensor], replace(chosen[sensor], shape=shape), *chosen[sensor + 1 :]]
                left = _lack(other, weights, widths_m, budget)
                gain = lack[0] - left[0] if lack[0] else lack[1] - left[1]
                if left < lack:
                    changes.append((chosen[sensor].losses[index] / gain, sensor, index, other))
        if not changes:
            raise _refused(chosen, lack, budget)
        chosen = min(changes, key=lambda change: change[:3])[3]
    return chosen


def _lack(
    chosen: Sequence[PartChoice], weights: np.ndarray, widths_m: np.ndarray, budget: BandwidthBudget
) -> tuple[int, int]:
    """Rays that the parts lack, and bins that they need beyond the bandwidth."""
    most = np.array([ANY if one.shape is None else one.shape.part.rays for one in chosen])
    if budget.rays is not None and np.minimum(most, budget.rays).sum() < budget.rays:
        return budget.rays - int(np.minimum(most, budget.rays).sum()), 0
    if budget.limit_mbps is None:
        return 0, 0
    own = [None if one.shape is None else one.shape.gate_m for one in chosen]
    widths_m = [width if gate is None else gate[1] - gate[0] for gate, width in zip(own, widths_m, strict=True)]
    bins = budget.model.bins(np.array(widths_m))
    counts = np.ones(len(chosen), dtype=np.int64)
    if budget.rays is not None:
        counts = capped_split(weights, budget.rays, most)
    return 0, max(int(counts @ bins) - int(budget.limit_mbps / budget.model.mbps_of_widths(np.zeros(1), 1)), 0)


def _refused(chosen: Sequence[PartChoice], lack: tuple[int, int], budget: BandwidthBudget) -> InfeasibleError:
    name = "budget.rays" if "budget.rays" in budget.names else "--rays"
    if lack[0]:
        return InfeasibleError(
            f"the parts found have {(budget.rays or 0) - lack[0]} rays, {lack[0]} fewer than asked for",
            conflicts=[name, "snap"],
            hint="fewer rays, more sensors, or parts with more rays",
        )
    needed = (budget.limit_mbps or 0.0) + lack[1] * budget.model.mbps_of_widths(np.zeros(1), 1)
    count = len(chosen) if budget.rays is None else budget.rays
    return InfeasibleError(
        f"{count} rays of the parts found need about {needed:g} Mbit/s: their ranges cannot be narrowed",
        conflicts=[BANDWIDTH, *([] if budget.rays is None else [name]), "snap"],
        allowed=f"at most {budget.limit_mbps:g} Mbit/s",
        hint="fewer rays, fewer sensors, or more bandwidth",
    )


def count_rays(useful: np.ndarray, weights: np.ndarray, widths_m: np.ndarray, budget: BandwidthBudget) -> np.ndarray:
    """Rays of every sensor where none are asked for: what parts have to tell, as far as the bandwidth pays for it.

    Arguments:
        useful: Rays of each part that look at something; 0 for sensors that stay as they are, which have their share.
        weights: Shares of the rays, shape (G,).
        widths_m: Gate widths, shape (G,).
        budget: The bandwidth.
    """
    of_parts = useful > 0
    counts = useful.astype(np.int64)
    if not of_parts.all():
        share = max(float(weights[of_parts].sum()), SMALLEST_SHARE)
        counts[~of_parts] = np.maximum(np.round(counts.sum() / share * weights[~of_parts]), 1)
    share = min(1.0, MOST_TABLE_RAYS / int(counts.sum()))
    if budget.limit_mbps is not None:
        share = min(share, budget.limit_mbps / budget.model.mbps_of_widths(widths_m, counts))
    fewer = np.maximum(np.floor(counts * share).astype(np.int64), 1)
    while budget.limit_mbps is not None and budget.model.mbps_of_widths(widths_m, fewer) > budget.limit_mbps:
        fewer[np.where(fewer > 1, fewer * budget.model.bins(widths_m), -1).argmax()] -= 1
    return fewer


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
    """One sensor as it was fitted and as the part that it becomes; one that stays as it was has no pose."""

    fitted: Sensor
    sensor: Sensor
    choice: PartChoice
    pose: Pose | None
    seen: Features

    @property
    def gate_m(self) -> tuple[float, float]:
        return self.sensor.gate_m if self.choice.shape is None else self.choice.shape.gate_m

    def at(self, pose: Pose) -> _PlacedPart:
        """The part at a pose, as a sensor."""
        (start, end), old = self.gate_m, self.sensor
        sensor = replace(
            part_sensor(self.choice.shape.part, pose, name=old.name, weight=old.weight, level=old.level),
            range_m=(start + end) / 2,
            spread_range_m=(end - start) / (2 * interval_factor(old.level)),
        )
        return replace(self, sensor=sensor, pose=pose)

    def looks_like(self, other: _PlacedPart) -> bool:
        """Whether two parts are of one kind, at one place, and look less than half a cell apart."""
        part, pose = self.choice.shape.part, self.pose
        if (part.name, self.choice.shape.turned) != (other.choice.shape.part.name, other.choice.shape.turned):
            return False
        cell = min(angle / cells for angle, cells in zip(part.field_of_view_rad, part.grid, strict=True))
        cosine = min(float(a @ b) for a, b in zip(pose.frame, other.pose.frame, strict=True))
        return np.array_equal(pose.origin_m, other.pose.origin_m) and cosine >= math.cos(cell / 2)

    def useful_rays(self) -> int:
        """How many rays of the part look at some of the density, at least one; 0 where it is none."""
        if self.pose is None:
            return 0
        part = self.choice.shape.part
        useful = useful_ray_filter(part, self.pose, self.seen.points, self.seen.weights)
        return max(int(useful(part.directions @ self.pose.frame).sum()), 1)

    def fired(self, count: int) -> np.ndarray:
        """The unit vectors that it fires: of the part's pattern, or of its own even grid, shape (count, 3)."""
        if self.pose is None:
            return tangent_directions(self.sensor.frame, grid_tangent(*field_on_sphere(self.sensor), count))
        part = self.choice.shape.part
        useful = useful_ray_filter(part, self.pose, self.seen.points, self.seen.weights, least=count)
        return part_rays(part, self.pose, count, wanted=useful).direction


def fix_part_origins(rules: Sequence[SensorRules], sensors: Sequence[Sensor]) -> tuple[SensorRules, ...] | None:
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
    refitted = fit_part_poses(ensemble, choices, [_is_held(rules, index) for index in range(len(before))])
    # every sensor with its part at the pose that its component has
    features = {sensor: part.features for part in ensemble.parts for sensor in part.group.sensors}
    placed = []
    sensors = zip(before, sensors_of(refitted, space, level), choices, strict=True)
    for index, (fitted, sensor, choice) in enumerate(sensors):
        one = _PlacedPart(fitted, sensor, choice, None, features[index])
        if choice.shape is not None:
            aimed = (sensor.origin_m, sensor.azimuth_rad, sensor.elevation_rad, sensor.roll_rad)
            one = one.at(choice.shape.pose(*aimed, features[index].axes))
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


def _is_held(rules: Sequence[SensorRules], index: int) -> bool:
    """Whether a sensor looks as a part where it looked as it was fitted."""
    snap = rules_of(rules, index).snap
    return snap is not None and snap.pose == "fitted"


def _interleave_alike(placed: Sequence[_PlacedPart], rules: Sequence[SensorRules]) -> list[_PlacedPart]:
    """Parts of a kind that stand and look alike fire between each other's rays, where they may turn that far."""
    alike: list[list[int]] = []
    for index, one in enumerate(placed):
        aims = rules_of(rules, index).boresight
        bounds = (aims.azimuth_deg.min, aims.azimuth_deg.max, aims.elevation_deg.min, aims.elevation_deg.max)
        if one.pose is None or _is_held(rules, index) or one.seen.axes.angular < 2 or bounds != (None,) * 4:
            continue
        group = next((group for group in alike if placed[group[0]].looks_like(one)), None)
        if group is None:
            alike.append([index])
        else:
            group.append(index)
    turned = list(placed)
    for group in alike:
        first = placed[group[0]]
        if len(group) > 1:
            for index, pose in zip(group, interleaved(first.choice.shape.part, first.pose, len(group)), strict=True):
                turned[index] = placed[index].at(pose)
    return turned


def _ray_counts(placed: Sequence[_PlacedPart], budget: BandwidthBudget) -> np.ndarray:
    weights = np.array([one.sensor.weight for one in placed])
    widths = np.array([one.gate_m[1] - one.gate_m[0] for one in placed])
    useful = np.array([one.useful_rays() for one in placed], dtype=np.int64)
    if budget.rays is None:
        return count_rays(useful, weights, widths, budget)
    shapes = [one.choice.shape for one in placed]
    most = np.array([budget.rays if shape is None else min(shape.part.rays, budget.rays) for shape in shapes])
    counts = useful_split(weights, budget.rays, np.where(useful > 0, np.minimum(useful, most), most), most)
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
    fired = [one.fired(int(n)) for one, n in zip(placed, counts, strict=True)]
    azimuth, elevation = angles(np.concatenate(fired))
    owner = np.repeat(np.arange(len(placed)), counts)
    gates = np.array([one.gate_m for one in placed])
    origins = np.array([sensor.origin_m for sensor in sensors], dtype=np.float64)
    return DesignSpec(
        name=name,
        sensors=sensors,
        layout="fixed",
        rays=total,
        ray_table=Rays.from_angles(origins[owner], azimuth, elevation, gates[owner], owner),
        constraints=constraints.as_document(),
        level=level,
    )


def _report_rows(
    placed: Sequence[_PlacedPart], options: Sequence[PartOptions], counts: np.ndarray, budget: BandwidthBudget
) -> list[dict[str, Any]]:
    """What every sensor was, what it became, and what that costs alone; in the order of the design."""
    shares = split_budget(np.array([one.fitted.weight for one in placed]), int(counts.sum()))
    rows = []
    for one, option, n, share in zip(placed, options, counts, shares, strict=True):
        shape = one.choice.shape
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
                "loss_nats": 0.0 if shape is None else one.choice.losses[option.shapes.index(shape)],
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
