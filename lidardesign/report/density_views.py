"""Views of the learned density: marginals over each dimension, and projections in space.

Marginals are taken along azimuth, elevation, range and origin, also of designs, whose sensors are represented by even
points of their normal distributions. Every design point observes one point in space: the density of observed points,
projected along an axis, is drawn over the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from lidardesign.numerics import FULL_TURN, effective_count, wrap_turn
from lidardesign.report.scene_figure import drawn_share
from lidardesign.samples import Samples
from lidardesign.scenes.scene import Plane, Scene
from lidardesign.scenes.triangulation import body_triangles
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import low_discrepancy
from lidardesign.sensors.sensor import Sensor, interval_factor, tangent_directions
from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, DesignSpace, angles, observed_point

# Points of a design, shared by its sensors, and of a sensor at least; places along a condition.
POINTS, FEWEST, PLACES = 48_000, 64, 9
MOST_STEPS = 512  # along a triangle's side: beyond, it is far larger than any picture
PERCENT = 100.0
# What lies further out than this share, at each end, is not shown: a stray sample would stretch every axis.
TAIL = 0.001
MARGIN = 0.04  # of an axis, beyond what it shows at each end
LEAST_BINS, MOST_BINS = 12, 80
LEAST_CELLS, MOST_CELLS = 16, 140
# A plane whose second axis holds a thousandth of the first one's spread is a line.
THINNEST = 1e-3
# Designs whose marginals stand out further are cut off: a fixed origin is a spike of any height.
HIGHEST = 2.5
CENTIMETRES, METRES = ("cm", 100.0), ("m", 1.0)
LONG_M = 5.0  # axes beyond this are told per metre
# A full turn is cut at the one of so many bins about which least lies, counting its neighbours; unless that is much.
TURN_BINS, CUT_BINS, EMPTY = 72, 4, 0.5
NAMES = ("x", "y", "z", "azimuth", "elevation", "range")


@dataclass(frozen=True, eq=False)
class DensityView:
    """The views of a learned density.

    Arguments:
        marginals: One per dimension that was learned, in the order of `DIMENSIONS`.
        planes: At most two, the one in which it is widest first.
        samples: Number of samples.
        effective: Their effective number.
        scene: The scene under the planes.
    """

    marginals: tuple[Marginal, ...]
    planes: tuple[PlaneDensity, ...]
    samples: int
    effective: float
    scene: str


@dataclass(frozen=True, eq=False)
class Marginal:
    """The marginal density along one dimension.

    Arguments:
        dimension: Its name, as "azimuth_rad".
        label: For an axis, as "azimuth [deg]".
        unit: Of the heights, as "% per deg".
        edges: Ends of its bins in the label's unit, degrees or metres, ascending, shape (B + 1,).
        heights: Of the density, shape (B,).
        designs: Of each design's sensors, by name, shape (B,) each.
    """

    dimension: str
    label: str
    unit: str
    edges: np.ndarray
    heights: np.ndarray
    designs: Mapping[str, np.ndarray]

    @property
    def top(self) -> float:
        """The end of an axis of heights; designs far above the density are cut off."""
        most = float(self.heights.max(initial=0.0))
        beside = max((float(heights.max(initial=0.0)) for heights in self.designs.values()), default=0.0)
        return 1.05 * (min(max(most, beside), HIGHEST * most) if most > 0 else max(beside, 1.0))


@dataclass(frozen=True, eq=False)
class PlaneDensity:
    """The density of observed points, projected along an axis onto a plane.

    Arguments:
        axes: The world axes across and up, as (1, 2) for y and z.
        labels: Of both, as "y [m]".
        unit: Of the heights, as "% per cm2".
        edges: Ends of the cells along both [m], shapes (U + 1,) and (V + 1,).
        heights: Of the density, up by across, shape (V, U).
        targets, others: Cells that the scene's targets, and its other bodies, cover, shape (V, U) bool.
    """

    axes: tuple[int, int]
    labels: tuple[str, str]
    unit: str
    edges: tuple[np.ndarray, np.ndarray]
    heights: np.ndarray
    targets: np.ndarray
    others: np.ndarray


def density_view(samples: Samples, scene: Scene, designs: Sequence[DesignSpec] = ()) -> DensityView:
    """The views of a density: marginals, with those of designs, and projections of its observed points.

    Arguments:
        samples: Weighted samples of it.
        scene: The scene under the projections, at its middle frame.
        designs: Designs with marginals to compare.
    """
    planes, effective = plane_densities(samples, scene, scene.frames // 2), effective_count(samples.weights)
    return DensityView(marginals(samples, designs), planes, len(samples), effective, scene.name)


def marginals(samples: Samples, designs: Sequence[DesignSpec] = ()) -> tuple[Marginal, ...]:
    """The marginal of each free dimension but conditions, over which the density is uniform by definition."""
    space, weights = samples.space, samples.weights
    start = turn_start(samples.points[:, AZIMUTH], weights, space)
    points = _degrees_points(samples.points, start)
    mixtures = {design.name: mixture_points(design) for design in designs}
    beside = {name: (_degrees_points(own, start), share) for name, (own, share) in mixtures.items()}
    bins = int(np.clip(2 * effective_count(weights) ** (1 / 3), LEAST_BINS, MOST_BINS))
    learned = [axis for axis in space.free if axis not in space.conditioned]
    bounds = _degrees_points(np.array([space.low, space.high]), None)
    if space.full_azimuth:
        bounds[:, AZIMUTH] = np.degrees([start, start + FULL_TURN])
    return tuple(_marginal(axis, points[:, axis], weights, beside, bounds[:, axis], bins) for axis in learned)


def _marginal(
    axis: int,
    values: np.ndarray,
    weights: np.ndarray,
    beside: Mapping[str, tuple[np.ndarray, np.ndarray]],
    bounds: np.ndarray,
    bins: int,
) -> Marginal:
    others = (_central(points[:, axis], share, 0.025) for points, share in beside.values())
    ends = [_central(values, weights, TAIL), *others]
    low, high = _widened(min(end[0] for end in ends), max(end[1] for end in ends))
    # nothing lies beyond the space but a design that was made for another one
    low, high = max(low, bounds[0]), min(high, bounds[1])
    edges = np.linspace(low, high, bins + 1)
    angle = axis in (AZIMUTH, ELEVATION)
    name, per = ("deg", 1.0) if angle else METRES if high - low > LONG_M else CENTIMETRES

    def heights(places: np.ndarray, shares: np.ndarray) -> np.ndarray:
        return PERCENT * np.histogram(places, edges, weights=shares)[0] / (np.diff(edges) * per)

    designs = {design: heights(points[:, axis], share) for design, (points, share) in beside.items()}
    label = f"{NAMES[axis]} [{'deg' if angle else 'm'}]"
    return Marginal(DIMENSIONS[axis], label, f"% per {name}", edges, heights(values, weights), designs)


def _degrees_points(points: np.ndarray, start: float | None) -> np.ndarray:
    """Design points with angles in degrees, azimuths wrapped to the turn from `start` on [rad]."""
    shown = np.array(points, dtype=np.float64)
    if start is not None:
        shown[:, AZIMUTH] = wrap_turn(shown[:, AZIMUTH], start)
    shown[:, [AZIMUTH, ELEVATION]] = np.degrees(shown[:, [AZIMUTH, ELEVATION]])
    return shown


def turn_start(azimuth_rad: np.ndarray, weights: np.ndarray, space: DesignSpace) -> float:
    """The azimuth at which an axis is cut: opposite of the space's middle, or where a full turn is emptiest [rad]."""
    low, middle = space.low[AZIMUTH], (space.low[AZIMUTH] + space.high[AZIMUTH]) / 2
    if not space.full_azimuth:
        return middle - FULL_TURN / 2
    edges = low + np.linspace(0.0, FULL_TURN, TURN_BINS + 1)
    held, _ = np.histogram(wrap_turn(azimuth_rad, low), edges, weights=weights)
    near = sum(np.roll(held, shift) for shift in range(-CUT_BINS, CUT_BINS + 1))
    if near.min() > EMPTY * near.mean():
        return low  # nowhere better than where the space begins
    cut = edges[int(np.argmin(near))]
    # of the turns from there, the one whose middle of mass is near the space's beginning or in its first three quarters
    mean = np.average(wrap_turn(azimuth_rad, cut), weights=weights)
    return float(cut + wrap_turn(mean, low - FULL_TURN / 4) - mean)


def mixture_points(design: DesignSpec) -> tuple[np.ndarray, np.ndarray]:
    """Points of a design's mixture and their weights, shapes (N, 6) and (N,); the weights sum to 1.

    Along a condition evenly spread knots count equally.
    """
    moments, name = [design], design.condition
    if name is not None:
        knots = design.patterns[-1].knots
        some = np.unique(np.linspace(0, len(knots) - 1, PLACES).round().astype(int))
        moments = [design.at_condition({name: knots[index]}) for index in some]
    sensors = [sensor for moment in moments for sensor in moment.sensors]
    weights = np.concatenate([moment.weights for moment in moments]) / len(moments)
    count = max(POINTS // len(sensors), FEWEST)
    normal = ndtri(low_discrepancy(count, 6))
    z = interval_factor(design.level)
    points = np.concatenate([sensor_points(sensor, normal, z) for sensor in sensors])
    return points, np.repeat(weights / count, count)


def sensor_points(sensor: Sensor, normal: np.ndarray, z: float) -> np.ndarray:
    """Design points of a sensor at standard normal coordinates, (N, 6) to (N, 6): origin, direction and range.

    Negative ranges become 0.

    Arguments:
        sensor: The sensor.
        normal: Standard normal coordinates.
        z: Standard deviations on each side of a mean that its field of view and gate span.
    """
    # a with A A' = covariance, also where that is singular: origins are often fixed along an axis
    values, vectors = np.linalg.eigh(np.asarray(sensor.covariance_m2, dtype=np.float64))
    origin = normal[:, :3] @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    tangent, (start, end) = normal[:, 3:5] * np.array(sensor.field_of_view_rad) / (2 * z), sensor.gate_m
    range_m = (start + end) / 2 + (end - start) / (2 * z) * normal[:, 5]
    azimuth, elevation = angles(tangent_directions(sensor.frame, tangent))
    return np.column_stack([origin + sensor.origin_m, azimuth, elevation, np.maximum(range_m, 0.0)])


def plane_densities(samples: Samples, scene: Scene, frame: int) -> tuple[PlaneDensity, ...]:
    """The density of observed points on the planes in which they are widest; none where all are one point."""
    points, weights = observed_point(samples.points), samples.weights
    ends = [_central(values, weights, TAIL) for values in points.T]
    spans = np.array([high - low for low, high in ends])
    least, pairs = THINNEST * spans.max(), [(0, 1), (0, 2), (1, 2)]
    wide = [pair for pair in pairs if spans[list(pair)].min() > least and spans.max() > 0]
    ranked = sorted(wide, key=lambda pair: -float(spans[pair[0]] * spans[pair[1]]))
    # along a condition the density is even: a second picture without it shows more
    beside = sorted(ranked[1:], key=lambda pair: bool(set(pair) & set(samples.space.conditioned)))
    shown = [_widened(*end) for end in ends]
    return tuple(_plane(pair, points, weights, shown, scene, frame) for pair in (*ranked[:1], *beside[:1]))


def _plane(
    axes: tuple[int, int],
    points: np.ndarray,
    weights: np.ndarray,
    ends: Sequence[tuple[float, float]],
    scene: Scene,
    frame: int,
) -> PlaneDensity:
    spans = [ends[axis][1] - ends[axis][0] for axis in axes]
    cell = max(spans) / np.clip(np.sqrt(effective_count(weights) / 5.0), LEAST_CELLS, MOST_CELLS)
    counts = [max(int(np.ceil(span / cell)), 1) for span in spans]
    across, up = (np.linspace(*ends[axis], count + 1) for axis, count in zip(axes, counts, strict=True))
    held, _, _ = np.histogram2d(points[:, axes[1]], points[:, axes[0]], bins=(up, across), weights=weights)
    name, per = METRES if max(spans) > LONG_M else CENTIMETRES
    area = np.outer(np.diff(up), np.diff(across)) * per**2
    return PlaneDensity(
        axes,
        (f"{NAMES[axes[0]]} [m]", f"{NAMES[axes[1]]} [m]"),
        f"% per {name}2",
        (across, up),
        PERCENT * smoothed(held) / area,
        silhouette(scene, frame, axes, (across, up)),
        silhouette(scene, frame, axes, (across, up), targets=False),
    )


def smoothed(held: np.ndarray) -> np.ndarray:
    """Counts smoothed by weights 1/4, 1/2, 1/4 along both axes; their sum is kept."""
    for axis in (0, 1):
        inner = np.moveaxis(held, axis, 0)
        padded = np.concatenate([inner[:1], inner, inner[-1:]])
        held = np.moveaxis(padded[:-2] / 4 + inner / 2 + padded[2:] / 4, 0, axis)
    return held


def silhouette(
    scene: Scene, frame: int, axes: tuple[int, int], edges: tuple[np.ndarray, np.ndarray], *, targets: bool = True
) -> np.ndarray:
    """Cells that targets (or the other bodies) cover in projection, shape (V, U) bool; infinite planes cover none.

    Arguments:
        scene, frame: The scene and its frame.
        axes: The world axes across and up.
        edges: Ends of the cells along both, evenly spaced [m], shapes (U + 1,) and (V + 1,).
        targets: Whether targets count, or everything else.
    """
    covered = np.zeros((len(edges[1]) - 1, len(edges[0]) - 1), dtype=bool)
    share, upper = drawn_share(scene), np.array(covered.shape[::-1])
    low, cell = np.array([edge[0] for edge in edges]), np.array([edge[1] - edge[0] for edge in edges])
    for body in scene.bodies:
        if body.is_target == targets and not isinstance(body.shape, Plane):
            vertices, faces = body_triangles(body, frame, np.zeros((2, 3)), share)
            # mark the cells that hold a point of a lattice, no wider than a cell, on triangles (F, 3, 2)
            places = (vertices[:, list(axes)][faces].astype(np.float64) - low) / cell
            places = places[((places.max(axis=1) >= 0) & (places.min(axis=1) < upper)).all(axis=1)]
            sides = np.abs(places - np.roll(places, 1, axis=1)).max(axis=(1, 2))
            steps = np.minimum(2 ** np.ceil(np.log2(np.maximum(sides, 1.0))), MOST_STEPS).astype(int)
            for count in np.unique(steps):
                # barycentric coordinates of a lattice on a triangle with so many steps along each side
                first, second = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
                keep = first + second <= count
                first, second = first[keep], second[keep]
                lattice = np.stack([first, second, count - first - second], axis=1) / count
                for some in np.array_split(
                    places[steps == count], max(1, (steps == count).sum() * len(lattice) // 2_000_000)
                ):
                    inside = np.floor(np.einsum("lc,fck->flk", lattice, some)).astype(int).reshape(-1, 2)
                    inside = inside[((inside >= 0) & (inside < upper)).all(axis=1)]
                    covered[inside[:, 1], inside[:, 0]] = True
    return covered


def _central(values: np.ndarray, weights: np.ndarray, tail: float) -> tuple[float, float]:
    """Weighted quantiles `tail` and 1 - `tail`."""
    order = np.argsort(values, kind="stable")
    cumulated = np.cumsum(weights[order])
    low, high = np.searchsorted(cumulated, [tail * cumulated[-1], (1 - tail) * cumulated[-1]])
    return float(values[order[low]]), float(values[order[min(high, len(order) - 1)]])


def _widened(low: float, high: float) -> tuple[float, float]:
    """An interval with a margin at both ends; a point gets a small width."""
    margin = MARGIN * (high - low) if high > low else THINNEST * max(abs(low), 1.0)
    return low - margin, high + margin
