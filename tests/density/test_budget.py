"""Learning within a time budget or to a tolerance: plans and stages, and the same bytes as a run of their steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.learning import BallTask, Interrupter, config_of, result_bytes

from lidardesign.config import LearningSettings, save_run_config
from lidardesign.density.learn import learn, make_trainer, prepare_training_data
from lidardesign.density.training import schedule as budget
from lidardesign.density.training.checkpoint import FOLDER
from lidardesign.density.training.schedule import (
    LEAST_STEPS,
    Stage,
    Timekeeper,
    TimePlan,
    ToleranceGoal,
    goal_of,
    learn_to_tolerance,
    stage_steps,
    with_steps,
)
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.manifest import note, read_manifest, start_manifest, verify
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
    with pytest.raises(ConfigError, match=r"--time-budget.*too short to learn.*\n.*at least 26 s") as caught:
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


PLANNED = 40


def staged(run, tolerance, progress=None, **options):
    config = config_of(steps=PLANNED)
    start_manifest(run, command=[], seed=config.seed)
    data = prepare_training_data(BallTask(), config)

    def once(config, resume):
        return learn(BallTask(), config, run, resume=resume, data=data, progress=progress)

    return learn_to_tolerance(config, run, ToleranceGoal(tolerance, PLANNED), once, **options)


def goal_with(tolerance, *shares, planned=100, error=0.001):
    stages = [Stage(n, share, error, 1.0) for n, share in zip(stage_steps(planned), shares, strict=False)]
    return ToleranceGoal(tolerance, planned, tuple(stages))


def test_stages_double_from_an_eighth_to_four_times_the_planned_steps():
    assert stage_steps(1000) == (125, 250, 500, 1000, 2000, 4000)
    assert stage_steps(3) == (1, 2, 3, 6, 12)


def test_learning_ends_with_the_first_stage_within_the_tolerance(tmp_path):
    result, goal = staged(tmp_path, 0.9)
    assert goal.met
    assert [stage.steps for stage in goal.stages] == [5]
    assert result.steps == 5


def test_a_run_to_a_tolerance_is_the_run_of_its_last_stage_bit_for_bit(tmp_path):
    (tmp_path / "staged").mkdir()
    (tmp_path / "plain").mkdir()
    (tmp_path / "first").mkdir()
    first, _ = staged(tmp_path / "first", 0.99)
    result, goal = staged(tmp_path / "staged", first.misplaced - 1e-6)
    assert len(goal.stages) > 1
    config = with_steps(config_of(steps=PLANNED), result.steps)
    learn(BallTask(), config, tmp_path / "plain")
    assert result_bytes(tmp_path / "staged") == result_bytes(tmp_path / "plain")
    assert load_yaml(tmp_path / "staged" / "config.yaml").mapping["learning"]["steps"] == result.steps
    listed = read_manifest(tmp_path / "staged")["files"]
    for name in listed:
        verify(tmp_path / "staged", name)
    assert goal_of(tmp_path / "staged") == goal


@pytest.mark.parametrize("stop", [5, 20])
def test_an_interrupted_stage_is_continued_and_earlier_ones_are_not_repeated(tmp_path, stop):
    (tmp_path / "straight").mkdir()
    (tmp_path / "resumed").mkdir()
    _, straight = staged(tmp_path / "straight", 1e-9)
    run = tmp_path / "resumed"
    with pytest.raises(KeyboardInterrupt):
        staged(run, 1e-9, progress=Interrupter(stop))
    before = goal_of(run)
    config = with_steps(config_of(steps=PLANNED), load_yaml(run / "config.yaml").mapping["learning"]["steps"])
    learned = []

    def once(config, resume):
        learned.append(config.learning.steps)
        return learn(BallTask(), config, run, resume=resume)

    resume = (run / "checkpoint.safetensors").exists()
    _, goal = learn_to_tolerance(config, run, before, once, resume=resume)
    assert [stage.steps for stage in goal.stages] == [stage.steps for stage in straight.stages]
    assert [stage.misplaced for stage in goal.stages] == [stage.misplaced for stage in straight.stages]
    assert not set(learned) & {stage.steps for stage in before.stages}
    assert result_bytes(run) == result_bytes(tmp_path / "straight")


def test_hope_is_given_up_only_where_the_last_fall_repeated_would_not_do():
    falling = (0.4, 0.3, 0.2, 0.1)
    assert not goal_with(0.03, *falling).hopeless  # 0.1 -> 0.05 -> 0.025
    assert goal_with(0.02, *falling).hopeless
    assert goal_with(0.1, 0.5, 0.4, 0.3, 0.29).hopeless
    assert not goal_with(0.01, 0.5, 0.49).hopeless  # fewer steps than planned fall by another law
    assert goal_with(1e-9, 0.4, 0.3, 0.2, 0.1, 0.05, 0.02).hopeless


def test_a_stage_that_is_learned_again_replaces_its_first_result():
    goal = goal_with(0.1, 0.5, 0.4).with_stage(Stage(25, 0.39, 0.001, 2.0))
    assert [stage.misplaced for stage in goal.stages] == [0.5, 0.39]


def test_a_run_without_a_tolerance_has_none(tmp_path):
    start_manifest(tmp_path, command=[], seed=0)
    save_run_config(config_of(), tmp_path)
    assert goal_of(tmp_path) is None


DAMAGES = ({"stages": [{"steps": 1}]}, {"stages": 3}, {"tolerance": "x"}, {"planned_steps": 0.5})


@pytest.mark.parametrize("change", DAMAGES)
def test_a_damaged_word_of_the_tolerance_is_told(tmp_path, change):
    start_manifest(tmp_path, command=[], seed=0)
    known = goal_with(0.1, 0.3, 0.2)
    note(tmp_path, goal=known.as_dict())
    assert goal_of(tmp_path) == known
    note(tmp_path, goal=change)
    with pytest.raises(DataError, match="'goal' is damaged"):
        goal_of(tmp_path)
