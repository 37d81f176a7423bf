"""Runs that differ in their seed, evaluated together: by the command and from Python."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.command_line import make_run

import lidardesign as package
from lidardesign.config import load_run_config, save_run_config, with_task_settings
from lidardesign.errors import ConfigError, DataError
from lidardesign.evaluation.seeds import two_way_interval

SMALL, ALONE = ("--rays", 8, "--set", "test=5"), ("--baseline", "none")
OPTIONS = {"rays": [8], "settings": {"test": 5}}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three runs, each with the design `two`, the first with another one, too."""
    folder = tmp_path_factory.mktemp("seeds")
    for seed in (1, 2, 3):
        run = package.open_run(make_run(folder / f"flat-{seed}", seed=seed))
        run.fit(layout="even", sensors=2, rays=8, name="two").save()
    package.open_run(folder / "flat-1").fit(layout="even", sensors=1, rays=8, name="one").save()
    return folder


@pytest.fixture
def runs(made, tmp_path):
    return [shutil.copytree(made / f"flat-{seed}", tmp_path / f"flat-{seed}") for seed in (1, 2, 3)]


def test_designs_of_one_name_are_one_row_over_seeds_and_scenes(lidardesign, runs, tmp_path):
    files = {"--csv": tmp_path / "scores.csv", "--report": tmp_path / "report.html"}
    written = [word for option in files.items() for word in option]
    found = lidardesign("evaluate", *runs, *SMALL, *written, "--json").json
    assert found["seeds"] == [1, 2, 3]
    assert [row["design"] for row in found["rows"]] == ["two", "uniform", "random", "bounding", "silhouette", "greedy"]
    assert any("in the held-out scenes of seed 1" in note for note in found["notes"])
    assert all(path.exists() for path in files.values())
    alone = [package.open_run(run).evaluate([run / "designs" / "two.yaml"], scenes_seed=1, **OPTIONS) for run in runs]
    for number, row in enumerate(found["rows"]):
        table = np.stack([scores.rows[number].per_scene for scores in alone])
        assert (row["value"], row["ci_low"], row["ci_high"]) == pytest.approx(
            two_way_interval(table, limits=(0.0, 500.0))
        )
        assert row["per_seed"] == pytest.approx(table.mean(axis=1))


def test_python_and_the_command_find_the_same_and_people_see_every_seed(lidardesign, runs):
    result = lidardesign("evaluate", *runs, *SMALL, *ALONE, "-v")
    assert "over 5 held-out scenes and 3 seeds, test=5" in " ".join(result.out.split())
    assert "value of each seed" in result.out
    assert "seed 3" in result.out
    scores = package.evaluate_seeds(runs, baselines=["none"], **OPTIONS)
    (row,) = lidardesign("evaluate", *runs, *SMALL, *ALONE, "--json").json["rows"]
    assert [row["value"]] == [one.value for one in scores.rows]
    opened = [package.open_run(run) for run in runs]
    own, other = (
        package.evaluate_seeds(opened, designs=["two"], baselines=["none"], scenes_seed=seed, **OPTIONS).rows[0]
        for seed in (1, 9)
    )
    assert own.per_seed == scores.rows[0].per_seed
    assert own.value == scores.rows[0].value != other.value


def test_names_choose_among_designs_of_one_run_too(lidardesign, runs):
    found = lidardesign("evaluate", runs[0], *SMALL, *ALONE, "--designs", "one", "--json").json
    assert [row["design"] for row in found["rows"]] == ["one"]
    assert found["seeds"] == []


def reseeded(run, seed, **settings):
    """A run with another seed, and other settings of the task, in its configuration."""
    task, config = load_run_config(run)
    config = with_task_settings(task, config, [f"{name}={value}" for name, value in settings.items()])
    (run / "config.yaml").unlink()
    save_run_config(replace(config, seed=seed), run)
    return run


def test_runs_of_other_settings_tasks_or_of_one_seed_are_refused(runs, tmp_path):
    reseeded(runs[1], 2, variation=0.5)
    reseeded(runs[2], 1)
    other = make_run(tmp_path / "face", task="face", seed=9, count=1000)
    for given, words in (
        (runs[:2], r"differ in task\.variation"),
        (runs[::2], "have the same seed, 1"),
        (2 * [package.open_run(runs[0])], "is named twice"),
        (runs[:1], "1 run"),
        ([runs[0], other], "differ in task"),
    ):
        with pytest.raises(ConfigError, match=words):
            package.evaluate_seeds(given, **OPTIONS)


def test_designs_that_are_missing_are_named(runs):
    (runs[1] / "designs" / "two.yaml").rename(runs[1] / "designs" / "other.yaml")
    with pytest.raises(ConfigError, match="no design has the same name") as refused:
        package.evaluate_seeds(runs, **OPTIONS)
    assert "flat-2: other" in refused.value.allowed
    shutil.rmtree(runs[2] / "designs")
    with pytest.raises(DataError, match="no designs yet"):
        package.evaluate_seeds(runs, **OPTIONS)


def test_runs_that_share_their_seed_stand_side_by_side(lidardesign, runs):
    reseeded(runs[1], 1)
    found = lidardesign("evaluate", *runs[:2], *SMALL, *ALONE, "--json").json
    assert {"flat-1/two", "flat-2/two"} <= {row["design"] for row in found["rows"]}
    assert found["seeds"] == []
