"""Direct optimisation as a baseline: it starts at the design, keeps constraints, and is never worse in its scenes."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.baselines import balls
from support.scoring import HitTask, MissTask, entries_of, make_request
from support.sensors import normal_sensor

from lidardesign.api.scores import score_choices
from lidardesign.cli.commands.evaluate import search_display
from lidardesign.errors import ConfigError
from lidardesign.evaluation.score import evaluate
from lidardesign.methods import cma
from lidardesign.methods.cma import CmaSearch, CmaSettings, MovableSensors
from lidardesign.methods.laid_out import rays_at
from lidardesign.numerics import wrap_angle
from lidardesign.parts.catalogue import Pose, find_part, part_design
from lidardesign.scoring.scene_scores import TrainingScorer
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern, even_rays
from lidardesign.simulate.plan import Planner
from lidardesign.space import DesignSpace, angles

FIXED = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
FREE = DesignSpace((-0.2, -0.2, -0.2, -0.6, -0.5, 0.05), (0.2, 0.2, 0.2, 0.6, 0.5, 4.0))
FLAT = DesignSpace((0, 0, 0.3, -0.5, 0.2, 0.05), (0, 0, 0.3, 0.5, 0.2, 4.0))
AISLE = DesignSpace(
    (0.0, 0, 0, 0.0, -0.5, 0.05), (1.0, 0, 0, 0.0, 0.5, 4.0), condition=("x_m",), measure="angles"
)  # fmt: skip
AHEAD = balls(np.array([3.0, 0, 0]))
FAST = CmaSettings(math.inf, evaluations=300)


class AnyMissTask(MissTask):
    """Percent of rays without a return, of however few."""

    fewest_returns = 0


def sensors(count, space=FIXED, azimuth=0.1, elevation=-0.1, spread=(0.03, 0.02), roll=0.3, apart=(0.0, 0.0)):
    origin = (np.array(space.low[:3]) + space.high[:3]) / 2
    return tuple(
        normal_sensor(
            f"s{i}", 1 / count, origin, azimuth + i * apart[0], elevation + i * apart[1], roll, spread, 2.7, 0.3
        )
        for i in range(count)
    )


def along(sensor):
    """Three rays along an aisle, of these sensors."""
    elevation = np.tile([-0.2, 0.0, 0.2], (3, 1))
    columns = np.zeros((3, 3, 3)), np.zeros((3, 3)), elevation, np.tile([2.0, 3.5], (3, 3, 1))
    knots = (0.0, 0.5, 1.0)
    columns[0][..., 0] = np.array(knots)[:, None]
    pattern = Pattern(*columns, np.array(sensor), "x_m", knots)
    count = max(sensor) + 1
    aimed = sensors(count, AISLE, 0.0, -0.2 if count > 1 else 0.0, apart=(0.0, 0.2))
    return DesignSpec("mine", aimed, "chosen", (pattern,))


def chosen():
    """A design whose nine rays were chosen, each with a gate of its own."""
    points = np.column_stack([np.zeros((9, 3)), np.linspace(0.1, 0.3, 9), np.full(9, -0.2)])
    rays = replace(rays_at(points, np.linspace((1.5, 1.7), (1.9, 2.3), 9)), sensor=np.arange(9) % 2)
    return DesignSpec("mine", sensors(2, azimuth=0.2), "chosen", (Pattern.of(rays),))


def ray_per_sensor():
    each = sensors(6, apart=(0.02, 0.0))
    return DesignSpec("mine", each, "chosen", (Pattern.of(even_rays(each, [1] * 6)),))


FOLLOWED = {
    "chosen": (chosen(), FIXED),
    "even": (DesignSpec("mine", sensors(2)), FIXED),
    "a ray per sensor": (ray_per_sensor(), FIXED),
    "free": (DesignSpec("mine", sensors(2, FREE)), FREE),
    "plane": (DesignSpec("mine", sensors(2, FLAT, elevation=0.2, spread=(0.1, 0.0), roll=0.0)), FLAT),
    "along": (along([0, 0, 0]), AISLE),
    "along, a ray per sensor": (along([0, 1, 2]), AISLE),
    "part": (part_design(find_part("vl53l5cx"), Pose(np.zeros(3), 0.3, -0.1, 0.2), 9, name="mine"), FIXED),
}
RAY_PER_SENSOR = ("a ray per sensor", "along, a ray per sensor")


def conditions_of(design):
    return [{"x_m": 0.25}, {"x_m": 0.75}] if design.condition else [{}]


def movable(name, rules=None):
    design, space = FOLLOWED[name]
    design = replace(design, constraints=rules or {})
    start = tuple(design.rays(design.count or 12, at or None) for at in conditions_of(design))
    return MovableSensors(design, start, space.at({"x_m": 0.5}) if space.conditioned else space, Bandwidth())


def vectors(model, steps):
    """Random vectors, the larger ones cut to the bounds, as the search has them."""
    generator, (low, high) = np.random.default_rng(5), model.vector_bounds
    for step in steps:
        yield np.clip(step * generator.standard_normal(len(low)), low, high)


@pytest.mark.parametrize("name", list(FOLLOWED))
def test_the_vector_zero_is_the_design_and_rays_move_little_by_little(name):
    model = movable(name)
    low, high = model.vector_bounds
    assert len(low) > 1
    assert ((low <= 0) & (high >= 0) & (low < high)).all()
    assert model.rays(np.zeros(len(low))) is model.start
    assert model.excess(model.start) == 0.0
    near, far = (model.rays(np.clip(np.full(len(low), step), low, high)) for step in (1e-7, 1.0))
    for one, other, start in zip(near, far, model.start, strict=True):
        for key in ("origin_m", "direction", "gate_m"):
            np.testing.assert_allclose(getattr(one, key), getattr(start, key), atol=1e-6)
        assert np.abs(other.direction - start.direction).max() > 1e-3
        assert (other.sensor == start.sensor).all()


RULES = {
    "gate": {"gate": {"start_m": {"min": 1.0}, "end_m": {"max": 2.9}, "width_m": {"min": 0.1, "max": 1.6}}},
    "field": {"field_of_view": {"horizontal_deg": {"min": 4, "max": 9}, "vertical_deg": {"min": 1, "max": 6}}},
    "boresight": {"boresight": {"azimuth_deg": {"min": -8, "max": 14}, "elevation_deg": {"min": -20, "max": 14}}},
    "box": {"origin": {"low_m": [-0.1, -0.05, -0.2], "high_m": [0.2, 0.05, 1.0]}},
    "mounts": {"origin": {"mounts_m": [[0, 0, 0], [0.1, 0, 0]]}},
    "exclude": {"origin": {"exclude": [{"low_m": [0.1, 0.1, 0.1], "high_m": [0.2, 0.2, 0.2]}]}},
}


@pytest.mark.parametrize(("name", "rules"), [*itertools.product(("free", "chosen", *RAY_PER_SENSOR), RULES)])
def test_however_far_a_vector_is_rays_keep_the_constraints(name, rules):
    asked, (_, space) = RULES[rules], FOLLOWED[name]
    model = movable(name, asked)
    for rays in (rays for vector in vectors(model, (0.5, 4.0, 400.0)) for rays in model.rays(vector)):
        assert (rays.origin_m >= np.array(space.low[:3]) - 1e-9).all()
        assert (rays.origin_m <= np.array(space.high[:3]) + 1e-9).all()
        assert space.low[5] - 1e-9 <= rays.gate_m.min() <= rays.gate_m.max() <= space.high[5] + 1e-9
        width = np.ptp(rays.gate_m, axis=1)
        azimuth, elevation = np.degrees(wrap_angle(np.array(angles(rays.direction))))
        if rules == "gate":
            assert 1.0 - 1e-9 <= rays.gate_m.min() < rays.gate_m.max() <= 2.9 + 1e-9
            assert 0.1 - 1e-9 <= width.min() <= width.max() <= 1.6 + 1e-9
        if rules in ("mounts", "exclude"):
            assert (rays.origin_m[:, 1:] == model.start[0].origin_m[:, 1:]).all()
        if rules == "box":
            assert np.abs(rays.origin_m[:, 1]).max() <= 0.05 + 1e-9
        for index in np.unique(rays.sensor) if name == "free" else ():
            own = rays.direction[rays.sensor == index]
            wide = np.degrees(np.arccos(np.clip(own @ own.T, -1, 1)).max())
            aimed, raised = (wrap_angle(angle) for angle in angles(own.mean(axis=0)))
            assert rules != "field" or wide <= math.hypot(9, 6) + 1e-6
            assert rules != "boresight" or (-8 <= math.degrees(aimed) <= 14 and -20 <= math.degrees(raised) <= 14)
        if rules == "boresight" and name in RAY_PER_SENSOR:
            assert -8 - 1e-9 <= azimuth.min() <= azimuth.max() <= 14 + 1e-9
            assert -20 - 1e-9 <= elevation.min() <= elevation.max() <= 14 + 1e-9


def test_where_elevations_are_fixed_rays_keep_theirs():
    model = movable("plane")
    for vector in vectors(model, (0.5, 4.0, 400.0)):
        (rays,) = model.rays(vector)
        np.testing.assert_allclose(angles(rays.direction)[1], angles(model.start[0].direction)[1], atol=1e-9)


def test_of_a_real_part_the_pose_alone_is_varied():
    model = movable("part")
    for vector in vectors(model, (0.5, 4.0)):
        (rays,) = model.rays(vector)
        (start,) = model.start
        np.testing.assert_allclose(rays.direction @ rays.direction.T, start.direction @ start.direction.T, atol=1e-9)
        assert (rays.gate_m == start.gate_m).all()


def test_wider_gates_take_more_bandwidth_than_the_design_has():
    model = movable("even")
    fired = [model.rays(vector) for vector in vectors(model, (0.5, 1.0, 2.0, 4.0))]
    excess, spent = [model.excess(rays) for rays in fired], [mean_mbps(rays, Bandwidth()) for rays in fired]
    limit = mean_mbps(model.start, Bandwidth())
    assert [one > 0 for one in excess] == [one > limit * (1 + 1e-9) for one in spent]
    assert max(excess) > 0


def request_of(name, task=None, **changes):
    design, space = FOLLOWED[name]
    values = {
        "task": task or AnyMissTask(),
        "space": space,
        "rays": [design.count or 12],
        "baselines": ("bounding", "cma"),
        "train": AHEAD,
        "test": AHEAD,
        "settings": {"cma": FAST},
    }
    return make_request([design], **{**values, **changes})


@pytest.mark.parametrize("name", list(FOLLOWED))
def test_every_kind_of_design_is_followed_to_no_worse_a_score_in_no_more_bandwidth(name):
    evaluation = evaluate(request_of(name))
    (record,) = evaluation.searches
    mine, found = (next(row for row in evaluation.rows if row.design == one) for one in ("mine", "cma"))
    assert found.rays == record.rays == mine.rays
    assert found.bandwidth_mbps <= mine.bandwidth_mbps * (1 + 1e-9)
    assert found.value == pytest.approx(record.value)
    assert mine.value == pytest.approx(record.start_value)
    assert record.value <= record.start_value
    (same,) = (row for row in evaluation.equal_bandwidth if row.design == "cma")
    assert (same.rays, same.value) == (found.rays, found.value)
    # a population may be on its way when the number is reached
    assert 1 < record.candidates < 300 / len(AHEAD) + 20
    assert [note for note in evaluation.notes if note.startswith(f"cma at {found.rays} rays")]
    json.dumps(evaluation.as_dict()["cma"], allow_nan=False)


@pytest.mark.parametrize("task", [AnyMissTask(), HitTask()])
def test_the_search_gains_in_the_direction_of_the_metric(task):
    (record,) = evaluate(request_of("even", task, settings={"cma": CmaSettings(math.inf, 1500)})).searches
    sign = 1.0 if task.metric.better == "lower" else -1.0
    assert sign * record.value < sign * record.start_value - 10


@pytest.mark.parametrize("name", ["along", "along, a ray per sensor"])
def test_along_a_condition_rays_stay_where_the_condition_is(name):
    task = AnyMissTask()
    task.conditions = lambda config: [{"x_m": 0.25}, {"x_m": 0.75}]
    found = next(entry for entry in entries_of(request_of(name, task)) if entry.name == "cma")
    assert found.search.value < found.search.start_value
    assert [np.unique(rays.origin_m[:, 0]).tolist() for rays in found.positions] == [[0.25], [0.75]]


def test_a_design_that_does_not_fire_a_number_of_rays_is_not_followed_there():
    other = replace(FOLLOWED["even"][0], name="other")
    request = request_of("chosen", rays=[9, 12])
    evaluation = evaluate(replace(request, designs=[*request.designs, other]))
    assert {row.rays for row in evaluation.rows if row.design == "cma"} == {9}


def candidate_of(name, settings=FAST, seed=0, scenes=AHEAD):
    design, space = FOLLOWED[name]
    model = movable(name)
    scorer = TrainingScorer(AnyMissTask(), AnyMissTask.metric, 0, scenes, Planner(), keeps_casters=True)
    return CmaSearch(design, {12: model.start}, space, None, scorer, settings, seed, Bandwidth())


def test_the_same_seed_and_number_of_evaluations_give_the_same_bytes():
    first, again, other = (candidate_of("free", seed=seed).positions(12)[0] for seed in (1, 1, 2))
    for key in ("origin_m", "direction", "gate_m"):
        assert getattr(first, key).tobytes() == getattr(again, key).tobytes()
    assert first.direction.tobytes() != other.direction.tobytes()


def test_a_search_ends_when_its_time_is_up(monkeypatch):
    now = itertools.count()
    monkeypatch.setattr(cma, "time", SimpleNamespace(perf_counter=lambda: float(next(now))))
    candidate = candidate_of("even", CmaSettings(60.0))
    candidate.positions(12)
    _, record = candidate.searches[12]
    assert 60 <= record.seconds <= 70
    assert record.candidates > 1


def test_where_nothing_is_gained_the_design_itself_is_the_answer():
    candidate = candidate_of("even", scenes=balls(np.array([-3.0, 0, 0])))
    assert candidate.positions(12) is candidate.starts[12]


def test_without_a_design_there_is_nothing_to_vary():
    with pytest.raises(ConfigError, match="no design"):
        evaluate(replace(request_of("even"), designs=[], rays=[9]))


@pytest.mark.parametrize(("seconds", "names"), [(0.0, ["cma"]), (math.nan, ["cma"]), (5.0, ["occupancy"])])
def test_a_time_that_is_none_or_that_nothing_takes_is_refused(seconds, names):
    with pytest.raises(ConfigError, match="--cma-seconds"):
        score_choices({"cma_seconds": seconds, "baselines": names})


def test_each_search_has_a_line_that_shows_how_far_it_is_and_its_best_score():
    shown = []
    bar = SimpleNamespace(show=lambda done, total, **fields: shown.append((done / total, fields)))
    request = SimpleNamespace(cma_seconds=60.0, run=SimpleNamespace(metric=AnyMissTask.metric))
    candidate_of("even", replace(FAST, show=search_display(request, bar))).positions(12)
    shares, fields = zip(*shown, strict=True)
    assert list(shares) == sorted(shares)
    assert {one["line"] for one in fields} == {"cma, 12 rays"}
    assert fields[-1]["detail"].startswith("best ")
