"""Laws of mixtures on the sphere and of the EM that fits them."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.mixtures import POINT, WHOLE, Z, drawn, features_of, random_mixture, taken

from lidardesign.mixture.bounds import Bounds, Floors
from lidardesign.mixture.components import (
    Axes,
    Mixture,
    angle_ratio,
    expect,
    label_statistics,
    linear_coefficients,
    log_density,
    mean_directions,
    responsibilities,
)
from lidardesign.mixture.em import fit_mixture, run_em, seed_mixture
from lidardesign.mixture.m_step import fit_field, fit_gate, maximise
from lidardesign.numerics import logsumexp, wrap_angle
from lidardesign.sensors.sensor import boresight_frame, tangent_coordinates, tangent_directions
from lidardesign.space import DesignSpace, angles, direction


@pytest.mark.parametrize("turn", [0.3, 1.7, 3.1, 5.9])
def test_fits_turn_with_the_world_also_across_azimuth_zero(turn):
    generator = np.random.default_rng(4)
    tangent = np.array([0.2, 0.1]) * generator.standard_normal((3000, 2))
    looking = tangent_directions(boresight_frame(0.0, 0.4, 0.2), tangent)
    fits = []
    for by in (0.0, turn):
        azimuth, elevation = angles(looking)
        points = np.zeros((3000, 6))
        points[:, 3], points[:, 4] = np.mod(azimuth + by, 2 * np.pi), elevation
        points[:, 5] = 3 + 0.1 * tangent[:, 0]
        fits.append(fit_mixture(features_of(points, POINT), Bounds.unbounded(1, Z), np.random.default_rng(0)))
    one, other = fits
    assert other.log_likelihood == pytest.approx(one.log_likelihood, abs=1e-6)
    turned = other.mixture.azimuth_rad - one.mixture.azimuth_rad
    np.testing.assert_allclose(wrap_angle(turned - turn), 0, atol=1e-6)
    np.testing.assert_allclose(other.mixture.spread_rad, one.mixture.spread_rad, rtol=1e-6)


def test_frames_of_many_boresights_are_those_of_each():
    generator = np.random.default_rng(6)
    values = generator.uniform(-1.5, 1.5, (3, 7))
    many = boresight_frame(*values)
    for k in range(7):
        np.testing.assert_allclose(many[k], boresight_frame(*values[:, k]), atol=1e-15)


def test_the_angle_ratio_is_accurate_from_zero_to_the_antipode():
    angle = np.array([0.0, 1e-9, 1e-5, 1e-3, 0.1, 1.0, 2.0, 3.0, 3.14])
    ratio = angle_ratio(np.cos(angle), np.empty(9), np.empty(9))
    exact = np.array([1.0, *(angle[1:] / np.sin(angle[1:]))])
    np.testing.assert_allclose(ratio, exact, rtol=1e-10)
    assert np.isfinite(angle_ratio(np.array([-1.0, 1.0]), np.empty(2), np.empty(2))).all()


def test_a_planted_mixture_is_recovered():
    generator = np.random.default_rng(10)
    plan = Mixture(
        weights=np.array([0.5, 0.3, 0.2]),
        origin_m=np.array([[-1.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]]),
        origin_covariance_m2=np.tile(np.diag([0.01, 0.02, 0.03]), (3, 1, 1)),
        azimuth_rad=np.array([0.0, 2.0, 4.0]),
        elevation_rad=np.array([0.0, 0.5, -1.2]),
        roll_rad=np.array([0.0, 0.3, -0.2]),
        spread_rad=np.array([[0.3, 0.1], [0.2, 0.1], [0.1, 0.25]]),
        range_m=np.array([2.0, 3.0, 4.0]),
        spread_range_m=np.array([0.1, 0.2, 0.3]),
    )
    features = features_of(drawn(plan, 30_000, generator))
    found = fit_mixture(features, Bounds.unbounded(3, Z), np.random.default_rng(0)).mixture
    found = taken(found, np.argsort(found.range_m))
    np.testing.assert_allclose(found.weights, plan.weights, atol=0.02)
    np.testing.assert_allclose(found.origin_m, plan.origin_m, atol=0.02)
    np.testing.assert_allclose(wrap_angle(found.azimuth_rad - plan.azimuth_rad), 0, atol=0.02)
    np.testing.assert_allclose(found.elevation_rad, plan.elevation_rad, atol=0.01)
    np.testing.assert_allclose(found.spread_rad, plan.spread_rad, rtol=0.05)
    np.testing.assert_allclose(found.roll_rad[:2], plan.roll_rad[:2], atol=0.05)
    np.testing.assert_allclose(found.range_m, plan.range_m, atol=0.02)
    np.testing.assert_allclose(found.spread_range_m, plan.spread_range_m, rtol=0.05)


bound = st.floats(0.0, 1.0)


@st.composite
def random_bounds(draw, count):
    base, found = vars(Bounds.unbounded(count, Z)), {}
    if draw(st.booleans()):
        found["origin_low"] = draw(bound) * 2 - 1.5
        found["origin_high"] = found["origin_low"] + draw(st.floats(0.05, 2.0))
    for name in ("origin_spread", "origin_thickness"):
        if draw(st.booleans()):
            found[name] = draw(st.floats(0.01, 0.5))
    if draw(st.booleans()):
        found |= {"azimuth_centre": 6 * draw(bound), "azimuth_half": draw(st.floats(0.05, 3.0))}
    if draw(st.booleans()):
        low = draw(st.floats(-1.5, 1.3))
        found |= {"elevation_low": low, "elevation_high": min(low + draw(st.floats(0.01, 1.0)), 1.57)}
    if draw(st.booleans()):
        low, width = (0.1 * np.array([draw(bound), draw(bound)]) for _ in range(2))
        found |= {"spread_low": low, "spread_high": low + 0.01 + 3 * width}
    if draw(st.booleans()):
        low = draw(st.floats(-math.pi / 4, math.pi / 4))
        found |= {"roll_low": low, "roll_high": draw(st.floats(low, math.pi / 4))}
    if draw(st.booleans()):
        start, width = 5 * draw(bound), draw(st.floats(0.1, 3.0))
        found |= {"start_low": start, "end_high": start + width}
        if draw(st.booleans()):
            found["width_high"] = width * draw(st.floats(0.1, 1.0))
        if draw(st.booleans()):
            found["end_low"] = start + width * draw(st.floats(0.0, 0.9))
    return Bounds(**{**base, **{name: np.full(base[name].shape, value) for name, value in found.items()}})


def assert_keeps(mixture, bounds):
    spreads = np.sqrt(np.linalg.eigvalsh(mixture.origin_covariance_m2))
    start, end = mixture.range_m - Z * mixture.spread_range_m, mixture.range_m + Z * mixture.spread_range_m
    away = np.abs(wrap_angle(mixture.azimuth_rad - bounds.azimuth_centre))
    for name, low, value, high in (
        ("origin", bounds.origin_low, mixture.origin_m, bounds.origin_high),
        ("thickness of origins", 0.0, spreads[:, 0], bounds.origin_thickness),
        ("spread of origins", 0.0, spreads[:, -1], bounds.origin_spread),
        ("azimuth", 0.0, away, bounds.azimuth_half),
        ("elevation", bounds.elevation_low, mixture.elevation_rad, bounds.elevation_high),
        ("roll", bounds.roll_low, mixture.roll_rad, bounds.roll_high),
        ("field", bounds.spread_low, mixture.spread_rad, bounds.spread_high),
        ("start", bounds.start_low, start, bounds.start_high),
        ("end", bounds.end_low, end, bounds.end_high),
        ("width", bounds.width_low, end - start, bounds.width_high),
    ):
        assert (value >= low - 1e-9).all(), name
        assert (value <= high + 1e-9).all(), name


@pytest.mark.hard_case("29")
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data(), count=st.integers(1, 4), seed_number=st.integers(0, 10_000))
def test_the_log_likelihood_never_decreases_and_every_bound_holds(data, count, seed_number):
    generator = np.random.default_rng(seed_number)
    bounds = data.draw(random_bounds(count))
    features = features_of(drawn(random_mixture(generator, 3, width=0.8), 600, generator))
    start = seed_mixture(features, bounds, generator)
    assert_keeps(start, bounds)
    trace = run_em(start, features, bounds, iterations=25)
    values = [expect(start, features).log_likelihood, *trace.history]
    assert (np.diff(values) >= 0).all()
    assert_keeps(trace.mixture, bounds)
    final = expect(trace.mixture, features).log_likelihood
    assert final == pytest.approx(trace.log_likelihood, rel=1e-9, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), mean=st.floats(0, 8), spread=st.floats(0.01, 2))
def test_the_gate_is_the_best_inside_its_bounds(data, mean, spread):
    bounds = data.draw(random_bounds(1))
    found_mean, found_spread = fit_gate(np.array([mean]), np.array([spread**2]), bounds, 1e-6)

    def quality(m, s):
        return -np.log(s) - (spread**2 + (mean - m) ** 2) / (2 * s * s)

    m, s = np.meshgrid(np.linspace(0, 10, 300), np.geomspace(0.005, 3, 300))
    inside = (m - Z * s >= bounds.start_low) & (m + Z * s <= bounds.end_high) & (m + Z * s >= bounds.end_low)
    inside &= 2 * Z * s <= bounds.width_high
    best = quality(m, s)[inside].max(initial=-np.inf)
    assert quality(found_mean[0], found_spread[0]) >= best - 1e-9


@settings(max_examples=40, deadline=None)
@given(data=st.data(), a=st.floats(0.01, 1), b=st.floats(0.01, 1), turn=st.floats(-1.5, 1.5))
def test_roll_and_spreads_are_the_best_inside_their_bounds(data, a, b, turn):
    bounds = data.draw(random_bounds(1))
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    moment = rotation @ np.diag([a * a, b * b]) @ rotation.T
    roll, spread = fit_field(moment[None], np.zeros(1), bounds, 1e-6, True)

    def variances(angle):
        axes = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        return np.diag(axes @ moment @ axes.T)

    def quality(angle, sigma):
        return (-np.log(sigma) - variances(angle) / (2 * sigma**2)).sum()

    found = quality(roll[0], spread[0])
    assert bounds.roll_low[0] <= roll[0] <= bounds.roll_high[0]
    for angle in np.linspace(bounds.roll_low[0], bounds.roll_high[0], 61):
        sigma = np.clip(np.sqrt(variances(angle)), bounds.spread_low[0], bounds.spread_high[0])
        assert found >= quality(angle, sigma) - 1e-9


def test_weights_equal_repeated_samples():
    generator = np.random.default_rng(13)
    mixture = random_mixture(generator, 2)
    points = drawn(mixture, 400, generator)
    times = generator.integers(1, 4, 400)
    weighted = features_of(points, weights=times)
    repeated = features_of(np.repeat(points, times, axis=0))
    bounds = Bounds.unbounded(2, Z)
    one = maximise(mixture, expect(mixture, weighted), weighted, bounds, Floors.of(weighted), 1.0)
    other = maximise(mixture, expect(mixture, repeated), repeated, bounds, Floors.of(repeated), 1.0)
    for name in one.__dataclass_fields__:
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-8, atol=1e-10)


FIXED = {
    "elevation fixed": ((-1.0, -1.0, 0.0, 0.0, 0.0, 0.1), (1.0, 1.0, 0.0, 2 * math.pi, 0.0, 5.0)),
    "tilted": ((0.0, 0.0, 0.0, 0.0, -0.7, 0.1), (0.0, 0.0, 0.0, 2 * math.pi, -0.7, 5.0)),
    "azimuth fixed": ((0.0, 0.0, 0.0, 1.0, -1.0, 0.1), (1.0, 0.0, 0.0, 1.0, 1.0, 5.0)),
    "one direction": ((0.0, 0.0, 0.0, 1.0, 0.5, 0.1), (1.0, 0.0, 0.0, 1.0, 0.5, 5.0)),
    "one range": ((0.0, 0.0, 0.0, 0.0, -1.0, 2.0), (1.0, 0.0, 0.0, 2 * math.pi, 1.0, 2.0)),
    "only range": ((0.0, 0.0, 0.0, 1.0, 0.5, 0.1), (0.0, 0.0, 0.0, 1.0, 0.5, 5.0)),
}


@pytest.mark.parametrize("name", FIXED)
def test_fixed_dimensions_leave_the_density(name):
    space = DesignSpace(*FIXED[name])
    generator = np.random.default_rng(14)
    features = features_of(space.sample(400, generator), space)
    trace = fit_mixture(features, Bounds.unbounded(3, Z), generator)
    assert (np.diff(trace.history) >= 0).all()
    # a uniform density over the free dimensions is known, and no fit can be far above it
    volume = math.prod(space.chart_high[i] - space.chart_low[i] for i in space.free)
    assert -math.log(volume) - 1.0 < trace.log_likelihood < -math.log(volume) + 0.6


SPACES = {name: DesignSpace(*bounds) for name, bounds in FIXED.items()} | {"all free": WHOLE, "one origin": POINT}


def naive_terms(mixture, features):
    """Log joint densities over the free dimensions alone, one sample and one component at a time, (N, K)."""
    axes = features.axes
    free, used = list(axes.origin), (axes.horizontal, axes.vertical)
    terms = np.zeros((len(features), len(mixture)))
    for k in range(len(mixture)):
        covariance = mixture.origin_covariance_m2[k][np.ix_(free, free)]
        tangent = tangent_coordinates(mixture.frames[k], features.directions.T)
        for n, point in enumerate(features.points):
            total = math.log(mixture.weights[k])
            away = (point[:3] - mixture.origin_m[k])[free]
            total -= 0.5 * (away @ np.linalg.solve(covariance, away) if free else 0.0)
            total -= 0.5 * math.log(np.linalg.det(2 * math.pi * covariance)) if free else 0.0
            for u, spread, random in zip(tangent[n], mixture.spread_rad[k], used, strict=True):
                total -= (0.5 * (u / spread) ** 2 + math.log(spread * math.sqrt(2 * math.pi))) if random else 0.0
            angle = math.hypot(*tangent[n])
            total += math.log(angle / math.sin(angle)) if all(used) and angle > 0 else 0.0
            z = (point[5] - mixture.range_m[k]) / mixture.spread_range_m[k]
            reach = 0.5 * z * z + math.log(mixture.spread_range_m[k] * math.sqrt(2 * math.pi))
            terms[n, k] = total - (reach if axes.range else 0.0)
    return terms


def case_of(name, count=70):
    """Three wide components and weighted samples of a space; boresights point off a fixed angle too."""
    generator, space = np.random.default_rng(21), SPACES[name]
    mixture = random_mixture(generator, 3, width=0.8)
    points = space.sample(count, generator)
    if name == "all free":
        points[::2] = drawn(mixture, count, generator)[::2]
    return mixture, features_of(points, space, generator.uniform(0.1, 1, count))


@pytest.mark.hard_case("30")
@pytest.mark.parametrize("block", [1, 7, 2048])
@pytest.mark.parametrize("name", SPACES)
def test_densities_and_sums_over_shares_are_those_of_the_free_dimensions_in_blocks_of_any_length(
    name, block, monkeypatch
):
    monkeypatch.setattr("lidardesign.mixture.components.BLOCK", block)
    mixture, features = case_of(name)
    terms = naive_terms(mixture, features)
    whole = logsumexp(terms, axis=1)
    shares = np.exp(terms - whole[:, None])
    np.testing.assert_allclose(log_density(mixture, features), whole, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(responsibilities(mixture, features), shares, atol=1e-9)
    found, shares = expect(mixture, features), shares * features.weights[:, None]
    assert found.log_likelihood == pytest.approx(features.weights @ whole, rel=1e-9)
    np.testing.assert_allclose(found.mass, shares.sum(axis=0), rtol=1e-8)
    np.testing.assert_allclose(found.phi, shares.T @ features.phi.T, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(found.tangent, tangent_sums(mixture, features, shares), rtol=1e-7, atol=1e-10)


def tangent_sums(mixture, features, shares):
    """Sums of 1, u_h, u_v times u_h, u_v by shares (N, K), 0 along fixed angles: (K, 2, 3)."""
    used = np.array([features.axes.horizontal, features.axes.vertical], dtype=float)
    sums = np.zeros((len(mixture), 2, 3))
    for k in range(len(mixture)):
        u = tangent_coordinates(mixture.frames[k], features.directions.T) * used
        sums[k, :, 0] = shares[:, k] @ u
        sums[k, :, 1:] = np.einsum("n,ni,nj->ij", shares[:, k], u, u)
    return sums


@pytest.mark.parametrize("name", SPACES)
def test_hard_statistics_are_sums_over_the_samples_of_a_label(name):
    mixture, features = case_of(name)
    labels = np.random.default_rng(22).choice([0, 2], size=len(features))
    shares = features.weights[:, None] * (labels[:, None] == np.arange(3))
    found = label_statistics(mixture, features, labels)
    assert math.isnan(found.log_likelihood)
    np.testing.assert_allclose(found.mass, shares.sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.phi, shares.T @ features.phi.T, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(found.tangent, tangent_sums(mixture, features, shares), rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("name", SPACES)
def test_the_mean_direction_of_a_cell_is_that_of_its_mean_unit_vector(name):
    _, features = case_of(name)
    labels = np.random.default_rng(23).choice([0, 1, 3], size=len(features))
    azimuth, elevation = mean_directions(features, labels, 5)
    assert azimuth.shape == elevation.shape == (5,)
    for cell in range(5):
        mine = labels == cell
        mean = features.weights[mine] @ features.directions[:, mine].T
        expected = math.atan2(mean[1], mean[0]) if features.axes.horizontal else 0.0
        assert abs(math.remainder(azimuth[cell] - expected, 2 * math.pi)) < 1e-12
        expected = math.atan2(mean[2], math.hypot(mean[0], mean[1])) if features.axes.vertical else 0.0
        assert elevation[cell] == pytest.approx(expected, abs=1e-12)


def test_a_component_without_weight_changes_nothing_and_its_logarithm_stays_finite():
    generator = np.random.default_rng(25)
    without = replace(random_mixture(generator, 3, width=0.8), weights=np.array([0.4, 0.0, 0.6]))
    left = taken(without, np.array([0, 2]))
    features = features_of(drawn(left, 100, generator))
    assert np.isfinite(linear_coefficients(without, features)).all()
    # a floor of 1e-12 stands under the weight
    np.testing.assert_allclose(log_density(without, features), log_density(left, features), atol=1e-6)
    assert expect(without, features).mass[1] < 1e-6


@pytest.mark.parametrize("which", ["mixture", "statistics", "features", "axes"])
def test_mixtures_and_what_they_are_fitted_to_never_change_and_arrays_are_themselves_alone(which):
    mixture, features = case_of("all free")
    ones = {"mixture": mixture, "statistics": expect(mixture, features), "features": features, "axes": features.axes}
    one = ones[which]
    same = replace(one)
    assert one == one
    assert (one == same) == (which == "axes")
    assert len({one, same}) == 1 + (one != same)
    for name in one.__dataclass_fields__:
        with pytest.raises(FrozenInstanceError):
            setattr(one, name, None)


@pytest.mark.parametrize(
    ("elevation", "turns", "scale"),
    [
        (0.0, True, 1.0),
        (-0.7, True, math.cos(0.7)),
        (math.pi / 2 - 1e-6, True, 1e-6),
        (math.pi / 2 - 1e-10, False, 1.0),
        (-math.pi / 2, False, 1.0),
    ],
)
def test_angles_along_a_fixed_elevation_are_narrower_by_its_cosine_and_none_at_a_pole(elevation, turns, scale):
    axes = Axes.of(DesignSpace((0.0, 0.0, 0.0, 0.5, elevation, 1.0), (1.0, 1.0, 0.0, 2.5, elevation, 1.0)))
    assert (axes.origin, axes.horizontal, axes.vertical, axes.range) == ((0, 1), turns, False, False)
    assert axes.angle_scale == pytest.approx(scale, rel=1e-6)
    assert (axes.azimuth_rad, axes.elevation_rad) == (0.5, elevation)
    assert Axes.of(WHOLE, (None, 1.0, None)).origin == (0, 2)
    assert Axes.of(WHOLE).angle_scale == 1.0


@pytest.mark.parametrize(
    ("half", "scale"), [(0.0, 1e-3), (1e-4, 1e-3), (0.002, 0.002), (0.4, 2 * math.sin(0.2)), (1.1, 1.0), (1.57, 1.0)]
)
def test_the_scale_of_directions_is_their_spread_from_a_thousandth_to_one_radian(half, scale):
    points = np.array([[0.0, 0.0, 0.0, azimuth, 0.0, 1.0] for azimuth in (1 - half, 1 + half)])
    assert features_of(points, POINT).angular_scale == pytest.approx(scale, rel=1e-6)


def test_coordinates_have_mean_0_and_spread_1_and_a_part_keeps_their_units_also_where_an_axis_does_not_vary():
    _, features = case_of("all free")
    points = features.points / [1, 1, 1, 9, 9, 1]
    points[:, 1] = 0.25
    features = features_of(points, WHOLE, 5 * features.weights)
    assert features.weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(features.linear @ features.weights, 0, atol=1e-12)
    np.testing.assert_allclose(np.square(features.linear) @ features.weights, [1, 0, 1, 1], atol=1e-12)
    assert features.scale[1] == pytest.approx(1e-3 * (WHOLE.high[1] - WHOLE.low[1]))
    part = features.subset(points[:, 0] > 0)
    assert part.weights.sum() == pytest.approx(1)
    np.testing.assert_array_equal(part.linear, features.linear[:, points[:, 0] > 0])
    # distances that seed components add those of coordinates and of directions, each in its unit
    looking = direction(points[:, 3], points[:, 4]).T / features.angular_scale
    apart = sum(np.square(rows - rows[:, :1]).sum(axis=0) for rows in (features.linear, looking))
    np.testing.assert_allclose(np.square(features.embedding - features.embedding[0]).sum(axis=1), apart, rtol=1e-12)
