"""Targets, occluders and sensor mount of a MuJoCo model, and their poses in the frames of a motion."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidardesign import (
    BackgroundNote,
    Body,
    ConfigError,
    DesignSpace,
    Mesh,
    Plane,
    Scene,
    SceneCaster,
    half_extents_m,
    inverse_rigid,
    mujoco_models,
    random_generator,
    sample_body,
    suggest,
)
from lidardesign_tasks.robot.recordings import listed

if TYPE_CHECKING:
    import mujoco

OUTLINE_POINTS = 1000
# Space that would limit planes; no plane is a target.
NEAR = DesignSpace((0.0,) * 6, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
Names = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Target:
    """A target body of the model.

    Arguments:
        name: Name of the body.
        body: Index of the body in the model.
        pieces: Indices of its pieces in the model, shape (K,).
        box_m: Corners of its bounding box in the body's frame, shape (8, 3).
        depth_m: Expected distance of its centre behind its returns, see `mean_depth_m`.
    """

    name: str
    body: int
    pieces: np.ndarray
    box_m: np.ndarray
    depth_m: float


@dataclass(frozen=True, eq=False)
class Model:
    """A robot model with its surroundings, targets and sensor mount.

    Arguments:
        model: The MuJoCo model.
        pieces: Its visible pieces without the ignored ones.
        targets: The targets.
        known: Mask of pieces whose returns are recognised, as those of a robot's own links, shape (pieces,).
        mount: Index of the body that carries the sensors; None: sensors in the world.
        notes: Repairs and omissions of reading, one line each.
    """

    model: mujoco.MjModel
    pieces: tuple[mujoco_models.ModelGeom, ...]
    targets: tuple[Target, ...]
    known: np.ndarray
    mount: int | None
    notes: Names

    def poses(self, qpos: np.ndarray) -> np.ndarray:
        """Poses of all bodies in the frame of the mount, or in the world, shape (F, nbody, 4, 4)."""
        poses = mujoco_models.body_poses(self.model, qpos)
        if self.mount is not None:
            poses = inverse_rigid(poses[:, self.mount])[:, None] @ poses
            poses[:, self.mount] = np.eye(4)
        resting = np.isclose(poses, poses[0], rtol=0.0).all(axis=(0, 2, 3))
        poses[:, resting] = poses[0, resting]
        return poses

    def bodies(self, poses: np.ndarray) -> tuple[Body, ...]:
        """All pieces as the bodies of a scene, in the same order."""
        wanted = {piece for target in self.targets for piece in target.pieces.tolist()}
        return tuple(
            piece.at(poses, "both" if number in wanted else "occluder") for number, piece in enumerate(self.pieces)
        )

    def places_m(self, poses: np.ndarray) -> np.ndarray:
        """Centres of the targets' boxes, shape (targets, F, 3) [m]."""
        return self.corners_m(poses).mean(axis=2)

    def corners_m(self, poses: np.ndarray) -> np.ndarray:
        """Corners of the box around each target, shape (targets, F, 8, 3) [m]."""
        return np.stack([_moved(target.box_m, poses[:, target.body]) for target in self.targets])

    def mount_top_m(self) -> np.ndarray:
        """Middle of the top of the mount's bounding box in its own frame, (3,) [m]; its origin without geometry."""
        own = [outline_m(piece) for piece in self.pieces if piece.body == self.mount]
        low, high = (pick(np.concatenate(own), axis=0) for pick in (np.min, np.max)) if own else np.zeros((2, 3))
        return np.array([*(low + high)[:2] / 2, high[2]])


def read_model(path: Path, folder: Path | None, targets: Names, ignored: Names, known: Names,
               groups: tuple[int, ...] | None, mount: str | None) -> Model:  # fmt: skip
    """Read a model, once per process while its files stay the same.

    Arguments:
        path: The MJCF or URDF file.
        folder: Folder that must contain all its files; None: the file's own folder.
        targets, ignored, known: Patterns of the names of bodies and geoms, as `hand*`.
        groups: Visible groups of geoms; None: as MuJoCo shows them.
        mount: Name of the body that carries the sensors; None: the world.

    Raises:
        DataError: The file cannot be used.
        ConfigError: A name or pattern matches nothing visible; with the nearest name.
    """
    return _read(path, folder, mujoco_models.model_files(path, folder), targets, ignored, known, groups, mount)


@lru_cache(maxsize=4)
def _read(path: Path, folder: Path | None, states: tuple[mujoco_models.FileState, ...], targets: Names, ignored: Names,
          known: Names, groups: tuple[int, ...] | None, mount: str | None) -> Model:  # fmt: skip
    """Read a model; `states` of its files are part of the cache key, so that a changed model is read again."""
    model, said = mujoco_models.load_model(path, folder=folder)
    pieces, notes = mujoco_models.visible_geoms(model, groups=groups)
    missing = [note for note in (*said, *notes) if not isinstance(note, BackgroundNote)]
    gone = _named(pieces, ignored, "ignored", missing)
    pieces = tuple(without_notes(piece) for piece, left_out in zip(pieces, gone, strict=True) if not left_out)
    wanted = _named(pieces, targets, "targets", missing)
    names = [model.body(body).name for body in range(model.nbody)]
    if mount is not None and mount not in names[1:]:
        raise ConfigError(f"no body is called {mount!r}", where="task.mount_body", allowed=listed(names[1:]),
                          hint=suggest(mount, names))  # fmt: skip
    found = [
        _target(pieces, np.flatnonzero(wanted & np.array([piece.body == body for piece in pieces])))
        for body in dict.fromkeys(piece.body for piece, is_target in zip(pieces, wanted, strict=True) if is_target)
    ]
    number = None if mount is None else names.index(mount)
    if any(target.body == number for target in found):
        raise ConfigError(f"{mount!r}, which sensors are on, is a target", where="task.targets",
                          hint="targets on other bodies, or another mount_body")  # fmt: skip
    told_apart = _named(pieces, known, "known", missing)
    if known and not (told_apart & ~wanted).any() and not wanted.all():
        raise ConfigError("all known pieces are targets", where="task.known",
                          allowed="names of other bodies or geoms, [*] for all of them, [] for none")  # fmt: skip
    told_apart &= ~wanted
    return Model(model, pieces, tuple(found), told_apart, number, (*said, *notes))


def _named(pieces: Sequence[mujoco_models.ModelGeom], patterns: Names, key: str, missing: Sequence[str]) -> np.ndarray:
    """Mask of pieces whose body or geom matches a pattern, shape (pieces,); `missing` tells what the model lacks."""
    found, names = np.zeros(len(pieces), dtype=bool), [(piece.body_name, piece.geom_name) for piece in pieces]
    for pattern in patterns:
        fits = np.array([fnmatchcase(body, pattern) or fnmatchcase(geom, pattern) for body, geom in names], dtype=bool)
        if not fits.any():
            every = list(dict.fromkeys(name for pair in names for name in pair if name))
            # what someone calls a hand or a gripper is often the last body of a chain
            last = next((body for body, _ in names[::-1] if body), every[-1])
            hint = suggest(pattern.strip("*"), every) or f"the last body is {last!r}"
            raise ConfigError(f"no visible body or geom is called {pattern!r}", where=f"task.{key}",
                              allowed=listed(every), hint="; ".join((hint, *missing)))  # fmt: skip
        found |= fits
    return found


def _target(pieces: Sequence[mujoco_models.ModelGeom], chosen: np.ndarray) -> Target:
    first = pieces[chosen[0]]
    if any(isinstance(pieces[piece].shape, Plane) for piece in chosen):
        raise ConfigError(f"{first.body_name!r} is an infinite plane", where="task.targets", hint="ignore it")
    points = np.concatenate([outline_m(pieces[piece]) for piece in chosen])
    box_m = np.array(list(itertools.product(*zip(points.min(axis=0), points.max(axis=0), strict=True))))
    return Target(first.body_name, first.body, chosen, box_m, mean_depth_m(points))


def without_notes(piece: mujoco_models.ModelGeom) -> mujoco_models.ModelGeom:
    """The piece without the notes of its mesh."""
    return replace(piece, shape=replace(piece.shape, notes=())) if isinstance(piece.shape, Mesh) else piece


def outline_m(piece: mujoco_models.ModelGeom) -> np.ndarray:
    """Points on a piece's surface in its body's frame, shape (K, 3) [m]."""
    if isinstance(piece.shape, Mesh):
        points = piece.shape.vertices[np.unique(piece.shape.faces)]
    else:
        points = sample_body([Body(piece.shape)], NEAR, OUTLINE_POINTS, random_generator(0, "outline")).points
        points = np.concatenate([points, -points])  # primitives are symmetric about their origin
    return points @ piece.pose[:3, :3].T + piece.pose[:3, 3]


def mean_depth_m(points_m: np.ndarray) -> float:
    """Half the mean chord 4 V / S of the convex hull of points (K, 3), the mean depth of its centre behind returns [m].

    Cauchy's mean chord; of a ball 2/3 of its radius, in the mean over its disc.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points_m, qhull_options="QJ")
    return 2 * float(hull.volume) / float(hull.area)


def _moved(points_m: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Points (K, 3) at poses (F, 4, 4), shape (F, K, 3)."""
    return np.einsum("fij,kj->fki", poses[:, :3, :3], points_m) + poses[:, None, :3, 3]


def refuse_sensors_inside(model: Model, poses: np.ndarray, origins_m: np.ndarray) -> None:
    """Refuse sensor origins (K, 3) [m] that are all inside a piece in most frames; raises ConfigError.

    In a few frames a randomly moving piece, as a hand, may pass through a sensor and hide everything else.
    """
    direction = np.array([0.36, 0.48, 0.8])  # parallel to nothing that models are built of
    for piece in model.pieces:
        if isinstance(piece.shape, Plane) or (isinstance(piece.shape, Mesh) and piece.shape.sign != "solid"):
            continue
        own = _moved(origins_m, inverse_rigid(poses[:, piece.body] @ piece.pose))
        half = half_extents_m(piece.shape)
        low, high = piece.shape.bounds_m if isinstance(piece.shape, Mesh) else (np.negative(half), half)
        # mostly they are outside of its box
        inside = ((own > low) & (own < high)).all(axis=(1, 2))
        if inside.any():
            flat = own.reshape(-1, 3)
            caster, limits = SceneCaster(Scene((Body(piece.shape),))), np.full(len(flat), np.inf)
            passed = caster.crossings(flat, np.tile(direction, (len(flat), 1)), np.zeros(len(flat)), limits).row
            inside = (np.bincount(passed, minlength=len(flat)) % 2 == 1).reshape(len(poses), -1).all(axis=1)
        if 2 * inside.sum() > len(inside):
            raise ConfigError(
                f"all places where sensors may stand are inside {piece.name!r} (frame {int(np.argmax(inside))})",
                where="task.origin_m", hint="move origin_m, or widen origin_box_m",
            )  # fmt: skip
