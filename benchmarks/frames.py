"""One evaluation of the target with its gradient over thousands of moving frames, against two ways without culling.

Ours keeps bodies in their own frames and passes over frames whose surface term is further below the best one at a
point than a tolerance. It is compared with

- the full sum: the same code with a tolerance that leaves nothing out;
- one caster per frame: distances of all frames, and one ray-casting scene for every frame, whose bodies are put where
  they are in that frame; casters are built for some frames, and their time is scaled up to all of them.

Points are near the surfaces at the final sigma, as a trained flow draws them, and uniform in the design space at the
sigma that training starts with. The error is (full sum - ours) / the largest surface term of a point, at most.

    python benchmarks/frames.py                          # the embedded arm, and the real one where it is there
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import common  # before numpy: it limits the thread pools
import numpy as np
from common import Timing, interleaved, median_ratio, parser, report, robot_settings, verdict, without_traceback

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import build_field, scene_columns
from lidardesign.density.objective.proposals import independent_points
from lidardesign.density.objective.surfaces import SceneTable
from lidardesign.density.objective.target import PADDING_SIGMAS, Target, build_target
from lidardesign.density.objective.visibility import NoVisibility, RayBatch, Raycast, RayGradient
from lidardesign.scenes.scene import Body, Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction, observed_point

NOTHING_LEFT_OUT_NATS = 1e6
FURTHER_TOLERANCE_NATS = 16.0
START_SIGMAS = 6.0  # where the annealing of sigma starts
FULL, CASTERS = "full sum", "caster per frame"


@dataclass(frozen=True, eq=False)
class Case:
    """Points that the target is evaluated at, and how wide its surfaces are there."""

    name: str
    points: np.ndarray
    sigma_m: float


def arm_scenes(robot: str, trajectories: int, frames: int) -> tuple[list[Scene], DesignSpace, DensitySettings]:
    """Training trajectories of the arm task with its space and density."""
    from lidardesign_tasks.arm import ArmTask

    task = ArmTask()
    config = task.Config(train=trajectories, frames=frames, **robot_settings(robot))
    return list(task.scenes(config, "train", 0)), task.space(config), DensitySettings(**task.defaults.density)


def cases(target: Target, count: int) -> list[Case]:
    """Near the surfaces at the final sigma, and uniform at the first one."""
    generator, sigma_m = np.random.default_rng(0), target.optics.sigma_m
    near, _ = independent_points(target, 2 * count, generator)
    return [
        Case("near surfaces", generator.permutation(near)[:count], sigma_m),
        Case("wide start", target.space.sample(count, generator), START_SIGMAS * sigma_m),
    ]


class CasterPerFrame:
    """The way without bodies in their own frames: every frame is a scene at rest with a caster of its own.

    Arguments:
        scenes: The moving scenes.
        target: Ours, whose optics and weights are taken.
        chosen: The frames that casters are built for, as columns.
    """

    def __init__(self, scenes: Sequence[Scene], target: Target, chosen: np.ndarray) -> None:
        columns = scene_columns(scenes)
        started = time.perf_counter()
        self._raycast = Raycast([_at_rest(scenes[columns[c][0]], columns[c][1]) for c in chosen])
        self.build_s = (time.perf_counter() - started) * len(columns) / len(chosen)
        self.scale = len(columns) / len(chosen)
        self._chosen = chosen
        field = build_field(
            scenes,
            lambda body: body.is_target,
            resolution=DensitySettings().field_resolution,
            padding_m=PADDING_SIGMAS * target.optics.sigma_m,
        )
        table = SceneTable(field, target.surfaces.log_column_weights)
        self.dense = replace(target, surfaces=table, visibility=NoVisibility())

    def surface_terms(self, case: Case) -> np.ndarray:
        """log of every frame's surface term, shape (N, columns)."""
        observed = observed_point(case.points)
        return self.dense.surfaces.terms(observed, self.dense.surfaces.field.distances(observed), case.sigma_m)

    def cast(self, case: Case) -> Callable[[], object]:
        """What casts at the chosen frames, for the pairs of point and frame that count among all frames."""
        surface = self.surface_terms(case)
        active = surface >= surface.max(axis=1, keepdims=True) - self.dense.surface_tolerance_nats
        active, points = active[:, self._chosen], case.points
        rays = RayBatch(
            np.ascontiguousarray(points[:, :3]),
            direction(points[:, AZIMUTH], points[:, ELEVATION]),
            np.ascontiguousarray(points[:, RANGE]),
        )
        optics, weights = self.dense.optics.widened(case.sigma_m), np.full(active.shape, 1.0 / len(self._chosen))

        def run() -> RayGradient:
            return self._raycast.transmittance(rays, active, optics).gradient(weights)

        return run


def _at_rest(scene: Scene, frame: int) -> Scene:
    """One frame of a scene, as a scene of its own."""
    bodies = [Body(one.shape, one.name, one.role, one.pose(frame)) for one in scene.bodies]
    return Scene(tuple(bodies), f"{scene.name} frame {frame}")


def tolerances(settings: DensitySettings) -> dict[str, float]:
    """The ways of ours by name."""
    own = settings.surface_tolerance_nats
    kept = dict.fromkeys((own, FURTHER_TOLERANCE_NATS))
    return {f"{nats:g} nats": nats for nats in kept} | {FULL: NOTHING_LEFT_OUT_NATS}


def compare(
    target: Target, case: Case, casters: CasterPerFrame, ways: dict[str, float], rounds: int
) -> tuple[list[list[object]], list[list[object]]]:
    """Rows of times of every way, and rows of errors of the culled ones."""
    targets = {name: replace(target, surface_tolerance_nats=nats) for name, nats in ways.items()}
    runs: dict[str, Callable[[], object]] = {
        name: lambda one=one: one.log_density_and_gradient(case.points, case.sigma_m) for name, one in targets.items()
    }
    runs["all distances"] = lambda: casters.dense.log_density_and_gradient(case.points, case.sigma_m)
    runs["casting"] = casters.cast(case)
    measured = interleaved(runs, rounds)
    parts = measured.pop("all distances"), measured.pop("casting")
    measured[CASTERS] = Timing(
        *(
            tuple(distances + casters.scale * casting for distances, casting in zip(*rounds_of, strict=True))
            for rounds_of in ([part.wall for part in parts], [part.cpu for part in parts])
        )
    )
    ours = measured[next(iter(ways))].wall
    times = [
        [case.name, name, 1e3 * one.wall_median, 1e3 * one.cpu_median, median_ratio(one.wall, ours)]
        for name, one in measured.items()
    ]
    return times, errors(targets, case, casters.surface_terms(case))


def errors(targets: dict[str, Target], case: Case, surface: np.ndarray) -> list[list[object]]:
    """What culling loses of p*, in units of each point's largest surface term, beside the bound that is stated."""
    largest = surface.max(axis=1)
    full = targets[FULL].log_density(case.points, case.sigma_m)
    rows: list[list[object]] = []
    for name, target in targets.items():
        if name == FULL:
            continue
        culled = target.log_density(case.points, case.sigma_m)
        lost = np.abs(np.exp(full - largest) - np.exp(culled - largest)).max()
        nats = target.surface_tolerance_nats
        counted = (surface >= largest[:, None] - nats).sum(axis=1).mean()
        rows.append([case.name, name, float(counted), float(lost), surface.shape[1] * math.exp(-nats)])
    return rows


def growth(robot: str, frames: int, options: Any) -> list[object]:
    """One row: the time of ours and of the full sum over so many frames, near the surfaces."""
    scenes, space, settings = arm_scenes(robot, max(frames // options.frames, 1), min(frames, options.frames))
    target = build_target(scenes, space, settings, "raycast")
    near = cases(target, options.points)[0]
    whole = replace(target, surface_tolerance_nats=NOTHING_LEFT_OUT_NATS)
    measured = interleaved(
        {
            "ours": lambda: target.log_density_and_gradient(near.points),
            FULL: lambda: whole.log_density_and_gradient(near.points),
        },
        options.rounds,
    )
    ratio = median_ratio(measured[FULL].wall, measured["ours"].wall)
    return [robot, target.columns, 1e3 * measured["ours"].wall_median, 1e3 * measured[FULL].wall_median, ratio]


def measure(robot: str, options: Any) -> tuple[list[list[object]], list[list[object]], list[str]]:
    """Rows of times and of errors, and remarks, for one arm."""
    scenes, space, settings = arm_scenes(robot, options.trajectories, options.frames)
    target = build_target(scenes, space, settings, "raycast")
    columns = target.columns
    chosen = np.unique(np.linspace(0, columns - 1, min(options.casters, columns)).round().astype(int))
    casters = CasterPerFrame(scenes, target, chosen)
    times: list[list[object]] = []
    lost: list[list[object]] = []
    for case in cases(target, options.points):
        found = compare(target, case, casters, tolerances(settings), options.rounds)
        times += found[0]
        lost += found[1]
    within = {f"{row[0]}, {row[1]}": row[3] <= row[4] for row in lost}
    remarks = [
        f"{robot}: {CASTERS}: cast at {len(chosen)} frames, scaled up to {columns}; "
        f"building all of them would take {casters.build_s:.2f} s more, once",
        f"{robot}: {verdict('what culling loses is within its bound', within)}",
    ]
    return [[robot, *row] for row in times], [[robot, *row] for row in lost], remarks


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    made.add_argument("--robot", action="append", help="embedded, iiwa14, or a file; repeatable (default both)")
    made.add_argument("--trajectories", type=int, default=40)
    made.add_argument("--frames", type=int, default=50, help="of a trajectory (default %(default)s)")
    made.add_argument("--points", type=int, default=1024, help="design points (default %(default)s)")
    made.add_argument("--casters", type=int, default=100, help="frames that get a caster (default %(default)s)")
    made.add_argument("--growth", type=int, nargs="*", default=[100, 500, 2000, 8000], help="numbers of frames")
    options = made.parse_args()
    robots = options.robot or ["embedded", *(["iiwa14"] if common.ARM_MODEL.exists() else [])]
    times, lost, lines = [], [], []
    for robot in robots:
        found = measure(robot, options)
        times += found[0]
        lost += found[1]
        lines += found[2]
    grown = [growth(robot, frames, options) for robot in robots for frames in options.growth]
    report(
        f"Target with gradient over {options.trajectories * options.frames} moving frames, {options.points} points",
        {
            "Time per evaluation": (["arm", "points", "way", "wall ms", "CPU ms", "wall / ours"], times),
            "Culled values against the full sum, in units of the largest surface term": (
                ["arm", "points", "tolerance", "frames that count", "error, max", "bound"],
                lost,
            ),
            "Growth with the number of frames, near surfaces": (
                ["arm", "frames", "ours ms", "full sum ms", "ratio"],
                grown,
            ),
        },
        lines,
        options.json,
    )


if __name__ == "__main__":
    without_traceback(main)
