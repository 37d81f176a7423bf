"""How cost grows: learning with scenes and frames, simulation with rays, choosing with candidates, EM with sensors, all
with free dimensions.

Every table has a column `exponent`: the slope of the logarithm of the processor time between a row and the one above
it, so that 1 is growth in proportion and 0 none. Below the tables, time and memory are fitted by a constant and a power
of the size. Learning and choosing are whole processes, with an empty field cache and a small number of steps.

    python benchmarks/growth.py [--of scenes] [--of candidates] ...
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import Any, NamedTuple

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import (
    face_scenes,
    face_settings,
    interleaved,
    lidardesign,
    model_option,
    parser,
    report,
    run_process,
    verdict,
)

MEMORY_LIMIT_MIB = 8 * 1024
# Between the two largest numbers of scenes, more than this is growth faster than in proportion, timing noise aside.
PROPORTIONAL = 1.1
# Low and high of x, y, z [m], azimuth and elevation [rad] and range [m]: a face is in front, 0.4 m away.
LOW = (0.35, -0.05, -0.05, math.pi - 0.6, -0.6, 0.05)
HIGH = (0.45, 0.05, 0.05, math.pi + 0.6, 0.6, 1.0)
# Dimensions in the order in which they are freed, and where those that are not yet free are fixed.
FREED = (5, 3, 4, 0, 1, 2)
FIXED = (0.40, 0.0, 0.0, math.pi, 0.0, 0.4)
# Standard deviation of the samples of a sensor, as a share of the space: clusters that overlap.
SPREAD = 0.1
# Powers that are tried in fits.
POWERS = np.linspace(0.0, 2.5, 251)[1:]


class Growth(NamedTuple):
    """What was measured at several sizes.

    Arguments:
        columns, rows: The table.
        sizes: Of each row.
        measured: What grows, of each row, by its unit; exponents between rows are of the first.
        lines: What follows besides.
    """

    columns: Sequence[str]
    rows: list[list[object]]
    sizes: Sequence[int]
    measured: Mapping[str, Sequence[float]]
    lines: Sequence[str] = ()


def exponents(sizes: Sequence[int], times: Sequence[float]) -> list[float]:
    """Slopes between each row and the one above it on logarithmic scales; NaN for the first."""
    pairs = zip(zip(sizes, times, strict=True), zip(sizes[1:], times[1:], strict=True), strict=False)
    return [math.nan, *(math.log(t / s) / math.log(m / n) for (n, s), (m, t) in pairs)]


def fitted(sizes: Sequence[int], values: Sequence[float]) -> tuple[float, float, float]:
    """Constant, factor and power of a + b n^p with the least relative squared error, a and b not negative."""
    from scipy.optimize import nnls

    fits = []
    for power in POWERS:
        parts = np.stack([np.ones(len(sizes)), np.array(sizes, dtype=float) ** power], axis=1)
        (constant, factor), rest = nnls(parts / np.array(values)[:, None], np.ones(len(sizes)))
        fits.append((rest, constant, factor, power))
    return min(fits)[1:]


def learning(options: Any, task: str, sizes: Sequence[int], settings: Callable[[int], list[str]]) -> Growth:
    """`learn` as a whole process at several sizes: time, phases and memory.

    Arguments:
        options: What was asked for.
        task: What is learned.
        sizes: Numbers of scenes or frames.
        settings: Keys of the task for a size.
    """
    found = []
    for count in sizes:
        with tempfile.TemporaryDirectory() as folder:
            words = ["learn", task, "--preset", "draft", "--json", "--out", Path(folder) / "run"]
            for setting in [*settings(count), "learning.misplaced=0", f"learning.steps={options.steps}", *options.set]:
                words += ["--set", setting]
            result = run_process(lidardesign(*words), {"LIDARDESIGN_CACHE": str(Path(folder) / "cache")})
            found.append((result, result.document()["timings"]))
    phases = list(dict.fromkeys(name for _, timings in found for name in timings if "/" not in name))
    spent, peaks = [result.cpu for result, _ in found], [result.peak_mib for result, _ in found]
    rows: list[list[object]] = [
        [count, result.wall, result.cpu, result.peak_mib, *(timings.get(phase, 0.0) for phase in phases)]
        for count, (result, timings) in zip(sizes, found, strict=True)
    ]
    slopes = zip(sizes[1:], exponents(sizes, spent)[1:], strict=True)
    lines = [
        verdict(
            "peak memory below 8 GiB", {str(n): peak < MEMORY_LIMIT_MIB for n, peak in zip(sizes, peaks, strict=True)}
        ),
        verdict("time grows no more than in proportion", {str(n): slope < PROPORTIONAL for n, slope in slopes}),
    ]
    columns = ["size", "wall s", "CPU s", "peak MiB", *(f"{phase} s" for phase in phases)]
    return Growth(columns, rows, sizes, {"CPU s": spent, "MiB": peaks}, lines)


def scenes(options: Any) -> Growth:
    """Learning a face by the number of training heads."""
    keys = [f"{key}={value}" for key, value in face_settings(options.model).items()]
    return learning(options, "face", options.scenes, lambda count: [f"train={count}", *keys])


def frames(options: Any) -> Growth:
    """Learning an arm by the number of training frames, in trajectories of fifty."""
    return learning(options, "arm", options.frames, lambda count: [f"train={max(count // 50, 1)}", "frames=50"])


def choosing(options: Any) -> Growth:
    """Choosing rays by the number of candidates, as whole processes."""
    from selection import STAGES, growth

    rows = growth(options, [(count, options.informing) for count in options.candidates])
    columns = [
        "candidates",
        "scenes",
        "million pairs",
        *(f"{stage} s" for stage in STAGES),
        "all s",
        "wall s",
        "MiB",
        "gap",
    ]
    seconds, peaks = ([float(str(row[columns.index(name)])) for row in rows] for name in ("all s", "MiB"))
    return Growth(columns, rows, options.candidates, {"CPU s": seconds, "MiB": peaks})


def simulation(options: Any) -> Growth:
    """Simulating and scoring one head by the number of rays, by geometry alone and with the effects called for."""
    from effects import even_rays
    from lidardesign_tasks.face import FaceTask

    from lidardesign.simulate.detector.files import load_detector
    from lidardesign.simulate.detector.physics import Physics
    from lidardesign.simulate.plan import Planner
    from lidardesign.simulate.returns import build_casters, simulate

    scene, task, detector = face_scenes(options.model, 1)[0], FaceTask(), load_detector(options.detector)
    casters, rows = build_casters(scene), []
    for count in options.rays:
        rays = even_rays(count, (0.05, 1.05))
        physics = Physics(detector, frozenset(Planner(detector).plan(scene, [rays], casters).effects))
        runs: dict[str, Callable[[], Any]] = {
            "geometry": lambda rays=rays: simulate(scene, rays, casters=casters),
            "effects": lambda rays=rays, physics=physics: simulate(scene, rays, casters=casters, physics=physics),
        }
        returns = runs["geometry"]()
        runs["score"] = lambda returns=returns: task.score(scene, returns)
        times = interleaved(runs, options.rounds)
        seconds = [times[name].cpu_median for name in runs]
        peak_mib = getrusage(RUSAGE_SELF).ru_maxrss / 1024  # of all rows so far
        rows.append([count, *(1e3 * value for value in seconds), count / seconds[0] / 1e6, peak_mib])
    columns = ["rays", "geometry ms", f"{options.detector} ms", "score ms", "million rays per s", "peak MiB"]
    spent = {"ms": [row[1] + row[3] for row in rows], "ms with effects": [row[2] for row in rows]}
    return Growth(columns, rows, options.rays, {**spent, "MiB": [row[-1] for row in rows]})


def mixtures(options: Any) -> Growth:
    """EM on samples of a mixture of as many components, by the number of sensors."""
    from lidardesign.mixture.bounds import Bounds, Floors
    from lidardesign.mixture.components import Axes, Features, expect
    from lidardesign.mixture.em import fit_mixture, seed_mixture
    from lidardesign.mixture.m_step import maximise
    from lidardesign.sensors.sensor import interval_factor
    from lidardesign.space import DesignSpace

    space, rows = DesignSpace(LOW, HIGH), []
    for count in options.sensors:
        points = clusters(space, count, options.samples)
        features = Features.of(points, np.ones(len(points)), Axes.of(space), space)
        bounds, floors = Bounds.unbounded(count, interval_factor(0.95)), Floors.of(features)
        start = seed_mixture(features, bounds, np.random.default_rng(0))

        def iteration(start=start, features=features, bounds=bounds, floors=floors) -> None:
            maximise(start, expect(start, features), features, bounds, floors, 1.0)

        times = interleaved({"iteration": iteration}, options.rounds)["iteration"]
        started = time.perf_counter()
        trace = fit_mixture(features, bounds, np.random.default_rng(0))
        rows.append([count, 1e3 * times.cpu_median, time.perf_counter() - started, len(trace.history)])
    columns = ["sensors", "ms per iteration", "whole fit s", "steps"]
    spent = {name: [row[column] for row in rows] for name, column in (("ms per iteration", 1), ("s of a fit", 2))}
    return Growth(columns, rows, options.sensors, spent)


def clusters(space: Any, count: int, samples: int) -> np.ndarray:
    """Samples in as many clusters as there are sensors, shape (samples, 6)."""
    generator = np.random.default_rng(1)
    low, high = np.array(space.low), np.array(space.high)
    means = low + (high - low) * generator.uniform(0.2, 0.8, (count, 6))
    points = means[generator.integers(count, size=samples)]
    points += SPREAD * (high - low) * generator.standard_normal((samples, 6))
    return points.clip(low, high)


def dimensions(options: Any) -> Growth:
    """The flow's step, the density of foreign points, and the target, by the number of free dimensions."""
    import torch

    from lidardesign.config import DensitySettings, LearningSettings
    from lidardesign.density.coordinates import Coordinates
    from lidardesign.density.objective.target import build_target
    from lidardesign.space import DesignSpace

    scenes, settings, rows = face_scenes(options.model, options.heads), LearningSettings(), []
    for count in range(1, len(FREED) + 1):
        low, high = list(FIXED), list(FIXED)
        for dimension in FREED[:count]:
            low[dimension], high[dimension] = LOW[dimension], HIGH[dimension]
        space = DesignSpace(tuple(low), tuple(high))
        flow = flow_of(Coordinates(space), settings)
        target = build_target(scenes, space, DensitySettings(), "raycast")
        generator = torch.Generator().manual_seed(1)
        base, _ = flow.draw(options.batch, generator)
        points = space.sample(options.batch, np.random.default_rng(0))

        def step(flow=flow, base=base) -> None:
            flow.zero_grad(set_to_none=True)
            values, log_prob = flow(base)
            (log_prob + values.square().sum(dim=1) / 2).mean().backward()

        def foreign(flow=flow, base=base) -> None:
            with torch.no_grad():
                flow.log_prob(base)

        def evaluate(target=target, points=points) -> None:
            target.log_density_and_gradient(points)

        times = interleaved({"step": step, "foreign": foreign, "target": evaluate}, options.rounds)
        weights = sum(parameter.numel() for parameter in flow.parameters())
        rows.append([count, *(1e3 * timing.cpu_median for timing in times.values()), weights])
    columns = ["free", "flow step ms", "foreign points ms", f"target of {options.heads} heads ms", "weights"]
    return Growth(columns, rows, range(1, len(FREED) + 1), {"ms of a flow step": [row[1] for row in rows]})


def flow_of(coordinates: Any, settings: Any) -> Any:
    """The flow that learning would make."""
    import torch

    from lidardesign.density.network import DesignFlow

    sizes = {"layers": settings.layers, "hidden": settings.hidden, "bins": settings.bins}
    generator = torch.Generator().manual_seed(0)
    return DesignFlow(len(coordinates.learned), len(coordinates.conditions), **sizes, generator=generator).double()


TABLES: dict[str, tuple[str, Callable[[Any], Growth]]] = {
    "scenes": ("Learning a face by the number of training heads, whole process", scenes),
    "frames": ("Learning an arm by the number of training frames, whole process", frames),
    "rays": ("One head by the number of rays; the exponent is of geometry and score", simulation),
    "candidates": ("Choosing rays by the number of candidates, whole process", choosing),
    "sensors": ("Expectation-maximisation by the number of sensors", mixtures),
    "dimensions": (
        "Flow and target by free dimensions: range, angles, then the origin; the exponent is of the flow",
        dimensions,
    ),
}


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    model_option(made)
    made.add_argument("--of", action="append", choices=list(TABLES), help="only this table; repeatable")
    made.add_argument("--scenes", type=int, nargs="+", default=[10, 30, 100, 300, 1000])
    made.add_argument("--frames", type=int, nargs="+", default=[100, 1000, 10_000])
    made.add_argument("--candidates", type=int, nargs="+", default=[1000, 3000, 10_000])
    made.add_argument("--informing", type=int, default=100, help="heads that rays are chosen on (default %(default)s)")
    made.add_argument("--count", type=int, default=361, help="rays that are chosen (default %(default)s)")
    made.add_argument("--rays", type=int, nargs="+", default=[10**n for n in range(2, 7)])
    made.add_argument("--sensors", type=int, nargs="+", default=[1, 2, 4, 8, 16, 32, 64])
    made.add_argument("--steps", type=int, default=50, help="of learning (default %(default)s)")
    made.add_argument("--samples", type=int, default=100_000, help="of EM (default %(default)s)")
    made.add_argument("--batch", type=int, default=1024, help="of flow and target (default %(default)s)")
    made.add_argument("--heads", type=int, default=50, help="of the target (default %(default)s)")
    made.add_argument("--detector", default="single-photon", help="of simulation (default %(default)s)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    options = made.parse_args()
    tables, lines = {}, []
    for name in options.of or TABLES:
        caption, measure = TABLES[name]
        found = measure(options)
        slopes = exponents(found.sizes, next(iter(found.measured.values())))
        rows = [[*row, "" if math.isnan(slope) else slope] for row, slope in zip(found.rows, slopes, strict=True)]
        tables[caption] = [*found.columns, "exponent"], rows
        for unit, values in found.measured.items():
            constant, factor, power = fitted(found.sizes, values)
            lines.append(f"{name}, n: {constant:.3g} + {factor:.3g} n^{power:.2f} {unit}")
        lines += found.lines
    report("How cost grows", tables, lines, options.json)


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
