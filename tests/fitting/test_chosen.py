"""`fit --layout selected`: rays that are chosen on training scenes, their tables, certificates and constraints."""

from __future__ import annotations

import functools
import json
import re

import numpy as np
import pytest
from lidardesign.layouts.rays import certificates_of, gates_of, lay_out
from support.command_line import caller, make_run
from support.tables import each_row

from lidardesign.api.run import open_run
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.density.objective.proposals import samples_without_visibility
from lidardesign.errors import ConfigError
from lidardesign.fitting import select_rays
from lidardesign.run_folder import RunFolder
from lidardesign.samples import save_samples
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design_file import design_document, load_design, save_design
from lidardesign.sensors.sensor import tangent_coordinates
from lidardesign.task import Information


@pytest.fixture
def lidardesign(capsys, tmp_path, monkeypatch):
    return caller(capsys, tmp_path, monkeypatch)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("run") / "flat")


@functools.cache
def spec_of(run, gates):
    """A design that several tests look at and none changes."""
    return chosen(run, gates=gates).specification


def chosen(run, sensors=2, **options):
    return open_run(run).fit(layout="selected", sensors=sensors, name="chosen", **options)


def tables_of(spec):
    return [*spec.further_tables, spec.ray_table]


class TestDesignsWithChosenRays:
    @pytest.mark.parametrize("gates", ["sensor", "ray"])
    def test_rays_lie_in_their_sensors_fields_and_gates(self, run, gates):
        spec = spec_of(run, gates)
        assert [len(table) for table in tables_of(spec)] == sorted(open_run(run).task.defaults.rays)
        for table in tables_of(spec):
            for index, sensor in enumerate(spec.sensors):
                own = table.subset(table.sensor == index)
                away = np.abs(tangent_coordinates(sensor.frame, own.direction))
                assert (away <= np.array(sensor.field_of_view_rad) / 2 + 1e-9).all()
                start, end = sensor.gate_m
                assert (own.gate_m[:, 0] >= start - 1e-12).all()
                assert (own.gate_m[:, 1] <= end + 1e-12).all()
                assert gates == "ray" or np.allclose(own.gate_m, [start, end], rtol=0, atol=1e-12)

    def test_no_two_chosen_rays_are_the_same(self, run):
        for table in tables_of(spec_of(run, "ray")):
            assert len(np.unique(np.hstack([table.origin_m, table.angles_rad]), axis=0)) == len(table)

    def test_constraints_are_kept_by_every_table(self, run):
        rules = {"gate": {"width_m": {"max": 0.6}}, "budget": {"bandwidth_mbps": 0.3}}
        design = chosen(run, gates="ray", constraints=rules)
        document = design_document(design.specification)
        checks = check_design(document, Constraints.from_mapping(rules), open_run(run).config.space)
        assert all(check.satisfied for check in checks)
        # a table that breaks them is found
        document["further_tables"][0]["gate_end_m"][0] += 5.0
        checks = check_design(document, Constraints.from_mapping(rules), open_run(run).config.space)
        assert not all(check.satisfied for check in checks)

    def test_files_give_them_back_bit_by_bit(self, run, tmp_path):
        spec = spec_of(run, "ray")
        path = tmp_path / "chosen.yaml"
        save_design(spec, path)
        again = load_design(path)
        assert design_document(again) == design_document(spec)
        for table in tables_of(spec):
            laid_out = lay_out(again, len(table))
            for name in ("origin_m", "direction", "gate_m", "sensor", "time_s"):
                np.testing.assert_array_equal(getattr(laid_out, name), getattr(table, name))

    def test_other_numbers_of_rays_are_refused(self, run):
        with pytest.raises(ConfigError, match="10 rays, which were not chosen"):
            lay_out(spec_of(run, "ray"), 10)

    def test_the_same_seed_chooses_the_same_rays_and_another_one_others(self, run):
        first, second, other = (chosen(run, rays=9, seed=seed).specification for seed in (0, 0, 1))
        np.testing.assert_array_equal(first.ray_table.direction, second.ray_table.direction)
        assert not np.array_equal(first.ray_table.direction, other.ray_table.direction)

    def test_certificates_bound_the_loss_from_below(self, run):
        for entry in certificates_of(spec_of(run, "ray")):
            assert 0 <= entry["bound"] <= entry["value"]
            assert entry["gap"] == pytest.approx((entry["value"] - entry["bound"]) / entry["value"])
            assert entry["scenes"] in (5, 10)

    @pytest.mark.parametrize("limit", [{}, {"budget": {"bandwidth_mbps": 0.3}}])
    def test_the_middle_number_says_what_bandwidth_and_more_candidates_buy(self, run, limit):
        entries = certificates_of(chosen(run, gates="ray", constraints=limit).specification)
        (middle,) = (entry for entry in entries if {"curve", "gap_doubled"} & set(entry))
        assert middle is entries[len(entries) // 2]
        mbps, loss = np.array(middle["curve"]).T
        assert (np.diff(mbps) > 0).all()
        assert (np.diff(loss) < 0).all()
        assert 0 <= middle["gap_doubled"] < 1
        assert {entry["unit"] for entry in entries} == {"m"}

    def test_it_looks_at_training_scenes_that_nothing_was_learned_from(self, run, monkeypatch):
        asked = []
        scenes = RunFolder.scenes
        monkeypatch.setattr(
            RunFolder, "scenes", lambda self, split, seed: asked.append((split, seed)) or scenes(self, split, seed)
        )
        chosen(run, rays=9)
        assert {split for split, _ in asked} == {"train"}
        assert open_run(run).config.seed not in {seed for _, seed in asked}
        # what judges is drawn apart from what is chosen on
        assert len({seed for _, seed in asked}) >= 2

    @pytest.mark.parametrize("gates", ["sensor", "ray"])
    def test_constrained_again_they_are_chosen_again_with_the_same_kind_of_gates(self, run, gates):
        again = chosen(run, rays=9, gates=gates).constrain(constraints={"gate": {"width_m": {"max": 0.5}}})
        assert again.specification.layout == "selected"
        assert gates_of(again.specification) == gates


class TestTheCommand:
    def test_names_the_sensors_that_no_ray_starts_from(self, lidardesign, run):
        fitted = lidardesign("fit", run, "--sensors", 6, "--rays", 6, "--name", "many", "--json")
        idle = [sensor["name"] for sensor in fitted.json["sensors"] if sensor["rays"] == 0]
        assert len(idle) >= 2
        assert f"note: {', '.join(idle)} need not be built: none of the 6 rays starts there" in fitted.err
        fitted = lidardesign("fit", run, "--sensors", 1, "--rays", 2, "--name", "one")
        assert "need not be built" not in fitted.err

    def test_says_how_far_from_the_best_they_are(self, lidardesign, run):
        printed = lidardesign("fit", run, "--layout", "selected", "--sensors", 2, "--rays", 9, "--name", "a")
        words = r"^chosen among \d+ rays on \d+ training scenes; these 9 have a loss of"
        assert re.search(words, printed.out, re.MULTILINE)
        fitted = lidardesign("fit", run, "--layout", "selected", "--sensors", 2, "--rays", 9, "--name", "a", "--json")
        shown = lidardesign("show", run / "designs" / "a.yaml", "--json")
        assert json.loads(fitted.out)["certificates"] == json.loads(shown.out)["provenance"]["certificates"]

    def test_evaluates_at_the_numbers_that_were_chosen(self, lidardesign, run):
        lidardesign("fit", run, "--layout", "selected", "--sensors", 2, "--rays", 9, "--name", "a")
        scored = lidardesign("evaluate", run / "designs" / "a.yaml", "--json", "--set", "test=2")
        assert {row["rays"] for row in scored.json["rows"] if row["design"] == "a"} == {9}
        refused = lidardesign("evaluate", run / "designs" / "a.yaml", "--rays", 10)
        assert refused.code == 2
        assert "rays were chosen at other numbers" in refused.err

    @each_row(
        ("options", "message"),
        [
            (("--weight", "variation=0.1"), "layout selected with --weight"),
            (("--rays", "5001"), "--rays: 5001"),
        ],
    )
    def test_what_does_not_go_together_is_refused(self, lidardesign, run, options, message):
        refused = lidardesign("fit", run, "--layout", "selected", *options)
        assert refused.code == 2
        assert message in refused.err

    def test_rays_that_tell_nothing_are_refused(self, lidardesign, run, monkeypatch):
        nothing = Information(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(5, int))
        monkeypatch.setattr(select_rays, "checked_information", lambda task, scene, returns: nothing)
        refused = lidardesign("fit", run, "--layout", "selected", "--rays", 4)
        assert refused.code == 3
        assert "tells anything about 5 training scenes" in refused.err

    def test_a_single_ray_can_be_chosen(self, run):
        assert len(chosen(run, sensors=1, rays=1, gates="ray").specification.ray_table) == 1

    def test_a_task_that_does_not_say_what_returns_tell_is_refused(self, lidardesign, run, monkeypatch):
        monkeypatch.setattr("lidardesign.fitting.request.informs_rays", lambda task: False)
        refused = lidardesign("fit", run, "--layout", "selected")
        assert refused.code == 2
        assert "has no method informs" in refused.err

    def test_damaged_certificates_are_left_out(self, lidardesign, run):
        lidardesign("fit", run, "--layout", "selected", "--sensors", 2, "--rays", 9, "--name", "a")
        path = run / "designs" / "a.yaml"
        spec = load_design(path)
        spec.provenance["certificates"] = [{"rays": "nine"}, 3]
        save_design(spec, path)
        shown = lidardesign("show", path)
        assert shown.code == 0
        assert "rays chosen on training scenes" not in shown.out


@pytest.fixture(scope="module")
def aisle(tmp_path_factory):
    folder = make_run(tmp_path_factory.mktemp("run") / "aisle", task="warehouse")
    config = RunFolder.open(folder).config
    scenes = RunFolder.open(folder).scenes("train", config.seed)
    generator = np.random.default_rng(0)
    save_samples(samples_without_visibility(scenes, config.space, config.density, 20_000, generator), folder)
    return folder


@pytest.fixture(scope="module")
def along(aisle):
    return chosen(aisle, constraints={"budget": {"bandwidth_mbps": 0.2}}).specification


class TestTracksOfChosenRays:
    def test_each_number_of_rays_has_one_that_leads_through_the_whole_aisle(self, aisle, along):
        space, tracks = open_run(aisle).config.space, [*along.further_tracks, along.track]
        assert [len(track.sensor) for track in tracks] == sorted(open_run(aisle).task.defaults.rays)
        for track in tracks:
            assert (track.knots[0], track.knots[-1]) == (space.low[0], space.high[0])
        for count, at in ((6, space.low[0]), (12, 1.0), (18, space.high[0])):
            rays = lay_out(along, count, at={"x_m": at})
            assert len(rays) == count
            assert (rays.origin_m[:, 0] == at).all()

    def test_the_bandwidth_is_kept_everywhere_between_knots_too(self, aisle, along):
        rules = Constraints.from_mapping({"budget": {"bandwidth_mbps": 0.2}})
        checks = check_design(design_document(along), rules, open_run(aisle).config.space)
        assert all(check.satisfied for check in checks)
        for count in (6, 12, 18):
            for at in np.linspace(-0.5, 4.0, 97):
                assert Bandwidth().mbps(lay_out(along, count, at={"x_m": float(at)})) <= 0.2 + 1e-12

    def test_files_give_them_back_bit_by_bit(self, along, tmp_path):
        path = tmp_path / "chosen.yaml"
        save_design(along, path)
        assert design_document(load_design(path)) == design_document(along)

    def test_a_place_is_refused_by_name(self, lidardesign, aisle):
        refused = lidardesign("fit", aisle, "--layout", "selected", "--at", "x_m=0.5")
        assert refused.code == 2
        assert "layout selected with --at" in refused.err
