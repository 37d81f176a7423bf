"""Lengths that do not fit together are told before anything is learned, and never where they fit."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.command_line import caller
from support.learning import config_of

from lidardesign.config import DensitySettings, resolve
from lidardesign.density.objective.prepare import training_scenes
from lidardesign.density.objective.scale import scale_notes
from lidardesign.scenes.scene import Body, Box, Capsule, Plane, Scene, Sphere, rigid
from lidardesign.space import RANGE, DesignSpace
from lidardesign.task import load_task

# Sensors within 0.1 m of the origin look to +x.
AHEAD = DesignSpace((-0.1, -0.1, 0, -0.6, -0.6, 0.8), (0.1, 0.1, 0, 0.6, 0.6, 2.2))
FLAT = replace(AHEAD, low=(0, -0.1, 0, -0.6, 0, 0.8), high=(0, 0.1, 0, 0.6, 0, 2.2))


def body(shape, x_m=1.5, turn=None, role="both"):
    return Body(shape, role=role, poses=rigid(turn, (x_m, 0, 0)))


def config(space=AHEAD, sigma_m=0.01, seed=3):
    return replace(config_of(space=space, seed=seed), density=DensitySettings(sigma_m=sigma_m))


def notes(*bodies, **settings):
    return scale_notes([Scene(bodies)], config(**settings))


def ranged(low_m, high_m, space=AHEAD):
    return replace(space, low=(*space.low[:RANGE], low_m), high=(*space.high[:RANGE], high_m))


BALL = body(Sphere(0.2))
PLATE = Body(Box((0.3, 0.3, 5e-4)), poses=rigid(translation_m=(1.5, 0, -0.02)))
WIRE = body(Capsule(5e-4, 0.3))
TILTED = np.array([[0.5, 0, math.sqrt(0.75)], [0, 1, 0], [-math.sqrt(0.75), 0, 0.5]])
UPRIGHT = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
# What is off, the words that say so, and what to do about it.
OFF = {
    "sigma is wider than a ball": ((BALL,), {"sigma_m": 0.5}, "blurs the targets away", "density.sigma_m to 0.04"),
    "sigma is in millimetres": ((BALL,), {"sigma_m": 25.0}, "are all lengths in metres?", "lower density.sigma_m"),
    "a ball is in millimetres": ((body(Sphere(200.0), 1500.0),), {}, "are all lengths in metres?", "set space.range_m"),
    "a ball around the sensors": ((body(Sphere(200.0)),), {}, "inside the targets, which are 400 m", "out of them"),
    "a ball that is far larger than the space": (
        (body(Sphere(1e3), 1002.0),), {"space": ranged(0.0, 5.0)}, "reaches 0.0", "cut the targets",
    ),
    "a wall of which hardly anything is in view": (
        (body(Box((0.1, 300.0, 300.0))),), {}, "looks past the targets", "are all lengths in metres?",
    ),
    "a ball behind the sensors": ((body(Sphere(0.2), -1.5),), {}, "0.00% of their surface", "look where"),
    "a ball behind the sensors, in a plane": (
        (body(Sphere(0.2), -1.5),), {"space": FLAT}, "0 of 8,192 random rays", "look where",
    ),
    "a ball behind a wall": (
        (body(Sphere(0.2), role="target"), body(Box((0.01, 3.0, 3.0)), 0.8, role="occluder")),
        {}, "occluders hide 100.0%", "roles",
    ),
    "a range that ends before the ball": ((BALL,), {"space": ranged(0.0, 0.9)}, "is 1.", "set space.range_m"),
    "a range that begins behind the ball": ((BALL,), {"space": ranged(2.0, 3.0)}, "is 2 to 3 m", "set space.range_m"),
    "a range in millimetres": ((BALL,), {"space": ranged(1e3, 3e3)}, "is 1e+03 to 3e+03 m", "set space.range_m"),
    "a plate seen edge-on": ((PLATE,), {"sigma_m": 0.003}, "edge-on", "move the design space"),
    "a wire": ((WIRE,), {"sigma_m": 0.05}, "thinner than sigma, 0.05 m", "with density.sigma_m=0.00"),
    "a range of ten thousand sigmas": ((BALL,), {"sigma_m": 1.4e-4}, "1/10,000 of", "m to 0.0014 m"),
}  # fmt: skip
FITTING = {
    "a ball": ((BALL,), {}),
    "a ball in a plane": ((BALL,), {"space": FLAT}),
    "a ball on the ground": ((BALL, body(Plane(), turn=np.eye(3))), {}),
    "a wall that fills the view": ((body(Box((0.1, 3.0, 3.0))),), {}),
    "a room around the sensors": (
        tuple(Body(Box((0.1, 2.0, 2.0)), poses=rigid(turn, place)) for turn, place in (
            (np.eye(3), (2.0, 0, 0)), (np.eye(3), (-2.0, 0, 0)), (UPRIGHT, (0, 0, 2.0)), (UPRIGHT, (0, 0, -2.0)),
        )), {},
    ),
    "a plate seen at 30 degrees": ((body(Box((5e-4, 0.3, 0.3)), turn=TILTED),), {}),
    "a wire": ((WIRE,), {"sigma_m": 0.003}),
    "a ball that a pole hides a part of": ((BALL, body(Capsule(0.05, 1.0), 0.8, role="occluder")), {}),
    "a range that cuts the ball": ((BALL,), {"space": ranged(0.0, 1.4)}),
    "a fixed range": ((BALL,), {"space": ranged(1.3, 1.3)}),
}  # fmt: skip


@pytest.mark.parametrize("case", OFF)
def test_what_is_off_is_told_in_one_note_with_what_to_do(case):
    bodies, settings, words, advice = OFF[case]
    (note,) = notes(*bodies, **settings)
    assert words in note
    assert advice in note


@pytest.mark.parametrize("case", FITTING)
def test_lengths_that_fit_together_need_no_note(case):
    bodies, settings = FITTING[case]
    assert notes(*bodies, **settings) == []


@pytest.mark.parametrize("case", ["sigma is wider than a ball", "a wire"])
def test_the_sigma_that_a_note_names_needs_no_further_one(case):
    bodies, settings, *_ = OFF[case]
    (note,) = notes(*bodies, **settings)
    named = float(re.search(r"density\.sigma_m(?: to |=)([\d.e-]+)", note)[1])
    assert notes(*bodies, **{**settings, "sigma_m": named}) == []


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize(
    "case", ["sigma is wider than a ball", "a wire", "a plate seen edge-on", "a ball behind a wall"]
)
def test_notes_do_not_depend_on_the_unit(case, factor):
    bodies, settings, _, _ = OFF[case]

    def scaled(part):
        values = vars(part.shape)
        lengths = {key: tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
                   for key, value in values.items()}  # fmt: skip
        poses = part.poses.copy()
        poses[:3, 3] *= factor
        return replace(part, shape=type(part.shape)(**lengths), poses=poses)

    factors = np.array([factor] * 3 + [1, 1, factor])
    space = replace(AHEAD, low=tuple(factors * AHEAD.low), high=tuple(factors * AHEAD.high))
    sigma_m = factor * settings.get("sigma_m", 0.01)
    (note,), (other,) = (
        notes(*bodies, **settings), notes(*map(scaled, bodies), space=space, sigma_m=sigma_m)
    )  # fmt: skip
    kinds = [re.sub(r"[\d.e+-]+", "#", text) for text in (note, other)]
    assert kinds[0] == kinds[1]


def test_the_same_seed_gives_the_same_notes():
    bodies, settings, _, _ = OFF["a wire"]
    first, again, other = (notes(*bodies, **settings, seed=seed) for seed in (1, 1, 2))
    assert first == again != other


TASKS = {
    "flatland": [],
    "flatland, discs": ["scene=discs"],
    "flatland, occluded": ["scene=occluded"],
    "face": ["train=8"],
    "emitter": ["train=8"],
    "arm": ["train=12"],
    "warehouse": ["train=8"],
}


@pytest.mark.parametrize("case", TASKS)
def test_the_tasks_that_come_along_need_no_note(case):
    task = load_task(case.partition(",")[0])
    config = resolve(task, preset="draft", overrides=TASKS[case], seed=0)
    assert scale_notes(training_scenes(task, config), config) == []


def test_the_street_needs_no_note_though_its_sigma_is_wider_than_a_pedestrian(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples" / "street")
    from lidardesign_street.task import StreetTask

    config = resolve(StreetTask(), preset="draft", seed=0)
    assert scale_notes(training_scenes(StreetTask(), config), config) == []


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work") / "plates"
    folder.mkdir()
    for number in range(2):
        trimesh.creation.box((0.3, 0.3 + 0.02 * number, 0.001)).export(folder / f"plate_{number}.stl")
    return folder


QUICK = [word for key in ("folder=plates", "poses=1", "truth_points=100", "jitter_rotation_deg=0.1",
                          "density.field_resolution=8") for word in ("--set", key)]  # fmt: skip


def test_a_dry_run_says_it_and_so_does_learning_before_it_fails(capsys, plates, monkeypatch):
    call = caller(capsys, plates.parent, monkeypatch)
    planned = call("learn", "meshes", *QUICK, "--dry-run")
    assert planned.code == 0, planned.err
    assert planned.err.count("note: the targets are seen edge-on") == 1
    failed = call("learn", "meshes", *QUICK, "--set", "density.sigma_m=1e-9", "--out", "run")
    assert failed.code == 2
    assert failed.err.index("note: the targets are seen edge-on") < failed.err.index("config error")


def test_learning_says_it_once_first_and_keeps_it(capsys, plates, monkeypatch):
    call = caller(capsys, plates.parent, monkeypatch)
    small = [word for key in ("learning.steps=4", "learning.batch=64", "learning.samples=1000")
             for word in ("--set", key)]  # fmt: skip
    result = call("learn", "meshes", *QUICK, *small, "--out", "learned")
    assert result.code == 0, result.err
    assert result.err.count("edge-on") == 1
    assert "edge-on" not in result.out
    assert "edge-on" in (plates.parent / "learned" / "manifest.json").read_text()
