"""Sensors that may fail: rays chosen for the loss of each, what is refused, and scores without each sensor."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.coverages import SUMS, small

from lidardesign.api.run import open_run
from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.estimates import worst_tenth
from lidardesign.rays.certificate import certify
from lidardesign.rays.choice import RayCounts, choose
from lidardesign.rays.coverage import LARGEST, LOSS_SHARE, MOST_LOSSES
from lidardesign.scoring.fired import without_each
from lidardesign.sensors.design_file import design_document, design_text

seeds = st.integers(0, 10_000)
NARROW = {"field_of_view": {"horizontal_deg": {"max": 20}}}


def fitted(made, notes=lambda note: None, **options):
    return open_run(made).fit(**{"sensors": 3, "rays": 32, "gates": "ray", "name": "d", "notes": notes, **options})


@pytest.mark.parametrize("table", [LARGEST, SUMS], ids=["largest", "sums"])
class TestTheTableOfLosses:
    @given(seed=seeds, sensors=st.integers(2, MOST_LOSSES))
    def test_counts_half_of_all_rays_and_half_of_the_mean_without_each_sensor(self, table, seed, sensors):
        coverage, generator = small(seed, table=table, harm=0.1), np.random.default_rng(seed)
        sensor = generator.integers(sensors, size=coverage.shape[0])
        gate = generator.integers(-1, coverage.shape[1], coverage.shape[0])
        left = [np.where(sensor == lost, -1, gate) for lost in range(sensors)]
        shared = coverage.with_losses(sensor, sensors)

        def expected(of):
            return (1 - LOSS_SHARE) * of(gate) + LOSS_SHARE * np.mean([of(one) for one in left])

        assert shared.value_of(gate) == pytest.approx(expected(coverage.value_of), rel=1e-9, abs=1e-12)
        harm = expected(lambda one: coverage.charge(one)[1])
        assert shared.charge(gate) == pytest.approx((coverage.charge(gate)[0], harm), abs=1e-12)

    @given(seed=seeds)
    def test_of_many_sensors_asks_every_item_about_a_few(self, table, seed):
        coverage = small(seed, table=table)
        shared = coverage.with_losses(np.arange(coverage.shape[0]), coverage.shape[0])
        assert len(shared.weight) == (MOST_LOSSES + 1) * len(coverage.weight)
        assert shared.weight.sum() == pytest.approx(coverage.weight.sum())
        assert shared.value_of(np.zeros(coverage.shape[0], dtype=int)) <= coverage.complete + 1e-12

    @given(seed=seeds)
    def test_has_a_certificate_that_no_choice_exceeds(self, table, seed):
        coverage, counts = small(seed, table=table, gates=1), RayCounts.of_one(7, 3)
        shared = coverage.with_losses(np.arange(7) % 2, 2)
        _, bound = certify(shared, counts, choose(shared, counts))
        for number in range(2**7):
            gate = np.array([(number >> ray & 1) - 1 for ray in range(7)])
            if np.count_nonzero(gate >= 0) <= 3:
                assert shared.value_of(gate) <= bound + 1e-9


class TestDesignsThatMayLoseASensor:
    def test_score_better_without_each_on_training_scenes_than_those_that_are_not_made_for_it(self, made):
        opened, means = open_run(made), []
        for survive in (0, 1):
            design = fitted(made, survive=survive)
            test = opened.scenes("train", 5)
            scores = []
            for left in without_each((design.rays(),), 3):
                scores += [opened.task.score(scene, scene_returns(scene, left[0])).value for scene in test]
            means.append(np.mean(scores))
        assert (means[1] < means[0]) == (opened.metric.better == "lower")

    def test_are_not_made_where_none_may_fail(self, made):
        plain, option, constraint = (
            design_text(fitted(made, **options).specification, made)
            for options in ({"constraints": {}}, {"constraints": {}, "survive": 0}, {"constraints": {"survive": 0}})
        )
        assert plain == option == constraint

    @pytest.mark.parametrize(
        "rules",
        [{}, {**NARROW, "gate": {"width_m": {"max": 0.5}}, "boresight": {"elevation_deg": {"max": 5}}}],
        ids=["free", "bounded"],
    )
    def test_keep_counts_fields_and_gates(self, made, rules):
        design = fitted(made, constraints=rules, survive=1)
        document, space = design_document(design.specification), open_run(made).config.space
        assert all(check.satisfied for check in check_design(document, Constraints.from_mapping(rules), space))
        assert len(design.rays()) == 32
        assert (design.specification.rays_per_sensor() > 0).all()

    def test_see_the_same_or_say_why_they_cannot(self, made):
        notes = []
        wide = fitted(made, notes.append, survive=1).specification
        assert not [note for note in notes if "lost with its sensor" in note]
        views = np.array([sensor.field_of_view_rad for sensor in wide.sensors])
        assert (views >= 0.5 * views.max(axis=0)).all()
        fitted(made, notes.append, survive=1, constraints=NARROW)
        assert [note for note in notes if "lost with its sensor" in note]

    def test_have_two_sensors_or_more_where_the_best_number_is_found(self, made):
        assert len(fitted(made, sensors="best", survive=1).specification.sensors) >= 2


class TestScoresWithoutEachSensor:
    def test_are_those_of_the_rays_that_are_left(self, lidardesign, made):
        open_run(made).fit(sensors=2, layout="even", name="even").save()
        words = ("--designs", "even", "--rays", 16, "--losses", "--json")
        row, *baselines = lidardesign("evaluate", made, *words).json["rows"]
        left = without_each((open_run(made).designs()[0].rays(16),), 2)
        opened = open_run(made)
        scenes = opened.scenes("test", opened.config.seed)
        scores = [[opened.task.score(scene, scene_returns(scene, one[0])).value for scene in scenes] for one in left]
        assert row["lost"] == pytest.approx(np.mean(scores, axis=1).tolist())
        assert row["worst_lost"] == (max if opened.metric.better == "lower" else min)(row["lost"])
        assert not any("lost" in one for one in baselines)

    def test_are_shown_for_designs_that_are_made_for_it_without_being_asked_for(self, lidardesign, made):
        assert lidardesign("fit", made, "--sensors", 2, "--rays", 16, "--survive", 1, "--name", "sure").code == 0
        printed = lidardesign("evaluate", made, "--designs", "sure", "--rays", 16)
        assert "worst" in printed.out

    @pytest.mark.parametrize(("better", "worst"), [("lower", 19.5), ("higher", 0.5)])
    def test_stand_beside_the_worst_tenth_of_scenes(self, better, worst):
        assert worst_tenth(np.random.default_rng(0).permutation(20.0 * np.arange(20) / 20), better) == pytest.approx(
            worst - (better == "lower")
        )


def scene_returns(scene, rays):
    from lidardesign.simulate.returns import simulate_many

    return list(next(iter(simulate_many(scene, [rays]))))
