"""What holds for street alone."""

import numpy as np
import pytest
from lidardesign import Rays
from lidardesign.simulate.returns import simulate

from lidardesign_street.scenes import BANDS_M, OWN, SIZES_M, User, scene_of, user_of
from lidardesign_street.task import StreetTask
from lidardesign_street.users import FEWEST_RETURNS, distances_m

ROOF_M = np.array([0.0, 0.0, 1.9])


@pytest.fixture(scope="module")
def scenes():
    """Ten busy moments."""
    task = StreetTask()
    return task.scenes(task.Config(test=10, users=8), "test", 5)


def rays_at(points):
    """A ray from the roof to each point (N, 3)."""
    offset = np.asarray(points, dtype=float) - ROOF_M
    looking = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    count = len(looking)
    return Rays(
        np.tile(ROOF_M, (count, 1)), looking, np.tile([1.0, 60.0], (count, 1)), np.zeros(count), np.zeros(count)
    )


@pytest.mark.parametrize("kind", SIZES_M)
def test_a_road_user_is_found_by_five_returns_and_missed_with_four(kind):
    scene = scene_of([user_of(kind, 10.0, 0.0)])
    for count, missed in ((FEWEST_RETURNS, 0.0), (FEWEST_RETURNS - 1, 100.0)):
        rays = rays_at([[10.0, 0.0, height] for height in np.linspace(0.6, 1.2, count)])
        assert StreetTask().score(scene, simulate(scene, rays)).value == missed


def test_what_returns_tell_is_what_they_leave_unfound():
    scene = scene_of([user_of("car", 10.0, 0.0), user_of("pedestrian", 0.0, 8.0)])
    found = StreetTask().informs(scene, simulate(scene, rays_at([[10.0, 0.0, 0.8], [0.0, 8.0, 1.0], [5.0, 5.0, 5.0]])))
    assert (found.ray.tolist(), found.item.tolist()) in (([0, 1], [0, 1]), ([1, 0], [1, 0]))
    assert found.sums.tolist() == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]


def test_road_users_stand_on_the_ground_and_apart_in_their_bands(scenes):
    for scene in scenes:
        centre, half = scene.truth["centre_m"], scene.truth["half_m"]
        np.testing.assert_allclose(centre[:, 2], half[:, 2])
        users = [OWN, *(User("", *pair) for pair in zip(centre, half, strict=True))]
        assert all(one.is_apart(other) for index, one in enumerate(users) for other in users[:index])
        bands = [(low <= distances_m(scene)) & (distances_m(scene) <= high) for low, high in BANDS_M]
        assert np.sum(bands, axis=1).tolist() == [8, 8, 8]


def test_shapes_fill_the_boxes_that_labels_draw():
    for kind, size in SIZES_M.items():
        bodies = user_of(kind, 0.0, 0.0).bodies(kind, "both")
        high = max(
            body.poses[2, 3] + getattr(body.shape, "radius_m", 0.0)
            + getattr(body.shape, "half_length_m", 0.0) + getattr(body.shape, "half_extents_m", (0, 0, 0))[2]
            for body in bodies
        )  # fmt: skip
        assert high == pytest.approx(size[2])
    assert max(body.shape.half_extents_m[0] for body in user_of("car", 0.0, 0.0).bodies("car", "both")) == 3.9 / 2


def test_more_scenes_keep_the_first_ones():
    task = StreetTask()
    few, more = (task.scenes(task.Config(train=n), "train", 3) for n in (2, 5))
    for one, other in zip(few, more, strict=False):
        assert [body.poses.tolist() for body in one.bodies] == [body.poses.tolist() for body in other.bodies]
