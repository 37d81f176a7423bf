"""Learning: the same bytes for a seed, also after interruptions; snapshots on the way; damage ends clearly."""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.learning import SPACE, BallTask, Interrupter, a_trainer, config_of, learn, result_bytes

from lidardesign.density.training import learn as learning
from lidardesign.density.training.checkpoint import (
    FOLDER,
    clear_snapshots,
    load_arrays,
    snapshot_name,
    stored_snapshots,
)
from lidardesign.density.training.learn import prepare_training_data
from lidardesign.density.training.sampling import log_density_of
from lidardesign.density.training.trainer import AVERAGING, BETAS, Adam
from lidardesign.errors import ConfigError, DataError
from lidardesign.numerics import HALF_DIGITS
from lidardesign.run.manifest import verify
from lidardesign.samples import Samples, load_samples
from lidardesign.space import DesignSpace


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run = tmp_path_factory.mktemp("finished")
    return run, learn(BallTask(), config_of(), run)


def snapshots(run):
    return {path.name: path.read_bytes() for path in (run / FOLDER).iterdir()}


def test_another_seed_gives_other_bytes(finished, tmp_path):
    learn(BallTask(), config_of(seed=4), tmp_path)
    assert result_bytes(tmp_path)[0] != result_bytes(finished[0])[0]


@pytest.mark.parametrize("step", [10, 50, 110])
def test_a_resumed_run_is_an_uninterrupted_run_bit_for_bit(finished, tmp_path, step):
    with pytest.raises(KeyboardInterrupt):
        learn(BallTask(), config_of(), tmp_path, progress=Interrupter(step))
    assert not (tmp_path / "flow.safetensors").exists()
    result = learn(BallTask(), config_of(), tmp_path, resume=True)
    assert result_bytes(tmp_path) == result_bytes(finished[0])
    assert snapshots(tmp_path) == snapshots(finished[0])
    assert result.steps == 120
    rows = [json.loads(line) for line in (tmp_path / "progress.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == list(range(10, 121, 10))


def test_proposals_on_the_faces_of_the_space_are_inside_the_flows_box(monkeypatch):
    # the space counts what is outside by rounding as inside; the flow's density would be 0 there
    points = np.array([[0, 0, 0, 0.4 + 1e-10, 0, 1.0], [0, 0, 0, 0.1, 0, 0.2 - 1e-10]])
    probes = Samples(points, np.zeros(2), np.zeros(2), SPACE)
    monkeypatch.setattr(learning, "independent_samples", lambda *_: probes)
    pool = prepare_training_data(BallTask(), config_of()).pool
    assert SPACE.contains(points).all()
    assert float(pool.unit.abs().max()) == 1.0


def test_weights_taken_back_to_the_start_forget_the_moments_of_later_steps(tmp_path):
    trainer = a_trainer(tmp_path)
    start = trainer._state_arrays()
    trainer._advance()
    assert len(trainer._state_arrays()) > len(start)
    trainer._restore_arrays(start)
    trainer.generator.set_state(torch.as_tensor(start["generator"]))
    taken_back = trainer._state_arrays()
    assert taken_back.keys() == start.keys()
    for name, value in start.items():
        np.testing.assert_array_equal(taken_back[name], value)


@pytest.mark.filterwarnings("ignore:for .* copying from a non-meta parameter")
def test_all_of_the_optimisers_state_comes_back_on_the_device_of_its_parameter(tmp_path):
    trainer = a_trainer(tmp_path)
    trainer._advance()
    arrays = trainer._state_arrays()
    # no values, but a device that is not the CPU on every computer
    trainer.flow.to("meta")
    trainer.optimiser.state.clear()
    trainer._restore_arrays(arrays)
    kept = [value for state in trainer.optimiser.state.values() for value in state.values()]
    assert kept
    assert {value.device.type for value in kept} == {"meta"}


def test_resuming_a_finished_run_changes_nothing(finished, tmp_path):
    run = shutil.copytree(finished[0], tmp_path / "run")
    learn(BallTask(), config_of(), run, resume=True)
    assert result_bytes(run) == result_bytes(finished[0])


def test_the_result_has_sensible_figures_and_files(finished):
    run, result = finished
    assert 0 <= result.coverage <= 1
    assert math.isfinite(result.log_z)
    samples = load_samples(run)
    assert 0 < len(samples) <= 2000
    assert SPACE.contains(samples.points).all()
    # the worse of what samples and independent points see
    assert result.ess <= samples.effective_sample_size * (1 + 1e-9)
    assert samples.log_prob.dtype == samples.log_target.dtype == np.float64
    assert (samples.points[:, [0, 1, 2, 4]] == 0).all()


def test_progress_rows_are_valid_and_complete(finished):
    rows = [json.loads(line) for line in (finished[0] / "progress.jsonl").read_text().splitlines()]
    for row in rows:
        assert set(row) >= {"step", "loss", "ess", "sigma_m", "rate", "skipped", "seconds"}
        assert 0 < row["ess"] <= 1
    sigmas = [row["sigma_m"] for row in rows]
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[-1] == pytest.approx(0.05)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_samples_carry_the_density_that_the_flow_has_there(tmp_path, monkeypatch, dtype):
    kept = {}
    measure = learning.measure

    def keep(flow, *rest):
        kept["flow"], kept["measured"] = flow, measure(flow, *rest)
        return kept["measured"]

    monkeypatch.setattr(learning, "measure", keep)
    learn(BallTask(), config_of(dtype=dtype), tmp_path)
    samples = kept["measured"].samples.subset(np.arange(500))
    again = log_density_of(kept["flow"], samples.points)
    thinned = kept["measured"].thinning.log_prob(again, samples.log_target)
    np.testing.assert_allclose(thinned, samples.log_prob, atol=1e-6)
    outside = samples.points + np.array([0, 0, 0, 0, 0, 5.0])
    assert (log_density_of(kept["flow"], outside) == -np.inf).all()


def test_a_conditioned_dimension_stays_uniform(tmp_path):
    space = DesignSpace((-0.3, 0, 0, -0.4, 0, 0.2), (0.3, 0, 0, 0.4, 0, 2.5), condition=("x_m",))
    result = learn(BallTask(), config_of(space), tmp_path)
    x = load_samples(tmp_path).points[:, 0]
    counts, each = np.histogram(x, bins=10, range=(-0.3, 0.3))[0], len(x) / 10
    assert np.abs(counts - each).max() < 4 * math.sqrt(each)
    assert 0 < result.ess <= 1
    assert result.coverage > 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_cuda_where_there_is_none_and_unknown_devices_are_config_errors(tmp_path):
    for device in ("cuda", "tpu"):
        with pytest.raises(ConfigError, match="--device"):
            learn(BallTask(), config_of(), tmp_path, device=device)


def test_a_task_without_scenes_is_a_data_error(tmp_path):
    class Empty(BallTask):
        def scenes(self, config, split, seed):
            return []

    with pytest.raises(DataError, match="no training scenes"):
        learn(Empty(), config_of(), tmp_path)


def test_spaces_that_see_nothing_or_have_nothing_to_learn_are_refused(tmp_path):
    away = replace(SPACE, low=(0, 0, 0, 2.0, 0, 0.2), high=(0, 0, 0, 3.0, 0, 2.5))
    with pytest.raises(DataError, match="no ray of the design space reaches"):
        learn(BallTask(), config_of(away), tmp_path)
    fixed = replace(SPACE, low=(0, 0, 0, 0, 0, 1.0), high=(0, 0, 0, 0, 0, 1.0))
    with pytest.raises(ConfigError, match="every dimension"):
        learn(BallTask(), config_of(fixed), tmp_path)


class PlainAdam:
    """Algorithm 1 of Kingma and Ba 2015 for one weight, in float64."""

    def __init__(self, weight):
        self.weight, self.count, self.mean, self.square = weight.copy(), 0, 0.0, 0.0

    def step(self, gradient, rate):
        self.count += 1
        self.mean = BETAS[0] * self.mean + (1 - BETAS[0]) * gradient
        self.square = BETAS[1] * self.square + (1 - BETAS[1]) * gradient**2
        mean, square = self.mean / (1 - BETAS[0] ** self.count), self.square / (1 - BETAS[1] ** self.count)
        self.weight -= rate * mean / (np.sqrt(square) + HALF_DIGITS)


@pytest.mark.parametrize(("dtype", "within"), [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_steps_of_adam_are_those_of_the_paper_with_rates_that_change_and_weights_that_wait(dtype, within):
    generator = np.random.default_rng(0)
    twins = [PlainAdam(generator.normal(size=shape)) for shape in ((3, 2), (4,), (1,))]
    weights = [torch.nn.Parameter(torch.as_tensor(twin.weight, dtype=dtype)) for twin in twins]
    optimiser = Adam(weights, 0.1)
    for turn in range(12):
        optimiser.clear()
        assert all(weight.grad is None for weight in weights)
        optimiser.rate = 0.1 / (1 + turn)
        for index, (twin, weight) in enumerate(zip(twins, weights, strict=True)):
            if index == 2 or (index == 1 and turn % 3 == 0):
                continue  # the last never has a gradient
            gradient = generator.normal(size=twin.weight.shape) * 10.0 ** generator.integers(-3, 4)
            weight.grad = torch.as_tensor(gradient, dtype=dtype)
            twin.step(gradient, optimiser.rate)
        optimiser.step()
    for twin, weight in zip(twins, weights, strict=True):
        np.testing.assert_allclose(weight.detach().numpy(), twin.weight, rtol=within, atol=within)
    assert [weight in optimiser.state for weight in weights] == [True, True, False]


def moved(trainer, balanced_steps, weights):
    """Let the average follow a flow that is at these weights after so many balancing steps."""
    trainer.step = trainer.settings.pathwise_steps + balanced_steps
    with torch.no_grad():
        for parameter, value in zip(trainer.flow.parameters(), weights, strict=True):
            parameter.copy_(value)
    trainer._average()
    return [parameter.detach().clone() for parameter in trainer.average.parameters()]


def like(trainer, generator):
    return [torch.randn(parameter.shape, generator=generator).double() for parameter in trainer.flow.parameters()]


def test_the_average_is_the_flow_until_balancing_begins_and_after_its_first_step(tmp_path):
    trainer, generator = a_trainer(tmp_path), torch.Generator().manual_seed(0)
    for step in range(-trainer.settings.pathwise_steps + 1, 2):
        weights = [value.float() for value in like(trainer, generator)]
        for found, expected in zip(moved(trainer, step, weights), weights, strict=True):
            assert torch.equal(found, expected)


def test_the_average_is_the_mean_whose_weights_rise_with_a_power_of_the_step(tmp_path):
    trainer, generator, path = a_trainer(tmp_path), torch.Generator().manual_seed(0), []
    trainer.flow.double()
    trainer.average.double()
    for done in range(1, 41):
        path.append(like(trainer, generator))
        found = moved(trainer, done, path[-1])
        # j (j + 1) ... (j + a - 1), about j^a
        shares = np.array([math.comb(j + AVERAGING - 1, AVERAGING) for j in range(1, done + 1)], float)
        for index, value in enumerate(found):
            mean = np.tensordot(shares / shares.sum(), np.stack([weights[index].numpy() for weights in path]), 1)
            np.testing.assert_allclose(value.numpy(), mean, rtol=1e-12, atol=1e-13)


def test_what_is_learned_is_the_average(finished):
    arrays, learned = (load_arrays(finished[0], f"{name}.safetensors")[0] for name in ("checkpoint", "flow"))
    for name, value in learned.items():
        np.testing.assert_array_equal(value, arrays[f"average.{name}"].astype(value.dtype))
    assert any((arrays[f"flow.{name}"] != arrays[f"average.{name}"]).any() for name in learned)


def test_a_run_lists_its_snapshots_with_their_hashes(finished):
    run, _ = finished
    assert stored_snapshots(run) == {step: snapshot_name(step) for step in (50, 100)}
    for name in stored_snapshots(run).values():
        verify(run, name)


def test_clearing_keeps_earlier_snapshots(finished, tmp_path):
    run = shutil.copytree(finished[0], tmp_path / "run")
    clear_snapshots(run, beyond=99)
    assert os.listdir(run / FOLDER) == ["step-000050.safetensors"]
    assert list(stored_snapshots(run)) == [50]
    clear_snapshots(run)
    assert not os.listdir(run / FOLDER)
    assert not stored_snapshots(run)
