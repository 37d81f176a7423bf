"""The rival that designs are held against: the best of all baselines on training scenes, never on held-out ones.

Whoever picks the best of several rivals by their scores on held-out scenes holds designs against a lucky one. The rival
is found on scenes that no rival's rays were chosen on.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidardesign.evaluate.entries import Entry
from lidardesign.evaluate.request import EvaluationRequest
from lidardesign.evaluate.scene_scores import score_here
from lidardesign.run.clock import phase
from lidardesign.scene import Scene

MOST_SCENES = 20
FEWEST_SCENES = 5
LARGEST_SHARE = 0.1  # of the rays that an evaluation fires may be fired to find it


@dataclass(frozen=True)
class StrongestRival:
    """The best of all baselines at one number of rays.

    Arguments:
        name: Its name.
        rays: Rays per frame.
        scenes: The number of training scenes that it was found on.
        values: The mean score of every baseline on them.
    """

    name: str
    rays: int
    scenes: int
    values: Mapping[str, float]

    @classmethod
    def best_of(cls, values: Mapping[str, float], better: str, rays: int, scenes: int) -> StrongestRival:
        """The best of mean scores by name; the first of equal ones."""
        choose = min if better == "lower" else max
        return cls(choose(values, key=lambda name: values[name]), rays, scenes, dict(values))

    def as_dict(self) -> dict[str, Any]:
        """For `--json`."""
        return {"name": self.name, "rays": self.rays, "scenes": self.scenes, "values": dict(self.values)}


@phase("strongest rival")
def strongest_rival(request: EvaluationRequest, entries: Sequence[Entry], rays: int) -> StrongestRival | None:
    """The best of all baselines at a number of rays, under the effects of the evaluation; None without baselines.

    Arguments:
        request: The evaluation.
        entries: All its rows to be.
        rays: The number of rays.
    """
    rivals = [entry for entry in entries if entry.baseline and entry.matched_to is None and entry.rays == rays]
    if not rivals or not request.train:
        return None
    fired = sum(entry.rays for entry in entries) * len(request.test)
    affordable = int(LARGEST_SHARE * fired / (rays * len(rivals)))
    scenes = held_back_scenes(request, min(max(affordable, FEWEST_SCENES), MOST_SCENES))
    scene_pass = request.scene_pass(lambda number: [entry.drawn(number) for entry in rivals], request.planner)
    found = score_here(replace(scene_pass, scenes=scenes), None)
    means = np.mean([[score.value for score, _ in scene.scores] for scene in found], axis=0).tolist()
    values = dict(zip((entry.name for entry in rivals), means, strict=True))
    return StrongestRival.best_of(values, request.metric.better, rays, len(scenes))


def held_back_scenes(request: EvaluationRequest, count: int) -> list[Scene]:
    """Training scenes that no rival's rays were chosen on; the first ones where a request has no others."""
    scenes = iter(request.train) if request.greedy is None else request.greedy.scenes("held back")
    return list(itertools.islice(scenes, count))


def mean_rival(found: Iterable[StrongestRival | None], better: str) -> StrongestRival | None:
    """The strongest rival of several seeds, by its mean score over them; None where one seed has none."""
    each = list(found)
    known = [one for one in each if one is not None]
    if not known or len(known) < len(each):
        return None
    names = [name for name in known[0].values if all(name in one.values for one in known)]
    values = {name: float(np.mean([one.values[name] for one in known])) for name in names}
    return StrongestRival.best_of(values, better, known[0].rays, sum(one.scenes for one in known))
