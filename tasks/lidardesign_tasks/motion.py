"""Motion of meshes of a folder from a CSV of poses, resampled to the frames of a scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lidardesign import ConfigError, DataError, Mesh
from lidardesign_tasks.poses import BodyPath, read_poses, span_s

EVERY = "*"
MOST_FRAMES = 500
# Most allowed names of a body in a message.
MOST_SHOWN = 12
# Tolerance in frames, so that rounding does not drop the last frame of a motion.
ROUNDING_FRAMES = 1e-3


@dataclass(frozen=True, eq=False)
class Motion:
    """Bodies' poses in the frames of a scene.

    Arguments:
        poses: Body to world by the name in the file, shape (T, 4, 4) each, T from 1.
    """

    poses: Mapping[str, np.ndarray]

    def of(self, name: str) -> np.ndarray | None:
        """Poses of a mesh file by its name with or without its suffix, shape (T, 4, 4), or None."""
        return next((self.poses[key] for key in (name, Path(name).stem) if key in self.poses), None)

    def of_object(self, name: str) -> np.ndarray | None:
        """Poses of a target: its own, or those of every object, shape (T, 4, 4), or None."""
        own = self.of(name)
        return self.poses.get(EVERY) if own is None else own


def load_motion(path: Path, frame_rate_hz: float, objects: Iterable[str], others: Iterable[str]) -> Motion:
    """Load the motion of a file in frames, from its first time to its last.

    Arguments:
        path: The CSV.
        frame_rate_hz: Frames per second [Hz].
        objects: Names of the mesh files that are targets; the body `*` is each of them.
        others: Names of the mesh files that are occluders.

    Raises:
        DataError: The file cannot be used, or has a body without a mesh of that name.
        ConfigError: More frames than a scene takes.
    """
    try:
        state = path.stat()
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", where=str(path)) from None
    paths = _read(path, state.st_mtime_ns, state.st_size)
    _check_bodies(paths, path, [*objects], [*others])
    first, last = span_s(paths)
    frames = int((last - first) * frame_rate_hz + ROUNDING_FRAMES) + 1
    if frames > MOST_FRAMES:
        raise ConfigError(
            f"{last - first:g} s of motion at {frame_rate_hz:g} frames per second are {frames} frames",
            where="task.frame_rate_hz",
            allowed=f"at most {MOST_FRAMES} frames",
            hint=f"at most {(MOST_FRAMES - 1) / (last - first):.3g} Hz, or fewer seconds",
        )
    times = first + np.arange(frames) / frame_rate_hz
    return Motion({name: one.at(times) for name, one in paths.items()})


@lru_cache(maxsize=8)
def _read(path: Path, changed_ns: int, size: int) -> dict[str, BodyPath]:
    """Read a file, cached as space and both splits need it."""
    return read_poses(path)


def _check_bodies(paths: Mapping[str, BodyPath], path: Path, objects: list[str], others: list[str]) -> None:
    """Refuse bodies of the file that are not exactly one mesh file or `*`, and meshes with two motions."""
    every = [*objects, *others]
    for name, one in paths.items():
        called = [mesh for mesh in every if name in (mesh, Path(mesh).stem)]
        if name == EVERY and objects:
            continue
        if len(called) != 1:
            found = f"no mesh is called {name!r}" if not called else f"{name!r} names {' and '.join(called)}"
            allowed = ", ".join([EVERY, *every][:MOST_SHOWN]) + (", ..." if len(every) >= MOST_SHOWN else "")
            raise DataError(found, where=f"{path}:{one.line}", allowed=allowed, hint="name one mesh file, or * for all")
    for mesh in every:
        both = [name for name in paths if name in (mesh, Path(mesh).stem)]
        if len(both) > 1:
            raise DataError(f"{both[0]!r} and {both[1]!r} are one mesh", where=f"{path}:{paths[both[1]].line}")


def moved_bounds_m(mesh: Mesh, poses: np.ndarray | None) -> np.ndarray:
    """Bounds of a mesh in all of its poses (T, 4, 4), shape (2, 3) [m]."""
    if poses is None:
        return mesh.bounds_m
    low, high = mesh.bounds_m
    corners = np.array([[(low, high)[(index >> axis) & 1][axis] for axis in range(3)] for index in range(8)])
    places = np.einsum("tij,kj->tki", poses[:, :3, :3], corners) + poses[:, None, :3, 3]
    return np.stack([places.min(axis=(0, 1)), places.max(axis=(0, 1))])
