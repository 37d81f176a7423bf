"""Beams have a width: each is split into thin ones that share its light, so that one ray may meet several surfaces.

What a detector makes of several echoes of one ray is its own matter (`simulate.detection`): near ones merge into one
mixed return, of distant ones it reports one.
"""

from __future__ import annotations

import math

import numpy as np

from lidardesign.simulate.detector import Detector
from lidardesign.simulate.echoes import Beams

# Pairs of opposite points are turned by the golden share of a half turn from one to the next: the most even spiral
# with two arms (Vogel 1979 has one arm and a full turn, whose centre of mass lies off the axis).
GOLDEN_SHARE = (math.sqrt(5) - 1) / 2


def even_disc(count: int) -> np.ndarray:
    """Points of equal share of the unit disc, shape (count, 2), that are unchanged by a half turn.

    So their mean is the centre exactly, and their mean square radius is a half, that of the disc (for an odd count,
    which has a point in the centre, it differs by less than 1 / count^2). One point lies in the centre.
    """
    pairs = np.arange(count // 2)
    radius = np.sqrt((2 * pairs + 1 + count % 2) / count)
    angle = pairs * math.pi * GOLDEN_SHARE
    half = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((count % 2, 2)), half, -half])


def split(beams: Beams, detector: Detector) -> Beams:
    """Each beam as `detector.footprint_rays` thin ones of equal share, even over the solid angle of its cone.

    The pattern is upright: it turns with the azimuth of a beam. Beams of no width stay as they are.

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
    lateral, upright = _across(beams.direction)
    direction = (1 - share * full)[:, None] * beams.direction[:, None]
    direction = direction + aside[:, :1] * lateral[:, None] + aside[:, 1:] * upright[:, None]
    return Beams(
        np.repeat(beams.ray, count),
        np.repeat(beams.origin_m, count, axis=0),
        direction.reshape(-1, 3),
        np.repeat(beams.time_s, count),
        np.repeat(beams.share / count, count),
    )


def _across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors across directions (B, 3): a level one to the left, and upwards; at a pole, those of azimuth 0."""
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    lateral = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))], axis=1)
    return lateral, np.cross(direction, lateral)
