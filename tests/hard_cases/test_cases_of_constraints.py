"""Hard cases of constraints: contradictions, almost nothing left, exact bounds, and budgets that do not divide."""

from __future__ import annotations

import ast
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from support.command_line import files_under, make_run
from support.constraints import CONTRADICTIONS, FACE, ROOM, SAMPLES
from support.fits import MOVING, broken, design_of, fitted, log_target
from support.hard_cases import hard_case

import lidardesign.constraints.check as checker
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.errors import InfeasibleError
from lidardesign.mixture.bounds import Bounds, Floors
from lidardesign.mixture.components import Axes, Features, expect, log_density
from lidardesign.mixture.em import fit_mixture
from lidardesign.mixture.m_step import maximise
from lidardesign.mixture.support import LEAST_MASS
from lidardesign.samples import Samples
from lidardesign.scoring.metrics import DRAW_ROUNDS
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.design_file import design_document, design_from_document
from lidardesign.sensors.sensor import interval_factor
from lidardesign.space import DesignSpace

Z = interval_factor(0.95)


def flat(points):
    """log p* of the room's samples but for their noise."""
    return np.zeros(len(points))


def entry(values, index, parts):
    """Where a key path stands: a mapping and its last key."""
    place = values if index is None else values["each"][index]
    for part in parts[:-1]:
        if not isinstance(place[part], dict):
            return place, part
        place = place[part]
    return place, parts[-1]


def path_of(name):
    """The entry of `each`, or None, and the keys of a constraint's name."""
    if not name.startswith("each["):
        return None, name.split(".")
    index, _, rest = name.removeprefix("each[").partition("].")
    return int(index), rest.split(".")


def only(values, names):
    """A constraint file that says nothing but what has these names."""
    kept = {}
    for name in names:
        if name.startswith(("space.", "--")):
            continue
        index, parts = path_of(name.split("[")[0] if name.startswith("origin.") else name)
        if parts == ["each"]:
            kept.setdefault("each", [{} for _ in values["each"]])
            continue
        source, key = entry(values, index, parts)
        if index is not None:
            kept.setdefault("each", [{} for _ in values["each"]])
        target = kept if index is None else kept["each"][index]
        for part in parts[: parts.index(key)]:
            target = target.setdefault(part, {})
        target[key] = source[key]
    return kept


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
    "wide gates of all": (
        {
            "budget": {"bandwidth_mbps": 0.1, "rays": 20},
            "gate": {"width_m": {"min": 0.4}},
            "each": [{}, {"gate": {"width_m": {"min": 0.6}}}],
        },
        {},
        {"budget.rays", "budget.bandwidth_mbps", "gate.width_m.min"},
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


@hard_case(
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

    @pytest.mark.parametrize("kind", ["file", "budget"])
    def test_nothing_is_sampled_before(self, kind, monkeypatch):
        def never(*_, **__):
            raise AssertionError("samples were asked for before the constraints")

        for step in ("restrict_samples", "pin_samples", "choose_mounts", "fit_groups"):
            monkeypatch.setattr(f"lidardesign.mixture.fit.{step}", never)
        samples = Samples(FACE.sample(10, np.random.default_rng(0)), np.zeros(10), np.zeros(10), FACE)
        files = [(values, {}) for values, _ in CONTRADICTIONS.values()]
        for values, asked in files if kind == "file" else [one[:2] for one in BUDGETS.values()]:
            with pytest.raises(InfeasibleError) as caught:
                fitted(samples, values, **asked)
            assert len(caught.value.conflicts) >= 2

    def test_the_command_names_them_exits_4_and_writes_nothing(self, call, tmp_path):
        run = make_run(tmp_path / "run", 2000)
        (tmp_path / "c.yaml").write_text("gate: {start_m: {min: 0.8}, end_m: {max: 0.5}}\n")
        before = files_under(run)
        result = call("constrain", "run", "--constraints", "c.yaml", "--json")
        assert result.code == 4
        assert set(result.json["error"]["conflicts"]) == {"gate.start_m.min", "gate.end_m.max"}
        assert files_under(run) == before


def rare(share, count=20_000):
    """Samples in the room of which those nearer than 0.5 m have a given share of the weight."""
    points = ROOM.sample(count, np.random.default_rng(1))
    near = points[:, 5] < 0.5
    log_weights = np.where(near, math.log(share) - math.log(near.sum()), math.log1p(-share) - math.log((~near).sum()))
    return Samples(points, np.zeros(count), log_weights, ROOM)


NEAR = {"gate": {"end_m": {"max": 0.5}}}
REGION = {"origin": {"spread_m": {"max": 9.0}}}


@hard_case(
    "33",
    "Constraints that leave almost nothing of the density",
    done="below a thousandth of the mass, or with too few effective samples, the fit is refused with the mass and what "
    "would do, exit 4; it is measured on samples that exist, once",
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

    def test_without_any_sample_inside_the_mass_is_zero(self):
        samples = rare(0.5)
        far = samples.subset(samples.points[:, 5] > 1.0)
        with pytest.raises(InfeasibleError) as caught:
            fitted(far, NEAR, sensors=1)
        assert caught.value.admissible_mass == 0.0

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
        from lidardesign.errors import DataError
        from lidardesign.scenes.scene import Body, Scene, Sphere
        from lidardesign.scoring import metrics

        draws = []
        exact = metrics.sample_body
        monkeypatch.setattr(metrics, "sample_body", lambda *a, **k: (draws.append(a[2]), exact(*a, **k))[1])
        away = DesignSpace((3.0, 0, 0, 0.0, -0.1, 0.1), (3.0, 0, 0, 0.1, 0.1, 2.0))
        with pytest.raises(DataError, match="no ray of the design space sees"):
            metrics.visible_surface(Scene((Body(Sphere(0.5)),)), away, 100, np.random.default_rng(0))
        assert len(draws) <= DRAW_ROUNDS


def random_section(generator):
    """Bounds on one sensor, some of which may contradict each other."""

    def number(low, high):
        return float(np.round(generator.uniform(low, high), 3))

    def interval(low, high, likely):
        ends = {"min": number(low, high), "max": max(number(low, high), 1e-3)}
        return {end: value for end, value in ends.items() if generator.random() < likely}

    def box():
        corner = [number(-1, 0.5) for _ in range(3)]
        return {"low_m": corner, "high_m": [value + number(0, 1.2) for value in corner]}

    section = {}
    if generator.random() < 0.4:
        keys = {
            "low_m": lambda: [number(-1, 0.2), number(-1, 0.2), number(0, 0.8)],
            "high_m": lambda: [number(0, 1), number(0, 1), number(0.7, 2)],
            "spread_m": lambda: {"max": number(0.001, 0.5)},
            "thickness_m": lambda: {"max": number(0.001, 0.2)},
            "exclude": lambda: [box() for _ in range(generator.integers(1, 3))],
        }
        section["origin"] = {key: make() for key, make in keys.items() if generator.random() < 0.4}
    if generator.random() < 0.4:
        section["boresight"] = {
            "azimuth_deg": interval(-400, 400, 0.4), "elevation_deg": interval(-80, 80, 0.4),
        }  # fmt: skip
    if generator.random() < 0.4:
        section["field_of_view"] = {f"{axis}_deg": interval(0, 70, 0.4) for axis in ("horizontal", "vertical")}
    if generator.random() < 0.6:
        section["gate"] = {
            "start_m": interval(0, 2, 0.4), "end_m": interval(0.5, 4, 0.4), "width_m": interval(0, 2, 0.4),
        }  # fmt: skip
    return section


def random_file(seed):
    """A whole constraint file."""
    generator = np.random.default_rng(seed)
    values = random_section(generator)
    values["budget"] = {"rays": int(generator.integers(3, 60))}
    if generator.random() < 0.5:
        values["budget"]["bandwidth_mbps"] = float(np.exp(generator.uniform(-5, 3)))
    values["sensors"] = {"count": int(generator.integers(1, 4))}
    if generator.random() < 0.25:
        values["each"] = [
            random_section(generator) for _ in range(generator.integers(1, values["sensors"]["count"] + 1))
        ]
    return values


def clamp_and_mstep():
    """Log-likelihoods of ranges: fitted freely, with gates clamped afterwards, and with gates bounded while fitting."""
    generator = np.random.default_rng(0)
    points = np.zeros((2000, 6))
    points[:, 5] = 2.0 + generator.gamma(1.0, 0.2, 2000)
    space = DesignSpace((0, 0, 0, 0, 0, 0.1), (0, 0, 0, 0, 0, 9.0))
    features = Features.of(points, np.ones(2000), Axes.of(space), space)
    start = fit_mixture(features, Bounds.unbounded(2, Z), np.random.default_rng(1))
    two = Bounds.unbounded(2, Z).narrowed(0.2)
    statistics = expect(start.mixture, features)
    clamped = maximise(start.mixture, statistics, features, Bounds.unbounded(2, Z), Floors.of(features), 0.0)
    rows = {name: getattr(clamped, name).copy() for name in clamped.__dataclass_fields__}
    rows["spread_range_m"] = np.minimum(rows["spread_range_m"], 0.2 / (2 * Z))
    after = float(features.weights @ log_density(type(clamped)(**rows), features))
    within = fit_mixture(features, two, np.random.default_rng(1)).log_likelihood
    return start.log_likelihood, after, within


@hard_case(
    "34",
    "Bounds on gates, fields of view and origins that the free fit breaks",
    done="every M-step is the best one inside the bounds, and the written file is verified bound by bound by a checker "
    "that shares no code with the fit",
)
class TestBoundsHoldOnTheWrittenFile:
    def test_bounds_in_the_m_step_lose_less_than_clamping_after_the_fit(self):
        free, after, within = clamp_and_mstep()
        assert free >= within > after + 0.1

    @pytest.mark.parametrize("start", range(0, 40, 5))
    def test_random_files_are_kept_exactly_or_refused_with_what_stands_against_them(self, start):
        kept, reasons = 0, []
        for seed in range(start, start + 5):
            values = random_file(seed)
            try:
                found = fitted(SAMPLES, values, em_samples=1200, restarts=1, retarget=flat)
            except InfeasibleError as refused:
                reasons.append(refused.conflicts or refused.admissible_mass or "effective samples" in refused.message)
                continue
            document = design_document(design_of(found))
            for written in (
                json.loads(json.dumps(document, allow_nan=False)),
                yaml.safe_load(yaml.safe_dump(document)),
                design_document(design_from_document(document, "again")),
            ):
                assert [check for check in check_design(written, values, ROOM) if not check.satisfied] == []
            assert found.rays == values["budget"]["rays"]
            kept += 1
        assert kept > 0
        assert all(reasons)

    @pytest.mark.parametrize("mbps", [0.05, 0.2])
    def test_a_bandwidth_that_narrows_gates_leaves_their_other_bounds(self, mbps):
        # the start must come early and the end late: narrowing has to stop between
        values = {
            "gate": {"start_m": {"max": 1.0}, "end_m": {"min": 1.3}}, "sensors": {"count": 2},
            "budget": {"bandwidth_mbps": mbps, "rays": 5},
        }  # fmt: skip
        if conflicts_of(values, ROOM):
            assert mbps == 0.05
            return
        assert broken(fitted(SAMPLES, values, retarget=flat), values, ROOM) == []

    def test_the_checker_shares_no_code_with_the_fit(self):
        # parts have to be looked up, and angles mean what they mean: data and conventions, nothing of the fit
        parts = {f"lidardesign.parts.{name}" for name in ("catalogue", "part")}
        conventions = {f"lidardesign.{name}" for name in ("numerics", "errors", "space", "sensors.sensor")}
        tree = ast.parse(Path(checker.__file__).read_text(encoding="utf-8"))
        imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
        assert {module for module in imported if module.startswith("lidardesign")} <= parts | conventions


weights = st.lists(st.floats(0, 1e12), min_size=1, max_size=40).filter(lambda values: max(values) > 0)


@hard_case(
    "35",
    "A ray budget of 0, of 1, below the number of sensors, or between equal weights",
    done="largest remainders: the sum is exact, no share is a whole ray off, ties go to the first; a fit gives "
    "every sensor a ray or is refused",
)
class TestBudgetsThatDoNotDivide:
    @given(st.permutations(range(6)), st.integers(0, 400))
    def test_the_order_of_sensors_matters_only_between_equal_ones(self, order, rays):
        weights = np.array([0.31, 0.05, 0.17, 0.23, 0.11, 0.13])
        order = np.array(order)
        quotas = weights * rays
        remainders = np.sort(quotas - np.floor(quotas))
        assume((np.diff(remainders) > 1e-6).all())
        np.testing.assert_array_equal(split_budget(weights[order], rays), split_budget(weights, rays)[order])

    @pytest.mark.parametrize("rays", [1, 2, 3, 4, 5])
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

    def test_fewer_rays_than_sensors_that_were_asked_for_are_refused(self):
        for values, asked in (
            ({}, {"sensors": 3, "rays": 2}),
            ({"sensors": {"count": 3}}, {"rays": 2}),
            ({"each": [{}, {}, {}]}, {"rays": 2}),
            ({"sensors": {"min": 3}, "budget": {"rays": 2}}, {}),
        ):
            with pytest.raises(InfeasibleError, match="2 rays for 3 sensors"):
                fitted(SAMPLES, values, **asked)
