"""`silhouette` and `lloyd`: exact numbers where training scenes return, gates that hold what they return."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.baselines import balls, problem_of, rays_of

from lidardesign.methods.bounding import bounding_layouts
from lidardesign.methods.laid_out import Site
from lidardesign.methods.returns import TrainingReturns
from lidardesign.methods.silhouette import lloyd_layouts, silhouette_layouts, survey
from lidardesign.scenes.casting import SceneCaster
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import DesignSpace, direction

AHEAD = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
DOWN = DesignSpace((0, 0, 3, 0, -math.pi / 2, 0.05), (0, 0, 3, 2 * math.pi, -0.5, 4.0))
BOX = DesignSpace((-0.3, -0.1, -0.1, -0.5, -0.5, 0.05), (0.1, 0.1, 0.1, 0.5, 0.5, 4.0))
LINE = DesignSpace((0, 0, 0, -0.5, 0, 0.05), (0, 0, 0, 0.5, 0, 4.0))
AROUND = DesignSpace((0, 0, 0, 0, -0.8, 0.05), (0, 0, 0, 2 * math.pi, 0.8, 4.0))
SUBJECTS = {
    "ahead": (AHEAD, balls(np.array([3.0, 0, 0]), count=12)),
    "straight down": (DOWN, balls(np.array([0.05, 0.02, 0.0]), count=12)),
    "from a box": (BOX, balls(np.array([3.0, 0, 0]), count=12)),
    "along a line": (LINE, balls(np.array([3.0, 0, 0]), 0.6, count=12)),
    "all around": (
        AROUND,
        [scene for x in (-2, 2) for scene in balls(np.array([x, 0, 0.0]), 0.9, count=6, seed=x + 9)],
    ),
}
MAKE = {"silhouette": silhouette_layouts, "lloyd": lloyd_layouts}


def laid_out(name, subject, count):
    space, scenes = SUBJECTS[subject]
    (layout,) = MAKE[name](TrainingReturns(space, scenes))
    return layout.lay_out(count, Site(space))


@pytest.mark.parametrize("subject", SUBJECTS)
@pytest.mark.parametrize("name", MAKE)
def test_any_number_is_met_exactly_inside_the_space_where_scenes_return_and_repeats(subject, name):
    space, scenes = SUBJECTS[subject]
    casters = [SceneCaster(scene) for scene in scenes]
    layouts = [MAKE[name](TrainingReturns(space, scenes))[0] for _ in range(2)]
    for count in (0, 1, 70):
        (points, gates), (again, gates_again) = (one.lay_out(count, Site(space)) for one in layouts)
        np.testing.assert_array_equal(points, again)
        np.testing.assert_array_equal(gates, gates_again)
        assert points.shape == (count, 5)
        assert gates.shape == (count, 2)
        middle = np.clip(gates.mean(axis=1), space.low[5], space.high[5])
        assert space.contains(np.column_stack([points, middle])).all()
        np.testing.assert_allclose(points[:, :3], np.tile((np.array(space.low) + space.high)[:3] / 2, (count, 1)))
        looking = direction(points[:, 3], points[:, 4])
        hit = np.any([np.isfinite(one.first_hit(points[:, :3], looking).range_m) for one in casters], axis=0)
        assert hit.sum() >= 0.95 * count


@pytest.mark.parametrize("subject", ["ahead", "straight down", "along a line", "all around"])
def test_gates_hold_what_training_scenes_return(subject):
    space, scenes = SUBJECTS[subject]
    for name, share in (("silhouette", 0.99), ("lloyd", 0.97)):
        points, gates = laid_out(name, subject, 100)
        looking = direction(points[:, 3], points[:, 4])
        ranges = np.stack([SceneCaster(scene).first_hit(points[:, :3], looking).range_m for scene in scenes])
        returned = np.isfinite(ranges)
        held = (ranges >= gates[:, 0]) & (ranges < gates[:, 1])
        assert held.sum() >= share * returned.sum()
        # and they are far shorter than the range that one could listen over
        assert np.median(np.diff(gates, axis=1)) < 0.3 * (space.high[5] - space.low[5])


@pytest.mark.parametrize("subject", ["ahead", "straight down", "all around"])
def test_a_silhouette_is_a_hexagonal_lattice_at_any_pole(subject):
    points, _ = laid_out("silhouette", subject, 300)
    looking = direction(points[:, 3], points[:, 4])
    distance = cKDTree(looking).query(looking, k=7)[0][:, 1:]
    # neighbours are equally far; the spiral over more than a hemisphere is hexagonal on average only
    tolerance = 0.35 if subject == "all around" else 0.05
    assert np.abs(distance[:, 0] / np.median(distance[:, 0]) - 1).max() < tolerance
    inner = np.sort(distance[:, 5])[: len(distance) // 3]
    assert inner.max() < 1.6 * np.median(distance[:, 0])


def test_lloyd_has_more_rays_where_returns_are_frequent_and_surfaces_large():
    space, scenes = SUBJECTS["ahead"]
    found = survey(TrainingReturns(space, scenes), space)
    points, _ = laid_out("lloyd", "ahead", 200)
    table = found.table
    density = table.share**0.75 * table.area_m2_sr**1.5
    here = density[table.nearest(points)]
    assert here.mean() > 1.05 * density[found.supported].mean()


@pytest.mark.parametrize("name", [*MAKE, "bounding"])
def test_where_nothing_returns_there_is_no_candidate_and_the_baseline_is_uniform(name):
    nothing = balls(np.array([-3.0, 0, 0]))
    assert name not in MAKE or MAKE[name](TrainingReturns(AHEAD, nothing)) == []
    own, even = (rays_of(one, problem_of(AHEAD, nothing, rays=9)) for one in (name, "uniform"))
    assert np.array_equal(own.direction, even.direction)


@pytest.mark.parametrize("limit", [0.0, 0.1])
@pytest.mark.parametrize("name", MAKE)
def test_a_bandwidth_is_kept_and_used(name, limit):
    space, scenes = SUBJECTS["ahead"]
    rays = rays_of(name, problem_of(space, scenes, limit_mbps=limit))
    cost = Bandwidth().mbps(rays)
    assert cost <= limit
    assert cost >= 0.9 * limit - 0.003


@pytest.mark.parametrize("subject", ["ahead", "straight down", "from a box"])
def test_bounding_has_gates_per_ray_to_choose_where_a_design_has_them(subject):
    space, scenes = SUBJECTS[subject]
    layouts = {layout.name: layout for layout in bounding_layouts(TrainingReturns(space, scenes), gates_per_ray=True)}
    assert len(layouts) == 2 * len(bounding_layouts(TrainingReturns(space, scenes)))
    plain, gated = (layouts[name].lay_out(100, Site(space)) for name in ("cropped", "cropped, a gate per ray"))
    np.testing.assert_array_equal(plain[0], gated[0])
    assert len(np.unique(plain[1], axis=0)) == 1
    assert Bandwidth().mbps_of_widths(np.diff(gated[1])) < 0.8 * Bandwidth().mbps_of_widths(np.diff(plain[1]))
    looking = direction(gated[0][:, 3], gated[0][:, 4])
    ranges = np.stack([SceneCaster(scene).first_hit(gated[0][:, :3], looking).range_m for scene in scenes])
    held = (ranges >= gated[1][:, 0]) & (ranges < gated[1][:, 1])
    assert held.sum() >= 0.9 * np.isfinite(ranges).sum()
