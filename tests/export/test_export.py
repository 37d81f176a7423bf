"""Exports: what is written is what the rays are, whole files only, and honest notes of what is lost."""

from __future__ import annotations

import numpy as np
import pytest
from support.sensors import normal_sensor

from lidardesign.errors import DataError
from lidardesign.formats.designs import load_design
from lidardesign.formats.galvo import SPEED_OF_LIGHT_M_PER_PS, read_galvo
from lidardesign.formats.registry import EXPORTERS
from lidardesign.sensors.compare import angles_between
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import interval_factor


def design(count=2):
    sensors = tuple(
        normal_sensor(
            f"s{i}, größe", 1 / count, (0.1 * i, -0.2, 1 / 3), i * 2.0, -0.7 * i, origin_covariance_m2=np.eye(3)
        )
        for i in range(count)
    )
    return DesignSpec("two", sensors, constraints={"gate": {"width_m": {"max": 1.0}}, "budget": {"rays": 37}})


def read_csv(path):
    header, *rows = path.read_text(encoding="utf-8").splitlines()
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows]).reshape(-1, len(header.split(",")))
    return dict(zip(header.split(","), values.T, strict=True))


def read_npz(path):
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)


@pytest.mark.parametrize(("name", "read"), [("csv", read_csv), ("npz", read_npz)])
@pytest.mark.parametrize("count", [0, 1, 37])
def test_a_ray_list_comes_back_to_the_last_bit(tmp_path, name, read, count):
    rays = design().rays(count)
    path = tmp_path / "out"
    notes = EXPORTERS[name].write(design(), rays, path)
    columns = read(path)
    np.testing.assert_array_equal(np.stack([columns[f"origin_{a}_m"] for a in "xyz"], 1), rays.origin_m)
    np.testing.assert_array_equal(np.stack([columns[f"direction_{a}"] for a in "xyz"], 1), rays.direction)
    gate = np.stack([columns["gate_start_m"], columns["gate_end_m"]], 1)
    np.testing.assert_array_equal(gate, rays.gate_m)
    np.testing.assert_array_equal(columns["sensor"], rays.sensor)
    np.testing.assert_array_equal(columns["time_s"], rays.time_s)
    assert any("covariances" in note for note in notes)
    assert any("constraints" in note for note in notes)


def test_the_sensor_table_is_a_design_again(tmp_path):
    path = tmp_path / "two.csv"
    notes = EXPORTERS["sensors-csv"].write(design(), design().rays(), path)
    assert any("37 rays" in note for note in notes)
    loaded = load_design(path)
    np.testing.assert_allclose(loaded.rays(37).direction, design().rays().direction, atol=1e-12)


def contents(path):
    """Every file of an export by its place in it; a single file has none."""
    files = [file for file in sorted(path.rglob("*")) if file.is_file()] if path.is_dir() else [path]
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


@pytest.mark.parametrize("name", EXPORTERS)
def test_every_format_is_written_whole_or_not_at_all(tmp_path, name):
    exporter = EXPORTERS[name]
    assert exporter.name == name
    assert exporter.suffix.startswith(".")
    path = tmp_path / f"a design{exporter.suffix}"
    exporter.write(design(), design().rays(), path)
    assert path.is_dir() == exporter.folder
    first = contents(path)
    exporter.write(design(), design().rays(), path)
    assert contents(path) == first
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", EXPORTERS)
def test_a_file_is_never_written_over_a_folder_nor_a_folder_over_a_file(tmp_path, name):
    exporter, path = EXPORTERS[name], tmp_path / "taken"
    if exporter.folder:
        path.write_text("mine", encoding="utf-8")
    else:
        path.mkdir()
    with pytest.raises(DataError, match="taken"):
        exporter.write(design(), design().rays(), path)
    assert contents(path) == ({".": b"mine"} if exporter.folder else {})


ROUNDING = 1e-15


def plain_design(roll=0.0):
    sensors = tuple(
        normal_sensor(f"s{i}", 0.5, (0.1, -0.2, 1 / 3), 0.1 * i, -0.07, roll, (0.05, 0.02)) for i in range(2)
    )
    return DesignSpec("two", sensors)


RAYS = plain_design().rays(37)


def test_a_scanners_gates_are_off_by_less_than_a_picosecond(tmp_path):
    path = tmp_path / "two.galvo.csv"
    notes = EXPORTERS["galvo"].write(plain_design(), RAYS, path)
    found = read_galvo(path)
    assert 0 < np.abs(found.gate_m - RAYS.gate_m).max() <= SPEED_OF_LIGHT_M_PER_PS
    assert angles_between(found.direction, RAYS.direction).max() < ROUNDING
    np.testing.assert_array_equal(found.origin_m, RAYS.origin_m)
    assert any("whole picoseconds" in note for note in notes)


@pytest.mark.parametrize(("roll", "spread_rad"), [(0.0, 0.05), (np.pi / 2, 0.02)])
def test_a_roll_that_a_table_cannot_hold_is_told_and_stays_in_its_spreads(tmp_path, roll, spread_rad):
    path = tmp_path / "two.csv"
    notes = EXPORTERS["sensors-csv"].write(plain_design(roll), RAYS, path)
    assert any("roll is lost" in note for note in notes) == (roll != 0)
    for one in load_design(path).sensors:
        assert one.field_of_view_rad[0] == pytest.approx(2 * interval_factor(0.95) * spread_rad, abs=ROUNDING)
