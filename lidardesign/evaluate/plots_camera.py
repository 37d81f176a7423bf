"""A scene as a shaded image, seen from afar: parallel light rays are cast at it, one per pixel.

Parallel projection has no vanishing points: equal lengths stay equal wherever they are, as in a technical drawing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidardesign.evaluate.plots_canvas import INK
from lidardesign.numerics import EPSILON_FLOAT32, HALF_DIGITS
from lidardesign.scene import Body, Plane, Scene
from lidardesign.simulate.raycast import SceneCaster

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
        forward = -_from(directions)
        up = np.array([0.0, 0.0, 1.0]) - forward[2] * forward
        up /= np.linalg.norm(up)
    view = View(np.cross(forward, up), up, forward, (0.0, 1.0, 0.0, 1.0), 0.0)
    places = view.project(points_m)
    low, high = places.min(axis=0), places.max(axis=0)
    # no picture is thinner than a third of its length
    least = max(float((high - low).max()), HALF_DIGITS) / 3
    pad = np.maximum((least - (high - low)) / 2, 0.0) + margin * 3 * least
    (left, bottom), (right, top) = low - pad, high + pad
    depth = view.depth(points_m)
    near = float(depth.min() - 3 * np.ptp(depth) - 3 * least)
    return replace(view, window=(float(left), float(right), float(bottom), float(top)), near_m=near)


def _from(directions: np.ndarray) -> np.ndarray:
    """The unit vector towards the camera."""
    mean = directions.mean(axis=0) if len(directions) else np.array([1.0, 0.0, 0.0])
    forward = np.array([mean[0], mean[1], 0.0])
    length = float(np.linalg.norm(forward))
    # what looks down or all around has no side
    forward = forward / length if length > 0.1 else np.array([0.6, 0.8, 0.0])
    eye = SIDE * np.array([-forward[1], forward[0], 0.0]) - BEHIND * forward + np.array([0.0, 0.0, ABOVE])
    return eye / np.linalg.norm(eye)


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
    seen = _without_backs(scene, frame, view)
    colour, depth = np.zeros((len(starts), 4)), np.full(len(starts), np.inf)
    if seen.bodies:
        caster = SceneCaster(seen, frame)
        kinds = np.array([_colour(body) for body in seen.bodies])
        for block in np.array_split(np.arange(len(starts)), max(1, len(starts) // BLOCK)):
            hits = caster.first_hit(starts[block], np.broadcast_to(view.forward, (len(block), 3)))
            met = np.isfinite(hits.range_m)
            depth[block] = view.near_m + hits.range_m
            lit = kinds[hits.body[met]] * _light(hits.normal[met], view)[:, None]
            colour[block[met], :3] = np.minimum(lit, 1.0)
            colour[block[met], 3] = 1.0
    depth = depth.reshape(height, width)
    colour = colour.reshape(height, width, 4)
    _draw_edges(colour, depth, EDGE_DEPTH * (right - left))
    return Shaded(colour, depth)


def _colour(body: Body) -> tuple[float, float, float]:
    if isinstance(body.shape, Plane):
        return GROUND
    return TARGET if body.is_target else OTHER


def _light(normal: np.ndarray, view: View) -> np.ndarray:
    """Brightness of surfaces: from the front, and from the upper left."""
    lamp = -view.forward - 0.8 * view.right + 0.9 * view.up
    lamp /= np.linalg.norm(lamp)
    front, sideways = np.abs(normal @ view.forward), np.clip(normal @ lamp, 0.0, 1.0)
    return AMBIENT + FRONT * front + LAMP * sideways


def _without_backs(scene: Scene, frame: int, view: View) -> Scene:
    """The scene without the planes that the camera is behind: walls and ceilings would hide everything."""
    kept = tuple(
        body
        for body in scene.bodies
        if not isinstance(body.shape, Plane) or body.pose(frame)[:3, 2] @ view.forward < -EPSILON_FLOAT32
    )
    return replace(scene, bodies=kept) if kept and len(kept) < len(scene.bodies) else scene


def _draw_edges(colour: np.ndarray, depth: np.ndarray, step_m: float) -> None:
    """Darken pixels where the depth jumps: outlines tell things apart that are lit alike."""
    from matplotlib.colors import to_rgb

    edge = np.zeros(depth.shape, dtype=bool)
    finite = np.where(np.isfinite(depth), depth, depth[np.isfinite(depth)].max(initial=0.0) + 10 * step_m)
    edge[:, 1:] |= np.abs(np.diff(finite, axis=1)) > step_m
    edge[1:] |= np.abs(np.diff(finite, axis=0)) > step_m
    edge &= np.isfinite(depth)
    colour[edge, :3] = 0.55 * colour[edge, :3] + 0.45 * np.array(to_rgb(INK))
