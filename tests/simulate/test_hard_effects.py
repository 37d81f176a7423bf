"""All effects at once where it is awkward: nothing to fire, on surfaces, inside things, along the baseline."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from support.rays import rays_along
from support.tables import each_row

from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Outcome
from lidardesign.scene import Ambient, Body, Medium, Plane, Receiver, Scene, Sphere, rigid
from lidardesign.simulate.detector.detector import IDEAL
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.light import Beams, direct_echoes
from lidardesign.simulate.physics import EFFECTS, Physics
from lidardesign.simulate.simulate import simulate

EVERYTHING = frozenset(EFFECTS) - {"multipath"}
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


@each_row("receiver", RECEIVERS.values(), ids=RECEIVERS)
@each_row("rays", RAYS.values(), ids=RAYS)
@each_row("name", ["single-photon", "consumer-8x8", "ideal"])
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


@each_row(("reflectance", "gain"), [(0.0, 0.0), (0.5, np.finfo(float).max)])
def test_a_surface_that_touches_the_sensor_blinds_it_unless_it_is_black(reflectance, gain):
    floor = Scene((Body(Plane(), reflectance=reflectance),))
    down = rays_along([0.0, 0.0, -1.0], (0.0, 1.0))
    hits = SceneCaster(floor).first_hit(down.origin_m, down.direction)
    assert hits.range_m == 0
    assert direct_echoes(floor, Beams.of(down), hits).gain == gain
