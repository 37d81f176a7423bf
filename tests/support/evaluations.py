"""An evaluation made up for its pictures."""

from __future__ import annotations

import numpy as np

from lidardesign.evaluation.results import Evaluation, Paired, Row
from lidardesign.task import Metric

METRIC = Metric("Chamfer distance", "mm", "lower", worst=200.0, tolerance=0.1)


def make_row(name, rays, value, baseline=False, matched_to=None):
    interval, matched_rays = (value * 0.9, value * 1.1), rays if matched_to else None
    values = np.array([value])
    return Row(name, rays, value, *interval, 1, rays * 0.01, 0.5, values, baseline, matched_to, matched_rays)


def make_evaluation(names=("first", "second"), rays=(36, 100, 576), value=30.0):
    rows = [make_row(name, n, value / n**0.3 + i) for i, name in enumerate(names) for n in rays]
    baselines = [make_row(name, n, 2 * value / n**0.3, True) for name in ("uniform", "bounding") for n in rays]
    paired = [Paired(names[0], "uniform", n, -1.0, -2.0, 0.5) for n in rays]
    matched = [make_row("uniform", n, value, True, names[0]) for n in rays]
    bandwidth = [Paired(names[0], "uniform", n, 1.0, 0.5, 2.0, n) for n in rays]
    return Evaluation(METRIC, 5, [*rows, *baselines], paired, matched, bandwidth, ["a note"])
