r"""The density restricted to what constrained sensors can measure: pinned origins, and one value of its conditions.

Constraints that restrict the samples: the origin boxes less what they exclude, the ranges between the
earliest admitted gate start and the latest admitted gate end, and, where both boresight and field of view are
bounded, the directions within half of the largest diagonal field of view of an admitted boresight. The others
bound sensors, not rays. With `each`, a sample is kept where any sensor admits it.

A pinned origin has measure zero. A sample d = (x, v, r) that observes the scene point s is re-aimed at s from
the pinned origin x': E over (x, s) is with respect to p*(d) / r^2, so the new weight is
$w(d)\, \frac{p^*(d') / r'^2}{p^*(d) / r^2}$ with d' = aim(x', s).

The density at one value of its conditions, as weighted samples: nothing is learned again and no window is cut.

Every sample d = (c, r) of the run is a draw of p(r | c) at its own condition c. Moved to the value v it is still a
draw of that proposal, so with the weight $p^*(v, r) / p(r | c)$ its weighted mean is unbiased for the integral over
$p^*(v, \cdot)$, however far c was: distance costs effective samples, never correctness. The nearest samples have the
most even weights; where the density moves quickly far ones get a few huge weights, so of the nearest `count`, half of
them, a quarter, and so on, the part with the largest effective number is taken. (Learned shelves, 40,000 samples of
ESS 0.2: effective numbers of 170 to 290 of the nearest 1000, 900 to 2400 of the nearest 20,000.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.constraints.document import SensorRules
from lidardesign.constraints.feasibility import azimuth_interval
from lidardesign.constraints.origins import inside_excluded, origin_box
from lidardesign.errors import ConfigError, DataError, InfeasibleError, NumericalError
from lidardesign.mixture.bounds import Group
from lidardesign.numerics import SLACK, effective_count, normalised_weights, systematic_draw, wrap_angle
from lidardesign.samples import Samples
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, RANGE, DesignSpace, aim, direction, observed_point

Retarget = Callable[[np.ndarray], np.ndarray]

# Below this share of the density a design would be fitted to its far tails.
LEAST_MASS = 1e-3
# Equal-weight samples per sensor, and in all, that moments of six dimensions need.
LEAST_SAMPLES_PER_SENSOR = 10
LEAST_SAMPLES = 50
# Fixed coordinates and boxes are met to this [m or rad].
TOLERANCE = SLACK


@dataclass(frozen=True, eq=False)
class Support:
    """Weighted samples that the sensors of one group may draw on.

    Arguments:
        points: Design points, shape (N, 6).
        weights: Unnormalised, shape (N,).
        total: The sum of weights relative to the whole density, where it has a meaning.
        effective: The effective number of samples.
        mass: The share of the density inside the constraints; None where an origin is pinned.
    """

    points: np.ndarray
    weights: np.ndarray
    total: float
    effective: float
    mass: float | None = None


def admissible(points: np.ndarray, rules: Sequence[SensorRules], space: DesignSpace, group: Group) -> np.ndarray:
    """Mask of the design points that some sensor of a group may measure, (N, 6) to (N,) bool."""
    keep = np.zeros(len(points), dtype=bool)
    for index in sorted({min(sensor, len(rules) - 1) for sensor in group.sensors}):
        one = rules[index]
        low, high = origin_box(one, space)
        inside = ((points[:, :3] >= low - TOLERANCE) & (points[:, :3] <= high + TOLERANCE)).all(axis=1)
        inside &= ~inside_excluded(points[:, :3], one)
        start, end = one.gate.start_m.min, one.gate.end_m.max
        inside &= points[:, RANGE] >= (-math.inf if start is None else start)
        inside &= points[:, RANGE] <= (math.inf if end is None else end)
        widest = one.field_of_view.horizontal_deg.max, one.field_of_view.vertical_deg.max
        ends = one.boresight.azimuth_deg, one.boresight.elevation_deg
        if None not in widest and any(value is not None for end in ends for value in (end.min, end.max)):
            # the directions that are near enough to an admitted boresight
            low, high = azimuth_interval(one, space)
            middle, half = (low + high) / 2, (high - low) / 2
            azimuth = middle + np.clip(wrap_angle(points[:, AZIMUTH] - middle), -half, half)
            bottom, top = -90.0 if ends[1].min is None else ends[1].min, 90.0 if ends[1].max is None else ends[1].max
            elevation = np.clip(points[:, ELEVATION], math.radians(bottom), math.radians(top))
            nearest, ray = direction(azimuth, elevation), direction(points[:, AZIMUTH], points[:, ELEVATION])
            reach = math.radians(math.hypot(*widest)) / 2
            inside &= np.einsum("ni,ni->n", nearest, ray) >= math.cos(min(reach, math.pi))
        keep |= inside
    return keep


def restrict_samples(samples: Samples, rules: Sequence[SensorRules], group: Group) -> Support:
    """The samples of p inside the admissible set of a group without pins; `total` is the admissible mass."""
    keep = admissible(samples.points, rules, samples.space, group)
    weights = samples.weights[keep]
    return Support(samples.points[keep], weights, float(weights.sum()), effective_count(weights))


def pin_samples(
    samples: Samples,
    rules: Sequence[SensorRules],
    group: Group,
    retarget: Retarget | None,
    count: int,
    generator: np.random.Generator,
) -> Support:
    """Samples re-aimed from pinned origin coordinates at the scene points that they observed.

    Arguments:
        samples: Samples of the density with free origins.
        rules: What the sensors must keep.
        group: Sensors and their pinned coordinates.
        retarget: log p* of design points, (N, 6) to (N,).
        count: How many samples are re-aimed; they are drawn by weight first.
        generator: Source of that draw.

    Raises:
        ConfigError: No way to evaluate the target density was given.
    """
    chosen = systematic_draw(samples.weights, count, generator)
    aimed, weights = reaim_samples(samples, chosen, rules, group, retarget)
    used = weights > 0
    return Support(aimed[used], weights[used], float(weights.sum()) / count, effective_count(weights))


def reaim_samples(
    samples: Samples, chosen: np.ndarray, rules: Sequence[SensorRules], group: Group, retarget: Retarget | None
) -> tuple[np.ndarray, np.ndarray]:
    """Samples re-aimed from the pins at their scene points, (N, 6), and their new weights, (N,); 0 where unseen.

    Raises:
        ConfigError: No way to evaluate the target density was given.
        NumericalError: The target density is NaN at one of them.
    """
    if retarget is None:
        raise ConfigError(
            "the origin is free in the learned density, and pinning it needs the target density",
            where="origin.fixed_m",
            hint="give the run folder instead of a design file",
        )
    points, space = samples.points[chosen], samples.space
    origins = points[:, :3].copy()
    for axis, pin in enumerate(group.pins):
        origins[:, axis] = origins[:, axis] if pin is None else pin
    aimed = space.wrap(aim(origins, observed_point(points)))
    weights = np.zeros(len(aimed))
    log_old = _per_scene_volume(points, samples.log_target[chosen], space)
    keep = space.contains(aimed, TOLERANCE) & admissible(aimed, rules, space, group)
    keep &= np.isfinite(log_old) & (aimed[:, RANGE] > 0)
    if not keep.any():
        return aimed, weights
    log_target = np.asarray(retarget(aimed[keep]), dtype=np.float64)
    if log_target.shape != (int(keep.sum()),) or np.isnan(log_target).any():
        raise NumericalError("the target density is NaN at re-aimed samples", where="origin.fixed_m")
    with np.errstate(invalid="ignore"):
        weights[keep] = np.exp(_per_scene_volume(aimed[keep], log_target, space) - log_old[keep])
    return aimed, weights


def _per_scene_volume(points: np.ndarray, log_target: np.ndarray, space: DesignSpace) -> np.ndarray:
    """log p* per volume of observed scene points instead of per chart volume of direction and range."""
    power = (AZIMUTH in space.free) + (ELEVATION in space.free)
    with np.errstate(divide="ignore"):
        jacobian = power * np.log(points[:, RANGE])
        if space.measure == "angles" and power == 2:
            jacobian = jacobian + np.log(np.cos(points[:, ELEVATION]))
    return log_target - jacobian


def check_support(support: Support, group: Group, *, mass: float | None, several: bool) -> None:
    """Refuse a support that holds too little of the density to fit sensors to.

    Raises:
        InfeasibleError: With the measured mass.
    """
    needed = max(LEAST_SAMPLES, LEAST_SAMPLES_PER_SENSOR * len(group.sensors))
    which = f"sensors {', '.join(map(str, group.sensors))}" if several else "the sensors"
    if any(pin is not None for pin in group.pins):
        place = ", ".join("free" if pin is None else f"{pin:g}" for pin in group.pins)
        which += f" at ({place}) m"
    if mass is not None and mass < LEAST_MASS:
        raise InfeasibleError(
            f"the constraints of {which} leave {mass:.3g} of the density",
            admissible_mass=mass,
            allowed=f"at least {LEAST_MASS:g}",
            hint="widen the origin box, the gate or the field of view, exclude less, or learn inside the smaller space",
        )
    if support.effective < needed:
        found = f"the constraints of {which} leave {support.effective:.0f} effective samples"
        hint = "learn with more samples or inside the smaller space"
        if mass is not None and mass >= 1 - TOLERANCE:
            found = f"the samples count as only {support.effective:.0f}, too few for {len(group.sensors)} sensors"
            hint = "fewer sensors, or learn longer (--preset standard or fine) or with more learning.samples"
        elif mass is not None:
            found += f" and {mass:.3g} of the density"
        raise InfeasibleError(found, admissible_mass=mass, allowed=f"at least {needed}", hint=hint)


# As many as a fit works on.
MOVED_SAMPLES = 20_000


def at_condition(
    samples: Samples,
    condition: Mapping[str, float],
    retarget: Retarget,
    count: int,
    generator: np.random.Generator,
) -> Samples:
    """Weighted samples of p* given exact values of conditions.

    Arguments:
        samples: Samples of the whole run: conditions uniform over their bounds.
        condition: Values by dimension, as {"x_m": 0.37}; conditions that are not named stay free.
        retarget: log p* of design points, (N, 6) to (N,).
        count: How many samples are moved, at most.
        generator: Decides among equally near samples, and the order of the result.

    Returns:
        Samples in `samples.space.at(condition)`; their effective sample size says what they are worth.

    Raises:
        ConfigError: A name that is no condition, or a value outside its bounds.
        DataError: The effective number of samples is too small for a fit.
        NumericalError: The target density is NaN somewhere.
    """
    space = samples.space.at(condition)
    if not condition:
        return samples
    # the nearest samples in a random order; distances are shares of each condition's bounds
    order = generator.permutation(len(samples))
    squared, values = np.zeros(len(samples)), {DIMENSIONS.index(name): value for name, value in condition.items()}
    for index, value in values.items():
        extent = samples.space.high[index] - samples.space.low[index]
        if extent > 0:
            squared += np.square((samples.points[order, index] - value) / extent)
    near = np.sort(np.argsort(squared, kind="stable")[:count])
    order, nearest = order[near], np.argsort(squared[near], kind="stable")
    points = samples.points[order].copy()
    points[:, list(values)] = list(values.values())
    log_target = np.asarray(retarget(points), dtype=np.float64)
    if log_target.shape != (len(points),) or np.isnan(log_target).any():
        raise NumericalError(f"the target density is NaN at {condition_text(condition)}", where="--at")
    # samples were drawn with uniform conditions; given their values that density is no part of it
    named = [index for index in samples.space.conditioned if DIMENSIONS[index] in condition]
    log_extent = float(np.log(samples.space.chart_high[named] - samples.space.chart_low[named]).sum())
    moved = Samples(points, samples.log_prob[order] + log_extent, log_target, space)
    # all of them, the nearer half, a quarter, ...
    parts = [nearest]
    while len(parts[-1]) >= 2 * LEAST_SAMPLES:
        parts.append(parts[-1][: len(parts[-1]) // 2])
    effective = [
        effective_count(normalised_weights(weights)) if np.isfinite(weights.max(initial=-np.inf)) else 0.0
        for weights in (moved.log_weights[part] for part in parts)
    ]
    best = int(np.argmax(effective))
    if effective[best] < LEAST_SAMPLES:
        raise DataError(
            f"at {condition_text(condition)} the {len(moved)} nearest samples count as only {effective[best]:.0f}",
            where="--at",
            allowed=f"at least {LEAST_SAMPLES}",
            hint="another value, learn longer (--preset standard or fine), or with more learning.samples",
        )
    # later steps take the first samples as a fair subset, so the random order stays
    return moved.subset(np.sort(parts[best]))


def condition_text(condition: Mapping[str, float]) -> str:
    """Conditions for people, as `x_m=0.37, y_m=1`."""
    return ", ".join(f"{name}={value:g}" for name, value in condition.items())
