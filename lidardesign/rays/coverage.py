"""Information of every candidate ray about every item of many scenes, as one sparse table.

A candidate is a ray with one of a few gates. Items are the quantities to measure in scenes: points of a visible
surface, frames of a motion, bodies. The worth of a choice S is F(S) = sum_u w_u phi_u(S), where phi is the largest
worth of the returns that S receives about item u (facility location), or a concave table of their sum. Both are
monotone and submodular (Nemhauser, Wolsey and Fisher 1978).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lidardesign.rays import kernels
from lidardesign.rays.training_scenes import LARGEST, SceneInformation

# Where a sensor may fail: how much the mean over losses counts, and of how many sensors an item's loss is asked.
# The mean over losses alone lets two sensors see the same: faces are 11 % worse while both live, and lose no less.
LOSS_SHARE, MOST_LOSSES = 0.5, 4


@dataclass(frozen=True, eq=False)
class Coverage:
    """The information of all candidates about all items, with the costs of candidates.

    Arguments:
        start: The first entry of each ray, (N + 1,).
        item: The item of each entry, (E,).
        worth: Its worth, float32 (E,).
        gates: One bit for each gate of the ray that lets the return through, uint8 (E,).
        weight: Weights of items, summing to 1, (U,).
        bits: Bandwidth of a ray with each gate [Mbit/s], inf for a gate that is not allowed, (N, G).
        harm: Harm of a ray with each gate, in the unit of worth, (N, G).
        table: The concave table of sums, 0 at 0, or `LARGEST`.
        complete: F of complete information; the loss of a choice is this less its F.
    """

    start: np.ndarray
    item: np.ndarray
    worth: np.ndarray
    gates: np.ndarray
    weight: np.ndarray
    bits: np.ndarray
    harm: np.ndarray
    table: np.ndarray = field(default_factory=lambda: LARGEST)
    complete: float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rays and of gates per ray, (N, G)."""
        return self.bits.shape

    @cached_property
    def ray(self) -> np.ndarray:
        """The ray of each entry, (E,)."""
        return np.repeat(np.arange(len(self.start) - 1, dtype=np.int32), np.diff(self.start))

    @cached_property
    def entries(self) -> kernels.ByRay:
        """The table for compiled loops."""
        return kernels.ByRay(self.start, self.item, self.worth, self.gates, self.weight, self.table)

    @cached_property
    def by_item(self) -> kernels.ByItem:
        """The table in the order of items, entries of an item by falling worth."""
        begin, order = self._order_by_item
        return kernels.ByItem(begin, self.ray[order], self.worth[order], self.gates[order], self.weight, self.table)

    @cached_property
    def _order_by_item(self) -> tuple[np.ndarray, np.ndarray]:
        """The first entry of each item, (U + 1,), and the order of entries by item, (E,)."""
        begin = _begins(self.item, len(self.weight))
        return begin, kernels.order_by_item(self.item, self.worth, begin)

    def of_rays(self, rays: slice) -> Coverage:
        """The table of a slice of the rays."""
        if rays == slice(0, len(self.bits)):
            return self
        first, last = self.start[rays.start], self.start[rays.stop]
        return replace(
            self,
            start=self.start[rays.start : rays.stop + 1] - first,
            item=self.item[first:last],
            worth=self.worth[first:last],
            gates=self.gates[first:last],
            bits=self.bits[rays],
            harm=self.harm[rays],
        )

    def through(self, gate: np.ndarray) -> Coverage:
        """The table with only the given gate of each ray, (N,)."""
        rays = np.arange(len(gate))
        narrowed = replace(
            self,
            gates=self.gates >> gate.astype(np.uint8)[self.ray] & 1,
            bits=self.bits[rays, gate][:, None],
            harm=self.harm[rays, gate][:, None],
        )
        vars(narrowed).update(ray=self.ray, _order_by_item=self._order_by_item)  # the same entries in the same order
        return narrowed

    def grouped(self, groups: Sequence[np.ndarray]) -> Coverage:
        """The table whose candidates are groups of rays that fire together, each with the gate of the same number.

        The information of a group is that of its rays together; their bandwidth and harm add up.

        Arguments:
            groups: The rays of each; a ray may be in several groups, and repeated within one.
        """
        first = np.cumsum([0, *map(len, groups)])
        members = np.concatenate([np.zeros(0, dtype=np.intp), *groups]).astype(np.intp)
        begin = np.zeros(len(first), dtype=np.int64)
        kernels.group_entries(self.entries, first, members, self.shape[1], begin, False)
        item, worth, gates = kernels.group_entries(self.entries, first, members, self.shape[1], begin, True)
        bits, harm = (np.array([values[rays].sum(axis=0) for rays in groups]) for values in (self.bits, self.harm))
        return replace(self, start=begin, item=item, worth=worth, gates=gates, bits=bits, harm=harm)

    def with_losses(self, sensor: np.ndarray, sensors: int) -> Coverage:
        """The table whose F is half of this one's and half of its mean over the loss of each sensor.

        Every item has a copy for each loss, of many sensors for a few of them by turns, and one without a loss. A ray
        informs about all copies but that for the loss of its own sensor, whose harm is lost too.

        Arguments:
            sensor: The sensor of each ray, (N,).
            sensors: Their number.
        """
        losses = min(sensors, MOST_LOSSES)
        lost = (np.arange(len(self.weight))[:, None] + np.arange(losses)) % sensors
        lost = np.column_stack([lost, np.full(len(lost), -1)])
        informs = lost[self.item] != sensor[self.ray][:, None]
        copies = np.append(0, np.cumsum(informs.sum(axis=1)))
        number = (losses + 1) * self.item[:, None] + np.arange(losses + 1, dtype=np.int32)
        share = np.append(np.full(losses, LOSS_SHARE / losses), 1 - LOSS_SHARE)
        return replace(
            self,
            start=copies[self.start],
            item=number[informs],
            worth=np.repeat(self.worth, np.diff(copies)),
            gates=np.repeat(self.gates, np.diff(copies)),
            weight=(self.weight[:, None] * share).ravel(),
            harm=self.harm * (1 - LOSS_SHARE / sensors),
        )

    def known(self, gate: np.ndarray) -> np.ndarray:
        """The known worth of each item, (U,), by a choice of one gate per ray, -1 for none, (N,)."""
        known = np.empty(len(self.weight))
        kernels.know(self.entries, gate, known)
        return known

    def gains(self, known: np.ndarray) -> np.ndarray:
        """The gain in F of each gate of every ray, (N, G)."""
        gains = np.empty(self.shape)
        kernels.gate_gains(self.by_item, known, gains)
        return gains

    @cached_property
    def first_gains(self) -> np.ndarray:
        """The gain in F of each gate of every ray from the empty choice, (N, G)."""
        return self.gains(np.zeros(len(self.weight)))

    def value_of(self, gate: np.ndarray) -> float:
        """F of a choice of one gate per ray, -1 for none, (N,)."""
        return float(self.weight @ self.counted(self.known(gate)))

    def loss_of(self, gate: np.ndarray) -> float:
        """The loss of a choice: `complete` less its F."""
        return self.complete - self.value_of(gate)

    def counted(self, known: np.ndarray) -> np.ndarray:
        """phi of known worths or sums of worths, any shape."""
        return known if len(self.table) == 0 else np.interp(known, np.arange(len(self.table)), self.table)

    def charge(self, gate: np.ndarray) -> tuple[float, float]:
        """Bits [Mbit/s] and harm of a choice of one gate per ray, -1 for none, (N,)."""
        rays = np.flatnonzero(gate >= 0)
        return float(self.bits[rays, gate[rays]].sum()), float(self.harm[rays, gate[rays]].sum())


def gather(informed: Iterable[SceneInformation], gates_m: np.ndarray, bits: np.ndarray) -> Coverage:
    """The table over scenes of equal weight, with items renumbered.

    Arguments:
        informed: The task's information in each scene.
        gates_m: The gates of each ray, 8 at most, start included and end not, shape (N, G, 2) [m].
        bits: Bandwidth of a ray with each gate, inf for gates that are not allowed, (N, G) [Mbit/s].
    """
    rays, gates = bits.shape
    parts, weights, items, sums = [], [], 0, LARGEST
    harm, complete = np.zeros((rays, gates)), 0.0
    small = np.uint16 if rays <= np.iinfo(np.uint16).max else np.int32
    for scene in informed:
        passes = _passes(scene.range_m, scene.ray, gates_m)
        if scene.is_repeated:
            passes = _largest_alone(scene, passes, gates)
        heard = passes > 0
        # few bytes each, as there are many; small integers are sorted fast
        found = (scene.ray.astype(small), np.int32(items) + scene.item, scene.worth, passes)
        parts.append([values[heard] for values in found])
        spoils = _passes(scene.harm_range_m, scene.spoiling, gates_m)
        for gate in range(gates):
            harm[:, gate] += np.bincount(scene.spoiling, np.where(spoils >> gate & 1, scene.harm, 0.0), rays)
        weights.append(scene.weight)
        items, complete, sums = items + len(scene.weight), complete + scene.complete, scene.sums
    ray, *others = (np.concatenate(column) for column in zip(*parts, strict=True))
    parts.clear()  # they may be large
    order = np.argsort(ray, kind="stable")
    item, worth, opens = (column[order] for column in others)
    start, best = _begins(ray, rays), np.empty(items, dtype=np.int32)
    # items with the same best ray are numbered in a row: loops from rays to items then read neighbouring memory
    kernels.best_rays(start, item, worth, best)
    by_ray, number = np.argsort(best, kind="stable"), np.empty(items, dtype=np.int32)
    number[by_ray] = np.arange(items)
    return Coverage(
        start=start,
        item=number[item],
        worth=worth,
        gates=opens,
        weight=np.concatenate(weights)[by_ray] / len(weights),
        bits=bits,
        harm=harm / len(weights),
        table=sums,
        complete=complete / len(weights),
    )


def _begins(labels: np.ndarray, count: int) -> np.ndarray:
    """The first position of each of `count` labels in sorted order, and the end of the last, (count + 1,)."""
    return np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=count))])


def _passes(range_m: np.ndarray, ray: np.ndarray, gates_m: np.ndarray) -> np.ndarray:
    """One bit for each gate of the rays (N, G, 2) that lets the return of a ray (K,) at a range (K,) through, uint8."""
    passed = np.empty(len(range_m), dtype=np.uint8)
    kernels.gates_passed(range_m, ray, gates_m, passed)
    return passed


def _largest_alone(scene: SceneInformation, passes: np.ndarray, gates: int) -> np.ndarray:
    """The gates (E,) less those for which another frame has more worth of the same ray about the same item."""
    pair = scene.ray.astype(np.int64) * len(scene.weight) + scene.item
    order = np.lexsort((-scene.worth, pair))
    kept = np.zeros_like(passes)
    for gate in range(gates):
        through = order[passes[order] >> gate & 1 > 0]
        kept[through[np.unique(pair[through], return_index=True)[1]]] |= 1 << gate
    return kept
