"""Loops over the sparse table of what rays tell about items, compiled by numba.

Rays' entries lie one after another: those of ray r are `start[r]` to `start[r + 1]`. An entry says about which item a
return tells, how much (its worth), and by one bit per gate which gates of the ray let the return through.
What a choice knows about an item is one number: the largest worth of its entries, or their sum. `table` turns sums into
what they count, by linear pieces between whole numbers; a table of no length stands for the largest worth.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def counted(known: float, table: np.ndarray) -> float:
    """What a known worth counts: itself, or the concave table of sums at it."""
    last = len(table) - 1
    if last < 0:
        return known
    if known >= last:
        return table[last]
    knot = int(known)
    return table[knot] + (known - knot) * (table[knot + 1] - table[knot])


@njit(cache=True, nogil=True)
def gate_gains(
    rays: np.ndarray,
    start: np.ndarray,
    item: np.ndarray,
    worth: np.ndarray,
    gates: np.ndarray,
    weight: np.ndarray,
    table: np.ndarray,
    known: np.ndarray,
    gains: np.ndarray,
) -> None:
    """What each gate of the given rays would add to what is known: fills those rows of `gains`, shape (N, G)."""
    for ray in rays:
        gains[ray] = 0.0
        for entry in range(start[ray], start[ray + 1]):
            now = known[item[entry]]
            after = max(now, worth[entry]) if len(table) == 0 else now + worth[entry]
            if after > now:
                gain = weight[item[entry]] * (counted(after, table) - counted(now, table))
                for gate in range(gains.shape[1]):
                    if gates[entry] >> gate & 1:
                        gains[ray, gate] += gain


@njit(cache=True, nogil=True)
def learn_of(
    ray: int,
    gate: int,
    start: np.ndarray,
    item: np.ndarray,
    worth: np.ndarray,
    gates: np.ndarray,
    largest: bool,
    known: np.ndarray,
) -> None:
    """Adds to `known` what a ray tells through a gate."""
    for entry in range(start[ray], start[ray + 1]):
        if gates[entry] >> gate & 1:
            place = item[entry]
            known[place] = max(known[place], worth[entry]) if largest else known[place] + worth[entry]


@njit(cache=True, nogil=True)
def forget(
    ray: int,
    start: np.ndarray,
    item: np.ndarray,
    worth: np.ndarray,
    gates: np.ndarray,
    item_start: np.ndarray,
    entry_of: np.ndarray,
    ray_of: np.ndarray,
    chosen: np.ndarray,
    largest: bool,
    known: np.ndarray,
    touched: np.ndarray,
) -> None:
    """Recomputes `known` at a ray's items from the gates that are `chosen` (N,), -1 for none; marks the rays there."""
    for own in range(start[ray], start[ray + 1]):
        place = item[own]
        now = 0.0
        for index in range(item_start[place], item_start[place + 1]):
            entry = entry_of[index]
            other = ray_of[entry]
            touched[other] = True
            if chosen[other] >= 0 and gates[entry] >> chosen[other] & 1:
                now = max(now, worth[entry]) if largest else now + worth[entry]
        known[place] = now


@njit(cache=True, nogil=True)
def slopes_and_excess(
    start: np.ndarray,
    item: np.ndarray,
    worth: np.ndarray,
    gates: np.ndarray,
    weight: np.ndarray,
    threshold: np.ndarray,
    excess: np.ndarray,
) -> None:
    """By how much each gate's worths exceed the items' thresholds, weighted: fills `excess`, shape (N, G)."""
    excess[:] = 0.0
    for ray in range(len(start) - 1):
        for entry in range(start[ray], start[ray + 1]):
            over = worth[entry] - threshold[item[entry]]
            if over > 0:
                for gate in range(excess.shape[1]):
                    if gates[entry] >> gate & 1:
                        excess[ray, gate] += weight[item[entry]] * over


@njit(cache=True, nogil=True)
def count_exceeding(
    chosen: np.ndarray,
    start: np.ndarray,
    item: np.ndarray,
    worth: np.ndarray,
    gates: np.ndarray,
    threshold: np.ndarray,
    count: np.ndarray,
) -> None:
    """How many of the chosen rays exceed each item's threshold: fills `count`, shape (U,)."""
    count[:] = 0
    for ray in range(len(start) - 1):
        if chosen[ray] >= 0:
            for entry in range(start[ray], start[ray + 1]):
                if gates[entry] >> chosen[ray] & 1 and worth[entry] > threshold[item[entry]]:
                    count[item[entry]] += 1
