"""Flash-LiDAR face scanning: choice of rays from a single origin in front of a head.

World frame: the nose of the mean head points along +x with its tip at the origin, z is up. The sensor is at
(distance, 0, 0) and looks back at the face. Heads are random identities of a morphable model (the embedded
one, or any in the layout of the Basel Face Model) with a small random pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from lidardesign import (
    Body,
    ConfigError,
    Defaults,
    DesignSpace,
    Information,
    Interval,
    Mesh,
    Metric,
    Receiver,
    Returns,
    Scene,
    Score,
    Sign,
    Split,
    mesh_files,
    random_generator,
)
from lidardesign_tasks.basel import MorphableModel, Unit, load_model
from lidardesign_tasks.importance import WEIGHING_KEYS, Importance, middle_of_origins
from lidardesign_tasks.poses import jittered_pose
from lidardesign_tasks.surface import surface_informs, surface_score, with_visible_truth
from lidardesign_tasks.surroundings import any_direction
from lidardesign_tasks.view import OriginBox

# columns: the world's x, y, z are the model's z (out of the face), x (to the head's left) and y (up)
WORLD_AXES = [2, 0, 1]
LARGEST_COEFFICIENT = 3.0  # identity coefficients are clipped to this many standard deviations


class HeadConfig(Importance):
    """The model, number, variation and motion of heads, points of their truth, importance, and surroundings."""

    model: Path | None = Field(None, description="HDF5 file of a morphable model; empty: the embedded head model")
    unit: Unit = Field("auto", description="unit of length of the model file")
    sign: Sign = Field("auto", description="inside rule of the head's surface; auto: unsigned where it is open")
    train: int = Field(50, ge=1, le=10_000, description="training heads")
    test: int = Field(50, ge=1, le=10_000, description="held-out heads")
    modes: int = Field(100, ge=1, le=10_000, description="use at most this many modes of the model")
    identity_scale: float = Field(1.0, ge=0, le=3, description="scale of the identity coefficients; 0: the mean head")
    jitter_rotation_deg: float = Field(4.0, ge=0, le=60, description="standard deviation of the pose [deg]")
    jitter_translation_m: float = Field(0.008, ge=0, le=0.5, description="standard deviation of the place [m]")
    truth_points: int = Field(
        5000, ge=100, le=200_000, description="points of the visible surface that scores compare with"
    )
    speed_m_s: float = Field(0.0, ge=0, le=100, description="how fast heads move within a frame, in any direction")


class FaceConfig(HeadConfig):
    """Heads, and bounds of the sensor in front of them."""

    distance_m: float = Field(0.40, ge=0.1, le=5, description="from the mean nose tip to the sensor [m]")
    origin_box_m: OriginBox = Field(0.0, description="half size of the box of sensor origins [m]; 0: fixed")
    half_angle_deg: float = Field(30.0, gt=0, le=80, description="azimuth and elevation span +- this [deg]")
    range_m: Interval = Field((0.05, 1.05), description="shortest and longest range [m]")


class FaceTask:
    """Reconstruct the surface of unknown faces from few rays."""

    name: ClassVar[str] = "face"
    summary: ClassVar[str] = "flash-LiDAR face scanning on heads of a morphable model, 0.40 m in front of the face"
    api_version: ClassVar[int] = 1
    weighing_keys: ClassVar[tuple[str, ...]] = WEIGHING_KEYS
    Config: ClassVar[type[FaceConfig]] = FaceConfig
    metric: ClassVar[Metric] = Metric("Chamfer distance", "mm", "lower", worst=200.0, tolerance=0.1)
    defaults: ClassVar[Defaults] = Defaults(rays=(36, 100, 196, 361, 576), density={"sigma_m": 0.005})

    def space(self, config: FaceConfig) -> DesignSpace:
        """Origins in a box around (distance, 0, 0), directions around -x."""
        half = np.broadcast_to(np.asarray(config.origin_box_m, dtype=np.float64), 3)
        angle, centre = math.radians(config.half_angle_deg), np.array([config.distance_m, 0.0, 0.0])
        return DesignSpace(
            low=(*(centre - half).tolist(), math.pi - angle, -angle, config.range_m[0]),
            high=(*(centre + half).tolist(), math.pi + angle, angle, config.range_m[1]),
        )

    def scenes(self, config: FaceConfig, split: Split, seed: int, space: DesignSpace | None = None) -> Sequence[Scene]:
        """Random heads, see `head_scenes`."""
        return head_scenes(config, space or self.space(config), split, seed)

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Chamfer distance between the reconstruction and the visible part of the face [mm]."""
        return surface_score(self.metric, scene, returns)

    def informs(self, scene: Scene, returns: Sequence[Returns], share: float) -> Information:
        """Information of returns about points of the visible face, larger for nearer points."""
        return surface_informs(scene, returns, share)


def head_scenes(
    config: HeadConfig, space: DesignSpace, split: Split, seed: int, receiver: Receiver | None = None
) -> list[Scene]:
    """Random heads; each has generators of its own, so counts do not change them.

    Arguments:
        config: Configuration of the heads.
        space: The design space, for which truths are computed.
        split: Training or held-out heads.
        seed: Seed of all heads.
        receiver: A fixed receiver in every scene.

    Raises:
        DataError: The model cannot be used, or no ray can reach a head.
        ConfigError: All heads would be the same.
    """
    if config.identity_scale == 0 and config.jitter_rotation_deg == 0 and config.jitter_translation_m == 0:
        raise ConfigError(
            "without identities and pose jitter all heads are the same, so held-out ones would not be new",
            where="task.identity_scale",
            hint="set identity_scale, jitter_rotation_deg or jitter_translation_m above 0",
        )
    heads = HeadFamily.load(config)
    heads.weigh(config, middle_of_origins(space))
    count = config.train if split == "train" else config.test
    return [heads.scene(config, space, split, seed, index, receiver) for index in range(count)]


class HeadFamily:
    """The heads of a model in the world frame: cleaned faces, sign rule, and the nose tip as origin.

    Importance is computed on the mean head, and used for the same vertices of all heads.
    """

    def __init__(self, model: MorphableModel, sign: Sign, where: str) -> None:
        self.model = model
        notes = list(model.notes)
        self.faces = mesh_files.usable_faces(model.mean, model.faces, notes)
        checked = mesh_files.check_mesh(model.mean, self.faces, sign=sign, where=where)
        self.sign, self.notes = checked.sign, (*notes, *checked.notes)
        mean = model.mean[:, WORLD_AXES]
        self.nose_tip = mean[mean[:, 0].argmax()]
        self.centre = (mean - self.nose_tip)[np.unique(self.faces)].mean(axis=0)
        self.weights: np.ndarray | None = None

    @classmethod
    def load(cls, config: HeadConfig) -> HeadFamily:
        """The family of a configuration.

        Raises:
            DataError: The model cannot be used; see `load_model` and `check_mesh`.
        """
        if config.model is not None:
            model = load_model(config.model, unit=config.unit, modes=config.modes)
            return cls(model, config.sign, str(config.model))
        return cls(_embedded_model(config.modes), config.sign, "the embedded head model")

    def weigh(self, importance: Importance, viewpoint_m: np.ndarray) -> None:
        """Set the importance of all heads to that of the mean one, seen from a viewpoint (3,) [m].

        Raises:
            ConfigError: The region of interest is beside the head, or roughness cannot be measured.
        """
        mean = self.mesh(np.zeros(0)).vertices
        importance.refuse_empty_region([mean])
        self.weights = importance.weights(mean, self.faces, viewpoint_m)

    def mesh(self, coefficients: np.ndarray) -> Mesh:
        """The head with standardised coefficients, in the world frame before its pose."""
        vertices = self.model.shape(coefficients)[:, WORLD_AXES] - self.nose_tip
        return Mesh(vertices, self.faces, self.sign, self.notes, self.weights)

    def scene(
        self,
        config: HeadConfig,
        space: DesignSpace,
        split: Split,
        seed: int,
        index: int,
        receiver: Receiver | None = None,
    ) -> Scene:
        """A random head of a split with its pose and truth."""
        drawn = random_generator(seed, "face", split, index, "identity").normal(size=len(self.model.modes))
        coefficients = config.identity_scale * np.clip(drawn, -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
        pose = jittered_pose(
            random_generator(seed, "face", split, index, "pose"),
            config.jitter_rotation_deg,
            config.jitter_translation_m,
            self.centre,
        )
        head = Body(self.mesh(coefficients), "head", "both", pose)
        scene = Scene((head,), f"{split} head {index}", receiver=receiver)
        generator = random_generator(seed, "face", split, index, "truth")
        judged = with_visible_truth(scene, space, config.truth_points, generator)
        direction = any_direction(random_generator(seed, "face", split, index, "velocity"))
        return config.around(judged, config.speed_m_s * direction)


@lru_cache(maxsize=1)
def _embedded_model(modes: int) -> MorphableModel:
    with as_file(files("lidardesign_tasks") / "data" / "head_model.h5") as path:
        return load_model(path, modes=modes)
