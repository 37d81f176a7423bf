"""Which hazards a set of returns shows, and which it shows that are not there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from lidardesign import Scene

# Whatever rises this far above the ground is a hazard [m].
RAISED_M = 0.1
# So many raised returns on a hazard, and it is found.
FEWEST_RETURNS = 2
# A raised return no further than this from a hazard is of it [m].
NEAR_M = 0.05


class Seen(NamedTuple):
    """What returns of one frame show.

    Arguments:
        missed: Which of them no estimate knows of, shape (H,).
        phantoms_m: Raised returns where nothing stands, shape (P, 3) [m].
        raised: The number of raised returns.
    """

    missed: np.ndarray
    phantoms_m: np.ndarray
    raised: int

    @property
    def error(self) -> float:
        """The share of hazards that are missed; phantoms hide so much of what was found. From 0 to 1."""
        missed = float(self.missed.mean())
        return missed + (1.0 - missed) * len(self.phantoms_m) / max(self.raised, 1)


def seen(scene: Scene, points_m: np.ndarray, frame: int) -> Seen:
    """What points (N, 3) [m] show of a scene in a frame; the estimate is the raised ones among them."""
    raised = points_m[points_m[:, 2] > RAISED_M]
    near = on_hazards(scene, raised, frame)
    return Seen(near.sum(axis=1) < FEWEST_RETURNS, raised[~near.any(axis=0)], len(raised))


def on_hazards(scene: Scene, points_m: np.ndarray, frame: int) -> np.ndarray:
    """Which raised points (N, 3) [m] are of which hazards of a scene in a frame, shape (H, N)."""
    hazards = [body for body in scene.bodies if body.is_target]
    near = np.stack([_is_near(body.pose(frame), body.shape.half_extents_m, points_m) for body in hazards])
    return near & (points_m[:, 2] > RAISED_M)


def _is_near(pose: np.ndarray, half_extents_m: tuple[float, float, float], points_m: np.ndarray) -> np.ndarray:
    local = (points_m - pose[:3, 3]) @ pose[:3, :3]
    return (np.abs(local) <= np.array(half_extents_m) + NEAR_M).all(axis=1)
