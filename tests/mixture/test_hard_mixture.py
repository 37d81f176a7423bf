"""Mixtures: data that do not fill their space, samples far from everything, dimensions that are fixed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fits import broken, design_of, fitted
from support.mixtures import POINT, WHOLE, Z, drawn, features_of, random_mixture, taken

from lidardesign.constraints.document import Constraints
from lidardesign.mixture.bounds import Bounds, Floors
from lidardesign.mixture.components import Axes, Features, Mixture, expect, log_density, responsibilities
from lidardesign.mixture.em import fit_mixture, revive_dead, run_em
from lidardesign.rays.proposals import Proposals
from lidardesign.samples import Samples
from lidardesign.sensors.design_file import design_document
from lidardesign.space import DesignSpace

REGION = {"origin": {"spread_m": {"max": 99.0}}}


def degenerate(kind, generator, count=80):
    """Samples that do not fill the space."""
    points = WHOLE.sample(count, generator)
    if kind == "one point":
        points[:] = points[0]
    elif kind == "two samples":
        points = points[:2]
    elif kind == "three points":
        points = points[generator.integers(3, size=count)]
    elif kind == "duplicates":
        points = np.repeat(points[: count // 4], 4, axis=0)
    elif kind == "collinear":
        points = points[0] + np.linspace(0, 1, count)[:, None] * 0.2 * np.array([1, 1, 1, 0.5, 0.1, 1])
    elif kind == "a plane of origins":
        points[:, 2] = 0.3 * points[:, 0] - 0.2 * points[:, 1]
    elif kind == "one range":
        points[:, 5] = 2.0
    elif kind == "one direction":
        points[:, 3:5] = 1.0, 0.3
    elif kind == "the pole":
        points[:, 4] = math.pi / 2
    return points


KINDS = (
    "one point", "two samples", "three points", "duplicates", "collinear",
    "a plane of origins", "one range", "one direction", "the pole",
)  # fmt: skip


def scaled(points, space, factor):
    """The same world in other units of length."""
    lengths = np.array([factor, factor, factor, 1.0, 1.0, factor])
    low, high = (tuple((np.array(ends) * lengths).tolist()) for ends in (space.low, space.high))
    return points * lengths, DesignSpace(low, high)


def assert_finite(mixture):
    for name in mixture.__dataclass_fields__:
        assert np.isfinite(getattr(mixture, name)).all(), name


@pytest.mark.hard_case(
    "29",
    "Fewer different samples than components, duplicates, or samples on a line",
    done="standard deviations have a floor relative to the data's scale, components that lose their samples are "
    "restarted where that helps, and a sensor that rests on too few is refused by name",
)
class TestSamplesThatDoNotFillTheirSpace:
    @pytest.mark.parametrize("count", [1, 2, 9])
    @pytest.mark.parametrize("kind", KINDS)
    def test_components_stay_finite_and_positive_definite(self, kind, count):
        generator = np.random.default_rng(12)
        features = features_of(degenerate(kind, generator))
        trace = fit_mixture(features, Bounds.unbounded(count, Z), generator, restarts=2)
        assert (np.diff(trace.history) >= 0).all()
        assert_finite(trace.mixture)
        floors = Floors.of(features)
        smallest = np.linalg.eigvalsh(trace.mixture.origin_covariance_m2)[:, 0]
        # a few roundings of the largest eigenvalue
        largest = np.linalg.eigvalsh(trace.mixture.origin_covariance_m2)[:, -1]
        assert (smallest >= floors.origin_m**2 - 1e-14 * largest).all()
        assert (trace.mixture.spread_range_m >= floors.range_m).all()
        assert (trace.mixture.spread_rad >= floors.angle_rad).all()
        assert trace.mixture.weights.sum() == pytest.approx(1.0, abs=1e-14)

    @pytest.mark.parametrize("power", [-20, -10, 17])
    @pytest.mark.parametrize("kind", ["one point", "three points", "collinear", "one range"])
    def test_floors_follow_the_scale_of_the_world(self, kind, power):
        factor = 2.0**power
        points = degenerate(kind, np.random.default_rng(3))
        fits, floors = [], []
        for own, space in ((points, WHOLE), scaled(points, WHOLE, factor)):
            features = Features.of(own, np.ones(len(own)), Axes.of(space), space)
            floors.append(Floors.of(features))
            fits.append(fit_mixture(features, Bounds.unbounded(4, Z), np.random.default_rng(0), restarts=2))
        assert floors[1].origin_m == factor * floors[0].origin_m
        assert floors[1].range_m == factor * floors[0].range_m
        assert floors[1].angle_rad == floors[0].angle_rad
        # four lengths, and so a density per length to the fourth; components on one sample share it as rounding has it
        one, other = (trace.log_likelihood for trace in fits)
        assert other == pytest.approx(one - 4 * math.log(factor), abs=0.2)
        spreads = [trace.mixture.spread_range_m.min() for trace in fits]
        assert spreads[1] == pytest.approx(factor * spreads[0], rel=0.2)

    def test_a_component_that_explains_nothing_is_restarted_and_named(self):
        generator = np.random.default_rng(4)
        plan = random_mixture(generator, 3)
        features = features_of(drawn(plan, 3000, generator))
        bounds = Bounds.unbounded(3, Z)
        good = fit_mixture(features, bounds, generator)
        rows = {name: getattr(good.mixture, name).copy() for name in good.mixture.__dataclass_fields__}
        rows["range_m"][2], rows["spread_range_m"][2] = 8.5, 1e-2
        rows["origin_m"][2], rows["weights"] = 8.0, np.array([0.5, 0.5, 1e-9])
        trace = revive_dead(run_em(Mixture(**rows), features, bounds), features, bounds, generator)
        assert any("restarted 1 of 3 sensors" in note for note in trace.notes)
        assert (trace.mixture.weights > 0.01).all()
        # it need not find the same optimum, but a better one than two sensors can
        two = fit_mixture(features, Bounds.unbounded(2, Z), generator)
        assert trace.log_likelihood > two.log_likelihood

    @pytest.mark.parametrize("different", [1, 2, 3])
    def test_fewer_different_samples_than_sensors_are_named(self, different):
        generator = np.random.default_rng(6)
        points = WHOLE.sample(different, generator)[np.arange(200) % different]
        samples = Samples(points, np.zeros(200), np.zeros(200), WHOLE)
        few = fitted(samples, REGION, sensors=5)
        assert broken(few, REGION, WHOLE) == []
        assert math.isfinite(few.log_likelihood.value)
        assert f"fewer different samples ({different}) than sensors (5): some sensors share a sample" in few.notes
        assert not any("fewer different" in note for note in fitted(samples, REGION, sensors=different).notes)

    @pytest.mark.parametrize("rules", [{}, REGION], ids=["places", "regions"])
    @pytest.mark.parametrize("kind", KINDS)
    def test_sensors_and_their_rays_take_them(self, kind, rules):
        points = degenerate(kind, np.random.default_rng(7), count=200)
        points = points[np.arange(200) % len(points)]
        samples = Samples(points, np.zeros(200), np.zeros(200), WHOLE)
        found = fitted(samples, rules, sensors=2, retarget=lambda points: np.zeros(len(points)))
        assert broken(found, rules, WHOLE) == []
        for sensor in found.sensors:
            values = [*sensor.origin_m, *sensor.gate_m, *sensor.field_of_view_rad, sensor.weight]
            assert np.isfinite(values).all()
        rays = Proposals(found.sensors, Constraints.from_mapping(rules).rules, 0.95, samples).draw(
            30, {}, np.random.default_rng(0)
        )
        assert len(rays) == 30


def far_away(mixture, sigmas, generator):
    """Samples that many standard deviations of every component away in range."""
    points = drawn(mixture, 60, generator)
    reach = mixture.range_m.max() + sigmas * mixture.spread_range_m.max()
    points[:, 5] = reach + generator.uniform(0, 1, 60)
    return points


@pytest.mark.hard_case(
    "30",
    "A sample sixty standard deviations from every component",
    done="responsibilities are computed in log space against the largest exponent: rows sum to 1 and the nearest "
    "component takes the sample",
)
class TestSamplesFarFromEveryComponent:
    @given(number=st.integers(0, 10_000), sigmas=st.floats(0, 1e8), count=st.integers(1, 7))
    def test_shares_are_those_of_exact_logarithms_and_sum_to_one(self, number, sigmas, count):
        generator = np.random.default_rng(number)
        mixture = random_mixture(generator, count)
        features = features_of(far_away(mixture, sigmas, generator))
        alone = np.stack([log_density(taken(mixture, np.array([k])), features) for k in range(count)], axis=1)
        logs = alone + np.log(mixture.weights)
        expected = np.exp(logs - np.logaddexp.reduce(logs, axis=1)[:, None])
        # exponents of 1e12 keep four digits behind the point
        tolerance = 1e-14 * np.abs(logs).max() + 1e-12
        shares = responsibilities(mixture, features)
        np.testing.assert_allclose(shares, expected, rtol=0, atol=tolerance)
        np.testing.assert_allclose(shares.sum(axis=1), 1.0, rtol=0, atol=1e-14)

    def test_a_ray_opposite_to_every_boresight_stays_finite(self):
        generator = np.random.default_rng(9)
        mixture = random_mixture(generator, 3)
        same = taken(mixture, np.zeros(3, dtype=int))
        points = drawn(mixture, 5, generator)
        points[:, 3], points[:, 4] = same.azimuth_rad[0] + math.pi, -same.elevation_rad[0]
        features = features_of(points)
        assert np.isfinite(log_density(same, features)).all()
        np.testing.assert_allclose(responsibilities(same, features), 1 / 3, atol=1e-12)

    def test_a_fit_reaches_them_and_its_log_likelihood_rises_all_the_way(self):
        generator = np.random.default_rng(10)
        mixture = random_mixture(generator, 2)
        features = features_of(np.concatenate([drawn(mixture, 500, generator), far_away(mixture, 1000, generator)]))
        trace = run_em(mixture, features, Bounds.unbounded(2, Z))
        assert expect(mixture, features).log_likelihood < -1e4
        assert trace.log_likelihood > -20
        assert (np.diff(trace.history) >= 0).all()
        assert_finite(trace.mixture)


FREE_BUT_ORIGIN = np.array([0.0, -math.pi / 2, 0.0]), np.array([2 * math.pi, math.pi / 2, 9.0])


def fixed_at(place):
    low, high = FREE_BUT_ORIGIN
    return DesignSpace((*place, *low.tolist()), (*place, *high.tolist()))


def narrow_samples(place, count=2000):
    generator = np.random.default_rng(11)
    points = np.tile(np.array([*place, 1.0, 0.2, 3.0]), (count, 1))
    points[:, 3:] += np.array([0.02, 0.01, 0.2]) * generator.standard_normal((count, 3))
    return points


@pytest.mark.hard_case(
    "31",
    "An origin, or any other dimension, that is fixed",
    done="fixed dimensions leave the density instead of getting a tiny variance",
)
class TestDimensionsThatAreFixed:
    @pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (1e-3, 0.0, -7.0), (1e7, -3e5, 12.0)])
    def test_the_log_likelihood_does_not_know_where_the_origin_is_fixed(self, place):
        here = features_of(narrow_samples((0.0, 0.0, 0.0)), POINT)
        there = features_of(narrow_samples(place), fixed_at(place))
        fits = [fit_mixture(one, Bounds.unbounded(2, Z), np.random.default_rng(0)) for one in (here, there)]
        assert fits[0].log_likelihood == fits[1].log_likelihood
        for name in ("weights", "azimuth_rad", "elevation_rad", "roll_rad", "spread_rad", "range_m", "spread_range_m"):
            np.testing.assert_array_equal(getattr(fits[0].mixture, name), getattr(fits[1].mixture, name))

    def test_the_log_likelihood_is_that_of_the_free_dimensions_in_closed_form(self):
        points = narrow_samples((0.4, -2.0, 1.0))
        trace = fit_mixture(
            features_of(points, fixed_at((0.4, -2.0, 1.0))), Bounds.unbounded(1, Z), np.random.default_rng(0)
        )
        spread = (points[:, 3:] - points[:, 3:].mean(axis=0)).std(axis=0)
        # of so narrow a field the sphere is flat to 1e-4, and azimuths shrink by the cosine of the elevation
        spread[0] *= math.cos(0.2)
        correlation = np.corrcoef(points[:, 3:5].T)[0, 1]
        expected = -np.log(spread * math.sqrt(2 * math.pi * math.e)).sum() - 0.5 * math.log(1 - correlation**2)
        assert trace.log_likelihood == pytest.approx(expected, abs=1e-3)

    @pytest.mark.parametrize("fixed", [(0,), (1,), (2,), (0, 2), (0, 1, 2)])
    def test_fixed_axes_have_exactly_no_spread_in_the_written_design(self, fixed):
        low, high = list(WHOLE.low), list(WHOLE.high)
        for axis in fixed:
            low[axis] = high[axis] = 0.1 * (axis + 1)
        space = DesignSpace(tuple(low), tuple(high))
        points = space.sample(600, np.random.default_rng(12))
        found = fitted(Samples(points, np.zeros(600), np.zeros(600), space), REGION, sensors=2)
        for sensor in design_document(design_of(found))["sensors"]:
            covariance = np.array(sensor["origin_m"].get("covariance", np.zeros((3, 3))))
            for axis in range(3):
                if axis in fixed:
                    assert sensor["origin_m"]["mean"][axis] == low[axis]
                    assert (covariance[axis] == 0).all()
                    assert (covariance[:, axis] == 0).all()
                else:
                    assert covariance[axis, axis] > 0
