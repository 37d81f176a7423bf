"""Scoring on held-out scenes, with a task of a few lines: the share of rays without a return."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console
from support.scoring import RAYS, HitTask, MissTask, design, make_request, rows_by_key, scenes

from lidardesign.cli.terminal.score_tables import show_evaluation
from lidardesign.errors import ConfigError, DataError, PluginError
from lidardesign.estimates import mean_interval, paired_difference
from lidardesign.evaluation.entries import FEWEST_BASELINE_SCENES
from lidardesign.evaluation.results import csv_text, verdict
from lidardesign.evaluation.score import evaluate
from lidardesign.methods import laid_out
from lidardesign.report.figures import scores_figure
from lidardesign.report.sections import scores_section
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import rigid
from lidardesign.scoring.scene_scores import silent_notes
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import DesignSpace
from lidardesign.task import Score


def test_rows_are_designs_then_baselines_at_every_number_of_rays():
    evaluation = evaluate(make_request())
    names = ["aimed", "uniform", "random", "bounding", "silhouette"]
    assert [(row.design, row.rays) for row in evaluation.rows] == [(name, n) for name in names for n in RAYS]
    for row in evaluation.rows:
        assert row.ci_low <= row.value <= row.ci_high
        assert row.value == pytest.approx(row.per_scene.mean())
        assert len(row.per_scene) == 6
        assert row.seconds > 0
    rows = rows_by_key(evaluation)
    assert rows["aimed", 25].value < rows["uniform", 25].value


def test_failures_are_counted_at_the_worst_value_and_never_dropped():
    blind = design("blind", azimuth=0.45)
    row = rows_by_key(evaluate(make_request([blind])))["blind", 25]
    assert row.failures == 6
    assert row.value == row.ci_low == row.ci_high == 150.0
    mixed = [*scenes(2, 3), *scenes(2, 3, side=1.5)]
    row = rows_by_key(evaluate(make_request(test=mixed)))["aimed", 25]
    assert row.failures == 3
    assert row.value == pytest.approx((row.per_scene[:3].sum() + 3 * 150.0) / 6)


class CutTask(MissTask):
    """Misses beyond 40 % are all alike, by a worst value that follows from the configuration."""

    def metric_of(self, config):
        return replace(self.metric, worst=40.0)


def test_a_worst_value_of_the_configuration_cuts_scores_and_is_what_failures_have():
    request = make_request([design(), design("blind", azimuth=0.45)], task=CutTask())
    evaluation, usual = evaluate(request), rows_by_key(evaluate(replace(request, task=MissTask())))
    assert evaluation.metric.worst == evaluation.as_dict()["metric"]["worst"] == 40.0
    for key, row in rows_by_key(evaluation).items():
        np.testing.assert_array_equal(row.per_scene, np.minimum(usual[key].per_scene, 40.0))


@pytest.mark.parametrize(
    ("designs", "task", "baselines", "said"),
    [
        ([design()], MissTask(), (), None),
        ([design()], MissTask(), ("uniform",), "6 of 6 scenes of 'uniform' {} 150 % (6 failed)"),
        ([design(spread=0.1)], CutTask(), (), "6 of 6 scenes of 'aimed' {} 40 %"),
        # a design is named before baselines
        (
            [design("blind", azimuth=0.45)],
            CutTask(),
            ("uniform", "random"),
            "6 of 6 scenes of 'blind' {} 40 % (6 failed); so do some of 2 other rows",
        ),
    ],
)
def test_scenes_at_the_worst_value_are_counted_in_one_note(designs, task, baselines, said):
    request = make_request(designs, task=task, baselines=baselines, rays=(25,), equal_bandwidth=False)
    notes = [note for note in evaluate(request).notes if "worst value" in note]
    assert notes == ([] if said is None else [said.format("at 25 rays score the worst value,")])


def test_every_design_is_paired_with_every_baseline_and_every_later_design():
    evaluation = evaluate(make_request([design("first"), design("second", azimuth=0.05)]))
    pairs = {(pair.a, pair.b, pair.rays): pair for pair in evaluation.paired}
    others = ("second", "uniform", "random", "bounding", "silhouette")
    expected = [("first", other, n) for n in RAYS for other in others]
    expected += [("second", other, n) for n in RAYS for other in others[1:]]
    assert sorted(pairs) == sorted(expected)
    rows = rows_by_key(evaluation)
    for (a, b, n), pair in pairs.items():
        difference = rows[a, n].per_scene - rows[b, n].per_scene
        assert pair.difference == pytest.approx(difference.mean())
        assert pair.ci_low <= pair.difference <= pair.ci_high


def test_a_baseline_of_which_more_rays_fit_than_any_sensor_fires_is_left_out_at_equal_bandwidth_and_named(monkeypatch):
    request = make_request([design("wide", range_m=2.0, spread=0.1)])
    whole = evaluate(request)
    most = sorted({row.rays for row in whole.equal_bandwidth})[1]
    monkeypatch.setattr(laid_out, "MOST_RAYS", most)
    found = evaluate(request)
    assert [row.design for row in found.equal_bandwidth] != [row.design for row in whole.equal_bandwidth]
    assert {(row.design, row.rays) for row in found.equal_bandwidth} <= {
        (row.design, row.rays) for row in whole.equal_bandwidth if row.rays <= most
    }
    assert [row.rays for row in found.rows] == [row.rays for row in whole.rows]
    assert len(found.paired_bandwidth) == len(found.equal_bandwidth)
    (note,) = (note for note in found.notes if "not compared at equal bandwidth" in note)
    assert "fit in the bandwidth of wide" in note


def test_baselines_at_equal_bandwidth_never_exceed_the_design_and_one_more_ray_would():
    evaluation = evaluate(make_request([design(), design("wide", range_m=2.0, spread=0.1)]))
    rows = rows_by_key(evaluation)
    assert len(evaluation.equal_bandwidth) == 2 * len(RAYS) * 4
    for row in evaluation.equal_bandwidth:
        own = rows[row.matched_to, row.matched_rays]
        assert row.bandwidth_mbps <= own.bandwidth_mbps
        if row.rays and row.design in ("uniform", "random"):
            assert row.bandwidth_mbps * (row.rays + 1) / row.rays > own.bandwidth_mbps
    keys = {(pair.a, pair.rays, pair.b, pair.rays_b) for pair in evaluation.paired_bandwidth}
    assert keys == {(row.matched_to, row.matched_rays, row.design, row.rays) for row in evaluation.equal_bandwidth}
    without = evaluate(make_request(equal_bandwidth=False))
    assert not without.equal_bandwidth
    assert not without.paired_bandwidth


def test_a_baseline_without_a_single_ray_in_the_bandwidth_fails_and_is_noted():
    evaluation = evaluate(make_request(rays=(1,), bandwidth=Bandwidth(bin_ps=100.0)))
    row = next(row for row in evaluation.equal_bandwidth if row.design == "uniform")
    assert row.rays == 0
    assert row.failures == 6
    assert any("not one ray of" in note for note in evaluation.notes)


def test_the_order_of_designs_changes_no_number():
    designs = [design("first"), design("second", azimuth=0.05), design("third", spread=0.05)]

    def numbers(order):
        evaluation = evaluate(make_request([designs[i] for i in order]))
        return {(r.design, r.rays): (r.value, r.ci_low, r.ci_high, r.failures) for r in evaluation.rows}

    assert numbers([0, 1, 2]) == numbers([2, 0, 1])


def test_a_judged_baseline_of_free_origins_is_scored_too():
    space = DesignSpace((-0.1, -0.1, -0.1, -0.5, -0.5, 0.05), (0.1, 0.1, 0.1, 0.5, 0.5, 4.0))
    for task in (MissTask(), HitTask()):
        evaluation = evaluate(make_request(space=space, task=task))
        rows = rows_by_key(evaluation)
        sign = 1 if task.metric.better == "lower" else -1
        assert sign * rows["bounding", 25].value < sign * rows["uniform", 25].value


def grouped(count, *groups):
    return [replace(scene, group=groups[i % len(groups)]) for i, scene in enumerate(scenes(2, count))]


def test_intervals_are_over_groups_of_scenes():
    alone, grouping = (evaluate(make_request(test=test)) for test in (scenes(2, 12), grouped(12, "a", "b", "c")))
    assert (alone.groups, grouping.groups) == (12, 3)
    assert [any("3 groups" in note for note in one.notes) for one in (alone, grouping)] == [False, True]
    limits = grouping.metric.limits
    for row in grouping.rows:
        np.testing.assert_array_equal(row.groups, np.arange(12) % 3)
        assert (row.value, row.ci_low, row.ci_high) == mean_interval(row.per_scene, np.arange(12) % 3, limits=limits)
    rows = rows_by_key(grouping)
    for pair in (*grouping.paired, *grouping.paired_bandwidth):
        if pair.rays_b is None:
            first, second = rows[pair.a, pair.rays], rows[pair.b, pair.rays]
            apart = paired_difference(first.per_scene, second.per_scene, np.arange(12) % 3, limits=limits)
            assert (pair.difference, pair.ci_low, pair.ci_high) == apart


def test_scenes_of_one_group_give_no_interval_and_no_verdict():
    evaluation = evaluate(make_request(test=grouped(4, "a"), audit=True))
    assert any("all 4 held-out scenes are of one group, 'a'" in note for note in evaluation.notes)
    document = evaluation.as_dict()
    for entry in (*document["rows"], *document["paired"], *document["equal_bandwidth"], *document["audit"]["rows"]):
        assert entry["ci_low"] is entry["ci_high"] is None
    assert {verdict(evaluation, pair) for pair in evaluation.paired} == {"open"}
    assert all(estimate["error"] is None for estimate in document["error_estimates"].values())
    assert ",,,0,4," in csv_text(evaluation)
    console = Console(file=StringIO(), width=200)
    for verbose in (False, True):
        show_evaluation(document, evaluation, console, verbose=verbose)
    assert "None" not in console.file.getvalue()
    assert "over other scenes" not in console.file.getvalue()
    assert scores_section(evaluation)
    assert scores_figure(evaluation, "rays")


def test_rows_that_fire_the_same_rays_are_scored_once():
    calls = []

    class Counting(MissTask):
        def score(self, scene, returns):
            calls.append(scene.name)
            return super().score(scene, returns)

    evaluate(make_request(task=Counting(), baselines=("uniform",), rays=(25, 25), test=scenes(2, 2)))
    # one design and one baseline at 25 rays, and the baseline at the design's bandwidth, in two scenes each; and the
    # baseline in the training scenes that the strongest baseline is found on
    assert len(calls) == 6 + FEWEST_BASELINE_SCENES


class BrokenTask(MissTask):
    def __init__(self, result):
        self.result = result

    def score(self, scene, returns):
        if isinstance(self.result, BaseException):
            raise self.result
        return self.result


@pytest.mark.parametrize(
    "result",
    [ValueError("boom"), SystemExit(0), None, Score(float("nan")), Score("3"), Score(True), Score(-1e9)],
    ids=str,
)
def test_a_broken_score_is_a_plugin_error_naming_task_metric_and_scene(result):
    with pytest.raises(PluginError) as caught:
        evaluate(make_request(task=BrokenTask(result)))
    assert all(word in str(caught.value) for word in ("task miss", "metric misses", "scene ball 0"))
    # errors about data keep their kind
    with pytest.raises(DataError):
        evaluate(make_request(task=BrokenTask(DataError("no such file"))))


@pytest.mark.parametrize("change", [{}, {"points": None}, {"more": 1}])
def test_a_score_that_changes_the_truth_of_a_scene_is_refused(change):
    class Careless(MissTask):
        def score(self, scene, returns):
            scene.truth.update(change)
            if not change:
                scene.truth["points"][:] = 0
            return Score(1.0)

    test = [replace(scene, truth={"points": np.ones(3)}) for scene in scenes(2)]
    with pytest.raises(PluginError, match=r"scene\.truth" if change else "read-only"):
        evaluate(make_request(task=Careless(), test=test))


def test_details_are_means_over_the_scenes_that_give_them():
    class Detailed(MissTask):
        def score(self, scene, returns):
            index = int(scene.name.split()[-1])
            some = {"even": float(index)} if index % 2 == 0 else {}
            return Score(1.0, details={"hit": index, "broken": float("nan"), **some})

    row = evaluate(make_request(task=Detailed())).rows[0]
    assert row.details == {"hit": 2.5, "even": 2.0}
    assert row.as_dict()["details"] == row.details
    for details in ({"hit": "many"}, {3: 1.0}, [1.0], None):
        with pytest.raises(PluginError, match="score returned the details"):
            evaluate(make_request(task=BrokenTask(Score(1.0, details=details))))


def test_a_failure_has_the_worst_value_whatever_the_task_put_there():
    row = evaluate(make_request(task=BrokenTask(Score(-5.0, failed=True)))).rows[0]
    assert row.value == 150.0
    row = evaluate(make_request(task=BrokenTask(Score(1e9)))).rows[0]
    assert (row.value, row.failures) == (150.0, 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"test": []}, "no held-out scenes"),
        ({"designs": [design("a"), design("a")]}, "another design"),
        ({"designs": [design("uniform")]}, "a baseline"),
        ({"designs": [replace(design("a"), mount="torso")]}, "mounted on the body 'torso'"),
        ({"baselines": ("nothing",)}, "unknown baseline"),
        ({"rays": (0,)}, "0 rays"),
    ],
)
def test_requests_that_make_no_sense_are_refused(changes, message):
    designs = changes.pop("designs", None)
    with pytest.raises(ConfigError, match=message):
        evaluate(make_request(designs, **changes))


def silent(evaluation):
    return [note for note in evaluation.notes if "returns from a target" in note]


def rays_ahead(gate_m=(0.05, 4.0), azimuth=0.0):
    gates_m = np.tile(gate_m, (2, 1))
    return Rays.from_angles(np.zeros((2, 3)), np.full(2, azimuth), np.zeros(2), gates_m, np.zeros(2, int))


@pytest.mark.parametrize("azimuth", [0.0, 0.45])
def test_an_evaluation_names_designs_that_look_past_the_targets(azimuth):
    found = silent(evaluate(make_request([design(), design("other", azimuth=azimuth)])))
    assert [note.split(",")[1].split(" returns")[0] for note in found] == ([" no ray of 'other'"] if azimuth else [])


@pytest.mark.parametrize(
    ("rays", "expected"),
    [
        (rays_ahead(), False),
        (rays_ahead(azimuth=1.0), True),
        (rays_ahead((50.0, 4000.0)), True),
        (rays_ahead((0.05, 1.0)), True),
        (rays_ahead().subset(np.array([], dtype=int)), True),
    ],
    ids=["ahead", "aside", "in millimetres", "gate too near", "no rays"],
)
def test_rays_are_silent_where_no_gate_holds_a_target(rays, expected):
    assert bool(silent_notes(scenes(1), {"looking": (rays,)})) == expected


def test_what_returns_from_occluders_does_not_count():
    hidden = []
    for scene in scenes(1):
        (ball,) = scene.bodies
        before = rigid(translation_m=ball.pose()[:3, 3] / 3)
        hidden.append(replace(scene, bodies=(ball, replace(ball, name="wall", role="occluder", poses=before))))
    assert not silent_notes(scenes(1), {"all": (rays_ahead(),)})
    (note,) = silent_notes(hidden, {"all": (rays_ahead(),)})
    assert note.startswith("in 6 of 6 frames")
