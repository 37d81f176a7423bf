r"""The research code's sensor table: one sensor per row, 16 columns, metres and radians.

Its angular columns are standard deviations of azimuth and elevation. On the sphere a step of azimuth is
cos(elevation) as long, so spread_horizontal = azimuth_sigma * cos(elevation), spread_vertical =
elevation_sigma (to first order in the spread, without roll). `time` is the one-way range in metres.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidardesign.design.rigs.rig import LARGEST_TABLE_BYTES, number_of
from lidardesign.design.sensor import DEFAULT_LEVEL, DesignSpec, Sensor
from lidardesign.errors import DataError
from lidardesign.numerics import COARSE_SLACK, SLACK
from lidardesign.run.arrays import csv_rows
from lidardesign.run.files import write_atomic
from lidardesign.space import FULL_TURN

COLUMNS = (
    "origin_x", "origin_y", "origin_z", "azimuth_mean", "elevation_mean", "time_mean",
    "orig_cov_xx", "orig_cov_xy", "orig_cov_xz", "orig_cov_yy", "orig_cov_yz", "orig_cov_zz",
    "azimuth_sigma", "elevation_sigma", "time_sigma", "weight",
)  # fmt: skip
QUERY_COLUMN = "x_query"
YAML_BEGINNINGS = ("{", "[", "- ", "#", "%")
NOT_NEGATIVE = ("time_mean", "azimuth_sigma", "elevation_sigma", "time_sigma", "weight")
# An elevation may exceed a right angle by its rounding in a file of few digits.
ELEVATION_ROUNDING = COARSE_SLACK
COVARIANCE_ROUNDING = COARSE_SLACK
WEIGHT_SUM_TOLERANCE = SLACK


def begins_as_sensor_csv(head: bytes) -> bool:
    """Whether a file begins with a line of comma-separated cells that no YAML mapping begins with."""
    text = head.decode("utf-8-sig", errors="replace")
    first = next((line.strip() for line in text.splitlines() if line.strip()), "")
    return "," in first and ":" not in first and not first.startswith(YAML_BEGINNINGS)


def read_sensor_csv(path: Path) -> DesignSpec:
    """Read a sensor table; the header is optional, weights are normalised (noted in the provenance).

    The variant with a first column x_query describes a moving robot; it is read where it has one position.

    Raises:
        DataError: The file cannot be read, or a cell cannot be used; with file, line and column (exit 3).
    """
    path = Path(path)
    rows, notes = _rows(path)
    sensors = [_sensor(row, index, where) for index, (row, where) in enumerate(rows)]
    total = math.fsum(sensor.weight for sensor in sensors)
    if not total > 0:
        raise DataError("the weights sum to 0", where=str(path), allowed="at least one weight above 0")
    if abs(total - 1) > WEIGHT_SUM_TOLERANCE:
        notes.append(f"weights summed to {total:.6g} and were normalised")
        sensors = [replace(sensor, weight=sensor.weight / total) for sensor in sensors]
    provenance = {"source": path.name, "format": "sensor CSV of the research code", "notes": notes}
    return DesignSpec(name=path.stem, sensors=tuple(sensors), provenance=provenance)


def _rows(path: Path) -> tuple[list[tuple[dict[str, float], str]], list[str]]:
    """Numbers by column name and the position of each row, with notes."""
    lines = csv_rows(path, LARGEST_TABLE_BYTES)
    if not lines:
        raise DataError("is empty", where=str(path), allowed=f"rows of {len(COLUMNS)} columns")
    first = [cell.strip() for cell in lines[0][1]]
    if any(number_of(cell) is not None for cell in first):
        names = COLUMNS if len(first) != len(COLUMNS) + 1 else (QUERY_COLUMN, *COLUMNS)
    else:
        names = tuple(first)
        missing = [name for name in COLUMNS if name not in names]
        unknown = [name for name in names if name not in (*COLUMNS, QUERY_COLUMN)]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if missing or unknown or repeated:
            wrong = {"missing columns": missing, "unknown or repeated": [*unknown, *repeated]}
            found = "; ".join(f"{what}: {', '.join(columns)}" for what, columns in wrong.items() if columns)
            raise DataError(found, where=f"{path}:{lines[0][0]}", allowed=", ".join(COLUMNS))
        lines = lines[1:]
    if not lines:
        raise DataError("has a header but no sensor", where=str(path))
    rows = [(_numbers(f"{path}:{number}", cells, names), f"{path}:{number}") for number, cells in lines]
    notes: list[str] = []
    if QUERY_COLUMN in names:
        positions = sorted({row[QUERY_COLUMN] for row, _ in rows})
        if len(positions) > 1:
            values = ", ".join(f"{value:g}" for value in positions)
            raise DataError(
                f"describes {len(positions)} positions of a moving robot ({QUERY_COLUMN} = {values})",
                where=str(path), allowed="one position per file", hint="keep the rows of one position",
            )  # fmt: skip
        notes.append(f"{QUERY_COLUMN} = {positions[0]!r} was dropped")
    return rows, notes


def _numbers(where: str, cells: list[str], names: tuple[str, ...]) -> dict[str, float]:
    """The numbers of a row by column."""
    if len(cells) != len(names):
        raise DataError(f"{len(cells)} columns", where=where, allowed=f"{len(names)}: {', '.join(names)}")
    row = {}
    for column, (name, text) in enumerate(zip(names, cells, strict=True), 1):
        low, value = 0.0 if name in NOT_NEGATIVE else -math.inf, number_of(text)
        if value is None or not math.isfinite(value) or value < low:
            allowed = "a finite number" if math.isinf(low) else "a finite number of at least 0"
            raise DataError(f"{name} is {text.strip()!r}", where=f"{where}:{column}", allowed=allowed)
        row[name] = value
    return row


def _sensor(row: dict[str, float], index: int, where: str) -> Sensor:
    elevation = row["elevation_mean"]
    if abs(elevation) > math.pi / 2 + ELEVATION_ROUNDING:
        allowed = "radians from -pi/2 to pi/2"
        raise DataError(f"elevation_mean is {elevation!r}", where=where, allowed=allowed)
    elevation = min(max(elevation, -math.pi / 2), math.pi / 2)
    xx, xy, xz, yy, yz, zz = (row[name] for name in COLUMNS[6:12])
    covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if np.linalg.eigvalsh(covariance).min() < -COVARIANCE_ROUNDING * np.abs(covariance).max():
        raise DataError("the origin covariance has a negative eigenvalue", where=where)
    return Sensor(
        name=f"sensor_{index + 1}",
        weight=row["weight"],
        origin_m=np.array([row[name] for name in COLUMNS[:3]]),
        origin_covariance_m2=covariance,
        azimuth_rad=row["azimuth_mean"],
        elevation_rad=elevation,
        roll_rad=0.0,
        spread_horizontal_rad=row["azimuth_sigma"] * math.cos(elevation),
        spread_vertical_rad=row["elevation_sigma"],
        range_m=row["time_mean"],
        spread_range_m=row["time_sigma"],
    )


def write_sensor_csv(design: DesignSpec, path: Path) -> list[str]:
    """Write a sensor table with its header, atomically; returns what the table cannot hold."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    notes = ["names, ray counts, layout, constraints and provenance are not held; a reader takes level 0.95"]
    if design.level != DEFAULT_LEVEL:
        notes.append(f"the level {design.level:g} is not held: intervals are read back at {DEFAULT_LEVEL:g}")
    if design.ray_table is not None:
        notes.append("the explicit rays of the layout are not held")
    if any(sensor.roll_rad for sensor in design.sensors):
        notes.append("roll is not held: spreads are those along azimuth and elevation")
    if any(sensor.coupling is not None for sensor in design.sensors):
        notes.append("couplings are not held: direction and range are read back as independent of the origin")
    for sensor in design.sensors:
        azimuth_sigma, elevation_sigma = sensor.spread_horizontal_rad, sensor.spread_vertical_rad
        if sensor.roll_rad != 0:
            # the spreads along azimuth and elevation of a sensor that is rolled about its boresight
            horizontal, vertical = azimuth_sigma, elevation_sigma
            cosine, sine = math.cos(sensor.roll_rad), math.sin(sensor.roll_rad)
            azimuth_sigma = math.hypot(cosine * horizontal, sine * vertical)
            elevation_sigma = math.hypot(sine * horizontal, cosine * vertical)
        cosine = math.cos(sensor.elevation_rad)
        if azimuth_sigma >= cosine * FULL_TURN:
            # towards a pole the azimuth covers the whole turn, and no standard deviation beyond a turn says more
            if azimuth_sigma > 0:
                notes.append(f"{sensor.name} points at a pole: its azimuth spread was cut at a full turn")
            azimuth_sigma = FULL_TURN
        else:
            azimuth_sigma /= cosine
        upper = np.asarray(sensor.origin_covariance_m2)[np.triu_indices(3)]
        row = [
            *sensor.origin_m, sensor.azimuth_rad, sensor.elevation_rad, sensor.range_m, *upper,
            azimuth_sigma, elevation_sigma, sensor.spread_range_m, sensor.weight,
        ]  # fmt: skip
        writer.writerow([repr(float(value)) for value in row])
    write_atomic(Path(path), buffer.getvalue())
    return notes
