"""A captured scan seen through a list of rays: of each ray the nearest pixel, and its histogram inside the ray's gate.

A design's measurement is cut out of the capture: a ray takes the pixel nearest to its direction, and only the bins
whose middles lie in its gate. Ranges are found as `lidardesign.simulate.detector.kernels` finds them in simulated
histograms. Where a gate holds too few photons to estimate the background, its threshold uses the typical level of the
whole capture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from scipy.spatial import cKDTree

from lidardesign.errors import ConfigError, DataError
from lidardesign.evaluation.captures.capture import Capture
from lidardesign.formats.galvo import degree_frame, middle_boresight_deg, scan_angles_deg, scan_directions
from lidardesign.methods.fields import quasi_random_points
from lidardesign.numerics import EPSILON
from lidardesign.scenes.rays import Rays
from lidardesign.simulate.detector.physics import FWHM_PER_SIGMA, Estimator, chunks

# A ray that starts further from the scanner than this was not captured: it sees other surfaces.
SAME_PLACE_M = 0.005


class Captured(IntEnum):
    """The capture of a ray: captured, or the reason why not."""

    YES = 0
    OTHER_PLACE = 1
    OUT_OF_FIELD = 2
    OUT_OF_WINDOW = 3


@dataclass(frozen=True, eq=False)
class CapturedScan:
    """Measurements of N rays in a capture.

    Arguments:
        captured: Values of `Captured`, shape (N,).
        pixel: The pixel that each ray takes, -1 where it was not captured, shape (N,).
        away_rad: The angle between the ray and its pixel, or the nearest one, shape (N,).
        first_bin, last_bin: The bins in its gate, the last one excluded, shape (N,).
        photons: Counts in them, shape (N,).
        range_m: The measured one-way range [m], NaN without a return, shape (N,).
        points_m: Measured points along the pixels, NaN without a return, shape (N, 3).
    """

    captured: np.ndarray
    pixel: np.ndarray
    away_rad: np.ndarray
    first_bin: np.ndarray
    last_bin: np.ndarray
    photons: np.ndarray
    range_m: np.ndarray
    points_m: np.ndarray

    @property
    def returned(self) -> np.ndarray:
        """Mask of the rays with a return, shape (N,)."""
        return np.isfinite(self.range_m)


def scan(
    capture: Capture, rays: Rays, within_rad: float, estimation: Estimation, name: str | None = None
) -> CapturedScan:
    """The measurements of a list of rays in a capture.

    Arguments:
        capture: The captured histograms.
        rays: The rays; their gates are one-way ranges.
        within_rad: The largest angle between a ray and the pixel that it takes [rad].
        estimation: The estimation of ranges from histograms.
        name: The name of the design, for the message.

    Raises:
        DataError: Not one ray was captured.
    """
    chord, nearest = cKDTree(capture.direction).query(rays.direction)
    away = 2 * np.arcsin(np.minimum(np.asarray(chord) / 2, 1.0))
    first, last = gate_bins(capture, nearest, rays.gate_m)
    offset = np.linalg.norm(rays.origin_m - capture.origin_m, axis=1)
    captured = np.full(len(rays), Captured.YES, dtype=np.int64)
    captured[last <= first] = Captured.OUT_OF_WINDOW
    captured[away > within_rad] = Captured.OUT_OF_FIELD
    captured[offset > SAME_PLACE_M] = Captured.OTHER_PLACE
    _refuse_nothing_captured(capture, rays, captured, away, offset, name)
    return _measured(capture, captured, nearest, away, first, last, estimation)


def scan_pixels(capture: Capture, estimation: Estimation) -> CapturedScan:
    """The measurement of every pixel in its whole histogram."""
    pixels = np.arange(len(capture))
    first, last = gate_bins(capture, pixels, np.tile(_listening_windows_m(capture), (len(capture), 1)))
    captured = np.where(first < last, Captured.YES, Captured.OUT_OF_WINDOW)
    return _measured(capture, captured, pixels, np.zeros(len(capture)), first, last, estimation)


def gate_bins(capture: Capture, pixel: np.ndarray, gate_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The bins of pixels (N,) whose middles lie in gates (N, 2) [m], start <= middle < end.

    First and last (excluded), each of shape (N,).
    """
    places = (gate_m - capture.start_m[pixel, None]) / capture.bin_m - 0.5
    bins = np.clip(np.ceil(places), 0, capture.bins).astype(np.int64)
    return bins[:, 0], bins[:, 1]


def whole_window(rays: Rays, capture: Capture) -> Rays:
    """The same rays with gates over the whole captured window."""
    return replace(rays, gate_m=np.tile(_listening_windows_m(capture), (len(rays), 1)))


def _listening_windows_m(capture: Capture) -> np.ndarray:
    """The captured window from the pulse on [m]; counts before it come from no surface."""
    return np.maximum(capture.window_m, 0.0)


def uniform_rays(capture: Capture, count: int) -> Rays:
    """So many rays even over the field of a capture, without gates, as of a scanner without a design.

    A cell-centred grid in scan angles over all pixels and half a pixel round them.
    """
    frame = degree_frame(*middle_boresight_deg(capture.direction))
    seen = scan_angles_deg(frame, capture.direction)
    half = np.degrees(capture.spacing_rad or 0.0) / 2
    low, high = seen.min(axis=0) - half, seen.max(axis=0) + half
    # a scan along a line, or of a single pixel, has no extent across it
    extents = np.maximum(high - low, EPSILON)
    looking = scan_directions(frame, low + quasi_random_points(count, extents) * (high - low))
    none = np.zeros(count)
    gates_m = np.tile(_listening_windows_m(capture), (count, 1))
    return Rays(np.tile(capture.origin_m, (count, 1)), looking, gates_m, none, none)


def default_within_rad(capture: Capture) -> float:
    """The default angle between a ray and its pixel: the spacing of neighbouring pixels [rad].

    Raises:
        ConfigError: All pixels have the same direction.
    """
    if capture.spacing_rad is None:
        raise ConfigError(
            "all pixels point the same way, so they have no spacing",
            where="--within-deg",
            allowed="an angle in degrees",
        )
    return capture.spacing_rad


@dataclass(frozen=True)
class Estimation:
    """The way from a histogram to a range.

    Arguments:
        estimator: Its highest bin, or the log-matched filter with the pulse.
        false_alarm: Probability that background alone is taken for a return, over all bins in a ray's gate.
    """

    estimator: Estimator = "peak"
    false_alarm: float = 0.01


def measured(
    capture: Capture, pixel: np.ndarray, first: np.ndarray, last: np.ndarray, estimation: Estimation
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges [m], NaN without a return, and counts of pixels (K,) between bins (K,) and (K,), each of shape (K,).

    Raises:
        DataError: The matched filter is asked for, and the capture does not say how wide its pulse is.
    """
    from lidardesign.simulate.detector.kernels import find_returns

    matched = estimation.estimator == "matched"
    if matched and capture.pulse_fwhm_ps is None:
        raise DataError(
            "the matched filter needs the width of the pulse, and the capture has no pulse_fwhm_ps",
            where="--estimator matched",
            hint="add pulse_fwhm_ps to the capture, or take --estimator peak",
        )
    pulse_ps = capture.pulse_fwhm_ps or 0.0
    place, photons = np.full(len(pixel), np.nan), np.zeros(len(pixel))
    for begin, end in chunks(np.append(0, np.cumsum(last - first))):
        lengths = np.maximum(last - first, 0)[begin:end]
        # the counts in the gates of all rays, concatenated, and the first of each ray
        offset = np.concatenate([[0], np.cumsum(lengths)])
        at = np.arange(offset[-1]) - np.repeat(offset[:-1] - first[begin:end], lengths)
        counts = capture.counts[np.repeat(pixel[begin:end], lengths), at].astype(np.int64)
        photons[begin:end] = np.diff(np.concatenate([[0], np.cumsum(counts)])[offset])
        place[begin:end] = find_returns(
            counts,
            offset,
            np.ones((end - begin, 2)),
            capture.bin_ps,
            pulse_ps / FWHM_PER_SIGMA,
            int(pulse_ps / (2 * capture.bin_ps)),
            np.full(end - begin, capture.background_per_bin),
            estimation.false_alarm,
            matched,
        )
    return capture.start_m[pixel] + (first + place) * capture.bin_m, photons


def _measured(
    capture: Capture,
    captured: np.ndarray,
    nearest: np.ndarray,
    away: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    estimation: Estimation,
) -> CapturedScan:
    taken = np.flatnonzero(captured == Captured.YES)
    pixel = np.where(captured == Captured.YES, nearest, -1)
    range_m, photons = np.full(len(pixel), np.nan), np.zeros(len(pixel))
    range_m[taken], photons[taken] = measured(capture, pixel[taken], first[taken], last[taken], estimation)
    points = capture.origin_m + range_m[:, None] * capture.direction[pixel]
    return CapturedScan(captured, pixel, away, first, last, photons, range_m, points)


def _refuse_nothing_captured(
    capture: Capture, rays: Rays, captured: np.ndarray, away: np.ndarray, offset: np.ndarray, name: str | None
) -> None:
    """Refuse rays of which none was captured: they have another place or frame than the capture."""
    if not len(rays) or (captured == Captured.YES).any():
        return
    start, end = capture.window_m
    texts = {
        Captured.OTHER_PLACE: f"they start {offset.min():.4g} m from {capture.origin_m.tolist()} or further",
        Captured.OUT_OF_FIELD: f"they point {np.degrees(away.min()):.3g} degrees past the nearest pixel or more",
        Captured.OUT_OF_WINDOW: f"their gates hold no bin between {start:.4g} and {end:.4g} m",
    }
    usual = max(texts, key=lambda reason: int((captured == reason).sum()))
    raise DataError(
        f"none of the {len(rays)} rays was captured: {texts[usual]}",
        where=name,
        hint="give the capture's origin_m and directions in the design's frame, and start_ps from the scanner",
    )
