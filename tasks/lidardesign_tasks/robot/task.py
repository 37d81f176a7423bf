"""Your robot: any model that MuJoCo loads, its motion, and sensors in the world or on one of its bodies.

The frame is the model's world, z up, or that of the body that sensors are mounted on: then everything moves around the
sensors. Without a given motion the robot moves at random, free of collisions.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from lidardesign import (
    ConfigError,
    Defaults,
    DesignSpace,
    FolderConfig,
    Information,
    Interval,
    Metric,
    Returns,
    Scene,
    Score,
    Split,
    Vector,
    random_generator,
)
from lidardesign_tasks.robot.measures import METRICS, TOLERATED_SHARE, Measure, features, informs, score, with_truth
from lidardesign_tasks.robot.motion import (
    Trajectory,
    held_out,
    keyframes,
    wandering,
    window_frames,
    windows,
)
from lidardesign_tasks.robot.recordings import ENDINGS, Recording, read_recordings
from lidardesign_tasks.robot.targets import Model, read_model, refuse_sensors_inside
from lidardesign_tasks.surface import MILLIMETRES
from lidardesign_tasks.surroundings import MovingSurroundings
from lidardesign_tasks.units import doubtful_times
from lidardesign_tasks.view import OriginBox, space_around

# names may be given alone or as a list
# MuJoCo shows geoms in six groups.
Group = Annotated[int, Field(ge=0, le=5)]
Patterns = Annotated[tuple[str, ...], BeforeValidator(lambda given: [given] if isinstance(given, str) else given)]
SENSOR_DISTANCE = 2.0  # extents
ROOM = 1.1  # around the sphere that holds the targets wherever they move
ABOVE_MOUNT_M = 0.01
# Random motions, or times of each recording, that define the space in which targets move.
SPACE_MOTIONS, SPACE_MOMENTS = 12, 200
TOUCHING_M = 1e-3  # targets that move less are at rest


class MujocoConfig(FolderConfig, MovingSurroundings):
    """The model, its motion and targets, bounds of sensors, and the surroundings."""

    folders: ClassVar[dict[str, tuple[str, ...]]] = {"motion": ENDINGS}

    model: Path | None = Field(None, description="MJCF or URDF file of the robot and what stands around it")
    folder: Path | None = Field(None, description="folder that holds all files of the model; its own if empty")
    targets: Patterns = Field((), description="what to find: names of bodies or geoms, such as [hand*]")
    motion: Literal["random", "keyframes"] | Path = Field(
        "random", description="CSV or NPZ of joint positions over time (time_s and a column per joint; NAME.x, .y, .z, "
        ".qw, .qx, .qy, .qz of free ones), a folder of them, keyframes of the model, or random"
    )  # fmt: skip
    known: Patterns = Field(
        ("*",), description="bodies or geoms, other than targets, whose returns are recognised; by default all"
    )
    ignored: Patterns = Field((), description="bodies or geoms to leave out")
    groups: tuple[Group, ...] | None = Field(None, description="groups of geoms that are seen; 0, 1 and 2 if empty")
    mount_body: str | None = Field(None, description="the body that sensors are on; in the world if empty")
    origin_m: Vector | None = Field(
        None,
        description="place of the sensor in the mount's frame [m]; if empty: in front, 2 extents away, or on the mount",
    )
    origin_box_m: OriginBox = Field(0.0, description="half size of the box of sensor origins [m]; 0: fixed")
    range_m: Interval | None = Field(None, description="shortest and longest range [m]; from the targets if empty")
    metric: Measure = Field(
        "position",
        description="what is scored: position of targets [m], their surface [mm], or whether they are seen [%]",
    )
    frames: int = Field(20, ge=1, le=1000, description="time frames of a scene")
    frame_rate_hz: float = Field(10.0, gt=0, le=10_000, description="frames per second [Hz]")
    train: int = Field(40, ge=1, le=10_000, description="training scenes")
    test: int = Field(40, ge=1, le=10_000, description="held-out scenes")

    def held_out(self, files: Sequence[Path]) -> Sequence[Path]:
        """Half of several recordings."""
        return [files[i] for i in held_out(len(files))]


class MujocoTask:
    """Find parts of a robot, or things around it, that move as you say."""

    name: ClassVar[str] = "mujoco"
    summary: ClassVar[str] = "your own robot, as a MuJoCo model, with sensors in the world or on one of its bodies"
    api_version: ClassVar[int] = 1
    Config: ClassVar[type[MujocoConfig]] = MujocoConfig
    metric: ClassVar[Metric] = METRICS["position"]
    metrics: ClassVar[tuple[Metric, ...]] = (METRICS["surface"], METRICS["seen"])
    defaults: ClassVar[Defaults] = Defaults(density={"sigma_m": 0.02})

    def space(self, config: MujocoConfig) -> DesignSpace:
        """All directions and ranges of possible targets from the possible sensor origins."""
        model = model_of(config)
        low, high = _bounds(_corners_m(config, model))
        ahead = [max(SENSOR_DISTANCE * float((high - low).max()), 2 * _radius_m(low, high)), 0.0, 0.0]
        usual = (low + high) / 2 + ahead
        if config.mount_body is not None:
            usual = model.mount_top_m() + np.array([0.0, 0.0, ABOVE_MOUNT_M])
        origin = usual if config.origin_m is None else np.array(config.origin_m)
        half = np.broadcast_to(np.asarray(config.origin_box_m, dtype=np.float64), 3)
        space = space_around((low + high) / 2, _radius_m(low, high), origin, half)
        if config.range_m is None:
            return space
        return replace(space, low=(*space.low[:5], config.range_m[0]), high=(*space.high[:5], config.range_m[1]))

    def scenes(
        self, config: MujocoConfig, split: Split, seed: int, space: DesignSpace | None = None
    ) -> Sequence[Scene]:
        """Windows of the recordings of a split, or random motions; see `spans` and `Wanderer`.

        Raises:
            DataError: A file cannot be used, or the robot cannot move as it should.
            ConfigError: Unknown names, or sensors inside geometry.
        """
        model, metric, space = model_of(config), self.metric_of(config), space or self.space(config)
        origins_m = np.array(list(itertools.product(*zip(space.low[:3], space.high[:3], strict=True))))
        found = []
        for index, motion in enumerate(_trajectories(config, model, split, seed)):
            poses = model.poses(motion.qpos)
            refuse_sensors_inside(model, poses, np.unique(origins_m, axis=0))
            scene = Scene(model.bodies(poses), motion.name, frame_rate_hz=config.frame_rate_hz, notes=model.notes,
                          group=motion.group)  # fmt: skip
            generator = random_generator(seed, "mujoco", split, index, "truth")
            found.append(config.around(with_truth(scene, model, poses, config.metric, metric, space, generator)))
        return found

    def metric_of(self, config: MujocoConfig) -> Metric:
        """Metric with the worst value: the extent in which targets move, or of the largest target for surfaces."""
        metric, model = METRICS[config.metric], model_of(config)
        if config.metric == "seen":
            return metric
        low, high = _bounds(_corners_m(config, model))
        worst = float((high - low).max())
        if config.metric == "surface":
            worst = MILLIMETRES * max(float(np.ptp(target.box_m, axis=0).max()) for target in model.targets)
        return replace(metric, worst=worst, tolerance=TOLERATED_SHARE * worst)

    def mount_of(self, config: MujocoConfig) -> str | None:
        """Name of the body that carries the sensors; None: sensors in the world."""
        return config.mount_body

    def notes(self, config: MujocoConfig, space: DesignSpace) -> list[str]:
        """Notes on targets, known pieces, and the split of motions."""
        model, recordings = model_of(config), _recordings(config)
        names = ", ".join(target.name for target in model.targets)
        found = [f"targets: {names}; {len(model.pieces)} visible pieces, {int(model.known.sum())} of them known"]
        moved_m = np.ptp(_corners_m(config, model), axis=1).max(axis=(1, 2))
        resting = [target.name for target, way_m in zip(model.targets, moved_m, strict=True) if way_m < TOUCHING_M]
        if resting:
            found.append(f"{', '.join(resting)}: at the same place in all scenes; free bodies move only in recordings")
        if len(recordings) > 1:
            found.append(f"{len(recordings)} recordings, half of them held out")
        elif recordings:
            frames = window_frames(recordings, config.frames, config.frame_rate_hz)
            found.append(
                f"{recordings[0].name}: one recording of {recordings[0].seconds:.3g} s serves both splits: scenes are "
                f"windows of {frames} frames, of its first half for training, of its second half held out"
            )
        return found + doubtful_times({one.name: one.time_s for one in recordings})

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Score by the metric of the configuration; see `measures`."""
        return score(scene, returns)

    def informs(self, scene: Scene, returns: Sequence[Returns], share: float) -> Information:
        """Information of returns by the metric of the configuration."""
        return informs(scene, returns, share)

    def features(self, scene: Scene, returns: Returns) -> np.ndarray:
        """The mean place of what is taken for a target, (3,) [m]; not a number where nothing is."""
        return features(scene, returns)


def model_of(config: MujocoConfig) -> Model:
    """The model of a configuration; raises ConfigError without a model or targets."""
    if config.model is None:
        raise ConfigError("no model is set", where="task.model", hint="--set model=robot.xml")
    if not config.targets:
        raise ConfigError("no targets are set", where="task.targets", hint="--set 'targets=[hand*]'")
    names = (config.targets, config.ignored, config.known)
    return read_model(config.model, config.folder, *names, config.groups, config.mount_body)


def _recordings(config: MujocoConfig) -> list[Recording]:
    """The recordings of a configuration; none where motions are random."""
    if config.motion == "random":
        return []
    model = model_of(config).model
    if config.motion == "keyframes":
        return [keyframes(model, str(config.model))]
    return read_recordings(model, Path(config.motion), config)


def _trajectories(config: MujocoConfig, model: Model, split: Split, seed: int) -> list[Trajectory]:
    count, recordings = config.train if split == "train" else config.test, _recordings(config)
    if recordings:
        return windows(model.model, recordings, split, count, config.frames, config.frame_rate_hz, seed)
    where = f"task.model, {config.model}"
    return wandering(model.model, split, count, config.frames, config.frame_rate_hz, seed, where)


def _corners_m(config: MujocoConfig, model: Model) -> np.ndarray:
    """Corners of the targets' boxes over all recordings or a few random motions, shape (targets, F, 8, 3) [m]."""
    recordings = _recordings(config)
    if recordings:
        thinned = [one.qpos[:: max(1, len(one.qpos) // SPACE_MOMENTS)] for one in recordings]
    else:
        few = config.model_copy(update={"train": SPACE_MOTIONS})
        thinned = [one.qpos for one in _trajectories(few, model, "train", 0)]
    return model.corners_m(model.poses(np.concatenate(thinned)))


def _bounds(corners_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a box around all targets in all frames, (3,) each [m]."""
    return corners_m.min(axis=(0, 1, 2)), corners_m.max(axis=(0, 1, 2))


def _radius_m(low: np.ndarray, high: np.ndarray) -> float:
    return ROOM * float(np.linalg.norm(high - low)) / 2
