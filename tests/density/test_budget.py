"""Learning that ends when it is good enough, or when its time is over: the same bytes as a run of its steps."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.learning import BallTask, Interrupter, config_of, result_bytes
from support.tables import each_row

from lidardesign.config import save_run_config
from lidardesign.density.learn import learn, make_trainer, prepare_training_data
from lidardesign.density.training import schedule as budget
from lidardesign.density.training import training
from lidardesign.density.training.checkpoint import load_arrays
from lidardesign.density.training.quality import IndependentProbes
from lidardesign.density.training.schedule import StepTimes, TimedProbes, Timekeeper
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.clock import Clock
from lidardesign.run.manifest import note, start_manifest
from lidardesign.run.yaml import load_yaml
from lidardesign.workflow.learning_budget import GOAL, MOST_STEPS, Goal, Learner, checked_goal, resumed_goal

CPU = torch.device("cpu")
STRETCH = 10
# The flow misplaces more when balancing begins, and less after all steps.
REACHABLE = 0.33
EARLY = {"pathwise": 20, "layers": 2}


@pytest.fixture(autouse=True)
def short_stretches(monkeypatch):
    """Measure what is reached every few steps, so that small runs may stop."""
    monkeypatch.setattr(training, "STRETCH", STRETCH)


def learned(run, progress=None, *, resume=False, is_over=None, **settings):
    run.mkdir(exist_ok=True)
    return learn(BallTask(), config_of(**{**EARLY, **settings}), run, progress=progress, resume=resume, is_over=is_over)


def is_over_at(step):
    return lambda trainer: trainer.step >= step


@pytest.fixture(scope="module")
def good_enough(tmp_path_factory):
    """A run that stopped once it was good enough."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(training, "STRETCH", STRETCH)
        run = tmp_path_factory.mktemp("good")
        return run, learned(run, misplaced=REACHABLE)


def test_learning_stops_once_it_is_good_enough_and_measures_at_stretches_only(good_enough):
    run, result = good_enough
    rows = [row for row in load_rows(run) if "misplaced" in row]
    assert result.steps < config_of().learning.steps
    assert [row["step"] for row in rows] == list(range(40, result.steps + 1, STRETCH))
    reached = [row["misplaced"] + training.STANDARD_ERRORS * row["misplaced_error"] for row in rows]
    assert [found <= REACHABLE for found in reached] == [False] * (len(rows) - 1) + [True]
    # samples that know nothing of those that stopped it
    assert result.misplaced < REACHABLE + 4 * (result.error_estimates["misplaced"].error + rows[-1]["misplaced_error"])


def load_rows(run):
    return [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]


def test_a_run_that_stopped_is_the_run_of_the_steps_that_it_reached(good_enough, tmp_path):
    run, result = good_enough
    learned(tmp_path / "plain", steps=result.steps)
    assert result_bytes(tmp_path / "plain") == result_bytes(run)


def test_a_smaller_goal_takes_no_fewer_steps_and_none_takes_all(good_enough, tmp_path):
    steps = [learned(tmp_path / str(goal), misplaced=goal, steps=90).steps for goal in (0.0, 1e-6, 1.0)]
    assert steps == [90, 90, 40]
    assert steps[-1] <= good_enough[1].steps
    assert not any("misplaced" in row for row in load_rows(tmp_path / "0.0"))


@pytest.mark.parametrize("step", [20, "the last"])
def test_a_run_that_stops_is_resumed_to_the_same_bytes(good_enough, tmp_path, step):
    run, straight = good_enough
    last = straight.steps if step == "the last" else step
    with pytest.raises(KeyboardInterrupt):
        learned(tmp_path / "run", Interrupter(last), misplaced=REACHABLE)
    assert learned(tmp_path / "run", resume=True, misplaced=REACHABLE).steps == straight.steps
    assert result_bytes(tmp_path / "run") == result_bytes(run)


def test_a_run_that_was_killed_after_it_stopped_takes_no_further_step(good_enough, tmp_path, monkeypatch):
    shutil.copytree(good_enough[0], tmp_path / "run")
    for name in ("flow.safetensors", "samples.npz"):
        (tmp_path / "run" / name).unlink()
    monkeypatch.setattr(training.Trainer, "_advance", lambda *_: pytest.fail("took a step"))
    assert load_arrays(tmp_path / "run", "checkpoint.safetensors")[1]["stopped"] is True
    learned(tmp_path / "run", resume=True, misplaced=REACHABLE)
    assert result_bytes(tmp_path / "run") == result_bytes(good_enough[0])


def test_time_decides_only_after_as_many_balancing_steps_as_path_wise_ones(tmp_path):
    config = config_of()
    data = prepare_training_data(BallTask(), config)
    assert learn(BallTask(), config, tmp_path, data=data, is_over=lambda _: True).steps == 100


def test_a_run_whose_time_was_over_is_the_run_of_its_steps(tmp_path):
    end = 73
    result = learned(tmp_path / "run", is_over=is_over_at(end), steps=MOST_STEPS)
    plain = learned(tmp_path / "plain", steps=end)
    assert result.steps == plain.steps == end
    assert result_bytes(tmp_path / "run") == result_bytes(tmp_path / "plain")
    (tmp_path / "killed").mkdir()
    with pytest.raises(KeyboardInterrupt):
        learned(tmp_path / "killed", Interrupter(end), is_over=is_over_at(end), steps=MOST_STEPS)
    learned(tmp_path / "killed", resume=True, is_over=is_over_at(end), steps=MOST_STEPS)
    assert result_bytes(tmp_path / "killed") == result_bytes(tmp_path / "plain")


def keeper_for(seconds, elapsed_s=1.0, finishing_s=2.0, **settings):
    """A keeper of a time, with steps that take 0.1 and 0.3 s and an end of some seconds."""
    keeper = Timekeeper(seconds, lambda: elapsed_s, config_of(**settings))
    return keeper, StepTimes(0.1, 0.3, finishing_s, TimedProbes(np.zeros((0, 6)), 1.0, 0.0))


@each_row("pathwise", [0, 30, 60])
def test_too_little_time_is_refused_with_the_least_that_would_do(pathwise):
    keeper, times = keeper_for(5.0, pathwise=pathwise)
    with pytest.raises(ConfigError, match=r"--time-budget.*too short to learn.*\n.*at least \d+ s") as caught:
        keeper.check(times)
    assert caught.value.exit_code == 2
    least = float(caught.value.allowed.split()[2])
    keeper_for(least, pathwise=pathwise)[0].check(times)
    with pytest.raises(ConfigError, match="too short"):
        keeper_for(least - 1, pathwise=pathwise)[0].check(times)


def test_as_many_balancing_steps_are_foreseen_as_fit_before_the_end():
    _, times = keeper_for(1.0)
    for seconds in np.linspace(1.0, 60.0, 20):
        steps = times.balancing_within(seconds, 30)
        assert steps == 0 or times.of(30, steps) <= seconds
        assert times.of(30, steps + 1) > seconds


def test_time_is_over_when_another_step_would_leave_too_little_to_finish(monkeypatch, tmp_path):
    monkeypatch.setattr(budget, "_finishing_s", lambda *_: 4.0)
    trainer = make_trainer(prepare_training_data(BallTask(), config_of()), config_of(), tmp_path, CPU)
    for elapsed_s in np.linspace(0.0, 60.0, 61):
        keeper, times = keeper_for(60.0, elapsed_s)
        keeper.times = times
        left_s = (60.0 - elapsed_s) * (1 - budget.RESERVE)
        assert keeper.is_over(trainer) == (left_s < 4.0 + times.balancing_s)


def test_a_time_budget_writes_the_steps_that_it_took_into_the_configuration(tmp_path, monkeypatch):
    run, plain = tmp_path / "run", tmp_path / "plain"
    for folder in (run, plain):
        folder.mkdir()
        start_manifest(folder, command=[], seed=0)
    goal = Goal(time_budget_s=3600.0)
    begun = goal.applied(config_of(misplaced=0.3))
    save_run_config(begun, run)
    monkeypatch.setattr(Timekeeper, "is_over", lambda self, trainer: trainer.step >= 105)
    result = Learner(BallTask(), run, "cpu", None, Clock()).learn(begun, goal, resume=False)
    kept = load_yaml(run / "config.yaml").mapping["learning"]
    assert result.goal == {"time_budget_s": 3600.0, "steps": 105}
    assert (kept["misplaced"], kept["steps"]) == (0.0, 105)
    learn(BallTask(), config_of(misplaced=kept["misplaced"], steps=kept["steps"]), plain)
    assert result_bytes(run) == result_bytes(plain)


def test_a_goal_sets_what_a_new_run_begins_with():
    config = config_of(misplaced=0.3)
    assert Goal().applied(config) == config
    for goal, misplaced, steps in (
        (Goal(tolerance=0.1), 0.1, 480),
        (Goal(tolerance=0.1, fixed_steps=True), 0.1, 120),
        (Goal(time_budget_s=60.0), 0.0, MOST_STEPS),
    ):
        learning = goal.applied(config).learning
        assert (learning.misplaced, learning.steps) == (misplaced, steps)


@each_row(
    "settings, text, fixed",
    [
        ([], None, False),
        ([], "learning: {batch: 64}", False),
        ([], "learning: {steps: 64}", True),
        (["learning.steps=64"], None, True),
    ],
)
def test_a_tolerance_takes_more_steps_than_a_preset_unless_the_user_set_them(settings, text, fixed, tmp_path):
    file = None if text is None else tmp_path / "settings.yaml"
    if file is not None:
        file.write_text(text, encoding="utf-8")
    assert checked_goal(0.1, None, {"overrides": settings, "config_file": file}).fixed_steps is fixed


def test_too_few_probes_stop_nothing(tmp_path):
    config = config_of(**EARLY, misplaced=1.0, steps=60)
    data = prepare_training_data(BallTask(), config)
    few = IndependentProbes(*(values[:99] for values in vars(data.probes).values()))
    assert learn(BallTask(), config, tmp_path, data=data).steps == 40
    assert learn(BallTask(), config, tmp_path, data=replace(data, probes=few)).steps == 60


def test_timing_steps_and_the_end_leaves_the_trainer_as_it_was(tmp_path):
    config = config_of()
    data = prepare_training_data(BallTask(), config)
    trainer = make_trainer(data, config, tmp_path, CPU)
    before, step = trainer._state_arrays(), trainer.step
    assert budget._seconds_per_step(trainer, trainer.pathwise_steps) > 0
    assert budget._finishing_s(trainer.learned(), budget._timed_probes(data.target, config), config) > 0
    after = trainer._state_arrays()
    assert trainer.step == step
    assert before.keys() == after.keys()
    for key, value in before.items():
        np.testing.assert_array_equal(value, after[key], err_msg=key)


def test_steps_are_timed_on_the_one_thread_that_learning_takes(tmp_path, monkeypatch):
    config, threads, timed = config_of(), [], budget._seconds_per_step

    def counted(*arguments):
        threads.append(torch.get_num_threads())
        return timed(*arguments)

    monkeypatch.setattr(budget, "_seconds_per_step", counted)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        StepTimes.measured(prepare_training_data(BallTask(), config), config, tmp_path, CPU)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert set(threads) == {1}


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
    planned_s = budget._finishing_s(trainer.learned(), budget._timed_probes(data.target, config), config)
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


@each_row("damaged", [{"tolerance": "x"}, {"time_budget_s": []}, {"tolerance": 0.1, "target_misplaced": "much"}])
def test_a_damaged_word_of_the_goal_is_told(tmp_path, damaged):
    start_manifest(tmp_path, command=[], seed=0)
    assert resumed_goal(Goal(), tmp_path).is_none
    note(tmp_path, **{GOAL: {"tolerance": 0.1, "target_misplaced": 0.01, "met": True}})
    assert resumed_goal(Goal(), tmp_path) == Goal(0.1)
    note(tmp_path, **{GOAL: damaged})
    with pytest.raises(DataError, match="'goal' is damaged"):
        resumed_goal(Goal(), tmp_path)
