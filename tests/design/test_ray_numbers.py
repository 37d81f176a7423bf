"""Designs of fixed patterns beside designs that can be laid out at any number of rays."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from support.command_line import make_run

from lidardesign.design.files import save_design
from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.errors import ConfigError
from lidardesign.evaluate.request import fired_numbers, left_out, usual_numbers
from lidardesign.geometry.rays import Rays

FAR_M = 0.9


def pattern(name, count, layout="fixed"):
    """A fan of flatland, of so many rays; an open grid where the layout is one."""
    sensor = Sensor("fan", 1.0, np.array([0.5, 0, 0]), np.zeros((3, 3)), 1.5, 0.0, 0.0, 0.3, 0.0, FAR_M / 2, FAR_M / 4)
    azimuth, zeros = np.linspace(1.0, 2.0, count), np.zeros(count)
    gates = np.tile([0.0, FAR_M], (count, 1))
    table = Rays.from_angles(np.tile([0.5, 0, 0], (count, 1)), azimuth, zeros, gates, zeros.astype(int))
    return DesignSpec(
        name, (sensor,), layout=layout, ray_table=table if layout == "fixed" else None, provenance={"run": ".."}
    )


def test_a_pattern_is_left_out_beyond_its_rays_and_the_others_are_not():
    designs = [pattern("few", 7), pattern("more", 20), pattern("any", 1, "grid")]
    assert usual_numbers(designs, (10, 30)) == [7, 10, 20, 30]
    assert usual_numbers(designs[2:], (10, 30)) == [10, 30]
    assert usual_numbers([pattern("large", 500)], (10, 30)) == [10, 30]
    assert fired_numbers(designs, (30, 7, 30)) == [30, 7]
    assert fired_numbers(designs[:2], (7, 30)) == [7]
    assert fired_numbers([], (7, 30)) == [7, 30]
    assert left_out(designs, (7, 10, 30)) == [
        "few fires 7 rays, its fixed pattern: it is left out at 10 and 30 rays",
        "more fires 20 rays, its fixed pattern: it is left out at 30 rays",
    ]
    assert left_out(designs[:1], (7, 10, 30))[-1] == "no design fires 10 or 30 rays: nothing is evaluated there"
    with pytest.raises(ConfigError, match="no design fires 21 or 30 rays"):
        fired_numbers(designs[:2], (21, 30))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = make_run(tmp_path_factory.mktemp("runs") / "flat", count=500)
    (folder / "designs").mkdir()
    for design in (pattern("any", 1, "grid"), pattern("few", 7)):
        save_design(design, folder / "designs" / f"{design.name}.yaml")
    return folder


def numbers_of(document, name):
    return sorted(row["rays"] for row in document["rows"] if row["design"] == name)


@pytest.fixture
def files(tmp_path):
    return ["--csv", tmp_path / "rows.csv", "--report", tmp_path / "report.html", "--plots", tmp_path / "plots"]


def test_a_design_of_a_fixed_pattern_spoils_no_evaluation_of_its_run(call, run, tmp_path, files):
    result = call("evaluate", run, "--rays", 5, "--rays", 12, *files, "--json")
    assert result.code == 0, result.err
    found = result.json
    assert numbers_of(found, "any") == numbers_of(found, "uniform") == [5, 12]
    assert numbers_of(found, "few") == [5]
    note = "few fires 7 rays, its fixed pattern: it is left out at 12 rays"
    assert note in found["notes"]
    few = [pair for pair in found["paired"] if "few" in (pair["a"], pair["b"])]
    assert {pair["rays"] for pair in few} == {5}
    assert {pair["b"] for pair in few} == {"few", "uniform", "random", "bounding", "silhouette", "greedy"}
    matched = {(row["matched_to"], row["matched_rays"]) for row in found["equal_bandwidth"]}
    assert matched == {("any", 5), ("any", 12), ("few", 5)}
    with (tmp_path / "rows.csv").open() as file:
        lines = [line for line in csv.reader(file) if line[0] == "few"]
    assert [line[1] for line in lines] == ["5"]
    assert note in (tmp_path / "report.html").read_text()
    assert list((tmp_path / "plots").glob("*.svg"))


def test_without_numbers_all_of_the_task_are_evaluated_and_a_smaller_pattern_at_its_own_too(call, run):
    usual = sorted(json.loads(call("tasks", "show", "flatland", "--json").out)["defaults"]["rays"])
    assert max(usual) > 7
    found = call("evaluate", run, "--json").json
    assert numbers_of(found, "any") == numbers_of(found, "uniform") == sorted({7, *usual})
    assert numbers_of(found, "few") == [count for count in sorted({7, *usual}) if count <= 7]
    assert any(note.startswith("few fires") for note in found["notes"])


def test_numbers_that_no_design_fires_are_refused(call, run):
    refused = call("evaluate", run / "designs" / "few.yaml", "--rays", 8)
    assert refused.code == 2
    assert "few does not fire 8 rays: it is a fixed pattern" in refused.err
    assert "at most 7" in refused.err


def test_a_comparison_says_where_one_of_the_two_has_no_row(call, run):
    paths = [run / "designs" / f"{name}.yaml" for name in ("any", "few")]
    result = call("compare", *paths, "--in", run, "--rays", 5, "--rays", 12, "--json")
    assert result.code == 0, result.err
    assert "few fires 7 rays, its fixed pattern: it is left out at 12 rays" in result.err
    assert [pair["rays"] for pair in result.json["paired"]] == [5]
    refused = call("compare", *paths, "--in", run, "--rays", 12)
    assert refused.code == 2
    assert "few does not fire 12 rays" in refused.err
