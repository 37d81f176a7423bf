"""A smooth factor of the density over scene points, what designs keep of it, and how samples are weighted by it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tables import each_row

from lidardesign.design.fit import fit
from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.errors import ConfigError, DataError
from lidardesign.evaluate.reweighting import LARGEST_LOG_FACTOR, NEIGHBOURS, Reweighting
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.samples import Samples
from lidardesign.space import RANGE, DesignSpace, observed_point
from lidardesign.workflow.run_samples import KEY, WIDEST_SPREAD_M, Weighting

SPACE = DesignSpace((0, 0, 0, -0.6, -0.4, 0.2), (0, 0, 0, 0.6, 0.4, 2.0))


def anchored(count, seed=0, scale=1.0):
    generator = np.random.default_rng(seed)
    return Reweighting(scale * generator.normal(size=(count, 3)), generator.uniform(-3, 3, count))


def drawn(count=3000, seed=1):
    """Samples of a density with two spots, drawn evenly."""
    points = SPACE.sample(count, np.random.default_rng(seed))
    spots = np.array([[-0.3, 0.1, 0.8], [0.25, -0.1, 1.2]])
    squares = np.square((points[:, None, 3:] - spots) / [0.12, 0.12, 0.1]).sum(-1)
    log_target = np.logaddexp(*(-squares.T / 2))
    return Samples(points, np.full(count, -SPACE.log_volume), log_target, SPACE)


@given(st.integers(1, 40), st.integers(0, 1000), st.sampled_from([1e-4, 1.0, 1e6]), st.sampled_from([0.1, 1.0, 1e8]))
def test_a_factor_lies_between_those_of_the_nearest_anchors(count, seed, scale, away):
    factor = anchored(count, seed, scale)
    places = away * scale * np.random.default_rng(seed + 1).normal(size=(50, 3))
    found = factor.at_places(places)
    distance = np.linalg.norm(places[:, None] - factor.points_m, axis=2)
    nearest = factor.log_factors[np.argsort(distance, axis=1)[:, :NEIGHBOURS]]
    rounding = 1e-12
    # at such distances several anchors may be equally far to rounding, and any of them is among the nearest
    nearest = nearest if away <= 1 else np.tile(factor.log_factors, (50, 1))
    assert (found >= nearest.min(axis=1) - rounding).all()
    assert (found <= nearest.max(axis=1) + rounding).all()


def test_the_factor_at_an_anchor_that_others_are_far_from_is_its_own():
    points = [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [9, 0, 0]]
    factor = Reweighting(points, [0.0, 0.0, 0.0, 0.0, 2.5])
    assert factor.at_places(np.array([[9.0, 0, 0]])) == pytest.approx(2.5, rel=1e-12)
    assert factor.at_places(np.array([[0.1, 0, 0]])) == pytest.approx(0.0, abs=1e-12)


def test_between_two_anchors_the_factor_goes_from_one_to_the_other():
    factor = Reweighting([[0, 0, 0], [1, 0, 0]], [-1.0, 3.0])
    way = np.column_stack([np.linspace(-1, 2, 61), np.zeros((61, 2))])
    found = factor.at_places(way)
    assert (np.diff(found) > 0).all()
    assert factor.at_places(np.array([[0.5, 0, 0]])) == pytest.approx(1.0, rel=1e-12)
    # a Gaussian of the distance, whose reach is the anchors' own distance
    shares = np.exp(-np.square(0.25 - np.array([0, 1])) / 2)
    assert factor.at_places(np.array([[0.25, 0, 0]]))[0] == pytest.approx(shares @ [-1, 3] / shares.sum(), rel=1e-12)


def test_a_naive_twin_gives_the_same():
    factor, places = anchored(30), np.random.default_rng(3).normal(size=(40, 3))
    apart = np.linalg.norm(factor.points_m[:, None] - factor.points_m, axis=2)
    np.fill_diagonal(apart, np.inf)
    reach = np.median(apart.min(axis=1))
    for place, found in zip(places, factor.at_places(places), strict=True):
        distance = np.linalg.norm(factor.points_m - place, axis=1)
        near = np.argsort(distance)[:NEIGHBOURS]
        shares = np.exp(-np.square(distance[near] / reach) / 2)
        assert found == pytest.approx((shares * factor.log_factors[near]).sum() / shares.sum(), rel=1e-9)


@given(st.integers(1, 30), st.integers(0, 1000))
def test_the_order_of_anchors_does_not_matter(count, seed):
    factor = anchored(count, seed)
    order = np.random.default_rng(seed).permutation(count)
    other = Reweighting(factor.points_m[order], factor.log_factors[order])
    places = np.random.default_rng(seed + 2).normal(size=(20, 3))
    np.testing.assert_allclose(factor.at_places(places), other.at_places(places), rtol=1e-9, atol=1e-12)


def test_turning_scaling_and_moving_a_scene_moves_the_factor_with_it():
    factor, places = anchored(25), np.random.default_rng(5).normal(size=(30, 3))
    turn, _ = np.linalg.qr(np.random.default_rng(6).normal(size=(3, 3)))
    moved = Reweighting(7 * factor.points_m @ turn + 3, factor.log_factors)
    np.testing.assert_allclose(moved.at_places(7 * places @ turn + 3), factor.at_places(places), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("points", [[[1, 2, 3]], [[1, 2, 3]] * 4, [[0, 0, 0], [1, 1, 1]]])
def test_a_factor_that_is_one_number_everywhere_is_that_number(points):
    factor = Reweighting(points, [1.5] * len(points))
    places = np.array([[0, 0, 0], [1, 2, 3], [1e6, -1e6, 0]], dtype=float)
    np.testing.assert_allclose(factor.at_places(places), 1.5, rtol=1e-12)


def test_anchors_at_one_place_give_their_mean():
    factor = Reweighting([[1, 2, 3]] * 4, [0.0, 1.0, 2.0, 3.0])
    assert factor.at_places(np.array([[0.0, 0, 0]])) == pytest.approx(1.5)


def test_design_points_have_the_factor_of_what_they_observe():
    factor, samples = anchored(20), drawn()
    expected = factor.at_places(observed_point(samples.points))
    np.testing.assert_array_equal(factor.log_factor(samples.points), expected)


@given(st.integers(1, 20), st.integers(0, 1000), st.sampled_from([1e-6, 1.0, 1e7]))
def test_documents_and_yaml_keep_a_factor_to_the_last_bit(count, seed, scale):
    factor = anchored(count, seed, scale)
    text = dump_yaml({"factors": factor.as_document()})
    again = Reweighting.from_document(parse_yaml(text, where="test").value["factors"], "test")
    np.testing.assert_array_equal(again.points_m, factor.points_m)
    np.testing.assert_array_equal(again.log_factors, factor.log_factors)
    places = np.random.default_rng(seed).normal(size=(10, 3))
    assert again.at_places(places).tobytes() == factor.at_places(places).tobytes()


MALFORMED = {
    "nothing": None,
    "a list": [[0, 0, 0], [1.0]],
    "a key missing": {"points_m": [[0, 0, 0]]},
    "a key too many": {"points_m": [[0, 0, 0]], "log_factors": [0], "reach_m": 1},
    "no anchor": {"points_m": [], "log_factors": []},
    "flat points": {"points_m": [[0, 0]], "log_factors": [0]},
    "one list of points": {"points_m": [0, 0, 0], "log_factors": [0]},
    "a factor too many": {"points_m": [[0, 0, 0]], "log_factors": [0, 1]},
    "ragged points": {"points_m": [[0, 0, 0], [1]], "log_factors": [0, 1]},
    "text": {"points_m": [["here", 0, 0]], "log_factors": [0]},
    "a number as text": {"points_m": [[0, 0, 0]], "log_factors": ["1"]},
    "true among numbers": {"points_m": [[0, 0, True]], "log_factors": [0]},
    "nothing among numbers": {"points_m": [[0, 0, 0]], "log_factors": [None]},
    "a mapping among numbers": {"points_m": [[0, 0, {}]], "log_factors": [0]},
    "a factor that is none": {"points_m": [[0, 0, 0]], "log_factors": [float("nan")]},
    "an infinite point": {"points_m": [[0, 0, float("inf")]], "log_factors": [0]},
    "a point that is none": {"points_m": [[0, float("nan"), 0]], "log_factors": [0]},
    "a factor too large": {"points_m": [[0, 0, 0]], "log_factors": [2 * LARGEST_LOG_FACTOR]},
    "a point too far": {"points_m": [[0, 0, 1e12]], "log_factors": [0]},
    "a whole number beyond all": {"points_m": [[0, 0, 0]], "log_factors": [10**400]},
}


@each_row("name", MALFORMED)
def test_malformed_documents_are_refused_by_their_place(name):
    with pytest.raises(ConfigError) as caught:
        Reweighting.from_document(MALFORMED[name], "weighting of design d: factors")
    assert caught.value.where.startswith("weighting of design d: factors")
    assert caught.value.exit_code == 2


def test_a_constant_factor_changes_no_weight_and_no_design():
    samples = drawn()
    factor = Reweighting([[0, 0, 0], [1, 0, 0]], [2.0, 2.0])
    other = samples.reweighted(factor.log_factor(samples.points))
    np.testing.assert_allclose(other.weights, samples.weights, rtol=1e-12)
    for layout, rays in (("grid", None), ("density", 20), ("scan", 9)):
        one, two = (fit(one, sensors=None if layout == "scan" else 2, layout=layout, rays=rays, restarts=2, seed=3)
                    for one in (samples, other))  # fmt: skip
        for before, after in zip(one.design.sensors, two.design.sensors, strict=True):
            assert after.range_m == pytest.approx(before.range_m, rel=1e-6)
            assert after.azimuth_rad == pytest.approx(before.azimuth_rad, abs=1e-6)
            np.testing.assert_allclose(after.field_of_view_rad, before.field_of_view_rad, rtol=1e-5)


def test_weights_of_a_reweighted_density_are_the_old_ones_times_the_factor():
    samples, factor = drawn(), anchored(10)
    other = samples.reweighted(factor.log_factor(samples.points))
    by_hand = samples.weights * np.exp(factor.at_places(observed_point(samples.points)))
    np.testing.assert_allclose(other.weights, by_hand / by_hand.sum(), rtol=1e-10)
    np.testing.assert_array_equal(other.points, samples.points)
    np.testing.assert_array_equal(other.log_prob, samples.log_prob)


def test_a_design_looks_more_where_the_factor_is_larger():
    samples = drawn()
    # the left spot counts e^2 times as much as the right one
    middle = observed_point(np.array([[0, 0, 0, -0.3, 0.1, 0.8], [0, 0, 0, 0.25, -0.1, 1.2]]))
    factor = Reweighting(middle, [1.0, -1.0])

    def left_share(one):
        design = fit(one, sensors=2, restarts=2, seed=0).design
        return sum(s.weight for s in design.sensors if np.sin(s.azimuth_rad) < 0)

    assert left_share(samples.reweighted(factor.log_factor(samples.points))) > left_share(samples) + 0.1


def test_log_targets_of_nothing_may_become_something():
    samples = drawn(100)
    hidden = samples.retargeted(np.where(np.arange(100) < 50, -np.inf, samples.log_target))
    assert (hidden.weights[:50] == 0).all()
    weighted = Weighting(("scene=discs",)).log_target(hidden, lambda points: samples.log_target)
    np.testing.assert_array_equal(weighted.log_target, samples.log_target)


def test_weights_that_are_none_are_refused():
    with pytest.raises(DataError, match="not finite"):
        drawn(10).reweighted(np.full(10, np.nan))


def test_spreading_in_range_moves_ranges_alone_and_stays_in_the_space():
    samples = drawn(4000)
    spread = samples.spread_in_range(0.05, np.random.default_rng(0))
    np.testing.assert_array_equal(spread.points[:, :RANGE], samples.points[:, :RANGE])
    np.testing.assert_array_equal(spread.weights, samples.weights)
    moved = spread.points[:, RANGE] - samples.points[:, RANGE]
    inside = (samples.points[:, RANGE] > 0.5) & (samples.points[:, RANGE] < 1.7)
    assert np.std(moved[inside]) == pytest.approx(0.05, rel=0.05)
    assert abs(moved[inside].mean()) < 0.005
    far = samples.spread_in_range(100.0, np.random.default_rng(0)).points[:, RANGE]
    assert far.min() == 0.2
    assert far.max() == 2.0


def design_with(weighting):
    sensor = Sensor("s0", 1.0, (0.0, 0.0, 0.0), np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.1, 0.1, 1.0, 0.1)
    return DesignSpec("d", (sensor,), provenance={KEY: weighting})


@pytest.mark.parametrize(
    "weighting",
    [
        Weighting(("importance_exponent=1",)),
        Weighting(("a=1", "b=2"), anchored(5), 0.02),
        Weighting((), anchored(3)),
        Weighting((), None, 0.5),
    ],
)
def test_a_design_says_how_its_samples_were_weighted(weighting):
    document = parse_yaml(dump_yaml(weighting.as_document()), where="test").value
    found = Weighting.of(design_with(document))
    assert found
    assert (found.settings, found.range_spread_m) == (weighting.settings, weighting.range_spread_m)
    if weighting.reweighting is not None:
        np.testing.assert_array_equal(found.reweighting.points_m, weighting.reweighting.points_m)


def test_no_weighting_is_none():
    assert not Weighting()
    assert Weighting().as_document() == {}
    assert not Weighting.of(design_with({}))


NO_WEIGHTINGS = {
    "a list": ["set"],
    "an unknown key": {"sets": []},
    "a set that is text": {"set": "a=1"},
    "a set of numbers": {"set": [3]},
    "a spread that is text": {"range_spread_m": "0.1"},
    "a spread that is true": {"range_spread_m": True},
    "a negative spread": {"range_spread_m": -0.1},
    "a spread beyond all lengths": {"range_spread_m": 10 * WIDEST_SPREAD_M},
    "a spread that is none": {"range_spread_m": float("nan")},
    "factors that are none": {"factors": {"points_m": []}},
}


@each_row("name", NO_WEIGHTINGS)
def test_what_is_no_weighting_is_refused_by_the_designs_name(name):
    with pytest.raises(ConfigError) as caught:
        Weighting.of(design_with(NO_WEIGHTINGS[name]))
    assert "weighting of design d" in caught.value.where
    assert caught.value.allowed
    assert "fit the design again" in caught.value.hint
