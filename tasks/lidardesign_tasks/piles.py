"""Piles of objects at rest in a bin or on a table, simulated as falling rigid bodies in MuJoCo.

In contact an object is the convex hull of its mesh: hollows are filled, so nothing lies in a bowl or through a handle,
and surfaces, kept apart by hulls, never cross. The simulation is scaled to objects of 0.1 m, so that objects of any
size come to rest alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from lidardesign import Body, Box, DataError, Mesh, Outcome, Returns, mujoco_models, rigid

Kind = Literal["bin", "table"]
# Size of objects in the scaled simulation, their density, and its time step.
SIMULATED_M, DENSITY_KG_M3, STEP_S = 0.1, 500.0, 0.002
# Sliding, twisting and rolling friction: dry plastic or wood, and balls that come to rest.
FRICTION = (0.6, 0.003, 0.001)
# MuJoCo's impedance: contacts with a penetration of a hundredth of a millimetre in the simulation.
STIFF = (0.95, 0.99, 1e-4, 0.5, 2.0)
# Rest: speeds below these over so many successive steps.
REST_M_S, REST_RAD_S, REST_STEPS, MOST_STEPS = 0.005, 0.1, 25, 3000
# Hulls at rest overlap by at most the smaller of a millimetre and a hundredth of an object.
MOST_OVERLAP_M, OVERLAP_SHARE = 1e-3, 0.01
# Distance from the known background, in objects, within which returns are removed.
REMOVED_SHARE = 0.01
ATTEMPTS = 12
# The square that objects are dropped into has a side of (1 + spread sqrt(objects)) objects;
# further the margin of a table, and thickness and height of a bin's walls, in objects.
SPREAD, TABLE_MARGIN, WALL_SHARE, WALL_HEIGHT = 0.5, 0.25, 0.05, 0.5
# Least share of space that hulls at rest fill; a pile is higher than one object by at most HEAPED times that filling.
PACKED_SHARE, HEAPED = 0.5, 0.75


@dataclass(frozen=True)
class Background:
    """A bin or a table around the z axis, its floor at z = 0.

    Arguments:
        kind: `bin` has walls, `table` none.
        object_m: Diameter of the largest object [m].
        objects: Number of dropped objects.
        highest_m: Largest height of a pile [m].
    """

    kind: Kind
    object_m: float
    objects: int
    highest_m: float

    @property
    def dropped_half_m(self) -> float:
        """Half the side of the square into which objects are dropped [m]."""
        return _side_m(self.object_m, self.objects) / 2

    @property
    def half_m(self) -> float:
        """Half the inner side of the bin, or of the table [m]."""
        return self.dropped_half_m + (TABLE_MARGIN * self.object_m if self.kind == "table" else 0.0)

    @property
    def overlap_m(self) -> float:
        """Largest overlap of hulls at rest [m]."""
        return min(MOST_OVERLAP_M, OVERLAP_SHARE * self.object_m)

    @property
    def bounds_m(self) -> np.ndarray:
        """Bounds of objects at rest, shape (2, 3) [m]."""
        half = self.half_m + (self.object_m / 2 if self.kind == "table" else 0.0)
        return np.array([[-half, -half, 0.0], [half, half, self.highest_m]])

    def boxes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Half extents and centres of the floor and the walls [m]."""
        half, thick, high = self.half_m, WALL_SHARE * self.object_m, WALL_HEIGHT * self.object_m / 2
        floor = (np.array([half + 2 * thick, half + 2 * thick, thick]), np.array([0.0, 0.0, -thick]))
        if self.kind == "table":
            return [floor]
        beside, ahead = np.array([thick, half, high]), np.array([half + 2 * thick, thick, high])
        out = half + thick
        return [
            floor,
            *((beside, np.array([side * out, 0.0, high])) for side in (-1, 1)),
            *((ahead, np.array([0.0, side * out, high])) for side in (-1, 1)),
        ]

    def bodies(self) -> tuple[Body, ...]:
        """Floor and walls as occluders of a scene."""
        names = ["floor", "wall 1", "wall 2", "wall 3", "wall 4"] if self.kind == "bin" else ["top"]
        return tuple(
            Body(Box(tuple(half.tolist())), f"{self.kind} {name}", "occluder", rigid(translation_m=centre))
            for name, (half, centre) in zip(names, self.boxes(), strict=True)
        )

    def removed(self, returns: Returns) -> Returns:
        """The returns without those on the background, whose pose is known.

        As with a depth camera, points within a hundredth of an object of its faces, or behind them, are removed,
        decided by measured points alone.
        """
        points, hit = returns.points_m, np.flatnonzero(returns.returned)
        near = np.zeros(len(points), dtype=bool)
        for half, centre in self.boxes():
            near |= (np.abs(points - centre) <= half + REMOVED_SHARE * self.object_m).all(axis=1)
        outcome, range_m, body = returns.outcome.copy(), returns.range_m.copy(), returns.body.copy()
        outcome[hit[near]], range_m[hit[near]], body[hit[near]] = Outcome.MISS, np.nan, -1
        return Returns(returns.rays, outcome, range_m, body, returns.frame)


def background_of(kind: Kind, meshes: Sequence[Mesh], objects: int) -> Background:
    """The bin or table for `objects` objects out of these meshes, any of them."""
    across_m = 2 * max(_hull(mesh).radius_m for mesh in meshes)
    filled_m = objects * max(_hull(mesh).volume_m3 for mesh in meshes) / PACKED_SHARE / _side_m(across_m, objects) ** 2
    return Background(kind, across_m, objects, across_m + HEAPED * filled_m)


def _side_m(object_m: float, objects: int) -> float:
    return object_m * (1 + SPREAD * objects**0.5)


@lru_cache(maxsize=4096)
def settled_poses(meshes: tuple[Mesh, ...], background: Background, seed: int) -> tuple[np.ndarray, ...]:
    """Poses (4, 4) of objects at rest after a fall into a bin with any rotation, or onto a table upright.

    Arguments:
        meshes: One per object, each in its own frame.
        background: The bin or table.
        seed: Seed of the fall, which is repeated until all objects come to rest in place.

    Raises:
        DataError: They come to rest in no attempt, or a mesh is flat.
    """
    from scipy.spatial.transform import Rotation

    hulls = [_hull(mesh) for mesh in meshes]
    simulation = _simulation(meshes, background)
    low, high = background.bounds_m + np.array([[-1.0], [1.0]]) * background.overlap_m
    for attempt in range(ATTEMPTS):
        placed = simulation.dropped(np.random.default_rng([seed, attempt]))
        if placed is None:
            continue
        turns = [Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix() for pose in placed]
        poses = [rigid(turn, pose[:3] / simulation.scale) for turn, pose in zip(turns, placed, strict=True)]
        pairs = list(zip(hulls, poses, strict=True))
        corners = np.concatenate([hull.corners @ pose[:3, :3].T + pose[:3, 3] for hull, pose in pairs])
        if (corners >= low).all() and (corners <= high).all():
            return tuple(pose @ rigid(translation_m=-hull.centre) for hull, pose in pairs)
    raise DataError(
        f"{len(meshes)} objects did not come to rest in the {background.kind} in {ATTEMPTS} attempts",
        where="task.clutter",
        hint="set fewer objects, or background=" + ("table" if background.kind == "bin" else "bin"),
    )


@dataclass(frozen=True, eq=False)
class _Hull:
    """The convex hull of a mesh: corners (H, 3) about the middle of their bounds (3,), [m]."""

    corners: np.ndarray
    centre: np.ndarray
    volume_m3: float

    @property
    def radius_m(self) -> float:
        return float(np.linalg.norm(self.corners, axis=1).max())


@lru_cache(maxsize=256)
def _hull(mesh: Mesh) -> _Hull:
    """The hull of a mesh; raises DataError where it is flat."""
    from scipy.spatial import ConvexHull, QhullError

    used = mesh.vertices[np.unique(mesh.faces)]
    try:
        hull = ConvexHull(used)
    except QhullError as error:
        raise DataError("a mesh is flat: it has no volume that could be dropped", where="task.clutter") from error
    corners = used[np.sort(hull.vertices)]
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return _Hull(corners - centre, centre, float(hull.volume))


@lru_cache(maxsize=64)
def _simulation(meshes: tuple[Mesh, ...], background: Background) -> _Simulation:
    """Cached simulation of objects: compiling takes as long as dropping them."""
    return _Simulation([_hull(mesh).corners for mesh in meshes], background)


class _Simulation:
    """Simulation of objects, a background, and planes that keep objects inside until all have fallen."""

    def __init__(self, hulls: Sequence[np.ndarray], background: Background) -> None:
        mujoco = mujoco_models.import_mujoco()
        self.background, self.scale = background, SIMULATED_M / background.object_m
        specification = mujoco.MjSpec()
        option = specification.option
        option.timestep, option.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
        solid = {"condim": 6, "friction": FRICTION, "solref": [2.5 * STEP_S, 1.0], "solimp": STIFF}
        world = specification.worldbody
        for half, centre in background.boxes():
            world.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=self.scale * half, pos=self.scale * centre, **solid)
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            place, facing = -self.scale * background.dropped_half_m * np.array([x, y, 0.0]), [x, y, 0.0]
            world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], pos=place, zaxis=facing, **solid)
        for number, corners in enumerate(hulls):
            specification.add_mesh(
                name=f"hull{number}",
                uservert=(self.scale * corners).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
            )
            body = world.add_body()
            body.add_freejoint()
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull{number}", density=DENSITY_KG_M3, **solid)
        with mujoco_models.mujoco_warnings():
            self.model = specification.compile()
        self.guides = np.flatnonzero(self.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        self.data = mujoco.MjData(self.model)

    def dropped(self, generator: np.random.Generator) -> np.ndarray | None:
        """Scaled positions and quaternions (N, 7) of the objects at rest; None if some do not come to rest."""
        from scipy.spatial.transform import Rotation

        mujoco, count = mujoco_models.import_mujoco(), self.model.nbody - 1
        mujoco.mj_resetData(self.model, self.data)
        free = max(self.scale * self.background.dropped_half_m - SIMULATED_M / 2, 0.0)
        order = generator.permutation(count)
        start = np.zeros((count, 7))
        start[:, :2] = generator.uniform(-free, free, (count, 2))
        start[:, 2] = SIMULATED_M * (0.55 + 1.02 * order)
        if self.background.kind == "bin":
            turn = Rotation.random(count, random_state=generator)
        else:
            turn = Rotation.from_rotvec(generator.uniform(0, 2 * np.pi, (count, 1)) * np.array([0.0, 0.0, 1.0]))
        start[:, 3:] = turn.as_quat()[:, [3, 0, 1, 2]]
        self.data.qpos[:] = start.ravel()
        with mujoco_models.mujoco_warnings() as warnings:
            for guided in (1, 0):
                self.model.geom_contype[self.guides] = self.model.geom_conaffinity[self.guides] = guided
                if not self._come_to_rest() or warnings:
                    return None
        placed = self.data.qpos.reshape(count, 7).copy()
        overlap = -min((contact.dist for contact in self.data.contact), default=0.0)
        return placed if overlap <= self.scale * self.background.overlap_m else None

    def _come_to_rest(self) -> bool:
        """Step until all objects are at rest; True if that happens within `MOST_STEPS`."""
        mujoco, still = mujoco_models.import_mujoco(), 0
        for _ in range(MOST_STEPS):
            mujoco.mj_step(self.model, self.data)
            speed = self.data.qvel.reshape(-1, 2, 3)
            slow = np.abs(speed[:, 0]).max() <= REST_M_S and np.abs(speed[:, 1]).max() <= REST_RAD_S
            still = still + 1 if slow else 0
            if still >= REST_STEPS:
                mujoco.mj_forward(self.model, self.data)
                return True
        return False
