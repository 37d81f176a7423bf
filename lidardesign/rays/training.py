"""Training scenes that nothing was learned from, and what a task says that returns tell about them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

from lidardesign.rays.information import CHOSEN_SHARE, FEW_SCENES, MOST_ITEMS, checked_information, choosing
from lidardesign.rays.informed import InformedScene, inform
from lidardesign.run.clock import phase
from lidardesign.run_folder import RunFolder
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.task import Task, random_generator
from lidardesign.workers import Starmap

MARGIN_SIGMAS = 2.0  # by which gates are longer than what training scenes returned, in the density's sigma
# Chosen on, and held back from the choice.
CHOICE, HELD_BACK = "choice", "held back"


class TrainingScenes:
    """The scenes of a run that rays are chosen on, without end, for each purpose.

    Arguments:
        run: The run, whose task says what returns tell.
        seed: Root of the random streams.
        starmap: How scenes are informed: `itertools.starmap`, or by workers.
        at: The one value of its conditions that rays are at; none where they are at all of them.
    """

    def __init__(
        self, run: RunFolder, seed: int, starmap: Starmap = itertools.starmap, at: Mapping[str, float] | None = None
    ) -> None:
        self.run, self.seed, self._starmap, self._at = run, seed, starmap, at or {}
        self._first: dict[str, list[Scene]] = {}

    @property
    def margin_m(self) -> float:
        """By how much gates are longer at both ends than what training scenes returned [m]."""
        return MARGIN_SIGMAS * self.run.config.density.sigma_m

    def scenes(self, purpose: str, start: int = 0) -> Iterator[Scene]:
        """Scenes without end from a number on, drawn with further seeds for each purpose."""
        skipped = 0
        for draw in itertools.count():
            label = random_generator(self.seed, "selection", purpose, draw)
            scenes = self.run.scenes("train", int(label.integers(2**31)))
            yield from scenes[max(start - skipped, 0) :]
            skipped += len(scenes)

    def first(self, purpose: str) -> list[Scene]:
        """The first few scenes; they are kept."""
        if purpose not in self._first:
            self._first[purpose] = list(itertools.islice(self.scenes(purpose), FEW_SCENES))
        return self._first[purpose]

    @phase("what returns tell")
    def inform(
        self, purpose: str, rays: Rays, visits: Sequence[slice], start: int, stop: int, share: float = CHOSEN_SHARE
    ) -> list[InformedScene]:
        """What returns of some rays tell about the scenes from one number to before another.

        Arguments:
            purpose: What the scenes are for.
            rays: Candidates with the widest gates that they may have.
            visits: Which of them fire at each condition.
            start, stop: Numbers of scenes.
            share: The share of the candidates that will be chosen.
        """
        scenes = itertools.islice(self.scenes(purpose, start), stop - start)
        if self._at:
            visits = self._at_nearest(visits[0])
        asked = ((scene, number) for number, scene in enumerate(scenes, start))
        work = partial(informed_scene, self.run.task, rays, visits, share, self.seed, purpose)
        return list(self._starmap(work, asked))

    def _at_nearest(self, visit: slice) -> list[slice]:
        """Rays at one value among the conditions that the task judges at: those of the nearest; elsewhere none fire."""
        conditions = self.run.conditions()
        away = [sum(abs(one[name] - value) for name, value in self._at.items()) for one in conditions]
        nearest = away.index(min(away))
        return [visit if number == nearest else slice(0, 0) for number in range(len(conditions))]


def informed_scene(
    task: Task, rays: Rays, visits: Sequence[slice], share: float, seed: int, purpose: str, scene: Scene, number: int
) -> InformedScene:
    """What returns tell about one scene, of a random draw of its items."""
    with choosing(share):
        found = inform(scene, rays, visits, partial(checked_information, task))
    return found.with_fewer_items(MOST_ITEMS, random_generator(seed, "items", purpose, number))
