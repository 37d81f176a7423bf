"""The way back to a fixed receiver: what it can see of the scene points that emitters light (paper, section 3.1).

A design point is then an emitter's ray; its light is measured where the receiver sees the same scene point s, so that
log T = log T_emitter(d) + log T_receiver(s) + log view(s). The receiver's own leg is traced as any ray is. Its view is
the product over the four planes of its field of view and the two ends of its range of sigmoid(distance inside / w) with
w a quarter of sigma: an edge that the density can be trained across.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, log_expit

from lidardesign.density.visibility.quadrature import Optics, RayBatch, RayGradient, Transmittance, Visibility
from lidardesign.errors import ConfigError
from lidardesign.geometry.receiver import receiver_axes
from lidardesign.scene import Receiver, Scene

# The width of the soft edge of the view, in sigmas.
EDGE_SIGMAS = 0.25


def common_receiver(scenes: Sequence[Scene]) -> Receiver | None:
    """The one receiver of all scenes; None where rays are heard at their own origins.

    Raises:
        ConfigError: The scenes have different ones.
    """
    receivers = {scene.receiver for scene in scenes}
    if len(receivers) > 1:
        raise ConfigError(
            f"{len(receivers)} different receivers in {len(scenes)} scenes",
            where="scenes",
            allowed="one fixed receiver for all scenes of a task, or none",
        )
    return next(iter(receivers), None)


@dataclass(frozen=True, eq=False)
class _Heard:
    """Both ways of a batch, and the view of the receiver."""

    log_values: np.ndarray
    rays: RayBatch
    out: Transmittance
    back_rays: RayBatch
    back: Transmittance
    view_gradient: np.ndarray

    def gradient(self, weights: np.ndarray) -> RayGradient:
        total = self.out.gradient(weights)
        back = self.back.gradient(weights)
        looking = self.back_rays.directions
        # the receiver stays where it is: turning its line of sight moves s across, lengthening it moves s along
        across = back.directions - np.einsum("nk,nk->n", back.directions, looking)[:, None] * looking
        reach = np.where(self.back_rays.ranges > 0, self.back_rays.ranges, np.inf)
        by_point = back.ranges[:, None] * looking + across / reach[:, None]
        by_point += weights.sum(axis=1, keepdims=True) * self.view_gradient
        total.add_by_point(by_point, self.rays)
        return total


class HeardVisibility:
    """Visibility from the emitter and from a fixed receiver.

    Arguments:
        one_way: How either way is computed.
        receiver: Where the light is heard.
    """

    def __init__(self, one_way: Visibility, receiver: Receiver) -> None:
        self.one_way, self.receiver = one_way, receiver
        self.name = one_way.name
        self._origin_m = np.asarray(receiver.origin_m, dtype=np.float64)
        self._inward, self._ahead = _view_planes(receiver)

    @property
    def rows_at_once(self) -> int:
        """How many rays keep its memory bounded: two ways at a time."""
        return max(1, self.one_way.rows_at_once // 2)

    def transmittance(
        self, rays: RayBatch, active: np.ndarray, optics: Optics, *, differentiable: bool = True
    ) -> Transmittance:
        """See `Visibility`."""
        observed = rays.observed
        offset = observed - self._origin_m
        reach = np.linalg.norm(offset, axis=1)
        looking = np.where(reach[:, None] > 0, offset, self._ahead)
        looking /= np.linalg.norm(looking, axis=1, keepdims=True)
        back_rays = RayBatch(np.broadcast_to(self._origin_m, offset.shape).copy(), looking, reach)
        out = self.one_way.transmittance(rays, active, optics, differentiable=differentiable)
        back = self.one_way.transmittance(back_rays, active, optics, differentiable=differentiable)
        log_view, by_point = self.log_view(observed, optics.sigma_m)
        values = out.log_values + back.log_values + log_view[:, None]
        return _Heard(values, rays, out, back_rays, back, by_point)

    def log_view(self, points: np.ndarray, sigma_m: float) -> tuple[np.ndarray, np.ndarray]:
        """log of how far points (N, 3) are in view, at most 0, (N,), and its gradient (N, 3) [1/m]."""
        width_m = EDGE_SIGMAS * sigma_m
        offset = points - self._origin_m
        reach = np.linalg.norm(offset, axis=1)
        near_m, far_m = self.receiver.range_m
        inside = np.column_stack([offset @ self._inward.T, reach - near_m, far_m - reach]) / width_m
        slope = expit(-inside) / width_m
        outward = offset / np.where(reach > 0, reach, 1.0)[:, None]
        gradient = slope[:, :4] @ self._inward + (slope[:, 4] - slope[:, 5])[:, None] * outward
        return log_expit(inside).sum(axis=1), gradient


def _view_planes(receiver: Receiver) -> tuple[np.ndarray, np.ndarray]:
    """Inward unit normals of the field of view's four sides, shape (4, 3), and the boresight, shape (3,)."""
    ahead, left, up = receiver_axes(receiver)
    sides = []
    for across, whole in ((left, receiver.horizontal_rad), (up, receiver.vertical_rad)):
        sides += [np.sin(whole / 2) * ahead + sign * np.cos(whole / 2) * across for sign in (1.0, -1.0)]
    return np.array(sides), ahead
