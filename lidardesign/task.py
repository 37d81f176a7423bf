"""The task plugin contract: scenes of a task, and scores of returns.

A plugin is a class with the members of `Task`, registered under the entry-point group
`lidardesign.tasks`. It is instantiated without arguments.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lidardesign.errors import ConfigError, DataError, PluginError
from lidardesign.plugins import AUTHOR_HINT, PluginKind, check_members
from lidardesign.run.files import sha256_file
from lidardesign.scenes.rays import Returns
from lidardesign.scenes.scene import Scene
from lidardesign.space import DIMENSIONS, FARTHEST_M, DesignSpace

API_VERSION = 1
Split = Literal["train", "test"]


# Lengths in configurations: larger ones are wrong units.
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
Vector = tuple[Metres, Metres, Metres]
Interval = tuple[Metres, Metres]


class TaskConfig(BaseModel):
    """Base of a task's configuration: unknown keys are errors, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class FolderConfig(TaskConfig):
    """Base of the configuration of a task that reads all files of a folder; a run records the files that it had.

    `folders` has the keys of folders, each with the suffixes, in lower case, of the files that are read there.
    """

    folders: ClassVar[Mapping[str, Sequence[str]]]

    inputs: dict[str, str] = Field({}, description="set by learn: SHA-256 of each file that was there, by its path")

    def reads(self, path: Path) -> bool:
        """True if a file is one of those that are read in the folders."""
        keys = [key for key, endings in self.folders.items() if path.suffix.lower() in endings]
        return not path.name.startswith(".") and any(path.parent == getattr(self, key) for key in keys)

    def held_out(self, files: Sequence[Path]) -> Sequence[Path]:
        """Those files, given by name, that only held-out scenes show; a task that splits files says which."""
        return ()

    def twin_notes(self) -> list[str]:
        """A note that names held-out files that are equal to files that are learned from; empty without any."""
        learned, held = self.sides()
        twins = [f"{held[digest]} and {learned[digest]}" for digest in held if digest in learned]
        return [f"equal files are held out and learned from, so scores flatter: {'; '.join(twins)}"] if twins else []

    def sides(self) -> tuple[dict[str, str], dict[str, str]]:
        """Names of the files that are learned from, and of those that are held out, by their SHA-256.

        The recorded files, and those that are in folders, or are named instead of one, of which none is recorded.
        """
        files = {Path(path): digest for path, digest in sorted(self.inputs.items()) if self.reads(Path(path))}
        for place in {getattr(self, key) for key in self.folders} - {None, *(path.parent for path in files)}:
            present = filter(self.reads, sorted(Path(place).iterdir())) if Path(place).is_dir() else [Path(place)]
            present = [path for path in present if path.is_file()]
            files |= {path: _digest(path, path.stat().st_mtime_ns, path.stat().st_size) for path in present}
        held_out = self.held_out(list(files))
        learned = {digest: path.name for path, digest in files.items() if path not in held_out}
        return learned, {files[path]: path.name for path in held_out}

    def learned_files(self, files: Sequence[Path]) -> dict[str, Path | None]:
        """Files of a folder by the names that they had when the run was learned, in that order; None for missing ones.

        Splits and random streams follow these names, so that an added file moves no other to another split: it is left
        out. A renamed file is recognised by its content, a changed one by its name. Before learning, all files are
        included.

        Arguments:
            files: The present files of one of the folders.

        Raises:
            DataError: None of the files that the run was learned from is left.
        """
        folder = files[0].parent
        recorded = {Path(path): digest for path, digest in self.inputs.items()}
        before = {path: recorded[path] for path in sorted(recorded) if path.parent == folder and self.reads(path)}
        if not before:
            return {path.name: path for path in files}
        now = {path: _digest(path, path.stat().st_mtime_ns, path.stat().st_size) for path in files if path.is_file()}
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


def moved_files(first: BaseModel, second: BaseModel) -> list[str]:
    """Names of files that are held out with one configuration of a task and learned from with the other.

    Where no file is held out, scenes of both kinds show all of them.
    """
    if not (isinstance(first, FolderConfig) and isinstance(second, FolderConfig)):
        return []
    (learned, held), (learned_now, held_now) = first.sides(), second.sides()
    moved = (learned.keys() & (held_now or learned_now).keys() - (held or learned).keys()) | (
        held.keys() & learned_now.keys() - learned.keys()
    )
    return sorted((learned | held)[digest] for digest in moved)


@lru_cache(maxsize=4096)
def _digest(path: Path, changed_ns: int, size: int) -> str:
    """SHA-256 of a file; the same file unchanged is read once per process."""
    return sha256_file(path)


@dataclass(frozen=True)
class Metric:
    """Name, unit and limits of a task's score.

    Arguments:
        name: Name in tables, as "Chamfer distance".
        unit: Unit, as "mm".
        better: Whether lower or higher values are better.
        worst: Value of a scene in which a design fails.
        tolerance: Differences below this do not matter to the task.
        best: The best value that a scene can have; None: 0 where lower is better, unknown where higher is.
    """

    name: str
    unit: str
    better: Literal["lower", "higher"]
    worst: float
    tolerance: float
    best: float | None = None

    @property
    def sign(self) -> float:
        """1 where lower is better, else -1: what scores are multiplied with to be lower where they are better."""
        return 1.0 if self.better == "lower" else -1.0

    @property
    def limits(self) -> tuple[float, float]:
        """The least and the largest value, infinite where the best one is unknown."""
        if self.better == "higher":
            return self.worst, math.inf if self.best is None else self.best
        return (0.0 if self.worst > 0 else -math.inf) if self.best is None else self.best, self.worst


@dataclass(frozen=True)
class Score:
    """The score of one design in one scene.

    Arguments:
        value: Score in the metric's unit; the metric's worst value where `failed`.
        failed: Whether the returns were too few to compute the metric.
        details: Further figures by name (with their unit), for the report.
    """

    value: float
    failed: bool = False
    details: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Information:
    """Information of returns about items of a scene (points of a surface, frames, bodies), as pairs of ray and item.

    Tasks provide it for choosing rays. The value of a choice is the weighted mean, over items, of the largest worth of
    its returns, or of the function `sums` of the sum of their worths.

    Arguments:
        ray: Index of each pair's ray, int (E,).
        item: Index of each pair's item, int (E,); without `seen_in` every pair is unique.
        worth: Information of the return about the item, 0 or more, (E,).
        frame: Index of the `Returns` that shows each item, int (U,).
        weight: Weights of items, 0 or more, (U,); None: equal weights.
        harm: Loss by each return, as by one of an occluder that is taken for a target, in the unit of worth,
            (frames, N); None: none.
        sums: None, or the value at sums of worths 0, 1, 2, ..., linear in between: 0 at first, increasing and concave.
        complete: Value of an item about which everything is known; the loss of a choice is the difference from it.
        unit: Unit of `worth` and `complete`, as `m`; `1` for shares.
        seen_in: Index of the `Returns` that each pair is from, int (E,), where returns of one frame inform about
            another, as about the continuation of a path; a pair then occurs once per frame, and its largest worth
            counts. None: those that show the item.
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
        """Index of the `Returns` that each pair is from, int (E,)."""
        return self.frame[self.item] if self.seen_in is None else self.seen_in


@dataclass(frozen=True)
class Defaults:
    """A task's default settings.

    Arguments:
        rays: Ray budgets per frame to evaluate at; where the density has conditions, per condition value.
        level: Share of each marginal inside fields of view and gates.
        density: Overrides of the `density` configuration section (for example {"sigma_m": 0.005}).
        learning: Overrides of the `learning` section, by preset name.
    """

    rays: tuple[int, ...] = (36, 100, 196, 361, 576)
    level: float = 0.95
    density: Mapping[str, Any] = field(default_factory=dict)
    learning: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@runtime_checkable
class Task(Protocol):
    """Interface of a task plugin; see the module docstring.

    `scenes` is deterministic in (config, split, seed), and the splits are disjoint, also those of two seeds: more
    training scenes are drawn with other seeds. `score` may use
    `scene.truth` only for scoring; the estimate is built from the returns alone.

    A task whose space has conditions may also give `conditions(config)`, the condition values that designs are
    evaluated at, as [{"x_m": 0.0}, {"x_m": 1.2}]. `score` then gets one `Returns` per condition value (and, within
    each, per time frame), in this order.

    A task may name `weighing_keys`, keys of its configuration that only weight parts of the density: designs
    of runs that differ only in them are scored side by side.

    A task may also give `informs(scene, returns) -> Information`, the information of returns for choosing rays;
    `returns` are as in `score`, of all candidate rays through open gates. Rays of a task without it are not chosen.
    Where it takes a keyword `share`, it gets the share of the candidates that will be chosen, roughly.

    A task may also give `features(scene, returns) -> array`, a few numbers of one frame's returns, always as many, by
    which the pattern of the next frame is picked, as the place of what is tracked; not a number where nothing is known.
    Without it, ranges of a first look inside the frame pick the pattern.

    A task may also give `metric_of(config) -> Metric`, where the worst value or the tolerance depend on its
    configuration; `metric` then has the usual ones. Name, unit and direction are those of `metric`, or of one of
    `metrics`, further ones that a key of the configuration selects.

    A task may also give `mount_of(config) -> str | None`, the body of a robot that carries the sensors, in whose frame
    its scenes are; designs keep it.

    A task may also give `prepare(scenes, returns, seed)`, which learns a reconstruction for a set of rays from what
    they return in each training scene. What it makes is picklable, and given to `score(scene, returns, prepared)`.

    A task may also give `notes(config, space) -> Sequence[str]`, notes to the user on a configuration before learning:
    lengths that look like another unit, splits that share their objects.

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
        """The score of a design's returns in a scene, one `Returns` per time frame of the scene."""
        ...


def check_interface(name: str, task: Any) -> dict[str, Any]:
    """Check that an object fulfils the task contract; returns its summary, for lists.

    Raises:
        PluginError: The first member that is missing or of the wrong type.
    """
    check_members("task", name, task, API_VERSION, name=str, summary=str, metric=Metric, defaults=Defaults)
    if not (isinstance(getattr(task, "Config", None), type) and issubclass(task.Config, TaskConfig)):
        raise PluginError("its Config is not a subclass of TaskConfig", where=f"task {name}", hint=AUTHOR_HINT)
    check_members("task", name, task, API_VERSION, space=object, scenes=object, score=object)
    return {"summary": task.summary}


TASKS: PluginKind[Task] = PluginKind("lidardesign.tasks", "task", check_interface)


def load_task(name: str) -> Task:
    """Load the installed task of a name; errors as of `PluginKind.load`."""
    return TASKS.load(name)


def prepares(task: Task) -> bool:
    """True where a task has a method `prepare`."""
    return callable(getattr(task, "prepare", None))


def random_generator(seed: int, *labels: str | int) -> np.random.Generator:
    """An independent generator for each purpose, so that adding draws to one never changes another."""
    return np.random.default_rng(
        np.random.SeedSequence([seed, *[int.from_bytes(str(label).encode(), "little") % (2**63) for label in labels]])
    )


def scenes_of(task: Task, config: Any, split: Split, seed: int, space: DesignSpace) -> Sequence[Scene]:
    """The scenes of a split, with ground truth for a run's own design space.

    A task whose `scenes` takes a keyword `space` gets it; its truth then follows a space set in the run's
    configuration. Other tasks use the space of their configuration.

    Raises:
        PluginError: The task returned something else.
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
    """Metric of a task with a configuration: of its `metric_of`, or else its `metric`.

    Raises:
        PluginError: The task returned something else, or another quantity than its `metric` and `metrics`.
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
    """Name of the robot's body that carries a task's sensors; None: sensors in the world, as without `mount_of`.

    Raises:
        PluginError: The task returned no name.
    """
    found = task.mount_of(config) if hasattr(task, "mount_of") else None
    if not isinstance(found, str | None) or found == "":
        raise PluginError(f"it returned {found!r}", where=f"task {task.name}, mount_of", allowed="a name or None")
    return found


def _quantity(metric: Metric) -> str:
    return f"{metric.name} [{metric.unit}], {metric.better} is better"


def notes_of(task: Task, config: Any, space: DesignSpace) -> list[str]:
    """Notes of a task on its configuration in a design space, one line each, and those on equal files.

    Raises:
        PluginError: The task returned something else.
    """
    found = task.notes(config, space) if hasattr(task, "notes") else []
    if isinstance(found, str) or not all(isinstance(line, str) for line in found):
        raise PluginError(f"notes gave {found!r}", where=f"task {task.name}", allowed="a list of lines of text")
    return [*found, *(config.twin_notes() if isinstance(config, FolderConfig) else ())]


def scoring_settings(task: Task, config: Any) -> dict[str, Any]:
    """Settings of a task that decide its scenes and scores: all but its `weighing_keys`."""
    return config.model_dump(mode="json", exclude=set(getattr(task, "weighing_keys", ())))


# Number of even condition values where a task gives none.
EVEN_CONDITIONS = 9


def conditions_of(task: Task, config: Any, space: DesignSpace) -> list[dict[str, float]]:
    """Condition values that designs are evaluated at; one empty mapping where the density has no conditions.

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
