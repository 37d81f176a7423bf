"""What a design sees in a scene: its returns as clouds of points, and the target surface that no sensor sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidardesign.clouds.ros import NANOSECONDS
from lidardesign.errors import ConfigError, DataError
from lidardesign.evaluation.request import fired_numbers
from lidardesign.numerics import COARSE_SLACK, SLACK
from lidardesign.run.clock import phase
from lidardesign.run_folder import RunFolder
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.mesh_files import OTHER_FORMATS, SUFFIXES, Y_UP, load_mesh
from lidardesign.scenes.rays import Returns
from lidardesign.scenes.scene import Body, Round, Scene, inverse_rigid
from lidardesign.scenes.triangulation import own_triangles, scene_bounds
from lidardesign.scoring.fired import Positions, fired
from lidardesign.scoring.scene_scores import returns_in_scene
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import Sensor
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import build_casters
from lidardesign.task import Metric

# Columns of a cloud with their types in files; points are rounded last.
COLUMNS = (
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2"), ("outcome", "u1"),
    ("occluder", "u1"), ("ray", "<u4"),
)  # fmt: skip
LONGEST_SHARE, MOST_TRIANGLES = 1 / 16, 500_000  # of a body's extent, in which what is seen is told; of a body


@dataclass(frozen=True, eq=False, repr=False)
class SeenScene:
    """What a design returns in a scene.

    Arguments:
        design: The design.
        scene: The scene.
        returns: One entry per frame; along a condition all frames of every value in turn.
        effects: Names of the effects that were simulated.
    """

    design: DesignSpec
    scene: Scene
    returns: Sequence[Returns]
    effects: tuple[str, ...] = ()

    def __repr__(self) -> str:
        count = sum(int(one.returned.sum()) for one in self.returns)
        return f"<SeenScene {self.scene.name}: {len(self.returns)} frames, {count} returns>"

    def points_m(self, number: int) -> np.ndarray:
        """The measured points of an entry of `returns`, not a number without a return, (N, 3) [m]."""
        one = self.returns[number]
        return one.rays.origin_m + one.range_m[:, None] * one.rays.direction

    def cloud(self, number: int) -> np.ndarray:
        """The table of all rays of an entry of `returns`: `COLUMNS`.

        `t` is since the frame began [ns], `ring` the sensor, `outcome` a number of `Outcome`; `occluder` is 1 where the
        first thing on the ray is no target, as the robot itself. Intensity is 1 for every return: it is not simulated.
        """
        one, table = self.returns[number], np.zeros(len(self.returns[number].rays), dtype=list(COLUMNS))
        hits = SceneCaster(self.scene, one.frame).first_hit(one.rays.origin_m, one.rays.direction)
        is_target = np.array([body.is_target for body in self.scene.bodies])
        columns = {
            **dict(zip("xyz", self.points_m(number).T, strict=True)),
            "intensity": one.returned,
            "t": np.round(NANOSECONDS * one.rays.time_s),
            "ring": one.rays.sensor,
            "outcome": one.outcome,
            "occluder": (hits.body >= 0) & ~is_target[hits.body],
            "ray": np.arange(len(table)),
        }
        for name, column in columns.items():
            table[name] = column
        return table

    def unseen(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles of the targets that no sensor sees in any entry of `returns`, where they are in the first frame.

        Large triangles are divided. One is seen where its middle lies in the field of view and gate of a sensor that
        fires, from where it fires, with nothing in between.

        Returns:
            Vertices (V, 3) [m] and faces (F, 3).
        """
        views, vertices, faces = self._views(), [], []
        bounds_m = scene_bounds(self.scene, 0, [one.rays for one in self.returns])
        for number, body in enumerate(self.scene.bodies):
            if not body.is_target:
                continue
            corners, triangles = _divided(*own_triangles(body, body.pose(), bounds_m))
            first, *others = np.moveaxis(corners[triangles], 1, 0)
            # what has no area cannot be seen, and is not missed
            size_m2 = np.square(np.ptp(corners, axis=0)).sum()
            seen = np.linalg.norm(np.cross(others[0] - first, others[1] - first), axis=1) <= SLACK * size_m2
            for frame, caster, sensors in views:
                pose = body.pose(frame)
                placed = (corners @ pose[:3, :3].T + pose[:3, 3])[triangles]
                centre = placed.mean(axis=(0, 1)) if isinstance(body.shape, Round) else None
                for sensor in sensors:
                    rest = np.flatnonzero(~seen)
                    seen[rest] = _seen_by(sensor, caster, number, placed[rest], centre)
            pose, own = body.pose(), triangles[~seen]
            faces.append(own + sum(map(len, vertices)))
            vertices.append(corners @ pose[:3, :3].T + pose[:3, 3])
        if not faces:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
        used, compact = np.unique(np.concatenate(faces), return_inverse=True)
        return np.concatenate(vertices)[used], compact.reshape(-1, 3).astype(np.int32)

    def _views(self) -> list[tuple[int, SceneCaster, list[Sensor]]]:
        """The frame of each entry of `returns`, with the sensors that fire in it where they fire from."""
        casters, found = build_casters(self.scene), []
        for one in self.returns:
            rays = one.rays
            places = {index: rays.origin_m[rays.sensor == index].mean(axis=0) for index in np.unique(rays.sensor)}
            sensors = [replace(self.design.sensors[index], origin_m=place) for index, place in places.items()]
            found.append((one.frame, casters[one.frame], sensors))
        return found


def _divided(corners: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of which none is long beside its body, each longer one divided into four again and again."""
    longest_m = LONGEST_SHARE * float(np.linalg.norm(np.ptp(corners, axis=0)))
    while True:
        ends = corners[triangles]
        is_long = np.linalg.norm(ends - ends[:, [1, 2, 0]], axis=2).max(axis=1) > longest_m
        if not is_long.any() or len(triangles) + 3 * is_long.sum() > MOST_TRIANGLES:
            return corners, triangles
        split, count = triangles[is_long], len(corners)
        middles = (corners[split] + corners[split[:, [1, 2, 0]]]) / 2
        corners = np.concatenate([corners, middles.reshape(-1, 3)])
        (a, b, c), (ab, bc, ca) = split.T, count + np.arange(3 * len(split)).reshape(-1, 3).T
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([triangles[~is_long], *(np.stack(part, axis=1) for part in parts)])


def _seen_by(
    sensor: Sensor, caster: SceneCaster, body: int, triangles_m: np.ndarray, centre_m: np.ndarray | None
) -> np.ndarray:
    """Mask of triangles of a body, (N, 3, 3) [m], that a sensor sees; a round body has a centre."""
    middle = triangles_m.mean(axis=1)
    away = middle - sensor.origin_m
    distance_m = np.linalg.norm(away, axis=1)
    seen = (sensor.gate_m[0] <= distance_m) & (distance_m < sensor.gate_m[1]) & (distance_m > 0)
    if centre_m is not None:
        # the triangles of round bodies lie inside them; but these are convex, and show what faces the sensor
        normal = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
        outward = np.sign(np.einsum("ij,ij->i", normal, middle - centre_m))
        seen &= outward * np.einsum("ij,ij->i", normal, away) < 0
    looking = away[seen] / distance_m[seen, None]
    inside = (np.abs(sensor.tangent_of(looking)) <= np.array(sensor.field_of_view_rad) / 2 + COARSE_SLACK).all(axis=1)
    seen[seen] = inside
    looking = looking[inside]
    hits = caster.first_hit(np.broadcast_to(sensor.origin_m, looking.shape), looking)
    near = True if centre_m is not None else hits.range_m >= (1 - COARSE_SLACK) * distance_m[seen]
    seen[seen] = (hits.body == body) & near
    return seen


@dataclass(frozen=True)
class Measuring:
    """How a design measures.

    Arguments:
        detector: The name of a detector, or its file.
        seed: Root of the scenes and of the effects' random numbers; None: the run's.
    """

    detector: str = "ideal"
    seed: int | None = None

    def planner(self, metric: Metric | None = None) -> Planner:
        """The rule by which effects are chosen: those that a scene calls for, and that a metric can tell."""
        planner = Planner(load_detector(self.detector))
        return planner if metric is None else replace(planner, tolerance=planner.tolerated.within(metric))


@phase("simulation")
def seen_scenes(
    run: RunFolder,
    design: DesignSpec,
    count: int,
    scenes: int | Sequence[Scene],
    measuring: Measuring,
    settings: Sequence[str] = (),
) -> list[SeenScene]:
    """What a design sees in scenes of a run, as `evaluate` simulates it.

    Arguments:
        run: The run.
        design: The design.
        count: Rays per frame.
        scenes: The scenes, or how many of the held-out ones.
        measuring: How it measures.
        settings: Keys of the task with values, for scenes other than the learned ones.
    """
    run = run.with_settings(settings)
    planner, seed = measuring.planner(run.metric), run.config.seed if measuring.seed is None else measuring.seed
    chosen = run.scenes("test", seed)[:scenes] if isinstance(scenes, int) else scenes
    positions = fired(design, *fired_numbers([design], [count]), run.conditions(), planner, run.task)
    return [_seen(design, scene, positions, planner, seed) for scene in chosen]


@phase("simulation")
def seen_in_file(scene: Scene, design: DesignSpec, count: int, measuring: Measuring) -> SeenScene:
    """What a design sees in a scene of a user's own; arguments as of `seen_scenes`."""
    planner = measuring.planner()
    return _seen(design, scene, fired(design, count, planner=planner), planner, measuring.seed or 0)


def _seen(design: DesignSpec, scene: Scene, positions: Positions, planner: Planner, seed: int) -> SeenScene:
    casters = build_casters(scene)
    plan = planner.plan(scene, list(positions), casters)
    return SeenScene(
        design,
        scene,
        returns_in_scene(scene, positions, casters, planner.physics(plan, seed)),
        tuple(sorted(plan.effects)),
    )


def scene_of_file(path: Path, mount: str | None, scale: float = 1.0) -> Scene:
    """A scene of a user's file: a mesh, or a MuJoCo model in its initial configuration; everything is a target.

    Arguments:
        path: The file.
        mount: The body of the model in whose frame the design is; None: the world.
        scale: Factor from a mesh's unit to metres.

    Raises:
        ConfigError: A scale for a robot.
        DataError: The file cannot be read.
    """
    if (suffix := path.suffix.lower()) in (*SUFFIXES, *OTHER_FORMATS):
        mesh = load_mesh(path, scale=scale)
        if suffix in Y_UP:
            mesh = replace(mesh, vertices=mesh.vertices[:, [2, 0, 1]])
        return Scene((Body(mesh, path.stem),), path.stem)
    if scale != 1:
        raise ConfigError("only meshes have a scale", where="--scale", hint="leave it out")
    from lidardesign.scenes.mujoco_models import body_poses, load_model, visible_geoms

    model, _ = load_model(path)
    poses = body_poses(model, model.qpos0)
    if mount is not None:
        names = [model.body(number).name for number in range(model.nbody)]
        if mount not in names:
            raise DataError(
                f"has no body {mount!r}, which the design is mounted on",
                where=str(path),
                allowed=", ".join(filter(None, names)),
            )
        poses = inverse_rigid(poses[:, names.index(mount)])[:, None] @ poses
    return Scene(tuple(geom.at(poses) for geom in visible_geoms(model)[0]), path.stem)
