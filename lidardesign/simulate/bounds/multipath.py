r"""Light that comes back by way of other surfaces: later, and weaker by each bounce.

From points P that rays meet, other surfaces Q are looked for in directions even in the cosine; those that meet one are
the form factor F. Relative to its direct echo, P gets through Q, a distance d away,

- of a flood, or for one receiver that hears all: rho_Q E_Q / E_P, the light on Q over that on P, late by
  (R_Q + d - R_P) / 2 of half path;
- where one spot of radius s at a time is lit and seen: rho_Q (s / d)^2, at most rho_Q, the share that falls on the spot
  again or leaves Q within it, late by d,

and as much again by further bounces, 1 / (1 - rho F) in all (energy is kept; a geometric series). What is late by more
than the detector tells apart makes its own peak, and is taken for the echo at most where all of it outweighs that; what
is late by less moves the echo by its delay times its share.

An estimate where light is gathered in a place that none of the points is near to; that Q is lit is not checked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scene import Mesh, Scene
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.sight import FLATTEST_COSINE, Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays

MOST_POINTS, DIRECTIONS = 96, 48
# Directions start this share of a range above the surface that they leave.
CLEARANCE = 1e-4
GOLDEN_TURN = math.pi * (3 - math.sqrt(5))


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why no light can go from one surface to another, if so."""
    if len(scene.bodies) == 1 and not isinstance(scene.bodies[0].shape, Mesh):
        return "one convex body lights nothing else"
    if not detector.bin_s and not detector.pulse_sigma_s:
        return "later light is told apart from the first echo"
    if max(body.reflectance for body in scene.bodies) == 0:
        return "nothing reflects"
    return None


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of light that is late, the same for all rays: as its rms over points."""
    rows = np.flatnonzero(sight.returned)
    if not len(rows):
        return sight.nothing("no ray returns")
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_POINTS).astype(int))]
    share, late_m, filled = _late_light(sight, rows)
    near = late_m < sight.resolution_m
    moved_m = np.minimum((share * late_m * near).sum(axis=1), sight.width_m[rows])
    outweighed = (share * ~near).sum(axis=1) > 1
    size = np.ones(len(sight))
    reason = f"surfaces fill {filled:.2g} of what others see; late light is {100 * share.sum(axis=1).mean():.2g} %"
    return Stake(size * np.mean(moved_m**2), np.where(sight.returned, outweighed.mean(), 0.0), reason)


def _late_light(sight: Sight, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Of points P: shares (P, K) of their direct echo by way of each direction, delays (P, K) [m], and F."""
    rays, hits = sight.rays, sight.hits
    point = rays.origin_m[rows] + sight.range_m[rows, None] * rays.direction[rows]
    start = point + CLEARANCE * sight.range_m[rows, None] * hits.normal[rows]
    looking = _around(hits.normal[rows])
    found = sight.caster.first_hit(np.repeat(start, DIRECTIONS, axis=0), looking.reshape(-1, 3))
    met = (found.body >= 0).reshape(-1, DIRECTIONS)
    away_m = np.where(met, found.range_m.reshape(-1, DIRECTIONS), np.inf)
    reflectance = np.array([*(body.reflectance for body in sight.scene.bodies), 0.0])
    filled = float(met.mean())
    bounces = 1 / max(1 - reflectance.max() * filled, FLATTEST_COSINE)
    each = bounces * reflectance[found.body].reshape(met.shape) / DIRECTIONS
    if _one_spot(sight):
        photons = sight.detector.photons
        angle_rad = max(sight.detector.divergence_rad / 2, math.sqrt(photons.field_of_view_sr / math.pi))
        spot_m = angle_rad * sight.range_m[rows, None]
        return each * np.minimum(spot_m / away_m, 1.0) ** 2, np.where(met, away_m, 0.0), filled
    away_m = np.where(met, away_m, 0.0)
    other = start[:, None] + away_m[..., None] * looking
    lit_m = np.linalg.norm(other - rays.origin_m[rows, None], axis=2)
    facing = np.abs(
        np.einsum("pkx,pkx->pk", other - rays.origin_m[rows, None], found.normal.reshape(*met.shape, 3))
    )
    light = safe_divide(facing, lit_m**3) / (sight.cosine / sight.range_m**2)[rows, None]
    late_m = np.maximum((lit_m + away_m - sight.range_m[rows, None]) / 2, 0.0)
    return each * light, np.where(met, late_m, 0.0), filled


def _one_spot(sight: Sight) -> bool:
    """Whether a spot at a time is lit, and only it is seen."""
    photons = sight.detector.photons
    return photons is not None and photons.emission == "scanned" and sight.scene.receiver is None


def _around(normal: np.ndarray) -> np.ndarray:
    """Directions even in the cosine about unit normals (P, 3), turned from one to the next, shape (P, K, 3)."""
    order = np.arange(DIRECTIONS)
    sine = np.sqrt((order + 0.5) / DIRECTIONS)
    angle = order * GOLDEN_TURN + np.arange(len(normal))[:, None]
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(normal, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    aside = np.cos(angle)[..., None] * first[:, None] + np.sin(angle)[..., None] * second[:, None]
    return sine[:, None] * aside + np.sqrt(1 - sine**2)[:, None] * normal[:, None]
