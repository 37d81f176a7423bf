"""The three-dimensional view of the page: a scene, the sensors in it, and what becomes of their rays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from lidardesign.report.scene_figure import (
    drawn_share,
    frustum_lines,
    origin_lines,
    round_steps,
)
from lidardesign.report.view import MARGIN, OUTCOMES, camera
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Body, Plane, Scene
from lidardesign.scenes.triangulation import own_triangles, scene_bounds
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor, boresight_of
from lidardesign.space import direction
from lidardesign.studio.choices import MOUNT, SensorPose

MOST_LINES = 2000  # rays that are drawn of a design
TARGET, OTHER, BLIND = (201, 184, 168), (160, 166, 174), (205, 60, 60)
DENSITY, BOX, PLACE = (123, 45, 139), (110, 118, 130), (40, 90, 160)
# Of the design that is changed, of its sensor with the handle, and of the design beside it.
SENSOR, CHOSEN, BESIDE = (40, 44, 52), (214, 94, 0), (0, 114, 178)
COLOURS = {int(code): tuple(bytes.fromhex(colour[1:])) for code, _, colour, _, _ in OUTCOMES}
COLOURS[int(Outcome.MISS)] = (214, 217, 222)  # they hide what is behind them least
HANDLE = "/handle"
Colour = tuple[int, int, int]
# In shares of the scene's extent.
DENSITY_SIZE, HANDLE_SIZE, SENSOR_SIZE, POINT_SIZE, AXES_SIZE, CAMERA_AWAY = 0.003, 0.16, 0.012, 0.006, 0.1, 0.8
LABEL_SCALE, LINE_PX = 0.8, 1.3
FROM_AHEAD_RAD, MOUNTED_AWAY = 1.4, 1.3


class Stage:
    """The view of a server; all its tabs show the same.

    Arguments:
        server: The server.
        design: A design in the frame that is drawn.
        on_pick: Called with the name of a sensor or mount that is clicked.
        on_drag: Called with the handle's pose, and True once it is let go.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        design: DesignSpec,
        on_pick: Callable[[str], None],
        on_drag: Callable[[SensorPose, bool], None],
    ) -> None:
        self.api, self._pick, self._drag = server.scene, on_pick, on_drag
        self._server, self._mount, self._is_mounted = server, design.mount or "the world", design.mount is not None
        self._bodies: list[tuple[Body, Any]] = []
        self._scene: Scene | None = None
        self.extent_m, self.bounds = 1.0, np.zeros((2, 3))
        self.api.set_up_direction("+z")
        self.api.configure_default_lights()
        self._visible: dict[str, bool] = {}
        self._nodes: dict[str, Any] = {}
        self._markers: dict[str, dict[str, Any]] = {}

    def show_scene(self, scene: Scene, frame: int, rays: Sequence[Rays]) -> None:
        """Draw a scene, once, and then only the poses of what moves in it."""
        if scene is not self._scene:
            self._draw_scene(scene, rays)
        for body, handle in self._bodies:
            pose = body.pose(frame)
            handle.position, handle.wxyz = pose[:3, 3], _quaternion(pose[:3, :3])

    def _draw_scene(self, scene: Scene, rays: Sequence[Rays]) -> None:
        is_first = self._scene is None
        for _, handle in self._bodies:
            handle.remove()
        self._scene, self._bodies = scene, []
        # floors and walls may be far larger than what is looked at
        targets = tuple(body for body in scene.bodies if body.is_target)
        self.bounds = scene_bounds(replace(scene, bodies=targets or scene.bodies), 0, list(rays))
        self.extent_m = float(np.ptp(self.bounds, axis=0).max())
        share, steps = drawn_share(scene), round_steps(scene)
        for number, body in enumerate(scene.bodies):
            vertices, faces = own_triangles(body, body.pose(), self.bounds, share, steps)
            colour = TARGET if body.is_target else OTHER
            # through a floor one looks from below
            side = "front" if isinstance(body.shape, Plane) else "double"
            handle = self.api.add_mesh_simple(
                f"/scene/{number}", vertices, faces, color=colour, flat_shading=True, side=side, cast_shadow=False
            )
            self._bodies.append((body, handle))
        if is_first:
            length = AXES_SIZE * self.extent_m
            self.api.add_frame("/frame", axes_length=length, axes_radius=0.02 * length)
            self.api.add_label(
                "/frame/name", f"x of {self._mount}", position=(length, 0, 0), font_screen_scale=LABEL_SCALE
            )
            first = camera(np.concatenate([np.zeros((0, 3)), *(one.direction for one in rays)]))
            # a robot that carries its sensors hides them from behind
            turn, share = (FROM_AHEAD_RAD, MOUNTED_AWAY) if self._is_mounted else (0.0, CAMERA_AWAY)
            away = share * self.extent_m * direction(first["turn"] - turn, first["height"])
            middle = self.bounds.mean(axis=0)
            self._server.initial_camera.look_at = middle
            self._server.initial_camera.position = middle + away

    def show_seen(self, scene: Scene, returns: Returns, beside: Colour | None = None) -> None:
        """Draw rays by what becomes of them, and their returns as points; those of a design beside it in one colour."""
        rays, name = returns.rays, "/design" if beside is None else "/beside"
        hits = SceneCaster(scene, returns.frame).first_hit(rays.origin_m, rays.direction)
        reach = np.minimum(np.minimum(hits.range_m, rays.gate_m[:, 1]), (1 + MARGIN) * self.extent_m)
        length = np.where(returns.returned, returns.range_m, reach)
        ends = np.stack([rays.origin_m, rays.origin_m + length[:, None] * rays.direction], axis=1)
        palette = np.array([beside or COLOURS.get(code, SENSOR) for code in range(max(COLOURS) + 1)], dtype=np.uint8)
        shades = palette[returns.outcome]
        drawn = np.unique(np.linspace(0, max(len(rays) - 1, 0), MOST_LINES).astype(int))[: len(rays)]
        self._lines(f"{name}/rays", ends[drawn], shades[drawn])
        self._points(f"{name}/returns", ends[returns.returned, 1], shades[returns.returned], POINT_SIZE)

    def show_sensors(self, sensors: Sequence[Sensor], chosen: str | None, beside: Colour | None = None) -> None:
        """Draw sensors with their fields of view and gates; the chosen one in another colour."""
        pieces = [
            *((_segments(frustum_lines(one)), one) for one in sensors),
            *((_segments(origin_lines(one, DEFAULT_LEVEL)), one) for one in sensors),
        ]
        shades = [np.tile(CHOSEN if one.name == chosen else beside or SENSOR, (len(lines), 1)) for lines, one in pieces]
        name = "/design" if beside is None else "/beside"
        self._lines(f"{name}/fields of view", np.concatenate([lines for lines, _ in pieces]), np.concatenate(shades))
        if beside is None:
            self._show_markers("sensors", {one.name: one.origin_m for one in sensors}, SENSOR)

    def show_places(self, mounts_m: Sequence[Sequence[float]], boxes: Sequence[np.ndarray]) -> None:
        """Draw mounts, and the boxes (2, 3) [m] that bound places."""
        lines = np.concatenate([_box_edges(box) for box in boxes])
        self._lines("/places/boxes", lines, np.tile(BOX, (len(lines), 1)))
        places = {f"{MOUNT}{number}": np.array(place) for number, place in enumerate(mounts_m)}
        self._show_markers("mounts", places, PLACE)

    def show_density(self, points_m: np.ndarray) -> None:
        """Draw the points that the learned density observes, (N, 3) [m]."""
        self._points("/density", points_m, np.tile(DENSITY, (len(points_m), 1)), DENSITY_SIZE)

    def show_blind(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Draw the surface that no sensor sees."""
        self.remove("/blind")
        if len(faces):
            self.api.add_mesh_simple("/blind", vertices, faces, color=BLIND, side="double", opacity=0.85)

    def show_handle(self, pose: SensorPose | None, *, turns: bool = True, moves: bool = True) -> None:
        """Put the handle on a pose, without rotations for a mount; None takes it away."""
        self.remove(HANDLE)
        if pose is None:
            return
        handle = self.api.add_transform_controls(
            HANDLE, scale=HANDLE_SIZE * self.extent_m, disable_rotations=not turns, depth_test=False,
            disable_axes=not moves, disable_sliders=not moves,
            position=pose.place_m, wxyz=_quaternion(pose.frame.T),
        )  # fmt: skip

        @handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.phase != "start":
                self._drag(_pose_of(event.target), event.phase == "end")

    def set_visible(self, name: str, visible: bool) -> None:
        """Show or hide a node and what is below it."""
        self._visible[name] = visible
        handle = self.api.get_handle_by_name(name)
        if handle is not None:
            handle.visible = visible

    def remove(self, name: str) -> None:
        """Take a node away, where it is there."""
        for inside in [node for node in self._nodes if node == name or node.startswith(f"{name}/")]:
            del self._nodes[inside]
        if self.api.get_handle_by_name(name) is not None:
            self.api.remove_by_name(name)

    def _lines(self, name: str, ends_m: np.ndarray, shades: np.ndarray) -> None:
        """Draw segments (N, 2, 3) [m] in colours (N, 3), or move those of this name."""
        # lines are shaded in linear light, unlike points
        linear = 255.0 * (shades / 255.0) ** 2.2
        colours = np.repeat(linear.round()[:, None], 2, axis=1).astype(np.uint8)
        options = {"thickness": LINE_PX, "thickness_units": "screen"}
        self._node(name, self.api.add_line_segments, ends_m, colours, options)

    def _points(self, name: str, points_m: np.ndarray, shades: np.ndarray, size: float) -> None:
        """Draw points (N, 3) [m] in colours (N, 3), or move those of this name."""
        options = {"point_size": size * self.extent_m}
        self._node(name, self.api.add_point_cloud, points_m.astype(np.float32), shades.astype(np.uint8), options)

    def _node(
        self, name: str, add: Callable[..., Any], points: np.ndarray, colors: np.ndarray, options: dict[str, Any]
    ) -> None:
        handle = self._nodes.get(name)
        if not len(points):
            # the browser calls empty buffers an error
            self.remove(name)
        elif handle is None:
            self._nodes[name] = add(name, points, colors, visible=self._visible.get(name, True), **options)
        else:
            handle.points, handle.colors = points, colors

    def _show_markers(self, group: str, places: dict[str, np.ndarray], colour: tuple[int, ...]) -> None:
        """Balls that choose a sensor or mount when they are clicked."""
        if [*places] != [*self._markers.get(group, {})]:
            for ball, _ in self._markers.pop(group, {}).values():
                ball.remove()
            self._markers[group] = {name: self._marker(f"/{group}/{name}", name, colour) for name in places}
        # what stands at one place is named together
        names: dict[tuple[float, ...], list[str]] = {}
        for name, place in places.items():
            names.setdefault(tuple(np.round(place, 3)), []).append(name)
        for name, place in places.items():
            ball, label = self._markers[group][name]
            ball.position, here = place, names[tuple(np.round(place, 3))]
            label.text, label.visible = ", ".join(here), name == here[0]

    def _marker(self, path: str, name: str, colour: tuple[int, ...]) -> tuple[Any, Any]:
        ball = self.api.add_icosphere(path, radius=SENSOR_SIZE * self.extent_m, color=colour)

        @ball.on_click
        async def _(event: Any) -> None:
            self._pick(name)

        return ball, self.api.add_label(f"{path}/name", name, font_screen_scale=LABEL_SCALE)


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) as viser has it: the scalar first."""
    return np.roll(Rotation.from_matrix(matrix).as_quat(), 1)


def _pose_of(handle: Any) -> SensorPose:
    """The pose of the handle, whose x axis looks forward and whose y axis is horizontal."""
    frame = Rotation.from_quat(np.roll(handle.wxyz, -1)).as_matrix().T
    return SensorPose.of(handle.position, np.degrees(boresight_of(frame)).tolist())


def _segments(lines_m: np.ndarray) -> np.ndarray:
    """Polylines separated by rows of NaN (K, 3) as segments (N, 2, 3)."""
    pairs = np.stack([lines_m[:-1], lines_m[1:]], axis=1) if len(lines_m) else np.zeros((0, 2, 3))
    return pairs[np.isfinite(pairs).all(axis=(1, 2))]


def _box_edges(box: np.ndarray) -> np.ndarray:
    """The edges of a box (2, 3) as segments (12, 2, 3)."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    ends = [(a, b) for a in corners for b in corners if (b - a).min() >= 0 and (b - a).sum() == 1]
    return np.where(np.array(ends, dtype=bool), box[1], box[0])
