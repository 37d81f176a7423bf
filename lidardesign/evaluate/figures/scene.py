"""A picture of a scene with each design in it: sensors, fields of view, and what becomes of their rays.

A scene as a shaded image, seen from afar: parallel light rays are cast at it, one per pixel.

Parallel projection has no vanishing points: equal lengths stay equal wherever they are, as in a technical drawing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.design.sensor import Sensor
from lidardesign.evaluate.figures.canvas import (
    INK,
    OUTCOME_WORDS,
    PAGE_INCHES,
    SMALL_POINTS,
    SOFT,
    add_legend,
    new_figure,
    plain_label,
)
from lidardesign.evaluate.figures.drawing import body_triangles, frustum_lines
from lidardesign.evaluate.figures.scene_figure import DrawnDesign, SceneFigure
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Outcome
from lidardesign.numerics import EPSILON_FLOAT32, HALF_DIGITS
from lidardesign.scene import Plane, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


SIDE, BEHIND, ABOVE = 1.25, 1.0, 0.75  # where the camera is, beside, behind and above the sensors
AMBIENT, FRONT, LAMP = 0.42, 0.33, 0.40
TARGET, OTHER = (0.86, 0.81, 0.76), (0.66, 0.69, 0.74)
# Floors and walls fill the picture: what stands before them counts.
GROUND = (1.02, 1.02, 1.02)
EDGE_DEPTH = 0.012  # of the picture's width: a step in depth that is drawn as an edge
BLOCK = 200_000  # rays cast at once


@dataclass(frozen=True, eq=False)
class View:
    """A parallel projection.

    Arguments:
        right, up, forward: Unit vectors of the picture and into it, shape (3,).
        window: Left, right, bottom and top of what is shown, along right and up [m].
        near_m: A depth along forward before everything that is shown [m].
    """

    right: np.ndarray
    up: np.ndarray
    forward: np.ndarray
    window: tuple[float, float, float, float]
    near_m: float

    @property
    def ratio(self) -> float:
        """Width over height."""
        left, right, bottom, top = self.window
        return (right - left) / (top - bottom)

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Places in the picture along right and up [m], (..., 3) to (..., 2)."""
        return np.stack([points_m @ self.right, points_m @ self.up], axis=-1)

    def depth(self, points_m: np.ndarray) -> np.ndarray:
        """How far away points are, along forward [m], (..., 3) to (...)."""
        return points_m @ self.forward


def view_of(directions: np.ndarray, points_m: np.ndarray, margin: float = 0.04) -> View:
    """From beside, behind and above sensors that look along directions; a flat world from straight above.

    Arguments:
        directions: Of rays, shape (N, 3).
        points_m: What is to be inside the picture, shape (K, 3).
        margin: Beyond it, as a share of the larger side.
    """
    if len(directions) and np.abs(directions[:, 2]).max() < EPSILON_FLOAT32:
        forward, up = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    else:
        mean = directions.mean(axis=0) * (1.0, 1.0, 0.0) if len(directions) else np.array([1.0, 0.0, 0.0])
        length = float(np.linalg.norm(mean))
        # what looks down or all around has no side
        ahead = mean / length if length > 0.1 else np.array([0.6, 0.8, 0.0])
        eye = SIDE * np.array([-ahead[1], ahead[0], 0.0]) - BEHIND * ahead + np.array([0.0, 0.0, ABOVE])
        forward = -(eye / np.linalg.norm(eye))
        up = np.array([0.0, 0.0, 1.0]) - forward[2] * forward
        up /= np.linalg.norm(up)
    view = View(np.cross(forward, up), up, forward, (0.0, 1.0, 0.0, 1.0), 0.0)
    places = view.project(points_m)
    low, high = places.min(axis=0), places.max(axis=0)
    # no picture is thinner than a third of its length
    least = max(float((high - low).max()), HALF_DIGITS) / 3
    pad = np.maximum((least - (high - low)) / 2, 0.0) + margin * 3 * least
    (left, right), (bottom, top) = zip((low - pad).tolist(), (high + pad).tolist(), strict=True)
    depth = view.depth(points_m)
    return replace(view, window=(left, right, bottom, top), near_m=float(depth.min() - 3 * np.ptp(depth) - 3 * least))


@dataclass(frozen=True, eq=False)
class Shaded:
    """What the camera sees.

    Arguments:
        colour: Shape (H, W, 4), the lowest row first; clear where there is nothing.
        depth_m: Along the view's forward, infinite where there is nothing, shape (H, W).
    """

    colour: np.ndarray
    depth_m: np.ndarray

    def hides(self, view: View, points_m: np.ndarray, slack_m: float) -> np.ndarray:
        """Which points lie behind something by more than a slack, (N, 3) to (N,) bool."""
        rows, columns = self.depth_m.shape
        left, right, bottom, top = view.window
        across, up = view.project(points_m).T
        column = np.clip((across - left) / (right - left) * columns, 0, columns - 1).astype(int)
        row = np.clip((up - bottom) / (top - bottom) * rows, 0, rows - 1).astype(int)
        return view.depth(points_m) > self.depth_m[row, column] + slack_m


def shaded(scene: Scene, frame: int, view: View, width: int) -> Shaded:
    """A scene's targets and other bodies in two colours, lit from where the camera is.

    Arguments:
        scene, frame: What is seen; infinite planes are seen from their front only.
        view: How.
        width: Of the image in pixels.
    """
    height = max(round(width / view.ratio), 1)
    left, right, bottom, top = view.window
    across = left + (np.arange(width) + 0.5) / width * (right - left)
    up = bottom + (np.arange(height) + 0.5) / height * (top - bottom)
    grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    starts = grid[:, :1] * view.right + grid[:, 1:] * view.up + view.near_m * view.forward
    # the scene without the planes that the camera is behind: walls and ceilings would hide everything
    kept = tuple(
        body
        for body in scene.bodies
        if not isinstance(body.shape, Plane) or body.pose(frame)[:3, 2] @ view.forward < -EPSILON_FLOAT32
    )
    seen = replace(scene, bodies=kept) if kept and len(kept) < len(scene.bodies) else scene
    colour, depth = np.zeros((len(starts), 4)), np.full(len(starts), np.inf)
    if seen.bodies:
        caster = SceneCaster(seen, frame)
        lamp = -view.forward - 0.8 * view.right + 0.9 * view.up
        lamp /= np.linalg.norm(lamp)
        kinds = np.array(
            [GROUND if isinstance(body.shape, Plane) else TARGET if body.is_target else OTHER for body in seen.bodies]
        )
        for block in np.array_split(np.arange(len(starts)), max(1, len(starts) // BLOCK)):
            hits = caster.first_hit(starts[block], np.broadcast_to(view.forward, (len(block), 3)))
            met = np.isfinite(hits.range_m)
            depth[block] = view.near_m + hits.range_m
            # brightness of surfaces: from the front, and from the upper left
            normal = hits.normal[met]
            front, sideways = np.abs(normal @ view.forward), np.clip(normal @ lamp, 0.0, 1.0)
            lit = kinds[hits.body[met]] * (AMBIENT + FRONT * front + LAMP * sideways)[:, None]
            colour[block[met], :3] = np.minimum(lit, 1.0)
            colour[block[met], 3] = 1.0
    depth, colour = depth.reshape(height, width), colour.reshape(height, width, 4)
    # darken pixels where the depth jumps: outlines tell things apart that are lit alike
    step_m = EDGE_DEPTH * (right - left)
    from matplotlib.colors import to_rgb

    edge = np.zeros(depth.shape, dtype=bool)
    finite = np.where(np.isfinite(depth), depth, depth[np.isfinite(depth)].max(initial=0.0) + 10 * step_m)
    edge[:, 1:] |= np.abs(np.diff(finite, axis=1)) > step_m
    edge[1:] |= np.abs(np.diff(finite, axis=0)) > step_m
    edge &= np.isfinite(depth)
    colour[edge, :3] = 0.55 * colour[edge, :3] + 0.45 * np.array(to_rgb(INK))
    return Shaded(colour, depth)


MOST_DESIGNS = 6
COLUMNS = 2
MOST_RAYS = 600
# From so many sensors on their frusta are a thicket; rays say it all.
MOST_SENSORS = 20
SENSOR = "#3b3f8f"
# Colour, dash and width by what became of a ray: told apart without colour too.
OUTCOME_LOOKS = {
    Outcome.MISS: ("#9aa5b1", "dotted", 0.45),
    Outcome.NOT_DETECTED: ("#CC79A7", "dashdot", 0.6),
    Outcome.AFTER_GATE: ("#0072B2", "dashed", 0.6),
    Outcome.OCCLUDED: ("#D55E00", (0, (4, 1.2, 1, 1.2)), 0.6),
    Outcome.RETURN: ("#007A59", "solid", 0.6),
}
PIECES = 24  # that a ray is cut into, each drawn or hidden
SEEN, HIDDEN = 0.65, 0.12
# Many rays are drawn thinner: so many together are as dark as one.
DENSE_RAYS = 100
# Bodies that reach further than this many times beyond the rays are cut.
REACH = 0.6
RECEIVER_LOOK = {"marker": "s", "color": INK, "markersize": 4.0, "linestyle": "none", "zorder": 5}
# Things nearer than this share of the picture's width do not hide each other.
SLACK_SHARE = 0.004
# Where more than this share of the rays start behind something, what is before the sensors is cut away.
MOST_HIDDEN = 0.5
HEAD_INCHES, LEGEND_INCHES = 0.25, 0.3
# Rays from more places than these are drawn with small marks.
FEW_PLACES = 30


def scene_picture(shown: SceneFigure) -> Figure:
    """The scene with each design at the middle of its positions and frames, a page wide; one panel per design."""
    designs = shown.designs[:MOST_DESIGNS]
    place, step = len(shown.places) // 2, len(shown.frames) // 2
    view = view_of(shown.directions, framed_points(shown, place, step))
    columns = min(COLUMNS, len(designs)) or 1
    rows, width = math.ceil(len(designs) / columns), PAGE_INCHES / columns
    height = min(width / view.ratio, 4.6)
    figure = new_figure(PAGE_INCHES, rows * (height + HEAD_INCHES) + LEGEND_INCHES)
    receiver = shown.scene.receiver
    image, cut = opened(shown, place, step, view, int(160 * min(width, height * view.ratio)))
    for number, design in enumerate(designs):
        axes = figure.add_subplot(rows, columns, number + 1)
        axes.imshow(image.colour, extent=view.window, origin="lower", interpolation="antialiased", zorder=0)
        axes.set(xlim=view.window[:2], ylim=view.window[2:], aspect="equal")
        axes.set_axis_off()
        _scale_bar(axes, view)
        _draw_design(axes, design, place, step, image, view)
        if receiver is not None:
            axes.plot(*view.project(np.array(receiver.origin_m)), **RECEIVER_LOOK)
    kinds = {int(kind) for one in designs for kind in np.unique(one.outcome[place, step])}
    looks = _legend_looks([kind for kind in Outcome if int(kind) in kinds], receiver=receiver is not None)
    add_legend(figure, looks, 6, handlelength=2.4, columnspacing=1.2)
    caption = _caption(shown, place, step) + "; cut open before the sensors" * cut
    figure.suptitle(caption, fontsize=SMALL_POINTS, color=SOFT)
    return figure


def opened(shown: SceneFigure, place: int, step: int, view: View, pixels: int) -> tuple[Shaded, bool]:
    """The scene as it is seen, and whether what stands before the sensors is cut away, as walls that hide them."""
    scene, frame = shown.scene, shown.frames[step]
    image = shaded(scene, frame, view, pixels)
    origins = np.concatenate([np.zeros((0, 3)), *(one.rays[place].origin_m for one in shown.designs)])
    slack = SLACK_SHARE * (view.window[1] - view.window[0])
    if not len(origins) or image.hides(view, origins, slack).mean() <= MOST_HIDDEN:
        return image, False
    nearer = replace(view, near_m=float(view.depth(origins).min()) - slack)
    return shaded(scene, frame, nearer, pixels), True


def framed_points(shown: SceneFigure, place: int, step: int) -> np.ndarray:
    """What the picture must hold: where rays start and end, and bodies that are not far beyond, shape (K, 3) [m]."""
    receiver = shown.scene.receiver
    ends = [np.zeros((0, 3)) if receiver is None else np.array([receiver.origin_m])]
    for one in shown.designs:
        rays = one.rays[place]
        # what hits nothing ends somewhere
        met = one.outcome[place, step] != Outcome.MISS
        ends += [rays.origin_m, one.ends_m[place, step][met] if met.any() else one.ends_m[place, step]]
    points = np.concatenate(ends)
    around = [lines for one in shown.designs for lines in _frusta(one.placed[place].sensors)]
    # ends of all finite targets along the axes
    boxes = [np.zeros((0, 3))]
    for body in shown.scene.bodies:
        if body.is_target and not isinstance(body.shape, Plane):
            vertices, _ = body_triangles(body, shown.frames[step], np.zeros((2, 3)))
            boxes.append(np.stack([vertices.min(axis=0), vertices.max(axis=0)]))
    bodies = np.concatenate([*boxes, *around])
    bodies = bodies[np.isfinite(bodies).all(axis=1)]
    if not len(points):
        return bodies if len(bodies) else np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    reach = REACH * float((high - low).max())
    return np.concatenate([points, np.clip(bodies, low - reach, high + reach)])


def _scale_bar(axes: Axes, view: View) -> None:
    """A round length in the lower left: parallel projection keeps it everywhere across the picture."""
    left, right, bottom, top = view.window
    wanted = 0.2 * (right - left)
    power = 10.0 ** math.floor(math.log10(wanted))
    length = power * max(step for step in (1, 2, 5) if step * power <= wanted)
    start, height = left + 0.03 * (right - left), bottom + 0.03 * (top - bottom)
    axes.plot([start, start + length], [height, height], color=INK, linewidth=1.6, solid_capstyle="butt", zorder=6)
    text = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm" if length >= 0.01 else f"{1000 * length:g} mm"
    axes.annotate(text, (start, height), (0, 3), textcoords="offset points", fontsize=SMALL_POINTS, color=INK, zorder=6)


def _draw_design(axes: Axes, one: DrawnDesign, place: int, step: int, image: Shaded, view: View) -> None:
    rays, outcome, ends = one.rays[place], one.outcome[place, step], one.ends_m[place, step]
    keep = np.unique(np.linspace(0, len(rays) - 1, min(len(rays), MOST_RAYS)).astype(int))
    slack = SLACK_SHARE * (view.window[1] - view.window[0])
    share = min(1.0, math.sqrt(DENSE_RAYS / max(len(keep), 1)))
    for kind, (colour, dash, width) in OUTCOME_LOOKS.items():
        some = keep[outcome[keep] == kind]
        if not len(some):
            continue
        look = {"colors": colour, "linestyles": dash, "linewidths": width * share}
        _draw_lines(axes, rays.origin_m[some], ends[some], image, view, slack, look)
        if kind == Outcome.RETURN:
            seen = ends[some][~image.hides(view, ends[some], 2 * slack)]
            axes.plot(*view.project(seen).T, "o", color=colour, markersize=2.2 * share + 0.3, zorder=4)
    for lines in _frusta(one.placed[place].sensors):
        axes.plot(*view.project(lines).T, color=SENSOR, linewidth=0.6, alpha=0.75, zorder=3)
    places = np.unique(np.round(view.project(rays.origin_m[keep]), 6), axis=0)
    few = len(places) < FEW_PLACES
    axes.plot(*places.T, "D" if few else ".", color=SENSOR, markersize=3.2 if few else 1.6, zorder=5)
    drawn = "" if len(outcome) == one.fired else f"{len(outcome)} of "
    title = f"{plain_label(one.design.name)}: {(outcome == Outcome.RETURN).sum()} of {drawn}{one.fired} rays"
    title += " drawn return" if drawn else " return"
    axes.set_title(title, fontsize=SMALL_POINTS, color=INK, pad=2)


def _draw_lines(
    axes: Axes, starts: np.ndarray, ends: np.ndarray, image: Shaded, view: View, slack_m: float, look: dict[str, Any]
) -> None:
    """Lines from starts to ends, (N, 3) each; where something is before them they are faint."""
    from matplotlib.collections import LineCollection

    steps = np.linspace(0.0, 1.0, PIECES + 1)
    points = starts[:, None] + steps[:, None] * (ends - starts)[:, None]
    middles = (points[:, 1:] + points[:, :-1]) / 2
    hidden = image.hides(view, middles.reshape(-1, 3), slack_m).reshape(middles.shape[:2])
    flat = view.project(points)
    for covered, opacity in ((False, SEEN), (True, HIDDEN)):
        pieces = [piece for line, mask in zip(flat, hidden == covered, strict=True) for piece in _runs(line, mask)]
        if pieces:
            axes.add_collection(LineCollection(pieces, **look, alpha=opacity, zorder=2))


def _runs(line: np.ndarray, mask: np.ndarray) -> list[np.ndarray]:
    """Ends of the stretches of a straight line whose pieces are in a mask, (P + 1, 2) and (P,) to (2, 2) each."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [line[[begin, end]] for begin, end in zip(edges[::2], edges[1::2], strict=True)]


def _frusta(sensors: Sequence[Sensor]) -> list[np.ndarray]:
    return [frustum_lines(sensor) for sensor in sensors] if len(sensors) <= MOST_SENSORS else []


def _legend_looks(kinds: Sequence[Outcome], *, receiver: bool) -> list[tuple[str, dict[str, Any]]]:
    sensor = {"color": SENSOR, "marker": "D", "markersize": 3.2, "linewidth": 0.6}
    looks = [("sensor, field of view and gate", sensor)]
    for kind in kinds:
        colour, dash, _ = OUTCOME_LOOKS[kind]
        look = {"color": colour, "linestyle": dash, "linewidth": 1.2, "marker": "o" if kind == Outcome.RETURN else ""}
        looks.append((OUTCOME_WORDS[kind], look))
    return [*looks, ("detector", RECEIVER_LOOK)] if receiver else looks


def _caption(shown: SceneFigure, place: int, step: int) -> str:
    caption = f"held-out scene {plain_label(shown.scene.name)}"
    if shown.scene.frames > 1:
        caption += f", frame {shown.frames[step] + 1} of {shown.scene.frames}"
    if shown.places and shown.places[place]:
        caption += ", seen from " + ", ".join(f"{name}={value:g}" for name, value in shown.places[place].items())
    left_out = len(shown.designs) - MOST_DESIGNS
    return f"{caption}; {left_out} more designs are not drawn" if left_out > 0 else caption
