"""Learning within a time budget: plans, what they leave alone, and the same bytes as a run of the planned steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.learning import BallTask, config_of, result_bytes

from lidardesign.config import LearningSettings
from lidardesign.density.learn import learn, make_trainer, prepare_training_data
from lidardesign.density.training import schedule as budget
from lidardesign.density.training.checkpoint import FOLDER
from lidardesign.density.training.schedule import LEAST_STEPS, Timekeeper, TimePlan
from lidardesign.errors import ConfigError
from lidardesign.run.manifest import read_manifest, start_manifest
from lidardesign.run.yaml import load_yaml

CPU = torch.device("cpu")
FINISHING_S = 2.0


@pytest.fixture
def steps_take(monkeypatch):
    """Pretend how long steps and the end take, so that no plan depends on the machine."""

    def pretend(*step_seconds):
        times = iter(step_seconds)
        monkeypatch.setattr(budget, "_seconds_per_step", lambda trainer, step: next(times))
        monkeypatch.setattr(budget, "_finishing_s", lambda *_: FINISHING_S)

    return pretend


def keeper_for(run, seconds, **settings):
    run.mkdir(exist_ok=True)
    start_manifest(run, command=[], seed=0)
    return Timekeeper(seconds, lambda: 1.0, config_of(**settings), run)


def test_the_plan_fills_the_time_with_steps_of_both_phases(tmp_path, steps_take):
    steps_take(0.01, 0.02, 0.06)
    keeper = keeper_for(tmp_path, 31.0)
    config = keeper.plan(prepare_training_data(BallTask(), keeper.config), CPU)
    # the slower of the path-wise steps counts: (31 - 1) * 0.9 - 2 s at (0.02 + 0.06) / 2 s a step
    assert config.learning.steps == 625
    assert keeper.planned.pathwise_steps == pytest.approx(312, abs=1)


@pytest.mark.parametrize("balancing_s", [0.06, 0.5, 50.0])
def test_a_budgeted_run_is_the_run_of_its_own_configuration_bit_for_bit(tmp_path, steps_take, balancing_s):
    run, plain = tmp_path / "run", tmp_path / "plain"
    plain.mkdir()
    steps_take(0.1, 0.1, 0.1, balancing_s)
    keeper = keeper_for(run, 15.0)
    data = prepare_training_data(BallTask(), keeper.config)
    config = keeper.plan(data, CPU)
    result = learn(BallTask(), config, run, data=data, replan=keeper.replan)
    final = load_yaml(run / "config.yaml").mapping["learning"]
    again = config_of(steps=final["steps"], balance=final["balance"])
    learn(BallTask(), again, plain)
    assert result.steps == final["steps"] == keeper.planned.steps
    assert result_bytes(run) == result_bytes(plain)
    kept = {path.name: path.read_bytes() for path in (run / FOLDER).iterdir()}
    assert kept == {path.name: path.read_bytes() for path in (plain / FOLDER).iterdir()}
    noted = read_manifest(run)["goal"]
    assert noted["settled"]
    assert noted["balancing_steps"] == result.steps - noted["pathwise_steps"]


def test_too_little_time_is_refused_with_the_least_that_would_do(tmp_path, steps_take):
    steps_take(0.1, 0.1, 0.3)
    keeper = keeper_for(tmp_path, 10.0)
    data = prepare_training_data(BallTask(), keeper.config)
    with pytest.raises(ConfigError, match=r"--time-budget.*over before.*\n.*at least 26 s") as caught:
        keeper.plan(data, CPU)
    assert caught.value.exit_code == 2
    steps_take(0.1, 0.1, 0.3)
    assert keeper_for(tmp_path, 26.0).plan(data, CPU).learning.steps >= LEAST_STEPS


@pytest.mark.parametrize("balance", [0.0, 1.0])
def test_trainings_of_one_phase_are_planned_too(tmp_path, steps_take, balance):
    steps_take(0.05, 0.05, 0.05)
    keeper = keeper_for(tmp_path, 20.0, balance=balance)
    config = keeper.plan(prepare_training_data(BallTask(), keeper.config), CPU)
    assert config.learning.balance == balance
    assert config.learning.steps > LEAST_STEPS


def test_planned_phases_come_back_from_the_settings_exactly():
    generator = np.random.default_rng(0)
    for pathwise, balancing in generator.integers(1, 100_000, size=(2000, 2)).tolist():
        plan = TimePlan(1.0, 1.0, 1.0, 1.0, pathwise, balancing)
        settings = plan.applied(LearningSettings())
        assert settings.steps == pathwise + balancing
        assert round((1 - settings.balance) * settings.steps) == pathwise


def test_timing_steps_and_the_end_leaves_the_trainer_as_it_was(tmp_path):
    config = config_of()
    data = prepare_training_data(BallTask(), config)
    trainer = make_trainer(data, config, tmp_path, CPU)
    before, step = trainer._state_arrays(), trainer.step
    assert budget._seconds_per_step(trainer, trainer.pathwise_steps) > 0
    assert budget._finishing_s(trainer, budget._timed_probes(data.target, config), config) > 0
    after = trainer._state_arrays()
    assert trainer.step == step
    assert before.keys() == after.keys()
    for key, value in before.items():
        np.testing.assert_array_equal(value, after[key], err_msg=key)


def test_what_is_only_compiled_once_is_not_planned_for_every_point(tmp_path, monkeypatch):
    config = config_of(samples=100_000)
    data = prepare_training_data(BallTask(), config)
    trainer = make_trainer(data, config, tmp_path, CPU)
    seconds = [0.0]
    monkeypatch.setattr(budget.time, "perf_counter", lambda: seconds[0])

    def compiling(name):
        exact, called = getattr(budget, name), []

        def slow_at_first(*arguments):
            seconds[0] += 0.001 if called else 5.0
            called.append(name)
            return exact(*arguments)

        monkeypatch.setattr(budget, name, slow_at_first)

    compiling("draw_samples")
    compiling("log_density_of")
    points_per_s = 1000 * budget.TIMED_POINTS
    planned_s = budget._finishing_s(trainer, budget._timed_probes(data.target, config), config)
    assert planned_s == pytest.approx(100_000 / points_per_s + 0.001 + budget.WRITING_S)


def test_what_drawing_takes_however_few_is_planned_once(monkeypatch):
    config = config_of(coverage_proposals=8000)
    data = prepare_training_data(BallTask(), config)
    seconds, exact = [0.0], budget.draw_probes
    monkeypatch.setattr(budget.time, "perf_counter", lambda: seconds[0])

    def slow(target, count, generator):
        seconds[0] += 4.0 + 1e-4 * count
        return exact(target, count, generator)

    monkeypatch.setattr(budget, "draw_probes", slow)
    assert budget._timed_probes(data.target, config).seconds == pytest.approx(4.8)
