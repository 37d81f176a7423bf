"""`fit --parts`: which real parts, and where; the design keeps its bounds and fires its parts' own rays."""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.command_line import make_run

from lidardesign.api.run import open_run
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import split_settings
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.fitting import part_design, trials
from lidardesign.fitting.part_sets import SetLimits, choose_set
from lidardesign.fitting.part_shapes import COARSE_CELL_RAD, PartBundle, cells_of, part_table, parts_inform
from lidardesign.formats.designs import read_design
from lidardesign.parts.catalogue import FOLDER, find_part, load_library, part_rays
from lidardesign.rays import information
from lidardesign.samples import load_samples
from lidardesign.sensors.design_file import design_document, save_design
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import IDEAL, Physics
from lidardesign.simulate.returns import simulate_many
from lidardesign.task import Information

THREE = ["vl53l5cx", "vl53l5cx:4x4", "tmf8828"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("run") / "flat")


@pytest.fixture(autouse=True, scope="module")
def few():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(information, "FEW_SCENES", 4)
        patch.setattr(information, "MOST_SCENES", 4)
        patch.setattr(part_design, "MOST_POSES", 20)
        yield


@pytest.fixture(scope="module")
def two(run, few):
    """A design of two parts."""
    return bought(run)


def bought(run, sensors=2, **constraints):
    return open_run(run).fit(parts=THREE, sensors=sensors, constraints=constraints or None, name="bought").specification


class TestDesignsOfParts:
    def test_fire_the_rays_of_parts_that_were_named_and_are_the_same_for_the_same_seed(self, run, two):
        assert [sensor.part in THREE for sensor in two.sensors] == [True, True]
        assert len(two.rays()) == sum(find_part(sensor.part).rays for sensor in two.sensors)
        rules = {"parts": {"names": THREE}}
        assert all(check.satisfied for check in check_design(design_document(two), rules))
        assert design_document(bought(run)) == design_document(two)

    def test_say_how_far_from_the_best_they_may_be(self, two, tmp_path):
        save_design(two, tmp_path / "bought.yaml")
        (certificate,) = read_design(tmp_path / "bought.yaml").certificates
        assert 0 <= certificate["bound"] <= certificate["value"]
        assert 0 <= certificate["gap"] <= 1
        assert certificate["scenes"] == 4

    def test_have_no_more_of_a_part_than_is_allowed(self, run):
        each = {"vl53l5cx": {"max": 1}, "tmf8828": {"max": 1}}
        spec = bought(run, sensors=3, parts={"names": "catalog", "each": each})
        names = [sensor.part for sensor in spec.sensors]
        assert max(names.count(name) for name in each) <= 1

    def test_count_all_modes_of_a_part_where_its_name_has_none(self, run):
        each = {"vl53l5cx": {"max": 1}}
        spec = bought(run, sensors=3, parts={"names": THREE, "each": each})
        document = design_document(spec)
        assert sum(sensor.part.startswith("vl53l5cx") for sensor in spec.sensors) == 1
        for sensor, name in zip(document["sensors"], THREE, strict=True):
            sensor["part"] = name
        counted = [check.value for check in check_design(document, {"parts": {"each": each}}) if "each" in check.name]
        assert counted == [2]

    @pytest.mark.parametrize("part", ["nosuch", "vl53l8ch:64x64", "tmf8701"])
    def test_are_the_parts_that_they_name_whether_parts_are_constrained_or_not(self, two, part):
        document = design_document(two)
        assert all(check.satisfied for check in check_design(document, {}))
        document["sensors"][1]["part"] = part
        assert [check.name for check in check_design(document, {}) if not check.satisfied] == ["s1.part"]

    def test_look_where_they_may(self, run):
        middle = bought(run, sensors=1).sensors[0].azimuth_rad
        bound = float(np.degrees(middle)) + 5.0
        spec = bought(run, boresight={"azimuth_deg": {"min": bound, "max": bound + 20}})
        away = np.mod(np.degrees([sensor.azimuth_rad for sensor in spec.sensors]) - bound, 360)
        assert (away <= 20 + 1e-6).all()

    def test_are_upright_where_they_may_not_roll(self, run):
        spec = bought(run, sensors=3, boresight={"roll_deg": {"min": 0, "max": 0}})
        assert [sensor.roll_rad for sensor in spec.sensors] == pytest.approx([0.0] * len(spec.sensors))

    def test_keep_a_bandwidth_and_a_number_of_rays(self, run):
        spec = bought(run, budget={"rays": 30, "bandwidth_mbps": 10.0})
        assert spec.count == 30

    def test_fire_no_more_than_a_power_and_leave_unknown_ones_out(self, run):
        notes = []
        rules = {"parts": {"names": "catalog", "power_w": 0.3}}
        fitted = open_run(run).fit(parts=["tmf8820", "tmf8828"], sensors=3, constraints=rules, notes=notes.append)
        sensors = fitted.specification.sensors
        assert {sensor.part for sensor in sensors} == {"tmf8820"}
        assert len(sensors) <= 2
        assert any("tmf8828" in note and "left out" in note for note in notes)


ASKED = {"parts": ["vl53l5cx", "tmf8820"], "sensors": 2}
LIGHT = {"detector": "consumer-8x8", "settings": ["illuminance_lux=100000"]}
WORLD = {"detector": "consumer-8x8", "set": ["illuminance_lux=100000"]}


class TestTheWorldAsItIs:
    def test_is_recorded_and_asked_for_again(self, run):
        first = open_run(run).fit(**ASKED, **LIGHT, name="bright")
        assert first.specification.provenance["world"] == WORLD
        again = first.constrain(parts=ASKED["parts"], sensors=2, name="bright").specification
        assert design_document(again)["patterns"] == design_document(first.specification)["patterns"]
        assert again.provenance["world"] == first.specification.provenance["world"]
        dark = first.constrain(parts=ASKED["parts"], sensors=2, detector="ideal", settings=["illuminance_lux=0"])
        assert dark.specification.provenance["world"] == {"detector": "ideal", "set": ["illuminance_lux=0"]}

    def test_is_judged_by_effects_that_a_line_names_with_what_the_others_could_change(self, run):
        notes = []
        open_run(run).fit(**ASKED, **LIGHT, name="bright", notes=notes.append)
        (line,) = [note for note in notes if note.startswith("judged under consumer-8x8")]
        assert "photon_noise" in line
        assert "multipath" not in line
        assert "could change" in line

    def test_takes_the_set_with_the_best_score(self, run, monkeypatch):
        """Whatever the proxy says: the scores are turned round, and the worst of the sets is taken."""
        tried = []

        def score(every, scorer, count):
            tried[:] = every if len(every) > 1 else tried
            for trial in every:
                order = every.index(trial) if len(every) > 1 else 0
                trial.scores = np.append(trial.scores, np.full(count - len(trial.scores), 100.0 - order))

        for module in (part_design, trials):
            monkeypatch.setattr(module, "score_trials", score)
        spec = open_run(run).fit(**ASKED, name="last").specification
        assert spec.sensors == tried[-1].design.sensors
        (certificate,) = spec.certificates
        assert certificate["bound"] <= certificate["value"]

    @pytest.mark.parametrize(
        ("words", "settings"),
        [
            (["gate.end_m.max=1"], 0),
            (["illuminance_lux=0", "gate.end_m.max=1", "light=sun"], 2),
            (["gaet.end_m.max=1"], 0),
        ],
    )
    def test_has_the_keys_of_the_task_beside_those_of_constraints(self, run, words, settings):
        bounds, own = split_settings(words, open_run(run).task)
        assert len(own) == settings
        assert sorted([*bounds, *own]) == sorted(words)

    def test_cannot_change_what_was_learned(self, run):
        with pytest.raises(ConfigError, match=r"learned|space"):
            open_run(run).fit(**ASKED, settings=["sigma_m=0.1"])

    def test_of_commands_is_that_of_python(self, lidardesign, run):
        options = ["--set", "illuminance_lux=100000", "--detector", "consumer-8x8", "--json"]
        parts = ["--parts", ",".join(ASKED["parts"]), "--sensors", 2, "--name", "bright"]
        done = lidardesign("fit", run, *parts, *options)
        assert done.code == 0, done.err
        done = lidardesign("constrain", run, *parts, *options, "--set", "parts.each.tmf8820.max=2", "--name", "again")
        assert done.code == 0, done.err
        worlds = [open_run(run).designs()[n].specification.provenance["world"] for n in (0, 1)]
        assert worlds == [WORLD, WORLD]


def priced(folder, name, price, **figures):
    """A copy of a shipped part with a price, or without."""
    text = (FOLDER / f"{name}.yaml").read_text()
    path = folder / f"my-{name}.yaml"
    path.write_text(text if price is None else f"{text}\nprice: [{{value: {price}, source: datasheet}}]\n")
    return str(path)


class TestPrices:
    def test_are_summed_bounded_and_left_out_where_they_are_unknown(self, run, tmp_path):
        own = [priced(tmp_path, "vl53l5cx", 10.0), priced(tmp_path, "tmf8820", None)]
        notes = []
        rules = {"parts": {"price": {"max": 25}}}
        spec = open_run(run).fit(parts=own, sensors=3, constraints=rules, name="cheap", notes=notes.append)
        names = [sensor.part for sensor in spec.specification.sensors]
        assert names == ["my-vl53l5cx"] * 2
        assert any("price of my-tmf8820" in note for note in notes)
        assert any("cost 20" in note for note in notes)
        document, rules = design_document(spec.specification), {"parts": {"names": own, "price": {"max": 19}}}
        assert [check.satisfied for check in check_design(document, rules)][-1] is False


class TestNumbersOfParts:
    def test_are_a_table_whose_best_is_the_design(self, run):
        fitted = open_run(run).fit(parts=THREE, sensors="1-3", name="table")
        rows = fitted.as_dict()["numbers"]
        assert [row["sensors"] for row in rows] == list(range(1, len(rows) + 1))
        assert all(sum(row["parts"].values()) == row["sensors"] for row in rows)
        best = min(rows, key=lambda row: row["score"])
        assert len(fitted.specification.sensors) == best["sensors"]
        assert Counter(sensor.part for sensor in fitted.specification.sensors) == best["parts"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sensors": "1-3"}, "without parts"),
        ({"sensors": "3-1"}, "1-4"),
        ({"parts": ["vl53l8cx"]}, "number of parts is missing"),
        ({"parts": ["vl53l8cx"], "sensors": 1, "layout": "even"}, "parts in the layout even"),
        ({"parts": ["vl53l8cx"], "sensors": 1, "gates": "ray"}, "with gates"),
        ({"parts": [str(Path(__file__).parent)], "sensors": 1}, "holds no file"),
        (
            {"sensors": 1, "constraints": {"parts": {"names": ["vl53l8cx"], "each": {"vl53l5cx": {"max": 1}}}}},
            "'vl53l5cx' is not one of the parts",
        ),
    ],
)
def test_what_cannot_be_is_refused(run, options, words):
    with pytest.raises(ConfigError, match=words):
        open_run(run).fit(name="none", **options)


@pytest.mark.parametrize(
    ("bounds", "named"),
    [
        ({"field_of_view": {"horizontal_deg": {"max": 1.0}}}, "field_of_view.horizontal_deg.max"),
        ({"budget": {"bandwidth_mbps": 0.001}}, "budget.bandwidth_mbps"),
        ({"budget": {"rays": 500}}, "rays, not 500"),
        ({"boresight": {"roll_deg": {"min": 5}}}, "plane"),
        ({"each": [{"gate": {"width_m": {"max": 0.1}}}]}, "no part satisfies"),
        ({"parts": {"price": {"max": 40}}}, "price of any"),
    ],
)
def test_bounds_that_no_part_keeps_are_named(run, bounds, named):
    with pytest.raises(InfeasibleError, match=re.escape(named)):
        bought(run, **bounds)


@pytest.mark.parametrize(
    ("options", "conflicts"),
    [
        ({"sensors": 2, "rays": 1}, ["rays", "sensors"]),
        ({"constraints": {"parts": {"count": 2}, "budget": {"rays": 1}}}, ["budget.rays", "parts.count"]),
        ({"constraints": {"parts": {"count": 1}, "sensors": {"count": 2}}}, ["sensors.count", "parts.count"]),
        ({"constraints": {"parts": {"count": 1}, "sensors": {"min": 2}}}, ["sensors.min", "parts.count"]),
    ],
)
def test_fewer_rays_or_parts_than_are_asked_for_are_refused_before_anything_is_cast(
    run, monkeypatch, options, conflicts
):
    monkeypatch.setattr(part_design, "proposed", None)
    with pytest.raises(InfeasibleError) as refusal:
        open_run(run).fit(parts=THREE, name="none", **options)
    assert list(refusal.value.conflicts) == conflicts


def test_fit_prints_parts_and_evaluate_takes_them(lidardesign, run):
    result = lidardesign("fit", run, "--parts", "vl53l5cx,tmf8828", "--sensors", 2, "--name", "b", "--json")
    assert result.code == 0, result.err
    assert {sensor["part"] for sensor in result.json["sensors"]} <= {"vl53l5cx", "tmf8828"}
    options = ("--rays", 64, "--baseline", "uniform", "--set", "test=2")
    scored = lidardesign("evaluate", run / "designs" / "b.yaml", *options)
    assert scored.code == 0, scored.err


# what parts tell, without a task


def every_return(scene, returns, share=None):
    """Every ray tells about one item, its tenth of azimuth, by its range."""
    rays = returns[0].rays
    tenth = np.mod(np.arctan2(rays.direction[:, 1], rays.direction[:, 0]) * 10 / (2 * np.pi), 10).astype(int)
    hit = np.flatnonzero(returns[0].returned)
    return Information(hit, tenth[hit], 1.0 + 0 * hit, np.zeros(10, dtype=int))


def test_cells_hold_directions_that_are_near():
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    cell, cells = cells_of(directions, COARSE_CELL_RAD)
    assert 0 <= cell.min() <= cell.max() < cells
    assert cells == pytest.approx(4 * np.pi / COARSE_CELL_RAD**2, rel=0.05)
    for one in np.unique(cell):
        own = directions[cell == one]
        assert (own @ own.T).min() > np.cos(1.6 * COARSE_CELL_RAD)


ZONES = replace(load_detector("consumer-8x8"), bins=None)


@pytest.mark.parametrize("detector", [IDEAL, ZONES], ids=["lines", "zones"])
def test_a_part_tells_what_its_own_rays_would(run, detector):
    opened = open_run(run)
    parts = [find_part(name) for name in THREE]
    placed = part_design.proposed(parts, part_design.Constraints(), 2, load_samples(run), 0)
    scene = opened.task.scenes(opened.config.task, "train", 0)[0]
    bundle = PartBundle(placed, 64, 1, detector)
    coverage = part_table(parts_inform(bundle, [scene], every_return, 2, 0), len(placed))
    for number in range(0, len(placed), 7):
        one = placed[number]
        rays = part_rays(one.part, one.pose)
        own = detector and replace(detector, divergence_rad=one.part.beam_rad, footprint_rays=4)
        ((returns,),) = simulate_many(scene, [rays], physics=own and Physics(own, frozenset({"footprint"})))
        told = every_return(scene, [returns])
        gate = np.full(len(placed), -1)
        gate[number] = 0
        exact = len(np.unique(told.item)) / 10
        assert coverage.value_of(gate) == pytest.approx(exact, abs=0.11)
    assert choose_set(coverage, SetLimits(2)).value <= 1


def test_the_zones_of_a_part_fill_its_field():
    for part in load_library().every_mode():
        if part.pattern.kind == "zones":
            assert part.beam_rad**2 * part.rays == pytest.approx(math.prod(part.field_of_view_rad))
        elif part.value("divergence_mrad") is None:
            assert part.beam_rad == 0


def test_a_part_keeps_its_own_entry_of_each_and_the_others_the_common_rules(run, two):
    aim = math.degrees(two.sensors[0].azimuth_rad) + 3
    entry = {"boresight": {"azimuth_deg": {"min": aim, "max": aim}}}
    for number in (0, 2):
        spec = bought(run, sensors=3, each=[*[{}] * number, entry])
        assert math.degrees(spec.sensors[number].azimuth_rad) == pytest.approx(aim % 360, abs=1e-6)
    away = {"boresight": {"azimuth_deg": {"min": aim + 180, "max": aim + 180}}}
    with pytest.raises(InfeasibleError, match=r"each\[0\] wants|azimuth"):
        bought(run, each=[away])


def test_parts_of_an_option_in_place_of_those_of_a_file_are_said(run):
    notes = []
    rules = {"parts": {"names": ["tmf8820"], "count": 1}}
    open_run(run).fit(parts=["vl53l8cx"], constraints=rules, notes=notes.append)
    assert any("takes the place" in str(note) and "tmf8820" in str(note) for note in notes)
