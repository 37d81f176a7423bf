"""Exports: what is written is what the rays are, whole files only, and honest notes of what is lost."""

from __future__ import annotations

import numpy as np
import pytest
from support.exports import write_as
from support.sensors import normal_sensor

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
    notes = write_as(name, DESIGN, rays, path)
    columns = read(path)
    np.testing.assert_array_equal(np.stack([columns[f"origin_{a}_m"] for a in "xyz"], 1), rays.origin_m)
    np.testing.assert_array_equal(np.stack([columns[f"direction_{a}"] for a in "xyz"], 1), rays.direction)
    gate = np.stack([columns["gate_start_m"], columns["gate_end_m"]], 1)
    np.testing.assert_array_equal(gate, rays.gate_m)
    np.testing.assert_array_equal(columns["sensor"], rays.sensor)
    np.testing.assert_array_equal(columns["time_s"], rays.time_s)
    assert any("covariances" in note for note in notes)
    assert any("constraints" in note for note in notes)
