"""Mirrors and glass: what they lead elsewhere may meet anything, so every ray that they meet may be wrong.

Lost is the share of rays whose first hit is on a body that mirrors or lets through, and what else comes back of them
may move their echoes by as much as the detector does not tell apart; the others are as they were. It bounds strictly:
where that light goes is not known without following it, and how much it weighs is not asked.
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
    """Why light is led nowhere else, if so."""
    return None if any(_leads(body) for body in scene.bodies) else "nothing mirrors or lets light through"


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of light that goes on."""
    leading = np.array([_leads(body) for body in sight.scene.bodies])
    met = np.where(sight.hits.body >= 0, leading[sight.hits.body], False)
    names = ", ".join(dict.fromkeys(body.name for body in sight.scene.bodies if _leads(body)))
    moved_m = np.minimum(sight.resolution_m, sight.width_m) * met
    return Stake(moved_m**2, met.astype(float), f"{100 * met.mean():.3g} % of rays meet mirrors or glass: {names}")


def _leads(body: object) -> bool:
    return body.specular > 0 or body.transmission > 0
