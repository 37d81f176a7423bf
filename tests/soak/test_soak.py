"""The soak in short: its plans cover what it promises, its second reader finds what is broken, some runs are whole."""

from __future__ import annotations

import copy
import dataclasses
import math
from itertools import product

import numpy as np
import pytest
from support.tables import each_row

from lidardesign.config import resolve
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.errors import InfeasibleError
from lidardesign.registry import load_task
from lidardesign.run.yaml import dump_yaml
from lidardesign.space import DesignSpace
from soak.keeping import broken_bounds
from soak.limits import Bounds, contradictions, drawn, kept_already
from soak.plans import DIMENSIONS, MOST_SENSORS, SIGMA_SHARES, SIZES_M, random_plan
from soak.scaled_flatland import NAME, ScaledFlatlandTask, offer
from soak.whole_runs import WHOLE, whole_run

PLANS = [random_plan(seed) for seed in range(300)]
# Runs that are whole after a second of learning, one with chosen rays and one with even ones.
WHOLE_IN_SHORT = (15, 26)
SHORT = {"steps": 30, "batch": 64, "layers": 2, "hidden": 16, "bins": 8, "samples": 4000, "balance_proposals": 2048}


@pytest.fixture
def offered(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(offer(tmp_path / "offered"))
    return load_task(NAME)


def test_plans_cover_sizes_sigmas_dimensions_and_sensors_to_their_ends():
    for found, (low, high) in (
        ([math.log10(plan.size_m) for plan in PLANS], SIZES_M),
        ([math.log10(plan.sigma_share) for plan in PLANS], SIGMA_SHARES),
    ):
        tenths = np.histogram(found, bins=10, range=(low, high))[0]
        assert tenths.sum() == len(PLANS)
        assert (tenths > 0).all()
    assert {len(plan.free) for plan in PLANS} == set(range(1, 7))
    assert {plan.sensors for plan in PLANS} == set(range(1, MOST_SENSORS + 1))
    assert {plan.layout for plan in PLANS} == {"even", "chosen"}
    conditioned = [plan for plan in PLANS if "condition" in plan.config["space"]]
    assert {(plan.layout, plan.is_moving) for plan in conditioned} == set(product(("even", "chosen"), (True, False)))


def test_a_number_always_gives_the_same_plan():
    assert [random_plan(seed) for seed in range(20)] == PLANS[:20]


def test_every_plan_is_a_valid_configuration(offered, tmp_path):
    for plan in PLANS[:100]:
        path = tmp_path / "asked.yaml"
        path.write_text(dump_yaml(plan.config))
        config = resolve(offered, config_file=path, preset="draft")
        assert len(config.space.free) == len(plan.free)
        assert config.density.sigma_m == pytest.approx(plan.sigma_share * plan.size_m)


def test_every_contradiction_is_refused_and_blind_bounds_are_valid_files():
    for plan in PLANS[:60]:
        section = {"condition": (), **plan.config["space"]}
        space, bounds = DesignSpace.from_dict(section), Bounds.of(section)
        for what, rules in contradictions(bounds, plan.sensors).items():
            with pytest.raises(InfeasibleError) as refused:
                check_feasible(Constraints.from_mapping(rules), space)
            assert refused.value.conflicts, what
        rules = drawn(bounds, plan.sensors, np.random.default_rng(plan.seed))
        assert Constraints.from_mapping(rules).as_document()


def hand_made():
    """Two sensors that are told apart by everything that can be bounded."""
    sensors = [
        {
            "name": f"s{index}",
            "weight": 0.5,
            "origin_m": {"mean": [0.2 + index, 0.0, 0.0], "covariance": np.diag([0.01, 0.0025, 0.0]).tolist()},
            "boresight": {"azimuth_rad": 1.0 + index, "elevation_rad": 0.1 - 0.2 * index, "roll_rad": 0.0},
            "field_of_view_rad": {"horizontal": 0.4, "vertical": 0.2},
            "gate_m": {"start": 0.5, "end": 0.8 + 0.1 * index},
        }
        for index in range(2)
    ]
    return {"level": 0.95, "layout": "even", "sensors": sensors, "constraints": {"budget": {"rays": 20}}}


SPACE = dict(zip(DIMENSIONS, ([0, 2], [-1, 1], [0, 0], [0, 3], [-1, 1], [0, 2]), strict=True))
KEPT_AND_BROKEN = {
    "count": ({"sensors": {"count": 2}}, {"sensors": {"count": 3}}),
    "most sensors": ({"sensors": {"max": 2}}, {"sensors": {"max": 1}}),
    "gate start": ({"gate": {"start_m": {"min": 0.5}}}, {"gate": {"start_m": {"min": 0.51}}}),
    "gate end": ({"gate": {"end_m": {"max": 0.9}}}, {"gate": {"end_m": {"max": 0.89}}}),
    "gate width": ({"gate": {"width_m": {"max": 0.41}}}, {"gate": {"width_m": {"max": 0.39}}}),
    "field": ({"field_of_view": {"vertical_deg": {"max": 12}}}, {"field_of_view": {"vertical_deg": {"max": 11}}}),
    "elevation": ({"boresight": {"elevation_deg": {"max": 6}}}, {"boresight": {"elevation_deg": {"max": 5}}}),
    "azimuth": (
        {"boresight": {"azimuth_deg": {"min": 330.0, "max": 480.0}}},
        {"boresight": {"azimuth_deg": {"min": 330.0, "max": 460.0}}},
    ),
    "box": ({"origin": {"high_m": [1.2, 0, 0]}}, {"origin": {"high_m": [1.1, 0, 0]}}),
    "pinned": ({}, {"origin": {"fixed_m": [0.2, 0, 0]}}),
    "mounts": ({}, {"origin": {"mounts_m": [[0.2, 0, 0], [1.2, 0, 0]]}}),
    "spread": ({"origin": {"spread_m": {"max": 0.1}}}, {"origin": {"spread_m": {"max": 0.09}}}),
    "taken": (
        {"origin": {"exclude": [{"low_m": [0.5, -1, -1], "high_m": [0.9, 1, 1]}]}},
        {"origin": {"exclude": [{"low_m": [0.35, -1, -1], "high_m": [0.9, 1, 1]}]}},
    ),
    "rays": ({"budget": {"rays": 20}}, {"budget": {"rays": 19}}),
    # 0.3 and 0.4 m are 21 and 27 bins of 100 ps: 480 bins of 40 bits at 10 Hz
    "bandwidth": ({"budget": {"bandwidth_mbps": 0.192}}, {"budget": {"bandwidth_mbps": 0.191}}),
    "each": ({"each": [{"gate": {"end_m": {"max": 0.8}}}]}, {"each": [{}, {"gate": {"end_m": {"max": 0.8}}}]}),
}


@each_row("name", KEPT_AND_BROKEN)
def test_the_second_reader_tells_kept_from_broken_bounds_as_the_program_does(name):
    kept, broken = KEPT_AND_BROKEN[name]
    design = hand_made()
    assert broken_bounds(design, kept, SPACE) == []
    assert all(check.satisfied for check in check_design(design, kept, SPACE))
    assert broken_bounds(design, broken, SPACE)
    assert not all(check.satisfied for check in check_design(design, broken, SPACE))


def test_the_second_reader_looks_at_every_ray_and_at_the_design_space():
    design = hand_made()
    pattern = {"gate_start_m": [[0.5, 0.5]] * 2, "gate_end_m": [[0.7, 0.9], [0.7, 0.9]], "sensor": [0, 1]}
    # 0.2 and 0.4 m are 14 and 27 bins of 100 ps: 41 bins of 40 bits at 10 Hz
    limit = {"gate": {"end_m": {"max": 0.9}}, "budget": {"rays": 2, "bandwidth_mbps": 0.0164}}
    assert broken_bounds({**design, "patterns": [pattern]}, limit, SPACE) == []
    pattern["gate_end_m"][1][1] = 0.92
    broken = broken_bounds({**design, "patterns": [pattern]}, limit, SPACE)
    assert [line.split(" ")[0] for line in broken] == ["budget.bandwidth_mbps", "sensor"]
    away = copy.deepcopy(design)
    away["sensors"][1]["origin_m"]["mean"][0] = 2.1
    assert broken_bounds(away, {}, SPACE)


def test_bounds_around_a_design_are_bounds_that_it_keeps():
    design, bounds = hand_made(), Bounds.of(SPACE)
    for seed in range(30):
        rules = kept_already(design, bounds, np.random.default_rng(seed))
        assert broken_bounds(design, rules, SPACE) == [], rules


def test_scaled_flatland_is_flatland_grown_and_moved():
    task = ScaledFlatlandTask()
    home = task.Config(train=1, test=1, scene="occluded")
    away = task.Config(train=1, test=1, scene="occluded", size_m=1000.0, offset_m=(5.0, -7.0, 3.0))
    (at_home,), (moved,) = task.scenes(home, "test", 3), task.scenes(away, "test", 3)
    for one, other in zip(at_home.bodies, moved.bodies, strict=True):
        assert other.shape.radius_m == pytest.approx(1000 * one.shape.radius_m)
        expected = 1000 * one.pose()[:3, 3] + np.array([5.0, -7.0, 3.0])
        np.testing.assert_allclose(other.pose()[:3, 3], expected)
    np.testing.assert_allclose(moved.truth["curve_m"], at_home.truth["curve_m"])


@pytest.mark.slow
@pytest.mark.parametrize("seed", WHOLE_IN_SHORT)
def test_random_runs_are_whole_and_repeat_to_the_byte(offered, tmp_path, seed):
    plan = random_plan(seed)
    plan = dataclasses.replace(plan, config={**plan.config, "learning": SHORT})
    record = whole_run(plan, tmp_path / "run")
    assert record.faults == []
    assert record.outcome == WHOLE
    assert record.bounds > 0
    assert record.differences(whole_run(plan, tmp_path / "again")) == []
