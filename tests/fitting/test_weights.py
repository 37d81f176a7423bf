"""`--weight` of fit and constrain: what users see, what designs keep, and what evaluate makes of it."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yaml
from lidardesign.layouts.rays import lay_out
from support.command_line import make_run

from lidardesign import open_run
from lidardesign.config import resolve, save_run_config
from lidardesign.fitting.request import RunTarget, Weighting, weighted_samples
from lidardesign.formats.designs import load_design
from lidardesign.mixture.fit import fit
from lidardesign.registry import load_task
from lidardesign.run.manifest import start_manifest
from lidardesign.samples import Samples, load_samples, save_samples
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.scene_scores import checked_score
from lidardesign.simulate.returns import simulate
from lidardesign.space import RANGE, direction
from lidardesign.task import scenes_of

SEED = 3


@pytest.fixture(autouse=True)
def few_restarts(monkeypatch):
    """Fits try fewer seeds than usual, which is quick."""
    monkeypatch.setitem(fit.__kwdefaults__, "restarts", 2)


def traced_run(folder, name, overrides, count=900):
    """A run whose samples are what random rays meet in its training scenes: a density without learning."""
    task = load_task(name)
    config = resolve(task, preset="draft", seed=SEED, overrides=overrides)
    generator, space = np.random.default_rng(0), config.space
    found = []
    while sum(map(len, found)) < count:
        for scene in scenes_of(task, config.task, "train", SEED, space):
            points, gates = space.sample(count, generator), np.tile([space.low[RANGE], space.high[RANGE]], (count, 1))
            rays = Rays(points[:, :3], direction(points[:, 3], points[:, 4]), gates, np.zeros(count), np.zeros(count))
            is_target = np.array([body.is_target for body in scene.bodies])
            for frame in simulate(scene, rays):
                hit = np.flatnonzero(frame.returned)
                hit = hit[is_target[frame.body[hit]]]
                noise = generator.normal(0, config.density.sigma_m, len(hit))
                points[hit, RANGE] = np.clip(frame.range_m[hit] + noise, space.low[RANGE], space.high[RANGE])
                found.append(points[hit])
    points = generator.permutation(np.concatenate(found))[:count]
    start_manifest(folder, command=["lidardesign", "learn"], seed=SEED)
    save_run_config(config, folder)
    save_samples(Samples(points, np.zeros(count), np.zeros(count), space), folder)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs by the name of their task."""
    folder = tmp_path_factory.mktemp("runs")
    few = ["train=5", "test=3"]
    found = {name: traced_run(folder / name, name, few) for name in ("flatland", "face", "warehouse")}
    return {**found, "spots": make_run(folder / "spots", 3000)}


def succeeded(lidardesign, *arguments):
    """What a command says that must go well, as JSON."""
    result = lidardesign(*arguments, "--json")
    assert result.code == 0, result.err
    return result.json


@pytest.fixture
def flat(runs, tmp_path):
    return shutil.copytree(runs["flatland"], tmp_path / "flat")


SETTING = "variation=1.5"


@pytest.fixture
def weighted(lidardesign, flat):
    """A design that was weighted with a setting."""
    layout = ("--layout", "density", "--gates", "ray", "--sensors", 2, "--rays", 12)
    succeeded(lidardesign, "fit", flat, *layout, "--weight", SETTING, "--name", "w")
    return flat / "designs" / "w.yaml"


def by_hand(path, run, count):
    """The rays of a weighted design at a number of rays."""
    design = load_design(path)
    weighting = Weighting.of(design)
    assert weighting.settings == (SETTING,)
    return lay_out(design, count, weighted_samples(open_run(run), weighting, _target(run, design)), gates="ray")


@pytest.mark.parametrize("count", [12, 20])
def test_evaluate_lays_a_weighted_design_out_by_the_same_weighted_samples(lidardesign, flat, weighted, count):
    rows = succeeded(lidardesign, "evaluate", weighted, "--rays", count, "--effects", "none")["rows"]
    run = open_run(flat)
    rays = by_hand(weighted, flat, count)
    scenes = run.scenes("test", SEED)
    scores = [checked_score(run.task, run.metric, scene, simulate(scene, rays)).value for scene in scenes]
    own = [row for row in rows if row["design"] == "w"]
    assert own[0]["value"] == pytest.approx(np.mean(scores), rel=1e-9)
    plain = lay_out(load_design(weighted), 20, load_samples(flat), gates="ray")
    assert not np.allclose(plain.direction, by_hand(weighted, flat, 20).direction)


def test_constrain_keeps_how_a_design_was_weighted(lidardesign, flat, weighted):
    found = succeeded(lidardesign, "constrain", weighted, "--gates", "ray", "--set", "gate.width_m.max=0.6")
    assert found["satisfied"]
    one, other = (Weighting.of(load_design(flat / "designs" / f"{name}.yaml")) for name in ("w", "constrained"))
    assert other.as_document() == one.as_document()


OTHER_VERSIONS = {
    "a spread": {"set": [SETTING], "range_spread_m": 0.04},
    "a list": [SETTING],
}


@pytest.mark.parametrize("name", OTHER_VERSIONS)
def test_what_an_earlier_version_refined_is_refused_wherever_samples_are_needed(lidardesign, weighted, name):
    document = yaml.safe_load(weighted.read_text())
    document["provenance"]["weighting"] = OTHER_VERSIONS[name]
    weighted.write_text(yaml.safe_dump(document))
    for command in (
        ("evaluate", weighted),
        ("constrain", weighted),
        ("export", weighted, "--format", "csv", "--rays", 20),
    ):
        result = lidardesign(*command)
        assert result.code == 2, command
        assert "weighting of design w" in result.err
        assert "fit the design again: an earlier version refined it" in result.err
        assert "Traceback" not in result.err
    assert lidardesign("constrain", weighted, "--weight", SETTING).code == 0


@pytest.mark.parametrize("command", ["evaluate", "constrain"])
def test_settings_in_a_design_that_cannot_be_are_not_blamed_on_an_option(lidardesign, flat, weighted, command):
    document = yaml.safe_load(weighted.read_text())
    document["provenance"]["weighting"] = {"set": ["colour=3"]}
    weighted.write_text(yaml.safe_dump(document))
    result = lidardesign(command, weighted, "--rays", "7")
    assert result.code == 2
    assert "weighting of design w: set colour=3: unknown key" in result.err
    assert "--weight" not in result.err


WRONG = {
    "an unknown key": ("flatland", "colour=3", "unknown key"),
    "no value": ("flatland", "scene", "KEY=VALUE"),
    "no YAML": ("flatland", "scene=[", "is not YAML"),
    "a value that is none": ("flatland", "scene=cube", "'surface', 'discs' or 'occluded'"),
    "a setting of the density": ("flatland", "density.sigma_m=0.1", "what was learned cannot be changed"),
    "another space": ("face", "origin_box_m=[0.1, 0.1, 0.1]", "changes the design space"),
}


@pytest.mark.parametrize("name", WRONG)
def test_weights_that_cannot_be_are_refused_by_the_options_name(lidardesign, runs, name):
    task, text, words = WRONG[name]
    result = lidardesign("fit", runs[task], "--weight", text)
    assert result.code == 2
    assert f"--weight {text}" in result.err
    assert words in result.err
    assert not (runs[task] / "designs").exists()


def test_a_density_is_weighted_towards_other_scenes(lidardesign, runs, tmp_path):
    run = shutil.copytree(runs["spots"], tmp_path / "run")
    result = lidardesign(
        "fit", run, "--weight", "scene=discs", "--weight", "train=3", "--sensors", 2, "--name", "discs", "-v"
    )
    assert result.code == 0, result.err
    assert "note: with scene=discs, train=3 the samples have ESS 0." in result.err
    design = load_design(run / "designs" / "discs.yaml")
    assert design.provenance["weighting"] == {"set": ["scene=discs", "train=3"]}
    # discs are at x of 0.30 and 0.68 and y of 0.65 and 0.80, each seen from both sides
    samples = weighted_samples(open_run(run), Weighting.of(design), _target(run, design))
    assert (samples.weights[_on_disc(samples.points)].sum()) > 0.9
    found = succeeded(lidardesign, "constrain", run / "designs" / "discs.yaml", "--name", "again")
    assert found["satisfied"]
    assert load_design(run / "designs" / "again.yaml").provenance["weighting"] == design.provenance["weighting"]


def _target(run, design):
    return RunTarget(open_run(run), weighting=Weighting.of(design))


def _on_disc(points):
    seen = points[:, :3] + points[:, RANGE, None] * direction(points[:, 3], points[:, 4])
    distance = [np.linalg.norm(seen - centre, axis=1) - radius for centre, radius in (
        ((0.30, 0.65, 0), 0.09), ((0.68, 0.80, 0), 0.13))]  # fmt: skip
    return np.abs(np.min(distance, axis=0)) < 0.15
