"""Even directions on the sphere: exact numbers, even spacing wherever they look, a pole like any other place."""

import math

import numpy as np
import pytest
from scipy.spatial import ConvexHull, SphericalVoronoi, cKDTree
from scipy.spatial.transform import Rotation
from support.baselines import balls, problem_of, rays_of

from lidardesign.methods.bounding import bounding_layouts
from lidardesign.methods.fields import Patch, Zone, central_field, even_placement
from lidardesign.methods.laid_out import Site
from lidardesign.methods.returns import TrainingReturns
from lidardesign.scenes.scene import Body, Box, Scene, rigid
from lidardesign.space import DesignSpace, angles, direction

SPHERE = DesignSpace((0, 0, 0, 0, -math.pi / 2, 0.05), (0, 0, 0, 2 * math.pi, math.pi / 2, 4.0))
DOWN = DesignSpace((0, 0, 1, 0, -math.pi / 2, 0.1), (0, 0, 1, 2 * math.pi, -0.7, 2.0))
PLACES = {
    "ahead": np.eye(3),
    "the nadir": Rotation.from_euler("y", 90, degrees=True).as_matrix(),
    "beside the zenith": Rotation.from_euler("zyx", (30, -83, 10), degrees=True).as_matrix(),
    "the seam of the turn": Rotation.from_euler("z", 180, degrees=True).as_matrix(),
    "aslant": Rotation.from_euler("zyx", (70, 35, 20), degrees=True).as_matrix(),
}
COUNTS = [0, 1, 2, 36, 101, 400]


def seen(turn, wide=0.5, high=0.3, count=2000):
    """Directions over a rectangle of a tangent plane that is turned to some place."""
    offsets = np.random.default_rng(3).uniform(-1, 1, (count, 2)) * np.tan([wide, high])
    looking = np.column_stack([np.ones(count), offsets]) @ turn.T
    return looking / np.linalg.norm(looking, axis=1, keepdims=True)


def nearest(looking):
    """The angle from each direction to its nearest neighbour [rad]."""
    return 2 * np.arcsin(cKDTree(looking).query(looking, k=2)[0][:, 1] / 2)


@pytest.mark.parametrize("place", PLACES)
def test_a_crop_has_as_even_a_grid_at_any_place_of_the_sphere(place):
    looking = seen(PLACES[place])
    field = central_field(SPHERE, *angles(looking))
    assert isinstance(field, Patch)
    for count in COUNTS:
        rays = direction(*field.grid(count).T)
        assert rays.shape == (count, 3)
        if count < 36:
            continue
        spacing = math.sqrt(field.area_sr / count)
        assert nearest(rays).min() > 0.8 * spacing
        # nothing that was seen is further from a ray than half of a cell's diagonal
        distance = cKDTree(rays).query(looking)[0]
        assert np.quantile(distance, 0.98) < 0.85 * spacing
    # no crop takes in more than the rectangle that was seen, however it is rolled
    plain = math.tan(0.5) * math.tan(0.3) * 4
    assert field.area_sr < 1.1 * plain


@pytest.mark.parametrize("place", PLACES)
def test_lattices_have_hexagonal_cells_of_one_area(place):
    field = central_field(SPHERE, *angles(seen(PLACES[place])))
    spacing = 0.03
    rays = direction(*field.lattice(spacing).T)
    # the projection keeps areas, not shapes: at 30 degrees from its middle distances are within 4 %
    np.testing.assert_allclose(nearest(rays), spacing, rtol=0.06)
    assert len(rays) == pytest.approx(field.area_sr / (math.sqrt(3) / 2 * spacing**2), rel=0.1)


def test_a_zone_is_even_up_to_the_pole():
    zone = Zone(np.array([0.0, -math.pi / 2]), np.array([2 * math.pi, math.pi / 2]))
    assert zone.area_sr == pytest.approx(4 * math.pi)
    for rays in (direction(*zone.grid(1500).T), direction(*zone.lattice(0.1).T)):
        areas = SphericalVoronoi(rays).calculate_areas() * len(rays) / (4 * math.pi)
        assert 0.6 < areas.min() < areas.max() < 1.7
        assert areas.std() < 0.1


@pytest.mark.parametrize(
    "field", [Zone(np.array([0.2, -1.5]), np.array([6.0, 0.4])), central_field(SPHERE, *angles(seen(np.eye(3))))]
)
def test_spread_points_are_even_in_solid_angle_and_in_further_axes(field):
    points = field.spread(4000, 2)
    assert points.shape == (4000, 4)
    half = direction(*points[:2000, 2:].T).mean(axis=0)
    np.testing.assert_allclose(half, direction(*points[2000:, 2:].T).mean(axis=0), atol=0.01)
    for column in points[:, :2].T:
        assert np.abs(np.histogram(column, 20, (0, 1))[0] - 200).max() < 20


def test_what_looks_over_more_than_a_hemisphere_is_a_zone():
    looking = np.random.default_rng(0).normal(size=(500, 3))
    assert isinstance(central_field(SPHERE, *angles(looking)), Zone)


def test_a_sliver_that_bends_is_a_zone_and_keeps_inside_the_space():
    space = DesignSpace((0, 0, 0, 0, 0.7, 0.05), (0, 0, 0, 2.5, 0.701, 4.0))
    azimuth = np.linspace(0, 2.5, 300)
    field = central_field(space, azimuth, np.full(300, 0.7005))
    assert isinstance(field, Zone)
    grid = field.grid(50)
    assert (np.abs(grid[:, 1] - 0.7005) < 6e-4).all()


def test_corners_outside_the_space_are_left_out_and_the_number_stays():
    # a target that reaches beyond what a sensor that looks down may look at
    looking = seen(PLACES["the nadir"], 1.2, 1.2)
    field = central_field(DOWN, *angles(looking[angles(looking)[1] < DOWN.high[4]]))
    for count in COUNTS:
        grid = field.grid(count)
        assert grid.shape == (count, 2)
        assert (grid[:, 1] <= DOWN.high[4] + 1e-9).all()


def boxes(half, turn, places):
    """Scenes of a box each, at some places of a world that is turned."""
    return [Scene((Body(Box(half), "box", "both", rigid(turn, turn @ np.array(place))),)) for place in places]


@pytest.mark.parametrize("count", [64, 400])
def test_bounding_from_straight_above_covers_as_well_as_a_plain_grid_in_the_tangent_plane(count):
    places = np.random.default_rng(2).normal((0, 0, 0.1), (0.02, 0.02, 0), (6, 3))
    (layout,) = bounding_layouts(TrainingReturns(DOWN, boxes((0.3, 0.2, 0.1), np.eye(3), places)))
    points, gates = layout.lay_out(count, Site(DOWN))
    rays = direction(points[:, 3], points[:, 4])
    across, up = np.meshgrid(np.linspace(-0.3, 0.3, 60), np.linspace(-0.2, 0.2, 40))
    top = np.column_stack([across.ravel(), up.ravel()])

    def coverage(looking):
        hits = 0.8 * looking[:, :2] / -looking[:, 2:]
        return cKDTree(hits).query(top)[0].mean()

    half = even_placement(np.array([-0.32, -0.22, 0, 0, 0]), np.array([0.32, 0.22, 0, 0, 0]), count)[:, :2] / 0.8
    plain = np.column_stack([half, -np.ones(count)])
    assert coverage(rays) < 1.05 * coverage(plain)
    assert (gates[:, 0] > 0.75).all()


def test_turning_the_world_turns_bounding():
    # a sensor that may look anywhere; the box ahead of it, below it and aslant
    areas = []
    for turn in PLACES.values():
        scenes = boxes((0.1, 0.4, 0.25), turn, [(1.5, 0.02 * i, 0) for i in range(4)])
        rays = rays_of("bounding", problem_of(SPHERE, scenes, rays=196))
        local = rays.direction @ turn
        areas.append(ConvexHull(local[:, 1:] / local[:, :1]).volume)
    # rolls go in steps of 5 degrees, and few of the rays over the whole sphere see the box
    assert max(areas) < 1.15 * min(areas)


def test_along_an_aisle_every_place_has_a_crop_of_its_own():
    space = DesignSpace((0, 0, 0, 0, 0, 0.1), (3, 0, 0, math.pi, 0, 5.0), condition=("x_m",))
    scenes = balls(np.array([1.5, 1.5, 0.0]), 0.3, 0.02)
    views = TrainingReturns(space, scenes)
    (layout,) = bounding_layouts(views)
    places = [0.0, 1.5, 3.0]
    found = layout.positions([space.at({"x_m": x}) for x in places], 20)
    for x, rays in zip(places, found, strict=True):
        towards = np.array([1.5 - x, 1.5, 0.0])
        middle = math.acos(float(rays.direction.mean(axis=0) @ towards / np.linalg.norm(towards)) - 1e-9)
        assert middle < 0.2
        assert (rays.direction @ towards / np.linalg.norm(towards) > 0.95).all()
        assert (np.abs(rays.gate_m.mean(axis=1) - np.linalg.norm(towards) + 0.15) < 0.15).all()
    # where nothing returns, the crop over all places stands
    blind = DesignSpace((0, 0, 0, 0, 0, 0.1), (30, 0, 0, math.pi, 0, 1.6), condition=("x_m",))
    (layout,) = bounding_layouts(TrainingReturns(blind, scenes))
    assert len(layout.positions([blind.at({"x_m": 29.0})], 7)[0]) == 7
