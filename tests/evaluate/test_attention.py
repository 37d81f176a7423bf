"""Where rays should go: the error at anchors in the scene, per fired ray and per density."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.evaluate.reweighting import (
    ANCHORS,
    FACTOR_DECIMALS,
    LARGEST_FACTOR,
    MOST_ANCHORS,
    Attention,
    anchors_for,
)
from lidardesign.geometry.rays import Rays
from lidardesign.scene import Body, Scene, Sphere, rigid
from lidardesign.simulate.simulate import simulate
from lidardesign.space import direction
from lidardesign.task import Residuals

PER_RAY, PER_DENSITY = "the error per ray", "the error"
NOTHING = Scene((Body(Sphere(0.01), "far away", "both", rigid(translation_m=np.array([0, 0, 900.0]))),))


def line(count=40):
    """Anchors on a line, which stand for the same share of the density each."""
    places = np.column_stack([np.arange(count, dtype=float), np.zeros((count, 2))])
    return Attention.at(places, places)


def fired_at(places):
    """Returns of rays whose gates' middles are at places, none of which meets anything."""
    origin = places + np.array([0.0, 0.0, 1.0])
    down = np.tile([0.0, 0.0, -1.0], (len(places), 1))
    gates = np.tile([0.5, 1.5], (len(places), 1))
    return simulate(NOTHING, Rays(origin, down, gates, np.zeros(len(places)), np.zeros(len(places))))


def seen(attention, error, rays):
    """What one scene shows where an error and so many rays are at every anchor."""
    places = np.repeat(attention.points_m, rays, axis=0)
    return [(Residuals(attention.points_m, np.asarray(error, dtype=float)), fired_at(places))]


@given(st.integers(0, 1000), st.floats(-12, 12))
def test_where_every_ray_has_the_same_error_nothing_is_gained(seed, log_scale):
    attention = line()
    rays = np.random.default_rng(seed).integers(1, 9, 40)
    gains = attention.gains(seen(attention, 10**log_scale * rays, rays))
    np.testing.assert_allclose(gains[PER_RAY], 0.0, atol=1e-9)


def test_an_even_error_has_nothing_to_gain_over_an_even_density():
    attention = line()
    gains = attention.gains(seen(attention, np.full(40, 3.0), np.random.default_rng(0).integers(1, 9, 40)))
    np.testing.assert_allclose(gains[PER_DENSITY], 0.0, atol=1e-9)


def test_more_error_per_ray_gains_and_less_loses():
    attention, error = line(), np.ones(40)
    error[30:] = 9.0
    gains = attention.gains(seen(attention, error, np.full(40, 2)))
    for found in gains.values():
        # away from the seam, over which errors are smoothed
        assert (found[34:] > 0).all()
        assert (found[:26] < 0).all()
        assert np.average(found, weights=np.full(40, 2)) == pytest.approx(0.0, abs=1e-9)


def test_fewer_rays_gain_per_ray_and_not_per_density():
    attention, rays = line(), np.full(40, 8)
    rays[30:] = 1
    gains = attention.gains(seen(attention, np.ones(40), rays))
    assert (gains[PER_RAY][34:] > 0.5).all()
    np.testing.assert_allclose(gains[PER_DENSITY], 0.0, atol=1e-9)


@given(st.integers(0, 1000), st.floats(-300, 300))
def test_the_unit_of_residuals_does_not_matter(seed, log_unit):
    attention, generator = line(), np.random.default_rng(seed)
    error, rays = generator.uniform(0.1, 1, 40), generator.integers(1, 5, 40)
    one = attention.gains(seen(attention, error, rays))
    other = attention.gains(seen(attention, error * 10.0**log_unit, rays))
    for name, found in one.items():
        np.testing.assert_allclose(other[name], found, rtol=1e-9, atol=1e-9)


def test_the_largest_residuals_there_are_do_not_overflow():
    attention = line()
    gains = attention.gains(seen(attention, np.full(40, 1.7e308), np.ones(40, dtype=int)))
    np.testing.assert_allclose(gains[PER_RAY], 0.0, atol=1e-9)


def test_the_order_of_scenes_and_of_residuals_does_not_matter():
    attention, generator = line(), np.random.default_rng(1)
    several = [seen(attention, generator.uniform(0, 1, 40), generator.integers(0, 4, 40))[0] for _ in range(3)]
    turned = [
        (replace(residuals, points_m=residuals.points_m[::-1], values=residuals.values[::-1]), returns)
        for residuals, returns in reversed(several)
    ]
    one, other = attention.gains(several), attention.gains(turned)
    for name, found in one.items():
        np.testing.assert_allclose(other[name], found, rtol=1e-9, atol=1e-12)


def test_without_error_or_without_rays_there_is_no_gain():
    attention = line()
    none = [(Residuals(np.zeros((0, 3)), np.zeros(0)), fired_at(attention.points_m))]
    assert attention.gains(none) == {}
    assert attention.gains(seen(attention, np.zeros(40), np.ones(40, dtype=int))) == {}
    assert attention.gains(seen(attention, np.ones(40), np.zeros(40, dtype=int))) == {}
    assert attention.gains([]) == {}


def test_an_anchor_without_error_or_rays_asks_for_no_infinite_factor():
    attention = line()
    error, rays = np.zeros(40), np.zeros(40, dtype=int)
    error[3], rays[30] = 1e9, 1000
    for found in attention.gains(seen(attention, error, rays)).values():
        assert np.isfinite(found).all()


def test_rays_count_where_they_hit_and_else_in_the_middle_of_their_gates():
    ball = Scene((Body(Sphere(0.5), "ball", "both", rigid(translation_m=np.array([3.0, 0, 0]))),))
    origin, looking = np.zeros((2, 3)), direction(np.array([0.0, np.pi]), np.zeros(2))
    returns = simulate(ball, Rays(origin, looking, np.tile([0.0, 8.0], (2, 1)), np.zeros(2), np.zeros(2)))
    attention = Attention.at(*(np.array([[2.5, 0, 0], [-4.0, 0, 0], [4.0, 0, 0]]),) * 2)
    everywhere = Residuals(attention.points_m, np.ones(3))
    alone = replace(attention, neighbours=np.arange(3)[:, None])
    gains = alone.gains([(everywhere, returns)])[PER_RAY]
    # one ray returns at 2.5 m, the other looks at 4 m behind; none looks at the third anchor
    assert gains[0] == pytest.approx(gains[1])
    assert gains[2] > gains[0]


@given(st.integers(0, 1000), st.floats(0, 1e6), st.integers(1, 30))
def test_steps_stay_inside_the_bound(seed, step, steps):
    attention, generator = line(), np.random.default_rng(seed)
    factors = np.zeros(40)
    for _ in range(steps):
        factors = attention.moved(factors, generator.normal(0, 10, 40), step)
    assert np.abs(factors).max() <= np.log(LARGEST_FACTOR)
    reweighting = attention.reweighting(factors)
    places = generator.normal(0, 30, (50, 3))
    assert np.abs(reweighting.at_places(places)).max() <= np.log(LARGEST_FACTOR) + 10**-FACTOR_DECIMALS


def test_a_step_goes_towards_the_gains():
    attention, gains = line(), np.linspace(-0.5, 0.5, 40)
    np.testing.assert_allclose(attention.moved(np.full(40, 0.1), gains, 0.5), 0.1 + gains / 2)
    np.testing.assert_array_equal(attention.moved(np.zeros(40), gains, 0.0), np.zeros(40))


def test_anchors_stand_for_shares_of_the_density():
    generator = np.random.default_rng(2)
    places = generator.normal(size=(4000, 3)) * [1.0, 0.5, 0.1]
    attention = Attention.over(places, np.random.default_rng(0), 100)
    assert attention.points_m.shape == (100, 3)
    assert attention.shares.sum() == pytest.approx(1.0)
    assert attention.shares.max() < 0.1
    # every anchor is its own nearest neighbour
    np.testing.assert_array_equal(attention.neighbours[:, 0], np.arange(100))
    again = Attention.over(places, np.random.default_rng(0), 100)
    assert again.points_m.tobytes() == attention.points_m.tobytes()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_rounding_moves_no_anchor_by_more_than_a_thousandth_of_the_scene(scale):
    places = scale * np.random.default_rng(3).uniform(size=(3000, 3))
    points = Attention.over(places, np.random.default_rng(0), 50).points_m
    nearest = np.linalg.norm(places[:, None] - points, axis=2).min(axis=0)
    assert nearest.max() < 0.15 * scale
    assert len(np.unique(points, axis=0)) == 50
    # short numbers, as people read them
    assert max(len(repr(float(value))) for value in points.ravel()) <= 11


def test_a_scene_of_a_few_places_has_no_more_anchors():
    places = np.repeat([[0.0, 0, 0], [1.0, 0, 0]], 20, axis=0)
    attention = Attention.over(places, np.random.default_rng(0))
    assert len(attention.points_m) == 2
    one = Attention.over(np.ones((20, 3)), np.random.default_rng(0))
    assert one.points_m.tolist() == [[1.0, 1.0, 1.0]]
    assert one.neighbours.shape == (1, 1)


def test_scenes_that_are_passed_have_more_anchors_but_not_too_many():
    assert anchors_for(1) == ANCHORS
    assert anchors_for(2) == 2 * ANCHORS
    assert anchors_for(100) == MOST_ANCHORS
