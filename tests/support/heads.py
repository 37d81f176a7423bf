"""Heads of the face task and rays towards them, for every effect."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from lidardesign_tasks.arm import ArmTask
from lidardesign_tasks.face import FaceTask
from lidardesign_tasks.flatland import FlatlandTask

from lidardesign.scenes.rays import Rays, fire_times
from lidardesign.simulate.detector.physics import EFFECTS
from lidardesign.space import direction

# Detours by matt surfaces are rendered by another program, and tested with it.
EVERYTHING = frozenset(EFFECTS) - {"multipath"}

FACE, ARM, FLATLAND = FaceTask(), ArmTask(), FlatlandTask()


def rays_of(origin_m, looking, gate_m):
    count = len(looking)
    origins = np.broadcast_to(np.asarray(origin_m, dtype=float), (count, 3))
    return Rays(origins, looking, np.tile(gate_m, (count, 1)), np.zeros(count), fire_times(count, 10.0))


def face_rays():
    """An even grid that the face fills, 0.4 m in front of it."""
    turn = np.linspace(-0.28, 0.28, 14)
    azimuth, elevation = map(np.ravel, np.meshgrid(math.pi + turn, turn))
    return rays_of((0.4, 0.0, 0.0), direction(azimuth, elevation), (0.05, 1.05))


def heads(*others, **surroundings):
    config = FACE.Config(test=3, truth_points=1000, **surroundings)
    return [replace(head, bodies=(*head.bodies, *others)) for head in FACE.scenes(config, "test", 0)]
