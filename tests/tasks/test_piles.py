"""Objects that were dropped: at rest, apart, inside; and a known background that is no object."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import trimesh
from lidardesign_tasks.meshes import KNOWN, MeshesTask
from lidardesign_tasks.piles import ATTEMPTS, background_of, settled_poses
from pydantic import ValidationError
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from support.meshes import write_ball
from support.rays import rays_of_points

from lidardesign.errors import DataError
from lidardesign.rays.information import checked_information
from lidardesign.scenes.scene import Box, Mesh
from lidardesign.simulate.returns import simulate
from lidardesign.space import aim

MILLIMETRE = 1e-3
SHAPES = {
    "box": trimesh.creation.box((0.1, 0.06, 0.03)),
    "rod": trimesh.creation.cylinder(0.02, 0.12, sections=12),
    "ring": trimesh.creation.torus(0.04, 0.012, 16, 8),
    "cone": trimesh.creation.cone(0.04, 0.08, sections=16),
    "ball": trimesh.creation.icosphere(1, 0.035),
}
each_kind = pytest.mark.parametrize("kind", ["bin", "table"])


def mesh(shape, scale=1.0):
    return Mesh(scale * np.array(shape.vertices), np.array(shape.faces))


def pile(kind, seed, count=8, scale=1.0):
    """A background, and the objects on it in the world."""
    shapes = [mesh(shape, scale) for shape in SHAPES.values()]
    objects = tuple(shapes[number % len(shapes)] for number in range(count))
    background = background_of(kind, shapes, count)
    poses = settled_poses(objects, background, seed)
    return background, [own.transformed(pose) for own, pose in zip(objects, poses, strict=True)]


def overlap_m(first, second):
    """How far two convex hulls have to be moved apart at least [m]; 0 where they are apart."""
    corners = (first[:, None] - second[None]).reshape(-1, 3)
    return max(0.0, -float(ConvexHull(corners).equations[:, 3].max()))


def corners(placed):
    return placed.vertices[ConvexHull(placed.vertices).vertices]


@each_kind
def test_no_two_objects_overlap_by_a_millimetre_and_none_sinks_into_the_background(kind):
    for seed in range(2):
        background, placed = pile(kind, seed)
        hulls = [corners(one) for one in placed]
        assert all(overlap_m(first, second) <= MILLIMETRE for first, second in combinations(hulls, 2))
        for half, centre in background.boxes():
            box = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T * half + centre
            assert all(overlap_m(box, hull) <= MILLIMETRE for hull in hulls)


@each_kind
def test_every_object_is_in_its_place(kind):
    for seed in range(2):
        background, placed = pile(kind, seed)
        low, high = background.bounds_m
        everything = np.concatenate([one.vertices for one in placed])
        assert (everything >= low - MILLIMETRE).all()
        assert (everything <= high + MILLIMETRE).all()
        if kind == "bin":
            assert np.abs(everything[:, :2]).max() <= background.half_m + MILLIMETRE


@each_kind
def test_every_object_is_held_up_by_what_it_touches(kind):
    _, placed = pile(kind, 1)
    hulls = [corners(one) for one in placed]
    grown = [hull.mean(axis=0) + (hull - hull.mean(axis=0)) * 1.02 for hull in hulls]
    floor = [hull[:, 2].min() <= MILLIMETRE for hull in hulls]
    for number, hull in enumerate(grown):
        others = [other for index, other in enumerate(grown) if index != number]
        assert floor[number] or any(meet(hull, other) for other in others), number


def meet(first, second):
    """Whether two convex hulls have a point in common, as shares of corners of both (a linear program)."""
    equal = np.vstack([np.hstack([first.T, -second.T]), np.eye(2).repeat([len(first), len(second)], axis=1)])
    right = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
    return linprog(np.zeros(len(first) + len(second)), A_eq=equal, b_eq=right).success


@each_kind
def test_the_same_seed_gives_the_same_bytes_and_another_one_another_pile(kind):
    def bytes_of(seed):
        settled_poses.cache_clear()
        return [one.vertices.tobytes() for one in pile(kind, seed)[1]]

    first = bytes_of(1)
    assert bytes_of(1) == first != bytes_of(0)


def test_what_lies_on_a_table_was_put_there_upright_and_turned():
    rod = mesh(SHAPES["box"])
    background = background_of("table", [rod], 1)
    turns = [settled_poses((rod,), background, seed)[0][:3, :3] for seed in range(6)]
    assert all(turn[2, 2] == pytest.approx(1.0, abs=1e-3) for turn in turns)
    assert np.ptp([np.arctan2(turn[1, 0], turn[0, 0]) for turn in turns]) > 1


def test_piles_of_larger_objects_are_the_same_piles():
    small, large = pile("bin", 1)[1], pile("bin", 1, scale=8.0)[1]
    for first, second in zip(small, large, strict=True):
        np.testing.assert_allclose(8 * first.vertices, second.vertices, atol=0.02)


def test_what_cannot_be_dropped_or_does_not_come_to_rest_is_one_message():
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]), "unsigned")
    with pytest.raises(DataError, match="flat"):
        background_of("bin", [flat], 1)
    box = mesh(SHAPES["box"])
    low = replace(background_of("bin", [box], 2), highest_m=1e-3)
    with pytest.raises(DataError, match=f"{ATTEMPTS} attempts"):
        settled_poses((box,) * 2, low, 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("clutter")
    for name, shape in SHAPES.items():
        shape.export(root / f"{name}.stl")
    return root


@each_kind
def test_random_rays_score_alike_with_and_without_the_background(folder, kind):
    task = MeshesTask()
    config = task.Config(folder=folder, clutter=8, background=kind, poses=1, truth_points=1500)
    space = task.space(config)
    with_it, without, taken_for_it = [], [], []
    for scene in task.scenes(config, "test", 0, space):
        design = space.sample(361, np.random.default_rng(5))
        rays = rays_of_points(design, (0.0, space.high[5]))
        bare = replace(scene, bodies=tuple(body for body in scene.bodies if body.is_target))
        with_it.append(task.score(scene, simulate(scene, rays)).value)
        without.append(task.score(bare, simulate(bare, rays)).value)
        stays = replace(scene, truth={key: scene.truth[key] for key in scene.truth if key != KNOWN})
        taken_for_it.append(task.score(stays, simulate(scene, rays)).value)
    assert np.mean(with_it) == pytest.approx(np.mean(without), rel=0.1)
    assert np.mean(taken_for_it) > 1.2 * np.mean(with_it)


def test_returns_on_the_background_tell_nothing_and_spoil_nothing(folder):
    task = MeshesTask()
    config = task.Config(folder=folder, clutter=3, poses=1, truth_points=1500)
    space = task.space(config)
    scene = task.scenes(config, "train", 0, space)[0]
    design = space.sample(2000, np.random.default_rng(1))
    rays = rays_of_points(design, (0.0, space.high[5]))
    information = checked_information(task, scene, simulate(scene, rays))
    assert len(information.ray)
    assert not information.harm.any()
    config = task.Config(**{**config.model_dump(), "background_returns": "stay"})
    (scene, *_) = task.scenes(config, "train", 0, space)
    assert checked_information(task, scene, simulate(scene, rays)).harm.any()


def test_a_pile_shows_the_mesh_of_its_scene_and_others_of_its_split_alone(folder):
    task = MeshesTask()
    for count in (1, 2, 7):
        config = task.Config(folder=folder, clutter=count, poses=1, truth_points=100)
        shown = {}
        for split in ("train", "test"):
            for scene in task.scenes(config, split, 0):
                names = [body.name.rsplit(" ", 1)[0] for body in scene.bodies if body.is_target]
                assert len(names) == count
                assert scene.name.split()[1] in names
                assert scene.group == ", ".join(sorted(set(names)))
                assert all(isinstance(body.shape, Box) for body in scene.bodies if not body.is_target)
                shown.setdefault(split, set()).update(names)
        assert not shown["train"] & shown["test"]
        assert shown["train"] | shown["test"] == {f"{name}.stl" for name in SHAPES}


@pytest.mark.parametrize(
    "keys", [{}, {"origin_m": (0.0, 0.0, 1.0)}, {"origin_m": (-0.5, 0.4, 0.6), "origin_box_m": 0.1}]
)
def test_the_derived_space_sees_the_whole_pile(folder, keys):
    task = MeshesTask()
    config = task.Config(folder=folder, clutter=6, poses=1, truth_points=100, **keys)
    space = task.space(config)
    places = np.random.default_rng(0).uniform(space.low[:3], space.high[:3], (20, 3))
    for scene in task.scenes(config, "train", 0, space):
        for body in scene.bodies:
            if body.is_target:
                seen = body.shape.transformed(body.pose()).vertices
                for place in places:
                    assert space.contains(aim(place, seen)).all()


def test_keys_that_say_nothing_together_are_refused(tmp_path):
    write_ball(tmp_path / "one" / "ball.stl", 0.1)
    for keys, words in (
        ({"background": "table"}, "set clutter=N too"),
        ({"background_returns": "stay"}, "set clutter=N too"),
        ({"clutter": 2, "speed_m_s": 1.0}, "speed_m_s is for a single object"),
        ({"clutter": 2, "motion": "a.csv"}, "motion is for a single object"),
        ({"clutter": 2, "area_exponent": 1.0}, "area_exponent is for a single object"),
    ):
        with pytest.raises(ValidationError, match=words):
            MeshesTask.Config(folder=tmp_path / "one", **keys)
