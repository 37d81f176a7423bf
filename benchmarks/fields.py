"""Distance fields of many head meshes: built with an empty cache, and read from it; one of them against other ways.

The other ways give exact distances at every grid point: libigl alone, trimesh, and open3d. Ours are exact in a band
around the surface and filled beyond it, which the second table shows as errors against libigl. trimesh is timed at some
of the points and scaled up.

    python -m pip install -r benchmarks/requirements.txt      # open3d
    python benchmarks/fields.py
"""

from __future__ import annotations

import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import face_scenes, installed, interleaved, median_ratio, model_option, parser, report

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import TableField, build_field
from lidardesign.density.fields.grids import BAND_CELLS, Grid, distance_grid
from lidardesign.density.objective.target import PADDING_SIGMAS
from lidardesign.scenes.scene import Mesh

INSIDE = 0.5  # winding numbers above this are inside


@dataclass(frozen=True)
class Way:
    """Distances of one mesh at points, and the share of the points that it is timed at."""

    distances: Callable[[np.ndarray], np.ndarray]
    share: float = 1.0


def timed(scenes: list, resolution: int) -> tuple[float, float, TableField]:
    """Wall and processor seconds of building the field of all scenes."""
    padding_m = PADDING_SIGMAS * DensitySettings().sigma_m
    started, spent = time.perf_counter(), time.process_time()
    field = build_field(scenes, lambda body: body.is_target, resolution=resolution, padding_m=padding_m)
    return time.perf_counter() - started, time.process_time() - spent, field


def libigl_distances(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Exact distances, negative inside unless the mesh has no inside: (N, 3) to (N,) [m]."""
    import igl

    faces = mesh.faces.astype(np.int64)
    unsigned = igl.SIGNED_DISTANCE_TYPE_UNSIGNED
    distance = igl.signed_distance(points, mesh.vertices, faces, sign_type=unsigned)[0]
    if mesh.sign == "unsigned":
        return distance
    return np.where(igl.fast_winding_number(mesh.vertices, faces, points) > INSIDE, -distance, distance)


def trimesh_way(mesh: Mesh) -> Callable[[np.ndarray], np.ndarray]:
    """trimesh's proximity query."""
    import trimesh

    query = trimesh.proximity.ProximityQuery(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))
    if mesh.sign == "unsigned":
        return lambda points: query.on_surface(points)[1]
    return lambda points: -query.signed_distance(points)


def open3d_way(mesh: Mesh) -> Callable[[np.ndarray], np.ndarray]:
    """open3d's distance query on one thread."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    ask = scene.compute_distance if mesh.sign == "unsigned" else scene.compute_signed_distance
    return lambda points: ask(open3d.core.Tensor(points.astype(np.float32)), nthreads=1).numpy()


def ways(mesh: Mesh, grid: Grid, trimesh_points: int) -> dict[str, Way]:
    """All that are installed, ours first."""
    found = {
        "lidardesign": Way(lambda points: distance_grid(mesh, grid)),
        "libigl alone": Way(lambda points: libigl_distances(mesh, points)),
    }
    if installed("rtree"):  # trimesh's queries need it
        found["trimesh"] = Way(trimesh_way(mesh), min(1.0, trimesh_points / grid.size))
    if installed("open3d"):
        found["open3d"] = Way(open3d_way(mesh))
    return found


def against_others(mesh: Mesh, grid: Grid, rounds: int, trimesh_points: int) -> list[list[object]]:
    """One row per way: seconds for a whole grid, ratio to ours, and errors near the surface and beyond [mm]."""
    points, generator = grid.points(), np.random.default_rng(0)
    contestants = ways(mesh, grid, trimesh_points)
    taken = {
        name: points if way.share == 1 else generator.choice(points, round(way.share * grid.size), replace=False)
        for name, way in contestants.items()
    }
    runs = {name: (lambda way=way, name=name: way.distances(taken[name])) for name, way in contestants.items()}
    times = interleaved(runs, rounds)
    rows: list[list[object]] = []
    for name, way in contestants.items():
        wall, cpu = (tuple(value / way.share for value in column) for column in (times[name].wall, times[name].cpu))
        exact = libigl_distances(mesh, taken[name])
        error = 1e3 * np.abs(way.distances(taken[name]) - exact)
        near = np.abs(exact) < BAND_CELLS * grid.step
        errors = [float(error[part].max(initial=0.0)) for part in (near, ~near)]
        ratio = median_ratio(cpu, times["lidardesign"].cpu)
        rows.append([name, statistics.median(wall), statistics.median(cpu), ratio, f"{way.share:.0%}", *errors])
    return rows


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    model_option(made)
    made.add_argument("--scenes", type=int, default=50)
    made.add_argument("--resolution", type=int, default=64)
    made.add_argument("--trimesh-points", type=int, default=2000, help="that trimesh is timed at (default %(default)s)")
    options = made.parse_args()
    scenes = face_scenes(options.model, options.scenes)
    built, read = [], []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["LIDARDESIGN_CACHE"] = folder
        for _ in range(options.rounds):
            shutil.rmtree(Path(folder) / "fields", ignore_errors=True)
            built.append(timed(scenes, options.resolution)[:2])
            *times, field = timed(scenes, options.resolution)
            read.append(times)
    counts = " x ".join(map(str, field.grid.counts))
    rows = [
        [state, *(statistics.median(column) for column in zip(*times, strict=True))]
        for state, times in (("built, cache empty", built), ("read from the cache", read))
    ]
    body = scenes[0].bodies[0]
    mesh = body.shape.transformed(body.pose())
    others = against_others(mesh, field.grid, options.rounds, options.trimesh_points)
    columns = ["way", "wall s", "CPU s", "CPU / ours", "points timed", "error near mm", "error beyond mm"]
    report(
        f"{options.scenes} fields of {counts} points from meshes of {len(mesh.faces)} triangles",
        {
            "Medians": (["state", "wall s", "CPU s"], rows),
            f"One field, without the cache; near is within {BAND_CELLS:g} cells of the surface": (columns, others),
        },
        path=options.json,
    )


if __name__ == "__main__":
    main()
