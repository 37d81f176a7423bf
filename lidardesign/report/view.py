"""The report's section with the 3D view: its switches, sliders and buttons, and the data that it is drawn from.

The data are one JSON document, numbers as base64 of little-endian arrays. Bodies at rest are merged, moving ones keep
their own frame and a pose per frame; sensors are a few numbers each, and the page draws their fields of view and gates;
a ray is its origin, direction, length and outcome. The page's script (`assets/scene.js`) draws the parts that
are switched on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidardesign.numerics import EPSILON_FLOAT32
from lidardesign.report.figures import OUTCOME_WORDS, Series, encoded
from lidardesign.report.scene_figure import (
    MOST_FACES,
    PATTERN,
    SMALLEST_SPREAD_M,
    DrawnDesign,
    SceneFigure,
    drawn_share,
    gate_shell,
    origin_lines,
    round_steps,
)
from lidardesign.run.markup import rendered
from lidardesign.scenes.rays import Outcome
from lidardesign.scenes.scene import Body, Mesh, Scene
from lidardesign.scenes.surface import half_extents_m
from lidardesign.scenes.triangulation import own_triangles, scene_bounds
from lidardesign.sensors.pattern import field_on_sphere
from lidardesign.sensors.sensor import Sensor, interval_factor

MOST_SENSORS = 40  # drawn as frusta and switched one by one; of more only rays are drawn
MOST_BODIES = 2000  # of a scene, the largest first
MOST_RUNS = 20  # of patterns that fire one after the other
MARGIN = 1.0  # of the scene's extent: rays that go farther are cut there
BESIDE_DEG, ABOVE_DEG = 129.0, 26.0  # of the first view: from where sensors look, and above the ground
# More rays that hit nothing would hide everything else.
MANY_RAYS, FAINT = 300, 0.22
# What tells outcomes apart beside their colours (Okabe and Ito 2008): dashes of lines, marks at their ends.
OUTCOMES = tuple(
    (code, OUTCOME_WORDS[code], colour, dash, symbol)
    for code, colour, dash, symbol in (
        (Outcome.RETURN, "#009E73", "solid", "cross-thin-open"),
        (Outcome.OCCLUDED, "#D55E00", "dash", "x-thin-open"),
        (Outcome.AFTER_GATE, "#0072B2", "dot", "diamond-open"),
        (Outcome.MISS, "#6b7280", "longdash", None),
        (Outcome.NOT_DETECTED, "#CC79A7", "dashdot", "square-open"),
    )
)


def view_document(shown: SceneFigure, looks: Sequence[Series], density_m: np.ndarray | None = None) -> dict[str, Any]:
    """The document of a view.

    Arguments:
        shown: The scene, and the designs in it.
        looks: The style of each design, in the same order.
        density_m: Points that the learned density observes, shape (K, 3) [m].
    """
    bodies = drawn_bodies(shown)
    bounds = view_bounds(shown)
    share, steps = drawn_share(shown.scene), round_steps(shown.scene)
    return {
        "frames": len(shown.frames),
        "places": len(shown.places),
        "bounds": bounds.tolist(),
        "camera": camera(shown.directions),
        "outcomes": [
            {"code": int(code), "colour": colour, "dash": dash, "symbol": symbol}
            for code, _, colour, dash, symbol in OUTCOMES
        ],
        "rest": [_resting(bodies, target, bounds, share, steps) for target in (True, False)],
        "moving": [_moving(body, shown, bounds, share, steps) for body in bodies if body.poses.ndim == 3],
        "designs": [_design(one, look) for one, look in zip(shown.designs, looks, strict=True)],
        "density": None if density_m is None else encoded(density_m, "<f4"),
        "many": MANY_RAYS,
        "faint": FAINT,
    }


def drawn_bodies(shown: SceneFigure) -> list[Body]:
    """The bodies that are drawn: the largest, where there are very many."""
    bodies = list(shown.scene.bodies)
    if len(bodies) <= MOST_BODIES:
        return bodies
    largest = np.argsort([_size(body) for body in bodies], kind="stable")[::-1][:MOST_BODIES]
    return [bodies[index] for index in np.sort(largest)]


def _size(body: Body) -> float:
    shape = body.shape
    return float(max(np.ptp(shape.bounds_m, axis=0) / 2 if isinstance(shape, Mesh) else half_extents_m(shape)))


def view_bounds(shown: SceneFigure) -> np.ndarray:
    """The drawn box, shape (2, 3) [m]: scene, sensors, and their rays up to a margin."""
    rays = [one for design in shown.designs for one in design.rays]
    each = np.array([scene_bounds(shown.scene, frame, rays) for frame in {shown.frames[0], shown.frames[-1]}])
    low, high = each[:, 0].min(axis=0), each[:, 1].max(axis=0)
    reach = MARGIN * float((high - low).max())
    ends = np.concatenate([np.zeros((0, 3)), *(piece for design in shown.designs for piece in _drawn_points(design))])
    if len(ends):
        low = np.minimum(low, np.maximum(ends.min(axis=0), low - reach))
        high = np.maximum(high, np.minimum(ends.max(axis=0), high + reach))
    return np.stack([low, high])


def _drawn_points(one: DrawnDesign) -> list[np.ndarray]:
    """Drawn points of a design: ends of rays, and gates and origins at the first and the last position."""
    points = [one.ends_m.reshape(-1, 3)]
    for design in (one.placed[0], one.placed[-1]) if len(one.design.sensors) <= MOST_SENSORS else ():
        for sensor in design.sensors:
            starts = origin_lines(sensor, design.level)
            points += [gate_shell(sensor)[0], starts[~np.isnan(starts[:, 0])]]
    return points


def is_flat(directions: np.ndarray) -> bool:
    """True where all rays lie in planes of constant z: a scene that is viewed as a map."""
    return bool(len(directions)) and float(np.abs(directions[:, 2]).max()) < EPSILON_FLOAT32


def camera(directions: np.ndarray) -> dict[str, Any]:
    """The direction of the first view [rad]: from beside the sensors, a little behind and above them.

    A world in the plane z = 0 is looked at from above, as on paper.
    """
    if is_flat(directions):
        return {"turn": -math.pi / 2, "height": math.pi / 2, "flat": True}
    x, y, _ = directions.mean(axis=0) if len(directions) else (1.0, 0.0, 0.0)
    # what looks down or all around has no side
    ahead = math.atan2(y, x) if math.hypot(x, y) > EPSILON_FLOAT32 else 0.0
    return {"turn": ahead + math.radians(BESIDE_DEG), "height": math.radians(ABOVE_DEG), "flat": False}


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    wide = len(vertices) > 65_535
    return {"vertices": encoded(vertices, "<f4"), "faces": encoded(faces, "<u4" if wide else "<u2"), "wide": wide}


def _resting(bodies: Sequence[Body], target: bool, bounds: np.ndarray, share: float, steps: int) -> dict[str, Any]:
    """All bodies at rest of one role as one mesh in the world."""
    pieces = []
    for body in bodies:
        if body.is_target == target and body.poses.ndim == 2:
            vertices, faces = own_triangles(body, body.poses, bounds, share, steps)
            pieces.append((vertices @ body.poses[:3, :3].T + body.poses[:3, 3], faces))
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    vertices = np.concatenate([np.zeros((0, 3)), *(vertices for vertices, _ in pieces)])
    moved = (faces + start for (_, faces), start in zip(pieces, offsets[:-1], strict=True))
    return _mesh(vertices, np.concatenate([np.zeros((0, 3), dtype=np.int64), *moved]))


def _moving(body: Body, shown: SceneFigure, bounds: np.ndarray, share: float, steps: int) -> dict[str, Any]:
    """A body in its own frame, with the upper three rows of its pose at every frame that is shown."""
    poses = np.stack([body.pose(frame) for frame in shown.frames])
    vertices, faces = own_triangles(body, poses[0], bounds, share, steps)
    return {"target": body.is_target, "poses": encoded(poses[:, :3], "<f4"), **_mesh(vertices, faces)}


def _design(one: DrawnDesign, look: Series) -> dict[str, Any]:
    few = len(one.design.sensors) <= MOST_SENSORS
    cones = [[_cone(sensor, design.level) for sensor in design.sensors] for design in one.placed] if few else []
    return {
        "colour": look.colour,
        "dash": look.dash,
        "sensors": len(one.design.sensors) if few else 0,
        "cones": encoded(np.array(cones), "<f4"),
        "rays": len(one.rays[0]),
        "owner": encoded(one.rays[0].sensor, "<u2"),
        "origin": encoded(np.stack([rays.origin_m for rays in one.rays]), "<f4"),
        "direction": encoded(np.stack([rays.direction for rays in one.rays]), "<f4"),
        "length": encoded(one.length_m, "<f4"),
        "outcome": encoded(one.outcome, "|u1"),
    }


def _cone(sensor: Sensor, level: float) -> np.ndarray:
    """Origin, forward, horizontal and vertical (3 each), field of view, gate (2 each), three axes of its origins."""
    variances, axes = np.linalg.eigh(sensor.covariance_m2)
    reach = interval_factor(level) * np.sqrt(np.clip(variances, 0.0, None))
    # spreads below the smallest are drawn as points; the largest axis comes first
    spread = np.where(reach < SMALLEST_SPREAD_M, 0.0, reach) * axes
    return np.concatenate(
        [sensor.origin_m, sensor.frame.ravel(), field_on_sphere(sensor), sensor.gate_m, spread.T[::-1].ravel()]
    )


def view_section(shown: SceneFigure, looks: Sequence[Series], density_m: np.ndarray | None) -> str:
    """The HTML section of the view; `looks` are the designs' styles, `density_m` (K, 3) observed points [m]."""
    there = {int(code) for one in shown.designs for code in np.unique(one.outcome)} | {int(Outcome.RETURN)}
    designs = [one.design for one in shown.designs]
    rays = [np.bincount(one.rays[0].sensor, minlength=len(one.design.sensors)).tolist() for one in shown.designs]
    return rendered(
        "report/templates/scene.html",
        notes=view_notes(shown),
        is_flat=is_flat(shown.directions),
        sliders=_sliders(shown),
        outcomes=[(int(code), *look) for code, *look in OUTCOMES if int(code) in there],
        has_occluders=not all(body.is_target for body in shown.scene.bodies),
        has_density=density_m is not None,
        designs=list(zip(designs, looks, rays, strict=True)),
        most_sensors=MOST_SENSORS,
        document=view_document(shown, looks, density_m),
    )


def view_notes(shown: SceneFigure) -> list[str]:
    """Lines on the scene that is shown, how to read it, and what is left out."""
    how = (
        f"Held-out scene {shown.scene.name}. Lines run from where each ray starts to its first hit, or to the end of "
        "its gate; frusta are the sensors' fields of view, tinted shells their gates, ellipses where their rays start."
    )
    left_out = []
    if drawn_share(shown.scene) < 1:
        left_out.append(f"about {MOST_FACES:,} triangles of the meshes are drawn")
    if len(shown.scene.bodies) > MOST_BODIES:
        left_out.append(f"the largest {MOST_BODIES} of {len(shown.scene.bodies)} bodies are drawn")
    if len(shown.frames) < shown.scene.frames:
        left_out.append(f"{len(shown.frames)} of {shown.scene.frames} frames are shown")
    if len(shown.places) < shown.all_places:
        steps = "patterns" if PATTERN in shown.places[0] else "positions"
        left_out.append(f"{len(shown.places)} of {shown.all_places} {steps} are shown")
    left_out += [f"{name} fires {_runs(patterns, shown.scene)}" for name, patterns in shown.fired.items()]
    left_out += [
        f"{len(one.rays[0])} of {one.fired} rays of {one.design.name} are drawn"
        for one in shown.designs
        if len(one.rays[0]) < one.fired
    ]
    if shown.physics:
        left_out.append("the detector's effects decide what returns")
    further = "; ".join(left_out)
    return [how, *([further[0].upper() + further[1:] + "."] if further else [])]


def _runs(patterns: Sequence[int], scene: Scene) -> str:
    """The patterns that fire one after the other, with the times at which they begin."""
    begins = [frame for frame, one in enumerate(patterns) if not frame or one != patterns[frame - 1]]
    if len(begins) == 1:
        return f"pattern {patterns[0]} here"
    shown = ", ".join(f"{patterns[frame]} from {frame / scene.frame_rate_hz:.4g} s" for frame in begins[:MOST_RUNS])
    return f"patterns {shown}{', ...' if len(begins) > MOST_RUNS else ''}"


def _sliders(shown: SceneFigure) -> list[tuple[str, str, list[str]]]:
    """The sliders over positions and frames: what they are of, their titles, and a label for each step."""
    names = " and ".join(shown.places[0]) or "position"
    along = "Pattern" if names == PATTERN else f"Position: {names}"
    places = [", ".join(f"{name} = {value:.4g}" for name, value in place.items()) for place in shown.places]
    rate_hz, count = shown.scene.frame_rate_hz, shown.scene.frames
    frames = [f"frame {frame + 1} of {count}, {frame / rate_hz:.2f} s" for frame in shown.frames]
    return [("place", along, places), ("frame", "Time", frames)]
