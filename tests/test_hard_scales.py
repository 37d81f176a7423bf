"""Moving scenes far from the origin, tiny and huge: the target density is that of the scene at home in metres."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lidardesign.density.frames import FramesTarget
from lidardesign.density.settings import DensitySettings
from lidardesign.density.target import build_target
from lidardesign.scene import Body, Box, Capsule, Plane, Scene, Sphere, rigid
from lidardesign.space import DesignSpace

FRAMES = 5


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARDESIGN_CACHE", str(tmp_path / "cache"))


def moving_scene(scale=1.0, offset=(0.0, 0.0, 0.0), half_length=0.1):
    """A ball under a capsule, beside a box and above a floor; all but the floor move."""
    share = np.linspace(0, 1, FRAMES)
    start, step = np.array([-0.2, 0.1, 0.3]), np.array([0.4, -0.1, 0.1])

    def along(away):
        places = [np.array(offset) + scale * (start + s * step + np.array(away)) for s in share]
        return np.stack([rigid(translation_m=place) for place in places])

    half = (0.05 * scale, 0.04 * scale, 0.03 * scale)
    return Scene(
        (
            Body(Sphere(0.04 * scale), "ball", "target", along((0, 0, 0))),
            Body(Capsule(0.03 * scale, half_length * scale), "arm", "occluder", along((0.05, 0, 0.25))),
            Body(Box(half), "box", "both", along((0.2, 0.2, 0))),
            Body(Plane(), "floor", "occluder", rigid(translation_m=offset)),
        ),
        "moving",
    )


def target_of(scale=1.0, offset=(0.0, 0.0, 0.0), **shape):
    low = np.array(offset) + scale * np.array([-0.5, -0.5, 1.0])
    high = np.array(offset) + scale * np.array([0.5, 0.5, 1.0])
    space = DesignSpace((*low, 0.0, -math.pi / 2, 0.1 * scale), (*high, 2 * math.pi, -math.pi / 4, 1.5 * scale))
    settings = DensitySettings(
        sigma_m=0.03 * scale,
        attenuation_per_m=40.0 / scale,
        margin_m=0.03 * scale,
        surface_tolerance_nats=30.0,
    )
    target = build_target([moving_scene(scale, offset, **shape)], space, settings, visibility="raycast")
    assert isinstance(target, FramesTarget)
    return target


def points_of(scale=1.0, offset=(0.0, 0.0, 0.0), count=400):
    space = DesignSpace((-0.5, -0.5, 1.0, 0.0, -math.pi / 2, 0.1), (0.5, 0.5, 1.0, 2 * math.pi, -math.pi / 4, 1.5))
    points = space.sample(count, np.random.default_rng(0))
    points[:, :3] = np.array(offset) + scale * points[:, :3]
    points[:, 5] *= scale
    return points


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_moving_scene_of_another_size_has_the_same_density(scale):
    # rounding of distances, 1e-16 of the scene, times distance / sigma^2 of up to 30 sigma
    np.testing.assert_allclose(
        target_of(scale).log_density(points_of(scale)), target_of().log_density(points_of()), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("offset", [(1e5, -1e5, 1e5), (-3e4, 0.0, 2e5)])
def test_a_moving_scene_far_from_the_origin_has_the_same_density(offset):
    # coordinates of 1e5 m are known to 1.5e-11 m, which up to 30 sigma away changes the exponent by some 1e-8
    far, home = target_of(offset=offset).log_density(points_of(offset=offset)), target_of().log_density(points_of())
    np.testing.assert_allclose(far, home, rtol=1e-9, atol=1e-9)


def test_a_capsule_without_length_is_a_ball_in_moving_scenes_too():
    target = target_of(half_length=0.0)
    assert np.isfinite(target.log_density(points_of())).all()
