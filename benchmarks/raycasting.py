"""First hits of rays with a mesh, against trimesh's wrapper of the same engine and against open3d.

One head mesh and two sets of rays: a picture taken from one place, and random origins with random targets. Ours is
`SceneCaster.first_hit`, which recentres in float64 and returns ranges, bodies and normals; Embree alone, called with
float32 rays that are ready, is what no wrapper can be faster than. Ranges are held against Moeller and Trumbore's
intersection with every triangle in float64, for some of the rays, and again with everything moved away from the world's
origin, where float32 coordinates lose their digits.

    python -m pip install -r benchmarks/requirements.txt      # open3d
    python benchmarks/raycasting.py
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import face_scenes, installed, interleaved, median_ratio, model_option, parser, report

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Body, Mesh, Scene

# A way of casting: (N, 3) origins and unit directions to ranges (N,), infinite for a miss.
Cast = Callable[[np.ndarray, np.ndarray], np.ndarray]
PARALLEL = 1e-12  # determinants below this times the triangle's size have no crossing
REFERENCE_RAYS_AT_ONCE = 64


def ray_sets(mesh: Mesh, count: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Origins and directions, both (count, 3): a picture from one place, and origins and targets at random."""
    low, high = mesh.bounds_m
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    side = int(np.ceil(np.sqrt(count)))
    across = np.linspace(-0.7, 0.7, side) * radius
    picture = np.stack(np.meshgrid([0.0], across, across, indexing="ij"), axis=-1).reshape(-1, 3)[:count]
    eye = centre + np.array([3 * radius, 0.0, 0.0])
    generator = np.random.default_rng(0)
    around = generator.standard_normal((count, 3))
    origins = centre + 3 * radius * around / np.linalg.norm(around, axis=1, keepdims=True)
    targets = low + (high - low) * generator.random((count, 3))
    return {
        "one origin": (np.broadcast_to(eye, (count, 3)).copy(), _unit(centre + picture - eye)),
        "random origins": (origins, _unit(targets - origins)),
    }


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def reference(mesh: Mesh, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Ranges of the first hits in float64 by every triangle, (N, 3) and (N, 3) to (N,); infinite for a miss."""
    corner, second, third = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    side, other = second - corner, third - corner
    found = np.empty(len(origins))
    for start in range(0, len(origins), REFERENCE_RAYS_AT_ONCE):
        part = slice(start, start + REFERENCE_RAYS_AT_ONCE)
        toward = directions[part, None]
        crossed = np.cross(toward, other)
        determinant = np.einsum("nfk,fk->nf", crossed, side)
        scale = np.linalg.norm(side, axis=1) * np.linalg.norm(other, axis=1)
        inverse = np.where(np.abs(determinant) > PARALLEL * scale, 1 / np.where(determinant, determinant, 1.0), np.nan)
        away = origins[part, None] - corner
        u = np.einsum("nfk,nfk->nf", away, crossed) * inverse
        turned = np.cross(away, side)
        v = np.einsum("nfk,nfk->nf", np.broadcast_to(toward, turned.shape), turned) * inverse
        range_m = np.einsum("nfk,fk->nf", turned, other) * inverse
        found[part] = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (range_m > 0), range_m, np.inf).min(axis=1)
    return found


def ours(mesh: Mesh) -> Cast:
    """This library."""
    caster = SceneCaster(Scene([Body(mesh)]))
    return lambda origins, directions: caster.first_hit(origins, directions).range_m


def embree(mesh: Mesh) -> Cast:
    """Embree's ranges of rays that are float32 already where they are given so."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    kept = TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces)

    def cast(origins: np.ndarray, directions: np.ndarray, _kept: object = kept) -> np.ndarray:
        rays = (array.astype(np.float32, copy=False) for array in (origins, directions))
        found = scene.run(*rays, output=True)
        return np.where(found["primID"] >= 0, found["tfar"], np.inf)

    return cast


def trimesh(mesh: Mesh) -> Cast:
    """trimesh's wrapper: locations of the first hits."""
    import trimesh as library

    intersector = library.Trimesh(mesh.vertices, mesh.faces, process=False).ray

    def cast(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        places, rays, _ = intersector.intersects_location(origins, directions, multiple_hits=False)
        range_m = np.full(len(origins), np.inf)
        range_m[rays] = np.linalg.norm(places - origins[rays], axis=1)
        return range_m

    return cast


def open3d(mesh: Mesh) -> Cast:
    """open3d's ray-casting scene on one thread."""
    import open3d as library

    scene = library.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))

    def cast(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        return scene.cast_rays(library.core.Tensor(rays), nthreads=1)["t_hit"].numpy()

    return cast


def ways() -> dict[str, Callable[[Mesh], Cast]]:
    """All that are installed, ours first."""
    found: dict[str, Callable[[Mesh], Cast]] = {"lidardesign": ours, "trimesh": trimesh}
    if installed("open3d"):
        found["open3d"] = open3d
    return found | {"floor: Embree, float32 rays": embree}


def timing_rows(mesh: Mesh, count: int, rounds: int) -> list[list[object]]:
    """One row per set of rays and way."""
    casts = {name: make(mesh) for name, make in ways().items()}
    rows = []
    for label, (origins, directions) in ray_sets(mesh, count).items():
        ready = tuple(array.astype(np.float32) for array in (origins, directions))
        runs = {
            name: partial(cast, *(ready if name.startswith("floor") else (origins, directions)))
            for name, cast in casts.items()
        }
        measured = interleaved(runs, rounds)
        for name, timing in measured.items():
            ratio = median_ratio(timing.cpu, measured["lidardesign"].cpu)
            millions = count / timing.cpu_median / 1e6
            rows.append([label, name, 1e3 * timing.wall_median, 1e3 * timing.cpu_median, millions, ratio])
    return rows


def error_rows(mesh: Mesh, count: int, offsets_m: list[float]) -> list[list[object]]:
    """Differences from the float64 reference, with mesh and rays moved by each offset along every axis."""
    rows = []
    for label, (origins, directions) in ray_sets(mesh, count).items():
        exact = reference(mesh, origins, directions)
        for offset_m in offsets_m:
            moved = Mesh(mesh.vertices + offset_m, mesh.faces, sign=mesh.sign)
            for name, make in ways().items():
                range_m = make(moved)(origins + offset_m, directions)
                both = np.isfinite(range_m) & np.isfinite(exact)
                differs = int((np.isfinite(range_m) != np.isfinite(exact)).sum())
                error = np.abs(range_m[both] - exact[both])
                typical, worst = (1e6 * float(np.quantile(error, q)) for q in (0.5, 0.99))
                rows.append([label, offset_m, name, differs, typical, worst])
    return rows


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=9)
    model_option(made)
    made.add_argument("--rays", type=int, default=100_000)
    made.add_argument("--checked", type=int, default=1000, help="rays that are checked (default %(default)s)")
    made.add_argument("--offset", type=float, nargs="+", default=[0.0, 1000.0], metavar="M", help="for the errors")
    options = made.parse_args()
    body = face_scenes(options.model, 1)[0].bodies[0]
    mesh = body.shape.transformed(body.pose())
    columns = ["rays", "way", "wall ms", "CPU ms", "million rays per s", "CPU / ours"]
    errors = ["rays", "offset m", "way", "hit or miss differs", "median error um", "99 % um"]
    report(
        f"First hits of {options.rays} rays with a mesh of {len(mesh.faces)} triangles",
        {
            "Medians; ratios are medians within rounds": (columns, timing_rows(mesh, options.rays, options.rounds)),
            f"{options.checked} rays against float64": (errors, error_rows(mesh, options.checked, options.offset)),
        },
        path=options.json,
    )


if __name__ == "__main__":
    main()
