"""Samples of a flow and independent points together, on densities whose every integral is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from support.learning import BallTask, Interrupter, a_trainer, config_of, learn

from lidardesign.density.objective.proposals import independent_points, log_proposal
from lidardesign.density.training.learn import draft_note, prepare_training_data
from lidardesign.density.training.sampling import KnownPoints, effective_count_of_mixture, log_constant, mixed
from lidardesign.estimates import Estimate
from lidardesign.samples import Samples
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, -3, -1.5, 0), (0, 0, 0, 3, 1.5, 9))
TARGET = multivariate_normal([0.0, 0.0, 4.0], 0.04)
CONSTANT = math.log(7.5)


def known(density, proposal, count, seed, source):
    """Points drawn from one of two normal densities of azimuth, elevation and range, with both there."""
    generator = np.random.default_rng(seed)
    inner = source.rvs(count, random_state=generator)
    points = np.concatenate([np.zeros((count, 3)), inner], axis=1)
    return KnownPoints(points, density.logpdf(inner), proposal.logpdf(inner) + CONSTANT, TARGET.logpdf(inner))


def shifted(by, variance):
    return multivariate_normal([by, 0.0, 4.0], variance)


# The flow, the independent points, and whether these help.
PAIRS = {
    "the flow misses what they hold": (shifted(0.35, 0.02), shifted(0.0, 0.08), True),
    "both are rough": (shifted(0.2, 0.09), shifted(-0.2, 0.09), True),
    "they are far away": (shifted(0.05, 0.05), shifted(1.2, 0.04), False),
}


@pytest.mark.parametrize(("flow", "other", "_"), PAIRS.values(), ids=PAIRS)
def test_the_constant_of_a_density_is_found_within_its_error(flow, other, _):
    found = [
        log_constant(known(flow, other, 4000, seed, flow), known(flow, other, 3000, seed + 50, other))
        for seed in range(12)
    ]
    away = np.array([(one.value - CONSTANT) / one.error for one in found])
    assert np.abs(away).max() < 5
    assert 0.4 < np.sqrt(np.square(away).mean()) < 2


@pytest.mark.parametrize(("flow", "other", "helps"), PAIRS.values(), ids=PAIRS)
def test_a_mixture_integrates_the_target_and_is_worth_no_less_than_the_flow_alone(flow, other, helps):
    kept, pool = known(flow, other, 6000, 0, flow), known(flow, other, 5000, 1, other)
    pilots = known(flow, other, 2000, 2, flow), known(flow, other, 2000, 3, other)
    samples = Samples(kept.points, kept.log_flow, kept.log_target, SPACE)
    found = mixed(samples, kept, pool, pilots)
    assert bool(found.independent) == helps
    assert found.effective >= found.of_flow
    assert len(found.samples) == len(kept) + found.independent
    weights = np.exp(found.samples.log_weights)
    error = weights.std() / math.sqrt(len(weights))
    # the target is normalised
    assert abs(weights.mean() - 1) < 5 * error + 3 * (found.constant.error or 0)
    mean = np.average(found.samples.points[:, 3], weights=weights)
    assert abs(mean) < 5 * 0.2 / math.sqrt(found.effective)


def test_the_worth_that_pilots_foretell_is_that_of_the_samples():
    flow, other, _ = PAIRS["both are rough"]
    kept, pool = known(flow, other, 6000, 0, flow), known(flow, other, 5000, 1, other)
    pilots = known(flow, other, 6000, 2, flow), known(flow, other, 6000, 3, other)
    foretold = effective_count_of_mixture(*pilots, (len(kept), len(pool)), CONSTANT, SPACE)
    weights = np.exp(np.concatenate([one.log_weights(5 / 11, CONSTANT) for one in (kept, pool)]))
    assert foretold == pytest.approx(weights.sum() ** 2 / np.square(weights).sum(), rel=0.03)


def test_points_that_repeat_count_once():
    flow, other, _ = PAIRS["the flow misses what they hold"]
    kept, pool = known(flow, other, 3000, 0, flow), known(flow, other, 40, 1, other)
    repeated = pool.subset(np.arange(8000) % 40)
    pilots = known(flow, other, 2000, 2, flow), known(flow, other, 2000, 3, other)
    found = mixed(Samples(kept.points, kept.log_flow, kept.log_target, SPACE), kept, repeated, pilots)
    assert found.effective <= found.of_flow + 40


SPACES = {
    "two angles and a range": DesignSpace((0, 0, 0, -0.4, -0.3, 0.2), (0, 0, 0, 0.4, 0.3, 2.5)),
    "resampled": DesignSpace((0, 0, 0, -0.4, 0, 0.2), (0, 0, 0, 0.4, 0, 2.5)),
    "a given range": DesignSpace((0, 0, 0, -0.4, -0.3, 1.0), (0, 0, 0, 0.4, 0.3, 1.0)),
}


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_the_density_of_independent_points_is_known_wherever_they_could_be(space):
    target = prepare_training_data(BallTask(), config_of(space=space)).target
    points, log_density = independent_points(target, 500, np.random.default_rng(0))
    np.testing.assert_allclose(log_proposal(target, points), log_density, atol=1e-9)
    assert not np.isnan(log_proposal(target, space.sample(200, np.random.default_rng(1)))).any()


def test_samples_of_a_run_say_what_they_are_and_are_worth(tmp_path):
    result = learn(BallTask(), config_of(samples=4000, steps=60), tmp_path)
    told = result.samples
    assert told["effective"] >= told["effective_of_flow"]
    assert told["independent"] in (0, 128, 256, 512)
    assert told["log_constant_error_nats"] < 0.2


def test_the_best_average_that_was_measured_is_kept(tmp_path, monkeypatch):
    """Also where learning was interrupted after it, and goes on from a checkpoint."""
    from lidardesign.density.training import trainer as training

    measured = {60: 0.4, 70: 0.2, 80: 0.6, 90: 0.5}
    monkeypatch.setattr(training, "STRETCH", 10)
    trainer = a_trainer(tmp_path)
    weights = {}

    def told(learned, probes, count):
        step = len(weights) * 10 + 60
        weights[step] = {name: value.clone() for name, value in learned.flow.state_dict().items()}
        found = type("Measured", (), {"estimates": {"misplaced": Estimate(measured.get(step, 0.7), 0.01)}})
        return found

    monkeypatch.setattr(training, "measure", told)
    monkeypatch.setattr(training, "least_balancing_steps", lambda _: 10)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(Interrupter(90))
    again = a_trainer(tmp_path)
    again.resume()
    again.train()
    for trained in (trainer, again):
        assert trained.least_misplaced == 0.2
        for name, value in trained.learned().flow.state_dict().items():
            torch.testing.assert_close(value, weights[70][name])


@pytest.mark.parametrize(
    ("measured", "preset", "says"),
    [
        ([(100, 0.30), (200, 0.28), (300, 0.28)], "standard", True),
        ([(100, 0.24), (200, 0.23), (300, 0.10)], "standard", False),
        ([(100, 0.24), (200, 0.23), (300, 0.238)], "fine", True),
        ([(100, 0.30), (200, 0.28), (300, 0.28)], "draft", False),
        ([(100, 0.30), (200, 0.28)], "standard", False),
        ([(300, 0.28), (400, 0.28)], "standard", False),
        ([], "standard", False),
    ],
)
def test_a_preset_that_is_no_better_than_draft_says_so(measured, preset, says):
    note = draft_note([(step, Estimate(value, 0.01)) for step, value in measured], preset)
    assert (note is not None) == says
    assert not says or "draft" in note
