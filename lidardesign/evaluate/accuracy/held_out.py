"""The number of held-out scenes: how wide the interval of a difference is, and what so many scenes cost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.evaluate.accuracy.probes import AccuracyRequest
from lidardesign.evaluate.accuracy.settings import Measurement, Sweep
from lidardesign.evaluate.results import Row
from lidardesign.evaluate.statistics import mean_interval
from lidardesign.task import random_generator

RIVAL = "bounding"
# Numbers of scenes that are tried where there are more.
COUNTS = (5, 10, 20, 50, 100, 200)
# So many sets of scenes are drawn for each; a mean half-width is then known to a few percent beside the scenes' own.
DRAWS = 32


def sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """One sweep: the first design at its largest number of rays against `bounding`; none with fewer than 2 scenes."""
    rows = request.evaluation.rows
    first = next((row.design for row in rows if not row.baseline), None)
    pairs = [
        (row, rival)
        for row in rows
        for rival in rows
        if row.design == first and rival.design == RIVAL and rival.rays == row.rays
    ]
    if not pairs:
        return []
    # where designs are closest
    design, rival = max(pairs, key=lambda pair: pair[0].rays)
    differences = np.asarray(design.per_scene, dtype=np.float64) - np.asarray(rival.per_scene, dtype=np.float64)
    if design.groups is not None:  # scenes of one group stand for each other
        differences = np.bincount(design.groups, differences) / np.bincount(design.groups)
    return [_sweep(differences, design, request)] if len(differences) > 1 else []


def _sweep(differences: np.ndarray, design: Row, request: AccuracyRequest) -> Sweep:
    metric, total = request.evaluation.metric, len(differences)
    # of all rows in all scenes [s]; rows that fire the same rays have one time, to the last bit
    row_seconds = {row.seconds for row in (*request.evaluation.rows, *request.evaluation.equal_bandwidth)}
    seconds = (request.evaluation.planning_seconds + sum(row_seconds)) / total
    units = "scenes" if total == len(design.per_scene) else "groups of scenes"
    counts = [*(count for count in COUNTS if count < total), total]
    measurements = [_measure(differences, count, seconds, request.request.seed) for count in counts]
    # half-widths fall with the root of the number of scenes
    half_width, tolerance = measurements[-1].error, metric.tolerance
    note = ""
    if half_width > tolerance > 0:
        needed = math.ceil(total * (half_width / tolerance) ** 2)
        note = f"{needed:,} {units} would tell differences of {tolerance:g} {metric.unit} apart"
    return Sweep(
        knob=f"held-out {units}",
        error_of=f"half-width of the 95 % interval of {design.design} minus {RIVAL} at {design.rays} rays",
        unit=metric.unit,
        against=f"all {units} that there could be",
        tolerance=tolerance,
        because="the task's own tolerance: smaller differences do not matter to it",
        work=f"simulating and scoring all rows in so many {units}",
        measurements=measurements,
        note=note,
    )


def _measure(differences: np.ndarray, count: int, seconds: float, seed: int) -> Measurement:
    """The mean half-width over sets of so many scenes; over the one set where all are taken."""
    total = len(differences)
    generator = random_generator(seed, "held-out ladder", count)
    draws = DRAWS if count < total else 1
    sets = [generator.permutation(total)[:count] for _ in range(draws)] if count < total else [np.arange(total)]
    intervals = [mean_interval(differences[chosen], seed, resamples=1000) for chosen in sets]
    halves = np.array([(one.high - one.low) / 2 for one in intervals])
    sign = np.sign(differences.mean())
    agree = np.mean([sign * one.low > 0 and sign * one.high > 0 for one in intervals])
    drawn = halves.std(ddof=1) / math.sqrt(draws) if draws > 1 else 0.0
    return Measurement(
        setting=str(count),
        error=float(halves.mean()),
        uncertainty=math.hypot(float(halves.mean()) * relative_error_of_spread(differences), float(drawn)),
        seconds=seconds * count,
        default=count == total,
        values={"told_apart_share": float(agree)},
    )


def relative_error_of_spread(values: np.ndarray) -> float:
    r"""The relative standard error of a sample's standard deviation, $\sqrt{(m_4 / m_2^2 - 1) / 4 n}$ (Cramer 1946).

    Every half-width is in proportion to it. 0 where all values are equal.
    """
    centred = values - values.mean()
    second = float(np.mean(centred**2))
    if second == 0:
        return 0.0
    return math.sqrt(max(float(np.mean(centred**4)) / second**2 - 1, 0.0) / (4 * len(values)))
