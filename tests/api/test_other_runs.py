"""Designs scored in the scenes of a run that they did not come from."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.command_line import make_run

import lidardesign as package
from lidardesign.errors import ConfigError
from lidardesign.evaluation.headline import difference_text
from lidardesign.formats.designs import load_design
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.compare import outside_space
from lidardesign.sensors.pattern import Pattern
from lidardesign.space import DIMENSIONS, direction

# Layouts, and further baselines that they are scored beside.
LAYOUTS = {"even": ["lloyd", "no-visibility"], "chosen": ["occupancy"]}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with a design of each layout, and a run of other scenes without any."""
    folder = tmp_path_factory.mktemp("runs")
    run = package.open_run(make_run(folder / "own", seed=4, overrides=["test=5"]))
    for layout in LAYOUTS:
        run.fit(layout=layout, sensors=2, rays=8, name=layout).save()
    make_run(folder / "other", seed=5, overrides=["variation=0.5", "train=12", "test=5"])
    return folder


@pytest.fixture
def runs(made, tmp_path):
    return [shutil.copytree(made / name, tmp_path / name) for name in ("own", "other")]


def without_times(scores):
    found = scores.as_dict() if not isinstance(scores, dict) else scores
    rows = [{**row, "seconds": None} for key in ("rows", "equal_bandwidth") for row in found[key]]
    return rows, [found[key] for key in ("paired", "paired_equal_bandwidth", "strongest_baseline", "metric", "scenes")]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scores_are_those_of_a_run_that_was_learned_there(runs, layout):
    own, other = runs
    design, options = own / "designs" / f"{layout}.yaml", {"rays": [8], "baselines": LAYOUTS[layout]}
    there = package.open_run(other).evaluate([design], **options)
    (other / "designs").mkdir()
    shutil.copy(design, other / "designs")
    at_home = package.open_run(other).evaluate(**options)
    assert without_times(there) == without_times(at_home)
    assert len(there.rows) == 6 + len(LAYOUTS[layout])
    elsewhere = package.open_run(own).evaluate([design], rays=[8], baselines=["none"])
    assert there.rows[0].value != elsewhere.rows[0].value


def test_the_command_takes_the_run_that_is_named(lidardesign, runs):
    own, other = runs
    design = own / "designs" / "even.yaml"
    found = lidardesign("evaluate", design, "--in", other, "--rays", 8, "--json")
    assert found.code == 0, found.err
    assert f"even of {own} is scored in the scenes of {other}" in " ".join(found.err.split())
    scores = package.open_run(other).evaluate([design], rays=[8])
    assert without_times(json.loads(found.out)) == without_times(json.loads(json.dumps(scores.as_dict())))
    # a run without designs can only be the one that judges
    assert without_times(lidardesign("evaluate", other, design, "--rays", 8, "--json").json) == without_times(
        found.json
    )
    # the run that judges has a design of the name, too
    package.open_run(other).fit(layout="even", sensors=1, rays=8, name="even").save()
    alone = ("--rays", 8, "--baseline", "none", "--json")
    both = lidardesign("evaluate", other, design, "--in", other, *alone).json
    values = {row["design"]: row["value"] for row in both["rows"]}
    assert values["own/even"] == found.json["rows"][0]["value"]
    assert "other/even" in values


def test_without_baselines_designs_score_and_pair_as_beside_them(lidardesign, runs):
    own, other = runs
    files = [own / "designs" / f"{layout}.yaml" for layout in LAYOUTS]
    options = (*files, "--in", other, "--rays", 8, "--baseline", "none")
    found = lidardesign("evaluate", *options, "--json").json
    scores = package.open_run(other).evaluate(files, rays=[8], baselines=["lloyd"])
    assert [(row["design"], row["value"]) for row in found["rows"]] == [
        (row.design, row.value) for row in scores.rows[:2]
    ]
    assert found["paired"] == [scores.paired[0].as_dict()]
    assert (found["equal_bandwidth"], found["strongest_baseline"]) == ([], None)
    verdict = difference_text(scores.paired[0], scores.evaluation.metric.better, scores.evaluation.metric.unit)
    assert verdict in lidardesign("evaluate", *options).out
    assert "scene by scene" in lidardesign("evaluate", *options, "--report", "page.html", "-v").out


def test_designs_of_two_runs_need_one_that_judges(lidardesign, runs):
    own, other = runs
    package.open_run(other).fit(layout="even", sensors=1, rays=8, name="flat").save()
    files = own / "designs" / "even.yaml", other / "designs" / "flat.yaml"
    for named in (files, (own, other)):
        refused = lidardesign("evaluate", *named)
        assert refused.code == 2
        assert "--in RUN" in refused.err
    assert lidardesign("evaluate", *files, "--in", own, "--rays", 8, "--baseline", "none").code == 0


def test_runs_that_differ_in_their_seed_alone_have_no_note(runs, tmp_path):
    notes = []
    twin = package.open_run(make_run(tmp_path / "twin", seed=9, overrides=["test=5"]))
    twin.evaluate([runs[0] / "designs" / "even.yaml"], rays=[8], baselines=["none"], notes=notes.append)
    assert notes == []


def test_a_design_of_another_task_is_scored_where_it_can_be(runs, tmp_path):
    flat = package.open_run(runs[0])
    aisle = package.open_run(make_run(tmp_path / "aisle", task="warehouse", overrides=["test=2", "train=4"]))
    notes = []
    design = runs[0] / "designs" / "even.yaml"
    (row,) = aisle.evaluate([design], rays=[4], baselines=["none"], notes=notes.append).rows
    assert row.design == "even"
    assert notes[0].startswith("even of ")
    assert notes[0].endswith("; 2 of 2 sensors start, point or listen outside its design space")
    along = aisle.fit(sensors=1, rays=4, name="along")
    with pytest.raises(ConfigError, match="its rays follow x_m, which the task flatland does not have"):
        flat.evaluate([along], rays=[4])


@pytest.mark.parametrize(
    ("axis", "moved"),
    [("x_m", 0.2), ("y_m", 0.01), ("z_m", -0.5), ("azimuth_rad", 1.0), ("elevation_rad", 0.1), ("range_m", 1.3)],
)
def test_what_lies_outside_a_design_space_is_counted(made, axis, moved):
    run, design = package.open_run(made / "own"), load_design(made / "own" / "designs" / "chosen.yaml")
    space = run.config.space
    generator = np.random.default_rng(6)
    points = space.sample(50, generator)
    points[:, 5] = generator.uniform(0.3, 1.2, 50)
    index = DIMENSIONS.index(axis)
    points[::3, index] = (space.low if moved < 0 else space.high)[index] + moved

    def told(points):
        gates = np.column_stack([points[:, 5] - 0.02, points[:, 5] + 0.02])
        table = Rays(points[:, :3], direction(points[:, 3], points[:, 4]), gates, np.zeros(50, int), np.zeros(50))
        return outside_space(replace(design, patterns=(Pattern.of(table),)), space)

    assert told(points) == f"{(~space.contains(points)).sum()} of 50 rays start, point or listen outside"
    points[::3] = points[1]
    assert told(points) == ""
