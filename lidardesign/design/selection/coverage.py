"""What every candidate ray tells about every item of many scenes, as one sparse table.

A candidate is a ray with one of a few gates. Items are what scenes ask about: points of a visible surface, frames of
a track, bodies. The worth of a choice S is F(S) = sum_u w_u phi_u(S), where phi is the largest worth of the returns
that S hears of item u (facility location), or a concave table of their sum. Both are monotone and submodular
(Nemhauser, Wolsey and Fisher 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from lidardesign.design.selection import kernels
from lidardesign.errors import DataError

MOST_GATES = 8  # of a ray: an entry keeps one bit for each
LARGEST = np.zeros(0)  # the table of items that count the largest worth


@dataclass(frozen=True, eq=False)
class Information:
    """What the returns of a scene tell, as a task's `informs` says it: E pairs of a ray and an item.

    Arguments:
        ray: Which ray, int (E,).
        item: Which of the scene's items, int (E,).
        range_m: The range of the return that tells it, (E,).
        worth: How much it tells, at least 0, (E,).
        weight: What each of the items counts, at least 0, (U,).
        harm: What each ray's returns spoil, at least 0, in the unit of worth, (N,).
    """

    ray: np.ndarray
    item: np.ndarray
    range_m: np.ndarray
    worth: np.ndarray
    weight: np.ndarray
    harm: np.ndarray


@dataclass(frozen=True, eq=False)
class Coverage:
    """All candidates beside all items, with prices.

    Arguments:
        start: Where the entries of each ray begin, (N + 1,).
        item: The item of each entry, (E,).
        worth: Its worth, float32 (E,).
        gates: One bit for each gate of the ray that lets the return through, uint8 (E,).
        weight: What items count; they sum to 1, (U,).
        bits: What reading a ray out through each gate costs [Mbit/s], inf for a gate that is not allowed, (N, G).
        harm: What a ray spoils through each gate, in the unit of worth, (N, G).
        table: The concave table of sums, 0 at 0, or `LARGEST`.
    """

    start: np.ndarray
    item: np.ndarray
    worth: np.ndarray
    gates: np.ndarray
    weight: np.ndarray
    bits: np.ndarray
    harm: np.ndarray
    table: np.ndarray = field(default_factory=lambda: LARGEST)

    def __post_init__(self) -> None:
        """Raises `DataError` where the table of sums is not concave, nondecreasing and 0 at 0."""
        rises = np.diff(self.table)
        if len(self.table) and (self.table[0] != 0 or (rises < 0).any() or (np.diff(rises) > 0).any()):
            raise DataError(
                f"the table of sums is {np.array2string(self.table)}",
                where="informs",
                allowed="0 at 0, never falling, and never rising faster than before",
            )

    @property
    def shape(self) -> tuple[int, int]:
        """How many rays, and how many gates each has."""
        return self.bits.shape

    @cached_property
    def by_item(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where each item's entries begin (U + 1,), the entries in that order (E,), and the ray of each entry (E,)."""
        order = np.argsort(self.item, kind="stable")
        begin = np.searchsorted(self.item[order], np.arange(len(self.weight) + 1))
        return begin, order, np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def known(self, gate: np.ndarray) -> np.ndarray:
        """What a choice of one gate per ray, -1 for none, (N,), knows about each item, (U,)."""
        known = np.zeros(len(self.weight))
        for ray in np.flatnonzero(gate >= 0):
            self.learn_of(int(ray), int(gate[ray]), known)
        return known

    def learn_of(self, ray: int, gate: int, known: np.ndarray) -> None:
        """Adds to `known` (U,) what a ray tells through a gate."""
        kernels.learn_of(ray, gate, self.start, self.item, self.worth, self.gates, len(self.table) == 0, known)

    def gains(self, rays: np.ndarray, known: np.ndarray, gains: np.ndarray) -> None:
        """Fills the rows `rays` of `gains` (N, G) with what each gate of these rays would add to F."""
        kernels.gate_gains(rays, self.start, self.item, self.worth, self.gates, self.weight, self.table, known, gains)

    def worth_of(self, gate: np.ndarray) -> float:
        """F of a choice of one gate per ray, -1 for none, (N,)."""
        return float(self.weight @ self.counted(self.known(gate)))

    def counted(self, known: np.ndarray) -> np.ndarray:
        """What known worths count, any shape."""
        return known if len(self.table) == 0 else np.interp(known, np.arange(len(self.table)), self.table)

    def charge(self, gate: np.ndarray) -> tuple[float, float]:
        """Bits [Mbit/s] and harm of a choice of one gate per ray, -1 for none, (N,)."""
        rays = np.flatnonzero(gate >= 0)
        return float(self.bits[rays, gate[rays]].sum()), float(self.harm[rays, gate[rays]].sum())


def gather(
    scenes: Sequence[Information],
    gates_m: np.ndarray,
    bits: np.ndarray,
    table: np.ndarray = LARGEST,
) -> Coverage:
    """The table over scenes, each of which counts as much as any other.

    Arguments:
        scenes: What the returns of each scene tell about its items.
        gates_m: The gates of each ray, each from a start to before an end, shape (N, G, 2).
        bits: What reading out costs, shape (N, G) [Mbit/s].
        table: See `Coverage`.

    Raises:
        DataError: No scene; more gates than an entry has bits; worths or weights that are negative or no numbers.
    """
    count, choices = bits.shape
    if not scenes or choices > MOST_GATES:
        raise DataError(
            f"{len(scenes)} scenes and {choices} gates per ray",
            where="selection",
            allowed=f"1 scene or more, at most {MOST_GATES} gates",
        )
    for scene in scenes:
        _require_valid(scene, count)
    first_item = np.cumsum([0, *(len(scene.weight) for scene in scenes)])
    ray = np.concatenate([scene.ray for scene in scenes])
    item = np.concatenate([scene.item + first for scene, first in zip(scenes, first_item, strict=False)])
    range_m = np.concatenate([scene.range_m for scene in scenes])
    worth = np.concatenate([scene.worth for scene in scenes])
    heard = (range_m[:, None] >= gates_m[ray, :, 0]) & (range_m[:, None] < gates_m[ray, :, 1])
    passes = np.packbits(heard, axis=1, bitorder="little")[:, 0]
    tells = np.flatnonzero((passes > 0) & (worth > 0))
    tells = tells[np.argsort(ray[tells], kind="stable")]
    weight = np.concatenate([scene.weight / max(scene.weight.sum(), np.finfo(float).tiny) for scene in scenes])
    harm = np.mean([scene.harm for scene in scenes], axis=0)
    return Coverage(
        start=np.searchsorted(ray[tells], np.arange(count + 1)),
        item=item[tells].astype(np.int32),
        worth=worth[tells].astype(np.float32),
        gates=passes[tells],
        weight=weight / len(scenes),
        bits=bits,
        harm=np.repeat(harm[:, None], choices, axis=1),
        table=table,
    )


def _require_valid(scene: Information, rays: int) -> None:
    numbers = (scene.worth, scene.weight, scene.harm)
    if not all(np.isfinite(values).all() and (values >= 0).all() for values in numbers):
        raise DataError("worths, weights and harm must be finite and not negative", where="informs")
    pairs = len(scene.ray)
    if not (len(scene.item) == len(scene.worth) == len(scene.range_m) == pairs and len(scene.harm) == rays):
        raise DataError("arrays of pairs must have one length, and harm one number per ray", where="informs")
    names = ((scene.ray, rays), (scene.item, len(scene.weight)))
    if pairs and not all(index.min() >= 0 and index.max() < count for index, count in names):
        raise DataError("pairs name rays and items that there are not", where="informs")
