r"""Light that the spots of other rays send to a ray's own, where a flood lights all of them at once.

All rays have the same power. Ray j lights a spot Q at the distance R_j, which sends rho_Q of it on; a spot P of the
area A, seen by pixel i, gets rho_Q cos cos A / (pi d^2) of what its own ray gives it, late by (R_j + d - R_i) / 2 of
half path. Further bounces bring at most 1 / (1 - rho) times as much in all, rho the largest reflectance (energy is
kept; a geometric series). Whether anything stands between the spots is not asked, and beams are taken to end on them:
where only part of a wide beam does, its own light is weaker than is said here.
"""

from __future__ import annotations

import math

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.simulate.bounds.sight import Sight

MOST_POINTS, AT_ONCE = 64, 8
# Bounces between white walls all around never end; a share this close to 1 stands for theirs.
WHITEST = 0.999


def moved_by_spots_m(sight: Sight) -> np.ndarray:
    """How far light from the spots of the same list moves ranges, for some rays of each list, shape (K,) [m]."""
    found = [np.zeros(1)]
    for row in np.unique(sight.row[sight.returned]):
        rays = np.flatnonzero((sight.row == row) & (sight.hits.body >= 0))
        own = np.flatnonzero((sight.row == row) & sight.returned)
        own = own[np.unique(np.linspace(0, len(own) - 1, MOST_POINTS).astype(int))]
        # a few at a time, so that memory stays small beside long lists
        found += [_moved_m(sight, some, rays) for some in np.array_split(own, max(len(own) // AT_ONCE, 1))]
    return np.concatenate(found)


def _moved_m(sight: Sight, own: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Of spots `own` by those of `rays`, all of one list, shape (len(own),) [m]."""
    place = sight.rays.origin_m + sight.range_m[:, None] * sight.rays.direction
    reflectance = np.array([body.reflectance for body in sight.scene.bodies])[sight.hits.body[rays]]
    photons, half_rad = sight.detector.photons, sight.detector.divergence_rad / 2
    pixel_sr = max(photons.field_of_view_sr, math.pi * half_rad**2)
    area_m2 = (pixel_sr * sight.range_m**2 / sight.cosine)[own, None]
    between = place[rays] - place[own, None]
    apart_m = np.linalg.norm(between, axis=2)
    leaving = np.maximum(np.einsum("ikx,ix->ik", between, sight.hits.normal[own]), 0.0)
    facing = np.maximum(-np.einsum("ikx,kx->ik", between, sight.hits.normal[rays]), 0.0)
    share = reflectance * np.minimum(safe_divide(leaving * facing * area_m2, math.pi * apart_m**4), 1.0)
    late_m = np.abs(sight.range_m[rays] + apart_m - sight.range_m[own, None]) / 2
    near = late_m < sight.resolution_m
    whitest = min(max(body.reflectance for body in sight.scene.bodies), WHITEST)
    return np.minimum((share * late_m * near).sum(axis=1) / (1 - whitest), sight.resolution_m)
