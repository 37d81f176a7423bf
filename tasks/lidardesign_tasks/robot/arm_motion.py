"""Pick-and-place motion: way-points, minimum-jerk timing, inverse kinematics, and rejection of infeasible motions."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from lidardesign import Capsule, ConfigError, DataError, Mesh, Shape, Sphere, half_extents_m, mujoco_models
from lidardesign_tasks.robot.arm_robot import BALL, BALL_RADIUS_M, Robot
from lidardesign_tasks.robot.motion import minimum_jerk

HOVER_M = np.array([0.5, 0.0, 0.35])
PICK_M = np.array([0.45, -0.35, 0.15])
PLACE_M = np.array([0.45, 0.35, 0.15])
LIFT_M = (0.12, 0.20)  # height at which the ball is carried above the pick and place points
FINAL_DESCENT_M = 0.05
LOWEST_M = BALL_RADIUS_M + 0.01
CLEARANCE_M = 0.07  # between the highest point of the arm and the ceiling
MAX_STEP_M = 0.05  # way-points of the inverse kinematics are not further apart
STEPS_PER_WAYPOINT = 3
FIRST_STEPS = 60  # the first way-point is reached from the home posture
POSITION_RESIDUAL_M = 1e-3
TILT_RESIDUAL_RAD = math.radians(0.5)
POSTURE_COST = 1e-2  # determines elbow and yaw, far below the costs of 1 per m and per rad of the ball's pose
LARGEST_TURN_RAD_S = math.radians(135)  # of the fastest joint in the arm's data sheet
PENETRATION_M = 5e-3
TRIES = 50


class RejectedError(Exception):
    """A drawn motion that the arm cannot perform; reasons are counted by message."""


def import_mink() -> Any:
    """Import mink, inverse kinematics for MuJoCo; raises ConfigError where it is missing."""
    try:
        return import_module("mink")
    except ImportError as error:
        raise ConfigError(
            f"the arm task needs mink, which cannot be imported ({error})",
            where="task arm",
            hint="pip install mujoco mink",
        ) from error


@dataclass(frozen=True, eq=False)
class Motion:
    """One pick-and-place cycle.

    Arguments:
        time_s: Times of the frames, shape (F,).
        joints_rad: Joint angles, shape (F, 7).
        ball_m: The ball's centre by forward kinematics [m], shape (F, 3).
        links: Poses of the bodies of the robot's links, shape (L, F, 4, 4).
        rejected: Number of drawn motions that were rejected before this one, by reason.
    """

    time_s: np.ndarray
    joints_rad: np.ndarray
    ball_m: np.ndarray
    links: np.ndarray
    rejected: Counter[str]


def draw_waypoints(jitter_m: float, generator: np.random.Generator) -> np.ndarray:
    """Places of the ball between the phases approach, pick, retract, transit, descent and place, shape (7, 3) [m]."""
    pick, place = (point + generator.uniform(-jitter_m, jitter_m, 3) for point in (PICK_M, PLACE_M))
    pick[2], place[2] = max(pick[2], LOWEST_M), max(place[2], LOWEST_M)
    lifts = generator.uniform(*LIFT_M, 2)
    up = np.array([0.0, 0.0, 1.0])
    above_pick, above_place = pick + lifts[0] * up, place + lifts[1] * up
    return np.stack([HOVER_M, above_pick, pick, above_pick, above_place, place + FINAL_DESCENT_M * up, place])


def phase_shares(waypoints: np.ndarray) -> np.ndarray:
    """Shares of the time at which phases end, (W, 3) to (W,), from 0 to 1: all have the same peak acceleration.

    A minimum-jerk phase of length L and time T peaks at 5.77 L / T^2, so T goes with the root of L.
    """
    durations = np.sqrt(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))
    return np.concatenate([[0.0], np.cumsum(durations) / durations.sum()])


def ball_path(waypoints: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Positions of the ball at shares of the time, (N,) to (N, 3) [m]."""
    ends = phase_shares(waypoints)
    phase = np.clip(np.searchsorted(ends, share, side="right") - 1, 0, len(ends) - 2)
    along = minimum_jerk((share - ends[phase]) / (ends[phase + 1] - ends[phase]))
    return waypoints[phase] + along[:, None] * (waypoints[phase + 1] - waypoints[phase])


class Arm:
    """A robot arm with the state for inverse kinematics."""

    def __init__(self, robot: Robot, ceiling_m: float) -> None:
        self.robot, self.mink, self.mujoco = robot, import_mink(), mujoco_models.import_mujoco()
        mink = self.mink
        self.highest_m = ceiling_m - CLEARANCE_M
        self.configuration = mink.Configuration(robot.model)
        self.reach = mink.FrameTask(BALL, "site", position_cost=1.0, orientation_cost=[1.0, 1.0, 0.0])
        self.posture = mink.PostureTask(robot.model, cost=POSTURE_COST)
        self.posture.set_target(robot.home_rad)
        self.limits = [mink.ConfigurationLimit(robot.model)]
        self.site = robot.model.site(BALL).id
        self.bodies = np.array([link.body for link in robot.links])

    def draw(self, jitter_m: float, frames: int, rate_hz: float, generator: np.random.Generator, name: str) -> Motion:
        """Draw motions until the arm can perform one.

        Raises:
            DataError: The arm can perform none of `TRIES` motions.
        """
        rejected: Counter[str] = Counter()
        for _ in range(TRIES):
            try:
                return self.follow(draw_waypoints(jitter_m, generator), frames, rate_hz, rejected)
            except RejectedError as reason:
                rejected[str(reason)] += 1
        counts = ", ".join(f"{count} {reason}" for reason, count in rejected.most_common())
        raise DataError(
            f"the arm can perform none of {TRIES} drawn motions ({counts})",
            where=f"task.robot, trajectory {name}",
            hint="lower jitter_m, raise duration_s, or use an arm that reaches 0.4 to 0.75 m around its base",
        )

    def follow(self, waypoints: np.ndarray, frames: int, rate_hz: float, rejected: Counter[str]) -> Motion:
        """The motion along way-points of the ball; raises `RejectedError`."""
        with mujoco_models.mujoco_warnings():
            joints = self._solve(waypoints, frames)
            time_s = np.arange(frames) / rate_hz
            ball, links = self._forward(joints, rate_hz)
        self._check_height(links)
        return Motion(time_s, joints, ball, links, rejected)

    def _solve(self, waypoints: np.ndarray, frames: int) -> np.ndarray:
        """Joint angles of all frames, shape (F, 7), solved at positions at most `MAX_STEP_M` apart."""
        share = np.linspace(0.0, 1.0, frames)
        places = ball_path(waypoints, share)
        self.configuration.update(self.robot.home_rad)
        self._reach(places[0], FIRST_STEPS)
        joints = [self.configuration.q.copy()]
        for start, end in zip(range(frames - 1), range(1, frames), strict=True):
            pieces = max(1, math.ceil(np.linalg.norm(places[end] - places[start]) / MAX_STEP_M))
            for target in ball_path(waypoints, np.linspace(share[start], share[end], pieces + 1)[1:]):
                self._reach(target, STEPS_PER_WAYPOINT)
            joints.append(self.configuration.q.copy())
        return np.stack(joints)

    def _reach(self, target: np.ndarray, steps: int) -> None:
        """Bring the ball to a place with the tool pointing down; the yaw stays near the home posture's."""
        mink, configuration = self.mink, self.configuration
        for step in range(steps + 1):
            here, rotation = self._ball()
            if self._arrived(here, rotation, target):
                return
            if step == steps:
                raise RejectedError("out of reach")
            pose = mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(_pointing_down(rotation)), target)
            self.reach.set_target(pose)
            try:
                velocity = mink.solve_ik(
                    configuration, [self.reach, self.posture], 1.0, solver="daqp", limits=self.limits
                )
            except mink.NoSolutionFound as error:
                raise RejectedError("out of reach") from error
            if not np.isfinite(velocity).all():
                raise RejectedError("diverged")
            configuration.integrate_inplace(velocity, 1.0)

    def _ball(self) -> tuple[np.ndarray, np.ndarray]:
        data = self.configuration.data
        return data.site_xpos[self.site].copy(), data.site_xmat[self.site].reshape(3, 3).copy()

    def _arrived(self, here: np.ndarray, rotation: np.ndarray, target: np.ndarray) -> bool:
        tilt = math.atan2(math.hypot(rotation[0, 2], rotation[1, 2]), -rotation[2, 2])
        return np.linalg.norm(here - target) <= POSITION_RESIDUAL_M and tilt <= TILT_RESIDUAL_RAD

    def _forward(self, joints: np.ndarray, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
        """Ball centres (F, 3) and link poses (L, F, 4, 4) by forward kinematics, with MuJoCo's own checks."""
        mujoco, model = self.mujoco, self.robot.model
        data = mujoco.MjData(model)
        velocity = np.gradient(joints, 1 / rate_hz, axis=0)
        if np.abs(np.diff(joints, axis=0)).max() * rate_hz > LARGEST_TURN_RAD_S:
            raise RejectedError("joints too fast")
        ball = np.zeros((len(joints), 3))
        links = np.tile(np.eye(4), (len(self.bodies), len(joints), 1, 1))
        for frame, angles in enumerate(joints):
            data.qpos[:], data.qvel[:] = angles, velocity[frame]
            mujoco.mj_checkPos(model, data)
            mujoco.mj_checkVel(model, data)
            mujoco.mj_forward(model, data)
            mujoco.mj_checkAcc(model, data)
            self._check_state(data)
            ball[frame] = data.site_xpos[self.site]
            links[:, frame, :3, :3] = data.xmat[self.bodies].reshape(-1, 3, 3)
            links[:, frame, :3, 3] = data.xpos[self.bodies]
        own = np.stack([link.pose for link in self.robot.links])
        return ball, links @ own[:, None]

    def _check_state(self, data: Any) -> None:
        if not (np.isfinite(data.qpos).all() and np.isfinite(data.qacc).all() and np.isfinite(data.xpos).all()):
            raise RejectedError("diverged")
        if data.warning.number.any():
            raise RejectedError("MuJoCo warned")
        if data.ncon and data.contact.dist[: data.ncon].min() < -PENETRATION_M:
            raise RejectedError("links collide")

    def _check_height(self, links: np.ndarray) -> None:
        for link, poses in zip(self.robot.links, links, strict=True):
            if highest_m(link.shape, poses) > self.highest_m:
                raise RejectedError("too near the ceiling")


def _pointing_down(rotation: np.ndarray) -> np.ndarray:
    """Rotation with the third axis straight down and the first axis nearest to the given one's, shape (3, 3)."""
    first = np.array([rotation[0, 0], rotation[1, 0], 0.0])
    if not first.any():
        first = np.array([1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    down = np.array([0.0, 0.0, -1.0])
    return np.stack([first, np.cross(down, first), down], axis=1)


def highest_m(shape: Shape, poses: np.ndarray) -> float:
    """Upper bound of the height of a shape over its poses (F, 4, 4), exact for balls and capsules [m]."""
    middle, up = poses[:, 2, 3], poses[:, 2, :3]
    if isinstance(shape, Sphere | Capsule):
        along_m = shape.half_length_m if isinstance(shape, Capsule) else 0.0
        return float((middle + np.abs(up[:, 2]) * along_m + shape.radius_m).max())
    low, high = shape.bounds_m if isinstance(shape, Mesh) else np.outer((-1.0, 1.0), half_extents_m(shape))
    return float((middle + up @ (low + high) / 2 + np.abs(up) @ (high - low) / 2).max())
