"""Laws of the task contract, the task that they are tried on, and their findings.

Helpers of several laws are here too: rays that see a scene's targets, and perturbed returns.
"""

from __future__ import annotations

import contextlib
import math
import random
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from lidardesign.config import RunConfig
from lidardesign.errors import LidardesignError, PluginError
from lidardesign.plugins import AUTHOR_HINT, plugin_guard
from lidardesign.run.content import fingerprint
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Outcome, Rays, Returns
from lidardesign.scenes.scene import Body, Scene
from lidardesign.scenes.surface import sample_body
from lidardesign.scoring.scene_scores import Preparation, checked_score
from lidardesign.simulate.returns import build_casters, simulate
from lidardesign.space import AZIMUTH, ELEVATION, FARTHEST_M, RANGE, DesignSpace, aim, direction
from lidardesign.task import Metric, Score, Split, Task, conditions_of, metric_of, prepares, scenes_of

PACKAGE = Path(__file__).parents[1]
# Libraries that tasks call, and that errors are raised in when they are called wrongly.
LIBRARIES = ("numpy", "scipy", "trimesh", "pydantic", "mujoco")
LawOutcome = Literal["pass", "fail", "skip"]
# What comes before all laws, formats having no configuration: name, group and statement.
LOADS = (
    "plugin loads",
    "interface",
    "it is imported, has all members of the interface, and its configuration resolves",
)
# One call of a task's code may take so long, where nothing else is asked for.
CALL_SECONDS = 60.0
# The geometry and the scores of so many training scenes are looked at.
LOOKED_AT = 3
# Fields of scenes and bodies without effect on rays, or compared in another way.
UNSEEN = ("name", "group", "notes", "truth", "bodies", "poses", "importance")
# So often rays at targets are drawn until they are enough; of a scene that moves, so many frames are aimed at.
DRAW_ROUNDS, MOST_FRAMES = 12, 8
# Half the gate where the space fixes the range, as a share of it.
HALF_GATE = 0.05
SEED = 20_251


class BrokenLawError(PluginError):
    """A law of its contract that a plugin does not keep; the message says how, with figures (exit 6)."""


class LawHolds(NamedTuple):
    """A law that holds: its measurements in words, and as numbers by name with their unit."""

    words: str
    figures: Mapping[str, float] = {}


class NotApplicable(NamedTuple):
    """A law that does not apply to this plugin, with the reason."""

    reason: str


@dataclass(frozen=True)
class Law:
    """One law of the contract.

    Arguments:
        name: Short and unique, for tables and test names.
        group: The part of the contract that it belongs to.
        statement: The requirement on a task, in one sentence.
        check: Tries it on a task; raises BrokenLawError where it does not hold.
        needs: Names of laws that must hold for it to be tried.
        after: Names of laws to be tried before it in any case, since it checks their side effects.
    """

    name: str
    group: str
    statement: str
    check: Callable[[Any], LawHolds | NotApplicable]
    needs: tuple[str, ...] = ()
    after: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """The outcome of a law.

    Arguments:
        law: Its name.
        group: Its group.
        statement: Its statement.
        outcome: Whether it holds.
        detail: Measurements where it holds; else the reason why it does not, or was not tried.
        seconds: Time of the check [s].
        figures: Numbers by name.
    """

    law: str
    group: str
    statement: str
    outcome: LawOutcome
    detail: str
    seconds: float = 0.0
    figures: Mapping[str, float] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """The JSON form."""
        return {
            "law": self.law,
            "group": self.group,
            "statement": self.statement,
            "outcome": self.outcome,
            "detail": self.detail,
            "seconds": round(self.seconds, 3),
            "figures": {name: float(value) for name, value in self.figures.items()},
        }


def error_words(error: LidardesignError) -> str:
    """An error in words for a finding: the message, allowed values and the hint."""
    parts = [error.message]
    if error.allowed:
        parts.append(f"allowed: {error.allowed}")
    # plugins are checked by their authors
    if error.hint and AUTHOR_HINT not in error.hint:
        parts.append(f"try: {error.hint}")
    return "; ".join(parts)


def place_of(error: BaseException) -> str:
    """The place in other code than this package's that an error comes from, as " (task.py:52)"; empty if unknown.

    The innermost place outside installed libraries is taken, or the innermost one in them where there is no other.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not (frame.filename.startswith("<") or Path(frame.filename).is_relative_to(PACKAGE))
    ]
    own = [
        frame
        for frame in frames
        if not any(name in Path(frame.filename).parts for name in (*LIBRARIES, "importlib", "contextlib.py"))
    ] or frames
    return f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""


@contextlib.contextmanager
def restore_random_states(drawn: list[str], what: str) -> Iterator[None]:
    """A context that restores global random states at its end, and notes those that had changed.

    Arguments:
        drawn: The list that the notes are added to.
        what: The work inside, in words.
    """
    before = _random_states()
    try:
        yield
    finally:
        now = _random_states()
        changed = [f"{name} in {what}" for name in before if fingerprint(now[name]) != fingerprint(before[name])]
        drawn += [note for note in changed if note not in drawn]
        random.setstate(before["Python's random"])
        np.random.set_state(before["numpy's random"])  # noqa: NPY002 - it is this state that must not change
        if "torch's random" in before:
            sys.modules["torch"].set_rng_state(before["torch's random"])


def _random_states() -> dict[str, Any]:
    """The global random states by the words for them; torch's only where torch is loaded."""
    found: dict[str, Any] = {
        "Python's random": random.getstate(),
        "numpy's random": np.random.get_state(),  # noqa: NPY002
    }
    torch = sys.modules.get("torch")
    return found if torch is None else found | {"torch's random": torch.get_rng_state()}


@dataclass(eq=False)
class Tried:
    """A plugin, tried by the laws of its contract.

    Arguments:
        noun: What it is, a task or a format.
        name: Its name.
        limit_s: Time limit of one call of its code [s].
        drawn: Global random states that its code drew from or seeded, with the call.
        on_call: Called with a description before every call of its code, and with "" after it.
        seconds: Longest time of each call by its description [s].
    """

    noun: str
    name: str
    limit_s: float = CALL_SECONDS
    drawn: list[str] = field(default_factory=list)
    on_call: Callable[[str], None] = lambda what: None
    seconds: dict[str, float] = field(init=False, default_factory=dict)

    @contextlib.contextmanager
    def calling(self, what: str) -> Iterator[None]:
        """A context for a call of the plugin's code: an exception breaks the law, and the longest time is kept.

        Raises:
            BrokenLawError: It raised an exception.
        """
        self.on_call(what)
        started = time.perf_counter()
        try:
            with restore_random_states(self.drawn, what), plugin_guard(self.name, self.noun):
                yield
        except LidardesignError as error:
            told = error.message if error.message.startswith((what, "scoring")) else f"{what} failed: {error.message}"
            raise BrokenLawError(f"{told}{place_of(error)}", allowed=error.allowed) from error
        finally:
            self.seconds[what] = max(self.seconds.get(what, 0.0), time.perf_counter() - started)
            self.on_call("")


class Subject(Tried):
    """A task with a configuration, tried by the laws.

    Arguments:
        task: The plugin.
        config: Its resolved configuration.
        conduct: The limit and what else `Tried` takes.
    """

    def __init__(self, task: Task, config: RunConfig, *conduct: Any) -> None:
        super().__init__("task", task.name, *conduct)
        self.task, self.config = task, config
        self._scenes: dict[tuple[Split, int], list[Scene]] = {}
        self._rays: dict[tuple[int, int], list[Rays]] = {}

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

    @cached_property
    def looked_at(self) -> list[Scene]:
        """The first training scenes, which the laws check."""
        scenes = self.scenes("train")[:LOOKED_AT]
        self._as_made = [fingerprint(scene) for scene in scenes]
        return scenes

    def touched(self) -> list[str]:
        """The names of checked scenes that were changed since they were made."""
        return [
            scene.name for scene, made in zip(self.looked_at, self._as_made, strict=True) if fingerprint(scene) != made
        ]

    @cached_property
    def metric(self) -> Metric:
        """The meaning of scores."""
        if not hasattr(self.task, "metric_of"):
            return self.task.metric
        with self.calling("metric_of"):
            return metric_of(self.task, self.config.task)

    @cached_property
    def conditions(self) -> list[dict[str, float]]:
        """The condition values that designs are evaluated at; one empty mapping where there are no conditions."""
        if not self.config.space.conditioned:
            return [{}]
        with self.calling("conditions"):
            return conditions_of(self.task, self.config.task, self.config.space)

    @cached_property
    def casters(self) -> list[list[SceneCaster]]:
        """One caster per frame of every scene that is looked at."""
        return [build_casters(scene) for scene in self.looked_at]

    def rays(self, number: int, count: int) -> list[Rays]:
        """Up to so many rays at what can be seen of a scene's targets, for each condition value."""
        if (number, count) not in self._rays:
            scene, casters, space = self.looked_at[number], self.casters[number], self.config.space
            self._rays[number, count] = [
                rays_at_targets(scene, space.at(condition), casters, count) for condition in self.conditions
            ]
        return self._rays[number, count]

    def returns(self, number: int, lists: Sequence[Rays]) -> list[Returns]:
        """Returns of rays in a scene that is looked at: for each condition value all frames, as `score` gets them."""
        scene, casters = self.looked_at[number], self.casters[number]
        return [frame for rays in lists for frame in simulate(scene, rays, casters=casters)]

    def new_preparation(self) -> Preparation:
        """What the task prepares for rays on its training scenes, to be made anew."""
        return Preparation(self.task, self.config.seed, self.scenes("train"), None)

    @cached_property
    def preparation(self) -> Preparation:
        """What the task prepares for rays, made once."""
        return self.new_preparation()

    def score(self, scene: Scene, returns: Sequence[Returns], preparation: Preparation | None = None) -> Score:
        """The checked score of returns, by what was prepared for their rays."""
        prepared = None
        if prepares(self.task):
            with self.calling("prepare"):
                (prepared,) = (preparation or self.preparation).of(
                    [tuple(one.rays for one in returns[:: scene.frames])]
                )
        with self.calling("score"):
            return checked_score(self.task, self.metric, scene, returns, prepared)


def geometry_fingerprint(scene: Scene) -> str:
    """SHA-256 of the geometry and optical properties of a scene, without names."""
    return fingerprint([*((np.round(body.poses, 12), *_others(body)) for body in scene.bodies), *_others(scene)])


def _others(of: Body | Scene) -> list[Any]:
    return [getattr(of, field.name) for field in fields(of) if field.name not in UNSEEN]


def rays_at_targets(scene: Scene, space: DesignSpace, casters: Sequence[SceneCaster], count: int) -> Rays:
    """Rays of a design space to visible points of targets, even over their area, with gates over the whole range.

    Arguments:
        scene: The scene of the targets; of a moving one, several frames.
        space: The design space at one condition value.
        casters: One per frame.
        count: Largest number of rays; fewer where little can be seen.
    """
    generator = np.random.default_rng(SEED)
    frames = np.unique(np.linspace(0, scene.frames - 1, min(scene.frames, MOST_FRAMES)).astype(int))
    found: list[np.ndarray] = []
    for _ in range(DRAW_ROUNDS):
        found += [
            rays_that_meet(scene, space, casters[frame], frame, math.ceil(count / len(frames)), generator)
            for frame in frames.tolist()
        ]
        if sum(map(len, found)) >= count:
            break
    return full_rays(generator.permutation(np.concatenate(found))[:count], space)


def full_rays(points: np.ndarray, space: DesignSpace) -> Rays:
    """Rays of design points (N, 6) with gates over the whole range of a design space."""
    low, high = space.low[RANGE], space.high[RANGE]
    gate = (low, high) if low < high else (low * (1 - HALF_GATE), high * (1 + HALF_GATE))
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    count = len(points)
    return Rays(points[:, :3], looking, np.tile(gate, (count, 1)), np.zeros(count), np.zeros(count))


def rays_that_meet(
    scene: Scene, space: DesignSpace, caster: SceneCaster, frame: int, count: int, generator: np.random.Generator
) -> np.ndarray:
    """Rays of a design space towards targets that meet a target first, observed design points of shape (K, 6).

    Arguments:
        scene: The scene of the targets.
        space: The design space at one condition value.
        caster: Of that frame.
        frame: Its number.
        count: Number of tries.
        generator: Draws origins and places.
    """
    origins = space.sample(count, generator)[:, :3]
    points = sample_body([body for body in scene.bodies if body.is_target], space, count, generator, frame).points
    design = aim(origins, points)
    low, high = np.array(space.low), np.array(space.high)
    # a space of fewer dimensions hardly ever holds the ray to a point drawn in all three
    design = np.where(low == high, low, design)
    hits = caster.first_hit(design[:, :3], direction(design[:, AZIMUTH], design[:, ELEVATION]))
    design[:, RANGE] = np.where(np.isfinite(hits.range_m), hits.range_m, 2 * FARTHEST_M)
    kept = np.array([*(body.is_target for body in scene.bodies), False])[hits.body] & space.contains(design)
    return design[kept]


def shuffled(returns: Sequence[Returns], generator: np.random.Generator) -> list[Returns]:
    """The returns with the rays of each list in a random order of its own."""
    return [returns_of_rays(one, generator.permutation(len(one.rays))) for one in returns]


def returns_of_rays(returns: Returns, chosen: np.ndarray) -> Returns:
    """The returns of the rays at an index or mask."""
    return Returns(
        returns.rays.subset(chosen),
        returns.outcome[chosen],
        returns.range_m[chosen],
        returns.body[chosen],
        returns.frame,
    )


def without_returns(returns: Sequence[Returns]) -> list[Returns]:
    """The returns of the same rays where all miss."""
    return [
        Returns(
            one.rays,
            np.full_like(one.outcome, Outcome.MISS),
            np.full_like(one.range_m, np.nan),
            np.full_like(one.body, -1),
            one.frame,
        )
        for one in returns
    ]
