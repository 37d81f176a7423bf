"""The density of emitters for a fixed receiver: both ways must be free, and the receiver must look there."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import references

from lidardesign.config import DensitySettings
from lidardesign.density.objective.prepare import refine_quadrature
from lidardesign.density.objective.target import build_target
from lidardesign.density.objective.visibility import BistaticVisibility, NoVisibility
from lidardesign.errors import ConfigError
from lidardesign.scenes.scene import Body, Box, Receiver, Scene, Sphere, rigid
from lidardesign.space import RANGE, DesignSpace, aim, observed_point

SPACE = DesignSpace((-0.3, -0.3, -0.3, -0.7, -0.7, 0.2), (0.3, 0.3, 0.3, 0.7, 0.7, 4.0))
SETTINGS = DensitySettings(sigma_m=0.05, attenuation_per_m=20.0, sharpness_per_m=40.0, margin_m=0.05)
CENTRES = ((2.0, 0.0, 0.0), (2.1, 0.2, 0.1))
WIDE = Receiver((0.0, 0.0, 0.0), 0.0, 0.0, math.radians(160), math.radians(160), (0.0, 100.0))


def looking(**changes):
    values = {
        "origin_m": (0.0, 0.25, 0.0), "azimuth_rad": 0.1, "elevation_rad": -0.05,
        "horizontal_rad": math.radians(60), "vertical_rad": math.radians(50), "range_m": (0.1, 3.0),
    }  # fmt: skip
    return Receiver(**{**values, **changes})


def balls(receiver, *further):
    return [
        Scene((Body(Sphere(0.5), poses=rigid(translation_m=centre)), *further), receiver=receiver) for centre in CENTRES
    ]


def plate(centre, half=(0.005, 0.2, 0.2)):
    return Body(Box(half), role="occluder", poses=rigid(translation_m=centre))


def points_near(count=80, seed=0):
    generator = np.random.default_rng(seed)
    points = SPACE.sample(count, generator)
    ahead = np.array([1.5, 0.0, 0.0]) + generator.normal(scale=0.1, size=(count, 3))
    return aim(points[:, :3], ahead)


@pytest.mark.parametrize("visibility", ["raycast", "quadrature", "off"])
def test_the_gradient_agrees_with_differences(visibility):
    occluder = plate((0.8, 0.6, 0.0))
    target = build_target(balls(looking(), occluder), SPACE, SETTINGS, visibility)
    points = points_near()
    values, gradient = target.log_density_and_gradient(points)
    assert np.isfinite(values).all()
    numerical = references.numerical_gradient(
        lambda chart: target.log_density(SPACE.from_chart(chart)), SPACE.to_chart(points), 1e-5
    )
    # a column more or less within the tolerance, or a silhouette, moves single points
    assert (np.isclose(gradient, numerical, rtol=2e-3, atol=2e-2).mean(axis=0) > 0.95).all()


def test_too_few_midpoints_are_refined_also_where_a_receiver_listens():
    scenes = balls(looking(), plate((0.8, 0.0, 0.0), half=(0.02, 0.5, 0.5)))
    few = DensitySettings(sigma_m=SETTINGS.sigma_m, quadrature_points=4)
    coarse = build_target(scenes, SPACE, few, "quadrature")
    finer, notes = refine_quadrature(coarse, points_near())
    assert isinstance(finer.visibility, BistaticVisibility)
    assert finer.visibility.one_way.points > 4
    assert "refined from 4" in notes[0]


def test_a_point_in_full_view_keeps_its_density_and_one_behind_a_plate_loses_it():
    points = points_near(seed=1)
    alone = build_target(balls(None), SPACE, SETTINGS, "off").log_density(points)
    heard = build_target(balls(WIDE), SPACE, SETTINGS, "off").log_density(points)
    assert np.allclose(heard, alone, atol=1e-9)
    clear = alone > alone.max() - 3
    # a plate right in front of the receiver hides everything from it and nothing from emitters beside it
    blind = looking(origin_m=(0.0, 0.0, -0.6), elevation_rad=0.3)
    in_front = plate((0.3, 0.0, -0.5), (0.005, 0.1, 0.1))
    scenes, dark = balls(blind), balls(blind, in_front)
    without, behind = (build_target(s, SPACE, SETTINGS, "raycast").log_density(points) for s in (scenes, dark))
    assert np.all(behind[clear] < without[clear] - 10)


def test_an_emitter_at_the_receiver_has_the_square_of_its_own_visibility():
    receiver = Receiver((0.0, 0.0, 0.0), 0.0, 0.0, math.radians(170), math.radians(170), (0.0, 100.0))
    hidden = plate((1.0, 0.0, 0.0))
    generator = np.random.default_rng(2)
    points = aim(np.zeros((60, 3)), np.array([1.5, 0.0, 0.0]) + generator.normal(scale=0.15, size=(60, 3)))
    ways = {}
    for name, there in (("alone", None), ("heard", receiver)):
        for way in ("off", "raycast"):
            # one scene, so that the sum over scenes does not mix visibilities
            scene = balls(there, hidden)[:1]
            ways[name, way] = build_target(scene, SPACE, SETTINGS, way).log_density(points)
    one_way = ways["alone", "raycast"] - ways["alone", "off"]
    both_ways = ways["heard", "raycast"] - ways["heard", "off"]
    assert one_way.min() < -1
    assert np.allclose(both_ways, 2 * one_way, atol=1e-9)


def test_the_view_is_one_inside_a_half_on_its_edges_and_nothing_outside():
    receiver = looking(origin_m=(0.0, 0.0, 0.0), azimuth_rad=0.0, elevation_rad=0.0)
    way = BistaticVisibility(NoVisibility(), receiver)
    half = receiver.horizontal_rad / 2
    points = np.array([
        [1.0, 0.0, 0.0],
        [math.cos(half), math.sin(half), 0.0],
        [math.cos(half), -math.sin(half), 0.0],
        [math.cos(receiver.vertical_rad / 2), 0.0, math.sin(receiver.vertical_rad / 2)],
        [3.0, 0.0, 0.0],
        [-1.0, 0.0, 0.0],
        [1.0, 1.0, 0.0],
        [3.1, 0.0, 0.0],
        [0.0, 0.0, 0.0],
    ])  # fmt: skip
    values, gradient = way.log_view(points, 0.01)
    assert values[0] == pytest.approx(0.0, abs=1e-6)
    assert values[1:5] == pytest.approx(np.full(4, math.log(0.5)), abs=1e-6)
    assert (values[5:] < -10).all()
    assert np.isfinite(gradient).all()


def test_a_design_point_that_listens_at_the_receiver_itself_stays_finite():
    receiver = looking()
    target = build_target(balls(receiver), SPACE, SETTINGS, "raycast")
    points = aim(np.zeros((1, 3)), np.array([receiver.origin_m]))
    assert np.allclose(observed_point(points), receiver.origin_m)
    values, gradient = target.log_density_and_gradient(points)
    assert points[0, RANGE] > 0
    assert np.isfinite(values).all()
    assert np.isfinite(gradient).all()


def test_scenes_with_different_receivers_are_refused():
    with pytest.raises(ConfigError, match="different receivers"):
        build_target([balls(looking())[0], balls(None)[1]], SPACE, SETTINGS, "raycast")
