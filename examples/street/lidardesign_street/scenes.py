"""Scenes of the task street: what stands, rides and walks around a car, at one moment.

The own car stands at the origin and looks along +x in a lane of its own; traffic keeps to the right. On the left is the
oncoming lane, on both sides are parked cars, pavements and walls.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from lidardesign import Body, Box, Capsule, Plane, Scene, rigid

from lidardesign_street.config import StreetConfig

# Length, width, height [m]: the means of the KITTI labels (Zhou and Tuzel, VoxelNet, CVPR 2018, section 3.1).
SIZES_M = {"car": (3.9, 1.6, 1.56), "cyclist": (1.76, 0.6, 1.73), "pedestrian": (0.8, 0.6, 1.73)}
SIZE_SPREAD = 0.1  # road users are larger or smaller by up to this share
# From where to where each band reaches, from above the middle of the own car [m].
BANDS_M = ((5.0, 20.0), (20.0, 40.0), (40.0, 60.0))
# How often each is met, and across the street from where to where [m].
PLACES = {
    "parked car": (0.25, ((-3.0, -2.8), (6.3, 6.5))),
    "moving car": (0.25, ((-0.3, 0.3), (3.2, 3.8))),
    "cyclist": (0.2, ((-1.5, -1.1), (4.6, 5.0))),
    "pedestrian": (0.2, ((-7.0, -4.5), (8.0, 10.5))),
    "crossing pedestrian": (0.1, ((-4.0, 7.5),)),
}
WALLS_M, WALL_HEIGHT_M, STREET_M = (-9.0, 12.0), 8.0, 160.0
GAP_M = 0.3  # between any two
CLEARANCE_M = 0.25  # below a car
RIDER_M, SADDLE_M, FRAME_M, BODY_M = 0.2, 0.8, 0.1, 0.25  # of capsules, a saddle's height, a bicycle's thickness


class User(NamedTuple):
    """A road user by the box that a label would draw around it, its sides along the street.

    Arguments:
        kind: A key of `SIZES_M`.
        centre_m: The middle of its box, shape (3,) [m].
        half_m: Half its length, width and height, shape (3,) [m].
    """

    kind: str
    centre_m: np.ndarray
    half_m: np.ndarray

    def is_apart(self, other: User) -> bool:
        """Whether there is room between the two."""
        return bool((np.abs(self.centre_m - other.centre_m) > self.half_m + other.half_m + GAP_M)[:2].any())

    def bodies(self, name: str, role: str) -> list[Body]:
        """Its shapes: two boxes, a capsule on a thin box, or a capsule."""
        (x, y, _), (length, width, height) = self.centre_m, 2 * self.half_m

        def box(long: float, wide: float, low: float, high: float) -> Body:
            half = (long / 2, wide / 2, (high - low) / 2)
            return Body(Box(half), name, role, rigid(translation_m=(x, y, (low + high) / 2)))

        def capsule(radius: float, low: float) -> Body:
            shape = Capsule(radius, (height - low) / 2 - radius)
            return Body(shape, name, role, rigid(translation_m=(x, y, (low + height) / 2)))

        if self.kind == "car":
            waist = 0.6 * height
            return [box(length, width, CLEARANCE_M, waist), box(0.55 * length, 0.9 * width, waist, height)]
        if self.kind == "cyclist":
            return [box(length, FRAME_M, 0.05, SADDLE_M), capsule(RIDER_M, SADDLE_M)]
        return [capsule(BODY_M, 0.0)]


def user_of(kind: str, x: float, y: float, scale: float = 1.0) -> User:
    """A road user that stands on the ground, of the usual size times a scale."""
    half = scale * np.array(SIZES_M[kind]) / 2
    return User(kind, np.array([x, y, half[2]]), half)


OWN = user_of("car", 0.0, 0.0)


def build_scene(config: StreetConfig, name: str, generator: np.random.Generator) -> Scene:
    """One moment."""
    users: list[User] = []
    for band in BANDS_M:
        for _ in range(config.users):
            users.append(next(user for user in _drawn(band, generator) if all(map(user.is_apart, (*users, OWN)))))
    return scene_of(users, name)


def scene_of(users: Sequence[User], name: str = "street") -> Scene:
    """These road users in the street; ground, walls and the own car block rays and are nothing worth observing."""
    ground = Body(Plane(), "ground", "occluder")
    middle_m = WALL_HEIGHT_M / 2
    walls = [
        Body(Box((STREET_M / 2, 0.1, middle_m)), "wall", "occluder", rigid(translation_m=(0, y, middle_m)))
        for y in WALLS_M
    ]
    shown = [body for number, user in enumerate(users) for body in user.bodies(f"{user.kind} {number}", "both")]
    truth = {
        "centre_m": np.stack([user.centre_m for user in users]),
        "half_m": np.stack([user.half_m for user in users]),
    }
    return Scene((ground, *walls, *OWN.bodies("own car", "occluder"), *shown), name, truth=truth)


def _drawn(band_m: tuple[float, float], generator: np.random.Generator) -> Iterator[User]:
    """Road users in a band, one after the other, without end."""
    shares = [share for share, _ in PLACES.values()]
    while True:
        place = str(generator.choice(list(PLACES), p=shares))
        rows = PLACES[place][1]
        y = generator.uniform(*rows[generator.integers(len(rows))])
        distance, side = generator.uniform(*band_m), generator.choice((-1.0, 1.0))
        scale = generator.uniform(1 - SIZE_SPREAD, 1 + SIZE_SPREAD)
        if distance > abs(y):
            yield user_of(place.split()[-1], side * float(np.sqrt(distance**2 - y**2)), y, scale)
