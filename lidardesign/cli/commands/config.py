"""`lidardesign config`: a configuration file to begin with, and the schemas of files."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Annotated, Any

import typer

from lidardesign.choices.flag import complete
from lidardesign.choices.listings import InitCommand, SchemaCommand
from lidardesign.choices.shared import Brief
from lidardesign.cli.terminal.options import command_line, tasks
from lidardesign.cli.terminal.output import Output, announce
from lidardesign.errors import ConfigError, check_choice
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_writable

config_app = typer.Typer(help="Write a configuration file, or the schema of a file.", no_args_is_help=True)


@config_app.command("init")
@command_line(InitCommand, Brief)
def init(
    output: Output,
    task: Annotated[
        str,
        typer.Argument(metavar="TASK", help="Name of a task; `lidardesign tasks` lists them.", autocompletion=tasks),
    ],
    *,
    out: Path | None = None,
    **given: Any,
) -> None:
    """Write a configuration file for TASK. It lists every key with its default, bounds and meaning."""
    choices = complete(InitCommand, given)
    _check_new(out)
    with phase("libraries"):
        from lidardesign.api.config_reference import config_template
        from lidardesign.task import load_task

    plugin = load_task(task)
    document, text = config_template(
        plugin, preset=choices["preset"], overrides=choices["settings"], seed=choices["seed"]
    )
    _write(text, {"task": plugin.name, "config": document, "text": text}, out, output)


@config_app.command("schema")
@command_line(SchemaCommand, Brief)
def schema(
    output: Output,
    kind: Annotated[
        str,
        typer.Argument(
            metavar="config|constraints|design|evaluate",
            help="What the schema is of.",
            autocompletion=lambda: ["config", "constraints", "design", "evaluate"],
        ),
    ],
    *,
    task: str | None = None,
    out: Path | None = None,
) -> None:
    """Print a JSON Schema. KIND is config, constraints, design, or evaluate for what `evaluate --json` prints."""
    with phase("libraries"):
        from lidardesign.api.config_reference import SCHEMA_KINDS, schema_of
        from lidardesign.task import load_task

    check_choice(kind, "KIND", SCHEMA_KINDS)
    if task is not None and kind != "config":
        raise ConfigError(f"the schema of {kind} has no task", where="--task", allowed="with config")
    _check_new(out)
    document = schema_of(kind, None if task is None else load_task(task))
    text = json_format.dumps(document, indent=2, ensure_ascii=False)
    _write(f"{text}\n", {"kind": kind, "schema": document}, out, output)


def _check_new(out: Path | None) -> None:
    if out is None:
        return
    check_writable(out)
    if out.is_file():
        raise ConfigError("already exists", where=f"--out {out}", hint="give another --out, or remove it")


def _write(text: str, document: dict[str, Any], out: Path | None, output: Output) -> None:
    from lidardesign.run.files import write_atomic

    if out is not None:
        announce([out], output)
        with phase("writing"):
            write_atomic(out, text)
    if output.json:
        output.result({**document, "out": out}, lambda rich: None)
    elif out is not None:
        output.note(f"wrote {out}")
    else:
        print(text, end="")
