"""Designs of fixed patterns beside designs that can fire any number of rays."""

from __future__ import annotations

import csv
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.command_line import make_run

from lidardesign.errors import ConfigError
from lidardesign.evaluation.request import (
    counts_without_baselines,
    fired_numbers,
    missing_row_notes,
    numbers_fired,
    usual_numbers,
)
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import save_design
from lidardesign.sensors.pattern import Pattern
from lidardesign.sensors.sensor import Sensor

FAR_M = 0.9


def pattern(name, count, layout="fixed"):
    """A fan of flatland, of so many rays; of any number where the layout is even."""
    sensor = Sensor("fan", 1.0, np.array([0.5, 0, 0]), 1.5, 0.0, 0.0, (1.2, 0.0), (0.0, FAR_M))
    azimuth, zeros = np.linspace(1.0, 2.0, count), np.zeros(count)
    gates = np.tile([0.0, FAR_M], (count, 1))
    rays = Rays.from_angles(np.tile([0.5, 0, 0], (count, 1)), azimuth, zeros, gates, zeros)
    patterns = (Pattern.of(rays),) if layout == "fixed" else ()
    return DesignSpec(name, (sensor,), layout, patterns, provenance={"run": ".."})


def test_a_pattern_is_left_out_beyond_its_rays_and_the_others_are_not():
    designs = [pattern("few", 7), pattern("more", 20), pattern("any", 1, "even")]
    assert usual_numbers(designs, (10, 30)) == [7, 10, 20, 30]
    assert usual_numbers(designs[2:], (10, 30)) == [10, 30]
    assert usual_numbers([replace(designs[2], constraints={"budget": {"rays": 17}})], (10, 30)) == [10, 17, 30]
    assert usual_numbers([pattern("large", 500)], (10, 30)) == [500]
    assert usual_numbers([pattern("large", 500), designs[2]], (10, 30)) == [10, 30, 500]
    assert fired_numbers(designs, (30, 7, 30)) == [30, 7]
    assert fired_numbers(designs[:2], (7, 30)) == [7]
    assert fired_numbers([], (7, 30)) == [7, 30]
    assert [(note.split()[0], note.split(": ")[1]) for note in missing_row_notes(designs, (7, 10, 30))] == [
        ("few", "it is left out at 10 and 30 rays"),
        ("more", "at 7 and 10 rays an even subset of them"),
        ("more", "it is left out at 30 rays"),
    ]
    assert "no design fires 10 or 30 rays" in missing_row_notes(designs[:1], (7, 10, 30))[-1]
    for some, numbers, words in ((2, (21, 30), "no design fires 21 or 30"), (1, (8,), "(?s)few does not fire 8.* 7")):
        with pytest.raises(ConfigError, match=words):
            fired_numbers(designs[:some], numbers)


@pytest.mark.parametrize(
    ("count", "layout", "asked", "fired"),
    [
        (7, "fixed", (5, 7, 10), [7]),  # all its rays where they are asked for, never some of them beside
        (7, "fixed", (5, 6, 10), [5, 6]),
        (7, "fixed", (8, 10), []),
        (3000, "fixed", (5, 3000), [3000]),
        (1, "even", (5, 7, 10), [5, 7, 10]),
        (1, "even", (5, 3000), [5]),
    ],
)
def test_a_pattern_fires_all_its_rays_and_a_huge_one_nobody_elses(count, layout, asked, fired):
    alone = counts_without_baselines(asked, (10, 30))
    assert alone == [number for number in asked if number == 3000]
    assert numbers_fired(pattern("one", count, layout), asked, alone) == fired
    cut = [line for line in missing_row_notes([pattern("one", count, layout)], asked) if "subset" in line]
    assert bool(cut) == (layout == "fixed" and bool(fired) and count not in asked)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = make_run(tmp_path_factory.mktemp("runs") / "flat", count=500)
    (folder / "designs").mkdir()
    for design in (pattern("any", 1, "even"), pattern("few", 7)):
        save_design(design, folder / "designs" / f"{design.name}.yaml")
    return folder


def numbers_of(document, name):
    return sorted(row["rays"] for row in document["rows"] if row["design"] == name)


def test_a_design_of_a_fixed_pattern_spoils_no_evaluation_of_its_run(call, run, tmp_path):
    files = ("--csv", tmp_path / "rows.csv", "--report", tmp_path / "report.html")
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


def test_patterns_of_several_sizes_are_ranked_with_all_their_rays(call, run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    save_design(pattern("some", 5), folder / "designs" / "some.yaml")
    save_design(pattern("scanner", 3000), folder / "designs" / "scanner.yaml")
    (folder / "designs" / "torn.yaml").write_text("sensors: [")  # of those that nobody asks for
    names = ("few", "some", "scanner")
    report = tmp_path / "report.html"
    told = call("evaluate", folder, *[word for name in names for word in ("--designs", name)], "--report", report)
    assert told.code == 0, told.err
    own = {"few": "7", "some": "5", "scanner": "3000"}
    lines = [line.split() for line in told.out.splitlines() if line.split()[:1] and line.split()[0] in own]
    assert {words[0]: words[1] for words in lines if words[1].isdigit()} == own
    page = report.read_text()
    assert all(re.search(rf"{name}</th>\s*<td>{rays}</td>", page) for name, rays in own.items())
    kept = {entry["name"]: entry["score"] for entry in call("show", folder, "--json").json["designs"]}
    assert {name: str(kept[name]["rays"]) for name in names} == own
    assert kept["few"]["baseline"] == kept["some"]["baseline"] is not None
    assert kept["scanner"]["baseline"] is None
