"""Plans: what a scene calls for, what is skipped and why, and what planning itself costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.planning import CONSUMER, SINGLE, TIMED, decisions, grid, room

from lidardesign.errors import ConfigError
from lidardesign.scenes.scene import Ambient, Body, Box, Medium, Receiver, Scene, Sphere, rigid
from lidardesign.simulate import plan as plan_module
from lidardesign.simulate.detector.physics import EFFECTS, IDEAL
from lidardesign.simulate.plan import Planner, Tolerance, parse_effects
from lidardesign.task import Metric

EVERYTHING = {
    "ball": {"velocity_m_s": (0.0, 3.0, 0.0)},
    "ambient": Ambient(1e5),
    "medium": Medium(0.1, 0.01),
}


def test_an_ideal_detector_calls_for_nothing_where_light_goes_straight_and_no_ray_is_cast(monkeypatch):
    monkeypatch.setattr(plan_module.FirstHits, "of", None)
    for scene in (room(), room(**EVERYTHING)):
        plan = Planner().plan(scene, [grid()])
        assert [decision.name for decision in plan.decisions] == list(EFFECTS)
        assert not plan.effects
        assert all(one.bound.range_m == one.bound.lost == 0 and one.bound.reason for one in plan.decisions)
        assert Planner().physics(plan, 0) is None


@pytest.mark.parametrize(
    ("name", "scene", "detector", "reason"),
    [
        ("specular", room(ball={"specular": 0.4}), IDEAL, "ball"),
        ("specular", room(wall={"transmission": 0.4}), IDEAL, "wall"),
        ("shadowing", room(receiver=Receiver((0, 0.2, 0), 0, 0, 1, 1, (0, 5))), IDEAL, "away from the receiver"),
        ("motion", room(ball={"velocity_m_s": (0.0, 3.0, 0.0)}), TIMED, "mm within a frame"),
        ("jitter", room(), TIMED, "timed to 10 ps"),
        ("footprint", room(), replace(TIMED, divergence_rad=0.02, footprint_rays=7), "20 mrad"),
        ("quantisation", room(), replace(TIMED, bin_s=1e-10), "15 mm wide"),
        ("photon_noise", room(), SINGLE, "photons"),
        ("ambient", room(ambient=Ambient(1e5)), SINGLE, "100,000 lux (sun)"),
        ("pile_up", room(ambient=Ambient(1e5)), SINGLE, "77 ns blind"),
        ("atmosphere", room(medium=Medium(0.1, 0.01)), SINGLE, "18.1 % per metre"),
    ],
)
def test_each_effect_is_called_for_by_its_own_cause_with_its_reason(name, scene, detector, reason):
    decision = decisions(Planner(detector).plan(scene, [grid()]))[name]
    assert decision.on
    assert reason in decision.bound.reason
    tolerance = Tolerance.of(detector)
    assert decision.bound.range_m > tolerance.range_m or decision.bound.lost > tolerance.lost


@pytest.mark.parametrize("detector", [TIMED, SINGLE, CONSUMER], ids=lambda detector: detector.name)
@pytest.mark.parametrize("tolerance", [Tolerance(1e-4, 1e-3), Tolerance(3e-3, 0.05), Tolerance(0.2, 0.6)])
@pytest.mark.parametrize("scene", [room(), room(**EVERYTHING)], ids=["plain", "everything"])
def test_all_that_is_skipped_stays_within_the_tolerance_together(detector, tolerance, scene):
    plan = Planner(detector, tolerance=tolerance).plan(scene, [grid()])
    skipped = [decision.bound for decision in plan.decisions if not decision.on and decision.missing is None]
    assert sum(bound.range_m for bound in skipped) <= tolerance.range_m
    assert sum(bound.lost for bound in skipped) <= tolerance.lost


def test_effects_are_on_where_they_exceed_the_tolerance_together_although_each_alone_is_within_the_tolerance():
    detector, scene = replace(TIMED, bin_s=1e-10), Scene((Body(Sphere(0.4), poses=rigid(translation_m=(2, 0, 0))),))
    bounds = {one.bound.range_m: one.name for one in Planner(detector).plan(scene, [grid()]).decisions}
    assert set(bounds.values()) >= {"quantisation", "jitter"}
    smaller, larger = sorted(bounds)[-2:]
    assert larger > smaller > 0
    planner = Planner(detector, tolerance=Tolerance(larger + smaller / 2))
    assert planner.plan(scene, [grid()]).effects == {bounds[larger]}
    assert not Planner(detector, tolerance=Tolerance(larger + smaller)).plan(scene, [grid()]).effects


def test_a_larger_tolerance_never_switches_more_on():
    scene, sizes = room(**EVERYTHING), []
    for scale in (0.1, 1, 10, 1000, 1e5):
        tolerance = Tolerance(scale * 1e-4, min(scale * 1e-3, 0.99))
        sizes.append(len(Planner(CONSUMER, tolerance=tolerance).plan(scene, [grid()]).effects))
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > sizes[-1]


def test_the_list_that_changes_most_decides_for_all():
    scene, few, many = room(ambient=Ambient(1e4)), grid(4), grid(30)
    alone = [decisions(Planner(SINGLE).plan(scene, [rays])) for rays in (few, many)]
    both = decisions(Planner(SINGLE).plan(scene, [few, many]))
    # multipath looks at a few points of all lists together
    for name, decision in ((name, one) for name, one in both.items() if name != "multipath"):
        assert decision.bound.range_m == pytest.approx(max(one[name].bound.range_m for one in alone))
        assert decision.bound.lost == pytest.approx(max(one[name].bound.lost for one in alone))


def test_lists_without_rays_and_rays_without_hits_are_planned_for():
    nothing = grid().subset(np.zeros(144, dtype=bool))
    assert not Planner(SINGLE).plan(room(), [nothing]).effects
    with_some = Planner(SINGLE).plan(room(), [nothing, grid()])
    assert (
        decisions(with_some)["photon_noise"].bound
        == decisions(Planner(SINGLE).plan(room(), [grid()]))["photon_noise"].bound
    )
    away = replace(grid(), direction=-grid().direction)
    for decision in Planner(SINGLE).plan(room(**EVERYTHING), [away]).decisions:
        assert np.isfinite(decision.bound.range_m)
        assert 0 <= decision.bound.lost <= 1


def test_choices_are_taken_as_they_are():
    scene = room()
    assert Planner(SINGLE, "none").plan(scene, [grid()]).effects == frozenset()
    assert Planner(SINGLE, parse_effects("jitter, motion")).plan(scene, [grid()]).effects == {"jitter", "motion"}
    assert Planner(SINGLE, "all").plan(scene, [grid()]).effects >= frozenset(EFFECTS) - {"multipath"}
    assert Planner(IDEAL, "all").plan(scene, [grid()]).effects >= frozenset(EFFECTS) - {"multipath", "motion"}
    assert "motion" not in Planner(IDEAL, "all").plan(scene, [grid()]).effects
    assert Planner(IDEAL, parse_effects("motion")).plan(scene, [grid()]).effects == {"motion"}
    physics = Planner(SINGLE, "all").physics(Planner(SINGLE, "all").plan(scene, [grid()]), 7)
    assert (physics.detector, physics.seed) == (SINGLE, 7)


def test_what_cannot_be_simulated_here_is_named_and_asking_for_it_is_refused(monkeypatch):
    monkeypatch.setattr(plan_module.transport, "missing", lambda: "not installed")
    floor = Body(Box((3, 3, 0.05)), "floor", poses=rigid(translation_m=(0, 0, -0.3)))
    scene = Scene((*room().bodies, floor))
    decision = decisions(Planner(CONSUMER).plan(scene, [grid()]))["multipath"]
    assert decision.missing == "not installed"
    assert not decision.on
    assert decision.bound.range_m > Tolerance.of(CONSUMER).range_m
    with pytest.raises(ConfigError, match="multipath cannot be simulated here: not installed"):
        Planner(CONSUMER, parse_effects("multipath")).plan(scene, [grid()])


@pytest.mark.hard_case("21")
@pytest.mark.parametrize("text", ["noise", "", "jitter,", "photon_noise,ambint", "Auto"])
def test_unknown_effects_are_refused_with_the_names_of_all(text):
    with pytest.raises(ConfigError) as caught:
        parse_effects(text)
    assert all(name in caught.value.allowed for name in (*EFFECTS, "auto", "all", "none", "audit"))


def test_a_choice_does_not_stand_among_names():
    for text in ("auto,jitter", "jitter,audit", "all,none"):
        with pytest.raises(ConfigError, match="one of auto, all, none, audit alone"):
            parse_effects(text)


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_tolerances_are_finite_and_above_zero(bad):
    for values in ((bad, 0.001), (0.001, bad)):
        with pytest.raises(ConfigError, match="tolerance"):
            Tolerance(*values)


def test_tolerances_follow_the_bins():
    assert Tolerance.of(IDEAL) == Tolerance(0.001, 0.001)
    assert Tolerance.of(CONSUMER).range_m == pytest.approx(0.1 * 299792458 * 250e-12 / 2)


def test_no_more_is_tolerated_than_the_metric_does():
    coarse = Tolerance.of(CONSUMER)
    assert coarse.within(Metric("Chamfer", "mm", "lower", 100.0, 0.5)) == Tolerance(0.0005, 0.001)
    assert coarse.within(Metric("Frechet", "m", "lower", 1.0, 0.5)) == coarse
    assert coarse.within(Metric("miss rate", "%", "lower", 100.0, 0.5)) == coarse
    assert coarse.within(Metric("exact", "mm", "lower", 100.0, 0.0)) == coarse


def test_costs_are_predicted_for_every_effect_and_grow_with_the_rays():
    for detector in (IDEAL, TIMED, SINGLE, CONSUMER):
        few, many = (Planner(detector).plan(room(), [grid(side)]) for side in (5, 10))
        for one, other in zip(few.decisions, many.decisions, strict=True):
            assert 4 * one.seconds == pytest.approx(other.seconds)
