"""Several seeds of learning and fitting, scored in the same held-out scenes: means and intervals over both.

What one seed is better by may be luck of that seed. Every row and every paired difference has a table of seeds by
groups of scenes, both drawn at random and crossed, one value in each cell (two random factors without replication;
Searle, Casella and McCulloch 1992, "Variance components", ch. 4). Its mean has the variance
(MS_seed + MS_group - MS_error) / (seeds groups), whose degrees of freedom are those of Satterthwaite (1946).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from lidardesign.errors import NumericalError
from lidardesign.estimates import (
    LEVEL,
    UNLIMITED,
    Interval,
    as_percent,
    log_ratios,
    skewness_of_mean,
    spanned,
    student_interval,
)
from lidardesign.evaluation.entries import mean_baseline
from lidardesign.evaluation.results import Evaluation, Mounting, Paired, Row
from lidardesign.task import Metric

# Design, rays, and what the bandwidth is matched to; rays at equal bandwidth differ between seeds.
RowKey: TypeAlias = tuple[str, int | None, str | None, int | None]


def two_way_interval(table: Any, *, limits: tuple[float, float] = UNLIMITED, level: float = LEVEL) -> Interval:
    """The mean of a table of seeds by groups with its interval over other seeds and other groups.

    The variance is no less than what the errors alone make of it, and its degrees of freedom are no fewer than those of
    the smaller factor: by chance the mean squares of seeds and groups lie below that of errors, or close to it. The
    mean is skewed as the mean of each factor is, by its part of the variance.

    Arguments:
        table: One value per seed and group, shape (R, G).
        limits: The least and the largest value that there can be.
        level: The share that the interval holds.

    Raises:
        NumericalError: It is no table, or holds values that are not finite.
    """
    table = np.asarray(table, dtype=np.float64)
    if table.ndim != 2 or not table.size or not np.isfinite(table).all():
        raise NumericalError(f"seeds by groups need finite values; found shape {table.shape}", where="statistics")
    mean, (seeds, groups) = float(table.mean()), table.shape
    if seeds == 1 or groups == 1:
        return Interval(mean, None, None)
    if (table == table[0, 0]).all():
        return Interval(*[float(table[0, 0])] * 3)
    of_seeds, of_groups = table.mean(axis=1) - mean, table.mean(axis=0) - mean
    errors = table - mean - of_seeds[:, None] - of_groups
    degrees = np.array([seeds - 1, groups - 1, (seeds - 1) * (groups - 1)])
    squares = np.array([groups * of_seeds @ of_seeds, seeds * of_groups @ of_groups, np.square(errors).sum()])
    mean_squares = squares / degrees
    variance = mean_squares @ [1.0, 1.0, -1.0]
    if variance <= mean_squares[2]:
        variance, freedom, skewness = mean_squares[2], degrees[2], 0.0
    else:
        parts = np.maximum(mean_squares[:2] - mean_squares[2], 0.0) / variance
        skewness = float(parts**1.5 @ [skewness_of_mean(of_seeds), skewness_of_mean(of_groups)])
        freedom = max(variance**2 / np.sum(np.square(mean_squares) / degrees), degrees[:2].min())
    error = math.sqrt(variance / table.size)
    return student_interval(mean, error, float(freedom), skewness, limits=limits, level=level)


def over_seeds(evaluations: Sequence[Evaluation], seeds: Sequence[int], scenes_seed: int) -> Evaluation:
    """One evaluation of many: rows and differences are means over seeds; failures and seconds are sums.

    Rows that not every seed has are left out, with a note. Effects are those of the first seed.

    Arguments:
        evaluations: One per seed, over the same scenes in the same order.
        seeds: Their seeds.
        scenes_seed: Of the held-out scenes.
    """
    first, metric = evaluations[0], evaluations[0].metric
    by_key = [{_key(row): row for row in (*each.rows, *each.equal_bandwidth)} for each in evaluations]
    rows = {key: [rows[key] for rows in by_key] for key in by_key[0] if all(key in rows for rows in by_key)}
    plain = [_mean_row(found, metric) for key, found in rows.items() if key[2] is None]
    matched = [_mean_row(found, metric) for key, found in rows.items() if key[2] is not None]
    pairs = [(pair, (pair.a, pair.rays, None, None), (pair.b, pair.rays, None, None)) for pair in first.paired]
    bandwidth_pairs = [
        (pair, (pair.a, pair.rays, None, None), (pair.b, None, pair.a, pair.rays)) for pair in first.paired_bandwidth
    ]
    left_out = sorted({key[0] for each in by_key for key in each if key not in rows})
    return replace(
        first,
        rows=plain,
        paired=[_mean_pair(pair, rows[a], rows[b], metric) for pair, a, b in pairs if a in rows and b in rows],
        equal_bandwidth=matched,
        paired_bandwidth=[
            replace(_mean_pair(pair, rows[a], rows[b], metric), rays_b=_mean_row(rows[b], metric).rays)
            for pair, a, b in bandwidth_pairs
            if a in rows and b in rows
        ],
        notes=[
            f"means over the seeds {', '.join(map(str, seeds))} of learning and fitting, in the held-out scenes of "
            f"seed {scenes_seed}; intervals are over seeds and scenes",
            *([f"rows that not every seed has are left out: {', '.join(left_out)}"] if left_out else []),
            *_joint_notes(evaluations, seeds),
        ],
        planning_seconds=sum(each.planning_seconds for each in evaluations),
        searches=[search for each in evaluations for search in each.searches],
        mounting=_mean_mounting(evaluations, rows),
        seeds=tuple(seeds),
        strongest_baseline=mean_baseline((each.strongest_baseline for each in evaluations), metric.better),
    )


def _mean_mounting(evaluations: Sequence[Evaluation], exact: Mapping[RowKey, Sequence[Row]]) -> Mounting | None:
    mountings = [each.mounting for each in evaluations if each.mounting is not None]
    if not mountings:
        return None
    by_key = [{_key(row): row for row in each.rows} for each in mountings]
    metric = evaluations[0].metric
    misplaced = {key: [rows[key] for rows in by_key] for key in by_key[0] if key in exact}
    costs = zip(mountings[0].costs, mountings[0].rows, strict=True)
    return Mounting(
        mountings[0].error,
        [_mean_row(rows, metric) for rows in misplaced.values()],
        [
            _mean_pair(cost, misplaced[_key(row)], exact[_key(row)], metric)
            for cost, row in costs
            if _key(row) in misplaced
        ],
    )


def _key(row: Row) -> RowKey:
    return (row.design, row.rays if row.matched_to is None else None, row.matched_to, row.matched_rays)


def _table(per_scene: np.ndarray, groups: np.ndarray | None) -> np.ndarray:
    """Values (R, S) as a table of seeds by groups (R, G) with the same mean: group means where sizes are equal."""
    if groups is None:
        return per_scene
    counts, mean = np.bincount(groups), per_scene.mean()
    sums = np.stack([np.bincount(groups, values) for values in per_scene])
    return mean + (sums - mean * counts) / counts.mean()


def _mean_row(rows: Sequence[Row], metric: Metric) -> Row:
    values = np.stack([row.per_scene for row in rows])
    mean, low, high = two_way_interval(_table(values, rows[0].groups), limits=metric.limits)
    deciles, numbers = [row.worst_decile for row in rows], {len(row.lost) for row in rows}
    names = [name for name in rows[0].details if all(name in row.details for row in rows)]
    return replace(
        rows[0],
        rays=round(float(np.mean([row.rays for row in rows]))),
        value=mean,
        ci_low=low,
        ci_high=high,
        failures=sum(row.failures for row in rows),
        bandwidth_mbps=float(np.mean([row.bandwidth_mbps for row in rows])),
        seconds=sum(row.seconds for row in rows),
        per_scene=values.mean(axis=0),
        details={name: float(np.mean([row.details[name] for row in rows])) for name in names},
        gates=max(row.gates for row in rows),
        per_seed=tuple(values.mean(axis=1).tolist()),
        worst_decile=None if None in deciles else float(np.mean(deciles)),
        # which sensor is the first says nothing over seeds: from the least score to the largest
        lost=tuple(np.mean([sorted(row.lost) for row in rows], axis=0).tolist()) if len(numbers) == 1 else (),
    )


def _mean_pair(pair: Paired, first: Sequence[Row], second: Sequence[Row], metric: Metric) -> Paired:
    values, groups = [np.stack([row.per_scene for row in rows]) for rows in (first, second)], first[0].groups
    limits, logs = spanned(metric.limits), log_ratios(*values)
    mean, low, high = two_way_interval(_table(values[0] - values[1], groups), limits=limits)
    percent = None if logs is None else as_percent(two_way_interval(_table(logs, groups)))
    return replace(pair, difference=mean, ci_low=low, ci_high=high, percent=percent)


def _joint_notes(evaluations: Sequence[Evaluation], seeds: Sequence[int]) -> list[str]:
    """Notes of all evaluations, then those of single ones."""
    shared = [note for note in evaluations[0].notes if all(note in each.notes for each in evaluations)]
    own = [
        type(note)(f"seed {seed}: {note}")
        for each, seed in zip(evaluations, seeds, strict=True)
        for note in each.notes
        if note not in shared
    ]
    return [*shared, *own]
