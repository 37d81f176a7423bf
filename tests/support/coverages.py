"""Random tables of what rays tell about items, and their best choices by a solver."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from lidardesign.rays.coverage import LARGEST, Coverage, SceneInformation, gather
from lidardesign.task import Information

SUMS = np.array([0.0, 1.0, 1.6, 1.9, 2.0])


def scene_of(generator, rays, items, pairs, table):
    """What a random scene's returns tell; no ray tells of an item twice."""
    pair = generator.choice(rays * items, size=min(pairs, rays * items), replace=False)
    ray, item = np.divmod(pair, items)
    worth = generator.uniform(0, 1, len(pair))
    weight, frame = generator.uniform(0.5, 1, items), np.zeros(items, dtype=int)
    sums = None if len(table) == 0 else table
    returns = SimpleNamespace(range_m=generator.uniform(1, 2, rays))
    information = Information(ray, item, worth, frame, weight, sums=sums, complete=max(table, default=1.0))
    return SceneInformation.of(information, [returns])


def small(seed, rays=7, gates=2, items=12, scenes=3, table=LARGEST, harm=0.0):
    """A random table of candidates: the first gate of each ray is open, others are narrower and cheaper."""
    generator = np.random.default_rng(seed)
    gates_m = np.sort(generator.uniform(1, 2, (rays, gates, 2)), axis=2)
    gates_m[:, 0] = (0.0, 3.0)
    informed = [scene_of(generator, rays, items, 30, table) for _ in range(scenes)]
    coverage = gather(informed, gates_m, gates_m[:, :, 1] - gates_m[:, :, 0])
    return Coverage(**{**vars(coverage), "harm": harm * generator.uniform(0, 1, coverage.shape)})


def relaxed_by_highs(coverage, count, price, integral, *, full=False):
    """At most `count` rays of one sensor, or so many, as a program: gates x, and who serves each item y <= x."""
    rays, gates = coverage.shape
    ray_of = coverage.ray
    pairs = [(e, g) for e in range(len(coverage.item)) for g in range(gates) if coverage.gates[e] >> g & 1]
    chosen, served = rays * gates, len(pairs)
    gain = [-float(coverage.weight[coverage.item[e]] * coverage.worth[e]) for e, _ in pairs]
    cost = np.concatenate([(price * coverage.bits + coverage.harm).ravel(), gain])
    rows, columns, values = [], [], []
    for n, (e, g) in enumerate(pairs):
        rows += [n, n]
        columns += [chosen + n, ray_of[e] * gates + g]
        values += [1.0, -1.0]
    for n, (e, _) in enumerate(pairs):
        rows.append(served + coverage.item[e])
        columns.append(chosen + n)
        values.append(1.0)
    items = len(coverage.weight)
    for ray in range(rays):
        rows += [served + items + ray] * gates
        columns += [ray * gates + g for g in range(gates)]
        values += [1.0] * gates
    last = served + items + rays
    rows += [last] * chosen
    columns += list(range(chosen))
    values += [1.0] * chosen
    most = np.concatenate([np.zeros(served), np.ones(items + rays), [count]])
    matrix = coo_array((values, (rows, columns)), shape=(last + 1, chosen + served)).tocsr()
    whole = np.concatenate([np.full(chosen, int(integral)), np.zeros(served)])
    least = np.where(np.arange(last + 1) == last, count if full else 0, -np.inf)
    result = milp(cost, constraints=LinearConstraint(matrix, least, most), bounds=Bounds(0, 1), integrality=whole)
    return -float(result.fun)
