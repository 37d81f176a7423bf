"""What an option or argument can be, by its metavar: tasks, runs, designs, keys, formats, parts, words, files."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lidardesign.cli.completing import FILES, FOLDERS, PATHS, WORDS, Answer, Line

Items = Sequence[tuple[str, str]]
DESIGN_SUFFIXES = (".yaml", ".yml", ".csv", ".npz", ".xml", ".sdf")
MANIFEST, CONFIGURATION = "manifest.json", "config.yaml"
# Words between strokes that are written as they are meant; the others name what is to be filled in.
CHOICE = re.compile(r"[a-z0-9][a-z0-9-]*")
FILE_NAMES = "FILE", "FILE.html", "FILE.yaml", "MESH", "CAPTURE", "PATH"
WITH_FILES = frozenset((*FILE_NAMES, "NAME|FILE", "auto|all|none|audit|LIST"))
WITH_FOLDERS = frozenset(("DIR", "FOLDER"))
WITH_RUNS = frozenset(("RUN",))
WITH_DESIGNS = frozenset(("DESIGN", "OTHER", "RUN|DESIGN", "RIG"))


def values_of(line: Line, parameter: Any, current: str) -> Answer:
    """What the value of an option or argument can be.

    Arguments:
        line: The command line so far.
        parameter: The option or argument.
        current: The value as far as it is typed.
    """
    metavar = str(parameter.metavar)
    source = source_of(line.name, parameter)
    if source is not None:
        items = [(value, words) for value, words in source(line, current) if value.startswith(current)]
        if items or metavar not in WITH_FILES:
            return Answer(WORDS, items)
    if metavar in WITH_DESIGNS or metavar in WITH_RUNS:
        return Answer(PATHS, list(paths(current, designs=metavar in WITH_DESIGNS)))
    if metavar in WITH_FOLDERS:
        return Answer(FOLDERS)
    return Answer(FILES) if metavar in WITH_FILES else Answer()


def source_of(command: str, parameter: Any) -> Callable[[Line, str], Items] | None:
    """What lists the values of an option or argument of a command; None where nothing does."""
    from lidardesign.cli import completion_names as names

    metavar, option = str(parameter.metavar), parameter.opts[0]
    by_option = {
        "--format": names.formats,
        "--baseline": names.baselines,
        "--detector": names.detectors,
        "--effects": names.effects,
        "--at": names.conditions,
        "--weight": names.weights,
    }
    if option in by_option:
        return by_option[option]
    if metavar == "KEY=VALUE":
        return names.constraint_keys if command == "constrain" else names.configuration_keys
    if metavar == "TASK" or (metavar == "NAME" and command in ("tasks show", "tasks check")):
        return names.tasks
    if metavar == "NAME" and command == "catalog show":
        return names.parts
    choices = [word for word in metavar.split("|") if CHOICE.fullmatch(word)]
    return (lambda line, current: [(word, "") for word in choices]) if choices else None


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
