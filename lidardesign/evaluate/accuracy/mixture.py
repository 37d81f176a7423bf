"""Fitting sensors: how many samples expectation maximisation works on, and how many seeds it tries."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from lidardesign.config import FILE_NAME as CONFIG_FILE
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.fit import EM_SAMPLES, RESTARTS
from lidardesign.design.layouts.rays import layout_of
from lidardesign.design.mixture.bounds import Bounds, bounds_of, sensor_groups
from lidardesign.design.mixture.em import fit_mixture
from lidardesign.design.mixture.features import Axes, Features
from lidardesign.design.mixture.mixture import log_density
from lidardesign.design.mixture.support import LEAST_SAMPLES, MOVED_SAMPLES, at_condition, condition_text
from lidardesign.design.sensor import DesignSpec, interval_factor
from lidardesign.evaluate.accuracy.probes import AccuracyRequest
from lidardesign.evaluate.accuracy.settings import Measurement, Sweep, with_memory
from lidardesign.numerics import effective_count, systematic_draw
from lidardesign.run.manifest import FILE_NAME as MANIFEST_FILE
from lidardesign.samples import FILE_NAME, Samples, load_samples
from lidardesign.task import random_generator

SAMPLE_COUNTS = (1000, 2000, 5000, 10_000, 20_000)
RESTART_COUNTS = (1, 2, 4, 8, 12)
# Each setting is fitted so often, on other splits and with other seeds; more often where luck decides more. Fits take
# in proportion to their sensors: of many, fewer are made, but no fewer than the least.
REPEATS, LEAST_REPEATS, SENSORS_FITTED = 5, 2, 40
HELD_OUT_SHARE = 1 / 3
MORE_REPEATS = {1: 3, 2: 2, 4: 2}
# Modules are found where this process finds them, and a folder's own files are not mistaken for libraries.
PROGRAM = "import runpy, sys; sys.path[:] = {path!r}; runpy.run_module('lidardesign', run_name='__main__')"


def sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """Two sweeps for the fit of the first design whose sensors are Gaussian; none for scans."""
    design = next((one for one in request.request.designs if not layout_of(one).one_sensor_per_ray), None)
    samples = None if design is None else _samples(request, design)
    if design is None or samples is None or effective_count(samples.weights) < LEAST_SAMPLES:
        return []
    bench = FitBench(samples, len(design.sensors), design.level, request.request.seed)
    counts = [*(count for count in SAMPLE_COUNTS if count < bench.pool), bench.pool]
    usual = min(EM_SAMPLES, bench.pool)
    # a single sensor has one best fit, which every seed finds
    restarts = RESTART_COUNTS if bench.sensors > 1 else ()
    settings = [(one, RESTARTS, bench.splits) for one in counts]
    settings += [(usual, one, bench.splits * MORE_REPEATS.get(one, 1)) for one in restarts]
    # one repeat of all after the other, so that whatever else the machine does slows all alike
    for repeat in range(max(repeats for _, _, repeats in settings)):
        for count, seeds, repeats in settings:
            if repeat < repeats:
                bench.fit(repeat, count, seeds)
    whole = _command_seconds(request.run, design)
    # what the command does besides is the same for all settings
    besides = 0.0 if whole is None else max(whole - bench.seconds(usual, RESTARTS), 0.0)
    of_samples = [bench.measure(f"{one:,}", one, RESTARTS, besides, default=one == usual) for one in counts]
    of_restarts = [bench.measure(str(one), usual, one, besides, default=one == RESTARTS) for one in restarts]
    work = "expectation maximisation" if whole is None else "the command `fit`, from its start to its end"
    sweeps = [_sweep("samples of the fit", f"{RESTARTS} seeds", of_samples, design, work)]
    if restarts:
        sweeps.append(_sweep("seeds of the fit", f"{usual:,} samples", of_restarts, design, work))
    return sweeps


def _sweep(knob: str, beside: str, measurements: Sequence[Measurement], design: DesignSpec, work: str) -> Sweep:
    note = f"{len(design.sensors)} sensors, as {design.name} has"
    note += f", at {condition_text(design.at)}" if design.at else ""
    note += ", without its constraints" if design.constraints else ""
    return Sweep(
        knob=knob,
        error_of="log density of held-out samples that is lost",
        unit="nats",
        against="the best fit of all settings to the same samples",
        tolerance=0.01,
        because="log densities that are 0.01 nats lower have one ray in a hundred fewer everywhere",
        work=work,
        measurements=measurements,
        note=f"{note}, with {beside}",
    )


def _command_seconds(run: Path, design: DesignSpec) -> float | None:
    """How long the command takes that fits such a design, from its start to its end [s]; None where it fails.

    It works on a copy of what it reads of the run, so that the run stays as it is.
    """
    needed = [run / name for name in (CONFIG_FILE, MANIFEST_FILE, FILE_NAME)]
    if not all(path.exists() for path in needed):
        return None
    options = ["--sensors", str(len(design.sensors)), "--layout", layout_of(design).fitted_as]
    options += ["--level", str(design.level)]
    options += [] if design.rays is None else ["--rays", str(design.rays)]
    options += [option for name, value in design.at.items() for option in ("--at", f"{name}={value}")]
    times = []
    with tempfile.TemporaryDirectory() as folder:
        for path in needed:
            shutil.copy(path, folder)
        for _ in range(2):
            command = [sys.executable, "-c", PROGRAM.format(path=sys.path), "fit", folder, "--quiet", *options]
            started = time.perf_counter()
            if subprocess.run(command, check=False, capture_output=True).returncode:
                return None
            times.append(time.perf_counter() - started)
    return min(times)


def _samples(request: AccuracyRequest, design: DesignSpec) -> Samples | None:
    """The samples that a design was fitted to, at its condition where it has one; None without any."""
    samples = request.request.samples.get(design.name)
    if samples is None and (request.run / FILE_NAME).exists():
        samples = load_samples(request.run, request.request.space)
    if samples is None or not samples.space.conditioned:
        return samples
    from lidardesign.density.target.prepare import prepare_target

    decided = request.decided_visibility
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
        space, rules = self.samples.space, Constraints().rules
        group = sensor_groups(rules, space, self.sensors)[0]
        return bounds_of(rules, space, group.sensors, interval_factor(self.level))

    @property
    def splits(self) -> int:
        """Into how many pairs of parts the samples are split, one after the other."""
        return min(REPEATS, max(LEAST_REPEATS, SENSORS_FITTED // self.sensors))

    @property
    def pool(self) -> int:
        """Samples that are left to fit to."""
        return len(self.samples) - round(HELD_OUT_SHARE * len(self.samples))

    def fit(self, repeat: int, count: int, restarts: int) -> None:
        """Fit to `count` of the pool's samples with so many seeds, once.

        Repeats differ in their draws and seeds, and take one split after the other; of one repeat, fits with more
        seeds also try those with fewer.
        """
        if (repeat, count, restarts) in self._known:
            return
        order = random_generator(self.seed, "mixture split", repeat % self.splits).permutation(len(self.samples))
        pool, held = order[: self.pool], order[self.pool :]
        generator = random_generator(self.seed, "mixture fit", repeat)
        started = time.perf_counter()
        trace, memory = with_memory(
            lambda: fit_mixture(self._drawn(pool, count, generator), self.bounds, generator, restarts=restarts)
        )
        seconds = time.perf_counter() - started
        judged = self._features(self.samples.points[held], self.samples.weights[held])
        likelihood = float(judged.weights @ log_density(trace.mixture, judged))
        self._known[repeat, count, restarts] = Fitted(likelihood, seconds, memory)

    def _drawn(self, pool: np.ndarray, count: int, generator: np.random.Generator) -> Features:
        """So many of the pool's samples, of equal weight; all of them as they are."""
        weights = self.samples.weights[pool]
        if count >= len(pool):
            return self._features(self.samples.points[pool], weights)
        chosen = systematic_draw(weights / weights.sum(), count, generator)
        return self._features(self.samples.points[pool[generator.permutation(chosen)]], np.ones(count))

    def _features(self, points: np.ndarray, weights: np.ndarray) -> Features:
        return Features.of(points, weights, Axes.of(self.samples.space), self.samples.space)

    def seconds(self, count: int, restarts: int) -> float:
        """The median time of a setting's fits [s]."""
        return float(np.median([one.seconds for _, one in self._of(count, restarts)]))

    def measure(self, setting: str, count: int, restarts: int, besides: float, *, default: bool) -> Measurement:
        """A setting, once all settings have been fitted; `besides`: what a fit takes besides [s]."""
        # against the best fit of the split, of all settings
        best: dict[int, float] = {}
        for (repeat, _, _), one in self._known.items():
            best[repeat % self.splits] = max(best.get(repeat % self.splits, -math.inf), one.log_likelihood)
        fits = self._of(count, restarts)
        lost = np.array([best[repeat % self.splits] - one.log_likelihood for repeat, one in fits])
        maximising = self.seconds(count, restarts)
        return Measurement(
            setting,
            error=float(lost.mean()),
            uncertainty=float(lost.std(ddof=1) / math.sqrt(len(lost))),
            seconds=besides + maximising,
            memory_bytes=max((one.memory_bytes for _, one in fits if one.memory_bytes is not None), default=None),
            default=default,
            values={"worst_nats": float(lost.max()), "fit_seconds": maximising},
        )

    def _of(self, count: int, restarts: int) -> list[tuple[int, Fitted]]:
        return [(key[0], one) for key, one in self._known.items() if key[1:] == (count, restarts)]
