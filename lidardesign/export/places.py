"""Rays by the place where they start, and rays that were read place by place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.design.sensor import Design
from lidardesign.errors import DataError
from lidardesign.export.poses import Mount
from lidardesign.simulate.returns import Rays

# Rays as read from one part of a file: indices of shape (K,), origins, directions (K, 3) and gates (K, 2).
Part = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Place:
    """Rays of one sensor that start at one place.

    Arguments:
        name: An identifier, unique in the design: that of the sensor, numbered where it has several places.
        mount: The sensor.
        origin_m: The place [m], shape (3,).
        ray: Indices of its rays in their order, shape (K,).
    """

    name: str
    mount: Mount
    origin_m: np.ndarray
    ray: np.ndarray


def places(mounted: Sequence[Mount], rays: Rays) -> list[Place]:
    """The places of all sensors, by sensor and then in the order in which they first fire."""
    found = []
    for mount in mounted:
        origins, first, place = np.unique(rays.origin_m[mount.ray], axis=0, return_index=True, return_inverse=True)
        place = place.reshape(-1)
        members = np.split(mount.ray[np.argsort(place, kind="stable")], np.cumsum(np.bincount(place))[:-1])
        for number, here in enumerate(np.argsort(first)):
            name = mount.name if len(origins) == 1 else f"{mount.name}_place_{number}"
            found.append(Place(name, mount, origins[here], members[here]))
    return found


def require_rays(design: Design, rays: Rays, what: str) -> None:
    """Refuse a design without rays, for a format that is made of them.

    Raises:
        DataError: There are none.
    """
    if not len(rays):
        raise DataError(f"has no rays, and {what} holds nothing else", where=design.name, hint="give --rays N")


def rays_of_parts(written: Rays, parts: Sequence[Part], where: str) -> Rays:
    """Rays that were read part by part, in the order of those that were written, with their sensors and times.

    Raises:
        DataError: The parts are not the rays.
    """
    index = np.concatenate([part[0] for part in parts]) if parts else np.zeros(0, dtype=np.int64)
    same = all(len(part[0]) == len(value) for part in parts for value in part[1:])
    if not same or not np.array_equal(np.sort(index), np.arange(len(written))):
        raise DataError("does not hold what was written", where=where, hint="export it again, to another disk")
    order = np.argsort(index)
    origin, looking, gate = (np.concatenate([part[k] for part in parts])[order] for k in (1, 2, 3))
    return Rays(origin, looking, gate, written.sensor, written.time_s)
