"""Emitter design: emitters around a detector that is fixed in front of a face, as in a smartphone.

World frame and heads are those of the task `face`. The detector has a fixed position and receives every ray; the
positions, directions and ranges of the emitters around it are designed. Light goes from an emitter to the face and
from there to the detector, so only surface visible to both counts, and the range along a ray follows from the whole
path of its light (`lidardesign.scenes.rays`). A flood emitter is a sensor whose rays are the dots of its pattern.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, field_validator

from lidardesign import (
    ConfigError,
    Defaults,
    DesignSpace,
    Information,
    Interval,
    Mesh,
    Metres,
    Metric,
    Receiver,
    Returns,
    Scene,
    Score,
    Split,
    Vector,
    inverse_rigid,
)
from lidardesign_tasks.face import FaceTask, HeadConfig, head_scenes
from lidardesign_tasks.importance import WEIGHING_KEYS
from lidardesign_tasks.surface import surface_informs, surface_score

FieldAngle = Annotated[float, Field(gt=0, lt=180)]


class EmitterConfig(HeadConfig):
    """Heads, the detector in front of them, and bounds of emitters."""

    detector_m: Vector = Field((0.40, 0.0, 0.0), description="place of the detector [m]; the nose tip is at 0")
    detector_azimuth_deg: float = Field(180.0, ge=-360, le=360, description="where the detector looks [deg]")
    detector_elevation_deg: float = Field(0.0, ge=-90, le=90, description="and its elevation [deg]")
    field_of_view_deg: tuple[FieldAngle, FieldAngle] = Field(
        (60.0, 50.0), description="the detector's whole horizontal and vertical field of view [deg]"
    )
    emitter_box_m: Metres | Vector = Field(
        (0.03, 0.15, 0.15), description="half size of the box of emitter places around the detector [m]"
    )
    half_angle_deg: float = Field(
        40.0, gt=0, le=80, description="emitted azimuth and elevation span +- this around the detector's [deg]"
    )
    range_m: Interval = Field(
        (0.05, 1.05), description="shortest and longest one-way range of emitters and detector [m]"
    )

    @field_validator("range_m")
    @classmethod
    def _ascending(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0 <= value[0] < value[1]:
            raise ValueError("the shortest range is 0 m or more, and the longest above it")
        return value

    @field_validator("emitter_box_m")
    @classmethod
    def _not_negative(cls, value: float | Vector) -> float | Vector:
        if np.min(value) < 0:
            raise ValueError("half sizes are 0 m or more")
        return value

    @property
    def receiver(self) -> Receiver:
        """The detector of every scene."""
        horizontal, vertical = (math.radians(angle) for angle in self.field_of_view_deg)
        return Receiver(
            origin_m=self.detector_m,
            azimuth_rad=math.radians(self.detector_azimuth_deg),
            elevation_rad=math.radians(self.detector_elevation_deg),
            horizontal_rad=horizontal,
            vertical_rad=vertical,
            range_m=self.range_m,
        )


class EmitterTask:
    """Light unknown faces for a fixed detector, and reconstruct their surface from few rays."""

    name: ClassVar[str] = "emitter"
    summary: ClassVar[str] = "emitters around a fixed smartphone-like detector, 0.40 m in front of a face"
    api_version: ClassVar[int] = 1
    weighing_keys: ClassVar[tuple[str, ...]] = WEIGHING_KEYS
    Config: ClassVar[type[EmitterConfig]] = EmitterConfig
    metric: ClassVar[Metric] = FaceTask.metric
    defaults: ClassVar[Defaults] = Defaults(rays=(100, 196, 361, 576), level=0.99, density={"sigma_m": 0.005})

    def space(self, config: EmitterConfig) -> DesignSpace:
        """Emitter origins in a box around the detector, directions around its boresight."""
        half = np.broadcast_to(np.asarray(config.emitter_box_m, dtype=np.float64), 3)
        centre, angle = np.array(config.detector_m), math.radians(config.half_angle_deg)
        azimuth, elevation = math.radians(config.detector_azimuth_deg), math.radians(config.detector_elevation_deg)
        bottom, top = max(elevation - angle, -math.pi / 2), min(elevation + angle, math.pi / 2)
        return DesignSpace(
            low=(*(centre - half).tolist(), azimuth - angle, bottom, config.range_m[0]),
            high=(*(centre + half).tolist(), azimuth + angle, top, config.range_m[1]),
        )

    def scenes(
        self, config: EmitterConfig, split: Split, seed: int, space: DesignSpace | None = None
    ) -> Sequence[Scene]:
        """The heads of the task `face` with the detector in front of them, see `head_scenes`.

        Raises:
            ConfigError: The detector is inside a head.
        """
        scenes = head_scenes(config, space or self.space(config), split, seed, config.receiver)
        for scene in scenes:
            head = scene.bodies[0]
            place = inverse_rigid(head.pose()) @ (*config.detector_m, 1.0)
            if winding_number(head.shape, place[:3]) > 0.5:
                raise ConfigError(
                    f"the detector at {list(config.detector_m)} is inside the {scene.name}",
                    where="task.detector_m",
                    allowed="a place in front of all heads, whose nose tips are at 0 and look along x",
                )
        return scenes

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Chamfer distance between the reconstruction and the visible part of the face [mm]."""
        return surface_score(self.metric, scene, returns)

    def informs(self, scene: Scene, returns: Sequence[Returns], share: float) -> Information:
        """Information of returns about points of the visible face, larger for nearer points."""
        return surface_informs(scene, returns, share)


def winding_number(mesh: Mesh, point: np.ndarray) -> float:
    """Generalised winding number of a mesh around a point (3,) [m]: 1 inside of a closed one, 0 outside.

    The sum of the solid angles of its triangles (van Oosterom and Strackee 1983) over 4 pi.
    """
    a, b, c = np.moveaxis((mesh.vertices - point)[mesh.faces], 1, 0)
    length_a, length_b, length_c = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.einsum("nk,nk->n", a, np.cross(b, c))
    around = length_a * length_b * length_c
    for one, other, length in ((a, b, length_c), (b, c, length_a), (c, a, length_b)):
        around += np.einsum("nk,nk->n", one, other) * length
    return float(np.arctan2(volume, around).sum() / (2 * math.pi))
