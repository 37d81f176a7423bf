"""A picture of a scene with each design in it: sensors, fields of view, and what becomes of their rays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.design.sensor import Sensor
from lidardesign.evaluate.drawing import body_triangles, frustum_lines
from lidardesign.evaluate.plots_camera import Shaded, View, shaded, view_of
from lidardesign.evaluate.plots_canvas import INK, PAGE_INCHES, SMALL_POINTS, SOFT, new_figure, plain_label
from lidardesign.evaluate.shown import Shown, ShownDesign
from lidardesign.scene import Plane, Scene
from lidardesign.simulate.returns import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_DESIGNS = 6
COLUMNS = 2
PIXELS_PER_INCH = 160
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
CUT_OPEN = "; cut open before the sensors"
HEAD_INCHES, LEGEND_INCHES = 0.25, 0.3
LARGEST_PANEL = 4.6
# Rays from more places than these are drawn with small marks.
FEW_PLACES = 30


def scene_picture(shown: Shown) -> Figure:
    """The scene with each design at the middle of its positions and frames, a page wide; one panel per design."""
    designs = shown.designs[:MOST_DESIGNS]
    place, step = len(shown.places) // 2, len(shown.frames) // 2
    view = view_of(shown.directions, framed_points(shown, place, step))
    columns = min(COLUMNS, len(designs)) or 1
    rows = math.ceil(len(designs) / columns)
    width = PAGE_INCHES / columns
    height = min(width / view.ratio, LARGEST_PANEL)
    figure = new_figure(PAGE_INCHES, rows * (height + HEAD_INCHES) + LEGEND_INCHES)
    receiver = shown.scene.receiver
    pixels = int(PIXELS_PER_INCH * min(width, height * view.ratio))
    image, cut = opened(shown, place, step, view, pixels)
    for number, design in enumerate(designs):
        axes = figure.add_subplot(rows, columns, number + 1)
        _draw_scene(axes, image, view)
        _draw_design(axes, design, place, step, image, view)
        if receiver is not None:
            axes.plot(*view.project(np.array(receiver.origin_m)), **RECEIVER_LOOK)
    kinds = [int(kind) for one in designs for kind in np.unique(one.outcome[place, step])]
    _legend(figure, kinds, receiver=receiver is not None)
    figure.suptitle(_told(shown, place, step) + CUT_OPEN * cut, fontsize=SMALL_POINTS, color=SOFT)
    return figure


def opened(shown: Shown, place: int, step: int, view: View, pixels: int) -> tuple[Shaded, bool]:
    """The scene as it is seen, and whether what stands before the sensors is cut away, as walls that hide them."""
    frame = shown.frames[step]
    image = shaded(shown.scene, frame, view, pixels)
    origins = np.concatenate([np.zeros((0, 3)), *(one.rays[place].origin_m for one in shown.designs)])
    slack = SLACK_SHARE * (view.window[1] - view.window[0])
    if not len(origins) or image.hides(view, origins, slack).mean() <= MOST_HIDDEN:
        return image, False
    nearer = replace(view, near_m=float(view.depth(origins).min()) - slack)
    return shaded(shown.scene, frame, nearer, pixels), True


def framed_points(shown: Shown, place: int, step: int) -> np.ndarray:
    """What the picture must hold: where rays start and end, and bodies that are not far beyond, shape (K, 3) [m]."""
    receiver = shown.scene.receiver
    ends = [np.zeros((0, 3)) if receiver is None else np.array([receiver.origin_m])]
    for one in shown.designs:
        rays = one.rays[place]
        # what hits nothing ends somewhere
        met = one.outcome[place, step] != Outcome.MISS
        ends += [rays.origin_m, one.ends_m[place, step][met] if met.any() else one.ends_m[place, step]]
    points = np.concatenate(ends)
    around = [frustum_lines(sensor) for one in shown.designs for sensor in _drawn_sensors(one.placed[place].sensors)]
    bodies = np.concatenate([_body_points(shown.scene, shown.frames[step]), *around])
    bodies = bodies[np.isfinite(bodies).all(axis=1)]
    if not len(points):
        return bodies if len(bodies) else np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    reach = REACH * float((high - low).max())
    return np.concatenate([points, np.clip(bodies, low - reach, high + reach)])


def _body_points(scene: Scene, frame: int) -> np.ndarray:
    """Ends of all finite targets along the axes, shape (K, 3)."""
    found = [np.zeros((0, 3))]
    for body in scene.bodies:
        if body.is_target and not isinstance(body.shape, Plane):
            vertices, _ = body_triangles(body, frame, np.zeros((2, 3)))
            found.append(np.stack([vertices.min(axis=0), vertices.max(axis=0)]))
    return np.concatenate(found)


def _draw_scene(axes: Axes, image: Shaded, view: View) -> None:
    axes.imshow(image.colour, extent=view.window, origin="lower", interpolation="antialiased", zorder=0)
    axes.set_xlim(view.window[0], view.window[1])
    axes.set_ylim(view.window[2], view.window[3])
    axes.set_aspect("equal")
    axes.set_axis_off()
    _scale_bar(axes, view)


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


def _draw_design(axes: Axes, one: ShownDesign, place: int, step: int, image: Shaded, view: View) -> None:
    rays, outcome, ends = one.rays[place], one.outcome[place, step], one.ends_m[place, step]
    keep = np.unique(np.linspace(0, len(rays) - 1, min(len(rays), MOST_RAYS)).astype(int))
    slack = SLACK_SHARE * (view.window[1] - view.window[0])
    share = min(1.0, math.sqrt(DENSE_RAYS / max(len(keep), 1)))
    for kind, (colour, dash, width) in OUTCOME_LOOKS.items():
        some = keep[outcome[keep] == kind]
        if not len(some):
            continue
        starts = rays.origin_m[some]
        _draw_lines(axes, starts, ends[some], image, view, slack, color=colour, linestyle=dash, width=width * share)
        if kind == Outcome.RETURN:
            seen = ends[some][~image.hides(view, ends[some], 2 * slack)]
            axes.plot(*view.project(seen).T, "o", color=colour, markersize=2.2 * share + 0.3, zorder=4)
    _draw_sensors(axes, one.placed[place].sensors, rays.origin_m[keep], view)
    returned = int((outcome == Outcome.RETURN).sum())
    drawn = "" if len(outcome) == one.fired else f" of {len(outcome)} of {one.fired} rays drawn"
    told = drawn or f" of {one.fired} rays"
    axes.set_title(f"{plain_label(one.design.name)}: {returned}{told} return", fontsize=SMALL_POINTS, color=INK, pad=2)


def _draw_lines(
    axes: Axes,
    starts: np.ndarray,
    ends: np.ndarray,
    image: Shaded,
    view: View,
    slack_m: float,
    *,
    color: str,
    linestyle: object,
    width: float,
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
            axes.add_collection(
                LineCollection(pieces, colors=color, linestyles=linestyle, linewidths=width, alpha=opacity, zorder=2)
            )


def _runs(line: np.ndarray, mask: np.ndarray) -> list[np.ndarray]:
    """Ends of the stretches of a straight line whose pieces are in a mask, (P + 1, 2) and (P,) to (2, 2) each."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [line[[begin, end]] for begin, end in zip(edges[::2], edges[1::2], strict=True)]


def _draw_sensors(axes: Axes, sensors: Sequence[Sensor], origins_m: np.ndarray, view: View) -> None:
    for sensor in _drawn_sensors(sensors):
        axes.plot(*view.project(frustum_lines(sensor)).T, color=SENSOR, linewidth=0.6, alpha=0.75, zorder=3)
    places = np.unique(np.round(view.project(origins_m), 6), axis=0)
    few = len(places) < FEW_PLACES
    axes.plot(*places.T, "D" if few else ".", color=SENSOR, markersize=3.2 if few else 1.6, zorder=5)


def _drawn_sensors(sensors: Sequence[Sensor]) -> Sequence[Sensor]:
    return sensors if len(sensors) <= MOST_SENSORS else ()


def _legend(figure: Figure, kinds: Sequence[int], *, receiver: bool) -> None:
    from matplotlib.lines import Line2D

    shown = [kind for kind in Outcome if int(kind) in kinds]
    looks = {kind: OUTCOME_LOOKS[kind] for kind in shown}
    handles = [Line2D([], [], color=SENSOR, marker="D", markersize=3.2, linewidth=0.6)]
    handles += [
        Line2D([], [], color=colour, linestyle=dash, linewidth=1.2, marker="o" if kind == Outcome.RETURN else "")
        for kind, (colour, dash, _) in looks.items()
    ]
    names = ["sensor, field of view and gate", *(kind.name.lower().replace("_", " ") for kind in shown)]
    if receiver:
        handles.append(Line2D([], [], **RECEIVER_LOOK))
        names.append("detector")
    look = {"ncols": 6, "frameon": False, "handlelength": 2.4, "columnspacing": 1.2}
    figure.legend(handles, names, loc="outside lower center", **look)


def _told(shown: Shown, place: int, step: int) -> str:
    """Which scene it is, when and where."""
    told = f"held-out scene {plain_label(shown.scene.name)}"
    if shown.scene.frames > 1:
        told += f", frame {shown.frames[step] + 1} of {shown.scene.frames}"
    at = shown.places[place] if shown.places else {}
    if at:
        told += ", seen from " + ", ".join(f"{name}={value:g}" for name, value in at.items())
    left_out = len(shown.designs) - MOST_DESIGNS
    return f"{told}; {left_out} more designs are not drawn" if left_out > 0 else told
