"""`--refine` and `--weight` of fit and constrain: what users see, what designs keep, and what evaluate makes of it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from lidardesign_tasks.flatland import FlatlandTask
from support.command_line import make_run

from lidardesign import open_run
from lidardesign.config import resolve, save_run_config
from lidardesign.design.constraints.check import check_design
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.files import design_document, load_design
from lidardesign.design.fit import fit
from lidardesign.design.layouts.rays import lay_out
from lidardesign.evaluate.reweighting import Reweighting
from lidardesign.evaluate.scene_scores import checked_score
from lidardesign.export.ray_lists import read_npz
from lidardesign.geometry.rays import Rays
from lidardesign.registry import load_task
from lidardesign.run.manifest import start_manifest
from lidardesign.samples import Samples, load_samples, save_samples
from lidardesign.simulate.simulate import simulate
from lidardesign.space import RANGE, direction
from lidardesign.task import Residuals, scenes_of
from lidardesign.workflow.fit import FitRequest
from lidardesign.workflow.fit_design import refinement_scenes
from lidardesign.workflow.run_folder import RunFolder
from lidardesign.workflow.run_samples import RunTarget, Weighting

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


def refined(lidardesign, *arguments):
    """What a command says that must go well, as JSON."""
    result = lidardesign(*arguments, "--json")
    assert result.code == 0, result.err
    return result.json


@pytest.fixture
def flat(runs, tmp_path):
    return shutil.copytree(runs["flatland"], tmp_path / "flat")


LAYOUTS = {
    "grid": ("flatland", "--layout", "grid", "--sensors", "2"),
    "gates per ray": ("flatland", "--layout", "density", "--sensors", "2", "--rays", "12", "--gates", "ray"),
    "gates per sensor": ("flatland", "--layout", "density", "--sensors", "2", "--rays", "12"),
    "scan": ("flatland", "--layout", "scan", "--rays", "8"),
    "distributed": ("flatland", "--layout", "distributed", "--sensors", "2", "--rays", "12"),
    "a head": ("face", "--layout", "density", "--sensors", "2", "--rays", "30", "--gates", "ray"),
    "a scan of a head": ("face", "--layout", "scan", "--rays", "12"),
    "a track": ("warehouse", "--layout", "scan", "--rays", "6"),
    "one place of a track": ("warehouse", "--layout", "density", "--rays", "6", "--sensors", "2", "--at", "x_m=1"),
    "another level": ("flatland", "--layout", "grid", "--sensors", "1", "--level", "0.8"),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_designs_of_every_layout_are_refined_and_no_worse(lidardesign, runs, tmp_path, name):
    task, *options = LAYOUTS[name]
    run = shutil.copytree(runs[task], tmp_path / "run")
    found = refined(lidardesign, "fit", run, *options, "--refine", 1, "--name", "r")["refinement"]
    rounds = found["rounds"]
    assert rounds[0]["change"] == "start"
    assert rounds[0]["score"] == found["start"]
    assert found["end"] <= found["start"]
    assert [one for one in rounds if one["kept"]][-1]["score"] == found["end"]
    assert {one["round"] for one in rounds} == {0, 1}
    assert found["scenes"] == {"looked_at": 3, "judged_on": 2}
    design = load_design(run / "designs" / "r.yaml")
    assert design.level == found["level"]
    assert Weighting.of(design).range_spread_m == found["range_spread_m"]
    stepped = any(one["kept"] and one["change"].startswith("towards") for one in rounds)
    assert (Weighting.of(design).reweighting is not None) == stepped


CONSTRAINTS = {
    "a pinned origin": ["origin.fixed_m=[0.5, 0, 0]"],
    "mounts": ["origin.mounts_m=[[0.3, 0, 0], [0.7, 0, 0]]"],
    "each": ["each=[{gate: {end_m: {max: 0.8}}}, {origin: {low_m: [0.5, 0, 0], high_m: [1, 0, 0]}}]"],
    "gates": ["gate.width_m.max=0.2", "gate.start_m.min=0.4"],
    "bandwidth": ["budget.bandwidth_mbps=0.04"],
    "bandwidth and bins": ["budget.bandwidth_mbps=0.2", "budget.bin_ps=50", "budget.rate_hz=20"],
    "fields": ["field_of_view.horizontal_deg.max=30"],
}


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_constraints_are_kept_by_what_is_refined(lidardesign, flat, name):
    options = [part for text in CONSTRAINTS[name] for part in ("--set", text)]
    if name not in ("mounts",):
        options += ["--sensors", "2"]
    found = refined(
        lidardesign, "constrain", flat, "--layout", "density", "--gates", "ray", "--rays", 12, *options, "--refine", 1
    )
    assert found["satisfied"]
    assert found["refinement"]["end"] <= found["refinement"]["start"]
    design = load_design(flat / "designs" / "constrained.yaml")
    rules = Constraints.from_mapping(design.constraints, where="test")
    space = open_run(flat).config.space
    assert all(check.satisfied for check in check_design(design_document(design), rules, space))


def test_a_scan_keeps_its_bandwidth(lidardesign, flat):
    found = refined(
        lidardesign, "constrain", flat, "--layout", "scan", "--rays", 8, "--set", "budget.bandwidth_mbps=0.02",
        "--refine", 1,
    )  # fmt: skip
    assert found["satisfied"]
    assert found["refinement"]["rounds"][-1]["bandwidth_mbps"] <= 0.02


def test_it_tells_what_every_round_brought(lidardesign, flat):
    result = lidardesign("fit", flat, "--layout", "scan", "--rays", 8, "--refine", 1)
    assert result.code == 0
    assert "refine 0: start: " in result.err
    assert "refine 1: " in result.err
    assert "refinement: 3 training scenes to look at, score on 2 others" in result.out
    assert "Mbit/s" in result.out
    quiet = lidardesign("fit", flat, "--layout", "scan", "--rays", 8, "--refine", 1, "--quiet")
    assert "refine 0" not in quiet.err


def curves(scenes):
    return {scene.truth["curve_m"].tobytes() for scene in scenes}


@pytest.mark.parametrize("seed", [SEED, 0, 1, 77])
def test_scenes_that_judge_are_neither_held_out_nor_learned_from_nor_looked_at(flat, seed):
    run = open_run(flat)
    look, judge = refinement_scenes(FitRequest(run, "r", seed))
    other = curves(run.scenes("test", SEED)) | curves(run.scenes("train", SEED)) | curves(run.scenes("test", seed))
    assert len(curves(look)) == 3
    assert len(curves(judge)) == 2
    assert not curves(look) & curves(judge)
    assert not (curves(look) | curves(judge)) & other


def test_scenes_of_one_group_never_look_and_judge(flat, monkeypatch):
    plain = RunFolder.scenes

    def grouped(run, split, seed):
        return [replace(scene, group="ab"[i % 2]) for i, scene in enumerate(plain(run, split, seed))]

    monkeypatch.setattr(RunFolder, "scenes", grouped)
    look, judge = refinement_scenes(FitRequest(open_run(flat), "r", SEED))
    assert {scene.group for scene in look} == {"a"}
    assert {scene.group for scene in judge} == {"b"}


def test_two_scenes_are_the_least(lidardesign, tmp_path):
    one = traced_run(tmp_path / "one", "flatland", ["train=1", "test=1"], 500)
    result = lidardesign("fit", one, "--refine", 1)
    assert result.code == 2
    assert "--refine: 1 training scene" in result.err
    assert "at least 2" in result.err
    assert not (one / "designs").exists()


def test_a_task_without_residuals_is_not_refined(lidardesign, flat, monkeypatch):
    monkeypatch.delattr(FlatlandTask, "residuals")
    result = lidardesign("fit", flat, "--refine", 1)
    assert result.code == 2
    assert "--refine: the task flatland does not say where its error is" in result.err
    assert lidardesign("fit", flat).code == 0


def raised(self, scene, returns):
    raise RuntimeError("the map is lost")


@pytest.mark.parametrize(
    ("residuals", "words"),
    [
        (raised, "the map is lost"),
        (lambda self, scene, returns: 3.0, "float"),
        (lambda self, scene, returns: Residuals(np.zeros((2, 3)), np.array([1.0, np.nan])), "NaN"),
    ],
)
def test_a_plugin_whose_residuals_are_broken_is_named(lidardesign, flat, monkeypatch, residuals, words):
    monkeypatch.setattr(FlatlandTask, "residuals", residuals)
    result = lidardesign("fit", flat, "--layout", "scan", "--rays", 6, "--refine", 1)
    assert result.code == 6
    assert "task flatland" in result.err
    assert words in result.err
    assert "Traceback" not in result.err


@pytest.fixture
def weighted(lidardesign, flat, monkeypatch):
    """A design whose refinement found a factor and a spread, whatever they are worth."""
    path = flat / "designs" / "w.yaml"
    refined(
        lidardesign, "fit", flat, "--layout", "density", "--gates", "ray", "--sensors", 2, "--rays", 12, "--name", "w"
    )
    factor = Reweighting([[0.3, 0.8, 0], [0.7, 0.8, 0]], [1.2, -1.2])
    document = {"range_spread_m": 0.04, "factors": factor.as_document()}
    text = path.read_text().replace("provenance:\n", f"provenance:\n  weighting: {json.dumps(document)}\n")
    path.write_text(text)
    assert Weighting.of(load_design(path)).range_spread_m == 0.04
    return path


def by_hand(path, run, count):
    """The rays of a weighted design at a number of rays."""
    opened, design = open_run(run), load_design(path)
    weighting, samples = Weighting.of(design), load_samples(run)
    assert weighting
    if weighting.reweighting is not None:
        samples = samples.reweighted(weighting.reweighting.log_factor(samples.points))
    moved = weighting.spread(samples, opened.config.seed)
    return lay_out(design, count, moved, gates="ray")


@pytest.mark.parametrize("count", [12, 20])
def test_evaluate_lays_a_weighted_design_out_by_the_same_weighted_samples(lidardesign, flat, weighted, count):
    rows = refined(lidardesign, "evaluate", weighted, "--rays", count, "--effects", "none")["rows"]
    run = open_run(flat)
    rays = by_hand(weighted, flat, count)
    scenes = run.scenes("test", SEED)
    scores = [checked_score(run.task, run.metric, scene, simulate(scene, rays)).value for scene in scenes]
    own = [row for row in rows if row["design"] == "w"]
    assert own[0]["value"] == pytest.approx(np.mean(scores), rel=1e-9)
    plain = lay_out(load_design(weighted), 20, load_samples(flat), gates="ray")
    assert not np.allclose(plain.direction, by_hand(weighted, flat, 20).direction)


def test_export_lays_a_weighted_design_out_by_the_same_weighted_samples(lidardesign, flat, weighted, tmp_path):
    out = tmp_path / "rays.npz"
    result = lidardesign("export", weighted, "--format", "npz", "--rays", 20, "--out", out)
    assert result.code == 0, result.err
    rays = by_hand(weighted, flat, 20)
    written = read_npz(out)
    np.testing.assert_array_equal(written.gate_m, rays.gate_m)
    np.testing.assert_allclose(written.direction, rays.direction, atol=1e-12)


def test_constrain_keeps_how_a_design_was_weighted(lidardesign, flat, weighted):
    found = refined(lidardesign, "constrain", weighted, "--gates", "ray", "--set", "gate.width_m.max=0.6")
    assert found["satisfied"]
    one, other = (Weighting.of(load_design(flat / "designs" / f"{name}.yaml")) for name in ("w", "constrained"))
    assert other.as_document() == one.as_document()


def test_refinement_goes_on_from_how_a_design_was_weighted(lidardesign, flat):
    first = refined(lidardesign, "fit", flat, "--layout", "grid", "--sensors", 2, "--refine", 2, "--name", "one")
    path = flat / "designs" / "one.yaml"
    then = refined(lidardesign, "constrain", path, "--refine", 1, "--name", "two")["refinement"]
    assert then["start"] == pytest.approx(first["refinement"]["end"], rel=1e-9)
    assert then["end"] <= then["start"]


def test_a_weighting_that_was_damaged_is_refused_wherever_it_is_read(lidardesign, flat, weighted):
    weighted.write_text(weighted.read_text().replace("[1.2, -1.2]", "[many, -1.2]"))
    for command in (
        ("evaluate", weighted),
        ("constrain", weighted),
        ("export", weighted, "--format", "csv", "--rays", 20),
    ):
        result = lidardesign(*command)
        assert result.code == 2, command
        assert "weighting of design w" in result.err
        assert "Traceback" not in result.err


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


@pytest.mark.parametrize("command", ["fit", "constrain"])
@pytest.mark.parametrize("name", WRONG)
def test_weights_that_cannot_be_are_refused_by_the_options_name(lidardesign, runs, name, command):
    task, text, words = WRONG[name]
    result = lidardesign(command, runs[task], "--weight", text)
    assert result.code == 2
    assert f"--weight {text}" in result.err
    assert words in result.err
    assert not (runs[task] / "designs").exists()


def test_a_density_is_weighted_towards_other_scenes(lidardesign, runs, tmp_path):
    run = shutil.copytree(runs["spots"], tmp_path / "run")
    result = lidardesign(
        "fit", run, "--weight", "scene=discs", "--weight", "train=3", "--sensors", 2, "--name", "discs"
    )
    assert result.code == 0, result.err
    assert "note: with scene=discs, train=3 the samples have ESS 0." in result.err
    design = load_design(run / "designs" / "discs.yaml")
    assert design.provenance["weighting"] == {"set": ["scene=discs", "train=3"]}
    # discs are at x of 0.30 and 0.68 and y of 0.65 and 0.80, each seen from both sides
    samples = Weighting.of(design).log_target(load_samples(run), _target(run, design))
    assert (samples.weights[_on_disc(samples.points)].sum()) > 0.9
    found = refined(lidardesign, "constrain", run / "designs" / "discs.yaml", "--name", "again")
    assert found["satisfied"]
    assert load_design(run / "designs" / "again.yaml").provenance["weighting"] == design.provenance["weighting"]


def _target(run, design):
    return RunTarget(open_run(run), weighting=Weighting.of(design))


def _on_disc(points):
    seen = points[:, :3] + points[:, RANGE, None] * direction(points[:, 3], points[:, 4])
    distance = [np.linalg.norm(seen - centre, axis=1) - radius for centre, radius in (
        ((0.30, 0.65, 0), 0.09), ((0.68, 0.80, 0), 0.13))]  # fmt: skip
    return np.abs(np.min(distance, axis=0)) < 0.15


def test_settings_that_leave_no_weight_are_refused(lidardesign, runs, tmp_path):
    run = shutil.copytree(runs["flatland"], tmp_path / "run")
    samples = load_samples(run)
    # all samples are far from where any curve is
    points = samples.points.copy()
    points[:, RANGE] = np.linspace(0.0, 0.1, len(points))
    save_samples(Samples(points, samples.log_prob, samples.log_target, samples.space), run)
    result = lidardesign("fit", run, "--weight", "scene=discs", "--weight", "train=1")
    assert result.code == 3
    assert "samples are worth" in result.err
    assert "a setting nearer to what was learned" in result.err
