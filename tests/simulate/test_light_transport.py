"""Single bounces agree with a light-transport simulator: when they arrive, and how much light there is of each.

Without the simulator only its process and its absence are tested; everything else is skipped, with the reason.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.transients import binned, flood, needs_simulator, pixel_rays, rays_from, spiral, spot

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.scenes.casting import shared_caster
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Mesh,
    Plane,
    Receiver,
    Scene,
    Sphere,
    rigid,
)
from lidardesign.simulate.detector.light import Beams, Echoes, direct_echoes
from lidardesign.simulate.effects.motion import still_tracer
from lidardesign.simulate.effects.shadowing import visible_echoes
from lidardesign.simulate.light_transport import transport as process
from lidardesign.simulate.light_transport.transport import Lights, PathBins, render_transient
from lidardesign.task import load_task

# float32 intersections against float64 ones: 1e-7 of lengths, some ten times that where surfaces are curved or grazed
ENERGY, MOST_ENERGY = 1e-5, 5e-3
BIN_M = 0.0075
PULSE_FWHM_M = 0.015
VIEW_RAD = 0.9
TURNED = Rotation.random(random_state=1).as_matrix()


def plane_scene() -> Scene:
    facing = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    tilted = facing @ np.array([[math.cos(0.4), 0, math.sin(0.4)], [0, 1, 0], [-math.sin(0.4), 0, math.cos(0.4)]])
    return Scene((Body(Plane(), reflectance=0.7, poses=rigid(tilted, (0.5, 0.02, -0.01))),), "plane")


def sphere_scene() -> Scene:
    return Scene((Body(Sphere(0.12), reflectance=0.4, poses=rigid(TURNED, (0.45, 0.01, 0.02))),), "sphere")


@lru_cache(maxsize=1)
def face_scene() -> Scene:
    """A head of the face task, looked at along +x from 0.4 m."""
    task = load_task("face")
    config = task.Config(train=2, test=2)
    (head,) = task.scenes(config, "test", 0)[0].bodies
    about = rigid(np.diag([-1.0, -1.0, 1.0]), (0.4, 0, 0))
    return Scene((replace(head, poses=about @ head.pose(0), velocity_m_s=(0.0, 0.0, 0.0), specular=0.0),), "face")


SCENES = {"plane": plane_scene, "sphere": sphere_scene, "face": face_scene}
BISTATIC = Receiver((-0.01, 0.06, 0.02), -0.1, 0.0, VIEW_RAD, VIEW_RAD, (0.0, 5.0))


def single_bounces(scene: Scene, rays: Rays) -> Echoes:
    """Our direct echoes that the receiver, where there is one, has in sight."""
    caster, beams = shared_caster(scene, 0), Beams.of(rays)
    hits = caster.first_hit(rays.origin_m, rays.direction)
    echoes = direct_echoes(scene, beams, hits)
    return echoes if scene.receiver is None else visible_echoes(scene, beams, hits, echoes, still_tracer(caster))


def histogram(path_m: np.ndarray, weight: np.ndarray, bins: PathBins) -> np.ndarray:
    """Whole paths by bins, each spread as a pulse."""
    cell = np.floor((path_m - bins.start_m) / bins.width_m).astype(int)
    inside = (cell >= 0) & (cell < bins.count)
    sharp = np.bincount(cell[inside], weight[inside], bins.count)
    away = np.arange(-bins.count + 1, bins.count) * bins.width_m
    pulse = np.exp(-4 * math.log(2) * (away / (2 * PULSE_FWHM_M)) ** 2)
    return np.convolve(sharp, pulse / pulse.sum(), mode="valid")


@needs_simulator
@pytest.mark.parametrize("receiver", [None, BISTATIC], ids=["co-located", "bistatic"])
@pytest.mark.parametrize("name", SCENES)
def test_every_ray_has_the_gain_and_the_time_of_the_direct_component(name, receiver):
    scene = replace(SCENES[name](), receiver=receiver)
    rays = rays_from((0, 0, 0), spiral(4000, 0.3))
    echoes = single_bounces(scene, rays)
    # light is sent from the receiver: what is then seen along a beam is its gain
    lights = flood(np.zeros((1, 3))) if receiver is None else Lights.receiver(receiver)
    found = render_transient(scene, 0, rays, lights, PathBins(BIN_M, 400))
    gain, path_m = np.zeros(len(rays)), np.zeros(len(rays))
    gain[echoes.ray], path_m[echoes.ray] = echoes.gain, 2 * echoes.path_m
    lit = gain > 0
    # a ray past the very edge of a silhouette or a shadow may fall on either side in float32
    assert np.mean(lit != (found.steady > 0)) < 2e-3
    both = np.flatnonzero(lit & (found.steady > 0))
    assert len(both) > 1000
    ratio = found.steady[both] / gain[both]
    assert abs(ratio.mean() - 1) < ENERGY
    assert np.quantile(np.abs(ratio - 1), 0.99) < 10 * ENERGY
    assert np.abs(ratio - 1).max() < MOST_ENERGY
    peak = found.bins.centres_m[binned(found)[both].argmax(axis=1)]
    # within its bin; paths that end on a bin's edge may round to the next
    assert np.abs(peak - path_m[both]).max() < BIN_M / 2 + 1e-6


@needs_simulator
@pytest.mark.parametrize(
    ("name", "emitter_m"), [("sphere", (0.0, 0.0, 0.0)), *((name, (-0.02, -0.08, 0.05)) for name in ("plane", "face"))]
)
def test_the_transient_of_a_whole_view_has_the_same_peak_and_energy(name, emitter_m):
    """Forward: a spot light of 1 W and a camera of the simulator's, against our beams from the emitter."""
    receiver = Receiver((0, 0, 0), 0.0, 0.0, VIEW_RAD, VIEW_RAD, (0.0, 5.0))
    scene, half_rad, count = replace(SCENES[name](), receiver=receiver), 0.35, 60_000
    axis = np.array([0.45, 0, 0]) - np.asarray(emitter_m)
    rays = rays_from(emitter_m, spiral(count, half_rad, tuple(axis)))
    echoes = single_bounces(scene, rays)
    bins = PathBins(BIN_M, 320)
    ours = histogram(2 * echoes.path_m, echoes.gain / count, bins)
    pixels, solid_sr = pixel_rays(receiver, 240, 240)
    solid_angle = 2 * math.pi * (1 - math.cos(half_rad))
    lights = spot(np.array([emitter_m]), axis[None], half_rad, 1 / solid_angle)
    found = render_transient(scene, 0, pixels, lights, bins)
    seen = np.bincount(found.cell, found.radiance * solid_sr[found.ray], bins.count)
    theirs = histogram(bins.centres_m, seen, bins)
    # two quadratures of one integral: edges of cone, silhouettes and shadows are met to within a pixel
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.005)
    assert abs(ours.argmax() - theirs.argmax()) <= 1
    assert np.abs(ours - theirs).sum() < 0.01 * theirs.sum()


@needs_simulator
@pytest.mark.parametrize("shape", [Sphere(0.3), Box((0.2, 0.3, 0.25)), Capsule(0.2, 0.25), Plane()], ids=repr)
@pytest.mark.parametrize("offset_m", [0.0, 1e5])
def test_every_shape_is_exported_where_it_is(shape, offset_m):
    place = np.array([1.5 + offset_m, 0.2, 0.1])
    scene = Scene((Body(shape, reflectance=0.6, poses=rigid(TURNED, place)),))
    rays = rays_from((offset_m, 0.0, 0.0), spiral(500, 0.3), far_m=100.0)
    echoes = single_bounces(scene, rays)
    found = render_transient(scene, 0, rays, flood(rays.origin_m[:1]), PathBins(0.01, 1))
    assert (np.flatnonzero(found.steady > 0) == echoes.ray).mean() == 1
    np.testing.assert_allclose(found.steady[echoes.ray], echoes.gain, rtol=MOST_ENERGY)


@needs_simulator
@pytest.mark.parametrize("shape", [Cylinder(0.2, 0.25), Ellipsoid((0.2, 0.3, 0.25))], ids=repr)
def test_shapes_that_the_renderer_takes_as_meshes_send_back_as_much_light(shape):
    scene = Scene((Body(shape, poses=rigid(TURNED, (1.5, 0.2, 0.1))),))
    rays = rays_from((0.0, 0.0, 0.0), spiral(500, 0.3), far_m=100.0)
    echoes = single_bounces(scene, rays)
    found = render_transient(scene, 0, rays, flood(rays.origin_m[:1]), PathBins(0.01, 1)).steady
    assert ((found > 0) == np.isin(np.arange(500), echoes.ray)).mean() > 0.99
    # flat sides are half a degree off where the shape is round
    assert found.sum() == pytest.approx(echoes.gain.sum(), rel=MOST_ENERGY)
    assert np.abs(found[echoes.ray] / echoes.gain - 1).mean() < 2 * MOST_ENERGY


@needs_simulator
def test_meshes_are_shaded_on_both_sides_and_follow_their_poses():
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), "unsigned")
    away = rigid(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), (5, 0, 0))
    near = rigid(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), (2, 0, 0))
    scene = Scene((Body(mesh, reflectance=0.5, poses=np.stack([away, near])),))
    # not onto the edge that both triangles share
    rays = rays_from((0, 0.3, 0.1), np.array([[1.0, 0, 0]]))
    for frame, distance_m in ((0, 5.0), (1, 2.0)):
        found = render_transient(scene, frame, rays, flood(rays.origin_m), PathBins(0.1, 200, -0.05))
        assert found.steady[0] == pytest.approx(0.5 / (math.pi * distance_m**2), rel=1e-5)
        assert found.cell.tolist() == [round(2 * distance_m / 0.1)]
    behind = replace(scene, bodies=(replace(scene.bodies[0], poses=away),))
    back = rays_from((7, 0.3, 0.1), np.array([[-1.0, 0, 0]]))
    found = render_transient(behind, 0, back, flood(back.origin_m), PathBins(0.1, 200))
    assert found.steady[0] == pytest.approx(0.5 / (math.pi * 4), rel=1e-5)


@needs_simulator
@pytest.mark.parametrize("bounces", [1, 2, 4, 7])
def test_light_within_a_ball_adds_up_to_the_geometric_series(bounces):
    """Inside a matt ball every bounce lights all of it evenly: E_k = rho^k Phi / (4 pi R^2), Ulbricht's sphere."""
    radius_m, reflectance = 1.5, 0.6
    scene = Scene((Body(Sphere(radius_m), reflectance=reflectance),))
    rays = rays_from((0, 0, 0), spiral(200, math.pi))
    lights = flood(np.zeros((1, 3)), 1 / (4 * math.pi))
    found = render_transient(scene, 0, rays, lights, PathBins(0.1, 400, -0.05), bounces=bounces, samples=256, seed=5)
    once = reflectance / (math.pi * 4 * math.pi * radius_m**2)
    series = once * sum(reflectance**k for k in range(bounces))
    spread = found.steady.std() / math.sqrt(len(rays))
    assert found.steady.mean() == pytest.approx(series, abs=4 * spread + 1e-5 * series)
    # a chord is 4 R / 3 long on average
    late_m = binned(found).mean(axis=0) @ found.bins.centres_m / found.steady.mean()
    share = np.array([reflectance**k for k in range(bounces)]) / sum(reflectance**k for k in range(bounces))
    assert late_m == pytest.approx(2 * radius_m + share @ np.arange(bounces) * 4 * radius_m / 3, rel=0.01)


@needs_simulator
def test_what_a_ray_sees_does_not_depend_on_the_rays_after_it():
    scene = Scene((Body(Box((1, 1, 1)), reflectance=0.5),))
    many = rays_from((0.1, 0, 0), spiral(40, 1.0))
    lights, bins = flood(np.array([[0.2, 0.1, 0.3]])), PathBins(0.05, 200)
    whole, part = (
        render_transient(scene, 0, rays, lights, bins, bounces=4, samples=64, seed=3)
        for rays in (many, many.subset(np.arange(20)))
    )
    # sums are made in any order
    np.testing.assert_allclose(binned(whole)[:20], binned(part), rtol=1e-4, atol=1e-9)
    other = render_transient(scene, 0, many, lights, bins, bounces=4, samples=64, seed=4)
    assert np.abs(other.steady - whole.steady).max() > 1e-4 * whole.steady.max()


def test_versions_are_read_from_the_names_of_libraries():
    names = ("libLLVM-19.so", "libLLVM-19.so.1", "libLLVM.so.19.1", "libLLVM-14.0.6.so.1", "libLLVMSupport.so")
    assert [process.llvm_version(name) for name in names] == [19, 19, 19, 14, None]


def test_an_old_or_absent_library_is_not_used_even_if_it_is_named(monkeypatch, tmp_path):
    for name, usable in (("libLLVM-15.so", False), ("libLLVM-19.so", True), ("mine.so", True)):
        path = tmp_path / name
        path.touch()
        monkeypatch.setenv(process.LLVM_VARIABLE, str(path))
        assert (process.llvm_library() == str(path)) == usable
    monkeypatch.setenv(process.LLVM_VARIABLE, str(tmp_path / "absent.so"))
    assert process.llvm_library() is None


def test_without_the_simulator_the_reason_and_the_remedy_are_given(monkeypatch):
    process.end_worker()
    monkeypatch.setattr(process, "PACKAGES", {"no_such_renderer": (1, 0)})
    assert process.missing() is not None
    with pytest.raises(ConfigError, match="not installed: no_such_renderer") as caught:
        process.ask({}, {})
    assert "lidardesign[transport]" in str(caught.value)
    assert "libllvm19" in str(caught.value)


def test_a_simulator_that_is_too_old_is_not_used(monkeypatch):
    monkeypatch.setattr(process, "PACKAGES", {"numpy": (1, 0)})
    assert "numpy" not in (process.missing() or "")
    monkeypatch.setattr(process, "PACKAGES", {"numpy": (99, 1)})
    assert "too old: 99.1 or newer" in process.missing()


@pytest.mark.parametrize(
    ("work", "words", "limit_s"),
    [
        ("aborts", ("crashes while it renders (Aborted)", "LLVM ERROR: Cannot select", "libllvm19"), 60),
        ("leaves", ("exit code 3",), 60),
        ("hangs", ("no answer within", "fewer rays"), 0.1),
    ],
)
def test_a_process_that_dies_or_takes_too_long_is_reported_with_what_it_said(monkeypatch, work, words, limit_s):
    process.end_worker()
    monkeypatch.setattr(process, "WORKER", f"support.work:{work}")
    monkeypatch.setattr(process, "missing", lambda: None)
    with pytest.raises(NumericalError) as caught:
        process.ask({}, {}, limit_s=limit_s)
    assert all(word in str(caught.value) for word in words)
    assert not process._running


@needs_simulator
def test_the_simulator_runs_from_any_folder_and_is_imported_in_its_own_process_alone(tmp_path, monkeypatch):
    (tmp_path / "mitsuba.py").write_text("raise SystemExit('the wrong one')")
    monkeypatch.chdir(tmp_path)
    process.end_worker()
    rays = rays_from((0, 0, 0), spiral(4, 0.1))
    assert render_transient(sphere_scene(), 0, rays, flood(rays.origin_m[:1]), PathBins(0.1, 9)).steady.all()
    assert not {"mitsuba", "drjit", "mitransient"} & set(sys.modules)


@needs_simulator
def test_a_request_that_fails_is_reported_and_the_next_one_is_answered():
    with pytest.raises(NumericalError, match="KeyError"):
        process.ask({}, {})
    rays = rays_from((0, 0, 0), spiral(10, 0.1))
    assert render_transient(sphere_scene(), 0, rays, flood(np.zeros((1, 3))), PathBins(0.1, 10)).steady.all()
