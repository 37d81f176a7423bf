r"""The vectors that a direct search varies, about a start, and the sensors that they stand for.

A vector holds, per sensor and in steps that change a score about equally: the shift of its origin along the free
axes, the turn of its boresight in the start's own tangent plane, the roll that is left when the frame is carried along,
the logarithms of both angular spreads, the middle and the logarithm of the width of its gate, and the logarithm of its
weight. Sensors whose origins are spread out also vary the matrix logarithm of their covariance, how far in front of
the sensor its rays meet (0: nowhere, 1: at its mean range, in each tangent direction), and the share of the gate that
is left for a ray whose origin is known. A scan has no spreads and weights to vary. A vector beyond the constraints
stands for the projected one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.design.sensor import Sensor
from lidardesign.evaluate.cma_figures import NARROWEST_RAD, Figures, Setting, figures_of, projected
from lidardesign.evaluate.cma_origins import exp_matrix, log_matrix
from lidardesign.numerics import TINY, sphere_exp, sphere_log

# One unit of a vector: shares of the start's own field of view, gate and origin spread, or nats, or radians.
DIRECTION_SHARE, GATE_SHARE, ORIGIN_SHARE = 0.15, 0.1, 0.5
ROLL_RAD, LOG_SPREAD, LOG_WIDTH, LOG_WEIGHT, LOG_SHARE = 0.2, 0.15, 0.15, 0.2, 0.2
LOG_COVARIANCE, FOCUS = 0.3, 0.15
# A shift of an origin that is a point at the start, as a share of its box.
BOX_SHARE = 0.05


class SensorCoordinates:
    """Vectors about some sensors, and the sensors that they stand for.

    Arguments:
        setting: What all candidates share.
        start: The sensors that the vector 0 stands for, up to their projection.
    """

    def __init__(self, setting: Setting, start: Sequence[Sensor]) -> None:
        self.setting = setting
        figures = figures_of(start, setting)
        self._bounds = setting.bounds(len(figures))
        self._start = projected(figures, setting, self._bounds)
        self._columns = self._varied()
        self.size = len(figures) * sum(width for _, width in self._columns)

    def _varied(self) -> list[tuple[str, int]]:
        """Names and widths of what one sensor's part of a vector holds."""
        axes, setting = self.setting.axes, self.setting
        spread = len(setting.spread_axes)
        whole = setting.layout != "scan"
        both = axes.angular == 2
        columns = [
            ("origin", len(axes.origin)),
            ("looking", axes.angular),
            ("roll", int(whole and both)),
            ("spread", axes.angular * whole),
            ("middle", int(axes.range and setting.gates)),
            ("width", int(axes.range and setting.gates)),
            ("log_weight", int(whole and len(self._start) > 1)),
            ("covariance", spread * (spread + 1) // 2),
            ("focus", axes.angular * bool(spread)),
            ("log_share", int(axes.range and setting.gates and bool(spread))),
        ]
        return [(name, width) for name, width in columns if width]

    @property
    def zero(self) -> np.ndarray:
        """The vector of the start, projected."""
        return self.projected(np.zeros(self.size))

    def projected(self, vector: np.ndarray) -> np.ndarray:
        """The nearest vector, step by step, that keeps the constraints."""
        return self._encoded(self.figures(vector))

    def figures(self, vector: np.ndarray, narrowed_m: float = math.inf) -> Figures:
        """The numbers that a vector stands for, projected; gates no wider than a cap [m]."""
        bounds = self._bounds if math.isinf(narrowed_m) else self._bounds.narrowed(narrowed_m)
        return projected(self._decoded(vector), self.setting, bounds)

    def _parts(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        rows = np.asarray(vector, dtype=np.float64).reshape(len(self._start), -1)
        parts, start = {}, 0
        for name, width in self._columns:
            parts[name] = rows[:, start : start + width]
            start += width
        return parts

    def _units(self) -> dict[str, np.ndarray]:
        """One unit of each column, shape (G, 1 or width)."""
        start, axes = self._start, self.setting.axes
        field = 2 * self.setting.interval * np.maximum(start.spread.max(axis=1, keepdims=True), NARROWEST_RAD)
        width = np.diff(start.gate, axis=1)
        box = (self._bounds.origin_high - self._bounds.origin_low)[:, list(axes.origin)]
        shift = BOX_SHARE * box
        if self.setting.spread_axes:
            spread = np.sqrt(np.einsum("gii->gi", start.covariance))
            shift = np.where(spread > 0, ORIGIN_SHARE * spread, shift)
        constants = {
            "roll": ROLL_RAD, "spread": LOG_SPREAD, "width": LOG_WIDTH, "log_weight": LOG_WEIGHT,
            "covariance": LOG_COVARIANCE, "focus": FOCUS, "log_share": LOG_SHARE,
        }  # fmt: skip
        units = {name: np.full((1, 1), value) for name, value in constants.items()}
        return units | {
            "origin": np.where(shift > 0, shift, 1.0),
            "looking": DIRECTION_SHARE * field,
            "middle": GATE_SHARE * np.maximum(width, TINY),
        }

    def _decoded(self, vector: np.ndarray) -> Figures:
        units = self._units()
        parts = {name: values * units[name] for name, values in self._parts(vector).items()}
        start, axes = self._start, self.setting.axes
        changes: dict[str, np.ndarray] = {}
        if "origin" in parts:
            changes["origin"] = start.origin.copy()
            changes["origin"][:, list(axes.origin)] += parts["origin"]
        free = [axes.horizontal, axes.vertical]
        if "looking" in parts:
            turn = np.zeros((len(start), 2))
            turn[:, free] = parts["looking"]
            changes["looking"] = np.einsum("gi,gij->gj", sphere_exp(turn), start.carried)
        if "spread" in parts:
            changes["spread"] = start.spread.copy()
            changes["spread"][:, free] *= np.exp(parts["spread"])
        if "middle" in parts:
            middle = start.gate.mean(axis=1) + parts["middle"][:, 0]
            half = np.diff(start.gate, axis=1)[:, 0] / 2 * np.exp(parts["width"][:, 0])
            changes["gate"] = np.stack([middle - half, middle + half], axis=1)
        if "covariance" in parts:
            logarithm = log_matrix(start.covariance) + _symmetric(parts["covariance"], len(axes.origin))
            changes["covariance"] = exp_matrix(logarithm)
        if "focus" in parts:
            changes["focus"] = start.focus.copy()
            changes["focus"][:, free] += parts["focus"]
        for name in ("roll", "log_weight", "log_share"):
            if name in parts:
                changes[name] = getattr(start, name) + parts[name][:, 0]
        return replace(start, **changes)

    def _encoded(self, figures: Figures) -> np.ndarray:
        """The vector of projected numbers."""
        start, axes, units = self._start, self.setting.axes, self._units()
        free = [axes.horizontal, axes.vertical]
        turned = np.einsum("gij,gj->gi", start.carried, figures.looking)
        widths = [np.diff(one.gate, axis=1) for one in (figures, start)]
        values = {
            "origin": (figures.origin - start.origin)[:, list(axes.origin)],
            "looking": sphere_log(turned)[:, free],
            "roll": (figures.roll - start.roll)[:, None],
            "spread": np.log(np.maximum(figures.spread / np.maximum(start.spread, TINY), TINY))[:, free],
            "middle": (figures.gate.mean(axis=1) - start.gate.mean(axis=1))[:, None],
            "width": np.log(np.maximum(widths[0] / np.maximum(widths[1], TINY), TINY)),
            "log_weight": (figures.log_weight - start.log_weight)[:, None],
            "focus": (figures.focus - start.focus)[:, free],
            "log_share": (figures.log_share - start.log_share)[:, None],
        }
        if self.setting.spread_axes:
            moved = log_matrix(figures.covariance) - log_matrix(start.covariance)
            rows, columns = np.triu_indices(moved.shape[1])
            values["covariance"] = moved[:, rows, columns]
        return np.concatenate([values[name] / units[name] for name, _ in self._columns], axis=1).ravel()


def _symmetric(upper: np.ndarray, size: int) -> np.ndarray:
    """Upper triangles (G, k (k + 1) / 2) as symmetric matrices (G, k, k)."""
    rows, columns = np.triu_indices(size)
    full = np.zeros((len(upper), size, size))
    full[:, rows, columns] = full[:, columns, rows] = upper
    return full
