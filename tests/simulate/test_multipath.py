"""Light by way of other surfaces: against closed forms, against its bound, and through the whole pipeline."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.transients import binned, needs_simulator, rays_from, spiral, spot

from lidardesign.scenes.casting import shared_caster
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Body, Box, Mesh, Plane, Receiver, Scene, Sphere, rigid
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.light import Beams, direct_echoes
from lidardesign.simulate.detector.physics import Detector, Physics
from lidardesign.simulate.effects.multipath import interreflections
from lidardesign.simulate.light_transport.detours import Detours, lamp_bound, pixel_bound, series
from lidardesign.simulate.light_transport.transport import Lights, PathBins, render_transient
from lidardesign.simulate.returns import simulate

REFLECTANCE = 0.6
FLOOD, SCANNED = load_detector("consumer-8x8"), load_detector("single-photon")
# wide enough pixels to hear detours at all
WIDE = replace(SCANNED, photons=replace(SCANNED.photons, field_of_view_sr=1e-3))
EMITTER_M = (0.0, 0.0, 0.5)
RECEIVER = Receiver((0.0, 0.3, 0.5), 0.0, -0.4, 1.0, 1.0, (0.0, 10.0))


def corner(receiver: Receiver | None = None) -> Scene:
    """A floor z = 0 and a wall x = 1."""
    upright = rigid(np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), (1.0, 0, 0))
    floor = Body(Plane(), "floor", reflectance=REFLECTANCE)
    return Scene((floor, Body(Plane(), "wall", poses=upright, reflectance=REFLECTANCE)), receiver=receiver)


def room(receiver: Receiver | None = None) -> Scene:
    return Scene((Body(Box((1.0, 1.5, 1.0)), "room", reflectance=REFLECTANCE),), receiver=receiver)


def ball(receiver: Receiver | None = None) -> Scene:
    place = rigid(translation_m=(1.5, 0, 0))
    return Scene((Body(Sphere(0.5), "ball", poses=place, reflectance=REFLECTANCE),), receiver=receiver)


def into_the_corner(count: int = 400) -> Rays:
    return rays_from(EMITTER_M, spiral(count, 0.5, (1.0, 0.0, -0.5)))


def shares(scene: Scene, rays: Rays, detector: Detector) -> tuple[np.ndarray, np.ndarray]:
    """Light by detours over direct light per ray, 0 where none is direct, and its mean delay in half paths [m]."""
    found = interreflections(scene, 0, rays, Physics(detector, frozenset({"multipath"}), seed=2))
    direct = direct_echoes(scene, Beams.of(rays), shared_caster(scene, 0).first_hit(rays.origin_m, rays.direction))
    gain, path_m = np.zeros(len(rays)), np.zeros(len(rays))
    gain[direct.ray], path_m[direct.ray] = direct.gain, direct.path_m
    indirect = np.bincount(found.ray, found.gain, len(rays))
    late = np.bincount(found.ray, found.gain * (found.path_m - path_m[found.ray]), len(rays))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(gain > 0, indirect / gain, 0.0), np.where(indirect > 0, late / indirect, 0.0)


def bounded(scene: Scene, rays: Rays, detector: Detector) -> Detours:
    caster = shared_caster(scene, 0)
    hits = caster.first_hit(rays.origin_m, rays.direction)
    if detector.photons.emission == "flood":
        return lamp_bound(scene, rays, hits, caster, None, 0.15)
    if scene.receiver is None:
        return pixel_bound(scene, rays, hits, caster, detector.photons.field_of_view_sr, 0.0075)
    return lamp_bound(scene, rays, hits, caster, np.asarray(scene.receiver.origin_m), 0.0075)


@needs_simulator
@pytest.mark.parametrize("receiver", [None, RECEIVER], ids=["co-located", "fixed"])
@pytest.mark.parametrize("detector", [FLOOD, WIDE], ids=["flood", "scanned"])
@pytest.mark.parametrize("scene", [ball, lambda receiver: Scene((corner().bodies[0],), receiver=receiver)])
def test_convex_and_flat_bodies_alone_hear_no_detours(scene, detector, receiver):
    share, _ = shares(scene(receiver), into_the_corner(100), detector)
    assert not share.any()
    assert not bounded(scene(receiver), into_the_corner(100), detector).share.any()


@needs_simulator
def test_a_scanned_pixel_hears_its_own_spot_by_way_of_the_wall_as_in_closed_form(monkeypatch):
    """P on the floor, x from the wall: E = rho^2 / (24 pi x^2) falls on it again; its gain is rho E w / pi.

    The integral over the half plane of the wall: x^2 z^2 / r^8 = pi / (24 x^2).
    """
    down = np.array([[0.5, 0.1, -0.5], [0.3, -0.2, -0.5], [0.2, 0.0, -0.5], [0.1, 0.1, -0.5]])
    monkeypatch.setattr("lidardesign.simulate.effects.multipath.MOST_SURFACES", 3)
    # the same four spots many times over: the mean of their estimates is what is tested
    down = np.repeat(down / np.linalg.norm(down, axis=1, keepdims=True), 64, axis=0)
    rays = rays_from(EMITTER_M, down)
    hits = shared_caster(corner(), 0).first_hit(rays.origin_m, rays.direction)
    away_m = 1 - hits.range_m * down[:, 0]
    direct = -down[:, 2] * REFLECTANCE / (math.pi * hits.range_m**2)
    gain = REFLECTANCE**3 * SCANNED.photons.field_of_view_sr / (24 * math.pi**2 * away_m**2)
    share, late_m = shares(corner(), rays, SCANNED)
    ratio = (share * direct / gain).reshape(4, 64)
    error = ratio.std(axis=1) / 8
    assert (error < 0.02).all()
    assert (np.abs(ratio.mean(axis=1) - 1) < 4 * error).all()
    # there and back: never sooner than straight to the wall, but for the width of a cell
    assert (late_m >= away_m - 0.02).all()


@needs_simulator
def test_a_flood_of_rays_hears_what_a_lamp_of_the_same_cone_shows():
    """The spots of rays, even in solid angle, stand for a lamp that lights the cone evenly."""
    rays = into_the_corner(1000)
    share, late_m = shares(corner(), rays, FLOOD)
    lights = spot(rays.origin_m[:1], np.array([[1.0, 0, -0.5]]), 0.5, 1.0)
    bins = PathBins(0.02, 1024)
    indirect = render_transient(corner(), 0, rays, lights, bins, bounces=6, samples=512, direct=False, seed=1)
    direct = render_transient(corner(), 0, rays, lights, bins)
    lamp = indirect.steady / direct.steady
    weight = direct.steady / direct.steady.sum()
    # how densely rays lie is told from six neighbours, worst at the edge of the field
    assert share @ weight == pytest.approx(lamp @ weight, rel=0.15)
    assert np.median(share / lamp) == pytest.approx(1, abs=0.12)
    direct_m = shared_caster(corner(), 0).first_hit(rays.origin_m, rays.direction).range_m
    lamp_late_m = (binned(indirect) @ bins.centres_m / indirect.steady - 2 * direct_m) / 2
    assert np.average(late_m, weights=share * weight) == pytest.approx(
        np.average(lamp_late_m, weights=lamp * weight), rel=0.15
    )


@needs_simulator
def test_a_fixed_receiver_hears_a_beam_by_way_of_the_wall_as_an_integral_says():
    """P on the floor, R before the wall: the double bounce E, P, Q, R summed over a fine grid of Q on the wall."""
    wide = Receiver((0.0, 0.3, 0.5), 0.0, 0.0, 3.0, 3.0, (0.0, 10.0))
    rays = rays_from(EMITTER_M, np.array([[0.6, 0.1, -0.5]]) / math.sqrt(0.62))
    spot = np.array([0.6, 0.1, 0.0])
    step = 0.02
    y, z = np.meshgrid(np.arange(-8, 8, step) + step / 2, np.arange(0, 8, step) + step / 2)
    wall = np.stack([np.ones_like(y), y, z], axis=-1)
    out, back = wall - spot, np.asarray(wide.origin_m) - wall
    out_m, back_m = np.linalg.norm(out, axis=-1), np.linalg.norm(back, axis=-1)
    inside = np.abs(np.arctan2(wall[..., 2] - 0.5, 1.0)) < 1.5
    twice = (z / out_m) * (out[..., 0] / out_m**3) * (-back[..., 0] / back_m**3) * inside
    expected = (REFLECTANCE / math.pi) ** 2 * twice.sum() * step**2
    found = render_transient(
        corner(wide), 0, rays, Lights.receiver(wide), PathBins(0.05, 400), bounces=2, samples=1 << 14, direct=False
    )
    assert found.steady[0] == pytest.approx(expected, rel=0.02)


@needs_simulator
@pytest.mark.parametrize("receiver", [None, RECEIVER], ids=["co-located", "fixed"])
@pytest.mark.parametrize("detector", [FLOOD, WIDE], ids=["flood", "scanned"])
@pytest.mark.parametrize("scene", [corner, room])
def test_the_bound_holds_and_says_something(scene, detector, receiver):
    rays = into_the_corner()
    share, _ = shares(scene(receiver), rays, detector)
    bound = bounded(scene(receiver), rays, detector)
    assert share[bound.chosen].max() > 0
    assert (bound.share >= share[bound.chosen]).mean() > 0.97
    assert bound.share.mean() >= share[bound.chosen].mean()
    if scene is corner:
        assert bound.share.mean() < 8 * share[bound.chosen].mean()
    assert bound.seen.mean() == pytest.approx(1.0 if scene is room else 0.5, abs=0.02)


def test_bounces_add_up_to_a_geometric_series_and_to_a_finite_one_between_white_walls():
    for once in (0.0, 0.3, 0.9):
        assert series(once) == pytest.approx(sum(once**k for k in range(1, 400)))
    assert math.isfinite(series(1.0))


def test_rays_that_meet_nothing_have_no_bound():
    rays = rays_from((0, 0, 5), np.array([[0.0, 0, 1]]))
    assert not len(bounded(ball(), rays, FLOOD).chosen)


@needs_simulator
def test_echoes_name_the_first_hit_and_lie_inside_the_gates():
    rays = into_the_corner(200)
    rays = replace(rays, gate_m=np.tile([0.4, 1.6], (200, 1)))
    found = interreflections(corner(), 0, rays, Physics(FLOOD, frozenset({"multipath"}), 1))
    hits = shared_caster(corner(), 0).first_hit(rays.origin_m, rays.direction)
    assert (found.body == hits.body[found.ray]).all()
    assert (found.gain > 0).all()
    assert not len(np.setdiff1d(found.ray, np.flatnonzero(hits.range_m < 1.6)))
    # bins go on to the next power of two, so that kernels are few
    assert found.path_m.min() > 0.4


@needs_simulator
def test_rays_without_anything_to_hear_have_no_echoes():
    effects = frozenset({"multipath"})
    away = rays_from((0, 0, 5), np.array([[0.0, 0, 1]]))
    assert not len(interreflections(corner(), 0, away, Physics(FLOOD, effects)))
    assert not len(interreflections(corner(), 0, into_the_corner(5), Physics(Detector("line"), effects)))
    none = into_the_corner(5).subset(np.zeros(0, dtype=int))
    assert not len(interreflections(corner(), 0, none, Physics(FLOOD, effects)))


@needs_simulator
def test_detours_add_light_and_move_the_ranges_of_a_flood_by_no_more_than_the_bound():
    """Corners look rounded to flood sensors: ranges grow, most in the crease, and by less than the bound."""
    rays = into_the_corner(64)
    rays = replace(rays, gate_m=np.tile([0.0, 4.0], (64, 1)))
    without, within = (
        simulate(corner(), rays, physics=Physics(FLOOD, frozenset(effects), 3))[0]
        for effects in ({"photon_noise"}, {"photon_noise", "multipath"})
    )
    both = without.returned & within.returned
    assert both.sum() > 50
    moved_m = within.range_m[both] - without.range_m[both]
    bound = bounded(corner(), rays, FLOOD)
    assert 0 < moved_m.mean() < bound.shift_m.mean()


@needs_simulator
def test_a_scan_of_a_concave_mesh_far_from_the_origin_is_rendered_there():
    corners = np.array([[0.0, -1, 0], [1, -1, 0], [1, 1, 0], [0, 1, 0], [1, -1, 1], [1, 1, 1]])
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]), "unsigned")
    found = []
    for offset_m in (0.0, 1e5):
        scene = Scene((Body(mesh, reflectance=REFLECTANCE, poses=rigid(translation_m=(offset_m, 0, 0))),))
        rays = rays_from((offset_m, 0.0, 0.5), spiral(100, 0.3, (1.0, 0.0, -0.5)))
        found.append(shares(scene, rays, WIDE)[0])
    assert found[0].sum() > 0
    np.testing.assert_allclose(found[0], found[1], rtol=0.02, atol=1e-3 * found[0].max())
