"""Sweeps of the fit, of effects and of held-out scenes: their errors are what the program itself would show."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.references import STANDARD_ERRORS
from support.scoring import design, make_request, scenes

from lidardesign.evaluate.accuracy import held_out, mixture, physics
from lidardesign.evaluate.accuracy.probes import AccuracyRequest
from lidardesign.evaluate.results import Evaluation, Row
from lidardesign.evaluate.score import evaluate
from lidardesign.samples import Samples
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.plan import Planner
from lidardesign.space import DesignSpace
from lidardesign.task import Metric

METRIC = Metric("Chamfer distance", "mm", "lower", worst=200.0, tolerance=0.1)


def make_row(name, values, baseline=False, rays=9):
    values = np.asarray(values, dtype=np.float64)
    return Row(name, rays, values.mean(), 0.0, 1.0, 0, 1.0, 2.0 + baseline, values, baseline)


def of_scores(own, rival, tmp_path):
    evaluation = Evaluation(METRIC, len(own), [make_row("own", own), make_row("bounding", rival, True)], [])
    return AccuracyRequest(None, tmp_path, make_request(), evaluation)


def test_half_widths_fall_with_the_root_of_the_number_of_scenes(tmp_path):
    generator = np.random.default_rng(3)
    own, rival = generator.normal(0, 3, 400), np.zeros(400)
    (sweep,) = held_out.sweeps(of_scores(own, rival, tmp_path))
    assert [measurement.setting for measurement in sweep.measurements] == ["5", "10", "20", "50", "100", "200", "400"]
    for measurement in sweep.measurements[2:]:
        closed_form = 1.96 * 3 / math.sqrt(int(measurement.setting))
        # resamples of n scenes spread by (n - 1) / n less, and a thousand of them know their ends to 3 %
        allowed = STANDARD_ERRORS * measurement.uncertainty + closed_form * (0.03 + 1 / int(measurement.setting))
        assert measurement.error == pytest.approx(closed_form, abs=allowed)
        assert measurement.seconds == pytest.approx((2.0 + 3.0) * int(measurement.setting) / 400)
    assert sweep.falls
    assert sweep.default is sweep.measurements[-1]


def test_the_number_of_scenes_that_the_tolerance_takes_is_said(tmp_path):
    generator = np.random.default_rng(3)
    (sweep,) = held_out.sweeps(of_scores(generator.normal(0, 3, 40), np.zeros(40), tmp_path))
    needed = int(sweep.note.split(" ")[0].replace(",", ""))
    assert needed == math.ceil(40 * (sweep.measurements[-1].error / METRIC.tolerance) ** 2)
    (sure,) = held_out.sweeps(of_scores(generator.normal(0, 1e-3, 40), np.zeros(40), tmp_path))
    assert sure.note == ""
    assert sure.chosen.setting == "5"


def test_equal_differences_leave_no_width_and_one_scene_no_sweep(tmp_path):
    (sweep,) = held_out.sweeps(of_scores(np.ones(12), np.zeros(12), tmp_path))
    assert [(measurement.error, measurement.uncertainty) for measurement in sweep.measurements] == [(0.0, 0.0)] * 3
    assert held_out.sweeps(of_scores([1.0], [0.0], tmp_path)) == []
    alone = Evaluation(METRIC, 2, [make_row("own", [1.0, 2.0])], [])
    assert held_out.sweeps(AccuracyRequest(None, tmp_path, make_request(), alone)) == []


def test_the_spread_of_normal_values_is_known_to_the_textbook_error():
    values = np.random.default_rng(5).normal(size=200_000)
    assert held_out.relative_error_of_spread(values) == pytest.approx(1 / math.sqrt(2 * len(values)), rel=0.05)
    assert held_out.relative_error_of_spread(np.ones(3)) == 0


SPACE = DesignSpace((0, 0, 0, -0.8, -0.5, 0.05), (0, 0, 0, 0.8, 0.5, 4.0))


def two_lumps(count=3000, seed=1):
    """Samples of two sensors that are far apart."""
    generator = np.random.default_rng(seed)
    points = np.zeros((count, 6))
    side = generator.integers(0, 2, count)
    points[:, 3] = generator.normal(np.where(side, 0.4, -0.4), 0.05)
    points[:, 4] = generator.normal(0, 0.05, count)
    points[:, 5] = generator.normal(np.where(side, 1.0, 3.0), 0.1)
    return Samples(points, np.zeros(count), np.zeros(count), SPACE)


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(mixture, "SAMPLE_COUNTS", (100, 400))
    monkeypatch.setattr(mixture, "RESTART_COUNTS", (1, 12))
    monkeypatch.setattr(mixture, "REPEATS", 3)
    monkeypatch.setattr(mixture, "MORE_REPEATS", {})


def of_fit(tmp_path, sensors=2, **changes):
    one = design()
    fitted = replace(one, sensors=tuple(replace(one.sensors[0], name=f"s{i}") for i in range(sensors)), **changes)
    request = make_request([fitted], samples={fitted.name: two_lumps()}, space=SPACE)
    return AccuracyRequest(None, tmp_path, request, None)


def test_more_samples_lose_less_likelihood_and_the_best_fit_loses_nothing(short, tmp_path):
    samples, seeds = mixture.sweeps(of_fit(tmp_path))
    assert [measurement.setting for measurement in samples.measurements] == ["100", "400", "2,000"]
    assert samples.default.setting == "2,000"
    assert [measurement.setting for measurement in seeds.measurements] == ["1", "12"]
    assert seeds.default.setting == "12"
    assert all(measurement.error >= 0 for measurement in (*samples.measurements, *seeds.measurements))
    assert samples.falls
    # of n samples, a fit with p parameters loses p / 2n (Akaike 1974); these two sensors have 13
    assert samples.measurements[0].error == pytest.approx(13 / 200, rel=0.6)
    assert samples.measurements[0].error > 3 * samples.measurements[-1].error


def test_one_sensor_has_no_sweep_of_seeds_and_scans_have_none(short, tmp_path):
    assert [sweep.knob for sweep in mixture.sweeps(of_fit(tmp_path, sensors=1))] == ["samples of the fit"]
    assert mixture.sweeps(of_fit(tmp_path, layout="scan")) == []
    without = of_fit(tmp_path)
    assert mixture.sweeps(replace(without, request=replace(without.request, samples={}))) == []


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
    sweep = next(one for one in physics.sweeps(asked) if one.knob == "effects")
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
    footprint, effects = physics.sweeps(of_light("single-photon"))
    assert footprint.default.setting == "7"
    assert effects.default is not None
    _, nothing = physics.sweeps(of_light("single-photon", "none"))
    assert nothing.default.setting == "none"


def test_where_the_detector_asks_for_nothing_another_one_stands_in_and_no_setting_is_the_runs():
    for sweep in physics.sweeps(of_light("ideal")):
        assert "measured by single-photon" in sweep.note
        assert sweep.default is None


def test_the_finest_footprint_is_the_reference_and_bounded_by_what_it_takes(monkeypatch):
    footprint, _ = physics.sweeps(of_light("single-photon"))
    assert [measurement.setting for measurement in footprint.measurements] == ["1", "4", "7", "16", "64", "256"]
    assert footprint.measurements[-1].reference
    assert footprint.measurements[-1].error == 0
    single, finest = (with_footprint(of_light("single-photon").request, count) for count in (1, 256))
    assert footprint.measurements[0].error == pytest.approx(np.abs(single - finest).mean())
    monkeypatch.setattr(physics, "MOST_THIN_RAYS", 20 * 25 * 4)
    footprint, _ = physics.sweeps(of_light("single-photon"))
    assert [measurement.setting for measurement in footprint.measurements] == ["1", "4", "7", "16"]


def test_gates_beyond_what_the_stand_in_hears_have_no_sweeps():
    far = make_request([design("far", range_m=18.0)], space=DesignSpace((0,) * 6, (0, 0, 0, 0.5, 0.5, 40.0)))
    assert physics.sweeps(AccuracyRequest(None, None, far, None)) == []


def test_a_single_scene_says_that_its_uncertainty_is_unknown():
    asked = of_light("single-photon")
    alone = replace(asked, request=replace(asked.request, test=asked.request.test[:1]))
    assert all("in 1 scene, so that differences" in sweep.note for sweep in physics.sweeps(alone))


def test_without_designs_nothing_is_measured():
    asked = of_light("single-photon")
    assert physics.sweeps(replace(asked, request=replace(asked.request, designs=[]))) == []
