r"""The density at one value of its conditions, as weighted samples: nothing is learned again and no window is cut.

Every sample d = (c, r) of the run is a draw of p(r | c) at its own condition c. Moved to the value v it is still a
draw of that proposal, so with the weight $p^*(v, r) / p(r | c)$ its weighted mean is unbiased for the integral over
$p^*(v, \cdot)$, however far c was: distance costs effective samples, never correctness. The nearest samples suit
best; where the density moves quickly far ones get a few huge weights, so of the nearest `count`, half of them, a
quarter, and so on, the part that is worth most equal weights is taken. (Learned shelves, 40,000 samples of ESS 0.2:
worth 170 to 290 of the nearest 1000, 900 to 2400 of the nearest 20,000.)
"""

from __future__ import annotations

from collections.abc import Mapping
from weakref import WeakKeyDictionary

import numpy as np

from lidardesign.design.mixture.support import LEAST_SAMPLES, Retarget
from lidardesign.errors import ConfigError, DataError, NumericalError
from lidardesign.numerics import effective_count, normalised_weights
from lidardesign.samples import Samples
from lidardesign.space import DIMENSIONS, DesignSpace
from lidardesign.task import random_generator

# As many as a fit works on.
MOVED_SAMPLES = 20_000
_MOVED: WeakKeyDictionary[Samples, dict[tuple[tuple[str, float], ...], Samples]] = WeakKeyDictionary()


def at_condition(
    samples: Samples,
    condition: Mapping[str, float],
    retarget: Retarget | None,
    count: int,
    generator: np.random.Generator,
) -> Samples:
    """Samples of p given that conditions have exactly these values, with the weights that lead to p*.

    Arguments:
        samples: Samples of the whole run: conditions uniform over their bounds.
        condition: Values by dimension, as {"x_m": 0.37}; conditions that are not named stay free.
        retarget: log p* of design points, (N, 6) to (N,).
        count: How many samples are moved, at most.
        generator: Decides among equally near samples, and the order of the result.

    Returns:
        Samples in `samples.space.at(condition)`; their effective sample size says what they are worth.

    Raises:
        ConfigError: A name that is no condition, a value outside its bounds, or no target density to ask.
        DataError: The samples are worth too few to fit anything to.
        NumericalError: The target density is NaN somewhere.
    """
    space = samples.space.at(condition)
    if not condition:
        return samples
    if retarget is None:
        raise ConfigError(
            f"the density at {condition_text(condition)} needs the target density",
            where="--at",
            hint="give the run folder, or a design that lies in its run",
        )
    # the nearest samples in a random order; distances are shares of each condition's bounds
    order = generator.permutation(len(samples))
    squared = np.zeros(len(samples))
    for name, value in condition.items():
        index = DIMENSIONS.index(name)
        extent = samples.space.high[index] - samples.space.low[index]
        if extent > 0:
            squared += np.square((samples.points[order, index] - value) / extent)
    near = np.sort(np.argsort(squared, kind="stable")[:count])
    order, nearest = order[near], np.argsort(squared[near], kind="stable")
    points = samples.points[order].copy()
    for name, value in condition.items():
        points[:, DIMENSIONS.index(name)] = value
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
            f"at {condition_text(condition)} the {len(moved)} nearest samples are worth {effective[best]:.0f}",
            where="--at",
            allowed=f"at least {LEAST_SAMPLES}",
            hint="another value, learn longer (--preset standard or fine), or with more learning.samples",
        )
    # later steps take the first samples as a fair subset, so the random order stays
    return moved.subset(np.sort(parts[best]))


def conditioned(samples: Samples, condition: Mapping[str, float], retarget: Retarget | None) -> Samples:
    """`at_condition` with every condition named, remembered for as long as the samples are.

    Raises:
        ConfigError: A condition is missing; and as `at_condition`.
    """
    missing = [DIMENSIONS[index] for index in samples.space.conditioned if DIMENSIONS[index] not in condition]
    if missing:
        raise ConfigError(
            f"the samples are of a density with the condition {missing[0]}",
            where="--at",
            allowed=", ".join(samples.space.condition),
            hint=f"give --at {missing[0]}=VALUE",
        )
    known = _MOVED.setdefault(samples, {})
    key = tuple(sorted(condition.items()))
    if key not in known:
        known[key] = at_condition(samples, condition, retarget, MOVED_SAMPLES, random_generator(0, "condition"))
    return known[key]


def fixed_conditions(space: DesignSpace) -> dict[str, float]:
    """The conditions of a space that have one value, as {"x_m": 0.37}."""
    return {
        name: space.low[index]
        for index, name in enumerate(DIMENSIONS)
        if name in space.condition and index not in space.free
    }


def condition_text(condition: Mapping[str, float]) -> str:
    """Conditions for people, as `x_m=0.37, y_m=1`."""
    return ", ".join(f"{name}={value:g}" for name, value in condition.items())
