"""Constraints: contradictions, almost nothing left, exact bounds, and budgets that do not divide."""

from __future__ import annotations

import ast
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from support.constraints import CONTRADICTIONS, FACE, ROOM, SAMPLES
from support.fits import MOVING, broken, design_of, fitted, log_target

import lidardesign.constraints.check as checker
from lidardesign.cli.main import run as run_program
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.errors import DataError, InfeasibleError
from lidardesign.fitting import fit as fit_design
from lidardesign.mixture.support import LEAST_MASS
from lidardesign.run.yaml import load_yaml
from lidardesign.samples import Samples
from lidardesign.scenes.scene import Body, Scene, Sphere
from lidardesign.scoring import metrics
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.design_file import design_document, design_from_document
from lidardesign.space import DesignSpace


def even(points):
    """log p* of the room's samples but for their noise."""
    return np.zeros(len(points))


def only(values, names, path=""):
    """What a constraint file says under these names."""
    found = {}
    for key, value in values.items():
        name = f"{path}{key}"
        if key == "each":
            entries = [only(one, names, f"each[{index}].") for index, one in enumerate(value)]
            if any(entries) or key in names:
                found[key] = entries
        elif any(name == one.split("[")[0] or name == one for one in names):
            found[key] = value
        elif isinstance(value, dict) and (inner := only(value, names, f"{name}.")):
            found[key] = inner
    return found


def conflicts_of(values, space, **asked):
    """The conflicting set that is refused, or none."""
    try:
        check_feasible(Constraints.from_mapping(values), space, **asked)
    except InfeasibleError as refused:
        error = refused
    else:
        return set()
    assert error.exit_code == 4
    assert all(name in error.message for name in error.conflicts)
    return set(error.conflicts)


def assert_smallest(values, space, conflicts, **asked):
    """What is named conflicts by itself, and without any one of it does not."""
    assert conflicts_of(only(values, conflicts), space, **asked)
    for name in conflicts:
        if not name.startswith(("space.", "--")):
            left = conflicts_of(only(values, conflicts - {name}), space, **asked)
            assert not left <= conflicts or not left, (name, left)


bounds = st.one_of(st.none(), st.floats(0.0, 1.3).map(lambda v: round(v, 3)))
widths = st.one_of(st.none(), st.floats(0.001, 1.3).map(lambda v: round(v, 3)))


@st.composite
def random_gates(draw):
    gate = {key: {"min": draw(bounds), "max": draw(widths)} for key in ("start_m", "end_m", "width_m")}
    return {"gate": {key: {end: v for end, v in one.items() if v is not None} for key, one in gate.items()}}


def gate_exists(gate, space):
    """Whether a start and an end keep all bounds, by linear programming; and by how much at least or at most."""
    low, high = space.low[5], space.high[5]
    rows, limits = [[1, -1]], [0.0]
    for key, row in (("start_m", [1, 0]), ("end_m", [0, 1]), ("width_m", [-1, 1])):
        for end, sign in (("max", 1), ("min", -1)):
            if end in gate.get(key, {}):
                rows.append([sign * v for v in row])
                limits.append(sign * gate[key][end])
    # the largest slack that all inequalities can have
    matrix = np.column_stack([np.array(rows, float), np.ones(len(rows))])
    found = linprog([0, 0, -1], matrix, limits, bounds=[(low, high), (low, high), (None, 1)])
    return found.x[2]


BUDGETS = {
    "rays below sensors": ({"sensors": {"count": 4}}, {"rays": 3}, {"--rays", "sensors.count"}),
    "rays twice": ({"budget": {"rays": 9}}, {"rays": 8}, {"--rays", "budget.rays"}),
    "sensors twice": ({"sensors": {"count": 4}}, {"sensors": 3}, {"--sensors", "sensors.count"}),
    "bandwidth": ({"budget": {"bandwidth_mbps": 0.01}}, {"rays": 99}, {"--rays", "budget.bandwidth_mbps"}),
    "late ends": (
        {"budget": {"bandwidth_mbps": 0.1, "rays": 20}, "gate": {"start_m": {"max": 0.2}, "end_m": {"min": 0.8}}},
        {},
        {"budget.rays", "budget.bandwidth_mbps", "gate.start_m.max", "gate.end_m.min"},
    ),
    "one ray too wide": (
        {"budget": {"bandwidth_mbps": 0.02, "rays": 20}, "gate": {"width_m": {"min": 0.9}}},
        {},
        {"budget.bandwidth_mbps", "gate.width_m.min"},
    ),
    "wide gates of each": (
        {
            "budget": {"bandwidth_mbps": 0.1, "rays": 20},
            "each": [{"gate": {"width_m": {"min": 0.5}}}, {"gate": {"width_m": {"min": 0.6}}}],
        },
        {},
        {"budget.rays", "budget.bandwidth_mbps", "each[0].gate.width_m.min", "each[1].gate.width_m.min"},
    ),
}


@pytest.mark.hard_case(
    "32",
    "Constraints that contradict each other: a gate outside bounds, min above max, fewer rays than sensors",
    done="refused before anything is sampled with the smallest conflicting set by name, exit 4",
)
class TestContradictions:
    @pytest.mark.parametrize("name", CONTRADICTIONS)
    def test_what_is_named_conflicts_and_without_any_one_of_it_does_not(self, name):
        values, expected = CONTRADICTIONS[name]
        conflicts = conflicts_of(values, FACE)
        assert conflicts == set(expected)
        assert_smallest(values, FACE, conflicts)

    @settings(max_examples=150)
    @given(random_gates())
    def test_gates_are_refused_where_linear_programming_finds_none(self, values):
        slack = gate_exists(values["gate"], FACE)
        # where only a gate without any width is left, the program asks for some
        assume(abs(slack) > 1e-9)
        conflicts = conflicts_of(values, FACE)
        assert bool(conflicts) == (slack < 0)
        if conflicts:
            assert_smallest(values, FACE, conflicts)

    @pytest.mark.parametrize("name", BUDGETS)
    def test_budgets_are_refused_with_all_that_makes_them_too_small(self, name):
        values, asked, expected = BUDGETS[name]
        conflicts = conflicts_of(values, FACE, **asked)
        assert conflicts == expected
        assert_smallest(values, FACE, conflicts, **asked)

    def test_nothing_is_sampled_before(self, monkeypatch):
        def never(*_, **__):
            raise AssertionError("samples were asked for before the constraints")

        for step in ("restrict_samples", "pin_samples", "choose_mounts", "fit_groups"):
            monkeypatch.setattr(f"lidardesign.mixture.fit.{step}", never)
        samples = Samples(FACE.sample(10, np.random.default_rng(0)), np.zeros(10), np.zeros(10), FACE)
        for values, asked in [
            *((one[0], {}) for one in CONTRADICTIONS.values()),
            *(one[:2] for one in BUDGETS.values()),
        ]:
            with pytest.raises(InfeasibleError) as caught:
                fitted(samples, values, **asked)
            assert len(caught.value.conflicts) >= 2


def rare(share, count=20_000):
    """Samples in the room of which those nearer than 0.5 m have a given share of the weight."""
    points = ROOM.sample(count, np.random.default_rng(1))
    near = points[:, 5] < 0.5
    log_weights = np.where(near, math.log(share) - math.log(near.sum()), math.log1p(-share) - math.log((~near).sum()))
    return Samples(points, np.zeros(count), log_weights, ROOM)


NEAR = {"gate": {"end_m": {"max": 0.5}}}
REGION = {"origin": {"spread_m": {"max": 9.0}}}


@pytest.mark.hard_case(
    "33",
    "Constraints that leave almost nothing of the density",
    done="below a thousandth of the mass, or with too few effective samples, the fit is refused with the mass and "
    "what would do, exit 4",
)
class TestAlmostNothingLeft:
    @pytest.mark.parametrize("share", [1e-4, 1e-7, 1e-12, 1e-300])
    def test_it_is_refused_with_the_measured_mass(self, share):
        with pytest.raises(InfeasibleError) as caught:
            fitted(rare(share), NEAR, sensors=2)
        assert caught.value.exit_code == 4
        assert caught.value.admissible_mass == pytest.approx(share, rel=1e-9)
        assert f"{share:.3g} of the density" in caught.value.message
        assert caught.value.allowed == f"at least {LEAST_MASS:g}"
        assert caught.value.hint

    def test_enough_mass_on_too_few_samples_says_how_many_count(self):
        samples = rare(0.5)
        keep = np.flatnonzero(samples.points[:, 5] < 0.5)[:30]
        few = samples.subset(np.sort(np.concatenate([keep, np.flatnonzero(samples.points[:, 5] > 1.0)[:200]])))
        with pytest.raises(InfeasibleError, match="leave 30 effective samples") as caught:
            fitted(few, NEAR, sensors=2)
        assert caught.value.admissible_mass > LEAST_MASS
        assert caught.value.allowed == "at least 50"
        assert "more samples" in caught.value.hint

    def test_a_pinned_origin_that_sees_nothing_asks_the_target_once_and_is_refused(self):
        asked = []

        def blind(points):
            asked.append(len(points))
            return np.full(len(points), -np.inf)

        where = [0.02, 0.0, 0.0]
        rules = {"origin": {"fixed_m": where}}
        assert broken(fitted(MOVING, rules, sensors=1, retarget=log_target), rules, MOVING.space) == []
        with pytest.raises(InfeasibleError, match=r"at \(0.02, 0, 0\) m leave 0 effective samples"):
            fitted(MOVING, rules, sensors=1, retarget=blind)
        assert len(asked) == 1
        assert asked[0] <= 2000

    def test_the_mass_that_is_reported_is_the_mass_that_is_there(self):
        for share in (0.002, 0.03, 0.4):
            samples = rare(share)
            found = fitted(samples, NEAR | REGION, sensors=1)
            assert found.admissible_mass == pytest.approx(share, rel=1e-9)
            estimate = found.estimates(samples)["admissible_mass"]
            assert 0 < estimate.error < share

    def test_surfaces_that_hardly_any_ray_sees_are_drawn_a_bounded_number_of_times(self, monkeypatch):
        draws = []
        exact = metrics.sample_body
        monkeypatch.setattr(metrics, "sample_body", lambda *a, **k: (draws.append(a[2]), exact(*a, **k))[1])
        away = DesignSpace((3.0, 0, 0, 0.0, -0.1, 0.1), (3.0, 0, 0, 0.1, 0.1, 2.0))
        with pytest.raises(DataError, match="no ray of the design space sees"):
            metrics.visible_surface(Scene((Body(Sphere(0.5)),)), away, 100, np.random.default_rng(0))
        assert len(draws) <= metrics.DRAW_ROUNDS


def least(low, high):
    return st.floats(low, high).map(lambda value: {"min": value})


def most(low, high):
    return st.floats(low, high).map(lambda value: {"max": value})


def optional(**keys):
    return st.fixed_dictionaries({}, optional=keys)


def constraint_files(**origin):
    """Constraint files that may contradict themselves; `origin` are further keys of origins."""
    bounds = {
        "gate": optional(
            width_m=most(0.05, 1.2), start_m=least(0, 0.6) | most(0.3, 1.0), end_m=most(0.5, 1.5) | least(0.5, 1.2)
        ),
        "field_of_view": optional(horizontal_deg=most(2, 90), vertical_deg=most(2, 90)),
        "boresight": optional(
            azimuth_deg=st.builds(
                lambda low, width: {"min": low, "max": low + width}, st.floats(30, 110), st.floats(1, 60)
            ),
            elevation_deg=most(-60, 60),
        ),
        "origin": optional(spread_m=most(1e-3, 0.3), **origin),
    }
    return optional(
        sensors=st.integers(1, 4).map(lambda count: {"count": count}),
        budget=st.fixed_dictionaries({"rays": st.integers(1, 60)}, optional={"bandwidth_mbps": st.floats(0.001, 2.0)}),
        each=st.lists(optional(**bounds), min_size=1, max_size=2),
        **bounds,
    )


corners = st.lists(st.floats(-1, 0.5), min_size=3, max_size=3)
boxes = corners.map(lambda low: [{"low_m": low, "high_m": [value + 0.6 for value in low]}])


@pytest.mark.hard_case(
    "34",
    "Bounds on gates, fields of view and origins that the free fit breaks",
    done="every M-step is the best one inside the bounds, and the written file is verified bound by bound by a checker "
    "that shares no code with the fit",
)
class TestBoundsHoldOnTheWrittenFile:
    @settings(max_examples=25)
    @given(constraint_files(low_m=corners, thickness_m=most(1e-3, 0.2), exclude=boxes))
    def test_any_file_is_kept_exactly_or_refused_with_what_stands_against_it(self, values):
        try:
            found = fitted(SAMPLES, values, em_samples=1200, restarts=1, retarget=even)
        except InfeasibleError as error:
            refused = error
        else:
            refused = None
        if refused is not None:
            assert refused.conflicts or refused.admissible_mass or "effective samples" in refused.message
            return
        document = design_document(design_of(found))
        for written in (
            json.loads(json.dumps(document, allow_nan=False)),
            yaml.safe_load(yaml.safe_dump(document)),
            design_document(design_from_document(document, "again")),
        ):
            assert [check for check in check_design(written, values, ROOM) if not check.satisfied] == []
        assert found.rays == values.get("budget", {}).get("rays")

    def test_the_checker_shares_no_code_with_the_fit(self):
        # parts have to be looked up, and angles mean what they mean: data and conventions, nothing of the fit
        parts = {f"lidardesign.parts.{name}" for name in ("catalogue", "part")}
        conventions = {f"lidardesign.{name}" for name in ("numerics", "errors", "space", "sensors.sensor")}
        tree = ast.parse(Path(checker.__file__).read_text(encoding="utf-8"))
        imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
        assert {module for module in imported if module.startswith("lidardesign")} <= parts | conventions


weights = st.lists(st.floats(0, 1e12), min_size=1, max_size=40).filter(lambda values: max(values) > 0)


@pytest.mark.hard_case(
    "35",
    "A ray budget of 0, of 1, below the number of sensors, or between equal weights",
    done="largest remainders: the sum is exact, no share is a whole ray off, ties go to the first",
)
class TestBudgetsThatDoNotDivide:
    @pytest.mark.parametrize("rays", [1, 3])
    def test_a_fit_has_no_more_sensors_than_rays_where_their_number_is_open(self, rays):
        found = fitted(SAMPLES, REGION, rays=rays, em_samples=1200, restarts=1)
        assert len(found.sensors) <= rays == found.rays

    @given(weights, st.integers(0, 60))
    def test_where_each_has_to_have_one_those_with_most_give_it(self, weights, rays):
        alone, each = (split_budget(np.array(weights), rays, each=one) for one in (False, True))
        assert alone.sum() == each.sum() == rays
        assert each.min() >= (1 if rays >= len(weights) else 0)
        assert (each <= np.maximum(alone, 1)).all()
        if alone.min() > 0:
            np.testing.assert_array_equal(each, alone)


def longer_gates(document):
    sensors = [{**one, "gate_m": {**one["gate_m"], "end": one["gate_m"]["end"] + 0.01}} for one in document["sensors"]]
    return {**document, "sensors": sensors}


@pytest.mark.hard_case(
    "P7",
    "Any constraints",
    done="the written design satisfies all of them, found by a checker that shares nothing with the fit, or nothing is "
    "written and the command exits 4",
)
class TestDesignsKeepTheirConstraints:
    # gates that are over before any target: none of the rays tells anything
    @example({"gate": {"width_m": {"max": 0.125}, "start_m": {"max": 0.375}}}, "chosen")
    @settings(max_examples=6)
    @given(constraint_files(), st.sampled_from(["even", "chosen"]))
    def test_the_written_design_satisfies_them_all_or_the_command_exits_4(self, made, rules, layout):
        folder = made.parent / "tried"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(made, folder)
        path = made.parent / "rules.yaml"
        path.write_text(json.dumps(rules))
        options = ("--layout", layout, *(() if "sensors" in rules else ("--sensors", "2")))
        with pytest.raises(SystemExit) as ended:
            run_program(["constrain", str(folder), "--constraints", str(path), *options, "--name", "d", "-q"])
        written = folder / "designs" / "d.yaml"
        assert (ended.value.code or 0) in (0, 4)
        assert written.exists() == (ended.value.code in (0, None))
        if written.exists():
            space = DesignSpace.from_dict(load_yaml(folder / "config.yaml").value["space"])
            checks = check_design(load_yaml(written).value, rules, space)
            assert checks or not rules
            assert all(check.satisfied for check in checks), [check.name for check in checks if not check.satisfied]

    def test_a_fit_that_broke_a_constraint_would_be_found_out_on_what_it_writes(self, lidardesign, flat, monkeypatch):
        dump = fit_design.dump_yaml
        # as if a gate had been written a little too long
        monkeypatch.setattr(fit_design, "dump_yaml", lambda document: dump(longer_gates(document)))
        options = ("--layout", "even", "--sensors", 2, "--set", "gate.width_m.max=0.1", "--name", "never", "--json")
        done = lidardesign("constrain", flat, *options)
        assert done.code == 4
        assert any("gate" in name for name in done.json["error"]["conflicts"])
        assert not (flat / "designs" / "never.yaml").exists()
