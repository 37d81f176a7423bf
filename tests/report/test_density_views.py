"""Views of a density: what is drawn holds all of it, in the right places and units, and the designs' own beside it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr
from support.sensors import normal_sensor

from lidardesign.report.density_views import PERCENT, density_view, marginals, mixture_points, silhouette
from lidardesign.samples import Samples
from lidardesign.scenes.scene import Body, Box, Plane, Scene, Sphere, rigid
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern
from lidardesign.space import AZIMUTH, RANGE, DesignSpace, observed_point

BALL = Scene((Body(Sphere(0.5), "ball", "target", rigid(translation_m=(3.0, 0.0, 0.0))),), "ball")
FIXED = DesignSpace((0, 0, 0, -0.5, -0.4, 1.0), (0, 0, 0, 0.5, 0.4, 4.0))
ANYWHERE = DesignSpace((-1, -1, 0.5, 0.0, -1.0, 0.5), (1, 1, 0.5, 2 * math.pi, 0.2, 3.0))


def samples_of(points, space, log_weights=None):
    weights = np.zeros(len(points)) if log_weights is None else log_weights
    return Samples(points, np.zeros(len(points)), weights, space)


def even(space, count=20_000, seed=0):
    return samples_of(space.sample(count, np.random.default_rng(seed)), space)


def make_sensor(**changes):
    values = {
        "origin_m": (0.1, -0.2, 0.5), "origin_covariance_m2": np.diag([0.04, 0.01, 0.0]), "azimuth_rad": 0.3,
        "elevation_rad": -0.4, "roll_rad": 0.2, "spread_rad": (0.1, 0.05), "range_m": 1.7, "spread_range_m": 0.2,
    }  # fmt: skip
    return normal_sensor(**{**values, **changes})


def held(marginal, heights):
    """The share under heights that are percent per degree, centimetre or metre."""
    per = 100.0 if marginal.unit.endswith("cm") else 1.0
    return float((heights * np.diff(marginal.edges)).sum()) * per / PERCENT


@pytest.mark.parametrize("space", [FIXED, ANYWHERE, replace(ANYWHERE, condition=("x_m",))])
def test_every_free_dimension_has_one_marginal_that_holds_all_but_the_tails(space):
    found = marginals(even(space))
    free = zip(space.as_dict(), space.low, space.high, strict=False)
    expected = [name for name, low, high in free if low < high and name not in space.condition]
    assert [one.dimension for one in found] == expected
    for one in found:
        assert held(one, one.heights) == pytest.approx(1.0, abs=0.003)


def test_an_even_density_is_flat_at_the_height_that_its_width_gives():
    azimuth, _, range_m = marginals(even(FIXED, 100_000))
    assert azimuth.unit == "% per deg"
    inner = azimuth.heights[2:-2]
    assert inner.mean() == pytest.approx(PERCENT / math.degrees(1.0), rel=0.02)
    assert np.ptp(inner) < 0.25 * inner.mean()
    assert range_m.unit == "% per cm"
    assert range_m.heights[2:-2].mean() == pytest.approx(PERCENT / 300.0, rel=0.02)


def test_marginals_are_of_the_weighted_density_and_not_of_the_one_that_was_drawn_from():
    space = FIXED
    points = space.sample(100_000, np.random.default_rng(1))
    mean, spread = 2.5, 0.2
    normal = -0.5 * ((points[:, RANGE] - mean) / spread) ** 2
    range_m = marginals(samples_of(points, space, normal))[-1]
    expected = np.diff(ndtr((range_m.edges - mean) / spread)) / np.diff(range_m.edges)
    assert np.abs(range_m.heights - expected).max() < 0.1 * expected.max()


def test_a_density_across_the_turn_is_one_hump():
    azimuth = np.mod(np.random.default_rng(2).normal(0.0, 0.2, 5000), 2 * math.pi)
    points = np.tile([0.0, 0.0, 0.5, 0.0, -0.2, 1.0], (5000, 1))
    points[:, AZIMUTH] = azimuth
    one = next(m for m in marginals(samples_of(points, ANYWHERE)) if m.dimension == "azimuth_rad")
    assert one.edges[-1] - one.edges[0] < 90.0
    assert abs(np.average((one.edges[1:] + one.edges[:-1]) / 2, weights=one.heights)) < 1.0


def test_an_even_turn_is_shown_from_where_the_space_begins():
    azimuth = next(m for m in marginals(even(ANYWHERE)) if m.dimension == "azimuth_rad")
    assert azimuth.edges[0] == 0.0
    assert azimuth.edges[-1] == pytest.approx(360.0)


def test_a_sensors_origin_and_range_are_normal_beside_the_density():
    found = {m.dimension: m for m in marginals(even(ANYWHERE), [DesignSpec("one", (make_sensor(),))])}
    for name, mean, spread in (("x_m", 0.1, 0.2), ("y_m", -0.2, 0.1), ("range_m", 1.7, 0.2)):
        one = found[name]
        expected = np.diff(ndtr((one.edges - mean) / spread)) / np.diff(one.edges)
        assert np.abs(one.designs["one"] - expected).max() < 0.03 * expected.max()


def test_sensors_count_by_their_weights():
    near, far = make_sensor(name="near", weight=3.0, range_m=1.0), make_sensor(name="far", weight=1.0, range_m=2.5)
    points, weights = mixture_points(DesignSpec("two", (near, far)))
    assert weights.sum() == pytest.approx(1.0)
    assert weights[points[:, RANGE] < 1.75].sum() == pytest.approx(0.75, abs=0.002)


def test_a_pattern_along_a_condition_counts_along_its_whole_way():
    way = np.tile([[0.0], [1.0]], (1, 3))
    origin_m = np.stack([way, 0 * way, 0 * way], axis=2)
    pattern = Pattern(origin_m, 0 * way, 0 * way, np.tile([1.0, 2.0], (2, 3, 1)), np.zeros(3, int), "x_m", (0.0, 1.0))
    points, weights = mixture_points(
        DesignSpec("moving", (make_sensor(origin_covariance_m2=None),), "chosen", (pattern,))
    )
    assert set(np.round(points[:, 0], 6)) == {0.0, 1.0}
    assert weights[points[:, 0] > 0.5].sum() == pytest.approx(0.5)


def test_planes_hold_the_density_where_it_looks():
    samples = even(FIXED)
    planes = density_view(samples, BALL).planes
    spots = observed_point(samples.points)
    assert len(planes) == 2
    for plane in planes:
        across, up = plane.edges
        area = np.outer(np.diff(up), np.diff(across)) * 100.0**2
        assert plane.unit == "% per cm2"
        assert (plane.heights * area).sum() == pytest.approx(PERCENT, rel=0.01)
        middles = (across[1:] + across[:-1]) / 2
        mean = np.average(middles, weights=(plane.heights * area).sum(axis=0))
        assert mean == pytest.approx(spots[:, plane.axes[0]].mean(), abs=0.02)
        assert plane.heights.shape == plane.targets.shape == plane.others.shape


def test_a_flat_world_has_one_plane_and_a_single_spot_none():
    flat = DesignSpace((0, 0, 0, -0.5, 0, 1.0), (0, 0, 0, 0.5, 0, 4.0))
    assert [plane.axes for plane in density_view(even(flat), BALL).planes] == [(0, 1)]
    spot = samples_of(np.tile([0, 0, 0, 0.1, 0.0, 2.0], (5, 1)), FIXED)
    view = density_view(spot, BALL)
    assert view.planes == ()
    assert all(np.isfinite(one.heights).all() and one.top > 0 for one in view.marginals)


def test_one_heavy_sample_is_drawn_without_a_number_that_is_none():
    points = FIXED.sample(50, np.random.default_rng(3))
    heavy = samples_of(points, FIXED, np.r_[0.0, np.full(49, -np.inf)])
    view = density_view(heavy, BALL, [DesignSpec("d", (make_sensor(),))])
    assert view.effective == pytest.approx(1.0)
    for one in view.marginals:
        assert np.isfinite(one.heights).all()
        assert (np.diff(one.edges) > 0).all()


def test_what_stands_out_far_beyond_the_density_is_cut_off():
    pinned = make_sensor(origin_covariance_m2=None)
    one = marginals(even(ANYWHERE), [DesignSpec("pinned", (pinned,))])[0]
    assert one.designs["pinned"].max() > one.top
    assert one.heights.max() < one.top


def test_silhouettes_cover_the_area_of_what_stands_there():
    edges = np.linspace(-1.0, 1.0, 401), np.linspace(-1.0, 1.0, 401)
    ball = Body(Sphere(0.5), "ball", "target")
    block = Body(Box((0.3, 0.2, 0.1)), "block", "occluder", rigid(translation_m=(0.2, 0.1, 0.4)))
    scene = Scene((ball, block, Body(Plane(), "floor", "target")), "things")
    cell = 0.005**2
    assert silhouette(scene, 0, (0, 1), edges).sum() * cell == pytest.approx(math.pi * 0.25, rel=0.03)
    others = silhouette(scene, 0, (0, 1), edges, targets=False)
    assert others.sum() * cell == pytest.approx(0.24, rel=0.05)
    up, across = np.argwhere(others).mean(axis=0) * 0.005 - 1.0
    assert (across, up) == (pytest.approx(0.2, abs=0.02), pytest.approx(0.1, abs=0.02))
