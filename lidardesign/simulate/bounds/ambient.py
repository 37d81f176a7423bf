r"""Light of the surroundings and dark counts: false peaks, hidden echoes, and returns where there is none.

With mean counts b per bin, B bins and s counts in the echo's bin, another bin wins with at most
(B - 1) exp(-(sqrt(s + b) - sqrt(b))^2): the union over bins of Chernoff's bound. A threshold that lets background pass
with the probability `false_alarm` hides echoes below it, and a ray that has no return invents one as often as that.
Counts under the echo make its range stray: in much background, b per metre, n photons of a Gaussian are placed with the
variance (sigma^2 / n) (4 sqrt(pi) sigma b / n) (Cramer and Rao's bound), which is added to that without; the highest
bin strays (1 + b / s)^(1/4) times as far.

No false peak can be where no count arrives: it is at most 1 - exp(-B b). Where a detector is blind after a count, light
before an echo leaves less of it (see `Blindness`), and is uneven, so that more of it is taken for returns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lidardesign.numerics import safe_divide
from lidardesign.scene import Scene
from lidardesign.simulate.bounds.blindness import Blindness, missed_behind, unevenness, variance_of_missing
from lidardesign.simulate.bounds.counts import Counts, counted, share_in_bins
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why nothing but the emitter's light is counted, if so."""
    if detector.photons is None:
        return "the detector does not count photons"
    dark = scene.ambient is None or scene.ambient.illuminance_lux == 0
    return "it is dark and the detector is quiet" if dark and detector.photons.dark_hz == 0 else None


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of counts that no echo brought."""
    sigma_m = sight.sigma_m()
    blind, in_the_dark = Blindness.of(counts), Blindness.of(counts, ambient=False)
    signal, per_bin = blind.left, counts.per_bin
    any_count = -np.expm1(-per_bin * counts.bins)
    hidden = np.maximum(missed_behind(counts, blind, sigma_m) - counts.missed(in_the_dark.left, 0.0, sigma_m), 0.0)
    wrong = np.minimum(counts.mistaken(signal, per_bin, per_bin * blind.under, sigma_m), any_count)
    # light that is no echo makes a return where one count is enough, and none where background asks for more
    stray = counts.leaked(sigma_m) + counts.pulses * counts.haze_per_pulse[0]
    unmade = np.where(counts.needed(per_bin) > 1, -np.expm1(-stray), 0.0)
    alarms = np.minimum(sight.detector.false_alarm + unevenness(counts, blind), any_count)
    lost = np.minimum(np.where(sight.returned, wrong + hidden, alarms + unmade), 1.0)
    squared = np.minimum(_strayed(counts, signal, sigma_m), sight.width_m) ** 2
    squared += variance_of_missing(counts, in_the_dark.left, signal, sigma_m)
    return Stake(squared, lost, _reason(sight, per_bin * counts.bins))


def _strayed(counts: Counts, signal: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    """How far counts under the echo make its range stray, shape (N,) [m]."""
    error, per_bin = counts.error_m(signal, sigma_m), counts.per_bin
    if counts.sight.detector.estimator == "matched":
        per_metre = per_bin / counts.bin_m
        return error * np.sqrt(4 * math.sqrt(math.pi) * sigma_m * safe_divide(per_metre, np.maximum(signal, 1.0)))
    echo = np.maximum(signal, 1.0) * share_in_bins(1, counts.bin_m, sigma_m)
    return error * np.sqrt(np.sqrt(1 + safe_divide(per_bin, echo)) - 1)


def _reason(sight: Sight, in_gate: np.ndarray) -> str:
    gate = float(np.median(in_gate[sight.returned] if sight.returned.any() else in_gate))
    ambient = sight.scene.ambient
    light = "dark counts" if ambient is None else f"{ambient.illuminance_lux:,.0f} lux ({ambient.source}), dark counts"
    return f"{light}: about {counted(gate)} in a gate"
