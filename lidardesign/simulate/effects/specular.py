"""Mirrors and glass: echoes by way of specular reflection and transmission, later and fainter than direct ones.

At every surface a beam goes on twice, mirrored with the share `specular` and straight on with the share `transmission`;
nothing is drawn at random. Surfaces that it hits send light back. A ray that is received at its own origin is received
through the pixel that it was sent from, so its light returns along the same path and meets every mirror and pane twice:
an emitter behind a mirror is its image there, and an echo is that of the image, times the square of the share that
arrives. A fixed receiver elsewhere sees a lit surface directly, through glass but by no mirror; rays that start at the
receiver are received as without one. Mirrors are flat over the width of a beam: curved ones neither focus nor spread
it. Panes do not refract light. A specular reflection straight back into the receiver makes no echo.

Bound of its effect (`bound`): redirected light may hit anything, so every ray that hits such a body may be wrong. Lost
is the share of rays whose first hit is on a body that mirrors or transmits, and redirected light may move their echoes
by the detector's resolution; other rays are unchanged. The bound is strict: the redirected light is neither followed
nor weighed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.scenes.rays import Hits, Rays, in_view
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.light import Beams, Echoes, Tracer, direct_echoes
from lidardesign.simulate.detector.physics import Detector
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits
from lidardesign.simulate.effects.shadowing import clearance_m, sight_shares

# Beams end after this many surfaces: four panes, in and out.
MAXIMUM_TURNS = 8
# Beams end below this share of their light: both ways, a millionth of it comes back.
FAINTEST_SHARE = 1e-3
# Beams that are followed together: each may become 2^8, at 200 bytes and more.
BEAMS_AT_ONCE = 1 << 14
# Largest step along a grazing beam off its surface, in clearances.
GRAZING_STEPS = 10.0


@dataclass(frozen=True, eq=False)
class _Front:
    """Unfolded beams: each starts at the image of its emitter and runs straight to its present hit.

    Arguments:
        beams: Origins at the images of the emitter, directions and remaining shares of light, in any order of rays.
        number: Index of the emitted beam that each comes from, shape (B,).
        passed: Remaining share of a beam's light, between 0 and 1, shape (B,).
        hits: Hits, with ranges from the images.
    """

    beams: Beams
    number: np.ndarray
    passed: np.ndarray
    hits: Hits

    def subset(self, chosen: np.ndarray | slice) -> _Front:
        return _Front(self.beams.subset(chosen), self.number[chosen], self.passed[chosen], self.hits.subset(chosen))


def detours(scene: Scene, beams: Beams, hits: Hits, tracer: Tracer) -> Echoes:
    """Echoes of surfaces that beams hit after up to `MAXIMUM_TURNS` mirrors and panes.

    Arguments:
        scene: Its bodies' shares of light, and its receiver.
        beams: The beams as they leave.
        hits: Their first hits.
        tracer: First hits of any rays at any time within the frame.
    """
    return Echoes.joined([*(_detours_of(scene, beams, hits, rows, tracer) for rows in _groups(beams)), _no_echoes()])


def _groups(beams: Beams) -> Iterator[slice]:
    """Slices of beams of whole rays, small enough that the beams that they split into fit into memory."""
    rays = beams.ray[-1] + 1 if len(beams) else 0
    step = max(BEAMS_AT_ONCE * rays // max(len(beams), 1), 1)
    edges = np.searchsorted(beams.ray, np.arange(0, rays + step, step))
    yield from (slice(begin, end) for begin, end in itertools.pairwise(edges) if end > begin)


def _detours_of(scene: Scene, beams: Beams, hits: Hits, rows: slice, tracer: Tracer) -> Echoes:
    mirrored = np.array([body.specular for body in scene.bodies])
    passing = np.array([body.transmission for body in scene.bodies])
    front = _Front(beams, np.arange(len(beams)), np.ones(len(beams)), hits).subset(rows)
    echoes = [_no_echoes()]
    for _ in range(MAXIMUM_TURNS):
        # mirrored direction v - 2 (v.n) n; arbitrary on a miss
        direction, normal = front.beams.direction, front.hits.normal
        back = direction - 2 * np.einsum("nk,nk->n", direction, normal)[:, None] * normal
        turned = _followed(scene, front, mirrored, back, tracer)
        straight = _followed(scene, front, passing, front.beams.direction, tracer)
        front = _Front(
            Beams.joined([turned.beams, straight.beams]),
            np.concatenate([turned.number, straight.number]),
            np.concatenate([turned.passed, straight.passed]),
            Hits.joined([turned.hits, straight.hits]),
        )
        if not len(front.beams):
            break
        echoes.append(_received(scene, beams, front, tracer))
    return Echoes.joined(echoes)


def _followed(scene: Scene, front: _Front, shares: np.ndarray, direction: np.ndarray, tracer: Tracer) -> _Front:
    """Continue beams from their hits in directions (B, 3), with the bodies' shares (bodies,), to their next hits."""
    passed = np.where(front.hits.body >= 0, shares[front.hits.body] * front.passed, 0.0)
    rows = np.flatnonzero(passed >= FAINTEST_SHARE)
    old, direction = front.subset(rows), direction[rows]
    beams, path_m = old.beams, old.hits.range_m
    point = beams.origin_m + path_m[:, None] * beams.direction
    cosine = np.abs(np.einsum("nk,nk->n", direction, old.hits.normal))
    # a step along the beam that lifts its start off the surface
    step_m = clearance_m(scene, path_m) / np.maximum(cosine, 1 / GRAZING_STEPS)
    found = tracer(point + step_m[:, None] * direction, direction, beams.time_s)
    image = replace(
        beams,
        origin_m=point - path_m[:, None] * direction,
        direction=direction,
        share=beams.share * shares[old.hits.body],
    )
    return _Front(image, old.number, passed[rows], Hits(path_m + step_m + found.range_m, found.body, found.normal))


def _received(scene: Scene, beams: Beams, front: _Front, tracer: Tracer) -> Echoes:
    front = front.subset(front.hits.body >= 0)
    if scene.receiver is None:
        return _received_back(scene, front)
    together = (beams.origin_m[front.number] == np.asarray(scene.receiver.origin_m)).all(axis=1)
    back = front.subset(together)
    image = beams.origin_m[back.number] + back.hits.range_m[:, None] * beams.direction[back.number]
    back = back.subset(in_view(scene.receiver, image))
    elsewhere = _received_elsewhere(scene, front.subset(~together), tracer)
    return Echoes.joined([_received_back(replace(scene, receiver=None), back), elsewhere])


def _received_back(scene: Scene, front: _Front) -> Echoes:
    return direct_echoes(scene, replace(front.beams, share=front.beams.share * front.passed), front.hits)


def _received_elsewhere(scene: Scene, front: _Front, tracer: Tracer) -> Echoes:
    """Echoes that a fixed receiver gets directly from lit surfaces."""
    echoes = direct_echoes(scene, front.beams, front.hits)
    point = front.beams.origin_m + front.hits.range_m[:, None] * front.beams.direction
    share = sight_shares(scene, point, front.hits.normal, front.beams.time_s, tracer)
    return replace(echoes, gain=echoes.gain * share).subset(share > 0)


def _no_echoes() -> Echoes:
    return Echoes(np.empty(0, dtype=np.int64), np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why mirrors and glass change nothing, or None."""
    return None if any(_leads(body) for body in scene.bodies) else "nothing mirrors or lets light through"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of mirrors and glass."""
    leading = np.array([_leads(body) for body in first_hits.scene.bodies])
    met = np.where(first_hits.hits.body >= 0, leading[first_hits.hits.body], False)
    names = ", ".join(dict.fromkeys(body.name for body in first_hits.scene.bodies if _leads(body)))
    moved_m = np.minimum(first_hits.resolution_m, first_hits.width_m) * met
    return EffectBound(
        moved_m**2, met.astype(float), f"{100 * met.mean():.3g} % of rays meet mirrors or glass: {names}"
    )


def _leads(body: object) -> bool:
    return body.specular > 0 or body.transmission > 0
