"""Several ranks learn what one process learns, to rounding; a lost one ends all, and the last checkpoint continues."""

from __future__ import annotations

import signal
import time

import numpy as np
import pytest
import torch
import typer
from hypothesis import given
from hypothesis import strategies as st
from parallel_cases import CASES, SETTINGS, SPACE, STEPS, TRAINED, everything
from ranks import finished, start_ranks

from lidardesign.cli.ranks import refuse_ranks
from lidardesign.density.learn import own_device
from lidardesign.density.rank_processes import _reached, join_ranks
from lidardesign.density.ranks import ALONE, Ranks
from lidardesign.density.target.ranks import _shared
from lidardesign.density.target.target import build_target
from lidardesign.errors import ConfigError, LostRankError
from lidardesign.scene import Body, Box, Scene, Sphere, rigid

RANKS = 2
# Sums in another order: float64 rounds at 1e-16 and float32 at 6e-8, and ten steps of Adam carry that on.
ROUNDING = {"float64": 1e-9, "float32": 2e-3}


@given(st.integers(0, 1000), st.integers(1, 40))
def test_every_row_belongs_to_one_rank_and_shares_differ_by_one_at_most(count, size):
    parts = [np.arange(count)[Ranks(rank, size).rows_of(count)] for rank in range(size)]
    np.testing.assert_array_equal(np.concatenate(parts), np.arange(count))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_one_process_alone_does_everything_itself():
    rows = np.arange(5.0)
    assert ALONE.first
    assert ALONE.gather(rows) is rows
    assert ALONE.part(rows) is rows
    assert ALONE.sum(rows) is rows
    assert ALONE.mean(rows) == 2.0
    assert ALONE.mean(rows[:0]) == 0.0
    assert join_ranks({}) is ALONE
    assert join_ranks({"WORLD_SIZE": "1"}) is ALONE


UNLIKELY = (
    {"WORLD_SIZE": "many"}, {"WORLD_SIZE": "0"}, {"WORLD_SIZE": "2", "RANK": "-1"}, {"WORLD_SIZE": "2", "RANK": "2"},
    {"WORLD_SIZE": "2", "RANK": "0", "MASTER_PORT": "door"}, {"WORLD_SIZE": "2", "RANK": "0", "MASTER_PORT": "65536"},
)  # fmt: skip


@pytest.mark.parametrize("environment", UNLIKELY)
def test_an_environment_that_no_launcher_makes_is_refused(environment):
    with pytest.raises(ConfigError, match="environment variable"):
        join_ranks(environment)


WAITING = """
from lidardesign.density.rank_processes import join_ranks
print("waits", flush=True)
join_ranks()
"""


def test_a_rank_whose_others_never_start_can_be_interrupted():
    (rank,) = start_ranks(1, "-c", WAITING, WORLD_SIZE="2")
    assert rank.stdout.readline() == "waits\n"
    # it is about to call into torch, or has
    time.sleep(1.0)
    rank.send_signal(signal.SIGINT)
    ((code, _, err),) = finished([rank])
    assert code in (-signal.SIGINT, 128 + signal.SIGINT)
    assert "KeyboardInterrupt" in err


@pytest.fixture(scope="module")
def alone():
    return everything(ALONE)


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranks")
    ended = finished(start_ranks(RANKS, "parallel_cases.py", str(folder)))
    assert [status for status, _, _ in ended] == [0] * RANKS, "\n".join(err for _, _, err in ended)
    return [dict(np.load(folder / f"rank-{rank}.npz")) for rank in range(RANKS)]


def apart(one, other):
    """The largest difference beside the largest value."""
    return np.abs(one - other).max() / np.abs(one).max()


@pytest.mark.parametrize("case", CASES)
def test_targets_that_ranks_share_are_those_of_one_process(alone, together, case):
    names = [name for name in alone if name.startswith(case) and "float" not in name]
    assert len(names) == 14
    for name in names:
        for rank in together:
            assert apart(alone[name], rank[name]) < ROUNDING["float64"], name


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("case", TRAINED)
def test_gradients_of_two_ranks_are_those_of_one_over_ten_steps(alone, together, case, dtype):
    for step in range(STEPS):
        name = f"{case} {dtype} step {step}"
        assert np.isfinite(alone[name]).all()
        assert apart(alone[name], together[0][name]) < ROUNDING[dtype], name
        np.testing.assert_array_equal(together[0][name], together[1][name])


def test_collectives_give_the_same_on_every_rank(together):
    for found in together:
        np.testing.assert_array_equal(found["gather"], [0, 10, 11])
        assert (found["sum"], found["max"], found["mean"]) == (10, 10, 7)
        assert found["share"].tobytes() == b"first"
        np.testing.assert_array_equal(found["gradients"], [1, 1])
        assert np.isnan(found["invalid"]).all()
        for case in ("frames", "meshes"):
            assert "design points are not finite" in str(found[f"{case} not finite"])
        assert "rank 1 has other scenes than rank 0" in str(found["disagreement"])


def test_commands_that_know_of_no_ranks_refuse_to_run_many_times_at_once(monkeypatch):
    refuse_ranks("fit")
    for name, value in {"TORCHELASTIC_RUN_ID": "none", "WORLD_SIZE": "2", "RANK": "0"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError, match="fit does not run on several ranks"):
        refuse_ranks("fit")
    monkeypatch.setenv("RANK", "1")  # the first rank has said it
    with pytest.raises(typer.Exit):
        refuse_ranks("fit")
    monkeypatch.setenv("WORLD_SIZE", "1")
    refuse_ranks("fit")


@pytest.mark.parametrize(("local_rank", "seen"), [(0, "cuda:0"), (1, "cuda:1")])
def test_every_rank_takes_a_gpu_of_its_own_and_the_cpu_is_everyones(monkeypatch, local_rank, seen):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    ranks = Ranks(local_rank, 3, local_rank)
    assert str(own_device(torch.device("cuda"), ranks)) == seen
    assert own_device(torch.device("cpu"), ranks) == torch.device("cpu")
    with pytest.raises(ConfigError, match="rank 2 has no GPU of its own"):
        own_device(torch.device("cuda"), Ranks(2, 3, 2))


@pytest.mark.parametrize("owned", [1, 0])
def test_a_scene_that_a_rank_only_carries_does_not_count_in_refining(owned):
    plate = Body(Box((0.002, 0.5, 0.5)), role="occluder", poses=rigid(translation_m=(0.7, 0, 0)))
    scenes = (Scene((Body(Sphere(0.3), role="target", poses=rigid(translation_m=(1.5, 0, 0))), plate)),)
    part = build_target(scenes, SPACE, SETTINGS.model_copy(update={"quadrature_points": 8}), "quadrature")
    target = _shared(part, scenes, np.arange(owned), np.zeros(owned), owned, ALONE)
    points = SPACE.sample(500, np.random.default_rng(0))
    assert bool(target.refined(points)[1]) == bool(owned)


@pytest.mark.parametrize("error", [TimeoutError(), RuntimeError("[gloo.cc:1] Connection closed. And more\nlines")])
def test_a_lost_rank_is_told_of_whatever_the_error_says(error):
    def lost():
        raise error

    with pytest.raises(LostRankError, match="another rank ended or does not answer") as caught:
        _reached(lost)
    assert "\n" not in caught.value.message
