"""Scores on training scenes: scenes as they are needed, and the effects that the first sets of rays call for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scoring import MissTask, design, scenes

from lidardesign.errors import ConfigError
from lidardesign.scoring.fired import fired
from lidardesign.scoring.scene_scores import TrainingScorer, score_in_scene
from lidardesign.sensors.pattern import Pattern
from lidardesign.simulate.plan import Bound, Decision, EffectPlan, Planner, Tolerance

SCENES = scenes(3)
PLACES = [{"x_m": 0.25}, {"x_m": 0.75}]
LISTS = [fired(design(azimuth=azimuth), 25) for azimuth in (0.0, 0.1, 0.2)]


class Recorded:
    """A planner that says which lists of rays it was asked about, and simulates nothing."""

    def __init__(self):
        self.asked = []

    def plan(self, scene, lists, casters):
        self.asked.append((scene, list(lists)))
        decisions = (Decision(name, True, Bound(0.0, 0.0, ""), 0.0) for name in ("jitter", "multipath"))
        return EffectPlan(tuple(decisions), Tolerance(1.0))

    def physics(self, plan, seed):
        return None


def scorer(planner=None, **options):
    return TrainingScorer(MissTask(), MissTask.metric, 0, SCENES, planner, **options)


@pytest.mark.parametrize("options", [{}, {"keeps_casters": True}, {"plans_once": True}])
def test_scores_are_those_of_every_scene_by_itself(options):
    found = scorer(Planner(), **options).scores(LISTS, 4)
    wanted = [
        [
            score.value
            for score, _ in score_in_scene(MissTask(), MissTask.metric, scene, LISTS, Planner(), None, 0).scores
        ]
        for scene in SCENES[:4]
    ]
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("plans_once", [False, True])
def test_what_is_scored_first_says_which_effects_all_meet(plans_once):
    planner = Recorded()
    judge = scorer(planner, plans_once=plans_once)
    for lists in (LISTS[:2], LISTS[2:]):
        judge.scores(lists, 3)
    first = [rays for positions in LISTS[:2] for rays in positions]
    assert [scene for scene, _ in planner.asked] == SCENES[: 1 if plans_once else 3]
    assert all(asked == first for _, asked in planner.asked)
    assert all(("multipath" in plan.effects) != plans_once for plan in judge.plans.values())


def test_scenes_are_drawn_as_they_are_needed_and_effects_are_of_what_is_named():
    stream, planner = iter(SCENES), Recorded()
    judge = TrainingScorer(MissTask(), MissTask.metric, 0, stream, planner)
    judge.scores_in(1, LISTS, LISTS[:1])
    assert [asked for _, asked in planner.asked] == [[*LISTS[0]]]
    assert judge.scenes(2) == SCENES[:2]
    assert next(stream) is SCENES[2]
    assert judge.scenes(100) == SCENES[:2] + SCENES[3:]


def test_a_design_fires_at_every_value_of_a_condition_and_is_refused_beyond_the_ends_of_its_rays():
    positions = fired(design(), 9, PLACES)
    assert [np.unique(rays.origin_m[:, 0]).tolist() for rays in positions] == [[0.25], [0.75]]
    short = Pattern.along("x_m", [0.25, 0.5], positions, (0.25, 0.5))
    with pytest.raises(ConfigError, match=r"from x_m=0.25 to 0.5, but designs are evaluated at 0.75"):
        fired(replace(design("short"), layout="chosen", patterns=(short,)), 9, PLACES)
