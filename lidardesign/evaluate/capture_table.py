"""What every ray measured in a capture, as CSV: one row per ray, gate and design."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.evaluate.capture_scan import Captured
from lidardesign.run.files import write_atomic

if TYPE_CHECKING:
    from lidardesign.evaluate.capture_score import CaptureEvaluation, CaptureRow

COLUMNS = (
    "design", "gate", "ray", "sensor", "captured", "pixel", "away_deg", "gate_start_m", "gate_end_m", "photons",
    "range_m", "reference_m", "outlier",
    "point_x_m", "point_y_m", "point_z_m",
)  # fmt: skip


def write_csv(found: CaptureEvaluation, path: Path) -> None:
    """Write the file, atomically; a cell is empty where there is no return, pixel or reference."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in found.rows:
        writer.writerows(_lines(row))
    write_atomic(path, text.getvalue())


def _lines(row: CaptureRow) -> list[list[object]]:
    scan = row.scan
    away = np.degrees(scan.away_rad)
    return [
        [
            row.design, row.gate, ray, int(row.rays.sensor[ray]), Captured(scan.captured[ray]).name.lower(),
            int(scan.pixel[ray]) if scan.pixel[ray] >= 0 else "", repr(float(away[ray])),
            *map(repr, row.rays.gate_m[ray].tolist()), int(scan.photons[ray]),
            _cell(scan.range_m[ray]), _cell(row.reference_m[ray]), int(row.outlier[ray]),
            *(_cell(value) for value in scan.points_m[ray]),
        ]
        for ray in range(len(row.rays))
    ]  # fmt: skip


def _cell(value: float) -> str:
    return "" if np.isnan(value) else repr(float(value))
