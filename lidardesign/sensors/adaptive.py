"""Patterns that follow what they see: a rule picks the next of a few patterns by what was returned last.

Inside a frame the first rays of all patterns are the same, a first look, whose ranges pick the pattern for the rest.
From frame to frame the frame before is the first look. The rule is the nearest of a few centroids in a few features of
returns; where these say nothing, the first pattern fires.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidardesign.errors import DataError
from lidardesign.scenes.rays import Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.pattern import Pattern

# Features of the returns of one frame, (F,), not a number where they say nothing.
Features = Callable[[Scene, Returns], np.ndarray]
UNKNOWN = 0  # the pattern that fires where nothing is known


@dataclass(frozen=True, eq=False)
class PatternRule:
    """The rule that picks the next pattern.

    Arguments:
        centroids: Of the features for which each pattern but the first fires, (K, F).
        looks: How many rays, the first ones of every pattern, are the first look; 0: the frame before is.
        missing_m: The range that stands for a miss, of each ray of the first look, (looks,) [m].
    """

    centroids: np.ndarray
    looks: int = 0
    missing_m: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def pattern_of(self, features: np.ndarray) -> int:
        """The pattern with the nearest centroid, the first of equally near ones; 0 where a feature is not a number."""
        if not np.isfinite(features).all():
            return UNKNOWN
        return 1 + int(np.square(self.centroids - features).sum(axis=1).argmin())

    def patterns_of(self, features: np.ndarray) -> np.ndarray:
        """The patterns of many features (U, F), (U,)."""
        return np.array([self.pattern_of(one) for one in features], dtype=np.intp)

    def ranges(self, range_m: np.ndarray) -> np.ndarray:
        """The features of ranges of the first look, (..., looks) [m]; not a number where every ray misses."""
        silent = np.isnan(range_m).all(axis=-1, keepdims=True)
        return np.where(np.isnan(range_m) & ~silent, self.missing_m, range_m)


@dataclass(frozen=True, eq=False)
class AdaptivePatterns:
    """Patterns with the rule that picks among them.

    Arguments:
        rule: The rule.
        patterns: One that fires where nothing is known, and one for each centroid; equal numbers of rays.
        shares: How often each fires, on training scenes, (K + 1,).
    """

    rule: PatternRule
    patterns: tuple[Pattern, ...]
    shares: np.ndarray

    def __len__(self) -> int:
        """The number of rays per frame."""
        return len(self.patterns[0])

    def rays(self, features: Features | None = None) -> AdaptiveRays:
        """The rays of all patterns, with the features of a task where the frame before is the first look."""
        return AdaptiveRays((pattern.at() for pattern in self.patterns), self.rule, self.shares, features)


class AdaptiveRays(tuple[Rays, ...]):
    """The rays of all patterns, of which the rule fires one in each frame.

    Arguments:
        lists: The rays of each pattern.
        rule: The rule.
        shares: How often each fires, (K + 1,).
        features: Features of a frame's returns, by the task; None where the rule has a first look of its own.
    """

    rule: PatternRule
    shares: np.ndarray
    features: Features | None

    def __new__(
        cls, lists: Iterable[Rays], rule: PatternRule, shares: np.ndarray, features: Features | None = None
    ) -> AdaptiveRays:
        """The rays of all patterns."""
        made = super().__new__(cls, lists)
        made.rule, made.shares, made.features = rule, shares, features
        return made

    def __getnewargs__(self) -> tuple[Any, ...]:
        """Its parts, for workers."""
        return tuple(self), self.rule, self.shares, self.features

    def fired(self, scene: Scene, returns: Sequence[Sequence[Returns]]) -> list[int]:
        """The pattern that fires in each frame.

        Arguments:
            scene: The scene.
            returns: What each pattern returns in every frame.

        Raises:
            DataError: The task gives another number of features than the rule has.
        """
        found, features, wanted = [], None, self.rule.centroids.shape[1]
        for frame in range(len(returns[UNKNOWN])):
            if self.rule.looks:
                features = self.rule.ranges(returns[UNKNOWN][frame].range_m[: self.rule.looks])
            elif self.features is not None and found:
                features = self.features(scene, returns[found[-1]][frame - 1])
                if len(features) != wanted:
                    raise DataError(
                        f"the task gives {len(features)} features of returns, the rule of the design has {wanted}",
                        where="adaptive.centroids",
                        hint="fit the design again",
                    )
            found.append(UNKNOWN if features is None else self.rule.pattern_of(features))
        return found


def mapped(positions: tuple[Rays, ...], change: Callable[[Rays], Rays]) -> tuple[Rays, ...]:
    """Rays at condition values, or of patterns, after a change of each."""
    if isinstance(positions, AdaptiveRays):
        return AdaptiveRays(map(change, positions), positions.rule, positions.shares, positions.features)
    return tuple(map(change, positions))


def mean_mbps(positions: Sequence[Rays], bandwidth: Bandwidth) -> float:
    """The bandwidth of rays, averaged over condition values, or over patterns by how often each fires [Mbit/s]."""
    mbps = [bandwidth.mbps(rays) for rays in positions]
    if isinstance(positions, AdaptiveRays):
        return float(np.dot(positions.shares, mbps))
    return math.fsum(mbps) / len(positions)


def returns_of(positions: Sequence[Rays], scene: Scene, returns: Sequence[Sequence[Returns]]) -> list[Returns]:
    """The returns of a scene: of every condition value, or of the patterns that fire, frame by frame.

    Arguments:
        positions: Rays at condition values, or of patterns.
        scene: The scene.
        returns: Of each list of rays in every frame.
    """
    if isinstance(positions, AdaptiveRays):
        return [returns[pattern][frame] for frame, pattern in enumerate(positions.fired(scene, returns))]
    return [frame for frames in returns for frame in frames]
