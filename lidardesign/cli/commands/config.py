"""`lidardesign config`: a configuration file to begin with, and the schemas of files."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Annotated, Any

import typer

from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.options import tasks, words
from lidardesign.cli.terminal.output import Output, announce, command
from lidardesign.errors import ConfigError, check_choice
from lidardesign.run.clock import phase
from lidardesign.run.outputs import check_writable

Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", help="New file to write; none is overwritten.", show_default="stdout"),
]

config_app = typer.Typer(help="Write a configuration file, or the schema of a file.", no_args_is_help=True)


@config_app.command("init")
def init(
    task: Annotated[
        str,
        typer.Argument(metavar="TASK", help="Name of a task; `lidardesign tasks` lists them.", autocompletion=tasks),
    ],
    preset: options.Preset = None,
    overrides: options.Overrides = None,
    out: Out = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Write a configuration file for TASK. It lists every key with its default, bounds and meaning."""
    with command(json=json, quiet=quiet) as output:
        _check_new(out)
        with phase("libraries"):
            from lidardesign.api.config_reference import config_template
            from lidardesign.task import load_task

        plugin = load_task(task)
        document, text = config_template(plugin, preset=preset, overrides=overrides or (), seed=seed)
        _write(text, {"task": plugin.name, "config": document, "text": text}, out, output)


@config_app.command("schema")
def schema(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="config|constraints|design|evaluate",
            help="What the schema is of.",
            autocompletion=words("config|constraints|design|evaluate"),
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option("--task", metavar="TASK", help="With config: include the keys of this task.", show_default=False),
    ] = None,
    out: Out = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Print a JSON Schema. KIND is config, constraints, design, or evaluate for what `evaluate --json` prints."""
    with command(json=json, quiet=quiet) as output:
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
