"""Designs that stand or hear so far outside a design space that their lengths are likelier in another unit."""

from __future__ import annotations

import numpy as np

from lidardesign.design.sensor import Design
from lidardesign.space import RANGE, DesignSpace

# In sizes of the space: the diagonal of its box of origins and its reach. Rigs of others may stand a bit beside.
FAR_SIZES = 10.0
UNIT = "are its lengths in millimetres?"


def outside_notes(design: Design, space: DesignSpace) -> list[str]:
    """What is said of a design far outside a design space, one line at most.

    Arguments:
        design: Its sensors' mean origins and gates, and its rays' where it has a table of them.
        space: The design space of the run that it is scored in.
    """
    low, high = np.array(space.low[:3]), np.array(space.high[:3])
    size_m = float(np.linalg.norm(high - low)) + space.high[RANGE]
    origins_m, starts_m = _places(design)
    apart_m = np.linalg.norm(np.maximum(np.maximum(origins_m - high, low - origins_m), 0.0), axis=1)
    if len(apart_m) and apart_m.max() > FAR_SIZES * size_m:
        return [f"{design.name} stands {apart_m.max():.4g} m outside the run's design space; {UNIT}"]
    if len(starts_m) and starts_m.max() > FAR_SIZES * size_m:
        return [
            f"{design.name} hears from {starts_m.max():.4g} m on, and the run's design space ends at "
            f"{space.high[RANGE]:.4g} m; {UNIT}"
        ]
    return []


def _places(design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Origins (N, 3) and where gates begin (M,) of everything in a design [m]."""
    origins_m = [np.array([sensor.origin_m for sensor in design.sensors]).reshape(-1, 3)]
    starts_m = [np.array([sensor.gate_m[0] for sensor in design.sensors])]
    if design.ray_table is not None:
        origins_m.append(design.ray_table.origin_m)
        starts_m.append(design.ray_table.gate_m[:, 0])
    return np.concatenate(origins_m), np.concatenate(starts_m)
