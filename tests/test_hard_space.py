"""The design space: seams and poles of the sphere, ranges that are none, fixed dimensions, bounds that cannot be."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import references
from support.spaces import log_volume

from lidardesign.config import DensitySettings, resolve
from lidardesign.density.objective.target import MINIMUM_POLE_COSINE, build_target
from lidardesign.errors import ConfigError, NumericalError
from lidardesign.scenes.scene import Body, Plane, Scene, Sphere, rigid
from lidardesign.space import (
    AZIMUTH,
    DIMENSIONS,
    ELEVATION,
    RANGE,
    DesignSpace,
    observed_point,
)
from lidardesign.task import load_task

TURN = 2 * math.pi
BOTH_POLES = ((-1.0, -1, -1, 0, -math.pi / 2, 0.0), (1.0, 1, 1, TURN, math.pi / 2, 4.0))
AROUND = DesignSpace(*BOTH_POLES)
MEASURES = ("solid_angle", "angles")
WAYS = ("off", "quadrature", "raycast")
SETTINGS = DensitySettings(sigma_m=0.05, attenuation_per_m=20.0, sharpness_per_m=40.0, margin_m=0.05)
BALLS = Scene(
    (
        Body(Sphere(0.3), "ball", poses=rigid(translation_m=(1.2, 0.05, 0.1))),
        Body(Sphere(0.1), "before", "occluder", rigid(translation_m=(0.6, -0.1, 0.0))),
    )
)
azimuths = st.floats(-50.0, 50.0)
elevations = st.floats(-math.pi / 2, math.pi / 2)


@pytest.mark.hard_case(
    "1",
    "Azimuth across 0 and 2 pi, azimuth = 2 pi, negative azimuths",
    done="angles count modulo a turn everywhere",
)
class TestAzimuthAcrossTheSeam:
    @given(azimuths, elevations, st.floats(-7.0, 7.0), st.floats(0.1, TURN))
    def test_wrapping_turns_no_ray_and_ends_inside_any_interval_that_holds_it(self, azimuth, elevation, start, width):
        space = DesignSpace((0, 0, 0, start, -math.pi / 2, 0), (0, 0, 0, start + width, math.pi / 2, 1))
        point = np.array([0, 0, 0, azimuth, elevation, 1.0])
        wrapped = space.wrap(point)
        # a number of 50 rad is known to 7e-15
        np.testing.assert_allclose(observed_point(wrapped), observed_point(point), atol=1e-13)
        np.testing.assert_array_equal(space.wrap(wrapped), wrapped)
        assert abs(wrapped[AZIMUTH] - (start + width / 2)) <= math.pi * (1 + references.ROUNDING) + width / 2
        assert bool(space.contains(wrapped)) == bool(space.contains(point))

    @pytest.mark.parametrize("way", WAYS)
    def test_densities_and_gradients_are_the_same_a_turn_further_in_either_direction(self, way):
        space = DesignSpace((0, 0, 0, -0.5, -0.5, 0.2), (0, 0, 0, 0.5, 0.5, 3.0))
        target = build_target([BALLS], space, SETTINGS, way)
        points = space.sample(100, np.random.default_rng(1))
        values, gradient = target.log_density_and_gradient(points)
        for turns in (-1, 1, 2):
            moved, turned = target.log_density_and_gradient(points + np.eye(6)[AZIMUTH] * turns * TURN)
            # angles of ten radians are rounded to 1e-15, times slopes of up to 1e4 nats per radian here
            np.testing.assert_allclose(moved, values, atol=1e-9)
            np.testing.assert_allclose(turned, gradient, atol=1e-6, rtol=1e-6)

    @pytest.mark.parametrize("way", WAYS)
    def test_the_density_has_no_step_at_the_seam_of_a_full_turn(self, way):
        target = build_target([BALLS], AROUND, SETTINGS, way)
        points = AROUND.sample(100, np.random.default_rng(2))
        points[:, :3] *= 0.1
        before, after, last = points.copy(), points.copy(), points.copy()
        before[:, AZIMUTH], after[:, AZIMUTH], last[:, AZIMUTH] = TURN - 1e-9, 1e-9, TURN
        first = points.copy()
        first[:, AZIMUTH] = 0.0
        slopes = np.abs(target.log_density_and_gradient(first)[1][:, AZIMUTH])
        np.testing.assert_allclose(target.log_density(last), target.log_density(first), atol=1e-9)
        step = np.abs(target.log_density(before) - target.log_density(after))
        assert (step <= 2e-9 * (2 * slopes + 1) + 1e-8).all()


@pytest.mark.hard_case(
    "2",
    "Elevation at +-pi/2, where the azimuth says nothing",
    done="the chart is sin(elevation) and densities are per solid angle",
)
class TestElevationAtThePoles:
    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize("measure", MEASURES)
    def test_values_and_gradients_are_finite_at_both_poles_in_both_charts(self, measure, way):
        space = DesignSpace(*BOTH_POLES, measure=measure)
        scene = Scene((Body(Plane(), "floor", poses=rigid(translation_m=(0, 0, -2.0))), *BALLS.bodies))
        target = build_target([scene], space, SETTINGS, way)
        points = space.sample(200, np.random.default_rng(6))
        points[:, ELEVATION] = np.repeat([-math.pi / 2, math.pi / 2], 100)
        values, gradient = target.log_density_and_gradient(points)
        assert np.isfinite(values).all()
        assert np.isfinite(gradient).all()
        spun = points.copy()
        spun[:, AZIMUTH] = np.roll(points[:, AZIMUTH], 1)
        # all azimuths are the same ray
        np.testing.assert_allclose(target.log_density(spun), values, atol=1e-9)

    @given(st.floats(1e-12, 1e-3), st.floats(0, 1), st.sampled_from([-1.0, 1.0]))
    def test_a_narrow_interval_at_a_pole_has_finite_coordinates_also_where_its_sines_are_one_number(
        self, width, gap, pole
    ):
        ends = sorted((pole * (math.pi / 2 - gap * width), pole * (math.pi / 2 - (gap + 1) * width)))
        space = DesignSpace((*AROUND.low[:4], ends[0], 0.0), (*AROUND.high[:4], ends[1], 4.0))
        points = space.sample(20, np.random.default_rng(0))
        assert np.isfinite(log_volume(space))
        assert np.isfinite(space.to_unit(points)).all()
        assert space.contains(points).all()
        assert (ELEVATION in space.free) == (math.sin(ends[0]) < math.sin(ends[1]))

    def test_the_capped_derivative_is_exact_down_to_its_cap(self):
        target = build_target([BALLS], AROUND, SETTINGS, "off")
        points = np.tile([0.0, 0, 0, 0.3, 0, 1.0], (50, 1))
        cosine = np.geomspace(2 * MINIMUM_POLE_COSINE, 0.1, 50)
        points[:, ELEVATION] = np.arccos(cosine)
        gradient = target.log_density_and_gradient(points)[1][:, ELEVATION]

        def value(chart):
            return target.log_density(AROUND.from_chart(chart))

        # the chart is bent by 1 / cos^3: steps shrink with cos^2
        step = 1e-4 * np.square(cosine)
        chart = AROUND.to_chart(points)
        ends = [chart + sign * step[:, None] * np.eye(6)[ELEVATION] for sign in (1, -1)]
        numerical = (value(ends[0]) - value(ends[1])) / (2 * step)
        np.testing.assert_allclose(gradient, numerical, rtol=1e-3)


TAUS = {"negative": -0.1, "infinite": math.inf, "not a number": math.nan}


@pytest.mark.hard_case(
    "3",
    "Range 0, negative, infinite or NaN",
    done="0 is a range, where T = 1, and what is negative or not finite is refused by the name of the field",
)
class TestRangesThatAreNone:
    @pytest.mark.parametrize("way", WAYS)
    def test_at_range_zero_the_density_is_that_of_the_origin_and_nothing_is_in_the_way(self, way):
        target = build_target([BALLS], AROUND, SETTINGS, way)
        points = AROUND.sample(100, np.random.default_rng(9))
        points[:, RANGE] = 0.0
        values, gradient = target.log_density_and_gradient(points)
        distance = np.linalg.norm(points[:, :3] - [1.2, 0.05, 0.1], axis=1) - 0.3
        np.testing.assert_allclose(values, -np.square(distance / 0.05) / 2, rtol=1e-12, atol=1e-12)
        assert np.isfinite(gradient).all()

    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize("value", TAUS.values(), ids=TAUS)
    def test_the_target_density_refuses_points_by_name(self, way, value):
        points = AROUND.sample(3, np.random.default_rng(11))
        points[1, RANGE] = value
        with pytest.raises(NumericalError, match="range_m"):
            build_target([BALLS], AROUND, SETTINGS, way).log_density(points)


@pytest.mark.hard_case(
    "4",
    "Lower bound = upper bound",
    done="such a dimension is fixed: it leaves the flow and comes back with exactly its value",
)
class TestFixedDimensions:
    @given(st.sets(st.integers(0, 5)), st.integers(0, 2**20), st.sampled_from(MEASURES))
    def test_fixed_dimensions_leave_the_unit_box_and_come_back_bit_for_bit(self, fixed, seed, measure):
        generator = np.random.default_rng(seed)
        low, high = np.array(AROUND.low), np.array(AROUND.high)
        for index in fixed:
            low[index] = high[index] = generator.uniform(low[index], high[index])
        space = DesignSpace(tuple(low.tolist()), tuple(high.tolist()), measure=measure)
        assert set(space.free) == set(range(6)) - fixed
        points = space.from_unit(generator.uniform(-1, 1, (20, len(space.free))))
        for index in fixed:
            assert (points[:, index] == low[index]).all()
        assert space.contains(points).all()
        assert np.isfinite(log_volume(space))
        assert space.to_unit(points).shape == (20, 6 - len(fixed))

    @pytest.mark.parametrize("fixed", range(6))
    def test_gradients_of_the_free_dimensions_do_not_notice(self, fixed):
        generator = np.random.default_rng(12)
        low, high = list(AROUND.low), list(AROUND.high)
        low[fixed] = high[fixed] = 0.25
        space = DesignSpace(tuple(low), tuple(high))
        points = space.sample(40, generator)
        some, all_free = (build_target([BALLS], one, SETTINGS, "raycast") for one in (space, AROUND))
        values, gradient = some.log_density_and_gradient(points)
        expected, whole = all_free.log_density_and_gradient(points)
        np.testing.assert_array_equal(values, expected)
        np.testing.assert_array_equal(gradient[:, list(space.free)], whole[:, list(space.free)])

    def test_a_space_with_all_six_fixed_is_one_design_point(self):
        here = (0.1, -0.2, 0.3, 1.0, -0.4, 2.0)
        space = DesignSpace(here, here)
        assert space.free == ()
        assert log_volume(space) == 0.0
        np.testing.assert_array_equal(space.sample(4, np.random.default_rng(14)), np.tile(here, (4, 1)))
        values, gradient = build_target([BALLS], space, SETTINGS, "raycast").log_density_and_gradient(
            space.sample(2, np.random.default_rng(15))
        )
        assert np.isfinite(values).all()
        assert np.isfinite(gradient).all()


BAD_BOUNDS = {
    "upside down": ("[2, 1]", "above the upper bound"),
    "not a number below": ("[.nan, 1]", "finite"),
    "not a number above": ("[0, .nan]", "finite"),
    "infinite": ("[0, .inf]", "finite"),
    "minus infinity": ("[-.inf, 1]", "finite"),
    "overflow": ("[0, 1e999]", "too large"),
    "fixed at nothing": (".nan", "finite"),
}


@pytest.mark.hard_case(
    "5",
    "Bounds upside down, NaN or infinite",
    done="a configuration error (exit 2) that names file, line and column, the dimension, and what is allowed",
)
class TestBoundsThatCannotBe:
    @pytest.mark.parametrize("dimension", DIMENSIONS)
    @pytest.mark.parametrize("case", BAD_BOUNDS)
    def test_the_error_names_the_line_and_the_dimension(self, tmp_path, dimension, case):
        value, words = BAD_BOUNDS[case]
        file = tmp_path / "config.yaml"
        file.write_text(f"seed: 1\nspace:\n  {dimension}: {value}\n", encoding="utf-8")
        with pytest.raises(ConfigError) as caught:
            resolve(load_task("flatland"), config_file=file)
        assert caught.value.where.startswith(f"{file}:3:")
        assert f"space.{dimension}" in str(caught.value)
        assert words in str(caught.value)
        assert caught.value.exit_code == 2

    @pytest.mark.parametrize("value", [1e12, 1e300])
    @pytest.mark.parametrize("dimension", DIMENSIONS)
    def test_bounds_absurdly_far_are_refused_too(self, dimension, value):
        low, high = list(AROUND.low), list(AROUND.high)
        low[DIMENSIONS.index(dimension)] = high[DIMENSIONS.index(dimension)] = value
        words = "leaves the sphere" if dimension == "elevation_rad" else "away"
        with pytest.raises(ConfigError, match=rf"space\.{dimension}: .*{words}"):
            DesignSpace(tuple(low), tuple(high))

    @pytest.mark.parametrize(
        ("dimension", "side", "value"),
        [*product(DIMENSIONS, ("low", "high"), (math.nan, math.inf, -math.inf)),
         ("range_m", "low", -0.1), ("range_m", "high", -0.1)],
    )  # fmt: skip
    def test_the_space_itself_refuses_them_and_negative_ranges_by_name(self, dimension, side, value):
        bounds = {"low": list(AROUND.low), "high": list(AROUND.high)}
        bounds[side][DIMENSIONS.index(dimension)] = value
        with pytest.raises(ConfigError, match=rf"space\.{dimension}"):
            DesignSpace(tuple(bounds["low"]), tuple(bounds["high"]))

    @given(st.lists(st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)), min_size=6, max_size=6))
    def test_every_space_that_is_accepted_has_a_point(self, pairs):
        low, high = (tuple(pair[side] for pair in pairs) for side in (0, 1))
        try:
            space = DesignSpace(low, high)
        except ConfigError:
            assert any(a > b for a, b in pairs) or low[RANGE] < 0
            return
        points = space.sample(5, np.random.default_rng(0))
        assert space.contains(points).all()
        assert np.isfinite(points).all()
