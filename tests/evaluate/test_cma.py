"""Direct optimisation as a rival: its vectors keep every constraint, its searches never lose what they started with."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.rivals import balls
from support.scoring import HitTask, MissTask
from support.tables import each_row

from lidardesign.cli.commands.evaluate import search_display
from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.constraints.check import check_design
from lidardesign.design.constraints.document import Constraints
from lidardesign.design.files import design_document
from lidardesign.design.sensor import DesignSpec, Sensor, Track, tangent_coordinates
from lidardesign.errors import ConfigError
from lidardesign.evaluate.baselines.candidates import mean_mbps, rays_at, whole_range
from lidardesign.evaluate.baselines.views import TrainingViews, dense_points
from lidardesign.evaluate.cma.candidate import CmaCandidate, CmaSettings
from lidardesign.evaluate.cma.model import DesignModel, RayAllowance, SearchRules
from lidardesign.evaluate.cma.search import OutOfTimeError, Search, SearchBudget, TrainingObjective
from lidardesign.evaluate.cma.starts import starts, tiles
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.score import evaluate
from lidardesign.simulate.plan import Planner
from lidardesign.space import AZIMUTH, ELEVATION, DesignSpace
from lidardesign.task import TaskConfig
from lidardesign.workflow.evaluate import ScoreOptions

FIXED = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
FREE = DesignSpace((-0.2, -0.2, -0.2, -0.6, -0.5, 0.05), (0.2, 0.2, 0.2, 0.6, 0.5, 4.0))
CEILING = DesignSpace((-1, -1, 1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, -0.8, 2.0))
FLAT = DesignSpace((0, 0, 0, math.pi / 4, 0, 0), (1, 0, 0, 3 * math.pi / 4, 0, 1.2))
AISLE = DesignSpace(
    (0.0, 0, 0, 0.0, -0.5, 0.05), (1.0, 0, 0, 0.0, 0.5, 4.0), condition=("x_m",), measure="angles"
)  # fmt: skip
FAST = SearchBudget(math.inf, evaluations=300)


AHEAD, BELOW = balls(np.array([3.0, 0, 0])), balls(np.array([0.3, 0.2, 0.0]), 0.3)
RULES = {
    "none": {},
    "gate": {"gate": {"start_m": {"min": 0.5}, "end_m": {"max": 2.9}, "width_m": {"min": 0.1, "max": 0.3}}},
    "field": {"field_of_view": {"horizontal_deg": {"min": 4, "max": 9}, "vertical_deg": {"max": 6}}},
    "boresight": {"boresight": {"azimuth_deg": {"min": -8, "max": 4}, "elevation_deg": {"min": -50, "max": -2}}},
    "read-out": {"budget": {"bandwidth_mbps": 0.2}},
    "each": {"each": [{"gate": {"end_m": {"max": 2.0}}}, {"field_of_view": {"vertical_deg": {"max": 2}}}]},
}
PLACES = {
    "box": {"origin": {"low_m": [-0.1, -0.05, -0.2], "high_m": [0.2, 0.05, 1.0], "spread_m": {"max": 0.04}}},
    "thin": {"origin": {"thickness_m": {"max": 0.01}}},
    "point": {"origin": {"fixed_m": [0.1, 0.0, 0.1]}},
    "mounts": {"origin": {"mounts_m": [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.1], [-0.1, 0.1, 0]]}},
    "exclude": {"origin": {"exclude": [{"low_m": [-0.1, -1, -1], "high_m": [0.1, 0.1, 2]}]}},
}
CEILING_PLACES = {
    "mounts": {"origin": {"mounts_m": [[0, 0, 1], [0.5, 0, 1], [0, 0.5, 1], [-0.5, 0.5, 1]]}},
    "point": {"origin": {"fixed_m": [0.1, 0.0, 1.0]}},
}
CASES = [
    *((FIXED, AHEAD, "grid", rules) for rules in RULES.values()),
    *((FIXED, AHEAD, "scan", rules) for name, rules in RULES.items() if name != "each"),
    *((FREE, AHEAD, "grid", rules) for rules in (RULES | PLACES).values()),
    *((CEILING, BELOW, "grid", rules) for rules in (PLACES | CEILING_PLACES).values()),
    (FLAT, balls(np.array([0.5, 0.8, 0.0]), 0.15, 0.0), "grid", RULES["gate"]),
]


def named(case):
    space, _, layout, rules = case
    place = next(name for name, value in globals().items() if value is space)
    return f"{place.lower()} {layout} {json.dumps(rules)[:60]}"


def rules_of(space, layout, rules, gates=True):
    origin, standing = rules.get("origin", {}), None
    if "mounts_m" in origin or "exclude" in origin:
        standing = np.array(origin.get("mounts_m", [[0.15, 0.0, max(space.low[2], 0.0)]] * 3), dtype=float)
    return SearchRules(space, Constraints.from_mapping(rules), 0.95, layout == "scan", {}, gates, standing)


def models_of(space, train, layout, rules, count=3):
    setting = rules_of(space, layout, rules)
    found = starts(setting, TrainingViews(space, train), count)
    return [DesignModel(setting, start, [{}], rules) for start in found]


@each_row("case", CASES, ids=named)
def test_every_vector_however_far_stands_for_a_design_that_keeps_its_constraints(case):
    space, train, layout, rules = case
    generator = np.random.default_rng(5)
    for model in models_of(space, train, layout, rules)[::7]:
        for step in (0.0, 0.5, 4.0, 40.0):
            vector, allowed = step * generator.standard_normal(model.size), RayAllowance(12 if layout != "scan" else 3)
            (design,) = model.designs(vector, allowed)
            checks = check_design(design_document(design), rules, space)
            assert not [check for check in checks if not check.satisfied]
            assert design.rays in (0, 12, 3)
            assert len(model.positions(vector, allowed)[0]) == design.rays


@each_row("case", [case for case in CASES if case[3] and "read-out" not in case[3]], ids=named)
def test_the_further_beyond_the_constraints_the_larger_the_excess(case):
    generator = np.random.default_rng(6)
    for model in models_of(*case)[::7]:
        vector = generator.standard_normal(model.size)
        inside, near, far = (model.excess(step * vector) for step in (0.0, 4.0, 400.0))
        assert inside == pytest.approx(0.0, abs=1e-9)
        assert far > max(near, 1.0)


def test_a_vector_that_breaks_nothing_has_no_excess():
    sensors = [
        Sensor(f"s{i}", 1 / 3, np.zeros(3), np.zeros((3, 3)), 0.1 * i, -0.05 * i, 0.3, 0.05, 0.03, 1.5, 0.1)
        for i in range(3)
    ]
    model = DesignModel(rules_of(FREE, "grid", {}), sensors, [{}], {})
    assert model.size == 3 * 11
    vector = 0.5 * np.random.default_rng(1).standard_normal(model.size)
    assert model.excess(vector) == pytest.approx(0.0, abs=1e-9)
    (moved,), (start,) = (model.designs(one, RayAllowance(12)) for one in (vector, model.zero))
    for one, other in zip(moved.sensors, start.sensors, strict=True):
        assert np.abs(one.origin_m - other.origin_m).min() > 0
        assert not np.allclose(one.frame, other.frame)
        assert one.gate_m != pytest.approx(other.gate_m)


def test_the_vector_zero_is_the_start():
    sensors = [
        Sensor(f"s{i}", 0.2 + 0.3 * i, [0.1, 0, 0], np.zeros((3, 3)), 0.1 * i, -0.1, 0.4 * i, 0.04, 0.02, 1.5, 0.1)
        for i in range(2)
    ]
    model = DesignModel(rules_of(FREE, "grid", {}), sensors, [{}], {})
    for one, other in zip(model.designs(model.zero, RayAllowance(10))[0].sensors, sensors, strict=True):
        np.testing.assert_allclose(one.frame, other.frame, atol=1e-9)
        assert one.gate_m == pytest.approx(other.gate_m)
        assert one.field_of_view_rad == pytest.approx(other.field_of_view_rad)
        assert one.weight == pytest.approx(other.weight / 0.7)


@each_row(("count", "rows"), [(n, r) for n in (1, 2, 5, 10) for r in range(1, n + 1)])
def test_tiles_are_equal_and_fill_their_rectangle(count, rows):
    low, high = np.array([-1.0, 2.0]), np.array([3.0, 2.5])
    found = tiles(low, high, count, rows)
    assert len(found) == count
    areas = [np.prod(tile.high - tile.low) for tile in found]
    np.testing.assert_allclose(areas, np.prod(high - low) / count)
    for one, other in itertools.combinations(found, 2):
        shared = np.minimum(one.high, other.high) - np.maximum(one.low, other.low)
        assert shared.min() < 1e-12
    assert len({tile.low[1] for tile in found}) == rows


@each_row("limit", [0.01, 0.05, 0.2])
def test_gates_are_as_wide_as_a_budget_allows_at_a_number_of_rays(limit):
    rules = {"budget": {"bandwidth_mbps": limit}}
    for model in models_of(FIXED, AHEAD, "grid", rules)[::6]:
        rays = model.positions(model.zero, RayAllowance(12))[0]
        spent, bin_m = mean_mbps((rays,), Bandwidth()), Bandwidth().bin_m
        free = mean_mbps(models_of(FIXED, AHEAD, "grid", {})[0].positions(model.zero, RayAllowance(12)), Bandwidth())
        assert len(rays) in (0, 12)
        assert spent <= limit
        if len(rays) and spent < 0.5 * free:
            # a bin more of each ray is too much
            wider = replace(rays, gate_m=rays.gate_m + np.array([0.0, bin_m]))
            assert mean_mbps((wider,), Bandwidth()) > limit


@each_row("limit", [0.004, 0.3, 2.0])
def test_rays_within_a_bandwidth_cost_no_more_and_hardly_less(limit):
    generator = np.random.default_rng(2)
    for model in models_of(FIXED, AHEAD, "grid", {})[::6]:
        for step in (0.0, 1.0):
            amount = RayAllowance(None, limit)
            positions = model.positions(step * generator.standard_normal(model.size), amount)
            spent = mean_mbps(positions, Bandwidth())
            assert spent <= limit * (1 + 1e-12)
            if limit > 0.2:
                assert spent > 0.7 * limit


class Bowl:
    """A model whose rays are its vectors, for searches of a function."""

    size = 4

    def __init__(self, start):
        self.zero = np.array(start, dtype=np.float64)

    def excess(self, vector):
        return float(np.square(np.minimum(vector + 1.0, 0.0)).mean())

    def positions(self, vector, amount):
        return np.clip(vector, -1.0, None)


class Distance:
    """The squared distance from the scene's point; vectors below -1 are never asked for."""

    sign = 1.0

    def __init__(self, points):
        self.scenes = [np.asarray(point, dtype=np.float64) for point in points]
        self.asked = 0

    def values(self, lists, scenes, stop=lambda: False):
        found = np.empty((len(lists), len(scenes)))
        for column, number in enumerate(scenes):
            assert min(vector.min() for vector in lists) >= -1.0
            found[:, column] = [np.square(vector - self.scenes[number]).sum() for vector in lists]
            self.asked += len(lists)
            if column + 1 < len(scenes) and stop():
                raise OutOfTimeError
        return found


def search(objective, starts, evaluations=1500, seed=0, **options):
    budget = SearchBudget(math.inf, evaluations)
    return Search(starts, RayAllowance(1), objective, budget, np.random.default_rng(seed), **options).run()


def test_a_search_finds_the_lowest_point_inside_the_constraints():
    objective = Distance([[0.5, 1.5, -3.0, 0.0]])
    found = search(objective, [Bowl([3.0, 3, 3, 3]), Bowl([0.0, 0, 0, 0])])
    np.testing.assert_allclose(np.maximum(found.vector, -1.0), [0.5, 1.5, -1.0, 0.0], atol=0.01)
    assert found.value == pytest.approx(4.0, abs=0.01)
    assert found.start_value == pytest.approx(11.5)


def test_a_search_begins_at_the_best_start_and_ends_no_worse():
    points = np.random.default_rng(4).normal(0, 2, (20, 4))
    for evaluations in (1, 40, 200, 1500):
        found = search(Distance(points), [Bowl([9.0] * 4), Bowl([1.0] * 4), Bowl([5.0] * 4)], evaluations)
        assert found.value <= found.start_value
        if evaluations >= 40:
            expected = np.square(points[: found.scenes] - 1.0).sum(axis=1).mean()
            assert found.start_value == pytest.approx(expected)


def test_a_search_asks_the_evaluations_that_it_counts_and_keeps_to_its_budget():
    objective = Distance(np.random.default_rng(1).normal(0, 1, (30, 4)))
    found = search(objective, [Bowl([2.0] * 4)], 3000)
    assert objective.asked == found.evaluations
    # one population may be on its way when the budget ends
    assert found.evaluations <= 3000 + 8 * 16
    assert found.scenes == 30


def test_the_best_score_that_is_shown_falls_as_long_as_the_scenes_are_the_same():
    shown = []
    found = search(Distance(np.random.default_rng(1).normal(0, 1, (30, 4))), [Bowl([2.0] * 4)], 3000, show=shown.append)
    # it may rise where the next stage sees more scenes: 8, 16, 30
    assert sum(later.best > one.best for one, later in itertools.pairwise(shown)) <= 2
    assert all(one.evaluations <= later.evaluations for one, later in itertools.pairwise(shown))
    assert all(0 <= one.share <= 1 for one in shown)
    assert shown[-1].evaluations <= found.evaluations


def test_a_search_ends_when_its_time_is_up_by_its_own_clock():
    now = itertools.count()
    objective = Distance(np.zeros((40, 4)))
    budget = SearchBudget(200.0, clock=lambda: float(next(now)))
    found = Search([Bowl([2.0] * 4)], RayAllowance(1), objective, budget, np.random.default_rng(0)).run()
    assert 100 < found.seconds <= 220


def test_a_search_that_has_converged_begins_anew():
    found = search(Distance([[0.2] * 4]), [Bowl([0.0] * 4)], 6000)
    assert found.restarts >= 1
    assert found.value < 1e-9


class AnyMissTask(MissTask):
    """Percent of rays without a return, of however few."""

    fewest_returns = 0


def sensors(count, space=FIXED):
    origin = np.array(space.low[:3])
    return tuple(
        Sensor(f"s{i}", 1 / count, origin, np.zeros((3, 3)), 0.3, 0.3, 0.0, 0.1, 0.1, 2.0, 0.3) for i in range(count)
    )


def track(count=3):
    knots = np.array([0.0, 0.5, 1.0])
    aimed = np.tile(np.linspace(-0.2, 0.2, count), (3, 1))
    gate = np.tile([2.0, 3.5], (3, count, 1))
    followed = Track("x_m", knots, np.zeros((3, count)), aimed, gate, np.arange(count))
    return DesignSpec("mine", sensors(count), layout="scan", rays=count, track=followed)


def chosen():
    """A design whose nine rays were chosen, each with a gate of its own."""
    points = np.column_stack([np.zeros((9, 3)), np.linspace(0.1, 0.5, 9), np.full(9, 0.3)])
    gates = np.linspace((1.5, 1.7), (1.9, 2.3), 9)
    table = rays_at(points, gates)
    return DesignSpec("mine", sensors(2), layout="selected", gates="ray", rays=9, ray_table=table)


def chosen_along():
    """The rays of a track that one sensor fires, as they are chosen along a condition."""
    of_each = track()
    of_one = replace(of_each.track, sensor=np.zeros(3, dtype=np.int64))
    return replace(of_each, sensors=sensors(1), layout="selected", gates="ray", track=of_one)


FOLLOWED = {
    "selected": (chosen(), FIXED, AHEAD),
    "grid": (DesignSpec("mine", sensors(2)), FIXED, AHEAD),
    "density": (DesignSpec("mine", sensors(2), layout="density"), FIXED, AHEAD),
    "scan": (DesignSpec("mine", sensors(6), layout="scan", rays=6), FIXED, AHEAD),
    "distributed": (DesignSpec("mine", sensors(2, CEILING), layout="distributed"), CEILING, BELOW),
    "track": (track(), AISLE, balls(np.array([3.0, 0, 0.1]), 0.3)),
    "chosen along": (chosen_along(), AISLE, balls(np.array([3.0, 0, 0.1]), 0.3)),
    "bounded": (DesignSpec("mine", sensors(2), constraints=RULES["gate"] | {"budget": {"rays": 9}}), FIXED, AHEAD),
}


def request_of(name, task=None, **changes):
    design, space, train = FOLLOWED[name]
    values = {
        "task": task or AnyMissTask(),
        "config": TaskConfig(),
        "space": space,
        "seed": 3,
        "designs": [design],
        "rays": [design.rays or 12],
        "baselines": ("bounding", "cma"),
        "train": train,
        "test": train,
        "equal_bandwidth": False,
        "cma": CmaSettings(FAST),
    }
    return EvaluationRequest(**{**values, **changes})


@each_row("name", [name for name in FOLLOWED if name != "density"])
def test_every_kind_of_design_is_followed_and_what_is_found_keeps_its_constraints(name):
    # rays of a density at another number follow from samples, which cma does without
    evaluation = evaluate(request_of(name))
    (record,) = evaluation.searches
    row = next(row for row in evaluation.rows if row.design == "cma")
    assert row.rays == record.rays == evaluation.rows[0].rays
    assert not record.broken
    followed = FOLLOWED[name][0]
    assert record.sensors == len(followed.sensors if followed.track is None else followed.track.sensor)
    # a ray of a track varies where it looks at both ends of its way
    assert followed.track is None or record.found.model.size == 2 * row.rays
    assert record.found.value <= record.found.start_value
    found = evaluation.as_dict()["cma"][0]
    assert found["evaluations"] <= 300 + 30
    assert found["satisfied"]
    assert any(note.startswith(f"cma at {row.rays} rays") for note in evaluation.notes)
    json.dumps(evaluation.as_dict()["cma"], allow_nan=False)


@pytest.mark.parametrize("task", [AnyMissTask(), HitTask()])
def test_the_search_gains_in_the_direction_of_the_metric_and_no_less_than_bounding(task):
    evaluation = evaluate(request_of("grid", task, cma=CmaSettings(SearchBudget(math.inf, 1500))))
    value = {row.design: row.value for row in evaluation.rows}
    sign = 1.0 if task.metric.better == "lower" else -1.0
    assert sign * value["cma"] < sign * value["bounding"]
    (record,) = evaluation.searches
    assert sign * record.found.value < sign * record.found.start_value


def candidate_of(name, settings=None):
    design, space, train = FOLLOWED[name]
    conditions = [{"x_m": 0.25}, {"x_m": 0.75}] if design.track is not None else [{}]
    objective = TrainingObjective(AnyMissTask(), AnyMissTask.metric, train, Planner(), 0)
    return CmaCandidate(
        design, space, conditions, TrainingViews(space, train), objective, settings or CmaSettings(FAST), 0
    )


@each_row("name", list(FOLLOWED))
def test_what_is_found_within_a_bandwidth_stays_within_it(name):
    source = candidate_of(name, CmaSettings(SearchBudget(math.inf, 60)))
    for limit in (0.02, 0.5):
        positions = source.positions_within([], limit, Bandwidth())
        assert mean_mbps(positions, Bandwidth()) <= limit * (1 + 1e-12)
        record = source.record_of(positions)
        assert record.limit_mbps == limit
        assert record.rays == len(positions[0])
        assert not record.broken


def test_every_number_of_rays_is_searched_once():
    begun = []
    settings = CmaSettings(FAST, lambda label, progress: begun.append(label))
    source = candidate_of("grid", settings)
    first = source.positions([], 12)
    count = len(begun)
    assert source.positions([], 12) is first
    assert len(begun) == count
    assert set(begun) == {"cma, 12 rays"}


def test_gates_that_cost_nothing_end_where_the_returns_do():
    source = candidate_of("grid")
    positions = source.positions([], 12)
    sensor, range_m = source.objective.returned(positions, range(3))
    gate = {index: positions[0].gate_m[positions[0].sensor == index][0] for index in np.unique(sensor)}
    for index, (start, end) in gate.items():
        own = range_m[sensor == index]
        assert start == pytest.approx(own.min(), rel=1e-5)
        assert end == pytest.approx(own.max(), rel=1e-5)
    assert np.ptp(whole_range(FIXED)) > 3 * max(end - start for start, end in gate.values())


def test_a_track_keeps_its_constraints_at_every_place():
    rules = {
        "gate": {"start_m": {"min": 1.0}, "width_m": {"min": 0.05, "max": 0.2}},
        "boresight": {"elevation_deg": {"min": -10, "max": 20}},
        "budget": {"bandwidth_mbps": 0.015},
    }
    count = 4
    start = [
        Sensor(f"s{i}", 1 / count, np.zeros(3), np.zeros((3, 3)), 0.0, elevation, 0.0, 0.0, 0.0, 1.75, 0.6)
        for i, elevation in enumerate(np.linspace(-0.3, 0.3, count))
    ]
    model = DesignModel(
        rules_of(AISLE, "scan", rules), start * 2, [{"x_m": x} for x in (0.0, 0.3, 1.0)], rules, ("x_m", 0, 1)
    )
    generator = np.random.default_rng(0)
    for step in (0.0, 1.0, 10.0):
        vector = step * generator.standard_normal(model.size)
        for design in model.designs(vector, RayAllowance(count)):
            checks = check_design(design_document(design), rules, AISLE)
            assert not [check for check in checks if not check.satisfied]
        for rays in model.positions(vector, RayAllowance(count)):
            assert np.degrees(rays.elevation_rad).min() >= -10 - 1e-9
            assert np.degrees(rays.elevation_rad).max() <= 20 + 1e-9
            assert rays.gate_m[:, 0].min() >= 1.0 - 1e-9
            assert np.ptp(rays.gate_m, axis=1).max() <= 0.2 + 1e-9
            assert mean_mbps((rays,), Bandwidth()) <= 0.015


def test_starts_on_returns_see_them_and_stay_in_the_space():
    setting = rules_of(FIXED, "grid", {}, gates=False)
    for start in starts(setting, TrainingViews(FIXED, AHEAD), 4):
        assert sum(sensor.weight for sensor in start) == pytest.approx(1.0)
        for sensor in start:
            assert sensor.gate_m == pytest.approx(tuple(whole_range(FIXED)))
            azimuth = (sensor.azimuth_rad + math.pi) % (2 * math.pi) - math.pi
            assert FIXED.low[AZIMUTH] <= azimuth <= FIXED.high[AZIMUTH]
            assert FIXED.low[ELEVATION] <= sensor.elevation_rad <= FIXED.high[ELEVATION]


def test_without_a_design_there_is_nothing_to_vary():
    with pytest.raises(ConfigError, match="no design"):
        evaluate(request_of("grid", designs=[], rays=[9]))


@pytest.mark.parametrize(
    ("seconds", "names"), [(0.0, ["cma"]), (math.nan, ["cma"]), (-1.0, ["cma"]), (5.0, ["occupancy"])]
)
def test_a_time_that_is_none_or_that_nothing_takes_is_refused(seconds, names):
    with pytest.raises(ConfigError, match="--cma-seconds"):
        ScoreOptions(cma_seconds=seconds, baselines=names)


def test_a_time_is_taken_where_it_is_asked_for_or_left_out():
    assert ScoreOptions(cma_seconds=5.0, baselines=["cma"]).cma_seconds == 5.0
    assert ScoreOptions().cma_seconds is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--cma-seconds", "5"], "there is no search"),
        (["--cma-seconds", "0", "--baseline", "cma"], "--cma-seconds"),
        (["--baseline", "cma:5"], "takes no value after its name"),
    ],
)
def test_the_command_refuses_it_before_anything_is_read(lidardesign, words, message):
    result = lidardesign("evaluate", "nowhere", *words)
    assert result.code == 2
    assert message in result.err


class Bar:
    """A progress bar that remembers what it was told."""

    def __init__(self):
        self.lines, self.updates = [], []

    def show(self, done, total, *, line, **fields):
        self.lines += [line] * (line not in self.lines)
        self.updates.append((line, {"share": done / total, **fields}))


def shown_settings(bar):
    request = SimpleNamespace(cma_seconds=FAST.seconds, run=SimpleNamespace(metric=AnyMissTask.metric))
    return CmaSettings(FAST, search_display(request, bar))


def test_each_search_has_a_line_that_shows_how_far_it_is_and_its_best_score():
    bar = Bar()
    settings = shown_settings(bar)
    candidate_of("grid", settings).positions([], 12)
    candidate_of("grid", settings).positions([], 13)
    assert bar.lines == ["cma, 12 rays", "cma, 13 rays"]
    shares = [fields["share"] for label, fields in bar.updates if label == "cma, 12 rays"]
    assert shares == sorted(shares)
    assert bar.updates[-1][1]["detail"].startswith("best ")
    assert bar.updates[-1][1]["detail"].endswith(" %")


def test_from_several_places_every_sensor_may_look_at_all_returns():
    setting = rules_of(CEILING, "grid", CEILING_PLACES["mounts"])
    views = TrainingViews(CEILING, BELOW)
    hits = views.hits(dense_points(CEILING)).hits_m
    first = starts(setting, views, 3)[0]
    assert len({tuple(sensor.origin_m) for sensor in first}) == 3
    for sensor in first:
        away = hits - sensor.origin_m
        tangent = tangent_coordinates(sensor.frame, away / np.linalg.norm(away, axis=1, keepdims=True))
        assert (np.abs(tangent) <= np.array(sensor.field_of_view_rad) / 2 * 1.2).all(axis=1).mean() > 0.95
        assert sensor.weight == pytest.approx(1 / 3)
