"""What a shell may offer at the cursor: commands and options, as the parser lists them, and values of parameters."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

import typer

if TYPE_CHECKING:
    from pydantic import BaseModel

    from lidardesign.task import Task

    Items = Sequence[tuple[str, str]]

# of click's own copy inside typer, or of click where an older typer stands on it
_COMPLETION = importlib.import_module(f"{typer.Context.__mro__[1].__module__.rpartition('.')[0]}.shell_completion")
FILE, FOLDER, PATH = "files", "folders", "paths"
FILE_METAVARS = frozenset(("FILE", "MODEL", "FILE.html", "FILE.yaml", "MESH", "CAPTURE", "PATH", "NAME|FILE"))
FOLDER_METAVARS = frozenset(("DIR", "FOLDER"))
DESIGN_METAVARS = frozenset(("DESIGN", "OTHER", "RUN|DESIGN", "RIG"))
# Words between strokes that are written as they are meant; the others name what is to be filled in.
CHOICE = re.compile(r"[a-z0-9][a-z0-9-]*")
DESIGN_SUFFIXES = (".yaml", ".yml", ".csv", ".npz", ".xml", ".sdf")
MANIFEST, CONFIGURATION = "manifest.json", "config.yaml"
PACKAGE = Path(__file__).parents[1]
# `evaluate --baseline` takes these, and says so where it is given another; scores of them are not needed to list them.
BASELINES = {
    "uniform": "even over the whole design space",
    "random": "random over the whole design space",
    "bounding": "one even grid cropped to the training returns",
    "silhouette": "a hexagonal lattice where training scenes return, a gate per ray",
    "lloyd": "as silhouette, denser where returns are frequent and surfaces large",
    "greedy": "chosen on training scenes, without a density",
    "occupancy": "rays towards cells that targets occupy",
    "no-visibility": "the first design without its occlusion term",
    "cma": "direct optimisation on training scenes",
}
# Marks the place of the cursor in a line that is split.
CURSOR = "\x01"


class ShellCompletion(_COMPLETION.ShellComplete):  # type: ignore[misc, name-defined]
    """Candidates for zsh and fish, which pass the words behind the program's name as arguments.

    The answer is the type of the candidates on one line (plain, files, folders or paths), then a line for each: the
    whole word, and behind a tab what it is. Files and folders the shell lists itself.
    """

    def source_vars(self) -> dict[str, str]:
        """Nothing: the scripts of `lidardesign completion` name the program."""
        return {}

    def get_completion_args(self) -> tuple[list[str], str]:
        """The words before the one at the cursor, and that one as far as it is typed."""
        return sys.argv[1:-1], sys.argv[-1]

    def get_completions(self, args: list[str], incomplete: str) -> list[Any]:
        """The candidates; behind `--option=` with the option in front."""
        add_values(self.cli)
        items = [item for item in super().get_completions(args, incomplete) if item.value.isprintable()]
        option, equals, _ = incomplete.partition("=")
        if equals and option.startswith("-"):
            for item in items:
                item.value = f"{option}={item.value}"
        return items

    def format_completion(self, item: Any) -> str:
        """A candidate and the first sentence of what it is."""
        sentence, _, _ = " ".join((item.help or "").split()).partition(". ")
        return f"{item.value}\t{sentence.rstrip('.')}"

    def complete(self) -> str:
        """The answer to the shell."""
        items = self.get_completions(*self.get_completion_args())
        return "\n".join([items[0].type if items else "plain", *map(self.format_completion, items)])


class BashCompletion(ShellCompletion):
    """Candidates for bash, which takes words apart at = and : and replaces what stands behind the last of them."""

    BREAKS = "=:"
    QUOTED = frozenset(" \t'\"\\$`!&;|<>()*?[]{}#~")
    # More is to follow on these, without a space.
    OPEN_ENDS = ("=", ":", ",")

    def complete(self) -> str:
        """The answer to the shell; `open` is the type of candidates that no space follows."""
        line, point = os.environ.get("COMP_LINE", ""), os.environ.get("COMP_POINT", "")
        words, in_quotes = split_line(line, int(point) if point.isdecimal() else len(line))
        items = self.get_completions(words[1:-1], words[-1] if len(words) > 1 else "")
        kind = items[0].type if items else "plain"
        if kind == "plain" and items and all(item.value.endswith(self.OPEN_ENDS) for item in items):
            kind = "open"
        # within quotes bash takes no words apart, and reads what it is given as it is
        start = 0 if in_quotes else 1 + max(words[-1].rfind(mark) for mark in self.BREAKS)
        values = [item.value[start:] for item in items]
        if kind != PATH and not in_quotes:
            values = ["".join(f"\\{mark}" if mark in self.QUOTED else mark for mark in value) for value in values]
        return "\n".join([kind, *values])


def split_line(line: str, point: int) -> tuple[list[str], bool]:
    """The words of a line up to the cursor, the last one as far as it is typed, and whether it is in open quotes."""
    for closing in ("", '"', "'"):
        try:
            words = shlex.split(line[:point] + CURSOR + closing)
        except ValueError:
            continue
        return [*words[:-1], words[-1].removesuffix(CURSOR)], bool(closing)
    return [""], False


def add_values(command: Any) -> None:
    """Give every parameter of a command, and of those below it, the candidates for its values."""
    command.short_help = command.get_short_help_str(80)  # the parser's own lists cut it shorter
    for parameter in command.params:
        parameter.shell_complete = partial(values_of, parameter)
    for subcommand in getattr(command, "commands", {}).values():
        add_values(subcommand)


def values_of(parameter: Any, context: Any, incomplete: str) -> list[Any]:
    """The candidates for the value of an option or argument, in the form of the parser."""
    metavar, item = str(parameter.metavar), _COMPLETION.CompletionItem
    if parameter.param_type_name == "argument" and context.args:  # words that no parameter takes
        return []
    source = source_of(context.command_path.partition(" ")[2], parameter)
    pairs = source(context, incomplete) if source is not None else ()
    items = [item(value, help=words) for value, words in pairs if value.startswith(incomplete)]
    if items:
        return items
    if metavar in DESIGN_METAVARS or metavar == "RUN":
        pairs = paths(incomplete, designs=metavar in DESIGN_METAVARS)
        return [item(value, type=PATH, help=words) for value, words in pairs]
    if metavar in FOLDER_METAVARS:
        return [item(incomplete, type=FOLDER)]
    return [item(incomplete, type=FILE)] if metavar in FILE_METAVARS else []


def source_of(command: str, parameter: Any) -> Any:
    """What lists the values of an option or argument of a command; None where nothing does."""
    metavar = str(parameter.metavar)
    by_option = {
        "--format": _formats,
        "--baseline": _baselines,
        "--designs": _design_names,
        "--fail-unless-better": _rivals,
        "--detector": _detectors,
        "--effects": _effects,
        "--at": _conditions,
        "--weight": _weights,
    }
    if parameter.opts[0] in by_option:
        return by_option[parameter.opts[0]]
    if metavar == "KEY=VALUE":
        return _constraint_keys if command == "constrain" else _configuration_keys
    if metavar == "TASK" or (metavar == "NAME" and command in ("tasks show", "tasks check")):
        return _tasks
    if metavar == "NAME" and command == "catalog show":
        return _parts
    choices = [(word, "") for word in metavar.split("|") if CHOICE.fullmatch(word)]
    return (lambda context, current: choices) if choices else None


def _tasks(context: Any, current: str) -> Items:
    # none of them is imported
    from importlib.metadata import entry_points

    return [(name, "a task") for name in sorted({entry.name for entry in entry_points(group="lidardesign.tasks")})]


def _formats(context: Any, current: str) -> Items:
    from lidardesign.export.registry import EXPORTERS

    return [(name, exporter.summary) for name, exporter in EXPORTERS.items()]


def _parts(context: Any, current: str) -> Items:
    return [(path.stem, "a part") for path in sorted((PACKAGE / "design" / "catalog" / "parts").glob("*.yaml"))]


def _detectors(context: Any, current: str) -> Items:
    presets = sorted((PACKAGE / "simulate" / "detector" / "presets").glob("*.yaml"))
    return [(name, "a detector") for name in dict.fromkeys(("ideal", *(path.stem for path in presets)))]


def _baselines(context: Any, current: str) -> Items:
    return list(BASELINES.items())


def _design_names(context: Any, current: str) -> Items:
    files = [file for run in _given(context, "RUN|DESIGN") for file in sorted(Path(run).glob("designs/*.yaml"))]
    return [(name, "a design") for name in dict.fromkeys(file.stem for file in files)]


def _rivals(context: Any, current: str) -> Items:
    return [*_design_names(context, current), *_baselines(context, current)]


def _effects(context: Any, current: str) -> Items:
    from lidardesign.simulate.detector.detector import EFFECTS

    before, comma, _ = current.rpartition(",")
    words = () if comma else ("auto", "all", "none", "audit")
    names = (*words, *(name for name in EFFECTS if name not in before.split(",")))
    return [(f"{before}{comma}{name}", "an effect") for name in names]


def _conditions(context: Any, current: str) -> Items:
    space = _run_document(context).get("space")
    names = space.get("condition") if isinstance(space, dict) else None
    return [(f"{name}=", "a condition") for name in names or () if isinstance(name, str)]


def _weights(context: Any, current: str) -> Items:
    task = _task_of_run(context)
    keys = () if task is None else _keys(task.Config, "", current)
    return [item for item in keys if item[0].partition("=")[0] in getattr(task, "weighing_keys", ())]


def _configuration_keys(context: Any, current: str) -> Items:
    """Keys of a task's configuration, or behind `=` the values of one that has few.

    Of a run only those of the task itself: the density was learned.
    """
    from lidardesign.config import DensitySettings, LearningSettings
    from lidardesign.registry import load_task
    from lidardesign.space import DIMENSIONS

    name = next(_given(context, "TASK"), None)
    if name is None:
        task = _task_of_run(context)
        return [] if task is None else list(_keys(task.Config, "", current))
    items = list(_keys(load_task(name).Config, "", current))
    items += _keys(DensitySettings, "density.", current)
    items += _keys(LearningSettings, "learning.", current)
    items += [(f"space.{name}=", "bounds, as [0,1]") for name in (*DIMENSIONS, "condition")]
    if current.startswith("space.measure="):
        items += [("space.measure=solid_angle", ""), ("space.measure=angles", "")]
    return items


def _constraint_keys(context: Any, current: str) -> Items:
    from lidardesign.design.constraints.document import Constraints

    return [item for item in _keys(Constraints, "", current) if not item[0].startswith("each")]


def _keys(model: type[BaseModel], prefix: str, current: str) -> Iterator[tuple[str, str]]:
    """The dotted keys of a model that hold values, each with =; the values of one that is typed already."""
    from lidardesign.run.validation import nested_model

    for name, info in model.model_fields.items():
        nested = nested_model(info.annotation)
        if nested is not None and get_origin(info.annotation) is not list:
            yield from _keys(nested, f"{prefix}{name}.", current)
            continue
        key = f"{prefix}{name}="
        words = _words_of(info.annotation) if current.startswith(key) else ()
        yield from ((f"{key}{word}", "") for word in words) if words else [(key, info.description or "")]


def _words_of(annotation: Any) -> tuple[str, ...]:
    if get_origin(annotation) is Literal:
        return tuple(str(value) for value in get_args(annotation))
    words = tuple(word for part in get_args(annotation) for word in _words_of(part))
    return ("true", "false") if annotation is bool else words


def _given(context: Any, *metavars: str) -> Iterator[str]:
    """The values of parameters on the command line so far, of those with a metavar among some."""
    for parameter in context.command.params:
        if str(parameter.metavar) not in metavars:
            continue
        value = context.params.get(parameter.name)
        if not value and parameter.param_type_name == "argument":
            # the parser leaves arguments here while the last option waits for its value
            value = context.args
        yield from map(str, value if isinstance(value, list | tuple) else () if value is None else (value,))


def _task_of_run(context: Any) -> Task | None:
    from lidardesign.registry import load_task

    name = _run_document(context).get("task_name")
    return load_task(name) if isinstance(name, str) else None


def _run_document(context: Any) -> Mapping[str, Any]:
    """The configuration of the run that a command line names, or that one of its designs lies in; else nothing."""
    from lidardesign.errors import ConfigError
    from lidardesign.run.yaml import load_yaml

    for word in _given(context, "RUN", "RUN|DESIGN", "DESIGN"):
        path = Path(os.path.expanduser(word))
        for folder in (path, path.parent.parent):
            if (folder / CONFIGURATION).is_file():
                try:
                    return load_yaml(folder / CONFIGURATION).mapping
                except ConfigError:
                    return {}
    return {}


def paths(current: str, *, designs: bool) -> Iterator[tuple[str, str]]:
    """Runs and, where they are wanted, designs that a path can become; folders on the way to them end in a stroke."""
    typed, _, beginning = current.rpartition("/")
    shown = f"{typed}/" if "/" in current else ""
    folder = Path(os.path.expanduser(shown or "."))
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return
    if designs and (folder / MANIFEST).is_file():
        yield from (item for item in _designs(folder, shown.rstrip("/")) if item[0].startswith(current))
        return
    for entry in entries:
        if not entry.name.startswith(beginning) or (entry.name.startswith(".") and not beginning.startswith(".")):
            continue
        path = shown + entry.name
        if entry.is_file():
            if designs and entry.name.endswith(DESIGN_SUFFIXES) and entry.name != CONFIGURATION:
                yield path, "a design"
        elif (folder / entry.name / MANIFEST).is_file():
            yield path, "a run"
            if designs:
                yield from _designs(folder / entry.name, path)
        elif entry.is_dir():
            yield f"{path}/", ""


def _designs(run: Path, shown: str) -> Iterator[tuple[str, str]]:
    for design in sorted((run / "designs").glob("*.yaml")):
        yield f"{shown}/designs/{design.name}", f"a design of {run.name}"
