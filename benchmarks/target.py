"""One evaluation of the target density with its gradient, against the plain way of writing it.

The plain way is `torch.nn.functional.grid_sample` on a volume whose channels are the scenes, or on one volume per
scene, and automatic differentiation. All use the same distance table, the same design points, the same formula
(midpoint quadrature of the visibility, all scenes) and one thread. Ratios are plain / ours; agreement is over points of
the density. Exact queries are libigl's distances and closest points for every scene, and of the surface term alone: a
quadrature would take as many again for each of its points. The floor is a plain copy of as many bytes as the gathers of
all corners of all scenes touch; ours leaves out what cannot matter.

    python benchmarks/target.py
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
import torch
from common import face_scenes, interleaved, median_ratio, model_option, parser, report

from lidardesign.config import DensitySettings
from lidardesign.density.fields.distance import TableField
from lidardesign.density.objective.proposals import propose
from lidardesign.density.objective.target import Target, build_target
from lidardesign.space import DesignSpace, observed_point

EXPONENT_LIMIT = 60.0
CORNERS = 8  # grid points around a place
FLOOR = "floor: copy of the bytes"


class PlainTarget:
    """log p* by `grid_sample` and autograd in the arithmetic of `dtype`; scenes are channels or separate volumes."""

    def __init__(
        self, target: Target, dtype: torch.dtype, layout: torch.memory_format, *, per_scene: bool = False
    ) -> None:
        field: TableField = target.surfaces.field
        counts = [int(n) for n in field.grid.counts]
        volume = torch.as_tensor(field.table).reshape(*counts, field.columns).permute(3, 0, 1, 2)[None]
        self.volume = volume.to(dtype).contiguous(memory_format=layout)
        self.low = torch.as_tensor(field.grid.low, dtype=dtype)
        self.extent = torch.as_tensor(field.grid.step * (field.grid.counts - 1), dtype=dtype)
        self.shell = torch.as_tensor(field.shell_m, dtype=dtype)
        self.per_scene = per_scene
        self.points, self.optics, self.dtype = target.visibility.points, target.optics, dtype

    def distances(self, places: torch.Tensor) -> torch.Tensor:
        """Distances of all scenes: (N, 3) to (N, scenes), a lower bound outside the grid."""
        inside = torch.minimum(torch.maximum(places, self.low), self.low + self.extent)
        unit = 2 * (inside - self.low) / self.extent - 1
        # grid_sample wants (x, y, z) as (last, middle, first) axis
        where = unit.flip(-1).reshape(1, -1, 1, 1, 3)
        parts = self.volume.split(1, dim=1) if self.per_scene else (self.volume,)
        sampled = [torch.nn.functional.grid_sample(part, where, mode="bilinear", align_corners=True) for part in parts]
        values = torch.cat([part.reshape(part.shape[1], -1) for part in sampled]).T
        beyond = (places - inside).square().sum(-1, keepdim=True)
        outside = beyond > 0
        far = (torch.where(outside, beyond, 1.0) + values.clamp(min=0).square()).sqrt()
        return torch.where(outside, far, values)

    def log_density(self, chart: torch.Tensor) -> torch.Tensor:
        """log p* of chart points (x, y, z, azimuth, sin elevation, range), (N, 6) to (N,)."""
        origins, azimuth, sine, range_m = chart[:, :3], chart[:, 3], chart[:, 4], chart[:, 5]
        cosine = (1 - sine.square()).sqrt()
        toward = torch.stack([cosine * azimuth.cos(), cosine * azimuth.sin(), sine], dim=1)
        surface = -self.distances(origins + range_m[:, None] * toward).square() / (2 * self.optics.sigma_m**2)
        # open surfaces occlude as shells, which must not hide the points that they are put around
        length = (range_m - self.optics.margin_m - self.shell.max()).clamp(min=0)
        share = (torch.arange(self.points, dtype=self.dtype) + 0.5) / self.points
        places = origins[:, None] + (share * length[:, None])[..., None] * toward[:, None]
        along = self.distances(places.reshape(-1, 3)).reshape(len(chart), self.points, -1) - self.shell
        exponent = (self.optics.sharpness_per_m * along).clamp(-EXPONENT_LIMIT, EXPONENT_LIMIT)
        depth = self.optics.attenuation_per_m * (length / self.points)[:, None] * torch.sigmoid(-exponent).sum(dim=1)
        return torch.logsumexp(surface - depth, dim=1)

    def evaluate(self, chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values and gradients by the chart: (N, 6) to (N,) and (N, 6)."""
        leaf = torch.tensor(chart, dtype=self.dtype, requires_grad=True)
        values = self.log_density(leaf)
        (gradient,) = torch.autograd.grad(values.sum(), leaf)
        return values.detach().numpy(), gradient.numpy()


def exact_queries(scenes: list, target: Target, points: np.ndarray) -> Callable[[], object]:
    """The surface term and its gradient from libigl's closest points in every scene."""
    import igl

    bodies = [scene.bodies[0] for scene in scenes]
    meshes = [body.shape.transformed(body.pose()) for body in bodies]
    surfaces = [(mesh.vertices, mesh.faces.astype(np.int64)) for mesh in meshes]
    reached = observed_point(points)
    unsigned = igl.SIGNED_DISTANCE_TYPE_UNSIGNED

    def run() -> tuple[np.ndarray, np.ndarray]:
        found = [igl.signed_distance(reached, *surface, sign_type=unsigned) for surface in surfaces]
        offsets = np.stack([reached - closest for _, _, closest, _ in found], axis=1)
        exponents = -(np.stack([distance for distance, *_ in found], axis=1) ** 2) / (2 * target.optics.sigma_m**2)
        highest = exponents.max(axis=1, keepdims=True)
        weights = np.exp(exponents - highest)
        total = weights.sum(axis=1)
        gradient = np.einsum("ns,nsk->nk", weights, -offsets) / (total[:, None] * target.optics.sigma_m**2)
        return highest[:, 0] + np.log(total), gradient

    return run


def copied(target: Target, count: int) -> Callable[[], object]:
    """A plain copy of as many bytes as the gathers of a full evaluation touch."""
    gathered = count * (target.visibility.points + 1) * CORNERS * target.surfaces.field.columns
    source, destination = (np.zeros(gathered, dtype=np.float32) for _ in range(2))
    return lambda: np.copyto(destination, source)


def agreement(target: Target, points: np.ndarray) -> list[Any]:
    """Differences of values [nats] and gradients (relative) to the plain way in float64, where p* matters.

    Ours leaves out scenes whose surface term is below the best by the stated tolerance; with the tolerance lifted the
    two are the same formula. The points that count are those within 20 nats of the largest value.
    """
    chart = target.space.to_chart(points)
    plain, plain_gradient = PlainTarget(target, torch.float64, torch.contiguous_format).evaluate(chart)
    whole = replace(target, surface_tolerance_nats=math.inf)
    values, gradient = whole.log_density_and_gradient(points)
    matters = plain > plain.max() - 20
    free = list(target.space.free)
    size = np.linalg.norm(plain_gradient[:, free], axis=1)
    off = np.linalg.norm((gradient - plain_gradient)[:, free], axis=1) / np.maximum(size, np.median(size[matters]))
    shortened = np.abs(target.log_density(points) - plain)[matters]
    return [
        int(matters.sum()),
        float(np.abs(values - plain)[matters].max()),
        float(np.quantile(off[matters], 0.99)),
        float(np.quantile(shortened, 0.99)),
    ]


def contestants(scenes: list, target: Target, points: np.ndarray) -> dict[str, Callable[[], object]]:
    """Ours, the plain way as one would write it first, with the faster memory layout and scene by scene, and others."""
    chart = target.space.to_chart(points)
    plain = PlainTarget(target, torch.float32, torch.contiguous_format)
    last = PlainTarget(target, torch.float32, torch.channels_last_3d)
    single = PlainTarget(target, torch.float32, torch.contiguous_format, per_scene=True)
    return {
        "lidardesign": lambda: target.log_density_and_gradient(points),
        "grid_sample": lambda: plain.evaluate(chart),
        "grid_sample, channels last": lambda: last.evaluate(chart),
        "grid_sample, per scene": lambda: single.evaluate(chart),
        "exact queries, surface term": exact_queries(scenes, target, points),
        FLOOR: copied(target, len(points)),
    }


def point_sets(scenes: list, space: DesignSpace, sigma_m: float, count: int) -> dict[str, np.ndarray]:
    """Uniform in the space, as an untrained flow draws, and near surfaces, as a trained one does."""
    generator = np.random.default_rng(0)
    near = propose(scenes, space, 2 * count, sigma_m, generator).points
    return {"uniform": space.sample(count, generator), "near surfaces": generator.permutation(near)[:count]}


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    model_option(made)
    made.add_argument("--scenes", type=int, default=50)
    made.add_argument("--batch", type=int, default=2048)
    made.add_argument("--points", type=int, default=64, help="quadrature points (default %(default)s)")
    made.add_argument("--resolution", type=int, default=64, help="field resolution (default %(default)s)")
    options = made.parse_args()
    torch.set_num_threads(1)
    from lidardesign_tasks.face import FaceConfig, FaceTask

    scenes, space = face_scenes(options.model, options.scenes), FaceTask().space(FaceConfig())
    settings = DensitySettings(quadrature_points=options.points, field_resolution=options.resolution)
    target = build_target(scenes, space, settings, "quadrature")
    raycast = build_target(scenes, space, settings, "raycast")
    times, agreements, lines = [], [], []
    for name, points in point_sets(scenes, space, settings.sigma_m, options.batch).items():
        runs = contestants(scenes, target, points)
        runs["lidardesign, raycast"] = lambda points=points: raycast.log_density_and_gradient(points)
        measured = interleaved(runs, options.rounds)
        ours = measured["lidardesign"]
        for contestant, timing in measured.items():
            ratio = median_ratio(timing.cpu, ours.cpu)
            times.append([name, contestant, 1e3 * timing.wall_median, 1e3 * timing.cpu_median, ratio])
        agreements.append([name, *agreement(target, points)])
        faster = median_ratio(measured["grid_sample"].cpu, ours.cpu)
        copies = median_ratio(ours.cpu, measured[FLOOR].cpu)
        lines.append(
            f"{name}: {faster:.1f} times faster than grid_sample, {copies:.2f} times the copy (processor time)"
        )
    report(
        f"Target with gradient: {options.scenes} scenes, batch {options.batch}, {options.points} points",
        {
            "Time per evaluation": (["points", "way", "wall ms", "CPU ms", "CPU / ours"], times),
            "Agreement with the plain way in float64 (within 20 nats of the peak)": (
                ["points", "compared", "value, max nats", "gradient, p99 relative", "value with tolerance, p99 nats"],
                agreements,
            ),
        },
        lines,
        options.json,
    )


if __name__ == "__main__":
    main()
