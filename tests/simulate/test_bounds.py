"""Bounds of effects: their closed forms, and that they grow with what causes them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import poisson
from support.meshes import icosphere
from support.planning import (
    CONSUMER,
    SIMULATED,
    SINGLE,
    TIMED,
    counts,
    decisions,
    errors,
    facing_wall,
    grid,
    room,
    sight,
)
from support.rays import rays_along

from benchmarks.soak.promise import random_case
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import (
    Ambient,
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Medium,
    Plane,
    Receiver,
    Scene,
    Sphere,
    rigid,
)
from lidardesign.simulate.detector.physics import Physics, metres
from lidardesign.simulate.effects.expected_counts import (
    Blindness,
    needed_counts,
)
from lidardesign.simulate.effects.first_hits import FirstHits, edge_probability
from lidardesign.simulate.effects.motion import entered_rays, moving_tracer
from lidardesign.simulate.effects.multipath import _detours, _moved_m
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import followed_light, photon_histograms, simulate


def bound(name, scene, detector, rays=None):
    return decisions(Planner(detector).plan(scene, [grid() if rays is None else rays]))[name].bound


NARROW = grid(side=4, half_rad=1e-4)


def test_one_time_per_return_strays_by_the_whole_jitter():
    assert bound("jitter", room(), TIMED).range_m == pytest.approx(metres(TIMED.jitter_sigma_s))


def test_the_matched_filter_averages_photons():
    never_blind = replace(SINGLE.photons, dead_s=0.0)
    detector = replace(SINGLE, divergence_rad=0.0, footprint_rays=1, photons=never_blind, bin_s=None)
    signal = float(counts(facing_wall(), detector, NARROW).signal[0])
    found = bound("photon_noise", facing_wall(), detector, NARROW).range_m
    assert found == pytest.approx(metres(detector.timing_sigma_s) / math.sqrt(signal), rel=1e-3)
    jitter = bound("jitter", facing_wall(), detector, NARROW).range_m
    assert jitter == pytest.approx(metres(detector.jitter_sigma_s) / math.sqrt(signal), rel=1e-3)


def test_expected_signal_is_the_light_budget_of_a_wall_met_head_on():
    photons = SINGLE.photons
    per_pulse = photons.pulse_energy_j / photons.photon_energy_j * photons.efficiency
    expected = per_pulse * photons.aperture_m2 * 0.3 / (math.pi * 2.0**2) * photons.pulses_per_frame / 16
    found = counts(facing_wall(reflectance=0.3), SINGLE, NARROW).signal
    assert found == pytest.approx(np.full(16, expected), rel=1e-6)


@pytest.mark.parametrize("mean", [0.0, 1e-9, 1e-3, 0.2, 1.0, 7.3, 100.0, 4e4])
@pytest.mark.parametrize("bins", [1.0, 40.0, 3000.0])
@pytest.mark.parametrize("allowed", [0.5, 0.01, 1e-6])
def test_a_return_needs_the_fewest_counts_that_background_rarely_reaches(mean, bins, allowed):
    needed = float(needed_counts(np.array([mean]), np.array([bins]), allowed)[0])
    rounding = 1 + 1e-6
    assert needed >= 1
    assert bins * poisson.sf(needed - 1, mean) <= allowed * rounding
    assert needed == 1 or bins * poisson.sf(needed - 2, mean) * rounding > allowed


@pytest.mark.parametrize("signal", [0.0, 3.0, 20.0, 80.0])
@pytest.mark.parametrize("level", [0.01, 0.5, 4.0])
def test_the_union_over_bins_bounds_how_often_another_bin_wins(signal, level):
    """Against drawn histograms: within four standard errors."""
    scene = facing_wall()
    found = counts(scene, replace(CONSUMER, bin_s=1e-9, pulse_sigma_s=0.0, jitter_sigma_s=0.0), NARROW)
    bins, draws, generator = int(found.bins[0]), 20_000, np.random.default_rng(3)
    echo = generator.poisson(signal * 0.5 + level, draws)
    other = generator.poisson(level, (draws, bins - 1)).max(axis=1)
    wrong = float((other >= echo).mean())
    bounded = found.mistaken(np.full(16, signal), np.full(16, level), np.full(16, level), np.zeros(16))[0]
    assert wrong - 4 * math.sqrt(wrong * (1 - wrong) / draws) <= bounded <= 1


SUNNY = [room(ambient=Ambient(lux)) for lux in (0.0, 1.0, 30.0, 1e3, 1e4, 1e5)]
DEAD = [replace(SINGLE, photons=replace(SINGLE.photons, dead_s=dead_s)) for dead_s in (0.0, 7.7e-8, 1e-6)]
GROWING = {
    "light of the surroundings": ("ambient", [(scene, SINGLE) for scene in SUNNY]),
    "dead time in light": ("pile_up", [(SUNNY[-1], detector) for detector in DEAD]),
    "fog": ("atmosphere", [(room(medium=Medium(a, a / 20)), SINGLE) for a in (0.0, 1e-4, 1e-2, 0.1, 1.0)]),
    "the width of beams": ("footprint", [(room(), replace(CONSUMER, divergence_rad=w)) for w in (1e-3, 0.01, 0.2)]),
    "speed": ("motion", [(room(ball={"velocity_m_s": (0.0, v, 0.0)}), TIMED) for v in (0.0, 0.01, 0.1, 1.0, 10.0)]),
    "jitter": ("jitter", [(room(), replace(TIMED, jitter_sigma_s=sigma)) for sigma in (0.0, 1e-12, 1e-10)]),
    "bins": ("quantisation", [(room(), replace(TIMED, bin_s=width)) for width in (1e-12, 1e-10, 1e-9)]),
}


@pytest.mark.parametrize(("name", "cases"), GROWING.values(), ids=GROWING)
def test_bounds_grow_with_what_causes_them(name, cases):
    found = [bound(name, *case) for case in cases]
    ranges, lost = [one.range_m for one in found], [one.lost for one in found]
    assert ranges == sorted(ranges)
    assert lost == sorted(lost)
    assert ranges[0] < ranges[-1] or lost[0] < lost[-1]


def test_light_of_the_surroundings_makes_blind_detectors_early():
    early_m = [bound("pile_up", scene, SINGLE).range_m for scene in SUNNY]
    assert early_m == sorted(early_m)
    assert early_m[-1] > 10 * early_m[0]


@pytest.mark.parametrize("tilt_deg", [0, 30, 60, 80, 88])
def test_a_slanted_plane_spreads_a_beam_as_far_as_its_rim(tilt_deg):
    tilt, width = math.radians(tilt_deg), 0.01
    turned = np.array([[math.cos(tilt), -math.sin(tilt), 0], [math.sin(tilt), math.cos(tilt), 0], [0, 0, 1.0]])
    wall = Body(Box((1e-6, 50, 50)), poses=rigid(turned, (2, 0, 0)))
    detector = replace(TIMED, divergence_rad=width, footprint_rays=7)
    found = bound("footprint", Scene((wall,)), detector, NARROW)
    assert found.range_m == pytest.approx(2 * (math.cos(tilt) / math.cos(tilt + width / 2) - 1), rel=0.05)
    assert found.lost == 0


def test_the_share_of_beams_on_a_depth_edge_is_that_of_drawn_edges():
    """A straight edge between two walls, anywhere between the rays of a grid: on average exact."""
    detector = replace(TIMED, divergence_rad=0.004, footprint_rays=7)
    rays, found, true = grid(side=20, half_rad=0.2), [], []
    for place in np.random.default_rng(0).uniform(-0.2, 0.2, 40):
        near = Body(Box((0.01, 5, 5)), "near", poses=rigid(translation_m=(1, 5 + place, 0)))
        seen = sight(Scene((near, *facing_wall().bodies)), detector, rays)
        chance = edge_probability(seen, detector.divergence_rad / 2 * seen.range_m)
        found.append(chance.mean())
        azimuth = np.arctan2(rays.direction[:, 1], rays.direction[:, 0])
        true.append((np.abs(azimuth - math.atan2(place, 1 - 0.01)) <= 0.002).mean())
    error = np.std(np.array(found) - np.array(true)) / math.sqrt(40)
    assert np.mean(found) >= np.mean(true) - 4 * error
    assert np.mean(found) <= 4 * np.mean(true) + 4 * error


def test_a_receiver_loses_what_lies_outside_its_view_and_may_lose_all_it_does_not_share():
    here = Receiver((0, 0, 0), 0.0, 0.0, 0.3, 3.0, (0.0, 10.0))
    found = bound("shadowing", Scene(room().bodies, receiver=here), TIMED)
    seen = sight(room(), TIMED)
    azimuth = np.abs(np.arctan2(seen.rays.direction[:, 1], seen.rays.direction[:, 0]))
    assert found.lost == pytest.approx((azimuth > 0.15).sum() / seen.returned.sum())
    assert bound("shadowing", Scene(room().bodies, receiver=replace(here, origin_m=(0, 0.1, 0))), TIMED).lost == 1.0


def test_a_wall_fills_half_of_what_the_floor_before_it_sees():
    floor, wall = Body(Plane(), "floor"), Body(Box((0.05, 1e4, 1e4)), "wall", poses=rigid(translation_m=(2, 0, 0)))
    down = grid(side=5, half_rad=0.2)
    looking = down.direction[:, [1, 2, 0]] * np.array([1, 1, -1])
    rays = replace(down, origin_m=down.origin_m + np.array([0, 0, 1.0]), direction=looking)
    found = _detours(sight(Scene((floor, wall)), CONSUMER, rays), np.arange(25))
    assert found.seen.mean() == pytest.approx(0.5, abs=0.02)


def test_a_convex_body_alone_lights_nothing_and_a_corner_lights_itself():
    assert bound("multipath", Scene((Body(Sphere(0.3), poses=rigid(translation_m=(1, 0, 0))),)), CONSUMER).range_m == 0
    side = Body(Box((2, 0.05, 2)), "side", poses=rigid(translation_m=(2, 0.3, 0)))
    corner = Scene((*facing_wall().bodies, side))
    assert bound("multipath", corner, CONSUMER).range_m > 0.005


def test_the_spots_of_a_flood_light_each_other_as_two_small_surfaces_do():
    """One spot on a wall ahead, one on a wall to the left of it, seen from two places."""
    side = Body(Box((5, 0.05, 5)), "side", poses=rigid(translation_m=(0, 0.55, 0)), reflectance=0.4)
    scene = Scene((*facing_wall(reflectance=0.2).bodies, side))
    origin, looking = np.array([[1.0, 0, 0], [1.7, 0, 0]]), np.array([[1.0, 0, 0], [0, 1.0, 0]])
    rays = rays_along(looking, (0.1, 4.0), origin)
    detector = replace(CONSUMER, divergence_rad=0.0, footprint_rays=1)
    ahead_m, aside_m = 0.3, 0.5
    apart_m = math.hypot(ahead_m, aside_m)
    factor = ahead_m * aside_m / (math.pi * apart_m**4) * detector.photons.field_of_view_sr / (1 - 0.4)
    first = 0.4 * factor * 1.0**2 * (0.5 + apart_m - 1.0) / 2
    second = 0.2 * factor * 0.5**2 * (1.0 + apart_m - 0.5) / 2
    found = sight(scene, replace(detector, bin_s=1e-8), rays)
    assert _moved_m(found, np.arange(2), np.arange(2)) == pytest.approx([first, second], rel=1e-6)
    balls = tuple(Body(Sphere(0.1), poses=rigid(translation_m=place)) for place in ((1, 0.15, 0), (1.3, -0.15, 0)))
    assert "spots of a flood" in bound("multipath", Scene(balls), CONSUMER, grid(24, 0.4)).reason


def test_shares_of_light_that_leads_elsewhere_are_counted():
    seen = sight(room(), TIMED)
    share = (seen.hits.body == 0).sum() / seen.returned.sum()
    assert bound("specular", room(ball={"specular": 0.2}), TIMED).lost == pytest.approx(share)
    assert bound("specular", room(wall={"transmission": 0.2}), TIMED).lost == pytest.approx(1 - share)


def test_beams_that_meet_what_lies_between_rays_call_for_their_width():
    poles = tuple(Body(Capsule(0.004, 2.0), "pole", poses=rigid(translation_m=(1, y, 0))) for y in (-0.1, 0.0, 0.1))
    scene, rays = Scene(poles), grid(side=12, half_rad=0.3)
    wide = replace(TIMED, divergence_rad=0.03, footprint_rays=19)
    assert (sight(scene, wide, rays).hits.body < 0).all()
    assert "footprint" in Planner(wide).plan(scene, [rays]).effects
    far = Scene((Body(Sphere(0.1), "ball", poses=rigid(translation_m=(-1, 0, 0))),))
    assert "footprint" not in Planner(wide).plan(far, [rays]).effects


MOVERS = {
    "sphere": Sphere(0.1),
    "box": Box((0.1, 0.05, 0.2)),
    "capsule": Capsule(0.05, 0.1),
    "cylinder": Cylinder(0.05, 0.1),
    "ellipsoid": Ellipsoid((0.1, 0.05, 0.2)),
    "plane": Plane(),
    "mesh": icosphere(0.1, (0.05, 0.05, 0.05), subdivisions=2),
}


@pytest.mark.parametrize("shape", MOVERS.values(), ids=MOVERS)
def test_what_flies_into_view_calls_for_motion(shape):
    """Nothing of the body is met when the frame begins; rays that it has reached by their time are, exactly."""
    still = rigid(Rotation.from_rotvec((0.3, math.pi / 2, 0.2)).as_matrix(), (0.7, -0.8, 0.0))
    moving = Body(shape, "flyer", poses=still, velocity_m_s=(0.0, 14.0, 0.0))
    if isinstance(shape, Plane):
        away = rigid(Rotation.from_rotvec((0.0, -math.pi / 2, 0.0)).as_matrix(), (9.0, 0.0, 0.0))
        moving = replace(moving, poses=away, velocity_m_s=(-90.0, 0.0, 0.0))
    wall = Body(Box((0.05, 9, 9)), "wall", poses=rigid(translation_m=(1.5, 0, 0)))
    scene, rays = Scene((wall, moving)), grid(side=30)
    seen = sight(scene, TIMED, rays)
    assert (seen.hits.body == 0).all()
    later = moving_tracer(scene, 0)(rays.origin_m, rays.direction, rays.time_s)
    assert (later.body == 1).any()
    assert np.array_equal(entered_rays(seen), later.body == 1)
    assert "motion" in Planner(TIMED).plan(scene, [rays]).effects


@pytest.mark.parametrize("place", [None, (4.8, 0, 0.3), (2, 0.01, 0), (0, 0, 0), (-1, 0.5, 0.2), (5, 1, 0)])
@pytest.mark.parametrize("gate_m", [(0.0, 6.5), (0.1, 6.5), (2.5, 3.0)])
def test_haze_is_bounded_also_beside_a_fixed_receiver(place, gate_m):
    """Against what the effect counts: all haze, and the fullest cell per length."""
    receiver = None if place is None else Receiver(place, 0.0, 0.0, 3.1, 3.1, (0.0, 20.0))
    wall = Body(Box((0.05, 50, 50)), "wall", poses=rigid(translation_m=(6.05, 0, 0)))
    scene = Scene((wall,), medium=Medium(0.01, 0.02), receiver=receiver)
    rays = grid(side=8, half_rad=0.1, gate_m=gate_m)
    found = counts(scene, replace(SINGLE, divergence_rad=0.0, footprint_rays=1), rays)
    background = followed_light(
        scene, 0, rays, SceneCaster(scene), Physics(found.first_hits.detector, frozenset({"atmosphere"}))
    ).background
    whole, fullest = found.haze_per_pulse
    assert (background.counts.sum(axis=1) <= whole * (1 + 1e-6) + 1e-300).all()
    length = np.diff(background.edges_m, axis=1)
    long = length > found.bin_m
    densest = np.where(long, background.counts / np.where(long, length, 1.0), 0.0).max(axis=1) * found.bin_m
    assert (densest <= fullest * (1 + 1e-6) + 1e-300).all()


STANDARD_ERRORS = 4.0


def check_effect(name, bound, scene, detector, rays):
    """Against light in photons where they are counted, against geometry elsewhere."""
    base = frozenset({"photon_noise"}) if detector.photons is not None and name != "photon_noise" else frozenset()
    resolved_m = FirstHits.of(scene, 0, detector, [rays], SceneCaster(scene)).resolution_m
    far_m = max(5 * bound.range_m, resolved_m, 1e-6)
    after, count, wrong = errors(scene, rays, Physics(detector, base | {name}, 1), far_m)
    before, _, wrong_before = errors(scene, rays, Physics(detector, base, 1) if base else None, far_m)
    returns = max(int(simulate(scene, rays)[0].returned.sum()), 1)
    noise = STANDARD_ERRORS * np.sqrt(2 / max(count, 1)) * (after + before)
    assert after - before <= (bound.range_m * 1.001) ** 2 + noise + 1e-12
    added = min(wrong - wrong_before, 1.0)
    assert added <= bound.lost + STANDARD_ERRORS * np.sqrt(max(bound.lost, 1 / returns) / returns)


@pytest.mark.parametrize("seed", range(25))
def test_no_effect_changes_more_than_its_bound(seed):
    case = random_case(seed)
    found = decisions(Planner(case.detector).plan(case.scene, [case.rays]))
    for name in sorted(SIMULATED):
        check_effect(name, found[name].bound, case.scene, case.detector, case.rays)


def test_rays_without_a_return_invent_one_as_rarely_as_asked_though_gates_end_within_bins():
    wall = Body(Box((0.05, 9, 9)), "wall", poses=rigid(translation_m=(3, 0, 0)), reflectance=0.3)
    scene, detector = Scene((wall,), ambient=Ambient(8e4)), replace(CONSUMER, bins=None, footprint_rays=1)
    rays = grid(40, 0.2, (0.1, 1.5324))
    invented = simulate(scene, rays, physics=Physics(detector, frozenset({"photon_noise", "ambient"})))[0].returned
    # the level is measured in the gate itself, in a few dozen bins: up to twice as often as with a known one
    assert invented.mean() <= 2 * detector.false_alarm + STANDARD_ERRORS * np.sqrt(0.02 / len(rays))


THIN = replace(SINGLE, divergence_rad=0.0, footprint_rays=1)
RAYS = grid(side=20, half_rad=0.3, gate_m=(0.1, 1.3))


def counting(**light):
    """A single-photon detector whose light budget is changed, with thin beams and many pulses per ray."""
    return replace(THIN, photons=replace(THIN.photons, pulses_per_frame=1e4 * len(RAYS), **light))


def wall(range_m, half_width_m=9.0, lux=1e5):
    box = Box((0.05, half_width_m, 9))
    return Scene((Body(box, "wall", poses=rigid(translation_m=(range_m + 0.05, 0, 0))),), ambient=Ambient(lux))


CALLED_FOR = {
    "light that hides echoes behind it, though its level is low": (
        {"ambient", "pile_up"}, wall(0.8), counting(pulse_energy_j=1e-12, field_of_view_sr=5e-5),
    ),
    "false alarms where gates start": ({"ambient", "pile_up"}, wall(3.0), counting(pulse_energy_j=1e-13)),
    "rare false alarms, which are none under pile-up": (
        {"ambient", "pile_up"}, wall(1.0, half_width_m=0.15),
        replace(counting(pulse_energy_j=1e-13), false_alarm=1e-4),
    ),
    "fog that hides echoes behind it, though it is faint": (
        {"atmosphere", "pile_up"}, replace(wall(0.8, lux=0.0), medium=Medium(0.39, 0.02)),
        counting(pulse_energy_j=1e-11),
    ),
    "timing errors of the first of many photons": ({"jitter"}, wall(0.8, lux=0.0), counting(pulse_energy_j=1e-12)),
}  # fmt: skip


@pytest.mark.parametrize(("effects", "scene", "detector"), CALLED_FOR.values(), ids=CALLED_FOR)
def test_light_that_is_easily_overlooked_is_called_for(effects, scene, detector):
    """Planned effects and all of them give the same share of wrong returns, and errors within the tolerance."""
    plan = Planner(detector).plan(scene, [RAYS])
    assert effects <= plan.effects
    chosen = plan.effects & SIMULATED
    planned, _, wrong = errors(scene, RAYS, Physics(detector, chosen, 1) if chosen else None, 0.05)
    every, _, wrong_every = errors(scene, RAYS, Physics(detector, SIMULATED, 1), 0.05)
    assert abs(np.sqrt(planned) - np.sqrt(every)) <= plan.tolerance.range_m
    assert abs(wrong - wrong_every) <= 0.005


@pytest.mark.parametrize("field_of_view_sr", [1e-6, 1e-5])
def test_what_is_left_is_what_is_counted(field_of_view_sr):
    """Against histograms: the echo's counts within 5 %, the background at the gate's start within 3 %."""
    scene, detector = facing_wall(), counting(field_of_view_sr=field_of_view_sr, pulse_energy_j=3e-13)
    scene = replace(scene, ambient=Ambient(1e5))
    rays = grid(side=20, half_rad=1e-4, gate_m=(0.5, 2.5))
    found = counts(scene, detector, rays)
    effects = frozenset({"photon_noise", "jitter", "ambient", "pile_up"})
    drawn = photon_histograms(scene, 0, rays, SceneCaster(scene), Physics(detector, effects)).counts
    per_metre = found.background_per_metre[0] * found.pulses[0]
    blind = Blindness.of(found)
    near = slice(int(1.48 / found.bin_m), int(1.52 / found.bin_m))
    echo = drawn[:, near].sum(axis=1) - per_metre * blind.under[0] * 0.04 * np.exp(
        -found.signal[0] / found.pulses[0] / 2
    )
    # background between the echo's photons adds a few per cent that the closed form leaves out
    assert echo.mean() == pytest.approx(blind.left[0], rel=0.05)
    start = drawn[:, 1:20].sum(axis=1).mean() / (19 * found.per_bin[0])
    assert start == pytest.approx(blind.awake[0], abs=0.03)
