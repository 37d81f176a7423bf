"""What rays meet: the first hit of each, or all surfaces along them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of N rays.

    Arguments:
        range_m: Distance along the ray [m], infinite on a miss, shape (N,).
        body: Index into the scene's bodies, -1 on a miss, shape (N,).
        normal: Unit surface normal facing the ray's origin, zero on a miss, shape (N, 3).
    """

    range_m: np.ndarray
    body: np.ndarray
    normal: np.ndarray


class Crossings(NamedTuple):
    """All surfaces that rays pass, as flat lists: ray (K,), range (K,) [m], |cosine| with the normal (K,)."""

    row: np.ndarray
    range_m: np.ndarray
    cosine: np.ndarray
