"""Rays towards occupied cells: where they end, how often each cell is aimed at, and spaces with fixed angles."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.baselines import problem_of

from lidardesign.methods.laid_out import Site
from lidardesign.methods.occupancy import AimedPoints, occupancy_grid, occupancy_layout
from lidardesign.methods.returns import RAY_AXES
from lidardesign.scenes.scene import Body, Box, Scene, Sphere, rigid
from lidardesign.space import DesignSpace, direction, observed_point

CEILING = DesignSpace((-1, -1, 1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, -0.2, 2.5))
AISLE = DesignSpace(
    (-0.5, 0.0, 0.0, -math.pi / 2, 0.0, 0.1), (4.0, 0.0, 0.0, -math.pi / 2, math.pi / 2, 5.0), condition=("x_m",)
)
LINE = DesignSpace((0, 0, 0, 0, 0, 0.1), (0, 0, 0, 0, 0, 5.0))
MEASURED = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0), measure="angles")


def balls(frames=6):
    path = np.stack([rigid(translation_m=(0.1 * i - 0.3, 0.2, 0.3)) for i in range(frames)])
    post = Body(Box((0.05, 0.05, 0.5)), "post", "occluder", rigid(translation_m=(0.8, -0.8, 0.5)))
    return [Scene((Body(Sphere(0.1 + 0.02 * i), "ball", "target", path), post)) for i in range(3)]


def boxes():
    return [
        Scene((Body(Box((0.4, 0.1, 0.2)), "box", poses=rigid(translation_m=(x, -1.0 - 0.02 * i, 0.6 + 0.1 * i))),))
        for i, x in enumerate((0.5, 1.5, 2.5))
    ]


AHEAD = [Scene((Body(Sphere(0.3), poses=rigid(translation_m=(2.0 + 0.1 * i, 0.05 * i, 0))),)) for i in range(3)]
CASES = {"ceiling": (CEILING, balls()), "line": (LINE, AHEAD), "fixed origin": (MEASURED, AHEAD)}


def distance_to_cells(grid, origins, directions, reach):
    """Which rays pass through an occupied cell, by marching in tenths of a cell."""
    met = np.zeros(len(origins), dtype=bool)
    for step in np.arange(0, reach, grid.edge_m / 10):
        met |= grid.at(origins + step * directions) > 0
    return met


@pytest.mark.parametrize("case", CASES)
def test_every_ray_passes_through_an_occupied_cell_inside_the_space(case):
    space, train = CASES[case]
    layout = occupancy_layout(problem_of(space, train, 2))
    grid = occupancy_grid(train, space, seed=2)
    points, (start, end) = layout.lay_out(200, Site(space))
    assert points.shape[0] == 200
    looking = direction(points[:, 3], points[:, 4])
    assert distance_to_cells(grid, points[:, :3], looking, space.high[5]).mean() > 0.99
    assert space.low[5] <= start < end
    assert end <= space.high[5] + 1e-9
    filled = np.column_stack([points[:, :RAY_AXES], np.full(200, (start + end) / 2)])
    assert space.contains(filled, tolerance=1e-7).all()


def test_with_conditions_rays_start_at_the_position_and_end_in_its_cells():
    train = boxes()
    layout, grid = occupancy_layout(problem_of(AISLE, train, 2)), occupancy_grid(train, AISLE, seed=2)
    for number, x in enumerate((0.5, 2.4)):
        space = AISLE.at({"x_m": x})
        points = layout.lay_out(100, Site(space, number))[0]
        assert (points[:, 0] == x).all()
        np.testing.assert_allclose(points[:, 3], -math.pi / 2)
        looking = direction(points[:, 3], points[:, 4])
        assert distance_to_cells(grid, points[:, :3], looking, 5.0).all()
    # beyond the last box nothing is occupied: rays are uniform there
    nowhere = layout.lay_out(2000, Site(AISLE.at({"x_m": 3.9}), 2))[0]
    assert np.sin(nowhere[:, 4]).mean() == pytest.approx(0.5, abs=0.03)


def test_probabilities_are_the_share_of_scenes_and_frames_that_a_cell_is_occupied_in():
    train = balls()
    grid = occupancy_grid(train, CEILING, seed=0)
    assert grid.probability.max() <= 1.0
    # a cell at the middle of a ball's path is no surface; the grid's whole is at most every cell in every view
    counts = grid.probability * len(train) * 6
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    spots = np.array([[0.0, 0.2 + 0.1 + 0.02 * i, 0.3] for i in range(3)])
    assert (grid.at(spots - [0, grid.edge_m / 4, 0]) > 0).all()
    assert (grid.at(np.array([[0.8, -0.8, 0.5], [9.0, 9, 9]])) == 0).all()


def test_aiming_and_weighting_draw_the_same_rays():
    """Both ways to draw must agree where both can: with both angles free."""
    grid = occupancy_grid(AHEAD, MEASURED, seed=0)
    aimed, worth = AimedPoints(grid, MEASURED, 0, 0).first(20_000)
    assert (worth == 1).all()
    uniform = replace(MEASURED, measure="solid_angle").sample(600_000, np.random.default_rng(1))
    weights = grid.at(observed_point(uniform)) * uniform[:, 5] ** 2
    for axis in (3, 4, 5):
        expected = np.average(uniform[:, axis], weights=weights)
        spread = math.sqrt(np.average((uniform[:, axis] - expected) ** 2, weights=weights))
        effective = weights.sum() ** 2 / np.square(weights).sum()
        # four standard errors of both means
        margin = 4 * spread * math.sqrt(1 / effective + 1 / len(aimed))
        assert aimed[:, axis].mean() == pytest.approx(expected, abs=margin)


def test_what_was_asked_for_before_changes_no_draw():
    train = balls()
    fresh, used = (occupancy_layout(problem_of(CEILING, train, 5)) for _ in range(2))
    used.lay_out(1500, Site(CEILING))
    used.lay_out(10, Site(CEILING, draw=4))
    for count in (0, 1, 30):
        np.testing.assert_array_equal(fresh.lay_out(count, Site(CEILING))[0], used.lay_out(count, Site(CEILING))[0])
    assert not np.array_equal(fresh.lay_out(30, Site(CEILING))[0], fresh.lay_out(30, Site(CEILING, draw=1))[0])


def test_targets_out_of_reach_and_no_scenes_leave_nothing_to_aim_at():
    behind = [Scene((Body(Sphere(0.1), poses=rigid(translation_m=(-3.0, 0, 0))),))]
    assert occupancy_layout(problem_of(MEASURED, behind, 0)) is None
    assert occupancy_layout(problem_of(MEASURED, [], 0)) is None
