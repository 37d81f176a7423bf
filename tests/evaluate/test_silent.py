"""Designs of which hardly a ray returns anything are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scoring import design, make_request, scenes

from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import rigid
from lidardesign.scoring.evaluation.score import evaluate
from lidardesign.scoring.scene_scores import silent_notes


def silent(evaluation):
    return [note for note in evaluation.notes if "returns from a target" in note]


def ahead(gate_m=(0.05, 4.0), azimuth=0.0):
    gates_m = np.tile(gate_m, (2, 1))
    return Rays.from_angles(np.zeros((2, 3)), np.full(2, azimuth), np.zeros(2), gates_m, np.zeros(2, int))


@pytest.mark.parametrize("azimuth", [0.0, 0.45])
def test_an_evaluation_names_designs_that_look_past_the_targets(azimuth):
    found = silent(evaluate(make_request([design(), design("other", azimuth=azimuth)])))
    assert [note.split(",")[1].split(" returns")[0] for note in found] == ([" no ray of 'other'"] if azimuth else [])


@pytest.mark.parametrize(
    "case",
    [
        ("ahead", ahead(), False),
        ("aside", ahead(azimuth=1.0), True),
        ("in millimetres", ahead((50.0, 4000.0)), True),
        ("gate too near", ahead((0.05, 1.0)), True),
        ("no rays", ahead().subset(np.array([], dtype=int)), True),
    ],
)
def test_rays_are_silent_where_no_gate_holds_a_target(case):
    name, rays, expected = case
    assert bool(silent_notes(scenes(1), {name: (rays,)})) == expected


def test_what_returns_from_occluders_does_not_count():
    hidden = [replace(scene, bodies=(*scene.bodies, between(scene))) for scene in scenes(1)]
    assert not silent_notes(scenes(1), {"all": (ahead(),)})
    (note,) = silent_notes(hidden, {"all": (ahead(),)})
    assert note.startswith("in 6 of 6 frames")


def between(scene):
    """What stands in front of a ball."""
    (ball,) = scene.bodies
    return replace(ball, name="wall", role="occluder", poses=rigid(translation_m=ball.pose()[:3, 3] / 3))
