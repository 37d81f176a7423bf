"""Designs in a captured scan: ranges, outliers and a surface, gated, not gated, and beside `uniform`, also ray by ray.

Ranges are compared with the capture's true ranges where it has them; else with the median range of each pixel and its
nearest neighbours over their whole histograms, which a single outlier does not move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.errors import DataError
from lidardesign.estimates import Estimate, median_error, share_error
from lidardesign.evaluation.captures.capture import Capture
from lidardesign.evaluation.captures.scan import (
    Captured,
    CapturedScan,
    Estimation,
    scan,
    scan_pixels,
    uniform_rays,
    whole_window,
)
from lidardesign.formats.galvo import degree_frame, middle_boresight_deg
from lidardesign.numerics import circular_difference
from lidardesign.run.arrays import csv_table
from lidardesign.run.files import write_atomic
from lidardesign.scenes.mesh_files import load_mesh
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Body, Scene
from lidardesign.scoring.metrics import (
    SurfaceCloud,
    delaunay_surface,
    ray_spacing,
    surface_cloud,
    visible_surface,
)
from lidardesign.space import DesignSpace, angles
from lidardesign.task import random_generator

SURFACE_POINTS = 4000
STEEPEST_DEG = 85.0  # flatter triangles bridge depth steps
MILLIMETRES = 1000.0
OWN, WHOLE = "own", "whole"
# Of the CSV: one row per ray, gate and design.
COLUMNS = (
    "design", "gate", "ray", "sensor", "captured", "pixel", "away_deg", "gate_start_m", "gate_end_m", "photons",
    "range_m", "reference_m", "outlier",
    "point_x_m", "point_y_m", "point_z_m",
)  # fmt: skip


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of the evaluation of a capture.

    Arguments:
        estimation: The estimation of ranges from histograms.
        within_rad: The largest angle between a ray and the pixel that it takes [rad].
        outlier_m: A return whose range is off by more is an outlier [m].
        reference: A mesh file of the surface in the design's frame, in metres; None: the true ranges' surface.
    """

    estimation: Estimation
    within_rad: float
    outlier_m: float
    reference: Path | None = None


@dataclass(frozen=True, eq=False)
class CaptureRow:
    """One list of rays in a capture.

    Arguments:
        design: Its name.
        gate: `own` with the rays' gates, `whole` with all that was captured.
        rays: Its rays.
        scan: Their measurements.
        reference_m: The range that each ray's pixel should have given [m], NaN where nothing is known, shape (N,).
        outlier: Mask of returns that are outliers, shape (N,).
        chamfer_mm: Distance between the surface through the returns and the reference surface; None: there is none.
        baseline: Whether it is no design.
    """

    design: str
    gate: str
    rays: Rays
    scan: CapturedScan
    reference_m: np.ndarray
    outlier: np.ndarray
    chamfer_mm: float | None
    baseline: bool = False

    def estimates(self) -> dict[str, Estimate]:
        """The figures that are means or medians over rays, with their standard errors over other rays."""
        estimates, outliers, known = {}, int(self.outlier.sum()), ~np.isnan(self.reference_m)
        # returns with a reference, and the errors of those that are no outliers
        judged = int((self.scan.returned & (self.outlier | known)).sum())
        errors_m = np.abs(self.scan.range_m - self.reference_m)[self.scan.returned & ~self.outlier & known]
        if judged:
            percent = 100.0 * outliers / judged
            estimates["outliers_percent"] = Estimate(percent, 100.0 * share_error(outliers, judged), "%")
        if len(errors_m):
            median = MILLIMETRES * float(np.median(errors_m))
            estimates["range_error_mm"] = Estimate(median, MILLIMETRES * median_error(errors_m), "mm")
        return estimates

    def as_dict(self) -> dict[str, Any]:
        """The row for `--json`; figures of which there are none are None."""
        scan, values = self.scan, {name: estimate.value for name, estimate in self.estimates().items()}
        taken = scan.captured == Captured.YES
        return {
            "design": self.design,
            "gate": self.gate,
            "rays": len(self.rays),
            "captured": int(taken.sum()),
            "not_captured": {
                reason.name.lower(): int((scan.captured == reason).sum()) for reason in Captured if reason
            },
            "pixels": len(np.unique(scan.pixel[taken])),
            "returns": int(scan.returned.sum()),
            "outliers": int(self.outlier.sum()),
            "outliers_percent": values.get("outliers_percent"),
            "range_error_mm": values.get("range_error_mm"),
            "chamfer_mm": self.chamfer_mm,
            "bins_per_ray": float((scan.last_bin - scan.first_bin)[taken].mean()) if taken.any() else None,
            "photons_per_ray": float(scan.photons[taken].mean()) if taken.any() else None,
            "baseline": self.baseline,
        }


@dataclass(frozen=True, eq=False)
class CaptureEvaluation:
    """All rows of a capture.

    Arguments:
        capture: The capture.
        settings: The settings.
        rows: Each design with its gates and without, then `uniform` at their numbers of rays; of a gated detector
            only the first.
        ranges_from, surface_from: The references of ranges and of the surface, in words; None: no surface.
        notes: Lines for readers.
    """

    capture: Capture
    settings: CaptureSettings
    rows: Sequence[CaptureRow]
    ranges_from: str
    surface_from: str | None
    notes: Sequence[str] = field(default=())

    def as_dict(self) -> dict[str, Any]:
        """The JSON form of `capture`."""
        capture, settings = self.capture, self.settings
        return {
            "pixels": len(capture),
            "bins": capture.bins,
            "bin_ps": capture.bin_ps,
            "window_m": list(capture.window_m),
            "estimator": settings.estimation.estimator,
            "false_alarm": settings.estimation.false_alarm,
            "within_deg": float(np.degrees(settings.within_rad)),
            "outlier_mm": MILLIMETRES * settings.outlier_m,
            "reference": {"ranges": self.ranges_from, "surface": self.surface_from},
            "rows": [row.as_dict() for row in self.rows],
            "notes": list(self.notes),
            "error_estimates": {
                f"{row.design}, gate {row.gate}: {name}": estimate.as_dict()
                for row in self.rows
                for name, estimate in row.estimates().items()
            },
        }


def evaluate_capture(
    capture: Capture, designs: Sequence[tuple[str, Rays]], settings: CaptureSettings
) -> CaptureEvaluation:
    """Score lists of rays in a capture.

    Arguments:
        capture: The captured histograms.
        designs: Names and rays, in the capture's frame.
        settings: The settings.

    Raises:
        DataError: Not one ray of a design was captured, or the reference cannot be used.
    """
    reference_m, ranges_from = _reference_ranges(capture, settings.estimation)
    surface, surface_from = _reference_surface(capture, settings.reference)

    def row(name: str, gate: str, rays: Rays, baseline: bool = False) -> CaptureRow:
        found = scan(capture, rays, settings.within_rad, settings.estimation, name)
        wanted = np.where(found.pixel >= 0, reference_m[found.pixel], np.nan)
        off = np.abs(found.range_m - wanted) > settings.outlier_m
        # where the true range is NaN, every return is wrong
        off |= np.isnan(wanted) if capture.true_range_m is not None else False
        chamfer = None if surface is None else _chamfer_mm(capture, found, surface)
        return CaptureRow(name, gate, rays, found, wanted, off & found.returned, chamfer, baseline)

    rows = []
    for name, rays in designs:
        rows.append(row(name, OWN, rays))
        if not capture.gated:
            rows.append(row(name, WHOLE, whole_window(rays, capture)))
    if not capture.gated:
        for count in dict.fromkeys(len(rays) for _, rays in designs):
            rows.append(row("uniform", WHOLE, uniform_rays(capture, count), baseline=True))
    return CaptureEvaluation(capture, settings, rows, ranges_from, surface_from, _notes(capture, rows))


def _notes(capture: Capture, rows: Sequence[CaptureRow]) -> list[str]:
    notes = []
    if capture.gated:
        notes.append("the detector was gated: what rays without gates would have measured is not known")
    for row in rows:
        missing = int((row.scan.captured != Captured.YES).sum())
        if missing and row.gate == (WHOLE if row.baseline else OWN):
            notes.append(f"{missing} of the {len(row.rays)} rays of {row.design} were not captured and return nothing")
    start, end = capture.window_m
    notes += [
        f"{int(cut.sum())} gates of {row.design} reach beyond the captured window, {start:.4g} to {end:.4g} m"
        for row in rows
        if row.gate == OWN
        and (
            cut := (row.rays.gate_m[:, 0] < start - capture.bin_m) | (row.rays.gate_m[:, 1] > end + capture.bin_m)
        ).any()
    ]
    return notes


def _reference_ranges(capture: Capture, estimation: Estimation) -> tuple[np.ndarray, str]:
    """The reference range of every pixel, shape (P,) [m], and its source in words."""
    if capture.true_range_m is not None:
        return capture.true_range_m, "the capture's true ranges"
    ranges = scan_pixels(capture, estimation).range_m
    count = min(9, len(capture))
    near = cKDTree(capture.direction).query(capture.direction, k=count)[1].reshape(len(capture), count)
    sorted_m = np.sort(ranges[near], axis=1)  # NaN comes last
    known = (~np.isnan(sorted_m)).sum(axis=1)
    middle = np.take_along_axis(sorted_m, np.maximum(known - 1, 0)[:, None] // 2, axis=1)[:, 0]
    return middle, f"the median range of the {count} nearest pixels over their whole histograms"


def _reference_surface(capture: Capture, mesh: Path | None) -> tuple[SurfaceCloud | None, str | None]:
    if mesh is not None:
        return _visible_mesh(capture, mesh), f"the part of {mesh} that the scanner sees"
    if capture.true_range_m is None:
        return None, None
    points = capture.origin_m + capture.true_range_m[:, None] * capture.direction
    surface = _surface(capture, points, capture.direction)
    return surface, None if surface is None else "the surface through the capture's true ranges"


def _surface(capture: Capture, points: np.ndarray, directions: np.ndarray) -> SurfaceCloud | None:
    """The surface through the points of rays (N, 3), NaN without a return; None where they span none."""
    kept = np.isfinite(points).all(axis=1)
    spacing = ray_spacing(directions)[kept]
    surface = delaunay_surface(points[kept], capture.origin_m, steepest_deg=STEEPEST_DEG, spacing=spacing)
    return None if surface is None else surface_cloud(*surface, SURFACE_POINTS, random_generator(0, "capture"))


def _chamfer_mm(capture: Capture, found: CapturedScan, surface: SurfaceCloud) -> float | None:
    """Mean distances of both surfaces to each other, added [mm]; None where the returns span no surface."""
    fired = found.captured == Captured.YES
    estimate = _surface(capture, found.points_m[fired], capture.direction[found.pixel[fired]])
    if estimate is None:
        return None
    apart = estimate.distance_m(surface.points).mean() + surface.distance_m(estimate.points).mean()
    return MILLIMETRES * float(apart)


def _visible_mesh(capture: Capture, path: Path) -> SurfaceCloud:
    """The part of a mesh that lies in the capture's field and window with nothing in front of it."""
    scene = Scene((Body(load_mesh(path), "reference"),), name=str(path))
    centre = degree_frame(*middle_boresight_deg(capture.direction))[0]
    azimuth, elevation = angles(capture.direction)
    middle = float(angles(centre)[0])
    # azimuths about the middle of the field, so that a field across azimuth 0 is one interval
    azimuth = middle + circular_difference(azimuth, middle)
    half = (capture.spacing_rad or 0.0) / 2
    start, end = capture.window_m
    place = tuple(float(value) for value in capture.origin_m)
    low = (*place, float(azimuth.min()) - half, max(float(elevation.min()) - half, -np.pi / 2), max(start, 0.0))
    high = (*place, float(azimuth.max()) + half, min(float(elevation.max()) + half, np.pi / 2), end)
    if high[3] - low[3] > 2 * np.pi:
        low, high = (*low[:3], 0.0, *low[4:]), (*high[:3], 2 * np.pi, *high[4:])
    try:
        return visible_surface(scene, DesignSpace(low, high), SURFACE_POINTS, random_generator(0, "reference"))
    except DataError as error:
        raise DataError(
            "no part of it lies in the captured field and window",
            where=str(path),
            hint="give it in metres, in the frame of origin_m and of the directions",
        ) from error


def write_csv(found: CaptureEvaluation, path: Path) -> None:
    """Write the file, atomically; a cell is empty where there is no return, pixel or reference."""
    write_atomic(path, csv_table([COLUMNS, *(line for row in found.rows for line in _lines(row))]))


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
