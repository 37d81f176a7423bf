"""Designs in a scene with the outcomes of their rays, and their shapes as float32 triangles and lines, for the 3D view.

As many rays, positions and frames are kept as a page can hold; `SceneFigure` has the numbers of all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lidardesign.constraints.check import check_design
from lidardesign.constraints.slack import SPACE_MARK, ConstraintSlack, constraint_slack
from lidardesign.evaluation.request import EvaluationRequest, numbers_fired
from lidardesign.evaluation.results import Evaluation
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, gate_outcomes
from lidardesign.scenes.scene import Mesh, Round, Scene
from lidardesign.scenes.surface import grid_faces
from lidardesign.scenes.triangulation import STEPS
from lidardesign.scoring.fired import Positions, fired
from lidardesign.sensors.adaptive import AdaptiveRays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.pattern import field_on_sphere
from lidardesign.sensors.sensor import Sensor, interval_factor, tangent_directions
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import build_casters, simulate_many
from lidardesign.space import DesignSpace

MOST_STEPS = 25  # positions, and frames, that a slider goes through
MOST_RAYS = 2000  # drawn per design
MOST_PLACED_RAYS = 30_000  # rays of all designs at all positions: 24 bytes each
MOST_RAY_STEPS = 120_000  # the same at all frames: 5 bytes each
FEWEST_RAYS = 300  # of a design, for which frames are given up
MOST_FACES = 40_000  # of a scene's meshes, and of its round bodies; more would make the page large and slow to open
FEWEST_STEPS = 4  # where a scene has very many of them
SHELL_STEPS = 8  # along each side of a gate's shell
SMALLEST_SPREAD_M = 1e-3  # of origins; less looks like one place
PATTERN = "pattern"  # in place of a condition, where patterns follow what they see
Conditions = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class DrawnDesign:
    """A design with its rays at each of P positions and T frames; N rays are drawn.

    Arguments:
        design: The design of the file.
        placed: The design at each position.
        rays: The drawn rays at each position, N each.
        length_m: Drawn length of each ray: to its return, the first hit, or the end of its gate, shape (P, T, N) [m].
        outcome: Values of `Outcome`, shape (P, T, N).
        fired: The number of its rays.
    """

    design: DesignSpec
    placed: tuple[DesignSpec, ...]
    rays: tuple[Rays, ...]
    length_m: np.ndarray
    outcome: np.ndarray
    fired: int

    @property
    def ends_m(self) -> np.ndarray:
        """Ends of the drawn rays at every position and frame, shape (P, T, N, 3) [m]."""
        origin = np.stack([rays.origin_m for rays in self.rays])
        direction = np.stack([rays.direction for rays in self.rays])
        return origin[:, None] + self.length_m[..., None] * direction[:, None]


@dataclass(frozen=True, eq=False)
class SceneFigure:
    """A scene with designs in it.

    Arguments:
        scene: The scene.
        frames: The frames of it that are shown, ascending.
        places: The condition values that are shown, ascending; one empty entry without conditions.
        designs: The designs, with their rays there.
        physics: Whether outcomes include a detector's effects, or are of geometry alone.
        all_places: Number of all condition values.
        fired: The pattern that fires in each frame, by the name of a design whose patterns follow what they see.
    """

    scene: Scene
    frames: tuple[int, ...]
    places: tuple[Conditions, ...]
    designs: tuple[DrawnDesign, ...]
    physics: bool = False
    all_places: int = 1
    fired: Mapping[str, Sequence[int]] = field(default_factory=dict)

    @cached_property
    def directions(self) -> np.ndarray:
        """All rays' directions, shape (K, 3)."""
        return np.concatenate([np.zeros((0, 3)), *(rays.direction for one in self.designs for rays in one.rays)])


def scene_figure(
    scene: Scene,
    designs: Sequence[DesignSpec],
    places: Sequence[Conditions],
    positions: Sequence[Positions],
    *,
    planner: Planner | None = None,
    seed: int = 0,
) -> SceneFigure:
    """Put designs into a scene.

    Arguments:
        scene: The scene.
        designs: The designs.
        places: The condition values that they are evaluated at, ascending.
        positions: The rays of each design at these, equal numbers at each; the last go on where there are fewer.
        planner: How effects are chosen; None: geometry alone.
        seed: Of the effects' random numbers.
    """
    steps = _spread(len(places), MOST_STEPS)
    chosen = tuple(places[index] for index in steps)
    every = [[lists[min(index, len(lists) - 1)] for index in steps] for lists in positions]
    # as many frames, and as many rays of each placed design, as can be drawn
    count = max(len(designs) * len(chosen), 1)
    frames = _spread(scene.frames, min(MOST_STEPS, max(5, MOST_RAY_STEPS // (count * FEWEST_RAYS))))
    share = min(MOST_PLACED_RAYS / count, MOST_RAY_STEPS / (count * len(frames)))
    budget = max(min(MOST_RAYS, math.floor(share)), 1)
    outcomes = _outcomes(scene, every, frames, planner, seed)
    drawn = []
    for design, rays, (length_m, outcome) in zip(designs, every, outcomes, strict=True):
        keep = np.array(_spread(len(rays[0]), budget), dtype=np.int64)
        at = tuple(design if PATTERN in where else design.at_condition(where) for where in chosen)
        some = tuple(one.subset(keep) for one in rays)
        drawn.append(DrawnDesign(design, at, some, length_m[..., keep], outcome[..., keep], len(rays[0])))
    return SceneFigure(scene, frames, chosen, tuple(drawn), planner is not None, len(places))


def _spread(count: int, most: int) -> tuple[int, ...]:
    """At most `most` of `count` indices, evenly from the first to the last."""
    return tuple(np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()) if count else ()


def _outcomes(
    scene: Scene, every: Sequence[Sequence[Rays]], frames: Sequence[int], planner: Planner | None, seed: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Drawn lengths and outcomes of each design's rays, shape (P, T, N) each."""
    casters = build_casters(scene) if planner is not None else {frame: SceneCaster(scene, frame) for frame in frames}
    found = [_first_hits(rays, [casters[frame] for frame in frames]) for rays in every]
    lists = [rays for one in every for rays in one]
    physics = None if planner is None else planner.physics(planner.plan(scene, lists, casters), seed)
    if physics is None:
        return found
    repeats = [place for one in every for place in range(len(one))]
    measured = iter(simulate_many(scene, lists, casters=casters, physics=physics, repeats=repeats))
    for rays, (length_m, outcome) in zip(every, found, strict=True):
        for place in range(len(rays)):
            returns = next(measured)
            for step, seen in enumerate(returns[frame] for frame in frames):
                outcome[place, step] = seen.outcome
                length_m[place, step][seen.returned] = seen.range_m[seen.returned]
    return found


def _first_hits(rays: Sequence[Rays], casters: Sequence[SceneCaster]) -> tuple[np.ndarray, np.ndarray]:
    """Lengths to the first hit or the gate's end, and outcomes by geometry alone, shape (P, T, N) each."""
    shape = (len(rays), len(casters), len(rays[0]))
    length_m, outcome = np.zeros(shape, dtype=np.float32), np.full(shape, Outcome.MISS, dtype=np.uint8)
    for place, one in enumerate(rays):
        for step, caster in enumerate(casters):
            range_m = caster.first_hit(one.origin_m, one.direction).range_m
            length_m[place, step] = np.minimum(range_m, one.gate_m[:, 1])
            outcome[place, step] = gate_outcomes(range_m, one.gate_m)
    return length_m, outcome


def evaluated_scene(evaluation: Evaluation, request: EvaluationRequest) -> SceneFigure:
    """An evaluation's designs in its first held-out scene, with the effects that the scenes call for."""
    places: Sequence[Conditions] = sorted(request.conditions, key=lambda condition: tuple(condition.values()))
    positions = {}
    for design in request.designs:
        count = design.count or max(numbers_fired(design, request.rays, request.alone))
        positions[design.name] = fired(design, count, places, request.planner, request.task)
    following = {name: lists for name, lists in positions.items() if isinstance(lists, AdaptiveRays)}
    planner = request.planner if any(effect.on for effect in evaluation.effects) else None
    if following:
        places = [{PATTERN: pattern} for pattern in range(max(map(len, following.values())))]
    scene = request.test[0]
    shown = [*positions.values()]
    found = scene_figure(scene, request.designs, places, shown, planner=planner, seed=request.seed)
    return replace(found, fired={name: _fired(scene, one, planner, request.seed) for name, one in following.items()})


def _fired(scene: Scene, positions: AdaptiveRays, planner: Planner | None, seed: int) -> list[int]:
    """The pattern that fires in each frame of a scene."""
    casters = build_casters(scene)
    physics = None if planner is None else planner.physics(planner.plan(scene, list(positions), casters), seed)
    returns = simulate_many(scene, positions, casters=casters, physics=physics, repeats=[0] * len(positions))
    return positions.fired(scene, returns)


def constraint_slack_of(design: DesignSpec, space: DesignSpace) -> list[ConstraintSlack]:
    """The slack of each constraint of a design, by the independent checker; the bounds of its space last."""
    checks = check_design(design_document(design), design.constraints, space)
    slacks = constraint_slack(checks, [sensor.name for sensor in design.sensors])
    return sorted(slacks, key=lambda one: one.name.startswith(SPACE_MARK))


def drawn_share(scene: Scene) -> float:
    """The share of a scene's triangles that is drawn: all of them up to `MOST_FACES`."""
    faces = sum(len(body.shape.faces) for body in scene.bodies if isinstance(body.shape, Mesh))
    return min(1.0, MOST_FACES / max(faces, 1))


def round_steps(scene: Scene) -> int:
    """Steps of a turn of round bodies, fewer where a scene has many of them."""
    count = sum(isinstance(body.shape, Round) for body in scene.bodies)
    # a ball of n steps has about n (n + 2) triangles
    most = math.sqrt(MOST_FACES / max(count, 1)) - 1
    return int(np.clip(4 * (most // 4), FEWEST_STEPS, STEPS))


def frustum_lines(sensor: Sensor) -> np.ndarray:
    """A field of view up to its gate's end and the gate's outlines, NaN between lines, (K, 3) float32 [m]."""
    start, end = sensor.gate_m
    corners = _patch(sensor, np.array([-1.0, 1.0]), np.array([-1.0, 1.0]))
    pieces = [np.stack([sensor.origin_m, sensor.origin_m + end * corner]) for corner in corners.reshape(-1, 3)]
    side, one = np.linspace(-1.0, 1.0, SHELL_STEPS + 1), np.ones(1)
    edges = ((side, -one), (one, side), (side[::-1], one), (-one, side[::-1]))
    outline = np.concatenate([_patch(sensor, *edge).reshape(-1, 3) for edge in edges])
    pieces += [sensor.origin_m + radius * outline for radius in (start, end)]
    return separated(pieces)


def origin_lines(sensor: Sensor, level: float) -> np.ndarray:
    """Ellipses that hold `level` of a sensor's origins along their axes, NaN between them, (K, 3) float32 [m].

    One in each plane of two principal axes; none where origins hardly spread.
    """
    variances, axes = np.linalg.eigh(sensor.covariance_m2)
    reach = interval_factor(level) * np.sqrt(np.clip(variances, 0.0, None))
    if reach.max() < SMALLEST_SPREAD_M:
        return np.zeros((0, 3), dtype=np.float32)
    turn = np.linspace(0.0, 2 * np.pi, STEPS + 1)
    spread = (axes * reach).T
    # eigenvalues grow: the first plane is that of the two largest, others only where there is a thickness
    planes = [(2, 1)] + [(2, 0), (1, 0)] * bool(reach[0] >= SMALLEST_SPREAD_M)
    return separated(
        [sensor.origin_m + np.outer(np.cos(turn), spread[a]) + np.outer(np.sin(turn), spread[b]) for a, b in planes]
    )


def gate_shell(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """The two curved faces of a sensor's gate: vertices (V, 3) float32 [m] and faces (F, 3) int32."""
    side = np.linspace(-1.0, 1.0, SHELL_STEPS + 1)
    patch = _patch(sensor, side, side).reshape(-1, 3)
    faces = grid_faces(SHELL_STEPS + 1, SHELL_STEPS + 1)
    vertices = np.concatenate([sensor.origin_m + radius * patch for radius in sensor.gate_m])
    return vertices.astype(np.float32), np.concatenate([faces, faces + len(patch)]).astype(np.int32)


def separated(lines: list[np.ndarray]) -> np.ndarray:
    """Polylines in one array with a row of NaN after each, (K, 3) float32."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([piece for line in lines for piece in (line, gap)]).astype(np.float32)


def _patch(sensor: Sensor, across: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Unit vectors over the field of view at shares -1 to 1 of its halves, shape (U, A, 3)."""
    horizontal, vertical = field_on_sphere(sensor)
    u, v = np.meshgrid(across * horizontal / 2, up * vertical / 2)
    return tangent_directions(sensor.frame, np.stack([u.ravel(), v.ravel()], axis=1)).reshape(*u.shape, 3)
