"""The soak in short: its plans cover what it promises, its bounds are kept or refused, some runs are whole."""

from __future__ import annotations

import dataclasses
import math
from itertools import product

import numpy as np
import pytest

from benchmarks.soak.limits import bounds_around, contradictions
from benchmarks.soak.plans import MOST_SENSORS, SIGMA_SHARES, SIZES_M, random_plan
from benchmarks.soak.runs import WHOLE, whole_run
from benchmarks.soak.scaled_flatland import NAME, ScaledFlatlandTask, offer
from lidardesign.config import resolve
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.errors import InfeasibleError
from lidardesign.run.yaml import dump_yaml
from lidardesign.space import DesignSpace
from lidardesign.task import load_task

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


def test_every_plan_is_a_valid_configuration(offered, tmp_path):
    for plan in PLANS[:60]:
        path = tmp_path / "asked.yaml"
        path.write_text(dump_yaml(plan.config))
        config = resolve(offered, config_file=path, preset="draft")
        assert len(config.space.free) == len(plan.free)
        assert config.density.sigma_m == pytest.approx(plan.sigma_share * plan.size_m)


def test_every_contradiction_is_refused():
    for plan in PLANS[:60]:
        space = DesignSpace.from_dict({"condition": (), **plan.config["space"]})
        for what, rules in contradictions(space, plan.sensors).items():
            with pytest.raises(InfeasibleError) as refused:
                check_feasible(Constraints.from_mapping(rules), space)
            assert refused.value.conflicts, what


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


def test_loose_bounds_around_a_design_are_kept_and_tight_ones_are_valid_files():
    design, space = hand_made(), DesignSpace((0, -1, 0, 0, -1, 0), (2, 1, 0, 3, 1, 2))
    for seed in range(30):
        generator = np.random.default_rng(seed)
        rules = bounds_around(design, space, generator, 1.0, is_moving=False)
        assert all(check.satisfied for check in check_design(design, rules, space)), rules
        tight = bounds_around(design, space, generator, generator.uniform(-1, 1), is_moving=False)
        assert Constraints.from_mapping(tight).as_document()


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
    assert record.counts["bounds read back"] > 0
    assert record.differences(whole_run(plan, tmp_path / "again")) == []
