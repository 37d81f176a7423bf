"""From a scene to photons: closed forms of signal and ambient counts, captures, outcomes, the presets' figures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.rays import rays_along
from support.references import STANDARD_ERRORS
from support.synthetic_light import PHOTON_EFFECTS

from lidardesign.errors import ConfigError
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S, Ambient, Body, Plane, Scene, Sphere, rigid
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.light import FIRST_NM, LED_AT_1_LUX, STEP_NM, SUN_AT_100_KLUX, spectral_irradiance
from lidardesign.simulate.detector.physics import PLANCK_J_S, Physics, metres
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import build_casters, followed_light, photon_histograms, simulate

DETECTOR = load_detector("single-photon")
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


def rays_towards(directions, gate_m):
    directions = np.asarray(directions, float)
    return rays_along(directions / np.linalg.norm(directions, axis=1, keepdims=True), gate_m)


def ceiling(distance_m, reflectance=0.6, **scene):
    """A plane above the origin, facing down."""
    pose = rigid(UPSIDE_DOWN, (0.0, 0.0, distance_m))
    return Scene((Body(Plane(), poses=pose, reflectance=reflectance),), **scene)


def captured(scene, rays, effects, detector=DETECTOR):
    return photon_histograms(scene, 0, rays, build_casters(scene)[0], Physics(detector, frozenset(effects)))


@pytest.mark.parametrize(("distance", "tilt", "reflectance"), [(0.4, 0.0, 0.6), (0.4, 1.0, 0.6), (1.5, 0.5, 0.05)])
@pytest.mark.parametrize("emission", ["scanned", "flood"])
def test_signal_counts_follow_the_radar_equation(distance, tilt, reflectance, emission):
    """N = E / (h c / lambda) * eta * A rho cos / (pi R^2), for each of a frame's shared pulses."""
    rays = rays_towards(np.tile([math.sin(tilt), 0.0, math.cos(tilt)], (50, 1)), (0.0, 5.0))
    detector = replace(DETECTOR, photons=replace(DETECTOR.photons, emission=emission))
    photons = detector.photons
    reach = distance / math.cos(tilt)
    sent = photons.pulse_energy_j * photons.wavelength_m / (PLANCK_J_S * SPEED_OF_LIGHT_M_S)
    caught = photons.efficiency * photons.aperture_m2 * reflectance * math.cos(tilt) / (math.pi * reach**2)
    expected = photons.pulses_per_frame * sent * caught / 50
    found = captured(ceiling(distance, reflectance), rays, {"photon_noise"}, detector).counts.sum()
    assert abs(found - 50 * expected) < STANDARD_ERRORS * math.sqrt(50 * expected)


@pytest.mark.parametrize("illuminance", [300.0, 100_000.0])
def test_ambient_counts_follow_radiance_aperture_and_solid_angle(illuminance):
    scene = ceiling(2.0, ambient=Ambient(illuminance, "sun"))
    rays = rays_towards(np.tile([0.0, 0.0, 1.0], (100, 1)), (0.5, 1.5))
    photons = DETECTOR.photons
    irradiance = spectral_irradiance(scene.ambient, photons.wavelength_m, photons.filter_m)
    power = irradiance * 0.6 / math.pi * photons.filter_m * photons.aperture_m2 * photons.field_of_view_sr
    rate = power * photons.efficiency / photons.photon_energy_j + photons.dark_hz
    expected = photons.pulses_per_frame * rate * 2 * 1.0 / SPEED_OF_LIGHT_M_S
    found = captured(scene, rays, {"ambient"}).counts.sum()
    assert abs(found - expected) < STANDARD_ERRORS * math.sqrt(expected)


def test_rays_that_meet_nothing_see_no_light():
    scene = ceiling(2.0, ambient=Ambient(1e5, "sun"))
    up_and_down = rays_towards([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], (0.5, 1.5))
    physics = Physics(DETECTOR, frozenset({"ambient"}))
    per_metre = followed_light(scene, 0, up_and_down, build_casters(scene)[0], physics).background.per_metre
    assert per_metre[1] == pytest.approx(DETECTOR.photons.dark_hz * 2 / SPEED_OF_LIGHT_M_S)
    assert per_metre[0] > 1e5 * per_metre[1]


def photopic(wavelength_nm):
    """A common approximation of the photopic curve: 1.019 exp(-285.4 (um - 0.559)^2); about 2 % off in lux."""
    return 1.019 * np.exp(-285.4 * (wavelength_nm / 1000 - 0.559) ** 2)


@pytest.mark.parametrize(("table", "lux"), [(SUN_AT_100_KLUX, 1e5), (LED_AT_1_LUX, 1.0)])
def test_the_spectra_have_the_illuminance_that_they_are_for(table, lux):
    wavelength_nm = FIRST_NM + STEP_NM * np.arange(len(table))
    assert 683 * STEP_NM * np.sum(table * photopic(wavelength_nm)) == pytest.approx(lux, rel=0.03)


def test_the_sun_shines_where_the_standard_says_and_lamps_hardly_do_in_the_infrared():
    sun, lamp = Ambient(109_495.0, "sun"), Ambient(500.0, "indoor")
    # ASTM G173-03, global: 1.357 W/(m^2 nm) at 667 to 673 nm, 0.44 at 940 (mean over 40 nm), 0.98 at 850
    assert spectral_irradiance(sun, 670e-9, 10e-9) == pytest.approx(1.41e9, rel=0.02)
    assert spectral_irradiance(sun, 850e-9, 10e-9) == pytest.approx(0.93e9, rel=0.05)
    assert spectral_irradiance(sun, 940e-9, 40e-9) == pytest.approx(0.4e9, rel=0.15)
    assert spectral_irradiance(lamp, 940e-9, 40e-9) < 1e-3 * spectral_irradiance(lamp, 600e-9, 40e-9)
    assert spectral_irradiance(lamp, 940e-9, 40e-9) > 0


def test_irradiance_is_linear_in_illuminance_and_none_in_darkness():
    for source in ("sun", "indoor"):
        one, ten, none = (spectral_irradiance(Ambient(lux, source), 670e-9, 1e-8) for lux in (10.0, 100.0, 0.0))
        assert ten == pytest.approx(10 * one)
        assert none == 0


def face_like():
    """A ball of a head's size at 0.4 m, and rays over most of it."""
    ball = Body(Sphere(0.09), poses=rigid(None, (0.49, 0.0, 0.0)))
    scene = Scene((ball,), name="ball", ambient=Ambient(300.0, "indoor"))
    across, up = np.meshgrid(np.linspace(-0.15, 0.15, 24), np.linspace(-0.15, 0.15, 24))
    return scene, np.stack([np.ones(576), across.ravel(), up.ravel()], axis=1)


def test_the_single_photon_preset_sees_a_face_indoors_with_few_photons_and_little_pile_up():
    scene, directions = face_like()
    rays = rays_towards(directions, (0.0, 1.0))
    histograms = captured(scene, rays, PHOTON_EFFECTS)
    truth, found = simulate(scene, rays)[0], simulate(scene, rays, physics=Physics(DETECTOR, PHOTON_EFFECTS))[0]
    with np.errstate(invalid="ignore"):
        outliers = found.returned & ~(np.abs(found.range_m - truth.range_m) < 0.01)
    counts = histograms.counts.sum(axis=1)[truth.returned]
    assert 50 < np.median(counts) < 300
    assert np.median(counts / histograms.pulses[truth.returned]) < 0.1
    assert found.returned[truth.returned].mean() > 0.99
    assert outliers.mean() < 0.01
    good = truth.returned & found.returned & ~outliers
    assert np.sqrt(np.mean((found.range_m - truth.range_m)[good] ** 2)) < 0.0006


def test_captures_hold_the_photons_that_returns_are_read_from():
    scene, directions = face_like()
    rays = rays_towards(directions, (0.3, 0.6))
    histograms = captured(scene, rays, PHOTON_EFFECTS)
    found = simulate(scene, rays, physics=Physics(DETECTOR, PHOTON_EFFECTS))[0]
    sure = found.returned & (histograms.counts.max(axis=1) > 10)
    highest = histograms.start_m + histograms.width_m * (histograms.counts.argmax(axis=1) + 0.5)
    assert sure.sum() > 300
    assert np.abs(highest - found.range_m)[sure].max() < metres(3 * DETECTOR.timing_sigma_s)


def test_captures_are_as_long_as_each_gate():
    scene, _ = face_like()
    gates = np.array([[0.3, 0.6], [0.5, 0.5], [0.39, 0.41]])
    histograms = captured(scene, rays_along(np.tile([1.0, 0.0, 0.0], (3, 1)), gates), PHOTON_EFFECTS)
    assert np.array_equal(histograms.number, np.ceil(np.diff(gates)[:, 0] / histograms.width_m))
    assert histograms.counts.shape == (3, histograms.number.max())
    assert histograms.counts[2, histograms.number[2] :].sum() == 0
    assert histograms.counts[0].sum() > 0
    assert histograms.counts[1].sum() == 0


def test_captures_of_no_rays_are_empty_and_need_a_detector_that_counts_photons():
    scene, directions = face_like()
    assert captured(scene, rays_towards(np.zeros((0, 3)), (0.3, 0.6)), PHOTON_EFFECTS).counts.shape == (0, 0)
    with pytest.raises(ConfigError, match="counts no photons"):
        captured(scene, rays_towards(directions, (0.3, 0.6)), {"jitter"}, load_detector("ideal"))


@pytest.mark.parametrize("choice", ["auto", "none", "all"])
def test_gates_that_a_detector_cannot_hear_are_refused_whatever_is_simulated(choice):
    scene, directions = face_like()
    short = replace(DETECTOR, bins=100)
    with pytest.raises(ConfigError, match="longer than the histogram"):
        Planner(short, choice).plan(scene, [rays_towards(directions, (0.3, 0.6))])
