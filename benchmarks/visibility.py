"""Which visibility gives the better accuracy per second: off, ray casting, or quadrature with 16 to 512 points.

All are scored against one reference, the opaque true geometry: a design point is hidden in a scene (T = 0) where the
exact first hit lies more than the margin in front of it, else visible (T = 1). Errors are measured on independent
proposals (random surface points with a range error), not on samples of any learned density:

- T: mean of |T - reference| over the pairs of ray and scene that count in p* (within the target's tolerance);
- weights: total variation between the proposals' importance weights p* / q, normalised, and the reference's;
- seconds are those of one p* with its gradient for all proposals.

Ray casting softens T over 1 / beta behind the surface as quadrature does, and that counts as its error too.

    python benchmarks/visibility.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import face_scenes, interleaved, model_option, parser, report
from scipy.special import logsumexp, softmax

from lidardesign.density.fields import build_field, scene_columns
from lidardesign.density.proposals import Proposals, propose
from lidardesign.density.settings import DensitySettings
from lidardesign.density.target import PADDING_SIGMAS, Target, build_target
from lidardesign.density.visibility import NoVisibility, Quadrature, RayBatch, Raycast, Visibility
from lidardesign.scene import Body, Box, Scene, rigid
from lidardesign.simulate.raycast import SceneCaster
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction

POINTS = (16, 32, 64, 128, 256, 512)
PLATE_M = 0.005
LOG_OPAQUE = -1e4  # log T of hidden points: far below anything that counts, and finite


def plate_scenes(count: int) -> tuple[list[Scene], DesignSpace]:
    """A wall at 3 m behind a plate of 5 mm that hides a part of it, at another place in every scene."""
    generator = np.random.default_rng(1)
    space = DesignSpace((0, 0, 0, -0.35, -0.35, 0.5), (0, 0, 0, 0.35, 0.35, 3.5))
    wall = Body(Box((0.05, 1.5, 1.5)), "wall", "both", rigid(translation_m=(3.05, 0.0, 0.0)))
    scenes = []
    for index in range(count):
        place = (generator.uniform(1.0, 2.0), *generator.uniform(-0.2, 0.2, 2))
        plate = Body(Box((PLATE_M / 2, 0.25, 0.25)), "plate", "occluder", rigid(translation_m=place))
        scenes.append(Scene((wall, plate), f"plate {index}"))
    return scenes, space


@dataclass(frozen=True, eq=False)
class Case:
    """Scenes with the proposals that errors are measured on, and the reference."""

    name: str
    target: Target
    proposals: Proposals
    rays: RayBatch
    surface: np.ndarray
    active: np.ndarray
    reference: np.ndarray

    @classmethod
    def of(cls, name: str, scenes: list[Scene], space: DesignSpace, count: int) -> Case:
        """Draw proposals, decide which pairs count, and trace the reference."""
        settings = DensitySettings()
        target = build_target(scenes, space, settings, "off")
        proposals = propose(scenes, space, count, settings.sigma_m, np.random.default_rng(0))
        points = proposals.points
        rays = RayBatch(points[:, :3], direction(points[:, AZIMUTH], points[:, ELEVATION]), points[:, RANGE])
        surface = -np.square(target.field.distances(rays.origins + rays.ranges[:, None] * rays.directions))
        surface /= 2 * target.optics.sigma_m**2
        active = surface >= surface.max(axis=1, keepdims=True) - target.surface_tolerance_nats
        return cls(name, target, proposals, rays, surface, active, _opaque(scenes, rays, target.optics.margin_m))

    def errors(self, visibility: Visibility) -> tuple[float, float]:
        """Error of T and of the weights."""
        log_values = visibility.transmittance(self.rays, self.active, self.target.optics).log_values
        error = np.abs(np.exp(log_values) - self.reference)[self.active].mean()
        exact = np.where(self.reference > 0, 0.0, LOG_OPAQUE)
        return float(error), float(np.abs(self._weights(log_values) - self._weights(exact)).sum() / 2)

    def _weights(self, log_transmittance: np.ndarray) -> np.ndarray:
        log_target = logsumexp(np.where(self.active, self.surface + log_transmittance, -np.inf), axis=1)
        return softmax(log_target - self.proposals.log_density)


def _opaque(scenes: list[Scene], rays: RayBatch, margin_m: float) -> np.ndarray:
    values = np.empty((len(rays.ranges), len(scenes)))
    for column, (index, frame) in enumerate(scene_columns(scenes)):
        hits = SceneCaster(scenes[index], frame, only="occluders").first_hit(rays.origins, rays.directions)
        values[:, column] = hits.range_m >= rays.ranges - margin_m
    return values


def measure(case: Case, scenes: list[Scene], points: tuple[int, ...], rounds: int) -> list[list[object]]:
    """One row per way: errors, seconds, and accuracy per second as 1 / (error x seconds)."""
    settings = DensitySettings()
    occluders = build_field(
        scenes,
        lambda body: body.is_occluder,
        resolution=settings.field_resolution,
        padding_m=PADDING_SIGMAS * settings.sigma_m,
    )
    ways = {"off": NoVisibility(), "raycast": Raycast(scenes)}
    ways |= {f"quadrature {count}": Quadrature(occluders, count) for count in points}
    targets = {name: replace(case.target, visibility=way) for name, way in ways.items()}
    runs = {
        name: lambda target=target: target.log_density_and_gradient(case.proposals.points)
        for name, target in targets.items()
    }
    timings = interleaved(runs, rounds)
    rows = []
    for name, way in ways.items():
        transmittance, weights = case.errors(way)
        seconds = timings[name].wall_median
        rows.append([case.name, name, transmittance, weights, 1e3 * seconds, 1 / (max(transmittance, 1e-9) * seconds)])
    return rows


def verdict(rows: list[list[object]]) -> str:
    """Which ways are beaten by no other in both error of T and time, and which is the best by accuracy per second."""
    front = [row[1] for row in rows if not any(o[2] <= row[2] and o[4] <= row[4] and o is not row for o in rows)]
    best = max((row for row in rows if row[1] != "off"), key=lambda row: row[5])
    raycast = next(row for row in rows if row[1] == "raycast")
    least = min(row[2] for row in rows if str(row[1]).startswith("quadrature"))
    return (
        f"{rows[0][0]}: beaten by none in both error and time: {', '.join(map(str, front))}; most accuracy per second: "
        f"{best[1]}; the best quadrature's error of T is {least / max(raycast[2], 1e-9):.3g} times that of ray casting"
    )


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    model_option(made)
    made.add_argument("--scenes", type=int, default=20)
    made.add_argument("--proposals", type=int, default=4096)
    made.add_argument("--points", type=int, nargs="+", default=POINTS, help="quadrature points to try")
    options = made.parse_args()
    from lidardesign_tasks.face import FaceConfig, FaceTask

    heads = face_scenes(options.model, options.scenes)
    cases = [("faces", heads, FaceTask().space(FaceConfig())), ("thin plate", *plate_scenes(options.scenes))]
    rows, lines = [], []
    for name, scenes, space in cases:
        case = Case.of(name, scenes, space, options.proposals)
        found = measure(case, scenes, tuple(options.points), options.rounds)
        hidden = 1 - case.reference[case.active].mean()
        lines += [f"{name}: {hidden:.1%} of the pairs of ray and scene that count are hidden", verdict(found)]
        rows += found
    columns = ["case", "visibility", "error of T", "error of weights", "wall ms", "1 / (error s)"]
    report(
        f"Visibility: {options.scenes} scenes, {options.proposals} proposals",
        {"Error against opaque geometry, and time of p* with gradient": (columns, rows)},
        lines,
        options.json,
    )


if __name__ == "__main__":
    main()
