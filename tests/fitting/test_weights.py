"""`--weight` of fit and constrain: what users see, what designs keep, and where sensors look then."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from support.command_line import make_run

from lidardesign import open_run
from lidardesign.density.objective.proposals import samples_without_visibility
from lidardesign.fitting.request import RunTarget, Weighting
from lidardesign.formats.designs import load_design
from lidardesign.run_folder import RunFolder
from lidardesign.samples import load_samples, save_samples
from lidardesign.space import RANGE, direction

SETTING = "variation=1.5"


def near_surfaces(folder, task):
    """A run whose samples lie near what its training scenes show: a density without learning."""
    run = RunFolder.open(make_run(folder, task=task))
    scenes, config = run.scenes("train", run.config.seed)[:5], run.config
    samples = samples_without_visibility(scenes, config.space, config.density, 900, np.random.default_rng(0))
    save_samples(replace(samples, log_target=np.zeros(len(samples)), log_prob=np.zeros(len(samples))), folder)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs by the name of their task; that of flatland has a design that was weighted with a setting."""
    folder = tmp_path_factory.mktemp("runs")
    found = {name: near_surfaces(folder / name, name) for name in ("flatland", "face")}
    open_run(found["flatland"]).fit(sensors=2, rays=12, weights=[SETTING], name="w").save()
    return {**found, "spots": make_run(folder / "spots", 3000)}


def succeeded(lidardesign, *arguments):
    """What a command says that must go well, as JSON."""
    result = lidardesign(*arguments, "--json")
    assert result.code == 0, result.err
    return result.json


@pytest.fixture
def flat(runs, tmp_path):
    return shutil.copytree(runs["flatland"], tmp_path / "flat")


@pytest.fixture
def weighted(flat):
    return flat / "designs" / "w.yaml"


@pytest.mark.parametrize("layout", ["even", "chosen"])
def test_a_setting_that_changes_nothing_changes_no_byte_but_what_says_so(lidardesign, flat, layout):
    samples, designs = load_samples(flat), []
    save_samples(replace(samples, log_target=RunTarget(open_run(flat))(samples.points)), flat)
    for weights in ((), ("--weight", "variation=1.0")):
        fit = ("fit", flat, "--layout", layout, "--sensors", 2, "--rays", 12, "--name", "same")
        succeeded(lidardesign, *fit, *weights)
        designs.append(yaml.safe_load((flat / "designs" / "same.yaml").read_text()))
    assert designs[1]["provenance"].pop("weighting") == {"set": ["variation=1.0"]}
    assert designs[0] == designs[1]


def test_rays_are_chosen_for_the_other_setting(lidardesign, flat, weighted):
    succeeded(lidardesign, "fit", flat, "--sensors", 2, "--rays", 12, "--name", "plain")
    plain, other = (load_design(flat / "designs" / f"{name}.yaml").rays() for name in ("plain", "w"))
    assert not np.allclose(plain.direction, other.direction)


def test_constrain_keeps_how_a_design_was_weighted(lidardesign, flat, weighted):
    found = succeeded(lidardesign, "constrain", weighted, "--set", "gate.width_m.max=0.6")
    assert found["satisfied"]
    one, other = (Weighting.of(load_design(flat / "designs" / f"{name}.yaml")) for name in ("w", "constrained"))
    assert other.settings == one.settings != ()


OTHER_VERSIONS = {
    "a spread": {"set": [SETTING], "range_spread_m": 0.04},
    "a list": [SETTING],
    "an unknown key": {"set": ["colour=3"]},
}


@pytest.mark.parametrize("name", OTHER_VERSIONS)
def test_a_weighting_that_cannot_be_is_refused_where_samples_are_needed(lidardesign, weighted, name):
    document = yaml.safe_load(weighted.read_text())
    document["provenance"]["weighting"] = OTHER_VERSIONS[name]
    weighted.write_text(yaml.safe_dump(document))
    result = lidardesign("constrain", weighted)
    assert result.code == 2
    assert "weighting of design w" in result.err
    assert "--weight" not in result.err
    # its rays are known without
    assert lidardesign("export", weighted, "--format", "csv").code == 0
    assert lidardesign("constrain", weighted, "--weight", SETTING).code == 0


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
    assert not (runs[task] / "designs" / "fit.yaml").exists()


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
    target = RunTarget(open_run(run), weighting=Weighting.of(design))
    samples = load_samples(run)
    samples = replace(samples, log_target=target(samples.points))
    assert (samples.weights[_on_disc(samples.points)].sum()) > 0.9
    found = succeeded(lidardesign, "constrain", run / "designs" / "discs.yaml", "--name", "again")
    assert found["satisfied"]
    assert load_design(run / "designs" / "again.yaml").provenance["weighting"] == design.provenance["weighting"]


def _on_disc(points):
    seen = points[:, :3] + points[:, RANGE, None] * direction(points[:, 3], points[:, 4])
    distance = [np.linalg.norm(seen - centre, axis=1) - radius for centre, radius in (
        ((0.30, 0.65, 0), 0.09), ((0.68, 0.80, 0), 0.13))]  # fmt: skip
    return np.abs(np.min(distance, axis=0)) < 0.15
