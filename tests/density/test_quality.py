"""Effective sample size, KL, log Z, coverage, misplaced share and thinning against closed forms of Gaussians."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from support import references

from lidardesign.density.training.quality import coverage, overlap, quality, worse_of
from lidardesign.density.training.sampling import Thinning, condition_groups
from lidardesign.errors import NumericalError
from lidardesign.samples import Samples
from lidardesign.space import DesignSpace

COUNT = 200_000
LOG_Z = 3.7


def gaussian(x, mean=0.0, spread=1.0):
    return -np.square((x - mean) / spread) / 2 - math.log(spread * math.sqrt(2 * math.pi))


def test_a_shifted_gaussian_has_its_closed_form_figures():
    shift = 0.5
    x = np.random.default_rng(0).normal(size=COUNT)
    found = quality(gaussian(x, 0, 1), gaussian(x, shift, 1) + LOG_Z)
    # E[w] = Z, E[w^2] = Z^2 exp(shift^2), KL = shift^2 / 2
    error = references.STANDARD_ERRORS / math.sqrt(COUNT)
    assert found["log_z"].value == pytest.approx(LOG_Z, abs=error * math.sqrt(math.expm1(shift**2)))
    assert found["kl_nats"].value == pytest.approx(shift**2 / 2, abs=error)
    assert found["ess"].value == pytest.approx(math.exp(-(shift**2)), abs=0.02)


@pytest.mark.parametrize("offset", [-1e6, 1e6])
def test_figures_are_computed_in_log_space(offset):
    x = np.random.default_rng(2).normal(size=1000)
    near = quality(gaussian(x, 0, 1), gaussian(x, 0.3, 1))
    far = quality(gaussian(x, 0, 1), gaussian(x, 0.3, 1) + offset)
    assert far["ess"].value == pytest.approx(near["ess"].value, rel=1e-6)
    assert far["kl_nats"].value == pytest.approx(near["kl_nats"].value, abs=1e-6)
    assert far["log_z"].value - offset == pytest.approx(near["log_z"].value, abs=1e-6)


def test_groups_are_judged_by_themselves_and_averaged():
    log_target = np.concatenate([np.zeros(500), np.full(500, 4.0)])
    groups = np.repeat([0, 1], 500)
    found = quality(np.zeros(1000), log_target, groups)
    assert (found["ess"].value, found["kl_nats"].value, found["log_z"].value) == pytest.approx((1.0, 0.0, 2.0))
    assert quality(np.zeros(1000), log_target)["ess"].value < 0.6


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_weights_that_are_no_numbers_are_an_error_and_no_figure(bad):
    log_target = np.zeros(10)
    log_target[3] = bad
    with pytest.raises(NumericalError, match="1 of 10"):
        quality(np.zeros(10), log_target)


def two_modes(x):
    return np.logaddexp(gaussian(x, -5, 1) + math.log(0.7), gaussian(x, 5, 1) + math.log(0.3)) + LOG_Z


def test_coverage_sees_a_dropped_mode_that_the_ess_cannot():
    generator = np.random.default_rng(3)
    x = generator.normal(-5, 1, COUNT)
    only_one = gaussian(x, -5, 1)
    found = quality(only_one, two_modes(x))
    assert found["ess"].value > 0.99
    proposed = generator.uniform(-12, 12, 50_000)
    covered = coverage(gaussian(proposed, -5, 1), two_modes(proposed), np.zeros(50_000), LOG_Z)
    assert covered.value == pytest.approx(0.7, abs=4 * covered.error)
    assert 0 < covered.error < 0.01
    whole = coverage(two_modes(proposed) - LOG_Z, two_modes(proposed), np.zeros(50_000), LOG_Z)
    assert whole.value == 1.0
    assert whole.error == pytest.approx(0.0, abs=1e-12)


def test_coverage_takes_a_log_z_per_proposal_and_nothing_covers_nothing():
    log_target = np.array([0.0, 10.0])
    assert coverage(np.zeros(2), log_target, log_target, np.array([0.0, 10.0])).value == 1.0
    assert coverage(np.zeros(2), log_target, log_target, 0.0).value == 0.5


def test_standard_errors_of_groups_are_those_of_their_mean():
    generator = np.random.default_rng(6)
    log_weights = generator.normal(0, 0.5, 4000)
    alone = quality(np.zeros(4000), log_weights)
    groups = np.arange(4000) % 4
    grouped = quality(np.zeros(4000), log_weights, groups)
    assert grouped["log_z"].error == pytest.approx(alone["log_z"].error, rel=0.05)
    assert grouped["ess"].error == pytest.approx(alone["ess"].error, rel=0.05)
    # four groups of the same samples know nothing more of each other
    same = quality(np.zeros(4000), np.tile(log_weights[:1000], 4), np.repeat(np.arange(4), 1000))
    one = quality(np.zeros(1000), log_weights[:1000])
    assert same["kl_nats"].error == pytest.approx(one["kl_nats"].error / 2)


FEW = 20_000


def mixture(x, weights, means):
    return np.logaddexp.reduce([math.log(w) + gaussian(x, m) for w, m in zip(weights, means, strict=True)], axis=0)


def sides_of(samples, log_prob, log_target, generator, count=FEW, width=12.0):
    proposals = generator.uniform(-width, width, size=count)
    return dict(
        at_samples=log_target(samples) + LOG_Z - log_prob(samples),
        at_proposals=log_target(proposals) + LOG_Z - log_prob(proposals),
        log_weights=log_target(proposals) + 5.0,
    )


@pytest.mark.parametrize("shift", [0.0, 0.2, 1.0, 4.0])
def test_shifted_gaussians_have_the_closed_forms_of_all_figures(shift):
    generator = np.random.default_rng(3)
    found = overlap(**sides_of(generator.normal(size=FEW), gaussian, lambda x: gaussian(x, shift), generator))
    # E_pi[pi / p] = exp(shift^2), KL(pi || p) = shift^2 / 2
    expected = {
        "misplaced": math.erf(shift / (2 * math.sqrt(2))),
        "ess": math.exp(-(shift**2)),
        "kl_nats": shift**2 / 2,
    }
    for name, value in expected.items():
        # four standard deviations away proposals cannot tell how little is left
        if shift < 4 or name == "misplaced":
            tolerance = references.STANDARD_ERRORS * found[name].error + 1e-3
            assert found[name].value == pytest.approx(value, abs=tolerance)


def own_figures(generator):
    # log weights of a normal distribution with variance 1/4: all moments of the weights are finite
    return quality(np.zeros(2000), generator.normal(0, 0.5, 2000))


def covered(generator):
    x = generator.uniform(-12, 12, 2000)
    return {"coverage": coverage(gaussian(x, -5, 1), two_modes(x), np.zeros(2000), LOG_Z)}


def apart(generator):
    samples = generator.normal(size=500)
    found = overlap(**sides_of(samples, gaussian, lambda x: gaussian(x, 0.7, 1.3), generator, count=700))
    return {"misplaced": found["misplaced"]}


@pytest.mark.parametrize("draw", [own_figures, covered, apart])
def test_standard_errors_are_the_spread_over_other_samples(draw):
    generator = np.random.default_rng(5)
    found = [draw(generator) for _ in range(300)]
    for figure in found[0]:
        spread = np.std([one[figure].value for one in found])
        # a standard deviation of 300 values is known to 4 %
        assert np.mean([one[figure].error for one in found]) == pytest.approx(spread, rel=4 * 0.041), figure


def test_a_starved_mode_is_seen_by_proposals_and_leaked_mass_by_samples_and_the_worse_is_told():
    generator = np.random.default_rng(9)
    samples = generator.normal(6.0, size=FEW)

    def starving(x):
        return mixture(x, (1e-6, 1 - 1e-6), (-6, 6))

    def both(x):
        return mixture(x, (0.01, 0.99), (-6, 6))

    starved = overlap(**sides_of(samples, starving, both, generator))
    own = quality(starving(samples), both(samples))
    # E_pi[pi / p] = 0.01^2 / 1e-6 + 0.99^2, which no sample knows
    assert own["ess"].value > 0.99
    assert starved["ess"].value == pytest.approx(1 / (100 + 0.99**2), rel=0.1)
    assert worse_of(own, starved)["ess"] == starved["ess"]
    samples = np.where(generator.random(FEW) < 0.01, 20.0, 0.0) + generator.normal(size=FEW)

    def leaking(x):
        return mixture(x, (0.99, 0.01), (0, 20))

    leaked = overlap(**sides_of(samples, leaking, gaussian, generator))
    own = quality(leaking(samples), gaussian(samples))
    assert leaked["kl_nats"].value < 0.02
    assert own["kl_nats"].value == pytest.approx(0.01 * 200, rel=0.2)
    assert worse_of(own, leaked)["kl_nats"] == own["kl_nats"]


@pytest.mark.parametrize(("shift", "spread"), [(0.0, 1.0), (0.7, 1.3), (2.0, 0.5)])
def test_thinned_samples_have_the_lesser_of_both_densities(shift, spread):
    x = np.random.default_rng(10).normal(size=COUNT)
    points = np.zeros((COUNT, 6))
    points[:, 5] = x
    samples = Samples(points, gaussian(x), gaussian(x, shift, spread) + LOG_Z, DesignSpace((0,) * 6, (1,) * 6))
    thinning = Thinning.of(samples.log_weights)
    kept = thinning.thinned(samples, torch.Generator().manual_seed(0))
    grid = np.linspace(-12, 12, 100_001)
    lesser = np.minimum(gaussian(grid), gaussian(grid, shift, spread))
    shared = np.trapezoid(np.exp(lesser), grid)  # 1 - TV
    log_prob = thinning.log_prob(gaussian(grid), gaussian(grid, shift, spread) + LOG_Z)
    assert len(kept) / COUNT == pytest.approx(shared, abs=0.01)
    # the threshold is the samples' own estimate of Z
    np.testing.assert_allclose(np.exp(log_prob), np.exp(lesser) / shared, rtol=0.05)
    assert np.trapezoid(np.exp(log_prob), grid) == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(kept.log_prob, thinning.log_prob(gaussian(kept.points[:, 5]), kept.log_target))
    inside = np.abs(kept.points[:, 5]) < 0.5
    density = np.exp(log_prob) * (np.abs(grid) < 0.5)
    assert inside.mean() == pytest.approx(np.trapezoid(density, grid), abs=0.01)
    least = thinning.log_least[0] + thinning.log_share[0]
    assert kept.log_weights.min() == pytest.approx(least, abs=1e-9)
    found = quality(kept.log_prob, kept.log_target)
    assert found["log_z"].value == pytest.approx(LOG_Z, abs=0.05)


def test_along_conditions_every_group_is_thinned_by_its_own_mean_weight_and_stays_as_frequent():
    generator = np.random.default_rng(11)
    points = np.zeros((COUNT, 6))
    points[:, 0], points[:, 5] = generator.uniform(size=COUNT), generator.normal(size=COUNT)
    near, x = points[:, 0] < 0.5, points[:, 5]
    log_target = np.where(near, gaussian(x, 0.7) + LOG_Z, gaussian(x, -1.4) - LOG_Z)
    space = DesignSpace((0,) * 6, (1,) * 6, condition=("x_m",))
    samples = Samples(points, gaussian(x), log_target, space)
    thinning = Thinning.of(samples.log_weights, condition_groups(space, points))
    kept = thinning.thinned(samples, torch.Generator().manual_seed(0))
    assert len(kept) / COUNT == pytest.approx(math.exp(thinning.log_kept), abs=0.02)
    assert (kept.points[:, 0] < 0.5).mean() == pytest.approx(0.5, abs=0.02)
    for here, shift, log_z in ((True, 0.7, LOG_Z), (False, -1.4, -LOG_Z)):
        part = kept.subset((kept.points[:, 0] < 0.5) == here)
        grid = np.linspace(-12, 12, 10_001)
        shared = np.trapezoid(np.exp(np.minimum(gaussian(grid), gaussian(grid, shift))), grid)
        expected = np.minimum(gaussian(part.points[:, 5]), gaussian(part.points[:, 5], shift)) - math.log(shared)
        np.testing.assert_allclose(part.log_prob, expected, atol=0.25)  # groups know their own Z from 1 in 32 samples
        assert np.mean(part.log_prob - expected) == pytest.approx(0.0, abs=0.02)
        assert quality(part.log_prob, part.log_target)["log_z"].value == pytest.approx(log_z, abs=0.05)


@pytest.mark.parametrize("hopeless_nats", [9.0, np.inf])
def test_a_badly_learned_condition_takes_no_samples_from_the_others(hopeless_nats):
    generator = np.random.default_rng(12)
    points = np.zeros((COUNT, 6))
    points[:, 0], points[:, 5] = generator.uniform(size=COUNT), generator.normal(size=COUNT)
    # in one group all but one sample in a hundred are worth next to nothing
    x, groups = points[:, 5], (points[:, 0] * 32).astype(int)
    depth = np.where((groups == 3) & (generator.uniform(size=COUNT) > 0.01), hopeless_nats, 0.0)
    space = DesignSpace((0,) * 6, (1,) * 6, condition=("x_m",))
    samples = Samples(points, gaussian(x), gaussian(x) - depth, space)
    thinning = Thinning.of(samples.log_weights, condition_groups(space, points))
    shares = np.exp(thinning.log_share)
    np.testing.assert_allclose(np.delete(shares, 3), 1.0)
    kept = thinning.thinned(samples, torch.Generator().manual_seed(0))
    assert len(kept) / COUNT == pytest.approx(math.exp(thinning.log_kept), abs=0.02)
    if np.isfinite(hopeless_nats):
        assert shares[3] == pytest.approx(0.25)
        assert (condition_groups(space, kept.points) == 3).mean() == pytest.approx(1 / 32, abs=0.01)


def test_what_the_target_rules_out_is_never_kept():
    log_target = np.where(np.arange(1000) % 2, 0.0, -np.inf)
    samples = Samples(np.zeros((1000, 6)), np.zeros(1000), log_target, DesignSpace((0,) * 6, (1,) * 6))
    kept = Thinning.of(samples.log_weights).thinned(samples, torch.Generator().manual_seed(1))
    assert len(kept) == 500
    np.testing.assert_allclose(kept.log_prob, math.log(2.0))


@pytest.mark.parametrize("at_proposals", [np.inf, 900.0])
def test_densities_without_overlap_are_wholly_apart(at_proposals):
    assert overlap(np.full(100, -900.0), np.full(100, at_proposals), np.zeros(100))["misplaced"].value == 1.0


def test_every_condition_is_normalised_by_itself():
    generator = np.random.default_rng(6)
    samples, proposals = generator.normal(size=FEW), generator.uniform(-8, 8, size=FEW)
    mine, theirs = np.arange(FEW) % 2, np.arange(FEW) % 2
    shift, log_z = np.array([0.0, 1.0]), np.array([2.0, -3.0])
    found = overlap(
        gaussian(samples, shift[mine]) + log_z[mine] - gaussian(samples),
        gaussian(proposals, shift[theirs]) + log_z[theirs] - gaussian(proposals),
        gaussian(proposals, shift[theirs]) + log_z[theirs],
        mine,
        theirs,
    )
    expected = math.erf(1 / (2 * math.sqrt(2))) / 2
    assert found["misplaced"].value == pytest.approx(
        expected, abs=references.STANDARD_ERRORS * found["misplaced"].error
    )


def test_nan_and_targets_that_are_nowhere_are_refused():
    with pytest.raises(NumericalError, match="NaN"):
        overlap(np.array([math.nan, 0.0]), np.zeros(2), np.zeros(2))
    with pytest.raises(NumericalError, match="0 wherever"):
        overlap(np.full(2, -np.inf), np.zeros(2), np.zeros(2))
