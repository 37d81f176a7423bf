"""Training scenes that the density was not learned from, what candidate rays tell of them, and how many are enough."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np

from lidardesign.numerics import systematic_draw
from lidardesign.rays.information import CHOSEN_SHARE, FEW_SCENES, MOST_ITEMS, checked_information
from lidardesign.run.clock import phase
from lidardesign.run_folder import RunFolder
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.returns import simulate_many
from lidardesign.task import Information, Task, random_generator
from lidardesign.workers import Starmap

MARGIN_SIGMAS = 2.0  # by which gates are longer than what training scenes returned, in the density's sigma
# Chosen on, and held back from the choice.
CHOICE, HELD_BACK = "choice", "held back"
# A task's information of the returns of candidates in a scene, by the share of them that will be chosen.
Informs = Callable[[Scene, Sequence[Returns], float], Information]
Found = TypeVar("Found")
# Scenes are enough once doubling them lowered the loss on scenes held back by less than the first share, and the loss
# on its own scenes is lower by at most the second; doubling again would gain about a hundredth.
SMALLEST_GAIN, SMALLEST_GAP = 0.02, 0.05
LARGEST = np.zeros(0)  # the table of sums of items whose largest worth counts


class TrainingScenes:
    """Endless streams of a run's scenes that rays are chosen on, one for each purpose.

    Arguments:
        run: The run, whose task has the method `informs`.
        seed: Root of the random streams.
        starmap: Map over scenes: `itertools.starmap`, or by workers.
        keeps: Whether information may be cached in the run.
    """

    def __init__(self, run: RunFolder, seed: int, starmap: Starmap = itertools.starmap, *, keeps: bool = False) -> None:
        self.run, self.seed, self._starmap, self.keeps = run, seed, starmap, keeps
        self._first: dict[str, list[Scene]] = {}
        # sizes of all draws so far, by purpose, and the last draw: skipped draws are not made again
        self._sizes: dict[str, list[int]] = {}
        self._last: dict[str, tuple[int, list[Scene]]] = {}

    @property
    def margin_m(self) -> float:
        """The margin of gates at both ends beyond the returns of training scenes [m]."""
        return MARGIN_SIGMAS * self.run.config.density.sigma_m

    def scenes(self, purpose: str, start: int = 0) -> Iterator[Scene]:
        """An endless stream of scenes from number `start`, drawn with further seeds for each purpose."""
        sizes = self._sizes.setdefault(purpose, [])
        for draw in itertools.count():
            if draw == len(sizes) or start < sizes[draw]:
                number, scenes = self._last.get(purpose, (-1, []))
                if number != draw:
                    label = random_generator(self.seed, "selection", purpose, draw)
                    scenes = self.run.scenes("train", int(label.integers(2**31)))
                    self._last[purpose] = draw, scenes
                if draw == len(sizes):
                    sizes.append(len(scenes))
                yield from scenes[start:]
            start = max(start - sizes[draw], 0)

    def first(self, purpose: str) -> list[Scene]:
        """The first `FEW_SCENES` scenes of a purpose, cached."""
        if purpose not in self._first:
            self._first[purpose] = list(itertools.islice(self.scenes(purpose), FEW_SCENES))
        return self._first[purpose]

    @phase("what returns tell")
    def inform(
        self, purpose: str, rays: Rays, visits: Sequence[slice], start: int, stop: int, share: float = CHOSEN_SHARE
    ) -> list[SceneInformation]:
        """Information of rays about the scenes `start` to before `stop`.

        Arguments:
            purpose: The purpose of the scenes.
            rays: Candidates with the widest gates that they may have.
            visits: Slices of them that fire at each condition.
            start, stop: Numbers of scenes.
            share: The share of the candidates that will be chosen.
        """
        kept = self._first.get(purpose, [])
        scenes = itertools.chain(kept[start:], self.scenes(purpose, max(start, len(kept))))
        work = partial(sampled_information, self.run.task, rays, visits, share, self.seed, purpose)
        return self.over(work, itertools.islice(scenes, stop - start), start)

    def over(self, work: Callable[[Scene, int], Found], scenes: Iterable[Scene], start: int = 0) -> list[Found]:
        """What some work finds in scenes and their numbers, here or by workers."""
        return list(self._starmap(work, ((scene, number) for number, scene in enumerate(scenes, start))))


def sampled_information(
    task: Task, rays: Rays, visits: Sequence[slice], share: float, seed: int, purpose: str, scene: Scene, number: int
) -> SceneInformation:
    """Information of rays about a random draw of one scene's items."""
    found = information_of(scene, rays, visits, partial(checked_information, task), share)
    return found.with_fewer_items(MOST_ITEMS, random_generator(seed, "items", purpose, number))


def information_of(
    scene: Scene, rays: Rays, visits: Sequence[slice], informs: Informs, share: float
) -> SceneInformation:
    """A task's information of the returns of rays in a scene, through the rays' own gates.

    Arguments:
        scene: The scene.
        rays: All candidates.
        visits: Slices of the rays at each condition; at the other conditions they have no returns.
        informs: The task's information of a scene's returns.
        share: The share of the candidates that will be chosen.
    """
    fired = simulate_many(scene, [rays.subset(visit) for visit in visits])
    returns = [pad_returns(rays, visit, frame) for visit, frames in zip(visits, fired, strict=True) for frame in frames]
    return SceneInformation.of(informs(scene, returns, share), returns)


def pad_returns(rays: Rays, fired: slice, returns: Returns) -> Returns:
    """The returns of a slice of the rays extended to all rays, of which the others miss."""
    outcome, range_m, body = np.full(len(rays), Outcome.MISS), np.full(len(rays), np.nan), np.full(len(rays), -1)
    outcome[fired], range_m[fired], body[fired] = returns.outcome, returns.range_m, returns.body
    return Returns(rays, outcome, range_m, body, returns.frame)


@dataclass(frozen=True, eq=False)
class SceneInformation:
    """A task's information of a scene's returns, with their ranges, from which gates follow.

    Arguments:
        ray, item: Of each pair, int32 (E,).
        worth: Above 0, float32 (E,).
        range_m: The range of its return, (E,) [m].
        weight: Weights of items, summing to 1, (U,).
        spoiling: Rays of returns with harm, one entry per return, (H,).
        harm, harm_range_m: Harm of these returns, and their ranges [m], (H,).
        sums: The table of sums, or `LARGEST`.
        complete: phi of an item with complete information.
        is_repeated: Whether a ray may inform about an item in several frames, of which the largest worth counts.
        unit: Of worth.
    """

    ray: np.ndarray
    item: np.ndarray
    worth: np.ndarray
    range_m: np.ndarray
    weight: np.ndarray
    spoiling: np.ndarray
    harm: np.ndarray
    harm_range_m: np.ndarray
    sums: np.ndarray
    complete: float
    is_repeated: bool
    unit: str

    @classmethod
    def of(cls, information: Information, returns: Sequence[Returns]) -> SceneInformation:
        """The checked information of the returns of all candidate rays, through open gates."""
        range_m = np.stack([frame.range_m for frame in returns])
        tells = np.flatnonzero(information.worth > 0)
        ray, item = information.ray[tells], information.item[tells]
        count = len(information.frame)
        weight = np.ones(count) if information.weight is None else np.asarray(information.weight, dtype=np.float64)
        harm = np.zeros_like(range_m) if information.harm is None else np.asarray(information.harm)
        spoiling = np.nonzero(harm)
        return cls(
            ray=ray.astype(np.int32),
            item=item.astype(np.int32),
            worth=information.worth[tells].astype(np.float32),
            range_m=range_m[information.source[tells], ray],
            weight=weight / weight.sum(),
            spoiling=spoiling[1],
            harm=harm[spoiling],
            harm_range_m=range_m[spoiling],
            sums=LARGEST if information.sums is None else np.asarray(information.sums, dtype=np.float64),
            # a scene without items has no loss
            complete=information.complete if count else 0.0,
            is_repeated=information.seen_in is not None,
            unit=information.unit,
        )

    @cached_property
    def informative_returns(self) -> tuple[np.ndarray, np.ndarray]:
        """Every return that informs about something: its ray (K,) and range (K,) [m]."""
        # a return informs about several items
        order = np.lexsort((self.range_m, self.ray))
        ray, range_m = self.ray[order], self.range_m[order]
        is_first = np.append(True, (np.diff(ray) > 0) | (np.diff(range_m) > 0))[: len(ray)]
        return ray[is_first].astype(np.intp), range_m[is_first]

    def of_rays(self, number: np.ndarray) -> SceneInformation:
        """The information of some rays under new numbers (N,), -1 for rays that are left out."""
        kept, spoils = number[self.ray] >= 0, number[self.spoiling] >= 0
        return replace(
            self,
            ray=number[self.ray[kept]].astype(np.int32),
            item=self.item[kept],
            worth=self.worth[kept],
            range_m=self.range_m[kept],
            spoiling=number[self.spoiling[spoils]],
            harm=self.harm[spoils],
            harm_range_m=self.harm_range_m[spoils],
        )

    def with_fewer_items(self, most: int, generator: np.random.Generator) -> SceneInformation:
        """The information about a random draw of at most `most` items by weight; about all where there are no more."""
        if len(self.weight) <= most:
            return self
        drawn, times = np.unique(systematic_draw(self.weight, most, generator), return_counts=True)
        number = np.full(len(self.weight), -1, dtype=np.int32)
        number[drawn] = np.arange(len(drawn))
        kept = number[self.item] >= 0
        return replace(
            self,
            ray=self.ray[kept],
            item=number[self.item[kept]],
            worth=self.worth[kept],
            range_m=self.range_m[kept],
            weight=times / most,
        )


def are_enough(before: float, loss: float, own: float) -> bool:
    """True where doubling the scenes of a choice would hardly lower its loss on others.

    Arguments:
        before: Loss of the choice on half the scenes, on scenes held back.
        loss: Loss of this choice there.
        own: Its loss on the scenes that it was chosen on.
    """
    return loss >= (1 - SMALLEST_GAIN) * before and loss - own <= SMALLEST_GAP * loss
