"""Pearson's test of draws against a density that is integrated over the cells of a grid, as renderers test samplers."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

# cells with fewer expected draws are pooled: below, Pearson's statistic is not distributed as chi-square
SMALLEST_EXPECTED = 5.0
# a right sampler with a fixed seed fails once in ten thousand seeds, and then always
UNLIKELY = 1e-4


def pooled(observed, expected, smallest=SMALLEST_EXPECTED):
    """Counts and expectations (C,) with the rarest cells pooled until each expects at least `smallest` draws."""
    order = np.argsort(np.ravel(expected), kind="stable")
    pools = [[0.0, 0.0]]
    for count, mean in zip(np.ravel(observed)[order], np.ravel(expected)[order], strict=True):
        if pools[-1][1] >= smallest:
            pools.append([0.0, 0.0])
        pools[-1][0] += count
        pools[-1][1] += mean
    if len(pools) > 1 and pools[-1][1] < smallest:
        rest = pools.pop()
        pools[-1] = [pools[-1][0] + rest[0], pools[-1][1] + rest[1]]
    return np.array(pools).T


def p_value(observed, expected, smallest=SMALLEST_EXPECTED):
    """How likely draws of the expected density are at least as far from it, 0 to 1.

    Arguments:
        observed: Draws by cell, any shape.
        expected: Their expectations, the same shape; a draw where nothing is expected is impossible.
        smallest: Of a pool's expectation.
    """
    observed, expected = np.ravel(observed), np.ravel(expected)
    if observed[expected <= 0].any():
        return 0.0
    counts, means = pooled(observed[expected > 0], expected[expected > 0], smallest)
    if len(means) < 2:
        raise ValueError("fewer than two cells: a test that cannot fail")
    return float(chi2.sf(np.sum(np.square(counts - means) / means), len(means) - 1))


def grid_points(edges, inside):
    """Midpoints of `inside` parts per axis and cell, (P, k), and the cell of each, (P,): edges are one array per axis.

    Midpoints are exact for straight lines, and never on an edge where a density may jump.
    """
    axes, cells, count = [], [], 1
    for edge in edges:
        share = (np.arange(inside) + 0.5) / inside
        axes.append((edge[:-1, None] + share * np.diff(edge)[:, None]).ravel())
        cells.append(np.repeat(np.arange(len(edge) - 1), inside))
    points = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    places = [axis.ravel() for axis in np.meshgrid(*cells, indexing="ij")]
    flat = np.zeros(len(points), dtype=int)
    for edge, place in zip(reversed(edges), reversed(places), strict=True):
        flat += count * place
        count *= len(edge) - 1
    return points, flat


def mass_of_cells(density, edges, inside):
    """Integrals of a density over the cells of a grid, flat: density takes (P, k) and gives (P,)."""
    points, cell = grid_points(edges, inside)
    sizes = np.ones(1)
    for edge in edges:
        sizes = np.multiply.outer(sizes, np.diff(edge)).ravel()
    return np.bincount(cell, density(points), minlength=len(sizes)) / inside ** len(edges) * sizes


def counts_of_cells(draws, edges):
    """How many draws (N, k) lie in the cells of a grid, flat; every one has to lie in the grid."""
    counts = np.histogramdd(draws, edges)[0].ravel()
    if counts.sum() != len(draws):
        raise ValueError(f"{len(draws) - int(counts.sum())} draws lie outside the grid")
    return counts
