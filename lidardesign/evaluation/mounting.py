"""The cost of mounting errors: sensors with a shifted and rotated pose, in the same scenes.

Every sensor has a normal error of its own in every scene, along each axis and about each. Errors depend on the scene
and the number of a sensor alone, so all designs have the same. A sensor keeps its rays, their gates and its error at
every position of its carrier. The erroneous pose is known, as after a calibration: rays change, and points are where
they are measured.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lidardesign.errors import ConfigError
from lidardesign.run.yaml import plain_number
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.fired import Positions
from lidardesign.sensors.adaptive import mapped
from lidardesign.task import random_generator

OPTION = "--mount-error"
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
RADIANS = {"mrad": 1e-3, "deg": math.pi / 180, "rad": 1.0}
PART = re.compile(r"\s*([0-9.eE+-]+)\s*([a-z]+)\s*")
MOST = {"place_m": 10.0, "angle_rad": math.pi / 2}


@dataclass(frozen=True)
class MountError:
    """Standard deviations of a sensor's place along each axis [m] and of its rotation about each axis [rad]."""

    place_m: float
    angle_rad: float

    @classmethod
    def parse(cls, text: str) -> MountError:
        """An error as people write it, as `5mm,0.5deg`; a missing part is 0.

        Raises:
            ConfigError: Text of another form.
        """
        found: dict[str, float] = {}
        for part in text.split(","):
            match = PART.fullmatch(part)
            number, unit = match.groups() if match else ("", "")
            kind, scales = ("place_m", METRES) if unit in METRES else ("angle_rad", RADIANS)
            try:
                value = plain_number(number) * scales.get(unit, math.nan)
            except ValueError:
                value = math.nan
            if kind in found or not 0 <= value <= MOST[kind]:
                raise ConfigError(
                    f"{part.strip()!r} in {text!r}",
                    where=OPTION,
                    allowed=f"a length in {', '.join(METRES)} from 0 to 10 m, an angle in {', '.join(RADIANS)} "
                    "from 0 to 90 degrees, once each",
                    hint=f"{OPTION} 5mm,0.5deg",
                )
            found[kind] = value
        return cls(found.get("place_m", 0.0), found.get("angle_rad", 0.0))

    def __str__(self) -> str:
        return f"{1e3 * self.place_m:.3g} mm and {math.degrees(self.angle_rad):.3g} degrees"

    def misplaced(self, positions: Positions, seed: int, scene: int) -> Positions:
        """The rays of sensors with the mounting errors of a scene, at every position."""
        sensors = max((int(rays.sensor.max(initial=-1)) for rays in positions), default=-1) + 1
        draws = random_generator(seed, "mounting", scene).normal(size=(sensors, 6))
        turn = Rotation.from_rotvec(self.angle_rad * draws[:, 3:]).as_matrix() if sensors else np.zeros((0, 3, 3))
        return mapped(positions, lambda rays: _moved(rays, self.place_m * draws[:, :3], turn))


def _moved(rays: Rays, shift_m: np.ndarray, turn: np.ndarray) -> Rays:
    """Rays whose sensors are turned about the middle of where their rays start (S, 3, 3), and shifted (S, 3) [m]."""
    own, count = rays.sensor, np.bincount(rays.sensor, minlength=len(turn))
    sums = np.stack([np.bincount(own, rays.origin_m[:, axis], len(turn)) for axis in range(3)], axis=1)
    middle = (sums / np.maximum(count, 1)[:, None])[own]
    origin = middle + np.einsum("nij,nj->ni", turn[own], rays.origin_m - middle) + shift_m[own]
    return replace(rays, origin_m=origin, direction=np.einsum("nij,nj->ni", turn[own], rays.direction), angles_rad=None)
