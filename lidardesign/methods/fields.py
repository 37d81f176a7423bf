"""Fields: even rays over boxes of origins and angles and over parts of the sphere.

A `Zone` is a box of azimuths and elevations: its rows are even in elevation and have rays in proportion to their
length. A `Patch` is a rectangle in the azimuthal equal-area projection about a middle direction (J. H. Lambert 1772),
which for narrow fields is the tangent plane: areas keep their ratio however wide it is, and no direction is singular
but the one opposite to its middle. A field of more than a hemisphere is a zone, any other a patch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidardesign.numerics import TINY, unit_vectors
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.pattern import grid_rows, grid_tangent, low_discrepancy
from lidardesign.sensors.sensor import boresight_frame
from lidardesign.space import AZIMUTH, ELEVATION, FULL_TURN, DesignSpace, angles, direction

# The projection's radius of the direction opposite to its middle.
OPPOSITE = 2.0
# A rectangle is rolled to where it is smallest, in these steps, if that saves more than the share beside.
ROLLS_RAD = np.deg2rad(np.arange(0.0, 90.0, 5.0))
WORTH_A_ROLL = 0.02
# A rectangle of which the design space admits less than this share is no good crop of it: a bent sliver, say.
SMALLEST_SHARE = 0.1
SHARE_POINTS = 1024
GOLDEN_TURN = FULL_TURN * (1.0 - 2.0 / (1.0 + math.sqrt(5.0)))
SIXTH = math.sqrt(3.0) / 2  # height of an equilateral triangle


@dataclass(frozen=True, eq=False)
class Zone:
    """A box of azimuths and elevations.

    Arguments:
        low, high: Its corners, shape (2,) [rad].
    """

    low: np.ndarray
    high: np.ndarray

    def grid(self, count: int) -> np.ndarray:
        """Exactly `count` azimuths and elevations of an even grid, shape (count, 2) [rad]."""
        if not count:
            return np.zeros((0, 2))
        width, height = self.high - self.low
        length = self.area_sr / height if height > 0 else width * math.cos(self.low[1])
        rows = len(grid_rows(length, height, count))
        elevation = self.low[1] + height * (np.arange(rows) + 0.5) / rows
        counts = split_budget(np.maximum(np.cos(elevation), TINY), count)
        across = np.concatenate([(np.arange(n) + 0.5) / max(n, 1) for n in counts])
        return np.column_stack([self.low[0] + width * across, np.repeat(elevation, counts)])

    def spread(self, count: int, further: int) -> np.ndarray:
        """Even points in the unit cube of further axes and in the field, shape (count, further + 2)."""
        points = low_discrepancy(count, further + 2)
        sines = np.sin([self.low[1], self.high[1]])
        points[:, -2] = self.low[0] + (self.high - self.low)[0] * points[:, -2]
        points[:, -1] = np.arcsin(np.clip(sines[0] + np.diff(sines) * points[:, -1], -1.0, 1.0))
        points[:, -1] = np.clip(points[:, -1], self.low[1], self.high[1])
        return points

    def lattice(self, spacing_rad: float) -> np.ndarray:
        """All azimuths and elevations of a lattice with (nearly) hexagonal cells of one area, shape (K, 2) [rad].

        It is the spiral of the golden angle (A. Gonzalez 2010).
        """
        whole = math.ceil(2 * FULL_TURN / (SIXTH * spacing_rad**2))
        sine = 1.0 - (2 * np.arange(whole) + 1) / whole
        ends = np.sin([self.low[1], self.high[1]])
        chosen = np.flatnonzero((sine >= ends[0]) & (sine <= ends[1]))
        azimuth = self.low[0] + np.mod(chosen * GOLDEN_TURN - self.low[0], FULL_TURN)
        return np.column_stack([azimuth, np.arcsin(sine[chosen])])[azimuth <= self.high[0]]

    def widened(self, share: float, space: DesignSpace) -> Zone:
        """The field widened by a share of its extents at every side, within the design space."""
        return Zone(*widened_angles(self.low, self.high, share, space))

    @property
    def area_sr(self) -> float:
        """Its area, that of directions outside the design space included [sr]."""
        return float((self.high - self.low)[0] * np.diff(np.sin([self.low[1], self.high[1]]))[0])


@dataclass(frozen=True, eq=False)
class Patch:
    """A rectangle in the equal-area projection about a middle direction, less what lies outside the design space.

    Arguments:
        frame: Rows middle, horizontal and vertical axis, shape (3, 3).
        low, high: Its corners in the projection, shape (2,).
        space: The design space.
    """

    frame: np.ndarray
    low: np.ndarray
    high: np.ndarray
    space: DesignSpace

    @property
    def extents(self) -> np.ndarray:
        """Width and height in the projection, shape (2,)."""
        return self.high - self.low

    def grid(self, count: int) -> np.ndarray:
        """See `Zone`; where the space cuts corners off, a finer grid without its outermost rays."""
        asked = count
        while True:
            offsets = grid_tangent(*self.extents.tolist(), asked)
            found, inside = self._directions(offsets + (self.low + self.high) / 2)
            inside = np.flatnonzero(inside)
            if len(inside) >= count:
                nearest = np.argsort(np.linalg.norm(offsets[inside], axis=1), kind="stable")[:count]
                return found[inside[np.sort(nearest)]]
            asked = min(2 * asked, max(asked + 1, asked * count // max(len(inside), 1)))

    def spread(self, count: int, further: int) -> np.ndarray:
        """See `Zone`."""
        asked = count
        while True:
            points = low_discrepancy(asked, further + 2)
            points[:, -2:], inside = self._directions(self.low + self.extents * points[:, -2:])
            if inside.sum() >= count:
                return points[inside][:count]
            asked *= 2

    def lattice(self, spacing_rad: float) -> np.ndarray:
        """See `Zone`."""
        steps = np.array([spacing_rad, SIXTH * spacing_rad])
        columns, rows = np.floor(self.extents / steps / 2).astype(np.int64) + 1
        column, row = np.meshgrid(np.arange(-columns, columns + 1), np.arange(-rows, rows + 1))
        offsets = np.column_stack([(column + 0.5 * (row % 2)).ravel(), row.ravel()]) * steps
        plane = offsets[(np.abs(offsets) <= self.extents / 2).all(axis=1)] + (self.low + self.high) / 2
        found, inside = self._directions(plane)
        return found[inside]

    def widened(self, share: float, space: DesignSpace) -> Patch:
        """See `Zone`."""
        return Patch(self.frame, self.low - share * self.extents, self.high + share * self.extents, space)

    @property
    def area_sr(self) -> float:
        """See `Zone`."""
        return float(self.extents.prod())

    @property
    def admitted_share(self) -> float:
        """The share of the rectangle that the design space admits."""
        _, inside = self._directions(self.low + self.extents * low_discrepancy(SHARE_POINTS, 2))
        return float(inside.mean())

    def _directions(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Azimuths and elevations of points in the projection, (N, 2) to (N, 2) [rad], and which the space admits."""
        radius = np.linalg.norm(plane, axis=1)
        within = radius < OPPOSITE
        across = plane * np.sqrt(1.0 - np.minimum(radius / OPPOSITE, 1.0) ** 2)[:, None]
        local = np.column_stack([1.0 - np.minimum(radius, OPPOSITE) ** 2 / 2, across])
        points = np.tile(np.asarray(self.space.low, dtype=np.float64), (len(plane), 1))
        points[:, AZIMUTH], points[:, ELEVATION] = angles(local @ self.frame)
        points = self.space.wrap(points)
        return points[:, AZIMUTH : ELEVATION + 1], within & self.space.contains(points)


SphereField = Zone | Patch


def widened_angles(
    low: np.ndarray, high: np.ndarray, share: float, space: DesignSpace
) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2,) of a box of azimuths and elevations widened by a share at every side, within the space."""
    low, high = low - share * (high - low), high + share * (high - low)
    lowest, highest = (np.array(end)[AZIMUTH : ELEVATION + 1] for end in (space.low, space.high))
    if space.full_azimuth:  # it may start anywhere
        middle, half = (low + high)[0] / 2, min((high - low)[0], FULL_TURN) / 2
        lowest[0], highest[0] = middle - half, middle + half
    return np.maximum(low, lowest), np.minimum(high, highest)


def projected(frame: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Equal-area coordinates of unit vectors about a frame's first row, (N, 3) to (N, 2)."""
    local = directions @ frame.T
    return local[:, 1:] * np.sqrt(2.0 / np.maximum(1.0 + local[:, :1], TINY))


def central_interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the central 99 % of each column, (N, ...) to two of shape (...)."""
    tail = (1 - 0.99) / 2
    low, high = np.quantile(values, [tail, 1 - tail], axis=0)
    return low, np.maximum(low, high)


def central_field(space: DesignSpace, azimuth_rad: np.ndarray, elevation_rad: np.ndarray) -> SphereField:
    """A field of the central 99 % of directions (K,) per axis: the smallest rectangle, or a zone past a hemisphere.

    Arguments:
        space: The design space, both of whose angles are free.
        azimuth_rad: Azimuths on one arc [rad].
        elevation_rad: Elevations [rad].
    """
    looking = direction(azimuth_rad, elevation_rad)
    mean = looking.mean(axis=0)
    frame = boresight_frame(*(float(angle) for angle in angles(mean)))
    if np.linalg.norm(mean) > 0 and central_interval(looking @ unit_vectors(mean))[0] > 0:
        patch = _smallest_patch(space, frame, projected(frame, looking))
        if patch.admitted_share >= SMALLEST_SHARE:
            return patch
    low, high = central_interval(np.column_stack([azimuth_rad, elevation_rad]))
    return Zone(low, high)


def _smallest_patch(space: DesignSpace, frame: np.ndarray, plane: np.ndarray) -> Patch:
    turns = [np.array([[math.cos(roll), math.sin(roll)], [-math.sin(roll), math.cos(roll)]]) for roll in ROLLS_RAD]
    ends = [central_interval(plane @ turn.T) for turn in turns]
    areas = np.array([np.prod(high - low) for low, high in ends])
    areas[0] *= 1.0 - WORTH_A_ROLL
    best = int(np.argmin(areas))
    return Patch(np.vstack([frame[:1], turns[best] @ frame[1:]]), *ends[best], space)


def quasi_random_points(count: int, extents: np.ndarray) -> np.ndarray:
    """Exactly `count` even points in the unit cube of the axes given by their extents, shape (count, k).

    No axis gives equal points, one a cell-centred line, two a cell-centred grid with cells as square as
    whole rays allow, more a low-discrepancy sequence.
    """
    if len(extents) == 2:
        return grid_tangent(float(extents[0]), float(extents[1]), count) / extents + 0.5
    if len(extents) == 1:
        return (np.arange(count)[:, None] + 0.5) / count
    return low_discrepancy(count, len(extents))


def even_placement(low: np.ndarray, high: np.ndarray, count: int, field: SphereField | None = None) -> np.ndarray:
    """Even points over the axes of a box that have a width, shapes (5,), (5,) to (count, 5).

    Where both angles have one, directions are even on the sphere. Two lengths get square cells; a length beside an
    angle gets cells that are square relative to the box.

    Arguments:
        low, high: Corners of the box: x, y, z, azimuth, elevation.
        count: The number of points.
        field: The directions, where they are not those of the box.
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    free = np.flatnonzero(high > low)
    points = np.tile(low, (count, 1))
    if field is not None or {AZIMUTH, ELEVATION} <= set(free.tolist()):
        field = field or Zone(low[AZIMUTH:], high[AZIMUTH:])
        lengths = free[free < AZIMUTH]
        spread = field.spread(count, len(lengths)) if len(lengths) else field.grid(count)
        points[:, AZIMUTH:] = spread[:, -2:]
        points[:, lengths] += spread[:, :-2] * (high - low)[lengths]
        return points
    extents = (high - low)[free]
    if len(free) == 2 and free[0] < AZIMUTH <= free[1]:
        extents = np.ones(2)
    points[:, free] += quasi_random_points(count, extents) * (high - low)[free]
    return np.clip(points, low, high)
