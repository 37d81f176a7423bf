r"""The chance in photons: their number, and when in the pulse they were sent.

n photons of a pulse (c / 2) sigma_p wide give a range that strays by (c / 2) sigma_p / sqrt(n) (Cramer and Rao's bound
for a Gaussian without background), or as far as the highest bin does; see `estimate_error_m`. Where photons are timed
with an error too, other photons bring other errors, and both count. The number is Poisson: the return is lost with the
probability that the echo's bin holds fewer than a return needs.

An estimate where n is a few: photons are then in the tail as often as not, and a lost return has no range.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why light is smooth, if so."""
    return None if detector.photons is not None else "the detector does not count photons"


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of few photons."""
    sigma_m = sight.sigma_m()
    lost = counts.missed(counts.in_air, counts.per_bin, sigma_m)
    reason = f"a return has about {counts.typical} photons"
    return Stake(counts.error_m(counts.in_air, sigma_m) ** 2, np.where(sight.returned, lost, 0.0), reason)
