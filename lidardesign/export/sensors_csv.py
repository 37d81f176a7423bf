"""The sensors as the research code's 16-column table; it holds sensors, not rays."""

from __future__ import annotations

from pathlib import Path

from lidardesign.design.rigs.sensor_csv import read_sensor_csv, write_sensor_csv
from lidardesign.design.sensor import DesignSpec
from lidardesign.estimates import Estimate
from lidardesign.export.common.read_back import sensors_rounding
from lidardesign.geometry.rays import Rays


def write(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the file, atomically; returns notes of what the format cannot hold."""
    notes = write_sensor_csv(design, path)
    return [*notes, f"the {len(rays)} rays are not held"] if len(rays) else notes


def rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose; spreads of rolled sensors are those along azimuth and elevation."""
    return sensors_rounding(design.sensors, read_sensor_csv(path).sensors, path)
