"""Thin plates and walls in the way of rays."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import build_field
from lidardesign.density.objective.quadrature import Quadrature
from lidardesign.density.objective.visibility import Optics, RayBatch, Raycast
from lidardesign.scenes.scene import Body, Box, Plane, rigid
from lidardesign.space import DesignSpace

FACING = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])

SPACE = DesignSpace((0, 0, 0, -0.3, -0.3, 0.2), (0, 0, 0, 0.3, 0.3, 2.5))

OPTICS = Optics.of(DensitySettings())


def wall(distance=2.0, role="both"):
    return Body(Plane(), "wall", role, rigid(FACING, (distance, 0, 0)))


def plate(thickness, distance=1.0, role="both", half=0.5):
    pose = rigid(translation_m=(distance, 0, 0))
    return Body(Box((thickness / 2, half, half)), "plate", role, pose)


def config_of(visibility, space=SPACE, **density):
    settings = DensitySettings(**{"sigma_m": 0.01, "visibility": visibility, **density})
    return SimpleNamespace(space=space, seed=0, density=settings)


def along_axis(ranges):
    count = len(ranges)
    return RayBatch(np.zeros((count, 3)), np.tile([1.0, 0, 0], (count, 1)), np.asarray(ranges, float))


def transmittance_on(body_scene, visibility, ranges, optics=OPTICS):
    rays = along_axis(ranges)
    return np.exp(visibility.transmittance(rays, np.ones((len(ranges), 1), bool), optics).log_values[:, 0])


def both_ways(scene, points=2000):
    field = build_field([scene], lambda body: body.is_occluder, resolution=64, padding_m=0.02)
    return {"raycast": Raycast([scene]), "quadrature": Quadrature(field, points)}
