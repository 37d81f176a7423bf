"""Air: exponentials of the whole way, and haze whose counts are the lidar equation's integral."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import exp1
from support.rays import rays_along

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import path_windows
from lidardesign.scenes.scene import Body, Box, Medium, Receiver, Scene, rigid
from lidardesign.simulate.detector.light import Background, Beams, direct_echoes
from lidardesign.simulate.detector.physics import IDEAL, Detector, Photons
from lidardesign.simulate.effects.atmosphere import through_air
from lidardesign.simulate.effects.footprint import split_beams

PHOTONS = Photons(905e-9, 1e-6, 1e4, "scanned", 1e6, 1e-6, 1e-4, 0.2, 1e-9, 1e3, 0.0)
COUNTING = Detector("counting", photons=PHOTONS)
GATE_M = (0.5, 8.0)
FOG = Medium(extinction_per_m=0.3, backscatter_per_m_sr=0.015)
WALL = Body(Box((0.1, 20, 20)), poses=rigid(translation_m=(5.1, 0, 0)))


def in_air(scene, rays, detector=COUNTING):
    beams = split_beams(Beams.of(rays), detector)
    hits = SceneCaster(scene).first_hit(beams.origin_m, beams.direction)
    echoes = direct_echoes(scene, beams, hits)
    background = Background(np.zeros(len(rays)))
    windows_m = path_windows(rays, scene.receiver)
    return echoes, *through_air(scene, rays, beams, hits, windows_m, echoes, detector, background)


def integral(low_m, high_m, medium=FOG):
    """Of exp(-2 alpha r) / r^2, in closed form by the exponential integral (Abramowitz, Stegun 5.1)."""
    rate = 2 * medium.extinction_per_m

    def primitive(r):
        return -math.exp(-rate * r) / r + rate * exp1(rate * r)

    return primitive(high_m) - primitive(low_m)


def test_light_fades_over_its_way_out_and_back():
    for receiver in (None, Receiver((0.0, 2.0, 0.0), 0.0, 0.0, 3.0, 3.0, (0.0, 99.0))):
        echoes, faded, _ = in_air(Scene((WALL,), medium=FOG, receiver=receiver), rays_along([[1.0, 0, 0]], GATE_M))
        whole = 10.0 if receiver is None else 5.0 + math.hypot(5.0, 2.0)
        assert faded.gain == pytest.approx(echoes.gain * math.exp(-0.3 * whole))
        assert np.array_equal(faded.path_m, echoes.path_m)


def test_haze_up_to_the_surface_sends_back_the_integral_of_the_lidar_equation():
    directions = [[1.0, 0, 0], [math.cos(0.5), math.sin(0.5), 0], [-1.0, 0, 0]]
    _, _, background = in_air(Scene((WALL,), medium=FOG), rays_along(directions, GATE_M))
    unit = PHOTONS.emitted(3) * PHOTONS.efficiency * PHOTONS.aperture_m2 * FOG.backscatter_per_m_sr
    ends = [5.0, 5.0 / math.cos(0.5), 8.0]
    assert background.edges_m[:, 0] == pytest.approx(np.full(3, 0.5))
    assert background.edges_m[:, -1] == pytest.approx(ends)
    # the disc's solid angle is 1e-6 m^2 / r^2 but for 3/4 (aperture radius / r)^2, some 1e-6 here
    expected = [unit * integral(0.5, end) for end in ends]
    assert background.counts.sum(axis=1) == pytest.approx(expected, rel=2e-6)
    cells = [unit * integral(*pair) for pair in zip(background.edges_m[0], background.edges_m[0, 1:], strict=False)]
    assert background.counts[0] == pytest.approx(cells, rel=2e-6)


def test_a_gate_from_the_aperture_on_counts_what_falls_on_the_pixel():
    _, _, background = in_air(Scene((WALL,), medium=FOG), rays_along([[1.0, 0, 0]], (0.0, 8.0)))
    radius, area, pixel = math.sqrt(PHOTONS.aperture_m2 / math.pi), PHOTONS.aperture_m2, PHOTONS.field_of_view_sr

    def profile(r):
        share = min(1.0, pixel / (area * (1 / r - 1 / 5) ** 2))
        return 2 * math.pi * (1 - r / math.hypot(r, radius)) * share * math.exp(-0.6 * r) * FOG.backscatter_per_m_sr

    sharp_from = 1 / (1 / 5 + math.sqrt(pixel / area))
    pieces = [1e-9, radius, 10 * radius, sharp_from, 1.0, 4.0, 4.999999]
    whole = sum(quad(profile, *pair, epsabs=1e-14)[0] for pair in itertools.pairwise(pieces))
    assert background.counts.sum() == pytest.approx(PHOTONS.emitted(1) * PHOTONS.efficiency * whole, rel=2e-3)
    assert (np.diff(background.edges_m) > 0).all()


def test_haze_before_the_sensor_counts_no_more_than_the_pixels_solid_angle():
    # nothing is met, so the pixel is sharp far away: up to sqrt(A / pixel) = 0.1 m haze fills it evenly
    _, _, background = in_air(Scene((WALL,), medium=FOG), rays_along([[-1.0, 0, 0]], (0.01, 0.09)))
    faded = (math.exp(-0.6 * 0.01) - math.exp(-0.6 * 0.09)) / 0.6
    expected = PHOTONS.emitted(1) * PHOTONS.efficiency * FOG.backscatter_per_m_sr * PHOTONS.field_of_view_sr * faded
    # the disc is seen from near under a little less than A / r^2
    assert background.counts.sum() == pytest.approx(expected, rel=1e-3)


def test_gates_behind_the_surface_and_gates_without_width_hear_no_haze():
    for gate in ((6.0, 8.0), (2.0, 2.0)):
        _, _, background = in_air(Scene((WALL,), medium=FOG), rays_along([[1.0, 0, 0]], gate))
        assert background.counts.shape == background.edges_m[:, 1:].shape
        assert not background.counts.any()
        assert np.isfinite(background.edges_m).all()


def test_detectors_without_photons_count_no_haze():
    _, faded, background = in_air(Scene((WALL,), medium=FOG), rays_along([[1.0, 0, 0]], GATE_M), IDEAL)
    assert len(faded) == 1
    assert background.counts is None


def test_behind_an_edge_only_the_light_that_passed_it_is_sent_back():
    plate = Body(Box((0.001, 5.0, 5.0)), poses=rigid(translation_m=(2.001, 5.0, 0.0)))
    wide = Detector("wide", divergence_rad=0.02, footprint_rays=64, photons=PHOTONS)
    _, _, whole = in_air(Scene((WALL,), medium=FOG), rays_along([[1.0, 0, 0]], GATE_M), wide)
    _, _, background = in_air(Scene((plate, WALL), medium=FOG), rays_along([[1.0, 0, 0]], GATE_M), wide)
    assert np.array_equal(whole.edges_m, background.edges_m)
    before, behind = whole.edges_m[0, 1:] < 2.0, whole.edges_m[0, :-1] > 2.001
    assert background.counts[0, before] == pytest.approx(whole.counts[0, before], rel=1e-12)
    # the last cell ends with the farthest part of the beam
    assert background.counts[0, behind][:-1] == pytest.approx(whole.counts[0, behind][:-1] / 2, rel=1e-12)


def test_a_receiver_elsewhere_hears_the_haze_in_its_view_by_the_whole_path():
    receiver = Receiver((0.0, 1.0, 0.0), 0.0, 0.0, 3.0, 3.0, (0.0, 99.0))
    scene = Scene((WALL,), medium=FOG, receiver=receiver)
    _, _, background = in_air(scene, rays_along([[1.0, 0, 0]], (0.5, 8.0)))

    def profile(r):
        return math.exp(-0.3 * (r + math.hypot(r, 1.0))) / (r * r + 1)

    unit = PHOTONS.emitted(1) * PHOTONS.efficiency * PHOTONS.aperture_m2 * FOG.backscatter_per_m_sr
    assert background.counts.sum() == pytest.approx(unit * quad(profile, 0.5, 5.0)[0], rel=1e-5)
    assert background.edges_m[0, [0, -1]] == pytest.approx([(r + math.hypot(r, 1)) / 2 for r in (0.5, 5.0)])


def test_a_rays_haze_depends_on_no_other_ray_but_for_the_shared_energy():
    many = rays_along([[1.0, 0, 0], [0.8, 0.6, 0], [0.0, 0.0, 1.0]], GATE_M)
    _, _, together = in_air(Scene((WALL,), medium=FOG), many)
    _, _, alone = in_air(Scene((WALL,), medium=FOG), many.subset(np.array([1])))
    assert np.array_equal(together.edges_m[1], alone.edges_m[0])
    assert np.array_equal(together.counts[1], alone.counts[0])
