"""What exported numbers lose is measured on the file itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.tables import each_row

from lidardesign.design.galvo import SPEED_OF_LIGHT_M_PER_PS
from lidardesign.design.layouts.rays import lay_out
from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.errors import DataError
from lidardesign.export.common.poses import angles_between, rays_rounding
from lidardesign.export.ray_lists import read_csv, read_npz
from lidardesign.export.registry import EXPORTERS

ROUNDING = 1e-15


def design(roll=0.0):
    sensors = tuple(
        Sensor(f"s{i}", 0.5, np.array([0.1, -0.2, 1 / 3]), np.zeros((3, 3)), 0.1 * i, -0.07, roll, 0.05, 0.02, 1.0, 0.1)
        for i in range(2)
    )
    return DesignSpec("two", sensors, rays=37)


RAYS = lay_out(design(), 37)


@each_row("name", EXPORTERS)
def test_every_format_says_what_its_numbers_lose(tmp_path, name):
    path = tmp_path / "out"
    EXPORTERS[name].write(design(), RAYS, path)
    found = EXPORTERS[name].rounding(design(), RAYS, path)
    assert {"origin_m", "direction_rad"} <= set(found)
    assert all(estimate.kind == "rounding" and np.isfinite(estimate.error) for estimate in found.values())
    if name in ("csv", "npz"):
        assert {key: estimate.error for key, estimate in found.items()} == dict.fromkeys(
            ("origin_m", "direction_rad", "gate_m", "time_s"), 0.0
        )


@each_row(("name", "read"), [("csv", read_csv), ("npz", read_npz)])
@each_row("count", [0, 1, 37])
def test_ray_lists_are_read_as_they_were(tmp_path, name, read, count):
    rays = RAYS.subset(np.arange(count))
    EXPORTERS[name].write(design(), rays, tmp_path / "rays")
    found = read(tmp_path / "rays")
    for name in ("origin_m", "direction", "gate_m", "sensor", "time_s"):
        np.testing.assert_array_equal(getattr(found, name), getattr(rays, name))


def test_a_scanners_gates_are_off_by_less_than_a_picosecond(tmp_path):
    path = tmp_path / "two.galvo.csv"
    EXPORTERS["galvo"].write(design(), RAYS, path)
    found = EXPORTERS["galvo"].rounding(design(), RAYS, path)
    assert 0 < found["gate_m"].error <= SPEED_OF_LIGHT_M_PER_PS / 2
    assert found["direction_rad"].error < ROUNDING
    assert found["origin_m"].error == 0
    assert "time_s" not in found


def test_a_roll_that_a_table_cannot_hold_shows_in_its_spreads(tmp_path):
    path = tmp_path / "two.csv"
    exporter = EXPORTERS["sensors-csv"]
    exporter.write(design(), RAYS, path)
    assert exporter.rounding(design(), RAYS, path)["spread_rad"].error < ROUNDING
    exporter.write(design(roll=np.pi / 2), RAYS, path)
    assert exporter.rounding(design(roll=np.pi / 2), RAYS, path)["spread_rad"].error == pytest.approx(0.03)


def test_differences_are_the_largest_of_their_kind():
    moved = replace(RAYS, origin_m=RAYS.origin_m + np.array([3e-3, 0, 4e-3]), gate_m=RAYS.gate_m + np.array([0, 0.25]))
    found = rays_rounding(RAYS, moved, None)
    assert found["origin_m"].error == pytest.approx(5e-3)
    assert found["gate_m"].error == pytest.approx(0.25)
    assert found["direction_rad"].error == 0


@each_row("angle", [1e-12, 1e-6, 0.3, np.pi])
def test_angles_are_exact_from_the_smallest_to_the_largest(angle):
    first, second = np.array([[1.0, 0, 0]]), np.array([[np.cos(angle), np.sin(angle), 0]])
    assert angles_between(first, second)[0] == pytest.approx(angle, rel=1e-7)


@each_row("name", ["csv", "npz"])
def test_damage_is_found(tmp_path, name):
    path = tmp_path / "rays"
    EXPORTERS[name].write(design(), RAYS, path)
    whole = path.read_bytes()
    for damage in (b"", b"nonsense", whole[: len(whole) // 2]):
        path.write_bytes(damage)
        with pytest.raises(DataError, match="rays"):
            EXPORTERS[name].rounding(design(), RAYS, path)
    EXPORTERS[name].write(design(), RAYS.subset(np.arange(5)), path)
    with pytest.raises(DataError, match="5 of 37 rays"):
        EXPORTERS[name].rounding(design(), RAYS, path)
