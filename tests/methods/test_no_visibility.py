"""The design without visibility: fitted and chosen as the design was, to the density without its occlusion term."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.command_line import make_run
from support.conditioned_runs import make_conditioned_run
from support.sensors import normal_sensor

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.density.objective.proposals import samples_without_visibility
from lidardesign.errors import DataError, InfeasibleError
from lidardesign.fitting.fit import fit_design
from lidardesign.fitting.request import FitRequest, RunTarget
from lidardesign.methods import no_visibility
from lidardesign.methods.no_visibility import NO_VISIBILITY, twin_samples, twin_without_visibility
from lidardesign.problem.problem import Comparison, Fired, Problem
from lidardesign.run_folder import RunFolder
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.pattern import Pattern
from lidardesign.task import random_generator

RAYS = 12
LIMITS = {"gate": {"width_m": {"max": 0.6}}}
CASES = {
    "chosen": {"sensors": 2},
    "a gate per ray": {"sensors": 2, "gates": "ray"},
    "even": {"sensors": 2, "layout": "even"},
    "along": {"sensors": 1},
    "at one place": {"sensors": 1, "at": {"x_m": 0.4}},
}
SAMPLES = 3000


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    monkeypatch.setattr(no_visibility, "TWIN_SAMPLES", SAMPLES)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    place = tmp_path_factory.mktemp("runs")
    plain, along = (few_scenes(run) for run in (make_run(place / "plain"), make_conditioned_run(place / "along")))
    return {case: along if case in ("along", "at one place") else plain for case in CASES}


def few_scenes(folder):
    """A run whose density is that of four training scenes."""
    opened = RunFolder.open(folder)
    task = opened.config.task.model_copy(update={"train": 4})
    return replace(opened, config=replace(opened.config, task=task))


def fit(run, case, visibility):
    """The design of a case, fitted to the exact density of its run without learning it."""
    config = run.config
    request = FitRequest.resolve(run, {"constraints": LIMITS, "rays": RAYS, "seed": 5, "name": "own", **CASES[case]})
    generator = random_generator(config.seed, "no visibility")
    scenes, target = run.scenes("train", config.seed), RunTarget(run, visibility)
    samples = samples_without_visibility(scenes, config.space, config.density, SAMPLES, generator)
    return fit_design(request, samples=replace(samples, log_target=target(samples.points)), target=target).design


@pytest.fixture(scope="module")
def fitted(runs):
    """Of each case its run and its design."""
    return {case: (run, fit(run, case, "raycast")) for case, run in runs.items()}


def fired(run, design):
    """Its rays at every value of its condition."""
    conditions = [design.at] if design.at else run.conditions()
    return tuple(design.rays(RAYS, at=at or None) for at in conditions)


def text(design):
    document = design_document(replace(design, name="same"))
    return {**document, "provenance": None, "constraints": None}


@pytest.mark.parametrize("case", CASES)
def test_a_twin_has_as_many_sensors_and_rays_and_keeps_the_same_constraints(fitted, case):
    run, design = fitted[case]
    twin = twin_without_visibility(design, run, RAYS)
    assert (twin.name, twin.layout, twin.at) == ("no-visibility", design.layout, design.at)
    assert (twin.condition, twin.has_gates_per_ray) == (design.condition, design.has_gates_per_ray)
    assert len(twin.sensors) == len(design.sensors)
    assert [len(rays) for rays in fired(run, twin)] == [RAYS] * len(fired(run, design))
    limits = Constraints.from_mapping(LIMITS)
    assert all(check.satisfied for check in check_design(design_document(twin), limits, run.config.space))


@pytest.mark.parametrize("case", CASES)
def test_where_nothing_occludes_a_design_is_its_own_twin(runs, case):
    design = fit(runs[case], case, "off")
    assert text(twin_without_visibility(design, runs[case], RAYS)) == text(design)


@pytest.mark.parametrize("case", ["chosen", "a gate per ray", "even", "along"])
def test_a_twin_within_a_bandwidth_never_exceeds_it_whatever_bits_the_design_was_made_for(fitted, case):
    run, design = fitted[case]
    coarse = replace(design, constraints={**design.constraints, "budget": {"rays": RAYS, "bin_ps": 1000.0}})
    limit = 0.7 * mean_mbps(fired(run, design), Bandwidth())
    spent = [
        mean_mbps(fired(run, twin_without_visibility(one, run, RAYS, limit)), Bandwidth()) for one in (design, coarse)
    ]
    assert max(spent) <= limit * (1 + 1e-9)
    assert spent[0] == spent[1]


def test_rays_of_real_parts_and_rings_have_even_rays_beside_them(fitted):
    run, design = fitted["even"]
    part = replace(design, layout="fixed", patterns=(Pattern.of(design.rays(RAYS)),))
    twin = twin_without_visibility(part, run, RAYS)
    assert twin.layout == "even"
    assert twin.rays_per_sensor(RAYS).sum() == RAYS
    # sensors that all fire are no more than rays
    assert len(twin_without_visibility(part, run, 1).sensors) == 1


def test_a_twin_that_cannot_be_fitted_says_which_baseline_to_leave_out(fitted):
    run, design = fitted["chosen"]
    drawn = twin_samples(run)
    few = replace(drawn, **{name: getattr(drawn, name)[:20] for name in ("points", "log_prob", "log_target")})
    with pytest.raises(DataError, match="--baseline no-visibility: the density is too rough") as refused:
        twin_without_visibility(design, run, RAYS, samples=lambda: few)
    assert "without" in refused.value.hint


@pytest.mark.parametrize("most", [24, 23, 5, 1])
def test_where_not_as_many_rays_fit_fewer_are_fired(most):
    def fit(count, limit_mbps):
        if count > most:
            raise InfeasibleError("too many rays", conflicts=["budget.bandwidth_mbps", "gate.width_m.min"])
        return DesignSpec("aimed", (normal_sensor(),), constraints={"budget": {"rays": count}})

    compared = Comparison(fired=[Fired(24, 1.5), Fired(9, 1.0)], refit=fit)
    design = NO_VISIBILITY.design(Problem(None, limit_mbps=1.5, compared=compared)).design
    assert most * 0.8 - 1 <= design.count <= most


def test_constraints_that_contradict_each_other_are_no_matter_of_the_number_of_rays():
    def fit(count, limit_mbps):
        raise InfeasibleError("no place is left", conflicts=["origin.exclude"])

    with pytest.raises(InfeasibleError, match="no place"):
        NO_VISIBILITY.design(Problem(None, limit_mbps=1.5, compared=Comparison(fired=[Fired(24, 1.5)], refit=fit)))
