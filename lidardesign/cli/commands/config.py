"""`lidardesign config`: a configuration file to begin with, and the schemas of files.

The file that `config init` writes: every key of a task's configuration, its default, and what it is.

JSON Schemas of what this program reads and prints, made of the models that check it.
"""

from __future__ import annotations

import json
import json as json_format
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.output import Output, command
from lidardesign.cli.streams import is_output, note_new_folders, put_on_stdout
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.workflow.runs import check_choice

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

    from lidardesign.task import Task


KINDS = ("config", "constraints", "design", "evaluate")
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", help="File to write; one that is there is kept.", show_default="stdout"),
]

config_app = typer.Typer(
    help="Write a configuration file to begin with, or the schema of a file.", no_args_is_help=True
)


@config_app.command("init")
def init(
    task: Annotated[str, typer.Argument(metavar="TASK", help="Name of a task; `lidardesign tasks` lists them.")],
    preset: options.Preset = None,
    overrides: options.Overrides = None,
    out: Out = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write a configuration file for TASK: every key with its default, its bounds and what it is."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        _check_new(out)
        with phase("libraries"):
            from lidardesign.registry import load_task

        plugin = load_task(task)
        document, chosen = _chosen(plugin, preset, overrides or [], seed)
        text = config_text(plugin, document, chosen)
        _give(text, {"task": plugin.name, "config": document, "text": text}, out, console)


def _chosen(task: Task, preset: str | None, overrides: list[str], seed: int | None) -> tuple[dict[str, Any], Chosen]:
    """The configuration to write, and what of it was chosen.

    Raises:
        ConfigError: A choice says nothing that the task takes.
    """
    from lidardesign.cli.output import plain_json
    from lidardesign.config import PRESETS, SECTIONS, parse_override, resolve

    paths = [parse_override(text).path for text in overrides]
    keys = frozenset(
        (str(path[0]), str(path[1])) if path[0] in SECTIONS and len(path) > 1 else ("task", str(path[0]))
        for path in paths
    )
    name = check_choice(preset or "standard", "--preset", PRESETS)
    chosen = Chosen(name, seed, keys, named=preset is not None)
    try:
        settings = resolve(task, preset=preset, overrides=overrides, seed=seed).as_document()
    except ConfigError:
        if overrides:
            raise
        # something that the task needs has no default
        settings = default_document(task, name)
    return plain_json(settings), chosen


@config_app.command("schema")
def schema(
    kind: Annotated[str, typer.Argument(metavar="|".join(KINDS), help="What the schema is of.")],
    task: Annotated[
        str | None,
        typer.Option(
            "--task", metavar="TASK", help="Of a configuration: with the keys of this task.", show_default=False
        ),
    ] = None,
    out: Out = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print the JSON Schema of a configuration, a constraint file, a design file, or what `evaluate --json` prints."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        check_choice(kind, "KIND", KINDS)
        if task is not None and kind != "config":
            raise ConfigError(f"the schema of {kind} has no task", where="--task", allowed="with config")
        _check_new(out)
        with phase("libraries"):
            from lidardesign.registry import load_task

        found = schema_of(kind, None if task is None else load_task(task))
        text = json_format.dumps(found, indent=2, ensure_ascii=False) + "\n"
        _give(text, {"kind": kind, "schema": found}, out, console)


def _check_new(out: Path | None) -> None:
    """Refuse a file that is there: it may hold somebody's settings.

    Raises:
        ConfigError: It is.
    """
    if out is not None and not is_output(out) and out.exists():
        raise ConfigError("is there already", where=f"--out {out}", hint="give another --out, or remove it")


def _give(text: str, document: dict[str, Any], out: Path | None, console: Output) -> None:
    """Write a text, or print it where no file is named."""
    from lidardesign.run.files import write_atomic

    to_file = out is not None and not is_output(out)
    if to_file:
        note_new_folders([Path(str(out))], console)
        with phase("writing"):
            write_atomic(Path(str(out)), text)
    if console.json:
        console.result({**document, "out": str(out) if to_file else None}, lambda rich: None)
    elif to_file:
        console.note(f"wrote {out}")
    else:
        put_on_stdout(text.encode(errors="backslashreplace"))


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
    from lidardesign.config import DensitySettings, LearningSettings

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
    from lidardesign.config import PRESET_LEARNING, DensitySettings, LearningSettings

    learning = {**PRESET_LEARNING[preset], **task.defaults.learning.get(preset, {})}
    return {
        "task": _defaults(task.Config, {}),
        "space": None,
        "density": _defaults(DensitySettings, task.defaults.density),
        "learning": _defaults(LearningSettings, learning),
    }


def _defaults(model: type[BaseModel], suggested: Mapping[str, Any]) -> dict[str, Any]:
    from lidardesign.cli.output import plain_json

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
    from lidardesign.cli.commands.tasks import kind_of_value

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


DIALECT = "https://json-schema.org/draft/2020-12/schema"
EVALUATE_SCHEMA = Path(__file__).parents[2] / "evaluate" / "evaluate.schema.json"
NULL = {"type": "null"}
NUMBER = {"type": "number"}


def schema_of(kind: str, task: Task | None = None) -> dict[str, Any]:
    """The schema of a kind of document.

    Arguments:
        kind: config, constraints, design or evaluate.
        task: Whose keys the section `task` of a configuration has; any by default.
    """
    if kind == "config":
        return config_schema(task)
    if kind == "constraints":
        return constraints_schema()
    if kind == "design":
        from lidardesign.design.files import SCHEMA_FILE

        return json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))
    return json.loads(EVALUATE_SCHEMA.read_text(encoding="utf-8"))


def config_schema(task: Task | None) -> dict[str, Any]:
    """The schema of `learn --config FILE`: any part of the document that a run keeps as config.yaml."""
    from lidardesign.config import MAX_SEED, PRESETS, SCHEMA_VERSION, DensitySettings, LearningSettings

    named = "" if task is None else f":{task.name}"
    definitions: dict[str, Any] = {}
    own = {"type": "object"} if task is None else _partial(task.Config, "task", definitions)
    return {
        "$schema": DIALECT,
        "$id": f"urn:lidardesign:config:{SCHEMA_VERSION}{named}",
        "title": "Configuration of a run" if task is None else f"Configuration of the task {task.name}",
        "type": "object",
        "additionalProperties": False,
        "properties": {
            "schema_version": {"const": SCHEMA_VERSION},
            "task_name": {"type": "string"} if task is None else {"const": task.name},
            "seed": {"type": "integer", "minimum": 0, "maximum": MAX_SEED},
            "preset": {"enum": [*PRESETS, None]},
            "task": _or_empty(own),
            "space": _or_empty(_space_schema()),
            "density": _or_empty(_partial(DensitySettings, "density", definitions)),
            "learning": _or_empty(_partial(LearningSettings, "learning", definitions)),
        },
        "$defs": definitions,
    }


def _partial(model: Any, section: str, definitions: dict[str, Any]) -> dict[str, Any]:
    """A model's schema without required keys, which --set may give; what it refers to goes to the definitions."""
    schema = model.model_json_schema(ref_template=f"#/$defs/{section}.{{model}}")
    for name, part in schema.pop("$defs", {}).items():
        definitions[f"{section}.{name}"] = part
    schema.pop("required", None)
    return schema


def _or_empty(schema: dict[str, Any]) -> dict[str, Any]:
    """A section that may be there without a key, which YAML reads as null."""
    return {"anyOf": [schema, NULL]}


def _space_schema() -> dict[str, Any]:
    from lidardesign.space import DIMENSIONS

    pair = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
    bounds = {"anyOf": [NUMBER, pair], "description": "bounds [low, high], or one number that fixes it"}
    return {
        "type": "object",
        "additionalProperties": False,
        "properties": {
            **dict.fromkeys(DIMENSIONS, bounds),
            "condition": {"type": "array", "items": {"enum": list(DIMENSIONS)}},
            "measure": {"enum": ["solid_angle", "angles"]},
        },
    }


def constraints_schema() -> dict[str, Any]:
    """The schema of `constrain --constraints FILE`."""
    from lidardesign.design.constraints.document import CATALOG, Constraints

    schema = _with_empty_keys(Constraints.model_json_schema())
    snap = schema["$defs"]["Snap"]
    schema["$defs"]["Snap"] = {"anyOf": [{"const": CATALOG}, snap], "description": snap.pop("description", "")}
    return {"$schema": DIALECT, "$id": "urn:lidardesign:constraints:1", **schema, "title": "Constraints of a design"}


def _with_empty_keys(schema: dict[str, Any]) -> dict[str, Any]:
    """A schema whose keys may all be left empty, as the reader of constraints takes them."""
    for part in (schema, *schema.get("$defs", {}).values()):
        for name, value in part.get("properties", {}).items():
            if name not in part.get("required", ()):
                part["properties"][name] = {"anyOf": [value, NULL]}
    return schema
