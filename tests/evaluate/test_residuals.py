"""Residuals of plugins: what is no place or no value is refused by the plugin's name, and none are none."""

from __future__ import annotations

import numpy as np
import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.tables import each_row

from lidardesign.errors import PluginError
from lidardesign.evaluate.scene_scores import checked_residuals, gives_residuals
from lidardesign.geometry.rays import Rays
from lidardesign.simulate.simulate import simulate
from lidardesign.task import Residuals

PLACES = np.zeros((3, 3))


def broken():
    raise RuntimeError("the map is lost")


class TaskWithResiduals(FlatlandTask):
    """Flatland whose residuals are something else."""

    def __init__(self, answer):
        self.answer = answer

    def residuals(self, scene, returns):
        return self.answer()


@pytest.fixture(scope="module")
def seen():
    """A scene and the returns of one ray."""
    task = FlatlandTask()
    config = task.Config(train=1, test=1)
    (scene,) = task.scenes(config, "train", 0)
    up = Rays(
        np.array([[0.5, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, 2.0]]), np.zeros(1), np.zeros(1)
    )
    return scene, simulate(scene, up)


ANSWERS = {
    "raises": (broken, "the map is lost"),
    "nothing": (lambda: None, "NoneType"),
    "a score": (lambda: 3.0, "float"),
    "places in the plane": (lambda: Residuals(np.zeros((3, 2)), np.zeros(3)), "(3, 2)"),
    "a value too many": (lambda: Residuals(PLACES, np.zeros(4)), "(4,)"),
    "one list of numbers": (lambda: Residuals(np.zeros(3), np.zeros(3)), "shape (3,)"),
    "a negative value": (lambda: Residuals(PLACES, np.array([1.0, -1.0, 0.0])), "negative"),
    "a value that is none": (lambda: Residuals(PLACES, np.array([1.0, np.nan, 0.0])), "NaN"),
    "a place that is none": (lambda: Residuals(np.full((3, 3), np.inf), np.ones(3)), "NaN or infinite"),
    "text": (lambda: Residuals(np.array([["a"] * 3] * 3), np.ones(3)), "task flatland"),
}


@each_row("given", ANSWERS)
def test_residuals_that_are_none_are_the_tasks_fault(seen, given):
    answer, words = ANSWERS[given]
    with pytest.raises(PluginError) as caught:
        checked_residuals(TaskWithResiduals(answer), *seen)
    assert words in str(caught.value)
    assert "task flatland" in caught.value.where
    assert caught.value.exit_code == 6


def test_no_place_at_all_is_no_error_anywhere(seen):
    found = checked_residuals(TaskWithResiduals(lambda: Residuals(np.zeros((0, 3)), np.zeros(0))), *seen)
    assert len(found.values) == 0


def test_lists_of_numbers_are_taken_as_arrays(seen):
    found = checked_residuals(TaskWithResiduals(lambda: Residuals([[0, 0, 1]], [2])), *seen)
    assert found.points_m.shape == (1, 3)
    assert found.points_m.dtype == found.values.dtype == np.float64


def test_a_task_says_whether_it_gives_residuals():
    assert gives_residuals(FlatlandTask())
    task = FlatlandTask()
    task.residuals = None
    assert not gives_residuals(task)
