"""How many rays each of several parts fires, and which: no more than it has, and none that nobody asked to read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.design.bandwidth import split_budget
from lidardesign.design.catalog.placing import Pose, part_rays
from lidardesign.design.constraints.budget import BandwidthBudget
from lidardesign.design.files import MOST_TABLE_RAYS
from lidardesign.design.layouts.grid import field_on_sphere, grid_tangent
from lidardesign.design.mixture.features import Features
from lidardesign.design.sensor import Sensor, tangent_directions
from lidardesign.design.snap.parts import PartChoice, PartOptions
from lidardesign.design.snap.shapes import useful_ray_filter
from lidardesign.errors import InfeasibleError

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
    bins = budget.model.bins(np.array(gate_widths(chosen, widths_m)))
    counts = np.ones(len(chosen), dtype=np.int64)
    if budget.rays is not None:
        counts = capped_split(weights, budget.rays, most)
    allowed = int(budget.limit_mbps / budget.model.mbps_of_widths(np.zeros(1), 1))
    return 0, max(int(counts @ bins) - allowed, 0)


def gate_widths(chosen: Sequence[PartChoice], widths_m: np.ndarray) -> list[float]:
    """Gate widths of the parts, and of the sensors that stay as they are [m]."""
    return [
        float(width) if one.shape is None else one.shape.gate_m[1] - one.shape.gate_m[0]
        for one, width in zip(chosen, widths_m, strict=True)
    ]


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


def fire_rays(shape_pose: tuple[PartChoice, Pose | None], sensor: Sensor, count: int, seen: Features) -> np.ndarray:
    """The unit vectors that a sensor fires: of its part's pattern, or of its own even grid, shape (count, 3)."""
    choice, pose = shape_pose
    if choice.shape is None or pose is None:
        return tangent_directions(sensor.frame, grid_tangent(*field_on_sphere(sensor), count))
    part = choice.shape.part
    wanted = useful_ray_filter(part, pose, seen.points, seen.weights, least=count)
    return part_rays(part, pose, count, wanted=wanted).direction


def count_useful_rays(choice: PartChoice, pose: Pose, seen: Features) -> int:
    """How many rays of a part look at some of the density; at least one."""
    if choice.shape is None:
        return 0
    part = choice.shape.part
    wanted = useful_ray_filter(part, pose, seen.points, seen.weights)(part.directions @ pose.frame)
    return max(int(wanted.sum()), 1)


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
        cost = budget.model.mbps_of_widths(widths_m, counts)
        share = min(share, budget.limit_mbps / cost)
    fewer = np.maximum(np.floor(counts * share).astype(np.int64), 1)
    while budget.limit_mbps is not None and budget.model.mbps_of_widths(widths_m, fewer) > budget.limit_mbps:
        dearest = np.where(fewer > 1, fewer * budget.model.bins(widths_m), -1).argmax()
        fewer[dearest] -= 1
    return fewer
