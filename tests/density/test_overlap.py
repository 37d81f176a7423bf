"""The misplaced share of a density against closed forms: shifted Gaussians, dropped modes, leaks, conditions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import references

from lidardesign.density.training.quality import OverlapPoints, overlap
from lidardesign.errors import NumericalError

LOG_Z = -2.3
COUNT = 20_000


def gaussian(x, mean=0.0, spread=1.0):
    return -np.square((x - mean) / spread) / 2 - math.log(spread * math.sqrt(2 * math.pi))


def mixture(x, weights, means):
    return np.logaddexp.reduce([math.log(w) + gaussian(x, m) for w, m in zip(weights, means, strict=True)], axis=0)


def sides_of(samples, log_prob, log_target, generator, count=COUNT, width=12.0):
    proposals = generator.uniform(-width, width, size=count)
    return OverlapPoints(
        at_samples=log_target(samples) + LOG_Z - log_prob(samples),
        at_proposals=log_target(proposals) + LOG_Z - log_prob(proposals),
        log_weights=log_target(proposals) + 5.0,
    )


@pytest.mark.parametrize("shift", [0.0, 0.2, 1.0, 4.0])
def test_shifted_gaussians_misplace_what_the_error_function_says(shift):
    generator = np.random.default_rng(3)
    samples = generator.normal(size=COUNT)
    found = overlap(sides_of(samples, gaussian, lambda x: gaussian(x, shift), generator))
    expected = math.erf(shift / (2 * math.sqrt(2)))
    assert found.misplaced == pytest.approx(expected, abs=max(references.STANDARD_ERRORS * found.error, 1e-7))
    assert found.log_z == pytest.approx(LOG_Z, abs=0.15 if shift > 2 else 0.05)


def test_its_standard_error_is_the_scatter_over_other_samples():
    estimates, errors = [], []
    for seed in range(200):
        generator = np.random.default_rng(seed)
        samples = generator.normal(size=500)
        found = overlap(sides_of(samples, gaussian, lambda x: gaussian(x, 0.7, 1.3), generator, count=700))
        estimates.append(found.misplaced)
        errors.append(found.error)
    # the scatter of 200 estimates is known to 5 %
    assert np.mean(errors) == pytest.approx(np.std(estimates), rel=0.2)


def test_a_dropped_mode_is_misplaced_mass_although_no_sample_ever_sees_it():
    generator = np.random.default_rng(4)
    samples = generator.normal(6.0, size=COUNT)
    found = overlap(sides_of(samples, lambda x: gaussian(x, 6), lambda x: mixture(x, (0.3, 0.7), (-6, 6)), generator))
    assert found.misplaced == pytest.approx(0.3, abs=references.STANDARD_ERRORS * found.error)


def test_mass_that_leaked_where_no_proposal_goes_is_misplaced_too():
    generator = np.random.default_rng(5)
    leaked = generator.uniform(size=COUNT) < 0.1
    samples = np.where(leaked, 40.0, 0.0) + generator.normal(size=COUNT)
    sides = sides_of(samples, lambda x: mixture(x, (0.9, 0.1), (0, 40)), gaussian, generator)
    found = overlap(sides)
    assert found.misplaced == pytest.approx(0.1, abs=references.STANDARD_ERRORS * found.error)


def test_densities_without_overlap_are_wholly_apart():
    sides = OverlapPoints(np.full(100, -900.0), np.full(100, np.inf), np.zeros(100))
    assert overlap(sides).misplaced == 1.0
    sides = OverlapPoints(np.full(100, -900.0), np.full(100, 900.0), np.zeros(100))
    assert overlap(sides).misplaced == 1.0


def test_every_condition_is_normalised_by_itself():
    generator = np.random.default_rng(6)
    samples, proposals = generator.normal(size=COUNT), generator.uniform(-8, 8, size=COUNT)
    mine, theirs = np.arange(COUNT) % 2, np.arange(COUNT) % 2
    shift, log_z = np.array([0.0, 1.0]), np.array([2.0, -3.0])
    sides = OverlapPoints(
        gaussian(samples, shift[mine]) + log_z[mine] - gaussian(samples),
        gaussian(proposals, shift[theirs]) + log_z[theirs] - gaussian(proposals),
        gaussian(proposals, shift[theirs]) + log_z[theirs],
        mine,
        theirs,
    )
    found = overlap(sides)
    expected = math.erf(1 / (2 * math.sqrt(2))) / 2
    assert found.misplaced == pytest.approx(expected, abs=references.STANDARD_ERRORS * found.error)
    assert found.log_z == pytest.approx(log_z.mean(), abs=0.05)


def test_nan_and_targets_that_are_nowhere_are_refused():
    with pytest.raises(NumericalError, match="NaN"):
        overlap(OverlapPoints(np.array([math.nan, 0.0]), np.zeros(2), np.zeros(2)))
    with pytest.raises(NumericalError, match="0 at all points"):
        overlap(OverlapPoints(np.full(2, -np.inf), np.zeros(2), np.zeros(2)))
