"""Sensors written by hand at the edge of what makes sense: an answer in numbers or a refusal, no warning between."""

from __future__ import annotations

import numpy as np
import pytest
from lidardesign.layouts.rays import lay_out
from support.tables import each_row

from lidardesign.errors import ConfigError
from lidardesign.sensors.design_file import design_from_document

COUPLING = {
    "direction_rad_per_m": [[0.0, 0.1, 0.0], [0.1, 0.0, 0.0]],
    "range_m_per_m": [0.1, 0.0, 0.0],
    "range_m_per_rad": [0.0, 0.0],
    "spread_rad": [0.01, 0.01],
    "spread_m": 0.01,
}


def written(**changes):
    """The document of one sensor that is spread along x, its rays starting across it."""
    sensor = {
        "origin_m": {"mean": [0.0, 0.0, 1.0], "covariance": [[0.04, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.0]]},
        "boresight": {"azimuth_rad": 0.0, "elevation_rad": -1.5},
        "spread": {"horizontal_rad": 0.1, "vertical_rad": 0.1, "range_m": 0.1},
        "range_m": 1.0,
        **changes,
    }
    return {"schema_version": 1, "layout": "distributed", "sensors": [sensor]}


MISTAKES = {
    "one row": ("direction_rad_per_m", [[0.0, 0.0, 0.0]], "1 rows"),
    "two columns": ("direction_rad_per_m", [[0.0, 0.0], [0.0, 0.0]], "2 numbers"),
    "flat": ("direction_rad_per_m", [0.0, 0.0], "a list"),
    "nan": ("range_m_per_rad", [float("nan"), 0.0], "a number"),
    "negative spread": ("spread_rad", [-0.1, 0.1], "at least 0"),
    "negative depth": ("spread_m", -1.0, "at least 0"),
}


@each_row("mistake", MISTAKES)
def test_a_mistake_in_a_coupling_is_refused_in_words(mistake):
    key, value, words = MISTAKES[mistake]
    with pytest.raises(ConfigError, match=words):
        design_from_document(written(coupling={**COUPLING, key: value}))


@pytest.mark.parametrize("direction", [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
def test_a_travel_across_the_covariance_is_refused(direction):
    longest = {"length": design_from_document(written()).sensors[0].travel_m[0]}
    assert design_from_document(written(travel_m={**longest, "direction": [-2.0, 0.0, 0.0]}))
    with pytest.raises(ConfigError, match="direction in which"):
        design_from_document(written(travel_m={**longest, "direction": direction}))


def test_a_sensor_whose_field_has_no_width_fires_along_its_boresight():
    still = {"horizontal_rad": 0.0, "vertical_rad": 0.0, "range_m": 0.1}
    design = design_from_document(written(spread=still, origin_m={"mean": [0.0, 0.0, 1.0]}))
    rays = lay_out(design, 5)
    np.testing.assert_allclose(rays.direction, np.tile(design.sensors[0].boresight, (5, 1)), atol=1e-12)


def test_a_gate_without_a_width_is_refused():
    with pytest.raises(ConfigError, match="a gate that has a width"):
        design_from_document(written(spread={"horizontal_rad": 0.1, "vertical_rad": 0.1, "range_m": 0.0}))


def test_a_ray_table_without_a_ray_is_refused():
    keys = ("origin_x_m", "origin_y_m", "origin_z_m", "azimuth_rad", "elevation_rad", "gate_start_m", "gate_end_m")
    document = {**written(), "ray_table": {key: [] for key in (*keys, "sensor")}}
    with pytest.raises(ConfigError, match=r"ray_table.sensor is empty"):
        design_from_document(document)
