"""The file that `config init` writes: every key of a task's configuration, its default, and what it is."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

    from lidardesign.task import Task

WIDTH = 110
INDENT = "  "
# What stands before a key that keeps its default; comments have a space behind it.
OFF = "#"
BOUNDS = {"ge": "from {}", "gt": "above {}", "le": "to {}", "lt": "below {}"}
UNREADABLE = re.compile(r"[^\x20-\x7e\xa0-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")
HEAD = """\
Configuration of the task {name}: {summary}
Scored by {metric} [{unit}], {better} is better.

Lines that begin with {off}KEY have the default: take the {off} away to set them. What is left out keeps its default.
Use it as: lidardesign learn {name} --config FILE"""
SPACE_WORDS = "bounds [LOW, HIGH] of every dimension, or one number that fixes it; they follow from the task"
DIMENSION_WORDS = {"condition": "dimensions that are given, not designed", "measure": "solid_angle or angles"}


@dataclass(frozen=True)
class Chosen:
    """What was chosen instead of defaults.

    Arguments:
        preset: The preset whose defaults are shown.
        seed: The seed, where one was given.
        keys: Sections and keys that were set.
        named: Whether the preset was given.
    """

    preset: str
    seed: int | None = None
    keys: frozenset[tuple[str, str]] = field(default_factory=frozenset)
    named: bool = False


def config_text(task: Task, document: Mapping[str, Any], chosen: Chosen) -> str:
    """The YAML text of a configuration, with comments.

    Arguments:
        task: The task.
        document: Its configuration, as `RunConfig.as_document` gives it; a section `space` of None is not known.
        chosen: What of it was chosen, and is set; all else is commented out.
    """
    from lidardesign.density.settings import DensitySettings, LearningSettings

    metric = task.metric
    head = HEAD.format(
        name=task.name, summary=task.summary, metric=metric.name, unit=metric.unit, better=metric.better, off=OFF
    )
    lines = [*_comment(head), _entry("schema_version", 1, on=True), _entry("task_name", task.name, on=True)]
    lines += ["", *_comment("root of every random stream; whole number from 0")]
    lines.append(_entry("seed", chosen.seed or 0, on=chosen.seed is not None))
    lines += _comment("effort of learning: draft, standard or fine")
    lines.append(_entry("preset", chosen.preset, on=chosen.named))
    lines += ["", "task:", *_section("task", task.Config, document, chosen)]
    lines += ["", *_comment(SPACE_WORDS), "space:", *_space(document["space"], chosen)]
    lines += ["", "density:", *_section("density", DensitySettings, document, chosen)]
    lines += ["", *_comment(f"the flow and its training, of preset {chosen.preset}"), "learning:"]
    lines += _section("learning", LearningSettings, document, chosen)
    return "\n".join(lines) + "\n"


def default_document(task: Task, preset: str) -> dict[str, Any]:
    """The defaults of a task that has none for something that it needs, so that no configuration follows."""
    from lidardesign.density.settings import PRESET_LEARNING, DensitySettings, LearningSettings

    learning = {**PRESET_LEARNING[preset], **task.defaults.learning.get(preset, {})}
    return {
        "task": _defaults(task.Config, {}),
        "space": None,
        "density": _defaults(DensitySettings, task.defaults.density),
        "learning": _defaults(LearningSettings, learning),
    }


def _defaults(model: type[BaseModel], suggested: Mapping[str, Any]) -> dict[str, Any]:
    from lidardesign.cli.console import plain_json

    own = {
        name: None if info.is_required() else info.get_default(call_default_factory=True)
        for name, info in model.model_fields.items()
    }
    return {name: plain_json(_dumped(suggested.get(name, value))) for name, value in own.items()}


def _dumped(value: Any) -> Any:
    return value.model_dump(mode="json") if hasattr(value, "model_dump") else value


def _section(name: str, model: type[BaseModel], document: Mapping[str, Any], chosen: Chosen) -> Iterator[str]:
    values = document[name]
    for key, info in model.model_fields.items():
        yield from _comment(_described(info), INDENT)
        yield textwrap.indent(_entry(key, values.get(key), on=(name, key) in chosen.keys), INDENT)


def _space(space: Mapping[str, Any] | None, chosen: Chosen) -> Iterator[str]:
    from lidardesign.space import DIMENSIONS

    known: Mapping[str, Any] = dict.fromkeys(DIMENSIONS, ("LOW", "HIGH")) if space is None else space
    for key, value in known.items():
        if key in DIMENSION_WORDS:
            yield from _comment(DIMENSION_WORDS[key], INDENT)
        yield textwrap.indent(_entry(key, value, on=("space", key) in chosen.keys), INDENT)


def _described(info: FieldInfo) -> str:
    from lidardesign.cli.tasks import kind_of_value

    kind = " ".join([kind_of_value(info.annotation), *bounds_of(info)])
    needed = "; needed" if info.is_required() else ""
    return f"{info.description}; {kind}{needed}" if info.description else f"{kind}{needed}"


def bounds_of(info: FieldInfo) -> Sequence[str]:
    """The bounds of a number, in words: `from 0`, `below 1`."""
    found = [
        words.format(f"{getattr(part, name):g}")
        for part in info.metadata
        for name, words in BOUNDS.items()
        if isinstance(getattr(part, name, None), int | float)
    ]
    return sorted(found, key=lambda words: words.startswith(("to", "below")))


def _comment(text: str, indent: str = "") -> list[str]:
    """Lines of comment; a task's own words may hold anything."""
    lines = []
    for part in text.split("\n"):
        plain = UNREADABLE.sub(" ", " ".join(part.split()))
        lines += textwrap.wrap(plain, WIDTH - len(indent) - 2, break_long_words=False) or [""]
    return [f"{indent}# {line}".rstrip() for line in lines]


def _entry(key: str, value: Any, *, on: bool) -> str:
    """A key and its value as YAML, commented out where it is a default."""
    from lidardesign.run.yaml import dump_yaml

    text = dump_yaml({key: list(value) if isinstance(value, tuple) else value}).rstrip("\n")
    if text.startswith("{") and text.endswith("}"):  # a single value, which stands on a line of its own here
        text = text[1:-1]
    return text if on else textwrap.indent(text, OFF)


def uncommented(text: str) -> str:
    """A file of `config_text` with every default set.

    Raises:
        ConfigError: It is no such file.
    """
    found, count = re.subn(rf"(?m)^( *){OFF}(?=\S)", r"\1", text)
    if not count:
        raise ConfigError("no default is commented out", where="config", hint="lidardesign config init TASK makes one")
    return found
