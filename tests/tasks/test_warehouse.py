"""Shelves that can stand, and a miss rate that agrees with ray casting, closed forms and common sense."""

from __future__ import annotations

import math

import numpy as np
import pytest
from lidardesign_tasks.warehouse import AISLE_M, PAPER_POSITIONS_M, WarehouseConfig, WarehouseTask
from lidardesign_tasks.warehouse_shelf import LEVELS, SHELF_DEPTH_M
from lidardesign_tasks.warehouse_truth import ON_FACE_M, BoxTruth, cut_scene, visible_boxes
from support.rays import rays_along

from lidardesign.errors import ConfigError
from lidardesign.rays.information import checked_information
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Body, Box, Scene, rigid
from lidardesign.simulate.returns import simulate
from lidardesign.space import ELEVATION, RANGE, DesignSpace, direction
from lidardesign.task import conditions_of, scenes_of

TASK = WarehouseTask()
SMALL = WarehouseConfig(size="small")
SPACE = TASK.space(SMALL)
SWEEP_RAYS = 9001  # 0.01 degrees apart: a box of SMALLEST_VISIBLE_RAD is met, or nearly so
ROUNDING_M = 1e-9


@pytest.fixture(scope="module")
def shelves() -> list[Scene]:
    return [scene for split in ("train", "test") for scene in TASK.scenes(SMALL, split, 0)]


def fan(x_m, elevation_rad, gate_m=(0.1, 5.0)) -> Rays:
    """Rays of the robot at x."""
    elevation = np.asarray(elevation_rad, dtype=float)
    return rays_along(direction(np.full(len(elevation), -math.pi / 2), elevation), gate_m, (x_m, 0.0, 0.0))


def returns_of(scene, elevation_rad, positions=None, **gate) -> list[Returns]:
    caster = SceneCaster(scene)
    places = scene.truth.origins_m[:, 0] if positions is None else positions
    return [simulate(scene, fan(x, elevation_rad, **gate), casters=[caster])[0] for x in places]


def scene_with(bodies, positions=(0.0,), space=SPACE) -> Scene:
    scene = Scene(tuple(bodies), "by hand")
    return Scene(scene.bodies, scene.name, BoxTruth(scene, space, np.array([[x, 0.0, 0.0] for x in positions])))


def block(low, high, role="both") -> Body:
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    return Body(Box(tuple(((high - low) / 2).tolist())), "block", role, rigid(translation_m=(low + high) / 2))


def in_shelf_frame(bodies) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Lowest and highest corners by name in the frame of the first body, to which all are parallel."""
    frame = bodies[0].pose()
    corners = {}
    for body in bodies:
        np.testing.assert_allclose(body.pose()[:3, :3], frame[:3, :3], atol=ROUNDING_M)
        middle = frame[:3, :3].T @ (body.pose()[:3, 3] - frame[:3, 3])
        half = np.array(body.shape.half_extents_m)
        corners[body.name] = (middle - half, middle + half)
    return corners


def test_boxes_stand_on_boards_within_the_shelf_and_have_the_sizes_asked_for(shelves):
    for scene in shelves:
        corners = in_shelf_frame(scene.bodies)
        for body in scene.bodies:
            if body.role == "both":
                board_low, board_high = corners[f"board {body.name.split()[1].split('.')[0]}"]
                low, high = corners[body.name]
                assert low[2] == pytest.approx(board_high[2], abs=ROUNDING_M)
                assert (low[:2] >= board_low[:2] - ROUNDING_M).all()
                assert (high[:2] <= board_high[:2] + ROUNDING_M).all()
                assert 0.05 - ROUNDING_M <= high[2] - low[2] <= 0.38 + ROUNDING_M
                assert 0.2 - ROUNDING_M <= high[0] - low[0] <= 0.6 + ROUNDING_M


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"second_row_share": 1.0, "box_setback_m": (0.05, 0.05), "empty_share": 0.0},
        {"empty_share": 0.9, "front_m": (1.1, 0.4), "front_jitter_m": 0.05, "bays": 20},
        {"box_width_m": (0.02, 1.0), "box_height_m": (0.399, 0.399), "level_spacing_m": (0.46, 0.46)},
    ],
)
def test_no_two_bodies_overlap(values):
    for scene in TASK.scenes(WarehouseConfig(size="small", test=3, **values), "test", 5):
        corners = list(in_shelf_frame(scene.bodies).values())
        low, high = np.array([one[0] for one in corners]), np.array([one[1] for one in corners])
        shared = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
        overlapping = (shared > ROUNDING_M).all(axis=-1)
        np.fill_diagonal(overlapping, False)
        assert not overlapping.any()


def test_a_shelf_has_four_levels_poles_in_front_and_spans_the_aisle(shelves):
    for scene in shelves:
        names = [body.name for body in scene.bodies]
        assert sum(name.startswith("board") for name in names) == LEVELS
        assert sum(name.startswith("pole") for name in names) >= 2
        assert {name.split()[1].split(".")[0] for name in names if name.startswith("box")} == set("0123")
        assert all(body.role == ("both" if body.name.startswith("box") else "occluder") for body in scene.bodies)
        for x in np.linspace(*AISLE_M, 7):
            cut = cut_scene(scene, np.array([x, 0.0, 0.0]), -math.pi / 2)
            boards = [scene.bodies[index].name.startswith("board") for index in cut.body]
            assert sum(boards) == LEVELS
            assert cut.low[boards, 0].min() > 0.7
            assert cut.high[boards, 0].max() < 1.3 + SHELF_DEPTH_M


@pytest.mark.parametrize("config", [WarehouseConfig(), SMALL, WarehouseConfig(positions=100)])
def test_designs_are_evaluated_at_the_papers_positions_and_others_all_inside_the_aisle(config):
    values = [one["x_m"] for one in conditions_of(TASK, config, TASK.space(config))]
    assert tuple(values[:4]) == PAPER_POSITIONS_M
    assert len(set(values)) == len(values) == 4 + config.count("positions")
    assert all(AISLE_M[0] < value < AISLE_M[1] for value in values)


def test_what_could_be_seen_is_what_a_dense_sweep_of_the_full_ray_caster_sees(shelves):
    elevations = np.linspace(0.0, math.pi / 2, SWEEP_RAYS)
    for scene in shelves[:4]:
        caster = SceneCaster(scene)
        for origin, visible in zip(scene.truth.origins_m, scene.truth["visible"], strict=True):
            hits = caster.first_hit(fan(origin[0], elevations).origin_m, fan(origin[0], elevations).direction)
            bodies, counts = np.unique(hits.body[hits.body >= 0], return_counts=True)
            boxes = np.array([scene.bodies[index].is_target for index in bodies], dtype=bool)
            # a box of one or two rays may be below the smallest visible angle
            clear, any_ray = bodies[boxes & (counts > 2)], bodies[boxes]
            assert set(clear) <= set(visible) <= set(any_ray)


def test_first_hits_in_the_plane_are_those_of_the_full_ray_caster(shelves):
    elevations = np.random.default_rng(0).uniform(0, math.pi / 2, 500)
    for scene in shelves:
        for x in (-0.5, 0.83, 4.0):
            cut = cut_scene(scene, np.array([x, 0.0, 0.0]), -math.pi / 2)
            row, range_m = cut.first_hits(elevations)
            hits = SceneCaster(scene).first_hit(fan(x, elevations).origin_m, fan(x, elevations).direction)
            np.testing.assert_array_equal(np.where(row >= 0, cut.body[row], -1), hits.body)
            np.testing.assert_allclose(range_m, hits.range_m, rtol=1e-9)


def test_the_score_agrees_with_counting_the_bodies_that_the_ray_caster_hit(shelves):
    generator = np.random.default_rng(7)
    for scene in shelves:
        returns = returns_of(scene, generator.uniform(0.0, 1.1, 10))
        pairs = [(visible, set(one.body)) for visible, one in zip(scene.truth["visible"], returns, strict=True)]
        missed = sum(index not in hit for visible, hit in pairs for index in visible)
        share = 100.0 * missed / sum(len(visible) for visible, _ in pairs)
        assert TASK.score(scene, returns).value == pytest.approx(share, abs=1e-12)


@pytest.mark.parametrize("rays", [2, 6, 40])
def test_what_is_not_told_about_is_the_miss_rate(shelves, rays):
    elevation = np.linspace(0.05, 1.5, rays)
    for scene in shelves:
        returns = returns_of(scene, elevation)
        found = checked_information(TASK, scene, returns)
        told = len(np.unique(found.item)) / len(found.frame)
        assert 100 * (1 - told) == pytest.approx(TASK.score(scene, returns).value, abs=1e-9)


def test_one_box_is_seen_between_its_two_known_elevations_and_inside_its_range():
    scene = scene_with([block((-1, -2.0, 0.5), (1, -1.0, 0.9))])
    foot, top = math.atan2(0.5, 1.0), math.atan2(0.9, 1.0)
    underside = math.atan2(0.5, 2.0)  # from below the box's floor is a face of it, too
    inside = (underside + 1e-6, foot, (foot + top) / 2, top - 1e-6)
    for elevation in inside:
        assert TASK.score(scene, returns_of(scene, [elevation])).value == 0.0
    for elevation in (0.0, underside - 1e-6, top + 1e-6, math.pi / 2):
        assert TASK.score(scene, returns_of(scene, [elevation])).failed
    front = 1.0 / math.cos(inside[2])
    assert TASK.score(scene, returns_of(scene, [inside[2]], gate_m=(front - 0.01, front + 0.01))).value == 0.0
    assert TASK.score(scene, returns_of(scene, [inside[2]], gate_m=(0.1, front - 0.01))).failed
    assert TASK.score(scene, returns_of(scene, [inside[2]], gate_m=(front + 0.01, 5.0))).failed


def test_a_box_behind_a_pole_is_no_truth_where_the_pole_stands():
    box = block((-1, -1.4, 0.1), (1, -1.0, 0.4))
    pole = block((-0.05, -0.95, -0.1), (0.05, -0.9, 2.0), "occluder")
    scene = scene_with([box, pole], positions=(0.0, 0.3))
    assert [list(one) for one in scene.truth["visible"]] == [[], [0]]
    assert [list(one) for one in scene.truth["standing"]] == [[0], [0]]
    result = TASK.score(scene, returns_of(scene, np.linspace(0.01, 0.5, 30)))
    assert result.value == 0.0
    assert result.details["hidden_percent"] == 50.0


def test_a_return_on_a_board_just_below_a_box_is_not_the_box():
    board = block((-1, -1.5, 0.37), (1, -1.0, 0.40), "occluder")
    box = block((-1, -1.5 + 0.1, 0.40), (1, -1.0 - 0.005, 0.6))
    scene = scene_with([board, box])
    assert TASK.score(scene, returns_of(scene, [math.atan2(0.395, 1.0)])).value == 100.0
    assert TASK.score(scene, returns_of(scene, [math.atan2(0.41, 1.0)])).value == 0.0


def test_returns_count_from_the_position_itself_and_near_the_face_of_a_box():
    scene = scene_with([block((-1, -1.6, -0.1), (1, -1.0, 0.4))])
    (one,) = returns_of(scene, [0.0])
    for error, value in ((0.9, 0.0), (-0.9, 0.0), (-2.0, 100.0)):
        wrong = Returns(one.rays, one.outcome, one.range_m + error * ON_FACE_M, one.body)
        assert TASK.score(scene, [wrong]).value == value
    lost = Returns(one.rays, np.full(1, Outcome.NOT_DETECTED), np.full(1, np.nan), np.full(1, -1))
    assert TASK.score(scene, [lost]).failed
    assert TASK.score(scene, returns_of(scene, [0.1], positions=[0.5])).value == 100.0


def test_the_shelf_may_be_turned_with_the_sensors_plane():
    turn = 0.3
    rotation = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    straight = TASK.scenes(SMALL, "test", 0)[0]
    bodies = [Body(body.shape, body.name, body.role, rigid(rotation) @ body.pose()) for body in straight.bodies]
    turned = Scene(tuple(bodies), "turned")
    for x in (0.0, 1.2):
        here = cut_scene(straight, np.array([x, 0.0, 0.0]), -math.pi / 2)
        there = cut_scene(turned, rotation @ np.array([x, 0.0, 0.0]), -math.pi / 2 + turn)
        np.testing.assert_allclose(there.low, here.low, atol=ROUNDING_M)
        np.testing.assert_allclose(there.high, here.high, atol=ROUNDING_M)
        np.testing.assert_array_equal(visible_boxes(there, SPACE), visible_boxes(here, SPACE))


def test_the_truth_follows_a_design_space_that_a_run_sets(shelves):
    low, high = list(SPACE.low), list(SPACE.high)
    high[ELEVATION], high[RANGE] = math.radians(30), 1.3
    narrow = DesignSpace(tuple(low), tuple(high), SPACE.condition)
    scene = scenes_of(TASK, SMALL, "train", 0, narrow)[0]
    full = scenes_of(TASK, SMALL, "train", 0, SPACE)[0]
    for few, all_of_them in zip(scene.truth["visible"], full.truth["visible"], strict=True):
        assert set(few) <= set(all_of_them)
        assert not any(scene.bodies[index].name.startswith(("box 2", "box 3")) for index in few)


def test_a_return_per_position_is_asked_for(shelves):
    returns = returns_of(shelves[0], [0.1, 0.2])
    with pytest.raises(ConfigError, match="lists of returns"):
        TASK.score(shelves[0], returns[:-1])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        *(({name: [-2.0, 0.5]}, "vertical plane") for name in ("y_m", "z_m", "azimuth_rad")),
        *(({"x_m": bounds}, r"-0\.5 to 4 m") for bounds in ([0.0, 2.0], [-0.5, 6.0], 4.5)),
        ({"condition": []}, "given robot positions"),
        ({"range_m": [0.1, 0.4]}, "can be seen"),
    ],
)
def test_a_space_that_does_not_fit_the_aisle_is_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        TASK.scenes(SMALL, "train", 0, space=DesignSpace.from_dict({**SPACE.as_dict(), **changes}))


def test_a_robot_that_stands_still_is_judged_where_it_stands():
    space = DesignSpace.from_dict({**SPACE.as_dict(), "x_m": 0.37})
    scene = scenes_of(TASK, SMALL, "test", 0, space)[0]
    assert conditions_of(TASK, SMALL, space) == [{}]
    np.testing.assert_array_equal(scene.truth.origins_m, [[0.37, 0.0, 0.0]])
    assert TASK.score(scene, returns_of(scene, np.linspace(0.0, math.pi / 2, SWEEP_RAYS))).value == 0.0


@pytest.mark.parametrize(
    "values",
    [
        {"train": 0},
        {"front_m": (float("nan"), 1.0)},
        {"box_height_m": (0.38, 0.05)},
        {"box_height_m": (0.05, 0.45)},
        {"box_height_m": (0.0, 0.2)},
        {"box_width_m": (0.2, 3.0)},
        {"box_setback_m": (0.0, 0.5)},
        {"level_spacing_m": (0.3, 0.5)},
        {"front_m": (0.1, 1.0)},
        {"front_m": (0.5, 3.0)},
    ],
)
def test_shelves_that_cannot_stand_are_refused(values):
    with pytest.raises(ValueError, match="validation error"):
        WarehouseConfig(**values)
