"""Faces of a mesh that run around it the same way: what is told from edges alone, and by how much they disagree."""

from __future__ import annotations

import numpy as np


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each distinct row (N, K) stands first, in their order, and which of these each row is, (U,) and (N,).

    As `numpy.unique` along an axis, which takes minutes for the faces of a large scan.
    """
    order = np.lexsort(rows.T[::-1])
    is_new = np.ones(len(rows), dtype=bool)
    is_new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    group = np.empty(len(rows), dtype=np.int64)
    group[order] = np.cumsum(is_new) - 1
    return order[is_new], group


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which edge each side of faces (F, 3) is and whether it runs upwards, (3 F,), and the faces per edge (E,)."""
    start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    # one number per edge: pairs of int32 fit into an int64
    number = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    _, edge, count = np.unique(number, return_inverse=True, return_counts=True)
    return edge.reshape(-1), start < end, count


def edge_defects(faces: np.ndarray) -> tuple[int, int]:
    """How many edges are open, and how many join faces that run along them the same way.

    An edge is open when an odd number of faces meets there. Where closed parts touch, four faces share an
    edge, two in each direction: that is no defect.
    """
    edge, upwards, count = _edges(faces)
    balance = np.bincount(edge, weights=np.where(upwards, 1.0, -1.0))
    is_open = count % 2 == 1
    return int(is_open.sum()), int((~is_open & (balance != 0)).sum())


def turned_to_agree(faces: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces (F, 3) of which those that disagree with their neighbours are turned, and how many those are.

    Two faces that alone share an edge agree when they run along it in opposite directions. Within a part that such
    edges hold together, the orientation of the larger area stays; a part that has none, as a Moebius strip, stays as
    it is.

    Arguments:
        faces: Vertex indices, shape (F, 3).
        areas: Of the faces, in any unit, shape (F,).
    """
    first, second, agree = _neighbours(faces)
    side = _sides(len(faces), first, second, agree)
    if side is None:
        return faces, 0
    part, flipped = side
    # the sheet of less area is turned
    share = np.bincount(part, weights=np.where(flipped, areas, -areas))
    turn = flipped ^ (share[part] > 0)
    return np.where(turn[:, None], faces[:, ::-1], faces), int(turn.sum())


def _neighbours(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of faces that alone share an edge, and whether they run along it in opposite directions, (P,) each."""
    edge, upwards, count = _edges(faces)
    order = np.argsort(edge, kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])[count == 2]
    one, other = order[starts], order[starts + 1]
    return one // 3, other // 3, upwards[one] != upwards[other]


def _sides(
    count: int, first: np.ndarray, second: np.ndarray, agree: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The part of each face and whether it lies on the other side than the part's first face; None if none turns.

    Every face stands twice in a graph, once as it is and once turned (the orientation double cover): a part whose
    two copies hang together cannot be oriented, and keeps its faces.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if agree.all():
        return None
    across = np.where(agree, 0, count)
    rows = np.concatenate([first, first + count])
    columns = np.concatenate([second + across, (second + count) - across])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    sheet = connected_components(graph, directed=False)[1]
    part = np.minimum(sheet[:count], sheet[count:])
    one_sided = sheet[:count] == sheet[count:]
    return part, (sheet[:count] != part) & ~one_sided
