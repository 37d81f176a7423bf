r"""Light that comes back by way of other surfaces: later, and weaker by each bounce.

Where a flood lights all surfaces at once, or one receiver hears all of them, a surface gets at most
rho F / (1 - rho F) of what the emitter sends there from others: rho the largest reflectance, F <= 1 the share of its
view that is other surface (energy is kept; a geometric series over bounces). Where one spot at a time is lit and seen,
light must leave it and come back: rho^2 / (1 - rho^2), and of that, from a surface at a distance d, only the share
(s / d)^2 that falls on the spot of radius s again.

What is late by more than a detector tells apart, w, makes its own, lower peak. What is late by d < w moves an echo by
at most d times its share: by w times the share, and by s times the share from spots of radius s. A surface met at a
grazing angle may still be outshone; that is not bounded here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scene import Mesh, Scene
from lidardesign.simulate.bounds.counts import Counts
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why no light can go from one surface to another, if so."""
    if len(scene.bodies) == 1 and not isinstance(scene.bodies[0].shape, Mesh):
        return "one convex body lights nothing else"
    if not detector.bin_s and not detector.pulse_sigma_s:
        return "later light is told apart from the first echo"
    if max(body.reflectance for body in scene.bodies) == 0:
        return "nothing reflects"
    return None


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of light that is late."""
    reflectance = max(body.reflectance for body in sight.scene.bodies)
    photons = sight.detector.photons
    spots = photons is not None and photons.emission == "scanned" and sight.scene.receiver is None
    once = reflectance**2 if spots else reflectance
    share = float(safe_divide(once, 1 - once, np.inf))
    late_m = np.full(len(sight), sight.resolution_m)
    if spots:
        angle_rad = max(sight.detector.divergence_rad / 2, math.sqrt(photons.field_of_view_sr / math.pi))
        late_m = np.minimum(late_m, angle_rad * sight.range_m)
    moved = np.minimum(np.where(late_m > 0, min(share, 1.0) * late_m, 0.0), sight.width_m)
    return Stake(moved**2, np.zeros(len(sight)), f"surfaces of reflectance {reflectance:.2g} may light each other")
