"""A receiver that stands elsewhere: what the emitter lights may be hidden from it.

What it sees of each point is not known without casting a ray there, so every return may be lost. Where a ray starts at
the receiver the two see the same, and only what lies outside of the receiver's own view is lost, exactly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.receiver_view import in_view
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why all that is lit is seen, if so."""
    return None if scene.receiver is not None else "every ray is heard where it starts"


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of points that the receiver does not see."""
    receiver, rays = sight.scene.receiver, sight.rays
    together = (rays.origin_m == np.asarray(receiver.origin_m)).all(axis=1)
    points = rays.origin_m + sight.range_m[:, None] * rays.direction
    lost = np.where(together, ~in_view(receiver, points), True) & sight.returned
    away, hidden = (f"{100 * share.mean():.3g} %" for share in (~together, lost))
    reason = f"{away} of rays start away from the receiver, {hidden} may not be seen by it"
    return Stake(np.zeros(len(sight)), lost.astype(float), reason)
