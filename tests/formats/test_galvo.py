"""Steering mirrors: angles of two real mirrors, little travel, gates that lose nothing, and back again."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.sensors import normal_sensor

from lidardesign.errors import ConfigError, DataError
from lidardesign.formats.galvo import (
    degree_frame,
    gate_m,
    gate_ps,
    is_galvo_file,
    middle_boresight_deg,
    read_galvo,
    scan_angles_deg,
    scan_directions,
    short_tour,
    travel,
    write_galvo,
)
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec

C_M_PER_PS = 299_792_458e-12
HERE = (0.4, 0.0, 0.0)


def sensor(name, azimuth, elevation, *, origin=HERE):
    return normal_sensor(name, 0.5, origin, azimuth, elevation, 0.0, (0.05, 0.05), 0.4, 0.02)


def design(*sensors, rays=60):
    chosen = sensors or (sensor("left", 3.05, 0.02), sensor("right", 3.3, -0.04))
    return DesignSpec("faces", chosen, constraints={"budget": {"rays": rays}})


def mirrored(beam, normal):
    return beam - 2 * (beam @ normal) * normal


def through_two_mirrors(x_deg, y_deg):
    """A beam that meets an x and a y mirror at one place, by the law of reflection; mirrors turn by half the angles."""
    forward, sideways, upward = np.eye(3)
    between = upward  # from the x mirror up to the y mirror
    x_axis, y_axis = -forward, -sideways
    x_mirror = Rotation.from_rotvec(x_axis * np.radians(x_deg) / 2).apply((between - sideways) / np.sqrt(2))
    y_mirror = Rotation.from_rotvec(y_axis * np.radians(y_deg) / 2).apply((forward - between) / np.sqrt(2))
    return mirrored(mirrored(sideways, x_mirror), y_mirror)


@pytest.mark.parametrize(("x", "y"), [*itertools.product((-20.0, -3.0, 0.0, 11.0, 20.0), repeat=2)])
def test_a_scan_angle_is_twice_the_angle_of_a_real_mirror(x, y):
    found = scan_directions(np.eye(3), np.array([[x, y]]))[0]
    np.testing.assert_allclose(found, through_two_mirrors(x, y), atol=1e-15)


@given(
    st.tuples(st.floats(-360, 360), st.floats(-90, 90)),
    st.lists(st.tuples(st.floats(-80, 80), st.floats(-170, 170)), min_size=1, max_size=20),
)
def test_angles_and_directions_are_inverses_anywhere(boresight, scan_deg):
    frame, scan_deg = degree_frame(*boresight), np.array(scan_deg)
    back = scan_angles_deg(frame, scan_directions(frame, scan_deg))
    np.testing.assert_allclose(back, scan_deg, atol=1e-11)


@pytest.mark.parametrize("elevation", [0.0, 40.0, 89.0, -90.0])
def test_the_boresight_is_the_middle_of_the_rays(elevation):
    generator = np.random.default_rng(3)
    own = degree_frame(10.0, elevation)
    looking = scan_directions(own, generator.uniform([-12, -4], [6, 19], (200, 2)))
    frame = degree_frame(*middle_boresight_deg(looking))
    seen = scan_angles_deg(frame, looking)
    mean = looking.mean(axis=0)
    # without a roll, frames near a pole are turned against the rays
    assert np.abs(seen).max() < (12.0 if abs(elevation) < 80 else 13.0)
    assert np.abs(seen).max() <= np.abs(scan_angles_deg(degree_frame(10.0, elevation), looking)).max()
    assert frame[0] @ mean > 0.9


@given(st.lists(st.tuples(st.floats(0, 5000), st.floats(0, 50)), min_size=1, max_size=30))
def test_whole_picoseconds_hold_the_gate_and_little_more(gates):
    gates = np.array([(start, start + width) for start, width in gates])
    times = gate_ps(gates)
    wide = gate_m(times)
    picosecond = C_M_PER_PS / 2
    rounding = 2e-6 * picosecond
    assert (wide[:, 0] <= gates[:, 0] + rounding).all()
    assert (wide[:, 1] >= gates[:, 1] - rounding).all()
    assert (np.abs(wide - gates) < picosecond + rounding).all()


@given(st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 10**6)), min_size=1, max_size=30))
def test_whole_picoseconds_come_back_as_they_were(times):
    np.testing.assert_array_equal(gate_ps(gate_m(np.array(times))), times)


def test_a_metre_takes_the_time_that_light_takes_forth_and_back():
    np.testing.assert_array_equal(gate_ps(np.array([[1.0, 1.5]])), [[6671, 10007 - 6671]])


# --- the tour


@given(st.lists(st.tuples(st.integers(-5, 5), st.integers(-5, 5)), min_size=0, max_size=40))
def test_a_tour_stops_everywhere_once_even_where_stops_coincide(points):
    points = np.array(points, dtype=float).reshape(-1, 2)
    tour = short_tour(points)
    assert sorted(tour) == list(range(len(points)))
    steps = np.abs(points[tour] - np.roll(points[tour], -1, axis=0)).max(axis=1)
    assert travel(points[tour]) <= travel(points) + 1e-9
    if len(points) > 3:
        assert steps[-1] == steps.max()


def test_scattered_stops_are_toured_nearly_as_shortly_as_is_known_to_be_possible():
    points = np.random.default_rng(5).uniform(-15, 15, (576, 2))
    stops = points[short_tour(points)]
    length = np.linalg.norm(stops - np.roll(stops, -1, axis=0), axis=1).sum()
    # Beardwood, Halton and Hammersley (1959), constant and boundary term of Johnson and McGeoch (1996)
    shortest = 0.7124 * np.sqrt(576 * 30.0**2) * (1 + 0.33 / 576)
    assert length < 1.2 * shortest
    assert travel(stops) < 0.1 * travel(points)


def test_stops_in_a_column_or_a_row_are_toured_along_it():
    for axis in (0, 1):
        points = np.zeros((9, 2))
        points[:, axis] = np.random.default_rng(1).permutation(9)
        assert travel(points[short_tour(points)]) == 16


# --- the file


def test_rays_come_back_in_their_order_with_gates_that_hold_theirs(tmp_path):
    rays = design().rays()
    notes = write_galvo(design(), rays, tmp_path / "f.csv")
    back = read_galvo(tmp_path / "f.csv")
    np.testing.assert_allclose(back.direction, rays.direction, atol=1e-14)
    np.testing.assert_array_equal(back.origin_m, rays.origin_m)
    np.testing.assert_array_equal(back.sensor, rays.sensor)
    assert (back.gate_m[:, 0] <= rays.gate_m[:, 0]).all()
    assert (back.gate_m[:, 1] >= rays.gate_m[:, 1]).all()
    assert np.abs(back.gate_m - rays.gate_m).max() < C_M_PER_PS / 2
    assert sorted(back.time_s) == pytest.approx(np.arange(60) / 600)
    assert "degrees per frame" in notes[0]
    write_galvo(design(), back, tmp_path / "again.csv")
    again = read_galvo(tmp_path / "again.csv")
    np.testing.assert_array_equal(again.gate_m, back.gate_m)
    np.testing.assert_allclose(again.direction, back.direction, atol=1e-14)


def test_sensors_at_other_places_are_positions_of_their_own(tmp_path):
    own = design(sensor("a", 3.0, 0.0), sensor("b", 0.5, -0.9, origin=(0.0, 1.0, 2.0)))
    rays = own.rays()
    notes = write_galvo(own, rays, tmp_path / "f.csv")
    assert any("2 places" in note for note in notes)
    table = np.genfromtxt(tmp_path / "f.csv", delimiter=",", names=True)
    assert (np.diff(table["position"]) >= 0).all()
    np.testing.assert_array_equal(table["sensor"], table["position"])
    np.testing.assert_allclose(read_galvo(tmp_path / "f.csv").direction, rays.direction, atol=1e-14)


def test_rays_of_a_sensor_that_start_at_many_places_are_refused(tmp_path):
    base = design().rays()
    moved = base.origin_m.copy()
    moved[:7, 1] += np.arange(7) * 0.01
    rays = Rays(moved, base.direction, base.gate_m, base.sensor, base.time_s)
    with pytest.raises(ConfigError, match="sensor 'left' start at 7 places") as caught:
        write_galvo(design(), rays, tmp_path / "f.csv")
    assert "origin.fixed_m" in caught.value.hint
    assert not list(tmp_path.iterdir())


def test_rays_out_of_reach_are_refused_with_their_number_and_the_worst(tmp_path):
    wide = design(sensor("a", 2.6, 0.0), sensor("b", 3.6, 0.0))
    with pytest.raises(ConfigError, match=r"\d+ of 60 rays are beyond the mirrors' reach, the farthest at x = -?3\d\."):
        write_galvo(wide, wide.rays(), tmp_path / "f.csv")
    assert not list(tmp_path.iterdir())


def test_rays_exactly_at_the_limit_are_within_reach(tmp_path):
    corners = np.array([[20.0, 20.0], [-20.0, -20.0], [20.0, -20.0], [-20.0, 20.0]])
    looking = scan_directions(degree_frame(180.0, 0.0), corners)
    rays = Rays(np.tile(HERE, (4, 1)), looking, np.tile([0.1, 0.2], (4, 1)), np.zeros(4), np.zeros(4))
    write_galvo(design(sensor("a", np.pi, 0.0)), rays, tmp_path / "f.csv")
    np.testing.assert_allclose(read_galvo(tmp_path / "f.csv").direction, looking, atol=1e-8)


def with_last(text, line):
    return "\n".join([*text.splitlines()[:-1], line, ""])


BROKEN = {
    "another table": (lambda text: "a,b\n1,2\n", "not a ray list of the galvo format"),
    "an empty file": (lambda text: "", "not a ray list"),
    "a unit of another kind": (lambda text: text.replace("x_deg", "x_rad"), "not a ray list"),
    "a ray twice": (lambda text: text + text.splitlines()[1] + "\n", "given twice"),
    "a row cut short": (lambda text: text[:-9], ":61: "),
    "no number": (lambda text: text.replace(",0.4,", ",wide,", 1), r":2:\d+: .*wide"),
    "NaN": (lambda text: text.replace(",0.4,", ",nan,", 1), r":2:\d+: "),
    "a negative gate": (lambda text: with_last(text, "59,0,0,0,0,0,0,0,0,-5,1,0,59"), "gate_start"),
    "mirrors beyond reach": (lambda text: with_last(text, "59,0,0,0,0,0,0,70,0,5,1,0,59"), "x_deg is 70"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_damaged_file_is_refused_where_it_is_damaged(tmp_path, name):
    damage, message = BROKEN[name]
    write_galvo(design(), design().rays(), tmp_path / "f.csv")
    (tmp_path / "f.csv").write_text(damage((tmp_path / "f.csv").read_text()))
    with pytest.raises(DataError, match=message):
        read_galvo(tmp_path / "f.csv")


def test_bytes_that_are_no_text_and_no_file_at_all_are_refused(tmp_path):
    (tmp_path / "f.csv").write_bytes(bytes(range(256)))
    for path in (tmp_path / "f.csv", tmp_path / "absent.csv", tmp_path):
        assert not is_galvo_file(path)
        with pytest.raises(DataError):
            read_galvo(path)
