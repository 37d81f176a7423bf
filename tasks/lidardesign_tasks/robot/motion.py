"""Motion of a robot in each scene: windows of recordings, paths through keyframes, or random collision-free paths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lidardesign import DataError, Split, mujoco_models, random_generator
from lidardesign_tasks.robot.recordings import Recording

if TYPE_CHECKING:
    import mujoco

SPLIT_SEED = 0  # of the choice of held-out recordings, for all seeds of runs
MOVE_S = 1.0  # from one configuration to the next
FINEST_HZ = 100.0  # of the path through keyframes
TRIES, NEARER = 40, 0.85  # a configuration that collides is drawn again, each time nearer to rest
DEPTH_M = 1e-3  # smaller penetrations are contacts, no collisions
LIFTS, CHECKS = 4, 8


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Motion of a scene.

    Arguments:
        name: Name of the scene.
        group: Name of the independent draw: the recording, or the part of one.
        qpos: Joint configurations, shape (F, nq).
    """

    name: str
    group: str
    qpos: np.ndarray


def minimum_jerk(share: np.ndarray) -> np.ndarray:
    """Share of the path [0, 1] at shares of the time: from rest to rest with the least integrated squared jerk.

    Flash and Hogan, The coordination of arm movements, Journal of Neuroscience 5 (1985).
    """
    share = np.clip(share, 0.0, 1.0)
    return share**3 * (10 - 15 * share + 6 * share**2)


def joined(model: mujoco.MjModel, start: np.ndarray, end: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Minimum-jerk path between two configurations (nq,) at shares (F,) of its time, shape (F, nq)."""
    mujoco, way = mujoco_models.import_mujoco(), np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, way, 1.0, start, end)
    found = np.tile(start, (len(share), 1))
    for qpos, along in zip(found, minimum_jerk(share), strict=True):
        mujoco.mj_integratePos(model, qpos, way, float(along))
    return found


def keyframes(model: mujoco.MjModel, where: str) -> Recording:
    """Path through all keyframes of a model, in their order and back to the first.

    Raises:
        DataError: It has less than two.
    """
    if model.nkey < 2:
        raise DataError(
            f"the model has {model.nkey} keyframes", where=where, allowed="2 or more", hint="motion=random, or a file"
        )
    frames = round(MOVE_S * FINEST_HZ)
    share, keys = np.arange(frames) / frames, np.array(model.key_qpos)
    ways = [joined(model, start, end, share) for start, end in zip(keys, np.roll(keys, -1, axis=0), strict=True)]
    qpos = np.concatenate([*ways, keys[:1]])
    return Recording("keyframes", np.arange(len(qpos)) / FINEST_HZ, qpos)


def held_out(count: int) -> np.ndarray:
    """Indices of the held-out ones of several recordings, the same for all seeds."""
    return random_generator(SPLIT_SEED, "mujoco", "split").permutation(count)[: count // 2]


def spans(recordings: Sequence[Recording], split: Split) -> list[tuple[Recording, float, float]]:
    """Recordings of a split with the first and last time of their part in it [s].

    Half of several recordings is held out; of one, its second half.
    """
    if len(recordings) == 1:
        (one,) = recordings
        first, middle, last = one.time_s[0], one.time_s[0] + one.seconds / 2, one.time_s[-1]
        return [(one, first, middle) if split == "train" else (one, middle, last)]
    held = held_out(len(recordings))
    chosen = [one for i, one in enumerate(recordings) if (i in held) == (split == "test")]
    return [(one, one.time_s[0], one.time_s[-1]) for one in chosen]


def window_frames(recordings: Sequence[Recording], frames: int, rate_hz: float) -> int:
    """Number of frames in a window: at most `frames`, and at most those of the shortest part of a split."""
    shortest_s = min(last - first for split in ("train", "test") for _, first, last in spans(recordings, split))
    return min(frames, int(shortest_s * rate_hz) + 1)


def windows(
    model: mujoco.MjModel, recordings: Sequence[Recording], split: Split, count: int, frames: int, rate_hz: float,
    seed: int,
) -> list[Trajectory]:  # fmt: skip
    """`count` windows of a split's recordings, in turn, that begin at random times; see `spans`."""
    frames, shown = window_frames(recordings, frames, rate_hz), spans(recordings, split)
    # a few windows of many recordings show others with every seed
    order = random_generator(seed, "mujoco", split, "order").permutation(len(shown))
    length_s, found = (frames - 1) / rate_hz, []
    for index in range(count):
        recording, first, last = shown[order[index % len(shown)]]
        start = random_generator(seed, "mujoco", split, index).uniform(first, max(last - length_s, first))
        times = start + np.arange(frames) / rate_hz
        # of one recording, windows that may overlap are one group
        part = "" if len(recordings) > 1 or not length_s else f" {int((start - recording.time_s[0]) / length_s)}"
        name = f"{split} {index}: {recording.name} from {start:.2f} s"
        found.append(Trajectory(name, recording.name + part, recording.at(model, times)))
    return found


class Wanderer:
    """Random collision-free paths of a model; contacts that it has at rest are no collisions.

    Free bodies are raised out of the ground.
    """

    def __init__(self, model: mujoco.MjModel, where: str) -> None:
        self.mujoco, self.model, self.where = mujoco_models.import_mujoco(), model, where
        self.data = self.mujoco.MjData(model)
        rest = np.array(model.key_qpos[0] if model.nkey else model.qpos0)
        kinds = self.mujoco.mjtJoint
        self.straight = np.isin(model.jnt_type, (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)))
        self.limited = self.straight & (model.jnt_limited != 0)
        self.turning = self.straight & ~self.limited & (model.jnt_type == int(kinds.mjJNT_HINGE))
        self.balls = np.flatnonzero(model.jnt_type == int(kinds.mjJNT_BALL))
        standing = model.jnt_type == int(kinds.mjJNT_FREE)
        self.free, self.heights = model.jnt_bodyid[standing], model.jnt_qposadr[standing] + 2
        places = model.jnt_qposadr[self.limited]
        rest[places] = np.clip(rest[places], *model.jnt_range[self.limited].T)
        self.rest = rest
        self.allowed = self._contacts(rest)

    def draw(self, frames: int, rate_hz: float, generator: np.random.Generator) -> np.ndarray:
        """Draw a path of `frames` frames through a random configuration per `MOVE_S`, shape (F, nq).

        Raises:
            DataError: No path without collisions was found.
        """
        time_s = np.arange(frames) / rate_hz
        moves = max(1, math.ceil(time_s[-1] / MOVE_S))
        share = np.clip(time_s[None] / MOVE_S - np.arange(moves)[:, None], 0.0, 1.0)
        first = self._next(self.rest, np.ones(1), generator)
        here, stuck = (self.rest, 1) if first is None else (first[-1], 0)
        found = np.tile(here, (frames, 1))
        for move in range(moves):
            now = (time_s >= move * MOVE_S) & ((time_s < (move + 1) * MOVE_S) | (move == moves - 1))
            shares = np.append(share[move, now], 1.0)
            way = self._next(here, shares, generator)
            if way is None:
                # it came from rest without a collision, and can go back
                way, stuck = self._way(here, self.rest, shares), stuck + 1
            found[now], here = way[:-1], way[-1]
        if stuck > moves:
            raise DataError(
                f"{stuck * TRIES} random configurations collide", where=self.where, hint="motion=FILE.csv, or a model "
                "at rest with room to move"
            )  # fmt: skip
        return found

    def _next(self, here: np.ndarray, share: np.ndarray, generator: np.random.Generator) -> np.ndarray | None:
        """Path to a random configuration without collisions at shares of its time, reachable from rest without any.

        None where none of `TRIES` is free.
        """
        for attempt in range(TRIES):
            there = self._configuration(NEARER**attempt, generator)
            way = self._way(here, there, share)
            if self._free(way) and self._free(self._way(self.rest, there, np.linspace(0.0, 1.0, CHECKS))):
                return way
        return None

    def _configuration(self, reach: float, generator: np.random.Generator) -> np.ndarray:
        """Random joints within a share of their limits around rest; free bodies and unlimited slides rest."""
        model, qpos = self.model, self.rest.copy()
        low, high = model.jnt_range[self.limited].T
        places, turning = model.jnt_qposadr[self.limited], model.jnt_qposadr[self.turning]
        qpos[places] += reach * (generator.uniform(low, high) - qpos[places])
        qpos[turning] += reach * generator.uniform(-math.pi, math.pi, len(turning))
        way = np.zeros(model.nv)
        for ball in self.balls:
            axis = generator.normal(size=3)
            largest = model.jnt_range[ball, 1] if model.jnt_limited[ball] else math.pi
            angle = reach * generator.uniform(0.0, largest)
            way[model.jnt_dofadr[ball] :][:3] = angle * axis / np.linalg.norm(axis)
        self.mujoco.mj_integratePos(model, qpos, way, 1.0)
        return qpos

    def _way(self, start: np.ndarray, end: np.ndarray, share: np.ndarray) -> np.ndarray:
        return np.stack([self._lifted(qpos) for qpos in joined(self.model, start, end, share)])

    def _free(self, way: np.ndarray) -> bool:
        return all(self._contacts(qpos) <= self.allowed for qpos in way)

    def _lifted(self, qpos: np.ndarray) -> np.ndarray:
        """The configuration with free bodies raised out of fixed geometry."""
        model = self.model
        for _ in range(LIFTS if len(self.free) else 0):
            pairs, depth_m = self._inside(qpos)
            roots = model.body_rootid[model.geom_bodyid[pairs]]
            grounded = (model.body_weldid[model.geom_bodyid[pairs]] == 0).any(axis=1)
            lifts = [depth_m[grounded & (roots == root).any(axis=1)].max(initial=0.0) for root in self.free]
            if not any(lifts):
                break
            qpos[self.heights] += lifts
        return qpos

    def _contacts(self, qpos: np.ndarray) -> set[tuple[int, int]]:
        """Pairs of geoms that penetrate each other."""
        return set(map(tuple, self._inside(qpos)[0].tolist()))

    def _inside(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of geoms that penetrate each other, (C, 2), and the depths, (C,) [m]."""
        self.data.qpos[:] = qpos
        with mujoco_models.mujoco_warnings():
            self.mujoco.mj_fwdPosition(self.model, self.data)
        depth_m = -np.array(self.data.contact.dist[: self.data.ncon])
        deep = depth_m > DEPTH_M
        return np.sort(self.data.contact.geom[: self.data.ncon][deep], axis=1), depth_m[deep]


def wandering(
    model: mujoco.MjModel, split: str, count: int, frames: int, rate_hz: float, seed: int, where: str
) -> list[Trajectory]:
    """`count` random paths, each with a generator of its own."""
    wanderer, found = Wanderer(model, where), []
    for index in range(count):
        qpos = wanderer.draw(frames, rate_hz, random_generator(seed, "mujoco", split, index))
        found.append(Trajectory(f"{split} {index}", f"{split} {index}", qpos))
    return found
