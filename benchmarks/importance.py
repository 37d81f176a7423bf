"""What weights on the surface bring: where rays go, and where the error falls and rises, on held-out faces.

Every design is fitted to the same learned density, weighted without learning again as `fit --weight` does it, and its
rays are chosen on training heads whose surfaces count by the same weights.

    python benchmarks/importance.py --run runs/face [--picture docs/importance.png]
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import face_settings, learned, model_option, parser, report, run_options, without_traceback

MILLIMETRES = 1000.0
# Eyes, nose and mouth, in the frame of a head.
REGION_CENTRE_M, REGION_RADIUS_M = (-0.03, 0.0, 0.015), 0.05
REGION = {
    "region_centre_m": f"[{', '.join(map(str, REGION_CENTRE_M))}]",
    "region_radius_m": REGION_RADIUS_M,
    "region_weight": 8,
}
WEIGHTS: dict[str, Mapping[str, Any]] = {
    "none": {},
    "area 0.25": {"area_exponent": 0.25},
    "area 0.5": {"area_exponent": 0.5},
    "roughness 0.5": {"roughness_exponent": 0.5},
    "region 8": REGION,
}
SENSORS = (4, 10)
COLUMNS = ["design", "rays", "weights", "ESS", "mm", "difference [%]", "interval [%]"]
REGION_COLUMNS = ["weights", "rays", "returns inside [%]", "inside mm", "outside mm"]


@dataclass(frozen=True, eq=False)
class Measured:
    """What one kind of design reaches, means over fits.

    Arguments:
        scores: Of each held-out head [mm].
        inside, outside: The mean distance of the visible surface to the reconstruction, by head [mm].
        share: Of the returns that are in the region, by head.
        rays: Of the last fit.
    """

    scores: Any
    inside: Any
    outside: Any
    share: Any
    rays: Any


@dataclass(frozen=True, eq=False)
class Bench:
    """A run with its held-out heads.

    Arguments:
        run: The run.
        heads: Its held-out scenes with their casters.
        rays: Numbers of rays.
        fits: Per design.
    """

    run: Any
    heads: list[tuple[Any, Any]]
    rays: Sequence[int]
    fits: int

    def measured(self, sensors: int, settings: Mapping[str, Any]) -> tuple[float, dict[int, Measured]]:
        """The effective share of the samples, and designs of so many sensors under weights at each number of rays."""
        import numpy as np

        found: dict[int, list[Any]] = {count: [] for count in self.rays}
        shares, last = [], {}
        for seed in range(self.fits):
            for count in self.rays:
                design = self.run.fit(sensors=sensors, rays=count, weights=settings, seed=seed, name="benchmark")
                last[count] = rays = design.rays(count)
                found[count].append([self._head(scene, casters, rays) for scene, casters in self.heads])
                shares.append(design.result.ess)
        return float(np.mean(shares)), {
            count: Measured(*np.mean(one, axis=0).T, last[count]) for count, one in found.items()
        }

    def _head(self, scene: Any, casters: Any, rays: Any) -> tuple[float, float, float, float]:
        """The score, and the error of the visible surface inside and outside of the region [mm], and its returns."""
        import numpy as np
        from lidardesign_tasks.surface import reconstruct

        from lidardesign.simulate.returns import simulate

        returns = simulate(scene, rays, casters=casters)
        truth, estimate = scene.truth["surface"], reconstruct(returns)
        score = self.run.task.score(scene, returns).value
        if estimate is None:
            return score, score, score, 0.0
        missed = MILLIMETRES * estimate.distance_m(truth.points)
        inside = in_region(scene, truth.points)
        hit = in_region(scene, np.concatenate([frame.points_m for frame in returns]))
        return score, missed[inside].mean(), missed[~inside].mean(), hit.mean()


def in_region(scene: Any, points: Any) -> Any:
    """Which points (N, 3) of a scene lie in the region of its head, shape (N,)."""
    import numpy as np

    from lidardesign.scenes.scene import inverse_rigid

    to_head = inverse_rigid(scene.bodies[0].pose())
    local = points @ to_head[:3, :3].T + to_head[:3, 3]
    return np.linalg.norm(local - np.array(REGION_CENTRE_M), axis=1) < REGION_RADIUS_M


def percent(values: Any, plain: Any) -> tuple[str, str]:
    """How much lower or higher values are than others of the same heads, and its 95 % interval, in percent."""
    from lidardesign.estimates import relative_difference

    found = relative_difference(values, plain)
    return f"{found[0]:+.1f}", f"{found[1]:+.1f} to {found[2]:+.1f}"


def compared(bench: Bench, sensors: Sequence[int]) -> tuple[list[list[object]], dict[tuple[str, int], Measured]]:
    """Rows of every design under every weight against itself without weights; what the last of the designs reach."""
    rows, kept = [], {}
    for number in sensors:
        found = {name: bench.measured(number, settings) for name, settings in WEIGHTS.items()}
        for count in bench.rays:
            plain = found["none"][1][count]
            for name, (ess, measured) in found.items():
                one = kept[name, count] = measured[count]
                apart = ("-", "-") if name == "none" else percent(one.scores, plain.scores)
                rows.append([f"{number} sensors", count, name, ess, one.scores.mean(), *apart])
    return rows, kept


def region_rows(kept: Mapping[tuple[str, int], Measured], counts: Sequence[int]) -> list[list[object]]:
    """The error inside and outside of the region, with and without its weight, and the differences in percent."""
    rows = []
    for count in counts:
        plain, weighted = kept["none", count], kept["region 8", count]
        for name, found in (("none", plain), ("region 8", weighted)):
            rows.append([name, count, 100 * found.share.mean(), found.inside.mean(), found.outside.mean()])
        parts = [percent(getattr(weighted, part), getattr(plain, part)) for part in ("inside", "outside")]
        rows.append(["difference [%]", count, "", *(f"{value} ({interval})" for value, interval in parts)])
    return rows


def draw(path: Path, scene: Any, kept: Mapping[tuple[str, int], Measured], count: int) -> None:
    """Where rays go on a head, and the error inside and outside of the region."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    from lidardesign.space import aim, angles

    shown = ("none", "area 0.25", "region 8")
    figure, axes = plt.subplots(1, 4, figsize=(12, 4), width_ratios=[1, 1, 1, 0.9], layout="constrained")
    truth = scene.truth["surface"].points
    for panel, name in zip(axes[:3], shown, strict=True):
        rays = kept[name, count].rays
        seen = np.degrees(aim(rays.origin_m[:1], truth)[:, 3:5])
        colours = np.where(in_region(scene, truth), "#f4a261", "#cfd8dc")
        panel.scatter(180 - seen[:, 0], seen[:, 1], c=colours, s=3, linewidths=0)
        azimuth, elevation = np.degrees(angles(rays.direction))
        panel.scatter(180 - np.mod(azimuth, 360), elevation, c="#1d3557", s=4, linewidths=0)
        panel.set_title("no weights" if name == "none" else name)
        panel.set_aspect("equal")
        panel.set_xlabel("azimuth [deg]")
    axes[0].set_ylabel("elevation [deg]")
    for offset, part in enumerate(("inside", "outside")):
        values = [getattr(kept[name, count], part).mean() for name in shown]
        axes[3].bar(np.arange(3) + 0.4 * offset, values, 0.38, label=part, color=("#f4a261", "#90a4ae")[offset])
    axes[3].set_xticks(np.arange(3) + 0.2, [name.replace(" ", "\n") for name in shown])
    axes[3].set_ylabel("distance to the reconstruction [mm]")
    axes[3].set_ylim(0, 1.3 * axes[3].get_ylim()[1])
    axes[3].legend(title="the region")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=2)
    model_option(made)
    run_options(made)
    made.add_argument("--rays", type=int, nargs="+", default=[196, 361, 576])
    made.add_argument("--sensors", type=int, nargs="+", default=SENSORS, help="of the designs (default %(default)s)")
    made.add_argument("--picture", type=Path, metavar="FILE", help="also draw where rays go")
    options = made.parse_args()
    from lidardesign import open_run
    from lidardesign.simulate.returns import build_casters

    settings = face_settings(options.model) if options.run is None else {}
    with tempfile.TemporaryDirectory() as folder:
        run = open_run(learned("face", Path(folder), options, settings))
        heads = [(scene, build_casters(scene)) for scene in run.scenes("test", run.config.seed)]
        rows, kept = compared(Bench(run, heads, options.rays, options.rounds), options.sensors)
    report(
        f"Weights on the surface, {len(heads)} held-out heads, {options.rounds} fits each",
        {
            "Chamfer distance, against the same design without weights": (COLUMNS, rows),
            f"The visible surface inside and outside of the region, {options.sensors[-1]} sensors": (
                REGION_COLUMNS,
                region_rows(kept, options.rays),
            ),
        },
        path=options.json,
    )
    if options.picture is not None:
        draw(options.picture, heads[0][0], kept, sorted(options.rays)[len(options.rays) // 2])


if __name__ == "__main__":
    without_traceback(main)
