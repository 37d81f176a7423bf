"""Visibility by opaque geometry: T = 1 up to the margin in front of the first hit, 0 behind it.

The closed form that ways to compute visibility are compared with; it has no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidardesign.density.frames import FramesTarget
from lidardesign.density.occlusion import Blocked, BodyRaycast, Pairs
from lidardesign.density.receiver import HeardVisibility, common_receiver
from lidardesign.density.target import Target
from lidardesign.density.visibility import Optics, RayBatch, Raycast, RayGradient, Visibility
from lidardesign.scene import Scene

# log T of hidden points: far below anything that counts, and finite
LOG_OPAQUE = -1e4


def opaque_target(target: Target, scenes: list[Scene]) -> Target:
    """The same target with opaque occluders; scenes are those that it was built of."""
    if isinstance(target, FramesTarget):
        return replace(target, visibility=OpaqueBodies(BodyRaycast.of(scenes)))
    receiver, way = common_receiver(scenes), Opaque(Raycast(scenes))
    return replace(target, visibility=way if receiver is None else HeardVisibility(way, receiver))


@dataclass(frozen=True, eq=False)
class _Hidden:
    log_values: np.ndarray

    def gradient(self, weights: np.ndarray) -> RayGradient:
        return RayGradient.zeros(len(self.log_values))


class Opaque:
    """Exact first hits on opaque scenes."""

    name = "opaque"

    def __init__(self, exact: Visibility) -> None:
        self._exact, self.rows_at_once = exact, exact.rows_at_once

    def transmittance(
        self, rays: RayBatch, active: np.ndarray, optics: Optics, *, differentiable: bool = True
    ) -> _Hidden:
        """See `Visibility`; its gradient is 0 wherever there is one."""
        return _Hidden(_opaque(self._exact.transmittance(rays, active, optics, differentiable=False).log_values))


class OpaqueBodies:
    """Exact first hits on opaque bodies of many columns."""

    name = "opaque"

    def __init__(self, exact: BodyRaycast) -> None:
        self._exact = exact

    def take(self, columns: np.ndarray) -> OpaqueBodies:
        """The same for some columns."""
        return OpaqueBodies(self._exact.take(columns))

    def blocked(self, rays: RayBatch, pairs: Pairs, optics: Optics) -> Blocked:
        """log T of every pair."""
        found = self._exact.blocked(rays, pairs, optics)
        return replace(found, log_values=_opaque(found.log_values), attenuation_per_m=0.0)


def _opaque(log_values: np.ndarray) -> np.ndarray:
    return np.where(log_values < 0, LOG_OPAQUE, 0.0)
