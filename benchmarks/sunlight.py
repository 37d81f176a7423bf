"""Gated designs against `uniform` with a noisy detector in sunlight: outliers, Chamfer distance, and why.

python benchmarks/sunlight.py [--run RUN] [--detector NAME|FILE] [--sensors 4 10] [--rays 196 576]

A run that is given must be of the task face with `illuminance_lux=100000` and `light=sun`.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from common import face_settings, fitted, learned, model_option, parser, report, run_options, without_traceback

SUNLIGHT = {"illuminance_lux": 100000, "light": "sun"}


@dataclass
class Tally:
    """What an entry met in every scene."""

    chamfer_mm: list[float] = field(default_factory=list)
    outliers: list[float] = field(default_factory=list)
    returned: list[float] = field(default_factory=list)
    background: list[float] = field(default_factory=list)
    blocked: list[float] = field(default_factory=list)
    mistaken: list[float] = field(default_factory=list)
    calm: list[float] = field(default_factory=list)
    single: list[float] = field(default_factory=list)


def request_of(run: Any, designs: list[Any], options: Any) -> Any:
    """What to evaluate, with the detector and what the scenes call for."""
    from lidardesign.evaluation.request import EvaluationRequest
    from lidardesign.simulate.detector.files import load_detector
    from lidardesign.simulate.plan import Planner

    return EvaluationRequest(
        task=run.task,
        config=run.config.task,
        space=run.config.space,
        seed=run.config.seed,
        designs=designs,
        rays=options.rays,
        baselines=("uniform", "bounding"),
        equal_bandwidth=False,
        train=run.scenes("train", run.config.seed),
        test=run.scenes("test", run.config.seed),
        planner=Planner(load_detector(options.detector)),
    )


def add_scene(request: Any, entries: list[Any], tallies: list[Tally], scene: Any) -> frozenset[str]:
    """Simulate and score every entry in one scene; what the scene called for."""
    from lidardesign.simulate.returns import build_casters, simulate_many

    casters = build_casters(scene)
    lists = [entry.lit_in(0)[0] for entry in entries]
    plan = request.planner.plan(scene, lists, casters)
    variants = {"all": plan.effects, "calm": plan.effects - {"ambient"}, "single": plan.effects - {"pile_up"}}
    for name, effects in variants.items():
        physics = physics_of(request, effects)
        measured = simulate_many(scene, lists, casters=casters, physics=physics)
        for tally, (returns,) in zip(tallies, measured, strict=True):
            score = request.task.score(scene, [returns])
            outliers = score.details.get("outliers_percent", 0.0)
            if name == "all":
                tally.chamfer_mm.append(score.value)
                tally.outliers.append(outliers)
                tally.returned.append(100.0 * float(returns.returned.mean()))
            else:
                getattr(tally, name).append(outliers)
    for tally, rays in zip(tallies, lists, strict=True):
        add_figures(tally, scene, rays, request.planner.detector, casters[0])
    return plan.effects


def physics_of(request: Any, effects: frozenset[str]) -> Any:
    """Some effects with the evaluation's own random numbers."""
    from lidardesign.simulate.detector.physics import Physics

    return Physics(request.planner.detector, effects, request.seed)


def add_figures(tally: Tally, scene: Any, rays: Any, detector: Any, caster: Any) -> None:
    """Expected background counts in a gate, pulses blinded before the echo, and false peaks, by their closed forms."""
    import numpy as np

    from lidardesign.simulate.effects.expected_counts import Counts
    from lidardesign.simulate.effects.first_hits import FirstHits

    sight = FirstHits.of(scene, 0, detector, [rays], caster)
    counts = Counts(sight)
    seen = sight.returned
    per_bin, sigma_s = counts.per_bin, detector.timing_sigma_s
    before = counts.background_per_metre * sight.before_m
    tally.background.append(float((per_bin * counts.bins).mean()))
    tally.blocked.append(100.0 * float(-np.expm1(-before[seen]).mean()) if seen.any() else 0.0)
    peaks = counts.mistaken(counts.in_air, per_bin, per_bin, sigma_s)
    tally.mistaken.append(100.0 * float(peaks[seen].mean()) if seen.any() else 0.0)


def figure_rows(entries: list[Any], tallies: list[Tally]) -> list[list[object]]:
    """Means over scenes."""
    import numpy as np

    names = ("chamfer_mm", "outliers", "calm", "single", "returned", "background", "blocked", "mistaken")
    return [
        [entry.name, entry.rays, *(float(np.mean(getattr(tally, name))) for name in names)]
        for entry, tally in zip(entries, tallies, strict=True)
    ]


def paired_rows(entries: list[Any], tallies: list[Tally]) -> list[list[object]]:
    """Every design against every baseline at equal rays, scene by scene."""
    from lidardesign.estimates import paired_difference

    rows = []
    for entry, tally in zip(entries, tallies, strict=True):
        for other, against in zip(entries, tallies, strict=True):
            if entry.baseline or not other.baseline or entry.rays != other.rays:
                continue
            cells: list[object] = [entry.name, other.name, entry.rays]
            for name in ("chamfer_mm", "outliers"):
                mean, low, high = paired_difference(getattr(tally, name), getattr(against, name))
                cells += [mean, f"{low:.3g} to {high:.3g}"]
            rows.append(cells)
    return rows


def main() -> None:
    """Measure and print."""
    options_of = parser(__doc__)
    model_option(options_of)
    run_options(options_of)
    options_of.add_argument("--detector", default="single-photon", help="detector (default %(default)s)")
    options_of.add_argument("--sensors", type=int, nargs="+", default=[4, 10], help="(default %(default)s)")
    options_of.add_argument("--rays", type=int, nargs="+", default=[196, 576], help="(default %(default)s)")
    options = options_of.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        settings = {} if options.run else {**SUNLIGHT, **face_settings(options.model)}
        run_folder = learned("face", Path(folder), options, settings)
        measure(run_folder, options)


def measure(run_folder: Path, options: Any) -> None:
    """Fit, simulate and print."""
    from support.scoring import entries_of

    from lidardesign import open_run

    run = open_run(run_folder)
    designs = [fitted(run_folder, f"sunlight-{n}", sensors=n, layout="even").specification for n in options.sensors]
    request = request_of(run, designs, options)
    entries = entries_of(request)
    tallies, called = [Tally() for _ in entries], set()
    for scene in request.test:
        called |= add_scene(request, entries, tallies, scene)
    columns = ["design", "rays", "Chamfer [mm]", "outliers [%]", "without ambient [%]", "without pile-up [%]",
               "returned [%]", "background per gate", "pulses blinded [%]", "false peak, at most [%]"]  # fmt: skip
    differences = ["design", "against", "rays", "Chamfer [mm]", "interval", "outliers [points]", "interval"]
    pairs = paired_rows(entries, tallies)
    report(
        f"Sunlight, detector {options.detector}",
        {
            "Means over held-out heads": (columns, figure_rows(entries, tallies)),
            "Differences, 95 % intervals": (differences, pairs),
        },
        [f"effects on: {', '.join(sorted(called))}"],
        options.json,
    )


if __name__ == "__main__":
    without_traceback(main)
