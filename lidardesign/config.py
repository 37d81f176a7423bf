"""The configuration of a run: defaults, preset, file and `--set`, in that order, checked with positions.

The document has the sections task, space, density and learning. The origin of every value is kept, so that an error
can point at file, line and column, or at the option `--set KEY=VALUE`.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from lidardesign.errors import ConfigError
from lidardesign.limits import MAX_SEED
from lidardesign.numerics import COARSE_SLACK
from lidardesign.plugins import UnknownPluginError, plugin_guard
from lidardesign.run.clock import phase
from lidardesign.run.manifest import read_manifest, verify, write_recorded
from lidardesign.run.validation import Override, apply_override, check_model, is_name, keep_texts, parse_overrides
from lidardesign.run.yaml import Document, KeyPath, dump_yaml, leaves, load_yaml, merged
from lidardesign.space import DIMENSIONS, FARTHEST_M, SHORTEST_M, DesignSpace
from lidardesign.task import Task, TaskConfig, load_task, moved_files

Visibility = Literal["auto", "raycast", "quadrature", "off"]
Preset = Literal["draft", "standard", "fine"]
PRESETS: tuple[str, ...] = ("draft", "standard", "fine")
FASTEST_PER_M = 1e12


class DensitySettings(BaseModel):
    """The target density p*(d) (design contract, section 2). `None` means: derived from the others."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sigma_m: float = Field(
        0.005, ge=SHORTEST_M, le=FARTHEST_M, description="standard deviation of the surface proximity [m]"
    )
    visibility: Visibility = Field("auto", description="how occlusion is computed; auto probes whether it is needed")
    attenuation_per_m: float | None = Field(
        None, gt=0, le=FASTEST_PER_M, description="beta [1/m]; default max(1000, 5 / sigma)"
    )
    sharpness_per_m: float | None = Field(
        None, gt=0, le=FASTEST_PER_M, description="k [1/m] of the quadrature; default max(1000, 5 / sigma)"
    )
    margin_m: float | None = Field(
        None, ge=0, le=FARTHEST_M, description="m [m]: a surface does not occlude itself; default sigma"
    )
    quadrature_points: int = Field(64, ge=4, le=4096, description="midpoints of the visibility quadrature")
    field_resolution: int = Field(64, ge=8, le=512, description="grid points along the longest side of mesh fields")
    surface_tolerance_nats: float = Field(
        16.0,
        gt=0,
        le=1e6,
        description="scenes whose surface term is this far below the best one skip visibility [nats]",
    )


class LearningSettings(BaseModel):
    """The flow, its optimiser and the measurements after training.

    Upper limits are what a large computer might handle; larger numbers are typing errors.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    misplaced: float = Field(
        0.15, ge=0, le=1, description="share of the density's mass in the wrong place at which learning stops"
    )
    steps: int = Field(300, ge=1, le=100_000_000, description="the most optimiser steps")
    pathwise: int = Field(
        50, ge=0, le=100_000_000, description="the first steps, which move samples up log p* while sigma falls"
    )
    batch: int = Field(1024, ge=2, le=1_000_000, description="design points per step")
    rate: float = Field(1e-2, ge=COARSE_SLACK, le=1, description="initial Adam step size")
    frames: int = Field(
        256, ge=1, le=1_000_000, description="scenes and frames that stand for all in each path-wise step, drawn anew"
    )
    layers: int = Field(2, ge=1, le=32, description="splines one after the other in each dimension of the flow")
    hidden: int = Field(96, ge=4, le=8_192, description="hidden width of each dimension's network")
    bins: int = Field(16, ge=2, le=1_024, description="spline bins per dimension")
    dtype: Literal["float64", "float32"] = Field(
        "float32",
        description="precision of training steps, as long as it can invert the flow; samples are always float64",
    )
    entropy: float = Field(0.0, ge=0, le=1e3, description="weight of the entropy, eta of the paper; annealed to 0")
    sigma_start_m: float | None = Field(
        None, ge=SHORTEST_M, le=FARTHEST_M, description="where sigma's annealing starts; default 6 sigma"
    )
    balance_proposals: int = Field(
        32768, ge=256, le=10_000_000, description="independent proposals that balancing draws from"
    )
    clip_norm: float = Field(5.0, ge=COARSE_SLACK, le=1e6, description="gradient norm that steps are clipped to")
    checkpoint_seconds: float = Field(20.0, gt=0, le=86_400, description="time between checkpoints [s]")
    samples: int = Field(
        100_000, ge=1000, le=10_000_000, description="samples of the flow, which are thinned for fit and constrain"
    )
    coverage_proposals: int = Field(
        8192, ge=256, le=10_000_000, description="independent proposals that coverage is measured on"
    )

    @property
    def pathwise_steps(self) -> int:
        """Steps before balancing begins; half of all, where these are few."""
        return min(self.pathwise, self.steps // 2)


PRESET_LEARNING: dict[str, dict[str, Any]] = {
    "draft": {"misplaced": 0.25, "steps": 200, "batch": 512, "samples": 40_000},
    "standard": {},
    "fine": {"misplaced": 0.05, "steps": 2000, "layers": 3, "hidden": 128, "bins": 24, "samples": 200_000},
}


FILE_NAME = "config.yaml"
SCHEMA_VERSION = 1
SECTIONS = ("task", "space", "density", "learning")
HEADER = ("schema_version", "task_name", "seed", "preset")
# Keys in runs of earlier versions that are ignored.
RETIRED = ("anneal", "balance")


@dataclass(frozen=True)
class RunConfig:
    """The whole configuration of a run.

    Arguments:
        task_name: Name of the task plugin.
        seed: Seed of all random numbers.
        preset: draft, standard or fine.
        task: The task's own configuration.
        space: The design space, with the task's bounds or the user's.
        density: The target density.
        learning: The flow and its optimiser.
    """

    task_name: str
    seed: int
    preset: str
    task: TaskConfig
    space: DesignSpace
    density: DensitySettings
    learning: LearningSettings

    def as_document(self) -> dict[str, Any]:
        """Content of config.yaml."""
        return {
            "schema_version": SCHEMA_VERSION,
            "task_name": self.task_name,
            "seed": self.seed,
            "preset": self.preset,
            "task": self.task.model_dump(mode="json"),
            "space": self.space.as_dict(),
            "density": self.density.model_dump(mode="json"),
            "learning": self.learning.model_dump(mode="json"),
        }


def _pair(value: Any) -> Any:
    return (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


_Bounds = Annotated[tuple[float, float], BeforeValidator(_pair)]


class _SpaceSection(BaseModel):
    """Bounds that replace the task's: a pair [low, high], or one number that fixes the dimension."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    x_m: _Bounds
    y_m: _Bounds
    z_m: _Bounds
    azimuth_rad: _Bounds
    elevation_rad: _Bounds
    range_m: _Bounds
    condition: tuple[Literal[DIMENSIONS], ...] = Field(())
    measure: Literal["solid_angle", "angles"] = Field("solid_angle")


@dataclass
class _Layers:
    """The merged document and the origin of each of its values."""

    values: dict[str, Any]
    origins: dict[KeyPath, str] = field(default_factory=dict)
    keys: dict[KeyPath, str] = field(default_factory=dict)

    def merge(self, section: str, values: Mapping[str, Any], origin: str) -> None:
        """Merge values into a section, and keep their origin."""
        self.values[section] = merged(self.values.get(section, {}), values)
        for path, _ in leaves(dict(values)):
            self.origins[(section, *path)] = origin

    def forget(self, path: KeyPath) -> None:
        """Drop the origins of a path, its children and its parents, before it is replaced."""
        for known in list(self.origins):
            if known[: len(path)] == path or path[: len(known)] == known:
                del self.origins[known]
                self.keys.pop(known, None)

    def origin(self, path: KeyPath, *, key: bool = False) -> str:
        """Origin of the value (or key) at a path, else of its nearest parent, else of its first child."""
        if key and path in self.keys:
            return self.keys[path]
        for length in range(len(path), 0, -1):
            if path[:length] in self.origins:
                return self.origins[path[:length]]
        held = [origin for known, origin in self.origins.items() if known[: len(path)] == path]
        return held[0] if held else ".".join(map(str, path))


@phase("configuration")
def resolve(
    task: Task,
    *,
    preset: str | None = None,
    config_file: Path | None = None,
    overrides: Sequence[str] = (),
    seed: int | None = None,
) -> RunConfig:
    """The configuration of a new run: defaults < preset < the task's suggestions < file < `--set`.

    Arguments:
        task: The task plugin.
        preset: draft, standard or fine; None takes the file's, else standard.
        config_file: A YAML file of the document form (any part of it).
        overrides: `KEY=VALUE` with dotted keys; a key without a section belongs to the task.
        seed: None takes the file's, else 0.

    Raises:
        ConfigError: At file:line:column or at the `--set` option.
    """
    document = load_yaml(config_file, empty_sections=True) if config_file else Document({}, "defaults")
    header = _header(task, document, preset, seed)
    layers = _Layers({section: {} for section in SECTIONS})
    layers.merge("learning", PRESET_LEARNING[header["preset"]], f"preset {header['preset']}")
    layers.merge("density", task.defaults.density, f"defaults of task {task.name}")
    layers.merge("learning", task.defaults.learning.get(header["preset"], {}), f"defaults of task {task.name}")
    _lay_file(layers, task, document)
    for override in parse_overrides(overrides):
        _lay_override(layers, task, override)
    return _build(task, header, layers)


def with_task_settings(task: Task, config: RunConfig, overrides: Sequence[str], *, option: str = "--set") -> RunConfig:
    """A run's configuration with other values of the task's own keys, to evaluate its designs with.

    Raises:
        ConfigError: At the option; also where the value would change the design space, or what is held out.
    """
    layers = _Layers({section: {} for section in SECTIONS})
    layers.merge("task", config.task.model_dump(mode="json"), FILE_NAME)
    for override in parse_overrides(overrides, option):
        first = str(override.path[0])
        learned = [name for name in SECTIONS[1:] if first in _models(task)[name].model_fields]
        if (first in SECTIONS[1:] and len(override.path) > 1) or (learned and first not in task.Config.model_fields):
            raise ConfigError(
                "what was learned cannot be changed", where=override.where, allowed=f"keys of the task {task.name}"
            )
        _lay_override(layers, task, override)
    judged = check_model(task.Config, layers.values["task"], layers.origin, "task")
    with plugin_guard(task.name):
        same = task.space(judged).as_dict() == task.space(config.task).as_dict()
        moved = moved_files(config.task, judged)
    if moved or not same:
        raise ConfigError(
            f"changes which files are held out: {', '.join(moved)}"
            if moved
            else "changes the design space that the run was learned in",
            where=f"{option} " + ", ".join(overrides),
            hint=f"learn another run with it: lidardesign learn {task.name} --set KEY=VALUE",
        )
    return replace(config, task=judged)


@phase("configuration")
def load_run_config(run: Path) -> tuple[Task, RunConfig]:
    """The task and configuration of a run folder, checked against the manifest.

    Raises:
        DataError: There is no such run, or its configuration is damaged or changed.
        ConfigError: It is of another version of this program, or its task is not installed.
        PluginError: The task is installed but broken.
    """
    run = Path(run)
    verify(run, FILE_NAME)
    document = load_yaml(run / FILE_NAME)
    try:
        return config_of(document)
    except UnknownPluginError as error:
        plugin = read_manifest(run).get("plugin")
        package, _, version = plugin.partition(" ") if is_name(plugin) else ("", "", "")
        raise UnknownPluginError(
            f"the task {document.mapping.get('task_name')!r} of this run is not installed"
            + (f"; it came with the package {package} {version}" if package else ""),
            where=str(run),
            allowed=error.allowed,
            hint=f"pip install {quote(f'{package}=={version}')}" if package else "install the package that has it",
        ) from None


def config_of(document: Document) -> tuple[Task, RunConfig]:
    """The task and configuration of a complete document, as from `RunConfig.as_document`.

    Raises:
        ConfigError: It is of another version of this program.
        PluginError: The task is installed but broken.
    """
    task = load_task(str(document.mapping.get("task_name")))
    layers = _Layers({section: {} for section in SECTIONS})
    header = _header(task, document, None, None)
    _lay_file(layers, task, document)
    return task, _build(task, header, layers)


def save_run_config(config: RunConfig, run: Path) -> None:
    """Write config.yaml into a run folder, with its hash always in the manifest."""
    write_recorded(run, FILE_NAME, dump_yaml(config.as_document()).encode())


def _header(task: Task, document: Document, preset: str | None, seed: int | None) -> dict[str, Any]:
    values = document.mapping
    unknown = [key for key in values if key not in (*HEADER, *SECTIONS)]
    if unknown:
        raise ConfigError(
            f"unknown section {unknown[0]!r}",
            where=document.locate((unknown[0],), key=True),
            allowed=", ".join((*HEADER, *SECTIONS)),
            hint=_meant(task, unknown[0]),
        )
    if values.get("schema_version", SCHEMA_VERSION) != SCHEMA_VERSION:
        raise ConfigError(
            f"schema version {values['schema_version']!r}",
            where=document.locate(("schema_version",)),
            allowed=str(SCHEMA_VERSION),
            hint="use the version of lidardesign that wrote it, or a newer one",
        )
    if values.get("task_name", task.name) != task.name:
        raise ConfigError(
            f"the file is for task {values['task_name']!r}",
            where=document.locate(("task_name",)),
            allowed=task.name,
        )
    chosen = preset or values.get("preset") or "standard"
    if chosen not in PRESETS:
        raise ConfigError(
            f"unknown preset {chosen!r}",
            where=document.locate(("preset",)) if preset is None else "--preset",
            allowed=", ".join(PRESETS),
        )
    root = values.get("seed", 0) if seed is None else seed
    if not isinstance(root, int) or isinstance(root, bool) or not 0 <= root <= MAX_SEED:
        raise ConfigError(
            f"seed {root!r}",
            where=document.locate(("seed",)) if seed is None else "--seed",
            allowed=f"a whole number from 0 to {MAX_SEED}",
        )
    return {"preset": chosen, "seed": root}


def _lay_file(layers: _Layers, task: Task, document: Document) -> None:
    is_of_run = Path(document.where).name == FILE_NAME
    for section in SECTIONS:
        values = document.mapping.get(section)
        if values is None:
            continue
        if not isinstance(values, dict):
            raise ConfigError(
                f"section {section!r} holds {values!r}",
                where=document.locate((section,), key=True),
                allowed="keys and values",
            )
        if is_of_run and section == "learning":
            values = {key: value for key, value in values.items() if key not in RETIRED}
        layers.values[section] = merged(layers.values[section], values)
        for path, _ in leaves(values, (section,)):
            for length in range(2, len(path) + 1):
                layers.origins[path[:length]] = document.locate(path[:length])
                layers.keys[path[:length]] = document.locate(path[:length], key=True)
    texts = {path[1:]: text for path, text in document.texts.items() if path[0] == "task"}
    keep_texts(layers.values["task"], task.Config, texts, Path(document.where).absolute().parent)


def _lay_override(layers: _Layers, task: Task, override: Override) -> None:
    path = override.path if override.path[0] in SECTIONS and len(override.path) > 1 else ("task", *override.path)
    layers.forget(path)
    path = apply_override(layers.values, replace(override, path=path))
    layers.origins[path] = override.where
    if path[0] == "task":
        texts = {(*path[1:], *within): text for within, text in override.texts.items()}
        keep_texts(layers.values["task"], task.Config, texts, Path.cwd())


def _models(task: Task) -> dict[str, type[BaseModel]]:
    """The model of each section."""
    return {"task": task.Config, "space": _SpaceSection, "density": DensitySettings, "learning": LearningSettings}


def _meant(task: Task, key: str, section: str = "") -> str | None:
    """Hint at a similar key of another section or a section's name, if it is closer than any of the given section."""
    models = _models(task)
    own = list(models[section].model_fields) if section else []
    keys = {name: f"{owner}.{name}" for owner, model in models.items() for name in model.model_fields}
    names = {**{name: name for name in models}, **keys}
    names |= {} if section else {name: name for name in HEADER}
    close = difflib.get_close_matches(key, [*own, *names], n=1)
    return f"did you mean {names[close[0]]!r}?" if close and close[0] not in own else None


def _check_keys(task: Task, layers: _Layers) -> None:
    """Refuse a key that belongs to another section, and name that section.

    Raises:
        ConfigError: At the key.
    """
    for section, model in _models(task).items():
        for key in layers.values[section]:
            hint = None if key in model.model_fields else _meant(task, str(key), section)
            if hint is not None:
                where, allowed = layers.origin((section, key), key=True), ", ".join(model.model_fields)
                raise ConfigError(f"unknown key '{section}.{key}'", where=where, allowed=allowed, hint=hint)


def _build(task: Task, header: dict[str, Any], layers: _Layers) -> RunConfig:
    _check_keys(task, layers)
    config = check_model(task.Config, layers.values["task"], layers.origin, "task")
    return RunConfig(
        task_name=task.name,
        seed=header["seed"],
        preset=header["preset"],
        task=config,
        density=check_model(DensitySettings, layers.values["density"], layers.origin, "density"),
        learning=check_model(LearningSettings, layers.values["learning"], layers.origin, "learning"),
        space=_space(task, config, layers),
    )


def _space(task: Task, config: TaskConfig, layers: _Layers) -> DesignSpace:
    given = layers.values["space"]
    if set(DIMENSIONS) <= set(given):
        base: dict[str, Any] = {}
    else:
        with plugin_guard(task.name):
            base = task.space(config).as_dict()
    section = check_model(_SpaceSection, {**base, **given}, layers.origin, "space")
    if section.range_m[0] == section.range_m[1]:
        found = f"space.range_m: found one range, {section.range_m[0]:g}, so that gates have no width"
        raise ConfigError(found, where=layers.origin(("space", "range_m")), allowed="[low, high]")
    try:
        return DesignSpace.from_dict(section.model_dump())
    except ConfigError as error:
        path: KeyPath = tuple((error.where or "space").split("."))
        raise ConfigError(
            f"{'.'.join(map(str, path))}: {error.message}", where=layers.origin(path), allowed=error.allowed
        ) from None
