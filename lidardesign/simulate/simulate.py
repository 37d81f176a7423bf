"""What a list of rays returns in a scene: exact first hits, or what a detector makes of them where effects are on.

Rays are traced from the sensor, not from the start of the gate, so whatever stands between the sensor and the
gate hides what is behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Outcome, Rays, Returns, gate_outcomes
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.simulate.physics import Physics


def simulate(
    scene: Scene, rays: Rays, *, casters: Sequence[SceneCaster] | None = None, physics: Physics | None = None
) -> list[Returns]:
    """The returns of rays in every time frame of a scene.

    Arguments:
        scene: What the rays meet; targets and occluders both stop them.
        rays: The rays, fired anew in each frame, N of them.
        casters: One caster per frame, as `build_casters` makes them; None builds them here.
        physics: A detector and the effects that are on; None, or none on: geometry alone.

    Returns:
        One `Returns` per frame, each with N outcomes.

    Raises:
        ConfigError: The number of casters is not the scene's number of frames.
    """
    return simulate_many(scene, [rays], casters=casters, physics=physics)[0]


@phase("tracing")
def simulate_many(
    scene: Scene,
    lists: Sequence[Rays],
    *,
    casters: Sequence[SceneCaster] | None = None,
    physics: Physics | None = None,
    repeats: Sequence[int] | None = None,
) -> list[list[Returns]]:
    """The returns of several lists of rays in every time frame of a scene, each as `simulate` gives them.

    All lists are traced together: over many frames, most of the time of short lists goes into the calls.

    Arguments:
        scene: What the rays meet; targets and occluders both stop them.
        lists: Lists of rays, each fired anew in each frame.
        casters: One caster per frame; None builds them here.
        physics: A detector and the effects that are on; each list shares the emitter's energy among its own rays.
        repeats: For each list, the `Physics.repeat` that its random numbers are of; None: the same for all lists.

    Returns:
        For each list, one `Returns` per frame.

    Raises:
        ConfigError: The number of casters is not the scene's number of frames.
    """
    casters = build_casters(scene) if casters is None else casters
    if len(casters) != scene.frames:
        raise ConfigError(f"{len(casters)} casters", where=f"scene {scene.name}", allowed=f"{scene.frames}")
    if not lists:
        return []
    if physics is not None and physics.effects:
        # its effects load compiled loops, which geometry alone does without
        from lidardesign.simulate.measure import measure

        each = [physics if repeats is None else replace(physics, repeat=repeats[i]) for i in range(len(lists))]
        return [
            [measure(scene, frame, rays, caster, chance) for frame, caster in enumerate(casters)]
            for rays, chance in zip(lists, each, strict=True)
        ]
    ends = np.cumsum([len(rays) for rays in lists])
    origins, directions, gate_m = (
        np.concatenate([getattr(rays, name) for rays in lists]) for name in ("origin_m", "direction", "gate_m")
    )
    found: list[list[Returns]] = [[] for _ in lists]
    for frame, caster in enumerate(casters):
        hits = caster.first_hit(origins, directions)
        outcome = gate_outcomes(hits.range_m, gate_m)
        returned = outcome == Outcome.RETURN
        columns = (outcome, np.where(returned, hits.range_m, np.nan), np.where(returned, hits.body, -1))
        for mine, rays, end in zip(found, lists, ends, strict=True):
            rows = slice(end - len(rays), end)
            # copies: a view would keep all the lists' returns alive with it
            mine.append(Returns(rays, *(column[rows].copy() for column in columns), frame=frame))
    return found


@phase("casters")
def build_casters(scene: Scene) -> list[SceneCaster]:
    """One caster per time frame of a scene, to be shared by all designs that are simulated in it."""
    return [SceneCaster(scene, frame) for frame in range(scene.frames)]


