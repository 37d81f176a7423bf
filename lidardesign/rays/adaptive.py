"""The choice of patterns that follow what they see, and of the rule that picks among them.

Training scenes are divided frame by frame. Their features are clustered, and the best rays of each cluster are chosen
with the rays of the first look, if there is one, kept. Patterns and assignment take turns: each frame goes to the
pattern that knows most about it, and the rule is fitted to that. How many patterns there are, how many rays look first
and whether frames change their pattern follows from frames that were held back. Small clusters overfit.

References:
    k-means++: Arthur and Vassilvitskii 2007.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from lidardesign.numerics import SLACK, TINY
from lidardesign.rays.choice import Choice, choose, choose_within
from lidardesign.rays.coverage import Coverage
from lidardesign.rays.information import checked_information
from lidardesign.rays.selection import Selection
from lidardesign.rays.training_scenes import CHOICE, SceneInformation, TrainingScenes
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.adaptive import UNKNOWN, Features, PatternRule
from lidardesign.simulate.returns import simulate_many
from lidardesign.task import Information, Task, random_generator

# Frames that patterns are chosen on, and scenes that they are taken from at most; held back a quarter as many.
WANTED_FRAMES, MOST_SCENES = 16_000, 800
HELD_BACK_SHARE = 0.25
MOST_ITEMS, MOST_ITEMS_HELD_BACK = 60, 100  # of a frame
LOOKS = (6, 3)  # of so many rays one looks first
ROUNDS = 2  # in which frames change their pattern
LEAST_PRICE = 0.01  # of all bandwidth, as a share of what rays know: where a single pattern has none
PRICES, NEAR = 6, 0.97  # of bandwidth that are tried, until patterns take so much of what the single one does
MISS_BEYOND_M = 0.15  # a miss counts as the median range of its ray and this much


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of training scenes: what the returns of all candidates tell about each, and their features.

    Arguments:
        informed: Of each frame.
        range_m: The ranges of all candidates, not a number for misses, float32 (U, N) [m].
        features: By the task, of the frame before, (U, F), not a number where they say nothing; None without.
    """

    informed: Sequence[SceneInformation]
    range_m: np.ndarray
    features: np.ndarray | None

    def __len__(self) -> int:
        return len(self.informed)

    def values(self, gate_m: np.ndarray) -> np.ndarray:
        """What rays with these gates, (N, 2), closed where they do not fire, know about each frame, less harm, (U,)."""
        return np.array([_value(one, gate_m) for one in self.informed])


def _value(informed: SceneInformation, gate_m: np.ndarray) -> float:
    rays, known = informed.ray, np.zeros(len(informed.weight))
    through = (gate_m[rays, 0] <= informed.range_m) & (informed.range_m < gate_m[rays, 1])
    if len(informed.sums):
        np.add.at(known, informed.item[through], informed.worth[through])
        known = np.interp(known, np.arange(len(informed.sums)), informed.sums)
    else:
        np.maximum.at(known, informed.item[through], informed.worth[through])
    spoils = (gate_m[informed.spoiling, 0] <= informed.harm_range_m) & (
        informed.harm_range_m < gate_m[informed.spoiling, 1]
    )
    return float(informed.weight @ known - informed.harm[spoils].sum())


def frames_of_scene(
    task: Task,
    rays: Rays,
    share: float,
    seed: int,
    features: Features | None,
    most_items: int,
    scene: Scene,
    number: int,
) -> Frames:
    """The frames of a scene; the first has no frame before, whose features then are not a number."""
    returns = simulate_many(scene, [rays])[0]
    information = checked_information(task, scene, returns, share)
    informed = [
        SceneInformation.of(_of_frame(information, frame), [one]).with_fewer_items(
            most_items, random_generator(seed, "items of frames", number, frame)
        )
        for frame, one in enumerate(returns)
    ]
    if features is None:
        return Frames(informed, np.array([one.range_m for one in returns], dtype=np.float32), None)
    seen = np.array([features(scene, one) for one in returns])
    before = np.concatenate([np.full_like(seen[:1], np.nan), seen[:-1]])
    return Frames(informed, np.zeros((len(informed), 0), dtype=np.float32), before)


def _of_frame(information: Information, frame: int) -> Information:
    """What the returns of a frame tell about its own items."""
    own = np.flatnonzero(information.frame == frame)
    number = np.full(len(information.frame), -1)
    number[own] = np.arange(len(own))
    kept = (information.source == frame) & (number[information.item] >= 0)
    return replace(
        information,
        ray=information.ray[kept],
        item=number[information.item[kept]],
        worth=information.worth[kept],
        frame=np.zeros(len(own), dtype=np.int64),
        weight=None if information.weight is None else information.weight[own],
        harm=None if information.harm is None else information.harm[frame][None],
        seen_in=None,
    )


@dataclass(frozen=True, eq=False)
class ChosenPatterns:
    """Patterns that were chosen, as gates of candidates, with their rule.

    Arguments:
        rule: The rule.
        look: The gates of the candidates that look first, -1 for others, (N,).
        members: Numbers of the frames that each pattern but the first was chosen on.
        gates: The gate of each candidate in each pattern, -1 where it does not fire, (K + 1, N).
        shares: How often each fires on frames that were held back, (K + 1,).
        value: What they know about these frames, as the rule fires them.
    """

    rule: PatternRule
    look: np.ndarray
    members: Sequence[np.ndarray]
    gates: np.ndarray
    shares: np.ndarray
    value: float

    def rows(self, pattern: int, sensor: np.ndarray) -> np.ndarray:
        """The candidates of a pattern in their order: those that look first, then the others, by sensor (N,)."""
        first = self.look >= 0
        rest = np.flatnonzero((self.gates[pattern] >= 0) & ~first)
        return np.concatenate([np.flatnonzero(first), rest[np.argsort(sensor[rest], kind="stable")]])


class PatternSearch:
    """The search for patterns of candidates.

    Arguments:
        selection: The candidates, with the limits that every pattern keeps.
        gates_m: A few gates of each, (N, G, 2) [m].
        fixed: The best single pattern.
        frames, held_back: Frames that patterns are chosen on, and that say which are better.
        seed: Root of the random streams.
    """

    def __init__(
        self,
        selection: Selection,
        gates_m: np.ndarray,
        fixed: Choice,
        frames: Frames,
        held_back: Frames,
        seed: int,
    ) -> None:
        self.selection, self.gates_m, self.fixed, self.seed = selection, gates_m, fixed, seed
        self.frames, self.held_back = frames, held_back
        self.count, self.price = len(fixed.rays), fixed.price

    def best(self, most: int, progress: Callable[[str], None]) -> ChosenPatterns | None:
        """The best patterns, at most `most` beside the one that fires where nothing is known.

        None where frames are too few or too much alike, or where no several patterns keep the bandwidth.
        """
        has_looks = self.frames.features is None
        counts = dict.fromkeys(max(self.count // part, 1) for part in LOOKS) if has_looks else (0,)
        none, best = np.full(len(self.gates_m), -1), None
        # the gates of the candidates that look first: the best as if they were all
        looks = [self._choose(self._whole, none, count) if count else none for count in counts]
        most = min(most, len(self.frames))
        # powers of two, and the largest
        for number in sorted({*(2**power for power in range(1, most.bit_length())), most} - {0, 1}, reverse=True):
            progress(f"choosing {number} patterns")
            # the numbers of looking rays are compared at the largest number of patterns
            found = [self._divided(look, number) for look in (looks if best is None else [best.look])]
            # of equally good ones the fewest patterns
            best = max([one for one in (*found, best) if one is not None], key=lambda one: one.value, default=None)
        if best is None:
            return None
        for _ in range(ROUNDS):
            best = max(best, self._reassigned(best), key=lambda one: one.value)
        return self._within(best)

    def gate_m(self, gate: np.ndarray) -> np.ndarray:
        """The gates of a choice, closed where rays do not fire, (N, 2) [m]."""
        return np.where(gate[:, None] >= 0, self.gates_m[np.arange(len(gate)), gate], 0.0)

    def _mbps(self, chosen: ChosenPatterns) -> float:
        gates_m = [self.gate_m(gate)[gate >= 0] for gate in chosen.gates]
        bits = [self.selection.bandwidth.mbps_of_widths(np.diff(one)) for one in gates_m]
        return float(chosen.shares @ bits)

    def _within(self, chosen: ChosenPatterns) -> ChosenPatterns | None:
        """The patterns at the least price of bandwidth at which they take no more than the best single one; or None."""
        tables = self._tables(chosen.members)
        chosen = self._of(chosen.rule, chosen.look, chosen.members, tables, passes=1)
        if np.isfinite(self.selection.limit_mbps):
            return chosen if ((chosen.gates >= 0).sum(axis=1) == self.count).all() else None
        low, high, best = 0.0, np.inf, None
        price = self.price
        self.price = price or LEAST_PRICE * self.fixed.worth / max(self.fixed.bits, TINY)
        for _ in range(PRICES):
            if self._mbps(chosen) <= self.fixed.bits * (1 + SLACK):
                best, high = chosen, self.price
            else:
                low = self.price
            if best is not None and self._mbps(best) >= NEAR * self.fixed.bits:
                break
            self.price = 2 * low if np.isinf(high) else (low + high) / 2
            chosen = self._of(chosen.rule, chosen.look, chosen.members, tables, passes=1)
        self.price = price
        return best

    @cached_property
    def _whole(self) -> Coverage:
        """Information of the candidates about all frames."""
        return self.selection.coverage(self.frames.informed, self.gates_m)

    def _tables(self, members: Sequence[np.ndarray]) -> list[Coverage]:
        """Information of the candidates about the frames of each pattern."""
        informed = self.frames.informed
        return [self.selection.coverage([informed[one] for one in own], self.gates_m) for own in members]

    def _rule(self, look: np.ndarray) -> tuple[PatternRule, np.ndarray]:
        """A rule without centroids, and the features of the frames, (U, F)."""
        if self.frames.features is not None:
            return PatternRule(np.zeros((0, self.frames.features.shape[1]))), self.frames.features
        range_m = self._seen_m(self.frames, look)
        heard = np.isfinite(range_m)
        usual = np.median(range_m[heard]) if heard.any() else 0.0
        median = np.array(
            [np.median(one[own]) if own.any() else usual for one, own in zip(range_m.T, heard.T, strict=True)]
        )
        rule = PatternRule(np.zeros((0, len(median))), len(median), median + MISS_BEYOND_M)
        return rule, rule.ranges(range_m)

    def _seen_m(self, frames: Frames, look: np.ndarray) -> np.ndarray:
        """Ranges of the first look through its gates, not a number for misses, (U, looks) [m]."""
        rays = np.flatnonzero(look >= 0)
        range_m, gate_m = frames.range_m[:, rays].astype(np.float64), self.gates_m[rays, look[rays]]
        return np.where((gate_m[:, 0] <= range_m) & (range_m < gate_m[:, 1]), range_m, np.nan)

    def _divided(self, look: np.ndarray, number: int) -> ChosenPatterns | None:
        """So many patterns, each for a cluster of features; None where there are fewer distinct features."""
        from scipy.cluster.vq import kmeans2

        rule, features = self._rule(look)
        known = features[np.isfinite(features).all(axis=1)]
        if len(np.unique(known, axis=0)) < number:
            return None
        generator = random_generator(self.seed, "patterns", number, int((look >= 0).sum()))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty cluster is left out
            centroids, labels = kmeans2(known, number, minit="++", seed=generator)
        return self._fitted(rule, look, centroids[np.unique(labels)])

    def _reassigned(self, chosen: ChosenPatterns) -> ChosenPatterns:
        """Patterns after each frame has gone to that which knows most about it."""
        rule, features = self._rule(chosen.look)
        known = np.flatnonzero(np.isfinite(features).all(axis=1))
        values = np.stack([self.frames.values(self.gate_m(gate))[known] for gate in chosen.gates[1:]])
        best = values.argmax(axis=0)
        return self._fitted(
            rule, chosen.look, np.array([features[known[best == one]].mean(axis=0) for one in np.unique(best)])
        )

    def _fitted(self, rule: PatternRule, look: np.ndarray, centroids: np.ndarray) -> ChosenPatterns:
        """Patterns of a rule with these centroids; one to which no frame is nearest is left out."""
        _, features = self._rule(look)
        rule = replace(rule, centroids=centroids)
        picked = rule.patterns_of(features)
        present = np.setdiff1d(picked, [UNKNOWN])
        members = [np.flatnonzero(picked == one) for one in present]
        return self._of(replace(rule, centroids=centroids[present - 1]), look, members, self._tables(members))

    def _of(
        self,
        rule: PatternRule,
        look: np.ndarray,
        members: Sequence[np.ndarray],
        tables: Sequence[Coverage],
        passes: int = 0,
    ) -> ChosenPatterns:
        """The patterns of a rule, each chosen on its frames, judged on frames that were held back."""
        gates = [
            self._choose(self._whole, look, passes=passes) if (look >= 0).any() else self.fixed.gate,
            *(self._choose(table, look, passes=passes) for table in tables),
        ]
        held_back = self.held_back
        features = held_back.features
        picked = rule.patterns_of(rule.ranges(self._seen_m(held_back, look)) if features is None else features)
        values = np.stack([held_back.values(self.gate_m(gate)) for gate in gates])
        value = float(values[picked, np.arange(len(picked))].mean())
        shares = np.bincount(picked, minlength=len(gates)) / len(picked)
        return ChosenPatterns(rule, look, members, np.array(gates), shares, value)

    @phase("choice")
    def _choose(self, coverage: Coverage, look: np.ndarray, count: int | None = None, passes: int = 0) -> np.ndarray:
        """The gates of the best rays for some frames with the first look kept, (N,)."""
        selection = self.selection
        counts, share = selection.counts(count or self.count), (count or self.count) / self.count
        if np.isinf(selection.limit_mbps):
            return choose(coverage, counts, price=self.price, passes=passes, kept=look).gate
        return choose_within(coverage, counts, share * selection.limit_mbps, passes=passes, kept=look).gate


@phase("what returns tell")
def training_frames(
    training: TrainingScenes, purpose: str, rays: Rays, share: float, features: Features | None
) -> Frames:
    """Frames of as many training scenes as patterns are chosen on, or of a quarter as many scenes held back."""
    frames, is_choice = training.first(purpose)[0].frames, purpose == CHOICE
    wanted = min(-(-WANTED_FRAMES // frames), MOST_SCENES) * (1.0 if is_choice else HELD_BACK_SHARE)
    items = MOST_ITEMS if is_choice else MOST_ITEMS_HELD_BACK
    work = partial(frames_of_scene, training.run.task, rays, share, training.seed, features, items)
    found = training.over(work, itertools.islice(training.scenes(purpose), round(wanted)))
    seen = [one.features for one in found if one.features is not None]
    return Frames(
        [informed for one in found for informed in one.informed],
        np.concatenate([one.range_m for one in found]),
        np.concatenate(seen) if seen else None,
    )
