"""Designs written in a format by its name."""

from __future__ import annotations

from pathlib import Path

from lidardesign.formats import FORMATS, write_design


def write_as(name: str, design, rays, path: Path, rate_hz=None, robot=None) -> list[str]:
    """Write a design's rays in a format; returns its notes."""
    return write_design(FORMATS.load(name), design, rays, path, rate_hz, robot)
