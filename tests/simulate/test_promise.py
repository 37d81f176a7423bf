"""What plans promise of all that they skip, in random scenes, and where detectors round."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm
from support.planning import CONSUMER, SINGLE, TIMED, decisions, facing_wall, grid, sight

from benchmarks.soak.promise import kept_promise, random_case
from lidardesign.scenes.scene import Ambient, Body, Box, Medium, Receiver, Scene, Sphere, rigid
from lidardesign.simulate.detector.kernels import find_returns
from lidardesign.simulate.detector.physics import FWHM_PER_SIGMA, Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import simulate


@cache
def kept(seed):
    return kept_promise(random_case(seed))


@pytest.mark.parametrize("seed", range(60))
def test_what_is_skipped_changes_no_more_than_is_tolerated(seed):
    assert not kept(seed).broken, str(kept(seed))


def test_random_plans_skip_something_in_a_quarter_of_scenes():
    assert sum(bool(kept(seed).skipped) for seed in range(20)) >= 5


def rounding(jitter_share, bin_m=0.1):
    bin_s = 2 * bin_m / 299792458
    return replace(TIMED, bin_s=bin_s, jitter_sigma_s=jitter_share * bin_s, histogram_start="pulse")


def wall_at(range_m):
    return Scene((Body(Box((0.05, 9, 9)), "wall", poses=rigid(translation_m=(range_m + 0.05, 0, 0))),))


@pytest.mark.parametrize(
    ("place", "jitter_share", "is_on"),
    [
        # in bins of 0.1 m from range 0; the wall lies so many bins off
        (20.0, 1e-5, True),
        (20.001, 1e-3, True),
        (20.25, 1e-3, False),
        (20.5, 0.05, False),
        (20.5, 0.3, True),
    ],
)
def test_timing_errors_are_called_for_where_they_reach_the_edge_of_a_bin(place, jitter_share, is_on):
    scene, detector, rays = wall_at(0.1 * place), rounding(jitter_share), grid(12, 1e-6)
    plan = Planner(detector).plan(scene, [rays])
    assert ("jitter" in plan.effects) == is_on
    planned, every = (
        simulate(scene, rays, physics=Physics(detector, effects))[0].range_m
        for effects in (plan.effects | {"quantisation"}, frozenset({"jitter", "quantisation"}))
    )
    assert np.sqrt(np.mean((planned - every) ** 2)) <= plan.tolerance.range_m


def test_steps_in_even_phases_are_as_likely_as_shifts_are_long():
    """Against drawn steps: a normal shift s passes the edge of a bin b with the probability E|s| / b."""
    bin_m, share = 0.1, 0.01
    tilted = rigid(np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]]), (2, 0, 0))
    scene, rays = Scene((Body(Box((0.01, 9, 9)), "wall", poses=tilted),)), grid(40, 0.3)
    jitter = decisions(Planner(rounding(share)).plan(scene, [rays]))["jitter"].bound.range_m
    drawn = bin_m * math.sqrt(math.sqrt(2 / math.pi) * share)
    assert drawn <= jitter <= 2 * drawn


@pytest.mark.parametrize("pulse_bins", [0.02, 0.1, 0.2, 0.3, 0.5, 0.8, 1.0, 1.7, 2.5, 4.0])
@pytest.mark.parametrize("timing_share", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("level", [0.0, 1e3, 1e6, 1e8])
def test_the_matched_filter_leaves_no_more_of_a_step_than_bounded(pulse_bins, timing_share, level):
    """Ten million photons of a pulse at every place in a bin, found by a filter for the pulse or a wider one."""
    bin_s, places = SINGLE.bin_s, np.linspace(-0.499, 0.499, 41)
    pulse_s, jitter_s = pulse_bins * bin_s, timing_share * pulse_bins * bin_s
    detector = replace(SINGLE, pulse_sigma_s=pulse_s, jitter_sigma_s=jitter_s, divergence_rad=0.0, footprint_rays=1)
    middles = np.arange(201) - 100.0 - places[:, None]
    share = norm.cdf((middles + 0.5) / pulse_bins) - norm.cdf((middles - 0.5) / pulse_bins)
    drawn = np.rint(1e7 * share + level).astype(np.int64)
    offset, whole, known = 201 * np.arange(len(places) + 1), np.ones((len(places), 2)), np.full(len(places), level)
    sigma = math.hypot(1.0, timing_share) * pulse_bins
    half = int(FWHM_PER_SIGMA * sigma / 2)
    found = find_returns(drawn.ravel(), offset, whole, 1.0, sigma, half, known, 0.5, True)
    off = np.abs(found - 100.5 - places)
    assert (off <= sight(facing_wall(), detector).step_m[0] / detector.bin_m / 2 + 1e-3).all()


@pytest.mark.parametrize("place", [20.0, 20.25, 20.5])
def test_rounding_is_bounded_by_what_it_does_to_walls_met_head_on(place):
    rays = grid(4, 1e-6)
    found = decisions(Planner(rounding(0.0)).plan(wall_at(0.1 * place), [rays]))["quantisation"].bound.range_m
    assert found == pytest.approx(max(0.1 / math.sqrt(12), 0.1 * abs(place % 1 - 0.5)), rel=1e-6)


@pytest.mark.parametrize(("baseline_m", "range_m"), [(0.0, 1.0), (0.4, 1.0), (2.0, 1.0), (0.4, 0.1)])
def test_errors_of_paths_are_larger_ones_of_ranges_beside_a_receiver(baseline_m, range_m):
    """One timing error per return: dr = dp / ((1 + cos) / 2), by finite differences of the whole way."""
    scene = replace(wall_at(range_m), receiver=Receiver((0, baseline_m, 0), 0, 0, 3.1, 3.1, (0, 20)))
    found = decisions(Planner(TIMED).plan(scene, [grid(4, 1e-6, (0.01, 4))]))["jitter"].bound.range_m
    alone = decisions(Planner(TIMED).plan(wall_at(range_m), [grid(4, 1e-6, (0.01, 4))]))["jitter"].bound.range_m
    step = 1e-6
    further, nearer = (r + math.hypot(r, baseline_m) for r in (range_m + step, range_m - step))
    assert found / alone == pytest.approx(4 * step / (further - nearer), rel=1e-4)


SHARP = replace(SINGLE, pulse_sigma_s=0.0, jitter_sigma_s=0.0)
BRIGHT = replace(SINGLE, photons=replace(SINGLE.photons, pulse_energy_j=1e-2, aperture_m2=1.0))
TOUCHING = {
    "wall": wall_at(0.0),
    "almost": wall_at(1e-12),
    "ball": Scene((Body(Sphere(1.0), poses=rigid(translation_m=(1, 0, 0))),)),
    "mirror": Scene((replace(wall_at(0.0).bodies[0], specular=0.5),)),
}


@pytest.mark.parametrize("scene", TOUCHING.values(), ids=TOUCHING)
@pytest.mark.parametrize("detector", [SINGLE, CONSUMER, SHARP, replace(SHARP, estimator="peak"), BRIGHT])
@pytest.mark.parametrize("gate_m", [(0.0, 4.0), (0.0, 1e-9)])
def test_surfaces_that_touch_a_receiver_are_bounded_without_overflow(scene, detector, gate_m):
    for air in ({}, {"medium": Medium(0.1, 0.01)}, {"receiver": Receiver((0, 0.2, 0), 0, 0, 3.1, 3.1, (0, 20))}):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            plan = Planner(detector).plan(replace(scene, ambient=Ambient(1e5), **air), [grid(6, gate_m=gate_m)])
        assert all(np.isfinite(one.bound.range_m) and 0 <= one.bound.lost <= 1 for one in plan.decisions)
