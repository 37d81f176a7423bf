"""What a task prepares for rays: on training scenes alone, once for equal rays, and scored by as if it were by hand."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import starmap
from types import SimpleNamespace

import numpy as np
import pytest
from support.scoring import MissTask, design, entries_of, make_request

from lidardesign.errors import PluginError
from lidardesign.evaluation.mounting import MountError
from lidardesign.evaluation.score import evaluate
from lidardesign.fitting.trials import held_back_scorer
from lidardesign.rays.information import FEW_SCENES
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.scenes.scene import Body, Scene, Sphere, rigid
from lidardesign.scoring import scene_scores
from lidardesign.scoring.fired import fired, without_each
from lidardesign.scoring.scene_scores import Preparation, TrainingScorer
from lidardesign.sensors.adaptive import AdaptiveRays, PatternRule
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import Physics
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import simulate
from lidardesign.task import Metric, Score, random_generator

SEED = 3
NOISY = load_detector("single-photon")
LISTS = [fired(design(azimuth=azimuth), 25) for azimuth in (0.0, 0.05, 0.1)]


def scenes_of(split, seed=SEED, count=6):
    """Scenes of a ball each, at a distance that is to be found."""
    generator = random_generator(seed, split)
    found = []
    for number, distance in enumerate(generator.uniform(2.9, 3.1, count).tolist()):
        ball = Body(Sphere(0.4), "ball", "both", rigid(translation_m=(distance, 0.0, 0.0)))
        found.append(Scene((ball,), f"{split} {seed} {number}", truth={"distance_m": distance}))
    return found


class DistanceTask(MissTask):
    """How far a ball is, by a ridge regression that is learned for the rays; remembers what it learned from."""

    metric = Metric("distance error", "mm", "lower", worst=1000.0, tolerance=1.0)

    def __init__(self):
        self.learned_from = []

    def scenes(self, config, split, seed):
        return scenes_of(split, seed)

    def prepare(self, scenes, returns, seed):
        self.learned_from.append(([scene.name for scene in scenes], returns))
        seen = np.stack([self.features(one) for one in returns])
        shifted = [scene.truth["distance_m"] + random_generator(seed).normal(0, 1e-3) for scene in scenes]
        return np.linalg.solve(seen.T @ seen + 1e-3 * np.eye(seen.shape[1]), seen.T @ shifted)

    def features(self, returns):
        return np.append(np.concatenate([np.nan_to_num(one.range_m) for one in returns]), 1.0)

    def score(self, scene, returns, prepared):
        error = abs(self.features(returns) @ prepared - scene.truth["distance_m"])
        return Score(1000 * float(error), details={"first": float(prepared[0])})


def two_sensors():
    sensors = (replace(sensor, name=name) for name, sensor in zip("ab", 2 * design().sensors, strict=True))
    return replace(design(), sensors=tuple(sensors))


def request_of(task, **changes):
    values = {"task": task, "designs": [two_sensors()], "rays": (9,), "baselines": ("uniform", "random")}
    scenes = {"train": scenes_of("train"), "test": scenes_of("test")}
    return make_request(**{**values, **scenes, "planner": Planner(choice="none"), **changes})


def score_by_hand(task, request, scene, positions, physics, nominal=None):
    """The score of rays in a scene, by what is prepared for them, or for others."""

    def seen(here, lists, noise):
        return [frame for rays in lists for frame in simulate(here, rays, physics=noise)]

    returns = [seen(one, nominal or positions, noise_of(number, physics)) for number, one in enumerate(request.train)]
    return task.score(scene, seen(scene, positions, physics), task.prepare(request.train, returns, SEED)).value


def noise_of(number, physics):
    """Effects with the noise that a training scene has to itself, whatever it is called."""
    return physics and replace(physics, seed=int(random_generator(SEED, "prepare", number).integers(2**63)))


@pytest.mark.parametrize("effects", [frozenset(), frozenset({"jitter"})], ids=["geometry", "jitter"])
def test_scores_are_those_of_preparing_by_hand(effects):
    task, by_hand = DistanceTask(), DistanceTask()
    request = request_of(task, planner=Planner(NOISY, effects or "none"), losses=True)
    physics = Physics(NOISY, effects, SEED) if effects else None
    evaluation, entries = evaluate(request), entries_of(request)
    rows = [*evaluation.rows, *evaluation.equal_bandwidth]
    for row, entry in zip(rows, entries, strict=True):
        for number, scene in enumerate(request.test):
            expected = score_by_hand(by_hand, request, scene, entry.lit_in(number), physics)
            assert row.per_scene[number] == pytest.approx(expected, rel=1e-12)
    for value, left in zip(evaluation.rows[0].lost, without_each(entries[0].positions, 2), strict=True):
        expected = [score_by_hand(by_hand, request, scene, left, physics) for scene in request.test]
        assert value == pytest.approx(np.mean(expected))


def test_equal_rays_are_prepared_for_once_and_held_out_scenes_never_seen():
    task = DistanceTask()
    evaluate(request_of(task, losses=True, mount_error=MountError(1.0, 0.01), equal_bandwidth=False))
    # a design, two baselines, and what is left by two losses; no more where the strongest is found or all are misplaced
    assert len(task.learned_from) == 5
    assert all(names == [scene.name for scene in scenes_of("train")] for names, _ in task.learned_from)


def test_misplaced_rays_are_scored_by_what_was_prepared_for_their_place():
    task, by_hand, error = DistanceTask(), DistanceTask(), MountError(5.0, 0.02)
    request = request_of(task, mount_error=error, baselines=(), equal_bandwidth=False)
    (row,), (entry,) = evaluate(request).mounting.rows, entries_of(request)
    for number, scene in enumerate(request.test):
        misplaced = error.misplaced(entry.positions, SEED, number)
        expected = score_by_hand(by_hand, request, scene, misplaced, None, entry.positions)
        assert row.per_scene[number] == pytest.approx(expected)


def test_scenes_of_one_name_have_noise_of_their_own():
    task, scenes = DistanceTask(), [replace(one, name="scene") for one in [scenes_of("train")[0]] * 2]
    Preparation(task, SEED, scenes, Planner(NOISY, frozenset({"jitter"}))).of(LISTS[:1])
    ((_, (one, other)),) = task.learned_from
    assert np.any(one[0].range_m != other[0].range_m)


def test_baselines_that_are_drawn_anew_in_every_scene_fire_one_draw_and_say_so():
    def draws(task):
        request = request_of(task, equal_bandwidth=False)
        drawn = next(entry for entry in entries_of(request) if entry.name == "random")
        return len({drawn.rays_in(number)[0].direction.tobytes() for number in range(3)}), evaluate(request).notes

    count, notes = draws(DistanceTask())
    assert (count, sum("random fires one draw in all scenes" in note for note in notes)) == (1, 1)
    count, notes = draws(MissTask())
    assert (count, [note for note in notes if "one draw" in note]) == (3, [])


def test_the_audit_prepares_under_all_effects():
    task = DistanceTask()
    request = request_of(task, planner=Planner(NOISY, "none"), audit=True, baselines=())
    evaluate(request)
    (_, plain), (_, noisy) = task.learned_from
    assert any(np.any(one[0].range_m != two[0].range_m) for one, two in zip(plain, noisy, strict=True))


def test_workers_score_by_the_same():
    def carried(function, asked):
        return starmap(function, (pickle.loads(pickle.dumps(one)) for one in asked))

    here, there = (evaluate(request_of(DistanceTask(), starmap=one)) for one in (starmap, carried))
    for one, other in zip(here.rows, there.rows, strict=True):
        assert (one.per_scene.tolist(), one.details) == (other.per_scene.tolist(), other.details)


def test_training_scores_prepare_once_for_equal_rays_in_any_company():
    task = DistanceTask()
    preparation = Preparation(task, SEED, scenes_of("other"), None)
    scorer = TrainingScorer(task, task.metric, SEED, scenes_of("train"), None, preparation=preparation)
    together = scorer.scores(LISTS, 4)
    copies = [tuple(replace(rays, time_s=rays.time_s.copy()) for rays in one) for one in reversed(LISTS)]
    np.testing.assert_array_equal(scorer.scores(copies, 4)[:, ::-1], together)
    assert len(task.learned_from) == len(LISTS)
    assert {names[0] for names, _ in task.learned_from} == {"other 3 0"}
    shorter = tuple(replace(rays, gate_m=0.9 * rays.gate_m) for rays in LISTS[0])
    scorer.scores([shorter], 1)
    assert len(task.learned_from) == len(LISTS) + 1


def test_the_rays_that_come_first_say_which_effects_all_meet():
    planned = []

    class Counted(Planner):
        def plan(self, scene, lists, casters=None):
            planned.append((scene.name, len(lists)))
            return super().plan(scene, lists, casters)

    preparation = Preparation(DistanceTask(), SEED, scenes_of("train"), Counted(NOISY))
    for lists in (LISTS[:2], LISTS):
        preparation.of(lists)
    assert planned == [(scene.name, 2) for scene in preparation.scenes]


def test_rays_under_another_rule_of_what_fires_next_are_prepared_for_by_themselves():
    task = DistanceTask()
    first = AdaptiveRays((LISTS[0][0], LISTS[1][0]), PatternRule(np.array([[2.5]]), 1, np.array([9.0])), np.ones(2) / 2)
    other = AdaptiveRays(first, PatternRule(np.array([[1.5]]), 1, np.array([9.0])), first.shares)
    Preparation(task, SEED, scenes_of("train"), None).of([first, other, first])
    assert len(task.learned_from) == 2


def test_of_many_rays_the_last_ones_are_kept(monkeypatch):
    monkeypatch.setattr(scene_scores, "MOST_KEPT", 1)
    task = DistanceTask()
    preparation = Preparation(task, SEED, scenes_of("train"), None)
    counts = []
    for lists in (LISTS, LISTS, LISTS[:1], LISTS[2:], LISTS[1:2]):
        preparation.of(lists)
        counts.append(len(task.learned_from))
    assert counts == [3, 3, 3, 3, 4]


def test_trials_prepare_on_scenes_that_nothing_else_is_tried_on():
    task = DistanceTask()
    run = SimpleNamespace(task=task, metric=task.metric, scenes=scenes_of)
    scorer = held_back_scorer(TrainingScenes(run, SEED), Planner(NOISY, "none"))
    scorer.scores(LISTS, FEW_SCENES)
    assert len(task.learned_from) == len(LISTS)
    for names, _ in task.learned_from:
        assert len(set(names)) == FEW_SCENES
        assert {name.split()[0] for name in names} == {"train"}
        assert not {*names} & {scene.name for scene in scorer.scenes(FEW_SCENES)}


def changes_truth(task, scenes, returns, seed):
    scenes[1].truth["distance_m"] = 0.0
    return 1.0


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda *_: 1 / 0, "prepare failed: ZeroDivisionError"),
        (lambda *_: None, "prepare returned nothing"),
        (lambda *_: lambda: 0, "prepare returned a function that cannot be pickled"),
        (changes_truth, "prepare changed scene.truth"),
        (lambda task, scenes, *_: scenes.pop(), "prepare failed: AttributeError"),
    ],
)
def test_a_task_that_prepares_nonsense_is_at_fault(prepare, words):
    task = type("Wrong", (DistanceTask,), {"prepare": prepare, "score": lambda *_, prepared: Score(1.0)})()
    request = request_of(task, baselines=())
    with pytest.raises(PluginError, match=words) as raised:
        evaluate(request)
    assert raised.value.exit_code == 6
    assert "task miss" in raised.value.where
    assert raised.value.hint
