"""What a design costs to read out, from its file alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.rays import split_budget
from lidardesign.design.sensor import Design

MODEL_KEYS = ("bin_ps", "bits_per_bin", "rate_hz")


@dataclass(frozen=True)
class Readout:
    """The bandwidth of a design.

    Arguments:
        model: The read-out: that of the design's own budget.
        low_mbps, high_mbps: Least and most over the knots of a track, else the same [Mbit/s]; of one ray where the
            design leaves its rays open.
        rays: Rays per frame; None where they are open.
    """

    model: Bandwidth
    low_mbps: float
    high_mbps: float
    rays: int | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for scripts."""
        model = {name: getattr(self.model, name) for name in MODEL_KEYS}
        values = {"low_mbps": self.low_mbps, "high_mbps": self.high_mbps}
        return {**values, "rays": self.rays, "of_one_ray": self.rays is None, **model}


def readout_of(design: Design) -> Readout:
    """What a design's gates cost, by the read-out of its own constraints or the usual one."""
    budget = design.constraints.get("budget") or {}
    model = Bandwidth(**{name: float(budget[name]) for name in MODEL_KEYS if budget.get(name) is not None})
    track = design.track
    if track is not None:
        widths = track.gate_m[..., 1] - track.gate_m[..., 0]
        found = [model.mbps_of_widths(row) for row in widths]
        return Readout(model, min(found), max(found), len(track.sensor))
    if design.ray_table is not None:
        gates = design.ray_table.gate_m
        once = model.mbps_of_widths(gates[:, 1] - gates[:, 0])
        return Readout(model, once, once, len(gates))
    widths = np.array([sensor.gate_m[1] - sensor.gate_m[0] for sensor in design.sensors])
    counts = _counts(design)
    if counts is None:
        once = float(design.weights @ np.array([model.mbps_of_widths(width) for width in widths]))
        return Readout(model, once, once, None)
    once = model.mbps_of_widths(widths, counts)
    return Readout(model, once, once, int(counts.sum()))


def _counts(design: Design) -> np.ndarray | None:
    """Rays per sensor, shape (G,); None where the design leaves them open."""
    own = [sensor.rays for sensor in design.sensors]
    if None not in own:
        return np.array(own, dtype=np.int64)
    if design.rays is not None:
        return split_budget(design.weights, design.rays)
    return np.ones(len(own), dtype=np.int64) if design.layout == "scan" else None
