"""Spinning sensors: rings as candidates, which of them are chosen, where, and `fit --layout spinning`."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import make_run
from support.coverages import SUMS, small

from lidardesign.api.run import open_run
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError
from lidardesign.fitting import spinning
from lidardesign.fitting.spinning import RingCandidates, chosen_rings, places_of, refine_elevations
from lidardesign.formats.designs import read_design
from lidardesign.numerics import FULL_TURN
from lidardesign.rays.coverage import LARGEST
from lidardesign.sensors.design_file import design_document, save_design
from lidardesign.space import DesignSpace

RINGS = RingCandidates(np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0]]), np.radians([-20.0, -5.0, 3.0]), 8, (1.0, 60.0))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("run") / "face", task="face")


class TestRings:
    def test_turn_evenly_at_their_elevation_about_their_place(self):
        rays = RINGS.rays(np.array([1, 5]), np.array([0, 1]))
        for sensor, (place, elevation) in enumerate((((0, 0, 2), -5.0), ((1, 0, 2), 3.0))):
            own = rays.subset(rays.sensor == sensor)
            np.testing.assert_array_equal(own.origin_m, np.tile(place, (8, 1)))
            np.testing.assert_allclose(own.elevation_rad, np.radians(elevation))
            np.testing.assert_allclose(np.diff(own.azimuth_rad), FULL_TURN / 8)
            assert own.azimuth_rad.sum() == pytest.approx(0)

    def test_of_one_sensor_fire_column_by_column(self):
        rays = RINGS.rays(np.array([0, 2]), np.array([0, 0]))
        np.testing.assert_allclose(rays.elevation_rad[:4], np.radians([-20, 3, -20, 3]))
        assert (np.diff(rays.azimuth_rad)[::2] == 0).all()

    @pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
    @given(seed=st.integers(0, 10_000), count=st.integers(1, 3))
    def test_are_as_good_as_the_best_of_all_sets_nearly_and_never_better_than_the_bound(self, table, seed, count):
        coverage, place, channels = small(seed, rays=12, gates=1, table=table), np.repeat(np.arange(4), 3), 2
        choice, loss, bound = chosen_rings(coverage, place, count, channels)
        assert sorted(np.bincount(place[choice.rays], minlength=4).tolist())[-count:] == [channels] * count
        least = min(
            coverage.loss_of(np.where(np.isin(np.arange(12), np.concatenate(rings)), 0, -1))
            for places in itertools.combinations(range(4), count)
            for rings in itertools.product(*(list(itertools.combinations(range(3 * p, 3 * p + 3), 2)) for p in places))
        )
        assert bound - 1e-9 <= least <= loss + 1e-9
        assert loss == pytest.approx(coverage.loss_of(choice.gate))
        assert loss <= least + 0.05 * coverage.complete

    def test_need_as_many_places_as_sensors_and_not_too_many_sets_of_them(self, monkeypatch):
        coverage, place = small(0, rays=12, gates=1), np.repeat(np.arange(4), 3)
        with pytest.raises(ConfigError, match="5 spinning sensors at 4 places"):
            chosen_rings(coverage, place, 5, 2)
        monkeypatch.setattr(spinning, "MOST_SETS", 5)
        with pytest.raises(ConfigError, match="2 spinning sensors at 4 places"):
            chosen_rings(coverage, place, 2, 2)


class TestCandidates:
    def test_lie_at_all_mounts_or_in_the_middle_and_at_corners_of_the_free_box(self):
        space = DesignSpace(low=(0, 0, 1, 0, -1, 1), high=(2, 1, 2, 6, 1, 60))

        def places(**origin):
            return places_of(Constraints.from_mapping({"origin": origin}), space).tolist()

        assert places(mounts_m=[[0, 0, 1], [1, 1, 2]]) == [[0, 0, 1], [1, 1, 2]]
        assert places(fixed_m=[1, 0, 2]) == [[1, 0, 2]]
        assert places() == [[0, 0, 1], [0, 1, 2], [1, 0.5, 1.5], [2, 0, 2], [2, 1, 1]]
        assert [0, 0, 1] not in places(exclude=[{"low_m": [-1, -1, 0], "high_m": [1, 0.4, 1.5]}])

    def test_are_some_of_them_even_and_the_others_where_rings_tell(self):
        even = np.linspace(-0.6, 0.2, 81)
        elevation = refine_elevations(even, np.where(np.abs(even + 0.1) < 0.05, 1.0, 0.0))
        assert (len(elevation), elevation[0], elevation[-1]) == (81, -0.6, 0.2)
        assert (np.diff(elevation) >= 0).all()
        assert np.isin(np.linspace(-0.6, 0.2, 21), elevation).all()
        assert (np.abs(elevation + 0.1) < 0.06).sum() >= 60


class TestDesigns:
    def test_have_channels_that_files_and_other_numbers_of_rays_keep(self, run, tmp_path):
        spec = open_run(run).fit(layout="spinning", channels=3, rays=150, name="spun").specification
        rays = spec.rays()
        assert (spec.layout, spec.count, len(spec.sensors)) == ("spinning", 150, 1)
        elevation, points = np.unique(rays.elevation_rad, return_counts=True)
        assert points.tolist() == [50, 50, 50]
        _, vertical = spec.sensors[0].field_of_view_rad
        assert vertical == pytest.approx(2 * np.abs(elevation).max())
        assert np.ptp(rays.azimuth_rad) == pytest.approx(FULL_TURN * 49 / 50)
        save_design(spec, tmp_path / "spun.yaml")
        again = read_design(tmp_path / "spun.yaml")
        assert design_document(again) == design_document(spec)
        np.testing.assert_array_equal(again.rays(150).direction, rays.direction)
        assert len(again.rays(75)) == 75
        (entry,) = spec.certificates
        assert 0 <= entry["bound"] <= entry["value"]
        assert (entry["rays"], entry["candidates"], entry["gates"]) == (150, 15, 1)

    def test_are_exported_exactly_where_formats_fire_even_grids_and_keep_their_channels(self, run, tmp_path):
        design = open_run(run).fit(layout="spinning", channels=2, rays=60, name="spun")
        for form in ("sdf", "urdf", "xacro", "carla"):
            exported = design.export(tmp_path / form, format=form)
            assert any("every channel is a sensor of its own" in note for note in exported.notes)
            # and none of rays that had to move, or were added
            assert not any("even grids" in note for note in exported.notes)
        again = design.constrain(constraints={"gate": {"end_m": {"max": 5.0}}})
        assert (again.specification.layout, again.specification.provenance["channels"]) == ("spinning", 2)

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            (("--layout", "spinning", "--channels", 4, "--rays", 30), "30 rays of 1 sensors with 4 channels"),
            (("--layout", "spinning", "--sensors", "best"), "'best' sensors in the layout spinning"),
            (("--layout", "even", "--channels", 4), "4 channels in the layout even"),
            (("--layout", "spinning", "--gates", "ray"), "a gate per ray in the layout spinning"),
            (("--layout", "spinning", "--channels", 100_000), "1 to 1000"),
        ],
    )
    def test_are_refused_where_options_contradict_each_other(self, lidardesign, run, options, says):
        refused = lidardesign("fit", run, *options)
        assert refused.code == 2
        assert says in refused.err

    def test_need_elevations_to_choose_among(self, tmp_path):
        with pytest.raises(ConfigError, match="16 channels"):
            open_run(make_run(tmp_path / "flat")).fit(layout="spinning", rays=16)
