"""Learning that ends when it is good enough, or when its time is over: the same bytes as a run of its steps."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import pytest
from support.learning import BallTask, Interrupter, config_of, learn, result_bytes

from lidardesign.api.learn import MOST_STEPS
from lidardesign.density.training import trainer as training
from lidardesign.density.training.checkpoint import load_arrays
from lidardesign.density.training.learn import prepare_training_data

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
    steps = [learned(tmp_path / str(goal), misplaced=goal, steps=60).steps for goal in (0.0, 1.0)]
    assert steps == [60, 40]
    assert steps[-1] <= good_enough[1].steps
    assert [row["step"] for row in load_rows(tmp_path / "0.0") if "misplaced" in row][-1] == 60


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
    assert learned(tmp_path, is_over=lambda _: True).steps == 40


def test_a_run_whose_time_was_over_is_the_run_of_its_steps(tmp_path):
    end = 43
    result = learned(tmp_path / "run", is_over=is_over_at(end), steps=MOST_STEPS)
    plain = learned(tmp_path / "plain", steps=end)
    assert result.steps == plain.steps == end
    assert result_bytes(tmp_path / "run") == result_bytes(tmp_path / "plain")
    (tmp_path / "killed").mkdir()
    with pytest.raises(KeyboardInterrupt):
        learned(tmp_path / "killed", Interrupter(end), is_over=is_over_at(end), steps=MOST_STEPS)
    learned(tmp_path / "killed", resume=True, is_over=is_over_at(end), steps=MOST_STEPS)
    assert result_bytes(tmp_path / "killed") == result_bytes(tmp_path / "plain")


def test_too_few_probes_stop_nothing(tmp_path, monkeypatch):
    config = config_of(**EARLY, misplaced=1.0, steps=60)
    data = prepare_training_data(BallTask(), config)
    few = data.probes.subset(slice(99))
    monkeypatch.setattr(
        "lidardesign.density.training.learn.prepare_training_data", lambda *_: replace(data, probes=few)
    )
    assert learn(BallTask(), config, tmp_path).steps == 60
