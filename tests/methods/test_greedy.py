"""`greedy`: exact numbers of rays in no more bandwidth than the design, and nearer to surfaces than even rays."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.baselines import SceneWorld, balls, problem_of, rays_of
from support.scoring import MissTask, design, entries_of, make_request, rows_by_key

from lidardesign.evaluation.score import evaluate
from lidardesign.methods import greedy as greedy_module
from lidardesign.methods.greedy import GREEDY, GreedyChoice
from lidardesign.methods.returns import TrainingReturns, whole_range
from lidardesign.problem.problem import Fired, Problem
from lidardesign.rays import information
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.pattern import Pattern
from lidardesign.simulate.returns import simulate
from lidardesign.space import DesignSpace, angles

RADIUS_M = 0.4
EVEN_ON_A_BALL = np.random.default_rng(4).normal(size=(300, 3))
EVEN_ON_A_BALL /= np.linalg.norm(EVEN_ON_A_BALL, axis=1, keepdims=True)
AHEAD = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
BOX = DesignSpace((-0.3, -0.1, -0.1, -0.5, -0.5, 0.05), (0.1, 0.1, 0.1, 0.5, 0.5, 4.0))
LINE = DesignSpace((0, 0, 0, -0.5, 0, 0.05), (0, 0, 0, 0.5, 0, 4.0))
AROUND = DesignSpace((0, 0, 0, 0, -0.8, 0.05), (0, 0, 0, 2 * np.pi, 0.8, 4.0))
ASIDE = DesignSpace((0, -0.6, 0, -0.5, -0.5, 0.05), (0, 0.6, 0, 0.5, 0.5, 4.0), condition=("y_m",))
PLACES = [ASIDE.at({"y_m": value}) for value in (-0.6, 0.2, 0.5)]
SUBJECTS = {"ahead": AHEAD, "from a box": BOX, "along a line": LINE, "all around": AROUND, "at three places": ASIDE}
COUNTS = (5, 30)
BANDWIDTH = Bandwidth()
BIN_MBPS = float(BANDWIDTH.mbps_of_widths(np.zeros(1)))


def scenes(seed, count=12):
    return balls(np.array([3.0, 0, 0]), RADIUS_M, count=count, seed=seed)


def visible(scene):
    """Points of the half of a ball that looks to the sensor, (U, 3) [m]."""
    return scene.bodies[0].pose(0)[:3, 3] + RADIUS_M * EVEN_ON_A_BALL[EVEN_ON_A_BALL[:, 0] < 0]


class BallTask(MissTask):
    """Says that returns tell about points of balls that are near them."""

    def informs(self, scene, returns):
        area_m2 = len(returns) * 2 * np.pi * RADIUS_M**2
        return information.surface_information([visible(scene)] * len(returns), returns, [True], area_m2)


def training(task=None, seed=5):
    """The training scenes of a run of the task, without end."""
    config = SimpleNamespace(density=SimpleNamespace(sigma_m=0.01))
    run = SimpleNamespace(task=task or BallTask(), config=config, scenes=lambda split, seed: scenes(seed))
    return TrainingScenes(run, seed)


def candidate(space=AHEAD, fired=(), gates_per_ray=True, spaces=None, seed=1):
    views = TrainingReturns(space, scenes(seed))
    return GreedyChoice(
        views, spaces or [space], training(seed=seed), 24, gates_per_ray, 5 * max(COUNTS), fired, BANDWIDTH
    )


def fired_at(bins):
    """Designs that spend so many bins on each ray."""
    return [Fired(count, count * bins * BIN_MBPS) for count in COUNTS]


@pytest.mark.parametrize("gates_per_ray", [True, False])
@pytest.mark.parametrize("subject", SUBJECTS)
def test_numbers_of_rays_are_met_exactly_inside_the_space_and_no_bandwidth_is_exceeded(subject, gates_per_ray):
    space = SUBJECTS[subject]
    spaces = PLACES if space is ASIDE else [space]
    # one bin per ray, which is the least, and few more
    for bins in (1, 3):
        fired = fired_at(bins)
        subject_of = candidate(space, fired, gates_per_ray, spaces)
        for count, mbps in fired:
            positions = subject_of.positions(count)
            for here, rays in zip(spaces, positions, strict=True):
                assert len(rays) == count
                points = np.column_stack([rays.origin_m, *angles(rays.direction), rays.gate_m.mean(axis=1)])
                assert here.contains(here.wrap(points)).all()
            within = subject_of.positions_within(mbps)
            assert mean_mbps(within, BANDWIDTH) <= mbps * (1 + 1e-12)
            if gates_per_ray:
                assert mean_mbps(positions, BANDWIDTH) <= mbps * (1 + 1e-12)
                assert [len(rays) for rays in within] == [count] * len(spaces)


def distance(rays, over):
    """The mean distance from points of scenes to the nearest return [m]."""
    found = []
    for scene in over:
        (returns,) = simulate(scene, rays)
        found.append(cKDTree(returns.points_m).query(visible(scene))[0].mean())
    return float(np.mean(found))


@pytest.mark.parametrize("subject", ["ahead", "all around"])
def test_returns_are_nearer_to_surfaces_than_those_of_even_and_random_rays_in_no_less_bandwidth(subject):
    space, held_out, count = SUBJECTS[subject], scenes(900, count=20), COUNTS[-1]
    ratios = []
    for seed in range(3):
        problem = problem_of(space, scenes(seed), seed, gates="ray", rays=count)
        even, random = (rays_of(name, problem) for name in ("bounding", "random"))
        (chosen,) = candidate(space, [Fired(count, BANDWIDTH.mbps(even))], seed=seed).positions(count)
        assert BANDWIDTH.mbps(chosen) <= BANDWIDTH.mbps(even)
        ratios.append([distance(chosen, held_out) / distance(other, held_out) for other in (even, random)])
    to_even, to_random = np.mean(ratios, axis=0)
    assert to_even < 0.97
    assert to_random < 0.7


def arrays(positions):
    return [array for rays in positions for array in (rays.origin_m, rays.direction, rays.gate_m, rays.time_s)]


def test_a_choice_repeats_whatever_was_chosen_before_it():
    fired = fired_at(4)
    first, second = candidate(fired=fired), candidate(fired=fired)
    upward = {count: first.positions(count) for count in COUNTS}
    downward = {count: second.positions(count) for count in reversed(COUNTS)}
    for count in COUNTS:
        for one, other in zip(arrays(upward[count]), arrays(downward[count]), strict=True):
            np.testing.assert_array_equal(one, other)


def test_one_gate_for_all_is_that_of_the_crops_and_costs_what_it_costs():
    (rays,) = candidate(fired=fired_at(1), gates_per_ray=False).positions(COUNTS[-1])
    gates = np.unique(rays.gate_m, axis=0)
    assert len(gates) == 1
    assert np.diff(gates[0]) < np.diff(whole_range(AHEAD))
    assert BANDWIDTH.mbps(rays) > COUNTS[-1] * BIN_MBPS


def test_rays_of_a_place_are_those_that_are_chosen_there_alone(monkeypatch):
    # how far a return tells follows from all returns, and which items are drawn from all items
    monkeypatch.setattr(information, "return_reach_m", lambda *arguments: 0.1)
    monkeypatch.setattr("lidardesign.rays.training_scenes.MOST_ITEMS", 3 * len(EVEN_ON_A_BALL))
    together = candidate(ASIDE, gates_per_ray=False, spaces=PLACES).positions(COUNTS[-1])
    for place, rays in zip(PLACES, together, strict=True):
        alone = candidate(ASIDE, gates_per_ray=False, spaces=[place]).positions(COUNTS[-1])
        for one, other in zip(arrays([rays]), arrays(alone), strict=True):
            np.testing.assert_array_equal(one, other)


def test_bandwidth_is_spent_at_the_places_where_it_tells_most():
    spaces, count = [ASIDE.at({"y_m": value}) for value in (0.0, 0.6)], COUNTS[-1]
    limit = 2 * count * BIN_MBPS
    rays = candidate(ASIDE, [Fired(count, limit)], spaces=spaces).positions(count)
    spent = [BANDWIDTH.mbps(one) for one in rays]
    assert np.mean(spent) <= limit * (1 + 1e-12)
    assert max(spent) > limit


def test_many_rays_at_many_places_take_too_long():
    world = SceneWorld(BallTask(), None, AHEAD, 0, training=training())
    world.conditions.extend([{}] * 3)
    reasons = [GREEDY.refuses(Problem(world, rays=count)) for count in (5, 500, 600)]
    assert reasons == [None, None, "choosing more than 500 rays takes too long"]


def aimed(counts=COUNTS):
    """The design beside `greedy`: even rays, each with a gate of its own that is longer than those of baselines."""
    problem = problem_of(AHEAD, scenes(1), 3)
    patterns = []
    for count in counts:
        rays = rays_of("bounding", replace(problem, rays=count))
        longer = np.linspace(0.2, 0.21, count)[:, None] * [-1, 1]
        patterns.append(Pattern.of(replace(rays, gate_m=rays.gate_m + longer)))
    return replace(design(), layout="chosen", patterns=tuple(patterns))


def ball_request(**changes):
    values = {"task": BallTask(), "training": training(), "train": scenes(1), "test": scenes(2), "rays": COUNTS}
    values |= changes
    return make_request([aimed(values["rays"])], **values)


def test_an_evaluation_has_it_at_each_number_of_rays_in_no_more_bandwidth_than_the_design(monkeypatch):
    monkeypatch.setattr(greedy_module, "MOST_CHOSEN", COUNTS[-1])
    evaluation = evaluate(ball_request())
    # others may fire more in the same bandwidth
    assert max(row.rays for row in evaluation.equal_bandwidth) > COUNTS[-1]
    assert not [note for note in evaluation.notes if "greedy" in note]
    rows = rows_by_key(evaluation)
    for count in COUNTS:
        assert rows["greedy", count].bandwidth_mbps <= rows["aimed", count].bandwidth_mbps
    matched = [(row.matched_rays, row.rays) for row in evaluation.equal_bandwidth if row.design == "greedy"]
    assert matched == [(count, count) for count in COUNTS]


@pytest.mark.parametrize(
    ("changes", "note"),
    [({"task": MissTask()}, "no method informs"), ({"rays": (5, 40)}, "more than 30 rays"), ({"training": None}, None)],
)
def test_it_is_left_out_with_one_note_where_rays_cannot_be_chosen(monkeypatch, changes, note):
    monkeypatch.setattr(greedy_module, "MOST_CHOSEN", 30)
    evaluation = evaluate(ball_request(**changes))
    kept = {row.rays for row in [*evaluation.rows, *evaluation.equal_bandwidth] if row.design == "greedy"}
    assert kept == ({5} if "rays" in changes else set())
    notes = [line for line in evaluation.notes if "greedy" in line]
    assert [note in line for line in notes] == ([True] if note else [])


@pytest.mark.parametrize("number", [7, 12])
def test_scenes_are_as_many_as_designs_beside_it_were_chosen_on(number):
    looked_at = []

    class CountingTask(BallTask):
        def informs(self, scene, returns):
            looked_at.append(scene.name)
            return super().informs(scene, returns)

    certificate = {"scenes": number}
    request = ball_request(task=CountingTask(), training=training(CountingTask()))
    entries_of(replace(request, designs=[replace(request.designs[0], certificates=(certificate,))]))
    assert len(looked_at) == number
