"""Rays of sensors: exact budgets, even grids, and the sensor that fires a sample of the density."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.designs import SPACE, sensor

from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError
from lidardesign.limits import MOST_RAYS
from lidardesign.rays.proposals import owners
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.pattern import even_subset, grid_rows, grid_tangent
from lidardesign.sensors.sensor import DEFAULT_LEVEL, interval_factor
from lidardesign.space import direction

Z = interval_factor(DEFAULT_LEVEL)


# --- budgets


@pytest.mark.hard_case("35")
@settings(max_examples=200, deadline=None)
@given(
    weights=st.lists(st.floats(0, 1e6), min_size=1, max_size=20).filter(lambda w: max(w) > 1e-3),
    count=st.integers(0, 5000),
)
def test_a_budget_sums_exactly_and_no_share_is_a_whole_ray_off(weights, count):
    shares = split_budget(np.array(weights), count)
    assert shares.sum() == count
    assert (shares >= 0).all()
    quotas = np.array(weights) / math.fsum(weights) * count
    assert np.abs(shares - quotas).max() < 1 + 1e-6
    assert (shares[np.array(weights) == 0] == 0).all()


@pytest.mark.hard_case("35")
@settings(max_examples=50, deadline=None)
@given(weights=st.lists(st.integers(1, 1000), min_size=1, max_size=10, unique=True), count=st.integers(0, 400))
def test_a_budget_does_not_depend_on_the_scale_of_the_weights(weights, count):
    weights = np.array(weights, float)
    assert (split_budget(weights, count) == split_budget(weights / weights.sum(), count)).all()


@pytest.mark.hard_case("35")
@pytest.mark.parametrize(
    ("weights", "count", "shares"),
    [
        # equal sensors: the first ones are ahead
        *[(np.full(7, 1 / 7), 100, [15, 15, 14, 14, 14, 14, 14]), (np.ones(7), 100, [15, 15, 14, 14, 14, 14, 14])],
        # fewer rays than sensors, or none at all
        *[([1, 1, 1, 1.0], 2, [1, 1, 0, 0]), ([0.1, 0.2, 0.7], 1, [0, 0, 1]), ([0.1, 0.2, 0.7], 0, [0, 0, 0])],
        # weights of any size, and none
        *[(np.array([3.0, 1.0]) * scale, 100, [75, 25]) for scale in (1e-300, 1e-160, 1e160, 1e300)],
        *[([0.0, 1.0, 0.0], 3, [0, 3, 0]), ([1.0, 3.0], MOST_RAYS, [MOST_RAYS // 4, 3 * MOST_RAYS // 4])],
        # shares that differ in the tenth decimal tie, in the ninth they do not
        *[([0.5 - 1e-10, 0.5 + 1e-10], 1, [1, 0]), ([0.5 - 2e-9, 0.5 + 2e-9], 1, [0, 1])],
    ],
)
def test_a_budget_is_split_by_largest_remainders(weights, count, shares):
    assert split_budget(np.array(weights), count).tolist() == shares


@pytest.mark.hard_case("35")
@pytest.mark.parametrize(
    ("weights", "count"),
    [
        *[([], 3), ([0.0, 0.0], 3), ([-1.0, 2.0], 3), ([np.nan], 3), ([1.0, np.inf], 3), ([1.0], -1), ([1.0], 2.5)],
        *[([[0.5, 0.5]], 3), (1.0, 3), ([1.0, 1.0], MOST_RAYS + 1)],
    ],
)
def test_a_budget_that_cannot_be_split_is_refused(weights, count):
    with pytest.raises(ConfigError, match="budget"):
        split_budget(np.array(weights), count)


# --- grids


@settings(max_examples=200, deadline=None)
@example(count=0, horizontal=1.0, vertical=1.0)
@given(count=st.integers(0, 700), horizontal=st.floats(0, 6.2), vertical=st.floats(0, 3.1))
def test_a_grid_has_exactly_its_rays_spread_over_rows_that_differ_by_one_at_most(count, horizontal, vertical):
    rows = grid_rows(horizontal, vertical, count)
    assert rows.sum() == count
    if count:
        assert rows.min() >= 1
        assert rows.max() - rows.min() <= 1
    tangent = grid_tangent(horizontal, vertical, count)
    assert tangent.shape == (count, 2)
    assert (np.abs(tangent[:, 0]) <= horizontal / 2).all()
    assert (np.abs(tangent[:, 1]) <= vertical / 2).all()
    if count and min(horizontal, vertical) > 1e-3:
        assert len(np.unique(tangent, axis=0)) == count
        np.testing.assert_allclose(tangent.mean(axis=0)[0], 0, atol=1e-9)
        # of all numbers of rows theirs has the cells that are closest to square
        ratios = np.log(horizontal / vertical * np.square(np.arange(1, count + 1)) / count)
        assert np.abs(ratios)[len(rows) - 1] <= np.abs(ratios).min() + 1e-9
        assert np.abs(np.cumsum(rows) - np.arange(1, len(rows) + 1) * count / len(rows)).max() <= 0.5


@given(across=st.integers(1, 25), up=st.integers(1, 25))
def test_a_budget_in_the_proportion_of_the_field_is_the_regular_grid_with_no_ray_on_the_edge(across, up):
    assert grid_rows(0.03 * across, 0.03 * up, across * up).tolist() == [across] * up
    assert len(grid_rows(0.03 * up, 0.03 * up, up * (up + 1))) == up  # as square as a row more, which is not added
    centres = np.meshgrid((np.arange(across) + 0.5) - across / 2, (np.arange(up) + 0.5) - up / 2)
    expected = 0.03 * np.stack([axis.ravel() for axis in centres], axis=1)
    np.testing.assert_allclose(grid_tangent(0.03 * across, 0.03 * up, across * up), expected, atol=1e-15)


# --- subsets


def test_a_field_without_height_or_width_is_one_even_row():
    row = 0.2 * np.arange(-2, 3)
    np.testing.assert_allclose(grid_tangent(1.0, 0.0, 5), np.stack([row, 0 * row], axis=1), atol=1e-15)
    np.testing.assert_allclose(grid_tangent(0.0, 1.0, 5), np.stack([0 * row, row], axis=1), atol=1e-15)
    assert grid_rows(0.0, 0.0, 5).tolist() == [5]


@given(st.integers(0, 1000), st.integers(0, 40))
def test_an_even_subset_has_its_number_of_distinct_points_in_their_order(seed, count):
    points = np.random.default_rng(seed).integers(0, 3, (40, 2)).astype(float)
    kept = even_subset(points, count)
    assert len(np.unique(kept)) == len(kept) == count
    assert (np.diff(kept) > 0).all()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("pieces", "size"), [(1, 9), (2, 5), (3, 1), (5, 3), (7, 5)])
def test_an_even_subset_of_a_line_is_the_middle_of_equal_pieces(pieces, size, axis):
    points = np.full((pieces * size, 2), 0.3)
    points[:, axis] = np.arange(7, pieces * size + 7)
    assert even_subset(points, pieces).tolist() == list(range(size // 2, pieces * size, size))


@pytest.mark.parametrize(("above", "by_extent", "by_place"), [(4e-10, [0, 1], [2, 3]), (6e-10, [0, 2], [1, 3])])
def test_less_than_half_a_billionth_does_not_decide_how_points_are_halved(above, by_extent, by_place):
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0 + above], [1.0, 1.0 + above]])
    assert even_subset(corners, 2).tolist() == by_extent
    assert even_subset(np.array([[1.0], [0.5 + above], [0.5], [0.0]]), 2).tolist() == by_place


# --- the sensor that fires a sample

NO_RULES = Constraints().rules
AHEAD = {"azimuth_rad": 0.0, "elevation_rad": 0.0, "roll_rad": 0.0}


def owned(sensors, points, level=DEFAULT_LEVEL):
    """The sensor of each point, and the points as they are fired."""
    return owners(sensors, NO_RULES, level, np.asarray(points, dtype=float), SPACE)


def naive_log_density(one, point):
    """The product of normals over the tangent plane and the range, per solid angle."""
    ray, reach = direction(point[3], point[4]), point[5]
    forward, right, up = one.frame
    angle = math.acos(ray @ forward)
    scale = angle / math.sin(angle)
    spread = (*(field / (2 * Z) for field in one.field_of_view_rad), (one.gate_m[1] - one.gate_m[0]) / (2 * Z))
    away = (scale * (ray @ right), scale * (ray @ up), reach - sum(one.gate_m) / 2)
    squares = sum((a / s) ** 2 for a, s in zip(away, spread, strict=True))
    return math.log(one.weight) - squares / 2 - math.log(math.prod(spread)) + math.log(scale)


def test_a_sample_belongs_to_the_sensor_of_the_largest_naive_density_that_sees_it():
    sensors = (
        sensor("a", 0.5), sensor("b", 0.3, azimuth_rad=1.1, spread_rad=(0.3, 0.2)),
        sensor("c", 0.2, elevation_rad=-0.2, range_m=1.2, spread_range_m=0.3),
    )  # fmt: skip
    generator = np.random.default_rng(3)
    points = np.column_stack([
        np.tile(sensors[0].origin_m, (300, 1)), generator.normal(1, 0.3, 300), generator.normal(-0.3, 0.2, 300),
        generator.normal(1, 0.2, 300),
    ])  # fmt: skip
    found, fired = owned(sensors, points)
    np.testing.assert_allclose(fired, points, atol=1e-12)
    assert set(found) == {-1, 0, 1, 2}
    for point, owner in zip(points, found, strict=True):
        best = max(range(3), key=lambda index: naive_log_density(sensors[index], point))
        one = sensors[best]
        seen = np.abs(one.tangent_of(direction(*point[3:5])[None])[0]) <= np.array(one.field_of_view_rad) / 2
        inside = seen.all() and one.gate_m[0] <= point[5] < one.gate_m[1]
        assert owner == (best if inside else -1)


def test_each_sensor_fires_what_it_sees_and_the_first_of_two_equal_ones_all():
    left, right = (sensor(name, 0.5, origin_m=(x, 0, 0)) for name, x in (("l", -1.0), ("r", 1.0)))
    points = [[-0.99, 0, 0, 1.0, -0.3, 1.0], [0.99, 0, 0, 1.0, -0.3, 1.0], [0, 0, 0, 4.0, -0.3, 1.0]]
    assert owned((left, right), points)[0].tolist() == [0, 1, -1]
    assert owned((left, replace(right, weight=0.0)), points)[0].tolist() == [0, -1, -1]
    assert owned((left, replace(left, name="m")), points)[0].tolist() == [0, -1, -1]


def test_a_sample_is_aimed_anew_from_one_place_and_stays_where_it_is_in_a_region():
    beside = [0.0, 0.2, 0.0, -math.atan2(0.2, 1.0), 0.0, math.hypot(0.2, 1.0)]
    still = sensor(origin_m=(0, 0, 0), **AHEAD)
    found, fired = owned((still,), [beside])
    assert found.tolist() == [0]
    np.testing.assert_allclose(fired, [[0, 0, 0, 0, 0, 1]], atol=1e-12)
    region = sensor(origin_m=(0, 0, 0), spread_rad=(0.3, 0.3), origin_covariance_m2=np.eye(3) * 0.01, **AHEAD)
    found, fired = owned((region,), [beside, [0.0, 0.9, 0.0, 0.0, 0.0, 1.0]])
    assert found.tolist() == [0, -1]
    np.testing.assert_allclose(fired[0, :3], beside[:3])


def test_a_fan_without_height_keeps_its_samples():
    fan = replace(sensor(elevation_rad=0.3, roll_rad=0.0), field_of_view_rad=(0.4, 0.0))
    generator = np.random.default_rng(6)
    drawn = np.column_stack([generator.normal(1.0, 0.1, 4000), np.full(4000, 0.3), generator.normal(1, 0.1, 4000)])
    points = np.column_stack([np.tile(fan.origin_m, (4000, 1)), drawn])
    found, _ = owned((fan, replace(fan, name="t", azimuth_rad=2.0)), points)
    expected = (np.abs(drawn[:, 0] - 1.0) * math.cos(0.3) < 0.2) & (drawn[:, 2] > fan.gate_m[0])
    expected &= drawn[:, 2] < fan.gate_m[1]
    assert ((found == 0) == expected).mean() > 0.99
