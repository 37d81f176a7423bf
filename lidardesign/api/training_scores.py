"""Scores on training scenes that no fit chooses on, to compare designs while they change."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.run_folder import RunFolder, settings_texts

if TYPE_CHECKING:
    from lidardesign.api.design import Design
    from lidardesign.estimates import Interval
    from lidardesign.scenes.scene import Scene

PURPOSE = "comparison"  # of the stream of training scenes: fits choose and hold back scenes of other streams
SCENES = 20
MOST_KEPT = 100  # designs whose scores are known


class TrainingScores:
    """Scores of designs on a few training scenes, the same for all; held-out scenes are left for `evaluate`.

    Arguments:
        run: The run whose scenes they are.
        detector: The name of a detector, or its file.
        settings: Settings of the task, for scenes other than the learned ones.
        scenes: How many scenes.

    Example:
        >>> scores = TrainingScores(run, scenes=4)
        >>> design = run.fit(sensors=1, rays=16)
        >>> scores.difference(design, design).mean
        0.0
    """

    def __init__(
        self,
        run: RunFolder,
        *,
        detector: str = "ideal",
        settings: Sequence[str] | Mapping[str, Any] = (),
        scenes: int = SCENES,
    ) -> None:
        self.run, self.detector, self.settings, self.count = run, detector, settings_texts(settings), scenes
        self.values = lru_cache(MOST_KEPT)(self._values)

    @cached_property
    def scenes(self) -> list[Scene]:
        """The scenes."""
        from lidardesign.rays.training_scenes import TrainingScenes

        run = self.run.with_settings(self.settings)
        return list(itertools.islice(TrainingScenes(run, run.config.seed).scenes(PURPOSE), self.count))

    def _values(self, design: Design) -> np.ndarray:
        """The score in each scene."""
        from lidardesign.scoring.scene_scores import checked_score

        seen = design.simulate(self.scenes, detector=self.detector, settings=self.settings)
        return np.array([checked_score(self.run.task, self.run.metric, one.scene, one.returns).value for one in seen])

    def score(self, design: Design) -> Interval:
        """The mean score with its interval."""
        from lidardesign.estimates import mean_interval

        return mean_interval(self.values(design), self._groups, limits=self.run.metric.limits)

    def difference(self, design: Design, other: Design) -> Interval:
        """The mean of the scores of a design less those of another, scene by scene, with its interval."""
        from lidardesign.estimates import paired_difference

        return paired_difference(self.values(design), self.values(other), self._groups, limits=self.run.metric.limits)

    @cached_property
    def _groups(self) -> np.ndarray:
        from lidardesign.scenes.scene import group_numbers

        return group_numbers(self.scenes)
