"""The strongest baseline: found at the middle number of rays, on training scenes that no baseline was built from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.evaluations import make_row
from support.scoring import HitTask, MissTask, design, entries_of, make_request, scenes

from lidardesign.evaluation.entries import (
    FEWEST_BASELINE_SCENES,
    LARGEST_BASELINE_SHARE,
    MOST_BASELINE_SCENES,
    mean_baseline,
)
from lidardesign.evaluation.results import middle_rays
from lidardesign.evaluation.score import evaluate
from lidardesign.evaluation.seeds import over_seeds
from lidardesign.scenes.casting import SceneCaster

HELD_BACK = scenes(31, 40, side=0.3)


class HeldBackAlone:
    """Training scenes of a run, of which none may be drawn but those that no choice was made on."""

    def scenes(self, purpose, start=0):
        assert (purpose, start) == ("held back", 0)
        yield from HELD_BACK


def with_held_back(**changes):
    return make_request(training=HeldBackAlone(), **changes)


@pytest.mark.parametrize(
    ("counts", "middle"),
    [
        ({"a": [9]}, 9),
        ({"a": [9, 25]}, 9),
        ({"a": [9, 25, 36]}, 25),
        ({"a": [100, 9, 36, 25]}, 25),
        # a small fixed pattern has rows at few numbers; what most designs have counts
        ({"a": [9, 25, 36], "b": [25, 36, 49], "c": [25]}, 25),
        ({"a": [9, 25, 36], "b": [9]}, 9),
    ],
)
def test_the_middle_number_of_rays_is_where_most_designs_have_a_row(counts, middle):
    rows = [make_row(name, count, 1.0) for name, own in counts.items() for count in own]
    baselines = [make_row("uniform", count, 1.0, True) for count in (1, 2, 3, 4, 1000)]
    assert middle_rays([*rows, *baselines]) == middle_rays(rows[::-1]) == middle
    assert middle_rays(baselines) == 3


@pytest.mark.parametrize("task", [MissTask(), HitTask()])
def test_its_scores_are_those_of_its_rays_in_scenes_that_were_held_back(task):
    request = with_held_back(task=task, rays=(9, 16, 25))
    baseline = evaluate(request).strongest_baseline
    values = {}
    for entry in entries_of(request):
        if entry.baseline and entry.rays == 16 and entry.matched_to is None:
            values[entry.name] = np.mean(
                [_naive(task, entry.rays_in(n)[0], HELD_BACK[n]) for n in range(baseline.scenes)]
            )
    assert baseline.values == pytest.approx(values)
    assert (baseline.rays, set(baseline.values)) == (16, {"uniform", "random", "bounding", "silhouette"})
    order = sorted(values, key=values.get, reverse=request.metric.better == "higher")
    assert baseline.name == order[0]


def _naive(task, rays, scene):
    hits = SceneCaster(scene, 0).first_hit(rays.origin_m, rays.direction)
    seen = int(((hits.body >= 0) & (rays.gate_m[:, 0] <= hits.range_m) & (hits.range_m < rays.gate_m[:, 1])).sum())
    if isinstance(task, HitTask):
        return 100.0 * seen / len(rays)
    return task.metric.worst if seen < task.fewest_returns else 100.0 * (1 - seen / len(rays))


def test_held_out_scenes_have_no_say():
    first, second = (evaluate(with_held_back(test=scenes(seed, side=side))) for seed, side in ((2, 0.0), (5, 1.0)))
    assert first.strongest_baseline == second.strongest_baseline
    assert [row.value for row in first.rows] != [row.value for row in second.rows]


@pytest.mark.parametrize(
    ("tests", "rays", "scenes_used"),
    [(1, (9,), FEWEST_BASELINE_SCENES), (100, (25,), 12), (40, (9, 100), MOST_BASELINE_SCENES)],
)
def test_it_costs_a_tenth_of_the_rays_or_few_scenes(tests, rays, scenes_used):
    request = with_held_back(test=scenes(2, tests), rays=rays, equal_bandwidth=False)
    found = evaluate(request).strongest_baseline
    assert found.scenes == scenes_used
    fired = sum(entry.rays for entry in entries_of(request)) * tests
    if found.scenes > FEWEST_BASELINE_SCENES:
        assert found.scenes * found.rays * len(found.values) <= LARGEST_BASELINE_SHARE * fired


def test_without_baselines_there_is_none():
    for request in (make_request(baselines=()), make_request(baselines=("uniform",), train=())):
        evaluation = evaluate(request)
        assert evaluation.strongest_baseline is None
        assert evaluation.as_dict()["strongest_baseline"] is None


def test_over_seeds_it_is_the_best_of_the_means():
    evaluations = [evaluate(make_request([design("own")], seed=seed)) for seed in range(3)]
    joint = over_seeds(evaluations, (0, 1, 2), 7).strongest_baseline
    for name, value in joint.values.items():
        assert value == pytest.approx(np.mean([each.strongest_baseline.values[name] for each in evaluations]))
    assert joint.name == min(joint.values, key=joint.values.get)
    assert joint.scenes == sum(each.strongest_baseline.scenes for each in evaluations)
    assert mean_baseline([evaluations[0].strongest_baseline, None], "lower") is None
    one = evaluations[0].strongest_baseline
    lacking = replace(one, values={"uniform": 3.0})
    assert mean_baseline([one, lacking], "lower").name == "uniform"
