"""What accuracy of visibility costs in time: off, ray casting, or quadrature with 16 to 512 points.

All are scored against one reference, the opaque true geometry: a design point is hidden in a scene (T = 0) where the
exact first hit lies more than the margin in front of it, else visible (T = 1). The error is the share of the density's
mass that is in the wrong place, measured on independent proposals (random surface points with a range error), not on
samples of any learned density; seconds are those of one p* with its gradient for a batch. Ray casting softens T over
1 / beta behind the surface as quadrature does, and that counts as its error too. `evaluate --accuracy` measures
off, ray casting and the run's own quadrature in the scenes of a run.

    python benchmarks/visibility.py
"""

from __future__ import annotations

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import face_scenes, interleaved, model_option, parser, report

from lidardesign.config import DensitySettings
from lidardesign.density.objective.visibility import NoVisibility
from lidardesign.evaluation.accuracy.fields import VisibilityCase
from lidardesign.evaluation.accuracy.probes import Probes
from lidardesign.scenes.scene import Body, Box, Scene, rigid
from lidardesign.space import DesignSpace

PLATE_M = 0.005
EVERY_POINTS = (16, 32, 64, 128, 256, 512)


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


def measure(name: str, case: VisibilityCase, points: tuple[int, ...], rounds: int) -> list[list[object]]:
    """One row per way: its error with the standard error, and milliseconds."""
    ways = {"off": case.cast.with_visibility(NoVisibility()), "raycast": case.cast}
    ways |= {f"quadrature {count}": case.quadrature(count) for count in points}
    batch = case.probes.points[: case.batch]
    timings = interleaved(
        {way: lambda target=target: target.log_density_and_gradient(batch) for way, target in ways.items()}, rounds
    )
    rows = []
    for way, target in ways.items():
        count = case.few if way.startswith("quadrature") else len(case.exact)
        probes = Probes(case.probes.points[:count], case.probes.log_proposal[:count])
        error, spread = probes.misplaced(target.log_density(probes.points), case.exact[: len(probes.points)])
        rows.append([name, way, error, spread, 1e3 * timings[way].wall_median])
    return rows


def verdict(rows: list[list[object]]) -> str:
    """Which ways are beaten by no other in both error and time, and how far off the best quadrature is."""
    front = [row[1] for row in rows if not any(o[2] <= row[2] and o[4] <= row[4] and o is not row for o in rows)]
    cast = next(row for row in rows if row[1] == "raycast")
    best = min((row for row in rows if str(row[1]).startswith("quadrature")), key=lambda row: row[2])
    return (
        f"{rows[0][0]}: beaten by none in both error and time: {', '.join(map(str, front))}; {best[1]} errs least of "
        f"all quadratures, {best[2] / cast[2]:.3g} times ray casting in {best[4] / cast[4]:.3g} times its time"
    )


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    model_option(made)
    made.add_argument("--scenes", type=int, default=20)
    made.add_argument("--batch", type=int, default=1024, help="design points that are timed")
    made.add_argument("--points", type=int, nargs="+", default=EVERY_POINTS, help="quadrature points to try")
    options = made.parse_args()
    from lidardesign_tasks.face import FaceConfig, FaceTask

    heads = face_scenes(options.model, options.scenes)
    rows, lines = [], []
    for name, scenes, space in [
        ("faces", heads, FaceTask().space(FaceConfig())),
        ("thin plate", *plate_scenes(options.scenes)),
    ]:
        case = VisibilityCase.of(scenes, space, DensitySettings(), 0, options.batch)
        rows += measure(name, case, tuple(options.points), options.rounds)
        lines.append(verdict(rows[-2 - len(options.points) :]))
    columns = ["case", "visibility", "mass in the wrong place", "standard error", "wall ms"]
    report(
        f"Visibility: {options.scenes} scenes, {options.batch} design points",
        {"Error against opaque geometry, and time of p* with gradient": (columns, rows)},
        lines,
        options.json,
    )


if __name__ == "__main__":
    main()
