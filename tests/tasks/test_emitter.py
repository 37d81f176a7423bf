"""Emitters for a fixed detector: closed-form ranges, reciprocity, the monostatic limit, the truth, and designs."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lidardesign_tasks.emitter import EmitterTask
from lidardesign_tasks.face import FaceTask
from support.rays import rays_of_points

from lidardesign.config import resolve
from lidardesign.constraints.document import Constraints
from lidardesign.density.objective.proposals import propose
from lidardesign.density.objective.target import build_target
from lidardesign.fitting.fit import fit_design
from lidardesign.fitting.request import FitRequest
from lidardesign.run.manifest import start_manifest
from lidardesign.run.yaml import parse_yaml
from lidardesign.run_folder import RunFolder
from lidardesign.samples import Samples
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, in_view, path_of_range, range_of_path
from lidardesign.scenes.scene import Body, Box, Receiver, Scene, Sphere, rigid
from lidardesign.scoring.metrics import is_received, is_visible, trial_origins
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.light import Beams, direct_echoes
from lidardesign.simulate.detector.physics import EFFECTS, IDEAL, Physics
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import FirstHits
from lidardesign.simulate.effects.multipath import _hidden, bound
from lidardesign.simulate.returns import simulate
from lidardesign.space import RANGE, aim

SMALL = {"train": 4, "test": 2, "truth_points": 800}
SHADOWED = Physics(IDEAL, frozenset({"shadowing"}))


def receiver_at(place, **changes):
    straight = Receiver(tuple(place), math.pi, 0.0, math.radians(60), math.radians(50), (0.05, 1.05))
    return replace(straight, **changes)


def rays_from(origins, targets, gate_m=(0.0, 5.0)):
    """Rays from origins (3,) or (N, 3) at targets (N, 3)."""
    return rays_of_points(aim(np.broadcast_to(origins, targets.shape), targets), gate_m)


def random_rays(count=2000, seed=0):
    """Rays from everywhere to everywhere, and the range of what they meet."""
    generator = np.random.default_rng(seed)
    ends = generator.normal(size=(2, count, 3))
    return rays_from(ends[0], ends[1]), np.linalg.norm(ends[1] - ends[0], axis=1)


@pytest.fixture(scope="module")
def heads():
    """Task, configuration and two training scenes."""
    task, config = EmitterTask(), EmitterTask.Config(**SMALL)
    return task, config, task.scenes(config, "train", 0)


# ranges from whole paths


def test_a_path_is_the_way_out_plus_the_way_back_halved():
    rays, range_m = random_rays(seed=2)
    receiver = receiver_at((0.3, -0.2, 0.1))
    points = rays.origin_m + range_m[:, None] * rays.direction
    whole = range_m + np.linalg.norm(points - np.array(receiver.origin_m), axis=1)
    np.testing.assert_allclose(path_of_range(rays, receiver, range_m), whole / 2, rtol=1e-14)


def test_a_path_shorter_than_the_way_to_the_receiver_has_no_range():
    rays, _ = random_rays(seed=3)
    receiver = receiver_at((0.3, -0.2, 0.1))
    apart = np.linalg.norm(rays.origin_m - np.array(receiver.origin_m), axis=1)
    assert np.isnan(range_of_path(rays, receiver, 0.499 * apart)).all()
    assert np.isfinite(range_of_path(rays, receiver, 0.501 * apart)).all()
    assert (range_of_path(rays, receiver, 0.501 * apart) > 0).all()


# light between two places


def ball_and_plate():
    ball = Body(Sphere(0.1), "ball")
    plate = Body(Box((0.01, 0.03, 0.2)), "plate", poses=rigid(translation_m=(0.25, 0.02, 0.0)))
    return Scene((ball, plate), receiver=receiver_at((0.4, -0.1, 0.0)))


def heard_rays(scene, rays):
    (returns,) = simulate(scene, rays, physics=SHADOWED)
    return returns


PLACES = np.array([[0.41, 0.12, 0.03], [0.40, -0.05, -0.10]])
EVERYWHERE = {"horizontal_rad": math.radians(170), "vertical_rad": math.radians(170)}


@pytest.fixture(scope="module", params=["head", "another head", "ball behind a plate"])
def two_ways(request, heads):
    """One scene heard at either of two places, and points that the first place lights."""
    base = {"head": heads[2][0], "another head": heads[2][1]}.get(request.param, ball_and_plate())
    aims = np.random.default_rng(7).uniform((-0.12, -0.12, -0.12), (0.02, 0.12, 0.14), (4000, 3))
    (returns,) = simulate(replace(base, receiver=None), rays_from(PLACES[0], aims))
    scenes = [replace(base, receiver=receiver_at(place, **EVERYWHERE)) for place in PLACES[::-1]]
    return scenes, returns.points_m


def test_what_one_place_lights_and_another_hears_can_be_lit_there_and_heard_here(two_ways):
    scenes, points = two_ways
    there, back = (heard_rays(scene, rays_from(place, points)) for scene, place in zip(scenes, PLACES, strict=True))
    # a ray from the second place ends at the point, and what it lights there is heard at the first one
    ends_there = np.abs(back.range_m - np.linalg.norm(points - PLACES[1], axis=1)) < 1e-4
    assert 0.1 < there.returned.mean() < 1.0
    # points at a silhouette are seen or not within rounding
    assert (there.returned == ends_there).mean() > 0.995
    both = there.returned & ends_there
    pairs = zip((there, back), scenes, strict=True)
    paths = [path_of_range(one.rays, scene.receiver, one.range_m)[both] for one, scene in pairs]
    # the error of a first hit grows as it grazes the surface
    np.testing.assert_allclose(paths[0], paths[1], rtol=2e-4)
    assert np.median(np.abs(paths[0] - paths[1])) < 1e-6


def test_the_same_share_of_an_even_source_arrives_with_emitter_and_receiver_swapped(two_ways):
    """Of an even source a patch gets cosine / distance^2, so gain * cosine / distance^2 is mutual (Helmholtz)."""
    scenes, points = two_ways
    points = points[is_received(SceneCaster(scenes[0]), scenes[0].receiver, points)]
    arriving = []
    for scene, place in zip(scenes, PLACES, strict=True):
        rays = rays_from(place, points)
        hits = SceneCaster(scene).first_hit(rays.origin_m, rays.direction)
        echoes = direct_echoes(scene, Beams.of(rays), hits)
        cosine = -np.einsum("nk,nk->n", hits.normal, rays.direction)
        arriving.append(np.bincount(echoes.ray, echoes.gain, len(rays)) * cosine / hits.range_m**2)
    agree = np.abs(arriving[0] - arriving[1]) <= 1e-3 * np.maximum(*arriving)
    # at an edge the two rays may meet different triangles
    assert agree.mean() > 0.98


def test_an_ideal_detector_takes_no_detour_for_an_echo_where_none_comes_straight(heads):
    _, config, scenes = heads
    targets = np.random.default_rng(15).uniform((-0.2, -0.12, -0.12), (0.02, 0.12, 0.12), (2000, 3))
    rays = rays_from(np.add(config.detector_m, (0.0, 0.12, 0.0)), targets, config.range_m)
    shadowed = heard_rays(scenes[0], rays)
    (with_all,) = simulate(scenes[0], rays, physics=Physics(IDEAL, frozenset(EFFECTS)))
    assert (shadowed.outcome == Outcome.NOT_DETECTED).any()
    for name in ("outcome", "range_m", "body"):
        np.testing.assert_array_equal(getattr(with_all, name), getattr(shadowed, name))


def test_detours_are_bounded_by_all_returns_of_which_nothing_else_is_heard():
    open_air, detector = ball_and_plate(), load_detector("single-photon")
    room = replace(open_air, bodies=(*open_air.bodies, Body(Box((2.0, 2.0, 2.0)), "room")))
    targets = np.random.default_rng(16).uniform((-0.1, -0.1, -0.1), (0.0, 0.1, 0.1), (3000, 3))
    rays = rays_from(np.array([0.4, 0.15, 0.0]), targets)
    (free,) = simulate(replace(room, receiver=None), rays)
    hidden = ~is_received(SceneCaster(room), room.receiver, free.points_m)
    sight = FirstHits.of(room, 0, detector, [rays], SceneCaster(room))
    np.testing.assert_array_equal(_hidden(sight, np.flatnonzero(sight.returned)), hidden)
    # from inside a room every point sees its walls; of a few of the points 5 % more or less are hidden
    assert bound(sight, Counts(sight)).lost[sight.returned].mean() > hidden.mean() - 0.15 > 0.0
    alone = FirstHits.of(replace(room, receiver=None), 0, detector, [rays], SceneCaster(room))
    assert not bound(alone, Counts(alone)).lost.any()


# the monostatic limit


def test_heads_are_those_of_the_face_task(heads):
    _, config, scenes = heads
    faces = FaceTask().scenes(FaceTask.Config(**SMALL), "train", 0)
    for mine, theirs in zip(scenes, faces, strict=True):
        assert mine.receiver == config.receiver
        assert theirs.receiver is None
        np.testing.assert_array_equal(mine.bodies[0].poses, theirs.bodies[0].poses)
        assert mine.bodies[0].shape.content_hash == theirs.bodies[0].shape.content_hash


# the truth


def test_the_truth_is_seen_by_the_receiver_and_lit_from_the_emitter_box(heads):
    task, config, scenes = heads
    space = task.space(config)
    for scene in scenes:
        points, caster = scene.truth["surface"].points, SceneCaster(scene)
        assert in_view(config.receiver, points).all()
        assert is_received(caster, config.receiver, points).all()
        origins = trial_origins(space, np.random.default_rng(11))
        assert is_visible(caster, space, origins, points).mean() > 0.99


def test_the_truth_is_what_both_places_see_where_the_emitter_is_fixed(heads):
    task, _, scenes = heads
    narrow = EmitterTask.Config(**SMALL, emitter_box_m=0.0)
    space, place = task.space(narrow), (0.4, 0.15, 0.0)
    aside = replace(space, low=(*place, *space.low[3:]), high=(*place, *space.high[3:]))
    (both, *_), (wide, *_) = task.scenes(narrow, "train", 0, aside), scenes
    seen = both.truth["surface"].points
    # the cheek away from the emitter is not lit, and so not asked for
    assert seen[:, 1].min() > wide.truth["surface"].points[:, 1].min() + 0.01
    assert is_visible(SceneCaster(both), aside, np.array([place]), seen).all()


# the configuration


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"range_m": (0.5, 0.5)}, "the longest above it"),
        ({"range_m": (-0.1, 0.5)}, "0 m or more"),
        ({"detector_m": (0.4, 0.0)}, "detector_m"),
        ({"half_angle_deg": 0.0}, "greater than 0"),
        ({"origin_box_m": 0.1}, "origin_box_m"),
    ],
)
def test_a_detector_that_cannot_be_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        EmitterTask.Config(**values)


def test_a_detector_that_looks_straight_down_has_an_upright_design_space():
    config = EmitterTask.Config(detector_m=(0, 0, 0.5), detector_elevation_deg=-90, half_angle_deg=50)
    space = EmitterTask().space(config)
    assert space.low[4] == pytest.approx(-math.pi / 2)
    assert space.high[4] == pytest.approx(math.radians(-40))
    centre = np.array([*config.detector_m, space.low[3], space.low[4], 0.5])
    assert space.contains(centre)
    assert space.high[RANGE] == config.range_m[1]


# designs

RAYS = 400
DESIGNS = {
    "laser": {"sensors": {"count": 1}, "origin": {"fixed_m": [0.4, 0.0, 0.0]}},
    "floods": {
        "sensors": {"count": 2},
        "origin": {
            "spread_m": {"max": 0.005}, "exclude": [{"low_m": [0.3, -0.025, -0.02], "high_m": [0.5, 0.025, 0.02]}],
        },
        "each": [
            {"origin": {"low_m": [0.38, 0.0, -0.05], "high_m": [0.42, 0.1, 0.05]}},
            {"origin": {"low_m": [0.38, -0.1, -0.05], "high_m": [0.42, 0.0, 0.05]}},
        ],
    },
}  # fmt: skip


@pytest.mark.slow
def test_floods_beside_the_detector_are_nearly_as_good_as_a_laser_at_it(heads, tmp_path):
    """Fitted to the exact density of training heads without learning it."""
    task, few, scenes = heads
    config = resolve(task, preset="draft", overrides=[f"{name}={value}" for name, value in SMALL.items()])
    run, settings = RunFolder(tmp_path, task, config), config.density
    target = build_target(scenes, config.space, settings, "raycast")
    proposals = propose(scenes, config.space, 15_000, settings.sigma_m, np.random.default_rng(13))
    samples = Samples(proposals.points, proposals.log_density, target.log_density(proposals.points), config.space)
    start_manifest(run.folder, command=["lidardesign", "learn"], seed=config.seed)
    held_out, chamfer_mm = task.scenes(few.model_copy(update={"test": 8}), "test", 0), {}
    for name, constraints in DESIGNS.items():
        request = FitRequest.resolve(run, {"constraints": constraints, "rays": RAYS})
        rays = fit_design(request, samples=samples, target=target.log_density).design.rays(RAYS)
        scores = [task.score(scene, simulate(scene, rays, physics=SHADOWED)) for scene in held_out]
        chamfer_mm[name] = np.mean([score.value for score in scores])
    assert chamfer_mm["laser"] < 8.0
    assert chamfer_mm["floods"] < 1.15 * chamfer_mm["laser"]


# the page and the example


def test_the_constraints_of_the_page_are_those_of_the_example():
    root = Path(__file__).parents[2]
    page = (root / "docs" / "emitter.md").read_text("utf-8")
    blocks = re.findall(r"```yaml\n# (\w+)\.yaml.*?\n(.*?)```", page, re.DOTALL)
    example = (root / "examples" / "emitter.py").read_text("utf-8")
    written = re.findall(r'^([A-Z]+) = """\\\n# .*?\n(.*?)"""', example, re.DOTALL | re.MULTILINE)
    assert [name for name, _ in blocks] == ["floods"]
    assert {name.upper(): text for name, text in blocks}.items() <= dict(written).items()
    for name, text in written:
        Constraints.from_mapping(parse_yaml(text, where=name).value)
