"""The nearest of some centres for each of many points, asked again and again while the centres move a little.

A point whose centre is nearer than any other can have become, by how far centres moved, is not asked about again
(G. Hamerly, Making k-means even faster, 2010). The answers are those of a search over all points.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.numerics import SLACK


class Nearest:
    """Points that are asked for their nearest centres.

    Arguments:
        points: Shape (N, F).
    """

    def __init__(self, points: np.ndarray) -> None:
        self._points = points
        self._centres = np.empty((0, points.shape[1]))
        self._labels = np.empty(0, dtype=np.int64)
        # how near any other centre may be
        self._others = np.empty(0)
        # rounding of distances; what is nearer together than this is always asked about
        self._slack = SLACK * float(np.ptp(points, axis=0).max(initial=0.0))

    def of(self, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The distance to the nearest centre, shape (N,), and its index, shape (N,), which may be changed.

        Arguments:
            centres: Shape (K, F).
        """
        if len(centres) == 1 or centres.shape != self._centres.shape:
            distance = self._search(centres)
        else:
            distance = self._bounded(centres)
        self._centres = centres.copy()
        return distance, self._labels.copy()

    def _bounded(self, centres: np.ndarray) -> np.ndarray:
        moved = np.sqrt(np.square(centres - self._centres).sum(axis=1))
        farthest = int(moved.argmax())
        others = np.full(len(centres), moved[farthest])
        # the centre that moved farthest is not among its own others
        others[farthest] = np.partition(moved, -2)[-2]
        self._others -= others[self._labels]
        distance = np.sqrt(np.square(self._points - centres[self._labels]).sum(axis=1))
        doubtful = np.flatnonzero(distance + self._slack >= self._others)
        if len(doubtful):
            found, labels = cKDTree(centres).query(self._points[doubtful], k=2)
            distance[doubtful], self._others[doubtful] = found.T
            self._labels[doubtful] = labels[:, 0]
        return distance

    def _search(self, centres: np.ndarray) -> np.ndarray:
        found, labels = cKDTree(centres).query(self._points, k=min(2, len(centres)))
        found, labels = found.reshape(len(found), -1), labels.reshape(len(labels), -1)
        self._labels, self._others = labels[:, 0].copy(), found[:, -1].copy()
        return found[:, 0]
