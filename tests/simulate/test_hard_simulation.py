"""Simulation: gates, empty returns, effects that nothing calls for, emitter and detector at one place."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lidardesign_tasks.arm import ArmTask
from lidardesign_tasks.emitter import EmitterTask
from lidardesign_tasks.face import FaceTask
from lidardesign_tasks.flatland import FlatlandTask
from lidardesign_tasks.warehouse import WarehouseTask
from support.heads import EVERYTHING, face_rays, heads
from support.scoring import design, make_request, rows_by_key

from lidardesign.density.training.learn import refuse_blind_receiver
from lidardesign.errors import DataError
from lidardesign.evaluation.score import evaluate
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, path_of_range, path_windows, range_of_path
from lidardesign.scenes.scene import Body, Box, Plane, Receiver, Scene, Sphere, rigid
from lidardesign.scoring.metrics import (
    chamfer_m,
    delaunay_surface,
    discrete_frechet_m,
)
from lidardesign.scoring.scene_scores import checked_score
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import IDEAL, Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import simulate
from lidardesign.space import direction
from lidardesign.task import conditions_of


def rays_of(origins, directions, gates):
    directions = np.asarray(directions, dtype=float)
    count = len(directions)
    origins = np.broadcast_to(np.asarray(origins, float), (count, 3))
    return Rays(origins, directions, np.broadcast_to(gates, (count, 2)), np.zeros(count), np.zeros(count))


FLOOR_AND_BALL = Scene(
    (Body(Plane(), "floor"), Body(Sphere(0.5), "ball", poses=rigid(translation_m=(0.4, 0.1, 0.5)))), "floor and ball"
)
PLATE = Body(Box((0.01, 0.2, 0.2)), "plate", "occluder", rigid(translation_m=(1.0, 0.0, 0.0)))
BALL = Body(Sphere(0.5), "ball", poses=rigid(translation_m=(3.0, 0.0, 0.0)))
AHEAD = [[1.0, 0.0, 0.0]]
SHADOWED = Physics(IDEAL, frozenset({"shadowing"}))


def random_rays(count=300, seed=3):
    """Rays downwards at a floor and a ball, from everywhere above them."""
    generator = np.random.default_rng(seed)
    origins = generator.uniform((-1, -1, 1.2), (1, 1, 2), (count, 3))
    return origins, direction(generator.uniform(0, 2 * math.pi, count), generator.uniform(-1.5, -0.4, count))


@pytest.mark.hard_case(
    "19",
    "No hit, a hit before or after the gate, or a surface exactly at the gate's edge",
    done="start <= range < end is a return, nearer hides, further comes too late, nothing is a miss",
)
class TestHitsAtTheEdgesOfGates:
    def test_each_kind_of_hit_has_its_outcome(self):
        scene = Scene((BALL, PLATE))
        gates = {(2.0, 4.0): Outcome.OCCLUDED, (0.5, 0.9): Outcome.AFTER_GATE, (0.9, 4.0): Outcome.RETURN}
        for gate, expected in gates.items():
            (returns,) = simulate(scene, rays_of(0.0, AHEAD, gate))
            assert returns.outcome.tolist() == [expected]
            assert np.isfinite(returns.range_m).tolist() == [expected == Outcome.RETURN]
            assert returns.body.tolist() == [1 if expected == Outcome.RETURN else -1]
        (missed,) = simulate(scene, rays_of(0.0, [[-1.0, 0, 0]], (0.0, 9.0)))
        assert missed.outcome.tolist() == [Outcome.MISS]

    @pytest.mark.parametrize("physics", [None, SHADOWED], ids=["geometry", "an ideal detector"])
    def test_a_surface_at_the_edge_is_met_by_the_gate_that_starts_there_alone(self, physics):
        above, below = np.nextafter(2.0, 3.0), np.nextafter(2.0, 1.0)
        gates = [(2.0, 3.0), (1.0, 2.0), (above, 3.0), (1.0, above), (below, 2.0), (2.0, 2.0), (2.0, above)]
        rays = rays_of((9.0, 9.0, 2.0), [[0.0, 0.0, -1.0]] * len(gates), gates)
        (returns,) = simulate(FLOOR_AND_BALL, rays, physics=physics)
        hit, late, near = Outcome.RETURN, Outcome.AFTER_GATE, Outcome.OCCLUDED
        assert returns.outcome.tolist() == [hit, late, near, hit, late, late, hit]

    @given(data=st.data(), baseline=st.sampled_from([None, 0.0, 1e-9, 0.3]))
    def test_gates_side_by_side_return_every_surface_exactly_once(self, data, baseline):
        origins, directions = random_rays(40, seed=data.draw(st.integers(0, 1000)))
        first = SceneCaster(FLOOR_AND_BALL).first_hit(origins, directions).range_m
        receiver = None if baseline is None else Receiver((baseline, 0.0, 1.5), 0.0, -1.0, 3.0, 3.0, (0.0, 99.0))
        scene = replace(FLOOR_AND_BALL, receiver=receiver)
        # every edge is also the exact range of some ray
        edges = np.unique([0.0, *data.draw(st.lists(st.sampled_from(first.tolist()), max_size=8)), 99.0])
        outcomes = []
        for start, end in itertools.pairwise(edges):
            rays = rays_of(origins, directions, (start, end))
            windows, paths = path_windows(rays, receiver), path_of_range(rays, receiver, first)
            heard = (windows[:, 0] <= paths) & (paths < windows[:, 1])
            (returns,) = simulate(scene, rays)
            np.testing.assert_array_equal(heard, returns.returned)
            outcomes.append(returns.outcome)
        outcomes = np.array(outcomes)
        assert ((outcomes == Outcome.RETURN).sum(axis=0) == np.isfinite(first)).all()
        # as gates move outwards a ray is late, then returns, then is hidden
        rank = np.select([outcomes == Outcome.AFTER_GATE, outcomes == Outcome.RETURN], [0, 1], 2)
        assert (np.diff(rank[:, np.isfinite(first)], axis=0) >= 0).all()


TASKS = {
    "flatland": (FlatlandTask, {"train": 1, "test": 1}),
    "face": (FaceTask, {"train": 1, "test": 1, "truth_points": 300}),
    "emitter": (EmitterTask, {"train": 1, "test": 1, "truth_points": 300}),
    "arm": (ArmTask, {"train": 1, "test": 1, "frames": 4}),
    "warehouse": (WarehouseTask, {"size": "small", "train": 1, "test": 1}),
}


@pytest.fixture(scope="module", params=TASKS)
def one_scene(request):
    """A task, one of its held-out scenes, and how often a design is fired there."""
    kind, values = TASKS[request.param]
    task, config = kind(), kind.Config(**values)
    return task, task.scenes(config, "test", 0)[0], len(conditions_of(task, config, task.space(config)))


NO_RAYS = Rays(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
# Far from every scene, upwards; and from the same place at nothing but a gate without width.
LOST = rays_of((500.0, 500.0, 500.0), direction(np.linspace(0, 6, 9), np.full(9, 0.5)), (0.0, 1.0))
SHUT = rays_of((500.0, 500.0, 500.0), direction(np.linspace(0, 6, 9), np.full(9, -0.5)), (1.0, 1.0))


@pytest.mark.hard_case(
    "20",
    "Every ray misses, or none is fired",
    done="the score is the metric's worst value with the status failed",
)
class TestEmptyReturns:
    @pytest.mark.parametrize("rays", [NO_RAYS, LOST, SHUT], ids=["no rays", "all miss", "gates without width"])
    def test_every_task_gives_the_worst_value_and_says_that_it_failed(self, one_scene, rays):
        task, scene, often = one_scene
        returns = [frame for _ in range(often) for frame in simulate(scene, rays)]
        assert not any(one.returned.any() for one in returns)
        score = checked_score(task, task.metric, scene, returns)
        assert score.failed
        assert score.value == task.metric.worst
        assert all(math.isfinite(value) for value in score.details.values())

    @pytest.mark.parametrize("choice", ["none", "all"])
    def test_an_evaluation_counts_every_scene_as_failed_and_stays_finite(self, choice):
        blind = design("blind", azimuth=0.45)
        request = make_request([design(), blind], planner=Planner(choice=choice))
        evaluation = evaluate(request)
        row = rows_by_key(evaluation)["blind", 25]
        assert row.failures == len(request.test)
        assert row.value == row.ci_low == row.ci_high == request.task.metric.worst
        document = json.loads(json.dumps(evaluation.as_dict(), allow_nan=False))
        (found,) = [one for one in document["rows"] if (one["design"], one["rays"]) == ("blind", 25)]
        assert found["failures"] == len(request.test)

    def test_distances_of_nothing_are_refused_in_words(self):
        points, nothing = np.random.default_rng(0).normal(size=(5, 3)), np.zeros((0, 3))
        for measure in (chamfer_m, discrete_frechet_m):
            for pair in ((points, nothing), (nothing, points), (nothing, nothing)):
                with pytest.raises(ValueError, match="without points has no distance"):
                    measure(*pair)
        assert delaunay_surface(nothing, np.zeros(3)) is None


@pytest.mark.hard_case(
    "21",
    "Effects that nothing calls for, and effects that do not exist",
    done="not imported and not a bit of the returns changed",
)
class TestEffectsNotCalledFor:
    def test_what_a_scene_does_not_call_for_changes_not_a_bit(self):
        (head,) = heads()[:1]
        rays, detector = face_rays(), load_detector("single-photon")
        calm = frozenset({"photon_noise", "jitter", "quantisation", "pile_up"})
        (planned,) = simulate(head, rays, physics=Physics(detector, calm))
        for more in ({"motion"}, {"specular"}, {"atmosphere"}, {"shadowing"}, {"motion", "specular", "shadowing"}):
            (everything,) = simulate(head, rays, physics=Physics(detector, calm | more))
            for name in ("outcome", "range_m", "body"):
                assert getattr(planned, name).tobytes() == getattr(everything, name).tobytes()


def looking_away(place, **changes):
    """A receiver that looks along -x, where nothing is."""
    return Receiver(place, math.pi, 0.0, 1.0, 1.0, (0.0, 9.0), **changes)


@pytest.mark.hard_case(
    "22",
    "An emitter at its detector, or a pair that sees no point together",
    done="at the detector everything is monostatic to the last bit",
)
class TestEmitterAndDetectorTogetherOrBlind:
    @pytest.mark.parametrize("detector", ["single-photon", "consumer-8x8"])
    def test_a_receiver_at_the_emitter_measures_to_the_bit_what_an_emitter_without_one_does(self, detector):
        harsh = {"visibility_m": 20, "gloss": 0.3, "speed_m_s": 1, "illuminance_lux": 100_000, "light": "sun"}
        (alone,) = FaceTask().scenes(FaceTask.Config(test=1, **harsh), "test", 0)
        beside = replace(alone, receiver=Receiver((0.4, 0.0, 0.0), math.pi, 0.0, 3.0, 3.0, (0.0, 9.0)))
        physics = Physics(load_detector(detector), EVERYTHING)
        (here,), (there,) = (simulate(scene, face_rays(), physics=physics) for scene in (alone, beside))
        assert here.returned.sum() > 50
        for name in ("outcome", "range_m", "body"):
            assert np.array_equal(getattr(here, name), getattr(there, name), equal_nan=name == "range_m")

    @given(exponent=st.integers(-300, 3), seed=st.integers(0, 1000))
    def test_ranges_come_back_from_paths_at_every_baseline_down_to_none(self, exponent, seed):
        generator = np.random.default_rng(seed)
        baseline = 10.0**exponent * generator.normal(size=3)
        rays = rays_of(0.0, direction(generator.uniform(0, 6, 50), generator.uniform(-1.5, 1.5, 50)), (0.0, 9.0))
        # light straight at the receiver has the same path wherever it turns
        length = np.linalg.norm(baseline)
        rays = rays.subset(rays.direction @ baseline < 0.9 * length)
        ranges = generator.uniform(0.5, 5.0, len(rays)) * max(1.0, length)
        receiver = Receiver(tuple(baseline), 0.0, 0.0, 3.0, 3.0, (0.0, 1e9))
        paths = path_of_range(rays, receiver, ranges)
        assert np.isfinite(paths).all()
        # a path differs from its range by half of the baseline at most, and a few roundings
        assert (np.abs(paths - ranges) <= length / 2 + 4e-15 * ranges).all()
        np.testing.assert_allclose(range_of_path(rays, receiver, paths), ranges, rtol=1e-12)

    def test_where_they_see_no_point_together_nothing_is_detected_and_the_score_says_so(self):
        task, config = EmitterTask(), EmitterTask.Config(train=1, test=1, truth_points=300)
        scene = task.scenes(config, "test", 0)[0]
        origins = np.add(config.detector_m, (0.0, 0.1, 0.0))
        generator = np.random.default_rng(1)
        targets = generator.uniform((-0.05, -0.05, -0.05), (0.0, 0.05, 0.05), (400, 3))
        rays = rays_of(origins, (targets - origins) / np.linalg.norm(targets - origins, axis=1, keepdims=True), (0, 2))
        wall = Body(Box((0.001, 0.05, 0.3)), "wall", "occluder", rigid(translation_m=(0.35, 0.0, 0.0)))
        blind = {
            "looks away": replace(scene, receiver=replace(scene.receiver, azimuth_rad=0.0)),
            "behind a wall": replace(scene, bodies=(*scene.bodies, wall)),
            "too short": replace(scene, receiver=replace(scene.receiver, range_m=(0.0, 0.01))),
        }
        for name, one in blind.items():
            (heard,) = simulate(one, rays, physics=SHADOWED)
            (lit,) = simulate(replace(one, receiver=None), rays)
            assert lit.returned.mean() > 0.5, name
            assert not heard.returned.any(), name
            assert (heard.outcome[lit.returned] == Outcome.NOT_DETECTED).all(), name
            score = checked_score(task, task.metric, replace(one, truth=scene.truth), [heard])
            assert (score.failed, score.value) == (True, task.metric.worst), name

    def test_learning_for_a_receiver_that_sees_nothing_is_refused_before_it_starts(self):
        points = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 2.5]])
        refuse_blind_receiver([Scene((BALL,), receiver=Receiver((0, 0.3, 0), 0.0, 0.0, 1.0, 1.0, (0.0, 9.0)))], points)
        for blind in (looking_away((0.0, 0.3, 0.0)), Receiver((0, 0.3, 0), 0.0, 0.0, 1.0, 1.0, (0.0, 0.2))):
            with pytest.raises(DataError, match="receiver: no surface that a ray of the design"):
                refuse_blind_receiver([Scene((BALL,), receiver=blind)], points)
