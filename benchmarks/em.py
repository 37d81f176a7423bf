"""EM of 10 sensors on 100,000 samples against scikit-learn's diagonal mixture: time per iteration and fit.

Both run on one thread, interleaved, on the same samples; log-likelihoods are on held-out samples in the same
measure (scikit-learn's angles are turned into solid angle by adding -log cos(elevation)). Run with

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/em.py
"""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import common  # noqa: F401 (before numpy: it limits the thread pools)
import numpy as np
from common import median_ratio, parser, report
from sklearn.mixture import GaussianMixture
from threadpoolctl import threadpool_limits

from lidardesign.mixture.bounds import Bounds, Floors
from lidardesign.mixture.components import Axes, Features, expect, log_density
from lidardesign.mixture.em import fit_mixture, seed_mixture
from lidardesign.mixture.m_step import maximise
from lidardesign.samples import load_samples
from lidardesign.sensors.sensor import interval_factor
from lidardesign.space import DesignSpace

SENSORS = 10
SPACE = DesignSpace((-2.0, -2.0, 0.0, -3.0, -1.4, 0.05), (2.0, 2.0, 2.0, 3.0, 1.4, 6.0))


def planted(count: int, seed: int, plan_seed: int) -> np.ndarray:
    """Samples of a mixture that is Gaussian in azimuth and elevation: its own model."""
    plan = np.random.default_rng(plan_seed)
    low, high = np.array(SPACE.low), np.array(SPACE.high)
    means = low + (high - low) * plan.uniform(0.25, 0.75, (SENSORS, 6))
    spreads = (high - low) * plan.uniform(0.01, 0.08, (SENSORS, 6))
    draw = np.random.default_rng(seed)
    which = draw.integers(SENSORS, size=count)
    points = means[which] + spreads[which] * draw.standard_normal((count, 6))
    return points[SPACE.contains(points)]


def constrained() -> Bounds:
    """Bounds of every kind, wide enough not to change the optimum."""
    free = Bounds.unbounded(SENSORS, interval_factor(0.95))
    values = {f: getattr(free, f) for f in free.__dataclass_fields__}
    values |= {
        "origin_low": np.full((SENSORS, 3), -3.0),
        "origin_high": np.full((SENSORS, 3), 3.0),
        "origin_spread": np.full(SENSORS, 2.0),
        "elevation_low": np.full(SENSORS, -1.5),
        "elevation_high": np.full(SENSORS, 1.5),
        "azimuth_half": np.full(SENSORS, 3.1),
        "start_low": np.full(SENSORS, -1.0),
        "end_high": np.full(SENSORS, 8.0),
        "width_high": np.full(SENSORS, 5.0),
    }
    return Bounds(**values)


def peer(points: np.ndarray, iterations: int) -> float:
    """Seconds per iteration of scikit-learn, as the difference of a long and a short run."""
    spent = []
    for steps in (2, 2 + iterations):
        model = GaussianMixture(
            SENSORS, covariance_type="diag", tol=0, max_iter=steps, init_params="random_from_data", random_state=0
        )
        start = time.perf_counter()
        model.fit(points)
        spent.append(time.perf_counter() - start)
    return (spent[1] - spent[0]) / iterations


def ours(features: Features, bounds: Bounds, iterations: int) -> float:
    """Seconds per iteration: one E-step and one M-step each."""
    generator = np.random.default_rng(0)
    mixture = seed_mixture(features, bounds, generator)
    floors = Floors.of(features)
    start = time.perf_counter()
    for _ in range(iterations):
        mixture = maximise(mixture, expect(mixture, features), features, bounds, floors, 1.0)
    return (time.perf_counter() - start) / iterations


def compare_on_run(run: Path, json_file: Path | None) -> None:
    """Held-out log-likelihood of both on p* samples of a run, for 2, 4 and 10 sensors and three seeds each."""
    samples = load_samples(run)
    points = samples.resample(60_000, np.random.default_rng(0))
    free = list(samples.space.free)
    axes, parts = Axes.of(samples.space), (points[:40_000], points[40_000:])
    train, test = (Features.of(part, np.ones(len(part)), axes, samples.space) for part in parts)
    rows = []
    for sensors in (2, 4, 10):
        bounds = Bounds.unbounded(sensors, interval_factor(0.95))
        for start in range(3):
            mixture = fit_mixture(train, bounds, np.random.default_rng(start)).mixture
            model = GaussianMixture(sensors, covariance_type="diag", max_iter=300, tol=1e-5, random_state=start)
            scores = model.fit(parts[0][:, free]).score_samples(parts[1][:, free]) - np.log(np.cos(parts[1][:, 4]))
            rows.append([sensors, start, f"{log_density(mixture, test).mean():.4f}", f"{scores.mean():.4f}"])
    columns = ["sensors", "seed", "lidardesign", "scikit-learn diag"]
    report(f"EM on 40,000 samples of {run.name}", {"Held-out log-likelihood": (columns, rows)}, [], json_file)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    made.add_argument("--samples", type=int, default=100_000)
    made.add_argument("--iterations", type=int, default=8)
    made.add_argument("--plan", type=int, default=7, help="seed of the planted mixture (default 7)")
    made.add_argument("--run", type=Path, help="only compare held-out fits on this run's samples")
    options = made.parse_args()
    warnings.filterwarnings("ignore", module="sklearn")
    if options.run is not None:
        with threadpool_limits(1):
            compare_on_run(options.run, options.json)
        return
    points, held = (planted(options.samples // part, seed, options.plan) for part, seed in ((1, 1), (2, 2)))
    axes = Axes.of(SPACE)
    features = Features.of(points, np.ones(len(points)), axes, SPACE)
    test = Features.of(held, np.ones(len(held)), axes, SPACE)
    bounds = constrained()
    with threadpool_limits(1):
        pairs = [
            (ours(features, bounds, options.iterations), peer(points, options.iterations))
            for _ in range(options.rounds)
        ]
        mine, theirs = np.median(np.array(pairs), axis=0)
        ratio = median_ratio(*zip(*pairs, strict=True))
        start = time.perf_counter()
        trace = fit_mixture(features, bounds, np.random.default_rng(0))
        fitted = time.perf_counter() - start
        model = GaussianMixture(SENSORS, covariance_type="diag", n_init=1, max_iter=200, tol=1e-5, random_state=0)
        start = time.perf_counter()
        model.fit(points)
        peer_fitted = time.perf_counter() - start
    # scikit-learn's density is per azimuth and elevation; per solid angle it is larger by 1 / cos(elevation)
    peer_score = (model.score_samples(held) - np.log(np.cos(held[:, 4]))).mean()
    score = log_density(trace.mixture, test).mean()
    columns = ["way", "ms per iteration", "whole fit s", "steps", "held-out log-likelihood"]
    rows = [
        ["lidardesign", 1e3 * mine, fitted, len(trace.history), f"{score:.5f}"],
        ["scikit-learn diag", 1e3 * theirs, peer_fitted, model.n_iter_, f"{peer_score:.5f}"],
    ]
    report(
        f"EM: {SENSORS} components on {len(points)} samples",
        {"Log-likelihoods are per solid angle; our steps are those after the restarts": (columns, rows)},
        [f"time per iteration, lidardesign / scikit-learn: {ratio:.2f}"],
        options.json,
    )


if __name__ == "__main__":
    main()
