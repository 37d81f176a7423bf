"""The task plugin contract: scenes of a task, and what a set of returns is worth there.

A plugin is a class with the members of `Task`, registered under the entry-point group
`lidardesign.tasks`. It is instantiated without arguments.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lidardesign.errors import ConfigError, DataError, PluginError
from lidardesign.run.files import sha256_file
from lidardesign.scenes.rays import Returns
from lidardesign.scenes.scene import Scene
from lidardesign.space import DIMENSIONS, FARTHEST_M, DesignSpace

API_VERSION = 1
Split = Literal["train", "test"]


# Numbers of configurations: beyond these they are slips of units.
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
Vector = tuple[Metres, Metres, Metres]
Interval = tuple[Metres, Metres]


class TaskConfig(BaseModel):
    """The base of a task's configuration: unknown keys are errors, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class FolderConfig(TaskConfig):
    """The base of the configuration of a task that reads all files of a folder: a run keeps which there were.

    `folders` has the keys that name folders, each with the endings, in small letters, of the files that are read there.
    """

    folders: ClassVar[Mapping[str, Sequence[str]]]

    inputs: dict[str, str] = Field({}, description="set by learn: SHA-256 of each file that was there, by its path")

    def reads(self, path: Path) -> bool:
        """Whether a file is one of those that are read in the folders."""
        keys = [key for key, endings in self.folders.items() if path.suffix.lower() in endings]
        return not path.name.startswith(".") and any(path.parent == getattr(self, key) for key in keys)

    def learned_files(self, files: Sequence[Path]) -> dict[str, Path | None]:
        """Files of a folder by the names that they had when the run was learned, in that order; None for those gone.

        Splits and random streams follow these names, so that a file that came since moves no other to another split:
        it is left out. A file is known by its content wherever it is called otherwise now, and by its name where it
        was changed. All files are known as long as nothing was learned.

        Arguments:
            files: Those of one of the folders now.

        Raises:
            DataError: Nothing is left of what was learned from.
        """
        folder = files[0].parent
        recorded = {Path(path): digest for path, digest in self.inputs.items()}
        before = {path: recorded[path] for path in sorted(recorded) if path.parent == folder and self.reads(path)}
        if not before:
            return {path.name: path for path in files}
        now = {path: _digest(path, path.stat().st_mtime_ns, path.stat().st_size) for path in files}
        by_content = {digest: path for path, digest in reversed(now.items())}
        found = {
            path.name: path
            if now.get(path) == digest
            else by_content.get(digest, path if path in now and now[path] not in before.values() else None)
            for path, digest in before.items()
        }
        if not any(found.values()):
            hint = "put them back, or learn again"
            raise DataError("holds none of the files that the run was learned from", where=str(folder), hint=hint)
        return found


@lru_cache(maxsize=4096)
def _digest(path: Path, changed_ns: int, size: int) -> str:
    """SHA-256 of a file; the same file unchanged is read once per process."""
    return sha256_file(path)


@dataclass(frozen=True)
class Metric:
    """What a task's score means.

    Arguments:
        name: For tables, as "Chamfer distance".
        unit: As "mm".
        better: Whether lower or higher values are better.
        worst: The value of a scene in which a design fails.
        tolerance: Differences below this one do not matter to the task.
    """

    name: str
    unit: str
    better: Literal["lower", "higher"]
    worst: float
    tolerance: float


@dataclass(frozen=True)
class Score:
    """The score of one design in one scene.

    Arguments:
        value: In the metric's unit; the metric's worst value where `failed`.
        failed: Whether the returns were too few to compute the metric.
        details: Further figures by name (with their unit), for the report.
    """

    value: float
    failed: bool = False
    details: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Information:
    """What returns tell about a scene: pairs of a ray and an item, as a point of the surface, a frame or a body.

    A task states it for choosing rays: what is chosen is worth the weighted mean, over items, of the largest worth of
    its returns, or of what the sum of their worths counts.

    Arguments:
        ray: The ray of each pair, int (E,).
        item: The item of each pair, int (E,); without `seen_in` no pair comes twice.
        worth: How much the return tells about the item, 0 or more, (E,).
        frame: Which of the `Returns` shows each item, int (U,).
        weight: What items count, 0 or more, (U,); None: all alike.
        harm: What each return spoils, as one of an occluder that is taken for a target, in the unit of worth,
            (frames, N); None: nothing.
        sums: None, or what sums of worths 0, 1, 2, ... count, linear in between: 0 at first, rising ever less.
        complete: What an item counts of which nothing is left to know; the loss of a choice is what lacks of it.
        unit: Of `worth` and `complete`, as `m`; `1` for shares.
        seen_in: Which of the `Returns` each pair is from, int (E,), where returns of one frame tell about another, as
            about where a path goes on; a pair then comes once per frame, and its largest worth counts. None: those that
            show the item.
    """

    ray: np.ndarray
    item: np.ndarray
    worth: np.ndarray
    frame: np.ndarray
    weight: np.ndarray | None = None
    harm: np.ndarray | None = None
    sums: Sequence[float] | np.ndarray | None = None
    complete: float = 1.0
    unit: str = "1"
    seen_in: np.ndarray | None = None

    @property
    def source(self) -> np.ndarray:
        """Which of the `Returns` each pair is from, int (E,)."""
        return self.frame[self.item] if self.seen_in is None else self.seen_in


@dataclass(frozen=True)
class Defaults:
    """What a task suggests where the user says nothing.

    Arguments:
        rays: Ray budgets per frame to evaluate at; where the density has conditions, per condition value.
        level: The share of each marginal that fields of view and gates hold.
        density: Overrides of the `density` configuration section (for example {"sigma_m": 0.005}).
        learning: Overrides of the `learning` section, by preset name.
    """

    rays: tuple[int, ...] = (36, 100, 196, 361, 576)
    level: float = 0.95
    density: Mapping[str, Any] = field(default_factory=dict)
    learning: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@runtime_checkable
class Task(Protocol):
    """What a task plugin provides; see the module docstring.

    `scenes` is deterministic in (config, split, seed), and the splits are disjoint, also those of two seeds: more
    training scenes are drawn with other seeds. `score` may use
    `scene.truth` only for scoring; the estimate is built from the returns alone.

    A task whose space has conditions may also give `conditions(config)`, the condition values that designs are
    evaluated at, as [{"x_m": 0.0}, {"x_m": 1.2}]. `score` then gets one `Returns` per condition value (and, within
    each, per time frame), in this order.

    A task may name `weighing_keys`, keys of its configuration that only say what counts more in the density: designs
    of runs that differ only in them are scored side by side.

    A task may also give `informs(scene, returns) -> Information`, what returns tell about a scene, for choosing rays;
    `returns` are as in `score`, of all candidate rays through open gates. Rays of a task without it are not chosen.

    A task may also give `metric_of(config) -> Metric`, where the worst value or the tolerance follow from its
    configuration; `metric` then has those that are usual. Name, unit and direction are those of `metric`, or of one of
    `metrics`, further ones that a key of the configuration chooses.

    A task may also give `mount_of(config) -> str | None`, the body of a robot that sensors are on, in whose frame its
    scenes are; designs keep it.

    A task may also give `notes(config, space) -> Sequence[str]`, what a user should know of a configuration before
    anything is learned of it: lengths that look like another unit, splits that share their objects.

    Example:
        >>> task = run.task
        >>> task.name, task.metric.unit, task.metric.better
        ('flatland', 'mm', 'lower')
        >>> len(task.scenes(task.Config(test=4), "test", seed=0))
        4
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    api_version: ClassVar[int]
    Config: ClassVar[type[TaskConfig]]
    metric: ClassVar[Metric]
    defaults: ClassVar[Defaults]

    def space(self, config: Any) -> DesignSpace:
        """The design space of a configuration."""
        ...

    def scenes(self, config: Any, split: Split, seed: int) -> Sequence[Scene]:
        """The scenes of a split."""
        ...

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """The score of one design's returns in a scene, one `Returns` per time frame of the scene."""
        ...


def random_generator(seed: int, *labels: str | int) -> np.random.Generator:
    """An independent generator per purpose, so that adding a draw to one never changes another."""
    return np.random.default_rng(
        np.random.SeedSequence([seed, *[int.from_bytes(str(label).encode(), "little") % (2**63) for label in labels]])
    )


def scenes_of(task: Task, config: Any, split: Split, seed: int, space: DesignSpace) -> Sequence[Scene]:
    """The scenes of a split, judged by what a run's own design space can see.

    A task whose `scenes` takes a keyword `space` gets it; its truth then follows a space set in the run's
    configuration. Other tasks judge by the space of their configuration.

    Raises:
        PluginError: The task gave something else.
    """
    takes_space = "space" in inspect.signature(task.scenes).parameters
    scenes = list(task.scenes(config, split, seed, **({"space": space} if takes_space else {})))
    for scene in scenes:
        if not isinstance(scene, Scene):
            raise PluginError(
                f"scenes() returned a {type(scene).__name__}",
                where=f"task {task.name}",
                allowed="lidardesign.scenes.scene.Scene",
            )
    return scenes


def metric_of(task: Task, config: Any) -> Metric:
    """What a task's scores mean with a configuration; that of every configuration where it has no `metric_of`.

    Raises:
        PluginError: The task gave something else, or another quantity than its `metric` and `metrics`.
    """
    if not hasattr(task, "metric_of"):
        return task.metric
    found = task.metric_of(config)
    where = f"task {task.name}, metric_of"
    if not isinstance(found, Metric):
        raise PluginError(f"it returned {type(found).__name__}", where=where, allowed="lidardesign.task.Metric")
    usual = [_quantity(metric) for metric in (task.metric, *getattr(task, "metrics", ()))]
    if _quantity(found) not in usual:
        raise PluginError(
            f"it returned {_quantity(found)}", where=where, allowed=f"{' or '.join(usual)}, as in its metric"
        )
    return found


def mount_of(task: Task, config: Any) -> str | None:
    """The body of a robot that a task's sensors are on; None: in the world, as where it has no `mount_of`.

    Raises:
        PluginError: The task gave no name.
    """
    found = task.mount_of(config) if hasattr(task, "mount_of") else None
    if not isinstance(found, str | None) or found == "":
        raise PluginError(f"it returned {found!r}", where=f"task {task.name}, mount_of", allowed="a name or None")
    return found


def _quantity(metric: Metric) -> str:
    return f"{metric.name} [{metric.unit}], {metric.better} is better"


def notes_of(task: Task, config: Any, space: DesignSpace) -> list[str]:
    """What a task says of its configuration in a design space, one line each; nothing where it has no `notes`.

    Raises:
        PluginError: The task gave something else.
    """
    if not hasattr(task, "notes"):
        return []
    found = task.notes(config, space)
    if isinstance(found, str) or not all(isinstance(line, str) for line in found):
        raise PluginError(f"notes gave {found!r}", where=f"task {task.name}", allowed="a list of lines of text")
    return list(found)


def scoring_settings(task: Task, config: Any) -> dict[str, Any]:
    """The settings of a task that decide its scenes and scores: all but its `weighing_keys`."""
    return config.model_dump(mode="json", exclude=set(getattr(task, "weighing_keys", ())))


# Conditions that a task does not name are evaluated at so many even places.
EVEN_CONDITIONS = 9


def conditions_of(task: Task, config: Any, space: DesignSpace) -> list[dict[str, float]]:
    """The condition values that designs are evaluated at; one empty mapping where the density has no conditions.

    Raises:
        ConfigError: The task names a value outside the design space.
        PluginError: The task names no value, or leaves one of the conditions open.
    """
    if not space.conditioned:
        return [{}]
    if hasattr(task, "conditions"):
        named = [{name: float(value) for name, value in one.items()} for one in task.conditions(config)]
        where = f"task {task.name}, conditions"
        if not named:
            raise PluginError("no condition value is given", where=where, allowed="1 or more")
        for one in named:
            try:
                space.at(one)
            except ConfigError as error:
                raise ConfigError(error.message, where=where, allowed=error.allowed) from None
            missing = [DIMENSIONS[i] for i in space.conditioned if DIMENSIONS[i] not in one]
            if missing:
                raise PluginError(
                    f"{dict(one)} leaves {missing[0]} open", where=where, allowed="every condition has one"
                )
        return named
    shares = (np.arange(EVEN_CONDITIONS) + 0.5) / EVEN_CONDITIONS
    low, high = np.array(space.low), np.array(space.high)
    return [{DIMENSIONS[i]: float(low[i] + share * (high - low)[i]) for i in space.conditioned} for share in shares]
