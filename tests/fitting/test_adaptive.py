"""`fit --adaptive`: patterns that follow what they see in design files, in checks and in commands."""

from __future__ import annotations

import copy
import re
from dataclasses import replace

import pytest
from hypothesis import given
from support.strategies import adaptive_designs

from lidardesign.api.run import open_run
from lidardesign.constraints.check import check_design
from lidardesign.errors import ConfigError
from lidardesign.formats.designs import load_design
from lidardesign.sensors.design_file import COLUMNS, design_document, design_from_document, save_design


@given(design=adaptive_designs())
def test_a_design_is_read_as_it_was_written_to_the_last_bit(tmp_path_factory, design):
    path = tmp_path_factory.mktemp("design") / "seen.yaml"
    save_design(design, path)
    read = load_design(path)
    assert design_document(read) == design_document(design)
    found, made = read.adaptive, design.adaptive
    assert found.rule.looks == made.rule.looks
    for one, other in (
        *((getattr(found.rule, name), getattr(made.rule, name)) for name in ("centroids", "missing_m")),
        (found.shares, made.shares),
        *(
            (getattr(one, name), getattr(other, name))
            for one, other in zip(found.patterns, made.patterns, strict=True)
            for name in ("origin_m", "azimuth_rad", "elevation_rad", "gate_m", "sensor")
        ),
    ):
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes()
        assert one.shape == other.shape


@pytest.fixture(scope="module")
def found(made):
    """A design of two sensors with patterns that were kept."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidardesign.fitting.fit.Fitter._if_better", lambda self, design, notes: design)
        fitted = open_run(made).fit(adaptive=2, rays=12, sensors=2, name="seen")
    fitted.save()
    return fitted.specification


EDITS = {
    "one centroid more": lambda rule: rule["centroids"].append(rule["centroids"][0]),
    "no centroid": lambda rule: rule.update(centroids=[]),
    "one pattern less": lambda rule: rule["patterns"].pop(),
    "one share less": lambda rule: rule["shares"].pop(),
    "shares that do not sum to 1": lambda rule: rule.update(shares=[0.5, 0.5, 0.5]),
    "a share below 0": lambda rule: rule.update(shares=[-0.5, 1.0, 0.5]),
    "longer looks than patterns": lambda rule: rule.update(
        looks=13, missing_m=[1.0] * 13, centroids=[[1.0] * 13, [2.0] * 13]
    ),
    "looks without their ranges of misses": lambda rule: rule.update(missing_m=[]),
    "centroids of other lengths": lambda rule: rule["centroids"][0].append(1.0),
    "a centroid that is no number": lambda rule: rule["centroids"].__setitem__(0, [float("nan")]),
    "a sensor that is missing": lambda rule: [pattern["sensor"].__setitem__(-1, 2) for pattern in rule["patterns"]],
    "a key that nobody knows": lambda rule: rule.update(centroid=[[1.0]]),
    **{
        f"another {name} in the first look": lambda rule, name=name: rule["patterns"][1][name][0].__setitem__(
            0, rule["patterns"][1][name][0][0] + 1e-6
        )
        for name in COLUMNS
    },
    "another sensor in the first look": lambda rule: rule["patterns"][1]["sensor"].__setitem__(
        0, 1 - rule["patterns"][1]["sensor"][0]
    ),
}


@pytest.mark.parametrize("edit", EDITS)
def test_a_rule_that_was_edited_wrongly_is_refused(found, edit):
    document = copy.deepcopy(design_document(found))
    assert design_document(design_from_document(document)) == document
    EDITS[edit](document["adaptive"])
    with pytest.raises(ConfigError, match=r"adaptive|a pattern names a sensor"):
        design_from_document(document, "seen", lambda path, **_: ".".join(map(str, path)) or "seen")


def test_patterns_need_a_single_one_of_as_many_rays(found):
    document = copy.deepcopy(design_document(found))
    document["patterns"] = design_document(replace(found, patterns=(shorter(found.patterns[0]),)))["patterns"]
    with pytest.raises(ConfigError, match="no pattern has as many rays as the adaptive ones"):
        design_from_document(document)


def shorter(pattern):
    """A pattern without its last ray."""
    columns = [getattr(pattern, name)[:, :-1] for name in ("origin_m", "azimuth_rad", "elevation_rad", "gate_m")]
    return replace(pattern, **dict(zip(("origin_m", "azimuth_rad", "elevation_rad", "gate_m"), columns, strict=True)),
                   sensor=pattern.sensor[:-1])  # fmt: skip


RULES = {"gate": {"end_m": {"max": 1.5}}, "budget": {"rays": 12, "bandwidth_mbps": 0.5}}


def broken(document, rules):
    return {check.name for check in check_design(document, rules) if not check.satisfied}


class TestTheChecker:
    @pytest.mark.parametrize("number", [0, 1, 2])
    def test_finds_what_any_pattern_breaks(self, found, number):
        whole = design_document(found)
        assert broken(whole, RULES) == set()
        for column, value, names in (
            ("gate_end_m", 1.6, {"ray3.gate.end_m.max"}),
            ("gate_end_m", 40.0, {"ray3.gate.end_m.max", "budget.bandwidth_mbps"}),
            ("azimuth_rad", 5.0, set()),
        ):
            document = copy.deepcopy(whole)
            pattern = document["adaptive"]["patterns"][number]
            pattern[column][0][3] = value
            name = document["sensors"][pattern["sensor"][3]]["name"]
            astray = f"{name}.rays.horizontal_rad" if column == "azimuth_rad" else f"{name}.rays.gate_m"
            assert broken(document, RULES) == {*names, astray}

    def test_counts_the_rays_of_every_pattern(self, found):
        cut = tuple(map(shorter, found.adaptive.patterns))
        document = design_document(replace(found, adaptive=replace(found.adaptive, patterns=cut)))
        assert broken(document, {"budget": {"rays": 12}}) == {"budget.rays"}


class TestAFit:
    @pytest.mark.parametrize("rays", [8, 12])
    def test_keeps_patterns_that_are_better_and_says_so_where_one_is(self, lidardesign, made, rays):
        done = lidardesign("fit", made, "--adaptive", 2, "--rays", rays, "--sensors", 1, "--name", f"f{rays}", "--json")
        assert done.code == 0, done.err
        found, said = load_design(made / "designs" / f"f{rays}.yaml").adaptive, done.json.get("adaptive")
        assert (found is None) == (said is None) == ("one pattern" in done.out + done.err)
        assert said is None or said == {"looks": found.rule.looks, "shares": found.shares.tolist()}
        assert found is None or {len(one) for one in found.patterns} == {rays}

    def test_is_scored_beside_its_best_single_pattern(self, lidardesign, made, found):
        options = ["--rays", 12, "--baseline", "uniform", "--set", "test=4", "--json"]
        done = lidardesign("evaluate", made / "designs" / "seen.yaml", *options)
        assert done.code == 0, done.err
        rows = {row["design"]: row for row in done.json["rows"]}
        assert list(rows)[:2] == ["seen", "seen-single"]
        alone = replace(found, name="alone", adaptive=None)
        save_design(alone, made / "designs" / "alone.yaml")
        single = lidardesign("evaluate", made / "designs" / "alone.yaml", *options).json["rows"][0]
        assert single["value"] == rows["seen-single"]["value"]
        assert single["value"] != rows["seen"]["value"]

    def test_has_a_report_that_says_which_pattern_fires_and_goes_through_all(self, lidardesign, made, found, tmp_path):
        page = tmp_path / "report.html"
        options = ["--rays", 12, "--baseline", "none", "--set", "test=2", "--report", page]
        assert lidardesign("evaluate", made / "designs" / "seen.yaml", *options).code == 0
        text = page.read_text(encoding="utf-8")
        assert re.search(r"[Ss]een fires pattern [0-9] here", text)
        assert 'label for="view-place">Pattern<' in text
        assert f"pattern = {len(found.adaptive.patterns) - 1}" in text

    def test_starts_a_search_for_a_baseline_from_the_single_pattern(self, lidardesign, made, found):
        options = ["--rays", 12, "--baseline", "cma", "--cma-seconds", 1, "--set", "test=2", "--json"]
        done = lidardesign("evaluate", made / "designs" / "seen.yaml", *options)
        assert [row["rays"] for row in done.json["rows"] if row["design"] == "cma"] == [12]

    def test_is_a_single_pattern_where_constraints_ask_for_what_none_can_follow(self, lidardesign, made, found):
        options = ["--survive", 1, "--sensors", 2, "--rays", 12, "--name", "survives"]
        done = lidardesign("constrain", made / "designs" / "seen.yaml", *options)
        assert done.code == 0, done.err
        assert load_design(made / "designs" / "survives.yaml").adaptive is None

    def test_of_one_pattern_is_a_fit_without_the_option(self, lidardesign, made):
        written = []
        for options in ([], ["--adaptive", 1]):
            assert lidardesign("fit", made, "--rays", 9, "--sensors", 1, "--name", "one", *options).code == 0
            written.append((made / "designs" / "one.yaml").read_bytes())
        assert written[0] == written[1]
