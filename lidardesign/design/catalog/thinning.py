"""Evenly spread subsets of a fixed set of directions: what a part can do with fewer rays than it has."""

from __future__ import annotations

import numpy as np

from lidardesign.errors import ConfigError


def thinned(points: np.ndarray, count: int) -> np.ndarray:
    """Indices, ascending, of `count` of the points that lie evenly among them: (M, K) to int64 (count,).

    The points are halved along their longest extent until as many groups as wanted are left, each with the same
    number of points but for one; of each the point nearest to its centre stays. Deterministic, and O(M log M).

    Raises:
        ConfigError: More are wanted than there are.
    """
    if not 0 <= count <= len(points):
        raise ConfigError(f"{count} of {len(points)} rays", where="rays", allowed=f"0 to {len(points)}")
    if count == len(points):
        return np.arange(count)
    kept: list[int] = []
    groups = [(np.arange(len(points)), count)] if count else []
    while groups:
        members, wanted = groups.pop()
        inside = points[members]
        if wanted == 1:
            kept.append(int(members[np.square(inside - inside.mean(axis=0)).sum(axis=1).argmin()]))
            continue
        # to so many digits, so that rounding does not choose among equal extents and positions
        axis = np.round(np.ptp(inside, axis=0), 9).argmax()
        order = members[np.argsort(np.round(inside[:, axis], 9), kind="stable")]
        first = wanted // 2
        cut = int(np.clip(round(len(order) * first / wanted), first, len(order) - (wanted - first)))
        groups += [(order[:cut], first), (order[cut:], wanted - first)]
    return np.sort(np.array(kept, dtype=np.int64))
