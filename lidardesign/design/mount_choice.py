"""Which mounting points the sensors take, where a constraint file lists more than there are sensors.

A mount is a pinned origin. How much of the density sensors at several mounts see together is, per sample, the
most that any of them sees of its scene point (re-aimed and reweighted as in `support`), summed over samples
drawn from the density. Mounts are taken one after the other, each time the one that newly sees most: this sum
is submodular, so the greedy choice sees at least 1 - 1/e of what the best choice sees (G. Nemhauser, L. Wolsey
and M. Fisher 1978). Sensors with constraints of their own are placed together with their mount.
"""

from __future__ import annotations

import numpy as np

from lidardesign.design.constraints import Constraints
from lidardesign.design.mounts import Mount, fixed_at, matched, mounts_of
from lidardesign.design.resolve import Group, pins_of
from lidardesign.design.samples import Samples
from lidardesign.design.support import Retarget, re_aimed
from lidardesign.errors import InfeasibleError
from lidardesign.numerics import systematic_draw
from lidardesign.task import random_generator

# So many samples tell apart mounts whose shares differ by a hundredth.
MOUNT_SAMPLES = 4000
# `auto` takes as few mounts as together see this share of what all see together.
ENOUGH_SHARE = 0.95


def at_mounts(
    constraints: Constraints, samples: Samples, counts: list[int], retarget: Retarget | None, seed: int
) -> tuple[Constraints, list[int]]:
    """The constraints with every mounted sensor fixed at the mount chosen for it, and the counts that are left.

    Where sensors beyond `each` are mounted and their number is open, it is the least of the counts whose mounts
    see 95 % of what those of the largest count see together.

    Arguments:
        constraints: Feasible constraints.
        samples: Samples of the density.
        counts: Numbers of sensors that may be chosen, ascending.
        retarget: log p* of design points, (N, 6) to (N,).
        seed: Root of the draw of samples.

    Raises:
        ConfigError: There is a choice, but no way to evaluate the target density.
        InfeasibleError: No mount sees any of the density.
    """
    open_count = bool(mounts_of(constraints, len(constraints.each))) and len(counts) > 1
    count = counts[-1] if mounts_of(constraints, len(constraints.each)) else len(constraints.each)
    options = [mounts_of(constraints, sensor) for sensor in range(count)]
    chosen = None if open_count else _only_choice(constraints, options)
    if chosen is None:
        views = _views(constraints, samples, options, retarget, seed)
        chosen, together = _greedy(views, options)
        if open_count:
            seen = {n: _greedy(views, options[:n]) for n in counts}
            count = min(n for n in counts if seen[n][1] >= ENOUGH_SHARE * together)
            chosen = seen[count][0]
    fixed = fixed_at(constraints, [chosen.get(sensor) for sensor in range(count)])
    return fixed, [count] if mounts_of(constraints, len(constraints.each)) else counts


def _only_choice(constraints: Constraints, options: list[list[Mount]]) -> dict[int, Mount] | None:
    """Alike sensors at all the mounts, in the file's order; None where there is something to choose."""
    if constraints.each or len(options[0]) != len(options):
        return None
    return dict(enumerate(options[0]))


def _views(
    constraints: Constraints,
    samples: Samples,
    options: list[list[Mount]],
    retarget: Retarget | None,
    seed: int,
) -> dict[tuple[int, Mount], np.ndarray]:
    """What each sensor would see of each drawn sample's scene point from each of its mounts, (N,) each."""
    chosen = systematic_draw(samples.weights, MOUNT_SAMPLES, random_generator(seed, "mounts"))
    last = len(constraints.each)
    views: dict[tuple[int, Mount], np.ndarray] = {}
    for sensor, mounts in enumerate(options):
        for mount in mounts:
            # sensors beyond the entries of `each` are alike
            view = views.get((last, mount)) if sensor > last else None
            if view is None:
                view = _view(constraints, samples, chosen, sensor, mount, retarget)
            views[sensor, mount] = view
    if not any(view.any() for view in views.values()):
        names = [constraints.name_of(0, "origin.mounts_m")]
        raise InfeasibleError("no mount sees any of the density", conflicts=names, hint="add mounts elsewhere")
    return views


def _view(
    constraints: Constraints,
    samples: Samples,
    chosen: np.ndarray,
    sensor: int,
    mount: Mount,
    retarget: Retarget | None,
) -> np.ndarray:
    places: list[Mount | None] = [None] * sensor
    fixed = fixed_at(constraints, [*places, mount])
    pins = pins_of(fixed.of_sensor(sensor), samples.space)
    return re_aimed(samples, chosen, fixed, Group(pins, (sensor,)), retarget)[1]


def _greedy(
    views: dict[tuple[int, Mount], np.ndarray], options: list[list[Mount]]
) -> tuple[dict[int, Mount], float]:
    """The mount of each mounted sensor, and how much of the density they see together."""
    seen = np.zeros(len(next(iter(views.values()))))
    left = {sensor: list(mounts) for sensor, mounts in enumerate(options) if mounts}
    chosen: dict[int, Mount] = {}
    while left:
        gains = {
            (sensor, mount): float(np.maximum(seen, views[sensor, mount]).sum())
            for sensor, mounts in left.items()
            for mount in mounts
            if matched([[m for m in others if m != mount] for other, others in left.items() if other != sensor])
        }
        sensor, mount = max(gains, key=lambda pair: gains[pair])
        chosen[sensor] = mount
        seen = np.maximum(seen, views[sensor, mount])
        del left[sensor]
        left = {other: [m for m in mounts if m != mount] for other, mounts in left.items()}
    return chosen, float(seen.mean())
