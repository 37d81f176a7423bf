"""Tracking the ball that a robot arm carries: sensors on the ceiling, pick-and-place below, occlusion by the arm.

World frame: the arm stands at the origin on the floor z = 0 and works on its +x side; the ceiling is z = 1 m.
The task of Behari et al. 2026, experiment B: a KUKA LBR iiwa 14 whose end effector is tracked.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from lidardesign import (
    Body,
    ConfigError,
    Defaults,
    DesignSpace,
    Information,
    Interval,
    Metric,
    Returns,
    Scene,
    Score,
    Sphere,
    Split,
    metrics,
    random_generator,
    rigid,
)
from lidardesign_tasks.robot.arm_motion import Arm, Motion
from lidardesign_tasks.robot.arm_robot import BALL_RADIUS_M, Robot, load_robot
from lidardesign_tasks.robot.tracking import FEWEST_FRAMES, MEAN_DEPTH, filled_path, path_information, tracked_places
from lidardesign_tasks.surroundings import MovingSurroundings

CEILING_M = 1.0
SMALL = {"train": 4, "test": 4, "frames": 12}


class ArmConfig(MovingSurroundings):
    """The arm, number, length and variation of its trajectories, the surroundings, and bounds of sensors."""

    size: Literal["full", "small"] = Field(
        "full", description="small: 4 trajectories of 12 frames in each split unless set otherwise, for trials"
    )
    robot: Path | None = Field(
        None, description="MJCF file of an arm with 7 hinges; empty: the embedded arm of primitive links"
    )
    train: int = Field(40, ge=1, le=10_000, description="training trajectories")
    test: int = Field(40, ge=1, le=10_000, description="held-out trajectories")
    frames: int = Field(50, ge=4, le=1000, description="time frames of a trajectory")
    duration_s: float = Field(8.0, ge=1, le=120, description="time of a trajectory [s]")
    jitter_m: float = Field(
        0.1, ge=0, le=0.3, description="pick and place points differ by up to this much along each axis [m]"
    )
    tool_m: float = Field(0.15, ge=0.05, le=0.3, description="from the flange to the ball's centre [m]")
    elevation_max_deg: float = Field(
        -60.0, gt=-90, le=0, description="the flattest elevation of a ray; -90 looks straight down [deg]"
    )
    range_m: Interval = Field((0.1, 2.0), description="shortest and longest range [m]")

    @model_validator(mode="before")
    @classmethod
    def _small(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("size") == "small":
            return {**SMALL, **values}
        return values


class ArmTask:
    """Track the ball that an arm carries through a pick-and-place cycle."""

    name: ClassVar[str] = "arm"
    summary: ClassVar[str] = "tracking what a 7-axis robot arm carries, with sensors on the ceiling"
    api_version: ClassVar[int] = 1
    Config: ClassVar[type[ArmConfig]] = ArmConfig
    metric: ClassVar[Metric] = Metric("Frechet distance", "m", "lower", worst=1.0, tolerance=0.002)
    defaults: ClassVar[Defaults] = Defaults(
        rays=(400, 1000, 1200),
        level=0.99,  # a path is as bad as its worst frame, so a lost return costs more than a bin
        density={"sigma_m": 0.025, "surface_tolerance_nats": 10.0},
    )

    def space(self, config: ArmConfig) -> DesignSpace:
        """Origins on the ceiling, the full turn, from straight down to the flattest elevation."""
        return DesignSpace(
            low=(-1.0, -1.0, CEILING_M, 0.0, -math.pi / 2, config.range_m[0]),
            high=(1.0, 1.0, CEILING_M, 2 * math.pi, math.radians(config.elevation_max_deg), config.range_m[1]),
        )

    def scenes(self, config: ArmConfig, split: Split, seed: int) -> Sequence[Scene]:
        """Random pick-and-place cycles; each has a generator of its own, so counts do not change them.

        Raises:
            DataError: The robot cannot be used, or can perform none of the drawn motions.
            ConfigError: All cycles would be the same.
        """
        if config.jitter_m == 0:
            raise ConfigError(
                "without jitter all trajectories are nearly the same, so held-out ones would not be new",
                where="task.jitter_m",
                hint="set jitter_m above 0",
            )
        robot = load_robot(config.robot, config.tool_m)
        arm, rate_hz = Arm(robot, CEILING_M), config.frames / config.duration_s
        motions = []
        for index in range(config.train if split == "train" else config.test):
            generator = random_generator(seed, "arm", split, index)
            motions.append(arm.draw(config.jitter_m, config.frames, rate_hz, generator, f"{split} {index}"))
        notes = (*robot.notes, *rejection_notes(motions, split))
        named = [(f"{split} {index}", motion) for index, motion in enumerate(motions)]
        return [config.around(_scene(robot, motion, name, rate_hz, notes)) for name, motion in named]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Discrete Frechet distance [m] between the tracked path and the ball's; fails below two tracked frames."""
        frames, places = _tracked(scene, returns)
        details = {"tracked_share": len(frames) / scene.frames}
        if len(frames) < FEWEST_FRAMES:
            return Score(self.metric.worst, failed=True, details=details)
        path = filled_path(frames, places, scene.frames)
        return Score(min(metrics.discrete_frechet_m(path, scene.truth["ball_m"]), self.metric.worst), details=details)

    def informs(self, scene: Scene, returns: Sequence[Returns]) -> Information:
        """Information of returns on the ball about its position in their own and in neighbouring frames."""
        return path_information(returns, [np.array([_target(scene)])], scene.truth["ball_m"][None])

    def features(self, scene: Scene, returns: Returns) -> np.ndarray:
        """The tracked place of the ball in a frame, (3,) [m]; not a number without a return of it."""
        _, places = _tracked(scene, [returns])
        return places[0] if len(places) else np.full(3, np.nan)


def _tracked(scene: Scene, returns: Sequence[Returns]) -> tuple[np.ndarray, np.ndarray]:
    """Frames with returns of the ball, and its position in each [m], see `tracked_places`.

    The poses of the robot's own links are known, so their returns are discarded; false alarms are not, and count as the
    ball.
    """
    target = _target(scene)
    taken = [(one.body == target) | (one.body < 0) for one in returns]
    return tracked_places(returns, taken, MEAN_DEPTH * scene.bodies[target].shape.radius_m)


def _target(scene: Scene) -> int:
    return next(index for index, body in enumerate(scene.bodies) if body.is_target)


def rejection_notes(motions: Sequence[Motion], split: str) -> tuple[str, ...]:
    """A note on drawn motions that the arm cannot perform; none where it can perform all."""
    rejected = sum((motion.rejected for motion in motions), Counter())
    if not rejected:
        return ()
    reasons = ", ".join(f"{count} {reason}" for reason, count in rejected.most_common())
    return (f"{split}: motions that the arm cannot perform were drawn again: {reasons}",)


def _scene(robot: Robot, motion: Motion, name: str, rate_hz: float, notes: tuple[str, ...]) -> Scene:
    ball = np.stack([rigid(translation_m=place) for place in motion.ball_m])
    links = [
        Body(link.shape, link.name, "occluder", _steady(poses))
        for link, poses in zip(robot.links, motion.links, strict=True)
    ]
    truth = {"ball_m": motion.ball_m, "time_s": motion.time_s, "joints_rad": motion.joints_rad}
    truth["rejected"] = dict(motion.rejected)
    return Scene((Body(Sphere(BALL_RADIUS_M), "ball", "target", ball), *links), name, truth, rate_hz, notes)


def _steady(poses: np.ndarray) -> np.ndarray:
    """A single pose (4, 4) of a body at rest, or all poses (F, 4, 4) of a moving one."""
    return poses[0] if (poses == poses[0]).all() else poses
