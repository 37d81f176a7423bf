"""Beam footprint: each beam is split into thin ones that share its light, so that one ray may hit several surfaces.

The detector combines several echoes of one ray (`simulate.detection`): near ones merge into one mixed return, of
distant ones it reports one.

Bound of its effect (`bound`), as slanted surfaces spread an echo and beams on a depth edge hit two surfaces: a beam of
half angle h has the radius R h at the range R; on a plane met at the angle theta its rim lies up to R cos(theta) /
cos(theta + h) away, so a return is off by at most the excess over R, and may leave or enter a gate that ends within
it, or spill into it, or sink below the detection threshold. A bistatic receiver is further from the rim, too. An edge
within R h of the ray's end mixes both surfaces: the return may be of either and counts as lost, or between them, within
the detector's resolution; see `edge_probability` (an estimate). Surfaces between rays are hit by a beam but by none of
the rays: one point on the rim of each beam is cast too. Photons from all over the spread act as timing noise: the
spread is counted in full, not its rms of a half.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.light import Beams
from lidardesign.simulate.detector.physics import Detector
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import FLATTEST_COSINE, STEEPER, EffectBound, FirstHits, edge_probability
from lidardesign.simulate.light_transport.detours import GOLDEN_ANGLE_RAD

# Successive pairs of opposite points are turned by the golden share of a half turn: the most even spiral with two
# arms (Vogel 1979 has one arm and a full turn, whose centre of mass lies off the axis).
GOLDEN_SHARE = (math.sqrt(5) - 1) / 2


def even_disc(count: int) -> np.ndarray:
    """Evenly spread points of the unit disc, symmetric under a half turn, shape (count, 2).

    So their mean is the centre exactly, and their mean square radius is a half, that of the disc (for an odd count,
    which has a point in the centre, it differs by less than 1 / count^2).
    """
    pairs = np.arange(count // 2)
    radius = np.sqrt((2 * pairs + 1 + count % 2) / count)
    angle = pairs * math.pi * GOLDEN_SHARE
    half = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((count % 2, 2)), half, -half])


def split_beams(beams: Beams, detector: Detector) -> Beams:
    """Split each beam into `detector.footprint_rays` thin ones of equal share, even over the solid angle of its cone.

    The pattern is upright: it turns with the azimuth of a beam. Beams without divergence are returned unchanged.

    Arguments:
        beams: B thin beams.
        detector: Its `divergence_rad` is the full angle of the cone.
    """
    count = detector.footprint_rays
    if count == 1 or detector.divergence_rad == 0:
        return beams
    disc = even_disc(count)
    share = np.einsum("nk,nk->n", disc, disc)
    # equal shares of the cone's solid angle are equal steps of the cosine c: with 1 - c = s u for a share s of the
    # disc, the sine is sqrt(s u (2 - s u)), and the point of the disc has the length sqrt(s)
    full = 2 * math.sin(detector.divergence_rad / 4) ** 2
    aside = disc * np.sqrt(full * (2 - share * full))[:, None]
    # perpendicular unit vectors, horizontally to the left and upwards; of azimuth 0 at a pole
    azimuth = np.arctan2(beams.direction[:, 1], beams.direction[:, 0])
    lateral = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))], axis=1)
    upright = np.cross(beams.direction, lateral)
    direction = (1 - share * full)[:, None] * beams.direction[:, None]
    direction = direction + aside[:, :1] * lateral[:, None] + aside[:, 1:] * upright[:, None]
    return Beams(
        np.repeat(beams.ray, count),
        np.repeat(beams.origin_m, count, axis=0),
        direction.reshape(-1, 3),
        np.repeat(beams.time_s, count),
        np.repeat(beams.share / count, count),
    )


# Smallest share of a range that counts as an edge: ranges of meshes are exact only to float32.
MESH_ROUNDING = 1e-5


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why beams are lines, or None."""
    if detector.divergence_rad == 0:
        return "beams are thin lines"
    return None if detector.footprint_rays > 1 else "each beam has a single sub-ray"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of the beam footprint."""
    radius_m, wide_rad = first_hits.beam_m, first_hits.detector.divergence_rad
    # of a plane, at its far end: R (cos theta / cos(theta + h) - 1)
    steepness = math.cos(wide_rad / 2) - first_hits.tangent * math.sin(wide_rad / 2)
    spread_m = first_hits.range_m * (1 / np.maximum(steepness, FLATTEST_COSINE) - 1)
    spread_m = first_hits.half_path_m(spread_m, radius_m)
    edge = edge_probability(first_hits, radius_m)
    squared = np.minimum(spread_m, first_hits.width_m) ** 2 + edge * first_hits.resolution_m**2
    lost = np.maximum(edge, (first_hits.gate_edge_m <= spread_m) | stray_rims(first_hits))
    lost = np.maximum(lost, counts.spilled(spread_m))
    if first_hits.detector.photons is not None:
        lost = np.maximum(lost, counts.slant_loss() * first_hits.returned)
    wide_m = float(np.median(2 * radius_m[first_hits.returned])) if first_hits.returned.any() else 0.0
    return EffectBound(
        squared, lost, f"beams of {1000 * wide_rad:.3g} mrad are {1000 * wide_m:.3g} mm wide where they return"
    )


def stray_rims(first_hits: FirstHits) -> np.ndarray:
    """Mask of beams whose rim, at one sampled point, hits another surface than their axis, shape (N,).

    Adjoining surfaces, as those of joined bodies, count as one.
    """
    rays, hits, half_rad = first_hits.rays, first_hits.hits, first_hits.detector.divergence_rad / 2
    level = np.cross(np.eye(3)[np.abs(rays.direction).argmin(axis=1)], rays.direction)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    turn = (GOLDEN_ANGLE_RAD * np.arange(len(first_hits)))[:, None]
    aside = np.cos(turn) * level + np.sin(turn) * np.cross(rays.direction, level)
    rim = first_hits.caster.first_hit(rays.origin_m, math.cos(half_rad) * rays.direction + math.sin(half_rad) * aside)
    both = np.flatnonzero((hits.body >= 0) & (rim.body >= 0))
    cosine = np.abs(np.einsum("nk,nk->n", rim.normal[both], rays.direction[both]))
    slope = 1 + first_hits.tangent[both] + 1 / np.maximum(cosine, FLATTEST_COSINE)
    stray = (rim.body >= 0) != (hits.body >= 0)
    step_m = np.abs(rim.range_m[both] - hits.range_m[both])
    stray[both] = step_m > STEEPER * first_hits.beam_m[both] * slope + MESH_ROUNDING * hits.range_m[both]
    return stray
