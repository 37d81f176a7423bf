"""`lidardesign config`: a configuration file to begin with, and the schemas of files."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.console import Console, command
from lidardesign.cli.outputs import tell_new_folders
from lidardesign.cli.runs import check_choice
from lidardesign.cli.streams import is_output, put_on_stdout
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from lidardesign.cli.config_text import Chosen
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
            from lidardesign.cli.config_text import config_text
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
    from lidardesign.cli.config_text import Chosen, default_document
    from lidardesign.cli.console import plain_json
    from lidardesign.density.settings import PRESETS
    from lidardesign.run.config import SECTIONS, resolve
    from lidardesign.run.overrides import parse_override

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
            from lidardesign.cli.schemas import schema_of
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


def _give(text: str, document: dict[str, Any], out: Path | None, console: Console) -> None:
    """Write a text, or print it where no file is named."""
    from lidardesign.run.files import write_atomic

    to_file = out is not None and not is_output(out)
    if to_file:
        tell_new_folders([Path(str(out))], console)
        with phase("writing"):
            write_atomic(Path(str(out)), text)
    if console.json:
        console.result({**document, "out": str(out) if to_file else None}, lambda rich: None)
    elif to_file:
        console.note(f"wrote {out}")
    else:
        put_on_stdout(text.encode(errors="backslashreplace"))
