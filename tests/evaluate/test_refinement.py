"""Refinement: whatever is fitted on the way, the best on scenes of its own is kept, and it ends by itself."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lidardesign_tasks.flatland import FlatlandTask

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.errors import ConfigError, InfeasibleError, NumericalError
from lidardesign.evaluate.refinement import LEVELS, PATIENCE, SPREADS, Refiner, Shape, Trial
from lidardesign.evaluate.reweighting import Attention
from lidardesign.evaluate.scene_scores import checked_score
from lidardesign.geometry.rays import Rays
from lidardesign.simulate.simulate import simulate
from lidardesign.task import Metric, Residuals, Score

TASK = FlatlandTask()
SCENES = TASK.scenes(TASK.Config(train=5, test=1), "train", 5)
LOOK, JUDGE = SCENES[:3], SCENES[3:]
PLACES = np.column_stack([np.linspace(0.1, 0.9, 60), np.full(60, 0.8), np.zeros(60)])
ATTENTION = Attention.at(PLACES[::3], PLACES)
SIGMA_M = 0.02
START = Shape(0.95)


class Seen(FlatlandTask):
    """Flatland judged by how many rays return: more are better."""

    metric: ClassVar[Metric] = Metric("returns", "%", "higher", worst=0.0, tolerance=1.0)

    def score(self, scene, returns):
        return Score(100 * float(np.mean(np.concatenate([frame.returned for frame in returns]))))

    def residuals(self, scene, returns):
        return Residuals(PLACES, np.ones(len(PLACES)))


def rays_at(x, gate=(0.0, 1.2)):
    """Rays upwards from places on the line of sensors."""
    origin = np.column_stack([x, np.zeros((len(x), 2))])
    up = np.tile([0.0, 1.0, 0.0], (len(x), 1))
    return Rays(origin, up, np.tile(gate, (len(x), 1)), np.zeros(len(x)), np.zeros(len(x)))


def trial(*positions, layout="grid"):
    """A design of a fit that never was, and its rays."""
    sensor = Sensor("s0", 1.0, np.zeros(3), np.zeros((3, 3)), 1.57, 0.0, 0.0, 0.1, 0.0, 0.8, 0.1, rays=1)
    result = SimpleNamespace(design=DesignSpec("d", (sensor,), layout))
    return Trial(result, positions, float(np.mean([Bandwidth().mbps(rays) for rays in positions])))


EVEN = trial(rays_at(np.linspace(0.2, 0.8, 9)))


def refiner(refit, task=TASK, **options):
    return Refiner(task, task.metric, refit, LOOK, JUDGE, ATTENTION, sigma_m=SIGMA_M, **options)


def mean_score(task, found):
    seen = [(scene, [frame for rays in found.positions for frame in simulate(scene, rays)]) for scene in JUDGE]
    scores = [checked_score(task, task.metric, scene, returns).value for scene, returns in seen]
    return float(np.mean(scores))


def random_refits(seed):
    """Fits that give anything, or nothing."""
    generator = np.random.default_rng(seed)

    def refit(factors, shape):
        if started and generator.uniform() < 0.2:
            raise InfeasibleError("there is no room")
        started.append(True)
        x = generator.uniform(0.1, 0.9, int(generator.integers(3, 20)))
        return trial(rays_at(x, (0.0, generator.uniform(0.6, 1.2))))

    started = []
    return refit


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 6), st.sampled_from([TASK, Seen()]))
def test_what_is_found_is_never_worse_than_the_start_on_the_judging_scenes(seed, rounds, task):
    found = refiner(random_refits(seed), task).run(rounds, START)
    turn = 1 if task.metric.better == "lower" else -1
    assert turn * found.end <= turn * found.start
    assert mean_score(task, found.trial) == pytest.approx(found.end, rel=1e-12)
    kept = [one.score for one in found.rounds if one.kept]
    assert (turn * np.diff(kept) <= 0).all()


def test_the_same_rounds_are_told_as_they_come_and_given_in_the_end():
    told = []
    found = refiner(random_refits(1), progress=told.append).run(3, START)
    assert tuple(told) == found.rounds
    first = found.rounds[0].as_dict()
    assert (first["round"], first["change"], first["kept"]) == (0, "start", True)
    assert set(first) == {"round", "change", "score", "bandwidth_mbps", "kept", "seconds"}
    assert [one.number for one in found.rounds] == sorted(one.number for one in found.rounds)


def even_fits():
    """Fits that give nine even rays whatever they are asked for, and the list of what that was."""
    calls = []

    def refit(factors, shape):
        calls.append((factors, shape))
        return EVEN

    return refit, calls


def test_it_stops_by_itself_when_nothing_gets_better():
    found = refiner(even_fits()[0]).run(100, START)
    assert found.rounds[-1].number == PATIENCE
    assert found.trial is EVEN
    assert found.reweighting is None
    assert found.shape == START
    assert found.start == found.end
    assert (found.looked_at, found.judged_on) == (3, 2)


def test_no_more_rounds_than_were_asked_for():
    counts = iter(range(3, 1000))

    def ever_better(factors, shape):
        return trial(rays_at(np.linspace(0.15, 0.85, next(counts))))

    found = refiner(ever_better).run(1, START)
    assert {one.number for one in found.rounds} <= {0, 1}


def test_nothing_is_fitted_twice():
    calls = []

    def refit(factors, shape):
        key = (None if factors is None else factors.log_factors.tobytes(), shape)
        assert key not in calls
        calls.append(key)
        return trial(rays_at(np.linspace(0.2, 0.8, 5 + len(calls) % 4)))

    refiner(refit).run(8, START)
    assert len(calls) > 3


@pytest.mark.parametrize("error", [InfeasibleError, NumericalError])
def test_a_trial_that_is_refused_is_survived_and_noted(error):
    def refit(factors, shape):
        if factors is None and shape == START:
            return EVEN
        raise error("the box is [too] small")

    found = refiner(refit).run(3, START)
    assert found.trial is EVEN
    refused = found.rounds[1:]
    assert refused
    assert all(one.score is None and one.bandwidth_mbps is None and not one.kept for one in refused)
    assert all("the box is [too] small" in one.change for one in refused)


@pytest.mark.parametrize("error", [InfeasibleError, ConfigError])
def test_a_start_that_is_refused_is_an_error(error):
    def refit(factors, shape):
        raise error("no")

    with pytest.raises(error):
        refiner(refit).run(3, START)


def test_a_step_goes_towards_the_error_and_keeps_what_helps():
    """The rays look left; what is wrong is on the right."""
    factors_seen = []

    def refit(factors, shape):
        if factors is None:
            return trial(rays_at(np.linspace(0.18, 0.45, 12)))
        factors_seen.append(factors)
        left, right = factors.at_places(np.array([[0.25, 0.8, 0], [0.8, 0.8, 0]]))
        return trial(rays_at(np.linspace(0.18, 0.83 if right > left else 0.3, 12)))

    found = refiner(refit).run(2, START)
    left, right = found.reweighting.at_places(np.array([[0.25, 0.8, 0], [0.8, 0.8, 0]]))
    assert right > left
    assert found.end < found.start
    assert any(one.kept and one.change.startswith("towards the error") for one in found.rounds)


def test_it_goes_on_from_factors_that_were_found_before():
    before = np.linspace(-1, 1, len(ATTENTION.points_m)).round(3)
    refit, calls = even_fits()
    found = refiner(refit).run(1, START, before)
    np.testing.assert_array_equal(calls[0][0].log_factors, before)
    np.testing.assert_array_equal(found.reweighting.log_factors, before)
    np.testing.assert_array_equal(found.reweighting.points_m, ATTENTION.points_m)


def levels_and_spreads(refit, rounds=2, **options):
    shapes = []

    def remembered(factors, shape):
        shapes.append(shape)
        return refit(factors, shape)

    found = refiner(remembered, **options).run(rounds, START)
    return found, shapes


def test_wider_intervals_are_climbed_as_long_as_they_help():
    def refit(factors, shape):
        steps = SPREADS.index(round(shape.range_spread_m / SIGMA_M)) + LEVELS.index(shape.level)
        return trial(rays_at(np.linspace(0.16, 0.84, 3 + steps)))

    found, _ = levels_and_spreads(refit)
    assert found.shape == Shape(LEVELS[-1], SPREADS[-1] * SIGMA_M)


def test_narrower_intervals_are_tried_where_wider_ones_do_not_help():
    def refit(factors, shape):
        return trial(rays_at(np.linspace(0.16, 0.84, 12 - round(100 * abs(shape.level - 0.9)))))

    found, shapes = levels_and_spreads(refit)
    assert found.shape.level == 0.9
    assert {shape.level for shape in shapes} == {0.98, 0.95, 0.9, 0.8}


def test_samples_are_not_spread_where_they_may_not_be():
    _, shapes = levels_and_spreads(lambda factors, shape: EVEN, spreads=False)
    assert {shape.range_spread_m for shape in shapes} == {0.0}


def test_more_bandwidth_has_to_be_worth_it():
    few, more = rays_at(np.linspace(0.16, 0.84, 30), (0.0, 1.0)), rays_at(np.linspace(0.16, 0.84, 40), (0.0, 200.0))
    assert mean_score(TASK, trial(more)) < mean_score(TASK, trial(few))

    def refit(factors, shape):
        return trial(few if shape == START else more)

    found, _ = levels_and_spreads(refit)
    assert found.shape == START


def test_gates_by_traced_returns_are_tried_once_where_every_ray_has_its_own():
    for layout, positions, tried in (("scan", 1, 1), ("grid", 1, 0), ("scan", 2, 0)):
        made = trial(*EVEN.positions * positions, layout=layout)
        found, shapes = levels_and_spreads(lambda factors, shape, made=made: made)
        assert sum(shape.traced_gates for shape in shapes) == tried
        assert [one.change for one in found.rounds].count("gates by traced returns") == tried


def test_a_design_without_any_error_stays_as_it_is():
    class Perfect(FlatlandTask):
        def residuals(self, scene, returns):
            return Residuals(np.zeros((0, 3)), np.zeros(0))

    refit, calls = even_fits()
    refiner(refit, Perfect()).run(5, START)
    assert calls
    assert all(factors is None for factors, _ in calls)


def test_the_shape_of_a_start_is_the_one_it_is_given():
    shape = replace(START, level=0.9, range_spread_m=0.04)
    refit, calls = even_fits()
    refiner(refit).run(1, shape)
    assert calls[0][1] == shape
    assert {one.range_spread_m for _, one in calls} >= {0.04, 0.08}
