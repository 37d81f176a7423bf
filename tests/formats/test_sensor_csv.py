"""The research code's sensor table: exact round trips, spreads on the sphere, and errors with positions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.sensors import normal_sensor
from support.strategies import sensors

from lidardesign.errors import ConfigError, DataError
from lidardesign.formats.designs import load_design
from lidardesign.formats.ray_lists import SENSOR_COLUMNS, begins_as_sensor_csv, read_sensor_csv, write_sensor_csv
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import DEFAULT_LEVEL, interval_factor, tangent_coordinates
from lidardesign.space import direction

ROW = "3,0,0,3.14,0.1,1.2,0.04,0.01,0,0.09,0.02,0.05,0.2,0.1,0.3,1"
HEADER = ",".join(SENSOR_COLUMNS)


@st.composite
def designs(draw):
    raw = np.array(draw(st.lists(st.floats(0.01, 1), min_size=1, max_size=5)))
    drawn = [
        draw(sensors(f"sensor_{index + 1}", float(weight), steepest=1.3, widest=1.5))
        for index, weight in enumerate(raw / raw.sum())
    ]
    return DesignSpec("table", tuple(replace(sensor, roll_rad=0.0) for sensor in drawn))


FIELDS = (
    "weight", "origin_m", "covariance_m2", "azimuth_rad", "elevation_rad", "roll_rad", "field_of_view_rad", "gate_m",
)  # fmt: skip
Z = interval_factor(DEFAULT_LEVEL)


def spreads_of(sensor):
    return tuple(angle / (2 * Z) for angle in sensor.field_of_view_rad)


@settings(max_examples=60, deadline=None)
@given(design=designs())
def test_sensors_come_back_from_the_table(design, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "table.csv"
    write_sensor_csv(design, (), path)
    loaded = load_design(path)
    assert loaded.name == "table"
    for before, after in zip(design.sensors, loaded.sensors, strict=True):
        for field in FIELDS:
            np.testing.assert_allclose(getattr(after, field), getattr(before, field), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("elevation", [-1.2, 0.0, 0.9])
def test_an_azimuth_sigma_is_the_angle_that_it_spans_on_the_sphere(tmp_path, elevation):
    path = tmp_path / "one.csv"
    sigma = 1e-4
    cells = ROW.split(",")
    cells[4], cells[12] = repr(elevation), repr(sigma)
    path.write_text(",".join(cells))
    sensor = read_sensor_csv(path).sensors[0]
    beside = tangent_coordinates(sensor.frame, direction(np.array([3.14 + sigma]), np.array([elevation])))
    assert spreads_of(sensor)[0] == pytest.approx(beside[0, 0], rel=1e-6)
    assert sensor.gate_m == pytest.approx((1.2 - Z * 0.3, 1.2 + Z * 0.3))


def test_the_header_the_order_of_named_columns_and_a_byte_order_mark_do_not_matter(tmp_path):
    plain, shuffled = tmp_path / "plain.csv", tmp_path / "shuffled.csv"
    plain.write_text(f"\n{ROW}\n\n")
    order = np.random.default_rng(0).permutation(16)
    rows = [[line.split(",")[i] for i in order] for line in (HEADER, ROW)]
    shuffled.write_text("\ufeff" + "\r\n".join(" , ".join(row) for row in rows), encoding="utf-8")
    assert begins_as_sensor_csv(shuffled.read_bytes())
    first, second = load_design(plain).sensors[0], load_design(shuffled).sensors[0]
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


def test_weights_are_normalised_with_a_note(tmp_path):
    path = tmp_path / "w.csv"
    path.write_text(f"{ROW}\n{ROW[:-1]}3\n")
    design = read_sensor_csv(path)
    assert [s.weight for s in design.sensors] == [0.25, 0.75]
    assert "normalised" in design.provenance["notes"][0]
    path.write_text(f"{ROW[:-1]}0.5\n{ROW[:-1]}0.5\n")
    assert read_sensor_csv(path).provenance["notes"] == []


def test_the_moving_robots_variant_is_read_at_one_position_and_refused_at_several(tmp_path):
    path = tmp_path / "warehouse.csv"
    path.write_text(f"x_query,{HEADER}\n1.2,{ROW}\n1.2,{ROW}\n")
    design = load_design(path)
    assert len(design.sensors) == 2
    assert "x_query = 1.2" in design.provenance["notes"][0]
    for text in (f"x_query,{HEADER}\n0,{ROW}\n1.2,{ROW}\n", f"0,{ROW}\n1.2,{ROW}\n"):
        path.write_text(text)
        with pytest.raises(DataError, match=r"2 positions .*x_query = 0, 1\.2"):
            load_design(path)


@pytest.mark.parametrize(
    ("pose", "word", "spreads"),
    [
        # the azimuth's spread is cut at a turn
        ({"azimuth_rad": 0.5, "elevation_rad": -math.pi / 2}, "pole", (None, 0.1)),
        ({"roll_rad": math.pi / 2}, "roll", (0.1, 0.2)),
    ],
)
def test_poses_that_the_table_cannot_hold_are_told(tmp_path, pose, word, spreads):
    sensor = normal_sensor("one", spread_rad=(0.2, 0.1), **pose)
    assert any(word in note for note in write_sensor_csv(DesignSpec("d", (sensor,)), (), tmp_path / "d.csv"))
    loaded = load_design(tmp_path / "d.csv").sensors[0]
    assert loaded.elevation_rad == sensor.elevation_rad
    for found, spread in zip(spreads_of(loaded), spreads, strict=True):
        assert np.isfinite(found) if spread is None else found == pytest.approx(spread)


@pytest.mark.parametrize(
    ("text", "position", "says"),
    [
        (ROW.replace("3.14", "abc"), ":1:4", "azimuth_mean is 'abc'"),
        (ROW.replace("3.14", "nan"), ":1:4", "finite"),
        (ROW.replace("3.14", ""), ":1:4", "azimuth_mean is ''"),
        (f"{HEADER}\n{ROW}\n{ROW.replace('0.3,1', '-0.3,1')}", ":3:15", "time_sigma"),
        (f"{HEADER}\n{ROW[:-1]}-1", ":2:16", "at least 0"),
        (f"{HEADER}\n{ROW[:-2]}", ":2", "15 columns"),
        (ROW.replace("0.1,1.2", "1.7,1.2"), ":1", "elevation_mean"),
        (ROW.replace("0.04,0.01", "0.04,0.9"), ":1", "eigenvalue"),
        (ROW[:-1] + "0", "", "sum to 0"),
        (ROW.replace(",0.3,1", ",0,1"), ":1", "no width"),
        (HEADER, "", "no sensor"),
        (f"{HEADER.replace('weight', 'wieght')}\n{ROW}", ":1", "unknown or repeated: wieght"),
        (f"{HEADER.replace('weight', 'time_sigma')}\n{ROW}", ":1", "missing columns: weight"),
    ],
)
def test_a_bad_table_is_refused_with_its_position(tmp_path, text, position, says):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        load_design(path)
    assert f"bad.csv{position}: " in str(caught.value)
    assert says in str(caught.value)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("text", ["schema_version: 2\nsensors: [1, 2]\n", "a: 1, 2", "{a: 1, b: 2}", "[1, 2]", "- 1"])
def test_yaml_is_not_taken_for_a_table(tmp_path, text):
    assert not begins_as_sensor_csv(text.encode())
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(ConfigError):
        load_design(path)
