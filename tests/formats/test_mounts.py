"""Even grids that stand for rays, names that other programs take, and poses of sensors."""

from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rays import rays_along
from support.rigs import even, farthest_nearest, sensor

from lidardesign.formats.mounts import mounts, nearest_grid, quaternion
from lidardesign.formats.names import distinct, document, element, identifier, renamed_note, xml_text
from lidardesign.scenes.rays import rotation_of_quaternion
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import grid_tangent
from lidardesign.sensors.sensor import tangent_directions
from lidardesign.space import angles, direction

angle = st.floats(-1.2, 1.2)


def identifiers(names):
    return distinct([identifier(name) for name in names], "_")


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 40), st.integers(1, 12), angle, st.floats(0.01, 1.5), angle, st.floats(0.01, 0.3))
def test_an_even_grid_is_found_again(columns, rows, left, width, low, height):
    wanted = even(columns, rows, (left, left + width), (low, low + height))
    azimuth, elevation = angles(np.random.default_rng(columns).permutation(wanted))
    found = nearest_grid(azimuth, elevation)
    assert len(found) == len(wanted)
    assert farthest_nearest(wanted, found.directions()) < 1e-7
    assert found.distance_rad(azimuth, elevation).max() < 1e-6


@pytest.mark.parametrize("columns", [1, 2, 3, 7, 360])
@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi, -2.9])
def test_a_whole_turn_is_found_wherever_it_begins(columns, turn):
    step = 2 * np.pi / columns
    wanted = even(columns, 3, (turn, turn + 2 * np.pi - step), (-0.2, 0.1))
    azimuth, elevation = angles(wanted)
    found = nearest_grid(azimuth, elevation)
    assert (found.columns, found.rows) == (columns, 3)
    assert farthest_nearest(wanted, found.directions()) < 1e-7


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 60), st.integers(0, 1000))
def test_any_rays_are_near_the_grid_by_no_more_than_is_said(count, seed):
    generator = np.random.default_rng(seed)
    azimuth, elevation = generator.uniform(-0.6, 0.6, count), generator.normal(0.1, 0.2, count)
    grid = nearest_grid(azimuth, elevation)
    assert abs(len(grid) - count) <= max(count // 10, 1)
    far = farthest_nearest(direction(azimuth, elevation), grid.directions())
    assert far <= grid.distance_rad(azimuth, elevation).max() + 1e-12


@pytest.mark.parametrize("wide_deg", [5, 20, 40])
def test_our_own_grids_are_nearly_even(wide_deg):
    """The tangent plane's grid is off by the third power of the angle."""
    field = np.radians(wide_deg)
    azimuth, elevation = angles(tangent_directions(np.eye(3), grid_tangent(field, field, 196)))
    grid = nearest_grid(azimuth, elevation)
    assert (grid.columns, grid.rows) == (14, 14)
    assert grid.distance_rad(azimuth, elevation).max() < 0.25 * (field / 2) ** 3


@pytest.mark.parametrize("seed", range(8))
def test_a_mounts_rotation_is_its_sensors_frame(seed):
    generator = np.random.default_rng(seed)
    elevation = (np.pi / 2, -np.pi / 2)[seed] if seed < 2 else generator.uniform(-1.5, 1.5)
    one = sensor("s", generator.normal(size=3), generator.uniform(0, 6.3), elevation, generator.uniform(-3, 3))
    (mount,) = mounts(DesignSpec("d", (one,)), rays_along(one.frame[:1], (1.0, 1.0), one.origin_m))
    np.testing.assert_allclose(rotation_of_quaternion(*mount.quaternion), one.frame.T, atol=1e-15)
    roll, pitch, yaw = mount.roll_pitch_yaw_rad
    about = [quaternion(*angles_rad) for angles_rad in ((roll, 0, 0), (0, pitch, 0), (0, 0, yaw))]
    steps = [rotation_of_quaternion(*one) for one in about]
    np.testing.assert_allclose(steps[2] @ steps[1] @ steps[0], one.frame.T, atol=1e-15)
    np.testing.assert_allclose([mount.azimuth_rad, mount.elevation_rad], 0.0, atol=1e-15)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.text(max_size=80), max_size=12))
def test_identifiers_are_words_and_no_two_alike(names):
    found = identifiers(names)
    assert all(one.isascii() and one.isidentifier() and one[0].isalpha() and "__" not in one for one in found)
    assert len({one.lower() for one in found}) == len(names)
    assert identifiers(found) == found


def test_a_plain_name_stays():
    assert identifier("front_left_2") == "front_left_2"
    assert renamed_note(["a", "b"], ["a", "b"]) == []
    assert "'ä b' became a_b" in renamed_note(["ä b"], identifiers(["ä b"]))[0]
    assert "and 2 more" in renamed_note(["1"] * 5, identifiers(["1"] * 5))[0]


@settings(max_examples=100, deadline=None)
@given(st.text(max_size=60))
def test_any_text_is_the_same_after_xml(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.xml"
    path.write_bytes(document(element("a", {"name": text})))
    kept = xml_text(text)
    assert ElementTree.parse(path).getroot().attrib["name"] == kept
    if text.isprintable():
        assert kept == text
