r"""The width of a beam: slanted surfaces spread an echo, and beams on a depth edge meet two surfaces.

A beam of half angle h is R h wide at the range R; on a surface met at the angle theta its ranges spread by
+-R h tan(theta), so a return is off by at most that, and may leave or enter a gate that ends within it. An edge within
R h of the ray's end mixes both surfaces: the return may be of either and counts as lost, or between them, as far apart
as the detector does not tell them apart; see `edge_probability` (an estimate). What lies between rays is met by a beam
but by none of them: one place on the rim of each beam is looked at too. Photons from all over the spread are as
good as noise for the time of one: the spread is counted in full, not its rms of a half.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.neighbours import STEEPER, edge_probability
from lidardesign.simulate.bounds.sight import FLATTEST_COSINE, Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.multipath_bound import GOLDEN_ANGLE_RAD
from lidardesign.simulate.returns import Rays

# Ranges of meshes are exact to float32; no step of less than this share of a range is an edge.
MESH_ROUNDING = 1e-5


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why beams are lines, if so."""
    if detector.divergence_rad == 0:
        return "beams are thin lines"
    return None if detector.footprint_rays > 1 else "the detector gives beams one sub-ray each"


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of beams with a width."""
    radius_m, wide_rad = sight.beam_m, sight.detector.divergence_rad
    spread_m = radius_m * sight.tangent
    edge = edge_probability(sight, radius_m)
    squared = np.minimum(spread_m, sight.width_m) ** 2 + edge * sight.resolution_m**2
    lost = np.maximum(edge, (sight.gate_edge_m <= spread_m) | stray_rims(sight))
    wide_m = float(np.median(2 * radius_m[sight.returned])) if sight.returned.any() else 0.0
    reason = f"beams of {1000 * wide_rad:.3g} mrad are {1000 * wide_m:.3g} mm wide where they return"
    return Stake(squared, lost, reason)


def stray_rims(sight: Sight) -> np.ndarray:
    """Which beams meet, at one place on their rim, a surface that is not the one in their middle, (N,).

    Surfaces that meet, as those of joined bodies, are one.
    """
    rays, hits, half_rad = sight.rays, sight.hits, sight.detector.divergence_rad / 2
    level = np.cross(np.eye(3)[np.abs(rays.direction).argmin(axis=1)], rays.direction)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    turn = (GOLDEN_ANGLE_RAD * np.arange(len(sight)))[:, None]
    aside = np.cos(turn) * level + np.sin(turn) * np.cross(rays.direction, level)
    rim = sight.caster.first_hit(rays.origin_m, math.cos(half_rad) * rays.direction + math.sin(half_rad) * aside)
    both = np.flatnonzero((hits.body >= 0) & (rim.body >= 0))
    cosine = np.abs(np.einsum("nk,nk->n", rim.normal[both], rays.direction[both]))
    slope = 1 + sight.tangent[both] + 1 / np.maximum(cosine, FLATTEST_COSINE)
    stray = (rim.body >= 0) != (hits.body >= 0)
    step_m = np.abs(rim.range_m[both] - hits.range_m[both])
    stray[both] = step_m > STEEPER * sight.beam_m[both] * slope + MESH_ROUNDING * hits.range_m[both]
    return stray
