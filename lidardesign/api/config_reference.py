"""The reference of configurations: a file to begin with, the keys of a task in words, and the schemas of files."""

from __future__ import annotations

import contextlib
import inspect
import json
import re
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

from lidardesign.config import (
    PRESET_LEARNING,
    PRESETS,
    SCHEMA_VERSION,
    SECTIONS,
    DensitySettings,
    LearningSettings,
    resolve,
)
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, check_choice
from lidardesign.limits import MAX_SEED
from lidardesign.plugins import plugin_guard
from lidardesign.run.validation import parse_override
from lidardesign.run.yaml import dump_yaml
from lidardesign.sensors.design_file import DesignFile
from lidardesign.space import DIMENSIONS

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

    from lidardesign.task import Task

SCHEMA_KINDS = ("config", "constraints", "design", "evaluate")
EVALUATE_SCHEMA = Path(__file__).parents[1] / "evaluation" / "evaluate.schema.json"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
NULL = {"type": "null"}
WIDTH = 110
INDENT = "  "
# What stands before a key that keeps its default; comments have a space behind it.
OFF = "#"
KINDS = {int: "whole number", float: "number", str: "text", bool: "true or false", type(None): "null"}
BOUNDS = {"ge": "from {}", "gt": "above {}", "le": "to {}", "lt": "below {}"}
UNREADABLE = re.compile(r"[^\x20-\x7e\xa0-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")
HEAD = """\
Configuration of the task {name}: {summary}
Scored by {metric} [{unit}], {better} is better.

Lines that begin with {off}KEY show the default: remove the {off} to set them. Keys left out keep their defaults.
Use it as: lidardesign learn --config FILE"""
SPACE_WORDS = "bounds [LOW, HIGH] of every dimension, or one number that fixes it; they follow from the task"
DIMENSION_WORDS = {"condition": "dimensions that are given, not designed", "measure": "solid_angle or angles"}


def describe_task(task: Task) -> dict[str, Any]:
    """A task's metric, design space, defaults and the keys of its configuration, as plain values."""
    from lidardesign.task import metric_of

    metric, defaults = task.metric, task.defaults
    space = None  # where the user must set something first
    if not any(info.is_required() for info in task.Config.model_fields.values()):
        with contextlib.suppress(ConfigError), plugin_guard(task.name):
            space = task.space(task.Config()).as_dict()
            metric = metric_of(task, task.Config())
    return {
        "name": task.name,
        "summary": task.summary,
        "metric": {"name": metric.name, "unit": metric.unit, "better": metric.better, "worst": metric.worst},
        "config": _describe_keys(task.Config, {}),
        "density": _describe_keys(DensitySettings, defaults.density),
        "learning": _describe_keys(LearningSettings, defaults.learning.get("standard", {})),
        "space": space,
        "defaults": {
            "level": defaults.level,
            "rays": list(defaults.rays),
        },
    }


def _describe_keys(model: type[BaseModel], suggested: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The keys of a section, those that it shares with others last, and what a task suggests instead of defaults."""
    own = inspect.get_annotations(model)
    return [
        {
            "key": name,
            "type": kind_of_value(info.annotation),
            "required": info.is_required(),
            "default": suggested.get(name, _default(info)),
            "description": info.description or "",
        }
        for name, info in sorted(model.model_fields.items(), key=lambda field: field[0] not in own)
    ]


def _default(info: FieldInfo) -> Any:
    value = None if info.is_required() else info.get_default(call_default_factory=True)
    return value.model_dump(mode="json") if hasattr(value, "model_dump") else value


def kind_of_value(annotation: Any) -> str:
    """The type of a key in words: `number`, `3 numbers`, `auto or mm or m`, `path or null`."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return kind_of_value(parts[0])
    if origin in (Literal, Union, UnionType):
        return " or ".join(str(part) if origin is Literal else kind_of_value(part) for part in parts)
    if origin is tuple and len(set(parts)) == 1:
        return f"{len(parts)} {kind_of_value(parts[0])}s"
    if origin in (list, tuple, set) and parts:
        return f"list of {kind_of_value(parts[0])}s"
    if origin is dict:
        return f"{kind_of_value(parts[1])}s by name"
    if isinstance(annotation, type) and issubclass(annotation, Path):
        return "path"
    return KINDS.get(annotation) or getattr(annotation, "__name__", str(annotation))


def config_template(
    task: Task, *, preset: str | None = None, overrides: Sequence[str] = (), seed: int | None = None
) -> tuple[dict[str, Any], str]:
    """The configuration of a task and the text of a starting file that sets only what is given here.

    Raises:
        ConfigError: A preset or setting that the task does not take.
    """
    chosen = {
        (str(path[0]), str(path[1])) if path[0] in SECTIONS and len(path) > 1 else ("task", str(path[0]))
        for path in (parse_override(text).path for text in overrides)
    }
    name = check_choice(preset or "standard", "--preset", PRESETS)
    if preset is not None:
        chosen.add(("", "preset"))
    try:
        document = resolve(task, preset=preset, overrides=overrides, seed=seed).as_document()
    except ConfigError:
        if overrides:
            raise
        # something that the task needs has no default
        document = default_document(task, name)
    return document, config_text(task, document, name, seed, chosen)


def default_document(task: Task, preset: str) -> dict[str, Any]:
    """The defaults of a task with required keys, from which alone no valid configuration follows."""

    def defaults_of(model: type[BaseModel], suggested: Mapping[str, Any]) -> dict[str, Any]:
        return {key: suggested.get(key, _default(info)) for key, info in model.model_fields.items()}

    learning = {**PRESET_LEARNING[preset], **task.defaults.learning.get(preset, {})}
    return {
        "task": defaults_of(task.Config, {}),
        "space": None,
        "density": defaults_of(DensitySettings, task.defaults.density),
        "learning": defaults_of(LearningSettings, learning),
    }


def config_text(
    task: Task,
    document: Mapping[str, Any],
    preset: str,
    seed: int | None = None,
    chosen: Collection[tuple[str, str]] = (),
) -> str:
    """The YAML text of a configuration, with comments.

    Arguments:
        task: The task.
        document: Its configuration, as `RunConfig.as_document` gives it; a section `space` of None is not known.
        preset: The preset whose defaults are shown.
        seed: The seed, where one was given.
        chosen: Sections and keys that are set, and ("", "preset"); all others are commented out.
    """
    metric = task.metric
    head = HEAD.format(
        name=task.name, summary=task.summary, metric=metric.name, unit=metric.unit, better=metric.better, off=OFF
    )
    lines = [*_comment(head), _entry("schema_version", 1, on=True), _entry("task_name", task.name, on=True)]
    lines += ["", *_comment("seed of all random numbers; whole number from 0")]
    lines.append(_entry("seed", seed or 0, on=seed is not None))
    lines += _comment("effort of learning: draft, standard or fine")
    lines.append(_entry("preset", preset, on=("", "preset") in chosen))
    lines += ["", "task:", *_section("task", task.Config, document, chosen)]
    lines += ["", *_comment(SPACE_WORDS), "space:"]
    space = document["space"] or dict.fromkeys(DIMENSIONS, ("LOW", "HIGH"))
    for key, value in space.items():
        if key in DIMENSION_WORDS:
            lines += _comment(DIMENSION_WORDS[key], INDENT)
        lines.append(textwrap.indent(_entry(key, value, on=("space", key) in chosen), INDENT))
    lines += ["", "density:", *_section("density", DensitySettings, document, chosen)]
    lines += ["", *_comment(f"the flow and its training, of preset {preset}"), "learning:"]
    lines += _section("learning", LearningSettings, document, chosen)
    return "\n".join(lines) + "\n"


def _section(
    name: str, model: type[BaseModel], document: Mapping[str, Any], chosen: Collection[tuple[str, str]]
) -> Iterator[str]:
    for key, info in model.model_fields.items():
        words = " ".join([kind_of_value(info.annotation), *_bounds(info)]) + ("; needed" if info.is_required() else "")
        yield from _comment(f"{info.description}; {words}" if info.description else words, INDENT)
        yield textwrap.indent(_entry(key, document[name].get(key), on=(name, key) in chosen), INDENT)


def _bounds(info: FieldInfo) -> Sequence[str]:
    bounds = [
        words.format(f"{getattr(part, name):g}")
        for part in info.metadata
        for name, words in BOUNDS.items()
        if isinstance(getattr(part, name, None), int | float)
    ]
    return sorted(bounds, key=lambda words: words.startswith(("to", "below")))


def _comment(text: str, indent: str = "") -> list[str]:
    """Text as wrapped comment lines, without control characters."""
    lines = []
    for part in text.split("\n"):
        plain = UNREADABLE.sub(" ", " ".join(part.split()))
        lines += textwrap.wrap(plain, WIDTH - len(indent) - 2, break_long_words=False) or [""]
    return [f"{indent}# {line}".rstrip() for line in lines]


def _entry(key: str, value: Any, *, on: bool) -> str:
    text = dump_yaml({key: value}).rstrip("\n")
    if text.startswith("{") and text.endswith("}"):  # a single value, which stands on a line of its own here
        text = text[1:-1]
    return text if on else textwrap.indent(text, OFF)


def schema_of(kind: str, task: Task | None = None) -> dict[str, Any]:
    """The JSON Schema of a kind of document.

    Arguments:
        kind: config, constraints, design or evaluate.
        task: The task whose keys the section `task` of a configuration has; any by default.
    """
    if kind == "config":
        return _config_schema(task)
    if kind == "constraints":
        # The schema of `constrain --constraints FILE`, whose keys may all be left out, and not left empty
        schema = Constraints.model_json_schema()
        for part in (schema, *schema.get("$defs", {}).values()):
            for value in part.get("properties", {}).values():
                if "anyOf" in value:
                    value["anyOf"] = [one for one in value["anyOf"] if one != NULL]
        return {
            "$schema": DIALECT,
            "$id": "urn:lidardesign:constraints:1",
            **schema,
            "title": "Constraints of a design",
        }
    if kind == "design":
        return {"$schema": DIALECT, "$id": "urn:lidardesign:design:2", **DesignFile.model_json_schema()}
    return json.loads(EVALUATE_SCHEMA.read_text(encoding="utf-8"))


def _config_schema(task: Task | None) -> dict[str, Any]:
    """The schema of `learn --config FILE`: any part of the document that a run keeps as config.yaml."""
    definitions: dict[str, Any] = {}

    def section(model: Any, name: str) -> dict[str, Any]:
        # without required keys, which --set may give; what it refers to goes to the definitions
        schema = model.model_json_schema(ref_template=f"#/$defs/{name}.{{model}}")
        definitions.update({f"{name}.{key}": part for key, part in schema.pop("$defs", {}).items()})
        schema.pop("required", None)
        return schema

    bounds = {
        "anyOf": [{"type": "number"}, {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}],
        "description": "bounds [low, high], or one number that fixes it",
    }
    space = {
        "type": "object",
        "additionalProperties": False,
        "properties": {
            **dict.fromkeys(DIMENSIONS, bounds),
            "condition": {"type": "array", "items": {"enum": list(DIMENSIONS)}},
            "measure": {"enum": ["solid_angle", "angles"]},
        },
    }
    sections = {
        "task": {"type": "object"} if task is None else section(task.Config, "task"),
        "space": space,
        "density": section(DensitySettings, "density"),
        "learning": section(LearningSettings, "learning"),
    }
    return {
        "$schema": DIALECT,
        "$id": f"urn:lidardesign:config:{SCHEMA_VERSION}" + ("" if task is None else f":{task.name}"),
        "title": "Configuration of a run" if task is None else f"Configuration of the task {task.name}",
        "type": "object",
        "additionalProperties": False,
        "properties": {
            "schema_version": {"const": SCHEMA_VERSION},
            "task_name": {"type": "string"} if task is None else {"const": task.name},
            "seed": {"type": "integer", "minimum": 0, "maximum": MAX_SEED},
            "preset": {"enum": [*PRESETS, None]},
            # YAML reads a section that is there without a key as null
            **{name: {"anyOf": [schema, NULL]} for name, schema in sections.items()},
        },
        "$defs": definitions,
    }
