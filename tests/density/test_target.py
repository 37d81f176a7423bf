"""The target density against its naive twin, its gradients against differences, and how it behaves far and small."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import references

from lidardesign.config import DensitySettings
from lidardesign.density.objective.target import build_target, nearby_order
from lidardesign.scenes.scene import Body, Capsule, Plane, Scene, Sphere, rigid
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace

FACING = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # turns a plane's +z to face the sensor along -x
SPACE = DesignSpace((-0.1, -0.1, -0.1, -0.5, -0.5, 0.2), (0.1, 0.1, 0.1, 0.5, 0.5, 4.0))
ANGLES = DesignSpace(SPACE.low, SPACE.high, measure="angles")
SETTINGS = DensitySettings(sigma_m=0.05, attenuation_per_m=20.0, sharpness_per_m=40.0, margin_m=0.05)
CENTRES = ((2.0, 0.0, 0.0), (2.1, 0.2, 0.1), (1.8, -0.2, 0.0))


pytestmark = pytest.mark.usefixtures("own_cache")


def ball(centre, radius=0.5, role="both"):
    return Body(Sphere(radius), role=role, poses=rigid(translation_m=centre))


def balls():
    return [Scene((ball(centre),)) for centre in CENTRES]


def points_near(scenes_centres=CENTRES, count=60, seed=0, spread=0.1):
    """Design points that listen around the balls' near sides, away from their silhouettes."""
    generator = np.random.default_rng(seed)
    points = SPACE.sample(count, generator)
    points[:, AZIMUTH], points[:, ELEVATION] = generator.uniform(-0.08, 0.08, (2, count))
    points[:, RANGE] = 1.5 + generator.normal(scale=spread, size=count)
    return points


@pytest.mark.parametrize("visibility", ["off", "raycast"])
def test_the_target_equals_its_naive_twin(visibility):
    target = build_target(balls(), SPACE, SETTINGS.model_copy(update={"surface_tolerance_nats": 500.0}), visibility)
    points = points_near(spread=0.3)

    def transmittance(index, point):
        return references.naive_sphere_log_transmittance(CENTRES[index], 0.5, point, target.optics)

    expected = references.naive_log_target(
        points,
        [references.sphere_distance(centre, 0.5) for centre in CENTRES],
        [0.0] * 3,
        SETTINGS.sigma_m,
        transmittance if visibility == "raycast" else None,
    )
    np.testing.assert_allclose(target.log_density(points), expected, atol=1e-9, rtol=1e-12)


@pytest.mark.parametrize("space", [SPACE, ANGLES], ids=["solid angle", "angles"])
@pytest.mark.parametrize("visibility", ["off", "quadrature", "raycast"])
def test_gradients_match_differences_of_the_values(visibility, space):
    target = build_target(balls(), space, SETTINGS, visibility)
    points = points_near(spread=0.15)
    _, gradient = target.log_density_and_gradient(points)

    def value(chart):
        return target.log_density(space.from_chart(chart))

    numerical = references.numerical_gradient(value, space.to_chart(points), 1e-6)
    # kinks: a margin's end, or a scene that falls below the surface tolerance
    error = np.abs(gradient - numerical) / (1 + np.abs(numerical))
    assert np.quantile(error, 0.98) < 1e-4


@pytest.mark.parametrize(
    ("visibility", "incidence_deg"),
    # at an angle the soft edge of the quadrature reaches into the margin: T is 0.96 at 45 degrees
    [("off", 0.0), ("raycast", 0.0), ("quadrature", 0.0), ("off", 45.0), ("raycast", 45.0)],
)
def test_the_peak_on_a_plane_at_three_metres_moves_less_than_a_millimetre(visibility, incidence_deg):
    scene = Scene((Body(Plane(), poses=rigid(FACING, (3.0, 0, 0))),))
    target = build_target([scene], SPACE, DensitySettings(quadrature_points=1024), visibility)
    azimuth = math.radians(incidence_deg)
    distance = 3.0 / math.cos(azimuth)
    points = np.tile([0.0, 0, 0, azimuth, 0, 0], (4001, 1))
    points[:, RANGE] = distance + np.linspace(-0.02, 0.02, 4001)
    values = target.log_density(points)
    assert abs(points[values.argmax(), RANGE] - distance) < 1e-3
    assert math.exp(values[2000]) > 0.99  # T on the visible surface, where the proximity is 1


def test_a_capsule_without_length_is_a_ball_in_moving_scenes_too():
    poses = np.stack([rigid(translation_m=(1.2, 0.02 * i, 0.0)) for i in range(3)])
    behind = Body(Sphere(0.5), "target", "target", rigid(translation_m=(2.0, 0, 0)))
    capsule, sphere = (
        build_target([Scene((behind, Body(shape, "before", "occluder", poses)))], SPACE, SETTINGS, "raycast")
        for shape in (Capsule(0.1, 0.0), Sphere(0.1))
    )
    points = points_near()
    alone = build_target([Scene((behind,))], SPACE, SETTINGS, "off")
    assert (sphere.log_density(points) < alone.log_density(points)).any()
    np.testing.assert_allclose(capsule.log_density(points), sphere.log_density(points), atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_every_point_is_visited_once(count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    np.testing.assert_array_equal(np.sort(nearby_order(points)), np.arange(count))
