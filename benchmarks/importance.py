"""What weights on the surface bring: where rays go, and where the error falls and rises, on held-out faces.

Every design is fitted to the same learned density, weighted without learning again as `fit --weight` does it. Gates
are fitted to samples that are spread a little further in range than training heads are, so that what is compared is
where rays go and not which heads a narrow gate happens to miss.

    python benchmarks/importance.py --run runs/face [--picture docs/importance.png]
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
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
DESIGNS = {"4 sensors": {"sensors": 4}, "10 sensors": {"sensors": 10}, "scan": {"layout": "scan", "level": 0.99}}
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
        spread_m: By how much samples are spread in range.
        fits: Per design.
    """

    run: Any
    heads: list[tuple[Any, Any]]
    spread_m: float
    fits: int

    def samples(self, settings: Mapping[str, Any]) -> Any:
        """The run's samples with the weights of some settings."""
        import numpy as np

        from lidardesign.fitting.request import RunTarget, Weighting, weighted_samples
        from lidardesign.space import RANGE
        from lidardesign.task import random_generator

        texts = tuple(f"{key}={value}" for key, value in settings.items())
        weighting = Weighting(texts)
        samples = weighted_samples(self.run, weighting, RunTarget(self.run, weighting=weighting))
        points, space = samples.points.copy(), samples.space
        noise = random_generator(self.run.config.seed, "range spread").normal(size=len(samples))
        points[:, RANGE] = np.clip(points[:, RANGE] + self.spread_m * noise, space.low[RANGE], space.high[RANGE])
        return replace(samples, points=points)

    def measured(self, samples: Any, choices: Mapping[str, Any], count: int) -> Measured:
        """Designs of one kind at a number of rays."""
        import numpy as np
        from lidardesign.layouts.rays import lay_out

        from lidardesign.mixture.fit import fit

        found, rays = [], None
        for seed in range(self.fits):
            further = {"rays": count} if choices.get("layout") == "scan" else {}
            rays = lay_out(fit(samples, seed=seed, **choices, **further).design, count, samples)
            found.append([self._head(scene, casters, rays) for scene, casters in self.heads])
        return Measured(*np.mean(found, axis=0).T, rays)

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
    from lidardesign.scoring.statistics import paired_difference

    found = [100 * value / plain.mean() for value in paired_difference(values, plain, 0)]
    return f"{found[0]:+.1f}", f"{found[1]:+.1f} to {found[2]:+.1f}"


def compared(
    bench: Bench, names: Sequence[str], counts: Sequence[int], keep: Callable[[str, int, Measured], None]
) -> list[list[object]]:
    """Rows of every design under every weight against itself without weights; scans are kept."""
    samples = {name: bench.samples(WEIGHTS[name]) for name in names}
    rows = []
    for design, choices in DESIGNS.items():
        for count in counts:
            plain = None
            for name in names:
                found = bench.measured(samples[name], choices, count)
                plain = found if plain is None else plain
                apart = ("-", "-") if found is plain else percent(found.scores, plain.scores)
                ess = samples[name].effective_sample_size
                rows.append([design, count, name, ess, found.scores.mean(), *apart])
                if design == "scan":
                    keep(name, count, found)
    return rows


def region_rows(scans: Mapping[tuple[str, int], Measured], counts: Sequence[int]) -> list[list[object]]:
    """The error inside and outside of the region, with and without its weight, and the differences in percent."""
    rows = []
    for count in counts:
        plain, weighted = scans["none", count], scans["region 8", count]
        for name, found in (("none", plain), ("region 8", weighted)):
            rows.append([name, count, 100 * found.share.mean(), found.inside.mean(), found.outside.mean()])
        parts = [percent(getattr(weighted, part), getattr(plain, part)) for part in ("inside", "outside")]
        rows.append(["difference [%]", count, "", *(f"{value} ({interval})" for value, interval in parts)])
    return rows


def draw(path: Path, scene: Any, scans: Mapping[tuple[str, int], Measured], count: int) -> None:
    """Where the rays of scans go on a head, and the error inside and outside of the region."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    from lidardesign.space import aim, angles

    shown = ("none", "area 0.25", "region 8")
    figure, axes = plt.subplots(1, 4, figsize=(12, 4), width_ratios=[1, 1, 1, 0.9], layout="constrained")
    truth = scene.truth["surface"].points
    for panel, name in zip(axes[:3], shown, strict=True):
        rays = scans[name, count].rays
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
        values = [getattr(scans[name, count], part).mean() for name in shown]
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
    made.add_argument("--spread-mm", type=float, default=20.0, help="of samples in range (default %(default)s)")
    made.add_argument("--picture", type=Path, metavar="FILE", help="also draw where rays go")
    options = made.parse_args()
    from lidardesign import open_run
    from lidardesign.simulate.returns import build_casters

    settings = face_settings(options.model) if options.run is None else {}
    scans: dict[tuple[str, int], Measured] = {}
    with tempfile.TemporaryDirectory() as folder:
        run = open_run(learned("face", Path(folder), options, settings))
        heads = [(scene, build_casters(scene)) for scene in run.scenes("test", run.config.seed)]
        bench = Bench(run, heads, options.spread_mm / MILLIMETRES, options.rounds)
        rows = compared(
            bench, list(WEIGHTS), options.rays, lambda name, count, found: scans.update({(name, count): found})
        )
    report(
        f"Weights on the surface, {len(heads)} held-out heads, {options.rounds} fits each",
        {
            "Chamfer distance, against the same design without weights": (COLUMNS, rows),
            "The visible surface inside and outside of the region, scans": (
                REGION_COLUMNS,
                region_rows(scans, options.rays),
            ),
        },
        path=options.json,
    )
    if options.picture is not None:
        draw(options.picture, heads[0][0], scans, sorted(options.rays)[len(options.rays) // 2])


if __name__ == "__main__":
    without_traceback(main)
