"""Reading a range from a histogram: Poisson tails, the log-matched filter against its likelihood, levels, edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import pdtrc
from scipy.stats import norm
from support.references import first_photon_distribution

from lidardesign.simulate.detector.dead_time import alive_shares, find_corrected
from lidardesign.simulate.detector.kernels import at_least, find_returns

WHOLE = np.ones((1, 2))
SIGMA, HALF = 2.5, 2


def found(counts, *, known=0.0, false_alarm=0.01, matched=True, sigma=SIGMA, half=HALF, ends=WHOLE):
    counts = np.asarray(counts, np.int64)
    offset = np.array([0, len(counts)])
    return find_returns(counts, offset, ends, 1.0, sigma, half, np.array([known]), false_alarm, matched)[0]


def found_corrected(counts, *, matched=True, false_alarm=0.01, pulses, dead, period=1e6):
    counts = np.asarray(counts, np.int64)
    offset, known = np.array([0, len(counts)]), np.array([0.0])
    times = np.array([float(pulses)]), dead, period
    return find_corrected(counts, offset, WHOLE, 1.0, SIGMA, HALF, known, false_alarm, matched, *times)[0]


def pulse(size, centre, photons, sigma=SIGMA):
    edges = np.arange(size + 1)
    return np.round(photons * np.diff(norm.cdf((edges - centre) / sigma))).astype(int)


@pytest.mark.parametrize("mean", [1e-12, 0.3, 7.0, 900.0, 9e4])
def test_tails_agree_with_scipy(mean):
    for extra in (0.5, 1.0, 3.0, 8.0):
        number = math.ceil(mean + extra * math.sqrt(mean) + 1e-9)
        assert at_least(number, mean) == pytest.approx(pdtrc(number - 1, mean), rel=1e-8)


def test_tails_of_very_bright_light_are_normal_and_whole_at_their_edges():
    assert at_least(1e6 + 3000, 1e6) == pytest.approx(pdtrc(1e6 + 2999, 1e6), rel=0.05)
    assert at_least(0, 3.0) == 1
    assert at_least(1, 0.0) == 0
    assert at_least(2, 3.0) == 1


@pytest.mark.parametrize("centre", [12.5, 12.6, 12.9, 13.0, 40.2])
def test_the_matched_filter_finds_a_pulse_anywhere_in_a_bin(centre):
    # rounding to whole photons moves the pulse by about a thousandth of a bin
    assert found(pulse(60, centre, 1e5)) == pytest.approx(centre, abs=0.02)


@pytest.mark.parametrize("centre", [0.5, 1.5, 58.5, 59.5])
def test_pulses_that_the_gate_cuts_are_found_where_they_are(centre):
    """Within a bin: without the likelihood's second term, cut pulses would be taken for ones further inside."""
    counts = pulse(60, centre, 1000) + 2
    assert abs(found(counts) - centre) <= 1.0


def log_likelihood(counts, place, signal, level):
    edges = np.arange(len(counts) + 1)
    expected = signal * np.diff(norm.cdf((edges - place) / SIGMA)) + level
    return np.sum(counts * np.log(expected) - expected)


@pytest.mark.parametrize("photons", [20, 100])
def test_the_matched_filter_agrees_with_the_largest_likelihood(photons):
    generator = np.random.default_rng(photons)
    size, level, off = 60, 0.5, []
    places = np.arange(0.0, size, 0.1)
    for _ in range(15):
        truth = generator.uniform(10, size - 10)
        counts = generator.poisson(photons * np.diff(norm.cdf((np.arange(size + 1) - truth) / SIGMA)) + level)
        best = places[np.argmax([log_likelihood(counts, place, photons, level) for place in places])]
        off.append(found(counts, known=level, false_alarm=1e9) - best)
    # ours knows neither how many photons are signal nor the level: a small share of the error sigma / sqrt(n)
    assert np.sqrt(np.mean(np.square(off))) < 0.25 * SIGMA / math.sqrt(photons)


def test_the_highest_bin_is_the_first_of_equals():
    counts = np.zeros(20, int)
    counts[[7, 11]] = 5
    assert found(counts, matched=False, half=0, sigma=0.0) == 7.5


def test_one_photon_is_a_return_in_darkness_and_none_in_light():
    counts = np.zeros(100, int)
    counts[30] = 1
    assert found(counts) == pytest.approx(30.5)
    assert np.isnan(found(counts, known=1e-3))


@pytest.mark.parametrize("matched", [True, False])
def test_it_takes_as_many_photons_as_background_seldom_brings(matched):
    """bins * P(Poisson(5 b) >= n) <= 0.01 for the 5 bins within the pulse's width."""
    size, level = 200, 3
    needed = next(n for n in range(500) if size * pdtrc(n - 1, 5 * level) <= 0.01)
    for extra, expected in ((-1, False), (0, True)):
        counts = np.full(size, level)
        counts[100] += needed + extra - 5 * level
        assert np.isfinite(found(counts, matched=matched)) is np.bool_(expected)


def test_a_gate_that_is_all_pulse_is_compared_with_the_level_that_is_known():
    counts = np.full(5, 20)
    assert np.isnan(found(counts, known=20.0))
    assert np.isfinite(found(counts, known=1.0))


def test_parts_of_bins_count_as_parts():
    """Even light in a gate whose last bin is heard for a tenth of it."""
    counts = np.append(np.full(40, 10), 1)
    whole = np.array([[1.0, 0.1]])
    assert np.isnan(found(counts, ends=whole))


@pytest.mark.parametrize("matched", [True, False])
def test_any_histogram_gives_a_place_inside_or_none(matched):
    generator = np.random.default_rng(2)
    ways = {"matched": matched, "false_alarm": 1e9}
    for size in (0, 1, 2, 3, 7, 50):
        for brightness in (0.01, 1.0, 1e3, 1e11):
            counts = generator.poisson(brightness, size)
            places = [found(counts, sigma=sigma, half=int(1.18 * sigma), **ways) for sigma in (0.0, 0.4, 3.0, 40.0)]
            for dead, period in ((1.0, 1e3), (1e6, 1e3), (1e12, 60.0)):
                places.append(found_corrected(counts, dead=dead, period=period, pulses=10, **ways))
            for place in places:
                assert np.isnan(place) if counts.sum() == 0 else 0 <= place <= size


class TestCorrected:
    """With a dead time that the detector reckons with."""

    @pytest.mark.parametrize(("dead", "period"), [(0.5, 1e6), (4.0, 1e6), (50.0, 1e6), (50.0, 45.0), (130.0, 45.0)])
    def test_alive_shares_agree_with_a_naive_count_over_pulses(self, dead, period):
        counts = np.random.default_rng(1).poisson(3.0, 40)
        pulses = 10_000.0
        naive = []
        for b in range(40):
            blind = 0
            for back in range(0, 10):
                for other in range(40):
                    age = b + back * period - other
                    # a count blinds what comes after it, in its own pulse or in later ones
                    blind += counts[other] * (0 < age < dead if back == 0 else age < dead)
            naive.append(1 - blind / pulses)
        np.testing.assert_allclose(alive_shares(counts, pulses, dead, period), naive, rtol=1e-12)

    @pytest.mark.parametrize("matched", [True, False])
    @pytest.mark.parametrize("seed", range(5))
    def test_without_blindness_it_agrees_with_the_uncorrected_search(self, matched, seed):
        generator = np.random.default_rng(seed)
        counts = generator.poisson(1.0, 80) + generator.poisson(pulse(80, 40.3, 60))
        plain = found(counts, matched=matched)
        corrected = found_corrected(counts, matched=matched, dead=1e-9, pulses=1e12)
        if matched:
            # its signal is measured around the filter's maximum, not around the fullest bins
            assert corrected == pytest.approx(plain, abs=0.05)
        else:
            assert corrected == plain

    @pytest.mark.parametrize("seed", range(5))
    def test_a_pulse_behind_the_tilt_is_found(self, seed):
        generator = np.random.default_rng(seed)
        arriving = np.full(200, 0.01) + 0.15 * np.diff(norm.cdf((np.arange(201) - 90.2) / SIGMA))
        counts = generator.multinomial(4000, first_photon_distribution(arriving))[:-1]
        assert abs(found_corrected(counts, dead=1e3, pulses=4000) - 90.2) < 4 * SIGMA / math.sqrt(200)

    def test_a_bright_pulse_is_found_where_it_is_and_not_where_its_first_photons_are(self):
        """Two photons a pulse: the first of them comes half a standard deviation early."""
        arriving = 2.0 * np.diff(norm.cdf((np.arange(61) - 30.3) / SIGMA))
        counts = np.round(1e5 * first_photon_distribution(arriving)[:-1]).astype(int)
        assert found(counts) < 30.3 - 0.4 * SIGMA
        assert found_corrected(counts, dead=1e3, pulses=1e5) == pytest.approx(30.3, abs=0.1 * SIGMA)
