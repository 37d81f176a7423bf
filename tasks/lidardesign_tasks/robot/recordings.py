"""Recorded joint positions over time, from CSV and NPZ files with the columns of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidardesign import DataError, FolderConfig, csv_rows, inputs, mujoco_models, plain_number, read_npz, suggest

if TYPE_CHECKING:
    import mujoco

TIME, ALL = "time_s", "qpos"
PLACE, TURN = (".x", ".y", ".z"), (".qw", ".qx", ".qy", ".qz")
ENDINGS = (".csv", ".npz")
MOST_SHOWN = 12
# Tolerated excess of recorded joints over their limits, as a share of the range: MuJoCo's own limits are soft.
BEYOND_LIMIT = 0.05


@dataclass(frozen=True, eq=False)
class Recording:
    """Joint positions over time.

    Arguments:
        name: Name of the file, for messages and groups.
        time_s: Ascending times, shape (T,).
        qpos: Joint configurations in MuJoCo's order, shape (T, nq).
    """

    name: str
    time_s: np.ndarray
    qpos: np.ndarray

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.time_s[-1] - self.time_s[0])

    def at(self, model: mujoco.MjModel, time_s: np.ndarray) -> np.ndarray:
        """Configurations (F, nq) at times (F,), linearly interpolated; quaternions are normalised."""
        qpos = np.stack([np.interp(time_s, self.time_s, column) for column in self.qpos.T], axis=1)
        for start in turns(model):
            qpos[:, start : start + 4] /= np.linalg.norm(qpos[:, start : start + 4], axis=1, keepdims=True)
        return qpos


def columns(model: mujoco.MjModel) -> list[str]:
    """Names of the entries of `qpos`: joint names, with .x to .z and .qw to .qz if free, and .qw to .qz for balls."""
    kinds, names = mujoco_models.import_mujoco().mjtJoint, []
    for joint in range(model.njnt):
        name = model.joint(joint).name or f"joint{joint}"
        kind = int(model.jnt_type[joint])
        endings = {int(kinds.mjJNT_FREE): PLACE + TURN, int(kinds.mjJNT_BALL): TURN}.get(kind, ("",))
        names += [name + ending for ending in endings]
    return names


def turns(model: mujoco.MjModel) -> list[int]:
    """Indices in `qpos` at which quaternions of free joints and balls begin."""
    kinds = mujoco_models.import_mujoco().mjtJoint
    shift = {int(kinds.mjJNT_FREE): 3, int(kinds.mjJNT_BALL): 0}
    pairs = zip(model.jnt_type.tolist(), model.jnt_qposadr.tolist(), strict=True)
    return [start + shift[kind] for kind, start in pairs if kind in shift]


def read_recordings(model: mujoco.MjModel, path: Path, config: FolderConfig | None = None) -> list[Recording]:
    """Read the recordings of a file, or of all files of a folder by name, or those that the configuration records.

    Raises:
        DataError: There is none, one is missing, or one cannot be used: with file, column and allowed values.
    """
    allowed = f"a file {' or '.join(ENDINGS)} or a folder of them"
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in ENDINGS and file.name[0] != ".")
    if not files or files[0].suffix.lower() not in ENDINGS:
        raise DataError("holds no motion", where=str(path), allowed=allowed, hint="or motion=keyframes, motion=random")
    if path.is_dir() and config is not None:
        known = config.learned_files(files)
        gone = [name for name, file in known.items() if file is None]
        if gone:
            hint = "put it back, or learn again"
            raise DataError("is gone, and the run was learned from it", where=str(path / gone[0]), hint=hint)
        files = [file for file in known.values() if file is not None]
    return [_checked(model, file) for file in files]


def _checked(model: mujoco.MjModel, path: Path) -> Recording:
    try:
        state = path.stat()
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", where=str(path)) from None
    table, names = dict(_read(path, state.st_mtime_ns, state.st_size)), columns(model)
    time_s = table.pop(TIME, None)
    if time_s is None:
        raise DataError(f"has no column {TIME}", where=str(path), allowed=listed([TIME, *names]))
    if set(table) == {ALL} and np.shape(table[ALL]) == (np.size(time_s), model.nq):
        table = dict(zip(names, np.asarray(table[ALL]).T, strict=True))
    unknown, missing = [name for name in table if name not in names], [name for name in names if name not in table]
    if unknown:
        hint = suggest(unknown[0], missing or names)
        raise DataError(f"{unknown[0]!r} is not a joint", where=str(path), allowed=listed([TIME, *names]), hint=hint)
    if missing:
        raise DataError(
            f"joints are missing: {listed(missing)}",
            where=str(path),
            allowed=f"a column each of {listed(names)}",
            hint="for a joint that rests, repeat its value in every row",
        )
    shapes = {np.shape(column) for column in (time_s, *table.values())}
    if len(shapes) > 1 or np.ndim(time_s) != 1 or len(time_s) < 2:
        raise DataError("columns differ in length, or have less than 2 rows", where=str(path), allowed="2 rows or more")
    qpos = np.stack([np.asarray(table[name], dtype=np.float64) for name in names], axis=1)
    time_s = np.asarray(time_s, dtype=np.float64)
    if not (np.isfinite(qpos).all() and np.isfinite(time_s).all()):
        raise DataError("values are NaN or infinite", where=str(path))
    if (np.diff(time_s) <= 0).any():
        raise DataError(f"{TIME} does not ascend", where=str(path), allowed="ascending times")
    _check_limits(model, qpos, time_s, path)
    for start in turns(model):
        qpos[:, start : start + 4] = _continuous(qpos[:, start : start + 4], names[start], path)
    return Recording(path.name, time_s, qpos)


def _check_limits(model: mujoco.MjModel, qpos: np.ndarray, time_s: np.ndarray, path: Path) -> None:
    """Refuse hinges and slides beyond their limits; raises DataError for the first."""
    names = columns(model)
    for joint, place in enumerate(model.jnt_qposadr.tolist()):
        if not model.jnt_limited[joint] or names[place] not in (model.joint(joint).name, f"joint{joint}"):
            continue
        low, high = model.jnt_range[joint]
        beyond = np.maximum(low - qpos[:, place], qpos[:, place] - high)
        worst = int(np.argmax(beyond))
        if beyond[worst] > BEYOND_LIMIT * (high - low):
            raise DataError(
                f"the joint {names[place]!r} is at {qpos[worst, place]:.4g} at {time_s[worst]:g} s",
                where=str(path),
                allowed=f"{low:.4g} to {high:.4g}, its limits in the model",
                hint="angles are radians: are they degrees?" if abs(qpos[worst, place]) > 2 * np.pi else None,
            )


def _continuous(quaternions: np.ndarray, name: str, path: Path) -> np.ndarray:
    """Unit quaternions (T, 4), each with the sign nearer to the one before."""
    largest = np.abs(quaternions).max(axis=1, keepdims=True)
    if not largest.all():
        raise DataError(f"a quaternion of {name.rpartition('.')[0]!r} is 0", where=str(path), allowed="other lengths")
    scaled = quaternions / largest  # of any length that a number has
    unit = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    turned = np.einsum("ij,ij->i", unit[1:], unit[:-1]) < 0
    return unit * np.where(np.cumsum([False, *turned]) % 2, -1.0, 1.0)[:, None]


@lru_cache(maxsize=256)
def _read(path: Path, changed_ns: int, size: int) -> Mapping[str, np.ndarray]:
    """Read the columns of a file by name, cached as space and both splits need it."""
    if path.suffix.lower() == ".npz":
        return read_npz(path)
    (_, header), *rows = csv_rows(path, inputs.TABLE) or [(1, [])]
    names = [name.strip() for name in header]
    if len(set(names)) < len(names):
        raise DataError("a column is given twice", where=str(path))
    wide = next((line for line, cells in rows if len(cells) != len(names)), None)
    if wide is not None:
        raise DataError(f"does not have {len(names)} columns like the header", where=f"{path}:{wide}")
    return {name: np.array([_number(path, name, line, cells[i]) for line, cells in rows])
            for i, name in enumerate(names)}  # fmt: skip


def _number(path: Path, name: str, line: int, cell: str) -> float:
    try:
        return plain_number(cell)
    except ValueError:
        raise DataError(f"{name} is {cell.strip()[:60]!r}", where=f"{path}:{line}", allowed="a number") from None


def listed(names: Sequence[str]) -> str:
    """The first of many names, as text."""
    return ", ".join(names[:MOST_SHOWN]) + (", ..." if len(names) > MOST_SHOWN else "")
