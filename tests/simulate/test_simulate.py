"""First hits, gates and outcomes against closed forms."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.rays import random_fan, rays_along

from lidardesign.errors import ConfigError
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome
from lidardesign.scenes.scene import Ambient, Body, Box, Capsule, Medium, Mesh, Plane, Receiver, Scene, Sphere, rigid
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.light import Beams, direct_echoes
from lidardesign.simulate.detector.physics import EFFECTS, IDEAL, Physics
from lidardesign.simulate.returns import build_casters, followed_light, simulate, simulate_many


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_a_wrong_number_of_casters_is_refused():
    scene = Scene((Body(Sphere(0.5)),))
    with pytest.raises(ConfigError, match="2 casters"):
        simulate(scene, rays_along(np.eye(3)), casters=[SceneCaster(scene)] * 2)


def moving_scene(generator, frames=4):
    """Primitives and a mesh that move, one of each at rest."""
    cube = trimesh.creation.box((0.5, 0.4, 0.3))
    mesh = Mesh(np.asarray(cube.vertices), np.asarray(cube.faces))
    shapes = [Sphere(0.2), Box((0.2, 0.1, 0.3)), Capsule(0.1, 0.3), mesh]

    def poses():
        return [rigid(turn, generator.normal(0, 0.4, 3)) for turn in Rotation.random(frames, generator).as_matrix()]

    return Scene(
        tuple(
            Body(shape, role=role, poses=np.stack(poses())[slice(None) if moves else 0])
            for shape in shapes
            for moves, role in ((True, "both"), (False, "occluder"))
        )
    )


@pytest.mark.hard_case("19")
def test_lists_of_rays_return_the_same_bits_together_as_alone():
    generator = np.random.default_rng(11)
    scene = moving_scene(generator)
    origins = generator.normal(0, 2, (1200, 3))
    ends = np.cumsum([0, 700, 1, 0, 499])
    lists = [
        rays_along(-unit(origins[a:b] + generator.normal(0, 0.2, (b - a, 3))), (0.5, 2.0 + a / 1000), origins[a:b])
        for a, b in itertools.pairwise(ends)
    ]
    casters = build_casters(scene)
    together = simulate_many(scene, lists, casters=casters)
    assert sum(int(returns.returned.sum()) for frames in together for returns in frames) > 500
    for rays, mine in zip(lists, together, strict=True):
        alone = simulate(scene, rays)
        assert [returns.frame for returns in mine] == [0, 1, 2, 3]
        for a, b in zip(mine, alone, strict=True):
            assert a.rays is rays
            for name in ("outcome", "range_m", "body"):
                assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    assert simulate_many(scene, []) == []


EVERYTHING = frozenset(EFFECTS) - {"multipath"}


def test_turning_the_world_changes_no_path_and_no_light():
    """Of bodies that turn and fly, a mirror and a pane, wide beams, haze and sun, heard by a receiver elsewhere."""
    still = rigid(Rotation.from_rotvec((0.3, 0.5, -0.2)).as_matrix(), (2.5, 0.2, 0.0))
    step = rigid(Rotation.from_rotvec((0.1, -0.3, 0.4)).as_matrix(), (0.1, 0.1, -0.1))
    slanted = [Rotation.from_euler("z", yaw).as_matrix() for yaw in (0.6, -0.3)]
    bodies = (
        Body(Box((0.3, 0.5, 0.2)), poses=np.stack([still, still @ step])),
        Body(Sphere(0.4), poses=rigid(translation_m=(2, 1, 0)), velocity_m_s=(1.0, -4.0, 2.0)),
        Body(Box((0.01, 1, 1)), poses=rigid(slanted[0], (3.5, 0, 0)), specular=0.6, reflectance=0.2),
        Body(Box((0.01, 0.3, 0.3)), poses=rigid(slanted[1], (1.2, 0, 0)), transmission=0.8, reflectance=0.1),
        Body(Sphere(6.0)),
    )
    light = {"ambient": Ambient(1e5), "medium": Medium(0.3, 0.02)}
    receiver = Receiver((0.0, 0.5, 0.1), -0.1, 0.2, 1.5, 1.2, (0.0, 9.0))
    world = rigid(Rotation.from_euler("z", 2.2).as_matrix(), (0.3, -2.0, 1.0))
    turn, place = world[:3, :3], world[:3, 3]
    turned = tuple(
        replace(body, poses=world @ body.poses, velocity_m_s=tuple(turn @ body.velocity_m_s)) for body in bodies
    )
    elsewhere = replace(receiver, origin_m=tuple(turn @ receiver.origin_m + place), azimuth_rad=2.1)
    looking, time_s = random_fan(300, 0.5), np.linspace(0, 0.1, 300)
    detector = replace(load_detector("single-photon"), divergence_rad=0.01, footprint_rays=7)
    found = []
    for scene, rays in (
        (Scene(bodies, receiver=receiver, **light), rays_along(looking)),
        (Scene(turned, receiver=elsewhere, **light), rays_along(looking @ turn.T, origin=place)),
    ):
        rays = replace(rays, time_s=time_s)
        found.append(followed_light(scene, 0, rays, SceneCaster(scene), Physics(detector, EVERYTHING)))
    here, there = (one.echoes for one in found)
    assert set(here.body) == {0, 1, 2, 3, 4}
    np.testing.assert_array_equal(here.ray, there.ray)
    np.testing.assert_array_equal(here.body, there.body)
    np.testing.assert_allclose(there.path_m, here.path_m, rtol=1e-7)
    np.testing.assert_allclose(there.gain, here.gain, rtol=1e-6)
    for name in ("per_metre", "edges_m", "counts"):
        here, there = (getattr(one.background, name) for one in found)
        np.testing.assert_allclose(there, here, rtol=1e-6)


BALL = Body(
    Sphere(0.5),
    "ball",
    poses=rigid(translation_m=(2.0, 0.0, 0.0)),
    specular=0.3,
    transmission=0.2,
    velocity_m_s=(1.0, 0.0, 0.0),
)
FLOOR = Body(Plane(), "floor", poses=rigid(translation_m=(0.0, 0.0, -1.0)))

RECEIVERS = {
    "none": None,
    "at the emitter": Receiver((0.0, 0.0, 0.0), 0.0, 0.0, 1.0, 1.0, (0.0, 9.0)),
    "on the ray": Receiver((1.0, 0.0, 0.0), 0.0, 0.0, 1.0, 1.0, (0.0, 9.0)),
    "beside it": Receiver((0.0, 0.3, 0.0), 0.0, 0.0, 1.0, 1.0, (0.0, 9.0)),
    "on the ball": Receiver((1.5, 0.0, 0.0), 0.0, 0.0, 1.0, 1.0, (0.0, 9.0)),
    "on the floor": Receiver((0.0, 0.0, -1.0), 0.0, math.pi / 2, 1.0, 1.0, (0.0, 9.0)),
}


def rays_of(directions, origin=(0.0, 0.0, 0.0), gate=(0.0, 2.5)):
    directions = np.asarray(directions, dtype=float).reshape(-1, 3)
    rays = rays_along(directions / np.linalg.norm(directions, axis=1, keepdims=True), gate, origin)
    return replace(rays, time_s=np.linspace(0.0, 0.1, len(rays)))


RAYS = {
    "no rays": rays_of([]),
    "axes and poles": rays_of([[1, 0, 0], [0, 0, 1], [0, 0, -1], [-1, 0, 0], [1, 1e-9, -0.3]]),
    "gates without width": rays_of([[1, 0, 0], [0, 0, -1]], gate=(1.0, 1.0)),
    "from the ball's surface": rays_of([[1, 0, 0], [0, 0, -1]], origin=(1.5, 0.0, 0.0)),
    "from inside the ball": rays_of([[1, 0, 0]], origin=(2.0, 0.0, 0.0)),
    "from the floor": rays_of([[0, 0, -1], [0, 0, 1]], origin=(0.0, 0.0, -1.0)),
}


@pytest.mark.parametrize("receiver", RECEIVERS.values(), ids=RECEIVERS)
@pytest.mark.parametrize("rays", RAYS.values(), ids=RAYS)
@pytest.mark.parametrize("name", ["single-photon", "consumer-8x8", "ideal"])
def test_every_ray_has_one_outcome_and_a_range_in_its_gate_where_it_returns(receiver, rays, name):
    scene = Scene((BALL, FLOOR), ambient=Ambient(1e5), medium=Medium(0.3, 0.02), receiver=receiver)
    (returns,) = simulate(scene, rays, physics=Physics(load_detector(name), EVERYTHING))
    assert len(returns.outcome) == len(rays)
    assert np.isin(returns.outcome, list(Outcome)).all()
    found = returns.returned
    assert np.array_equal(np.isfinite(returns.range_m), found)
    # ranges are solved from paths: a few roundings beyond a gate's end
    assert (returns.range_m[found] >= rays.gate_m[found, 0] - 1e-9).all()
    assert (returns.range_m[found] <= rays.gate_m[found, 1] + 1e-9).all()
    assert (returns.body[~found] == -1).all()


def test_a_scene_of_mirrors_alone_returns_nothing():
    mirrors = tuple(
        Body(Sphere(radius), poses=rigid(translation_m=(2.0, y, 0.0)), reflectance=0.0, specular=1.0)
        for radius, y in ((0.5, 0.0), (0.4, 1.2))
    )
    rays = rays_of([[1, 0.01, 0.01], [1, 0.2, 0], [1, 0.5, 0]])
    (returns,) = simulate(Scene(mirrors), rays, physics=Physics(IDEAL, frozenset({"specular"})))
    assert not returns.returned.any()
    assert (returns.outcome[:2] == Outcome.NOT_DETECTED).all()


@pytest.mark.parametrize(("reflectance", "gain"), [(0.0, 0.0), (0.5, np.finfo(float).max)])
def test_a_surface_that_touches_the_sensor_blinds_it_unless_it_is_black(reflectance, gain):
    floor = Scene((Body(Plane(), reflectance=reflectance),))
    down = rays_along([0.0, 0.0, -1.0], (0.0, 1.0))
    hits = SceneCaster(floor).first_hit(down.origin_m, down.direction)
    assert hits.range_m == 0
    assert direct_echoes(floor, Beams.of(down), hits).gain == gain
