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
def gain(known: float, worth: float, table: np.ndarray) -> float:
    """What a further worth adds to what is known."""
    after = max(known, worth) if len(table) == 0 else known + worth
    return counted(after, table) - counted(known, table)


@njit(cache=True, nogil=True)
def gate_gains(
    start: np.ndarray,
    item: np.ndarray,
    worth: np.ndarray,
    gates: np.ndarray,
    weight: np.ndarray,
    table: np.ndarray,
    known: np.ndarray,
    gains: np.ndarray,
) -> None:
    """What each gate of every ray would add to what is known: fills `gains`, shape (N, G)."""
    gains[:] = 0.0
    for ray in range(len(start) - 1):
        for entry in range(start[ray], start[ray + 1]):
            more = weight[item[entry]] * gain(known[item[entry]], worth[entry], table)
            if more > 0.0:
                for gate in range(gains.shape[1]):
                    if gates[entry] >> gate & 1:
                        gains[ray, gate] += more


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
def change_choice(
    ray: int,
    gate: int,
    adding: bool,
    start: np.ndarray,
    item: np.ndarray,
    worth: np.ndarray,
    gates: np.ndarray,
    weight: np.ndarray,
    table: np.ndarray,
    item_start: np.ndarray,
    item_ray: np.ndarray,
    item_worth: np.ndarray,
    item_gates: np.ndarray,
    chosen: np.ndarray,
    known: np.ndarray,
    gains: np.ndarray,
) -> None:
    """Adds a ray through a gate, or takes it out; keeps what is known (U,) and what all gates would add (N, G) true.

    `chosen` holds the gates of the other rays, -1 for none, (N,). Only items of which something else is known
    afterwards are followed to the rays that tell of them.
    """
    for own in range(start[ray], start[ray + 1]):
        if not gates[own] >> gate & 1:
            continue
        place = item[own]
        old = known[place]
        first, last = item_start[place], item_start[place + 1]
        if len(table) > 0:
            new = old + worth[own] if adding else max(old - worth[own], 0.0)
        elif adding:
            new = max(old, worth[own])
        elif worth[own] < old:
            continue
        else:
            new = 0.0
            for index in range(first, last):
                other = chosen[item_ray[index]]
                if other >= 0 and item_gates[index] >> other & 1:
                    new = max(new, item_worth[index])
        if new == old:
            continue
        known[place] = new
        for index in range(first, last):
            more = gain(new, item_worth[index], table) - gain(old, item_worth[index], table)
            if more != 0.0:
                for other in range(gains.shape[1]):
                    if item_gates[index] >> other & 1:
                        gains[item_ray[index], other] += weight[place] * more


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
