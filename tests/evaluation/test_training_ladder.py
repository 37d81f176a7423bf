"""The sweep of training: the density that a run had reached at its snapshots."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.learning import learn
from support.small_runs import shifted

from lidardesign.api import scores as scoring
from lidardesign.api.run import open_run
from lidardesign.config import load_run_config, resolve, save_run_config
from lidardesign.density.objective.proposals import independent_samples
from lidardesign.density.training import trainer as steps
from lidardesign.density.training.learned import load_flow, remeasured, seconds_at
from lidardesign.density.training.trainer import Trainer
from lidardesign.errors import DataError, NumericalError
from lidardesign.evaluation.accuracy import evaluation as accuracy
from lidardesign.evaluation.accuracy import fields, training
from lidardesign.evaluation.accuracy.probes import AccuracyRequest
from lidardesign.evaluation.request import EvaluationRequest
from lidardesign.evaluation.sweep import Accuracy
from lidardesign.run.manifest import start_manifest
from lidardesign.task import load_task, random_generator, scenes_of

SMALL = (
    "learning.batch=128", "learning.layers=1", "learning.hidden=16", "learning.bins=8", "learning.samples=2000",
    "learning.balance_proposals=1024", "learning.coverage_proposals=512", "learning.pathwise=16", "train=6", "test=3",
    "density.sigma_m=0.06",
)  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run that was learned, and has a design."""
    folder = tmp_path_factory.mktemp("runs") / "mine"
    task = load_task("flatland")
    config = resolve(
        task, preset="draft", overrides=[*SMALL, "learning.steps=64", "learning.misplaced=0"], seed=shifted(1)
    )
    folder.mkdir()
    start_manifest(folder, command=[], seed=1)
    save_run_config(config, folder)
    learn(task, config, folder)
    open_run(folder).fit(layout="even", sensors=1, name="one").save()
    return folder


def request_for(run):
    task, config = load_run_config(run)
    train, test = (scenes_of(task, config.task, split, config.seed, config.space) for split in ("train", "test"))
    asked = EvaluationRequest(
        task, config.task, config.space, config.seed, (), [12], train=list(train), test=list(test)
    )
    return AccuracyRequest(config, run, asked, None)


@pytest.fixture(scope="module")
def sweeps(runs):
    return training.steps_sweeps(request_for(runs))


@pytest.mark.parametrize(
    ("sweeps_of", "count"),
    [(fields.visibility_sweeps, 1), (fields.field_sweeps, 0), (training.dtype_sweeps, 1), (training.frames_sweeps, 1)],
)
def test_sweeps_of_a_run_have_errors_that_fall(runs, sweeps_of, count, monkeypatch, own_cache):
    monkeypatch.setattr(fields, "VISIBILITY_PROBES", 2048)
    monkeypatch.setattr(fields, "BODY_PROBES", 256)
    monkeypatch.setattr(training, "DTYPE_BATCHES", 4)
    monkeypatch.setattr(training, "FRAMES_BATCHES", 4)
    found = sweeps_of(request_for(runs))
    assert len(found) == count
    for sweep in found:
        assert sweep.falls
        assert all(measurement.seconds > 0 and measurement.uncertainty >= 0 for measurement in sweep.measurements)
        assert sweep.as_rows()


def test_every_snapshot_and_the_flow_itself_are_measurements_with_errors_and_seconds(sweeps):
    steps = sweeps[0]
    assert steps.knob == "learning.steps"
    assert [measurement.setting for measurement in steps.measurements] == ["16", "32", "64"]
    assert [measurement.default for measurement in steps.measurements] == [False] * 2 + [True]
    assert all(0 < measurement.error < 1 and 0 < measurement.uncertainty < 0.1 for measurement in steps.measurements)
    seconds = [measurement.seconds for measurement in steps.measurements]
    assert seconds == sorted(seconds)
    assert steps.measurements[-1].error < steps.measurements[0].error
    estimates = {name + end for name in ("ess", "kl_nats", "coverage") for end in ("", "_error")}
    assert set(steps.measurements[-1].values) == estimates


def test_errors_repeat_within_their_uncertainty_on_other_samples_and_probes(runs, sweeps):
    request = request_for(runs)
    config, target = request.config, request.target
    probes = independent_samples(target, 8192, random_generator(99, "others"))
    again = remeasured(runs, config, target, probes, count=8192, seed=99)
    for measurement, reached in zip(sweeps[0].measurements, again, strict=True):
        found = reached.estimates["misplaced"]
        assert abs(found.value - measurement.error) < 4 * np.hypot(found.error, measurement.uncertainty)


def test_a_snapshot_of_another_flow_is_refused(runs):
    request = request_for(runs)
    wide = replace(request.config, learning=request.config.learning.model_copy(update={"hidden": 32}))
    with pytest.raises(DataError, match="another flow"):
        load_flow(runs, "flow.safetensors", wide, request.target, 0)


def test_seconds_of_steps_between_rows_of_the_progress_are_interpolated(runs, sweeps):
    seconds = seconds_at(runs)
    assert list(seconds) == [0, 10, 20, 30, 40, 50, 60, 64]
    first, *_, last = (measurement.seconds for measurement in sweeps[0].measurements)
    assert first == pytest.approx(0.4 * seconds[10] + 0.6 * seconds[20])
    assert last == seconds[64]


@pytest.fixture
def fitted(runs, tmp_path):
    """A copy of the run in the current folder."""
    return shutil.copytree(runs, tmp_path / "run")


@pytest.mark.parametrize("name", ["flow.safetensors", "progress.jsonl", "snapshots/step-000032.safetensors"])
def test_accuracy_of_a_damaged_run_is_refused_before_anything_is_evaluated(fitted, lidardesign, name, monkeypatch):
    monkeypatch.setattr(scoring, "score_designs", lambda *_, **__: pytest.fail("was evaluated"))
    (fitted / name).write_bytes(b"{")
    done = lidardesign("evaluate", "run", "--accuracy", "--json")
    assert done.code == 3
    assert name in done.json["error"]["where"]
    (fitted / name).unlink()
    assert "missing" in lidardesign("evaluate", "run", "--accuracy", "--json").json["error"]["message"]


@pytest.mark.parametrize("judged", [("--seed", "7"), ("--set", "train=2"), ("--baseline", "none")])
def test_sweeps_are_those_of_the_scenes_that_were_learned_whatever_designs_are_judged_by(
    fitted, lidardesign, judged, monkeypatch
):
    asked = []
    monkeypatch.setattr(accuracy, "measure_accuracy", lambda request, **_: asked.append(request) or Accuracy([], {}))
    for options in ((), judged):
        assert lidardesign("evaluate", "run", "--rays", "12", "--accuracy", *options).code == 0
    own, other = asked
    assert other.config == own.config
    poses = [[body.poses.tolist() for scene in one.request.train for body in scene.bodies] for one in asked]
    assert poses[0] == poses[1]


def flatland(lidardesign, out, *options):
    small = [word for setting in SMALL for word in ("--set", setting)]
    return lidardesign("learn", "flatland", "--preset", "draft", "--seed", shifted(), "--out", out, *small, *options)


def test_a_tolerance_that_is_missed_exits_1_with_what_was_reached_and_a_usable_run(lidardesign, tmp_path):
    done = flatland(lidardesign, "run", "--set", "learning.steps=8", "--tolerance", "1e-4", "--json")
    assert done.code == 1
    assert done.json["steps"] == 8
    assert "--tolerance" in done.err
    again = lidardesign("learn", "flatland", "--out", "run", "--resume", "--tolerance", "0.3")
    assert again.code == 2
    assert "learning.misplaced = 0.0001, not 0.3" in again.err


def test_a_tolerance_that_is_met_stops_there_and_resuming_changes_nothing(lidardesign, tmp_path, monkeypatch):
    monkeypatch.setattr(steps, "STRETCH", 10)
    done = flatland(lidardesign, "run", "--set", "learning.steps=64", "--tolerance", "0.95", "--json")
    assert done.code == 0
    assert done.json["steps"] == 36  # the first that may be the last
    learning = load_run_config(tmp_path / "run")[1].learning
    assert (learning.misplaced, learning.steps) == (0.95, 64)
    before = (tmp_path / "run" / "flow.safetensors").read_bytes()
    assert lidardesign("learn", "flatland", "--out", "run", "--resume").code == 0
    assert (tmp_path / "run" / "flow.safetensors").read_bytes() == before


def test_a_failure_before_the_first_checkpoint_leaves_nothing_behind(lidardesign, tmp_path, monkeypatch):
    monkeypatch.setattr(Trainer, "_save", lambda *_: (tmp_path / "missing" / "file").read_text())
    done = flatland(lidardesign, "run", "--set", "learning.steps=16")
    assert done.code == 3
    assert not (tmp_path / "run").exists()


def test_a_time_budget_ends_at_the_clock_and_writes_its_steps_into_the_configuration(lidardesign, tmp_path):
    done = flatland(lidardesign, "run", "--time-budget", "1", "--json")
    assert done.code == 0
    learning = load_run_config(tmp_path / "run")[1].learning
    assert (learning.misplaced, learning.steps) == (0.0, done.json["steps"])
    assert done.json["steps"] >= 2 * learning.pathwise_steps
    flatland(lidardesign, "plain", "--set", f"learning.steps={learning.steps}", "--set", "learning.misplaced=0")
    flows = [(tmp_path / run / "flow.safetensors").read_bytes() for run in ("run", "plain")]
    assert flows[0] == flows[1]


def test_a_run_that_ends_by_the_clock_is_resumed_by_one_and_says_so(lidardesign, tmp_path, monkeypatch):
    monkeypatch.setattr("lidardesign.density.training.trainer.PROGRESS_STEPS", 1)
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_report", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        stopped = flatland(lidardesign, "run", "--time-budget", "60")
    assert stopped.code == 130
    assert "--resume --time-budget 60" in stopped.err
    assert lidardesign("learn", "--out", "run", "--resume").code == 2
    assert lidardesign("learn", "--out", "run", "--resume", "--time-budget", "1").code == 0


def test_what_was_scored_is_written_before_accuracy_is_measured(fitted, lidardesign, monkeypatch):
    def interrupted(*_, **__):
        assert "one" in Path("rows.csv").read_text(encoding="utf-8")
        raise NumericalError("interrupted", where="a sweep")

    monkeypatch.setattr(accuracy, "measure_accuracy", interrupted)
    done = lidardesign("evaluate", "run", "--rays", "8", "--accuracy", "--csv", "rows.csv", "--json")
    assert done.code == 5
    assert Path("rows.csv").exists()
