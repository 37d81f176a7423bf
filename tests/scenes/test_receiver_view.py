"""A receiver's field of view is the pyramid of its two angles, wherever it looks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lidardesign.scenes.rays import angles_in_view, in_view, receiver_axes
from lidardesign.scenes.scene import Receiver
from lidardesign.space import direction

STRAIGHT = Receiver((0.0, 0.0, 0.0), 0.0, 0.0, math.radians(60), math.radians(50), (0.1, 2.0))
LOOKS = [(0.0, 0.0), (2.0, 0.4), (5.5, -1.2), (1.0, math.pi / 2), (0.3, -math.pi / 2)]


@pytest.mark.parametrize("look", LOOKS)
def test_axes_are_right_handed_with_a_level_lateral_axis_and_the_boresight_first(look):
    axes = receiver_axes(replace(STRAIGHT, azimuth_rad=look[0], elevation_rad=look[1]))
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[0] == pytest.approx(direction(*look), abs=1e-15)
    assert axes[1, 2] == 0
    assert axes[2, 2] >= 0


def test_angles_are_turns_about_the_upright_and_the_lateral_axis():
    points = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, -1.0], [2.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    horizontal, vertical, distance_m = angles_in_view(STRAIGHT, points)
    assert horizontal == pytest.approx(np.radians([45, 0, 0, 180, 45]))
    assert vertical == pytest.approx(np.radians([0, -45, 0, 180, 45]))
    assert distance_m == pytest.approx(np.sqrt([2, 2, 4, 1, 3]))


@pytest.mark.parametrize("look", LOOKS)
def test_angles_turn_and_move_with_the_receiver(look):
    points = np.random.default_rng(0).normal(size=(200, 3))
    turned = replace(STRAIGHT, origin_m=(3.0, -2.0, 0.5), azimuth_rad=look[0], elevation_rad=look[1])
    moved = points @ receiver_axes(turned) + np.array(turned.origin_m)
    for mine, expected in zip(angles_in_view(turned, moved), angles_in_view(STRAIGHT, points), strict=True):
        assert mine == pytest.approx(expected, abs=1e-12)


def test_the_view_ends_at_half_of_its_extents_and_at_its_ranges():
    half_h, half_v, inside = math.radians(30), math.radians(25), 1 - 1e-9
    edges = np.array([[1.0, math.tan(half_h * s), math.tan(half_v * s)] for s in (inside, 2 - inside)]) / 2
    assert in_view(STRAIGHT, edges).tolist() == [True, False]
    along = np.array([[0.1, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0999, 0.0, 0.0], [2.001, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    assert in_view(STRAIGHT, along).tolist() == [True, True, False, False, False]


def test_the_share_of_directions_in_view_is_the_solid_angle_of_the_pyramid():
    generator = np.random.default_rng(1)
    count = 200_000
    vectors = generator.normal(size=(count, 3))
    points = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    a, b = math.tan(STRAIGHT.horizontal_rad / 2), math.tan(STRAIGHT.vertical_rad / 2)
    # the solid angle of a right rectangular pyramid of unit height and half sides a and b
    expected = 4 * math.asin(a * b / math.sqrt((1 + a**2) * (1 + b**2))) / (4 * math.pi)
    error = math.sqrt(expected * (1 - expected) / count)
    assert in_view(STRAIGHT, points).mean() == pytest.approx(expected, abs=4 * error)
