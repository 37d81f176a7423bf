"""Poses of bodies over time from a CSV file, and small random ones.

One row is the pose of one body at one time, under a header that names the columns: `time_s`, `body`, `x_m`, `y_m`,
`z_m`, and for rotations either a quaternion `qw`, `qx`, `qy`, `qz` of any length, or `roll_deg`, `pitch_deg`, `yaw_deg`
(or `_rad`) about the fixed axes x, y, z in this order. Between the rows of a body positions are linear in time and
rotations have a constant rate the shorter way; before its first and after its last row a body is at rest.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidardesign import (
    FARTHEST_M,
    DataError,
    csv_rows,
    inputs,
    plain_number,
    rigid,
    rotation_of_quaternion,
    rotation_of_rpy,
)

PLACE = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
DEGREES, RADIANS = ("roll_deg", "pitch_deg", "yaw_deg"), ("roll_rad", "pitch_rad", "yaw_rad")
ROTATIONS = (QUATERNION, DEGREES, RADIANS)
TIME, BODY = "time_s", "body"
COLUMNS = (TIME, BODY, *PLACE, *QUATERNION, *DEGREES, *RADIANS)
MOST_ROWS = 200_000
LATEST_S = 1e9
LARGEST_NUMBER = FARTHEST_M
LONGEST_QUOTE = 60
LARGEST_DEVIATIONS = 2.5  # jitter is normal, clipped at this many standard deviations


@dataclass(frozen=True, eq=False)
class BodyPath:
    """The poses of one body at ascending times.

    Arguments:
        time_s: Strictly ascending times, shape (K,).
        poses: Body to world, shape (K, 4, 4).
        line: Line of its first row in the file.
    """

    time_s: np.ndarray
    poses: np.ndarray
    line: int

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Poses at times (T,) [s], shape (T, 4, 4)."""
        moments = np.clip(time_s, self.time_s[0], self.time_s[-1])
        return np.stack([self._at(float(moment)) for moment in moments])

    def _at(self, moment: float) -> np.ndarray:
        after = int(np.searchsorted(self.time_s, moment))
        if self.time_s[after] == moment:
            return self.poses[after]
        before = after - 1
        share = (moment - self.time_s[before]) / (self.time_s[after] - self.time_s[before])
        return interpolated(self.poses[before], self.poses[after], float(share))


def interpolated(first: np.ndarray, last: np.ndarray, share: float) -> np.ndarray:
    """Pose between two, shapes (4, 4), with linear position and a rotation by a share of the angle between."""
    turn = first[:3, :3].T @ last[:3, :3]
    place = (1 - share) * first[:3, 3] + share * last[:3, 3]
    return rigid(first[:3, :3] @ rotation_matrix(share * rotation_vector(turn)), place)


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Rotation vector of a rotation (3, 3), the axis times the angle from 0 to pi [rad], shape (3,)."""
    axial = np.array([
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1],
    ]) / 2  # fmt: skip
    sine, cosine = float(np.linalg.norm(axial)), (float(np.trace(rotation)) - 1) / 2
    angle = math.atan2(sine, cosine)
    if cosine > 0:
        return axial * (angle / sine) if sine > 0 else np.zeros(3)
    # towards half a turn the axis is the longest column of R + R^T - (tr R - 1) I
    columns = rotation + rotation.T - (float(np.trace(rotation)) - 1) * np.eye(3)
    axis = columns[np.argmax(np.abs(columns).max(axis=1))]
    axis = axis / np.linalg.norm(axis)
    return angle * (axis if axis @ axial >= 0 else -axis)


def read_poses(path: Path) -> dict[str, BodyPath]:
    """Read the poses of every body of a file by name, in order of appearance.

    Raises:
        DataError: The file cannot be read, or a cell cannot be used; with file, line and column.
    """
    rows = _rows(path)
    (header_line, header), *body = rows
    names = tuple(cell.strip() for cell in header)
    rotation = _checked_header(names, f"{path}:{header_line}")
    if not body:
        raise DataError("has a header but no pose", where=str(path))
    found: dict[str, list[tuple[float, np.ndarray, int]]] = {}
    for line, cells in body:
        row = _Row(path, line, names, cells)
        found.setdefault(row.text(BODY), []).append((row.number(TIME, LATEST_S), row.pose(rotation), line))
    return {name: _path(poses, name, path) for name, poses in found.items()}


@dataclass(frozen=True)
class _Row:
    """A row of the file."""

    path: Path
    line: int
    names: tuple[str, ...]
    cells: Sequence[str]

    def where(self, name: str) -> str:
        return f"{self.path}:{self.line}:{self.names.index(name) + 1}"

    def text(self, name: str) -> str:
        found = self.cells[self.names.index(name)].strip()
        if not found:
            raise DataError(f"{name} is empty", where=self.where(name), allowed="the name of a body")
        return found

    def number(self, name: str, largest: float) -> float:
        cell = self.cells[self.names.index(name)]
        try:
            value = plain_number(cell)
        except ValueError:
            value = math.nan
        if not abs(value) <= largest:
            shown = repr(cell.strip()[:LONGEST_QUOTE])
            raise DataError(f"{name} is {shown}", where=self.where(name), allowed=f"a number up to {largest:g}")
        return value

    def pose(self, rotation: tuple[str, ...]) -> np.ndarray:
        place = [self.number(name, FARTHEST_M) for name in PLACE]
        values = [self.number(name, LARGEST_NUMBER) for name in rotation]
        if not rotation:
            return rigid(None, place)
        if rotation != QUATERNION:
            return rigid(rotation_of_rpy(*(values if rotation == RADIANS else np.radians(values))), place)
        try:
            return rigid(rotation_of_quaternion(*values), place)
        except ValueError as error:
            raise DataError(str(error), where=self.where(QUATERNION[0]), allowed=", ".join(QUATERNION)) from None


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line and cells of every row that is not blank, the header first."""
    rows = csv_rows(path, inputs.TABLE)
    if not rows or len(rows) > MOST_ROWS + 1:
        raise DataError(f"{max(len(rows) - 1, 0)} rows", where=str(path), allowed=f"a header and 1 to {MOST_ROWS} rows")
    width = len(rows[0][1])
    for line, cells in rows:
        if len(cells) != width:
            raise DataError(f"{len(cells)} columns", where=f"{path}:{line}", allowed=f"{width}, as the header has")
    return rows


def _checked_header(names: tuple[str, ...], where: str) -> tuple[str, ...]:
    """Columns of the rotation; none where bodies only translate.

    Raises:
        DataError: A column is unknown, given twice or missing, or two kinds of rotation are mixed.
    """
    wrong = sorted({name for name in names if name not in COLUMNS or names.count(name) > 1})
    missing = [name for name in (TIME, BODY, *PLACE) if name not in names]
    given = [group for group in ROTATIONS if any(name in names for name in group)]
    missing += [name for group in given for name in group if name not in names]
    if wrong or missing or len(given) > 1:
        told = {"missing columns": missing, "unknown or repeated": wrong}
        found = "; ".join(f"{what}: {', '.join(columns)}" for what, columns in told.items() if columns)
        if len(given) > 1:
            found = "rotations are given twice, in two forms"
        either = " or ".join(", ".join(group) for group in ROTATIONS)
        raise DataError(found, where=where, allowed=f"{', '.join((TIME, BODY, *PLACE))}, and {either}")
    return given[0] if given else ()


def _path(poses: Sequence[tuple[float, np.ndarray, int]], name: str, path: Path) -> BodyPath:
    for (before, _, first), (after, _, line) in itertools.pairwise(poses):
        if after <= before:
            raise DataError(
                f"body {name!r} is at {after:g} s after {before:g} s in line {first}",
                where=f"{path}:{line}",
                allowed="ascending times for each body",
            )
    return BodyPath(np.array([one[0] for one in poses]), np.stack([one[1] for one in poses]), poses[0][2])


def span_s(paths: Mapping[str, BodyPath]) -> tuple[float, float]:
    """First and last time of any body [s]."""
    return min(float(one.time_s[0]) for one in paths.values()), max(float(one.time_s[-1]) for one in paths.values())


def rotation_matrix(rotation_rad: np.ndarray) -> np.ndarray:
    """The 3x3 rotation about a vector by its length [rad] (Rodrigues' formula)."""
    angle = float(np.linalg.norm(rotation_rad))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(rotation_rad) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def jittered_pose(
    generator: np.random.Generator, rotation_deg: float, translation_m: float, centre_m: np.ndarray
) -> np.ndarray:
    """A 4x4 pose: a normal random rotation about a centre and a normal random shift, per axis.

    Arguments:
        generator: The random generator.
        rotation_deg: Standard deviation of the rotation about each axis [degrees].
        translation_m: Standard deviation of the shift along each axis [m].
        centre_m: Centre of the rotation [m], shape (3,).
    """
    draws = np.clip(generator.normal(size=(2, 3)), -LARGEST_DEVIATIONS, LARGEST_DEVIATIONS)
    rotation = rotation_matrix(np.deg2rad(rotation_deg) * draws[0])
    return rigid(rotation, translation_m * draws[1] + centre_m - rotation @ centre_m)
