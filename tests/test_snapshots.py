"""Snapshots of a flow while it learns: where they lie, what they hold, and the same bytes after interruptions."""

from __future__ import annotations

import numpy as np
import pytest
from test_learn import BallTask, Interrupter, config_of

from lidardesign.density.learn import learn
from lidardesign.density.snapshots import FOLDER, clear_snapshots, kept_snapshots, snapshot_name, snapshot_steps
from lidardesign.run.checkpoint import load_arrays
from lidardesign.run.manifest import verify


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run = tmp_path_factory.mktemp("finished")
    learn(BallTask(), config_of(), run)
    return run


def contents(run):
    return {path.name: path.read_bytes() for path in (run / FOLDER).iterdir()}


@pytest.mark.parametrize(
    ("first", "steps", "kept"),
    [(500, 1000, (500, 562, 625, 750)), (145, 290, (145, 163, 181, 217)), (0, 8, (1, 2, 4)), (1, 2, (1,)), (1, 1, ())],
)
def test_snapshots_are_kept_when_the_last_phase_begins_and_at_an_eighth_a_quarter_and_half_of_it(first, steps, kept):
    assert snapshot_steps(first, steps) == kept


def test_nothing_is_kept_before_sigma_has_its_final_value(tmp_path):
    learn(BallTask(), config_of(steps=40, balance=0.0, anneal=0.5), tmp_path)
    assert list(kept_snapshots(tmp_path)) == [20, 22, 25, 30]


def test_a_run_lists_its_snapshots_with_their_hashes(finished):
    assert kept_snapshots(finished) == {step: snapshot_name(step) for step in (60, 67, 75, 90)}
    for name in kept_snapshots(finished).values():
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


@pytest.mark.parametrize("step", [70, 110])
def test_a_resumed_run_keeps_the_same_snapshots_bit_for_bit(finished, tmp_path, step):
    with pytest.raises(KeyboardInterrupt):
        learn(BallTask(), config_of(), tmp_path, progress=Interrupter(step))
    learn(BallTask(), config_of(), tmp_path, resume=True)
    assert contents(tmp_path) == contents(finished)


def test_clearing_keeps_earlier_snapshots_and_removes_what_a_killed_process_left(tmp_path):
    learn(BallTask(), config_of(), tmp_path)
    (tmp_path / FOLDER / ".step-000060.safetensors.1.aa.tmp").write_bytes(b"half")
    clear_snapshots(tmp_path, beyond=70)
    assert sorted(contents(tmp_path)) == ["step-000060.safetensors", "step-000067.safetensors"]
    assert list(kept_snapshots(tmp_path)) == [60, 67]
    clear_snapshots(tmp_path)
    assert not contents(tmp_path)
    assert not kept_snapshots(tmp_path)
