r"""The width of a beam: slanted surfaces spread an echo, and beams on a depth edge meet two surfaces.

A beam of half angle h is R h wide at the range R; on a surface met at the angle theta its ranges spread by
+-R h tan(theta), so a return is off by at most that, and may leave or enter a gate that ends within it. An edge within
R h of the ray's end mixes both surfaces: the return may be of either and counts as lost, or between them, as far apart
as the detector does not tell them apart; see `edge_probability` (an estimate). Photons from all over the spread are as
good as noise for the time of one: the spread is counted in full, not its rms of a half.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.neighbours import edge_probability
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays


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
    lost = np.maximum(edge, sight.gate_edge_m <= spread_m)
    wide_m = float(np.median(2 * radius_m[sight.returned])) if sight.returned.any() else 0.0
    reason = f"beams of {1000 * wide_rad:.3g} mrad are {1000 * wide_m:.3g} mm wide where they return"
    return Stake(squared, lost, reason)
