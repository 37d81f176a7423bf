"""Blindness after a count: the first photon's distribution and naive loops over events."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm
from support.references import STANDARD_ERRORS, first_photon_distribution, naive_counts_with_dead_time
from support.synthetic_light import PULSES, background, counted, counting_detector, no_echoes, single_echoes, windows

from lidardesign.simulate.detector.dead_time import (
    DRAWS_PER_BIN,
    _across_pulses,
    _hit_pulses,
    _within_pulses,
)
from lidardesign.simulate.detector.physics import metres
from lidardesign.simulate.detector.streams import uniform

BIN_S = 1e-9
BIN_M = metres(BIN_S)
RAYS = 400
BINS = 40


def seen(per_bin, effects, *, dead_bins=1e6, rays=RAYS, pulses=PULSES, period_bins=1e7, echo=None, counts=0.0):
    """Counts of rays in even light of so many photons per pulse and bin, shape (N, BINS)."""
    detector = counting_detector(
        rays, pulses=pulses, dead_s=dead_bins * BIN_S, repetition_hz=1 / (period_bins * BIN_S), bin_s=BIN_S
    )
    window_m = windows(rays, 0.0, BINS * BIN_M)
    echoes = no_echoes() if echo is None else single_echoes(np.full(rays, (echo + 0.5) * BIN_M), counts)
    found, _ = counted(window_m, echoes, background(rays, per_bin / BIN_M), detector, {*effects, "quantisation"})
    return found


def even_light(per_bin, **options):
    return seen(per_bin, {"ambient", "pile_up"}, **options)


@pytest.mark.parametrize("per_bin", [0.002, 0.03, 0.3])
def test_the_first_photon_of_a_pulse_follows_its_distribution(per_bin):
    counts = even_light(per_bin).sum(axis=0)
    observed = np.append(counts, RAYS * PULSES - counts.sum())
    expected = RAYS * PULSES * first_photon_distribution([per_bin] * BINS)
    enough = expected > 10
    rest = expected[~enough].sum(), observed[~enough].sum()
    statistic = np.sum((observed - expected)[enough] ** 2 / expected[enough])
    statistic += (rest[1] - rest[0]) ** 2 / rest[0] if rest[0] > 10 else 0.0
    assert chi2.sf(statistic, enough.sum() - 1) > 1e-4


def test_an_echo_is_hidden_by_the_light_before_it():
    per_bin, echo, signal = 0.02, 30, 200.0
    with_echo = seen(per_bin, {"photon_noise", "ambient", "pile_up"}, echo=echo, counts=signal)
    arriving = np.full(BINS, per_bin)
    arriving[echo] += signal / PULSES
    expected = RAYS * PULSES * first_photon_distribution(arriving)[echo]
    assert abs(with_echo[:, echo].sum() - expected) < STANDARD_ERRORS * np.sqrt(expected)


def test_a_gate_that_starts_later_is_not_hidden():
    per_bin, echo, signal, late = 0.05, 30, 200.0, 25
    detector = counting_detector(RAYS, dead_s=1e-3, repetition_hz=10.0, bin_s=BIN_S)
    echoes = single_echoes(np.full(RAYS, (echo + 0.5) * BIN_M), signal)
    peaks = []
    for start in (0, late):
        counts, _ = counted(
            windows(RAYS, start * BIN_M, BINS * BIN_M),
            echoes,
            background(RAYS, per_bin / BIN_M),
            detector,
            {"photon_noise", "ambient", "pile_up", "quantisation"},
        )
        peaks.append(counts[:, echo - start].mean())
    # exp(-0.05) per bin of light before the gate
    assert peaks[1] / peaks[0] == pytest.approx(np.exp(per_bin * late), rel=0.03)


def pulses_of(key, ray, arrived, pulses):
    draws = [b * DRAWS_PER_BIN + k for b, number in enumerate(arrived) for k in range(number)]
    return [min(int(uniform(np.uint64(key), ray, draw) * pulses), pulses - 1) for draw in draws]


@pytest.mark.parametrize(("dead", "period"), [(3.0, 45.0), (30.0, 45.0), (44.0, 45.0), (100.5, 45.0), (1000.0, 45.0)])
def test_dead_times_that_reach_across_pulses_agree_with_a_naive_loop_to_the_photon(dead, period):
    generator = np.random.default_rng(3)
    for ray in range(20):
        arrived = generator.poisson(2.0, BINS)
        found = np.zeros(BINS, np.int64)
        # fewer pulses than photons, and more
        pulses = 50 if ray % 2 else 500
        _across_pulses(arrived, found, pulses, dead, period, np.uint64(5), ray)
        pulse = pulses_of(5, ray, arrived, pulses)
        expected = naive_counts_with_dead_time(pulse, np.repeat(np.arange(BINS), arrived), BINS, dead, period)
        assert np.array_equal(found, expected)


@pytest.mark.parametrize("per_bin", [0.3, 3.0, 60.0])
@pytest.mark.parametrize("dead", [0.4, 1.0, 2.5, 7.0, 100.0])
def test_dead_times_within_pulses_agree_with_a_naive_loop_on_average(dead, per_bin):
    generator, pulses, repeats = np.random.default_rng(4), 50, 150 if per_bin < 10 else 40
    ours, naive = np.zeros((repeats, BINS)), np.zeros((repeats, BINS))
    for ray in range(repeats):
        arrived = generator.poisson(per_bin, BINS)
        found = np.zeros(BINS, np.int64)
        _within_pulses(arrived, found, pulses, dead, np.uint64(6), ray)
        ours[ray] = found
        pulse = generator.integers(pulses, size=arrived.sum())
        naive[ray] = naive_counts_with_dead_time(pulse, np.repeat(np.arange(BINS), arrived), BINS, dead, 1e6)
    spread = np.sqrt((ours.var(axis=0) + naive.var(axis=0)) / repeats)
    off = np.abs(ours.mean(axis=0) - naive.mean(axis=0))
    # 40 bins: the largest of so many differences
    assert (off <= (STANDARD_ERRORS + 0.5) * spread + 1e-9).all()
    assert ours.sum(axis=1).std() == pytest.approx(naive.sum(axis=1).std(), rel=0.4, abs=0.2)


@pytest.mark.parametrize("follow", [_within_pulses, _across_pulses])
def test_a_photon_more_changes_nothing_in_bins_that_its_pulse_does_not_blind(follow):
    arrived = np.random.default_rng(8).poisson(3.0, BINS)
    one_more = arrived.copy()
    one_more[10] += 1
    period = () if follow is _within_pulses else (45.0,)
    counts = []
    for photons in (arrived, one_more):
        counts.append(np.zeros(BINS, np.int64))
        follow(photons, counts[-1], 1000, 5.0, *period, np.uint64(6), 0)
    changed = np.flatnonzero(counts[0] != counts[1])
    assert np.array_equal(changed, [10])


def test_dead_times_that_reach_the_next_pulse_blind_its_start():
    light = 0.05
    apart = even_light(light, dead_bins=60, period_bins=1000)
    close = even_light(light, dead_bins=60, period_bins=61)
    # a count in the pulse before is less than 60 bins ago
    assert close[:, 0].mean() < 0.6 * apart[:, 0].mean()
    assert close.sum() < apart.sum()


@pytest.mark.parametrize(("alive", "pulses"), [(1, 10_000), (7, 10_000), (60, 10_000), (300, 10_000), (5, 40)])
@pytest.mark.parametrize("photons", [33, 80, 400])
def test_the_last_pulses_are_hit_as_often_as_they_should(alive, pulses, photons):
    """Few of many pulses are alive where gates begin brightly: less than one is hit per bin."""
    share = (np.arange(20_000) + 0.5) / 20_000
    mean = np.mean([_hit_pulses(photons, alive, pulses, z) for z in norm.ppf(share)])
    assert mean == pytest.approx(alive * (1 - (1 - 1 / pulses) ** photons), rel=0.01)


@pytest.mark.parametrize(("alive", "pulses", "photons"), [(0, 10, 50), (1, 1, 10**12), (2, 2, 100), (10, 10, 10**12)])
def test_light_that_hits_every_pulse_is_counted_in_every_pulse_that_is_alive(alive, pulses, photons):
    for z in (-3.0, 0.0, 3.0):
        assert _hit_pulses(photons, alive, pulses, z) == alive


def test_endless_light_is_counted_in_a_share_of_the_pulses():
    arrived = np.full(BINS, 100_000)
    found = np.zeros(BINS, np.int64)
    _across_pulses(arrived, found, 1000, 30.0, 45.0, np.uint64(1), 0)
    # every pulse is hit in every bin: one count, 30 bins dead, the second one in bin 30, dead until bin 15 of the next
    assert 0 < found.sum() <= 2 * 1000 + BINS
    assert found.sum() == pytest.approx(1000 * 45 / 30, rel=0.05)


def test_an_echo_that_blinds_one_ray_changes_no_other():
    expected = [0.4999, np.finfo(float).max, 0.4999]
    window_m = windows(3, 0.0, BINS * BIN_M)
    detector = counting_detector(3, bin_s=BIN_S)
    found, _ = counted(window_m, single_echoes(np.full(3, BIN_M), expected), background(3), detector, {"quantisation"})
    assert found.sum(axis=1).tolist() == [0, found[1].sum(), 0]
    assert found[1].sum() > 1e12


def test_a_detector_without_dead_time_counts_everything():
    assert np.array_equal(even_light(0.5, dead_bins=0), seen(0.5, {"ambient"}))
