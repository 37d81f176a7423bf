"""Light on its way out and back: beams that leave an emitter, echoes that come home.

Both are flat lists that name the ray of a design that each entry belongs to, so that a ray may have many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidardesign.simulate.returns import Rays


@dataclass(frozen=True, eq=False)
class Beams:
    """Thin beams of light, B of them.

    Arguments:
        ray: The ray that each is part of, shape (B,), ascending.
        origin_m: Where each starts [m], shape (B, 3).
        direction: Unit vectors, shape (B, 3).
        time_s: When each is sent within the frame [s], shape (B,).
        share: Its share of the ray's light; the shares of a ray add up to 1, shape (B,).
    """

    ray: np.ndarray
    origin_m: np.ndarray
    direction: np.ndarray
    time_s: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, rays: Rays) -> Beams:
        """One thin beam per ray."""
        count = len(rays)
        return cls(np.arange(count), rays.origin_m, rays.direction, rays.time_s, np.ones(count))

    def __len__(self) -> int:
        return len(self.ray)


@dataclass(frozen=True, eq=False)
class Echoes:
    """Light that comes back, E echoes.

    Arguments:
        ray: The ray that each belongs to, shape (E,).
        path_m: Half of the whole way from the emitter to the receiver: the range, where both are at one place [m],
            shape (E,).
        gain: Share of the ray's light that reaches 1 m^2 of aperture: share * reflectance * cosine / (pi * distance^2)
            and what else weakens it, shape (E,) [1/m^2].
        body: What sent it back, shape (E,).
    """

    ray: np.ndarray
    path_m: np.ndarray
    gain: np.ndarray
    body: np.ndarray

    def __len__(self) -> int:
        return len(self.ray)

    def kept(self, chosen: np.ndarray) -> Echoes:
        """The echoes at an index or mask."""
        return Echoes(self.ray[chosen], self.path_m[chosen], self.gain[chosen], self.body[chosen])

    @classmethod
    def joined(cls, parts: list[Echoes]) -> Echoes:
        """Several lists as one."""
        names = ("ray", "path_m", "gain", "body")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class Background:
    """Counts that no surface sent back, per pulse, of N rays.

    Arguments:
        per_metre: Ambient light and dark counts per metre of range, the same over the whole gate, shape (N,).
        edges_m: Cells of range within which the air sends light back, shape (N, C + 1) [m]; None: clear air.
        counts: Counts per pulse in each of those cells, shape (N, C); None: clear air.
    """

    per_metre: np.ndarray
    edges_m: np.ndarray | None = None
    counts: np.ndarray | None = None
