"""Sweeps of effects and of held-out scenes: their errors are what the program itself would show."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.evaluations import METRIC
from support.references import STANDARD_ERRORS
from support.scoring import design, make_request, scenes

from lidardesign.evaluation.accuracy import evaluation as sweeps
from lidardesign.evaluation.accuracy.probes import AccuracyRequest
from lidardesign.evaluation.results import Evaluation, Row
from lidardesign.evaluation.score import evaluate
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.plan import Planner
from lidardesign.space import DesignSpace


def make_row(name, values, baseline=False, rays=9):
    values = np.asarray(values, dtype=np.float64)
    return Row(name, rays, values.mean(), 0.0, 1.0, 0, 1.0, 2.0 + baseline, values, baseline)


def of_scores(own, baseline, tmp_path):
    evaluation = Evaluation(METRIC, len(own), [make_row("own", own), make_row("bounding", baseline, True)], [])
    return AccuracyRequest(None, tmp_path, make_request(), evaluation)


def test_half_widths_fall_with_the_root_of_the_number_of_scenes(tmp_path):
    generator = np.random.default_rng(3)
    own, baseline = generator.normal(0, 3, 400), np.zeros(400)
    (sweep,) = sweeps.scenes_sweeps(of_scores(own, baseline, tmp_path))
    assert [measurement.setting for measurement in sweep.measurements] == ["5", "10", "20", "50", "100", "200", "400"]
    for measurement in sweep.measurements[2:]:
        closed_form = 1.96 * 3 / math.sqrt(int(measurement.setting))
        # Student's t of n scenes is wider by about 1.2 / n, and sets of scenes are skewed by chance
        allowed = STANDARD_ERRORS * measurement.uncertainty + closed_form * (0.03 + 2 / int(measurement.setting))
        assert measurement.error == pytest.approx(closed_form, abs=allowed)
        assert measurement.seconds == pytest.approx((2.0 + 3.0) * int(measurement.setting) / 400)
    assert sweep.falls
    assert sweep.default is sweep.measurements[-1]


def test_the_number_of_scenes_that_the_tolerance_takes_is_said(tmp_path):
    generator = np.random.default_rng(3)
    (sweep,) = sweeps.scenes_sweeps(of_scores(generator.normal(0, 3, 40), np.zeros(40), tmp_path))
    needed = int(sweep.note.split(" ")[0].replace(",", ""))
    assert needed == math.ceil(40 * (sweep.measurements[-1].error / METRIC.tolerance) ** 2)
    (sure,) = sweeps.scenes_sweeps(of_scores(generator.normal(0, 1e-3, 40), np.zeros(40), tmp_path))
    assert sure.note == ""
    assert sure.chosen.setting == "5"


def test_equal_differences_leave_no_width_and_one_scene_no_sweep(tmp_path):
    (sweep,) = sweeps.scenes_sweeps(of_scores(np.ones(12), np.zeros(12), tmp_path))
    assert [(measurement.error, measurement.uncertainty) for measurement in sweep.measurements] == [(0.0, 0.0)] * 3
    assert sweeps.scenes_sweeps(of_scores([1.0], [0.0], tmp_path)) == []
    alone = Evaluation(METRIC, 2, [make_row("own", [1.0, 2.0])], [])
    assert sweeps.scenes_sweeps(AccuracyRequest(None, tmp_path, make_request(), alone)) == []


def test_the_spread_of_normal_values_is_known_to_the_textbook_error():
    values = np.random.default_rng(5).normal(size=200_000)
    assert sweeps.relative_error_of_spread(values) == pytest.approx(1 / math.sqrt(2 * len(values)), rel=0.05)
    assert sweeps.relative_error_of_spread(np.ones(3)) == 0


def of_light(detector, choice="auto", **changes):
    measuring = load_detector(detector)
    request = make_request([design("aimed")], planner=Planner(measuring, choice), test=scenes(7, 4), **changes)
    return AccuracyRequest(None, None, request, None)


def scored(request, effects):
    """What an evaluation gives the design per scene under effects that are named."""
    planner = replace(request.planner, choice=frozenset(effects))
    count = max(request.rays)
    found = evaluate(replace(request, planner=planner, rays=(count,), baselines=()))
    return next(row.per_scene for row in found.rows if row.design == "aimed")


def with_footprint(request, count):
    """Scores per scene of beams of so many rays, without any other effect."""
    planner = replace(request.planner, detector=replace(request.planner.detector, footprint_rays=count))
    return scored(replace(request, planner=planner), ["footprint"])


def test_changes_of_effects_are_those_of_evaluations_under_them():
    asked = of_light("single-photon")
    sweep = next(one for one in sweeps.physics_sweeps(asked) if one.knob == "effects")
    found = {measurement.setting: measurement for measurement in sweep.measurements}
    there = [name.removeprefix("without ") for name in found if name.startswith("without")]
    assert {"footprint", "photon_noise", "jitter", "quantisation"} <= set(there)
    full, none = scored(asked.request, there), scored(asked.request, ())
    assert found["none"].error == pytest.approx(abs((none - full).mean()))
    left = scored(asked.request, [name for name in there if name != "footprint"])
    alone, values = scored(asked.request, ["footprint"]), found["without footprint"].values
    assert values["change_left_out"] == pytest.approx(abs((left - full).mean()))
    assert values["change_alone"] == pytest.approx(abs((alone - none).mean()))
    assert found["without footprint"].error == max(values["change_left_out"], values["change_alone"])
    assert sweep.measurements[-1].setting == "all"
    assert sweep.measurements[-1].reference
    assert sweep.tolerance == pytest.approx(asked.request.metric.tolerance / len(there))


def test_the_settings_that_the_evaluation_has_are_marked():
    footprint, effects = sweeps.physics_sweeps(of_light("single-photon"))
    assert footprint.default.setting == "7"
    assert effects.default is not None
    _, nothing = sweeps.physics_sweeps(of_light("single-photon", "none"))
    assert nothing.default.setting == "none"


def test_where_the_detector_asks_for_nothing_another_one_stands_in_and_no_setting_is_the_runs():
    for sweep in sweeps.physics_sweeps(of_light("ideal")):
        assert "single-photon" in sweep.note
        assert sweep.default is None


def test_the_finest_footprint_is_the_reference_and_bounded_by_what_it_takes(monkeypatch):
    footprint, _ = sweeps.physics_sweeps(of_light("single-photon"))
    assert [measurement.setting for measurement in footprint.measurements] == ["1", "4", "7", "16", "64", "256"]
    assert footprint.measurements[-1].reference
    assert footprint.measurements[-1].error == 0
    single, finest = (with_footprint(of_light("single-photon").request, count) for count in (1, 256))
    assert footprint.measurements[0].error == pytest.approx(np.abs(single - finest).mean())
    monkeypatch.setattr(sweeps, "MOST_THIN_RAYS", 20 * 25 * 4)
    footprint, _ = sweeps.physics_sweeps(of_light("single-photon"))
    assert [measurement.setting for measurement in footprint.measurements] == ["1", "4", "7", "16"]


def test_gates_beyond_what_the_stand_in_hears_have_no_sweeps():
    far = make_request([design("far", range_m=18.0)], space=DesignSpace((0,) * 6, (0, 0, 0, 0.5, 0.5, 40.0)))
    assert sweeps.physics_sweeps(AccuracyRequest(None, None, far, None)) == []


def test_a_single_scene_says_that_its_uncertainty_is_unknown_and_without_designs_nothing_is_measured():
    asked = of_light("single-photon")
    alone, empty = (
        replace(asked, request=replace(asked.request, **changes))
        for changes in ({"test": asked.request.test[:1]}, {"designs": []})
    )
    assert all("in 1 scene" in sweep.note for sweep in sweeps.physics_sweeps(alone))
    assert sweeps.physics_sweeps(empty) == []
