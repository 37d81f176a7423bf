"""Fitting sensors: how many samples expectation maximisation works on, and how many seeds it tries."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from lidardesign.design.bounds import Bounds
from lidardesign.design.conditions import MOVED_SAMPLES, at_condition, shown
from lidardesign.design.constraints import Constraints
from lidardesign.design.em import fit_mixture
from lidardesign.design.features import Axes, Features
from lidardesign.design.fit import EM_SAMPLES, HELD_OUT_SHARE, RESTARTS, fit
from lidardesign.design.mixture import log_density
from lidardesign.design.resolve import bounds_of, groups
from lidardesign.design.samples import FILE_NAME, Samples, load_samples
from lidardesign.design.sensor import Design, interval_factor
from lidardesign.design.support import LEAST_SAMPLES
from lidardesign.evaluate.accuracy import AccuracyRequest
from lidardesign.evaluate.rungs import Ladder, Rung, with_memory
from lidardesign.numerics import effective_count, systematic_draw
from lidardesign.task import random_generator

LABEL = "samples and seeds of the fit"
SAMPLE_COUNTS = (1000, 2000, 5000, 10_000, 20_000)
RESTART_COUNTS = (1, 2, 4, 8, 12)
# Each setting is fitted so often, on other splits and with other seeds; more often where luck decides more. Fits take
# in proportion to their sensors: of many, fewer are made, but no fewer than the least.
REPEATS, LEAST_REPEATS, SENSORS_FITTED = 5, 2, 40
MORE_REPEATS = {1: 3, 2: 2, 4: 2}
START = (
    "import sys; from pathlib import Path; import lidardesign.design.fit; "
    "from lidardesign.design.samples import load_samples; load_samples(Path(sys.argv[1]))"
)
STARTS = 2
TOLERANCE_NATS = 0.01
BECAUSE = "log densities that are 0.01 nats lower have one ray in a hundred fewer everywhere"


def ladders(request: AccuracyRequest) -> Sequence[Ladder]:
    """Two ladders for the fit of the first design whose sensors are Gaussian; none for scans."""
    design = next((one for one in request.request.designs if one.layout != "scan" and one.track is None), None)
    samples = None if design is None else _samples(request, design)
    if design is None or samples is None or effective_count(samples.weights) < LEAST_SAMPLES:
        return []
    bench = FitBench(samples, len(design.sensors), design.level, request.request.seed)
    counts = [*(count for count in SAMPLE_COUNTS if count < bench.pool), bench.pool]
    usual = min(EM_SAMPLES, bench.pool)
    # a single sensor has one best fit, which every seed finds
    restarts = RESTART_COUNTS if bench.sensors > 1 else ()
    for one in counts:
        for repeat in range(bench.splits):
            bench.fitted(repeat, one, RESTARTS)
    for one in restarts:
        for repeat in range(bench.splits * MORE_REPEATS.get(one, 1)):
            bench.fitted(repeat, usual, one)
    besides = _start_seconds(request.run) + _other_seconds(bench, design)
    of_samples = [bench.rung(one, RESTARTS, besides, default=one == usual) for one in counts]
    of_restarts = [bench.rung(usual, one, besides, default=one == RESTARTS) for one in restarts]
    named = [replace(rung, setting=f"{count:,}") for rung, count in zip(of_samples, counts, strict=True)]
    found = [_ladder("samples of the fit", f"{RESTARTS} seeds", named, design)]
    if not restarts:
        return found
    seeds = [replace(rung, setting=str(count)) for rung, count in zip(of_restarts, restarts, strict=True)]
    return [*found, _ladder("seeds of the fit", f"{usual:,} samples", seeds, design)]


def _ladder(knob: str, beside: str, rungs: Sequence[Rung], design: Design) -> Ladder:
    fitted = f"{len(design.sensors)} sensors, as {design.name} has"
    where = f", at {shown(design.at)}" if design.at else ""
    held = ", without its constraints" if design.constraints else ""
    return Ladder(
        knob=knob,
        error_of="log density of held-out samples that is lost",
        unit="nats",
        against="the best fit of all settings to the same samples",
        tolerance=TOLERANCE_NATS,
        because=BECAUSE,
        work="the command `fit`: its start, reading the samples and the whole fit",
        rungs=rungs,
        note=f"{fitted}{where}{held}, with {beside}",
    )


def _start_seconds(run: Path) -> float:
    """How long a program takes to start and to read a run's samples, which every fit begins with [s]."""
    command = [sys.executable, "-c", START, str(run.resolve())]
    taken = []
    for _ in range(STARTS):
        started = time.perf_counter()
        if subprocess.run(command, check=False, capture_output=True).returncode:
            return 0.0
        taken.append(time.perf_counter() - started)
    return min(taken)


def _other_seconds(bench: FitBench, design: Design) -> float:
    """What a fit takes besides expectation maximisation: choosing samples, sensors and rays [s]."""
    started = time.perf_counter()
    fit(
        bench.samples,
        sensors=bench.sensors,
        layout=design.layout,
        rays=design.rays,
        level=design.level,
        seed=bench.seed,
        em_samples=SAMPLE_COUNTS[0],
        restarts=1,
    )
    whole = time.perf_counter() - started
    return max(whole - bench.fitted(0, SAMPLE_COUNTS[0], 1).seconds, 0.0)


def _samples(request: AccuracyRequest, design: Design) -> Samples | None:
    """The samples that a design was fitted to, at its condition where it has one; None without any."""
    samples = request.request.samples.get(design.name)
    if samples is None and (request.run / FILE_NAME).exists():
        samples = load_samples(request.run)
    if samples is None or not samples.space.conditioned:
        return samples
    from lidardesign.density.prepare import prepare_target
    from lidardesign.run.manifest import read_manifest

    decided = read_manifest(request.run).get("visibility")
    target = prepare_target(request.request.train, request.config, visibility=decided, compiled=False)[0]
    generator = random_generator(request.request.seed, "mixture ladder")
    return at_condition(samples, design.at, target.log_density, MOVED_SAMPLES, generator)


@dataclass(frozen=True)
class Fitted:
    """A fit: mean log density of the split's held-out samples [nats], time [s] and memory [bytes]."""

    log_likelihood: float
    seconds: float
    memory_bytes: int | None


@dataclass(eq=False)
class FitBench:
    """Fits of unconstrained sensors to one part of the samples, judged on the other, remembered.

    Arguments:
        samples: Weighted samples.
        sensors: How many are fitted.
        level: The share that their intervals hold.
        seed: Root of splits, draws and seeds.
    """

    samples: Samples
    sensors: int
    level: float
    seed: int
    _known: dict[tuple[int, int, int], Fitted] = field(default_factory=dict)

    @cached_property
    def bounds(self) -> Bounds:
        """What the space alone asks of the sensors."""
        space, free = self.samples.space, Constraints()
        group = groups(free, space, self.sensors)[0]
        return bounds_of(free, space, group.sensors, interval_factor(self.level))

    @property
    def splits(self) -> int:
        """Into how many pairs of parts the samples are split, one after the other."""
        return min(REPEATS, max(LEAST_REPEATS, SENSORS_FITTED // self.sensors))

    @property
    def pool(self) -> int:
        """Samples that are left to fit to."""
        return len(self.samples) - round(HELD_OUT_SHARE * len(self.samples))

    def fitted(self, repeat: int, count: int, restarts: int) -> Fitted:
        """A fit to `count` of the pool's samples with so many seeds.

        Repeats differ in their draws and seeds, and take one split after the other; of one repeat, fits with more
        seeds also try those with fewer.
        """
        key = repeat, count, restarts
        if key not in self._known:
            self._known[key] = self._fit(*key)
        return self._known[key]

    def _fit(self, repeat: int, count: int, restarts: int) -> Fitted:
        order = random_generator(self.seed, "mixture split", repeat % self.splits).permutation(len(self.samples))
        pool, held = order[: self.pool], order[self.pool :]
        generator = random_generator(self.seed, "mixture fit", repeat)
        started = time.perf_counter()
        trace, memory = with_memory(
            lambda: fit_mixture(self._drawn(pool, count, generator), self.bounds, generator, restarts=restarts)
        )
        seconds = time.perf_counter() - started
        judged = self._features(self.samples.points[held], self.samples.weights[held])
        return Fitted(float(judged.weights @ log_density(trace.mixture, judged)), seconds, memory)

    def _drawn(self, pool: np.ndarray, count: int, generator: np.random.Generator) -> Features:
        """So many of the pool's samples, of equal weight; all of them as they are."""
        weights = self.samples.weights[pool]
        if count >= len(pool):
            return self._features(self.samples.points[pool], weights)
        chosen = systematic_draw(weights / weights.sum(), count, generator)
        return self._features(self.samples.points[pool[generator.permutation(chosen)]], np.ones(count))

    def _features(self, points: np.ndarray, weights: np.ndarray) -> Features:
        return Features.of(points, weights, Axes.of(self.samples.space), self.samples.space)

    def lost(self, count: int, restarts: int) -> list[float]:
        """What every fit of a setting lost against the best fit of its split, of all settings [nats]."""
        best: dict[int, float] = {}
        for (repeat, _, _), one in self._known.items():
            best[repeat % self.splits] = max(best.get(repeat % self.splits, -math.inf), one.log_likelihood)
        return [best[repeat % self.splits] - one.log_likelihood for repeat, one in self._of(count, restarts)]

    def rung(self, count: int, restarts: int, besides: float, *, default: bool) -> Rung:
        """A setting, once all settings have been fitted; `besides`: what a fit takes besides [s]."""
        lost = np.array(self.lost(count, restarts))
        fits = [one for _, one in self._of(count, restarts)]
        maximising = float(np.median([one.seconds for one in fits]))
        memory = [one.memory_bytes for one in fits if one.memory_bytes is not None]
        return Rung(
            "",
            error=float(lost.mean()),
            uncertainty=float(lost.std(ddof=1) / math.sqrt(len(lost))),
            seconds=besides + maximising,
            memory_bytes=max(memory, default=None),
            default=default,
            values={"worst_nats": float(lost.max()), "fit_seconds": maximising},
        )

    def _of(self, count: int, restarts: int) -> list[tuple[int, Fitted]]:
        return [(key[0], one) for key, one in self._known.items() if key[1:] == (count, restarts)]
