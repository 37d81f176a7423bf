"""Rays that are chosen on training scenes, from the command to the evaluation: seeds, scenes, files and messages."""

from __future__ import annotations

import functools
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
from support.command_line import make_run, set_options

from lidardesign.api.run import open_run
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.density.objective.proposals import samples_without_visibility
from lidardesign.errors import ConfigError
from lidardesign.formats.designs import load_design, read_design
from lidardesign.rays import training_scenes
from lidardesign.run.yaml import dump_yaml
from lidardesign.run_folder import RunFolder
from lidardesign.samples import save_samples
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design_file import design_document, save_design
from lidardesign.task import Information


def chosen(run, sensors=2, **options):
    return open_run(run).fit(sensors=sensors, name="chosen", **options)


@pytest.fixture(scope="module")
def run(made):
    """A run with a design of nine rays."""
    chosen(made, rays=9).save()
    return made


@functools.cache
def spec_of(run):
    """A design that several tests look at and none changes."""
    return chosen(run, gates="ray").specification


class TestDesignsWithChosenRays:
    def test_have_a_pattern_for_each_number_of_the_task_in_which_no_two_rays_are_the_same(self, run):
        assert spec_of(run).counts == sorted(open_run(run).task.defaults.rays)
        for pattern in spec_of(run).patterns:
            angles = np.stack([pattern.azimuth_rad[0], pattern.elevation_rad[0]], axis=1)
            assert len(np.unique(np.hstack([pattern.origin_m[0], angles]), axis=0)) == len(pattern)

    def test_fire_no_other_number_of_rays(self, run):
        with pytest.raises(ConfigError, match="no choice of 10 rays"):
            spec_of(run).rays(10)

    def test_may_fire_a_single_ray(self, run):
        assert len(chosen(run, sensors=1, rays=1, gates="ray").rays()) == 1

    def test_are_the_same_for_the_same_seed_and_others_for_another_one(self, run):
        first, second, other = (chosen(run, rays=9, seed=seed).rays() for seed in (0, 0, 1))
        np.testing.assert_array_equal(first.direction, second.direction)
        assert not np.array_equal(first.direction, other.direction)

    def test_are_chosen_on_training_scenes_that_nothing_was_learned_from(self, run, monkeypatch):
        asked, scenes = [], RunFolder.scenes
        monkeypatch.setattr(
            RunFolder, "scenes", lambda self, split, seed: asked.append((split, seed)) or scenes(self, split, seed)
        )
        # a region needs no density at any one place, and so no scene that was learned from
        chosen(run, rays=9, constraints={"origin": {"spread_m": {"max": 0.5}}})
        assert {split for split, _ in asked} == {"train"}
        assert open_run(run).config.seed not in {seed for _, seed in asked}
        # what judges is drawn apart from what is chosen on
        assert len({seed for _, seed in asked}) >= 2

    @pytest.mark.parametrize("limit", [{}, {"budget": {"bandwidth_mbps": 0.3}}])
    def test_say_what_more_bandwidth_buys(self, run, limit):
        certificates = chosen(run, gates="ray", constraints=limit).specification.certificates
        for entry in certificates:
            mbps, loss = np.array(entry["curve"]).T
            assert (np.diff(mbps) > 0).all()
            assert (np.diff(loss) < 0).all()
        assert {entry["unit"] for entry in certificates} == {"m"}

    @pytest.mark.parametrize("gates", ["sensor", "ray"])
    def test_are_chosen_again_with_the_same_kind_of_gates(self, run, gates):
        again = chosen(run, rays=9, gates=gates).constrain(constraints={"gate": {"width_m": {"max": 0.5}}})
        assert again.specification.layout == "chosen"
        assert again.specification.has_gates_per_ray == (gates == "ray")


CHANGES = {
    "a gap below zero": lambda certificate, pattern: certificate.update(gap=-0.5),
    "a bound above the value": lambda certificate, pattern: certificate.update(bound=9 * certificate["value"] + 1),
    "words for a number": lambda certificate, pattern: certificate.update(rays="nine"),
    "no digest": lambda certificate, pattern: certificate.pop("digest"),
    "a ray elsewhere": lambda certificate, pattern: pattern["azimuth_rad"][0].__setitem__(3, 0.25),
    "another gate": lambda certificate, pattern: pattern["gate_end_m"][0].__setitem__(3, 3.25),
    "another sensor": lambda certificate, pattern: pattern["sensor"].__setitem__(0, 1),
}


@pytest.fixture
def nine(run):
    """Its path; the design is put back afterwards."""
    path = run / "designs" / "chosen.yaml"
    content = path.read_bytes()
    yield path
    path.write_bytes(content)


class TestTheCommand:
    def test_says_how_far_from_the_best_they_are(self, lidardesign, run, nine):
        printed = lidardesign("fit", run, "--sensors", 2, "--rays", 9, "--name", "chosen")
        assert re.search(r"^chosen among \d+ rays on \d+ training scenes", printed.out, re.MULTILINE)
        shown = lidardesign("show", nine, "--json").json["certificates"]
        assert [(entry["rays"], entry["unit"]) for entry in shown] == [(9, "m")]

    def test_scores_them_at_the_numbers_that_were_chosen(self, lidardesign, nine):
        scored = lidardesign("evaluate", nine, "--json", "--set", "test=2", "--baseline", "random").json
        assert {row["rays"] for row in scored["rows"] if row["design"] == "chosen"} == {9}
        refused = lidardesign("evaluate", nine, "--rays", 10)
        assert refused.code == 2
        assert "rays were chosen at other numbers" in refused.err

    def test_refuses_rays_that_tell_nothing(self, lidardesign, run, monkeypatch):
        nothing = Information(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(5, int))
        monkeypatch.setattr(training_scenes, "checked_information", lambda *arguments: nothing)
        refused = lidardesign("fit", run, "--rays", 4)
        assert refused.code == 4
        assert "has information about 5 training scenes" in refused.err

    def test_needs_a_task_that_says_what_returns_tell(self, lidardesign, run, monkeypatch):
        monkeypatch.setattr("lidardesign.fitting.options.informs_rays", lambda task: False)
        refused = lidardesign("fit", run, "--layout", "chosen")
        assert refused.code == 2
        assert "has no method informs" in refused.err

    @pytest.mark.parametrize("change", CHANGES)
    def test_leaves_certificates_out_that_are_damaged_or_of_other_rays(self, lidardesign, nine, change):
        document = design_document(load_design(nine))
        CHANGES[change](document["certificates"][0], document["patterns"][0])
        nine.write_text(dump_yaml(document), encoding="utf-8")
        shown = lidardesign("show", nine, "--json")
        assert (shown.code, shown.json["certificates"]) == (0, [])
        assert "left out" in shown.err

    def test_is_held_against_its_own_sensors_without_constraints(self, lidardesign, nine):
        spec = load_design(nine)
        moved = replace(spec.sensors[0], origin_m=spec.sensors[0].origin_m + 3.0)
        save_design(replace(spec, sensors=(moved, *spec.sensors[1:])), nine)
        for words in ("show", nine), ("evaluate", nine, "--set", "test=2", "--baseline", "none"):
            told = lidardesign(*words)
            assert "chosen breaks s0.rays.origin_m" in f"{told.out}{told.err}"


def test_along_an_aisle_patterns_lead_all_the_way_and_keep_the_bandwidth_between_knots_too(tmp_path):
    aisle = make_run(tmp_path / "aisle", task="warehouse")
    opened, generator = RunFolder.open(aisle), np.random.default_rng(0)
    scenes, config = opened.scenes("train", opened.config.seed), opened.config
    save_samples(samples_without_visibility(scenes, config.space, config.density, 5000, generator), aisle)
    rules, space = {"budget": {"bandwidth_mbps": 0.2}}, open_run(aisle).config.space
    design = chosen(aisle, rays=16, constraints=rules).specification
    assert {pattern.ends for pattern in design.patterns} == {(space.low[0], space.high[0])}
    save_design(design, aisle / "along.yaml")
    assert read_design(aisle / "along.yaml").certificates == design.certificates != ()
    checks = check_design(design_document(design), Constraints.from_mapping(rules), space)
    assert all(check.satisfied for check in checks)
    for at in np.linspace(space.low[0], space.high[0], 97):
        rays = design.rays(at={"x_m": float(at)})
        assert len(rays) == 16
        assert (rays.origin_m[:, 0] == at).all()
        assert Bandwidth().mbps(rays) <= 0.2 + 1e-12


def test_the_command_of_a_refused_place_learns_a_run_that_has_room_for_it(lidardesign, run):
    space = open_run(run).config.space
    place = [float(space.low[0]) - 0.05, *map(float, space.low[1:3])]
    words = ("--set", f"origin.fixed_m={place}", "--layout", "even", "--sensors", 1, "--name", "far")
    refused = lidardesign("constrain", run, *words)
    assert refused.code == 4
    command = shlex.split(refused.err.partition("room for it: ")[2].splitlines()[0])
    assert command[:2] == ["lidardesign", "learn"]
    settings = ("learning.steps=20", "learning.layers=1", "learning.samples=1000", "learning.coverage_proposals=256")
    assert lidardesign(*command[1:], *set_options(settings)).code == 0
    wide = open_run(command[command.index("--out") + 1])
    np.testing.assert_allclose(wide.config.space.low[:3], place)
    assert "space.x_m" not in lidardesign("constrain", wide.folder, *words).err
