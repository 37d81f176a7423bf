"""Loops over the sparse table of the information of rays about items, compiled by numba.

Rays' entries lie one after another: those of ray r are `start[r]` to `start[r + 1]`. An entry has the item that a
return informs about, its worth, and one bit for each gate of the ray that lets the return through.
The known worth of an item is one number: the largest worth of the chosen entries, or their sum. `table` is phi of sums,
linear between whole numbers; an empty table stands for the largest worth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class ByRay(NamedTuple):
    """The entries of the table in the order of rays, and the weights of items.

    Arguments:
        start: The first entry of each ray, (N + 1,).
        item, worth, gates: Of each entry, (E,).
        weight: Of each item, (U,).
        table: phi of sums of worths, empty for the largest worth.
    """

    start: np.ndarray
    item: np.ndarray
    worth: np.ndarray
    gates: np.ndarray
    weight: np.ndarray
    table: np.ndarray


class ByItem(NamedTuple):
    """The same entries in the order of items, those of each item from the largest worth to the least.

    Where an item's largest worth counts, only the first of its entries exceed what is known of it.

    Arguments:
        start: The first entry of each item, (U + 1,).
        ray, worth, gates: Of each entry, (E,).
        weight, table: As of `ByRay`.
    """

    start: np.ndarray
    ray: np.ndarray
    worth: np.ndarray
    gates: np.ndarray
    weight: np.ndarray
    table: np.ndarray


@njit(cache=True, nogil=True)
def best_rays(start: np.ndarray, item: np.ndarray, worth: np.ndarray, best: np.ndarray) -> None:
    """Fill `best`, (U,), with the ray of the largest worth for each item, one beyond the last for none."""
    most = np.zeros(len(best), dtype=worth.dtype)
    best[:] = len(start) - 1
    for ray in range(len(start) - 1):
        for entry in range(start[ray], start[ray + 1]):
            if worth[entry] > most[item[entry]]:
                most[item[entry]], best[item[entry]] = worth[entry], ray


@njit(cache=True, nogil=True)
def order_by_item(item: np.ndarray, worth: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The order (E,) of entries by item, and by falling worth; those of each item begin at `start`, (U + 1,)."""
    order, place = np.empty(len(item), dtype=np.int64), start.copy()
    for entry in range(len(item)):
        order[place[item[entry]]] = entry
        place[item[entry]] += 1
    for index in range(len(start) - 1):
        own = order[start[index] : start[index + 1]]
        own[:] = own[np.argsort(-worth[own], kind="mergesort")]
    return order


@njit(cache=True, nogil=True)
def gates_passed(range_m: np.ndarray, ray: np.ndarray, gates_m: np.ndarray, passed: np.ndarray) -> None:
    """One bit for each gate of a ray, (N, G, 2) [m], that lets its return at a range through: fills `passed`, (K,)."""
    for index in range(len(range_m)):
        passed[index] = 0
        for gate in range(gates_m.shape[1]):
            if gates_m[ray[index], gate, 0] <= range_m[index] < gates_m[ray[index], gate, 1]:
                passed[index] |= 1 << gate


@njit(cache=True, nogil=True)
def counted(known: float, table: np.ndarray) -> float:
    """phi of a known worth: itself, or the concave table of sums at it."""
    last = len(table) - 1
    if last < 0:
        return known
    if known >= last:
        return table[last]
    knot = int(known)
    return table[knot] + (known - knot) * (table[knot + 1] - table[knot])


@njit(cache=True, nogil=True)
def gain(known: float, worth: float, table: np.ndarray) -> float:
    """The gain in phi by a further worth."""
    after = max(known, worth) if len(table) == 0 else known + worth
    return counted(after, table) - counted(known, table)


@njit(cache=True, nogil=True)
def gate_gains(items: ByItem, known: np.ndarray, gains: np.ndarray) -> None:
    """Fill `gains`, shape (N, G), with the weighted gain of each gate of every ray."""
    gains[:] = 0.0
    for place in range(len(known)):
        for index in range(items.start[place], items.start[place + 1]):
            more = items.weight[place] * gain(known[place], items.worth[index], items.table)
            if more > 0.0:
                for gate in range(gains.shape[1]):
                    if items.gates[index] >> gate & 1:
                        gains[items.ray[index], gate] += more
            elif len(items.table) == 0:
                break


@njit(cache=True, nogil=True)
def best_gate(
    gains: np.ndarray, cost: np.ndarray, bits: np.ndarray, may_fire: np.ndarray, room_mbps: float
) -> tuple[int, int, float]:
    """The ray of those that may fire (N,) and the gate, within bits, of the largest net gain, and it; -inf for none."""
    ray, gate, most = 0, 0, -np.inf
    for one in range(gains.shape[0]):
        if may_fire[one]:
            for other in range(gains.shape[1]):
                net = gains[one, other] - cost[one, other]
                if net > most and bits[one, other] <= room_mbps and bits[one, other] < np.inf:
                    ray, gate, most = one, other, net
    return ray, gate, most


@njit(cache=True, nogil=True)
def know(entries: ByRay, chosen: np.ndarray, known: np.ndarray) -> None:
    """Fill `known`, shape (U,), with the known worth of each item by chosen gates, -1 for none, (N,)."""
    known[:] = 0.0
    for ray in range(len(entries.start) - 1):
        if chosen[ray] < 0:
            continue
        for entry in range(entries.start[ray], entries.start[ray + 1]):
            if entries.gates[entry] >> chosen[ray] & 1:
                place, worth = entries.item[entry], entries.worth[entry]
                known[place] = known[place] + worth if len(entries.table) else max(known[place], worth)


@njit(cache=True, nogil=True)
def change_choice(
    ray: int,
    gate: int,
    adding: bool,
    entries: ByRay,
    items: ByItem,
    chosen: np.ndarray,
    known: np.ndarray,
    gains: np.ndarray,
) -> None:
    """Add a ray with a gate, or remove it, and update the known worths (U,) and the gains of all gates (N, G).

    `chosen` holds the gates of the other rays, -1 for none, (N,). Only items whose known worth changes are followed
    to their rays.
    """
    sums = len(entries.table) > 0
    for own in range(entries.start[ray], entries.start[ray + 1]):
        if not entries.gates[own] >> gate & 1:
            continue
        place = entries.item[own]
        old = known[place]
        first, last = items.start[place], items.start[place + 1]
        if sums:
            new = old + entries.worth[own] if adding else max(old - entries.worth[own], 0.0)
        elif adding:
            new = max(old, entries.worth[own])
        elif entries.worth[own] < old:
            continue
        else:
            new = 0.0
            for index in range(first, last):
                other = chosen[items.ray[index]]
                if other >= 0 and items.gates[index] >> other & 1:
                    new = items.worth[index]
                    break
        if new == old:
            continue
        known[place] = new
        if sums and counted(min(old, new), entries.table) == entries.table[-1]:
            continue
        for index in range(first, last):
            if not sums and items.worth[index] <= min(old, new):
                break
            more = gain(new, items.worth[index], entries.table) - gain(old, items.worth[index], entries.table)
            if more != 0.0:
                for other in range(gains.shape[1]):
                    if items.gates[index] >> other & 1:
                        gains[items.ray[index], other] += entries.weight[place] * more


@njit(cache=True, nogil=True)
def weigh_excess(items: ByItem, weight: np.ndarray, threshold: np.ndarray, excess: np.ndarray) -> None:
    """Fill `excess`, shape (N, G), with the weighted excess of each gate's worths over the items' thresholds."""
    excess[:] = 0.0
    for place in range(len(threshold)):
        for index in range(items.start[place], items.start[place + 1]):
            over = items.worth[index] - threshold[place]
            if over <= 0:
                break
            for gate in range(excess.shape[1]):
                if items.gates[index] >> gate & 1:
                    excess[items.ray[index], gate] += weight[place] * over


@njit(cache=True, nogil=True)
def count_exceeding(entries: ByRay, chosen: np.ndarray, threshold: np.ndarray, count: np.ndarray) -> None:
    """Fill `count`, shape (U,), with the number of chosen rays whose worth exceeds each item's threshold."""
    count[:] = 0
    for ray in range(len(entries.start) - 1):
        if chosen[ray] >= 0:
            for entry in range(entries.start[ray], entries.start[ray + 1]):
                if entries.gates[entry] >> chosen[ray] & 1 and entries.worth[entry] > threshold[entries.item[entry]]:
                    count[entries.item[entry]] += 1


@njit(cache=True, nogil=True)
def group_entries(
    entries: ByRay, first: np.ndarray, members: np.ndarray, gates: int, start: np.ndarray, fills: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The entries of groups of rays, one for each distinct worth of a group's gates about an item.

    Arguments:
        entries: Those of the rays.
        first, members: The first member of each group, (M + 1,), and all groups' rays.
        gates: Number of gates per ray.
        start: The first entry of each group, (M + 1,); filled unless `fills`.
        fills: Whether to return the entries; else only `start` is filled.

    Returns:
        Item, worth and gates of each entry, empty unless `fills`.
    """
    count = start[-1] if fills else 0
    item, worth = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.float32)
    opens = np.empty(count, dtype=np.uint8)
    told = np.zeros((len(entries.weight), gates))
    touched, is_touched = np.empty(len(told), dtype=np.int32), np.zeros(len(told), dtype=np.bool_)
    place, last = 0, float(len(entries.table) - 1)
    for group in range(len(first) - 1):
        if not fills:
            start[group] = place
        many = 0
        for ray in members[first[group] : first[group + 1]]:
            for entry in range(entries.start[ray], entries.start[ray + 1]):
                about = entries.item[entry]
                if not is_touched[about]:
                    is_touched[about], touched[many] = True, about
                    many += 1
                for gate in range(gates):
                    if entries.gates[entry] >> gate & 1:
                        old, more = told[about, gate], entries.worth[entry]
                        # beyond its end the table is constant: capping changes no F and tightens bounds
                        told[about, gate] = min(old + more, last) if last >= 0 else max(old, more)
        for about in touched[:many]:
            for gate in range(gates):
                largest = told[about, gate]
                if largest > 0.0:
                    bit = 0
                    for other in range(gate, gates):
                        if told[about, other] == largest:
                            bit |= 1 << other
                            told[about, other] = 0.0
                    if fills:
                        item[place], worth[place], opens[place] = about, largest, bit
                    place += 1
            is_touched[about] = False
    if not fills:
        start[-1] = place
    return item, worth, opens


@njit(cache=True, nogil=True)
def gather_parts(
    entries: ByRay, range_m: np.ndarray, first: np.ndarray, members: np.ndarray, gate_m: np.ndarray, told: np.ndarray
) -> None:
    """Worth of parts about each item: the largest of their rays' returns inside their gates, or the sum.

    Arguments:
        entries: Those of the rays.
        range_m: The range of each entry's return, (E,) [m].
        first, members: The first member of each part, (M + 1,), and all parts' rays.
        gate_m: Of each part, (M, 2) [m].
        told: Filled, (M, U).
    """
    told[:] = 0.0
    for part in range(len(first) - 1):
        low, high = gate_m[part]
        for ray in members[first[part] : first[part + 1]]:
            for entry in range(entries.start[ray], entries.start[ray + 1]):
                if low <= range_m[entry] < high:
                    old, more = told[part, entries.item[entry]], entries.worth[entry]
                    told[part, entries.item[entry]] = old + more if len(entries.table) else max(old, more)
