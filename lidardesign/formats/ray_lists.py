"""Rays and sensors as tables (CSV and NPZ), as `export` and other programs write them.

A ray needs a direction: azimuth and elevation, or a vector of any length. Origin, start of the gate and sensor are
optional; the end of the gate only where a reach is given otherwise.

The research code's sensor table: one sensor per row, 16 columns, metres and radians.

Its angular columns are standard deviations of azimuth and elevation. On the sphere a step of azimuth is
cos(elevation) as long, so spread_horizontal = azimuth_sigma * cos(elevation), spread_vertical =
elevation_sigma (to first order in the spread, without roll). `time` is the one-way range in metres.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidardesign.errors import DataError
from lidardesign.formats import ADAPTIVE, RAYS, Format
from lidardesign.formats.rig import MOST_SENSORS, Rig, RigSensor, indices_by_owner, number_of
from lidardesign.limits import MOST_RAYS
from lidardesign.numerics import COARSE_SLACK, SLACK
from lidardesign.run.arrays import NUMERIC_KINDS, csv_rows, csv_table, read_npz
from lidardesign.run.files import write_atomic
from lidardesign.run.inputs import RAY_TABLE
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor, interval_factor
from lidardesign.space import FULL_TURN, MOST_TURNS, angles, direction

ORIGIN = ("origin_x_m", "origin_y_m", "origin_z_m")
VECTOR = ("direction_x", "direction_y", "direction_z")
RADIANS, DEGREES = ("azimuth_rad", "elevation_rad"), ("azimuth_deg", "elevation_deg")
START, END, SENSOR, TIME = "gate_start_m", "gate_end_m", "sensor", "time_s"
NAMES = "sensor_names"
COLUMNS = (*ORIGIN, *VECTOR, *RADIANS, *DEGREES, START, END, SENSOR, TIME)
LOOKS = (VECTOR, RADIANS, DEGREES)
# Directions that are given twice may differ by rounding to six digits [rad].
AGREEMENT_RAD = 10 * COARSE_SLACK
# Firing times within this share of their span from even ones count as even.
EVEN_TIMES = COARSE_SLACK
LONGEST_CELL = 100


@dataclass(frozen=True, eq=False)
class RayColumns:
    """Columns of a ray table, checked to be complete and of one length.

    Arguments:
        numbers: Finite numbers by column, shape (N,) each.
        sensor: Index of each ray's sensor, shape (N,), from 0 without gaps.
        names: Names of the sensors.
        locate: Location of a row in a column, as `file:line:column`.
    """

    numbers: Mapping[str, np.ndarray]
    sensor: np.ndarray
    names: tuple[str, ...]
    locate: Callable[[int, str], str]

    def refuse(self, wrong: np.ndarray, name: str, message: str, allowed: str) -> None:
        """Raise for the first row of a mask, shape (N,), if there is one."""
        if wrong.any():
            row = int(np.argmax(wrong))
            raise DataError(
                f"{name} is {self.numbers[name][row]:g}: {message}", where=self.locate(row, name), allowed=allowed
            )


def check_names(names: tuple[str, ...], where: str) -> None:
    """Refuse unknown or repeated columns, and an incomplete direction or origin.

    Raises:
        DataError: Such columns.
    """
    unknown = [name for name in names if name not in COLUMNS]
    twice = sorted({name for name in names if names.count(name) > 1})
    if unknown or twice:
        raise DataError(
            f"unknown columns {', '.join(map(repr, unknown))}" if unknown else f"{', '.join(twice)} given twice",
            where=where,
            allowed=", ".join(COLUMNS),
        )
    for group in (ORIGIN, *LOOKS):
        given = [name for name in group if name in names]
        if given and len(given) < len(group):
            missing = ", ".join(name for name in group if name not in given)
            raise DataError(f"{', '.join(given)} without {missing}", where=where, allowed=", ".join(group))
    if not any(group[0] in names for group in LOOKS):
        raise DataError(
            "no column says where rays point", where=where, allowed=" or ".join(", ".join(group) for group in LOOKS)
        )


def rig_of_columns(columns: RayColumns, kind: str) -> Rig:
    """The rig of a ray table.

    Raises:
        DataError: Invalid numbers, or directions that contradict each other.
    """
    azimuth, elevation = _angles(columns)
    unsaid = {
        ORIGIN[0]: "the file does not say where rays start: all start at the world's origin",
        START: "the file does not say where gates start: rays listen from 0 m",
    }
    notes = [note for name, note in unsaid.items() if name not in columns.numbers]
    usual = {name: np.zeros(len(azimuth)) for name in (*ORIGIN, START)}
    numbers = {**usual, END: np.full(len(azimuth), np.inf), TIME: np.zeros(1), **columns.numbers}
    origin = np.stack([numbers[name] for name in ORIGIN], axis=1)
    start, end, times = numbers[START], numbers[END], numbers[TIME]
    columns.refuse(start < 0, START, "negative", "0 m or more")
    columns.refuse(end < start, END, "before the gate's start", "at least the gate's start")
    even = times[0] + np.arange(len(times)) / (Bandwidth().rate_hz * len(times))
    if np.abs(times - even).max() > EVEN_TIMES * max(even[-1] - even[0], np.abs(times).max()):
        notes.append(f"{TIME} is not kept: rays fire evenly over a frame, in the order of the file")
    gate = np.stack([start, end], axis=1)
    sensors = [
        RigSensor(name, origin[rays], azimuth[rays], elevation[rays], gate[rays], order=rays)
        for name, rays in zip(columns.names, indices_by_owner(columns.sensor, len(columns.names)), strict=True)
    ]
    return Rig(kind, sensors, notes, f"add a column {END}")


def _angles(columns: RayColumns) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation of every ray (N,) [rad]; given radians are kept to the last bit."""
    found: dict[tuple[str, ...], tuple[np.ndarray, np.ndarray]] = {}
    numbers = columns.numbers
    for names, unit, right, in_rad in (
        (RADIANS, "rad", math.pi / 2, np.asarray),
        (DEGREES, "degrees", 90.0, np.radians),
    ):
        if names[0] not in numbers:
            continue
        azimuth, elevation = (in_rad(numbers[name]) for name in names)
        columns.refuse(np.abs(azimuth) > 2 * math.pi * MOST_TURNS, names[0], "too many turns", "an angle in " + unit)
        beyond = np.abs(elevation) > math.pi / 2 + COARSE_SLACK
        columns.refuse(beyond, names[1], f"no elevation in {unit}", f"{-right:g} to {right:g}")
        found[names] = azimuth, np.clip(elevation, -math.pi / 2, math.pi / 2)
    if VECTOR[0] in numbers:
        vectors = np.stack([numbers[name] for name in VECTOR], axis=1)
        largest = np.abs(vectors).max(axis=1)
        columns.refuse(largest == 0, VECTOR[0], "a direction without length", "a vector of any length above 0")
        found[VECTOR] = angles(vectors / largest[:, None])
    (first, chosen), *others = found.items()
    for names, other in others:
        away = np.linalg.norm(direction(*chosen) - direction(*other), axis=1)
        columns.refuse(away > AGREEMENT_RAD, names[0], f"a different direction than {first[0]} says", "one direction")
    return chosen


def read_ray_csv(path: Path) -> Rig:
    """Read the rig of a CSV ray table; a column `sensor` of whole numbers has indices from 0, any other has names.

    Raises:
        DataError: The file cannot be read, or a cell cannot be used; with file, line and column.
    """
    rows = csv_rows(path, RAY_TABLE)
    if not rows:
        raise DataError("is empty", where=str(path), allowed="a header and one ray per line")
    (header_line, header), *body = rows
    names = tuple(cell.strip() for cell in header)
    check_names(names, f"{path}:{header_line}")
    if not body:
        raise DataError("has a header but no ray", where=str(path))
    if len(body) > MOST_RAYS:
        raise DataError(f"{len(body)} rays", where=str(path), allowed=f"at most {MOST_RAYS}")
    for line, row in body:
        if len(row) != len(names):
            raise DataError(f"{len(row)} columns", where=f"{path}:{line}", allowed=f"{len(names)}: {', '.join(names)}")

    def locate(row: int, name: str) -> str:
        return f"{path}:{body[row][0]}:{names.index(name) + 1}"

    cells = dict(zip(names, zip(*(row for _, row in body), strict=True), strict=True))
    labels = [cell.strip() for cell in cells.pop(SENSOR, ("0",) * len(body))]
    if "" in labels:
        raise DataError("sensor is empty", where=locate(labels.index(""), SENSOR), allowed="a number or a name")
    indices = np.array([number_of(label) for label in labels], dtype=np.float64)
    is_number, is_index = np.isfinite(indices), (indices >= 0) & (indices < MOST_RAYS) & (indices % 1 == 0)
    for row in np.flatnonzero(is_number & ~is_index).tolist():
        raise DataError(
            f"{SENSOR} is {labels[row][:LONGEST_CELL]!r}",
            where=locate(row, SENSOR),
            allowed=f"a whole number from 0 to {MOST_RAYS - 1}, or a name",
        )
    if is_number.all():
        found, sensor = np.unique(indices, return_inverse=True)
        sensor_names = tuple(f"sensor_{int(index) + 1}" for index in found)
    else:
        sensor_names = tuple(dict.fromkeys(labels))
        number_of_name = {name: number for number, name in enumerate(sensor_names)}
        sensor = np.array([number_of_name[label] for label in labels])
    numbers = {}
    for name, column in cells.items():
        values = np.array([number_of(cell) for cell in column], dtype=np.float64)
        for row in np.flatnonzero(~np.isfinite(values)).tolist():
            raise DataError(
                f"{name} is {column[row][:LONGEST_CELL]!r}", where=locate(row, name), allowed="a finite number"
            )
        numbers[name] = values
    return rig_of_columns(RayColumns(numbers, sensor.reshape(-1), sensor_names, locate), "rays CSV")


def read_ray_npz(path: Path) -> Rig:
    """Read the rig of an NPZ ray table; `sensor` has indices into `sensor_names`, if there are names.

    Raises:
        DataError: The file cannot be read, or an array cannot be used.
    """
    arrays = read_npz(path, kinds=NUMERIC_KINDS + "U", hint="export it again, or write it with numpy.savez")
    names = arrays.pop(NAMES, None)
    check_names(tuple(arrays), str(path))
    shapes = {name: values.shape for name, values in arrays.items()}
    shape = next(iter(shapes.values()))
    if len(shape) != 1 or len(set(shapes.values())) > 1 or not 1 <= shape[0] <= MOST_RAYS:
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise DataError(f"shapes {found}", where=str(path), allowed=f"columns of one length, 1 to {MOST_RAYS}")

    def locate(row: int, name: str) -> str:
        return f"{path}: {name}[{row}]"

    numbers = {}
    for name, values in arrays.items():
        if values.dtype.kind not in "iuf":
            raise DataError(f"{name} is of type {values.dtype}", where=str(path), allowed="real numbers")
        numbers[name] = values.astype(np.float64)
        for row in np.flatnonzero(~np.isfinite(numbers[name])).tolist():
            raise DataError(f"{name} is {numbers[name][row]}", where=locate(row, name), allowed="a finite number")
    indices = numbers.pop(SENSOR, np.zeros(shape))
    if (indices < 0).any() or (indices >= MOST_RAYS).any() or (indices % 1 != 0).any():
        raise DataError(f"{SENSOR} is not a whole number from 0 to {MOST_RAYS - 1}", where=str(path))
    used, sensor = np.unique(indices, return_inverse=True)
    if names is None:
        sensor_names = tuple(f"sensor_{int(index) + 1}" for index in used)
    elif names.ndim != 1 or names.dtype.kind != "U" or used[-1] >= len(names):
        raise DataError(
            f"{NAMES} has shape {names.shape} and type {names.dtype}",
            where=str(path),
            allowed=f"text, at least {int(used[-1]) + 1} names",
        )
    else:
        sensor_names = tuple(str(names[int(index)]) for index in used)
    return rig_of_columns(RayColumns(numbers, sensor.reshape(-1), sensor_names, locate), "rays NPZ")


# Losses of every list of rays.
LOST = ["names, weights, fields of view and origin covariances of the sensors are lost: rows have their numbers"]


def ray_columns(rays: Rays) -> dict[str, np.ndarray]:
    """Columns by name, each of shape (N,), in the order in which they are written."""
    azimuth, elevation = angles(rays.direction)
    columns = (*rays.origin_m.T, *rays.direction.T, azimuth, elevation, *rays.gate_m.T, rays.sensor, rays.time_s)
    return dict(zip((*ORIGIN, *VECTOR, *RADIANS, START, END, SENSOR, TIME), columns, strict=True))


def write_csv(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write one ray per row, every number with all its digits; returns notes of what the format cannot hold.

    Of patterns that follow what they see each row names its pattern, and the rule follows as comments.
    """
    columns, rule = pattern_columns(design, rays)
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    lines += [
        f"# {name}: {','.join(map(repr, row))}"
        for name, values in rule.items()
        for row in np.atleast_2d(values).tolist()
    ]
    write_atomic(path, "\n".join(lines) + "\n")
    return list(LOST)


CSV = Format(
    "csv",
    ".csv",
    "one ray per row: origin, direction, angles, gate, time",
    write_csv,
    reader="anything that reads CSV; `evaluate` and `fit` too",
    checked="read by numpy",
    holds=frozenset({RAYS, ADAPTIVE}),
    read=read_ray_csv,
)


def write_npz(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write an array per column, names of sensors, and a rule of patterns; returns notes of what is lost."""
    buffer = io.BytesIO()
    names = np.array([sensor.name for sensor in design.sensors], dtype=np.str_)
    columns, rule = pattern_columns(design, rays)
    np.savez(buffer, **columns, **rule, **{NAMES: names})
    write_atomic(path, buffer.getvalue())
    return list(LOST)


NPZ = Format(
    "npz",
    ".npz",
    "the same columns as numpy arrays",
    write_npz,
    reader="numpy",
    checked="read by numpy",
    holds=frozenset({RAYS, ADAPTIVE}),
    read=read_ray_npz,
)


def pattern_columns(design: DesignSpec, rays: Rays) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The columns of a ray table, and the rule where the design's patterns follow what they see; else none.

    These have a column `pattern`: 0 fires where nothing is known, the others near their centroid, row by row.
    """
    adaptive = design.following(len(rays))
    if adaptive is None:
        return ray_columns(rays), {}
    rule, lists = adaptive.rule, [pattern.at() for pattern in adaptive.patterns]
    columns = [ray_columns(replace(one, time_s=rays.time_s)) for one in lists]
    joined = {name: np.concatenate([one[name] for one in columns]) for name in columns[0]}
    joined["pattern"] = np.repeat(np.arange(len(lists)), len(rays))
    return joined, {"looks": np.array(rule.looks), "missing_m": rule.missing_m, "centroids": rule.centroids}


SENSOR_COLUMNS = (
    "origin_x", "origin_y", "origin_z", "azimuth_mean", "elevation_mean", "time_mean",
    "orig_cov_xx", "orig_cov_xy", "orig_cov_xz", "orig_cov_yy", "orig_cov_yz", "orig_cov_zz",
    "azimuth_sigma", "elevation_sigma", "time_sigma", "weight",
)  # fmt: skip
QUERY_COLUMN = "x_query"
NOT_NEGATIVE = ("time_mean", "azimuth_sigma", "elevation_sigma", "time_sigma", "weight")
WEIGHT_SUM_TOLERANCE = SLACK


def begins_as_sensor_csv(head: bytes) -> bool:
    """True if a file begins with a line of comma-separated cells, unlike any YAML mapping."""
    text = head.decode("utf-8-sig", errors="replace")
    first = next((line.strip() for line in text.splitlines() if line.strip()), "")
    return "," in first and ":" not in first and not first.startswith(("{", "[", "- ", "#", "%"))


def read_sensor_csv(path: Path) -> DesignSpec:
    """Read a sensor table; the header is optional, weights are normalised (noted in the provenance).

    The variant with a first column x_query describes a moving robot; it is read if it has a single position.

    Raises:
        DataError: The file cannot be read, or a cell cannot be used; with file, line and column (exit 3).
    """
    rows, notes = _rows(path)
    sensors = [_sensor(row, index, where) for index, (row, where) in enumerate(rows)]
    total = math.fsum(sensor.weight for sensor in sensors)
    if not total > 0:
        raise DataError("the weights sum to 0", where=str(path), allowed="at least one weight above 0")
    if abs(total - 1) > WEIGHT_SUM_TOLERANCE:
        notes.append(f"weights summed to {total:.6g} and were normalised")
        sensors = [replace(sensor, weight=sensor.weight / total) for sensor in sensors]
    return DesignSpec(
        name=path.stem,
        sensors=tuple(sensors),
        provenance={"source": path.name, "format": "sensor CSV of the research code", "notes": notes},
    )


def _rows(path: Path) -> tuple[list[tuple[dict[str, float], str]], list[str]]:
    """Numbers by column name and the position of each row, with notes."""
    lines = csv_rows(path, RAY_TABLE)
    if not lines or len(lines) > MOST_SENSORS + 1:
        raise DataError(
            f"has {len(lines)} rows" if lines else "is empty",
            where=str(path),
            allowed=f"rows of {len(SENSOR_COLUMNS)} columns, at most {MOST_SENSORS}",
        )
    first = [cell.strip() for cell in lines[0][1]]
    if any(number_of(cell) is not None for cell in first):
        names = SENSOR_COLUMNS if len(first) != len(SENSOR_COLUMNS) + 1 else (QUERY_COLUMN, *SENSOR_COLUMNS)
    else:
        names = tuple(first)
        missing = [name for name in SENSOR_COLUMNS if name not in names]
        unknown = [name for name in names if name not in (*SENSOR_COLUMNS, QUERY_COLUMN)]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if missing or unknown or repeated:
            wrong = {"missing columns": missing, "unknown or repeated": [*unknown, *repeated]}
            raise DataError(
                "; ".join(f"{what}: {', '.join(columns)}" for what, columns in wrong.items() if columns),
                where=f"{path}:{lines[0][0]}",
                allowed=", ".join(SENSOR_COLUMNS),
            )
        lines = lines[1:]
    if not lines:
        raise DataError("has a header but no sensor", where=str(path))
    rows = [
        (row_of_numbers(f"{path}:{number}", cells, names, NOT_NEGATIVE), f"{path}:{number}") for number, cells in lines
    ]
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


def row_of_numbers(
    where: str, cells: list[str], names: tuple[str, ...], not_negative: tuple[str, ...]
) -> dict[str, float]:
    """The finite numbers of a table's row by their columns, some of them not negative.

    Raises:
        DataError: Another number of cells, or a cell that is no such number; with its column.
    """
    if len(cells) != len(names):
        raise DataError(f"{len(cells)} columns", where=where, allowed=f"{len(names)}: {', '.join(names)}")
    row = {}
    for column, (name, text) in enumerate(zip(names, cells, strict=True), 1):
        low, value = 0.0 if name in not_negative else -math.inf, number_of(text)
        if value is None or not math.isfinite(value) or value < low:
            raise DataError(
                f"{name} is {text.strip()!r}",
                where=f"{where}:{column}",
                allowed="a finite number" if math.isinf(low) else "a finite number of at least 0",
            )
        row[name] = value
    return row


def _sensor(row: dict[str, float], index: int, where: str) -> Sensor:
    elevation = row["elevation_mean"]
    # it may exceed a right angle by rounding in a file of few digits
    if abs(elevation) > math.pi / 2 + COARSE_SLACK:
        raise DataError(f"elevation_mean is {elevation!r}", where=where, allowed="radians from -pi/2 to pi/2")
    elevation = min(max(elevation, -math.pi / 2), math.pi / 2)
    xx, xy, xz, yy, yz, zz = (row[name] for name in SENSOR_COLUMNS[6:12])
    covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if np.linalg.eigvalsh(covariance).min() < -COARSE_SLACK * np.abs(covariance).max():
        raise DataError("the origin covariance has a negative eigenvalue", where=where)
    z, middle, spread = interval_factor(DEFAULT_LEVEL), row["time_mean"], row["time_sigma"]
    across = row["azimuth_sigma"] * math.cos(elevation)
    if spread == 0:
        raise DataError("time_sigma is 0: the gate has no width", where=where, allowed="a number above 0")
    return Sensor(
        name=f"sensor_{index + 1}",
        weight=row["weight"],
        origin_m=np.array([row[name] for name in SENSOR_COLUMNS[:3]]),
        azimuth_rad=row["azimuth_mean"],
        elevation_rad=elevation,
        roll_rad=0.0,
        field_of_view_rad=(min(2 * z * across, FULL_TURN), min(2 * z * row["elevation_sigma"], FULL_TURN)),
        gate_m=(max(middle - z * spread, 0.0), middle + z * spread),
        origin_covariance_m2=covariance if covariance.any() else None,
    )


def write_sensor_csv(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write a sensor table with its header, atomically, without any rays; returns what the table cannot hold."""
    table: list[Sequence[str]] = [SENSOR_COLUMNS]
    lost = {
        "the patterns of rays are lost": bool(design.patterns),
        "roll is lost: spreads are those along azimuth and elevation":
            any(sensor.roll_rad for sensor in design.sensors),
    }  # fmt: skip
    notes = [
        "names, layout and provenance are lost; readers assume level 0.95",
        *(note for note, applies in lost.items() if applies),
    ]
    z = interval_factor(DEFAULT_LEVEL)
    for sensor in design.sensors:
        horizontal, vertical = (angle / (2 * z) for angle in sensor.field_of_view_rad)
        # the spreads along azimuth and elevation of a sensor that is rolled about its boresight
        cosine, sine = math.cos(sensor.roll_rad), math.sin(sensor.roll_rad)
        azimuth_sigma = math.hypot(cosine * horizontal, sine * vertical)
        elevation_sigma = math.hypot(sine * horizontal, cosine * vertical)
        cosine = math.cos(sensor.elevation_rad)
        if azimuth_sigma >= cosine * FULL_TURN:
            # towards a pole the azimuth covers the whole turn; larger standard deviations make no difference
            if azimuth_sigma > 0:
                notes.append(f"{sensor.name} points at a pole: its azimuth spread was cut at a full turn")
            azimuth_sigma = FULL_TURN
        else:
            azimuth_sigma /= cosine
        upper, (start, end) = np.asarray(sensor.covariance_m2)[np.triu_indices(3)], sensor.gate_m
        row = [
            *sensor.origin_m, sensor.azimuth_rad, sensor.elevation_rad, (start + end) / 2, *upper,
            azimuth_sigma, elevation_sigma, (end - start) / (2 * z), sensor.weight,
        ]  # fmt: skip
        table.append([repr(float(value)) for value in row])
    write_atomic(path, csv_table(table))
    return [*notes, f"the {len(rays)} rays are lost"] if len(rays) else notes


SENSORS_CSV = Format(
    "sensors-csv",
    ".sensors.csv",
    "one sensor per row, the 16 columns of the research code",
    write_sensor_csv,
    reader="the research code of the paper",
    checked="read as a design; the columns are those of its own files",
    holds=frozenset(),
)
