"""Counting photons and reading ranges from them: closed forms, errors, false alarms, streams of random numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2
from support.references import STANDARD_ERRORS
from support.synthetic_light import (
    PHOTON_EFFECTS,
    PULSES,
    background,
    counted,
    counting_detector,
    detected,
    no_echoes,
    single_echoes,
    windows,
)

from lidardesign.errors import ConfigError
from lidardesign.simulate.detection import PHOTONS_ONE_BY_ONE
from lidardesign.simulate.detector.light import Background, Echoes
from lidardesign.simulate.detector.physics import FWHM_PER_SIGMA, Detector, Photons, metres

RAYS = 4000
SIGMA_S = 50e-12
SIGMA_M = metres(SIGMA_S)
BIN_S = 100e-12
BIN_M = metres(BIN_S)
NO_LIGHT = background(RAYS)
GATE = windows(RAYS, 1.0, 3.0)
# off the middle of a bin and off its edges
PATHS = 2.0 + np.random.default_rng(0).uniform(0, BIN_M, RAYS)


def total_counts(expected, effects, **timing):
    timing = {"pulse_sigma_s": SIGMA_S, "bin_s": BIN_S, **timing}
    detector = counting_detector(RAYS, **timing)
    counts, _ = counted(GATE, single_echoes(PATHS, expected), NO_LIGHT, detector, effects)
    return counts


@pytest.mark.parametrize("expected", [0.2, 40.0, PHOTONS_ONE_BY_ONE - 1, PHOTONS_ONE_BY_ONE + 1, 1e5])
def test_counts_are_poisson_with_the_expected_mean(expected):
    totals = total_counts(expected, {"photon_noise", "quantisation"}).sum(axis=1)
    error = np.sqrt(expected / RAYS)
    assert abs(totals.mean() - expected) < STANDARD_ERRORS * error
    # the variance of a sample variance of Poisson counts: (2 m^2 + m) / N
    assert abs(totals.var() - expected) < STANDARD_ERRORS * np.sqrt((2 * expected**2 + expected) / RAYS)


@pytest.mark.parametrize("expected", [0.2, 3.4, 40.0, 700.3])
def test_without_photon_noise_every_ray_gets_the_rounded_expectation(expected):
    assert (total_counts(expected, {"quantisation"}).sum(axis=1) == round(expected)).all()


@pytest.mark.parametrize("effects", [{"photon_noise"}, {"photon_noise", "jitter"}, {"jitter"}, set()])
def test_photon_by_photon_and_bin_by_bin_give_the_same_histogram(effects):
    """On average over rays whose echoes lie anywhere in a bin, either way of counting has the pulse's shape."""
    timing = {"jitter_sigma_s": 80e-12}
    shapes = []
    for expected in (PHOTONS_ONE_BY_ONE - 1, PHOTONS_ONE_BY_ONE + 1):
        mean = total_counts(expected, {*effects, "quantisation"}, **timing).mean(axis=0)
        shapes.append(mean / expected)
    # without noise, rounding to whole photons is off by half a photon in a ray's bin at most
    error = np.sqrt(2 * shapes[0] / (PHOTONS_ONE_BY_ONE * RAYS)) + 0.5 / PHOTONS_ONE_BY_ONE / np.sqrt(RAYS)
    assert (np.abs(shapes[0] - shapes[1]) <= (STANDARD_ERRORS + 0.5) * error).all()


@pytest.mark.parametrize("expected", [300.0, 3000.0])
def test_photons_have_the_pulse_s_shape_and_the_jitter_s(expected):
    detector = counting_detector(RAYS, pulse_sigma_s=SIGMA_S, jitter_sigma_s=2 * SIGMA_S, bin_s=SIGMA_S)
    echoes = single_echoes(np.full(RAYS, 2.0), expected)
    counts, bins = counted(GATE, echoes, NO_LIGHT, detector, {"photon_noise", "jitter", "quantisation"})
    middles = bins.first_m[0] + bins.width_m * (np.arange(counts.shape[1]) + 0.5) - 2.0
    total = counts.sum()
    mean = (counts.sum(axis=0) * middles).sum() / total
    variance = (counts.sum(axis=0) * middles**2).sum() / total
    # Sheppard: bins add width^2 / 12
    expected_variance = 5 * SIGMA_M**2 + bins.width_m**2 / 12
    assert abs(mean) < STANDARD_ERRORS * np.sqrt(expected_variance / total)
    assert abs(variance / expected_variance - 1) < STANDARD_ERRORS * np.sqrt(2 / total)


def ambient_counts(rays, start, end, per_metre, bin_s=BIN_S, effects=("ambient", "quantisation")):
    detector = counting_detector(rays, bin_s=bin_s)
    return counted(windows(rays, start, end), no_echoes(), background(rays, per_metre), detector, effects)


@pytest.mark.parametrize("width", [0.03, 0.3, 1.5])
@pytest.mark.parametrize("per_metre", [1e-4, 2e-2, 5.0])
def test_ambient_counts_are_linear_in_the_gate(width, per_metre):
    rays = 1000
    counts, _ = ambient_counts(rays, 1.0, 1.0 + width, per_metre)
    expected = per_metre * width * PULSES
    totals = counts.sum(axis=1)
    assert abs(totals.mean() - expected) < STANDARD_ERRORS * np.sqrt(expected / rays)
    assert abs(totals.var() - expected) < STANDARD_ERRORS * np.sqrt((2 * expected**2 + expected) / rays)


@pytest.mark.parametrize("per_metre", [2e-3, 5.0])
def test_ambient_counts_are_linear_in_the_bin_also_in_the_part_of_the_last_one(per_metre):
    rays, width = 2000, 10.25 * BIN_M
    counts, bins = ambient_counts(rays, 1.0, 1.0 + width, per_metre)
    assert counts.shape[1] == 11
    expected = np.full(11, per_metre * PULSES * bins.width_m)
    expected[-1] *= 0.25
    statistic = np.sum((counts.sum(axis=0) - rays * expected) ** 2 / (rays * expected))
    assert chi2.sf(statistic, 11) > 1e-4


def test_haze_falls_into_its_own_cells():
    rays = 500
    edges = np.tile([1.0, 1.2, 1.2, 3.0], (rays, 1))
    haze = np.tile([0.03, 5.0, 0.2], (rays, 1))
    detector = counting_detector(rays, bin_s=2 * 0.1 / 299_792_458.0)
    light = Background(np.zeros(rays), edges, haze)
    counts, _ = counted(windows(rays, 1.0, 3.0), no_echoes(), light, detector, {"atmosphere", "quantisation"})
    sums = counts.sum(axis=0)
    expected = rays * PULSES * np.concatenate([[0.015] * 2, [0.2 / 18] * 18])
    # an edge of a cell at an edge of a bin goes to either by rounding
    assert abs(sums[:2].sum() - expected[:2].sum()) < STANDARD_ERRORS * np.sqrt(expected[:2].sum()) + sums[2] * 1e-6
    assert abs(sums.sum() - expected.sum()) < STANDARD_ERRORS * np.sqrt(expected.sum())


def errors(effects, expected, estimator, paths=PATHS, **timing):
    rays = len(paths)
    detector = counting_detector(rays, estimator=estimator, **timing)
    found = detected(windows(rays, 1.0, 3.0), single_echoes(paths, expected), background(rays), detector, effects)
    assert (found.body == 0).all()
    return found.path_m - paths


@pytest.mark.parametrize("expected", [20, 100, 2000])
def test_the_matched_filter_reaches_the_bound_of_timing(expected):
    """(c / 2) sigma / sqrt(N) (Cramer and Rao for a Gaussian pulse in darkness), and of bins by Sheppard."""
    off = errors({"jitter", "photon_noise"}, expected, "matched", jitter_sigma_s=SIGMA_S, bin_s=SIGMA_S / 2)
    width_m = metres(SIGMA_S / 2)
    # rays with fewer photons than expected stray more: E(1 / n) = (1 + 1 / N) / N
    theory = np.sqrt((SIGMA_M**2 + width_m**2 / 12) / expected * (1 + 1 / expected))
    rms = np.sqrt(np.mean(off**2))
    # the sub-bin parabola adds a little
    assert theory * (1 - STANDARD_ERRORS / np.sqrt(2 * RAYS)) < rms < theory * 1.08


@pytest.mark.parametrize("count", [64, 400])
def test_jitter_alone_strays_by_its_own_share(count):
    off = errors({"jitter"}, count, "matched", jitter_sigma_s=SIGMA_S, bin_s=SIGMA_S / 2)
    theory = SIGMA_M / np.sqrt(count)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(theory, rel=0.08)


def test_the_highest_bin_is_off_by_a_bin_over_root_12_when_the_pulse_is_short():
    off = errors({"quantisation"}, 50, "peak", bin_s=BIN_S)
    assert np.abs(off).max() <= BIN_M / 2 * (1 + 1e-9)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(BIN_M / np.sqrt(12), rel=STANDARD_ERRORS / np.sqrt(5 * RAYS))
    assert abs(off.mean()) < STANDARD_ERRORS * BIN_M / np.sqrt(12 * RAYS)


def test_without_quantisation_and_noise_the_range_is_exact():
    for estimator in ("peak", "matched"):
        off = errors({"jitter"}, 50, estimator, pulse_sigma_s=SIGMA_S, bin_s=BIN_S)
        # even quantiles are symmetric about the pulse's middle
        assert np.abs(off).max() < 1e-12


def test_a_detector_without_bins_reads_ranges_from_fine_ones():
    off = errors({"photon_noise"}, 200, "peak", PATHS[:300], pulse_sigma_s=SIGMA_S)
    assert np.sqrt(np.mean(off**2)) < SIGMA_M / 2
    exact = errors({"photon_noise"}, 200, "peak", PATHS[:300])
    assert np.abs(exact).max() < 1e-12


def test_false_alarms_in_even_light_are_as_rare_as_asked():
    for per_metre in (1e-4, 3e-3, 0.1):
        for allowed in (0.01, 0.2):
            detector = counting_detector(RAYS, pulse_sigma_s=SIGMA_S, bin_s=BIN_S, false_alarm=allowed)
            light = background(RAYS, per_metre)
            found = detected(GATE, no_echoes(), light, detector, {"ambient", "quantisation"})
            invented = np.isfinite(found.path_m)
            assert (found.body == -1).all()
            assert invented.mean() <= allowed + STANDARD_ERRORS * np.sqrt(allowed / RAYS), per_metre


@pytest.mark.parametrize("per_metre", [0.1, 2.0])
@pytest.mark.parametrize(("dead_s", "repetition_hz"), [(1e-9, 1e6), (40e-9, 1e6), (40e-9, 20e6)])
def test_false_alarms_under_pile_up_are_as_rare_as_asked_of_a_detector_that_reckons_with_it(
    per_metre, dead_s, repetition_hz
):
    timing = {"pulse_sigma_s": SIGMA_S, "bin_s": BIN_S, "dead_s": dead_s, "repetition_hz": repetition_hz}
    effects, rays = {"ambient", "pile_up", "quantisation"}, 1000
    shares = {}
    for correction in ("none", "coates"):
        for estimator in ("peak", "matched"):
            detector = counting_detector(rays, estimator=estimator, correction=correction, **timing)
            light = background(rays, per_metre)
            found = detected(windows(rays, 1.0, 3.0), no_echoes(), light, detector, effects)
            shares[correction, estimator] = np.isfinite(found.path_m).mean()
    for estimator in ("peak", "matched"):
        assert shares["coates", estimator] <= 0.01 + STANDARD_ERRORS * np.sqrt(0.01 / rays)
    if per_metre > 1 and dead_s > 1e-8 and repetition_hz < 1e7:
        assert shares["none", "matched"] > 0.2


def test_a_correction_changes_nothing_where_nothing_piles_up():
    echoes, light = random_light(200)
    gate, found = windows(200, 1.0, 3.0), []
    for correction in ("none", "coates"):
        detector = counting_detector(200, correction=correction, **FULL)
        found.append(detected(gate, echoes, light, detector, ALL - {"pile_up"}).path_m)
    assert np.array_equal(*found, equal_nan=True)


def test_a_range_that_no_echo_explains_is_nobody_s():
    detector = counting_detector(RAYS, bin_s=BIN_S, pulse_sigma_s=SIGMA_S)
    edges = np.tile([1.4, 1.41], (RAYS, 1))
    light = Background(np.zeros(RAYS), edges, np.full((RAYS, 1), 0.5))
    found = detected(GATE, single_echoes(PATHS, 3.0), light, detector, {"photon_noise", "atmosphere"})
    assert np.abs(found.path_m - 1.405).max() < 0.02
    assert (found.body == -1).all()


def random_light(rays, seed=1):
    generator = np.random.default_rng(seed)
    ray = np.sort(generator.integers(rays, size=3 * rays))
    echoes = Echoes(ray, generator.uniform(0.9, 3.1, 3 * rays), generator.exponential(30, 3 * rays), ray % 5)
    edges = np.sort(generator.uniform(1, 3, (rays, 5)), axis=1)
    light = Background(generator.uniform(0, 0.1, rays), edges, generator.uniform(0, 0.01, (rays, 4)))
    return echoes, light


FULL = {"pulse_sigma_s": SIGMA_S, "jitter_sigma_s": SIGMA_S, "bin_s": BIN_S, "dead_s": 20e-9}
ALL = PHOTON_EFFECTS | {"atmosphere"}


def test_a_ray_s_result_does_not_depend_on_other_rays_light():
    rays = 200
    echoes, light = random_light(rays)
    detector = counting_detector(rays, **FULL)
    before = detected(windows(rays, 1.0, 3.0), echoes, light, detector, ALL)
    odd = echoes.ray % 2 == 1
    changed = Echoes(echoes.ray, echoes.path_m, np.where(odd, 7 * echoes.gain, echoes.gain), echoes.body)
    after = detected(windows(rays, 1.0, 3.0), changed, light, detector, ALL)
    assert np.array_equal(before.path_m[::2], after.path_m[::2], equal_nan=True)
    assert not np.array_equal(before.path_m[1::2], after.path_m[1::2], equal_nan=True)


def test_the_order_of_a_list_s_echoes_by_ray_does_not_matter():
    rays = 100
    echoes, light = random_light(rays)
    detector = counting_detector(rays, **FULL)
    # whole rays change places, so that each ray's own echoes stay in order
    by_ray = np.argsort(-echoes.ray, kind="stable")
    gate = windows(rays, 1.0, 3.0)
    before = detected(gate, echoes, light, detector, ALL)
    after = detected(gate, echoes.subset(by_ray), light, detector, ALL)
    assert np.array_equal(before.path_m, after.path_m, equal_nan=True)
    assert np.array_equal(before.body, after.body)


def test_light_of_several_sources_is_the_sum_of_what_each_brings_alone():
    """Switching one effect off leaves the others' draws as they are."""
    rays = 200
    echoes, light = random_light(rays)
    detector = counting_detector(rays, **FULL)
    gate = windows(rays, 1.0, 3.0)
    dark = Background(np.zeros(rays))
    hazy = Background(np.zeros(rays), light.edges_m, light.counts)
    even = Background(light.per_metre)
    effects = {"photon_noise", "jitter", "quantisation"}
    together, _ = counted(gate, echoes, light, detector, {*effects, "ambient", "atmosphere"})
    signal, _ = counted(gate, echoes, dark, detector, effects)
    haze, _ = counted(gate, no_echoes(), hazy, detector, {*effects, "atmosphere"})
    ambient, _ = counted(gate, no_echoes(), even, detector, {*effects, "ambient"})
    assert np.array_equal(together, signal + haze + ambient)


def test_a_little_less_light_takes_a_few_photons_and_leaves_the_others():
    rays = 500
    detector = counting_detector(rays, **FULL)
    gate = windows(rays, 1.0, 3.0)
    bright, _ = counted(gate, single_echoes(np.full(rays, 2.0), 100.0), background(rays), detector, {"photon_noise"})
    dim, _ = counted(gate, single_echoes(np.full(rays, 2.0), 99.0), background(rays), detector, {"photon_noise"})
    assert (dim <= bright).all()
    assert (bright - dim).sum() == pytest.approx(rays, rel=0.2)


def test_seeds_scenes_and_frames_have_their_own_noise():
    detector = counting_detector(RAYS, **FULL)
    echoes = single_echoes(PATHS, 50.0)
    # rounding to bins is the same for all seeds
    effects = ALL - {"quantisation"}
    first, again, other = (detected(GATE, echoes, NO_LIGHT, detector, effects, seed=seed) for seed in (0, 0, 1))
    assert np.array_equal(first.path_m, again.path_m, equal_nan=True)
    off = first.path_m - PATHS, other.path_m - PATHS
    assert abs(np.corrcoef(*off)[0, 1]) < STANDARD_ERRORS / np.sqrt(RAYS)


def test_no_light_is_not_detected():
    detector = counting_detector(RAYS, **FULL)
    for echoes in (no_echoes(), single_echoes(PATHS, 0.0), single_echoes(np.full(RAYS, 3.5), 100.0)):
        found = detected(GATE, echoes, NO_LIGHT, detector, ALL)
        assert np.isnan(found.path_m).all()
        assert (found.body == -1).all()


class TestTimingOnly:
    """Detectors that count no photons."""

    detector = Detector("timing", pulse_sigma_s=SIGMA_S, jitter_sigma_s=SIGMA_S, bin_s=BIN_S)
    ideal = Detector("exact")

    def test_photon_effects_do_nothing_to_them(self):
        echoes = single_echoes(PATHS, 1.0)
        found = detected(GATE, echoes, background(RAYS, 1e6), self.ideal, {"photon_noise", "ambient", "pile_up"})
        assert np.array_equal(found.path_m, PATHS)
        assert (found.body == 0).all()

    def test_the_strongest_echo_in_the_gate_is_reported(self):
        echoes = Echoes(np.zeros(4, int), np.array([0.5, 1.5, 2.5, 3.0]), np.array([9.0, 1.0, 2.0, 9.0]), np.arange(4))
        found = detected(windows(1, 1.0, 3.0), echoes, background(1), self.ideal, {"footprint"})
        assert found.path_m[0] == 2.5
        assert found.body[0] == 2

    def test_echoes_closer_than_its_resolution_are_one_at_their_mean_by_strength(self):
        width = metres(FWHM_PER_SIGMA * SIGMA_S)
        paths = np.array([2.0, 2.0 + 0.9 * width, 2.0 + 1.1 * width])
        echoes = Echoes(np.zeros(3, int), paths, np.array([3.0, 1.0, 2.0]), np.arange(3))
        detector = Detector("wide", pulse_sigma_s=SIGMA_S)
        found = detected(windows(1, 1.0, 3.0), echoes, background(1), detector, {"footprint"})
        assert found.path_m[0] == pytest.approx(2.0 + 0.25 * 0.9 * width, abs=1e-12)
        assert found.body[0] == 0

    def test_jitter_is_one_normal_error_per_return(self):
        found = detected(GATE, single_echoes(PATHS, 1.0), NO_LIGHT, self.detector, {"jitter"})
        off = found.path_m - PATHS
        assert off.std() == pytest.approx(SIGMA_M, rel=STANDARD_ERRORS / np.sqrt(2 * RAYS))
        assert abs(off.mean()) < STANDARD_ERRORS * SIGMA_M / np.sqrt(RAYS)

    def test_quantisation_rounds_to_the_middles_of_bins(self):
        found = detected(GATE, single_echoes(PATHS, 1.0), NO_LIGHT, self.detector, {"quantisation"})
        place = (found.path_m - 1.0) / BIN_M
        np.testing.assert_allclose(place - np.floor(place), 0.5, atol=1e-9)
        rms = np.sqrt(np.mean((found.path_m - PATHS) ** 2))
        assert rms == pytest.approx(BIN_M / np.sqrt(12), rel=STANDARD_ERRORS / np.sqrt(5 * RAYS))

    def test_the_part_of_a_last_bin_is_rounded_to_its_own_middle(self):
        gate = windows(1, 1.0, 1.0 + 1.5 * BIN_M)
        found = detected(gate, single_echoes([1.0 + 1.4 * BIN_M], 1.0), background(1), self.detector, {"quantisation"})
        assert found.path_m[0] == pytest.approx(1.0 + 1.25 * BIN_M, abs=1e-12)

    def test_histograms_from_the_pulse_on_have_bins_at_whole_multiples(self):
        detector = Detector("from pulse", bin_s=BIN_S, bins=1000, histogram_start="pulse")
        found = detected(GATE, single_echoes(PATHS, 1.0), NO_LIGHT, detector, {"quantisation"})
        place = found.path_m / BIN_M
        np.testing.assert_allclose(place - np.floor(place), 0.5, atol=1e-9)


# What a detector hears without complaint, and what it refuses with these words: a histogram of a given length, or the
# time between pulses, limits what gates can be.
SHORT = counting_detector(1, bin_s=BIN_S, bins=100)
FROM_PULSE = Detector("timing", bin_s=BIN_S, bins=100, histogram_start="pulse")
GATES = {
    "longer than the histogram": (SHORT, (1.0, 1.0 + 100 * BIN_M), (1.0, 1.0 + 100.5 * BIN_M), "100 bins of 100 ps"),
    "ends outside": (FROM_PULSE, (0.2, 1.4), (0.1, 1.6), "ends outside"),
    "starts outside": (FROM_PULSE, (9.0, 9.0), (1.7, 1.8), "starts outside"),
    "beyond the next pulse": (
        counting_detector(1, repetition_hz=1e8, bin_s=BIN_S), (1.0, 1.4), (1.0, 1.6), r"next pulse(.|\n)*1\.499 m",
    ),
    "of millions of bins": (
        counting_detector(1, repetition_hz=1e3, bin_s=1e-15), (1.0, 1.0), (1.0, 3.0), "bins of 1.5e-07 m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("effects", [{"quantisation"}, ALL])
@pytest.mark.parametrize(("detector", "fits", "too_much", "words"), GATES.values(), ids=GATES)
def test_a_gate_that_a_detector_cannot_hear_is_refused(detector, fits, too_much, words, effects):
    found = detected(windows(1, *fits), no_echoes(), background(1), detector, effects)
    assert np.isnan(found.path_m[0])
    with pytest.raises(ConfigError, match=words):
        detected(windows(1, *too_much), no_echoes(), background(1), detector, effects)


@pytest.mark.parametrize("seed", range(9))
def test_any_detector_and_any_light_give_ranges_in_their_gates_or_none(seed):
    """Values from end to end of what detector files may hold, also in gates without width; warnings are errors."""
    generator = np.random.default_rng(seed)

    def between(low, high):
        return float(10.0 ** generator.uniform(np.log10(low), np.log10(high)))

    rays = 6
    photons = Photons(
        wavelength_m=between(280e-9, 4000e-9),
        pulse_energy_j=between(1e-21, 1.0),
        pulses_per_frame=between(1, 1e12),
        emission=("scanned", "flood")[seed % 2],
        repetition_hz=between(1e-3, 1e7),
        aperture_m2=between(1e-12, 10),
        field_of_view_sr=1e-6,
        efficiency=between(1e-9, 1),
        filter_m=1e-9,
        dark_hz=0.0,
        dead_s=between(1e-12, 1.0),
    )
    detector = Detector(
        "any",
        pulse_sigma_s=between(1e-15, 1e-6),
        jitter_sigma_s=between(1e-15, 1e-6),
        bin_s=None if seed % 3 == 0 else between(1e-12, 1e-6),
        photons=photons if seed % 4 else None,
        estimator=("peak", "matched")[seed // 2 % 2],
    )
    echoes, light = random_light(rays, seed)
    gain = echoes.gain * between(1e-12, 1e12)
    gain[:2] = np.finfo(float).max
    echoes = Echoes(echoes.ray, echoes.path_m, gain, echoes.body)
    light = Background(light.per_metre * between(1e-9, 1e13), light.edges_m, light.counts * between(1e-9, 1e9))
    start = generator.uniform(1, 3, rays)
    gate = np.stack([start, start + generator.exponential(0.2, rays)], axis=1)
    gate[:2, 1] = gate[:2, 0]
    for effects in (ALL, ALL - {"quantisation"}, {"photon_noise"}, {"jitter"}, {"ambient", "pile_up"}):
        found = detected(gate, echoes, light, detector, effects)
        inside = np.isfinite(found.path_m)
        assert not inside[:2].any()
        assert (found.path_m[inside] >= gate[inside, 0]).all()
        assert (found.path_m[inside] < gate[inside, 1]).all()
        assert (found.body[~inside] == -1).all()
