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

from collections.abc import Sequence

import numpy as np

from lidardesign.design.sensor import Sensor
from lidardesign.evaluate.cma_figures import Setting, figures_of, projected

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
