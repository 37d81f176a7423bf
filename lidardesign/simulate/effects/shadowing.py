"""A receiver that stands elsewhere may not see what the emitter lights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidardesign.scene import Scene
from lidardesign.simulate.echoes import Beams, Echoes
from lidardesign.simulate.effects.sight import sight_shares
from lidardesign.simulate.hits import Hits
from lidardesign.simulate.physics import Tracer
from lidardesign.simulate.receiver_view import in_view


def heard(scene: Scene, beams: Beams, hits: Hits, echoes: Echoes, tracer: Tracer) -> Echoes:
    """The direct echoes that reach the scene's receiver, those behind glass fainter; all of them without a receiver.

    Arguments:
        scene: Its receiver and its bodies' transmissions.
        beams: Beams of light, B of them.
        hits: What they meet first.
        echoes: One for each of those hits, in their order.
        tracer: First hits of any rays at any time within the frame.
    """
    if scene.receiver is None:
        return echoes
    seen = np.flatnonzero(hits.body >= 0)
    points = beams.origin_m[seen] + hits.range_m[seen, None] * beams.direction[seen]
    share = in_view(scene.receiver, points).astype(np.float64)
    # what starts at the receiver finds its way back open: nothing was in its way out
    apart = (beams.origin_m[seen] != np.asarray(scene.receiver.origin_m)).any(axis=1)
    rows = seen[apart]
    share[apart] = sight_shares(scene, points[apart], hits.normal[rows], beams.time_s[rows], tracer)
    return replace(echoes, gain=echoes.gain * share).kept(share > 0)
