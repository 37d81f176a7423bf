r"""Fog and haze: light that fades, and light that comes back from the air itself.

Over a range R the air leaves exp(-2 alpha R) of an echo's photons: the range strays more and returns are lost, as
from fewer photons. Haze sends h counts into a bin, most at the gate's start; it is taken for the echo with at most
(B - 1) exp(-(sqrt(s) - sqrt(h))^2) (see `Counts.mistaken`), and raises the level that an echo has to stand out from. A
ray without a return may take it for one where any of it is counted: 1 - exp(-all of its counts), as one count is enough
in the dark. Where a detector is blind after a count, haze before an echo leaves less of it (see `Blindness`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.bounds.blindness import Blindness
from lidardesign.simulate.bounds.counts import Counts, Echo, changed_share
from lidardesign.simulate.bounds.sight import Sight, Stake
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.returns import Rays


def absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Why the air does not matter, if so."""
    if scene.medium is None or scene.medium.extinction_per_m == scene.medium.backscatter_per_m_sr == 0:
        return "the air is clear"
    return None if detector.photons is not None else "the detector hears an echo however weak"


def stake(sight: Sight, counts: Counts) -> Stake:
    """Of air that weakens and scatters."""
    sigma_m = sight.sigma_m()
    blind, without = Blindness.of(counts), Blindness.of(counts, haze=False)
    clear, left = counts.signal, blind.left
    haze, fullest = (counts.pulses * part for part in counts.haze_per_pulse)
    # haze raises the level of background that a return has to stand out from
    fewer = counts.more_missed(Echo(clear, sigma_m), Echo(left, sigma_m, haze / counts.bins))
    any_count = -np.expm1(-haze)
    own = counts.per_bin * blind.under
    wrong = np.minimum(counts.mistaken(left, counts.per_bin + fullest, own, sigma_m), any_count)
    changed = np.maximum(changed_share(clear, counts.in_air), changed_share(without.left, left))
    squared = counts.error_m(left, sigma_m) ** 2 * np.minimum(2 * np.sqrt(changed) + any_count, 1.0)
    lost = np.where(sight.returned, fewer + wrong, any_count)
    medium = sight.scene.medium
    reason = f"air that dims light by {100 * -np.expm1(-2 * medium.extinction_per_m):.3g} % per metre of range"
    return Stake(squared, np.minimum(lost, 1.0), reason)
