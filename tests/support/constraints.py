"""Constraint files, and which of them contradict themselves."""

from __future__ import annotations

import math

import numpy as np

from lidardesign.samples import Samples
from lidardesign.space import DesignSpace

FACE = DesignSpace((0.0, 0.0, 0.0, -0.5, -0.5, 0.05), (0.0, 0.0, 0.0, 0.5, 0.5, 1.05))

ROOM = DesignSpace((-1.0, -1.0, 0.0, 0.0, -1.5, 0.1), (1.0, 1.0, 2.0, 2 * math.pi, 1.5, 4.0))

CONTRADICTIONS = {
    "fov": (
        {"field_of_view": {"horizontal_deg": {"min": 20, "max": 10}}},
        ["field_of_view.horizontal_deg.min", "field_of_view.horizontal_deg.max"],
    ),
    "gate start": ({"gate": {"start_m": {"min": 0.5, "max": 0.4}}}, ["gate.start_m.min", "gate.start_m.max"]),
    "gate end": ({"gate": {"end_m": {"min": 0.5, "max": 0.4}}}, ["gate.end_m.min", "gate.end_m.max"]),
    "gate width": ({"gate": {"width_m": {"min": 0.5, "max": 0.4}}}, ["gate.width_m.min", "gate.width_m.max"]),
    "width above end": (
        {"gate": {"width_m": {"min": 0.5}, "end_m": {"max": 0.4}}},
        ["gate.width_m.min", "gate.end_m.max"],
    ),
    "start after end": (
        {"gate": {"start_m": {"min": 0.5}, "end_m": {"max": 0.4}, "width_m": {"min": 0.01}}},
        ["gate.start_m.min", "gate.end_m.max"],
    ),
    "three": (
        {"gate": {"start_m": {"min": 0.5}, "end_m": {"max": 0.8}, "width_m": {"min": 0.4}}},
        ["gate.start_m.min", "gate.width_m.min", "gate.end_m.max"],
    ),
    "too narrow": (
        {"gate": {"start_m": {"max": 0.2}, "end_m": {"min": 0.8}, "width_m": {"max": 0.4}}},
        ["gate.end_m.min", "gate.width_m.max", "gate.start_m.max"],
    ),
    "beyond the space": ({"gate": {"start_m": {"min": 2.0}}}, ["gate.start_m.min", "space.range_m"]),
    "wider than the space": ({"gate": {"width_m": {"min": 2.0}}}, ["gate.width_m.min", "space.range_m"]),
    "roll": ({"boresight": {"roll_deg": {"min": 10, "max": 5}}}, ["boresight.roll_deg.min", "boresight.roll_deg.max"]),
    "elevation": (
        {"boresight": {"elevation_deg": {"min": 10, "max": 5}}},
        ["boresight.elevation_deg.min", "boresight.elevation_deg.max"],
    ),
    "elevation outside": (
        {"boresight": {"elevation_deg": {"min": 60}}},
        ["boresight.elevation_deg.min", "space.elevation_rad"],
    ),
    "azimuth outside": (
        {"boresight": {"azimuth_deg": {"min": 100, "max": 200}}},
        ["boresight.azimuth_deg.min", "boresight.azimuth_deg.max", "space.azimuth_rad"],
    ),
    "origin outside": ({"origin": {"fixed_m": [0, 0, 1]}}, ["origin.fixed_m", "space.z_m"]),
    "box": ({"origin": {"low_m": [1, 0, 0], "high_m": [0, 0, 0]}}, ["origin.low_m", "space.x_m"]),
    "rays": ({"sensors": {"count": 4}, "budget": {"rays": 3}}, ["budget.rays", "sensors.count"]),
    "sensors": ({"sensors": {"min": 4, "max": 3}}, ["sensors.min", "sensors.max"]),
    "each": ({"sensors": {"count": 1}, "each": [{}, {}]}, ["each", "sensors.count"]),
    "bandwidth": (
        {"budget": {"rays": 576, "bandwidth_mbps": 0.1}},
        ["budget.rays", "budget.bandwidth_mbps"],
    ),
    "bandwidth of wide gates": (
        {"budget": {"rays": 100, "bandwidth_mbps": 0.1}, "gate": {"width_m": {"min": 0.5}}},
        ["budget.rays", "budget.bandwidth_mbps", "gate.width_m.min"],
    ),
    "one sensor of each": (
        {"gate": {"width_m": {"min": 0.2}}, "each": [{}, {"gate": {"width_m": {"max": 0.1}}}]},
        ["gate.width_m.min", "each[1].gate.width_m.max"],
    ),
}


def room_samples(count=6000):
    generator = np.random.default_rng(0)
    points = ROOM.sample(count, generator)
    return Samples(points, np.zeros(count), generator.normal(0, 0.5, count), ROOM)


SAMPLES = room_samples()
