"""A task under test: its configuration and scenes, made once, with its code guarded, watched and timed."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from lidardesign.config import RunConfig
from lidardesign.errors import LidardesignError
from lidardesign.evaluate.scene_scores import checked_score
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Rays, Returns
from lidardesign.registry import plugin_guard
from lidardesign.scene import Scene
from lidardesign.simulate.simulate import build_casters, simulate
from lidardesign.task import Score, Split, Task, conditions_of, scenes_of
from lidardesign.testing.fingerprint import fingerprint
from lidardesign.testing.law import BrokenLawError, Limits, place_of
from lidardesign.testing.probing import rays_at_targets
from lidardesign.testing.watch import Watch

# The geometry and the scores of so many training scenes are looked at.
LOOKED_AT = 3


@dataclass(eq=False)
class Subject:
    """A task with a configuration, tried by the laws.

    Arguments:
        task: The plugin.
        config: Its resolved configuration.
        limits: What its code may take.
        watch: Notes what its code does to the process.
        tell_call: Told what is called before every call of its code, and "" after it.
    """

    task: Task
    config: RunConfig
    limits: Limits = field(default_factory=Limits)
    watch: Watch = field(default_factory=Watch)
    tell_call: Callable[[str], None] = lambda what: None

    def __post_init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._scenes: dict[tuple[Split, int], list[Scene]] = {}
        self._as_made: list[str] = []
        self._casters: dict[int, list[SceneCaster]] = {}
        self._rays: dict[tuple[int, int], list[Rays]] = {}

    @contextlib.contextmanager
    def calling(self, what: str) -> Iterator[None]:
        """Run the task's code: what it raises breaks the law that is tried, and the longest time is kept.

        Raises:
            BrokenLawError: Whatever it raised.
        """
        self.tell_call(what)
        started = time.perf_counter()
        try:
            with self.watch.during(what), plugin_guard(self.task.name):
                yield
        except LidardesignError as error:
            told = error.message if error.message.startswith((what, "scoring")) else f"{what} failed: {error.message}"
            raise BrokenLawError(f"{told}{place_of(error)}", allowed=error.allowed) from error
        finally:
            self.seconds[what] = max(self.seconds.get(what, 0.0), time.perf_counter() - started)
            self.tell_call("")

    def new_scenes(self, split: Split, seed: int) -> list[Scene]:
        """The scenes of a split, made anew."""
        with self.calling("scenes"):
            return list(scenes_of(self.task, self.config.task, split, seed, self.config.space))

    def scenes(self, split: Split, seed: int | None = None) -> list[Scene]:
        """The scenes of a split, made once."""
        key = (split, self.config.seed if seed is None else seed)
        if key not in self._scenes:
            self._scenes[key] = self.new_scenes(*key)
        return self._scenes[key]

    @property
    def looked_at(self) -> list[Scene]:
        """The first training scenes."""
        scenes = self.scenes("train")[:LOOKED_AT]
        if not self._as_made:
            self._as_made = [fingerprint(scene) for scene in scenes]
        return scenes

    def touched(self) -> list[str]:
        """The names of scenes that are looked at and are not as they were made."""
        return [
            scene.name for scene, made in zip(self.looked_at, self._as_made, strict=True) if fingerprint(scene) != made
        ]

    @cached_property
    def conditions(self) -> list[dict[str, float]]:
        """The condition values that designs are evaluated at; one empty mapping where there are no conditions."""
        if not self.config.space.conditioned:
            return [{}]
        with self.calling("conditions"):
            return conditions_of(self.task, self.config.task, self.config.space)

    def casters(self, number: int) -> list[SceneCaster]:
        """One caster per frame of a scene that is looked at, by its number."""
        if number not in self._casters:
            self._casters[number] = build_casters(self.looked_at[number])
        return self._casters[number]

    def rays(self, number: int, count: int) -> list[Rays]:
        """Up to so many rays at what can be seen of a scene's targets, for each condition value."""
        if (number, count) not in self._rays:
            scene, casters, space = self.looked_at[number], self.casters(number), self.config.space
            self._rays[number, count] = [
                rays_at_targets(scene, space.at(condition), casters, count) for condition in self.conditions
            ]
        return self._rays[number, count]

    def returns(self, number: int, lists: Sequence[Rays]) -> list[Returns]:
        """What rays give in a scene that is looked at: for each condition value all frames, as `score` gets them."""
        scene, casters = self.looked_at[number], self.casters(number)
        return [frame for rays in lists for frame in simulate(scene, rays, casters=casters)]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """The checked score of returns."""
        with self.calling("score"):
            return checked_score(self.task, scene, returns)
