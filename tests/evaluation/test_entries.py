"""Rows at several condition values: who fires what where, in which order it is judged, and what it costs."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.scoring import MissTask, entries_of, make_request
from support.sensors import normal_sensor

from lidardesign.errors import ConfigError
from lidardesign.evaluation.score import evaluate
from lidardesign.scenes.scene import Body, Box, Capsule, Scene, Sphere, rigid
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern
from lidardesign.simulate.returns import simulate
from lidardesign.space import DesignSpace, angles
from lidardesign.task import Metric, Score

AISLE = DesignSpace(
    (-0.5, 0.0, 0.0, -math.pi / 2, 0.0, 0.1), (4.0, 0.0, 0.0, -math.pi / 2, math.pi / 2, 5.0), condition=("x_m",)
)
PLACES = (3.0, 0.25, 1.5)
CEILING = DesignSpace((-1, -1, 1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, -0.2, 2.5))


class SeenTask(MissTask):
    """Percent of rays that return; remembers the returns that it was given."""

    metric = Metric("seen", "%", "higher", worst=0.0, tolerance=1.0)

    def __init__(self, places=None):
        self.given = []
        if places is not None:
            self.conditions = lambda config: [{"x_m": place} for place in places]

    def score(self, scene, returns):
        self.given.append((scene, list(returns)))
        hit = [int(one.returned.sum()) for one in returns]
        return Score(100.0 * sum(hit) / max(sum(len(one.outcome) for one in returns), 1), details={"hit": sum(hit)})


def shelves(count, seed):
    """Boxes along the aisle at y = -1."""
    heights = np.random.default_rng(seed).uniform(0.2, 1.2, (count, 9))
    return [
        Scene(
            tuple(
                Body(Box((0.2, 0.1, 0.15)), f"box {i}", poses=rigid(translation_m=(x, -1.0, z)))
                for i, (x, z) in enumerate(zip(np.linspace(-0.4, 3.9, 9), row, strict=True))
            ),
            f"shelf {index}",
        )
        for index, row in enumerate(heights)
    ]


def carried(count, frames, seed):
    """A ball that moves below the ceiling, sometimes behind a capsule that moves with it."""
    generator = np.random.default_rng(seed)
    scenes = []
    for index in range(count):
        start, end = generator.uniform(-0.5, 0.5, (2, 3))
        path = start + np.linspace(0, 1, frames)[:, None] * (end - start)
        turns = Rotation.random(frames, generator).as_matrix()
        ball = Body(Sphere(0.3), "ball", "target", np.stack([rigid(translation_m=p) for p in path]))
        arm = np.stack([rigid(turn, p + np.array([0.1, 0.1, 0.4])) for turn, p in zip(turns, path, strict=True)])
        scenes.append(Scene((ball, Body(Capsule(0.08, 0.3), "arm", "occluder", arm)), f"path {index}"))
    return scenes


def upward():
    return normal_sensor("up", 1.0, (2.0, 0.0, 0.0), -math.pi / 2, 0.6, 0.0, (1e-3, 0.2), 1.2, 0.1)


BUILT = ("uniform", "random", "bounding", "occupancy")


def aisle_request(task, **changes):
    scenes = {"train": shelves(4, 1), "test": shelves(3, 2)}
    designs = [DesignSpec("cart", (upward(),))]
    values = {"task": task, "space": AISLE, "rays": (6, 10), "baselines": BUILT, "designs": designs, **scenes}
    return make_request(**{**values, **changes})


def test_returns_come_condition_by_condition_and_within_each_frame_by_frame():
    task, lifts = SeenTask(PLACES), [rigid(translation_m=(0, 0, dz)) for dz in (0.0, 0.1)]
    moving = [
        replace(scene, bodies=tuple(replace(body, poses=np.stack([lift @ body.poses for lift in lifts]))
                                    for body in scene.bodies))
        for scene in shelves(2, 2)
    ]  # fmt: skip
    evaluate(aisle_request(task, test=moving, rays=(6,), equal_bandwidth=False))
    judged = [(scene, returns) for scene, returns in task.given if any(scene is other for other in moving)]
    assert judged
    for _, returns in judged:
        assert [one.frame for one in returns] == [0, 1] * len(PLACES)
        assert [one.rays.origin_m[0, 0] for one in returns] == [x for x in PLACES for _ in range(2)]


def test_every_row_scores_what_its_rays_return_when_simulated_alone():
    task = SeenTask(PLACES)
    request = aisle_request(task)
    entries = entries_of(request)
    evaluation = evaluate(request)
    rows = [*evaluation.rows, *evaluation.equal_bandwidth]
    assert [(row.design, row.rays) for row in rows] == [(entry.name, entry.rays) for entry in entries]
    for row, entry in zip(rows, entries, strict=True):
        for index, scene in enumerate(request.test):
            alone = [one for rays in entry.rays_in(index) for one in simulate(scene, rays)]
            assert row.per_scene[index] == task.score(scene, alone).value
        assert row.details["hit"] == pytest.approx(row.per_scene.mean() * row.rays * len(PLACES) / 100)
    # rays count per position, and bandwidth is the mean over positions
    for row, entry in zip(evaluation.rows, entries, strict=False):
        assert [len(rays) for rays in entry.positions] == [row.rays] * len(PLACES)
        costs = [Bandwidth().mbps(rays) for rays in entry.positions]
        assert row.bandwidth_mbps == pytest.approx(np.mean(costs), rel=1e-12)
    own = {(row.design, row.rays): row for row in evaluation.rows}
    for row in evaluation.equal_bandwidth:
        assert row.bandwidth_mbps <= own[row.matched_to, row.matched_rays].bandwidth_mbps
    assert any("per position" in note and "3 positions" in note for note in evaluation.notes)


def test_baselines_lie_in_what_the_condition_leaves_free_and_drawn_ones_differ_by_scene_and_place():
    for entry in entries_of(aisle_request(SeenTask(PLACES))):
        for (place, x_m), scene in itertools.product(enumerate(PLACES), range(2)):
            rays, inside = entry.rays_in(scene)[place], AISLE.at({"x_m": x_m})
            middle = np.clip(rays.gate_m.mean(axis=1), inside.low[5], inside.high[5])
            points = np.column_stack([rays.origin_m, *angles(rays.direction), middle])
            assert (rays.origin_m[:, 0] == x_m).all()
            assert not entry.baseline or inside.contains(points, tolerance=1e-7).all()
        drawn = [rays.direction for scene in range(2) for rays in entry.rays_in(scene)]
        if entry.name in ("random", "occupancy") and entry.rays:
            assert len({one.tobytes() for one in drawn}) == len(drawn)
        assert entry.rays_in(1)[0].direction.tobytes() == entry.rays_in(1)[0].direction.tobytes()


def test_conditions_that_a_task_does_not_name_are_even():
    request = aisle_request(SeenTask())
    places = {rays.origin_m[0, 0] for rays in entries_of(request)[0].positions}
    assert len(places) == 9


def test_a_twin_is_fitted_for_each_number_of_rays_alone_and_in_the_bandwidth_of_the_design():
    asked = []
    looks = [(0.4, -math.pi / 2), (math.radians(359), -1.0), (2.0, -1.2)]
    down = tuple(normal_sensor(f"s{i}", 1 / 3, (0.1 * i, 0.2, 1.0), *look, 0.2) for i, look in enumerate(looks))

    def twin(count, limit_mbps):
        asked.append((count, limit_mbps))
        return DesignSpec("no-visibility", down[:2], constraints={"budget": {"rays": count}})

    request = make_request(
        [DesignSpec("d", down)], task=SeenTask(), space=CEILING, rays=(40, 80), baselines=("no-visibility",),
        train=carried(1, 4, 1), test=carried(2, 4, 2), without_visibility=twin,
    )  # fmt: skip
    evaluation = evaluate(request)
    assert [(row.design, row.rays, row.baseline) for row in evaluation.rows] == [
        ("d", 40, False), ("d", 80, False), ("no-visibility", 40, True), ("no-visibility", 80, True)
    ]  # fmt: skip
    assert [(row.design, row.rays, row.matched_rays) for row in evaluation.equal_bandwidth] == [
        ("no-visibility", 40, 40), ("no-visibility", 80, 80)
    ]  # fmt: skip
    own = [(row.rays, row.bandwidth_mbps) for row in evaluation.rows if row.design == "d"]
    assert asked == [(40, None), (80, None), *own]
    evaluate(replace(request, baselines=("uniform",)))
    assert len(asked) == 4


def test_a_design_whose_rays_end_before_where_it_is_evaluated_is_refused():
    rays = DesignSpec("cart", (upward(),)).rays(6)
    pattern = Pattern.along("x_m", (0.0, 2.0), [rays, rays], (0.0, 2.0))
    designs = [DesignSpec("cart", (upward(),), "chosen", (pattern,))]
    assert entries_of(aisle_request(SeenTask((0.25, 1.5)), designs=designs, rays=(6,)))
    with pytest.raises(ConfigError, match="design cart"):
        entries_of(aisle_request(SeenTask(PLACES), designs=designs, rays=(6,)))
