"""The truth and the score of moving surfaces: every frame has a surface of its own and equal weight.

A frame in which no admissible ray sees any of the targets is left out; a frame with too few returns has the metric's
worst value, and a scene fails if all of its frames do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lidardesign import DataError, DesignSpace, Information, Metric, Returns, Scene, Score, metrics, random_generator
from lidardesign_tasks.surface import ITEMS, LazyTruth, fewer_points, information_of, surface_score

SURFACES = "surfaces"
FEWEST_ITEMS = 25  # of a frame: they give its area to within 10 to 20 %


class MovingTruth(LazyTruth):
    """Part of the targets that is visible to some admissible ray: a SurfaceCloud or None per frame, as `surfaces`."""

    key = SURFACES

    def find(self) -> tuple[metrics.SurfaceCloud | None, ...]:
        """Compute the visible part of the targets in each frame."""
        found = [self._surface(frame) for frame in range(self.scene.frames)]
        if all(surface is None for surface in found):
            raise DataError(
                "no ray of the design space sees any part of a target in any frame",
                where=f"scene {self.scene.name!r}",
                hint="move the sensors, or the poses of the bodies",
            )
        return tuple(found)

    def _surface(self, frame: int) -> metrics.SurfaceCloud | None:
        generator = random_generator(self.seed, "truth", frame)
        try:
            return metrics.visible_surface(self.scene, self.space, self.points, generator, frame=frame)
        except DataError:
            # no target is in view
            return None


def with_moving_truth(
    scene: Scene, space: DesignSpace, points: int, generator: np.random.Generator, **further: Any
) -> Scene:
    """The scene with its truth: `surfaces`, the visible part of the targets in each frame, and further keys."""
    return replace(scene, truth=MovingTruth(scene, space, points, int(generator.integers(2**62)), further))


def moving_score(metric: Metric, scene: Scene, returns: Sequence[Returns]) -> Score:
    """Mean over frames of the Chamfer distance of each frame's returns to its visible surface [mm].

    Details are means over frames; `failed_frames` counts those with too few returns.
    """
    scores = [surface_score(metric, still, seen) for still, seen in _frames(scene, returns)]
    names = dict.fromkeys(name for score in scores for name in score.details)
    details = {
        name: float(np.mean([score.details[name] for score in scores if name in score.details])) for name in names
    }
    failed = sum(score.failed for score in scores)
    value = float(np.mean([score.value for score in scores]))
    return Score(value, failed=failed == len(scores), details={**details, "failed_frames": float(failed)})


def moving_informs(scene: Scene, returns: Sequence[Returns], share: float) -> Information:
    """Information of returns about points of the visible surface of their own frame, see `surface_information`.

    A frame without a visible surface has no points, and its returns are ignored.
    """
    count = max(ITEMS // scene.frames, FEWEST_ITEMS)
    return information_of(fewer_points(scene.truth, count)[SURFACES], scene, returns, share)


def _frames(scene: Scene, returns: Sequence[Returns]) -> list[tuple[Scene, list[Returns]]]:
    """Each frame with a visible surface as a scene of its own, with its returns from all positions of a robot."""
    surfaces = scene.truth[SURFACES]
    return [
        (replace(scene, truth={"surface": surface}), [one for one in returns if one.frame == frame])
        for frame, surface in enumerate(surfaces)
        if surface is not None
    ]
