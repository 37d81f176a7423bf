"""Captures for tests: a ball in front of a wall, by a scanner at the origin that looks along +x."""

from __future__ import annotations

import numpy as np

from lidardesign.formats.galvo import degree_frame, scan_directions

C_M_PER_PS = 299_792_458e-12
BIN_PS = 20.0
BINS = 600
START_PS = 2000.0
BALL_AT, BALL_M = np.array([0.6, 0.0, 0.0]), 0.15


def ball_range_m(directions, wall_m=1.5):
    """The first hit of rays from the origin (P, 3): a ball of 0.15 m at 0.6 m, then a wall across x; shape (P,)."""
    along = directions @ BALL_AT
    inside = along**2 - (BALL_AT @ BALL_AT - BALL_M**2)
    wall = wall_m / directions[:, 0]
    return np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), wall)


def bin_of(range_m):
    return np.floor((2 * range_m / C_M_PER_PS - START_PS) / BIN_PS).astype(int)


def make_capture(side=31, *, photons=60, background=0.05, outliers=0.0, half_deg=15.0, truth=True, seed=0, images=True):
    """The arrays of a capture of side x side pixels; a share of them has a false peak that is higher than the true."""
    generator = np.random.default_rng(seed)
    axis = np.linspace(-half_deg, half_deg, side)
    x, y = np.meshgrid(axis, axis)
    looking = scan_directions(degree_frame(0.0, 0.0), np.stack([x.ravel(), y.ravel()], axis=1))
    range_m = ball_range_m(looking)
    counts = generator.poisson(background, (side * side, BINS))
    rows = np.arange(side * side)
    for _ in range(photons):
        late = generator.normal(0.0, 25.0, side * side)
        counts[rows, bin_of(range_m + late * C_M_PER_PS / 2)] += 1
    wrong = generator.random(side * side) < outliers
    # a glint that no surface explains, well before or behind the ball
    counts[wrong, bin_of(generator.choice([0.35, 0.95, 1.2], int(wrong.sum())))] += photons
    shape = (side, side) if images else (side * side,)
    arrays = {
        "counts": counts.reshape(*shape, BINS).astype(np.uint16),
        "bin_width_ps": BIN_PS,
        "start_ps": START_PS,
        "origin_m": np.zeros(3),
        "x_deg": x.reshape(shape),
        "y_deg": y.reshape(shape),
        "boresight_azimuth_deg": 0.0,
        "boresight_elevation_deg": 0.0,
        "pulse_fwhm_ps": 60.0,
    }
    return {**arrays, "true_range_m": range_m.reshape(shape)} if truth else arrays
