"""Snapshots of a flow while it learns: where they lie, what they hold, and the same bytes after interruptions."""

from __future__ import annotations

import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.learning import BallTask, config_of
from support.tables import each_row

from lidardesign.config import LearningSettings
from lidardesign.density.learn import learn
from lidardesign.density.training.checkpoint import (
    FOLDER,
    clear_snapshots,
    load_arrays,
    measured_steps,
    snapshot_name,
    snapshot_steps,
    stored_snapshots,
    twin_step,
)
from lidardesign.run.manifest import verify


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run = tmp_path_factory.mktemp("finished")
    learn(BallTask(), config_of(), run)
    return run


@each_row(
    ("steps", "balance", "kept"),
    [
        (1000, 0.5, (500, 609, 625, 734, 750)),
        (290, 0.5, (145, 176, 181, 212, 217)),
        (8, 1.0, (2, 3, 4)),
        (2, 0.5, (1,)),
        (1, 0.5, ()),
    ],
)
def test_snapshots_are_kept_when_balancing_begins_and_twins_at_a_quarter_and_half_of_it(steps, balance, kept):
    assert snapshot_steps(LearningSettings(steps=steps, balance=balance)) == kept


@given(st.integers(1, 5000), st.floats(0, 1), st.floats(0, 1))
def test_rungs_ascend_to_the_last_step_and_twins_lie_between_the_first_rung_and_their_own(steps, balance, anneal):
    settings = LearningSettings(steps=steps, balance=balance, anneal=anneal)
    rungs = measured_steps(settings)
    assert list(rungs) == sorted(set(rungs))
    assert rungs[-1] == steps
    for step in rungs:
        twin = twin_step(settings, step)
        assert twin is None or rungs[0] < twin < step < steps
    assert all(0 < step < steps for step in snapshot_steps(settings))


def test_nothing_is_kept_before_sigma_has_its_final_value(tmp_path):
    learn(BallTask(), config_of(steps=40, balance=0.0, anneal=0.5), tmp_path)
    assert list(stored_snapshots(tmp_path)) == [20, 24, 25, 29, 30]


def test_a_run_lists_its_snapshots_with_their_hashes(finished):
    assert stored_snapshots(finished) == {step: snapshot_name(step) for step in (60, 73, 75, 88, 90)}
    for name in stored_snapshots(finished).values():
        verify(finished, name)


def test_snapshots_hold_the_weights_of_the_flow_on_the_way_to_its_last_ones(finished):
    last, _ = load_arrays(finished, "flow.safetensors")
    early, state = load_arrays(finished, snapshot_name(60))
    late, _ = load_arrays(finished, snapshot_name(90))
    assert state["step"] == 60
    assert early.keys() == last.keys()

    def distance(weights):
        return sum(float(np.square(weights[key] - last[key]).sum()) for key in last if last[key].dtype.kind == "f")

    assert distance(early) > distance(late) > 0


def test_clearing_keeps_earlier_snapshots_and_removes_what_a_killed_process_left(tmp_path):
    learn(BallTask(), config_of(), tmp_path)
    (tmp_path / FOLDER / ".step-000060.safetensors.1.aa.tmp").write_bytes(b"half")
    clear_snapshots(tmp_path, beyond=74)
    assert sorted(os.listdir(tmp_path / FOLDER)) == ["step-000060.safetensors", "step-000073.safetensors"]
    assert list(stored_snapshots(tmp_path)) == [60, 73]
    clear_snapshots(tmp_path)
    assert not os.listdir(tmp_path / FOLDER)
    assert not stored_snapshots(tmp_path)
