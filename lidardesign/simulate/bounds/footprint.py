r"""The width of a beam: slanted surfaces spread an echo, and beams on a depth edge meet two surfaces.

A beam of half angle h is R h wide at the range R; on a surface met at the angle theta its ranges spread by
+-R h tan(theta), so a return is off by at most that. An edge within R h of the ray's end mixes both surfaces: the
return may be of either, or between them, and counts as lost; see `edge_probability` (an estimate). Photons from all
over the spread are as good as noise for the time of one: the spread is counted in full, not its rms of a half.
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
    spread_m = np.minimum(radius_m * sight.tangent, sight.width_m)
    lost = edge_probability(sight, radius_m)
    wide_m = float(np.median(2 * radius_m[sight.returned])) if sight.returned.any() else 0.0
    reason = f"beams of {1000 * wide_rad:.3g} mrad are {1000 * wide_m:.3g} mm wide where they return"
    return Stake(spread_m**2, lost, reason)
