"""Learning to a tolerance: stages, when they end, and the same bytes as a run that was asked for the last one."""

from __future__ import annotations

import pytest
from support.learning import BallTask, Interrupter, config_of, result_bytes

from lidardesign.config import save_run_config
from lidardesign.density.learn import learn, prepare_training_data
from lidardesign.density.training.schedule import (
    Stage,
    ToleranceGoal,
    goal_of,
    learn_to_tolerance,
    stage_steps,
    with_steps,
)
from lidardesign.errors import DataError
from lidardesign.run.manifest import note, read_manifest, start_manifest, verify
from lidardesign.run.yaml import load_yaml

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
