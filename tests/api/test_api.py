"""The package's own API: its nouns' examples, and what notebooks show; docs/python.md is run with the other pages."""

from __future__ import annotations

import doctest
import shutil

import numpy as np
import pytest
from support.small_runs import shifted

import lidardesign
from lidardesign.errors import ConfigError, DataError, InfeasibleError
from lidardesign.run_folder import RunFolder
from lidardesign.samples import load_samples

SMALL = {
    "learning.steps": 60, "learning.batch": 128, "learning.samples": 10_000, "density.sigma_m": 0.05, "train": 3,
    "test": 2,
}  # fmt: skip
NOUNS = ("Run", "Design", "Constraints", "Scores", "Rays", "Task", "Scene")


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("learned") / "flat"
    lidardesign.learn("flatland", preset="draft", out=folder, seed=shifted(), settings=SMALL)
    return folder


@pytest.fixture
def run(learned, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lidardesign.open_run(shutil.copytree(learned, tmp_path / "flat"))


@pytest.mark.parametrize("name", ["uniform", "bounding", "greedy"])
def test_a_baseline_as_a_design_scores_as_the_baseline_does(run, name):
    with pytest.warns(DeprecationWarning, match=r"fit\(method="):
        design = run.baseline(name, rays=16)
    assert design.save() == run.design_path(f"{name}-rays")
    named = run.fit(method=name, rays=16)
    np.testing.assert_array_equal(named.rays(16).direction, design.rays(16).direction)
    (own, row) = (row for row in run.evaluate([design], rays=[16]).rows if row.design in (name, f"{name}-rays"))
    np.testing.assert_allclose(own.per_scene, row.per_scene, rtol=1e-12)
    assert own.gates == row.gates
    again = lidardesign.load_design(design.path)
    assert again.simulate(rays=16)[0].returns[0].rays.direction.shape == (16, 3)


@pytest.mark.parametrize(
    ("name", "choices", "said"),
    [
        ("random", {}, "draws other rays"),
        ("cma", {}, "begins with a design"),
        ("x", {}, "greedy"),
        ("greedy", {"layout": "even"}, "beside layout"),
        ("greedy", {"sensors": 2}, "keeps to no such choice"),
        ("uniform", {"constraints": {"gate": {"width_m": {"max": 1.0}}}}, "keeps to no such choice"),
    ],
)
def test_a_method_makes_no_design_that_is_another_in_every_scene_or_keeps_to_choices(run, name, choices, said):
    with pytest.raises(ConfigError, match=said):
        run.fit(method=name, **choices)


@pytest.mark.parametrize(("name", "heeded"), [("greedy", True), ("uniform", False)])
def test_a_method_that_gives_rays_no_gates_of_their_own_says_so(run, caplog, name, heeded):
    with caplog.at_level("INFO", "lidardesign"):
        design = run.fit(method=name, rays=16, gates="ray")
    assert (len(np.unique(design.rays(16).gate_m, axis=0)) > 1) == heeded
    assert ("one gate, whatever --gates says" in caplog.text) != heeded


@pytest.mark.parametrize("name", NOUNS)
def test_every_noun_has_an_example_that_runs(run, name):
    noun = getattr(lidardesign, name)
    assert len(noun.__doc__.splitlines()) < 60
    names = {"lidardesign": lidardesign, "run": run, "folder": run.folder, "np": np, name: noun}
    examples = doctest.DocTestParser().get_doctest(noun.__doc__, names, name, None, 0)
    assert examples.examples
    assert doctest.DocTestRunner().run(examples).failed == 0


def test_notebooks_show_tables_and_figures(run):
    design = run.fit(layout="even", sensors=2, rays=16, name="a-b")
    scores = run.evaluate([design], rays=[16])
    for noun, rows in ((run, 9), (design, 3), (scores, 7)):
        page = noun._repr_html_()
        assert (page.count("<table"), page.count("<tr")) == (1, rows)
    assert len(design.figure(16).data) == 3
    assert {trace.name for trace in scores.figure().data} >= {"a-b", "uniform"}
    assert "bandwidth" in scores.figure("bandwidth").layout.xaxis.title.text.lower()


def test_saved_designs_are_those_of_commands(run):
    from lidardesign.cli.main import run as program

    rules = {"gate": {"width_m": {"max": 0.3}}, "budget": {"rays": 16}}
    mine = run.fit(layout="even", sensors=2, constraints=rules, name="mine").save()
    before = mine.read_bytes()
    with pytest.raises(SystemExit) as ended:
        program(
            ["constrain", str(run.folder), "--layout", "even", "--sensors", "2", "--set", "gate.width_m.max=0.3",
             "--set", "budget.rays=16", "--name", "mine", "--quiet"]
        )  # fmt: skip
    assert not ended.value.code
    assert mine.read_bytes() == before
    assert lidardesign.load_design(mine).run.folder == run.folder
    assert [design.name for design in run.designs()] == ["mine"]


def test_a_design_is_fitted_again_with_what_is_not_chosen_anew(run):
    design = run.fit(sensors=2, rays=16, layout="even", level=0.8, name="first")
    assert not run.design_path("first").exists()
    again = design.constrain(constraints={"gate": {"width_m": {"max": 0.3}}})
    assert (again.name, again.specification.layout, again.specification.count) == ("constrained", "even", 16)
    assert again.specification.level == 0.8
    assert max(end - start for start, end in (s.gate_m for s in again.specification.sensors)) <= 0.3 + 1e-12


def test_designs_work_without_a_run_and_find_their_own(run, tmp_path):
    design = run.fit(layout="even", sensors=2, rays=16, name="away")
    path = design.save(tmp_path / "elsewhere" / "away.yaml")
    assert lidardesign.load_design(path).run.folder.resolve() == run.folder.resolve()
    shutil.rmtree(run.folder)
    alone = lidardesign.load_design(path)
    assert alone.run is None
    assert len(alone.rays()) == 16
    assert alone.export(tmp_path / "rays.npz").rays == 16
    assert alone.as_dict()["design"] == str(path)
    with pytest.raises(DataError, match="the run of this design cannot be found"):
        alone.constrain(constraints={})


def test_notes_go_to_whoever_asks(run, caplog):
    notes = []
    run.fit(sensors=2, rays=12, weights={"variation": 1.5}, notes=notes.append)
    assert any("variation=1.5" in note for note in notes)
    with caplog.at_level("INFO", "lidardesign"):
        run.fit(sensors=2, rays=12, weights=["variation=1.5"])
    assert "variation=1.5" in caplog.text


def test_the_density_draws_the_same_points_for_the_same_seed(run):
    density = run.density
    assert np.array_equal(density.sample(50, seed=3), density.sample(50, seed=3))
    assert not np.array_equal(density.sample(50, seed=3), density.sample(50, seed=4))
    # samples are of the density and of points that are independent of it together
    kept = load_samples(run.folder)
    ratio = np.exp(density.log_prob(kept.points) - kept.log_prob)
    assert ratio.mean() == pytest.approx(1.0, abs=5 * ratio.std() / np.sqrt(len(kept)))
    outside = density.sample(2)
    outside[1, 5] = 1e6
    assert np.isfinite(density.log_prob(outside)).tolist() == [True, False]
    with pytest.raises(ConfigError, match="shape"):
        density.log_prob(np.zeros(6))


@pytest.mark.parametrize(
    ("call", "where"),
    [
        (lambda run: run.fit(layout="spiral"), "layout"),
        (lambda run: run.fit(method="uniform", name="../x"), "name"),
        (lambda run: run.fit(method="uniform", rays=0), "rays"),
        (lambda run: run.fit(sensors=2, rays=0), "rays"),
        (lambda run: run.evaluate(baselines=["best"]), "baselines"),
        (lambda run: run.evaluate(baselines=["none", "lloyd"]), "baselines"),
        (lambda run: run.evaluate(range_tolerance_mm=-1.0), "range_tolerance_mm"),
        (lambda run: run.evaluate(workers=0), "workers"),
        (lambda run: lidardesign.evaluate_seeds([run, run], scenes_seed=-1), "scenes_seed"),
        (lambda run: lidardesign.learn("flatland", out="new", time_budget_s=-1.0), "time_budget_s"),
        (lambda run: lidardesign.learn("flatland", out="new", device="tpu"), "device"),
    ],
)
def test_errors_name_arguments(run, call, where):
    with pytest.raises(ConfigError) as raised:
        call(run)
    assert raised.value.where == where
    assert "--" not in str(raised.value)


def test_conflicts_name_arguments(run):
    with pytest.raises(InfeasibleError) as raised:
        run.fit(sensors=2, rays=16, constraints={"budget": {"rays": 8}})
    assert raised.value.conflicts == ("rays", "budget.rays")


def test_one_kind_of_progress_says_how_far_everything_has_come(tmp_path):
    said = []
    run = lidardesign.learn(
        "flatland", preset="draft", out=tmp_path / "run", settings=SMALL, progress=lambda *now: said.append(now)
    )
    assert said[-1][0] == "learning"
    assert 0 < said[-1][1] <= said[-1][2]
    design = run.fit(sensors=1, rays=8, progress=lambda *now: said.append(now))
    assert said[-1] == ("choosing 8 rays", None, None)
    run.evaluate([design], rays=[8], baselines=["none"], progress=lambda *now: said.append(now))
    assert said[-1][1:] == (2, 2)


def test_without_baselines_no_training_scene_is_made(run, monkeypatch):
    design, splits, scenes = run.fit(sensors=1, rays=8, layout="even"), [], RunFolder.scenes
    monkeypatch.setattr(RunFolder, "scenes", lambda own, split, seed: splits.append(split) or scenes(own, split, seed))
    run.evaluate([design], rays=[8], baselines=["none"])
    assert splits == ["test"]


def test_steps_are_not_counted_down_where_time_decides(tmp_path):
    said = []
    options = {"settings": SMALL, "time_budget_s": 1.0, "progress": lambda *now: said.append(now)}
    lidardesign.learn("flatland", out=tmp_path / "run", **options)
    assert all(now[1] > 0 and now[2] is None for now in said)
