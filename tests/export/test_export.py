"""Exports: what is written is what the rays are, whole files only, and honest notes of what is lost."""

from __future__ import annotations

import numpy as np
import pytest
from support.sensors import normal_sensor

from lidardesign.errors import DataError
from lidardesign.formats.registry import EXPORTERS
from lidardesign.sensors.design import DesignSpec

SENSORS = tuple(
    normal_sensor(f"s{i}, größe", 0.5, (0.1 * i, -0.2, 1 / 3), i * 2.0, -0.7 * i, origin_covariance_m2=np.eye(3))
    for i in range(2)
)
DESIGN = DesignSpec("two", SENSORS, constraints={"gate": {"width_m": {"max": 1.0}}, "budget": {"rays": 37}})


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
    rays = DESIGN.rays(count)
    path = tmp_path / "out"
    notes = EXPORTERS[name].write(DESIGN, rays, path)
    columns = read(path)
    np.testing.assert_array_equal(np.stack([columns[f"origin_{a}_m"] for a in "xyz"], 1), rays.origin_m)
    np.testing.assert_array_equal(np.stack([columns[f"direction_{a}"] for a in "xyz"], 1), rays.direction)
    gate = np.stack([columns["gate_start_m"], columns["gate_end_m"]], 1)
    np.testing.assert_array_equal(gate, rays.gate_m)
    np.testing.assert_array_equal(columns["sensor"], rays.sensor)
    np.testing.assert_array_equal(columns["time_s"], rays.time_s)
    assert any("covariances" in note for note in notes)
    assert any("constraints" in note for note in notes)


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
    exporter.write(DESIGN, DESIGN.rays(), path)
    assert path.is_dir() == exporter.folder
    first = contents(path)
    exporter.write(DESIGN, DESIGN.rays(), path)
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
        exporter.write(DESIGN, DESIGN.rays(), path)
    assert contents(path) == ({".": b"mine"} if exporter.folder else {})
